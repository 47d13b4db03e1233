"""Frequency response of a sampled open loop, without LAPACK: it vmaps, and runs on any device."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxtank.analysis.elimination import solve_all

RADIUS = 1e-7
"""How far outside the unit circle encirclements are counted: a growth below it is none [-]."""

SQUARINGS = 40  # a matrix is raised to the power 2^SQUARINGS to find its spectral radius


class OpenLoop(NamedTuple):
    """L(z) = C (z I - A)^-1 B z^-dead, the loop opened at its m inputs; closed with u = -L u.
    `dead` is a whole number, or one for each input, (m,). With `inputs` (m, k), the inputs that
    k loops move for a signal of 1, L is C (z I - A)^-1 B z^-dead inputs, with C (k, n).
    """

    A: Any
    B: Any
    C: Any
    dead: Any
    dt: Any
    inputs: Any = None


def _size(value):
    """A size of complex numbers that costs no root."""
    return jnp.abs(jnp.real(value)) + jnp.abs(jnp.imag(value))


def is_stable(A: Any) -> Any:
    """Return True if the spectral radius of A (n, n) is at most 1, to 1e-9."""

    def square(_, state):
        P, log, power = state
        P, power = P @ P, 0.5 * power
        size = jnp.sqrt(jnp.sum(P * P))
        size = jnp.where(size > 0.0, size, 1.0)
        return P / size, log + power * jnp.log(size), power

    start = (A, jnp.zeros((), A.dtype), jnp.ones((), A.dtype))
    P, log, _ = jax.lax.fori_loop(0, SQUARINGS, square, start)
    return jnp.any(P != 0.0) & (log <= 1e-9) | ~jnp.any(P != 0.0)


def hessenberg(loop: OpenLoop) -> OpenLoop:
    """Return the same loop with A in Hessenberg form, by Householder's reflections (Laub 1981)."""
    index = np.arange(loop.A.shape[0])

    def reflect(k, state):
        H, B, C = state
        x = jnp.where(index > k, H[:, k], 0.0)
        size = jnp.sqrt(jnp.sum(x * x))
        v = x + jnp.where(index == k + 1, jnp.where(x[k + 1] < 0.0, -size, size), 0.0)
        square = jnp.sum(v * v)
        scaled = v * jnp.where(square > 0.0, 2.0 / jnp.where(square > 0.0, square, 1.0), 0.0)
        H = H - scaled[:, None] * (v @ H)
        return (
            H - (H @ v)[:, None] * scaled,
            B - scaled[:, None] * (v @ B),
            C - (C @ v)[:, None] * scaled,
        )

    H, B, C = jax.lax.fori_loop(0, max(len(index) - 2, 0), reflect, (loop.A, loop.B, loop.C))
    return loop._replace(A=H, B=B, C=C)


def _of_loops(loop: OpenLoop, L: Any, late: Any) -> Any:
    """(F, k, k) of the k loops, from L (F, k, m) without dead time and its factors (F, m or 1)."""
    L = L * late[:, None, :]
    return L if loop.inputs is None else L @ loop.inputs


def response(loop: OpenLoop, z: Any) -> tuple[Any, Any]:
    """Return (L (F, k, k), det(I - A/z) (F,)) at z (F,) of a loop in Hessenberg form."""
    H, B, C, dead = loop[:4]
    n, F = H.shape[0], z.shape[0]
    eye = jnp.eye(n, dtype=z.dtype)

    def row(k):
        shifted = z[:, None] * eye[k] - H[k]
        return jnp.concatenate([shifted, jnp.broadcast_to(B[k], (F, B.shape[1]))], axis=1)

    def eliminate(state, k):
        now, det = state
        after = row(k + 1)
        swap = (_size(after[:, k]) > _size(now[:, k]))[:, None]
        pivot, other = jnp.where(swap, after, now), jnp.where(swap, now, after)
        now = other - (other[:, k] / pivot[:, k])[:, None] * pivot
        det = det * pivot[:, k] / z * jnp.where(swap[:, 0], -1.0, 1.0)
        return (now, det), pivot

    start = (row(0), jnp.ones(F, z.dtype))
    (last, det), rows = jax.lax.scan(eliminate, start, jnp.arange(n - 1))
    det = det * last[:, n - 1] / z
    rows = jnp.concatenate([rows, last[None]])

    def substitute(X, k):
        row = rows[k]
        known = jnp.einsum("fj,fjm->fm", row[:, :n], X)
        return X.at[:, k].set((row[:, n:] - known) / row[:, k, None]), None

    zero = jnp.zeros((F, n, B.shape[1]), z.dtype)
    X = jax.lax.scan(substitute, zero, jnp.arange(n - 1, -1, -1))[0]
    late = z[:, None] ** -np.atleast_1d(dead)
    return _of_loops(loop, jnp.einsum("in,fnm->fim", C, X), late), det


def held(loop: OpenLoop, w: Any) -> tuple[Any, Any]:
    """Return ((z I - A)^-1 B (K, n, m), C (z I - A)^-1 (K, k, n)) at w (K,) [rad/s], for `near`."""
    (A, B, C), w = jax.lax.stop_gradient((loop[:3], w))

    def at(w):
        M = jnp.exp(1j * w * loop.dt) * jnp.eye(A.shape[0]) - A
        both = jnp.stack([M, M.T])
        widest = max(B.shape[1], C.shape[0])
        pad = lambda v: jnp.pad(v.astype(M.dtype), ((0, 0), (0, widest - v.shape[1])))
        X, Y = jax.vmap(solve_all)(both, jnp.stack([pad(B), pad(C.T)]))
        return X[:, : B.shape[1]], Y[:, : C.shape[0]].T

    return jax.vmap(at)(w)


def near(loop: OpenLoop, base: tuple[Any, Any], w: Any) -> Any:
    """L (K, k, k) at w (K,) [rad/s] next to `base`, to second order, with first derivatives."""
    A, B, C, dead, dt = loop[:5]
    z = jnp.exp(1j * w * dt)
    X, Y = base
    residual = B - z[:, None, None] * X + jnp.einsum("ij,kjm->kim", A, X)
    L = jnp.einsum("ij,kjm->kim", C, X) + jnp.einsum("kin,knm->kim", Y, residual)
    return _of_loops(loop, L, jnp.exp(-1j * (w * dt)[:, None] * np.atleast_1d(dead)))
