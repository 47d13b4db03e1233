"""Batches of the studies on a Dask cluster: the tasks, and what takes the place of local devices.

Imported by the studies and, by name, on workers.
"""

import functools

import jax

from tuning.cluster.sent import received, sent
from tuning.uncertainty.batches import group_of, run_batch, run_points


def batch(text, names, seed, rows, indices):
    """Return what `run_batch` gives for the case of `sent`; a task."""
    return run_batch(received(text), names, seed, rows, indices)


def points(text, names, seed, values):
    """Return what `run_points` gives for the case of `sent`; a task. seed: None without noise."""
    return run_points(_group(text, seed), names, values)


@functools.lru_cache(maxsize=8)
def _group(text, seed):
    return group_of(received(text), None if seed is None else jax.random.key(seed))


class RemoteRunner:
    """Runs batches of an ensemble on the workers of an Engine; used as `batches.Runner` is."""

    def __init__(self, case, names, seed, engine):
        self.engine, self.given = engine, (sent(case, names), names, seed)

    def each(self, numbers, rows_of):
        """Yield (number, batch) as they come; rows_of(number): (values, numbers of the draws)."""
        return self.engine.run("batch", ((k, (*self.given, *rows_of(k))) for k in numbers))


def points_on(case, names, seed, engine):
    """Return what takes the place of `batches.Runs._each` on the workers of an Engine."""
    given = sent(case, names), names, seed
    return lambda starts, rows_of: engine.run("points", ((s, (*given, rows_of(s))) for s in starts))
