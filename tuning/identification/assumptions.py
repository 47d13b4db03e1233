"""What a log leaves open, decided by what the data fit: inputs between irregular rows, and whether
the rig's inflow that varies acted.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from tuning.identification.data_checks import assuming, with_steps
from tuning.identification.experiment import Log
from tuning.identification.least_squares import Fit, solve
from tuning.identification.problem import Estimation
from tuning.identification.simulation import substeps_for, varies

CLEAR = 10.0  # twice the difference of log likelihoods from which an assumption is preferred


class Assumption(NamedTuple):
    """Whether inputs step at irregular rows, in place of lines, and whether the inflow acts."""

    steps: bool
    inflow: bool

    def applied(self, log: Log, case: Any) -> Log:
        """Return the Log under this assumption."""
        log = with_steps(log) if self.steps else log
        if not varies(case.loop.disturbance):
            return log
        return assuming(log, "inflow", "acts" if self.inflow else "left out")


def open_assumptions(case: Any, log: Log, acts: bool = False) -> list[Assumption]:
    """Return the assumptions that a Log leaves open, that of the least change first; acts: the
    inflow is known to act.
    """
    steps, varying = log.assumed.get("inputs") == "lines", varies(case.loop.disturbance)
    inflows = [varying] if acts or not varying else [False, True]
    return [Assumption(s, i) for i in inflows for s in ([False, True] if steps else [False])]


def needs_inflow(case: Any, logs: Sequence[Log], options: Any) -> bool:
    """Whether a simulation is finite only with the inflow that varies: a tank may run empty."""
    if not varies(case.loop.disturbance):
        return False
    alone = Estimation(case, logs, **{**options, "substeps": 1, "inflow": False})
    z = alone.nominal()
    at = (alone.rig_at(z), alone.data, alone.first_levels(z))
    return not np.all(np.isfinite(substeps_for(*at, error=np.inf)[1]))


def best_assumptions(
    estimation: Estimation,
    fit: Fit,
    logs: Sequence[Log],
    options: Any,
    acts: bool = False,
    **settings: Any,
) -> list[Assumption]:
    """Return for each Log the first of its `open_assumptions` that no later one fits clearly
    better, from the Fit of an Estimation.
    """
    case, best = estimation.case, list[Assumption]()
    for e, log in enumerate(logs):
        every, alone = open_assumptions(case, log, acts), estimation.of_log(e)
        if len(every) > 1:
            z = np.concatenate([fit.p, fit.levels[e] / alone.level_scale])
            misfits = [_misfit(alone, z, a, log, options, settings) for a in every]
            every = [_preferred(every, misfits, int(alone.mask.sum()))]
        best.append(every[0])
    return best


def _preferred(every, misfits, readings):
    """The first Assumption that no later one fits clearly better."""
    best = 0
    for k, value in enumerate(misfits):
        if readings * np.log(misfits[best] / max(value, 1e-300)) > CLEAR:
            best = k
    return every[best]


def _misfit(alone, z, assumption, log, options, settings):
    """Half the weighted sum of squares of the readings, without a prior; of a robust loss that."""
    same = {"noise": alone.noise, "substeps": alone.substeps, "inflow": assumption.inflow}
    logs = [assumption.applied(log, alone.case)]
    other = Estimation(alone.case, logs, **{**options, **same})
    fits = [solve(other, start, **settings) for start in (z, other.nominal())]
    linear = all(fit.loss == "linear" and np.isfinite(fit.cost) for fit in fits)
    return min(0.5 * float(np.sum(fit.residual**2)) if linear else fit.cost for fit in fits)
