"""What is odd in experiment data before and after a fit: readings that no tank makes."""

import copy
import itertools
from typing import Any, NamedTuple

import numpy as np

from jaxtank.rig.sensors import spans_of
from tuning.identification.experiment import Log
from tuning.identification.least_squares import Fit, solve
from tuning.identification.problem import Estimation

LUCK = 1e-4
"""Probability of equal readings in a row above which they may be chance."""
SHORTEST = 8
"""Fewest equal readings in a row that are called frozen, and fewest changes of others [-]."""
JUMP = 8.0
"""Least jump of a spike, there and back, in noise, and over the changes beside it a half of it."""
BAD_FIT = 3.0
"""RMS of a residual, in the noise of its channel, from which exchanged columns are tried."""
BETTER = 0.2
"""Share of the sum of squares that an exchange of columns must come below."""


class Oddity(NamedTuple):
    """Something odd in experiment data; kind: frozen, saturated, spike, still, off or swapped."""

    kind: str
    log: str
    where: str  # pump1, h2; of swapped "h1, h2"
    count: int  # readings
    first: float  # time of the first [s]
    value: float  # the value it stays at; of swapped the RMS that is left, as a share
    unit: str = ""

    @property
    def alters_fit(self) -> bool:
        """Whether the fit describes readings that the tanks did not have."""
        return self.kind in ("frozen", "saturated", "spike", "swapped")


def oddities(log: Log, loop=None) -> list[Oddity]:
    """Return the oddities of experiment data; of a rig's sensors with its loop."""
    length, drive = ("", "") if loop is None else loop.units
    rows: list[Any] = [
        ("pump", j, *row, drive) for j, u in enumerate(log.u.T) for row in _still(log.t, u)
    ]
    spans = None if loop is None else spans_of(loop)
    for c, (tank, volts) in enumerate(zip(log.tanks, log.in_volts)):
        ends = () if spans is None else spans[tank]
        if loop is not None and volts:
            ends = (0.0, float(loop.sensor.full_scale))
        rows += [("h", tank, *row, "V" if volts else length) for row in _of_level(log, c, ends)]
    return [
        Oddity(kind, log.name, f"{letter}{i + 1}", int(n), float(first), float(value), unit)
        for letter, i, kind, n, first, value, unit in rows
    ]


def _still(t, u):
    """Yield (kind, samples, first time, value) of an input that never changes."""
    if len(u) > 1 and np.ptp(u) == 0.0:
        yield "still" if u[0] else "off", len(u), t[0], u[0]


def _of_level(log, c, ends):
    """Yield (kind, readings, first time, value) of a channel whose sensor ends at `ends`."""
    present = np.flatnonzero(np.isfinite(log.y[:, c]))
    t, y = log.t[present], log.y[present, c]
    others = np.delete(log.y, c, axis=1)[present]
    for start, stop in _stuck(y):
        moved = np.any(np.diff(log.u[present[start] : present[stop - 1]], axis=0) != 0)
        if moved or _moves(others[start:stop]):
            kind = "saturated" if _at_end(y, y[start], ends) else "frozen"
            yield kind, stop - start, t[start], y[start]
    if (k := _spikes(y)).size:
        yield "spike", k.size, t[k[0]], y[k[0]]


def _stuck(y):
    """Return [(start, stop)] of equal readings in a row: more than the resolution makes, among
    readings with noise, or left by a jump.
    """
    if len(y) < 2 * SHORTEST:
        return []
    step, bend = np.diff(y), np.diff(y, 2)
    edges = np.flatnonzero(step) + 1
    starts, stops = np.concatenate([[0], edges]), np.concatenate([edges, [len(y)]])
    lengths = stops - starts
    usual = lengths[lengths <= np.quantile(lengths, 0.9)]
    same = max(float(1 - len(usual) / usual.sum()), 1e-3)  # that a reading is the one before
    most = max(SHORTEST, 1 + np.log(LUCK / len(y)) / np.log(same))
    bend = bend[bend != 0.0]
    signs, noise = np.sign(bend), np.median(np.abs(bend)) / 1.65 if bend.size else 0.0
    changes = np.abs(step[edges - 1])
    typical, resolution = (np.median(changes), changes.min()) if edges.size else (np.inf, np.inf)
    noisy = noise > 2 * resolution and np.mean(signs[1:] != signs[:-1]) > 0.3
    leaves = lambda b: b < len(y) and abs(step[b - 1]) > 5 * typical
    runs = zip(starts, stops, lengths)
    return [(a, b) for a, b, n in runs if n > most and (noisy or leaves(b))]


def _moves(others):
    """Whether another level changes by more than the noise of its readings."""
    for y in others.T:
        y = y[np.isfinite(y)]
        if y.size >= SHORTEST and np.ptp(y) > 6 * np.sqrt(np.mean(np.diff(y) ** 2) + 1e-300):
            return True
    return False


def _at_end(y, value, ends):
    """Whether readings stay at an end of the sensor, or at the highest or lowest of all."""
    near = [abs(value - end) <= 1e-3 * (ends[1] - ends[0]) for end in ends]
    return any(near) or ((y == value).sum() > SHORTEST and value in (y.min(), y.max()))


def _spikes(y):
    """Return the samples of single readings that jump away and back, as no level does."""
    if len(y) < SHORTEST:
        return np.zeros(0, dtype=int)
    step, bend = np.diff(y), np.diff(y, 2)
    resolution = np.min(np.abs(step), where=step != 0.0, initial=np.inf)
    noise = max(1.4826 * np.median(np.abs(bend)) / np.sqrt(6), resolution)
    there, back = step[1:-2], -step[2:-1]
    jump = np.where(there * back > 0, np.minimum(np.abs(there), np.abs(back)), 0.0)
    beside = np.maximum(np.abs(step[:-3]), np.abs(step[3:]))
    lasting = np.abs(there - back)
    return 2 + np.flatnonzero((jump > JUMP * noise) & (jump > 5 * beside) & (jump > 2 * lasting))


def swapped(estimation: Estimation, fit: Fit, rmse, settings) -> list[Oddity]:
    """Return the pair of channels that fit far better exchanged, where the fit is bad."""
    channels = estimation.data.channels
    bad = [c for c, r in enumerate(rmse) if r is not None and r > BAD_FIT * estimation.noise[c]]
    best, pair = BETTER * fit.cost, None
    for a, b in itertools.combinations(range(len(channels)), 2):
        if not {a, b} & {*bad} or channels[a][1] != channels[b][1]:
            continue
        other, order = copy.copy(estimation), list(range(len(channels)))
        order[a], order[b] = b, a
        other.data = estimation.data._replace(y=estimation.data.y[..., order])
        other.mask, other.noise = estimation.mask[..., order], estimation.noise[order]
        other.initial = estimation.initial.copy()
        first, second = channels[a][0], channels[b][0]
        other.initial[:, [first, second]] = estimation.initial[:, [second, first]]
        cost = min(
            solve(other, start, tolerance=1e-6, **settings).cost
            for start in (other.nominal(), estimation.unknowns(fit))
        )
        if cost < best:
            best, pair = cost, f"h{first + 1}, h{second + 1}"
    if pair is None:
        return []
    log, share = estimation.logs[0], float(np.sqrt(best / fit.cost))
    return [Oddity("swapped", log.name, pair, log.samples, float(log.t[0]), share)]
