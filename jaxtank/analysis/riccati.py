"""Linear systems: discretisation, Lyapunov and Riccati equations, linear-quadratic gains.

Jittable and differentiable, forward and reverse; for use before the time loop (in a controller's
`step` too: the loop hoists such work).
"""

import jax
import jax.numpy as jnp

from jaxtank.analysis.elimination import inverse, solve_all

DEGREE = 18  # of the Taylor polynomial of a matrix exponential, for a norm of at most 1
SQUARINGS = 30  # most: of a norm of 2^30, beyond which the exponential is NaN
# scaled Newton steps of the matrix sign: about 10 are needed; once it has converged, more change
# nothing
SIGN_STEPS = 30
DOUBLINGS = 40  # 2^40 samples of memory: closed-loop poles up to 1 - 1e-11


def matrix_exponential(A):
    """Return exp(A) (n, n), by scaling and squaring."""
    norm = jax.lax.stop_gradient(jnp.max(jnp.sum(jnp.abs(A), axis=0)))
    count = jnp.ceil(jnp.log2(jnp.maximum(norm, 1.0)))
    eye, scaled = jnp.eye(A.shape[0], dtype=A.dtype), A * jnp.exp2(-count)
    term = lambda k, E: eye + scaled @ E / (DEGREE - k)
    E = jax.lax.fori_loop(0, DEGREE, term, eye + 0.0 * scaled)
    square = lambda k, E: jnp.where(k < count, E @ E, E)
    E = jax.lax.fori_loop(0, SQUARINGS, square, E)
    return jnp.where(count <= SQUARINGS, E, jnp.nan)


def zero_order_hold(A, B, dt):
    """Return (Ad, Bd) of x' = A x + B u sampled with u held: exp([[A, B], [0, 0]] dt)."""
    n, m = B.shape
    block = jnp.concatenate([jnp.concatenate([A, B], axis=1), jnp.zeros((m, n + m))], axis=0)
    exponential = matrix_exponential(block * dt)
    return exponential[:n, :n], exponential[:n, n:]


def lyapunov(A, Q):
    """Return X (n, n) of A X + X A' + Q = 0, for stable A."""
    # by Cayley's transform with a step of the length of the fastest mode
    eye, step = jnp.eye(A.shape[0]), 1.0 / jax.lax.stop_gradient(jnp.linalg.norm(A))
    left = inverse(eye - step * A)
    return discrete_lyapunov(left @ (eye + step * A), 2.0 * step * left @ Q @ left.T)


def discrete_lyapunov(A, Q):
    """Return X (n, n) of X = A X A' + Q, for stable A, by doubling (Smith 1968)."""
    double = lambda _, state: (state[0] + state[1] @ state[0] @ state[1].T, state[1] @ state[1])
    return jax.lax.fori_loop(0, DOUBLINGS, double, (Q + 0.0 * A, A + 0.0 * Q))[0]


def riccati(A, B, Q, R):
    """Return the stabilising P (n, n) of A'P + P A - P B R^-1 B'P + Q = 0."""
    still = jax.lax.stop_gradient
    P = still(_riccati_by_sign(*map(still, (A, B, Q, R))))
    K = solve_all(R, B.T @ P)
    closed = A - B @ K
    return _symmetric(lyapunov(closed.T, Q + K.T @ R @ K))


def _riccati_by_sign(A, B, Q, R):
    n = A.shape[0]
    Z = jnp.block([[A, -B @ solve_all(R, B.T)], [-Q, -A.T]])

    def newton(_, Z):
        inverted = inverse(Z)
        scale = jnp.sqrt(jnp.linalg.norm(inverted) / jnp.linalg.norm(Z))
        return 0.5 * (scale * Z + inverted / scale)

    S = jax.lax.fori_loop(0, SIGN_STEPS, newton, Z)
    # the stable subspace [I; P] is the null space of sign + I
    lhs = jnp.concatenate([S[:n, n:], S[n:, n:] + jnp.eye(n)])
    rhs = -jnp.concatenate([S[:n, :n] + jnp.eye(n), S[n:, :n]])
    P = _symmetric(solve_all(lhs.T @ lhs, lhs.T @ rhs))
    # the normal equations square the condition number, and one Newton step mends it: the
    # derivatives are taken at the solution
    K = solve_all(R, B.T @ P)
    return _symmetric(lyapunov((A - B @ K).T, Q + K.T @ R @ K))


def lqr(A, B, Q, R):
    """Return K (m, n) of u = -K x that minimises the integral of x'Q x + u'R u."""
    # K = R^-1 B'P (mirakhorli eq. 15, without its transpose); arguments as in `riccati`.
    return solve_all(R, B.T @ riccati(A, B, Q, R))


def discrete_riccati(A, B, Q, R):
    """Return the stabilising P (n, n) of P = A'P A - A'P B (R + B'P B)^-1 B'P A + Q."""
    still = jax.lax.stop_gradient
    P = still(_discrete_riccati_by_doubling(*map(still, (A, B, Q, R))))
    K = solve_all(R + B.T @ P @ B, B.T @ P @ A)
    return _symmetric(discrete_lyapunov((A - B @ K).T, Q + K.T @ R @ K))


def _discrete_riccati_by_doubling(A, B, Q, R):
    eye = jnp.eye(A.shape[0])

    def double(_, state):
        A, G, H = state
        W = inverse(eye + G @ H)
        AW = A @ W
        return AW @ A, _symmetric(G + AW @ G @ A.T), _symmetric(H + A.T @ H @ W @ A)

    start = tuple(a + 0.0 * Q[0, 0] for a in (A, B @ solve_all(R, B.T), Q))
    return jax.lax.fori_loop(0, DOUBLINGS, double, start)[2]


def _symmetric(P):
    return 0.5 * (P + P.T)
