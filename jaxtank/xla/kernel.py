"""A loop over samples of many runs in one Pallas kernel: a block of runs to a program.

What it is for, estimated for an H100 in float64, 1e6 plants of 120,001 steps: about 600 operations
a step and plant are 7e13, 2 s at the 34e12 a second of its data sheet; with square roots and
divisions 5 to 7 s in a loop that keeps levels and sums in registers. As `jax.lax.scan` each step is
a launch of one fused kernel that reads and writes 100 bytes a plant: 15 to 25 s. It has been run by
Pallas's interpreter, and lowered to Triton, and not on a GPU yet: `tests/benchmarks/accelerator.py`
measures it there.
"""
# jax leaves the types of its trees partly open.
# pyright: reportUnknownMemberType=false, reportUnknownArgumentType=false
# pyright: reportUnknownVariableType=false, reportUnknownParameterType=false
# pyright: reportUnknownLambdaType=false

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax.extend.core import Literal

from jaxtank.xla.barrier import materialised
from jaxtank.xla.hoist import read, run

BARRIER = "_as_it_is"
"""Name of the call that `materialised` makes on a CPU, which stays one."""

CALLS = ("jit", "pjit", "custom_jvp_call", "custom_vjp_call", "closed_call")
"""Operations that call a program which they carry."""


class Unfit(ValueError):
    """A step that a kernel cannot hold."""


def looped(advance: Callable[..., Any], rows: Any, start: Any, xs: Any, block: int) -> Any:
    """Return the carry of N runs after the last sample, by programs that run a block each."""
    from jax.experimental import pallas as pl
    from jax.experimental.pallas import triton

    first = lambda tree: jax.tree.map(lambda v: v[:block], tree)
    now = jax.tree.map(lambda v: v[0], xs)
    traced = jax.make_jaxpr(advance)(first(rows), first(start), now)
    flat = jax.tree.leaves((first(rows), first(start), now))
    closed = jax.make_jaxpr(lambda *v: _inlined(traced.jaxpr, traced.consts, v))(*flat)
    moving, structure = jax.tree.flatten(start)
    shared, own, inside = _before(closed, jax.tree.leaves(rows), block)
    samples = jax.tree.leaves(xs)
    groups = [list(shared.values()), samples, list(own.values()), moving]
    size = sum(map(len, groups))

    def kernel(*refs: Any) -> None:
        given, parts = iter(refs[:size]), []
        for group in groups:
            parts.append([next(given) for _ in group])
        values = dict(zip((*shared, *own), (r[...] for r in (*parts[0], *parts[2]))))
        changing = closed.jaxpr.invars[len(jax.tree.leaves(rows)) :]

        def body(k: Any, carry: Any) -> Any:
            here = values | dict(zip(changing, (*carry, *(r[k] for r in parts[1]))))
            run(inside, here, {})
            return tuple(read(v, here, {}) for v in closed.jaxpr.outvars)

        last = jax.lax.fori_loop(0, samples[0].shape[0], body, tuple(r[...] for r in parts[3]))
        for ref, value in zip(refs[size:], last, strict=True):
            ref[...] = value

    def whole(v: Any) -> Any:
        return pl.BlockSpec(v.shape, lambda i: (0,) * v.ndim)

    def blocked(v: Any) -> Any:
        return pl.BlockSpec((block, *v.shape[1:]), lambda i: (i, *(0,) * (v.ndim - 1)))

    ended = pl.pallas_call(
        kernel,
        grid=(moving[0].shape[0] // block,),
        in_specs=[*map(whole, (*groups[0], *samples)), *map(blocked, (*groups[2], *moving))],
        out_specs=[blocked(v) for v in moving],
        out_shape=[jax.ShapeDtypeStruct(v.shape, v.dtype) for v in moving],
        compiler_params=triton.CompilerParams(),
        interpret=jax.default_backend() == "cpu",
    )
    return jax.tree.unflatten(structure, ended(*(v for group in groups for v in group)))


def _before(closed: Any, rows: list[Any], block: int) -> tuple[Any, Any, list[Any]]:
    """({variable: value} that is the same in all runs, {variable: (N, ...)} of each run, operations
    of the loop): what depends on neither state nor sample is computed once, before the loop.
    """
    jaxpr, lanes = closed.jaxpr, closed.jaxpr.invars[: len(rows)]
    same, of_run = set(jaxpr.constvars), set(lanes)
    once: list[Any] = []
    each: list[Any] = []
    inside: list[Any] = []
    for eqn in jaxpr.eqns:
        operands = [v for v in eqn.invars if not isinstance(v, Literal)]
        if all(v in same for v in operands):
            once.append(eqn)
            same.update(eqn.outvars)
        elif all(v in same or v in of_run for v in operands):
            each.append(eqn)
            of_run.update(eqn.outvars)
        else:
            inside.append(eqn)
    if any(len(v.aval.shape) > 1 for eqn in inside for v in eqn.outvars):
        raise Unfit
    known = dict(zip(jaxpr.constvars, map(jnp.asarray, closed.consts)))
    run(once, known, {})
    used = {v for eqn in inside for v in eqn.invars if not isinstance(v, Literal)}
    used |= {v for v in jaxpr.outvars if not isinstance(v, Literal)}
    wanted = [v for v in (*lanes, *(v for eqn in each for v in eqn.outvars)) if v in used]

    def prepare(*given: Any) -> Any:
        here = known | dict(zip(lanes, given))
        run(each, here, {})
        return [here[v] for v in wanted]

    parted = [v.reshape(-1, block, *v.shape[1:]) for v in rows]
    found = [v.reshape(-1, *v.shape[2:]) for v in jax.vmap(prepare)(*parted)]
    return {v: value for v, value in known.items() if v in used}, dict(zip(wanted, found)), inside


def _inlined(jaxpr: Any, constants: Any, arguments: Any) -> list[Any]:
    """What a traced program gives, with the programs that it calls written out: a kernel cannot
    call functions, and needs no rules for derivatives.
    """
    values: dict[Any, Any] = dict(zip((*jaxpr.constvars, *jaxpr.invars), (*constants, *arguments)))
    for eqn in jaxpr.eqns:
        inner = eqn.params.get("call_jaxpr", eqn.params.get("jaxpr"))
        given = [read(v, values, {}) for v in eqn.invars]
        if eqn.params.get("name") == BARRIER:
            values.update(zip(eqn.outvars, materialised(tuple(given))))
        elif eqn.primitive.name in CALLS:
            values.update(zip(eqn.outvars, _inlined(inner.jaxpr, inner.consts, given)))
        else:
            run([eqn], values, {})
    return [read(v, values, {}) for v in jaxpr.outvars]
