"""The search behind the default answer: a few local searches, then every gain that may
stays put.
"""

import dataclasses
from typing import Any

import numpy as np

from tuning.cluster.ahead import evaluate_ahead
from tuning.cluster.engine import Engine
from tuning.problem.functions import check_slopes
from tuning.problem.problem import Problem
from tuning.problem.slopes import SlopeCheck
from tuning.search import diagnostics
from tuning.search.driver import Search
from tuning.search.methods import METHODS, restore, search_alone
from tuning.search.screening import (
    Population,
    around,
    distinct_starts,
    evolution_size,
    evolve,
    sobol,
)
from tuning.search.starts import search_from as local_search

WORTH = 0.01
"""A gain is changed only where that lowers the cost by this share [-]."""

AGREE = 0.01
"""Two searches whose costs differ by less than this share agree [-]: the mean of 32 plants is known
to a few percent."""

AGAIN = 1.25
"""All gains stay at their first values where that costs less than this many times WORTH: those of
an earlier answer, which may cost WORTH already, on plants and limits that differ a little [-]."""

TOLERANCE = 1e-4
"""Change of the cost, as a share of its first value, at which a search has converged [-]."""

FINE = 0.1
"""Share of WORTH to which the cost with some gains at their first values is searched [-]."""

PROBES = 3
"""Differential evolutions that are tried, at most, until one finds nothing better."""

LINE, STRIDE = 32, 8
"""Values that are tried between a gain's best and its first value, also the screened points; and
how many of these values are run at once."""

MANY = 4
"""Number of parameters from which Gauss-Newton is tried before limits are considered."""


@dataclasses.dataclass
class Found:
    """What the search found so far; Ctrl-C leaves it as it is."""

    search: Search | None = None
    starts: list[dict[str, Any]] = dataclasses.field(default_factory=list)
    z: Any = None
    kept: Any = None
    idle: Any = None
    slopes: dict[str, SlopeCheck] = dataclasses.field(default_factory=dict)
    slack: Any = None
    agreed: bool = False
    interrupted: bool = False

    @property
    def point(self) -> Any:
        """The Point of the answer; None where none is finite."""
        if self.search is None:
            return None
        return self.search.best if self.z is None else self.search.point(self.z)


class Subspace(Search):
    """A search over some of the parameters, the others fixed; every point is one of the owner's."""

    def __init__(self, owner: Search, z: np.ndarray, free: np.ndarray):
        # its owner reports every evaluation already
        tolerance = max(owner.tolerance, FINE * WORTH)
        super().__init__(owner.problem, owner.last_finite, lambda search: None, tolerance)
        self.scale, self.owner, self.fixed = owner.scale, owner, z
        self.free: np.ndarray = np.asarray(free)

    def full(self, z: Any) -> np.ndarray:
        """Return (P,) the point of the owner at z, values of the free parameters."""
        found = self.fixed.copy()
        found[self.free] = np.clip(z, 0.0, 1.0)
        return found

    def point(self, z: Any) -> Any:
        """Return the Point at z, derivatives by the free parameters alone; cached."""
        z = np.clip(z, 0.0, 1.0)
        if z.tobytes() not in self.memory:
            found, free = self.owner.point(self.full(z)), self.free
            self.take(
                found._replace(
                    z=z,
                    gradient=found.gradient[free],
                    gauss_newton=found.gauss_newton[free][:, free],
                    margin_slopes=found.margin_slopes[:, free],
                    run_slopes=found.run_slopes[:, free] if found.run_slopes.size else np.zeros(0),
                )
            )
        return self.memory[z.tobytes()]


def method_of(problem: Problem) -> str:
    """Return the local method: Gauss-Newton where no limit is to be kept and the cost has
    squares.
    """
    if problem.model and not problem.limits:
        return "trf"
    return "trf-slsqp" if problem.model and len(problem.bounds) >= MANY else "slsqp"


def search_from(
    problem: Problem, plan: dict[str, int], report: Any, found: Found, engine: Engine | None = None
) -> None:
    """Search the problem from its start and from screened points, and keep in `found` the
    answer.
    """
    first = problem.start()
    reference = problem.point(first)
    check_slopes(problem, reference)
    search = found.search = Search(problem, reference, report, TOLERANCE)
    search.take(reference)
    zs = sobol(LINE, len(first), plan["seed"])
    costs, margins = problem.screen(zs)
    found.slopes["start"] = search.slope(reference)
    shortfall = np.maximum(0.0, -margins / search.limit_scale)
    merits = costs / search.scale + 10.0 * shortfall.sum(axis=1)
    starts = distinct_starts(zs, merits, plan["starts"], first)
    how = (method_of(problem), plan["iterations"], TOLERANCE)
    searches = [(z, number, how) for number, z in enumerate(starts)]
    evaluate_ahead(engine, problem, searches, search_alone, lambda: report(search))
    for z in starts:
        search.start = len(found.starts)
        _local_search(search, found, z, plan["iterations"])
        found.agreed = _agree(found.starts)
        if found.agreed:
            break
    if search.best is not None and search.violation(search.best) > 0:
        restore(search, search.best.z, plan["iterations"])
        METHODS["slsqp"](search, search.best.z, plan["iterations"])
    if search.best is None:
        return
    if not (found.agreed and search.slope(search.best).usable):
        found.agreed = _confirmed(search, found, Population(zs, costs, margins), plan)
    found.idle = diagnostics.unexercised(problem, search, first)
    found.z, found.kept = stay_put(search, first, plan["iterations"], found.slack)
    found.slopes["answer"] = search.slope(found.point)


def _local_search(search, found, z, iterations):
    """Run one local search from z; its outcome is added to those found."""
    method = METHODS[method_of(search.problem)]
    local_search(search, found.starts, z, lambda s, z: method(s, z, iterations))


def _confirmed(search, found, screened, plan):
    """Return True if differential evolution finds nothing that is better by AGREE than the best."""
    _, generations = evolution_size(search, screened)
    order = np.argsort(screened.merits(search), kind="stable")
    for k in range(PROBES):
        near = around(search.best.z, LINE // 4, plan["seed"] + k)
        members = np.concatenate([search.best.z[None], near, screened.zs[order]])[:LINE]
        last, _ = evolve(search, members, generations, plan["seed"] + k, coarse=False)
        merits, mark = last.merits(search), search.best
        i = int(np.argmin(merits))
        if merits[i] < mark.cost * (1.0 - AGREE) or search.violation(mark) > 0:
            search.start = len(found.starts)
            _local_search(search, found, last.zs[i], plan["iterations"])
        if not _clearly_better(search, search.best, mark):
            return search.violation(search.best) == 0
    return False


def _clearly_better(search, point, other):
    """Return True if a point is better than another by AGREE, or violates the limits by less."""
    if max(search.violation(point), search.violation(other)) > 0:
        return search.better(point, other)
    return point.cost < other.cost * (1.0 - AGREE)


def _agree(starts):
    """Return True if the two best of the searches that keep the limits agree, and one converged."""
    costs = sorted(s["cost"] for s in starts if s["violation"] == 0.0 and np.isfinite(s["cost"]))
    converged = any(s["converged"] for s in starts)
    return len(costs) > 1 and converged and costs[1] <= costs[0] * (1.0 + AGREE)


def stay_put(
    search: Search, first: np.ndarray, iterations: int, slack: Any = None
) -> tuple[np.ndarray, np.ndarray]:
    """Return (z (P,), kept (P,)): the point nearest to the first values that costs little more."""
    # One gain after the other is set back to its value in `first` and the rest searched again. It
    # stays there (kept) if the cost is within WORTH of the best found, and no limit that the best
    # point keeps is violated. A gain that cannot is moved back as far as it can.
    best = search.best
    kept, z = np.zeros(len(first), dtype=bool), best.z
    ceiling = best.cost + WORTH * abs(best.cost)
    allowed = search.violation(best)

    def good(point):
        return point.finite and point.cost <= ceiling and search.violation(point) <= allowed

    if _all_stay(search, search.point(first), allowed, slack):
        return first.copy(), ~kept
    # first those whose value costs least by the curvature at the best point
    order = np.argsort(np.diag(best.gauss_newton) * (best.z - first) ** 2, kind="stable")
    for i in order:
        trial = kept.copy()
        trial[i] = True
        reached = _without(search, trial, first, z, iterations)
        if reached is not None and good(search.point(reached)):
            kept, z = trial, reached
        else:
            z = _towards(search, i, first, z, ceiling, allowed, good)
    return z, kept


def _all_stay(search, start, allowed, slack):
    """Return True if the first values may stay, all of them: see AGAIN and `Found.slack`."""
    given = start if slack is None else start._replace(margins=start.margins + slack)
    dearest = search.best.cost + AGAIN * WORTH * abs(search.best.cost)
    return start.finite and start.cost <= dearest and search.violation(given) <= allowed


def _without(search, trial, first, z, iterations):
    """Return the best point with the gains of `trial` at their first values, if there is one."""
    begin = np.where(trial, first, z)
    if trial.all():
        return begin
    free = np.flatnonzero(~trial)
    inner = Subspace(search, begin, free)
    METHODS[method_of(search.problem)](inner, begin[free], iterations)
    return None if inner.best is None else inner.full(inner.best.z)


def _towards(search, i, first, z, ceiling, allowed, good):
    """Return z with gain i moved towards its first value as far as the cost stays below `ceiling`.

    LINE values at most, a few at once, up to the first that does not fit; without derivatives.
    """
    shares = np.arange(1, LINE + 1) / (LINE + 1)
    line = np.repeat(z[None], LINE, axis=0)
    line[:, i] = z[i] + shares * (first[i] - z[i])
    count = 0
    for some in np.split(line, LINE // STRIDE):
        costs, margins = search.problem.screen(some)
        shortfall = np.max(-margins / search.limit_scale, axis=1, initial=0.0)
        fits = np.isfinite(costs) & (costs <= ceiling) & (shortfall <= allowed)
        count += STRIDE if fits.all() else int(np.argmin(fits))
        if not fits.all():
            break
    for k in range(count - 1, -1, -1):
        if good(search.point(line[k])):
            return line[k]
    return z
