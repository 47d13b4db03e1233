"""What a log leaves open, decided by what the data fit: inputs between irregular rows, and whether
the rig's inflow that varies acted.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from tuning.identification.data_checks import assuming, with_steps
from tuning.identification.experiment import Log
from tuning.identification.least_squares import Fit, solve
from tuning.identification.problem import Estimation
from tuning.identification.simulation import varies

CLEAR = 10.0  # twice the difference of log likelihoods from which an assumption is preferred


class Assumption(NamedTuple):
    """Whether inputs step at irregular rows, in place of lines, and whether the inflow acts."""

    steps: bool
    inflow: bool

    def applied(self, logs: Sequence[Log], case: Any) -> list[Log]:
        """Return the Logs under this assumption."""
        chosen = with_steps(logs) if self.steps else None
        if not varies(case.loop.disturbance):
            return list(logs) if chosen is None else chosen
        acts = "acts" if self.inflow else "left out"
        return [assuming(log, "inflow", acts) for log in chosen or logs]


def open_assumptions(case: Any, logs: Sequence[Log]) -> list[Assumption]:
    """Return the assumptions that the Logs leave open, those of the least change first."""
    steps, inflow = with_steps(logs) is not None, varies(case.loop.disturbance)
    every = [Assumption(s, i) for i in (False, True) for s in (False, True)]
    return [a for a in every if a.steps <= steps and a.inflow <= inflow]


def best_assumption(
    every: Sequence[Assumption],
    case: Any,
    logs: Sequence[Log],
    misfit: Callable[[list[Log], bool], float],
    readings: int,
) -> Assumption:
    """Return the first Assumption that no later one fits clearly better."""
    if len(every) == 1:
        return every[0]
    misfits = [misfit(a.applied(logs, case), a.inflow) for a in every]
    best = 0
    for k, value in enumerate(misfits):
        if readings * np.log(misfits[best] / max(value, 1e-300)) > CLEAR:
            best = k
    return every[best]


def misfit_of(
    estimation: Estimation, fit: Fit, options: Any, **settings: Any
) -> Callable[[list[Log], bool], float]:
    """Return the function (Logs, whether the inflow acts) -> misfit, about an Estimation's Fit."""
    same = {"noise": estimation.noise, "substeps": estimation.substeps}

    def misfit(logs: list[Log], inflow: bool) -> float:
        other = Estimation(estimation.case, logs, **{**options, **same, "inflow": inflow})
        fits = [
            solve(other, start, **settings) for start in (estimation.unknowns(fit), other.nominal())
        ]
        return min(_misfit(each) for each in fits)

    return misfit


def _misfit(fit):
    """Half the weighted sum of squares of the readings, without a prior; of a robust loss that."""
    finite = np.isfinite(fit.cost) and fit.loss == "linear"
    return 0.5 * float(np.sum(fit.residual**2)) if finite else fit.cost
