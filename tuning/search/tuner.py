"""tune: better gains for a case, found through the simulation and checked at its own step."""

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
from tuning.problem.functions import as_measures, check_slopes, digests
from tuning.problem.problem import Problem
from tuning.problem.provenance import provenance
from tuning.problem.reported import in_force, margin_measures, run_measures, table_of
from tuning.problem.scenarios import noisy
from tuning.search import diagnostics
from tuning.search.discrete import tune_choices
from tuning.search.kkt import named_optimality
from tuning.search.messages import messages_of
from tuning.search.methods import OFFERED, UNCONSTRAINED
from tuning.search.options import Solver, check_options, check_precision, spelled_out
from tuning.search.result import TuningResult, constraint_rows
from tuning.search.screening import LARGEST_STATE
from tuning.search.stages import Outcome, Plan, solve
from tuning.search.verdicts import lost_outputs, points_to_fragile, status_of
from tuning.storage.evaluation_log import EvaluationLog
from tuning.storage.fingerprint import fingerprint
from tuning.uncertainty.validation import validate

MANY = 4
"""Number of parameters from which "auto" tries Gauss-Newton before it considers limits."""


def tune(
    case: Case | Problem,
    method: str | Solver = "auto",
    *,
    free: Mapping[str, Any] | None = None,
    objective: Any = None,
    limits: Any = None,
    scenarios: Sequence[Scenario] | None = None,
    risk: str = "mean",
    choices: Mapping[str, Sequence] | None = None,
    starts: int = 8,
    seed: int = 0,
    screening: int = 64,
    iterations: int = 60,
    batch: int | None = None,
    validation: int = 64,
    tolerance: float | None = None,
    checkpoint: str | Path | None = None,
    resume: bool = False,
    progress: Callable | None = None,
    cluster: Any = None,
) -> TuningResult:
    """Return better values for the free parameters of a case, under its limits."""
    objective, limits = as_measures(objective, limits)
    options: dict[str, Any] = dict(
        free=free,
        objective=objective,
        limits=limits,
        scenarios=scenarios,
        risk=risk,
        starts=starts,
        seed=seed,
        screening=screening,
        iterations=iterations,
        batch=batch,
        validation=validation,
        tolerance=tolerance,
        progress=progress,
    )
    if isinstance(case, Problem) or isinstance(method, Solver):
        case, method, options = spelled_out(case, method, options)
    keep: dict[str, Any] = dict(checkpoint=checkpoint, resume=resume)
    with connect(cluster) as engine:
        if choices:
            return tune_choices(tune, case, method, choices, cluster=engine, **keep, **options)
        return _tune(case, method, engine, **keep, **options)


def _tune(case, method, engine, *, checkpoint, resume, validation, progress, **options):
    """Check everything, run the stages, and put the result together."""
    began = time.perf_counter()
    check_precision()
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
        problem.cache = EvaluationLog(checkpoint, _what(problem, plan, validation), resume)
    found = solve(problem, first, plan, progress)
    result = _result(problem, plan, found, first, before, key)
    if validation and not found.interrupted and _varies(problem):
        values = {n: p["after"] for n, p in result.parameters.items()}
        summary, cloud = validate(problem, problem.own_values(), values, validation, plan.seed)
        result = result.replace(validation=summary, cloud=cloud)
    steps = diagnostics.step_warnings(problem, result.tuned, _after(result), key)
    result = result.replace(messages=messages_of(result, steps), wall_s=time.perf_counter() - began)
    problem.cache = problem.cache.in_memory()
    return result


def _what(problem, plan, validation):
    """Return the fingerprint of a search."""
    return fingerprint(
        problem.case,
        command="tune",
        free=problem.bounds,
        objective=problem.objective,
        limits=problem.limits,
        scenarios=[(s.name, sorted(s.values.items()), s.seed, s.weight) for s in problem.scenarios],
        risk=problem.risk,
        validation=validation,
        **digests(problem.loop, problem.clock, problem.needed),
        **{n: v for n, v in vars(plan).items() if n != "engine"},
    )


def _varies(problem):
    """Return True if a validation set differs from the runs of the search."""
    case = problem.case
    return case.uncertain or case.covariance or any(run.key is not None for run in problem.runs)


def _after(result):
    return {n: p["after"] for n, p in result.parameters.items()}


def _result(problem, plan, found: Outcome, first, before, key):
    """Return the TuningResult of what the stages found, without validation and messages."""
    case, best = problem.case, found.best
    own = problem.own_values()
    z = first if best is None else best.z
    values = problem.values(z)
    if best is not None and np.array_equal(z, first):
        values = dict(own)
    values |= {n: v for (n, v), idle in zip(own.items(), found.idle) if idle}
    # what stays as it was before is no change to report
    values |= {n: v for n, v in in_force(case.loop, values).items() if values[n] != own[n]}
    complete = best is not None and not found.interrupted
    change = found.change if complete and found.change else [None] * len(z)
    tuned = case.replace(loop=with_values(case.loop, values))
    after = run_measures(tuned.loop, tuned.clock, key, problem.needed)
    tables = {"before": [before], "after": [after]}
    if problem.scenarios:
        tables = {"before": table_of(problem, own), "after": table_of(problem, values)}
    lost = lost_outputs(problem, tables, values) if complete else ()
    rings = points_to_fragile(case.loop, before, after)
    optimum = named_optimality(found.search, best)
    rows = constraint_rows(problem, tables["after"], tables["before"], optimum["multipliers"])
    return TuningResult(
        case=case,
        tuned=tuned,
        method=plan.method,
        status=status_of(found, all(row.margin >= 0 for row in rows), lost),
        parameters=_parameters(problem, values, change, found.idle.tolist()),
        objective={side: problem.total(table) for side, table in tables.items()}
        | {"terms": problem.objective},
        measures={
            "before": before | (_margins(case.loop, case.clock) if rings else {}),
            "after": after | (_margins(tuned.loop, tuned.clock) if rings else {}),
        },
        tables=tables,
        constraints=rows,
        symmetry=diagnostics.symmetric(problem, found.starts, values) if complete else None,
        evaluations={
            "simulations": problem.simulations,
            "gradients": problem.gradients,
            "non_finite": problem.non_finite,
            "redone_at_true_step": found.redone,
        },
        wall_s=0.0,
        history=found.search.history if found.search else [],
        starts=found.starts,
        optimality=optimum,
        curvature=found.curvature,
        validation=None,
        provenance=provenance(case, plan.seed),
        problem=problem,
        lost=lost,
        probe=found.probe,
        slopes=found.slopes,
    )


def _margins(loop, clock):
    """Return the margins of the linearised loop; {} for a loop with a long state."""
    small = sum(map(np.size, jax.tree.leaves(initial(loop, clock)))) <= LARGEST_STATE
    return margin_measures(loop, clock) if small else {}


def _parameters(problem, values, change, idle):
    """Return {name: values before and after, range, sensitivity} of the parameters."""
    own = problem.own_values()
    return {
        b.name: {
            "before": own[b.name],
            "after": values[b.name],
            "unit": b.unit,
            "lower": b.low,
            "upper": b.high,
            "at_bound": "lower" if v < 1e-6 else "upper" if v > 1 - 1e-6 else None,
            "sensitivity_percent": percent,
            "exercised": not still,
        }
        for b, percent, still in zip(problem.bounds, change, idle)
        for v in [float(b.to_unit(values[b.name]))]
    }


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


def _method(method, problem, batch):
    """Return the method to use. Raises InputError for one that is unknown or does not apply."""
    if batch is not None:
        if method not in ("auto", "adam"):
            raise InputError(f"batch = {batch}: only method adam draws scenarios, not {method}")
        return "adam"
    if method == "auto":
        if problem.model and not problem.limits:
            return "trf"
        return "trf-slsqp" if problem.model and len(problem.bounds) >= MANY else "slsqp"
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
