"""Small quadratic programmes with two-sided rows, solved by an interior-point method and
differentiable in all data.

    min_x 1/2 x'H x + f'x    subject to    l <= G x <= u

Mehrotra's predictor-corrector interior point (Nocedal & Wright 2006, algorithm 16.4, with su and sl
the slack variables of the two sides). Its derivatives, of any order and in both modes, follow from
the implicit function theorem at the solution (khalid notes S4.5).
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxtank.analysis.elimination import factor, normal_matrix, substitute

MU_MIN = 1e-12  # last complementarity: 1e-10 biases slopes, 1e-13 loses digits (khalid notes S4.5)

OFF = 1e-4
"""Largest distance of a row's complementarity from MU_MIN at a solution, in MU_MIN: derivatives are
taken along the central path, and a row off it changes them by percents.
"""
NEAR = 100.0  # complementarity, in MU_MIN, from which on plain Newton steps go to the central path
RESIDUAL = 1e-9  # largest residual, in the scaled problem, of a solution that is left alone
MOST = 40  # iterations: most programmes of a closed loop take 6, at the edge of a limit up to 20

CORRECTIONS = 4  # of a derivative
BACK = 0.99  # share of the way to the nearest bound that a step may go


class Point(NamedTuple):
    """An iterate: x (n,); slacks and multipliers of upper and lower sides (rows,), positive."""

    x: jax.Array
    su: jax.Array
    sl: jax.Array
    lu: jax.Array
    ll: jax.Array


@functools.partial(jax.custom_jvp, nondiff_argnums=(5,))
def solve(H, f, G, l, u, iterations=MOST):
    """Return x that minimises 1/2 x'Hx + f'x within l <= G x <= u; differentiable in all five."""
    unit, inside = scaled(H, f, G, l, u)
    return unit * interior_point(*inside, iterations).x


def scaled(H, f, G, l, u):
    """(unit (n,), the programme of z = x / unit): Hessian of unit diagonal, rows of length 1."""
    # z is of the order of 1, for what the iterates begin and end with are plain numbers: the unit
    # of x is the largest of the narrowest row, the slope at 0, and how far from there limits are
    each = jax.lax.rsqrt(jnp.diagonal(H))
    length = jnp.sqrt(jnp.sum((G * each) ** 2, axis=1))
    length = jnp.where(length > 0.0, length, 1.0)
    away = jnp.max(jnp.maximum(jnp.maximum(l, -u), 0.0) / length)
    size = jnp.maximum(jnp.maximum(jnp.max(jnp.abs(f * each)), away), jnp.min((u - l) / length))
    # held as they are: the answer does not depend on them but for what the corners are rounded by
    each, length, size = jax.lax.stop_gradient((each, length, size))
    row = 1.0 / (length * size)
    return size * each, (
        H * jnp.outer(each, each),
        f * each / size,
        G * (each / length[:, None]),
        l * row,
        u * row,
    )


@solve.defjvp
def _slope(iterations, primals, tangents):
    (unit, data), (_, moved) = jax.jvp(scaled, primals[:5], tangents[:5])
    inside = jax.lax.stop_gradient(data)
    point = interior_point(*inside, iterations=iterations)
    point = _held(point, *data)
    return unit * point.x, unit * _implicit(point, data, moved)


@jax.custom_jvp
def _held(point, H, f, G, l, u):
    """The solution `point`, knowing how it moves with the data, for second derivatives."""
    return point


@_held.defjvp
def _held_slope(primals, tangents):
    point, *data = primals
    moved = tangents[1:]
    solution = _held(point, *data)
    x, su, sl, lu, ll = solution
    dx = _implicit(solution, data, moved)
    dg = data[2] @ dx + moved[2] @ x
    dsu, dsl = moved[4] - dg, dg - moved[3]
    # along the path on which every product s lam stays
    return solution, Point(dx, dsu, dsl, -lu / su * dsu, -ll / sl * dsl)


def _implicit(point, data, moved):
    """How x moves with the data: one Newton step on the optimality conditions."""
    # H dx + A' v = a, A dx - D v = b,
    # of x and of v, the change of lu - ll, with the slacks eliminated; each row is scaled so that
    # every entry is of the order of 1. The matrix H + A' D^-1 A that v leaves for dx (`normal`)
    # loses four to ten digits of H in the shadow of binding rows; corrections by what the two
    # equations above leave bring them back. The elimination is not differentiated: second
    # derivatives follow from the linear system.
    H, _, G, _, _ = data
    x, su, sl, lu, ll = point
    up, low = lu / su, ll / sl
    both = up + low
    row, D = jnp.sqrt(jnp.minimum(both, 1.0)), jnp.minimum(1.0, 1.0 / both)
    A = row[:, None] * G

    def residual(H, f, G, l, u):
        return H @ x + f + G.T @ (lu - ll), row * (G @ x - (up * u + low * l) / both)

    a, b = (-r for r in jax.jvp(residual, tuple(data), tuple(moved))[1])
    normal = normal_matrix(H, G, lu / su + ll / sl)
    factored = factor(jax.lax.stop_gradient(normal))
    solved = lambda b: jax.lax.custom_linear_solve(  # b -> normal^-1 b
        lambda x: normal @ x, b, lambda _, b: substitute(factored, b), symmetric=True
    )

    def corrected(solution, _):
        dx, v = solution
        rest, over = a - H @ dx - A.T @ v, b - A @ dx + D * v
        step = solved(rest + A.T @ (over / D))
        return (dx + step, v + (A @ step - over) / D), None

    start = jnp.zeros_like(a), jnp.zeros_like(b)
    return jax.lax.scan(corrected, start, None, length=1 + CORRECTIONS)[0][0]


def interior_point(H, f, G, l, u, iterations=MOST):
    """Return the `Point` at which the iterates converge, or the last of `iterations`."""
    x = jnp.zeros_like(f)
    multipliers = jnp.full(G.shape[0], 0.1, f.dtype)
    rounding = 64.0 * jnp.finfo(f.dtype).eps * jnp.maximum(1.0, jnp.maximum(jnp.abs(u), jnp.abs(l)))
    slacks = jnp.maximum(u - G @ x, 0.1), jnp.maximum(G @ x - l, 0.1)
    start = Point(x, *slacks, multipliers, multipliers)
    data = H, f, G, l, u

    def under_way(state):
        k, p = state
        worst = jnp.max(jnp.stack([jnp.max(jnp.abs(r)) for r in _residuals(p, *data)]))
        pairs = (p.su, p.lu), (p.sl, p.ll)
        off = [jnp.max(jnp.abs(s * lam - MU_MIN) - rounding * lam) for s, lam in pairs]
        return (k < iterations) & ~((jnp.maximum(*off) < OFF * MU_MIN) & (worst < RESIDUAL))

    def advance(state):
        k, p = state
        new = _iterate(p, *data)
        # where no point is feasible the multipliers grow until they overflow: the last finite ones
        # are kept
        parts = map(jnp.sum, (new.lu, new.ll, new.su, new.sl))
        good = sum(parts, jnp.sum(jnp.abs(new.x))) < 1e300
        count = jnp.where(good, k + 1, iterations)
        return count, jax.tree.map(lambda a, b: jnp.where(good, b, a), p, new)

    return jax.lax.while_loop(under_way, advance, (jnp.int32(0), start))[1]


def _residuals(p, H, f, G, l, u):
    """Residuals at an iterate: of the gradient (n,), and of the upper and lower sides (rows,)."""
    g = G @ p.x
    return H @ p.x + f + G.T @ (p.lu - p.ll), p.su + g - u, p.sl - g + l


def _iterate(p, H, f, G, l, u):
    """The next iterate: predictor, then corrector with the centring of Mehrotra."""
    dual, up, low = _residuals(p, H, f, G, l, u)
    rows = G.shape[0]
    mu = (p.su @ p.lu + p.sl @ p.ll) / (2 * rows)
    factored = factor(normal_matrix(H, G, p.lu / p.su + p.ll / p.sl))

    def towards(cu, cl):
        """The step that clears the residuals, with s lam brought to what leaves cu and cl."""
        dx = -substitute(
            factored, dual + G.T @ ((p.lu * up - cu) / p.su - (p.ll * low - cl) / p.sl)
        )
        dg = G @ dx
        dsu, dsl = -up - dg, dg - low
        return Point(dx, dsu, dsl, -(cu + p.lu * dsu) / p.su, -(cl + p.ll * dsl) / p.sl)

    guess = towards(p.su * p.lu, p.sl * p.ll)
    reach = _reach(p, guess, 1.0)
    after = (
        (p.su + reach * guess.su) @ (p.lu + reach * guess.lu)
        + (p.sl + reach * guess.sl) @ (p.ll + reach * guess.ll)
    ) / (2 * rows)
    near = jnp.maximum(jnp.max(p.su * p.lu), jnp.max(p.sl * p.ll)) < NEAR * MU_MIN
    centre = jnp.where(near, MU_MIN, jnp.maximum((after / mu) ** 3 * mu, MU_MIN))
    ahead = jnp.where(near, 0.0, 1.0)
    step = towards(
        p.su * p.lu + ahead * guess.su * guess.lu - centre,
        p.sl * p.ll + ahead * guess.sl * guess.ll - centre,
    )
    reach = _reach(p, step, BACK)
    return jax.tree.map(lambda a, b: a + reach * b, p, step)


def _reach(p, step, back):
    """The largest share <= 1 of `step` that keeps slacks and multipliers positive, by `back`."""
    share = lambda v, d: jnp.where(d < 0, -back * v / jnp.where(d < 0, d, -1.0), 1.0)
    shares = [jnp.min(share(v, d)) for v, d in zip(p[1:], step[1:])]
    return jnp.minimum(1.0, jnp.min(jnp.stack(shares)))
