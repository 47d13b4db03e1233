"""The range of a parameter, and the scale on which it is searched."""

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from jaxtank import controllers
from jaxtank.case import Case, Free
from jaxtank.core.errors import InputError
from jaxtank.core.text import shortened
from jaxtank.core.tree import describe, get_value, split_index
from jaxtank.loop.closed_loop import ClosedLoop
from jaxtank.rig import by_rig_name, check_free

EDGE = 1e-4  # share of its range within which a value is at an end of it [-]


class Bound(NamedTuple):
    """One scalar parameter: its dotted name, range and unit.

    The search uses z in [0, 1], logarithmic in the size of the value, for ranges of one sign, or
    linear in the value.

    Examples
    --------
    >>> bound = Bound("controller.k", 0.01, 1.0, "log", "1/s")
    >>> round(float(bound.to_unit(0.1)), 12), round(float(bound.from_unit(0.5)), 12)
    (0.5, 0.1)
    """

    name: str
    low: float
    high: float
    scale: str  # "log" or "linear"
    unit: str

    def to_unit(self, value: Any) -> Any:
        """Return z in [0, 1] of a value; values outside the range give z outside [0, 1]."""
        if self.scale == "log":
            return np.log(value / self.low) / math.log(self.high / self.low)
        return (value - self.low) / (self.high - self.low)

    def from_unit(self, z: ArrayLike) -> Any:
        """Return the value at z; the ends are met exactly. Numbers or arrays."""
        z = np.asarray(z, dtype=float)
        if self.scale == "log":
            value = self.low * np.exp(z * math.log(self.high / self.low))
        else:
            value = self.low + z * (self.high - self.low)
        return np.where(z <= 0, self.low, np.where(z >= 1, self.high, value))

    def end_at(self, value: float) -> str | None:
        """Return "lower" or "upper" where a value is at this end of the range, else None."""
        z = float(self.to_unit(value))
        return "lower" if z < EDGE else "upper" if z > 1.0 - EDGE else None

    def slope(self, value: Any) -> Any:
        """Return d value / d z."""
        return (
            value * math.log(self.high / self.low)
            if self.scale == "log"
            else np.full_like(value, self.high - self.low)
        )


WIDE = 30.0  # factor by which a gain may change either way where a case names no range [-]

GAINS: dict[type, tuple[str, ...]] = {
    controllers.PID: ("Kc", "Ti", "Td"),
    controllers.SplitRange: ("Kc", "Ti", "Td"),
    controllers.Ratio: ("Kc", "Ti", "Td"),
    controllers.Cascade: ("Kc", "Ti", "Td", "inner_Kc", "inner_Ti"),
    controllers.FlowCascade: ("Kc", "Ti", "Td", "inner_Kc", "inner_Ti"),
    controllers.Override: ("Kc", "Ti", "Td"),  # a weak loop on the limit costs an objective nothing
    controllers.ReferenceGovernor: ("Kc", "Ti", "Td"),
    controllers.StateFeedback: ("K",),
    controllers.LQI: ("Q", "R"),
    controllers.NGPC: ("Tp",),
    controllers.ENMPC: ("Tp",),
    controllers.Backstepping: ("k", "k1"),
    controllers.TwoTankBackstepping: ("K_phi", "K_y"),
    controllers.SlidingMode: ("surface", "ks", "phi"),
    controllers.FuzzyBlend: ("surface", "ks", "phi", "b", "w"),
    controllers.GPC: ("r_w",),
    controllers.Laguerre: ("r_w", "a"),
    controllers.NMPC: ("horizon", "r_w"),
    controllers.Scheduled: ("values",),
}
"""Gains of a controller, which are tuned where a case does not say what is free."""


def free_of(case: Case) -> Mapping[str, Any]:
    """Return what is free in a case: what it names, else the gains of its controller."""
    return case.free or gain_ranges(case.loop)


def gain_ranges(loop: ClosedLoop) -> dict[str, Free]:
    """Return {name: Free} of the gains of a controller, a factor WIDE either side of their values;
    the entries of a matrix, which may have either sign, within four times the largest.
    """
    ranges: dict[str, Free] = {}
    for gain in GAINS.get(type(loop.controller), ()):
        name, value = f"controller.{gain}", getattr(loop.controller, gain)
        if value is None:
            continue
        array = np.asarray(value, dtype=float)
        for index in np.ndindex(array.shape):
            entry = f"{name}[{','.join(map(str, index))}]" if index else name
            number = float(array[index])
            low, high = sorted((number / WIDE, number * WIDE))
            if array.ndim > 1 and gain != "values":
                high = 4.0 * float(np.abs(array).max())
                low = -high
            ends = Free(_rounded(low), _rounded(high), "log" if low * high > 0 else "linear")
            low, high, scale = within_run(loop, entry, ends)
            if low < high < math.inf:
                ranges[entry] = Free(low, high, scale)
    return ranges


def widened(loop: ClosedLoop, bound: Bound, end: str, longest: float) -> Free:
    """Return the range of a Bound with one end ("lower" or "upper") WIDE times as far out, as far
    as its parameter allows; longest : largest upper end of a time [s]. A range with gains of both
    signs gets twice as wide.
    """
    upper = end == "upper"
    value, other = (bound.high, bound.low) if upper else (bound.low, bound.high)
    if value * other > 0.0:
        value = _rounded(value * WIDE if abs(value) > abs(other) else value / WIDE)
    else:
        value += value - other
    ends = (bound.low, max(value, bound.high)) if upper else (min(value, bound.low), bound.high)
    return within_run(loop, bound.name, Free(*ends, bound.scale), max(longest, bound.high))


def within_run(loop: ClosedLoop, name: str, ends: Free, longest: float = math.inf) -> Free:
    """Return a range within what its parameter allows, and of a time [s] up to `longest`: one
    beyond the duration of a run has no effect in it.
    """
    meta = describe(loop, split_index(name)[0])
    low = ends.low if meta["low"] is None else max(ends.low, meta["low"])
    high = ends.high if meta["high"] is None else min(ends.high, meta["high"])
    return Free(low, min(high, longest) if meta["unit"] == "s" else high, ends.scale)


def _rounded(value: float) -> float:
    return float(f"{value:.3g}")


def is_tunable(case: Case) -> bool:
    """Return whether `tune` has something to search in a case without options."""
    return bool(free_of(case)) and not isinstance(case.loop.controller, controllers.OnOff)


def remedy(loop: ClosedLoop) -> str:
    """Return what to do where nothing is free."""
    if isinstance(loop.controller, controllers.OnOff):
        return (
            "on-off has no gains; compare values of `on` and `off` by simulate or uncertainty with"
            " --set controller.on=VALUE"
        )
    return "name at least one parameter, free={name: (low, high)} or --free NAME=LOW:HIGH"


def bounds(loop: ClosedLoop, free: Mapping[str, Any]) -> list[Bound]:
    """Return the Bounds of {name: Free}; the name of an array stands for all its entries."""
    # Raises InputError for an unknown name, a range that is empty, not finite or outside what the
    # parameter allows.
    if not isinstance(free, Mapping) or not all(isinstance(name, str) for name in free):
        raise InputError(f"free = {shortened(free)}: must be {{name: (low, high)}}")
    if not free:
        raise InputError(f"nothing to tune: {remedy(loop)}")
    entries: list[Bound] = []
    for name, spec in by_rig_name(loop, free, convert=False).items():
        if not isinstance(spec, tuple | list) or len(spec) not in (2, 3):
            raise InputError(
                f"free {name} = {shortened(spec)}: must be (low, high), (low, high, scale) or a"
                " jaxtank.case.Free"
            )
        if name.startswith("safety_filter."):
            raise InputError(
                f"free {name}: the safety filter is designed for the rig, not tuned: its settings"
                " go into [safety_filter] of a rig file"
            )
        low, high, scale = check_free(loop, name, *spec)
        unit = describe(loop, name)["unit"]
        base, _ = split_index(name)
        value = get_value(loop, name)
        names = (
            [name]
            if np.ndim(value) == 0
            else [f"{base}[{','.join(map(str, i))}]" for i in np.ndindex(np.shape(value))]
        )
        entries += [Bound(n, float(low), float(high), scale, unit) for n in names]
    names = [b.name for b in entries]
    for name in names:
        if names.count(name) > 1:
            raise InputError(f"free {name} is given twice")
    return entries
