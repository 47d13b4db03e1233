"""Measures that a result reports, of the case's own run and of every scenario.

Imported by `search` and by `jaxtank simulate`.
"""

# functions of jax and of `measures` whose types are not complete
# pyright: reportUnknownMemberType=false

from collections.abc import Iterable
from typing import Any

import numpy as np

from jaxtank import measures as ms
from jaxtank.core.clock import Clock
from jaxtank.loop import run as lp
from jaxtank.loop.closed_loop import ClosedLoop, zero_of
from jaxtank.loop.margins import worst
from tuning.problem import scenarios as sc
from tuning.problem.problem import Problem


def run_measures(
    loop: ClosedLoop, clock: Clock, key: Any, besides: Iterable[str] = ()
) -> dict[str, np.ndarray]:
    """Return {measure: value} of everything that is reported of one run.

    key : of the sensor noise, None where there is none. besides : names, of which the functions of
    the user's and the margins of the linearised loop are reported too.
    """
    values = lp.evaluate(loop, clock, _names(loop, besides), key)
    return {m: np.asarray(v) for m, v in values.items()}


def margin_measures(loop: ClosedLoop, clock: Clock) -> dict[str, np.ndarray]:
    """Return {measure: value} of the linearised loop, the worst of its plateaus; {} where the
    reference holds no setpoints, and outside float64.
    """
    names = tuple(m for m in ms.linear() if ms.serves(m, loop))
    if not names or zero_of(loop).dtype != np.float64:
        return {}
    found = worst(loop, clock)
    return {m: np.asarray(getattr(found, m)) for m in names}


def table_of(problem: Problem, values: dict[str, float]) -> list[dict[str, Any]]:
    """Return {measure: value} of every scenario at {parameter: value}."""
    points = {n: np.array([v]) for n, v in values.items()}
    table: list[Any] = [None] * len(problem.runs)
    for group in problem.groups:
        loop = problem.runs[group.runs[0]].case.loop
        measures, _ = sc.values_of(group, _names(loop, problem.needed), points)
        for j, i in enumerate(group.runs):
            table[i] = {m: np.asarray(v)[0, j] for m, v in measures.items()}
    return table


def _names(loop: ClosedLoop, besides: Iterable[str]) -> tuple[str, ...]:
    """Return the measures that are reported of a loop, and when levels were reached."""
    known = (m for m in ms.reported() if ms.serves(m, loop))
    besides = tuple(besides)
    linear = (m for m in besides if ms.MEASURES[m].linear)
    return (*known, *ms.times(), *ms.functions(besides), *linear)
