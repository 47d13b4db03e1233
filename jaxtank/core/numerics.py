"""Square roots, clips and rounding whose slopes are right, not merely finite.

Every function works on scalars and arrays, costs a few operations, and is safe under forward and
reverse differentiation: where two branches meet, the branch not taken is evaluated at a point where
it is finite (a NaN there would reach the sum).
"""

import functools
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np

Real = jax.Array | float  # a traced or concrete number, or an array of them

Bound = Real | np.ndarray  # a limit: also an entry of a leaf

LAMINAR_THRESHOLD = 0.01
"""Level below which `smooth_sqrt` leaves the exact square root, in the rig's length unit [cm]."""


@functools.partial(jax.custom_jvp, nondiff_argnums=(1,))
def smooth_sqrt(h: Real, threshold: float = LAMINAR_THRESHOLD) -> jax.Array:
    """Return the square root of a level, C1 through zero and below."""
    # q(h) = sqrt(h) h >= h0 = threshold = sqrt(h0) (1.5 x - 0.5 x^2) 0 <= h < h0, x = h/h0 = 1.5
    # sqrt(h0) x h < 0
    # Exact at and above the laminar threshold. Between, it is below the square root by at most
    # 0.175 sqrt(h0) (at x = 0.13): at small depth the outflow is laminar, slower than Torricelli's.
    # Value and slope are continuous; the slope at 0 is 1.5/sqrt(h0) = 15 cm^-0.5 for the default.
    # Negative levels are drawn back to 0. A run whose levels stay above the threshold equals the
    # run with the exact root. With ramps of 30 s, where NGPC brings tank 3 of the benchmark down to
    # 0.004 cm, no level changes by more than 3e-3 cm.
    # sqrt(h) of a negative level is NaN and not taken; the rule below keeps it out of the
    # derivatives, which spares the select in front of every root of the time loop
    laminar = h * (1.5 * threshold**-0.5 - (0.5 * threshold**-1.5) * jnp.where(h > 0.0, h, 0.0))
    return jnp.where(h >= threshold, jnp.sqrt(h), laminar)


@smooth_sqrt.defjvp
def _smooth_sqrt_jvp(threshold: float, primals: Any, tangents: Any) -> Any:
    (h,), (dh,) = primals, tangents
    q = cast(jax.Array, smooth_sqrt(h, threshold))
    deep = h >= threshold
    laminar = 1.5 * threshold**-0.5 - threshold**-1.5 * jnp.where(h > 0.0, h, 0.0)
    return q, jnp.where(deep, 0.5 / jnp.where(deep, q, 1.0), laminar) * dh


def smooth_signed_sqrt(x: Real, threshold: float = LAMINAR_THRESHOLD) -> jax.Array:
    """Return the signed square root of a difference of levels, smooth through zero."""
    # s(x) = x / (x^2 + threshold^2)^(1/4) (gouta2022 notes S2.1)
    return x / jnp.sqrt(jnp.sqrt(x * x + threshold * threshold))


def smooth_signed_sqrt_slope(x: Real, threshold: float = LAMINAR_THRESHOLD) -> jax.Array:
    """Return the slope of `smooth_signed_sqrt`, itself smooth."""
    # s'(x) = (1 - x^2 / (2 (x^2 + threshold^2))) / (x^2 + threshold^2)^(1/4)
    square = x * x + threshold * threshold
    return (1.0 - 0.5 * x * x / square) / jnp.sqrt(jnp.sqrt(square))


def limited_sqrt(h: Real, threshold: float, supply: Real) -> jax.Array:
    """Return the smaller of `smooth_sqrt(h, threshold)` and supply h; 0 below an empty tank."""
    # Slope `supply` at h = 0, the one from above: a level comes no lower.
    level = lower_clip(h, 0.0)
    q, most = cast(jax.Array, smooth_sqrt(level, threshold)), supply * level
    return jnp.where(most <= q, most, q)


@jax.custom_jvp
def limited_flow(s: Real, most: Real, least: Real) -> jax.Array:
    """Return the flow of a pipe, limited to what the tanks at its two ends can give."""
    return jnp.where(s > most, most, jnp.where(s < -least, -least, s))


@limited_flow.defjvp
def _limited_flow_jvp(primals: Any, tangents: Any) -> Any:
    (s, most, least), (ds, dmost, dleast) = primals, tangents
    forth, back = (s >= 0.0) & (most <= s), (s <= 0.0) & (least <= -s)
    slope = jnp.where(forth, dmost, 0.0) - jnp.where(back, dleast, 0.0)
    return limited_flow(s, most, least), jnp.where(forth | back, slope, ds)


@jax.custom_jvp
def clipped_sqrt(h: Real, lower: Real) -> jax.Array:
    """Return sqrt(max(h, lower)), of a level that a controller multiplies or divides by."""
    return jnp.where(h >= lower, jnp.sqrt(h), jnp.sqrt(lower))


@clipped_sqrt.defjvp
def _clipped_sqrt_jvp(primals: Any, tangents: Any) -> Any:
    (h, lower), (dh, dlower) = primals, tangents
    q = clipped_sqrt(h, lower)
    return q, 0.5 / q * jnp.where(h >= lower, dh, dlower)


def root_of_mean(x: Real) -> jax.Array:
    """Return sqrt(x) of a mean of squares x >= 0, with slope 0 at exactly 0."""
    return jnp.where(x == 0.0, 0.0, jnp.sqrt(jnp.where(x == 0.0, 1.0, x)))


@jax.custom_jvp
def magnitude(x: Real) -> jax.Array:
    """Return |x|, with slope 0 at exactly 0."""
    return jnp.abs(x)


@magnitude.defjvp
def _magnitude_jvp(primals: Any, tangents: Any) -> Any:
    (x,), (dx,) = primals, tangents
    return magnitude(x), jnp.sign(x) * dx


def lower_clip(x: Real, lower: Bound) -> jax.Array:
    """Return the larger of `x` and `lower`; NaN of NaN."""
    return jnp.where(x < lower, lower, x)


def clip(x: Real, low: Bound, high: Bound) -> jax.Array:
    """Return `x` held in [low, high]."""
    return jnp.where(x < low, low, jnp.where(x > high, high, x))


def portion(x: Real, low: Real, high: Real) -> jax.Array:
    """Return how much of [low, high] lies below `x`: 0, x - low, or high - low."""
    # Slope 1 inside, 0 outside and 1/2 at the two ends, where a central difference gives the same:
    # of two segments that meet at a knot, the mean of both slopes and not their sum.
    return jnp.minimum(jnp.maximum(x, low), high) - low


def decay(dt: Real, time_constant: Real) -> jax.Array:
    """Return exp(-dt/time_constant), 0 for a time constant of 0 s."""
    # the exponent of a time constant of 0 is taken at a harmless one and dropped
    slow = time_constant > 0
    return jnp.where(slow, jnp.exp(-dt / jnp.where(slow, time_constant, 1.0)), 0.0)


def quantise(x: Real, step: Real) -> jax.Array:
    """Return `x` rounded to a multiple of `step` (> 0), as an ADC does."""
    # The slope is 1, the mean of the staircase: its true slope is 0 almost everywhere and does not
    # describe a change larger than one step.
    rounded = jnp.round(x / step) * step
    return x + jax.lax.stop_gradient(rounded - x)
