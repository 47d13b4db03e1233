"""Which parameters an identification estimates, and the coordinates in which it searches."""

import dataclasses
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from scipy.linalg import block_diag

from jaxtank.bounds import bounds
from jaxtank.core.errors import InputError
from jaxtank.core.labels import input_unit
from jaxtank.core.quantities import factor
from jaxtank.core.tables import unit_name
from jaxtank.core.tree import get_value, split_index
from jaxtank.rig import by_rig_name
from jaxtank.signals.base import Constant

ESTIMATED = ("plant.", "sensor.", "actuator.", "disturbance.")
WITHOUT_EFFECT = {
    *("sensor.noise", "sensor.full_scale", "actuator.low", "actuator.high"),
    *("actuator.initial", "actuator.stop", "actuator.pulse"),
}


OF_PUMPS = ("pump_gain", "split")  # of a pump that is off throughout, no reading depends on these


class Scalar(NamedTuple):
    """One parameter: p its logarithm, or its share of the range."""

    name: str
    low: float
    high: float
    scale: str  # "log" or "linear"

    @property
    def names(self):
        return (self.name,)

    @property
    def box(self):
        return [(np.log(self.low), np.log(self.high)) if self.scale == "log" else (0.0, 1.0)]

    def values(self, p, exp):
        return (exp(p[0]) if self.scale == "log" else self.low + p[0] * (self.high - self.low),)

    def point(self, value):
        """Return [p] of a value."""
        if self.scale == "log":
            return [np.log(max(value, 1e-300))]
        return [(value - self.low) / (self.high - self.low)]

    def slopes(self, p):
        return [[np.exp(p[0]) if self.scale == "log" else self.high - self.low]]


class Branches(NamedTuple):
    """Gain k, split s of a pump by its branch gains k s and k (1 - s) (mirakhorli notes S11)."""

    gain: str
    split: str
    first: tuple  # (low, high) of c1
    second: tuple

    @property
    def names(self):
        return (self.gain, self.split)

    @property
    def box(self):
        return [tuple(np.log(self.first)), tuple(np.log(self.second))]

    def values(self, p, exp):
        """Return (gain, split) at p (2,)."""
        first, second = exp(p[0]), exp(p[1])
        return first + second, first / (first + second)

    def point(self, gain, split):
        split = np.clip(split, 1e-9, 1 - 1e-9)
        return [np.log(gain * split), np.log(gain * (1 - split))]

    def slopes(self, p):
        """Return (2, 2) derivatives of (gain, split)."""
        first, second = np.exp(p)
        share = first / (first + second)
        return [[first, second], [share * (1 - share), -share * (1 - share)]]


class Ladder(NamedTuple):
    """Levels of the points of a sensor's curve below its last: p, logarithms of their distances."""

    names: tuple
    top: float  # level of the last point

    @property
    def box(self):
        return [(np.log(1e-3 * self.top), np.log(self.top))] * len(self.names)

    def values(self, p, exp):
        """Return the levels at p, the first point first."""
        levels, level = [], self.top
        for distance in reversed(p):
            level = level - exp(distance)
            levels.append(level)
        return tuple(reversed(levels))

    def point(self, *levels):
        return np.log(np.maximum(np.diff([*levels, self.top]), 1e-300)).tolist()

    def slopes(self, p):
        return np.triu(np.tile(-np.exp(p), (len(p), 1)))


@dataclasses.dataclass(frozen=True)
class Coordinates:
    """The coordinates p of the parameters to be estimated, as a hashable description."""

    items: tuple  # of Scalar, Branches and Ladder
    inputs: tuple = ()  # (field of Inputs, pump, null) of each of the last items, in no program

    @property
    def names(self):
        """(size,) dotted name of the value of each coordinate; of a branch, gain then split."""
        return tuple(name for item in self.items for name in item.names)

    @property
    def size(self):
        return len(self.names)

    @property
    def leaves(self):
        return Coordinates(self.items[: len(self.items) - len(self.inputs)])

    @property
    def pairs(self):
        """[[i, i + 1], ..]: coordinates that are the two branches of one pump."""
        return [i for item, i in self._items(range(self.size)) if isinstance(item, Branches)]

    @property
    def box(self):
        """(low (size,), high (size,)) of the coordinates."""
        ends = [end for item in self.items for end in item.box]
        return tuple(np.array(ends, dtype=float).reshape(-1, 2).T)

    def _items(self, p):
        """Return [(item, its entries of p)]."""
        entries = iter(p[i] for i in range(self.size))
        return [(item, [next(entries) for _ in item.names]) for item in self.items]

    def values(self, p):
        """Return {name: value} at coordinates p (size,), of numpy or jax."""
        exp = np.exp if isinstance(p, np.ndarray) else jnp.exp
        items = self._items(p)
        return {n: v for item, q in items for n, v in zip(item.names, item.values(q, exp))}

    def point(self, values):
        """Return (size,) coordinates of {name: value}, projected onto the bounds."""
        p = [q for item in self.items for q in item.point(*(values[n] for n in item.names))]
        return np.clip(np.array(p, dtype=float), *self.box)

    def slopes(self, p) -> Any:
        """Return (size, size) derivatives of the values, ordered as `names`, by the coordinates."""
        return block_diag(*(item.slopes(entries) for item, entries in self._items(p)))


def coordinates_of(bounds, branches=True, inputs=()):
    """Return the Coordinates of a list of jaxtank.bounds.Bound, the last of `inputs`."""
    by_name = {b.name: b for b in bounds}
    items: dict[str, Any] = {}
    for b in bounds:
        base, index = split_index(b.name)
        if base == "sensor.curve_level" and branches:
            curve = items.get(f"{base}[{index[0]}]", Ladder((), b.high))
            items[f"{base}[{index[0]}]"] = curve._replace(names=(*curve.names, b.name))
            continue
        pump = index[0] if index else None
        gain, split = (by_name.get(f"plant.{n}[{pump}]") for n in ("pump_gain", "split"))
        if not (branches and gain and split and b in (gain, split)):
            items[b.name] = Scalar(b.name, b.low, b.high, b.scale)
            continue
        low, high = max(split.low, 1e-6), min(split.high, 1 - 1e-6)
        first = (gain.low * low, gain.high * high)
        second = (gain.low * (1 - high), gain.high * (1 - low))
        if b is gain:
            items[gain.name] = Branches(gain.name, split.name, first, second)
    return Coordinates(tuple(items.values()), inputs)


def free_bounds(loop, free):
    """Return the Bounds of {name: (low, high)}; raise InputError for what no reading shows."""
    free = default_free(loop) if free is None else free
    if not free:  # a prediction: the levels at the first sample alone
        return []
    free = by_rig_name(loop, free, convert=False)
    for name in free:
        if not name.startswith(ESTIMATED):
            raise InputError(
                f"free {name}: an identification estimates what begins with"
                f" {', '.join(ESTIMATED)}; levels with --start"
            )
        if split_index(name)[0] in WITHOUT_EFFECT:
            raise InputError(f"free {name}: no reading depends on it in a way that could be fitted")
    ranges = bounds(loop, {n: (*v, "log" if v[0] > 0 else "linear")[:3] for n, v in free.items()})
    feeds: Any = getattr(loop.plant, "feeds", ())
    idle = {f"plant.split[{j}]" for j, (_, second) in enumerate(feeds) if second is None}
    for name in idle & set(free):
        raise InputError(f"free {name}: this pump feeds one tank alone, its split changes nothing")
    ranges = [b for b in ranges if b.name not in idle]
    if not ranges:
        raise InputError(
            f"free {', '.join(free)}: these pumps feed one tank each, their splits change nothing"
        )
    return ranges


def default_free(loop, logs=()):
    """Return {name: (low, high)}: the default unknowns of an identification of `logs`."""
    # flows and their coefficients; not areas, which are measured with a ruler
    plant: Any = loop.plant
    free = {}
    for name in ("pump_gain", "drain", "orifice", "pipe", "valve"):
        values = getattr(plant, name, None)
        values = np.ravel(np.asarray(() if values is None else values, dtype=float))
        positive = [(i, float(v)) for i, v in enumerate(values) if v > 0]
        free |= {f"plant.{name}[{i}]": (v / 10, v * 10) for i, v in positive}
    feeds: Any = getattr(plant, "feeds", ())
    divided = [j for j, (_, second) in enumerate(feeds) if second is not None]
    free |= {f"plant.split[{j}]": (0.02, 0.98, "linear") for j in divided}
    if getattr(plant, "overflow", False):
        free |= {f"plant.caught[{k}]": (0.0, 1.0) for k in range(len(plant.spills))}
    if isinstance(loop.disturbance, Constant):
        sizes = enumerate(np.abs(np.asarray(loop.disturbance.level, dtype=float)).tolist())
        free |= {f"disturbance.level[{i}]": (-10 * v, 10 * v) for i, v in sizes if v}
    if not free:
        kind = type(plant).__name__
        raise InputError(
            f"plant {kind}: no parameter is estimated by default: free={{name: (low, high)}}"
            " names those that are"
        )
    return _without_idle(free, loop, logs)


def _without_idle(free, loop, logs):
    """Return `free` without gain and split of a pump that is off, and without a log's own gain."""
    if not logs:
        return free
    used = np.any([np.any(log.u != 0, axis=0) for log in logs], axis=0)
    off = [f"plant.{name}[{j}]" for j in np.flatnonzero(~used) for name in OF_PUMPS]
    off += [f"plant.pump_gain[{j}]" for j in range(len(used)) if _is_flow(loop, logs, j)]
    return {name: ends for name, ends in free.items() if name not in off} or free


def _is_flow(loop, logs, pump):
    length, drive = loop.units
    units = [unit_name(log.units[1 + pump]) for log in logs if log.units is not None]
    drive_unit = input_unit(loop.plant, pump, drive)
    return any(factor(u, f"{length}^3/s") and factor(u, drive_unit) is None for u in units if u)


def refuse_used(loop, logs, names):
    """Raise InputError for parameters by which columns of a log became inputs or levels."""
    pumps, length, drive = loop.plant.pumps, *loop.units
    of_pumps = [(f"plant.pump_gain[{j}]", 1 + j, "flows", "inputs") for j in range(pumps)]
    for log in logs:
        areas = {f"plant.area[{i}]": 1 + pumps + c for c, i in enumerate(log.tanks)}
        of_tanks = [(name, column, "volumes", "levels") for name, column in areas.items()]
        for name, column, what, became in of_pumps + of_tanks:
            unit = log.units and unit_name(log.units[column] or "")
            volume = unit and factor(length, "m") and factor(unit, f"{length}^3")
            used = _is_flow(loop, [log], column - 1) if became == "inputs" else volume
            if name in names and used:
                unit = input_unit(loop.plant, column - 1, drive) if became == "inputs" else length
                raise InputError(
                    f"free {name}: {log.where(column=column)} has {what}, which became {became} by"
                    f" it, so that these data cannot tell it: leave it out, or give {became} in"
                    f" {unit}"
                )


def nominal(loop, names):
    return {name: float(np.asarray(get_value(loop, name))) for name in names}
