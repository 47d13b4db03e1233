"""Plants that are looked at during a search: on them too, limits that nothing proves shall hold."""

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np

from jaxtank import measures as ms
from jaxtank.case import Case, Scenario
from jaxtank.core.tree import with_values
from jaxtank.limits import UNDEFINED_MARGIN
from tuning.problem.problem import Problem
from tuning.problem.reported import in_force
from tuning.problem.scenarios import ScenarioRun, runs_of
from tuning.search.judged import Judged, judge, matters
from tuning.search.methods import automatic
from tuning.search.setting import NEAR, PLANTS, Setting
from tuning.search.small_changes import move_back, stay_put
from tuning.search.stages import Outcome, reporter, run_stages

CHECKED = 256  # plants that are looked at

SEED = 20_011
"""Of these plants and their noise, whatever the seed of a search, so that limits bind alike."""

ADDED = 8  # plants that join those of the search
WORST = 2  # of each limit, the plants that come nearest to it are added, as many as this

SHARE = 0.4
"""Tightening of a limit, as a share of the distance from the 90 % quantile over the plants to their
worst: other plants are worse than all of them now and then [-]."""

LARGEST = 0.25  # largest tightening, as a share of the limit [-]
LIGHT = 1e-9  # weight of an added plant in the cost [-]: it serves the limits alone

Key = tuple[str, int]  # (measure, entry) of a limit


class Checks:
    """Limits on CHECKED plants: how much each is tightened, and which plants a search needs."""

    def __init__(
        self, setting: Setting, case: Case, free: Any, limits: Mapping[str, Any], least: Mapping
    ):
        plants = [s._replace(name=f"added {s.name}") for s in setting.plants(case, CHECKED, SEED)]
        self.problem = Problem(case, free, setting.objective, limits, plants, SEED)
        self.given, self.least = limits, least
        keys = [(limit.measure, limit.index) for limit in self.problem.limits]
        self.rows = {
            key: [i for i, k in enumerate(keys) if k == key] for key in dict.fromkeys(keys)
        }
        self.tightening: dict[Key, float] = {}
        self.margins: dict[Key, np.ndarray] = {}
        self.added: list[int] = []

    def look(self, z: np.ndarray) -> None:
        """Run every plant at z (P,): its margins set the tightening, the worst plants are added."""
        _, margins = self.problem.screen(np.asarray(z)[None])
        worst: list[int] = []
        for key, rows in self.rows.items():
            found = self.margins[key] = margins[0, rows]
            self.tightening[key] = self._tightening(key, found)
            order = np.argsort(found, kind="stable")
            worst += [self.problem.limits[rows[i]].run for i in order[:WORST]]
        self.added = list(dict.fromkeys([*worst, *self.added, *range(ADDED)]))[:ADDED]

    def _tightening(self, key, margins):
        limit = self.problem.limits[self.rows[key][0]]
        least, size = self.least.get(key, 0.0), abs(limit.value)
        known = margins[np.abs(margins) < UNDEFINED_MARGIN]
        if size == 0.0 or key[0] not in self.given or not len(known):
            return 0.0
        spread = float(np.quantile(known, 0.1) - known.min())
        # far past its limit, a measure spreads more than at it
        reached = abs(limit.value - limit.sign * known.min())
        return min(max(SHARE * spread * min(1.0, size / reached), least), LARGEST * size)

    def hold(self, share: float = 0.5) -> bool:
        """Return True if all plants keep all limits, with this share of the tightening left."""
        return all(m.min() >= share * self.tightening[k] for k, m in self.margins.items())

    def slack(self, problem: Problem) -> np.ndarray:
        """Return (limits,) by how much the limits of a problem are tighter than they were given."""
        keys = ((limit.measure, limit.index) for limit in problem.limits)
        return np.array([self.tightening.get(key, 0.0) for key in keys])

    @property
    def share(self) -> float:
        """Largest tightening as a share of its limit [-]."""
        sizes = {k: abs(self.problem.limits[rows[0]].value) for k, rows in self.rows.items()}
        return max((v / sizes[k] for k, v in self.tightening.items() if v > 0.0), default=0.0)

    def limits(self) -> dict[str, Any]:
        """Return {measure: value} tightened."""
        found = dict(self.given)
        plant = self.problem.loop.plant
        for (measure, index), tightening in self.tightening.items():
            if not tightening:
                continue
            value: Any = found[measure]
            if isinstance(value, str):
                value = plant.rim
            values = np.array(np.broadcast_to(np.asarray(value, float), ms.entries(measure, plant)))
            values[index] -= ms.MEASURES[measure].sense * tightening
            found[measure] = values.tolist()
        return found

    def scenarios(self) -> list[Scenario]:
        """Return the added plants."""
        return [self.problem.scenarios[i]._replace(weight=LIGHT) for i in self.added]

    def runs(self, share: float) -> list[ScenarioRun]:
        """Return the added plants as runs with the noise of here; share : of the cost."""
        return [self.problem.runs[i]._replace(weight=share) for i in self.added]


ATTEMPTS = 4
"""Answers that are judged, at most: with a filter, at the true step, with tighter limits."""

ROUNDS = 4
"""Searches for an answer, at most, until it holds the limits on the plants that are looked at."""

MISLED = 1.5
"""Ratio of the costs at the true and at the coarse step above which the coarse one misleads [-]."""

TIGHTER = 1.2
"""Factor on the violation of a limit by which it is tightened further for the next search [-]."""

LEVELS = ("max_level", "overflow_volume")
"""Measures that a safety filter on levels keeps within their limits."""


class Task:
    """What was asked for, and what stays the same from one search to the next."""

    def __init__(self, free, plan, samples, progress):
        self.free, self.plan, self.samples, self.progress = free, plan, samples, progress
        self.may_filter = True
        self.cache: Any = None
        self.stage = ""
        self.last: dict[str, Any] | None = None

    def problem(self, setting: Setting, case: Case, checks: Checks | None) -> Problem:
        """Return the problem of the search on the plants of a case, and on those of `checks`."""
        seed = self.plan.seed
        plants = setting.plants(case, PLANTS, seed)
        cache, self.cache = self.cache, None
        stated = case, self.free, setting.objective
        if checks is None:
            return Problem(*stated, {}, plants, seed, cache, drawn=True)
        every = (*plants, *checks.scenarios())
        runs = runs_of(case, every, seed)
        runs[PLANTS:] = checks.runs(runs[-1].weight)
        return Problem(*stated, checks.limits(), every, seed, cache, runs=runs, drawn=True)

    def report(self, unit):
        """Return what a Search calls after every evaluation; unit : of the cost, None: unknown."""

        def progress(event):
            self.last = event | {"stage": self.stage}
            self.progress(self.last)

        return reporter(progress if self.progress else None, self.plan.starts, unit=unit)

    def enter(self, stage):
        """Report what is done next, where no evaluation reports it; not before the first one."""
        self.stage = stage
        if self.progress is not None and self.last is not None:
            self.progress(self.last | {"stage": stage})


@dataclasses.dataclass
class Attempt:
    """A search on plants, and how its answer does on validation plants."""

    setting: Setting
    outcome: Outcome = dataclasses.field(default_factory=Outcome)
    problem: Any = None
    after: Judged | None = None
    tightened: float = 0.0
    number: int = 0


def attempts(task: Task, setting: Setting, near: np.ndarray) -> Attempt:
    """Return the Attempt whose answer holds on validation plants, the last where none does."""
    coarse, limits, least = True, _searched_limits(setting, near), {}
    last: Any = None
    for number in range(ATTEMPTS):
        case = setting.coarse() if coarse else setting.searched
        attempt = Attempt(setting, number=number)
        try:
            task.stage = _words_of(setting, case)
            checks = _search(task, attempt, case, limits, least)
            if attempt.outcome.point is None:
                return dataclasses.replace(attempt, number=0)
            move_back(setting, attempt.problem, attempt.outcome)
            tuned = _at(setting, values_of(attempt.problem, attempt.outcome))
            task.enter(f"judging the answer on {task.samples} validation plants")
            attempt.after = judge(tuned, task.samples, task.plan.seed, round_=number)
        except KeyboardInterrupt:
            last = dataclasses.replace(attempt, number=0) if last is None else last
            last.outcome.interrupted = True
            return last
        last, cost, search = attempt, attempt.outcome.point.cost, attempt.outcome.search
        if coarse and case is not setting.searched and _misled(cost, attempt.after):
            coarse = False
        elif attempt.after.held.all():
            break
        elif task.may_filter and setting.filter is None and _levels_broken(attempt.after):
            filtered = setting.with_filter(matters(setting, attempt.after, NEAR))
            limits = dict(setting.case.limits) if filtered is setting else dict(filtered.limits)
            setting = filtered
        elif checks and search and search.violation(attempt.outcome.point) == 0:
            least = _tighter(attempt.after, checks)
        else:
            break
    return last


def _search(task, attempt, case, limits, least):
    """Search, and again on more plants until the limits hold on those that are looked at."""
    setting = attempt.setting

    def search(outcome, checks=None, stays=False):
        problem = attempt.problem = task.problem(setting, case, checks)
        # a start that holds the limits as they are may stay where they are tighter
        slack = checks.slack(problem) if checks and stays else None
        first, plan = problem.start(), task.plan
        plan = dataclasses.replace(plan, method=automatic(problem))
        run_stages(problem, first, plan, outcome, task.report(setting.cost_unit))
        if outcome.best is not None:
            outcome.z, outcome.kept = stay_put(outcome.search, first, plan.iterations, slack)
            outcome.slopes["answer"] = outcome.search.slope(outcome.point)

    if not limits:
        search(attempt.outcome)
        return None
    checks = Checks(setting, case, task.free, limits, least)
    checks.look(checks.problem.start())
    stays = not least and checks.hold(share=0.0)
    for _ in range(ROUNDS):
        outcome, attempt.tightened = Outcome(), checks.share
        attempt.outcome = outcome if attempt.outcome.point is None else attempt.outcome
        search(outcome, checks, stays)
        attempt.outcome = outcome
        if outcome.point is None:
            break
        checks.look(outcome.point.z)
        if checks.hold() or outcome.kept.all():
            break
    return checks


def _words_of(setting, case):
    """What a search is, in words."""
    guard = " with a safety filter" if setting.filter is not None else ""
    return f"search on {PLANTS} plants{guard}, step {case.clock.dt:g} s"


def _tighter(after, checks):
    """Return {key: least tightening} after limits were violated on validation plants."""
    found = dict(checks.tightening)
    for row in after.worst():
        key = row["limit"].measure, row["limit"].index
        if row["broken"] and key in found:
            found[key] += TIGHTER * min(-row["margin"], LARGEST * abs(row["limit"].value))
    return found


def _searched_limits(setting, near):
    """Return the limits of the search: those not proved, without levels that stay far below."""
    limits = dict(setting.limits)
    if not near.any():
        limits.pop("max_level", None)
    return limits


def _at(setting, values):
    """Return the setting with the searched case at `values`."""
    loop = with_values(setting.searched.loop, values)
    return setting.replace(searched=setting.searched.replace(loop=loop))


def values_of(problem, outcome):
    """Return {name: value} of the answer; exactly the first value of a gain that stays."""
    own, point = problem.own_values(), outcome.point
    if point is None:
        return own
    values = problem.values(point.z)
    if np.array_equal(point.z, problem.start()):
        values = dict(own)
    stays = np.zeros(len(own), dtype=bool) if outcome.idle is None else np.asarray(outcome.idle)
    stays = stays if outcome.kept is None else stays | outcome.kept
    values |= {n: own[n] for n, same in zip(own, stays) if same}
    acting = in_force(problem.loop, values)
    return {n: v if v == own[n] else acting[n] for n, v in values.items()}


def _misled(cost, after: Judged):
    """Return True if the cost at the true step is another than at the coarse one."""
    good = ~after.failed
    if not good.any():
        return True
    ratio = float(np.mean(after.cost[good])) / cost if cost > 0 else 1.0
    return not 1.0 / MISLED < ratio < MISLED


def _levels_broken(after):
    return any(r["broken"] and r["limit"].measure in LEVELS for r in after.worst())
