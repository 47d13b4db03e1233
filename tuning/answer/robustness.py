"""A last step of the default answer: gains that make the linearised loop fragile are moved back."""

from typing import Any

import numpy as np

from tuning.answer.setting import Setting
from tuning.answer.stay_put import LINE, STRIDE, WORTH, Found
from tuning.problem.reported import margin_measures

PEAK = 2.5
"""Sensitivity peak Ms that an answer may have, unless a lower one costs more than PRICE [-].
Textbooks recommend 1.4 to 2: above 2 a rise is reported, above this it is taken back."""

PRICE = 0.05
"""Share of the cost that a lower Ms may cost: half of it as a share of the error [-]."""

SPAN, ROUNDS = 0.01, 16
"""A step of the descent of Ms and of its differences, as a share of a range [-]; how often STRIDE
steps are taken along one direction, at most."""


def move_back(setting: Setting, problem: Any, found: Found) -> None:
    """Move the answer in `found` to a point whose Ms is at most PEAK."""
    search, first = found.search, problem.start()
    if search is None or found.point is None or np.array_equal(found.point.z, first):
        return
    z, point = found.point.z, found.point
    highest = _peak(setting, problem, z)
    if not highest > PEAK:  # NaN: it has none
        return
    before = _peak(setting, problem, first)
    allowed = max(PEAK, before)
    if before > PEAK:
        calmer, highest = _descended(setting, problem, found, highest)
        found.z, found.kept = calmer, calmer == first
    if not highest > allowed:
        return
    line = z + np.arange(1, LINE + 1)[:, None] / LINE * (first - z)
    ceiling, violation = point.cost + PRICE * abs(point.cost), search.violation(point)
    for some in np.split(line, LINE // STRIDE):
        low = np.array([_peak(setting, problem, each) <= allowed for each in some])
        if not low.any():
            continue
        costs, _ = problem.screen(some)
        for each in some[low & (costs <= ceiling)]:
            there = search.point(each)
            if search.violation(there) <= violation:
                dearest = min(ceiling, there.cost + WORTH * abs(there.cost))
                here = search.point(first)
                if here.cost <= dearest and search.violation(here) <= violation:
                    each = first.copy()
                found.z, found.kept = each, each == first
                return


def _descended(setting, problem, found, highest):
    """Return (point of the lowest peak within PRICE along the steepest descent of Ms from the
    answer, whose peak is `highest`, or the first whose peak is at most PEAK; that peak).
    """
    search, z, point = found.search, found.point.z, found.point
    ceiling, violation = point.cost + PRICE * abs(point.cost), search.violation(point)
    free, calmer, lowest = ~np.asarray(found.kept), z, highest
    for _ in range(ROUNDS):
        slope = _peak_slope(setting, problem, z) * free
        norm = float(np.linalg.norm(slope))
        if not 0.0 < norm < np.inf:
            break
        steps = np.arange(1, STRIDE + 1)[:, None] * SPAN
        line = np.clip(z - steps * slope / norm, 0.0, 1.0)
        costs, margins = problem.screen(line)
        beyond = np.max(-margins / search.limit_scale, axis=1, initial=0.0)
        for each, fits in zip(line, (costs <= ceiling) & (beyond <= violation)):
            if not fits:
                return calmer, lowest
            peak = _peak(setting, problem, each)
            if peak < lowest:
                calmer, lowest = each, peak
            if lowest <= PEAK:
                return calmer, lowest
        z = line[-1]
    return calmer, lowest


def _peak_slope(setting, problem, z):
    """Return (P,) the slope of the logarithm of Ms at z, by differences; 0 where it has none."""
    slope = np.zeros(len(z))
    for i, unit in enumerate(np.eye(len(z))):
        ends = [np.clip(z + sign * SPAN * unit, 0.0, 1.0) for sign in (1.0, -1.0)]
        up, down = (np.log(_peak(setting, problem, end)) for end in ends)
        if np.isfinite(up - down):
            slope[i] = (up - down) / (ends[0] - ends[1])[i]
    return slope


def _peak(setting, problem, z):
    """Return the sensitivity peak at z (P,); NaN where the loop has none."""
    case = setting.tuned(problem.values(z))
    found = margin_measures(case.loop, case.clock)
    return float(found.get("sensitivity_peak", np.nan))
