"""tune: the default answer, or the optimum of a stated problem."""

import math
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np

from jaxtank import measures as ms
from jaxtank.bounds import WIDE, gain_ranges, within_run
from jaxtank.case import Case, Free, check_case
from jaxtank.core.errors import InputError
from jaxtank.core.jsonable import fields
from jaxtank.core.tree import get_value, with_values
from jaxtank.limits import limited_levels, resolve_limits
from jaxtank.loop import run as lp
from jaxtank.loop.closed_loop import ClosedLoop
from tuning.cluster.ahead import check_sent
from tuning.cluster.engine import Engine, connect
from tuning.feasible.study import can_judge, feasibility
from tuning.problem.evaluator import Evaluator
from tuning.problem.functions import as_measures, digests
from tuning.problem.pairing import check_signs
from tuning.problem.problem import Problem
from tuning.problem.provenance import provenance
from tuning.problem.reported import (
    Deferred,
    margin_measures,
    reported_names,
    run_measures,
    table_of,
)
from tuning.problem.rules import RULES, refusal, rule_gains
from tuning.problem.scenarios import noisy, runs_of
from tuning.problem.slopes import check_slopes
from tuning.problem.status import Status
from tuning.problem.tracking import lost_runs
from tuning.search import diagnostics
from tuning.search.default import Attempt, Task, best_attempt, values_of
from tuning.search.driver import named_optimality
from tuning.search.judged import FRESH, Answer, Judged, judge, near_limits
from tuning.search.messages import messages_of
from tuning.search.methods import UNCONSTRAINED, automatic
from tuning.search.options import Options, check_precision, options_of
from tuning.search.result import Message, TuningResult, constraint_rows, row_of
from tuning.search.robustness import margins_at
from tuning.search.screening import LARGEST_STATE, state_size
from tuning.search.setting import Setting, setting_of
from tuning.search.solve import Plan, Solution, solve
from tuning.storage.evaluation_log import EvaluationCache, EvaluationLog
from tuning.storage.fingerprint import fingerprint
from tuning.storage.store import check_resume
from tuning.uncertainty.validation import summary_of, validate

TOLERANCE = 1e-4  # relative change of the cost at convergence: a mean of drawn plants [-]
AGREE = 0.01  # relative difference of two costs that agree: a mean of 32 plants [-]

DEFAULT = {"starts": 4, "screening": 32, "iterations": 40, "validation": FRESH}
NOMINAL = {"starts": 8, "screening": 64, "iterations": 60, "validation": 64}
"""Numbers of the default answer, and of the optimum of a stated problem."""


def tune(
    case: Case | Problem,
    method: str | Options = "auto",
    *,
    nominal: bool | None = None,
    free: Mapping[str, Any] | None = None,
    objective: Any = None,
    limits: Any = None,
    distributions: Mapping[str, Any] | None = None,
    safety_filter: bool | None = None,
    starts: int | None = None,
    seed: int = 0,
    checkpoint: str | Path | None = None,
    resume: bool = False,
    progress: Callable | None = None,
) -> TuningResult:
    """Return better values for the free parameters of a case, under its limits.

    The default answer is for an uncertain rig with sensor noise. It minimises the squared error
    plus a price on changes of the inputs per sample, except at a jump of a setpoint, as a mean over
    32 plants (sets of coefficients) drawn from the tolerances of the case. Where levels come near
    their limits, a safety filter keeps them below. Each parameter returns to its start, or moves
    towards it as far as possible, while all these changes together cost less than 1 %. The answer
    is judged on 256 validation plants at the step of the case (`result.answer`).

    With nominal=True: the optimum of the unchanged case, with its run or scenarios and its
    objective; no noise, plants or filter are added. Implied by a Problem, a method, and by
    `screening` and `tolerance` of Options.

    Converged: two searches ended within 1 % of each other (nominal: 0.1 %), or differential
    evolution found nothing better.

    Parameters
    ----------
    case : Case, or a Problem of one, which has free, objective, limits, scenarios and risk of its
        own (and its seed, unless another is given).
    method : "auto" (trf where the cost is a sum of squares and no limit is active, else slsqp),
        "slsqp", "trf", "coarse-trf" (trf at a tenth of the samples, then at all), "lbfgs", "adam",
        or Options (SQP, TRF, LBFGS, Adam) with the numbers of the search.
    nominal : True for the optimum of the unchanged case, False for the default answer, None for the
        default answer unless the optimum is implied.
    free : {name: (low, high) or Free}; the case's own where None.
    objective : {measure: weight}, or a custom function, (measures) or (measures, trajectory)
        -> number, alone or instead of a measure (`Objective` gives it a name and a unit);
        where None the case's own (of a preset, the default cost, unless nominal).
    limits : {measure: value}, {} for none, the case's own where None. A list of such and of
        `Constraint`, [case.limits, Constraint("name", function, upper=1.0)].
    distributions : {name: distribution or share}, the plants of the default answer; what the case
        calls uncertain where None; where that is nothing, 5 % of pump gains, splits, outlets,
        pipes, valves and sizes of shapes.
    safety_filter : of the default answer; None: where a level comes near its limit.
    starts : local searches at most, until two agree (4; 8 if nominal); as in Options.
    seed : of the Sobol points, the plants and the sensor noise.
    checkpoint : folder for the log of evaluations, with which a killed search is continued by
        resume=True, to the same bits.
    progress : called with a dict after every evaluation. Ctrl-C ends the search with the best
        point so far.

    Returns
    -------
    TuningResult

    Raises
    ------
    InputError : for anything that cannot be used, before anything is run.

    Examples
    --------
    >>> import jax, tuning
    >>> from jaxtank import presets
    >>> jax.config.update("jax_enable_x64", True)
    >>> result = tuning.tune(presets.find("gouta2015/backstepping"))  # doctest: +SKIP
    >>> result["controller.k1"].after, result.answer.held  # doctest: +SKIP
    """
    check_case(case.case if isinstance(case, Problem) else case, seed)
    options = options_of(method, starts=starts)
    check_resume(checkpoint, resume)
    reasons = {"a Problem": isinstance(case, Problem), "method": options.name != "auto"}
    reasons |= {n: getattr(options, n) is not None for n in ("screening", "tolerance")}
    implied = next((name for name, value in reasons.items() if value), None)
    if nominal is False and implied:
        raise InputError(f"{implied}: belongs to the nominal optimum (nominal=True, --nominal)")
    nominal = nominal or bool(implied)
    check_precision()
    if isinstance(case, Case):
        check_signs(case, free)
    stated = {"free": free, "objective": objective, "limits": limits}
    options = options.filled(**(NOMINAL if nominal else DEFAULT))
    with connect(options.cluster) as engine:
        keep = {"checkpoint": checkpoint, "resume": resume, "progress": progress}
        if not nominal:
            assert isinstance(case, Case)
            stated["objective"], stated["limits"] = as_measures(objective, limits)
            box = {"distributions": distributions, "safety_filter": safety_filter}
            return _default_answer(case, options, engine, seed=seed, **box, **stated, **keep)
        for name, value in (("distributions", distributions), ("safety_filter", safety_filter)):
            if value is not None:
                raise InputError(
                    f"{name}: belongs to the default answer, not to the nominal optimum"
                )
        return _optimum(_stated(case, seed, **stated), options, engine, **keep)


def _stated(case: Case | Problem, seed: int, **stated: Any) -> Problem:
    """Return the Problem of a case, or the Problem itself, under another seed if one is given."""
    if not isinstance(case, Problem):
        return Problem(case, seed=seed, **stated)
    for name, value in stated.items():
        if value is not None:
            raise InputError(f"{name}: the Problem has it already, leave it out of tune")
    return case.with_seed(seed) if seed else case


def _optimum(
    problem: Problem,
    options: Options,
    engine: Engine | None,
    checkpoint: str | Path | None,
    resume: bool,
    progress: Callable | None,
) -> TuningResult:
    """Return the optimum of a stated problem."""
    began, case = time.perf_counter(), problem.case
    key = jax.random.key(problem.seed) if noisy(case) else None
    lp.check(case.loop, case.clock, key)
    plan = Plan.of(options, _method(options, problem), problem.seed, engine=engine)
    first, start = problem.start(), problem.own_values()
    before = run_measures(case.loop, case.clock, key, problem.needed)
    _check_start(problem, before, first)
    check_sent(engine, problem)
    evaluator = Evaluator(problem)
    if checkpoint is not None:
        what = _what(problem, options.validation, "tune", vars(plan))
        evaluator.cache = EvaluationLog(checkpoint, what, resume)
    solution = solve(evaluator, first, plan, progress)
    values = values_of(problem, solution)
    tuned = case.replace(loop=with_values(case.loop, values))
    after = run_measures(tuned.loop, tuned.clock, key, problem.needed)
    tables = {"before": [before], "after": [after]}
    if problem.scenarios:
        tables = {"before": table_of(problem, start), "after": table_of(problem, values)}
    lost, symmetry = (), None
    if solution.best is not None and not solution.interrupted:
        lost = diagnostics.lost_outputs(problem.runs, tables, values, problem.objective)
        symmetry = diagnostics.symmetric(evaluator, solution.starts, values)
    multipliers = named_optimality(solution.search, solution.best)["multipliers"]
    rows = constraint_rows(problem, tables["after"], tables["before"], multipliers)
    measures = {"before": before, "after": after}
    fragile = diagnostics.points_to_fragile(case.loop, before, after)
    if fragile and state_size(case.loop, case.clock) <= LARGEST_STATE:
        for side, loop in (("before", case.loop), ("after", tuned.loop)):
            measures[side] = measures[side] | margin_measures(loop, case.clock)
    summary, cloud = None, None
    if options.validation and not solution.interrupted and _varies(problem):
        summary, cloud = validate(problem, start, values, options.validation, plan.seed)
    scenarios = problem.runs if problem.scenarios else ()
    objective = {side: problem.total(table) for side, table in tables.items()}
    steps = diagnostics.step_warnings(tuned, values, key, scenarios)
    result = _result(
        *(evaluator, solution, values, began, steps),
        case=case,
        tuned=tuned,
        method=plan.method,
        status=solution.status(all(row.margin >= 0 for row in rows), lost),
        objective=objective | {"terms": problem.objective},
        measures=measures,
        tables=tables,
        constraints=rows,
        symmetry=symmetry,
        validation=summary,
        cloud=cloud,
        lost=lost,
    )
    evaluator.cache.close()
    return result


def _varies(problem: Problem) -> bool:
    """Return True if a validation run can differ from the nominal one."""
    case, noisy_runs = problem.case, any(run.key is not None for run in problem.runs)
    return bool(case.uncertain or case.covariance) or noisy_runs


def _setting(case, objective, limits, distributions, safety_filter):
    """Return the Setting of a default answer, before a filter is taken for levels near a limit."""
    if safety_filter and not case.safety:
        case = case.without_safety_filter()
    setting = setting_of(case, objective, limits, distributions)
    return setting.without_filter() if safety_filter is False else setting


def _default_answer(
    case: Case,
    options: Options,
    engine: Engine | None,
    *,
    free: Mapping[str, Any] | None,
    objective: Any,
    limits: Any,
    distributions: Mapping[str, Any] | None,
    safety_filter: bool | None,
    seed: int,
    checkpoint: str | Path | None,
    resume: bool,
    progress: Callable | None,
) -> TuningResult:
    began, samples = time.perf_counter(), options.validation
    if not samples:
        raise InputError(
            "validation = 0: the default answer is judged on at least 1 plant (the nominal optimum"
            " needs none)"
        )
    setting = _setting(case, objective, limits, distributions, safety_filter)
    few = {"tolerance": TOLERANCE, "agree": AGREE, "lower_by": AGREE}
    plan = Plan.of(options, "auto", seed, engine=engine, polish=False, coarse=False, **few)
    may_widen = free is None and not case.free
    gains, reasons = _gains_of_rules(setting.case)
    free = _with_rule(case, free, gains.get(GENTLE, {}))
    stated = Problem(setting.searched, free, setting.objective, setting.case.limits, None, seed)
    stated.start()
    _check_functions(setting, stated.needed)
    check_sent(engine, stated)
    log = EvaluationCache()
    if checkpoint is not None:
        box = {n: repr(d) for n, d in setting.distributions.items()}
        more = {"distributions": box, "safety_filter": safety_filter, **vars(plan)}
        log = EvaluationLog(checkpoint, _what(stated, samples, "answer", more), resume)
    task = Task(
        *(free, plan, samples, progress, safety_filter is not False, tuple(gains.values()), log),
        may_widen=may_widen,
        may_remove_filter=safety_filter is None,
    )
    before = judge(_unfiltered(setting), samples, seed)
    near = near_limits(setting, before)
    if safety_filter or (safety_filter is None and near.any()):
        setting = setting.with_filter(near)
    attempt = best_attempt(task, setting, bool(near.any()), before)
    setting, solution = attempt.setting, attempt.solution
    if attempt.number:  # the plants that asked for another search do not judge it
        before = judge(_unfiltered(setting), samples, seed, round_=attempt.number)
    evaluator = attempt.evaluator or Evaluator(stated)  # Ctrl-C before the first search
    problem = evaluator.problem
    values = values_of(problem, solution)
    answer = _answer(attempt, problem, before, values)
    solution.least = True  # of the limits on plants that judged
    first = solution.search.point(problem.start()) if solution.search is not None else None
    known = setting, samples, seed, attempt.number, gains, reasons
    sides = {"before": first, "after": solution.point}
    steps = diagnostics.step_warnings(setting.tuned(values), values)
    result = _result(
        *(evaluator, solution, values, began, steps),
        method="default answer",
        status=solution.status(answer.held, answer.lost),
        tables={side: [] if p is None else list(p.measures) for side, p in sides.items()},
        rules=() if solution.interrupted else rule_rows(*known),
        **_judged_parts(answer, values),
    )
    log.close()
    return result


GENTLE = "lambda"
"""The slowest rule: from gains that are farther than WIDE from it, ranges that a case does not name
are about its gains too."""


def _with_rule(
    case: Case, free: Mapping[str, Any] | None, gains: Mapping[str, float]
) -> Mapping[str, Any] | None:
    """What is free; else the gains, about those of a rule too where one of these is outside."""
    if free is not None or case.free:
        return free
    ranges, about, outside = gain_ranges(case.loop), dict[str, Free](), False
    for name, (low, high, scale) in ranges.items():
        gain = gains.get(name, 0.0)
        if low * high > 0.0 and low * gain > 0.0:
            ends = sorted((gain / WIDE, gain * WIDE))
            about[name] = Free(min(low, ends[0]), max(high, ends[1]), scale)
            outside |= not low <= gain <= high
    ranges = ranges | about if outside else ranges
    for name, ends in ranges.items():
        longest = max(case.clock.duration, float(get_value(case.loop, name)))
        ranges[name] = within_run(case.loop, name, ends, longest)
    return ranges or None


def _gains_of_rules(case: Case) -> tuple[dict[str, dict[str, float]], dict[str, str]]:
    """({rule: gains}, {rule: why it has none}) of a case; of another controller, none of both."""
    gains, reasons = dict[str, dict[str, float]](), dict[str, str]()
    for rule in () if refusal(case) else RULES:
        try:
            gains[rule] = rule_gains(case, rule)
        except InputError as error:
            reasons[rule] = str(error)
    return gains, reasons


def rule_rows(
    setting: Setting,
    samples: int,
    seed: int,
    round_: int = 0,
    gains: Mapping[str, Mapping[str, float]] | None = None,
    reasons: Mapping[str, str] | None = None,
) -> tuple[dict[str, Any], ...]:
    """Return what each tuning rule gives on validation plants, () of another controller."""
    if gains is None or reasons is None:
        gains, reasons = _gains_of_rules(setting.case)
    rows: list[dict[str, Any]] = []
    for rule in () if refusal(setting.case) else RULES:
        why, judgement = reasons.get(rule, ""), None
        if rule in gains:
            try:
                judgement = judge(_with_gains(setting, gains[rule]), samples, seed, round_)
            except InputError as error:
                why = str(error)
        rows.append(
            rule_row(setting.case.loop, rule, gains.get(rule, {}), judgement) | {"why": why}
        )
    return tuple(rows)


def rule_row(
    loop: ClosedLoop, rule: str, gains: Mapping[str, float], judged: Judged | None
) -> dict[str, Any]:
    """Return a row of `TuningResult.rules`; judged : None where a rule has no gains."""
    means = {} if judged is None else judged.to_json()
    lost = None if judged is None else int(lost_runs(loop, judged.measures, judged.failed).sum())
    numbers = {name: means.get(name) for name in ("error", "objective", "travel_percent")}
    holds = None if judged is None else bool(judged.held.all())
    limits = {"holds": holds, "setpoints_lost": lost}
    return {"rule": rule, "parameters": gains, **limits, **numbers}


def _with_gains(setting: Setting, gains: Mapping[str, float]) -> Setting:
    loop = with_values(setting.searched.loop, gains)
    return setting.replace(searched=setting.searched.replace(loop=loop))


def tune_by_rule(
    case: Case,
    rule: str,
    *,
    objective: Any = None,
    limits: Any = None,
    distributions: Mapping[str, Any] | None = None,
    safety_filter: bool | None = None,
    validation: int = FRESH,
    seed: int = 0,
) -> TuningResult:
    """Return the gains of a tuning rule for a PI or PID controller, judged like an answer.

    Parameters
    ----------
    case : Case with a controller of kind p, pi, pid or split-range.
    rule : "simc", "lambda", "ziegler-nichols", "amigo" or "relay", from the plant linearised at
        the last setpoint (or a simulated relay experiment) with the dead time of its actuator.
    objective, limits, distributions, safety_filter, seed : as in `tune`.
    validation : plants that judge the gains.

    Returns
    -------
    TuningResult

    Raises
    ------
    InputError : for another controller or rule, and a plant for which the rule has no gains.

    Examples
    --------
    >>> import jax
    >>> from jaxtank import presets
    >>> jax.config.update("jax_enable_x64", True)
    >>> result = tune_by_rule(presets.find("cascaded/pi"), "simc", validation=8)
    >>> round(result["controller.Kc[0]"].after, 2)
    0.31
    """
    check_case(case, seed)
    began = time.perf_counter()
    check_precision()
    objective, limits = as_measures(objective, limits)
    setting = _setting(case, objective, limits, distributions, safety_filter)
    gains = rule_gains(case, rule)
    ranges = {n: Free(*_around(get_value(case.loop, n), gain)) for n, gain in gains.items()}
    stated = setting.searched, ranges, setting.objective, setting.case.limits
    evaluator = Evaluator(Problem(*stated, None, seed))
    before = judge(_unfiltered(setting), validation, seed)
    after = judge(_with_gains(setting, gains), validation, seed)
    near = near_limits(setting, after)
    if safety_filter or (safety_filter is None and near.any()):
        setting = setting.with_filter(near)
        after = judge(_with_gains(setting, gains), validation, seed)
    attempt = Attempt(setting, evaluator=evaluator, after=after)
    answer = _answer(attempt, evaluator.problem, before, gains)
    status = Status.CONVERGED if answer.held else Status.INFEASIBLE
    steps = diagnostics.step_warnings(setting.tuned(gains), gains)
    return _result(
        *(evaluator, attempt.solution, gains, began, steps),
        method=f"rule {rule}",
        status=Status.NOT_CONVERGED if answer.held and answer.lost else status,
        tables={"before": [], "after": []},
        **_judged_parts(answer, gains),
    )


def _around(*values: Any) -> tuple[float, float, str]:
    """A range, as of `Free`, that holds two gains of either sign."""
    sizes = [abs(float(v)) for v in values if float(v)]
    low, high = min(sizes) / WIDE, max(sizes) * WIDE
    signs = {math.copysign(1.0, float(v)) for v in values if float(v)}
    if len(signs) == 2:
        return -high, high, "linear"
    return (low, high, "log") if signs == {1.0} else (-high, -low, "log")


def _result(
    evaluator: Evaluator,
    solution: Solution,
    values: Mapping[str, float],
    began: float,
    steps: tuple[Message, ...],
    **parts: Any,
) -> TuningResult:
    """Return the TuningResult of a search; steps: problems with the step size of the answer."""
    if parts["status"] == Status.CONVERGED and any(message.headline for message in steps):
        parts["status"] = Status.NOT_CONVERGED
    result = TuningResult(
        parameters=_parameters(evaluator, solution, values),
        evaluations={
            **fields(evaluator, "simulations gradients non_finite"),
            "redone_at_true_step": solution.redone,
        },
        wall_s=0.0,
        history=solution.search.history if solution.search else [],
        **{n: getattr(solution, n) for n in ("starts", "curvature", "probe", "slopes")},
        optimality=named_optimality(solution.search, solution.point),
        provenance=provenance(parts["case"], evaluator.problem.seed),
        problem=evaluator.problem,
        messages=steps,
        **parts,
    )
    wall_s = time.perf_counter() - began
    return result.replace(messages=messages_of(result), wall_s=wall_s)


def _judged_parts(answer: Answer, values: Mapping[str, float]) -> dict[str, Any]:
    """Return the fields of a TuningResult that follow from an Answer."""
    setting, sides = answer.setting, {"before": answer.before, "after": answer.after}
    costs: dict[str, Any] = {side: _mean(plants) for side, plants in sides.items()}
    summary, cloud = _validation(answer)
    return dict(
        case=setting.case,
        tuned=setting.tuned(values),
        objective=costs | {"terms": dict(setting.objective)},
        measures=dict(answer.measures),
        constraints=_rows(answer),
        symmetry=None,
        validation=summary,
        cloud=cloud,
        lost=answer.lost,
        answer=answer,
    )


def _what(problem, validation, command, more):
    """Return the fingerprint of a search."""
    return fingerprint(
        problem.case,
        command=command,
        free=problem.bounds,
        **{name: getattr(problem, name) for name in ("objective", "limits", "risk")},
        scenarios=[(s.name, sorted(s.values.items()), s.seed, s.weight) for s in problem.scenarios],
        validation=validation,
        **digests(problem.loop, problem.clock, problem.needed),
        **{n: v for n, v in more.items() if n != "engine"},
    )


def _parameters(evaluator, solution, values):
    """Return {name: values before and after, range, sensitivity} of the parameters."""
    problem, point, change = evaluator.problem, solution.point, solution.change
    start = problem.own_values()
    if point is None or solution.interrupted:
        change = [None] * len(start)
    elif change is None:
        costs, _ = evaluator.screen(diagnostics.neighbours(problem, point.z))
        change = diagnostics.sensitivities(costs)
    idle = np.zeros(len(start), dtype=bool) if solution.idle is None else solution.idle
    return {
        b.name: {
            "before": start[b.name],
            "after": values[b.name],
            **fields(b, "unit lower=low upper=high"),
            "at_bound": b.end_at(values[b.name]),
            "sensitivity_percent": percent,
            "exercised": not still,
        }
        for b, percent, still in zip(problem.bounds, change, idle.tolist())
    }


def _check_start(problem, before, first):
    """Raise InputError for an objective, and functions of the user's, without value or slope."""
    functions = ms.functions(problem.needed)
    for measure in (*problem.objective, *functions):
        if measure not in before or not np.all(np.isfinite(before[measure])):
            raise InputError(
                f"{'objective' if measure in problem.objective else 'constraint'} {measure} is not"
                " a number at the starting values (it cannot be measured on this run), so it cannot"
                " be tuned"
            )
    if functions:  # before anything is written
        check_slopes(problem, problem.point(first))


def _check_functions(setting, needed):
    """Raise InputError for a function of the user's that has no value at the starting values."""
    functions, case = tuple(ms.functions(needed)), setting.searched
    key = jax.random.key(0) if noisy(case) else None
    values = lp.evaluate(case.loop, case.clock, functions, key) if functions else {}
    for name, value in values.items():
        if not np.isfinite(value):
            raise InputError(
                f"function {name}: its value at the starting values is {value}: must be a finite"
                f" number [{ms.unit(name, case.loop.units)}]"
            )


def _method(options, problem):
    """Return the method to use. Raises InputError for one that does not apply."""
    method = options.name
    if method == "auto":
        return automatic(problem)
    if method in UNCONSTRAINED and problem.limits:
        raise InputError(
            f"method {method} cannot hold limits: use slsqp (or auto), or drop them with --limit"
            " none"
        )
    if method in UNCONSTRAINED and not problem.model:
        raise InputError(
            f"method {method} needs rms_error_total or a mean of squares"
            f" ({', '.join(ms.squares())}) in the objective: use slsqp"
        )
    return method


def _unfiltered(setting: Setting) -> Setting:
    """Return the setting without a filter, unless the case as given has one."""
    if setting.case.loop.safety_filter is not None:
        return setting
    return setting.replace(searched=setting.searched.without_safety_filter())


def _answer(
    attempt: Attempt, problem: Problem, before: Judged, values: Mapping[str, float]
) -> Answer:
    """Return the Answer: the judged cases, the validation plants, and the run of the case."""
    setting, solution, after = attempt.setting, attempt.solution, attempt.after
    start, case = problem.own_values(), setting.case
    sides = {"before": (case, before), "after": (setting.tuned(values), after)}
    gains = {"before": start, "after": values}
    nominal = {
        side: _nominal(tuned, plants, problem.needed, margins_at(setting, solution, gains[side]))
        for side, (tuned, plants) in sides.items()
    }
    runs = runs_of(setting.tuned(start), (), 0)
    validated = [plants for plants in (before, after) if plants is not None]
    near = np.any([near_limits(setting, plants) for plants in validated], axis=0)
    levels = limited_levels(case)
    fixed = np.zeros(len(start), dtype=bool) if solution.kept is None else solution.kept
    feasible = None  # it is not known
    if can_judge(case):
        feasible = feasibility(case, setting.distributions, limits=case.limits)
    return Answer(
        setting=setting,
        before=before,
        after=after,
        nominal={side: float(m["rms_error_total"]) for side, m in nominal.items()},
        kept=dict(zip(start, np.asarray(fixed).tolist())),
        least_cost_peaks=solution.least_cost_peaks,
        filter_offsets=attempt.filter_offsets,
        filter_lost=attempt.filter_lost,
        agreed=solution.confirmed,
        lost=diagnostics.lost_outputs(
            runs, {side: [m] for side, m in nominal.items()}, values, setting.objective
        ),
        idle=tuple(int(i) + 1 for i in np.flatnonzero(np.isfinite(levels) & ~near)),
        tightened=attempt.tightened,
        coarse_dt=problem.clock.dt,
        integrator=problem.clock.integrator,
        measures=nominal,
        feasibility=feasible,
    )


def _nominal(case, plants, needed, margins):
    """Return the measures and margins of the case's own run; run now if not judged already."""
    of_run = [m for m in needed if m not in ms.linear()]

    def make():
        key = jax.random.key(0) if noisy(case) else None
        return run_measures(case.loop, case.clock, key, of_run) | margins

    if plants is None or not plants.nominal:
        return make()
    return Deferred((*reported_names(case.loop, of_run), *margins), plants.nominal | margins, make)


def _mean(plants: Judged | None) -> float:
    """Return the mean cost of the plants whose run is finite; NaN where there is none."""
    if plants is None or plants.failed.all():
        return float("nan")
    return float(np.mean(plants.cost[~plants.failed]))


def _rows(answer):
    """Return a ConstraintRow for each limit: its worst value on the plants that judged."""
    if answer.after is None:
        return []
    loop, scenario = answer.setting.case.loop, f"the worst of {answer.after.samples} plants"
    return [
        row_of(row["limit"], loop, row["value"], before=old["value"], scenario=scenario)
        for row, old in zip(answer.after.worst(), answer.before.worst())
    ]


def _validation(answer):
    """Return (summary, cloud) of the plants that judged, as `validation.summary_of`."""
    if answer.after is None:
        return None, None
    sides, setting = (answer.before, answer.after), answer.setting
    cost, holds, level = (
        np.stack([getattr(s, n) for s in sides], axis=1) for n in ("cost", "held", "level")
    )
    failed = sides[0].failed | sides[1].failed
    spread = {n: getattr(d, "relative", None) for n, d in setting.distributions.items()}
    astray = np.stack([lost_runs(setting.case.loop, s.measures, s.failed) for s in sides], axis=1)
    limits = resolve_limits(setting.case)
    return summary_of(limits, cost, holds, level, failed, spread, True, astray)
