"""Exact derivatives of the measures, carried along with the run."""

import functools

import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree

from jaxtank import measures as ms
from jaxtank.invariants import scan
from jaxtank.stepping import initial, inputs, is_broken, run_of, step
from jaxtank.tree import with_values


@functools.partial(jax.jit, static_argnames=("clock", "names", "order"))  # a dict would come back from jit with its keys sorted
def _sensitivities(loop, clock, names, order, values, key):
    """What `loop.sensitivities` returns, unchecked."""
    flat, unflatten = ravel_pytree(values)

    def at(theta):
        return with_values(loop, dict(zip(order, unflatten(theta))))

    basis = jnp.eye(flat.size, dtype=flat.dtype)

    def pushed(f, point, *tangents):
        """(f(point), tangents of f with the P directions as the last axis)."""
        return jax.vmap(lambda *t: jax.jvp(f, point, t, has_aux=True), in_axes=-1, out_axes=(None, -1, None))(*tangents)

    carried, structure = jax.tree.flatten(jax.eval_shape(lambda: (initial(loop, clock), ms.start(run_of(loop, clock), names))))
    moves = tuple(jnp.issubdtype(v.dtype, jnp.floating) for v in carried)  # only floats have derivatives

    def split(tree):
        leaves = jax.tree.leaves(tree)
        return tuple(v for v, m in zip(leaves, moves) if m), tuple(v for v, m in zip(leaves, moves) if not m)

    def join(floats, rest):
        floats, rest = iter(floats), iter(rest)
        return jax.tree.unflatten(structure, [next(floats) if m else next(rest) for m in moves])

    def begin(theta):
        here = at(theta)
        floats, rest = split((initial(here, clock), ms.start(run_of(here, clock), names)))
        return (floats, inputs(here, clock, names, key)), rest

    (floats, xs), (dfloats, dxs), rest = pushed(begin, (flat,), basis)
    if not any(name.startswith(("reference.", "disturbance.")) for name in order):
        dxs = None  # the inputs do not depend on the parameters: their tangents need not be carried

    def body(carry, scanned):
        floats, dfloats, rest, gauss_newton = carry
        now, dnow = scanned

        def advance(floats, theta, now=now):
            here = at(theta)
            state, acc = join(floats, rest)
            state, sample = step(here, clock, state, now)
            floats, others = split((state, ms.update(run_of(here, clock), acc, sample, now.window, now.since)))
            return (floats, sample.e), others

        if dnow is None:
            (floats, _), (dfloats, de), rest = pushed(advance, (floats, flat), dfloats, basis)
        else:
            (floats, _), (dfloats, de), rest = pushed(advance, (floats, flat, now), dfloats, basis, dnow)
        for slope in de:
            gauss_newton = gauss_newton + slope[:, None] * slope[None, :]
        return (floats, dfloats, rest, gauss_newton), None

    carry = (floats, dfloats, rest, jnp.zeros((flat.size, flat.size), flat.dtype))
    (floats, dfloats, rest, gauss_newton), _ = scan(body, carry, (xs, dxs), length=clock.samples)

    def finish(floats, theta):
        _, acc = join(floats, rest)
        return ms.read(run_of(at(theta), clock), acc, names), None

    results, slopes, _ = pushed(finish, (floats, flat), dfloats, basis)
    return results, slopes, gauss_newton * (2.0 / clock.samples), is_broken(join(floats, rest)[0])
