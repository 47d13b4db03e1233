"""Local searches on a Dask cluster: what they evaluate is entered into the evaluation cache.

The search itself then runs as without a cluster, and finds its evaluations in the cache: the answer
is the same to the bit. Imported by `stages` and `tuning.answer` and, by name, on workers.
"""

import copy
import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import numpy as np

from jaxtank.core.clock import Clock
from tuning.cluster.engine import Engine
from tuning.cluster.sent import received, sent
from tuning.problem import scenarios as sc
from tuning.problem.limits import Limit, limit_scale
from tuning.problem.problem import Problem
from tuning.search.driver import Search
from tuning.search.first_order import minibatches
from tuning.search.methods import METHODS
from tuning.storage.evaluation_log import EvaluationCache
from tuning.storage.fingerprint import digest


class Local(NamedTuple):
    """How a local search runs.

    Examples
    --------
    >>> Local("slsqp", 40).batch is None
    True
    """

    method: str
    iterations: int
    tolerance: float | None = None  # that of a Search where None
    batch: int | None = None  # scenarios drawn for each step of adam
    seed: int = 0  # of these


def run_local(search: Search, z: Any, how: Local) -> bool:
    """Run a local search from z (P,); returns whether it converged."""
    if how.batch is None:
        return METHODS[how.method](search, z, how.iterations)
    rng = np.random.default_rng([how.seed, search.start])
    return minibatches(search, z, how.iterations, how.batch, rng)


def check_sent(engine: Engine | None, problem: Problem) -> None:
    """Raise InputError, before anything is run, for a problem that cannot be sent to workers."""
    if engine is not None:
        _sent(problem)


def evaluate_ahead(engine: Engine | None, search: Search, starts: list, how: Local) -> None:
    """Run the local searches from `starts` on the workers, and enter what they evaluate.

    What the cache holds already, of a run that is continued, is not run again. engine: None for
    nothing.
    """
    if engine is None:
        return
    problem, tasks = search.problem, []
    for number, z in enumerate(starts):
        known = _Known(problem.cache)
        try:
            _from(problem, known, z, number, how)
        except _Missing:
            tasks.append((number, (z, number, tuple(how), list(known.used.values()))))
    if not tasks:
        return
    text, arrays = _sent(problem)
    given = ((number, (text, arrays, *more)) for number, more in tasks)
    for _, entries in engine.run("search", given, lambda: search.report(search)):
        for entry in entries:
            problem.cache.enter(*entry)


def search(text: tuple, arrays: Any, z: Any, number: int, how: tuple, known: list) -> list:
    """Run a local search of the problem of `_sent`; returns its new evaluations. A task.

    known : [(kind, key, result)] evaluations that were made before.
    """
    cache = _Recorded()
    for entry in known:
        cache.enter(*entry)
    cache.entries.clear()
    _from(_received(text, arrays), cache, z, number, Local(*how))
    return cache.entries


def _from(problem: Problem, cache: EvaluationCache, z: Any, number: int, how: Local) -> None:
    """Run a local search of a problem whose evaluations go through `cache`."""
    problem = copy.copy(problem)  # its counts are those of the search that follows
    problem.cache = cache
    reference = problem.point(problem.start())
    tolerance = {} if how.tolerance is None else {"tolerance": how.tolerance}
    found = Search(problem, reference, lambda search: None, **tolerance)
    found.take(reference)
    found.start = number
    run_local(found, z, how)


class _Missing(Exception):
    """An evaluation is not in the cache."""


class _Known(EvaluationCache):
    """The evaluations of another cache; `used` are those that were asked for."""

    def __init__(self, cache: EvaluationCache):
        super().__init__()
        self.found, self.used = cache.found, {}

    def recall(self, kind: str, arguments: Any, compute: Callable[[], Any]) -> Any:
        key = digest(kind, *arguments)
        if key not in self.found:
            raise _Missing
        self.used[key] = kind, key, self.found[key]
        return self.found[key]


class _Recorded(EvaluationCache):
    """A cache that lists what is entered."""

    def __init__(self):
        super().__init__()
        self.entries: list[tuple] = []

    def keep(self, kind: str, key: str, result: Any) -> Any:
        self.entries.append((kind, key, result))
        return result


def _sent(problem: Problem) -> tuple[tuple, list]:
    """A problem as texts and numbers, and the arrays of its groups.

    A group is the structure of a loop, of which a rig file is sent, and arrays: no file describes
    the loop of a drawn plant under the safety filter of another one.
    """
    base, structure = sent(problem.case, problem.needed), jax.tree.structure(problem.loop)
    limits = [dataclasses.astuple(limit) for limit in problem.limits]
    text = (
        base,
        tuple((b.name, (b.low, b.high, b.scale)) for b in problem.bounds),
        tuple(problem.objective.items()),
        tuple(limits),
        tuple((run.name, run.weight) for run in problem.runs),
        problem.risk,
    )
    arrays = [
        (
            base if group.structure == structure else sent(problem.runs[group.runs[0]].case),
            group.runs,
            dataclasses.asdict(group.clock),
            [np.asarray(leaf) for leaf in group.leaves],
            group.apart,
            *_sent_keys(group.keys),
        )
        for group in problem.groups
    ]
    return text, arrays


def _sent_keys(keys):
    """(array, True where it is noise that was drawn) of the keys of a group."""
    if keys is None or not jax.numpy.issubdtype(keys.dtype, jax.dtypes.prng_key):
        return (None if keys is None else np.asarray(keys)), True
    return np.asarray(jax.random.key_data(keys)), False


def _received(text: tuple, arrays: list) -> Problem:
    """The problem of `_sent`."""
    case, free, objective, limits, runs, risk = text
    found = Problem(received(case), dict(free), dict(objective), {}, (), risk=risk)
    found.runs = [sc.ScenarioRun(name, found.case, None, weight) for name, weight in runs]
    found.limits = [Limit(*limit) for limit in limits]
    found.limit_scales = np.array([limit_scale(limit, found.loop) for limit in found.limits])
    measures = (*found.objective, *(limit.measure for limit in found.limits))
    found.needed = tuple(dict.fromkeys(measures))
    found.groups = [
        sc.Group(
            tuple(mine),
            Clock(**clock),
            jax.tree.structure(received(rig).loop),
            tuple(leaves),
            tuple(apart),
            keys if drawn else jax.random.wrap_key_data(jax.numpy.asarray(keys)),
        )
        for rig, mine, clock, leaves, apart, keys, drawn in arrays
    ]
    return found
