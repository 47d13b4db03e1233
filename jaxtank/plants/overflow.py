"""Overflow at the rims: in which order tanks overflow into each other, and overflow on arrays."""

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxtank.core.numerics import clip
from jaxtank.xla.barrier import materialised
from jaxtank.xla.gather import gathered

UNROLLED = 4
"""Overflows into each other, one after the other, up to which each is written out."""

Pairs = tuple[tuple[int, int], ...]


@functools.lru_cache(maxsize=256)
def downwards(spills: Pairs, tanks: int) -> tuple[list[int], list[int]]:
    """Return (every tank, after those that overflow into it; the tanks of rings, where there is no
    such order): what a tank receives must be in it before its own overflow is computed.
    """
    below: list[list[int]] = [[] for _ in range(tanks)]
    waits = [0] * tanks
    for source, sink in spills:
        below[source].append(sink)
        waits[sink] += 1
    order: list[int] = []
    free = [i for i in range(tanks) if not waits[i]]
    while free:
        order += free
        after: list[int] = []
        for sink in (sink for i in free for sink in below[i]):
            waits[sink] -= 1
            if not waits[sink]:
                after.append(sink)
        free = sorted(after)
    placed = set(order)
    ring = [i for i in range(tanks) if i not in placed]
    return [*order, *ring], ring


class Cascade(NamedTuple):
    """The spills of a rig, in the order in which its tanks overflow."""

    forth: np.ndarray[Any, Any]  # spills into a tank that comes later in the order
    back: np.ndarray[Any, Any]  # those of a ring into a tank that has overflowed before
    ring: np.ndarray[Any, Any]  # (n,) whether a tank belongs to a ring, or follows one
    depth: int  # how many overflows can follow each other


@functools.lru_cache(maxsize=256)
def cascade(spills: Pairs, tanks: int) -> Cascade:
    """Return the Cascade of the spills of a rig."""
    order, ring = downwards(spills, tanks)
    place = {tank: k for k, tank in enumerate(order)}
    forward = [k for k, (source, sink) in enumerate(spills) if place[source] < place[sink]]
    behind = [k for k in range(len(spills)) if k not in set(forward)]
    level = [0] * tanks
    for k in sorted(forward, key=lambda k: place[spills[k][0]]):
        source, sink = spills[k]
        level[sink] = max(level[sink], level[source] + 1)
    rings = np.zeros(tanks, dtype=bool)
    rings[ring] = True
    return Cascade(np.array(forward, int), np.array(behind, int), rings, max(level, default=0))


def overflowed(net: Any, x: Any) -> tuple[Any, Any]:
    """Return (levels (n,) at or below the rims, volume lost over each rim (n,) [cm^3])."""
    area, rim, caught = (jnp.asarray(v) for v in (net.area, net.rim, net.caught))
    found = cascade(net.spills, net.tanks)

    def over(levels: Any) -> Any:
        return materialised(area * (levels - clip(levels, -rim, rim)))

    def caught_of(volumes: Any, which: np.ndarray[Any, Any]) -> Any:
        """(n,) what the spills `which` bring to each tank, as a rise of its level [cm]."""
        source = [net.spills[k][0] for k in which]
        sink = tuple(net.spills[k][1] for k in which)
        return gathered(caught[which], volumes, sink, net.tanks, of=source) / area

    def further(volumes: Any, _: Any) -> Any:
        return over(x + caught_of(volumes, found.forth)), None

    volumes = over(x)
    if found.depth > UNROLLED:

        def all_of(volumes: Any) -> Any:
            return jax.lax.scan(further, volumes, None, length=found.depth)[0]

        # most samples have no overflow, and none then follows
        full = jnp.any(volumes != 0.0)
        volumes = jax.lax.cond(full, all_of, lambda volumes: volumes, volumes)
    else:
        for _ in range(found.depth):
            volumes, _ = further(volumes, None)
    if found.depth:
        x = x + caught_of(volumes, found.forth)
    x, lost = clip(x, -rim, rim), volumes
    if net.spills:
        kept = gathered(caught, None, tuple(a for a, _ in net.spills), net.tanks)
        lost = volumes * (1.0 - kept)
    if len(found.back):  # what has come back to a full tank leaves the rig there
        x = x + caught_of(volumes, found.back)
        held = jnp.where(found.ring, clip(x, -rim, rim), x)
        lost, x = lost + area * (x - held), held
    return x, lost
