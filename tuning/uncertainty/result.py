"""The result of an uncertainty study: every draw, and what is counted over them."""

import dataclasses
import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from jaxtank import measures as ms
from tuning.storage.columns import column, row_blocks
from tuning.uncertainty.promise import Promise
from tuning.uncertainty.sampling import clopper_pearson
from tuning.views import Result

TAIL = 0.05  # share of the draws that the conditional value at risk is the mean of [-]
LEVELS = (0.05, 0.5, 0.95)  # levels of the percentiles [-]

QUANTITIES = ("mean", "mean_interval95", "sd", "p05", "p50", "p95", "cvar95", "max")


@dataclasses.dataclass(frozen=True, kw_only=True, repr=False)
class Ensemble(Result):
    """Result of `tuning.ensemble`: N draws of the uncertain parameters, and the measures of each.

    Attributes
    ----------
    case : Case
    distributions : dict
        {dotted name: distribution}.
    labels : list of str
        What varies, an array's entries by their index.
    values : mapping
        {name: (N, ...)} drawn parameters.
    measures : mapping
        {name: (N, ...)}. Above 16 MiB it and `values` are in a file without a name, mapped at each
        look-up, rather than in memory.
    failed : (N,) array
        True where the run diverged: some number is not finite.
    infeasible : (N,) array or None
        True where some plateau of the reference has no steady state below the rims and within the
        pumps' limits; None where there is no closed form for it.
    limits : list of Limit
        Those whose violations are counted.
    fan : dict or None
        {"t", "r", "x", "u"}: quantiles (5, rows, ...) of the first draws.
    promise : Promise or None
        Probability that any limit is broken, beside the promised one.
    wall_s : float
        [s].
    seed : int
    method : str
        "random", "latin" or "sobol".
    """

    case: Any
    distributions: dict
    labels: list
    values: Mapping[str, Any]
    measures: Mapping[str, Any]
    failed: np.ndarray
    infeasible: np.ndarray | None
    limits: list
    fan: dict | None
    promise: Promise | None = None
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
        return {name: _statistics(self.measures, name, ~self.failed) for name in self.measures}

    def violations(self) -> list[dict[str, Any]]:
        """Return how often each limit is broken; a run that diverged counts as breaking it.

        Returns
        -------
        list of dict
            {name, limit, unit, count, probability, interval95}, intervals of Clopper and Pearson.
        """
        rows, n = [], self.samples
        for limit in self.limits:
            count = int(np.sum(self._broken(limit)))
            rows.append(
                {
                    "name": limit.label,
                    "words": limit.words,
                    "limit": limit.value,
                    "unit": ms.unit(limit.measure, self.case.loop.units),
                    "count": count,
                    "probability": count / n,
                    "interval95": clopper_pearson(count, n),
                }
            )
        return rows

    def _broken(self, limit):
        """(N,) True where a draw breaks a limit."""
        broken = self.failed.copy()
        for block in row_blocks(self.samples):
            values = self.measures[limit.measure][block]
            values = values.reshape(len(values), -1)[:, limit.index]
            broken[block] |= limit.margins(values) < 0
        return broken

    @property
    def held(self) -> np.ndarray:
        """(N,) True where the run is finite and every limit holds."""
        held = ~self.failed
        for limit in self.limits:
            held &= ~self._broken(limit)
        return held


def _statistics(measures, name, finite):
    """QUANTITIES of a measure over the runs that are finite, each entry on its own."""
    count = int(np.sum(finite))
    if not count:
        return dict.fromkeys(QUANTITIES)
    shape = measures[name].shape[1:]
    rows = [_entry_statistics(measures, name, finite, i) for i in range(math.prod(shape))]
    summary = {
        q: [np.reshape(ends, shape)[()] for ends in np.transpose(values)]
        if q == "mean_interval95"
        else np.reshape(values, shape)[()]
        for q, values in zip(QUANTITIES, zip(*rows))
    }
    return summary | ({"mean_interval95": None, "sd": None} if count == 1 else {})


@np.errstate(invalid="ignore")
def _entry_statistics(measures, name, finite, entry):
    """QUANTITIES of one entry of a measure, of which one column is in memory, and no copy of it."""
    several = measures[name].ndim > 1 and measures[name].shape[1] > 1
    total = _sum_of_rows if several else np.sum
    values = column(measures, name, entry, finite)
    n, sense = len(values), ms.MEASURES[name].sense
    mean, highest, ends = total(values) / n, values.max(), (values.min(), values.max())
    values -= mean
    values *= values
    sd = np.sqrt(total(values) / (n - 1)) if n > 1 else 0.0
    half = 1.959964 * sd / math.sqrt(n)
    interval = [_within(name, ends, end) for end in (mean - half, mean + half)]
    column(measures, name, entry, finite, out=values)
    values *= sense
    values.sort()
    worst = sense * values[-max(1, math.ceil(TAIL * n)) :]
    values *= sense
    percent = np.quantile(values, LEVELS, method="inverted_cdf", overwrite_input=True)
    return mean, interval, sd, *percent, total(worst) / len(worst), highest


def _sum_of_rows(values):
    """Sum of one column as numpy sums the rows of an array of several: one after the other."""
    total = values[:0].sum()
    for rows in row_blocks(len(values)):
        total = np.cumsum(np.append(total, values[rows]))[-1]
    return total


def _within(name, ends, end):
    """Return `end` of an interval of a measure, moved to what the measure cannot pass."""
    low, high = ms.MEASURES[name].low, ms.MEASURES[name].high
    if low is not None:
        end = np.maximum(end, np.minimum(low, ends[0]))
    return end if high is None else np.minimum(end, np.maximum(high, ends[1]))
