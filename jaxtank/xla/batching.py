"""Functions of which `jax.vmap` runs a limited number of elements at a time."""

import functools
import itertools
from collections.abc import Callable
from typing import Any

import jax
from jax.extend.core import ClosedJaxpr, Primitive, jaxpr_as_fun
from jax.interpreters import ad, batching, mlir

_call = Primitive("in_batches")
"""A traced function as one operation, until it is mapped, differentiated or compiled: then its own
operations stand there. Not custom_vmap in custom_jvp: jax then takes the axes of one for results of
the other, where the derivative is taken of a vmap that is staged, and neither may hold tracers.
"""
_call.multiple_results = True


def in_batches(function: Callable[..., Any], batch: int) -> Callable[..., Any]:
    """Return `function` of trees, of which `jax.vmap` on a CPU runs `batch` elements at a time."""

    def whole(*arguments: Any) -> Any:
        closed, shapes = jax.make_jaxpr(function, return_shape=True)(*arguments)
        if closed.effects:
            return function(*arguments)
        # also what the function closes over, traced or not
        leaves = *closed.consts, *jax.tree.leaves(arguments)
        results = _call.bind(*leaves, jaxpr=closed.jaxpr, batch=batch)
        return jax.tree.unflatten(jax.tree.structure(shapes), results)

    return whole


def _inlined(*operands: Any, jaxpr: Any, batch: int) -> list[Any]:
    """The operations of the traced function."""
    count = len(jaxpr.constvars)
    return jaxpr_as_fun(ClosedJaxpr(jaxpr, operands[:count]))(*operands[count:])


def _join(moving: Any, flags: list[bool], operands: Any) -> list[Any]:
    """`operands`, of which those with a flag are replaced by the entries of `moving`, in order."""
    entries = iter(moving)
    return [next(entries) if flag else v for flag, v in zip(flags, operands)]


def _mapped(operands: Any, axes: Any, *, jaxpr: Any, batch: int) -> Any:
    """Rule of `jax.vmap`: all results have their axis in front."""
    flags = [axis is not None for axis in axes]
    run = functools.partial(_inlined, jaxpr=jaxpr, batch=batch)
    size = next(v.shape[axis] for v, axis in zip(operands, axes) if axis is not None)
    if size <= batch or jax.default_backend() != "cpu":
        results = jax.vmap(run, in_axes=axes)(*operands)
    else:
        moving = [jax.numpy.moveaxis(v, a, 0) for v, a in zip(operands, axes) if a is not None]
        row_of = lambda row: run(*_join(row, flags, operands))
        results = jax.lax.map(row_of, moving, batch_size=batch)
    return results, [0] * len(results)


def _derived(primals: Any, tangents: Any, *, jaxpr: Any, batch: int) -> Any:
    """Derivative rule: differentiate the operations by the operands that have a tangent."""
    flags = [not isinstance(v, ad.Zero) for v in tangents]

    def run(*moving: Any) -> list[Any]:
        return _inlined(*_join(moving, flags, primals), jaxpr=jaxpr, batch=batch)

    moving, slopes = (tuple(itertools.compress(v, flags)) for v in (primals, tangents))
    return jax.jvp(run, moving, slopes)


_call.def_impl(_inlined)
_call.def_abstract_eval(lambda *_, jaxpr, batch: [v.aval for v in jaxpr.outvars])
batching.primitive_batchers[_call] = _mapped
ad.primitive_jvps[_call] = _derived
mlir.register_lowering(_call, mlir.lower_fun(_inlined, multiple_results=True))
