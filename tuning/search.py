"""tune: better gains for a case, found through the simulation and checked at its own step."""

import dataclasses
import os
import platform
import time
from typing import Any

import jax
import numpy as np

import jaxtank
from jaxtank import loop as lp
from jaxtank import measures as ms
from jaxtank._xla import KEY
from jaxtank.errors import InputError
from jaxtank.tree import get_value, with_values
from tuning.objective import Problem
from tuning.screening import coarse_clock, distinct_starts, screen
from tuning.solvers import METHODS, Search, optimality, slsqp

REPORTED = tuple(m for m in ms.MEASURES if m not in ("time_of_max_level",))
"""Measures in a result, before and after."""

BARELY = 0.5
"""Change of the objective [%] for 10 % of a parameter, below which the answer says that the parameter is barely felt."""

STATUSES = ("converged", "not_converged", "infeasible", "interrupted")


@dataclasses.dataclass(frozen=True, kw_only=True)
class TuningResult:
    """What `tune` found. `print(result)` for the table, `.save(dir)` for files, `.plot()` for pictures.

    parameters: {name: {before, after, unit, lower, upper, at_bound, felt_percent}}, the last how much 10 % of the value changes the
    objective [%]; measures: {"before": {}, "after": {}}; constraints: one dict per limit with value, margin, tank and time; history:
    (start, cost, violation [unit of the limit], z) of every evaluation; starts: one dict per local search. case and tuned are the Case
    before and after.
    """

    case: Any
    tuned: Any
    method: str
    status: str
    message: str
    parameters: dict
    objective: dict
    measures: dict
    constraints: list
    evaluations: dict
    wall_s: float
    history: list
    starts: list
    optimality: dict
    provenance: dict
    problem: Any

    @property
    def success(self):
        """True if a search converged and every limit holds at the case's own step."""
        return self.status == "converged"

    def save(self, folder):
        """Write result.json, rig.toml, trajectory.csv and the pictures to a folder."""
        from tuning.report import save

        return save(self, folder)

    def plot(self):
        """Matplotlib figures {name: figure}: responses before and after, convergence, landscape."""
        from tuning.report import figures

        return figures(self)

    def __repr__(self):
        from tuning.report import text

        return text(self)


def tune(
    case, method="auto", *, free=None, objective=None, limits=None, starts=8, seed=0, screening=64, iterations=60, progress=None
):
    """Better values for the free parameters of a case, under its limits.

    case: presets Case; method: "auto" (trf without limits, slsqp with them), "slsqp", "trf", "lbfgs" or "adam"; free: {name: (low,
    high) or Free}; objective: {measure: weight}; limits: {measure: value}, {} for none; starts: local searches, from the case's own
    values and the best distinct ones of `screening` Sobol points; seed: of the Sobol points and the sensor noise; iterations: of
    each local search; progress: called with a dict after every evaluation. Ctrl-C ends the search with the best point so far.
    Returns a TuningResult. Raises InputError for anything it cannot use, before anything is run.
    """
    began = time.perf_counter()
    if jax.numpy.result_type(float) != np.float64:
        raise InputError(
            "tune needs float64 (a limit held to 1e-3 cm is lost in float32): jax.config.update('jax_enable_x64', True)"
        )
    for name, value, low in (("starts", starts, 1), ("screening", screening, 1), ("iterations", iterations, 1)):
        if not isinstance(value, int) or isinstance(value, bool) or not low <= value <= 100_000:
            raise InputError(f"{name} = {value!r}: must be a whole number from {low} to 100000")
    noisy = bool(np.any(np.asarray(case.loop.sensor.noise) > 0))
    key = jax.random.key(seed) if noisy else None
    lp.check(case.loop, case.clock, key)
    problem = Problem(case, free=free, objective=objective, limits=limits, key=key)
    method = _method(method, problem)
    first = problem.start()
    before = run_measures(case.loop, case.clock, key)  # a start that is not finite is an input error, told by evaluate

    for measure in problem.objective:
        if not np.all(np.isfinite(before[measure])):
            raise InputError(
                f"objective {measure} is not a number at the starting values (it cannot be measured on this run), so it cannot be tuned"
            )

    search, outcomes, interrupted, redone, polished = None, [], False, 0, False
    report = _reporter(progress, problem, starts)
    try:
        reference = problem.point(first)
        search = Search(problem, reference, report)
        search.take(reference)
        zs, costs, margins, redone = screen(problem, screening, seed)
        merits = costs / search.scale + 10.0 * np.maximum(0.0, -margins / search.room).sum(axis=1)
        for i, z in enumerate(distinct_starts(zs, merits, starts, first)):
            search.start = i
            count, converged = len(search.history), METHODS[method](search, z, iterations)
            outcomes.append(_outcome(search, z, count, converged))
        search.start = len(outcomes)
        if method in ("slsqp", "trf") and search.best is not None:
            polished = slsqp(search, search.best.z, iterations, tolerance=1e-12)
    except KeyboardInterrupt:
        interrupted = True
    best = search.best if search and search.best else None
    z = first if best is None else best.z
    values = problem.values(z)
    if best is not None and np.array_equal(z, first):
        values = {b.name: float(get_value(case.loop, b.name)) for b in problem.bounds}
    felt = [None] * len(z) if interrupted or best is None else _felt(problem, z)
    tuned = case.replace(loop=with_values(case.loop, values))
    after = run_measures(tuned.loop, tuned.clock, key)
    checked = _constraints(problem, after, tuned)
    holds = all(c["margin"] >= 0 for c in checked)
    status = "interrupted" if interrupted else _status(outcomes, holds, search, polished)
    return TuningResult(
        case=case,
        tuned=tuned,
        method=method,
        status=status,
        message=_message(status, problem, outcomes, checked, _constraints(problem, before, case), z, felt, redone),
        parameters={
            b.name: {
                "before": float(get_value(case.loop, b.name)),
                "after": values[b.name],
                "unit": b.unit,
                "lower": b.low,
                "upper": b.high,
                "at_bound": "lower" if v < 1e-6 else "upper" if v > 1 - 1e-6 else None,
                "felt_percent": f,
            }
            for b, v, f in zip(problem.bounds, z, felt)
        },
        objective={"before": problem.cost(before), "after": problem.cost(after), "terms": problem.objective},
        measures={"before": before, "after": after},
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
        provenance=provenance(case, seed),
        problem=problem,
    )


def _method(method, problem):
    if method == "auto":
        return "trf" if problem.squares and not problem.limits else "slsqp"
    if method not in METHODS:
        raise InputError(f"method = {method!r}: must be one of auto, {', '.join(METHODS)}")
    if method == "trf" and problem.limits:
        raise InputError("method trf cannot hold limits: use slsqp (or auto), or drop them with --limit none")
    if method == "trf" and not problem.squares:
        raise InputError("method trf is for the objective rms_error_total alone: use slsqp (or auto)")
    return method


def run_measures(loop, clock, key):
    """{measure: value} of everything that is reported of a run, and when the highest levels were reached."""
    names = tuple(m for m in REPORTED if ms.serves(m, loop))
    values = lp.evaluate(loop, clock, (*names, "time_of_max_level"), key)
    return {m: np.asarray(v) for m, v in values.items()}


def _outcome(search, z, count, converged):
    """One local search: where it began, the best it reached, and whether it converged."""
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
    }


def _felt(problem, z):
    """Percent by which the objective changes when each parameter alone goes 10 % up or down (of its range where that is linear)."""
    trials = [z]
    for i, b in enumerate(problem.bounds):
        value = float(b.from_unit(z[i]))
        for factor in (-0.1, 0.1):
            moved = b.to_unit(value * (1 + factor)) if b.scale == "log" else z[i] + factor
            trials.append(np.where(np.arange(len(z)) == i, np.clip(moved, 0.0, 1.0), z))
    costs, _ = problem.screen(np.array(trials), problem.clock)
    change = 100 * np.abs(costs[1:] / costs[0] - 1).reshape(-1, 2).max(axis=1)
    return [float(c) if np.isfinite(c) else None for c in change]


def _constraints(problem, after, tuned):
    checked = []
    for limit in problem.limits:
        value = float(np.ravel(after[limit.measure])[limit.index])
        per = ms.MEASURES[limit.measure].per
        tank = limit.index if per == "tank" else tuned.loop.plant.outputs[limit.index] if per == "output" else None
        checked.append(
            {
                "name": limit.label,
                "measure": limit.measure,
                "unit": ms.unit(limit.measure, tuned.loop.units),
                "limit": limit.value,
                "value": value,
                "margin": limit.margin(after),
                "tank": None if tank is None else tank + 1,
                "time_s": float(after["time_of_max_level"][limit.index]) if limit.measure == "max_level" else None,
            }
        )
    return checked


def _status(outcomes, holds, search, polished):
    """Converged means: the search that gave the answer did, or the last polish of it."""
    if search.best is None:
        return "not_converged"
    if not holds:
        return "infeasible"
    mine = search.best_start < len(outcomes) and outcomes[search.best_start]["converged"]
    return "converged" if mine or polished else "not_converged"


def _message(status, problem, outcomes, checked, started, z, felt, redone):
    """One paragraph for people: what was found, what is tight, what to doubt."""
    words = []
    broken = [c for c in checked if c["margin"] < 0]
    if status == "infeasible":
        worst = min(broken, key=lambda c: c["margin"])
        words.append(
            f"no point was found that meets every limit: {worst['name']} is {worst['value']:.6g} {worst['unit']}, "
            f"limit {worst['limit']:.6g} {worst['unit']}"
        )
    if status == "interrupted":
        words.append("interrupted: this is the best point so far")
    if status == "not_converged":
        words.append("no search converged within its iterations: raise --iterations, or try other starts")
    over = [c for c in started if c["margin"] < 0]
    if over and status != "infeasible":
        told = ", ".join(f"{c['name']} {c['value']:.4g} of {c['limit']:.4g} {c['unit']}" for c in over)
        words.append(f"the starting values break a limit ({told}), so their objective is not one to reach")
    tight = [c for c in checked if 0 <= c["margin"] < 1e-3 * abs(c["limit"])]
    for c in tight:
        when = f" at {c['time_s']:.2f} s" if c["time_s"] is not None else ""
        words.append(f"tight: {c['name']}{when} ({c['value']:.7g} of {c['limit']:.7g} {c['unit']})")
    if checked and not tight and not broken:
        words.append("no limit is tight")
    for b, v, f in zip(problem.bounds, z, felt):
        if v < 1e-6 or v > 1 - 1e-6:
            words.append(f"{b.name} ends at its {'lower' if v < 0.5 else 'upper'} bound, {b.low if v < 0.5 else b.high:g} {b.unit}")
        if f is not None and f < BARELY:
            words.append(f"{b.name} is barely felt: 10 % changes the objective by {f:.2g} %")
    held = [o for o in outcomes if o["violation"] == 0.0] or outcomes
    if held:
        best = min(o["cost"] for o in held)
        agree = sum(o["violation"] == 0.0 and o["cost"] <= best * 1.001 for o in outcomes)
        words.append(f"{agree} of {len(outcomes)} starts ended within 0.1 % of the best")
    if redone:
        words.append(f"{redone} screening points are unstable at the coarse step alone and were judged at the true one")
    if problem.non_finite:
        words.append(f"{problem.non_finite} trial points gave numbers that are not finite and were shrunk away from")
    return "; ".join(words)


def _optimality(search, best):
    if best is None:
        return {"gradient_norm": None, "kkt_residual": None, "multipliers": {}}
    norm, residual, multipliers = optimality(search, best)
    named = {limit.label: float(m) for limit, m in zip(search.problem.limits, multipliers) if m > 0}
    return {"gradient_norm": norm, "kkt_residual": residual, "multipliers": named}


def _reporter(progress, problem, starts):
    def report(search):
        if progress is not None:
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


def provenance(case, seed):
    """Versions and settings that a result depends on."""
    import optax
    import scipy

    return {
        "jaxtank": jaxtank.__version__,
        "python": platform.python_version(),
        "jax": jax.__version__,
        "jaxlib": jax.lib.__version__,
        "numpy": np.__version__,
        "scipy": scipy.__version__,
        "optax": optax.__version__,
        "backend": jax.default_backend(),
        "dtype": str(jax.numpy.result_type(float)),
        "xla_option": KEY in os.environ.get("XLA_FLAGS", ""),
        "seed": seed,
        "dt_s": case.clock.dt,
        "coarse_dt_s": coarse_clock(case.clock).dt,
        "integrator": case.clock.integrator,
        "rims_are_physics": case.loop.plant.overflow,
    }
