"""Run a case on many draws of what is uncertain: fixed-size batches, running measures only."""

import contextlib
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from jaxtank import measures as ms
from jaxtank.case import Case
from jaxtank.loop import floor
from jaxtank.loop import run as lp
from tuning.cluster.engine import check_cluster, connect
from tuning.problem.functions import as_measures, digests
from tuning.problem.limits import Limit, resolve_limits
from tuning.problem.scenarios import noisy
from tuning.storage.columns import Columns, row_blocks
from tuning.storage.fingerprint import fingerprint
from tuning.storage.store import Store
from tuning.uncertainty.batches import (
    batch_size,
    check_devices,
    fan_of,
    gather,
    on_devices,
    on_workers,
    run_batch,
)
from tuning.uncertainty.distributions import stated
from tuning.uncertainty.draws import Draws
from tuning.uncertainty.needs import BLOCK, infeasible
from tuning.uncertainty.result import Ensemble
from tuning.uncertainty.sampling import Points, check_whole, spread_of

FAN_DRAWS = 512
"""Draws of a fan chart."""


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
    batch: int | None = None,
    devices: int = 1,
    cluster: Any = None,
    checkpoint: str | Path | None = None,
    resume: bool = False,
    progress: Callable | None = None,
) -> Ensemble:
    """Run a case on `samples` draws of what is uncertain.

    The numbers of a draw do not depend on batches, devices or processes. Under `jax.distributed`
    every process runs its share of the batches and all get the whole.

    Parameters
    ----------
    case : Case
    distributions : dict or None
        {dotted name: distribution, or a relative half-width as in a case's `uncertain`}; those of
        the case where None.
    samples : int
        Number of draws.
    key : int
        Seed of draws and sensor noise; draw i has the noise of fold_in(key, i).
    draws : {"random", "latin", "sobol"}
    measures : sequence of str or None
        Names; those of a summary where None.
    limits : dict or None
        {measure: limit} as in `tune`; those of the case where None.
    fan : bool
        Keep quantiles of the trajectories of the first draws.
    batch : int or None
        Draws run at once on a device; a size that fits the case where None.
    devices : int
        Local devices to use.
    cluster : str, distributed.Client or None
        Run the batches on a Dask cluster: "HOST:PORT" of its scheduler, "local:N" for N workers on
        this machine, or a Client. A worker that is killed or added changes no number.
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
    began = time.perf_counter()
    check_whole("samples", samples, 1, 2**31 - 1)
    check_whole("key", key, 0, 2**31 - 1)
    check_devices(devices)
    check_cluster(cluster, devices)
    distributions = spread_of(case) if distributions is None else stated(distributions)
    limits = as_measures(None, limits)[1]
    limited = [*resolve_limits(case, limits), *_floors(case)]
    names = _measure_names(case, measures, limited)
    plan = _plan(case, Draws(case.loop, distributions), names, samples, key, draws, batch)
    store = None
    with _runner(case, names, plan.seed, devices, cluster) as runner:
        if checkpoint is not None:
            what = _what(case, distributions, samples, key, draws, names, plan.batch)
            store = Store(checkpoint, what, resume=resume, shared=jax.process_count() > 1)
        joined = _joined(plan, store, runner, progress)
    values, beyond = _drawn(case, plan, checkpoint)
    first = {n: np.array(v[:FAN_DRAWS]) for n, v in values.items()}
    return Ensemble(
        case=case,
        distributions=distributions,
        labels=plan.space.labels,
        values=values,
        measures=joined[0],
        failed=joined[1],
        infeasible=beyond,
        limits=limited,
        fan=fan_of(case, first, plan.seed) if fan else None,
        wall_s=time.perf_counter() - began,
        seed=key,
        method=draws,
    )


def _floors(case):
    """Limits at the bottoms of tanks whose levels may fall below them."""
    if not floor.is_open(case.loop):
        return []
    lowest = floor.lowest(case.loop.plant)
    return [Limit("min_level", i, float(level)) for i, level in enumerate(lowest)]


def _measure_names(case, measures, limited):
    """The measures of a study, those of its limits among them."""
    if measures is None:
        measures = [m for m in ms.placed("summary") if ms.serves(m, case.loop)]
    ms.check_names(tuple(measures))
    return tuple(dict.fromkeys([*measures, *(limit.measure for limit in limited)]))


class _Plan(NamedTuple):
    """What the batches of an ensemble are made of."""

    space: Draws
    points: Points  # probabilities
    seed: int | None  # of the sensor noise
    batch: int  # draws in a batch
    count: int  # of batches
    shapes: dict  # {name: shape} of what a batch holds

    def rows(self, k):
        """Return ({name: (batch, ...)} values, (batch,) numbers) of the draws of batch k."""
        indices = np.arange(k * self.batch, (k + 1) * self.batch)
        inside = indices[indices < self.points.samples]
        points = self.points.rows(int(inside[0]), int(inside[-1]) + 1)
        return self.space.values(points[np.minimum(indices - indices[0], len(points) - 1)]), indices


def _plan(case, space, names, samples, key, draws, batch):
    """Check the runs of an ensemble and lay them out in batches."""
    random = noisy(case) or any(n.startswith("sensor.noise") for n in space.labels)
    lp.check(case.loop, case.clock, jax.random.key(0) if random else None)
    batch = batch or batch_size(case, random, samples)
    points = Points(draws, space.dimensions, samples, key)
    shapes = {
        m: (batch,) if ms.MEASURES[m].per == "run" else (batch, ms.entries(m, case.loop.plant))
        for m in names
    }
    count = -(-samples // batch)
    return _Plan(
        space, points, key if random else None, batch, count, shapes | {"failed": (batch,)}
    )


@contextlib.contextmanager
def _runner(case, names, seed, devices, cluster):
    """Give what runs batches: the devices of this process, or the workers of a cluster."""
    with connect(cluster) as engine:
        if engine is not None:
            yield on_workers(engine, "batches", case, names, seed)
        else:
            yield on_devices(
                devices, lambda at, rows: run_batch(case, names, seed, rows[0], rows[1], at)
            )


def _joined(plan, store, runner, progress):
    """Run the batches that the store lacks; returns (Columns of the measures, (draws,) failed)."""
    folder, several = None if store is None else store.folder, jax.process_count() > 1
    samples, mine = plan.points.samples, {}
    failed, tables = np.zeros(samples, dtype=bool), []

    def put(k, batch):
        if not tables:
            like = {n: batch[n] for n in plan.shapes if n != "failed"}
            tables.append(Columns(like, samples, folder))
        tables[0].put(k * plan.batch, batch)
        rows = slice(k * plan.batch, min((k + 1) * plan.batch, samples))
        failed[rows] = batch["failed"][: rows.stop - rows.start] > 0

    _batches(plan, store, runner, progress, mine.__setitem__ if several else put)
    for k, batch in gather(mine, plan.count).items() if several else ():
        put(k, batch)
    return tables[0], failed


def _drawn(case, plan, folder):
    """(Columns of the drawn values, (draws,) True where infeasible or None), blocks at a time."""
    space, samples = plan.space, plan.points.samples
    values, beyond = Columns(space.values(plan.points.rows(0, 1)), samples, folder), []
    for rows in row_blocks(samples, BLOCK):
        block = space.values(plan.points.rows(rows.start, rows.stop))
        values.put(rows.start, block)
        beyond.append(infeasible(case, block))
    return values, None if beyond[0] is None else np.concatenate(beyond)


def _batches(plan, store, runner, progress, put):
    """Run the batches of this process that the store lacks; put(number, batch) takes each."""
    mine = range(jax.process_index(), plan.count, jax.process_count())
    finished = set() if store is None else set(store.finished())
    missing = [k for k in mine if str(k) not in finished]
    done = len(mine) - len(missing)
    for k, batch in runner(missing, plan.rows, plan.batch):
        if store is not None:
            store.put(str(k), batch)
        put(k, batch)
        done += 1
        if progress is not None:
            progress(min(plan.points.samples, plan.batch * done))
    if store is not None:
        for k in sorted(set(mine) - set(missing)):
            put(k, _stored(store, k, plan.shapes))
        store.close()


def _stored(store, k, shapes):
    """Return batch k of a store. Raises InputError unless it has these {name: shape}."""
    batch = store.get(str(k))
    if not isinstance(batch, dict) or {n: np.shape(v) for n, v in batch.items()} != shapes:
        raise store.changed(str(k))
    return batch


def _what(case, distributions, samples, key, draws, names, batch):
    """Return the fingerprint of an ensemble: batches of another one are refused."""
    return fingerprint(
        case,
        distributions={name: [type(d).__name__, d] for name, d in distributions.items()},
        samples=samples,
        key=key,
        draws=draws,
        measures=names,
        batch=batch,
        **digests(case.loop, case.clock, names),
    )
