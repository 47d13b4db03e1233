"""The stages of one tuning: screening, local searches, feasibility, a final search, diagnostics.

Imported by `tuner`.
"""

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np

from tuning.problem.problem import Problem
from tuning.problem.status import Status
from tuning.search import diagnostics
from tuning.search.driver import SETTLED, Search
from tuning.search.first_order import minibatches
from tuning.search.kkt import UNSTABLE, downhill, optimality
from tuning.search.methods import METHODS, UNCONSTRAINED, approach, restore, slsqp
from tuning.search.screening import best_screened, distinct_starts, screen

RENEWED = 3
"""How often a search is begun again from where it stopped before conditions of an optimum hold."""

POLISHED = 1e-12
"""Tolerance of the last search, from the best point [-]."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Plan:
    """What is to be done: the keywords of `tune` that the stages read."""

    method: str
    starts: int
    screening: int
    iterations: int
    seed: int
    batch: int | None
    tolerance: float | None


@dataclasses.dataclass
class Outcome:
    """What the stages found so far; Ctrl-C leaves it as it is."""

    search: Search | None = None
    starts: list[dict[str, Any]] = dataclasses.field(default_factory=list)
    interrupted: bool = False
    redone: int = 0  # screening points that were run again at the true step
    least: bool = False  # whether the search for the least violation came to its end
    polished: bool = False  # whether the last search converged
    settled: bool = False  # whether nothing lower lies along a gradient that is left
    idle: Any = None  # (P,) True for parameters that no run exercises
    curvature: dict[str, Any] | None = None

    @property
    def best(self) -> Any:
        """The best Point; None where no finite one was found."""
        return self.search.best if self.search else None


def solve(problem: Problem, first: np.ndarray, plan: Plan, progress: Callable | None) -> Outcome:
    """Return the Outcome of all stages from z = first (P,); Ctrl-C ends them early."""
    found = Outcome(idle=np.zeros(len(first), dtype=bool))
    try:
        _run_stages(problem, first, plan, found, _reporter(progress, problem, plan.starts))
    except KeyboardInterrupt:
        found.interrupted = True
    return found


def _run_stages(problem, first, plan, found, report):
    """Run the stages one after the other, and keep in `found` what each of them gave."""
    reference = problem.point(first)
    tolerance = {} if plan.tolerance is None else {"tolerance": plan.tolerance}
    search = found.search = Search(problem, reference, report, **tolerance)
    search.take(reference)
    zs, costs, margins, found.redone = screen(problem, plan.screening, plan.seed)
    shortfall = np.maximum(0.0, -margins / search.limit_scale)
    merits = costs / search.scale + 10.0 * shortfall.sum(axis=1)
    for z in distinct_starts(zs, merits, plan.starts, first):
        search.start = len(found.starts)
        _local_search(search, found, plan, z, len(search.history))
    search.start, count = len(found.starts), len(search.history)
    z = best_screened(search, zs, costs, margins)
    if z is not None:
        _local_search(search, found, plan, z, count)
    search.start = len(found.starts)
    infeasible = search.best is not None and search.violation(search.best) > 0
    if infeasible and plan.method not in UNCONSTRAINED:
        found.least = _find_feasible(search, zs, shortfall.max(axis=1), plan.iterations)
    approach(search)
    if search.best is None:
        return
    found.polished = _last_search(search, found, plan)
    feasible = search.violation(search.best) == 0
    found.settled = feasible and _nothing_lower(search, plan.iterations)
    found.idle = diagnostics.unexercised(problem, search, first)
    if feasible:
        found.curvature = diagnostics.curvature(problem, search, search.best, found.idle)


def _local_search(search, found, plan, z, count):
    """Run one local search from z; its outcome is added to those found.

    count : evaluations before the first that belongs to this search.
    """
    search.exhausted = False
    if plan.batch is None:
        converged = METHODS[plan.method](search, z, plan.iterations)
    else:
        rng = np.random.default_rng([plan.seed, search.start])
        converged = minibatches(search, z, plan.iterations, plan.batch, rng)
    mine = search.history[count:]
    reached = min(mine, key=lambda h: (h[2] > 0, h[2] if h[2] > 0 else h[1]), default=None)
    if reached is None:  # every point it asked for was known already
        point = search.memory.get(np.clip(z, 0, 1).tobytes(), search.best or search.last_finite)
        reached = (search.start, float(point.cost), search.violation(point), tuple(point.z))
    found.starts.append(
        {
            "from": search.problem.values(z),
            "to": search.problem.values(reached[3]),
            "cost": reached[1],
            "violation": reached[2],
            "evaluations": len(mine),
            "converged": converged,
            "exhausted": search.exhausted,
        }
    )


def _find_feasible(search, zs, shortfall, iterations):
    """Return True if a search for the least violation of the limits came to its end.

    Where no search met the limits: from the best point so far, and from the two screened points
    of least `shortfall` (points,).
    """
    order = np.argsort(np.where(np.isfinite(shortfall), shortfall, np.inf), kind="stable")
    ended = []
    for z in (search.best.z, *(zs[i] for i in order[:2])):
        ended.append(restore(search, z, iterations))
        if search.violation(search.best) == 0:
            slsqp(search, search.best.z, iterations)
            break
    return any(ended)


def _last_search(search, found, plan):
    """Return True if a last search from the best point converged.

    With a tolerance of the user's own, a search also ends where one step of its line search
    happened to be short, and is begun again from there, a few times.
    """
    if plan.tolerance is None:
        if plan.method not in ("slsqp", "trf", "coarse-trf", "trf-slsqp"):
            return False
        return slsqp(search, search.best.z, plan.iterations, tolerance=POLISHED)

    def optimal():
        return optimality(search, search.best)[1] < SETTLED

    if _converged(search, found.starts) and optimal():
        return True
    return any(slsqp(search, search.best.z, plan.iterations) and optimal() for _ in range(RENEWED))


def _nothing_lower(search, iterations):
    """Return True if nothing lower is found along the gradient that is left at the best point.

    And that gradient is below UNSTABLE. Where there is something lower, the search goes on from
    it, a few times.
    """
    for _ in range(RENEWED):
        better = downhill(search, search.best)
        if better is None:
            return optimality(search, search.best)[1] < UNSTABLE
        slsqp(search, better.z, iterations)
    return downhill(search, search.best) is None


def _converged(search, starts):
    """Return True if the local search that gave the best point converged, not on a step."""
    mine = search.best_start < len(starts) and starts[search.best_start]["converged"]
    return bool(mine) and not _without_slope(search)


def _without_slope(search):
    """Return True if the gradient is exactly zero at a cost that is not: the cost has steps."""
    return not np.any(search.best.gradient) and search.best.cost != 0.0


def status_of(found: Outcome, feasible: bool) -> Status:
    """Return how the stages ended; feasible : whether every limit holds at the answer.

    Converged: the search that gave the answer converged, or the last one did, and nothing lower
    lies along a gradient that is left. Infeasible: the search for the least violation came to its
    end, and some was left.
    """
    if found.interrupted:
        return Status.INTERRUPTED
    if found.search is None or found.best is None:
        return Status.NOT_CONVERGED
    if not feasible:
        return Status.INFEASIBLE if found.least else Status.NOT_CONVERGED
    done = found.polished and not _without_slope(found.search)
    if found.settled and (done or _converged(found.search, found.starts)):
        return Status.CONVERGED
    return Status.NOT_CONVERGED


def _reporter(progress, problem, starts):
    """Return what a Search calls after every evaluation: `progress` with a dict."""

    def report(search):
        if progress is not None and search.history:
            best = search.best
            progress(
                {
                    "start": search.start,
                    "starts": starts,
                    "evaluations": len(search.history),
                    "cost": search.history[-1][1],
                    "violation": search.history[-1][2],
                    "best": None if best is None else best.cost,
                    "best_violation": None if best is None else search.violation(best),
                    "values": None if best is None else problem.values(best.z),
                }
            )

    return report
