"""Batches of runs of one case on drawn parameters, on one device or many; used by the studies."""

import functools
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxtank.core.errors import InputError
from jaxtank.core.tree import get_value, with_values
from jaxtank.loop import run as lp
from jaxtank.xla.jit import compiled
from tuning.cluster.sent import received, sent
from tuning.problem import scenarios as sc
from tuning.uncertainty.sampling import check_whole

BATCH = 256
"""Draws in a batch, on each device: enough to fill the vector units, few enough for the cache."""

POINTS, SAMPLES = 64, 1 << 22
"""Runs in a batch of `Runs`, and most samples of all of them: each holds its signals."""

NOISE = 1 << 27
"""Bytes of sensor noise that a batch may hold: long noisy runs have smaller batches."""

FAN_BATCH, FAN_ROWS = 64, 240
"""Draws simulated at once, and time stamps, of a fan chart."""

WORK = 1 << 24
"""Samples of all runs of a batch from which it is a task of its own [-]: 0.1 s of work, while the
command and the scheduler need 5 ms for a task.
"""

SHARES = 16
"""Least number of tasks, where there are as many batches: workers end at about the same time."""

CUTS = (0.05, 0.25, 0.5, 0.75, 0.95)
"""Quantiles of a fan chart [-]."""


def check_devices(devices):
    """Raise InputError unless this process has so many devices."""
    check_whole("devices", devices, 1)
    if devices > jax.local_device_count():
        raise InputError(
            f"devices = {devices}: this process has {jax.local_device_count()} (jax_num_cpu_devices"
            " before jax starts)"
        )


def batch_size(case, noisy, samples):
    """Return the draws of a batch: a power of 2 that memory and the number of samples allow."""
    size = case.clock.samples * case.loop.plant.tanks * 8 if noisy else 1
    most = max(1, min(BATCH, NOISE // size))
    return 1 << (min(most, max(1, samples)).bit_length() - 1)


def on_devices(devices, run):
    """Return each(numbers, rows_of, runs): (number, run(device, rows_of(number))), in order."""
    # Each device has a thread, and runs the program of a single device. One program partitioned
    # over the devices (shard_map) rounds the last bit differently; this does not.
    local, pool = jax.local_devices()[:devices], ThreadPoolExecutor(devices)

    def each(numbers, rows_of, runs):
        for i in range(0, len(numbers), devices):
            group = numbers[i : i + devices]
            yield from zip(group, pool.map(run, local, map(rows_of, group)))

    return each


def on_workers(engine, task, case, names, seed):
    """Return what `on_devices` gives, on the workers of an Engine: as the batches come."""
    given = sent(case, names), names, seed

    def each(numbers, rows_of, runs):
        groups = grouped(numbers, runs * case.clock.samples)
        tasks = ((group, (*given, [rows_of(k) for k in group])) for group in groups)
        for group, found in engine.run(task, tasks):
            yield from zip(group, found, strict=True)

    return each


def run_batch(case, names, seed, rows, indices, device=None):
    """Return {measure: (batch, ...), "failed": (batch,)} of the draws `indices` at values
    `rows`.
    """
    values, indices = jax.device_put((rows, indices.astype(np.uint32)), device)
    found = _run(case.loop, values, indices, seed, case.clock, names)
    return {n: np.asarray(v) for n, v in found.items()}


@compiled("clock", "names", "seed", keep=True)
def _run(loop, values, indices, seed, clock, names):
    def one(values, index):
        noise = None if seed is None else jax.random.fold_in(jax.random.key(seed), index)
        measures, diverged = lp.evaluate_and_flag(with_values(loop, values), clock, names, noise)
        return {**measures, "failed": diverged.astype(jnp.result_type(float))}

    return jax.vmap(one)(values, indices)


def gather(batches, count):
    """Return {number: batch} of all processes."""
    from jax.experimental import multihost_utils

    most = -(-count // jax.process_count())
    template = next(iter(batches.values()))
    padded = {
        n: np.stack([batches.get(k, template)[n] for k in _share(count, most)]) for n in template
    }
    everywhere = multihost_utils.process_allgather(padded)
    return {
        k: {n: v[k % jax.process_count(), k // jax.process_count()] for n, v in everywhere.items()}
        for k in range(count)
    }


def _share(count, most):
    return [i * jax.process_count() + jax.process_index() for i in range(most)]


class Runs:
    """A case as a function of (n, D) probabilities; returns (n, K) entries of measures."""

    # An entry is NaN where its run is not finite.
    # Batches have one size, so that one compiled program serves; the case's own run goes first.
    # After a call `nominal` (K,) holds its values and `failed` the number of other runs that
    # stopped being finite.

    def __init__(
        self, case, draws, names, key, batch=None, progress=None, devices=1, each: Any = None
    ):
        self.group = group_of(case, key)
        self.own = {
            name: np.asarray(get_value(case.loop, name))[None]
            for name in draws.values(np.zeros((0, draws.dimensions)))
        }
        self.draws, self.names, self.progress = draws, names, progress
        self.batch = batch or max(
            8, min(POINTS, 1 << (max(1, SAMPLES // case.clock.samples).bit_length() - 1))
        )
        self.nominal: Any = None
        self.failed = 0
        self.each = each or on_devices(
            devices,
            lambda device, values: run_points(self.group, names, jax.device_put(values, device)),
        )

    def __call__(self, p):
        values = {
            name: np.concatenate([self.own[name], v]) for name, v in self.draws.values(p).items()
        }
        total, found = len(p) + 1, {}
        size = min(self.batch, total)
        starts = range(0, total, size)

        def rows_of(start):  # the last run repeated to fill the batch
            index = np.minimum(np.arange(start, start + size), total - 1)
            return {name: v[index] for name, v in values.items()}

        for start, (flat, diverged) in self.each(starts, rows_of, size):
            found[start] = flat[: total - start]
            # the case's own run, the very first, is not counted
            self.failed += int(diverged[int(start == 0) : total - start].sum())
            if self.progress is not None:
                self.progress(min(size * len(found), total) - 1, len(p))
        joined = np.concatenate([found[start] for start in starts])
        self.nominal = joined[0]
        return joined[1:]


def group_of(case, key):
    """Return the Group of the case's own run alone; key: of its sensor noise, None without."""
    return sc.groups_of([sc.ScenarioRun("", case, key, 1.0)])[0]


def run_points(group, names, values):
    """Return ((points, entries) of the measures, NaN where not finite, (points,) True there)."""
    measures, broken = sc.values_of(group, names, values)
    flat = np.concatenate(
        [np.asarray(measures[m])[:, 0].reshape(len(broken), -1) for m in names], axis=1
    )
    return np.where(np.asarray(broken), np.nan, flat), np.asarray(broken)[:, 0]


def fan_of(case, values, seed):
    """Return the quantiles CUTS of the trajectories of drawn parameters at fixed times."""
    every = max(1, (case.clock.samples - 1) // FAN_ROWS)
    size, found = len(next(iter(values.values()))), []
    for start in range(0, size, FAN_BATCH):
        index = np.minimum(np.arange(start, start + FAN_BATCH), size - 1)
        rows = {n: v[index] for n, v in values.items()}
        run = _trajectories(case.loop, rows, index.astype(np.uint32), seed, case.clock, every)
        t, r, x, u = map(np.asarray, run)
        found.append((x[: size - start], u[: size - start]))
    x, u = (np.concatenate(column) for column in zip(*found))
    finite = np.isfinite(x).all(axis=(1, 2))
    if not finite.any():
        return None
    return {
        "t": t[0],
        "r": r[0],
        "x": np.quantile(x[finite], CUTS, axis=0),
        "u": np.quantile(u[finite], CUTS, axis=0),
        "draws": int(finite.sum()),
        "of": size,
    }


@compiled("seed", "clock", "every", keep=True)
def _trajectories(loop, values, indices, seed, clock, every):
    def one(values, index):
        noise = None if seed is None else jax.random.fold_in(jax.random.key(seed), index)
        run = lp.simulate_compiled(with_values(loop, values), clock, noise, every)[0]
        return run.t, run.r, run.x, run.u

    return jax.vmap(one)(values, indices)


def batches(text, names, seed, chunks):
    """Return what `run_batch` gives for the case of `sent` and each (values, indices) of `chunks`;
    a task.
    """
    return [run_batch(received(text), names, seed, *chunk) for chunk in chunks]


def points(text, names, seed, chunks):
    """Return what `run_points` gives for the case of `sent` and each array of values of `chunks`; a
    task.
    """
    return [run_points(_group(text, seed), names, values) for values in chunks]


@functools.lru_cache(maxsize=8)
def _group(text, seed):
    return group_of(received(text), None if seed is None else jax.random.key(seed))


def grouped(numbers, samples):
    """Return `numbers` of batches in groups, one for each task."""
    size = max(1, min(WORK // max(1, samples), len(numbers) // SHARES))
    return [tuple(numbers[i : i + size]) for i in range(0, len(numbers), size)]
