"""The result of an uncertainty study: every draw, and what is counted over them.

Made by `study`; imported by whoever reads an Ensemble.
"""

import dataclasses
import math
from typing import Any

import numpy as np

from jaxtank import measures as ms
from tuning.problem.result import Result
from tuning.uncertainty.sampling import clopper_pearson

TAIL = 0.05
"""Share of the draws that the conditional value at risk is the mean of [-]."""

QUANTITIES = ("mean", "mean_interval95", "sd", "p05", "p50", "p95", "cvar95", "max")


@dataclasses.dataclass(frozen=True, kw_only=True, repr=False)
class Ensemble(Result):
    """N draws of what is uncertain in a case, and the measures of each; made by `tuning.ensemble`.

    Attributes
    ----------
    case : Case
    distributions : dict
        {dotted name: distribution}.
    labels : list of str
        What varies, an array's entries by their index.
    values : dict
        {name: (N, ...)} drawn parameters.
    measures : dict
        {name: (N, ...)}.
    failed : (N,) array
        True where the run diverged: some number is not finite.
    infeasible : (N,) array or None
        True where some plateau of the reference has no steady state below the rims and within the
        pumps' limits; None where there is no closed form for it.
    limits : list of Limit
        Those whose violations are counted.
    fan : dict or None
        {"t", "r", "x", "u"}: quantiles (5, rows, ...) of the first draws.
    wall_s : float
        [s].
    seed : int
    method : str
        "random", "latin" or "sobol".
    """

    REPORT = "tuning.report.studies.uncertainty"

    case: Any
    distributions: dict
    labels: list
    values: dict
    measures: dict
    failed: np.ndarray
    infeasible: np.ndarray | None
    limits: list
    fan: dict | None
    wall_s: float
    seed: int
    method: str

    @property
    def samples(self) -> int:
        """Number of draws N."""
        return len(self.failed)

    def summary(self) -> dict[str, Any]:
        """Return the statistics of every measure over the draws whose run is finite.

        Returns
        -------
        dict
            {measure: {mean, mean_interval95, sd, p05, p50, p95, cvar95, max}}, one entry per
            output, tank or pump where the measure has several. cvar95 is of the worse side: the
            lower one for a level's minimum. mean_interval95 is cut at what the measure cannot
            pass; it and sd are None for a single draw, all are None where no run is finite.
        """
        finite = ~self.failed
        return {name: _statistics(name, values[finite]) for name, values in self.measures.items()}

    def violations(self) -> list[dict[str, Any]]:
        """Return how often each limit is broken; a run that diverged counts as breaking it.

        Returns
        -------
        list of dict
            {name, limit, unit, count, probability, interval95}, intervals of Clopper and Pearson.
        """
        rows = []
        for limit in self.limits:
            values = self.measures[limit.measure].reshape(self.samples, -1)[:, limit.index]
            broken = int(np.sum(self.failed | (limit.margins(values) < 0)))
            rows.append(
                {
                    "name": limit.label,
                    "limit": limit.value,
                    "unit": ms.unit(limit.measure, self.case.loop.units),
                    "count": broken,
                    "probability": broken / self.samples,
                    "interval95": clopper_pearson(broken, self.samples),
                }
            )
        return rows


def _statistics(name, values):
    """QUANTITIES of a measure; values: (draws, ...) of finite runs."""
    n = len(values)
    if not n:
        return dict.fromkeys(QUANTITIES)
    sense = ms.MEASURES[name].sense
    with np.errstate(invalid="ignore"):
        worst = sense * np.sort(sense * values, axis=0)[-max(1, math.ceil(TAIL * n)) :]
        mean = values.mean(axis=0)
        sd = values.std(axis=0, ddof=1) if n > 1 else np.zeros(values.shape[1:])
        p05, p50, p95 = np.quantile(values, (0.05, 0.5, 0.95), axis=0, method="inverted_cdf")
        half = 1.959964 * sd / math.sqrt(n)
        interval = [_within(name, values, end) for end in (mean - half, mean + half)]
        cvar95, highest = worst.mean(axis=0), values.max(axis=0)
    if n == 1:
        interval = sd = None
    return dict(zip(QUANTITIES, (mean, interval, sd, p05, p50, p95, cvar95, highest)))


def _within(name, values, end):
    """Return `end` of an interval of a measure, moved to what the measure cannot pass.

    values: (draws, ...) that it had; one of them that did pass it moves the bound.
    """
    low, high = ms.MEASURES[name].low, ms.MEASURES[name].high
    if low is not None:
        end = np.maximum(end, np.minimum(low, values.min(axis=0)))
    return end if high is None else np.minimum(end, np.maximum(high, values.max(axis=0)))
