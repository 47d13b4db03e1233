"""What is odd in experiment data before and after a fit: readings that no tank makes."""

import dataclasses
from typing import Any, NamedTuple

import numpy as np

from jaxtank.core.labels import input_unit
from jaxtank.rig.sensors import spans_of
from tuning.identification.data_checks import valid
from tuning.identification.experiment import Log

LUCK = 1e-4  # probability of equal readings in a row above which they may be chance
SHORTEST = 8  # equal readings in a row that are called frozen, and changes of others
JUMP = 8.0  # least jump of a spike, there and back, in noise; over its neighbours half of it

FEW = 5  # most readings in a row that a spike has


class Oddity(NamedTuple):
    """Something odd in experiment data; kind: frozen, saturated, spike, held, still or off."""

    kind: str
    log: str
    where: str  # pump1, h2
    count: int  # readings
    first: float  # time of the first [s]
    value: float  # the value it stays at
    unit: str = ""

    @property
    def alters_fit(self) -> bool:
        """Whether the fit describes readings that the tanks did not have."""
        return self.kind in ("frozen", "saturated", "spike", "held")


def oddities(log: Log, loop=None) -> list[Oddity]:
    """Return the oddities of experiment data; of a rig's sensors with its loop."""
    length, rows = "", list[Any]()
    if loop is not None:  # readings that failed have a note of their own
        length, log = loop.units[0], dataclasses.replace(log, y=valid(log, loop))
    if "parts" not in log.assumed:  # of a log whose inputs move in others
        rows += _of_inputs(log, loop)
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


def _of_inputs(log, loop):
    """Yield what is odd of inputs that never change."""
    for j, u in enumerate(log.u.T):
        if len(u) > 1 and np.ptp(u) == 0.0:
            drive = "" if loop is None else input_unit(loop.plant, j, loop.units[1])
            yield "pump", j, "still" if u[0] else "off", len(u), log.t[0], u[0], drive


def _of_level(log, c, ends):
    """Yield (kind, readings, first time, value) of a channel whose sensor ends at `ends`."""
    present = np.flatnonzero(np.isfinite(log.y[:, c]))
    t, y = log.t[present], log.y[present, c]
    others = np.delete(log.y, c, axis=1)[present]
    for start, stop in _stuck(y):
        moved = np.any(np.diff(log.u[present[start] : present[stop - 1]], axis=0) != 0)
        if moved or _moves(others[start:stop]):
            value = y[start]  # at an end of the sensor, or the highest or lowest of all
            near = any(abs(value - end) <= 1e-3 * (ends[1] - ends[0]) for end in ends)
            near |= (y == value).sum() > SHORTEST and value in (y.min(), y.max())
            yield "saturated" if near else "frozen", stop - start, t[start], value
    quiet = np.all(np.diff(log.u[present], axis=0) == 0, axis=1)
    k = np.union1d(_spikes(y), _dips(y, quiet)) if len(y) >= SHORTEST else np.zeros(0)
    if k.size:
        yield "spike", k.size, t[k[0]], y[k[0]]
    repeats = 1 + np.flatnonzero(np.diff(y) == 0.0)
    if (band := _band(y)) > 0.0:
        yield "held", repeats.size, t[repeats[0]], band


def _band(y):
    """Return the dead band of readings that are written on change and repeated, else 0."""
    changes = np.abs(np.diff(y))
    changes = changes[changes > 0.0]
    if changes.size < SHORTEST or 2 * changes.size > len(y) - 1:
        return 0.0
    band = float(np.quantile(changes, 0.1))  # some are written by time, however small
    return band if np.diff(np.unique(y)).min() < 0.5 * band else 0.0


def _stuck(y):
    """Return [(start, stop)] of equal readings in a row that resolution does not explain."""
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


def _noise(y):
    """Return the noise of readings from sample to sample, at least their resolution."""
    step, bend = np.diff(y), np.diff(y, 2)
    changes = np.abs(step) > 1e-9 * np.ptp(y)  # less is rounding, of a unit that was converted
    resolution = np.min(np.abs(step), where=changes, initial=np.inf)
    return max(1.4826 * np.median(np.abs(bend)) / np.sqrt(6), resolution)


def _dips(y, quiet):
    """Return the samples of two to FEW readings that jump away and back while inputs rest."""
    dips: list[int] = []
    step, noise = np.diff(y), _noise(y)
    jumps, step = np.sign(step) * (np.abs(step) > JUMP * noise), np.abs(step)
    for n in range(2, FEW + 1):
        there, back = jumps[1 : len(y) - n - 2], jumps[1 + n : len(y) - 2]
        # k: the last before them; k + n + 1 is the first after
        for k in 1 + np.flatnonzero(there * back < 0):
            around, away = y[[k, k + n + 1]], y[k + 1 : k + n + 1]
            jump = np.abs(away - around.mean()).min()
            beside = max(step[k - 1], step[k + n + 1], np.ptp(around))
            if jump > max(JUMP * noise, 5 * beside) and quiet[k - 1 : k + n + 2].all():
                dips += range(k + 1, k + n + 1)
    return np.array(dips, dtype=int)


def _spikes(y):
    """Return the samples of single readings that jump away and back, as no level does."""
    step, noise = np.diff(y), _noise(y)
    there, back = step[1:-2], -step[2:-1]
    jump = np.where(there * back > 0, np.minimum(np.abs(there), np.abs(back)), 0.0)
    beside = np.maximum(np.abs(step[:-3]), np.abs(step[3:]))
    lasting = np.abs(there - back)
    return 2 + np.flatnonzero((jump > JUMP * noise) & (jump > 5 * beside) & (jump > 2 * lasting))
