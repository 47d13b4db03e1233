"""tune: better gains for a case, found through the simulation and checked at its own step."""

import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, cast

import jax
import numpy as np

from jaxtank import measures as ms
from jaxtank.case import Case, Scenario
from jaxtank.core.errors import InputError
from jaxtank.core.tree import get_value, with_values
from jaxtank.loop import run as lp
from tuning.problem.problem import Problem
from tuning.problem.scenarios import noisy
from tuning.problem.status import Status
from tuning.search import diagnostics
from tuning.search.baseline import own_values, run_measures
from tuning.search.diagnostics import of_answer
from tuning.search.discrete import tune_choices
from tuning.search.driver import SETTLED, Search
from tuning.search.first_order import minibatches
from tuning.search.kkt import UNSTABLE, downhill, optimality
from tuning.search.methods import METHODS, approach, restore, slsqp
from tuning.search.options import Solver, check_options, spelled_out
from tuning.search.provenance import fingerprint, provenance
from tuning.search.result import TuningResult, constraint_rows, message
from tuning.search.screening import best_screened, distinct_starts, screen
from tuning.storage.evaluation_log import Log, folder_of

OFFERED = ("trf", "coarse-trf", "slsqp", "lbfgs", "adam")
"""Methods that can be asked for by name."""

FREELY = ("trf", "coarse-trf")
"""Those that do not look at limits."""

RENEWED = 3
"""How often a search with a tolerance of its own is begun again from where it stopped short."""

MANY = 4
"""Number of parameters from which "auto" tries Gauss-Newton before it looks at limits."""


def tune(
    case: Case,
    method: str = "auto",
    *,
    free: Mapping[str, Any] | None = None,
    objective: Mapping[str, float] | None = None,
    limits: Mapping[str, Any] | None = None,
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
    log: str | Path | None = None,
    checkpoint: str | Path | None = None,
    resume: bool = False,
    progress: Callable | None = None,
) -> TuningResult:
    """Better values for the free parameters of a case, under its limits.

    case: presets Case, or a Problem of one, which has free, objective, limits, scenarios and risk
    of its own (and its seed, unless another is given); method: solver options (SQP, TRF, LBFGS,
    Adam), or "auto" (trf where the cost has squares and no limit is in the way, else slsqp),
    "slsqp", "trf", "coarse-trf" (trf at a tenth of the samples, then at all), "lbfgs" or "adam";
    free: {name: (low, high) or Free}; objective: {measure: weight};
    limits: {measure: value}, {} for none, held in every
    scenario; scenarios: tuple of presets.Scenario, () for the case's own run alone; risk: what
    their costs come to, "mean", "cvar" (the mean of the worst 5 %) or "worst"; choices: {static
    name: [values]}, each combination of which is tuned, the best taken; starts: local searches,
    from the case's own values and the best distinct ones of `screening` Sobol points (and one more
    from the best of these points, where it is better than what those searches reached);
    seed: of the Sobol points and the sensor noise; iterations: of each local search; batch:
    scenarios drawn for each step of adam, None for all; validation: runs on perturbed plants and
    fresh noise that the answer is judged on, 0 for none; tolerance: change of the objective, as a
    share of its first value, below which a search under limits has arrived, None for 1e-8 and a
    polish of the best to 1e-12; checkpoint (or log): folder for the log of evaluations, with which
    a killed search is continued by resume=True, to the same bits; progress: called with a dict
    after every evaluation. Ctrl-C ends the search with the best point so far. Returns a
    TuningResult. Raises InputError for anything it cannot use, before anything is run.
    """
    log = folder_of(checkpoint, log=log)
    options = dict(
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
        return tune(case, method, choices=choices, log=log, resume=resume, **options)
    if choices:
        return tune_choices(tune, case, method, choices, log=log, resume=resume, **options)
    began = time.perf_counter()
    _check_precision()
    check_options(
        starts=starts,
        screening=screening,
        iterations=iterations,
        batch=batch,
        validation=validation,
        tolerance=tolerance,
    )
    problem = Problem(
        case,
        free=free,
        objective=objective,
        limits=limits,
        scenarios=scenarios,
        seed=seed,
        risk=risk,
    )
    key = jax.random.key(seed) if noisy(case) else None
    lp.check(case.loop, case.clock, key)
    method = _method(method, problem, batch)
    first = problem.start()
    # a start that is not finite is an input error, told by evaluate
    before = run_measures(case.loop, case.clock, key)
    _check_objective(problem, before)
    if log is not None:
        problem.memo = Log(log, fingerprint(problem, method, options), resume)

    search, outcomes, interrupted, redone, polished, curved = None, [], False, 0, False, None
    idle = np.zeros(len(first), dtype=bool)  # parameters that no run exercises
    # whether the least violation was found; whether nothing lower lies along a slope that is left
    least, settled = False, False
    report = _reporter(progress, problem, starts)
    try:
        reference = problem.point(first)
        search = Search(problem, reference, report, *([] if tolerance is None else [tolerance]))
        search.take(reference)
        zs, costs, margins, redone = screen(problem, screening, seed)
        merits = costs / search.scale + 10.0 * np.maximum(0.0, -margins / search.room).sum(axis=1)

        def begin(z, count):
            search.exhausted = False
            if batch is None:
                converged = METHODS[method](search, z, iterations)
            else:
                converged = minibatches(
                    search, z, iterations, batch, np.random.default_rng([seed, search.start])
                )
            outcomes.append(_outcome(search, z, count, converged))

        for z in distinct_starts(zs, merits, starts, first):
            search.start = len(outcomes)
            begin(z, len(search.history))
        search.start, count = len(outcomes), len(search.history)
        z = best_screened(search, zs, costs, margins)
        if z is not None:
            begin(z, count)
        search.start = len(outcomes)
        if search.best is not None and search.violation(search.best) > 0 and method not in FREELY:
            least = _find_feasible(search, zs, margins, iterations)
        approach(search)
        if tolerance is not None and search.best is not None:
            polished = _settled(search, outcomes, iterations)
        elif method in ("slsqp", "trf", "coarse-trf", "trf-slsqp") and search.best is not None:
            polished = slsqp(search, search.best.z, iterations, tolerance=1e-12)
        if search.best is not None:
            held = search.violation(search.best) == 0
            settled = held and _at_rest(search, iterations)
            idle = diagnostics.unexercised(problem, search, first)
            curved = diagnostics.curvature(problem, search, search.best, idle) if held else None
    except KeyboardInterrupt:
        interrupted = True
    best = search.best if search and search.best else None
    z = first if best is None else best.z
    values = problem.values(z)
    if best is not None and np.array_equal(z, first):
        values = own_values(problem)
    values |= {n: v for (n, v), still in zip(own_values(problem).items(), idle) if still}
    felt = [None] * len(z) if interrupted or best is None else diagnostics.felt(problem, z)
    tuned = case.replace(loop=with_values(case.loop, values))
    after = run_measures(tuned.loop, tuned.clock, key)
    tables = {"before": [before], "after": [after]}
    if problem.scenarios:
        tables = {
            "before": diagnostics.table_of(problem, own_values(problem)),
            "after": diagnostics.table_of(problem, values),
        }
    checked = constraint_rows(problem, tables["after"])
    holds = all(c["margin"] >= 0 for c in checked)
    status = (
        "interrupted" if interrupted else _status(outcomes, holds, search, polished, least, settled)
    )
    mirrored = (
        None if interrupted or best is None else diagnostics.mirror_of(problem, outcomes, values)
    )
    validated, cloud = None, None
    if (
        validation
        and not interrupted
        and (
            case.uncertain or case.covariance or any(lane.key is not None for lane in problem.lanes)
        )
    ):
        validated, cloud = diagnostics.validate(
            problem, own_values(problem), values, validation, seed
        )
    result = TuningResult(
        case=case,
        tuned=tuned,
        method=method,
        status=Status(status),
        message="",
        parameters={
            b.name: {
                "before": float(get_value(case.loop, b.name)),
                "after": values[b.name],
                "unit": b.unit,
                "lower": b.low,
                "upper": b.high,
                "at_bound": "lower" if v < 1e-6 else "upper" if v > 1 - 1e-6 else None,
                "felt_percent": f,
                "exercised": not still,
            }
            for b, v, f, still in zip(problem.bounds, z, felt, idle.tolist())
        },
        objective={
            "before": problem.total(tables["before"]),
            "after": problem.total(tables["after"]),
            "terms": problem.objective,
        },
        measures={"before": before, "after": after},
        tables=tables,
        constraints=checked,
        evaluations={
            "simulations": problem.simulations,
            "gradients": problem.gradients,
            "non_finite": problem.non_finite,
            "redone_at_true_step": redone,
        },
        wall_s=time.perf_counter() - began,
        history=search.history if search else [],
        starts=outcomes,
        optimality=_optimality(search, best),
        curvature=curved,
        mirrored=mirrored,
        validation=validated,
        cloud=cloud,
        provenance=provenance(case, seed),
        problem=problem,
    )
    result = result.replace(
        message=message(result, z, felt, redone, of_answer(problem, tuned, values, key))
    )
    if log is not None:
        problem.memo = cast(Log, problem.memo).memo()
    return result


def _settled(search, outcomes, iterations):
    """True once the best point is one that first-order conditions hold at: a search with a wide
    tolerance also ends where a step of its line search happened to be short, and is begun again
    from there, a few times.
    """
    if (
        _status(outcomes, True, search, False) == "converged"
        and optimality(search, search.best)[1] < SETTLED
    ):
        return True
    for _ in range(RENEWED):
        done = slsqp(search, search.best.z, iterations)
        if done and optimality(search, search.best)[1] < SETTLED:
            return True
    return False


def _find_feasible(search, zs, margins, iterations):
    """Where no search met the limits: least violations from the best so far and from the screened
    points that come nearest to them. True if one of these searches for the least came to its end.
    """
    shortfall = np.maximum(0.0, -margins / search.room).max(axis=1)
    nearest = [
        zs[i]
        for i in np.argsort(np.where(np.isfinite(shortfall), shortfall, np.inf), kind="stable")[:2]
    ]
    ended = []
    for z in (search.best.z, *nearest):
        ended.append(restore(search, z, iterations))
        if search.violation(search.best) == 0:
            slsqp(search, search.best.z, iterations)
            break
    return any(ended)


def _check_precision():
    if jax.numpy.result_type(float) != np.float64:
        raise InputError(
            "tune needs float64 (a limit held to 1e-3 cm is lost in float32):"
            " jax.config.update('jax_enable_x64', True)"
        )


def _check_objective(problem, before):
    for measure in problem.objective:
        if measure not in before or not np.all(np.isfinite(before[measure])):
            raise InputError(
                f"objective {measure} is not a number at the starting values (it cannot be measured"
                " on this run), so it cannot be tuned"
            )


def _method(method, problem, batch):
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
    if method in FREELY and problem.limits:
        raise InputError(
            f"method {method} cannot hold limits: use slsqp (or auto), or drop them with --limit"
            " none"
        )
    if method in FREELY and not problem.model:
        raise InputError(
            f"method {method} needs rms_error_total or a mean of squares ({', '.join(ms.squares())})"
            " in the objective: use slsqp"
        )
    return method


def _outcome(search, z, count, converged):
    """One local search: where it began, the best it reached, whether it converged, and whether it
    used up its iterations."""
    mine = search.history[count:]
    reached = min(mine, key=lambda h: (h[2] > 0, h[2] if h[2] > 0 else h[1]), default=None)
    if reached is None:  # every point it asked for was known already
        point = search.memory.get(np.clip(z, 0, 1).tobytes(), search.best or search.last_finite)
        reached = (search.start, float(point.cost), search.violation(point), tuple(point.z))
    return {
        "from": search.problem.values(z),
        "to": search.problem.values(reached[3]),
        "cost": reached[1],
        "violation": reached[2],
        "evaluations": len(mine),
        "converged": converged,
        "exhausted": search.exhausted,
    }


def _at_rest(search, iterations):
    """True if nothing lower is found along the slope that is left at the best point, and that slope
    is below UNSTABLE. Where there is something lower, the search goes on from it, a few times."""
    for _ in range(RENEWED):
        better = downhill(search, search.best)
        if better is None:
            return optimality(search, search.best)[1] < UNSTABLE
        slsqp(search, better.z, iterations)
    return downhill(search, search.best) is None


def _status(outcomes, holds, search, polished, least=False, settled=True):
    """Converged means: the search that gave the answer came to its end, or the last polish of it
    did, and nothing lower lies along a slope that is left (`settled`). Infeasible: the search for
    the least violation (`least`) came to its end, and some was left.
    """
    if search.best is None:
        return "not_converged"
    if not holds:
        return "infeasible" if least else "not_converged"
    mine = search.best_start < len(outcomes) and outcomes[search.best_start]["converged"]
    flat = not np.any(search.best.gradient) and search.best.cost != 0.0
    return "converged" if (mine or polished) and settled and not flat else "not_converged"


def _optimality(search, best):
    if best is None:
        return {"gradient_norm": None, "kkt_residual": None, "multipliers": {}}
    norm, residual, multipliers = optimality(search, best)
    named = {limit.label: float(m) for limit, m in zip(search.problem.limits, multipliers) if m > 0}
    return {"gradient_norm": norm, "kkt_residual": residual, "multipliers": named}


def _reporter(progress, problem, starts):
    def report(search):
        if progress is not None and search.history:
            best = search.best
            progress(
                {
                    "start": search.start,
                    "starts": starts,
                    "evaluations": len(search.history),
                    "cost": search.history[-1][1],
                    "violation": search.history[-1][2],
                    "best": None if best is None else best.cost,
                    "best_violation": None if best is None else search.violation(best),
                    "values": None if best is None else problem.values(best.z),
                }
            )

    return report
