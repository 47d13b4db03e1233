"""The default answer of `tune`: noise, many plants, priced inputs, a safety filter, a validation.

Imported by `default`.
"""

import dataclasses
import time
from collections.abc import Callable, Mapping
from typing import Any

import jax
import numpy as np

from jaxtank import measures as ms
from jaxtank.case import Case
from jaxtank.core.tree import with_values
from tuning.answer.answer import Answer
from tuning.answer.findings import findings_of
from tuning.answer.judged import FRESH, Judged, judge, matters
from tuning.answer.result import result_of
from tuning.answer.setting import NEAR, PLANTS, Setting, limited_levels, plants_of, setting_of
from tuning.answer.stay_put import Found, search_from
from tuning.feasible.study import apply_mend, can_judge, feasibility
from tuning.problem.problem import Problem
from tuning.problem.reported import margin_measures, run_measures
from tuning.problem.scenarios import noisy, with_noise_drawn
from tuning.search import diagnostics
from tuning.search.result import TuningResult
from tuning.search.verdicts import lost_outputs
from tuning.storage.evaluation_log import EvaluationLog
from tuning.storage.fingerprint import fingerprint

ATTEMPTS = 4
"""Searches at most: with a filter, at the true step, with tightened limits."""

MISLED = 1.5
"""Ratio of the costs at the true and at the coarse step above which the coarse one misleads [-]."""

TIGHTER = 1.2
"""Factor on the largest violation by which limits are tightened for the next search [-]."""


LEVELS = ("max_level", "overflow_volume")
"""Measures that a safety filter on levels keeps within their limits."""


class _Task:
    """What was asked for, and what stays the same from one search to the next."""

    def __init__(self, free, plan, samples, progress):
        self.free, self.plan, self.samples = free, plan, samples
        self.progress, self.may_filter = progress, True
        self.cache: Any = None

    def problem(self, setting: Setting, case: Case, limits: Mapping[str, Any]) -> Problem:
        """Return the problem of the search on the plants of a case."""
        seed = self.plan["seed"]
        plants = setting.plants(case, PLANTS, seed)
        found = Problem(case, self.free, setting.objective, limits, plants, seed)
        found.groups = [with_noise_drawn(group) for group in found.groups]
        if self.cache is not None:
            found.cache, self.cache = self.cache, None
        return found

    def report(self, problem, unit):
        """Return what a Search calls after every evaluation; unit : of the cost, None: unknown."""

        def report(search):
            if self.progress is None or not search.history:
                return
            best, last = search.best, search.history[-1]
            self.progress(
                {
                    "unit": unit,
                    "start": search.start,
                    "starts": self.plan["starts"],
                    "evaluations": len(search.history),
                    "cost": last[1],
                    "violation": last[2],
                    "best": None if best is None else best.cost,
                    "best_violation": None if best is None else search.violation(best),
                    "values": None if best is None else problem.values(best.z),
                }
            )

        return report


def recommend(
    case: Case,
    *,
    free: Mapping[str, Any] | None = None,
    objective: Mapping[str, float] | None = None,
    limits: Mapping[str, Any] | None = None,
    distributions: Mapping[str, Any] | None = None,
    safety_filter: bool | None = None,
    mend: str | None = None,
    starts: int = 4,
    iterations: int = 40,
    seed: int = 0,
    validation: int = FRESH,
    checkpoint: Any = None,
    resume: bool = False,
    progress: Callable | None = None,
) -> TuningResult:
    """Return the default answer; parameters and errors as `tuning.tune`."""
    began = time.perf_counter()
    case, mended = _mended(case, mend, distributions, limits, seed)
    if safety_filter and not case.safety:  # asked for here: the case as given has none
        case = case.without_safety_filter()
    setting = setting_of(case, objective, limits, distributions)
    if safety_filter is False:
        setting = setting.without_filter()
    plan = {"starts": starts, "iterations": iterations, "seed": seed}
    task = _Task(free, plan, validation, progress)
    Problem(setting.searched, free, setting.objective, setting.case.limits, None, seed).start()
    if checkpoint is not None:
        what = _what(setting, free, plan, validation, safety_filter)
        task.cache = EvaluationLog(checkpoint, what, resume)
    task.may_filter = safety_filter is not False
    before = judge(setting.replace(searched=_as_given(setting)), task.samples, seed)
    near = matters(setting, before, NEAR)
    if safety_filter or (safety_filter is None and near.any()):
        setting = setting.with_filter(near)
    setting, found, problem, after, tightened, attempt = _attempts(task, setting, near)
    if attempt:  # the plants that asked for another search do not judge it
        as_given = setting.replace(searched=_as_given(setting))
        before = judge(as_given, task.samples, seed, round_=attempt)
    values = _values(problem, found)
    answer = _answer(setting, before, after, found, problem, values, tightened)
    answer = dataclasses.replace(answer, feasibility=_feasibility(setting), mended=mended)
    result = result_of(answer, found, problem, values, validation)
    steps = diagnostics.step_warnings(_own(problem), result.tuned, values)
    messages = findings_of(result, steps)
    problem.cache = problem.cache.in_memory()
    return result.replace(messages=messages, wall_s=time.perf_counter() - began)


def _mended(case, kind, distributions, limits, seed):
    """Return the case with the smallest change of one kind, and that Mend; None where none is
    asked for.
    """
    if kind is None:
        return case, None
    return apply_mend(case, kind, distributions or plants_of(case), seed=seed, limits=limits)


def _feasibility(setting):
    """Return what no gain can mend; None where levels have no limits, or that is not known."""
    case = setting.case
    if not np.isfinite(limited_levels(case)).any() or not can_judge(case):
        return None
    return feasibility(case, setting.distributions, limits=case.limits)


def _as_given(setting):
    """Return the searched case without a filter, unless the case as given has one."""
    if setting.case.loop.safety_filter is not None:
        return setting.searched
    return setting.searched.without_safety_filter()


def _own(problem):
    """Return a Problem whose only run is the case's own: what step warnings are of."""
    return Problem(problem.case, problem.given["free"], problem.objective, {}, ())


def _attempts(task, setting, near):
    """Search until the answer holds on validation plants, or nothing is left to try.

    Returns the setting, the Found and the Problem of the last search, its Judged (None where the
    search was interrupted), the share by which limits were tightened, and its number, from 0: every
    search is judged on plants of its own.
    """
    coarse, tightened, limits = True, 0.0, _searched_limits(setting, near)
    last = None
    for attempt in range(ATTEMPTS):
        case = setting.coarse() if coarse else setting.searched
        problem, found = task.problem(setting, case, _tightened(limits, tightened)), Found()
        try:
            search_from(problem, task.plan, task.report(problem, setting.cost_unit), found)
            if found.point is None:
                return setting, found, problem, None, tightened, 0
            tuned = _at(setting, _values(problem, found))
            after = judge(tuned, task.samples, task.plan["seed"], round_=attempt)
        except KeyboardInterrupt:
            if last is None:
                found.interrupted = True
                return setting, found, problem, None, tightened, 0
            last[1].interrupted = True
            return last
        last = (setting, found, problem, after, tightened, attempt)
        if coarse and case is not setting.searched and _misled(found.point.cost, after):
            coarse = False
        elif after.held.all():
            break
        elif task.may_filter and setting.filter is None and _levels_broken(after):
            filtered = setting.with_filter(matters(setting, after, NEAR))
            limits = dict(setting.case.limits) if filtered is setting else dict(filtered.limits)
            setting = filtered
        elif limits and found.search and found.search.violation(found.point) == 0:
            tightened = TIGHTER * _violation(after, setting) + tightened
        else:
            break
    return last


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


def _values(problem, found):
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
    return values


def _misled(cost, after: Judged):
    """Return True if the cost at the true step is another than at the coarse one."""
    good = ~after.failed
    if not good.any():
        return True
    ratio = float(np.mean(after.cost[good])) / cost if cost > 0 else 1.0
    return not 1.0 / MISLED < ratio < MISLED


def _levels_broken(after):
    return any(r["broken"] and r["limit"].measure in LEVELS for r in after.worst())


def _violation(after, setting):
    """Return the largest violation on the validation plants, as a share of its limit [-]."""
    rows = [r for r in after.worst() if r["margin"] < 0 and abs(r["limit"].value) > 0]
    shares = [-r["margin"] / abs(r["limit"].value) for r in rows]
    return min(max(shares, default=0.0), 0.5)


def _tightened(limits, share):
    """Return `limits` tightened by a share of each; "rim" stays where it is."""
    if not share:
        return limits
    found = {}
    for measure, value in limits.items():
        if isinstance(value, str):
            found[measure] = value
            continue
        numbers = np.asarray(value, dtype=float)
        found[measure] = (numbers - share * ms.MEASURES[measure].sense * np.abs(numbers)).tolist()
    return found


def _answer(setting, before, after, found, problem, values, tightened):
    """Return the Answer: what was judged, on which plants, and the case's own run."""
    own = problem.own_values()
    sides = {"before": setting.case, "after": setting.tuned(values)}
    nominal = {side: _nominal(case) for side, case in sides.items()}
    errors = {side: float(m["rms_error_total"]) for side, m in nominal.items()}
    stays = {n: bool(k) for n, k in zip(own, found.kept)} if found.kept is not None else {}
    return Answer(
        setting=setting,
        before=before,
        after=after,
        nominal=errors,
        kept=stays or dict.fromkeys(own, False),
        agreed=found.agreed,
        lost=_lost(setting, problem, nominal, values),
        idle=tuple(int(i) + 1 for i in _idle(setting, before, after)),
        tightened=tightened,
        coarse_dt=problem.case.clock.dt,
        measures=nominal,
    )


def _lost(setting, problem, nominal, values):
    """Return the outputs of the case's own run that no longer follow their setpoints."""
    case = setting.tuned(problem.own_values())
    own = Problem(case, problem.given["free"], setting.objective, {}, ())
    return lost_outputs(own, {side: [table] for side, table in nominal.items()}, values)


def _nominal(case):
    """Return the measures of the case's own run, without noise unless it has some, and the
    stability margins of its linearised loop.
    """
    key = jax.random.key(0) if noisy(case) else None
    return run_measures(case.loop, case.clock, key) | margin_measures(case.loop, case.clock)


def _idle(setting, before, after):
    """Return the indices of the tanks that have a limit which no plant comes near."""
    limited = np.isfinite(limited_levels(setting.case))
    near = matters(setting, before, NEAR)
    if after is not None:
        near = near | matters(setting, after, NEAR)
    return np.flatnonzero(limited & ~near)


def _what(setting, free, plan, validation, safety_filter):
    """Return the fingerprint of a search."""
    return fingerprint(
        setting.searched,
        command="tune, default",
        free=free or {n: tuple(f) for n, f in setting.case.free.items()},
        objective=setting.objective,
        limits=dict(setting.case.limits),
        distributions={n: repr(d) for n, d in setting.distributions.items()},
        safety_filter=safety_filter,
        validation=validation,
        **plan,
    )
