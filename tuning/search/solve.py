"""solve: screening, local searches, feasibility, a last search, differential evolution."""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from tuning.cluster.ahead import evaluate_ahead
from tuning.problem.evaluator import Evaluator
from tuning.problem.slopes import SlopeCheck, check_slopes
from tuning.problem.status import Status
from tuning.search import diagnostics
from tuning.search.driver import LOWER_BY, SETTLED, UNSTABLE, Search, downhill, optimality, reporter
from tuning.search.methods import (
    UNCONSTRAINED,
    Local,
    approach,
    find_feasible,
    run_local,
    search_alone,
    slsqp,
)
from tuning.search.options import Options
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

RENEWED = 3  # times that a search begins again before conditions of an optimum hold

AGREE = 1e-3  # two searches whose objectives differ by less than this share agree [-]
SAME = 1e-9  # share of the cost by which two programs that compute it may differ, by rounding [-]
FRESH = 2  # new Sobol points, as multiples of the members of a differential evolution

TRIED = 8  # members of a differential evolution among which a start is found
MISLED = 0.1  # share by which a coarse run's cost may differ from the true one [-]

POLISHED = 1e-12  # tolerance of the last search, from the best point [-]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Plan:
    """Plan of `solve`: numbers of starts, points and iterations."""

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

    @classmethod
    def of(cls, options: Options, method: str, seed: int, **more: Any) -> "Plan":
        numbers = ("starts", "screening", "iterations", "tolerance")
        batch = getattr(options, "batch", None)
        stated = {n: getattr(options, n) for n in numbers}
        return cls(method=method, seed=seed, batch=batch, **{**stated, **more})

    @property
    def local(self) -> Local:
        return Local(self.method, self.iterations, self.tolerance, self.batch, self.seed)


@dataclasses.dataclass
class Solution:
    """Result of the stages so far; Ctrl-C does not change it."""

    search: Search | None = None
    starts: list[dict[str, Any]] = dataclasses.field(default_factory=list)
    interrupted: bool = False
    redone: int = 0  # screening points that were run again at the true step
    least: bool = False  # whether the search for the least violation came to its end
    ended: bool = False  # whether the search that gave the answer converged, and so it stayed
    confirmed: bool = False  # whether it converged, and two agree or evolution found nothing better
    probe: dict[str, int] | None = None  # result of differential evolution, see TuningResult
    change: Any = None  # (P,) percent of the cost by 10 % of each parameter
    idle: Any = None  # (P,) True for parameters that no run exercises
    curvature: dict[str, Any] | None = None
    # at the start and at the answer, whether runs bear the slopes out
    slopes: dict[str, SlopeCheck] = dataclasses.field(default_factory=dict)
    z: Any = None  # (P,) the answer, where it is not the best point
    kept: Any = None  # (P,) True for parameters that stay at their first values
    least_cost_peaks: tuple[float, float] | None = None
    """Ms and Mt of the gains of least cost, if others were chosen [-]."""
    screened: list[Population] = dataclasses.field(default_factory=list)
    """Points at which a search might have started."""
    # {((name, value), ...): margin measures} at points where they were asked for
    margins: dict[Any, Any] = dataclasses.field(default_factory=dict)

    @property
    def best(self) -> Any:
        """The best Point; None where no finite one was found."""
        return self.search.best if self.search else None

    @property
    def point(self) -> Any:
        return self.best if self.search is None or self.z is None else self.search.point(self.z)

    def status(self, feasible: bool, lost: Sequence[Lost] = ()) -> Status:
        """Return how the search ended; feasible : whether every limit holds at the answer."""
        if self.interrupted:
            return Status.INTERRUPTED
        if self.search is None or self.best is None:
            return Status.NOT_CONVERGED
        if not feasible:
            return Status.INFEASIBLE if self.least else Status.NOT_CONVERGED
        done = self.confirmed and not without_slope(self.search) and not lost
        return Status.CONVERGED if done else Status.NOT_CONVERGED


def solve(
    evaluator: Evaluator, first: np.ndarray, plan: Plan, progress: Callable | None
) -> Solution:
    """Return the Solution of all stages from z = first (P,); Ctrl-C ends them early."""
    stages = Stages(evaluator, plan, reporter(progress, plan.starts))
    try:
        stages.run(first)
    except KeyboardInterrupt:
        stages.solution.interrupted = True
    return stages.solution


class Stages:
    """The stages one after the other; `solution` has what each of them gave."""

    search: Search

    def __init__(
        self, evaluator: Evaluator, plan: Plan, report: Callable, rivals: Sequence[np.ndarray] = ()
    ):
        self.evaluator, self.plan, self.report = evaluator, plan, report
        self.solution, self.rivals = Solution(), rivals

    def run(self, first: np.ndarray) -> None:
        """Search from z = first (P,)."""
        plan, solution = self.plan, self.solution
        reference = self.evaluator.point(first)
        check_slopes(self.evaluator.problem, reference)
        search = self.search = solution.search = Search(
            self.evaluator, reference, self.report, plan.tolerance
        )
        search.take(reference)
        screened, solution.redone = screen(self.evaluator, plan.screening, plan.seed, plan.coarse)
        self.screened = screened
        solution.screened.append(screened)
        solution.slopes["start"] = search.slope(reference)
        shortfall = np.maximum(0.0, -screened.margins / search.limit_scale)
        merits = screened.costs / search.scale + 10.0 * shortfall.sum(axis=1)
        self.search_from(distinct_starts(screened.zs, merits, plan.starts, first))
        if self.violated and plan.method not in UNCONSTRAINED:
            solution.least = find_feasible(
                search, screened, plan.iterations, plan.seed, plan.coarse
            )
        if plan.polish:
            approach(search)
        if search.best is not None:
            self.finish()
            self.confirm()
            solution.idle = diagnostics.unexercised(search, first)
            if plan.polish and not self.violated and search.slope(search.best).usable:
                solution.curvature = diagnostics.curvature(search, search.best, solution.idle)
        if plan.polish and search.return_to_start():
            solution.confirmed, solution.curvature = False, None
        if search.best is not None:
            solution.slopes["answer"] = search.slope(search.best)

    @property
    def violated(self) -> bool:
        return self.search.best is not None and self.search.violation(self.search.best) > 0

    @property
    def agreed(self) -> bool:
        """True if two searches ended at the answer, or in its value, and one converged."""
        best, starts = self.search.best, self.solution.starts
        if best is None or not any(start["converged"] for start in starts):
            return False
        most = best.cost + self.plan.agree * abs(best.cost)
        return sum(s["violation"] == 0.0 and s["cost"] <= most for s in starts) > 1

    @property
    def converged(self) -> bool:
        """True if the local search that gave the best point converged, not on a step."""
        start, starts = self.search.best_start, self.solution.starts
        done = start < len(starts) and starts[start]["converged"]
        return bool(done) and not without_slope(self.search)

    def search_from(self, starts: Sequence[np.ndarray]) -> None:
        """Search from `starts` until two agree, then from better screened points and rivals."""
        search, plan = self.search, self.plan
        tasks = [(z, number, tuple(plan.local)) for number, z in enumerate(starts)]
        report = lambda: self.report(search)
        evaluate_ahead(plan.engine, self.evaluator, tasks, search_alone, report)
        for z in starts:
            self.local_search(z)
            if self.agreed:
                break
        while True:
            search.start, count = len(self.solution.starts), len(search.history)
            z = best_screened(search, self.screened)
            if z is None and len(self.rivals):
                zs, self.rivals = np.stack(self.rivals), ()
                rivals = Population(zs, *self.evaluator.screen(zs, plan.coarse))
                self.solution.screened.append(rivals)
                z = best_screened(search, rivals)
            if z is None:
                return
            self.local_search(z, count)

    def local_search(self, z: np.ndarray, count: int | None = None) -> None:
        """Run one local search from z; count : evaluations before the first that is part of it."""
        search, starts = self.search, self.solution.starts
        search.start = len(starts)
        count = len(search.history) if count is None else count
        z, search.exhausted = np.clip(z, 0.0, 1.0), False
        check = search.slopes.get(z.tobytes())
        usable = check is None or check.usable
        converged = usable and bool(run_local(search, z, self.plan.local))
        mine = search.history[count:]
        reached = min(mine, key=lambda h: (h[2] > 0, h[2] if h[2] > 0 else h[1]), default=None)
        if reached is None:  # every point it asked for was known already
            point = search.memory.get(z.tobytes(), search.best or search.last_finite)
            reached = (search.start, float(point.cost), search.violation(point), tuple(point.z))
        if np.array_equal(reached[3], z):
            check = search.slope(search.point(z))
        usable = None if check is None else check.usable
        _, cost, violation, end = reached
        start = {"from": search.problem.values(z), "to": search.problem.values(end)}
        start |= {"cost": cost, "violation": violation, "evaluations": len(mine)}
        start |= {"converged": converged and usable is not False, "exhausted": search.exhausted}
        starts.append(start | {"slope_usable": usable})

    def finish(self) -> None:
        """Search a last time from the best point, and find out whether it is an optimum."""
        search, solution, polish = self.search, self.solution, self.plan.polish
        search.start, solution.ended = len(solution.starts), not polish and not self.violated
        if not polish or not search.slope(search.best).usable:
            return
        polished = self.last_search()
        settled = not self.violated and self.nothing_lower()
        ended = settled and (polished or self.converged)
        solution.ended = ended and search.slope(search.best).usable

    def last_search(self) -> bool:
        """Return True if a last search from the best point converged."""
        search, plan = self.search, self.plan
        if plan.tolerance is None:
            if plan.method not in ("slsqp", "trf", "coarse-trf", "trf-slsqp"):
                return False
            return slsqp(search, search.best.z, plan.iterations, tolerance=POLISHED)
        optimal = lambda: optimality(search, search.best)[1] < SETTLED
        if self.converged and optimal():
            return True
        again = range(RENEWED)
        return any(slsqp(search, search.best.z, plan.iterations) and optimal() for _ in again)

    def nothing_lower(self) -> bool:
        """Return True if nothing lower is found along the gradient left at the best point."""
        search = self.search
        for _ in range(RENEWED):
            better = downhill(search, search.best)
            if better is None:
                return optimality(search, search.best)[1] < UNSTABLE
            slsqp(search, better.z, self.plan.iterations)
        return downhill(search, search.best) is None

    def confirm(self) -> None:
        """Look for points that are better than the answer, and search on from them, a few times."""
        search, solution = self.search, self.solution
        for k in range(RENEWED):
            mark = search.best
            lower = self.lower_neighbour() if self.plan.polish else None
            blind = not search.slope(mark).usable
            if lower is None and (blind or (solution.ended and not self.agreed)):
                lower = self.evolved(self.plan.seed + k)
            if lower is not None:
                self.local_search(lower)
                self.finish()
            if not self.is_lower(search.best, mark):
                solution.confirmed = solution.ended
                return
            if solution.probe:
                solution.probe["lower"] += 1
        solution.confirmed = solution.ended and self.agreed

    def is_lower(self, point: Any, other: Any) -> bool:
        """Return True if a point is better than another by more than the cost is trusted to."""
        search = self.search
        if search.violation(other) > 0 or search.violation(point) > 0:
            return search.better(point, other)
        return point.cost < other.cost - self.plan.lower_by * abs(other.cost)

    def lower_neighbour(self) -> Any:
        """Return z of a neighbour of the best point that is lower; None where none is."""
        search, best = self.search, self.search.best
        near = diagnostics.neighbours(search.problem, best.z)
        costs, margins = self.evaluator.screen(near)
        self.solution.change = diagnostics.sensitivities(costs)
        merits = Population(near, costs, margins).merits(search)
        i = int(np.argmin(merits))
        if merits[i] >= merits[0] - SAME * abs(merits[0]):
            return None
        return near[i] if self.is_lower(search.point(near[i]), best) else None

    def evolved(self, seed: int) -> Any:
        """Return z of a point that may be better than the answer, by differential evolution."""
        # the answer, points around it, the best known ones; on coarse runs unless these mislead
        search, evaluator, plan = self.search, self.evaluator, self.plan
        best, mark = search.best, evaluator.simulations
        count, generations = evolution_size(search, self.screened)
        new = np.split(sobol(FRESH * MEMBERS, len(best.z), seed + 1)[: FRESH * count], FRESH)
        known = [self.screened, *(Population(zs, *evaluator.screen(zs, plan.coarse)) for zs in new)]
        known = Population(*(np.concatenate(parts) for parts in zip(*known)))
        order = np.argsort(known.merits(search), kind="stable")
        near = around(best.z, count // 4, seed)
        members = np.concatenate([best.z[None], near, known.zs[order]])[:count]
        last, first = evolve(search, members, generations, seed, plan.coarse)
        cost = first.merits(search)[0]
        if not np.isclose(cost, best.cost, rtol=MISLED) and len(search.problem.runs) == 1:
            last, first = evolve(search, members, max(2, generations // 8), seed, coarse=False)
            cost = first.merits(search)[0]
        probe = self.solution.probe = self.solution.probe or {"runs": 0, "searches": 0, "lower": 0}
        probe["runs"] += evaluator.simulations - mark
        merits = last.merits(search)
        for i in np.argsort(merits, kind="stable")[:TRIED]:
            if merits[i] >= cost - plan.lower_by * abs(cost):
                search.point(last.zs[i])  # nothing lower, but it may be, by a little
                return None
            if search.point(last.zs[i]).finite:
                probe["searches"] += 1
                return last.zs[i]
        return None


def without_slope(search: Search) -> bool:
    """Return True if the gradient is exactly zero at a cost that is not: the cost has steps."""
    return not np.any(search.best.gradient) and search.best.cost != 0.0
