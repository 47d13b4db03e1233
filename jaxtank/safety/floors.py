"""Lower limits on the pumps, computed from the readings, that keep levels above low limits.

The signs of the caps turned: README.md of this folder, "Low limits".
"""

from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp

from jaxtank.core.numerics import clip, lower_clip
from jaxtank.safety.worst_case import Rates, fall


def floor_rows(guard: Any, rates: Rates, y: Sequence, hold: Any, low: Sequence) -> list:
    """Return [(tank, f)] of the tanks with a low limit: sum_j b_j,min u_j >= f [cm/s] keeps it."""
    # f = -Phi_min(y + band) - rate (y - band - low)
    below = lowest(guard, rates, y, hold, low)
    return [
        (
            i,
            -fall(rates, i, y[i] + guard.band[i], below)
            - guard.rate[i] * (y[i] - guard.band[i] - guard.low[i]),
        )
        for i in guard.kept
    ]


def lowest(guard: Any, rates: Rates, y: Sequence, hold: Any, low: Sequence) -> list:
    """Return the (n) least that each level can be until the inputs of this sample end [cm]."""
    below = []
    for i in range(guard.least.tanks):
        drawn = sum(b * lower_clip(-low[j], 0.0) for j, (_, b) in rates.pumps[i].items())
        fastest = lower_clip(drawn - fall(rates, i, guard.reach[i], guard.bottom), 0.0)
        least = y[i] - guard.band[i] - (hold + guard.age) * fastest
        below.append(lower_clip(least, guard.bottom[i]))
    return below


def floors_of(rates: Rates, rows: Sequence, low: Sequence, caps: Sequence) -> tuple:
    """Return ((m) lower limits of the inputs [V], none above its cap, the rows [({pump: b_min}, f)]
    of tanks with two pumps or more).
    """
    floors, shared = list(low), []
    for tank, f in rows:
        gains = rates.pumps[tank]
        if len(gains) > 1:
            shared.append(({j: b for j, (b, _) in gains.items()}, f))
            for j in gains:  # none of them draws
                floors[j] = lower_clip(floors[j], 0.0)
            continue
        ((j, (least, most)),) = gains.items()
        gain = jnp.where(f >= 0.0, least, most)
        needed = jnp.where(gain > 0.0, f / jnp.where(gain > 0.0, gain, 1.0), low[j])
        floors[j] = lower_clip(floors[j], needed)
    return tuple(jnp.where(f < cap, f, cap) for f, cap in zip(floors, caps)), shared


def raised(u: Sequence, shared: Sequence, caps: Sequence) -> tuple:
    """Return inputs u (m) [V] raised towards their caps until the rows of several pumps hold."""
    u = list(u)
    for row, f in shared:
        lacking = f - sum(b * u[j] for j, b in row.items())
        left = sum(b * lower_clip(caps[j] - u[j], 0.0) for j, b in row.items())
        share = clip(lacking / jnp.where(left > 0.0, left, 1.0), 0.0, 1.0)
        for j in row:
            u[j] = u[j] + share * lower_clip(caps[j] - u[j], 0.0)
    return tuple(u)
