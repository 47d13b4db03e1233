"""The kinks of the physics: roots, floors and clips whose slopes are right, not merely finite.

Every function works on scalars and arrays, costs a few operations, and is safe under forward and
reverse differentiation: where two branches meet, the branch not taken is evaluated at a point where
it is harmless (a NaN there would poison the sum).
"""

import functools

import jax
import jax.numpy as jnp

LAMINAR_THRESHOLD = 0.01
"""Level below which `smooth_sqrt` leaves the exact square root, in the rig's length unit [cm]."""


@functools.partial(jax.custom_jvp, nondiff_argnums=(1,))
def smooth_sqrt(h, knee=LAMINAR_THRESHOLD):
    r"""Square root of a level, C1 through zero and below.

    h: level (...) [cm]; returns (...) [cm^0.5].

        q(h) = sqrt(h)                           h >= h0 = knee
             = sqrt(h0) (1.5 x - 0.5 x^2)        0 <= h < h0,  x = h/h0
             = 1.5 sqrt(h0) x                    h < 0

    Exact at and above the knee. Between, it is below the square root by at most 0.175 sqrt(h0) (at
    x = 0.13): a thin film drains as laminar flow, slower than Torricelli. Value and slope are
    continuous; the slope at 0 is 1.5/sqrt(h0) = 15 cm^-0.5 for the default. Negative levels are
    drawn back to 0. A run whose levels stay above the knee is that of the exact root; with ramps of
    30 s, where NGPC brings tank 3 of the benchmark down to 0.004 cm, no level moves by 3e-3 cm.
    """
    # sqrt(h) of a negative level is NaN and not taken; the rule below keeps it out of the
    # derivatives, which spares the select in
    # front of every root of the time loop
    film = h * (1.5 * knee**-0.5 - (0.5 * knee**-1.5) * jnp.where(h > 0.0, h, 0.0))
    return jnp.where(h >= knee, jnp.sqrt(h), film)


@smooth_sqrt.defjvp
def _smooth_sqrt_jvp(knee, primals, tangents):
    (h,), (dh,) = primals, tangents
    q = smooth_sqrt(h, knee)
    deep, film = h >= knee, 1.5 * knee**-0.5 - knee**-1.5 * jnp.where(h > 0.0, h, 0.0)
    return q, jnp.where(deep, 0.5 / jnp.where(deep, q, 1.0), film) * dh


def smooth_signed_sqrt(x, knee=LAMINAR_THRESHOLD):
    r"""Signed square root of a difference of levels, smooth through zero: what drives the flow in a
    pipe between two tanks.

    x: (...) [cm]; returns (...) [cm^0.5].

        s(x) = x / (x^2 + knee^2)^(1/4)          (gouta2022 notes S2.1)

    Odd; slope knee^-1/2 at 0, where sign(x) sqrt(|x|) has none (a NaN gradient at equal levels).
    Below the exact root in size, by at most 0.255 sqrt(knee) (at 0.28 knee) and by 0.25 % of it at
    10 knee: a pipe between nearly equal levels flows laminar.
    """
    return x / jnp.sqrt(jnp.sqrt(x * x + knee * knee))


def smooth_signed_sqrt_slope(x, knee=LAMINAR_THRESHOLD):
    """Slope of `smooth_signed_sqrt` (...) [cm^-0.5], smooth: (1 - x^2 / (2 (x^2 + knee^2))) / (x^2 +
    knee^2)^(1/4), knee^-1/2 at 0.
    """
    square = x * x + knee * knee
    return (1.0 - 0.5 * x * x / square) / jnp.sqrt(jnp.sqrt(square))


def limited_sqrt(h, knee, supply):
    r"""Return the smaller of `smooth_sqrt(h, knee)` and supply h; 0 below an empty tank.

    h : (...) level [cm].  knee : as in `smooth_sqrt` [cm].  supply : largest ratio of root to level
    [cm^-0.5], at most 1.5 knee^-0.5 (the slope of `smooth_sqrt` at 0, which then holds nowhere).
    Slope `supply` at h = 0, the one from above: a level comes no lower.
    """
    held = lower_clip(h, 0.0)
    q, most = smooth_sqrt(held, knee), supply * held
    return jnp.where(most <= q, most, q)


@jax.custom_jvp
def limited_flow(s, most, least):
    """Return `s` limited to [-least, most], with most and least >= 0: what the tanks at the two
    ends of a pipe can give. At a tie the slopes are those from above of most and least, which are 0
    at an empty tank and come no lower.
    """
    return jnp.where(s > most, most, jnp.where(s < -least, -least, s))


@limited_flow.defjvp
def _limited_flow_jvp(primals, tangents):
    (s, most, least), (ds, dmost, dleast) = primals, tangents
    forth, back = (s >= 0.0) & (most <= s), (s <= 0.0) & (least <= -s)
    slope = jnp.where(forth, dmost, 0.0) - jnp.where(back, dleast, 0.0)
    return limited_flow(s, most, least), jnp.where(forth | back, slope, ds)


@jax.custom_jvp
def clipped_sqrt(h, floor):
    """sqrt(max(h, floor)), floor > 0: the root a law takes of a level it multiplies or divides by.
    Slope 0 below the floor.
    """
    return jnp.where(h >= floor, jnp.sqrt(h), jnp.sqrt(floor))


@clipped_sqrt.defjvp
def _floored_smooth_sqrt_jvp(primals, tangents):
    (h, floor), (dh, dfloor) = primals, tangents
    q = clipped_sqrt(h, floor)
    return q, 0.5 / q * jnp.where(h >= floor, dh, dfloor)


def root_of_mean(x):
    """sqrt(x) of a mean of squares x >= 0. Slope 0 at exactly 0, where a norm has no slope: what is
    zero throughout stays so. NaN stays NaN.
    """
    return jnp.where(x == 0.0, 0.0, jnp.sqrt(jnp.where(x == 0.0, 1.0, x)))


@jax.custom_jvp
def magnitude(x):
    """|x|. Slope 0 at exactly 0: whatever the slopes of `x` to the left and to the right, a and b, those of |x| are -|a| and |b|, and 0
    lies between. (jnp.abs takes +1: behind a clip at its end, where a pump rests at its limit, that is neither.)
    """
    return jnp.abs(x)


@magnitude.defjvp
def _magnitude_jvp(primals, tangents):
    (x,), (dx,) = primals, tangents
    return magnitude(x), jnp.sign(x) * dx


def lower_clip(x, floor):
    """The larger of `x` and `floor`. Slope 1 in `x` at and above the floor, 0 below (jnp.maximum
    halves it at a tie).
    """
    return jnp.where(x >= floor, x, floor)


def clip(x, low, high):
    """`x` held in [low, high]. Slope 1 inside, ends included, 0 outside; the bounds get the slope
    when they hold.
    """
    return jnp.where(x < low, low, jnp.where(x > high, high, x))


def portion(x, low, high):
    """How much of [low, high] lies below `x`: 0, x - low, or high - low. Slope 1 inside, 0 outside
    and 1/2 at the two ends, where a
    central difference finds the same: of pieces that meet at a knot, the mean of both slopes and
        not their sum.
    """
    return jnp.minimum(jnp.maximum(x, low), high) - low


def quantise(x, step):
    """`x` rounded to a multiple of `step` (> 0), as an ADC does. The slope is 1: the mean of a
    staircase, whose true slope is 0 almost everywhere and says nothing of a change larger than one
    step.
    """
    rounded = jnp.round(x / step) * step
    return x + jax.lax.stop_gradient(rounded - x)
