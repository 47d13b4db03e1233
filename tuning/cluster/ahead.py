"""Local searches on workers, whose evaluations the search here then finds in its cache."""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from jaxtank.core.clock import Clock
from jaxtank.limits import Limit
from tuning.cluster.engine import Engine
from tuning.cluster.sent import received, sent
from tuning.problem import scenarios as sc
from tuning.problem.evaluator import Evaluator
from tuning.problem.problem import Problem
from tuning.storage.evaluation_log import EvaluationCache
from tuning.storage.fingerprint import digest


def evaluate_ahead(engine: Engine | None, evaluator: Evaluator, searches, run, waiting) -> None:
    """Make searches on the workers, and enter what they evaluate into the cache."""
    # What the cache holds already, of a run that is continued, is not evaluated again.
    if engine is None:
        return
    unfinished = []
    for number, arguments in enumerate(searches):
        known = _Known(evaluator.cache)
        try:
            run(Evaluator(evaluator.problem, known), *arguments)
        except _Missing:
            unfinished.append((number, (arguments, known.used)))
    if not unfinished:
        return
    text, arrays = sent_problem(evaluator.problem)
    tasks = ((number, (text, arrays, *more)) for number, more in unfinished)
    for _, entries in engine.run("search", tasks, waiting):
        for key, result in entries.items():
            evaluator.cache.enter(key, result)


def recorded(text, arrays, run: Callable[..., Any], arguments: tuple, known: dict) -> dict:
    """Return the new evaluations of a search of the problem of `sent_problem`, on a worker."""
    cache = EvaluationCache()
    cache.found = dict(known)
    run(Evaluator(received_problem(text, arrays), cache), *arguments)
    return {key: result for key, result in cache.found.items() if key not in known}


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
        self.used[key] = self.found[key]
        return self.used[key]


def check_sent(engine: Engine | None, problem: Problem) -> None:
    """Raise InputError, before anything is run, for a problem that cannot be sent to workers."""
    if engine is not None:
        sent_problem(problem)


def sent_problem(problem: Problem) -> tuple[tuple, list]:
    """Return a problem as texts and numbers, and the arrays of its groups."""
    base, structure = sent(problem.case, problem.needed), jax.tree.structure(problem.loop)
    text = (
        base,
        tuple((b.name, (b.low, b.high, b.scale)) for b in problem.bounds),
        tuple(problem.objective.items()),
        tuple(dataclasses.astuple(limit) for limit in problem.limits),
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
            None if group.keys is None else np.asarray(jax.random.key_data(group.keys)),
            None if group.noise is None else np.asarray(group.noise),
        )
        for group in problem.groups
    ]
    return text, arrays


def received_problem(text: tuple, arrays: list) -> Problem:
    """Return the problem of `sent_problem`, for local searches: its runs have no case."""
    case, free, objective, limits, runs, risk = text
    problem = Problem(received(case), dict(free), dict(objective), {}, (), risk=risk)
    groups = [
        sc.Group(
            tuple(mine),
            Clock(**clock),
            jax.tree.structure(received(rig).loop),
            tuple(leaves),
            tuple(apart),
            None if keys is None else jax.random.wrap_key_data(jax.numpy.asarray(keys)),
            noise,
        )
        for rig, mine, clock, leaves, apart, keys, noise in arrays
    ]
    return problem.replace(
        runs=[sc.ScenarioRun(name, problem.case, None, weight) for name, weight in runs],
        limits=[Limit(*limit) for limit in limits],
        groups=groups,
    )
