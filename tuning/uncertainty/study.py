"""Run a case on many draws of uncertain parameters: fixed-size batches, running measures."""

import dataclasses
import math
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from jaxtank import measures as ms
from jaxtank.case import Case, check_case
from jaxtank.core.checks import check_whole
from jaxtank.limits import Limit, of_drawn_rims, resolve_limits
from jaxtank.loop import tank_bottom
from tuning.cluster.engine import check_cluster
from tuning.problem.functions import as_measures, digests
from tuning.storage.columns import Columns, column, row_blocks
from tuning.storage.fingerprint import fingerprint
from tuning.storage.store import Store, check_resume
from tuning.uncertainty.batches import (
    batch_runner,
    batch_size,
    check_devices,
    fan_of,
    gather,
    seed_of,
)
from tuning.uncertainty.needs import BLOCK, infeasible
from tuning.uncertainty.promise import Promise, Study, check_promise, promise_of
from tuning.uncertainty.sampling import Points, clopper_pearson, varied, with_tails
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
            count, unit = int(np.sum(self._broken(limit))), self.case.loop.units
            row = {"name": limit.label, "words": limit.words, "limit": limit.value}
            row |= {"unit": ms.unit(limit.measure, unit), "count": count, "probability": count / n}
            rows.append(row | {"interval95": clopper_pearson(count, n)})
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


FAN_DRAWS = 512  # draws of a fan chart


def ensemble(
    case: Case,
    distributions: Mapping[str, Any] | None = None,
    samples: int = 1000,
    key: int = 0,
    *,
    draws: str = "random",
    measures: Sequence[str] | None = None,
    limits: Any = None,
    fan: bool = True,
    promise: float | None = None,
    batch: int | None = None,
    devices: int = 1,
    cluster: Any = None,
    checkpoint: str | Path | None = None,
    resume: bool = False,
    progress: Callable | None = None,
) -> Ensemble:
    """Run a case on `samples` draws of its uncertain parameters.

    The numbers of a draw do not depend on batches, devices or processes. Under `jax.distributed`
    every process runs its share of the batches and all get the whole.

    Parameters
    ----------
    case : Case
    distributions : dict or None
        {dotted name: distribution, or a relative half-width as in a case's `uncertain`}; by
        default the case's `uncertain`.
    samples : int
        Number of draws.
    key : int
        Seed of draws and sensor noise; draw i has the noise of fold_in(key, i).
    draws : {"random", "latin", "sobol"}
    measures : sequence of str or None
        Names; by default the measures of a summary.
    limits : dict or None
        {measure: limit} as in `tune`; by default the limits of the case.
    fan : bool
        Keep quantiles of the trajectories of the first draws.
    promise : float or None
        Largest share of plants in which any limit may be broken: it is estimated by importance
        sampling around the most likely failures, which start from these draws, with at most
        100 times as many further runs. Normal distributions with the usual cut at 3 standard
        deviations are then cut at 7, or as far as values are physical.
    batch : int or None
        Draws run at once on a device; a size that fits the case where None.
    devices : int
        Local devices to use.
    cluster : str, distributed.Client, concurrent.futures.Executor or None
        Run the batches on workers: "HOST:PORT" of a Dask scheduler, "local:N" for N workers on this
        machine, a Client, or any Executor. A worker that is killed or added changes no number.
    checkpoint : path or None
        Folder where finished batches are kept.
    resume : bool
        Go on with the batches in the checkpoint.
    progress : callable or None
        Called with the number of draws done.

    Returns
    -------
    Ensemble

    Raises
    ------
    InputError
        Before anything is run.

    Examples
    --------
    >>> import tuning
    >>> from jaxtank import presets, rig
    >>> case = rig.set_values(presets.find("cascaded/pi"), {"clock.duration": 8.0})
    >>> spread = {"plant.pump_gain": tuning.Normal(relative=0.05)}
    >>> found = tuning.ensemble(case, spread, samples=4, measures=["max_level"], limits={})
    >>> found.samples, found.measures["max_level"].shape
    (4, (4, 2))
    """
    check_case(case)
    began = time.perf_counter()
    check_whole("samples", samples, 1, 2**31 - 1)
    check_whole("batch", batch, 1, 2**31 - 1, optional=True)
    check_whole("key", key, 0, 2**31 - 1)
    check_resume(checkpoint, resume)
    check_devices(devices)
    check_cluster(cluster, devices)
    distributions, space = with_tails(case, *varied(case, distributions), promise)
    limits = [*resolve_limits(case, as_measures(None, limits)[1]), *_tank_bottoms(case)]
    limits = of_drawn_rims(limits, case.loop.plant, space.labels)
    check_promise(case, promise, limits, distributions)
    if measures is None:
        measures = [m for m in ms.placed("summary") if ms.serves(m, case.loop)]
    ms.check_names(tuple(measures))
    names = tuple(dict.fromkeys([*measures, *(limit.measure for limit in limits)]))
    seed = seed_of(case, space.labels, key)
    samples, batch = int(samples), int(batch or batch_size(case, seed is not None, samples))
    points = Points(draws, space.dimensions, samples, key)
    count, processes = -(-samples // batch), jax.process_count()
    table, failed, batches = Columns(samples, checkpoint), np.zeros(samples, dtype=bool), {}

    def inputs(k):
        """Values and indices of the draws of batch k, the last draw repeated to fill it."""
        rows = points.rows(k * batch, min((k + 1) * batch, samples))
        repeated = np.minimum(np.arange(batch), len(rows) - 1)
        return space.values(rows[repeated]), np.arange(k * batch, (k + 1) * batch)

    def enter(k, result):
        start = k * batch
        failed[start : start + batch] = result.pop("failed")[: samples - start] > 0
        table.put(start, result)

    with batch_runner(case, names, seed, devices, cluster) as run:
        store = None
        if checkpoint is not None:
            kinds = {name: [type(d).__name__, d] for name, d in distributions.items()}
            what = {"distributions": kinds, "measures": names, "samples": samples, "key": key}
            what |= {"draws": draws, "batch": batch, **digests(case.loop, case.clock, names)}
            problem = fingerprint(case, **what)
            store = Store(checkpoint, problem, resume=resume, shared=processes > 1)
        mine = range(jax.process_index(), count, processes)
        results = _results(store, mine, _shapes(case, names, batch), run, inputs, batch)
        for done, (k, result) in enumerate(results, 1):
            (enter if processes == 1 else batches.__setitem__)(k, result)
            if progress is not None:
                progress(min(samples, batch * done))
    for k, result in gather(batches, count).items() if processes > 1 else ():
        enter(k, result)
    values, beyond = _values(case, space, points, checkpoint)
    first = {n: np.array(v[:FAN_DRAWS]) for n, v in values.items()}
    study = Study(case, space, tuple(limits), names, seed, key, batch)
    return Ensemble(
        case=case,
        distributions=distributions,
        labels=space.labels,
        values=values,
        measures=table,
        failed=failed,
        infeasible=beyond,
        limits=limits,
        fan=fan_of(case, first, seed) if fan else None,
        promise=promise_of(study, promise, points, table, failed, devices, cluster, progress),
        wall_s=time.perf_counter() - began,
        seed=key,
        method=draws,
    )


def _tank_bottoms(case):
    """Limits at the bottoms of tanks whose levels may fall below them."""
    if not tank_bottom.is_open(case.loop):
        return []
    lowest = tank_bottom.lower_bounds(case.loop.plant)
    return [Limit("min_level", i, float(level)) for i, level in enumerate(lowest)]


def _shapes(case, names, batch):
    """{name: shape} of the arrays of a batch."""
    entries = lambda m: ms.entries(m, case.loop.plant)
    shapes = {m: () if ms.MEASURES[m].per == "run" else (entries(m),) for m in names}
    return {name: (batch, *shape) for name, shape in shapes.items()} | {"failed": (batch,)}


def _results(store, numbers, shapes, run, inputs, size):
    """Yield (number, batch) of all batches: run those that the store lacks, and enter them."""
    if store is None:
        yield from run(numbers, inputs, size)
        return
    stored = set(store.finished())
    for k, batch in run([k for k in numbers if str(k) not in stored], inputs, size):
        store.put(str(k), batch)
        yield k, batch
    for k in (k for k in numbers if str(k) in stored):
        batch = store.get(str(k))
        if not isinstance(batch, dict) or {n: np.shape(v) for n, v in batch.items()} != shapes:
            raise store.changed(str(k))
        yield k, batch
    store.close()


def _values(case, space, points, folder):
    """(Columns of the drawn values, (draws,) True where infeasible or None), blocks at a time."""
    values, beyond = Columns(points.samples, folder), []
    for rows in row_blocks(points.samples, BLOCK):
        block = space.values(points.rows(rows.start, rows.stop))
        values.put(rows.start, block)
        beyond.append(infeasible(case, block))
    return values, None if beyond[0] is None else np.concatenate(beyond)
