"""Ascent by the signs of the slopes, in the unit cube, many points at once."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

SHORTEST = 1 / 64
"""Step at which a point counts as the top of its hill."""


class Ascent(NamedTuple):
    """Points (runs, ...) after an ascent, their values (runs,), and the values (iterations + 1,
    runs) on the way."""

    z: dict[str, np.ndarray]
    value: np.ndarray
    history: np.ndarray


def ascend(
    slopes: Callable, z: dict[str, np.ndarray], iterations: int, report: Callable | None = None
) -> Ascent:
    """Return points with higher values than those of `z`, in the unit cube."""
    # Each point moves by its own step along the signs of its slopes, z + step sign(dz) cut to the
    # cube: a step of 1 goes to the corner that a linear function is highest at. A point that does
    # not rise stays, and its step is halved.
    value, slope = slopes(z)
    step, history = np.ones(len(value)), [value]
    for done in range(iterations):
        if report is not None:
            report(done)
        tried = {k: _moved(z[k], slope[k], step) for k in z}
        moves = [np.any(_flat(tried[k]) != _flat(z[k]), axis=1) for k in z]
        active = (step >= SHORTEST) & np.any(moves, axis=0)
        if not active.any():
            break
        new, new_slope = slopes(tried)
        better = active & (new > value)
        z = {k: np.where(_wide(better, v), tried[k], v) for k, v in z.items()}
        slope = {k: np.where(_wide(better, v), new_slope[k], v) for k, v in slope.items()}
        value = np.where(better, new, value)
        step = np.where(better, step, 0.5 * step)
        history.append(value)
    return Ascent(z, value, np.stack(history))


def _wide(row, like):
    """(runs,) as an array that is multiplied with `like` (runs, ...)."""
    return row.reshape(-1, *([1] * (np.ndim(like) - 1)))


def _moved(z, slope, step):
    """z + step sign(slope), cut to the unit cube; a slope that is not finite counts as 0."""
    sign = np.sign(np.where(np.isfinite(slope), slope, 0.0))
    return np.clip(z + _wide(step, z) * sign, 0.0, 1.0)


def _flat(rows):
    return np.reshape(rows, (len(rows), -1))
