"""tune: the default answer, or the optimum of a problem as it is stated."""

import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from jaxtank import measures as ms
from jaxtank.case import Case, Scenario
from jaxtank.core.errors import InputError
from jaxtank.core.tree import with_values
from jaxtank.loop import run as lp
from jaxtank.loop.closed_loop import initial
from tuning.cluster.ahead import check_sent
from tuning.cluster.engine import connect
from tuning.feasible.study import apply_mend, can_judge, feasibility
from tuning.problem.functions import as_measures, digests
from tuning.problem.problem import Problem
from tuning.problem.provenance import provenance
from tuning.problem.reported import (
    Deferred,
    margin_measures,
    reported_names,
    run_measures,
    table_of,
)
from tuning.problem.scenarios import noisy
from tuning.problem.slopes import check_slopes
from tuning.search import diagnostics
from tuning.search.attempts import Task, attempts, values_of
from tuning.search.diagnostics import lost_outputs, points_to_fragile
from tuning.search.discrete import tune_choices
from tuning.search.driver import named_optimality
from tuning.search.judged import FRESH, Answer, Judged, judge, matters
from tuning.search.messages import messages_of
from tuning.search.methods import OFFERED, UNCONSTRAINED, automatic
from tuning.search.options import Solver, check_options, check_precision, spelled_out
from tuning.search.result import ConstraintRow, TuningResult, constraint_rows, row_of
from tuning.search.screening import LARGEST_STATE
from tuning.search.setting import NEAR, limited_levels, plants_of, setting_of
from tuning.search.stages import Outcome, Plan, solve, status_of
from tuning.storage.evaluation_log import EvaluationLog
from tuning.storage.fingerprint import fingerprint
from tuning.uncertainty.validation import summary_of, validate

SCREENED = 32  # Sobol points of the search of a default answer

TOLERANCE = 1e-4
"""Change of the cost, as a share of its first value, at which a search has converged [-]."""

AGREE = 0.01
"""Two searches whose costs differ by less than this share agree [-]: the mean of 32 plants is known
to a few percent."""

DEFAULT = {"starts": 4, "screening": SCREENED, "iterations": 40, "validation": FRESH}
NOMINAL = {"starts": 8, "screening": 64, "iterations": 60, "validation": 64}
"""Numbers of the default answer, and of the optimum of a problem as it is stated."""


def tune(
    case: Case | Problem,
    method: str | Solver = "auto",
    *,
    nominal: bool | None = None,
    free: Mapping[str, Any] | None = None,
    objective: Any = None,
    limits: Any = None,
    distributions: Mapping[str, Any] | None = None,
    safety_filter: bool | None = None,
    mend: str | None = None,
    scenarios: Sequence[Scenario] | None = None,
    risk: str = "mean",
    choices: Mapping[str, Sequence] | None = None,
    starts: int | None = None,
    seed: int = 0,
    screening: int | None = None,
    iterations: int | None = None,
    batch: int | None = None,
    validation: int | None = None,
    tolerance: float | None = None,
    checkpoint: str | Path | None = None,
    resume: bool = False,
    progress: Callable | None = None,
    cluster: Any = None,
) -> TuningResult:
    """Return better values for the free parameters of a case, under its limits.

    By default, values for a rig that is not exactly known: the mean over 32 plants (sets of
    coefficients) drawn from what the case calls uncertain, with sensor noise, of the squared error
    plus a price on changes of the inputs per sample. A safety filter keeps levels below their
    limits where they come near them. Each parameter goes back to its start, or as near to it as
    that allows, if all these changes together cost less than 1 %. The answer is judged on 256
    validation plants at the case's own step (`result.answer`).

    With nominal=True the optimum of the case as it is: its own run or scenarios alone, its own
    objective, without adding noise, plants or a filter. Implied by a Problem, a method, scenarios,
    risk, choices, batch, screening or tolerance.

    Converged: two searches ended within 1 % of each other (nominal: 0.1 %), or differential
    evolution found nothing better.

    Parameters
    ----------
    case : Case, or a Problem of one, which has free, objective, limits, scenarios and risk of its
        own (and its seed, unless another is given).
    method : solver options (SQP, TRF, LBFGS, Adam), or "auto" (trf where the cost is a sum of
        squares and no limit is active, else slsqp), "slsqp", "trf", "coarse-trf" (trf at a tenth
        of the samples, then at all), "lbfgs" or "adam".
    nominal : True for the optimum of the case as it is, False for the default answer, None for the
        default answer unless method, scenarios, risk, choices, batch, screening or tolerance are
        given.
    free : {name: (low, high) or Free}; the case's own where None.
    objective : {measure: weight}, or a custom function, (measures) or (measures, trajectory)
        -> number, alone or in the place of a measure (`Objective` gives it a name and a unit);
        where None the case's own (of a preset, the default cost, unless nominal).
    limits : {measure: value}, {} for none, the case's own where None. A list of such and of
        `Constraint`, [case.limits, Constraint("name", function, upper=1.0)].
    distributions : {name: distribution or share}, the plants of the default answer; what the case
        calls uncertain where None, 5 % of every flow where that is nothing.
    safety_filter : of the default answer; None: where a level comes near its limit.
    mend : "setpoints", "rims", "orifices", "pumps" or "ramps": make the smallest such change that
        lets 95 % of the plants hold the setpoints (of ramps: the nominal run keep its limits), then
        tune.
    scenarios : tuple of Scenario, () for the case's own run alone.
    risk : "mean", "cvar" (the mean of the worst 5 %) or "worst" of the costs of the scenarios.
    choices : {static name: [values]}, each combination of which is tuned, the best taken;
        {"controller.kind": ["pid", "lqi"]} tunes each of these controllers with gains and ranges of
        its own.
    starts : local searches at most, until two agree (4; 8 if nominal).
    seed : of the Sobol points, the plants and the sensor noise.
    screening : number of Sobol points (64); nominal only.
    iterations : of each local search (60; 40 of the default answer).
    batch : scenarios drawn for each step of adam, None for all.
    validation : validation plants (256; nominal: 64, 0 for none).
    tolerance : change of the objective, as a share of its first value, below which a search under
        limits has converged; None for 1e-8 and a last search to 1e-12; nominal only.
    checkpoint : folder for the log of evaluations, with which a killed search is continued by
        resume=True, to the same bits.
    progress : called with a dict after every evaluation. Ctrl-C ends the search with the best
        point so far.
    cluster : Dask cluster on which the local searches run side by side, to the same answer:
        "HOST:PORT" of its scheduler, "local:N" for N workers on this machine, or a
        `distributed.Client`.

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
    objective, limits = as_measures(objective, limits)
    stated: dict[str, Any] = dict(free=free, objective=objective, limits=limits, seed=seed)
    more = {"scenarios": scenarios, "choices": choices, "batch": batch, "tolerance": tolerance}
    asked = [n for n, v in {**more, "screening": screening}.items() if v is not None]
    asked += ["risk"] * (risk != "mean") + ["method"] * (method != "auto")
    if nominal is False and (asked or isinstance(case, Problem)):
        what = asked[0] if asked else "a Problem"
        raise InputError(f"{what}: belongs to the nominal optimum (nominal=True, --nominal)")
    nominal = nominal or bool(asked) or isinstance(case, Problem)
    numbers = {"starts": starts, "screening": screening, "iterations": iterations}
    numbers["validation"] = validation
    usual = NOMINAL if nominal else DEFAULT
    filled = {n: usual[n] if v is None else v for n, v in numbers.items()}
    options: dict[str, Any] = {**stated, **filled}
    options["progress"] = progress
    keep: dict[str, Any] = dict(checkpoint=checkpoint, resume=resume)
    own = {"distributions": distributions, "safety_filter": safety_filter, "mend": mend}
    check_precision()
    if not nominal:
        assert isinstance(case, Case)
        with connect(cluster) as engine:
            return _recommend(case, engine, **own, **keep, **options)
    for name, value in own.items():
        if value is not None:
            raise InputError(f"{name}: belongs to the default answer, not to the nominal optimum")
    options |= {"scenarios": scenarios, "risk": risk, "batch": batch, "tolerance": tolerance}
    if isinstance(case, Problem) or isinstance(method, Solver):
        case, method, options = spelled_out(case, method, options)
    with connect(cluster) as engine:
        if choices:
            return tune_choices(_optimum, case, method, choices, engine=engine, **keep, **options)
        return _optimum(case, method, engine=engine, **keep, **options)


def _optimum(case, method, *, engine, checkpoint, resume, validation, progress, **options):
    """Return the optimum of a problem as it is stated."""
    began = time.perf_counter()
    numbers = ("starts", "screening", "iterations", "batch", "tolerance")
    check_options(validation=validation, **{n: options[n] for n in numbers})
    stated = ("free", "objective", "limits", "scenarios", "seed", "risk")
    problem = Problem(case, **{n: options[n] for n in stated})
    key = jax.random.key(options["seed"]) if noisy(case) else None
    lp.check(case.loop, case.clock, key)
    plan = Plan(
        method=_method(method, problem, options["batch"]),
        seed=options["seed"],
        engine=engine,
        **{n: options[n] for n in numbers},
    )
    first = problem.start()
    # a start that is not finite is an input error, reported by evaluate
    before = run_measures(case.loop, case.clock, key, problem.needed)
    _check_start(problem, before, first)
    check_sent(engine, problem)
    if checkpoint is not None:
        what = _what(problem, validation, "tune", vars(plan))
        problem.cache = EvaluationLog(checkpoint, what, resume)
    outcome = solve(problem, first, plan, progress)
    values = values_of(problem, outcome)
    tuned = case.replace(loop=with_values(case.loop, values))
    after = run_measures(tuned.loop, tuned.clock, key, problem.needed)
    tables = {"before": [before], "after": [after]}
    if problem.scenarios:
        own = problem.own_values()
        tables = {"before": table_of(problem, own), "after": table_of(problem, values)}
    complete = outcome.best is not None and not outcome.interrupted
    lost = lost_outputs(problem, tables, values) if complete else ()
    multipliers = named_optimality(outcome.search, outcome.best)["multipliers"]
    rows = constraint_rows(problem, tables["after"], tables["before"], multipliers)
    sides = {"before": (case, before), "after": (tuned, after)}
    if points_to_fragile(case.loop, before, after):
        sides = {n: (side, m | _margins(side.loop, side.clock)) for n, (side, m) in sides.items()}
    summary, cloud = None, None
    if validation and not outcome.interrupted and _varies(problem):
        summary, cloud = validate(problem, problem.own_values(), values, validation, plan.seed)
    result = _result(
        problem,
        outcome,
        values,
        case=case,
        tuned=tuned,
        method=plan.method,
        status=status_of(outcome, all(row.margin >= 0 for row in rows), lost),
        objective={side: problem.total(table) for side, table in tables.items()}
        | {"terms": problem.objective},
        measures={side: measures for side, (_, measures) in sides.items()},
        tables=tables,
        constraints=rows,
        symmetry=diagnostics.symmetric(problem, outcome.starts, values) if complete else None,
        validation=summary,
        cloud=cloud,
        lost=lost,
    )
    return _with_messages(result, diagnostics.step_warnings(problem, tuned, values, key), began)


def _recommend(
    case,
    engine,
    *,
    free,
    objective,
    limits,
    distributions,
    safety_filter,
    mend,
    starts,
    screening,
    iterations,
    seed,
    validation,
    checkpoint,
    resume,
    progress,
):
    """Return the default answer."""
    began = time.perf_counter()
    check_options(starts=starts, iterations=iterations, validation=validation)
    if validation == 0:
        raise InputError(
            "validation = 0: the default answer is judged on at least 1 plant (the nominal optimum"
            " needs none)"
        )
    mended = None
    if mend is not None:
        box = distributions or plants_of(case)
        case, mended = apply_mend(case, mend, box, seed=seed, limits=limits)
    if safety_filter and not case.safety:  # asked for here: the case as given has none
        case = case.without_safety_filter()
    setting = setting_of(case, objective, limits, distributions)
    if safety_filter is False:
        setting = setting.without_filter()
    plan = Plan(
        method="auto",
        starts=starts,
        screening=screening,
        iterations=iterations,
        seed=seed,
        tolerance=TOLERANCE,
        engine=engine,
        polish=False,
        coarse=False,
        agree=AGREE,
        lower_by=AGREE,
    )
    task = Task(free, plan, validation, progress)
    stated = Problem(setting.searched, free, setting.objective, setting.case.limits, None, seed)
    stated.start()
    _check_functions(setting, stated.needed)
    check_sent(engine, stated)
    if checkpoint is not None:
        box = {n: repr(d) for n, d in setting.distributions.items()}
        more = {"distributions": box, "safety_filter": safety_filter, **vars(plan)}
        task.cache = EvaluationLog(checkpoint, _what(stated, validation, "answer", more), resume)
    task.may_filter = safety_filter is not False
    before = judge(setting.replace(searched=_as_given(setting)), validation, seed)
    near = matters(setting, before, NEAR)
    if safety_filter or (safety_filter is None and near.any()):
        setting = setting.with_filter(near)
    attempt = attempts(task, setting, near)
    setting, outcome, problem = attempt.setting, attempt.outcome, attempt.problem
    if attempt.number:  # the plants that asked for another search do not judge it
        as_given = setting.replace(searched=_as_given(setting))
        before = judge(as_given, validation, seed, round_=attempt.number)
    values = values_of(problem, outcome)
    answer = _answer(attempt, before, values, mended)
    outcome.least = True  # of the limits on plants that judged
    first = outcome.search.point(problem.start()) if outcome.search is not None else None
    summary, cloud = _validation(answer, problem)
    result = _result(
        problem,
        outcome,
        values,
        case=setting.case,
        tuned=setting.tuned(values),
        method="default answer",
        status=status_of(outcome, answer.held, answer.lost),
        objective={"before": _mean(before), "after": _mean(answer.after)}
        | {"terms": dict(setting.objective)},
        measures=dict(answer.measures),
        tables={
            side: [] if p is None else list(p.measures)
            for side, p in {"before": first, "after": outcome.point}.items()
        },
        constraints=_rows(answer, problem),
        symmetry=None,
        validation=summary,
        cloud=cloud,
        lost=answer.lost,
        answer=answer,
    )
    return _with_messages(
        result, diagnostics.step_warnings(_own(problem), result.tuned, values), began
    )


def _with_messages(result, steps, began):
    """Return a result with its messages and its duration; its problem needs no log any more."""
    result.problem.cache = result.problem.cache.in_memory()
    messages = messages_of(result, steps)
    return result.replace(messages=messages, wall_s=time.perf_counter() - began)


def _what(problem, validation, command, more):
    """Return the fingerprint of a search."""
    return fingerprint(
        problem.case,
        command=command,
        free=problem.bounds,
        objective=problem.objective,
        limits=problem.limits,
        scenarios=[(s.name, sorted(s.values.items()), s.seed, s.weight) for s in problem.scenarios],
        risk=problem.risk,
        validation=validation,
        **digests(problem.loop, problem.clock, problem.needed),
        **{n: v for n, v in more.items() if n != "engine"},
    )


def _varies(problem):
    """Return True if a validation set differs from the runs of the search."""
    case = problem.case
    return case.uncertain or case.covariance or any(run.key is not None for run in problem.runs)


def _result(problem: Problem, outcome: Outcome, values: Mapping[str, float], **parts: Any):
    """Return the TuningResult of a search, without messages; parts : fields of their own."""
    return TuningResult(
        parameters=_parameters(problem, outcome, values),
        evaluations={
            "simulations": problem.simulations,
            "gradients": problem.gradients,
            "non_finite": problem.non_finite,
            "redone_at_true_step": outcome.redone,
        },
        wall_s=0.0,
        history=outcome.search.history if outcome.search else [],
        starts=outcome.starts,
        optimality=named_optimality(outcome.search, outcome.point),
        curvature=outcome.curvature,
        provenance=provenance(parts["case"], problem.seed),
        problem=problem,
        probe=outcome.probe,
        slopes=outcome.slopes,
        **parts,
    )


def _parameters(problem, outcome, values):
    """Return {name: values before and after, range, sensitivity} of the parameters."""
    own, point, change = problem.own_values(), outcome.point, outcome.change
    if point is None or outcome.interrupted:
        change = [None] * len(own)
    elif change is None:
        costs, _ = problem.screen(diagnostics.neighbours(problem, point.z))
        change = diagnostics.sensitivities(costs)
    idle = np.zeros(len(own), dtype=bool) if outcome.idle is None else outcome.idle
    return {
        b.name: {
            "before": own[b.name],
            "after": values[b.name],
            "unit": b.unit,
            "lower": b.low,
            "upper": b.high,
            "at_bound": "lower" if z < 1e-6 else "upper" if z > 1 - 1e-6 else None,
            "sensitivity_percent": percent,
            "exercised": not still,
        }
        for b, percent, still in zip(problem.bounds, change, idle.tolist())
        for z in [float(b.to_unit(values[b.name]))]
    }


def _margins(loop, clock):
    """Return the margins of the linearised loop; {} for a loop with a long state."""
    small = sum(map(np.size, jax.tree.leaves(initial(loop, clock)))) <= LARGEST_STATE
    return margin_measures(loop, clock) if small else {}


def _check_start(problem, before, first):
    """Raise InputError for an objective, and functions of the user's, without value or slope."""
    for measure in (*problem.objective, *ms.functions(problem.needed)):
        if measure not in before or not np.all(np.isfinite(before[measure])):
            raise InputError(
                f"{'objective' if measure in problem.objective else 'constraint'} {measure} is not"
                " a number at the starting values (it cannot be measured on this run), so it cannot"
                " be tuned"
            )
    if ms.functions(problem.needed):  # before anything is written
        cache = problem.cache
        check_slopes(problem, problem.point(first))
        problem.cache, problem.simulations, problem.gradients = cache, 0, 0


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


def _method(method, problem, batch):
    """Return the method to use. Raises InputError for one that is unknown or does not apply."""
    if batch is not None:
        if method not in ("auto", "adam"):
            raise InputError(f"batch = {batch}: only method adam draws scenarios, not {method}")
        return "adam"
    if method == "auto":
        return automatic(problem)
    if method not in OFFERED:
        raise InputError(f"method = {method!r}: must be one of auto, {', '.join(OFFERED)}")
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


def _answer(attempt, before, values, mended):
    """Return the Answer: what was judged, on which plants, and the case's own run."""
    setting, outcome, problem, after = (
        attempt.setting,
        attempt.outcome,
        attempt.problem,
        attempt.after,
    )
    own = problem.own_values()
    sides = {"before": (setting.case, before), "after": (setting.tuned(values), after)}
    nominal = {side: _nominal(*both, problem.needed) for side, both in sides.items()}
    errors = {side: float(m["rms_error_total"]) for side, m in nominal.items()}
    stays = {n: bool(k) for n, k in zip(own, outcome.kept)} if outcome.kept is not None else {}
    return Answer(
        setting=setting,
        before=before,
        after=after,
        nominal=errors,
        kept=stays or dict.fromkeys(own, False),
        agreed=outcome.confirmed,
        lost=_lost(setting, problem, nominal, values),
        idle=tuple(int(i) + 1 for i in _idle(setting, before, after)),
        tightened=attempt.tightened,
        coarse_dt=problem.case.clock.dt,
        integrator=problem.case.clock.integrator,
        measures=nominal,
        feasibility=_feasibility(setting),
        mended=mended,
    )


def _lost(setting, problem, nominal, values):
    """Return the outputs of the case's own run that no longer follow their setpoints."""
    case = setting.tuned(problem.own_values())
    own = Problem(case, problem.given["free"], setting.objective, {}, ())
    return lost_outputs(own, {side: [table] for side, table in nominal.items()}, values)


def _nominal(case, judged, needed):
    """Return the measures and margins of the case's own run; run now if not judged already."""
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


def _mean(judged: Judged | None) -> float:
    """Return the mean cost of the plants whose run is finite; NaN where there is none."""
    if judged is None or judged.failed.all():
        return float("nan")
    return float(np.mean(judged.cost[~judged.failed]))


def _rows(answer: Answer, problem: Problem) -> list[ConstraintRow]:
    """Return a ConstraintRow for each limit: its worst value on the plants that judged."""
    if answer.after is None:
        return []
    before, samples = answer.before.worst(), answer.after.samples
    return [
        row_of(
            row["limit"],
            problem,
            row["value"],
            before=old["value"],
            scenario=f"the worst of {samples} plants",
        )
        for row, old in zip(answer.after.worst(), before)
    ]


def _validation(answer, problem):
    """Return (summary, cloud) of the plants that judged, as `validation.summary_of`."""
    if answer.after is None:
        return None, None
    sides, setting = (answer.before, answer.after), answer.setting
    cost, held, level = (
        np.stack([getattr(s, n) for s in sides], axis=1) for n in ("cost", "held", "level")
    )
    failed = sides[0].failed | sides[1].failed
    spread = {n: getattr(d, "relative", None) for n, d in setting.distributions.items()}
    judged = Problem(setting.case, problem.given["free"], setting.objective, None, ())
    return summary_of(judged, cost, held, level, failed, spread, True)
