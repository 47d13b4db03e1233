"""Derivatives of predicted states along a trajectory, for programmes of all its variables."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp


def slopes_along(onward: Callable[..., Any], x: Any, u: Any, *more: Any) -> jax.Array:
    """Return (samples, n + m, n) derivatives of onward(x, u, ...) (n,) at rows of x, u, `more`."""
    n, unit = x.shape[1], jnp.eye(x.shape[1] + u.shape[1])

    def slopes(x, u, *more):
        along = lambda s, w: jax.jvp(lambda x, u: onward(x, u, *more), (x, u), (s, w))[1]
        return jax.vmap(along)(unit[:, :n], unit[:, n:])

    # of all samples at once: the vectors are long, and the levels are known
    return jax.vmap(slopes, in_axes=1)(x.T, u.T, *(v.T for v in more))


def condensed(slopes: Any, basis: Any, first: Any) -> Any:
    """Return (samples, n, K) derivatives of the states by K variables, from those of one step."""

    def grow(S, now):
        slope, b = now  # (n + m, n), (m, K)
        S = sum(along[:, None] * row for along, row in zip(slope, [*S, *b]))
        return S, S

    return jax.lax.scan(grow, first, (slopes, basis))[1]
