"""tune: the default answer, or the optimum of a problem as it is stated."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from jaxtank.case import Case, Scenario
from jaxtank.core.errors import InputError
from tuning.answer.judged import FRESH
from tuning.answer.recommend import recommend
from tuning.cluster.engine import connect
from tuning.problem.functions import as_measures
from tuning.problem.problem import Problem
from tuning.search import tuner
from tuning.search.options import Solver, check_options, check_precision
from tuning.search.result import TuningResult

DEFAULT = {"starts": 4, "iterations": 40, "validation": FRESH}
NOMINAL = {"starts": 8, "screening": 64, "iterations": 60, "validation": 64}


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
    objective : {measure: weight}, or a function of one's own, (measures) or (measures, trajectory)
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
    starts : local searches, 8 if nominal; else at most 4, until two agree.
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
    asked = _asked(method, scenarios, risk, choices, batch, tolerance, screening)
    _check_nominal(nominal, asked, case)
    own = NOMINAL if nominal or asked or isinstance(case, Problem) else DEFAULT
    counts = {"starts": starts, "iterations": iterations, "validation": validation}
    common: dict[str, Any] = dict(free=free, objective=objective, limits=limits, seed=seed)
    common |= dict(checkpoint=checkpoint, resume=resume)
    common |= {n: own[n] if v is None else v for n, v in counts.items()} | {"progress": progress}
    given = {"distributions": distributions, "safety_filter": safety_filter, "mend": mend}
    if own is DEFAULT:
        assert isinstance(case, Case)
        _check_default(**{n: common[n] for n in counts})
        with connect(cluster) as engine:
            return recommend(case, engine=engine, **given, **common)
    for name, value in given.items():
        if value is not None:
            raise InputError(f"{name}: belongs to the default answer, not to the nominal optimum")
    return tuner.tune(
        case,
        method,
        scenarios=scenarios,
        risk=risk,
        choices=choices,
        screening=NOMINAL["screening"] if screening is None else screening,
        batch=batch,
        tolerance=tolerance,
        cluster=cluster,
        **common,
    )


def _asked(method, scenarios, risk, choices, batch, tolerance, screening):
    """Return the names of what is given and belongs to the nominal optimum."""
    states = {
        "scenarios": scenarios,
        "choices": choices,
        "batch": batch,
        "tolerance": tolerance,
        "screening": screening,
    }
    found = [name for name, value in states.items() if value is not None]
    return found + ["risk"] * (risk != "mean") + ["method"] * (method != "auto")


def _check_nominal(nominal, asked, case):
    """Raise InputError where nominal=False contradicts what is given."""
    if nominal is False and (asked or isinstance(case, Problem)):
        what = asked[0] if asked else "a Problem"
        raise InputError(f"{what}: belongs to the nominal optimum (nominal=True, --nominal)")


def _check_default(**counts):
    """Raise InputError for numbers that the default answer cannot use."""
    check_precision()
    check_options(**counts)
    if counts["validation"] == 0:
        raise InputError(
            "validation = 0: the default answer is judged on at least 1 plant (the nominal optimum"
            " needs none)"
        )
