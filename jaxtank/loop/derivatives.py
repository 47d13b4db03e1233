"""Exact derivatives of the measures, carried along with the run (forward mode)."""
# pyright: reportUnknownMemberType=false

from collections.abc import Callable
from typing import Any, cast

import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jax.typing import ArrayLike

from jaxtank import measures as ms
from jaxtank.core.clock import Clock
from jaxtank.core.tree import with_values
from jaxtank.loop.closed_loop import (
    ClosedLoop,
    Partition,
    floats_of,
    initial,
    inputs,
    is_broken,
    keyed,
    run_of,
    takes_arrays,
)
from jaxtank.loop.functions import needed_by, values_of
from jaxtank.loop.margins import run_with
from jaxtank.loop.step import step
from jaxtank.xla.barrier import materialised
from jaxtank.xla.hoist import scan
from jaxtank.xla.jit import compiled
from jaxtank.xla.reachability import reached

OUTER = 12
"""Number of parameters above which the derivatives of a residual are stored before their products
are added to the Gauss-Newton matrix [-]: else the compiler computes each again for each entry.
"""

SMALL = 8
"""Number of entries above which a coefficient of the linearised step is not copied at each sample
[-]: copies made runs 4 to 20 times as long (`tests/benchmarks/plant_derivatives.py`).
"""

FEW = 3
"""Number of parameters up to which the tangents of each direction are separate scalars, in a batch
of plants [-]: the compiler then vectorises over plants (the same benchmark).
"""

Names = tuple[str, ...]
Arrays = dict[str, jax.Array]
Squares = tuple[tuple[str, float], ...]
"""((measure, weight), ...) of sums of squares"""


# the values as a tuple: a dict would come back with its keys sorted
@compiled("clock", "names", "order", "squares", "batched", keep=True)
def sensitivities_compiled(
    loop: ClosedLoop,
    clock: Clock,
    names: Names,
    order: Names,
    values: tuple[ArrayLike, ...],
    key: jax.Array | None,
    squares: Squares = (("mean_square_error", 1.0),),
    batched: bool = False,
) -> tuple[Arrays, Arrays, jax.Array, jax.Array]:
    """Unchecked `sensitivities`; batched: one of several runs side by side."""
    flat, unflatten = ravel_pytree(values)
    basis = jnp.eye(flat.size, dtype=flat.dtype)

    def at(theta: Any) -> ClosedLoop:
        return with_values(loop, dict(zip(order, unflatten(theta))))

    if ms.functions(names):  # by the chain rule: along the measures that they read, and along rows
        needed = needed_by(at(flat), clock, names)
        measures, slopes, matrix, broken = sensitivities_compiled(
            loop, clock, needed, order, values, key, squares, batched
        )

        def functions(measures: Any, theta: Any) -> Any:
            return values_of(at(theta), clock, names, key, measures), None

        results, rates, _ = _pushed(functions, (measures, flat), slopes, basis)
        return results, rates, matrix, broken

    arrays = takes_arrays(loop)
    # the axis of the directions in the loop, and that in (a state, samples): in front of arrays,
    # whose entries then stay side by side
    axis, axes = (0, (0, 1)) if arrays else (-1, (-1, -1))
    computed = tuple(dict.fromkeys([*names, *(m for m, _ in squares)]))

    def sampled(theta: Any) -> Any:
        return inputs(at(theta), clock, computed, key, arrays=arrays)

    def start(loop: ClosedLoop) -> Any:
        return initial(loop, clock, arrays), ms.start(run_of(loop, clock, arrays), computed)

    known = _dependent(sampled, flat)
    carried = floats_of(jax.eval_shape(lambda: start(loop)))

    def begin(theta: Any) -> Any:
        floats, rest = carried.split(start(keyed(at(theta), key)))
        moving, fixed = known.split(sampled(theta))
        return (floats, moving), (rest, fixed)

    begun = _pushed(begin, (flat,), basis, outs=axes)
    (floats, moving), (dfloats, dmoving), (rest, fixed) = begun
    weights = ms.residual_weights(run_of(loop, clock, arrays), squares)
    separate = batched and not arrays and flat.size <= FEW
    push, directions = _pushed_stored if batched and not arrays else _pushed, basis
    if separate:
        push, directions = _pushed_separately, tuple(basis)
        dfloats, dmoving = _split(dfloats, flat.size), _split(dmoving, flat.size)

    def body(carry: Any, now: Any) -> Any:
        (floats, dfloats, rest, matrix), (moving, dmoving, fixed) = carry, now

        def advance(floats: Any, theta: Any, moving: Any) -> Any:
            loop_at = at(theta)
            run, now = run_of(loop_at, clock, arrays), known.join(moving, fixed)
            state, acc = carried.join(floats, rest)
            state, sample = step(loop_at, clock, state, now)
            errors = ms.residuals(run, acc, sample, now.context, squares)
            floats, others = carried.split((state, ms.update(run, acc, sample, now.context)))
            return (floats, errors), others

        point = (floats, flat, moving)
        moved = push(advance, point, dfloats, directions, dmoving, ins=axis, outs=axis)
        (floats, _), (dfloats, derrors), rest = moved
        if separate:
            derrors = [jnp.stack(v) for v in zip(*derrors)]
        return (floats, dfloats, rest, _with_squares(matrix, derrors, weights)), None

    carry = (floats, dfloats, rest, jnp.zeros_like(basis))
    floats, dfloats, rest, matrix = scan(body, carry, (moving, dmoving, fixed), clock.samples)[0]
    if separate:
        dfloats = jax.tree.map(lambda *v: jnp.stack(v, axis=-1), *dfloats)

    def finish(floats: Any, theta: Any) -> Any:
        run = run_with(at(theta), clock, names, arrays)
        return ms.read(run, carried.join(floats, rest)[1], names), None

    results, slopes, _ = _pushed(finish, (floats, flat), dfloats, basis, ins=axis)
    return results, slopes, 2.0 * matrix, is_broken(carried.join(floats, rest)[0])


def _dependent(f: Callable[[Any], Any], flat: jax.Array) -> Partition:
    """Partition of f(flat) by dependence: only what depends on `flat` carries tangents."""

    def leaves(theta: Any) -> list[Any]:
        return jax.tree.leaves(f(theta))

    return Partition(jax.tree.structure(jax.eval_shape(f, flat)), tuple(reached(leaves, flat)))


def _pushed(
    f: Callable[..., Any], point: tuple[Any, ...], *tangents: Any, ins: Any = -1, outs: Any = -1
) -> Any:
    """(f(point), its tangents, auxiliary output of f); ins, outs: the axis of the P directions."""

    def push(*t: Any) -> Any:
        return jax.jvp(f, point, t, has_aux=True)

    return jax.vmap(push, in_axes=ins, out_axes=(None, outs, None))(*tangents)


def _pushed_stored(
    f: Callable[..., Any], point: tuple[Any, ...], *tangents: Any, ins: Any = -1, outs: Any = -1
) -> Any:
    """`_pushed`, with the coefficients of the linear part computed once for all directions."""
    value, push, rest = _linearised(f, point)
    return value, jax.vmap(push, in_axes=ins, out_axes=outs)(*tangents), rest


def _pushed_separately(
    f: Callable[..., Any], point: tuple[Any, ...], *tangents: Any, ins: Any = -1, outs: Any = -1
) -> Any:
    """`_pushed_stored` of tangents that are tuples of trees, as is its result: one a direction."""
    value, push, rest = _linearised(f, point)
    return value, tuple(zip(*(push(*t) for t in zip(*tangents)))), rest


def _linearised(f: Callable[..., Any], point: tuple[Any, ...]) -> Any:
    """(f(point), its linear part as a function of tangents, auxiliary output of f)."""
    value, linear, rest = cast(Any, jax.linearize)(f, *point, has_aux=True)
    function, coefficients = cast(Any, jax.closure_convert)(linear, *point)
    if all(jnp.size(v) <= SMALL for v in coefficients):
        coefficients = materialised(coefficients)
    else:  # a barrier on an array would copy it, and keep it in the loop
        coefficients = [v if jnp.ndim(v) else materialised(v) for v in coefficients]

    def push(*tangents: Any) -> Any:
        return function(*tangents, *coefficients)

    return value, push, rest


def _split(tree: Any, count: int) -> tuple[Any, ...]:
    """A tree for each of `count` directions, which are along the last axis."""
    leaves: list[Any] = jax.tree.leaves(tree)
    structure: Any = cast(Any, jax.tree.structure)(tree)
    return tuple(jax.tree.unflatten(structure, [v[..., k] for v in leaves]) for k in range(count))


def _with_squares(matrix: Any, derrors: Any, weights: Any) -> Any:
    """`matrix` (P, P) + sum_k weight_k slope_k slope_k', of slopes (P,) or arrays (P, k)."""
    if derrors and derrors[0].ndim > 1:
        for slopes, weight in zip(derrors, weights):
            matrix = matrix + weight * jnp.sum(slopes[:, None] * slopes[None, :], axis=-1)
        return matrix
    for slope, weight in zip(derrors, weights):
        if len(matrix) > OUTER:
            # a product that nothing else reads, as `barrier` asks
            slope = materialised(jnp.sqrt(jnp.abs(weight)) * slope)
            weight = jnp.sign(weight)
        matrix = matrix + weight * slope[:, None] * slope[None, :]
    return matrix
