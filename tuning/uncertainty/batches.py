"""Batches of runs of one case on drawn parameters, on the devices of a process or on a cluster."""

import contextlib
import functools

import jax
import jax.numpy as jnp
import numpy as np

from jaxtank.core.checks import check_whole
from jaxtank.core.errors import InputError
from jaxtank.core.tree import with_values
from jaxtank.loop import run as lp
from jaxtank.xla.jit import compiled
from tuning.cluster.engine import connect
from tuning.cluster.sent import received, sent
from tuning.problem.scenarios import at_once, noisy, threads

BATCH = 256  # draws in a batch, on each device: fills vector units, fits the cache
SEQUENTIAL = 16  # of a loop whose runs are one after the other: every processor has some

NOISE = 1 << 27  # bytes of sensor noise that a batch may hold: long noisy runs have smaller batches
FAN_BATCH, FAN_ROWS = 64, 240  # draws simulated at once, and time stamps, of a fan chart

WORK = 1 << 24  # samples of a batch that is a task: 0.1 s of work, overhead 5 ms [-]
SHARES = 16  # least number of tasks: workers end at about the same time

CUTS = (0.05, 0.25, 0.5, 0.75, 0.95)  # quantiles of a fan chart [-]


def check_devices(devices):
    """Raise InputError unless this process has so many devices."""
    check_whole("devices", devices, 1)
    if devices > jax.local_device_count():
        raise InputError(
            f"devices = {devices}: this process has {jax.local_device_count()} (jax_num_cpu_devices"
            " before jax starts)"
        )


def seed_of(case, labels, seed):
    """Return the seed of the sensor noise, None where neither the case nor a draw has any."""
    random = noisy(case) or any(label.startswith("sensor.noise") for label in labels)
    lp.check(case.loop, case.clock, jax.random.key(0) if random else None)
    return seed if random else None


def batch_size(case, noisy, samples):
    """Return the draws of a batch: a power of 2 that memory and the number of samples allow."""
    size = case.clock.samples * case.loop.plant.tanks * 8 if noisy else 1
    most = max(1, min(SEQUENTIAL if case.loop.sequential else BATCH, NOISE // size))
    return 1 << (int(min(most, max(1, samples))).bit_length() - 1)


@contextlib.contextmanager
def batch_runner(case, names, seed, devices, cluster):
    """Give run(numbers, inputs, size), which yields (number, measures); inputs(number): values."""

    def on_devices(numbers, inputs, size):
        # a thread for each device: one program over all (shard_map) rounds the last bit differently
        places = jax.local_devices()[:devices] if devices > 1 else [None] * threads()
        task = lambda batch: run_batch(case, names, seed, *batch[1], device=batch[0])
        for i in range(0, len(numbers), len(places)):
            group = numbers[i : i + len(places)]
            tasks = list(zip(places, map(inputs, group)))
            yield from zip(group, at_once(task, tasks, len(places)))

    def on_workers(engine, numbers, inputs, size):
        text = sent(case, names)
        share = max(1, min(WORK // (size * case.clock.samples), len(numbers) // SHARES))
        groups = [tuple(numbers[i : i + share]) for i in range(0, len(numbers), share)]
        tasks = ((group, (text, names, seed, [inputs(k) for k in group])) for group in groups)
        for group, results in engine.run("batches", tasks):
            yield from zip(group, results, strict=True)

    with connect(cluster) as engine:
        yield on_devices if engine is None else functools.partial(on_workers, engine)


def batches(text, names, seed, inputs):
    """Return the results of `run_batch` for the case of `sent` and each of `inputs`; a task."""
    return [run_batch(received(text), names, seed, *batch) for batch in inputs]


def run_batch(case, names, seed, values, indices, device=None):
    """Return {measure: (batch, ...), "failed"} at `values`; draw i has noise fold_in(seed, i)."""
    indices = None if indices is None else indices.astype(np.uint32)
    values, indices = jax.device_put((values, indices), device)
    measures = _run(case.loop, values, indices, seed, case.clock, names)
    return {n: np.asarray(v) for n, v in measures.items()}


@compiled("clock", "names", "seed", keep=True)
def _run(loop, values, indices, seed, clock, names):
    def run(values, index):
        noise = None if seed is None else _noise_key(seed, index)
        measures, diverged = lp.evaluate_and_flag(with_values(loop, values), clock, names, noise)
        return {**measures, "failed": diverged.astype(jnp.result_type(float))}

    if loop.sequential:
        return jax.lax.map(lambda draw: run(*draw), (values, indices))
    return jax.vmap(run)(values, indices)


def _noise_key(seed, index):
    key = jax.random.key(seed)
    return key if index is None else jax.random.fold_in(key, index)


def gather(batches, count):
    """Return {number: batch} of all processes, each of which has every n-th."""
    from jax.experimental import multihost_utils

    processes, template = jax.process_count(), next(iter(batches.values()))
    numbers = range(jax.process_index(), -(-count // processes) * processes, processes)
    rows = [batches.get(k, template) for k in numbers]
    everywhere = multihost_utils.process_allgather(
        {n: np.stack([row[n] for row in rows]) for n in template}
    )
    return {
        k: {n: v[k % processes, k // processes] for n, v in everywhere.items()}
        for k in range(count)
    }


def in_batches(function, size, *arrays):
    """`function` of trees (runs, ...), `size` at a time; the last row fills the last batch."""
    runs = len(jax.tree.leaves(arrays)[0])
    first, *others = (np.minimum(np.arange(i, i + size), runs - 1) for i in range(0, runs, size))
    task = lambda rows: function(*jax.tree.map(lambda v: v[rows], arrays))
    parts = [task(first), *at_once(task, others)]  # the first one compiles
    return jax.tree.map(lambda *v: np.concatenate([np.asarray(p) for p in v])[:runs], *parts)


def fan_of(case, values, seed):
    """Return the quantiles CUTS of the trajectories of drawn parameters at fixed times."""
    every = max(1, (case.clock.samples - 1) // FAN_ROWS)
    size = len(next(iter(values.values())))
    run = lambda rows, index: _trajectories(case.loop, rows, index, seed, case.clock, every)
    t, r, x, u = in_batches(run, FAN_BATCH, values, np.arange(size, dtype=np.uint32))
    finite = np.isfinite(x).all(axis=(1, 2))
    if not finite.any():
        return None
    fan = {name: np.quantile(v[finite], CUTS, axis=0) for name, v in {"x": x, "u": u}.items()}
    return {"t": t[0], "r": r[0], **fan, "draws": int(finite.sum()), "of": size}


@compiled("seed", "clock", "every", keep=True)
def _trajectories(loop, values, indices, seed, clock, every):
    def run(values, index):
        noise = None if seed is None else _noise_key(seed, index)
        trajectory = lp.simulate_compiled(with_values(loop, values), clock, noise, every)[0]
        return trajectory.t, trajectory.r, trajectory.x, trajectory.u

    return jax.vmap(run)(values, indices)
