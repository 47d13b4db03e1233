"""Shapes of tanks: volume, cross-section and level of each, exact inverses of each other.

Levels are lengths above the bottom. Above its height a sphere or a horizontal cylinder goes on as a
narrow neck, a table as a prism of its last area, a cone as a cone.
"""

import functools
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

NECK = 0.01
"""Cross-section of the neck above a closed vessel, as a share of the largest."""

TIP = 1e-6
"""Share of the largest cross-section below which a slope uses this instead: the slope dh/dV of a
cone or a sphere is infinite at the bottom."""


class Vessel(NamedTuple):
    """A shape, as functions of its dimensions p."""

    dimensions: tuple[str, ...]  # names of the entries of p
    volume: Callable[..., Any]  # (p, level) -> volume
    area: Callable[..., Any]  # (p, level) -> cross-section
    level: Callable[..., Any]  # (p, volume) -> level, not differentiated
    largest: Callable[..., Any]  # p -> largest cross-section up to the height


def _prism() -> Vessel:
    return Vessel(
        ("area",),
        lambda p, h: p[0] * h,
        lambda p, h: p[0] + 0.0 * h,
        lambda p, volume: volume / p[0],
        lambda p: p[0],
    )


def _cone() -> Vessel:
    def top(p: Any) -> Any:
        return math.pi * p[1] ** 2 / 4.0

    return Vessel(
        ("height", "diameter"),
        lambda p, h: top(p) * h * (h / p[0]) ** 2 / 3.0,
        lambda p, h: top(p) * (h / p[0]) ** 2,
        lambda p, volume: p[0] * jnp.cbrt(3.0 * volume / (top(p) * p[0])),
        top,
    )


def _necked(diameter: Callable, full: Callable, largest: Callable, inside: Vessel) -> Vessel:
    """Return a vessel that is closed at the level diameter(p) with its neck above."""

    def volume(p: Any, h: Any) -> Any:
        d = diameter(p)
        within = inside.volume(p, jnp.minimum(h, d))
        return within + NECK * largest(p) * jnp.maximum(h - d, 0.0)

    def area(p: Any, h: Any) -> Any:
        d = diameter(p)
        return jnp.where(h < d, inside.area(p, jnp.minimum(h, d)), NECK * largest(p))

    def level(p: Any, v: Any) -> Any:
        within = inside.level(p, jnp.minimum(v, full(p)))
        return within + jnp.maximum(v - full(p), 0.0) / (NECK * largest(p))

    return Vessel(inside.dimensions, volume, area, level, largest)


def _sphere() -> Vessel:
    def full(p: Any) -> Any:
        return math.pi * p[0] ** 3 / 6.0

    def share(p: Any, h: Any) -> Any:  # of the volume: y^2 (3 - 2 y), y = h / d
        y = h / p[0]
        return y * y * (3.0 - 2.0 * y)

    def level(p: Any, volume: Any) -> Any:
        # y = 1/2 - sin(asin(1 - 2 w) / 3) inverts w = y^2 (3 - 2 y)
        w = jnp.clip(volume / full(p), 0.0, 1.0)
        y = 0.5 - jnp.sin(jnp.arcsin(1.0 - 2.0 * w) / 3.0)
        # near the bottom that difference has few digits left: two steps of Newton restore them
        low = jnp.maximum(jnp.where(w < 1e-6, jnp.sqrt(w / 3.0), y), 1e-150)
        for _ in range(2):
            low = low - (low * low * (3.0 - 2.0 * low) - w) / (6.0 * low * (1.0 - low))
        return p[0] * jnp.where(w < 0.25, jnp.where(w > 0.0, low, 0.0), y)

    inside = Vessel(
        ("diameter",),
        lambda p, h: full(p) * share(p, h),
        lambda p, h: math.pi * h * (p[0] - h),
        level,
        full,
    )
    return _necked(lambda p: p[0], full, lambda p: math.pi * p[0] ** 2 / 4.0, inside)


def _angle(y: Any) -> Any:
    """Return the angle t in [0, 2 pi] at which t - sin t = y."""
    turned = jnp.where(y > math.pi, 2.0 * math.pi - y, y)
    s = jnp.cbrt(6.0 * jnp.maximum(turned, 0.0))
    z = s * s
    # series of the inverse; exact to rounding below s = 0.3, a start for Newton above
    terms = (1.0, 1 / 60, 1 / 1400, 1 / 25200, 43 / 17248000, 1213 / 7207200000)
    series = s * functools.reduce(lambda total, term: total * z + term, reversed(terms))
    t = jnp.maximum(series, 0.3)
    for _ in range(3):
        t = t - (t - jnp.sin(t) - turned) / (1.0 - jnp.cos(t))
    t = jnp.where(s < 0.3, series, t)
    return jnp.where(y > math.pi, 2.0 * math.pi - t, t)


def _horizontal_cylinder() -> Vessel:
    def angle_at(p: Any, h: Any) -> Any:
        return 4.0 * jnp.arcsin(jnp.sqrt(jnp.clip(h / p[0], 0.0, 1.0)))

    def volume(p: Any, h: Any) -> Any:
        t = angle_at(p, h)
        return p[1] * p[0] ** 2 / 8.0 * (t - jnp.sin(t))

    def area(p: Any, h: Any) -> Any:
        return 2.0 * p[1] * jnp.sqrt(jnp.maximum(h * (p[0] - h), 0.0))

    def level(p: Any, v: Any) -> Any:
        half = jnp.sin(_angle(8.0 * v / (p[1] * p[0] ** 2)) / 4.0)
        return p[0] * half * half

    return _necked(
        lambda p: p[0],
        lambda p: math.pi * p[0] ** 2 / 4.0 * p[1],
        lambda p: p[0] * p[1],
        Vessel(("diameter", "length"), volume, area, level, lambda p: p[0] * p[1]),
    )


def _table() -> Vessel:
    """Return a vessel of cross-sections at levels, linear between them: p is (levels, areas)."""

    def below(p: Any) -> Any:
        z, a = jnp.asarray(p[0]), jnp.asarray(p[1])
        rises = 0.5 * (a[1:] + a[:-1]) * (z[1:] - z[:-1])
        return jnp.concatenate([jnp.zeros_like(z[:1]), jnp.cumsum(rises)])

    def segment(p: Any, where: Any, knots: Any) -> tuple[Any, ...]:
        z, a = jnp.asarray(p[0]), jnp.asarray(p[1])
        i = jnp.clip(jnp.searchsorted(knots, where, side="right") - 1, 0, z.size - 1)
        after = jnp.minimum(i + 1, z.size - 1)
        width = jnp.where(after > i, z[after] - z[i], 1.0)
        return i, z[i], a[i], (a[after] - a[i]) / width

    def volume(p: Any, h: Any) -> Any:
        i, z, a, slope = segment(p, h, jnp.asarray(p[0]))
        return below(p)[i] + (h - z) * (a + 0.5 * slope * (h - z))

    def area(p: Any, h: Any) -> Any:
        _, z, a, slope = segment(p, h, jnp.asarray(p[0]))
        return a + slope * jnp.maximum(h - z, 0.0)

    def level(p: Any, v: Any) -> Any:
        knots = below(p)
        i, z, a, slope = segment(p, v, knots)
        rest = v - knots[i]
        root = jnp.sqrt(jnp.maximum(a * a + 2.0 * slope * rest, 0.0))
        return z + 2.0 * rest / jnp.maximum(a + root, 1e-300)

    return Vessel(("levels", "areas"), volume, area, level, lambda p: jnp.max(jnp.asarray(p[1])))


VESSELS = {
    "prism": _prism(),
    "cone": _cone(),
    "sphere": _sphere(),
    "horizontal-cylinder": _horizontal_cylinder(),
    "table": _table(),
}


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def volume_of(shape: str, dimensions: tuple, level: Any) -> Any:
    """Return the volume below a level; a level below the bottom is in a neck as above a sphere."""
    vessel = VESSELS[shape]
    below = NECK * vessel.largest(dimensions) * jnp.minimum(level, 0.0)
    return vessel.volume(dimensions, jnp.maximum(level, 0.0)) + below


@volume_of.defjvp
def _volume_jvp(shape: str, primals: Any, tangents: Any) -> Any:
    (dimensions, level), (dimension_rates, rate) = primals, tangents
    by_dimensions = _volume_rate(shape, dimensions, level, dimension_rates)
    return volume_of(shape, dimensions, level), area_of(
        shape, dimensions, level
    ) * rate + by_dimensions


def _volume_rate(shape: str, dimensions: tuple, level: Any, rates: tuple) -> Any:
    """Return the rate of the volume below a fixed level as the dimensions change."""
    vessel = VESSELS[shape]
    # the root in a horizontal cylinder has no slope at its bottom and top
    inside = jnp.maximum(level, TIP * vessel.largest(dimensions) ** 0.5)
    return jax.jvp(lambda p: vessel.volume(p, inside), (dimensions,), (rates,))[1]


def area_of(shape: str, dimensions: tuple, level: Any) -> Any:
    """Return the cross-section at a level, at least TIP of the largest."""
    vessel = VESSELS[shape]
    largest = vessel.largest(dimensions)
    area = jnp.maximum(vessel.area(dimensions, jnp.maximum(level, 0.0)), TIP * largest)
    return jnp.where(level < 0.0, NECK * largest, area)


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def level_of(shape: str, dimensions: tuple, volume: Any) -> Any:
    """Return the level of a volume, the inverse of `volume_of`."""
    vessel = VESSELS[shape]
    below = jnp.minimum(volume, 0.0) / (NECK * vessel.largest(dimensions))
    return vessel.level(dimensions, jnp.maximum(volume, 0.0)) + below


@level_of.defjvp
def _level_jvp(shape: str, primals: Any, tangents: Any) -> Any:
    (dimensions, volume), (dimension_rates, rate) = primals, tangents
    level = level_of(shape, dimensions, volume)
    rate = rate - _volume_rate(shape, dimensions, level, dimension_rates)
    return level, rate / area_of(shape, dimensions, level)
