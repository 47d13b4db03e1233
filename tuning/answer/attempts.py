"""The searches behind a default answer: with a filter, at the true step, on more plants."""

import dataclasses
from typing import Any

import numpy as np

from jaxtank.case import Case
from jaxtank.core.tree import with_values
from tuning.answer.checks import LARGEST, Checks
from tuning.answer.judged import Judged, judge, matters
from tuning.answer.robustness import move_back
from tuning.answer.setting import NEAR, PLANTS, Setting
from tuning.answer.stay_put import Found, search_from
from tuning.problem.problem import Problem
from tuning.problem.reported import in_force
from tuning.problem.scenarios import groups_of, with_noise_drawn
from tuning.search.driver import event_of

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

    def __init__(self, free, plan, samples, progress, engine=None):
        self.free, self.plan, self.samples, self.engine = free, plan, samples, engine
        self.progress, self.may_filter = progress, True
        self.cache: Any = None
        self.stage = ""
        self.last: dict[str, Any] | None = None

    def problem(self, setting: Setting, case: Case, checks: Checks | None) -> Problem:
        """Return the problem of the search on the plants of a case, and on those of `checks`."""
        seed = self.plan["seed"]
        plants = setting.plants(case, PLANTS, seed)
        if checks is None:
            found = Problem(case, self.free, setting.objective, {}, plants, seed)
        else:
            every, limits = (*plants, *checks.scenarios()), checks.limits()
            found = Problem(case, self.free, setting.objective, limits, every, seed)
            found.runs[PLANTS:] = checks.runs(found.runs[-1].weight)
            found.groups = groups_of(found.runs)
        found.groups = [with_noise_drawn(group) for group in found.groups]
        if self.cache is not None:
            found.cache, self.cache = self.cache, None
        return found

    def report(self, unit):
        """Return what a Search calls after every evaluation; unit : of the cost, None: unknown."""

        def report(search):
            if self.progress is not None and search.history:
                self.last = event_of(search, self.plan["starts"], unit=unit, stage=self.stage)
                self.progress(self.last)

        return report

    def enter(self, stage):
        """Report what is done next, where no evaluation reports it; not before the first one."""
        self.stage = stage
        if self.progress is not None and self.last is not None:
            self.progress(self.last | {"stage": stage})


@dataclasses.dataclass
class Outcome:
    """What a search led to."""

    setting: Setting
    found: Found = dataclasses.field(default_factory=Found)
    problem: Any = None
    after: Judged | None = None
    tightened: float = 0.0
    attempt: int = 0


def attempts(task: Task, setting: Setting, near: np.ndarray) -> Outcome:
    """Return the Outcome of searches until the answer holds on validation plants, or nothing is
    left to try.
    """
    coarse, limits, least = True, _searched_limits(setting, near), {}
    last: Any = None
    for attempt in range(ATTEMPTS):
        case = setting.coarse() if coarse else setting.searched
        made = Outcome(setting, attempt=attempt)
        try:
            task.stage = _words_of(setting, case)
            checks = _search(task, made, case, limits, least)
            if made.found.point is None:
                return dataclasses.replace(made, attempt=0)
            move_back(setting, made.problem, made.found)
            tuned = _at(setting, values_of(made.problem, made.found))
            task.enter(f"judging the answer on {task.samples} validation plants")
            made.after = judge(tuned, task.samples, task.plan["seed"], round_=attempt)
        except KeyboardInterrupt:
            found = made.found if last is None else last.found
            found.interrupted = True
            return dataclasses.replace(made, attempt=0) if last is None else last
        last = made
        if coarse and case is not setting.searched and _misled(made.found.point.cost, made.after):
            coarse = False
        elif made.after.held.all():
            break
        elif task.may_filter and setting.filter is None and _levels_broken(made.after):
            filtered = setting.with_filter(matters(setting, made.after, NEAR))
            limits = dict(setting.case.limits) if filtered is setting else dict(filtered.limits)
            setting = filtered
        elif checks and _holds(made.found):
            least = _tighter(made.after, checks)
        else:
            break
    return last


def _search(task, made, case, limits, least):
    """Search, and again on more plants until the limits hold on those that are looked at."""
    setting = made.setting

    def search(found, checks=None, stays=False):
        problem = made.problem = task.problem(setting, case, checks)
        if (
            checks and stays
        ):  # a start that holds the limits as they are may stay where they are tighter
            found.slack = checks.slack(problem)
        report = task.report(setting.cost_unit)
        search_from(problem, task.plan, report, found, task.engine)

    if not limits:
        search(made.found)
        return None
    checks = Checks(setting, case, task.free, limits, least)
    checks.look(checks.problem.start())
    stays = not least and checks.hold(share=0.0)
    for _ in range(ROUNDS):
        found, made.tightened = Found(), checks.share
        made.found = found if made.found.point is None else made.found
        search(found, checks, stays)
        made.found = found
        if found.point is None:
            break
        checks.look(found.point.z)
        if checks.hold() or found.kept.all():
            break
    return checks


def _words_of(setting, case):
    """What a search is, in words."""
    guard = " with a safety filter" if setting.filter is not None else ""
    return f"search on {PLANTS} plants{guard}, step {case.clock.dt:g} s"


def _holds(found):
    return found.search.violation(found.point) == 0


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


def values_of(problem, found):
    """Return {name: value} of the answer; exactly the first value of a gain that stays."""
    own = problem.own_values()
    if found.point is None:
        return own
    values = problem.values(found.point.z)
    if np.array_equal(found.point.z, problem.start()):
        values = dict(own)
    if found.kept is not None:
        stays = found.kept if found.idle is None else found.kept | found.idle
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
