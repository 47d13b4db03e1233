"""The trade-off between the objective and one limit, by the epsilon-constraint method."""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from jaxtank import measures as ms
from jaxtank.case import Case, Scenario
from jaxtank.core.errors import InputError
from tuning.problem.functions import as_measures
from tuning.problem.problem import Problem
from tuning.search.driver import Search
from tuning.search.methods import approach, find_feasible, restore, slsqp
from tuning.search.screening import Population, best_screened, screen

MANY = 50  # values of the limit at most


def tradeoff(
    case: Case,
    measure: str,
    values: Sequence[float],
    *,
    free: Mapping[str, Any] | None = None,
    objective: Any = None,
    limits: Any = None,
    scenarios: Sequence[Scenario] | None = None,
    seed: int = 0,
    iterations: int = 60,
    screening: int = 64,
    start: Any = None,
    progress: Callable[[Search], Any] | None = None,
) -> dict[str, Any]:
    """Return the least objective for each of `values` as the limit of `measure`, the loosest first.

    Each value is searched from the answer of the next looser one (from the first point too, where
    that leads to none that keeps the limit) and from that of the next tighter one, and the best is
    kept: a tighter limit's answer keeps a looser one too, so that the objective never falls as the
    limit is tightened. Where one of `screening` Sobol points, or a point that was evaluated for
    another value, keeps the limit at a lower objective, the search is begun again from it.

    Parameters
    ----------
    case, free, objective, limits, scenarios, seed, iterations, screening : as in `tune`; the other
        limits stay.
    measure : name of a measure; the limit holds for every entry of it.
    values : values of its limit, in its unit.
    start : {name: value} to begin at, the case's own values where None.
    progress : called after every evaluation.

    Returns
    -------
    {"measure", "points": [{"limit", "status" ("converged", "not_converged" or "infeasible"),
        "objective", "violation", "parameters"}]}

    Raises
    ------
    InputError : for an unknown measure and for values that are not finite.

    Examples
    --------
    >>> import tuning
    >>> from jaxtank import presets
    >>> case = presets.find("cascaded/pi")
    >>> tuning.tradeoff(case, "input_travel", [80.0, 40.0])  # doctest: +SKIP
    """
    objective, limits = as_measures(objective, limits)
    ms.check_names([measure])
    values = [float(v) for v in values]
    if not 1 <= len(values) <= MANY or not all(math.isfinite(v) for v in values):
        raise InputError(f"tradeoff of {measure}: must have 1 to {MANY} finite values of its limit")
    others = {m: v for m, v in (case.limits if limits is None else limits).items() if m != measure}
    values = sorted(values, reverse=ms.MEASURES[measure].sense > 0)
    steps = [{**others, measure: value} for value in values]
    problem = Problem(
        case, free=free, objective=objective, limits=steps[0], scenarios=scenarios, seed=seed
    )
    z = problem.start()
    if start is not None:
        z = np.clip([float(b.to_unit(start[b.name])) for b in problem.bounds], 0.0, 1.0)
    sweep = _Sweep(problem, steps, iterations, progress or (lambda search: None))
    z = sweep.tighten(z)
    sweep.loosen(screening, seed)
    return {
        "measure": measure,
        "points": [_row(problem, value, answer, z) for value, answer in zip(values, sweep.found)],
    }


class _Answer(NamedTuple):
    """The result of a search for one value of the limit."""

    search: Search
    converged: bool

    @property
    def best(self):
        """The best Point; None where nothing finite was found."""
        return self.search.best

    @property
    def violation(self):
        """Largest violation as a share of its limit; infinite where nothing finite was found."""
        return np.inf if self.best is None else self.search.violation(self.best)


class _Sweep:
    """The problem solved for a row of limits, first from loose to tight, then back."""

    def __init__(self, problem, steps, iterations, progress):
        self.problem, self.steps, self.iterations = problem, steps, iterations
        self.progress = progress
        self.found: list[_Answer] = []
        self.known = {}  # every Point that was evaluated

    def tighten(self, begin):
        """Solve each step from the answer before it, the first from `begin` (P,)."""
        z = begin
        for limits in self.steps:
            answer = self._solve(limits, z)
            if answer.violation and z is not begin:
                answer = _better(answer, self._solve(limits, begin))
            self.found.append(answer)
            z = z if answer.best is None else answer.best.z
        return z

    def loosen(self, screening, seed):
        """Solve each step again from the answer of the tighter one and from better known points."""
        for k in reversed(range(len(self.steps))):
            if k + 1 < len(self.steps) and not self.found[k + 1].violation:
                nearby = self._solve(self.steps[k], self.found[k + 1].best.z)
                self.found[k] = _better(self.found[k], nearby)
            search = self.found[k].search
            screened = self._candidates(search.problem, screening, seed)
            other = best_screened(search, screened)
            if other is not None:
                self.found[k] = _answer(search, slsqp(search, other, self.iterations))
            if self.found[k].violation and search.best is not None:
                find_feasible(search, screened, self.iterations, seed)
                done = slsqp(search, search.best.z, self.iterations)
                self.found[k] = _answer(search, done)
            approach(search)
            self.known.update(search.memory)

    def _solve(self, limits, z):
        """Return the _Answer under `limits` {measure: value}, searched from z (P,)."""
        problem = self.problem.with_limits(limits)
        search = Search(problem, problem.point(problem.start()), self.progress)
        converged = slsqp(search, z, self.iterations)
        if search.best is not None and search.violation(search.best) > 0:
            restore(search, search.best.z, self.iterations)
            converged = slsqp(search, search.best.z, self.iterations)
        self.known.update(search.memory)
        return _answer(search, converged)

    def _candidates(self, problem, screening, seed):
        """Return the Population of screened and of known points, under the present limits."""
        zs, costs, margins, _ = screen(problem, screening, seed)
        points = [p for p in self.known.values() if p.finite]
        old = [problem.margins(p.measures) for p in points]
        return Population(
            np.concatenate([zs, [p.z for p in points]]),
            np.concatenate([costs, [p.cost for p in points]]),
            np.concatenate([margins, np.reshape(old, (len(points), margins.shape[1]))]),
        )


def _answer(search, converged):
    """Return the _Answer of a search; not converged where no slope is of use."""
    best = search.best
    return _Answer(search, bool(converged) and best is not None and search.slope(best).usable)


def _better(one, other):
    """Return the _Answer to keep of two for the same limits."""
    if one.best is None or other.best is None:
        return other if one.best is None else one
    return other if one.search.better(other.best, one.best) else one


def _row(problem, value, answer, z):
    """Return one row of `tradeoff`; z (P,): what to name where nothing finite was found."""
    best, violation = answer.best, answer.violation
    return {
        "limit": value,
        "status": (
            "infeasible" if violation > 0 else "converged" if answer.converged else "not_converged"
        ),
        "objective": np.nan if best is None else float(best.cost),
        "violation": float(violation),
        "parameters": problem.values(z if best is None else best.z),
    }
