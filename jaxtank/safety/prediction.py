"""Levels at the end of a dead time, from above and from below, over the inputs under way.

Two copies of each tank: Theorem 5 of README.md of this folder.
"""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp

from jaxtank.core.numerics import lower_clip, smooth_sqrt
from jaxtank.safety.worst_case import Rates, fall, rise


def line_of(u: Sequence[Any], samples: int) -> tuple[Any, ...]:
    """Return the inputs under way of pumps that have run at u (m) [V]: (m) arrays (samples,)."""
    return tuple(jnp.broadcast_to(jnp.asarray(v), (samples,)) for v in u)


def moved_on(line: Sequence[Any], u: Sequence[Any]) -> tuple[Any, ...]:
    """Return the inputs under way (m) a sample later, u (m) the latest [V]; the oldest is first."""
    return tuple(jnp.concatenate([v[1:], jnp.asarray(w)[None]]) for v, w in zip(line, u))


def brackets(
    rates: Rates,
    tank: int,
    levels: tuple[Any, ...],
    line: Sequence[Any],
    others: tuple[Any, ...],
    step: Any,
    substeps: int,
) -> tuple:
    """Return (least, largest) level [cm] of a tank without pipes after the inputs under way."""
    low, high, top = levels
    above, below = others[1], others[0]
    enters = rise(rates, tank, 0.0 * top, above)
    least_enters = fall(rates, tank, 0.0 * top, below)
    gains = list(rates.pumps[tank].values())
    # within the laminar threshold, and where outflow may be limited, nothing leaves for certain
    shallow = lower_clip(rates.empty[tank] + 0.0 * top, rates.knee)

    def next_pair(pair, inputs):
        low, high = pair
        most: Any = sum(jnp.where(u >= 0.0, b, a) * u for u, (a, b) in zip(inputs, gains))
        least: Any = sum(jnp.where(u >= 0.0, a, b) * u for u, (a, b) in zip(inputs, gains))
        for _ in range(substeps):
            high = _from_above(high, enters + most, rates.out[tank], step, rates.knee, shallow)
            high = jnp.where(high < top, high, top)
            low = _from_below(low, least_enters + least, rates.out_most[tank], step, rates.knee)
        return (low, high), None

    way = tuple(line[j] for j in rates.pumps[tank])
    zero = 0.0 * sum(v[0] for v in way)
    begin = (low + zero, jnp.where(high < top, high, top) + zero)
    return jax.lax.scan(next_pair, begin, way)[0]


def _explicit(h, flow, out, step, knee):
    return h + step * (flow - out * smooth_sqrt(lower_clip(h, 0.0), knee))


def _implicit(h, flow, out, step):
    """The level h1 >= 0 with h1 + step out sqrt(h1) = h + step flow."""
    half = 0.5 * step * out
    target = lower_clip(h + step * flow, 0.0)
    # the clip keeps the slope at an empty tank without outlets finite
    root = jnp.sqrt(lower_clip(half * half + target, 1e-30))
    return lower_clip(target + 2.0 * half * (half - root), 0.0)


def _from_above(h, flow, out, step, knee, shallow):
    explicit, implicit = _explicit(h, flow, out, step, knee), _implicit(h, flow, out, step)
    least = jnp.where(h < shallow, h, shallow)
    falling = lower_clip(implicit, least)
    return jnp.where(explicit >= h, explicit, falling)


def _from_below(h, flow, out, step, knee):
    h = lower_clip(h, 0.0)
    explicit, implicit = _explicit(h, flow, out, step, knee), _implicit(h, flow, out, step)
    return lower_clip(jnp.where(explicit >= h, implicit, explicit), 0.0)
