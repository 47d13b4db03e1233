"""Curves through points with a continuous slope, such as the flow of a pump over its input."""

from typing import Any

import jax.numpy as jnp
import numpy as np

from jaxtank.core.numerics import lower_clip


def straight_curve(x: Any, y: Any, at: Any) -> Any:
    """Return straight lines through points (x (.., k), y (.., k)) at `at` (..), the first and last
    of them prolonged. The inverse is that of x and y exchanged.
    """
    slope = (y[..., 1] - y[..., 0]) / (x[..., 1] - x[..., 0])
    value = y[..., 0] + slope * (at - x[..., 0])
    for i in range(1, np.shape(x)[-1] - 1):
        after = (y[..., i + 1] - y[..., i]) / (x[..., i + 1] - x[..., i])
        value = value + (after - slope) * lower_clip(at - x[..., i], 0.0)
        slope = after
    return value


def monotone_slopes(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return slopes at the points by which the cubic between two of them is monotone
    (F. N. Fritsch and R. E. Carlson, SIAM J. Numer. Anal. 17, 1980; harmonic means inside).
    """
    width, secant = np.diff(x), np.diff(y) / np.diff(x)
    slopes = np.empty_like(y)
    slopes[0], slopes[-1] = secant[0], secant[-1]
    for i in range(1, len(x) - 1):
        before, after = secant[i - 1], secant[i]
        if before * after <= 0.0:
            slopes[i] = 0.0
            continue
        a, b = 2.0 * width[i] + width[i - 1], width[i] + 2.0 * width[i - 1]
        slopes[i] = (a + b) / (a / before + b / after)
    return slopes


def monotone_curve(points: tuple[tuple[float, float], ...], at: Any) -> Any:
    """Return the curve through (x, y) points at `at`, straight beyond its ends: C1, and monotone
    wherever the points are.
    """
    x, y = (np.array(column, dtype=float) for column in zip(*points))
    slopes = monotone_slopes(x, y)
    value = y[0] + slopes[0] * jnp.minimum(at - x[0], 0.0)
    value = value + slopes[-1] * jnp.maximum(at - x[-1], 0.0)
    for i in range(len(x) - 1):
        width = x[i + 1] - x[i]
        t = jnp.clip((at - x[i]) / width, 0.0, 1.0)
        # the part of the cubic between two points, without the value at the first
        rise = y[i + 1] - y[i]
        first, last = width * slopes[i], width * slopes[i + 1]
        value = value + t * (first + t * (3.0 * rise - 2.0 * first - last + t * (
            first + last - 2.0 * rise
        )))  # fmt: skip
    return value
