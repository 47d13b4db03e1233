"""The trade-off between the objective and one limit, by the epsilon-constraint method."""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from jaxtank import measures as ms
from jaxtank.case import Case, Scenario, check_case
from jaxtank.core.errors import InputError
from tuning.problem.evaluator import Evaluator
from tuning.problem.functions import as_measures
from tuning.problem.pairing import check_signs
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
    check_case(case, seed)
    check_signs(case, free)
    objective, limits = as_measures(objective, limits)
    ms.check_names([measure])
    values = [float(v) for v in values]
    if not 1 <= len(values) <= MANY or not all(math.isfinite(v) for v in values):
        raise InputError(f"tradeoff of {measure}: must have 1 to {MANY} finite values of its limit")
    others = {m: v for m, v in (case.limits if limits is None else limits).items() if m != measure}
    values = sorted(values, reverse=ms.MEASURES[measure].sense > 0)
    steps = [{**others, measure: value} for value in values]
    problem = Problem(case, free, objective, steps[0], scenarios, seed)
    z = problem.start()
    if start is not None:
        z = np.clip([float(b.to_unit(start[b.name])) for b in problem.bounds], 0.0, 1.0)
    sweep = _Sweep(problem, steps, iterations, progress or (lambda search: None))
    z = sweep.tighten(z)
    sweep.loosen(screening, seed)
    points = [_row(problem, *pair, z) for pair in zip(values, sweep.answers)]
    return {"measure": measure, "points": points}


class _Answer(NamedTuple):
    """The result of a search for one value of the limit."""

    search: Search
    converged: bool

    @classmethod
    def of(cls, search, converged):
        """Return the answer of a search; not converged where no slope is of use."""
        best = search.best
        return cls(search, bool(converged) and best is not None and search.slope(best).usable)

    @property
    def best(self):
        """The best Point; None where nothing finite was found."""
        return self.search.best

    @property
    def violation(self):
        """Largest violation as a share of its limit; infinite where nothing finite was found."""
        return np.inf if self.best is None else self.search.violation(self.best)

    def better(self, other):
        """Return the better of two answers for the same limits."""
        if self.best is None or other.best is None:
            return other if self.best is None else self
        return other if self.search.better(other.best, self.best) else self


class _Sweep:
    """The problem solved for a row of limits, first from loose to tight, then back."""

    def __init__(self, problem, steps, iterations, progress):
        self.problems = [problem.with_limits(limits) for limits in steps]
        self.iterations, self.progress = iterations, progress
        self.answers: list[_Answer] = []
        self.known = {}  # every Point that was evaluated

    def tighten(self, begin):
        """Solve each step from the answer before it, the first from `begin` (P,)."""
        z = begin
        for problem in self.problems:
            answer = self._solve(problem, z)
            if answer.violation and z is not begin:
                answer = answer.better(self._solve(problem, begin))
            self.answers.append(answer)
            z = z if answer.best is None else answer.best.z
        return z

    def loosen(self, screening, seed):
        """Solve each step again from the answer of the tighter one and from better known points."""
        answers = self.answers
        for k in reversed(range(len(answers))):
            if k + 1 < len(answers) and not answers[k + 1].violation:
                answers[k] = answers[k].better(self._solve(self.problems[k], answers[k + 1].best.z))
            search = answers[k].search
            screened = self._candidates(search, screening, seed)
            other = best_screened(search, screened)
            if other is not None:
                answers[k] = _Answer.of(search, slsqp(search, other, self.iterations))
            if answers[k].violation and search.best is not None:
                find_feasible(search, screened, self.iterations, seed)
                answers[k] = _Answer.of(search, slsqp(search, search.best.z, self.iterations))
            approach(search)
            self.known.update(search.memory)

    def _solve(self, problem, z):
        """Return the _Answer of a problem, searched from z (P,)."""
        evaluator = Evaluator(problem)
        search = Search(evaluator, evaluator.point(problem.start()), self.progress)
        converged = slsqp(search, z, self.iterations)
        if search.best is not None and search.violation(search.best) > 0:
            restore(search, search.best.z, self.iterations)
            converged = slsqp(search, search.best.z, self.iterations)
        self.known.update(search.memory)
        return _Answer.of(search, converged)

    def _candidates(self, search, screening, seed):
        """Return the Population of screened and of known points, under the present limits."""
        screened, _ = screen(search.evaluator, screening, seed)
        # a limit at a rim is one on what spills, which points for other values do not measure
        needed = {limit.measure for limit in search.problem.limits}
        points = [p for p in self.known.values() if p.finite and needed <= p.measures[0].keys()]
        margins = [search.problem.margins(p.measures) for p in points]
        margins = np.reshape(margins, (len(points), screened.margins.shape[1]))
        known = ([p.z for p in points], [p.cost for p in points], margins)
        first = (screened.zs, screened.costs, screened.margins)
        return Population(*map(np.concatenate, zip(first, known)))


def _row(problem, value, answer, z):
    """Return one row of `tradeoff`; z (P,): what to name where nothing finite was found."""
    best, violation = answer.best, answer.violation
    done = "converged" if answer.converged else "not_converged"
    objective, at = (np.nan, z) if best is None else (float(best.cost), best.z)
    status = "infeasible" if violation > 0 else done
    row = {"limit": value, "status": status, "objective": objective}
    return row | {"violation": float(violation), "parameters": problem.values(at)}
