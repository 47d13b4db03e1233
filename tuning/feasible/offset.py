"""The least distance from the setpoints that any controller can leave on each plant."""

import numpy as np

from tuning.uncertainty.needs import Needs

ROUNDS = 12
"""Times that the limits are linearised."""

SWEEPS = 60
"""Sweeps of Hildreth's method over the linearised limits."""

REACHED = 1e-4
"""Excess over a limit, as a share of it, with which an answer counts as within the limits."""


def least_offsets(needs: Needs) -> np.ndarray:
    """Return (N, P) least distance of a steady state within the limits from each plateau's
    setpoints [cm, Euclidean over outputs]; NaN where none was found.
    """
    # by sequential quadratic programming from y = r, all plants at once: the limits are linearised
    # at y, and r is projected onto them by Hildreth's method (dual coordinate ascent).
    r = np.broadcast_to(needs.setpoints, (needs.count, *needs.setpoints.shape[1:]))
    size = np.maximum(np.abs(needs.high), np.abs(needs.low))[:, None]
    wrong = needs.excess() > 0
    found = np.zeros(r.shape[:2])
    plants = np.flatnonzero(wrong.any(axis=(1, 2)))
    if not len(plants):
        return found
    few = Needs(needs.case, {n: v[plants] for n, v in needs.values.items()}, needs.limits)
    few_r, size = r[plants], size[plants]
    low, high = few.low[:, None] / size, few.high[:, None] / size
    y, best = few_r.copy(), np.full(few_r.shape[:2], np.inf)
    step = 1e-5 * np.maximum(few_r, 1e-2 * few_r.max())
    for _ in range(ROUNDS):
        needed = few.at(y) / size
        slopes = np.stack(
            [
                (few.at(y + step * one) - few.at(y - step * one))
                / size
                / (2.0 * step * one).sum(-1)[..., None]
                for one in np.eye(r.shape[2])
            ],
            axis=-1,
        )
        best = _kept(best, y, few_r, np.maximum(needed - high, low - needed))
        rows = np.concatenate([slopes, -slopes], axis=2)
        ends = np.concatenate([high - needed, needed - low], axis=2)
        ends = ends + np.einsum("spqm,spm->spq", rows, y)
        y = np.maximum(_projected(few_r, rows, ends), 1e-3 * few_r.max())
    needed = few.at(y) / size
    best = _kept(best, y, few_r, np.maximum(needed - high, low - needed))
    found[plants] = np.where(np.isfinite(best), best, np.nan)
    return found


def _kept(best, y, r, over):
    """The smaller of `best` and the distance of y from r, where y is within the limits."""
    good = np.nan_to_num(over, nan=np.inf).max(axis=2) <= REACHED
    return np.minimum(best, np.where(good, np.linalg.norm(y - r, axis=2), np.inf))


def _projected(r, rows, ends):
    """The points next to r with rows . y <= ends, by Hildreth's method."""
    weight = np.sum(rows * rows, axis=3)
    weight = np.where(weight > 1e-18, weight, np.inf)
    y, dual = r.copy(), np.zeros(ends.shape)
    for _ in range(SWEEPS):
        before = dual.copy()
        for q in range(ends.shape[2]):
            row = rows[:, :, q]
            over = np.einsum("spm,spm->sp", row, y) - ends[:, :, q]
            new = np.maximum(0.0, dual[:, :, q] + over / weight[:, :, q])
            y = y - row * (new - dual[:, :, q])[..., None]
            dual[:, :, q] = new
        if np.max(np.abs(dual - before)) <= 1e-9 * max(1.0, np.max(np.abs(dual))):
            break
    return y
