"""The default answer of `tune`: noise, many plants, priced inputs, a safety filter, a
validation.
"""

import dataclasses
import time
from collections.abc import Callable, Mapping
from typing import Any

import jax
import numpy as np

from jaxtank import measures as ms
from jaxtank.case import Case
from jaxtank.core.errors import InputError
from jaxtank.loop import run as lp
from tuning.answer.answer import Answer
from tuning.answer.attempts import Task, attempts, values_of
from tuning.answer.findings import findings_of
from tuning.answer.judged import FRESH, judge, matters
from tuning.answer.result import result_of
from tuning.answer.setting import NEAR, limited_levels, plants_of, setting_of
from tuning.cluster.ahead import check_sent
from tuning.cluster.engine import Engine
from tuning.feasible.study import apply_mend, can_judge, feasibility
from tuning.problem.functions import digests
from tuning.problem.problem import Problem
from tuning.problem.reported import Deferred, margin_measures, reported_names, run_measures
from tuning.problem.scenarios import noisy
from tuning.search import diagnostics
from tuning.search.result import TuningResult
from tuning.search.verdicts import lost_outputs
from tuning.storage.evaluation_log import EvaluationLog
from tuning.storage.fingerprint import fingerprint


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
    engine: Engine | None = None,
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
    task = Task(free, plan, validation, progress, engine)
    first = Problem(setting.searched, free, setting.objective, setting.case.limits, None, seed)
    first.start()
    _check_functions(setting, first.needed)
    check_sent(engine, first)
    if checkpoint is not None:
        what = _what(setting, free, plan, validation, safety_filter, first.needed)
        task.cache = EvaluationLog(checkpoint, what, resume)
    task.may_filter = safety_filter is not False
    before = judge(setting.replace(searched=_as_given(setting)), task.samples, seed)
    near = matters(setting, before, NEAR)
    if safety_filter or (safety_filter is None and near.any()):
        setting = setting.with_filter(near)
    made = attempts(task, setting, near)
    setting, found, problem = made.setting, made.found, made.problem
    if made.attempt:  # the plants that asked for another search do not judge it
        as_given = setting.replace(searched=_as_given(setting))
        before = judge(as_given, task.samples, seed, round_=made.attempt)
    values = values_of(problem, found)
    answer = _answer(made, before, values)
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


def _answer(made, before, values):
    """Return the Answer: what was judged, on which plants, and the case's own run."""
    setting, found, problem, after = made.setting, made.found, made.problem, made.after
    own = problem.own_values()
    sides = {"before": (setting.case, before), "after": (setting.tuned(values), after)}
    nominal = {side: _nominal(*both, problem.needed) for side, both in sides.items()}
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
        tightened=made.tightened,
        coarse_dt=problem.case.clock.dt,
        integrator=problem.case.clock.integrator,
        measures=nominal,
    )


def _lost(setting, problem, nominal, values):
    """Return the outputs of the case's own run that no longer follow their setpoints."""
    case = setting.tuned(problem.own_values())
    own = Problem(case, problem.given["free"], setting.objective, {}, ())
    return lost_outputs(own, {side: [table] for side, table in nominal.items()}, values)


def _nominal(case, judged, needed):
    """Return the measures of the case's own run, without noise unless it has some, and the
    stability margins of its linearised loop. What was not judged beside the plants is run when it
    is asked for.
    """
    margins = margin_measures(case.loop, case.clock)
    of_run = [m for m in needed if m not in ms.linear()]

    def make():
        key = jax.random.key(0) if noisy(case) else None
        return run_measures(case.loop, case.clock, key, of_run) | margins

    if judged is None or not judged.nominal:
        return make()
    names = (*reported_names(case.loop, of_run), *margins)
    return Deferred(names, judged.nominal | margins, make)


def _idle(setting, before, after):
    """Return the indices of the tanks that have a limit which no plant comes near."""
    limited = np.isfinite(limited_levels(setting.case))
    near = matters(setting, before, NEAR)
    if after is not None:
        near = near | matters(setting, after, NEAR)
    return np.flatnonzero(limited & ~near)


def _check_functions(setting, needed):
    """Raise InputError for a function of the user's that has no value at the starting values."""
    own, case = tuple(ms.functions(needed)), setting.searched
    key = jax.random.key(0) if noisy(case) else None
    values = lp.evaluate(case.loop, case.clock, own, key) if own else {}
    for name, value in values.items():
        if not np.isfinite(value):
            raise InputError(
                f"function {name}: its value at the starting values is {value}: must be a finite"
                f" number [{ms.unit(name, case.loop.units)}]"
            )


def _what(setting, free, plan, validation, safety_filter, needed):
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
        **digests(setting.searched.loop, setting.searched.clock, needed),
        **plan,
    )
