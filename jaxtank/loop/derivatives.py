"""Exact derivatives of the measures, carried along with the run."""

import functools

import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree

from jaxtank import measures as ms
from jaxtank.core.tree import with_values
from jaxtank.loop.closed_loop import initial, inputs, is_broken, keyed, run_of
from jaxtank.loop.step import step
from jaxtank.xla.barrier import materialised
from jaxtank.xla.hoist import scan
from jaxtank.xla.reachability import reached

OUTER = 12
"""Number of parameters above which the Gauss-Newton matrix grows by a matrix product: element by
element the compiler makes each slope anew for each entry (20 parameters, one run: 62 of 80 ms, with
the product 5 of 23; 8 parameters, 7 lanes: 11 against 53 ms).
"""


@functools.partial(
    jax.jit, static_argnames=("clock", "names", "order", "squares", "lanes")
)  # a dict would come back with its keys sorted
def sensitivities_compiled(
    loop, clock, names, order, values, key, squares=(("mean_square_error", 1.0),), lanes=False
):
    """What `loop.sensitivities` returns, unchecked. `lanes`: this will be one of several runs side
    by side.
    """
    flat, unflatten = ravel_pytree(values)
    kept = tuple(dict.fromkeys([*names, *(m for m, _ in squares)]))

    def at(theta):
        return with_values(loop, dict(zip(order, unflatten(theta))))

    basis = jnp.eye(flat.size, dtype=flat.dtype)

    def pushed(f, point, *tangents):
        """(f(point), tangents of f with the P directions as the last axis)."""
        return jax.vmap(
            lambda *t: jax.jvp(f, point, t, has_aux=True), in_axes=-1, out_axes=(None, -1, None)
        )(*tangents)

    def pushed_apart(f, point, *tangents):
        """`pushed`, where what the tangents are multiplied by is made once and kept. For many
        lanes: alone, fetching costs more.
        """
        value, linear, rest = jax.linearize(f, *point, has_aux=True)
        linear, slopes = jax.closure_convert(linear, *point)
        slopes = materialised(slopes)
        return (
            value,
            jax.vmap(lambda *t: linear(*t, *slopes), in_axes=-1, out_axes=-1)(*tangents),
            rest,
        )

    carried, structure = jax.tree.flatten(
        jax.eval_shape(lambda: (initial(loop, clock), ms.start(run_of(loop, clock), kept)))
    )
    # only floats have derivatives
    moves = tuple(jnp.issubdtype(v.dtype, jnp.floating) for v in carried)

    def split(tree):
        leaves = jax.tree.leaves(tree)
        return tuple(v for v, m in zip(leaves, moves) if m), tuple(
            v for v, m in zip(leaves, moves) if not m
        )

    def join(floats, rest):
        floats, rest = iter(floats), iter(rest)
        return jax.tree.unflatten(structure, [next(floats) if m else next(rest) for m in moves])

    def known(theta):
        """The samples of references, plans and noise, as a list of arrays (samples,)."""
        return jax.tree.leaves(inputs(at(theta), clock, kept, key))

    scanned = jax.tree.structure(
        jax.eval_shape(lambda theta: inputs(at(theta), clock, kept, key), flat)
    )
    # which of them depend on the parameters: only theirs are tangents to be carried
    feels = reached(known, flat)

    def begin(theta):
        here = keyed(at(theta), key)
        floats, rest = split((initial(here, clock), ms.start(run_of(here, clock), kept)))
        xs = known(theta)
        return (floats, [x for x, f in zip(xs, feels) if f]), (
            rest,
            [x for x, f in zip(xs, feels) if not f],
        )

    (floats, felt), (dfloats, dfelt), (rest, fixed) = pushed(begin, (flat,), basis)

    def body(carry, sampled):
        floats, dfloats, rest, gauss_newton = carry
        felt, dfelt, fixed = sampled

        def advance(floats, theta, felt):
            here = at(theta)
            mine, others = iter(felt), iter(fixed)
            now = jax.tree.unflatten(scanned, [next(mine) if f else next(others) for f in feels])
            state, acc = join(floats, rest)
            state, sample = step(here, clock, state, now)
            run = run_of(here, clock)
            errors = ms.residuals(run, acc, sample, now.window, now.rest, squares)
            floats, others = split(
                (state, ms.update(run, acc, sample, now.window, now.since, now.rest))
            )
            return (floats, errors), others

        if lanes:
            (floats, _), (dfloats, derrors), rest = pushed_apart(
                advance, (floats, flat, felt), dfloats, basis, dfelt
            )
        else:
            (floats, _), (dfloats, derrors), rest = pushed(
                advance, (floats, flat, felt), dfloats, basis, dfelt
            )
        if flat.size > OUTER:
            rows = jnp.stack(derrors)
            gauss_newton = gauss_newton + (rows.T * jnp.asarray(weights, rows.dtype)) @ rows
        else:
            for slope, weight in zip(derrors, weights):
                gauss_newton = gauss_newton + weight * slope[:, None] * slope[None, :]
        return (floats, dfloats, rest, gauss_newton), None

    weights = ms.residual_weights(run_of(loop, clock), squares)
    carry = (floats, dfloats, rest, jnp.zeros((flat.size, flat.size), flat.dtype))
    (floats, dfloats, rest, gauss_newton), _ = scan(
        body, carry, (felt, dfelt, fixed), length=clock.samples
    )

    def finish(floats, theta):
        _, acc = join(floats, rest)
        return ms.read(run_of(at(theta), clock), acc, names), None

    results, slopes, _ = pushed(finish, (floats, flat), dfloats, basis)
    return results, slopes, 2.0 * gauss_newton, is_broken(join(floats, rest)[0])
