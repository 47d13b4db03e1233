"""A last step of the default answer: gains that make the linearised loop fragile are moved back.

Imported by `attempts`.
"""

from typing import Any

import numpy as np

from tuning.answer.setting import Setting
from tuning.answer.stay_put import LINE, STRIDE, WORTH, Found
from tuning.problem.reported import margin_measures

PEAK = 2.5
"""Sensitivity peak Ms that an answer may have, unless that of the first values is higher [-].
Textbooks recommend 1.4 to 2: above 2 a rise is reported, above this it is taken back."""

PRICE = 0.05
"""Share of the cost that a lower Ms may cost: half of it as a share of the error [-]."""


def highest_peak(before: float) -> float:
    """Return the sensitivity peak that an answer may have, where that of the first values is
    `before`.

    Examples
    --------
    >>> highest_peak(1.4), highest_peak(2.9)
    (2.5, 2.9)
    """
    return max(PEAK, before)


def move_back(setting: Setting, problem: Any, found: Found) -> None:
    """Move the answer in `found` towards the first values until Ms is at most `highest_peak`.

    Along the straight line in the search's coordinates, to the first of LINE points whose
    sensitivity peak (of the nominal loop, at the case's own step, the worst of its plateaus) is low
    enough, whose cost is within PRICE of the answer's, and that keeps the limits as well; to the
    first values themselves where they fit and cost less than WORTH more than that point. The answer
    stays where there is none, or where the loop has no sensitivity peak.

    Parameters
    ----------
    setting : what is searched.
    problem : Problem of the search.
    found : its outcome; `z` and `kept` change.
    """
    search, first = found.search, problem.start()
    if search is None or found.point is None or np.array_equal(found.point.z, first):
        return
    z, point = found.point.z, found.point
    allowed = highest_peak(_peak(setting, problem, first))
    if not _peak(setting, problem, z) > allowed:  # NaN: it has none
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


def _peak(setting, problem, z):
    """Return the sensitivity peak at z (P,); NaN where the loop has none."""
    case = setting.tuned(problem.values(z))
    found = margin_measures(case.loop, case.clock)
    return float(found.get("sensitivity_peak", np.nan))
