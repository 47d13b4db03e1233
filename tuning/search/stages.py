"""The stages of one tuning: screening, local searches, feasibility, a final search, diagnostics."""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from tuning.cluster.ahead import evaluate_ahead
from tuning.problem.problem import Problem
from tuning.problem.slopes import SlopeCheck, check_slopes
from tuning.problem.status import Status
from tuning.search import diagnostics
from tuning.search.driver import LOWER_BY, SETTLED, UNSTABLE, Search, downhill, event_of, optimality
from tuning.search.methods import (
    UNCONSTRAINED,
    Local,
    approach,
    find_feasible,
    run_local,
    search_alone,
    slsqp,
)
from tuning.search.result import Lost
from tuning.search.screening import (
    MEMBERS,
    Population,
    around,
    best_screened,
    distinct_starts,
    evolution_size,
    evolve,
    screen,
    sobol,
)

RENEWED = 3
"""How often a search is begun again from where it stopped before conditions of an optimum hold."""

AGREE = 1e-3  # two searches whose objectives differ by less than this share agree [-]
SAME = 1e-9  # share of the cost by which two programs that compute it may differ, by rounding [-]
FRESH = 2  # new Sobol points, as multiples of the members of a differential evolution

TRIED = 8
"""Members of a differential evolution of which the first that is no chaotic run is a start."""

MISLED = 0.1
"""Share by which the cost of a coarse run may differ from the true one to be searched with [-]."""

POLISHED = 1e-12  # tolerance of the last search, from the best point [-]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Plan:
    """What is to be done: the keywords of `tune` that the stages read."""

    method: str
    starts: int
    screening: int
    iterations: int
    seed: int
    batch: int | None = None
    tolerance: float | None = None
    engine: Any = None  # of a cluster, on which the local searches run first
    # search on to rounding, look at neighbours, and compute the curvature of the answer
    polish: bool = True
    coarse: bool = True  # screen and look for better points at ten times the step
    agree: float = AGREE  # share by which the costs of two searches that agree differ [-]
    lower_by: float = LOWER_BY  # share by which a point must be lower to be searched from [-]

    @property
    def local(self) -> Local:
        """How each local search runs."""
        return Local(self.method, self.iterations, self.tolerance, self.batch, self.seed)


@dataclasses.dataclass
class Outcome:
    """What the stages found so far; Ctrl-C leaves it as it is."""

    search: Search | None = None
    starts: list[dict[str, Any]] = dataclasses.field(default_factory=list)
    interrupted: bool = False
    redone: int = 0  # screening points that were run again at the true step
    least: bool = False  # whether the search for the least violation came to its end
    ended: bool = False  # whether the search that gave the answer converged, and so it stayed
    confirmed: bool = False  # whether it converged, and two agree or evolution found nothing better
    probe: dict[str, int] | None = None  # what evolution found, see TuningResult
    change: Any = None  # (P,) percent of the cost by 10 % of each parameter
    idle: Any = None  # (P,) True for parameters that no run exercises
    curvature: dict[str, Any] | None = None
    # at the start and at the answer, whether runs bear the slopes out
    slopes: dict[str, SlopeCheck] = dataclasses.field(default_factory=dict)
    z: Any = None  # (P,) the answer, where it is not the best point
    kept: Any = None  # (P,) True for parameters that stay at their first values

    @property
    def best(self) -> Any:
        """The best Point; None where no finite one was found."""
        return self.search.best if self.search else None

    @property
    def point(self) -> Any:
        """The Point of the answer; None where none is finite."""
        return self.best if self.search is None or self.z is None else self.search.point(self.z)


def solve(problem: Problem, first: np.ndarray, plan: Plan, progress: Callable | None) -> Outcome:
    """Return the Outcome of all stages from z = first (P,); Ctrl-C ends them early."""
    outcome = Outcome(idle=np.zeros(len(first), dtype=bool))
    try:
        run_stages(problem, first, plan, outcome, reporter(progress, plan.starts))
    except KeyboardInterrupt:
        outcome.interrupted = True
    return outcome


def run_stages(
    problem: Problem, first: np.ndarray, plan: Plan, outcome: Outcome, report: Callable
) -> None:
    """Run the stages one after the other, and keep in `found` what each of them gave."""
    reference = problem.point(first)
    check_slopes(problem, reference)
    tolerance = {} if plan.tolerance is None else {"tolerance": plan.tolerance}
    search = outcome.search = Search(problem, reference, report, **tolerance)
    search.take(reference)
    *measured, outcome.redone = screen(problem, plan.screening, plan.seed, plan.coarse)
    screened = Population(*measured)
    outcome.slopes["start"] = search.slope(reference)
    shortfall = np.maximum(0.0, -screened.margins / search.limit_scale)
    merits = screened.costs / search.scale + 10.0 * shortfall.sum(axis=1)
    starts = distinct_starts(screened.zs, merits, plan.starts, first)
    searches = [(z, number, tuple(plan.local)) for number, z in enumerate(starts)]
    evaluate_ahead(plan.engine, problem, searches, search_alone, lambda: report(search))
    for z in starts:
        _local_search(search, outcome, plan, z)
        if _agreed(search, outcome, plan):
            break
    _search_screened(search, outcome, plan, screened)
    if _violated(search) and plan.method not in UNCONSTRAINED:
        outcome.least = find_feasible(search, screened, plan.iterations, plan.seed, plan.coarse)
    if plan.polish:
        approach(search)
    if search.best is not None:
        _finish(search, outcome, plan)
        _confirm(search, outcome, plan, screened)
        outcome.idle = diagnostics.unexercised(problem, search, first)
        if plan.polish and not _violated(search) and search.slope(search.best).usable:
            outcome.curvature = diagnostics.curvature(problem, search, search.best, outcome.idle)
    if plan.polish and search.return_to_start():
        outcome.confirmed, outcome.curvature = False, None
    if search.best is not None:
        outcome.slopes["answer"] = search.slope(search.best)


def _violated(search):
    """Return True if the best point violates a limit."""
    return search.best is not None and search.violation(search.best) > 0


def _search_screened(search, outcome, plan, screened):
    """Search on from each screened point that is better than all searches, until none is."""
    while True:
        search.start, count = len(outcome.starts), len(search.history)
        z = best_screened(search, screened)
        if z is None:
            return
        _local_search(search, outcome, plan, z, count)


def _finish(search, outcome, plan):
    """Search a last time from the best point, and find out whether it is an optimum."""
    search.start, outcome.ended = len(outcome.starts), not plan.polish and not _violated(search)
    if not plan.polish or not search.slope(search.best).usable:
        return
    polished = _last_search(search, outcome, plan)
    settled = not _violated(search) and _nothing_lower(search, plan.iterations)
    ended = settled and (polished or _converged(search, outcome.starts))
    outcome.ended = ended and search.slope(search.best).usable


def _confirm(search, outcome, plan, screened):
    """Look for points that are better than the answer, and search on from them, a few times."""
    for k in range(RENEWED):
        mark = search.best
        lower = _lower_neighbour(search, outcome, plan) if plan.polish else None
        blind = not search.slope(mark).usable
        if lower is None and (blind or (outcome.ended and not _agreed(search, outcome, plan))):
            lower = _probe(search, outcome, plan, screened, plan.seed + k)
        if lower is not None:
            _local_search(search, outcome, plan, lower)
            _finish(search, outcome, plan)
        if not _is_lower(search, search.best, mark, plan):
            outcome.confirmed = outcome.ended
            return
        if outcome.probe:
            outcome.probe["lower"] += 1
    outcome.confirmed = outcome.ended and _agreed(search, outcome, plan)


def _is_lower(search, point, other, plan):
    """Return True if a point is better than another by more than the cost can be trusted to."""
    if search.violation(other) > 0 or search.violation(point) > 0:
        return search.better(point, other)
    return point.cost < other.cost - plan.lower_by * abs(other.cost)


def _agreed(search, outcome, plan):
    """Return True if two searches ended at the answer, or in its value, and one converged."""
    if search.best is None or not any(o["converged"] for o in outcome.starts):
        return False
    most = search.best.cost + plan.agree * abs(search.best.cost)
    return sum(o["violation"] == 0.0 and o["cost"] <= most for o in outcome.starts) > 1


def _lower_neighbour(search, outcome, plan):
    """Return z of a neighbour of the best point that is lower; None where none is."""
    best = search.best
    near = diagnostics.neighbours(search.problem, best.z)
    costs, margins = search.problem.screen(near)
    outcome.change = diagnostics.sensitivities(costs)
    merits = Population(near, costs, margins).merits(search)
    i = int(np.argmin(merits))
    if merits[i] >= merits[0] - SAME * abs(merits[0]):
        return None
    return near[i] if _is_lower(search, search.point(near[i]), best, plan) else None


def _probe(search, outcome, plan, screened, seed):
    """Return z of a point that may be better than the answer, by differential evolution."""
    # Its members are the answer, points around it, and the best of the screened and of new Sobol
    # points. On coarse runs, unless they mislead: then a search decides at the true step.
    problem, best, mark = search.problem, search.best, search.problem.simulations
    count, generations = evolution_size(search, screened)
    new = np.split(sobol(FRESH * MEMBERS, len(best.z), seed + 1)[: FRESH * count], FRESH)
    seen = [screened, *(Population(zs, *problem.screen(zs, plan.coarse)) for zs in new)]
    seen = Population(*(np.concatenate(parts) for parts in zip(*seen)))
    order = np.argsort(seen.merits(search), kind="stable")
    near = around(best.z, count // 4, seed)
    members = np.concatenate([best.z[None], near, seen.zs[order]])[:count]
    now, began = evolve(search, members, generations, seed, plan.coarse)
    here = began.merits(search)[0]
    if not np.isclose(here, best.cost, rtol=MISLED) and len(problem.runs) == 1:
        now, began = evolve(search, members, max(2, generations // 8), seed, coarse=False)
        here = began.merits(search)[0]
    runs = problem.simulations - mark
    outcome.probe = outcome.probe or {"runs": 0, "searches": 0, "lower": 0}
    outcome.probe["runs"] += runs
    merits = now.merits(search)
    for i in np.argsort(merits, kind="stable")[:TRIED]:
        if merits[i] >= here - plan.lower_by * abs(here):
            search.point(now.zs[i])  # nothing lower, but it may be, by a little
            return None
        if search.point(now.zs[i]).finite:
            outcome.probe["searches"] += 1
            return now.zs[i]
    return None


def _local_search(search, outcome, plan, z, count=None):
    """Run one local search from z; `count` : evaluations before the first that belongs to it."""
    search.start = len(outcome.starts)
    count = len(search.history) if count is None else count
    z, search.exhausted = np.clip(z, 0.0, 1.0), False
    blind = search.slopes.get(z.tobytes())
    converged = bool(run_local(search, z, plan.local)) if blind is None or blind.usable else False
    mine = search.history[count:]
    reached = min(mine, key=lambda h: (h[2] > 0, h[2] if h[2] > 0 else h[1]), default=None)
    if reached is None:  # every point it asked for was known already
        point = search.memory.get(z.tobytes(), search.best or search.last_finite)
        reached = (search.start, float(point.cost), search.violation(point), tuple(point.z))
    if np.array_equal(reached[3], z):
        blind = search.slope(search.point(z))
    usable = None if blind is None else blind.usable
    outcome.starts.append(
        {
            "from": search.problem.values(z),
            "to": search.problem.values(reached[3]),
            "cost": reached[1],
            "violation": reached[2],
            "evaluations": len(mine),
            "converged": converged and usable is not False,
            "exhausted": search.exhausted,
            "slope_usable": usable,
        }
    )


def _last_search(search, outcome, plan):
    """Return True if a last search from the best point converged."""
    if plan.tolerance is None:
        if plan.method not in ("slsqp", "trf", "coarse-trf", "trf-slsqp"):
            return False
        return slsqp(search, search.best.z, plan.iterations, tolerance=POLISHED)

    def optimal():
        return optimality(search, search.best)[1] < SETTLED

    if _converged(search, outcome.starts) and optimal():
        return True
    return any(slsqp(search, search.best.z, plan.iterations) and optimal() for _ in range(RENEWED))


def _nothing_lower(search, iterations):
    """Return True if nothing lower is found along the gradient that is left at the best point."""
    for _ in range(RENEWED):
        better = downhill(search, search.best)
        if better is None:
            return optimality(search, search.best)[1] < UNSTABLE
        slsqp(search, better.z, iterations)
    return downhill(search, search.best) is None


def _converged(search, starts):
    """Return True if the local search that gave the best point converged, not on a step."""
    mine = search.best_start < len(starts) and starts[search.best_start]["converged"]
    return bool(mine) and not without_slope(search)


def without_slope(search):
    """Return True if the gradient is exactly zero at a cost that is not: the cost has steps."""
    return not np.any(search.best.gradient) and search.best.cost != 0.0


def reporter(progress: Callable | None, starts: int, **more: Any) -> Callable:
    """Return what a Search calls after every evaluation: `progress` with a dict."""

    def report(search):
        if progress is not None and search.history:
            progress(event_of(search, starts, **more))

    return report


def status_of(outcome: Outcome, feasible: bool, lost: Sequence[Lost] = ()) -> Status:
    """Return how the stages ended; feasible : whether every limit holds at the answer."""
    if outcome.interrupted:
        return Status.INTERRUPTED
    if outcome.search is None or outcome.best is None:
        return Status.NOT_CONVERGED
    if not feasible:
        return Status.INFEASIBLE if outcome.least else Status.NOT_CONVERGED
    done = outcome.confirmed and not without_slope(outcome.search) and not lost
    return Status.CONVERGED if done else Status.NOT_CONVERGED
