"""Small quadratic programmes with two-sided rows, solved in a fixed number of steps and differentiable in everything.

    min_x 1/2 x'H x + f'x    subject to    l <= G x <= u

Mehrotra's predictor-corrector interior point (Nocedal & Wright 2006, algorithm 16.4, with su and sl the slacks of the two sides). Its
derivative is one Newton step on the optimality conditions: the implicit function theorem at the solution, in forward and in reverse mode
and under vmap, without a tape of the iterations (khalid spec C.3). A run that is not differentiated does not pay for it. A second
derivative is that of this step, whose multipliers and slacks are differentiated through the iterations: right, and slow.
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

MU_MIN = 1e-12
"""Complementarity at which iterates stop, in the scaled problem: 1e-10 biases small slopes of a closed loop by percents, 1e-13 loses
digits in the normal matrix (khalid spec C.3)."""

LEFT = 4.0  # largest complementarity of a row, in MU_MIN, of a solution that is left alone
RESIDUAL = 1e-9  # largest residual, in the scaled problem, of a solution that is left alone
UNROLLED = 20  # variables up to which the elimination is written out
BACK = 0.99  # share of the way to the nearest bound that a step may go


class Point(NamedTuple):
    """An iterate: x (n,); slacks and multipliers of the upper and lower sides (rows,), all positive."""

    x: jax.Array
    su: jax.Array
    sl: jax.Array
    lu: jax.Array
    ll: jax.Array


@functools.partial(jax.custom_jvp, nondiff_argnums=(5,))
def solve(H, f, G, l, u, iterations=15):
    """x (n,) that minimises 1/2 x'Hx + f'x within l <= G x <= u.

    H: (n, n) symmetric, positive definite; f: (n,); G: (rows, n); l, u: (rows,) finite, l < u; iterations: 12 to 15 are enough for the
    problems of predictive control (8 leave 3e-7 of the answer, khalid spec C.1). Rows may be collinear, and x is unique all the same.
    A problem without a feasible point gives a meaningless x: nothing is raised inside a trace. Differentiable in all five.
    """
    return interior_point(*_scaled(H, f), G, l, u, iterations).x


def _scaled(H, f):
    scale = jnp.trace(H) / H.shape[0]
    return H / scale, f / scale


@solve.defjvp
def _slope(iterations, primals, tangents):
    """One Newton step on the optimality conditions, whose residual moves with the data: the implicit function theorem at the solution.

    Newton's equations of x and w = lu - ll with the slacks eliminated; each row is scaled so that every entry of the matrix is of the
    order of 1 (`_normal` would lose H in the shadow of binding rows)."""
    H, f, G, l, u = primals
    H, f = _scaled(H, f)
    x, su, sl, lu, ll = interior_point(H, f, G, l, u, iterations)
    up, low = lu / su, ll / sl
    both = up + low
    row = jnp.sqrt(jnp.minimum(both, 1.0))
    held = row[:, None] * G
    matrix = jnp.block([[H, held.T], [held, -jnp.diag(jnp.minimum(1.0, 1.0 / both))]])

    def residual(H, f, G, l, u):
        H, f = _scaled(H, f)
        return jnp.concatenate([H @ x + f + G.T @ (lu - ll), row * (G @ x - (up * u + low * l) / both)])

    moved = jax.jvp(residual, primals, tangents)[1]
    return x, -jnp.linalg.solve(matrix, moved)[: x.shape[0]]


def interior_point(H, f, G, l, u, iterations):
    """The last iterate, a `Point`, of `iterations` predictor-corrector steps; arguments as in `solve`. Not for differentiation."""
    rows = G.shape[0]
    x = jnp.zeros_like(f)
    one = jnp.full(rows, 0.1, f.dtype)
    start = Point(x, jnp.maximum(u - G @ x, 0.1), jnp.maximum(G @ x - l, 0.1), one, one)

    def advance(p, _):
        g = G @ p.x
        dual, up, low = H @ p.x + f + G.T @ (p.lu - p.ll), p.su + g - u, p.sl - g + l
        mu = (p.su @ p.lu + p.sl @ p.ll) / (2 * rows)
        factor = _factor(_normal(H, G, p))

        def towards(cu, cl):
            """The step that clears the residuals and brings s * lam to the values that leave cu and cl."""
            dx = -_substitute(factor, dual + G.T @ ((p.lu * up - cu) / p.su - (p.ll * low - cl) / p.sl))
            dg = G @ dx
            dsu, dsl = -up - dg, dg - low
            return Point(dx, dsu, dsl, -(cu + p.lu * dsu) / p.su, -(cl + p.ll * dsl) / p.sl)

        guess = towards(p.su * p.lu, p.sl * p.ll)
        reach = _reach(p, guess, 1.0)
        after = ((p.su + reach * guess.su) @ (p.lu + reach * guess.lu) + (p.sl + reach * guess.sl) @ (p.ll + reach * guess.ll)) / (
            2 * rows
        )
        centre = jnp.maximum((after / mu) ** 3 * mu, MU_MIN)
        step = towards(p.su * p.lu + guess.su * guess.lu - centre, p.sl * p.ll + guess.sl * guess.ll - centre)
        reach = _reach(p, step, BACK)
        new = jax.tree.map(lambda a, b: a + reach * b, p, step)
        worst = jnp.maximum(jnp.max(jnp.abs(dual)), jnp.maximum(jnp.max(jnp.abs(up)), jnp.max(jnp.abs(low))))
        # every product, not their mean: a row that is left behind at 7e-11 bends the slopes by 1e-4. Further steps would only stir the
        # last digits
        left = jnp.maximum(jnp.max(p.su * p.lu), jnp.max(p.sl * p.ll))
        done = (left < LEFT * MU_MIN) & (worst < RESIDUAL)
        return jax.tree.map(lambda a, b: jnp.where(done, a, b), p, new), None

    return jax.lax.scan(advance, start, None, length=iterations)[0]


def _normal(H, G, p):
    """H + G' diag(lu/su + ll/sl) G."""
    return H + (G.T * (p.lu / p.su + p.ll / p.sl)) @ G


def _reach(p, step, back):
    """The largest share, at most 1, of `step` that keeps slacks and multipliers positive, short of the bound by `back`."""
    shares = [jnp.min(jnp.where(d < 0, -back * v / jnp.where(d < 0, d, -1.0), 1.0)) for v, d in zip(p[1:], step[1:])]
    return jnp.minimum(1.0, jnp.min(jnp.stack(shares)))


def _factor(A):
    """A factor of A (n, n) symmetric positive definite, for `_substitute`: [(column of L, pivot), ...] of A = L D L' where A is small.

    Written out column by column, for calls of LAPACK take longer than the work on so small a matrix: measured, a closed loop runs 3 to 5
    times as fast with 4 or 10 variables, as fast with 20, half as fast with 30.
    """
    if A.shape[0] > UNROLLED:
        return jax.scipy.linalg.cho_factor(A, lower=True)
    columns = []
    for j in range(A.shape[0]):
        columns.append((A[:, j] / A[j, j], A[j, j]))
        A = A - jnp.outer(columns[-1][0], A[j])
    return columns


def _substitute(columns, b):
    """A^-1 b for the `_factor` of A; b: (n,)."""
    if isinstance(columns, tuple):
        return jax.scipy.linalg.cho_solve(columns, b)
    index = np.arange(len(columns))
    for j, (column, _) in enumerate(columns):
        b = b - jnp.where(index > j, column, 0.0) * b[j]
    b = b / jnp.stack([pivot for _, pivot in columns])
    for j, (column, _) in reversed(list(enumerate(columns))):
        b = jnp.where(index == j, b - jnp.sum(jnp.where(index > j, column * b, 0.0)), b)
    return b
