"""Batches of the studies on a Dask cluster: the tasks, and what takes the place of local
devices.
"""

import functools

import jax

from tuning.cluster.sent import received, sent
from tuning.uncertainty.batches import group_of, run_batch, run_points

WORK = 1 << 24
"""Samples of all runs of a batch from which it is a task of its own [-]: 0.1 s of work, while the
command and the scheduler need 5 ms for a task.
"""

SHARES = 16
"""Least number of tasks, where there are as many batches: workers end at about the same time."""


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


class RemoteRunner:
    """Runs batches of an ensemble on the workers of an Engine; used as `batches.Runner` is."""

    def __init__(self, case, names, seed, engine):
        self.engine, self.given = engine, (sent(case, names), names, seed)
        self.samples = case.clock.samples

    def each(self, numbers, rows_of):
        """Yield (number, batch) as they come; rows_of(number): (values, numbers of the draws)."""
        runs = len(rows_of(numbers[0])[1]) if numbers else 1
        groups = grouped(numbers, runs * self.samples)
        yield from _each(self.engine, "batches", self.given, groups, rows_of)


def points_on(case, names, seed, engine):
    """Return what takes the place of `batches.Runs._each` on the workers of an Engine."""
    given = sent(case, names), names, seed

    def each(starts, rows_of):
        runs = starts[1] - starts[0] if len(starts) > 1 else 1
        groups = grouped(starts, runs * case.clock.samples)
        yield from _each(engine, "points", given, groups, rows_of)

    return each


def _each(engine, task, given, groups, rows_of):
    """Yield (number, result) of the batches of all groups, a group at a time."""
    tasks = ((group, (*given, [rows_of(k) for k in group])) for group in groups)
    for group, found in engine.run(task, tasks):
        yield from zip(group, found, strict=True)
