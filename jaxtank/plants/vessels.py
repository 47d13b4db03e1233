"""Shapes of tanks: volume, cross-section and level, exact inverses of each other.

A shape is given by its largest cross-section and its extent, the level at which it ends: the height
of a cone that stands on its tip, the diameter of a sphere or of a lying cylinder, the last level of
a table. Above that a closed vessel goes on as a narrow neck, a cone or a table as a prism.
"""

import functools
import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

NECK = 0.01  # cross-section of the neck above a closed vessel, as a share of the largest

TIP = 1e-6  # least cross-section of a slope, as a share of the largest: dh/dV is infinite at a tip

SHAPES = ("prism", "cone", "sphere", "horizontal-cylinder")
"""Shapes by name; a table is ((level, area), ...), shares of the extent and of the largest area."""


def shape_name(plant: Any, tank: int) -> str:
    """Return "cone", "sphere", "lying cylinder", "table" or, of an upright tank, ""."""
    shape = plant.shapes[tank] if getattr(plant, "shapes", ()) else "prism"
    if not isinstance(shape, str):
        return "table"
    return {"prism": "", "horizontal-cylinder": "lying cylinder"}.get(shape, shape)


Shape = str | tuple[tuple[float, float], ...]


class Share(NamedTuple):
    """A shape of unit cross-section and unit extent below y = 1."""

    volume: Any  # y -> volume
    area: Any  # y -> cross-section
    level: Any  # volume -> y
    full: float  # volume at y = 1
    above: float  # cross-section above y = 1


def _sphere_level(volume: Any) -> Any:
    # y = 1/2 - sin(asin(1 - 2 w) / 3) inverts w = y^2 (3 - 2 y). Near the bottom that difference
    # has few digits left, which two steps of Newton restore.
    w = 1.5 * volume
    y = 0.5 - jnp.sin(jnp.arcsin(1.0 - 2.0 * w) / 3.0)
    low = jnp.maximum(jnp.where(w < 1e-6, jnp.sqrt(w / 3.0), y), 1e-150)
    for _ in range(2):
        low = low - (low * low * (3.0 - 2.0 * low) - w) / (6.0 * low * (1.0 - low))
    return jnp.where(w < 0.25, jnp.where(w > 0.0, low, 0.0), y)


def _angle(y: Any) -> Any:
    """Return the angle t in [0, 2 pi] at which t - sin t = y."""
    turned = jnp.where(y > math.pi, 2.0 * math.pi - y, y)
    s = jnp.cbrt(6.0 * jnp.maximum(turned, 0.0))
    z = s * s
    # series of the inverse: exact to rounding below s = 0.3, the start of Newton above
    terms = (1.0, 1 / 60, 1 / 1400, 1 / 25200, 43 / 17248000, 1213 / 7207200000)
    series = s * functools.reduce(lambda total, term: total * z + term, reversed(terms))
    t = jnp.maximum(series, 0.3)
    for _ in range(3):
        t = t - (t - jnp.sin(t) - turned) / (1.0 - jnp.cos(t))
    t = jnp.where(s < 0.3, series, t)
    return jnp.where(y > math.pi, 2.0 * math.pi - t, t)


def _segment_volume(y: Any) -> Any:
    t = 4.0 * jnp.arcsin(jnp.sqrt(y))
    return (t - jnp.sin(t)) / 8.0


def _segment_level(volume: Any) -> Any:
    half = jnp.sin(_angle(8.0 * volume) / 4.0)
    return half * half


SHARES = {
    "cone": Share(
        lambda y: y * y * y / 3.0,
        lambda y: y * y,
        lambda volume: jnp.cbrt(3.0 * volume),
        1.0 / 3.0,
        1.0,
    ),
    "sphere": Share(
        lambda y: y * y * (2.0 - 4.0 / 3.0 * y),
        lambda y: 4.0 * y * (1.0 - y),
        _sphere_level,
        2.0 / 3.0,
        NECK,
    ),
    "horizontal-cylinder": Share(
        _segment_volume,
        lambda y: 2.0 * jnp.sqrt(y * (1.0 - y)),
        _segment_level,
        math.pi / 4.0,
        NECK,
    ),
}


@functools.lru_cache(maxsize=256)
def _table_share(points: tuple[tuple[float, float], ...]) -> Share:
    """Return the Share of cross-sections at levels, linear between them."""
    y, area = (np.array(column, dtype=float) for column in zip(*points))
    slope = np.diff(area) / np.diff(y)
    below = np.concatenate([[0.0], np.cumsum(0.5 * (area[1:] + area[:-1]) * np.diff(y))])

    def segment(knots: np.ndarray, at: Any) -> Any:
        inner = jnp.searchsorted(knots[1:-1], at, side="right")
        return inner, *(jnp.asarray(v)[inner] for v in (y[:-1], area[:-1], slope, below[:-1]))

    def volume(at: Any) -> Any:
        _, start, first, rise, before = segment(y, at)
        return before + (at - start) * (first + 0.5 * rise * (at - start))

    def area_at(at: Any) -> Any:
        _, start, first, rise, _ = segment(y, at)
        return first + rise * (at - start)

    def level(at: Any) -> Any:
        _, start, first, rise, before = segment(below, at)
        rest = at - before
        root = jnp.sqrt(jnp.maximum(first * first + 2.0 * rise * rest, 0.0))
        return start + 2.0 * rest / jnp.maximum(first + root, 1e-300)

    return Share(volume, area_at, level, float(below[-1]), float(area[-1]))


def _share(shape: Shape) -> Share:
    return SHARES[shape] if isinstance(shape, str) else _table_share(shape)


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def volume_of(shape: Shape, area: Any, extent: Any, level: Any) -> Any:
    """Return the volume below a level; a level below the bottom stands in a neck."""
    if shape == "prism":
        return area * level
    share, y = _share(shape), level / extent
    within = share.volume(jnp.clip(y, 0.0, 1.0))
    outside = share.above * jnp.maximum(y - 1.0, 0.0) + NECK * jnp.minimum(y, 0.0)
    return area * extent * (within + outside)


def _rate_of_size(at: Any, volume: Any, section: Any, by_area: Any, by_extent: Any) -> Any:
    """Return the rate of V = area extent v(level / extent) at a fixed level."""
    area, extent, level = at
    return volume / area * by_area + (volume - section * level) / extent * by_extent


@volume_of.defjvp
def _volume_jvp(shape: Shape, primals: Any, tangents: Any) -> Any:
    area, extent, level = primals
    by_area, by_extent, by_level = tangents
    volume = volume_of(shape, area, extent, level)
    section = area_of(shape, area, extent, level)
    rate = _rate_of_size((area, extent, level), volume, section, by_area, by_extent)
    return volume, rate + section * by_level


def area_of(shape: Shape, area: Any, extent: Any, level: Any) -> Any:
    """Return the cross-section at a level, at least TIP of the largest."""
    if shape == "prism":
        return area + 0.0 * level
    share, y = _share(shape), level / extent
    within = jnp.maximum(share.area(jnp.clip(y, 0.0, 1.0)), TIP)
    return area * jnp.where(y < 0.0, NECK, jnp.where(y > 1.0, share.above, within))


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def level_of(shape: Shape, area: Any, extent: Any, volume: Any) -> Any:
    """Return the level of a volume, the inverse of `volume_of`."""
    if shape == "prism":
        return volume / area
    share, v = _share(shape), volume / (area * extent)
    within = share.level(jnp.clip(v, 0.0, share.full))
    outside = jnp.maximum(v - share.full, 0.0) / share.above + jnp.minimum(v, 0.0) / NECK
    return extent * (within + outside)


@level_of.defjvp
def _level_jvp(shape: Shape, primals: Any, tangents: Any) -> Any:
    area, extent, volume = primals
    by_area, by_extent, by_volume = tangents
    level = level_of(shape, area, extent, volume)
    section = area_of(shape, area, extent, level)
    rate = _rate_of_size((area, extent, level), volume, section, by_area, by_extent)
    return level, (by_volume - rate) / section
