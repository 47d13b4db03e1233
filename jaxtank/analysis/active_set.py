"""Small quadratic programmes whose minimum is often free of limits, by an active-set method.

    min_x 1/2 x'Hx + f'x    subject to    l <= G x <= u

The dual method of Goldfarb and Idnani (Mathematical Programming 27, 1983) in its first form: from
the minimum without rows it adds the row that is violated most, until none is. Its derivatives are
those of the optimality conditions with the same rows: one-sided where a row begins to bind.
"""

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxtank.analysis.elimination import entry, times
from jaxtank.analysis.qp import scaled

TOLERANCE = 1e-9  # violation of a row at which it is added, in the scaled problem
DEPENDENT = 1e-10  # share of a row that the rows of the face leave free, below which it is 0
PASSES = 5  # largest number of iterations for each variable
SPAN = 10.0  # bounds of rows that have one side, in the largest level or limit: far, but finite


class Face(NamedTuple):
    """The rows that bind, one in each of n slots, and the minimum among the x that keep them."""

    x: Any  # (n,)
    multiplier: Any  # (n,)
    row: Any  # (n,) its number
    side: Any  # (n,) 1 if its lower end binds, -1 if its upper end does, 0 in an empty slot
    inverse: Any  # (n, n) of H, within the face
    image: Any  # (n, n) image[i]: the change of x that changes row i alone, at the least cost


class Candidate(NamedTuple):
    """The row that is being added."""

    row: Any
    side: Any  # 0: there is none
    multiplier: Any


@jax.jit
def solve_soft(H, f, A, l, u, G, room, penalty, span):
    """Return (x (n,), s (k,)) of a programme with soft limits, which is always feasible:

        min 1/2 x'Hx + f'x + sum_i penalty_i (s_i + 50 s_i^2 / span),
        l <= A x <= u,  G_ji'x <= room_ji + s_i,  s_i >= 0

    with G (samples, k, n), room (samples, k) and s, room far below span. Where the minimum without
    limits is within them it is taken: most programmes of a loop end there. penalty: one number,
    (k,), or a jax.tree_util.Partial that returns these and is called in the other programmes alone.
    """
    n, (samples, k) = f.shape[0], room.shape
    fixed = jax.lax.stop_gradient(H)
    each = jax.lax.rsqrt(jnp.diagonal(fixed))
    inverse = _inverse(fixed * jnp.outer(each, each)) * jnp.outer(each, each)

    def unlimited(_, right):
        x = times(inverse, right)
        return x + times(inverse, right - times(fixed, x))

    free = jax.lax.custom_linear_solve(lambda x: times(H, x), -f, unlimited, symmetric=True)
    reached = times(A, free)
    within = jnp.all((l <= reached) & (reached <= u)) & jnp.all(times(G, free) <= room)

    def limited():
        none, eye = jnp.zeros((n, k)), jnp.eye(k)
        prices: Any = penalty() if callable(penalty) else penalty
        price = jnp.broadcast_to(prices, (k,))
        rows = jnp.concatenate([G, jnp.broadcast_to(-eye, (samples, k, k))], axis=2)
        hard = jnp.concatenate([jnp.eye(k, n + k, n), jnp.pad(A, ((0, 0), (0, k)))])
        far, high = jnp.full(samples * k, span), jnp.full(k, span)
        unit, programme = scaled(
            jnp.block([[H, none], [none.T, 100.0 / span * jnp.diag(price)]]),
            jnp.concatenate([f, price]),
            jnp.concatenate([hard, rows.reshape(-1, n + k)]),
            jnp.concatenate([0.0 * high, l, -far]),
            jnp.concatenate([high, u, room.reshape(-1)]),
        )
        z = unit * minimum(*programme, k).x
        return z[:n], z[n:]

    return jax.lax.cond(within, lambda: (free, jnp.zeros(k, f.dtype)), limited)


@functools.partial(jax.custom_jvp, nondiff_argnums=(5,))
def minimum(H, f, G, l, u, active):
    """Return the Face of the minimum; the first `active` rows are slacks that start at 0."""
    size, rows = f.shape[0], G.shape[0]
    index, slots = np.arange(rows), np.arange(size)
    whole = jnp.pad(_inverse(H[: size - active, : size - active]), (0, active))

    def excess(x, candidates):
        values = G @ x
        return jnp.where(candidates, jnp.maximum(l - values, values - u), -jnp.inf)

    def goes_on(state):
        count, face, candidates, candidate = state
        more = (candidate.side != 0.0) | (jnp.max(excess(face.x, candidates)) > TOLERANCE)
        return (count < PASSES * size) & more

    def advance(state):
        count, face, candidates, candidate = state
        pending = candidate.side != 0.0
        worst = jnp.argmax(excess(face.x, candidates)).astype(jnp.int32)
        number = jnp.where(pending, candidate.row, worst)
        row, low, high = entry(G, number), entry(l, number), entry(u, number)
        value = row @ face.x
        side = jnp.where(pending, candidate.side, jnp.where(low - value > value - high, 1.0, -1.0))
        gap, row = jnp.where(side > 0.0, low - value, value - high), side * row
        direction, dual = face.inverse @ row, face.image @ row  # z and r of the paper
        # the step ends where a multiplier becomes 0, or where the new row binds
        shrinks = (face.side != 0.0) & (dual > 0.0)
        ratios = jnp.where(shrinks, face.multiplier / jnp.where(shrinks, dual, 1.0), jnp.inf)
        leaving, curvature = jnp.argmin(ratios), row @ direction
        independent = curvature > DEPENDENT * (row @ (whole @ row))
        full = jnp.where(independent, gap / jnp.where(independent, curvature, 1.0), jnp.inf)
        joins = full <= jnp.min(ratios)
        step = jnp.minimum(full, jnp.min(ratios))
        feasible = jnp.isfinite(step)  # else no x keeps all rows
        step = jnp.where(feasible, step, 0.0)
        empty = jnp.argmin(jnp.abs(face.side))
        slot = feasible & (slots == jnp.where(joins, empty, leaving))
        # one row more and one row less both change the two matrices by one of rank 1
        released = entry(face.image, leaving)
        force = H @ released
        line = jnp.where(joins, direction, released)
        tilt = jnp.where(joins, slot - dual, -(face.image @ force))
        divisor = jnp.where(joins, curvature, released @ force)
        scale = jnp.where(feasible, 1.0 / divisor, 0.0)
        multiplier = face.multiplier - step * dual
        new = Face(
            x=face.x + step * jnp.where(independent, direction, 0.0),
            multiplier=jnp.where(slot, joins * (candidate.multiplier + step), multiplier),
            row=jnp.where(slot & joins, number, face.row),
            side=jnp.where(slot, joins * side, face.side),
            inverse=face.inverse + jnp.where(joins, -scale, scale) * line[:, None] * line,
            image=face.image + (scale * tilt)[:, None] * line,
        )
        dropped = entry(face.row, leaving)
        ahead, again = candidates & (index != number), candidates | (index == dropped)
        candidates = jnp.where(joins, ahead, again)
        multiplier = jnp.where(joins, 0.0, candidate.multiplier + step)
        candidate = Candidate(number, jnp.where(joins, 0.0, side), multiplier)
        return jnp.where(feasible, count + 1, PASSES * size), new, candidates, candidate

    zero = 0.0 * f[0]
    face = Face(
        x=-(whole @ f),
        multiplier=jnp.concatenate([f[size - active :], 0.0 * f[: size - active]]),
        row=jnp.asarray(slots, dtype=jnp.int32),
        side=jnp.where(slots < active, 1.0, 0.0) + zero,
        inverse=whole,
        image=jnp.eye(size, k=size - active) + 0.0 * whole,
    )
    none = Candidate(jnp.int32(0), zero, zero)
    first = jnp.int32(0), face, jnp.asarray(index >= active), none
    face = jax.lax.while_loop(goes_on, advance, first)[1]
    # one step of refinement removes the rounding errors of the updates
    gradient, violation = _residuals(face, H, f, G, l, u)
    x, multiplier = _solve_on(face, H, gradient, violation)
    return face._replace(x=face.x - x, multiplier=face.multiplier + multiplier)


def _inverse(A):
    """Return A^-1 (n, n), positive definite with a unit diagonal, by sweeps."""
    index = np.arange(A.shape[0])

    def sweep(k, A):
        unit, column = index == k, entry(A, k)
        pivot = entry(column, k)
        # c c' / pivot, with pivot - 1 as c_k, does the whole sweep but 2 on the diagonal
        c = column - unit
        return A - (c / pivot)[:, None] * c - 2.0 * unit[:, None] * unit

    return -jax.lax.fori_loop(0, A.shape[0], sweep, A)


def _residuals(face, H, f, G, l, u):
    """Residuals of the optimality conditions: of the gradient, and of the rows in the slots."""
    rows = face.side[:, None] * G[face.row]
    ends = jnp.where(face.side > 0.0, l[face.row], -u[face.row]) * (face.side != 0.0)
    return times(H, face.x) + f - times(rows.T, face.multiplier), times(rows, face.x) - ends


def _solve_on(face, H, a, c):
    """Solve H x + R'y = a, R x = c for x, y with the rows R of the face."""
    x = times(face.inverse, a) + times(face.image.T, c)
    return x, times(face.image, a - times(H, x))


@minimum.defjvp
def _slope(active, data, tangents):
    face = minimum(*data, active)
    H, G = data[0], data[2]
    fixed = jax.lax.stop_gradient(face)
    at_face = lambda *data: _residuals(face, *data)
    gradient, violation = jax.jvp(at_face, tuple(data), tuple(tangents))[1]
    rows = face.side[:, None] * G[face.row]

    def conditions(change):
        x, y = jnp.split(change, 2)
        return jnp.concatenate([times(H, x) + times(rows.T, y), times(rows, x) - empty * y])

    def solve(_, right):
        return jnp.concatenate(_solve_on(fixed, jax.lax.stop_gradient(H), *jnp.split(right, 2)))

    # one right side: jax transposes no pair of which one part, as by f alone, is a constant
    right, empty = -jnp.concatenate([gradient, violation]), face.side == 0.0
    change = jax.lax.custom_linear_solve(conditions, right, solve, symmetric=True)
    x, y = jnp.split(change, 2)
    whole = lambda v: jnp.issubdtype(v.dtype, jnp.integer)
    still = lambda v: np.zeros(v.shape, jax.dtypes.float0) if whole(v) else jnp.zeros_like(v)
    return face, jax.tree.map(still, face)._replace(x=x, multiplier=-y)
