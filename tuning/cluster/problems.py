"""A problem of a search as texts, numbers and arrays, and the problem that a worker makes of it."""

import dataclasses

import jax
import numpy as np

from jaxtank.core.clock import Clock
from tuning.cluster.engine import Engine
from tuning.cluster.sent import received, sent
from tuning.problem import scenarios as sc
from tuning.problem.limits import Limit, limit_scale
from tuning.problem.problem import Problem


def check_sent(engine: Engine | None, problem: Problem) -> None:
    """Raise InputError, before anything is run, for a problem that cannot be sent to workers."""
    if engine is not None:
        sent_problem(problem)


def sent_problem(problem: Problem) -> tuple[tuple, list]:
    """Return a problem as texts and numbers, and the arrays of its groups."""
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
            None if group.keys is None else np.asarray(jax.random.key_data(group.keys)),
            None if group.noise is None else np.asarray(group.noise),
        )
        for group in problem.groups
    ]
    return text, arrays


def received_problem(text: tuple, arrays: list) -> Problem:
    """Return the problem of `sent_problem`, for local searches: its runs have no case."""
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
            None if keys is None else jax.random.wrap_key_data(jax.numpy.asarray(keys)),
            noise,
        )
        for rig, mine, clock, leaves, apart, keys, noise in arrays
    ]
    return found
