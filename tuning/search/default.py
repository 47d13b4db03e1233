"""The search of the default answer, from the problem to gains that hold on validation plants."""

import contextlib
import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from jaxtank.bounds import widened
from jaxtank.case import Case, Free, Scenario
from jaxtank.core.tree import with_values
from jaxtank.limits import UNDEFINED_MARGIN, tightened
from jaxtank.loop import run as lp
from jaxtank.loop.closed_loop import without_noise
from tuning.problem.evaluator import Evaluator
from tuning.problem.problem import Problem
from tuning.problem.reported import in_force
from tuning.problem.scenarios import ScenarioRun, runs_of
from tuning.problem.tracking import lost_runs, tracked_of
from tuning.search.driver import reporter
from tuning.search.judged import Judged, judge, near_limits
from tuning.search.methods import automatic
from tuning.search.robustness import make_robust, prefer_robust
from tuning.search.setting import PLANTS, Setting
from tuning.search.small_changes import WORTH, stay_put
from tuning.search.solve import Plan, Solution, Stages

CHECKED = 256  # plants that are looked at

SEED = 20_011  # of these plants and their noise, whatever the seed of the search

ADDED = 8  # validation plants that are added to the plants of the search
WORST = 2  # of each limit, the plants that come nearest to it are added, as many as this

SHARE = 0.4  # tightening of a limit, from the 90 % quantile of the plants to their worst [-]

LARGEST = 0.25  # largest tightening, as a share of the limit [-]
LIGHT = 1e-9  # weight of an added plant in the cost [-]: it serves the limits alone

ATTEMPTS = 4  # answers that are judged: with a filter, at the true step, tighter limits
ROUNDS = 4  # most searches until an answer holds the limits on the plants looked at
MISLED = 1.5  # ratio of the costs at true and coarse step above which the coarse one misleads
TIGHTER = 1.2  # factor on the violation of a limit, for the next search [-]
LEVELS = ("max_level", "overflow_volume")  # that a safety filter keeps

LOST = 0.05  # share of the plants that miss setpoints, above which a search leaves a filter out

OFFSET_GROWTH, OFFSET_RATIO = 5.0, 2.0
"""A safety filter keeps a level off its setpoint if the steady-state error is OFFSET_RATIO times
the standard deviation of the noise and that with the same gains without the filter. This is asked
where it is OFFSET_GROWTH times that before, or more than a verdict allows [-]."""

Key = tuple[str, int]  # (measure, entry) of a limit


class Checks:
    """Limits on CHECKED plants: how much each is tightened, and which plants a search needs."""

    def __init__(
        self,
        setting: Setting,
        case: Case,
        free: Any,
        limits: Mapping[str, Any],
        least: Mapping[Key, float],
    ):
        plants = [s._replace(name=f"added {s.name}") for s in setting.plants(case, CHECKED, SEED)]
        self.problem = Problem(case, free, setting.objective, limits, plants, SEED)
        self.stated, self.least = limits, least
        self.rows: dict[Key, list[int]] = {}
        for i, limit in enumerate(self.problem.limits):
            self.rows.setdefault(limit.key, []).append(i)
        self.tightening: dict[Key, float] = {}
        self.margins: dict[Key, np.ndarray] = {}
        self.added: list[int] = []

    def look(self, z: np.ndarray) -> None:
        """Run every plant at z (P,): its margins set the tightening, the worst plants are added."""
        _, margins = self.problem.screen(np.asarray(z)[None])
        worst: list[int] = []
        for key, rows in self.rows.items():
            values = self.margins[key] = margins[0, rows]
            self.tightening[key] = self._tightening(key, values)
            order = np.argsort(values, kind="stable")
            worst += [self.problem.limits[rows[i]].run for i in order[:WORST]]
        self.added = list(dict.fromkeys([*worst, *self.added, *range(ADDED)]))[:ADDED]

    def _tightening(self, key: Key, margins: np.ndarray) -> float:
        limit = self.problem.limits[self.rows[key][0]]
        size = abs(limit.value)
        known = margins[np.abs(margins) < UNDEFINED_MARGIN]
        if size == 0.0 or key[0] not in self.stated or not len(known):
            return 0.0
        spread = float(np.quantile(known, 0.1) - known.min())
        # far past its limit, a measure spreads more than at it
        reached = abs(limit.value - limit.sign * known.min())
        amount = SHARE * spread * (size / reached if reached > size else 1.0)
        return min(max(amount, self.least.get(key, 0.0)), LARGEST * size)

    def hold(self, share: float = 0.5) -> bool:
        """Return True if all plants keep all limits, with this share of the tightening left."""
        return all(m.min() >= share * self.tightening[k] for k, m in self.margins.items())

    def slack(self, problem: Problem) -> np.ndarray:
        """Return (limits,) by how much the limits of a problem are tighter than stated."""
        return np.array([self.tightening.get(limit.key, 0.0) for limit in problem.limits])

    @property
    def share(self) -> float:
        """Largest tightening as a share of its limit [-]."""
        sizes = {key: abs(self.problem.limits[rows[0]].value) for key, rows in self.rows.items()}
        return max((v / sizes[k] for k, v in self.tightening.items() if v > 0.0), default=0.0)

    def limits(self) -> dict[str, Any]:
        return tightened(self.problem.loop.plant, self.stated, self.tightening)

    def scenarios(self) -> list[Scenario]:
        return [self.problem.scenarios[i]._replace(weight=LIGHT) for i in self.added]

    def runs(self, share: float) -> list[ScenarioRun]:
        """Return the added plants as runs with their own noise; share : of the cost."""
        return [self.problem.runs[i]._replace(weight=share) for i in self.added]


def problem_of(
    setting: Setting, case: Case, free: Any, seed: int, checks: Checks | None
) -> Problem:
    """Return the problem of the search on the plants of a case and on the plants of `checks`."""
    plants = setting.plants(case, PLANTS, seed)
    stated = case, free, setting.objective
    if checks is None:
        return Problem(*stated, {}, plants, seed, draw_noise=True)
    scenarios = (*plants, *checks.scenarios())
    runs = runs_of(case, scenarios, seed)
    runs[len(plants) :] = checks.runs(runs[-1].weight)
    return Problem(*stated, checks.limits(), scenarios, seed, runs=runs, draw_noise=True)


@dataclasses.dataclass
class Task:
    """The request of the user, and data that all searches share."""

    free: Any
    plan: Plan
    samples: int  # validation plants
    progress: Any  # a callable, or None
    may_filter: bool = True
    rivals: Sequence[Mapping[str, float]] = ()  # gains of tuning rules
    cache: Any = None  # of the first search
    may_widen: bool = False  # the ranges are defaults
    may_remove_filter: bool = False  # a filter was neither asked for nor refused
    stage: str = ""
    last: dict[str, Any] | None = None

    def report(self, unit: str | None) -> Callable:
        """Return the callback of a Search after each evaluation; unit : of the cost, or None."""

        def progress(event):
            self.last = event | {"stage": self.stage}
            self.progress(self.last)

        return reporter(progress if self.progress else None, self.plan.starts, unit)

    def enter(self, stage: str) -> None:
        """Report the next stage before its first evaluation; nothing before the first stage."""
        self.stage = stage
        if self.progress is not None and self.last is not None:
            self.progress(self.last | {"stage": stage})


@dataclasses.dataclass
class Attempt:
    """A search on plants, and the result on validation plants."""

    setting: Setting
    solution: Solution = dataclasses.field(default_factory=Solution)
    evaluator: Any = None
    after: Judged | None = None
    tightened: float = 0.0
    number: int = 0
    filter_offsets: dict[int, tuple[float, float]] = dataclasses.field(default_factory=dict)
    """{output: steady-state errors without and with the safety filter} where it enlarges them."""
    filter_lost: int = 0  # validation plants that miss their setpoints under a new safety filter


def best_attempt(task: Task, setting: Setting, near: bool, before: Judged) -> Attempt:
    """Return the answer; near: whether a level comes near its limit; before: the case as given."""
    attempt = _search_wider_ranges(task, attempts(task, setting, near))
    attempt.filter_offsets, attempt.filter_lost = _offsets(attempt, before), _lost(attempt)
    return _compare_without_filter(task, attempt)


def _lost(attempt: Attempt) -> int:
    """Number of plants that miss setpoints within their reach, under a filter that is new."""
    setting, after = attempt.setting, attempt.after
    if after is None or setting.filter is None or setting.case.loop.safety_filter is not None:
        return 0
    lost = lost_runs(setting.case.loop, after.measures, after.failed)
    return int(lost.sum() if after.infeasible is None else (lost & ~after.infeasible).sum())


def _allowed(setting: Setting, after: Judged) -> Any:
    """(outputs,) steady-state errors that a verdict allows."""
    runs = after.measures if after.nominal is None else after.nominal
    tracked = tracked_of(setting.case.loop, runs)
    if tracked is None:
        return np.inf
    return tracked.allowed.reshape(-1, len(setting.case.loop.plant.outputs)).min(axis=0)


def _offsets(attempt: Attempt, before: Judged) -> dict[int, tuple[float, float]]:
    """Return {output: steady-state errors without and with it} where a new filter enlarges them."""
    # of the nominal plant without noise; median over the plants where the case states noise
    setting, after, name = attempt.setting, attempt.after, "steady_state_error"
    new = setting.filter is not None and setting.case.loop.safety_filter is None
    if not new or after is None or name not in after.measures:
        return {}
    if after.infeasible is not None and after.infeasible.any():
        return {}
    errors = [np.asarray(run[name]) for run in (before.nominal, after.nominal) if run is not None]
    if len(errors) < 2:
        rows = [side.measures[name].reshape(side.samples, -1) for side in (before, after)]
        errors = [np.quantile(np.nan_to_num(values), 0.5, axis=0) for values in rows]
    noise = setting.noise[np.array(setting.case.loop.plant.outputs)]
    large = errors[1] > np.minimum(OFFSET_GROWTH * errors[0], _allowed(setting, after))
    large &= errors[1] > OFFSET_RATIO * noise
    if not large.any():
        return {}
    case = _tuned(attempt).without_filter().searched  # the same gains: slow ones have errors too
    bare = without_noise(case.loop)
    alone = np.asarray(lp.evaluate(bare, case.clock, [name])[name])
    large &= errors[1] > OFFSET_RATIO * alone
    return {int(i): (float(alone[i]), float(errors[1][i])) for i in np.flatnonzero(large)}


def _search_wider_ranges(task: Task, attempt: Attempt) -> Attempt:
    """Return the attempt, or a better one with wider ranges where a gain is at an end."""
    solution, after = attempt.solution, attempt.after
    if not task.may_widen or solution.interrupted or solution.point is None or after is None:
        return attempt
    problem = attempt.evaluator.problem
    values, free, wider = values_of(problem, solution), _ranges(problem), {}
    for b, slope in zip(problem.bounds, solution.point.gradient):
        end = b.end_at(values[b.name])
        falls = {"lower": slope, "upper": -slope}.get(end, 0.0)  # outwards, along a whole range
        if end and falls > WORTH * abs(solution.point.cost):
            wider[b.name] = widened(problem.loop, b, end, attempt.setting.case.clock.duration)
    wider = {name: ends for name, ends in wider.items() if ends != free[name]}
    if not wider:
        return attempt
    again = dataclasses.replace(task, free=free | wider, rivals=(*task.rivals, values))
    return _better(task, attempt, attempts(again, attempt.setting, True, attempt.number))


def _ranges(problem: Problem) -> dict[str, Free]:
    return {b.name: Free(b.low, b.high, b.scale) for b in problem.bounds}


def _compare_without_filter(task: Task, attempt: Attempt) -> Attempt:
    """Return the attempt; gains without a filter where it leaves an error and these are better."""
    offsets, lost = attempt.filter_offsets, attempt.filter_lost
    in_the_way = offsets or lost > LOST * task.samples
    if not task.may_remove_filter or attempt.solution.interrupted or not in_the_way:
        return attempt
    alone = dataclasses.replace(task, may_filter=False, free=_ranges(attempt.evaluator.problem))
    other = attempts(alone, attempt.setting.without_filter(), True, attempt.number)
    other.filter_offsets, other.filter_lost = offsets, lost
    return _better(task, attempt, other)


def _better(task: Task, attempt: Attempt, other: Attempt) -> Attempt:
    """The other attempt if it costs less, by WORTH, and keeps the limits on as many plants."""
    if other.solution.interrupted or other.after is None:
        attempt.solution.interrupted = other.solution.interrupted
        return attempt
    after = attempt.after
    assert after is not None
    if other.number != attempt.number:  # judged on other plants
        after = judge(_tuned(attempt), task.samples, task.plan.seed, round_=other.number)
    good = other.after.held.sum() >= after.held.sum() and not other.after.failed.any()
    old, new = (float(plants.cost.mean()) for plants in (after, other.after))
    cheaper = after.failed.any() or new < old - WORTH * abs(old)
    return other if good and cheaper else attempt


def _tuned(attempt: Attempt) -> Setting:
    """The setting of an attempt with its gains."""
    setting = attempt.setting
    values = values_of(attempt.evaluator.problem, attempt.solution)
    loop = with_values(setting.searched.loop, values)
    return setting.replace(searched=setting.searched.replace(loop=loop))


def attempts(task: Task, setting: Setting, near: bool, first: int = 0) -> Attempt:
    """Return the Attempt whose answer holds on validation plants, the last where none does."""
    # first: its number, as each attempt is judged on plants of its own
    coarse, limits, least = True, dict(setting.limits), {}
    if not near:  # levels stay far below
        limits.pop("max_level", None)
    last: Any = None
    for number in range(first, first + ATTEMPTS):
        case = setting.coarse() if coarse else setting.searched
        attempt = Attempt(setting, number=number)
        try:
            task.stage = _stage(setting, case)
            checks = _search(task, attempt, case, limits, least)
            if attempt.solution.point is None:
                return dataclasses.replace(attempt, number=0)
            make_robust(setting, attempt.solution)
            task.enter(f"judging the answer on {task.samples} validation plants")
            attempt.after = judge(_tuned(attempt), task.samples, task.plan.seed, round_=number)
        except KeyboardInterrupt:
            if last is None:
                last = dataclasses.replace(attempt, number=0)
                with contextlib.suppress(KeyboardInterrupt):  # a second one waits for nothing
                    prefer_robust(setting, last.solution)
            last.solution.interrupted = True
            return last
        last = attempt
        remedy = _remedy(task, attempt, checks, coarse and case is not setting.searched)
        if not remedy:
            break
        if remedy == "fine step":
            coarse = False
            continue
        if remedy == "safety filter":
            known, setting = limits, setting.with_filter(_near(attempt))
            limits = dict(setting.limits)
            if setting is not attempt.setting or limits != known:
                continue
        if checks is None or not _keeps_limits(attempt):
            break
        least = _tighter(attempt.after, checks)
    return last


def _stage(setting: Setting, case: Case) -> str:
    filtered = " with a safety filter" if setting.filter is not None else ""
    plants = max(PLANTS, len(case.scenarios))
    return f"search on {plants} plants{filtered}, step {case.clock.dt:g} s"


def _near(attempt: Attempt) -> np.ndarray:
    """(tanks,) whose levels come near their limits on the validation plants."""
    assert attempt.after is not None
    return near_limits(attempt.setting, attempt.after)


def _remedy(task: Task, attempt: Attempt, checks: Checks | None, coarse: bool) -> str:
    """What the next attempt has to change; "" where the answer holds, or nothing helps."""
    setting, after, solution = attempt.setting, attempt.after, attempt.solution
    assert after is not None
    if coarse and _misled(solution.point.cost, after):
        return "fine step"
    if after.held.all():
        return ""
    levels_broken = any(r["broken"] and r["limit"].measure in LEVELS for r in after.worst())
    if task.may_filter and setting.filter is None and levels_broken:
        return "safety filter"
    return "tighter limits" if checks and _keeps_limits(attempt) else ""


def _keeps_limits(attempt: Attempt) -> bool:
    """Whether the best gains keep the limits of their search."""
    search = attempt.solution.search
    return search is not None and search.violation(attempt.solution.point) == 0


def _search(
    task: Task, attempt: Attempt, case: Case, limits: Mapping[str, Any], least: Mapping[Key, float]
) -> Checks | None:
    """Search, then again on more plants until the limits hold on the plants of `Checks`."""
    setting = attempt.setting

    def search(checks: Checks | None = None, stays: bool = False) -> None:
        problem = problem_of(setting, case, task.free, task.plan.seed, checks)
        attempt.evaluator, task.cache = Evaluator(problem, task.cache), None
        plan, first = dataclasses.replace(task.plan, method=automatic(problem)), problem.start()
        rivals = [_at(problem, first, gains) for gains in task.rivals]
        stages = Stages(attempt.evaluator, plan, task.report(setting.cost_unit), rivals)
        if attempt.solution.point is None:  # else Ctrl-C leaves the answer of the search before
            attempt.solution = stages.solution
        stages.run(first)
        solution = attempt.solution = stages.solution
        if solution.search is not None and solution.best is not None:
            # a start that holds the limits as they are stated may stay where they are tighter
            slack = checks.slack(problem) if checks and stays else None
            solution.z, solution.kept = stay_put(solution.search, first, plan.iterations, slack)
            solution.slopes["answer"] = solution.search.slope(solution.point)

    if not limits:
        search()
        return None
    checks = Checks(setting, case, task.free, limits, least)
    checks.look(checks.problem.start())
    stays = not least and checks.hold(share=0.0)
    for _ in range(ROUNDS):
        attempt.tightened = checks.share
        search(checks, stays)
        if attempt.solution.point is None:
            break
        stated = attempt.solution.point.margins + checks.slack(attempt.evaluator.problem)
        checks.look(attempt.solution.point.z)
        if np.any(stated < 0.0):  # not even these plants: more of them would not be kept either
            break
        if checks.hold() or attempt.solution.kept.all():
            break
    return checks


def _at(problem: Problem, first: np.ndarray, gains: Mapping[str, float]) -> np.ndarray:
    """Return `first` (P,) with the gains that are free, within their ranges."""
    z = np.array(first)
    for i, bound in enumerate(problem.bounds):
        value = gains.get(bound.name)
        if value is not None and (bound.scale != "log" or value * bound.low > 0.0):
            z[i] = np.clip(bound.to_unit(value), 0.0, 1.0)
    return z


def _tighter(after: Judged, checks: Checks) -> dict[Key, float]:
    """Return {key: least tightening} after limits were violated on validation plants."""
    least = dict(checks.tightening)
    for row in after.worst():
        key = row["limit"].key
        if row["broken"] and key in least:
            least[key] += TIGHTER * min(-row["margin"], LARGEST * abs(row["limit"].value))
    return least


def values_of(problem: Problem, solution: Solution) -> dict[str, float]:
    """Return {name: value} of the answer; exactly the first value of a gain that stays."""
    start, point = problem.own_values(), solution.point
    if point is None or np.array_equal(point.z, problem.start()):
        return start
    values = problem.values(point.z)
    stays = np.zeros(len(start), dtype=bool)
    for flags in (solution.idle, solution.kept):
        stays = stays if flags is None else stays | flags
    values |= {n: start[n] for n, same in zip(start, stays) if same}
    acting = in_force(problem.loop, values)
    return {n: v if v == start[n] else acting[n] for n, v in values.items()}


def _misled(cost: float, after: Judged) -> bool:
    """Return True if the cost at the true step is another than at the coarse one."""
    good = ~after.failed
    if not good.any():
        return True
    ratio = float(np.mean(after.cost[good])) / cost if cost > 0 else 1.0
    return not 1.0 / MISLED < ratio < MISLED
