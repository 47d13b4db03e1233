"""Limits: a measure, its bound, and the margin that is left."""

from typing import NamedTuple

import numpy as np

from jaxtank import measures as ms
from jaxtank.core.errors import InputError
from jaxtank.rig import check_limits
from tuning.problem import scenarios as sc

NOT_A_NUMBER = 1e6
"""Amount by which a measure that is infinite (never settled) or undefined (never reached 90 % of
the step) is taken to break its limit.
"""

NOTHING = 1e-3
"""Share of what a measure is about, below which a limit is as good as 0 [-]."""

SPILL = 1e-6
"""Volume over a rim that counts as none, where rims are physics, as a share of what the tank holds
[-].
"""


class Limit(NamedTuple):
    """One hard constraint: entry `index` of `measure` at most (or at least) `value`, in the
    measure's unit, in one scenario.
    """

    measure: str
    index: int
    value: float
    lane: int = 0
    scenario: str = ""

    @property
    def sign(self):
        """+1 for an upper limit, -1 for a lower one."""
        return ms.MEASURES[self.measure].sense

    @property
    def label(self):
        """Name with the entry, counted from 1: "max_level of tank 3", and its scenario."""
        per = ms.MEASURES[self.measure].per
        where = f" in {self.scenario}" if self.scenario else ""
        return (
            self.measure if per == "run" else f"{self.measure} of {per} {self.index + 1}"
        ) + where

    def margin(self, measures):
        """How far the limit is from being met exactly: positive where it holds. See `margins`."""
        return float(self.margins(np.ravel(measures[self.measure])[self.index]))

    def margins(self, values):
        """Return the margin for each of `values` of the measure.

        An infinite value (never settled) breaks the limit by NOT_A_NUMBER, as does an undefined one
        (a rise that never reached 90 %). An undefined settling time holds: the output never left
        its band.
        """
        undefined = NOT_A_NUMBER if ms.MEASURES[self.measure].nan_holds else -NOT_A_NUMBER
        found = np.clip(self.sign * (self.value - np.asarray(values)), -NOT_A_NUMBER, NOT_A_NUMBER)
        return np.where(np.isnan(values), undefined, found)


def room_of(limit, loop):
    """The size by which a limit's margin counts: the limit's own, but no less than a thousandth of
    what its measure is about (the tanks' height or volume, 1 for a share, 100 for percent), which
    matters where a limit is 0 or nearly.
    """
    length, rim = loop.units[0], np.asarray(loop.plant.rim)
    # no other plant spills, and some have no area to name
    area = np.asarray(loop.plant.area) if loop.plant.overflow else 1.0
    own = {
        length: float(np.max(rim)),
        f"{length}^3": float(np.max(rim * area)),
        "%": 100.0,
        "-": 1.0,
    }.get(ms.unit(limit.measure, loop.units))
    return max(abs(limit.value), NOTHING * own) if own is not None else abs(limit.value) or 1.0


def resolve_limits(case, limits=None, lane=0, scenario=""):
    """The Limits of {measure: number, list or "rim"}; the case's own where None.

    With rims as physics a level cannot pass its rim, so a limit at the rim becomes one of no
    overflow volume. An entry that is undefined on the case's run (see `undefined`) has no Limit.
    Raises InputError for an unknown measure, a value that is no number, and a measure all of whose
    entries are undefined.
    """
    return resolve_in([sc.Lane(scenario, case, None, 1.0)], limits, lane)


def resolve_in(lanes, limits=None, first=0):
    """Return the Limits of `resolve_limits` in each of `lanes`, numbered from `first`.

    Raises InputError as it does, for a measure that is undefined in all of them."""
    found, why = [], {}
    for i, lane in enumerate(lanes, first):
        plant = lane.case.loop.plant
        given = check_limits(lane.case.loop, lane.case.limits if limits is None else limits)
        for measure, value in given.items():
            value = np.asarray(plant.rim) if isinstance(value, str) else value
            values = np.broadcast_to(np.asarray(value, dtype=float), (ms.entries(measure, plant),))
            reason, missing = undefined(measure, lane.case)
            if all(missing):
                why.setdefault(measure, (value, reason))
                continue
            for j, v in enumerate(values):
                held = plant.overflow and measure == "max_level" and v >= plant.rim[j]
                measured, at = (
                    ("overflow_volume", SPILL * float(plant.area[j] * plant.rim[j]))
                    if held
                    else (measure, float(v))
                )
                if not missing[j]:
                    found.append(Limit(measured, j, at, i, lane.name))
    for measure, (value, reason) in why.items():
        if not any(limit.measure == measure for limit in found):
            unit, text = (
                ms.unit(measure, lanes[0].case.loop.units),
                ", ".join(f"{v:g}" for v in np.ravel(value)),
            )
            where = "in every scenario" if len(lanes) > 1 else "on this run"
            raise InputError(
                f"limit {measure} = {text} {unit}: undefined {where}: {reason}, or drop the limit"
                f" (--limit {measure}=none)"
            )
    return found


def undefined(measure, case):
    """Return (reason and remedy, (entries,) True where `measure` has no value on the run of
    `case`).

    Whatever the gains, overshoot, rise and settling are undefined for an output whose setpoint has
    no step within the run, and recovery where nothing is poured.
    """
    wanted, clock, loop = ms.refers_to([measure]), case.clock, case.loop
    onset = None if loop.disturbance is None else loop.disturbance.since(clock)
    since = np.full(1, -1.0) if onset is None else np.asarray(onset)
    if "since" in wanted and onset is not None:
        why = f"nothing is poured within its {clock.duration:g} s; add a pour ([[pour]])"
        return why, [not np.any(since >= 0.0)] * ms.entries(measure, loop.plant)
    windows = loop.reference.windows(clock) if "window" in wanted else None
    if windows is not None:
        steps = [np.asarray(step) for _, step, *_ in windows]
        why = (
            f"no setpoint is stepped within its {clock.duration:g} s; add a step"
            " (reference.changes)"
        )
        return why, [not np.any((step != 0.0) & (since < 0.0)) for step in steps]
    return "", [False] * ms.entries(measure, loop.plant)
