"""What a limit costs: the problem solved again for a row of values of one limit, each search begun
where a neighbour's ended.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from jaxtank import measures as ms
from jaxtank.case import Case, Scenario
from jaxtank.core.errors import InputError
from tuning.problem.problem import Problem
from tuning.search.driver import Search
from tuning.search.methods import approach, restore, slsqp
from tuning.search.screening import best_screened, screen

MANY = 50
"""Values of the limit at most."""


def tradeoff(
    case: Case,
    measure: str,
    values: Sequence[float],
    *,
    free: Mapping[str, Any] | None = None,
    objective: Mapping[str, float] | None = None,
    limits: Mapping[str, Any] | None = None,
    scenarios: Sequence[Scenario] | None = None,
    seed: int = 0,
    iterations: int = 60,
    screening: int = 64,
    start: Any = None,
    progress: Callable | None = None,
) -> dict[str, Any]:
    """The least objective for each of `values` as the limit of `measure` (the epsilon-constraint
    method), the loosest first.

    Each value is searched from the answer of the next looser one (from the first point too, where
    that leads to none that keeps the limit) and from that of the next tighter one, and the best is
    kept: a tighter limit's answer holds a looser one too, so that the objective never falls as the
    limit is drawn in. Where one of `screening` Sobol points, or a point that was evaluated for
    another value, keeps the limit at a lower objective, the search is begun again from it.

    case, free, objective, limits, scenarios, seed, iterations, screening: as in `tune`; the limit
    holds for every entry of the measure, the other limits stay; start: {name: value} to begin at,
    the case's own where None; progress: called after every evaluation. Returns {"measure",
    "points": [{"limit", "status" ("converged", "not_converged" or "infeasible"), "objective",
    "violation", "parameters"}]}. Raises InputError for an unknown measure and for values that are
    not finite.
    """
    ms.check_names([measure])
    values = [float(v) for v in values]
    if not 1 <= len(values) <= MANY or not all(math.isfinite(v) for v in values):
        raise InputError(f"tradeoff of {measure}: must have 1 to {MANY} finite values of its limit")
    others = {m: v for m, v in (case.limits if limits is None else limits).items() if m != measure}
    values = sorted(values, reverse=ms.MEASURES[measure].sense > 0)
    problem = Problem(
        case,
        free=free,
        objective=objective,
        limits={**others, measure: values[0]},
        scenarios=scenarios,
        seed=seed,
    )
    z = problem.start()
    if start is not None:
        z = np.clip([float(b.to_unit(start[b.name])) for b in problem.bounds], 0.0, 1.0)
    found, begin, known = [], z, {}

    def solve(value, z):
        answer = _solve(problem, {**others, measure: value}, z, iterations, progress)
        known.update(answer.search.memory)
        return answer

    for value in values:
        found.append(solve(value, z))
        if found[-1].broken and z is not begin:
            found[-1] = _better(found[-1], solve(value, begin))
        z = z if found[-1].best is None else found[-1].best.z
    for k in reversed(range(len(values))):
        if k + 1 < len(values) and not found[k + 1].broken:
            found[k] = _better(found[k], solve(values[k], found[k + 1].best.z))
        problem.limit({**others, measure: values[k]})
        search = found[k].search
        other = best_screened(search, *_candidates(problem, known, screening, seed))
        if other is not None:
            found[k] = _Answer(search, slsqp(search, other, iterations))
        approach(search)
        known.update(search.memory)
    return {
        "measure": measure,
        "points": [_told(problem, value, answer, z) for value, answer in zip(values, found)],
    }


def _candidates(problem, known, screening, seed):
    """Return (zs, costs, margins under the problem's limits) of screened points and of the finite
    Points among `known`.
    """
    zs, costs, margins, _ = screen(problem, screening, seed)
    points = [p for p in known.values() if p.finite]
    old = [problem.margins(p.measures) for p in points]
    return (
        np.concatenate([zs, [p.z for p in points]]),
        np.concatenate([costs, [p.cost for p in points]]),
        np.concatenate([margins, np.reshape(old, (len(points), margins.shape[1]))]),
    )


class _Answer(NamedTuple):
    """What a search for one value of the limit came to."""

    search: Search
    converged: bool

    @property
    def best(self):
        return self.search.best

    @property
    def broken(self):
        """Largest share by which a limit is broken; infinite where nothing finite was found."""
        return np.inf if self.best is None else self.search.violation(self.best)


def _better(one, other):
    """The _Answer to keep of two for the same limits."""
    if one.best is None or other.best is None:
        return other if one.best is None else one
    return other if one.search.better(other.best, one.best) else one


def _solve(problem, limits, z, iterations, progress=None):
    """The _Answer of `problem` under `limits` {measure: value}, searched from z (P,)."""
    problem.limit(limits)
    search = Search(problem, problem.point(problem.start()), progress or (lambda search: None))
    converged = slsqp(search, z, iterations)
    if search.best is not None and search.violation(search.best) > 0:
        restore(search, search.best.z, iterations)
        converged = slsqp(search, search.best.z, iterations)
    return _Answer(search, converged)


def _told(problem, value, answer, z):
    """One row of `tradeoff`'s points; z: (P,) what to name where nothing finite was found."""
    best, broken = answer.best, answer.broken
    return {
        "limit": value,
        "status": (
            "infeasible" if broken > 0 else "converged" if answer.converged else "not_converged"
        ),
        "objective": np.nan if best is None else float(best.cost),
        "violation": float(broken),
        "parameters": problem.values(z if best is None else best.z),
    }
