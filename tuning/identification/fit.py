"""`identify`: output-error estimation of plant parameters, by Gauss-Newton with exact sensitivities
from several starts. Imported as `tuning.identify` and by the command `identify`.
"""

import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.stats import chi2

from jaxtank.case import Case
from jaxtank.core.errors import DataError, InputError
from jaxtank.plants.base import Plant
from tuning.identification import experiment
from tuning.identification.confidence import Spread, at_search_bounds
from tuning.identification.design import remedies
from tuning.identification.experiment import check_data, check_float64, check_length, first_samples
from tuning.identification.identified_case import bare, check_kind
from tuning.identification.least_squares import Fit, solve
from tuning.identification.least_squares import profile_likelihood as _profile
from tuning.identification.problem import Estimation
from tuning.identification.residuals import quality, validate
from tuning.identification.result import Identification
from tuning.problem.status import Status
from tuning.storage.evaluation_log import EvaluationCache, EvaluationLog
from tuning.storage.fingerprint import digest, fingerprint

LOSSES = ("linear", "soft_l1", "huber")
AGREE = 1.001
"""Factor between the sums of squares of two searches below which they found the same minimum."""


def identify(
    case: Case | Plant,
    log: experiment.Log | Sequence[experiment.Log],
    free: Mapping[str, Any] | None = None,
    *,
    start: str = "free",
    starts: int = 8,
    seed: int = 0,
    hold_back: float = 0.25,
    noise: ArrayLike | None = None,
    loss: str = "linear",
    substeps: int | None = None,
    profile: bool = False,
    iterations: int = 100,
    gap: float = 1.5,
    checkpoint: str | Path | None = None,
    resume: bool = False,
    progress: Callable | None = None,
    ready: Callable | None = None,
    law: str | None = None,
) -> Identification:
    """Estimate parameters of a rig from experiment data, by least squares on simulated readings.

        min over theta, h(0)   sum over readings ((y_k - y(t_k; theta, h(0))) / sigma)^2

    Parameters
    ----------
    case : Case or Plant
        The rig; a plant stands for one with ideal pumps and sensors.
    log : Log or sequence of Log
        Experiment data, of `tuning.log` or `tuning.read_log`; several have first levels each.
    free : mapping, optional
        {name: (low, high)} or {name: (low, high, "log" or "linear")} of plant, sensor, actuator or
        a constant disturbance; by default pump gains, splits, orifices and pipes.
    start : {"free", "measured", "case"}
        Levels at the first sample: estimated, as measured, or those of the case.
    starts : int
        Number of searches: the first from the case's values, others from Sobol points of the box.
    seed : int
        Of the Sobol points.
    hold_back : float
        Share of each log (below 1), or number of samples, at its end that validates a fit to the
        rest before all is fitted.
    noise : (channels,) array, optional
        Standard deviation of each channel in its unit; estimated from the data if omitted.
    loss : {"linear", "soft_l1", "huber"}
        Robust beyond 3 standard deviations.
    substeps : int, optional
        Runge-Kutta steps per sample; found by halving if omitted.
    profile : bool
        Whether to compute the profile likelihood of the least certain parameter.
    iterations : int
        Most evaluations of each search.
    gap : float
        Longest step between samples, in median steps.
    checkpoint : path, optional
        Folder of finished searches, from which `resume=True` continues to the same bits.
    resume : bool
        Continue from `checkpoint`.
    progress : callable, optional
        Called with the Fit of each search that has ended; if it raises KeyboardInterrupt, the best
        of them is completed.
    ready : callable, optional
        Called once all inputs are checked, before the first search.
    law : {"pi"}, optional
        Propose a PI controller with gains from the identified model; the case's own
        controller by default.

    Returns
    -------
    Identification

    Raises
    ------
    InputError
        For what cannot be estimated.
    DataError
        For experiment data that cannot be used.

    Examples
    --------
    >>> import jax, numpy as np, tuning
    >>> from jaxtank import presets
    >>> jax.config.update("jax_enable_x64", True)
    >>> case = presets.load("cascaded").cases["open-loop"]
    >>> t = np.arange(30.0)
    >>> data = tuning.log(t=t, u=0 * t + 3, y=4.46 + 0.02 * t, tanks=[0])
    >>> result = tuning.identify(
    ...     case, data, {"plant.pump_gain": (0.01, 0.2)}, start="case", starts=1, substeps=1)
    >>> result.status, list(result.parameters)
    (<Status.CONVERGED: 'converged'>, ['plant.pump_gain[0]'])
    """
    began = time.perf_counter()
    check_float64()
    _check_options(loss, starts=starts, iterations=iterations)
    case = bare(case) if isinstance(case, Plant) else case
    check_kind(law, case)
    logs = [log] if isinstance(log, experiment.Log) else list(log)
    check_data(logs, case.loop, gap)
    kept = [first_samples(one, hold_back) for one in logs]
    options = {"free": free, "start": start, "noise": noise, "substeps": substeps}
    partial, options = _first_problem(case, logs, kept, options)
    check_length(logs)
    settings = {"loss": loss, "iterations": iterations}
    cache = EvaluationCache()
    if checkpoint is not None:
        what = _what(case, logs, partial, start=start, gap=gap, **settings)
        cache = EvaluationLog(checkpoint, what, resume)
    if ready is not None:
        ready()
    fits, interrupted = _searches(cache, partial, starts, seed, loss, iterations, progress)
    first = min(fits, key=lambda f: f.cost if np.isfinite(f.cost) else np.inf)
    if not np.isfinite(first.cost):
        raise DataError(f"{logs[0].name}: no search ended with finite readings")
    estimation, best, validation = _final_fit(partial, first, logs, kept, options, settings)
    best, spread, fit_quality = _spread(estimation, best, settings)
    return Identification(
        case=case,
        estimation=estimation,
        fit=best,
        **_estimates(case, estimation, best, spread, interrupted),
        quality=fit_quality
        | {"widened": spread.widened, "noise": [float(v) for v in estimation.noise]},
        starts=_agreement(fits, first.cost),
        validation=validation,
        profile=None if interrupted or not profile else _profile(estimation, best, spread, loss),
        wall_s=time.perf_counter() - began,
        seed=seed,
        law=law,
    )


def _what(case, logs, partial, **options):
    """Return the fingerprint of the searches: case, experiment data and what decides a number."""
    return fingerprint(
        case,
        command="identify",
        logs=digest(*(v for one in logs for v in (one.t, one.u, one.y))),
        hold=[one.hold for one in logs],
        free=partial.bounds,
        held_back=[one.samples for one in partial.logs],
        noise=partial.noise,
        substeps=partial.substeps,
        **options,
    )


def _estimates(case, estimation, best, spread, interrupted):
    """Return status, estimates with intervals, and what is not identifiable."""
    parameters = spread.parameters()
    status = _status(case, best, parameters, interrupted)
    unclear = status is Status.NOT_IDENTIFIABLE
    return {
        "status": status,
        "parameters": parameters,
        "levels": spread.levels(),
        "covariance": spread.covariance_of_parameters(),
        "directions": spread.directions(),
        "remedies": remedies(estimation, best, spread) if unclear else [],
    }


def _agreement(fits, least):
    """Return {"cost", "evaluations", "agrees"} of each search; least: the lowest cost."""
    return [
        {
            "cost": f.cost,
            "evaluations": f.evaluations,
            "agrees": bool(f.cost <= least * AGREE + 1e-12),
        }
        for f in fits
    ]


def _check_options(loss, **counts):
    """Raise InputError for an unknown loss, or for a count below 1."""
    if loss not in LOSSES:
        raise InputError(f"loss = {loss!r}: must be one of {', '.join(LOSSES)}")
    for name, count in counts.items():
        if not isinstance(count, int) or isinstance(count, bool) or count < 1:
            raise InputError(f"{name} = {count!r}: must be a whole number above 0")


def _first_problem(case, logs, kept, options):
    """Return the Estimation of the first `kept` samples of each log, and all its options."""
    options = options | {"samples": max(one.samples for one in logs)}
    begin = [one.part(0, n) for one, n in zip(logs, kept)]
    longest, first = (max(np.diff(one.t).max() for one in side) for side in (logs, begin))
    if options["substeps"] is None and longest > 1.01 * first:  # the validation set needs more
        options["substeps"] = Estimation(case, logs, **options).substeps
    return Estimation(case, begin, **options), options


def _searches(cache, estimation, starts, seed, loss, iterations, progress):
    """Return (Fits of the searches that ended, whether they were interrupted)."""
    fits = []
    try:
        for z in estimation.starts(starts, seed):
            fits.append(_search(cache, estimation, z, loss, iterations))
            if progress is not None:
                progress(fits[-1])
    except KeyboardInterrupt:
        if not fits:
            raise
        return fits, True
    return fits, False


def _search(cache, estimation, z, loss, iterations):
    """Return the Fit of a first search from z."""
    # One from the checkpoint has where it ended, not its residual and Jacobian.
    made = []

    def compute():
        one = solve(estimation, z, loss, iterations, tolerance=1e-8)
        made.append(one)
        return one.p, one.levels, one.cost, float(one.evaluations), float(one.status)

    p, levels, cost, evaluations, status = cache.recall("search", [z], compute)
    if made:
        return made[0]
    none = np.zeros((0, estimation.size))
    return Fit(
        p=p,
        levels=levels,
        cost=cost,
        residual=none[:, 0],
        jacobian=none,
        evaluations=int(evaluations),
        status=int(status),
        loss=loss,
    )


def _final_fit(partial, first, logs, kept, options, settings):
    """Return (Estimation, Fit, validation) to all samples, from the best of the first searches."""
    best = solve(partial, partial.unknowns(first), **settings)
    estimation, validation = partial, None
    if any(n < one.samples for n, one in zip(kept, logs)):
        same = {"substeps": partial.substeps, "noise": partial.noise}
        estimation = Estimation(partial.case, logs, **(options | same))
        validation = validate(estimation, partial, best, kept)
        best = solve(estimation, partial.unknowns(best), **settings)
    # branch gains may leave the ranges of gain and split: the same search in these themselves
    if not _within(estimation, best):
        plain = estimation.without_branch_gains()
        p = plain.coordinates.point(estimation.coordinates.values(best.p))
        begin = np.concatenate([p, best.levels.ravel() / plain.level_scale])
        estimation, best = plain, solve(plain, np.clip(begin, *plain.box), **settings)
    if not np.isfinite(best.cost):
        raise DataError(
            f"{logs[0].name}: the fit to the first {kept[0]} samples diverges when simulated over"
            " all of them"
        )
    return estimation, best, validation


def _within(estimation, fit):
    """Return whether every value lies in its range."""
    values = estimation.coordinates.values(fit.p)
    return all(
        b.low - 1e-9 * abs(b.high) <= values[b.name] <= b.high + 1e-9 * abs(b.high)
        for b in estimation.bounds
    )


def _spread(estimation, best, settings):
    """Return (Fit, Spread, quality): where something is not identifiable, of a fit near nominal."""
    found = quality(estimation, best)
    spread = Spread(estimation, best, found)
    if spread.open.any():
        best = _nearest(estimation, best, spread.scale, settings)
        found = quality(estimation, best)
        spread = Spread(estimation, best, found)
    return best, spread, found


def _nearest(estimation, best, scale, settings):
    """Return a Fit in the 95 % region about `best` that is near the case's own values."""
    nominal = estimation.nominal()
    most = best.residual @ best.residual + chi2.ppf(0.95, estimation.size) * scale
    for strength in (100.0, 30.0, 10.0, 3.0, 1.0):
        prior = (nominal, strength)
        near = solve(estimation, nominal, tolerance=1e-8, prior=prior, **settings)
        if near.residual.size and near.residual @ near.residual <= most:
            return near
    return best


def _status(case, best, parameters, interrupted):
    """Return the Status; a first level that is not identifiable costs only its interval."""
    if interrupted:
        return Status.INTERRUPTED
    if not all(p["identifiable"] for p in parameters.values()):
        return Status.NOT_IDENTIFIABLE
    if best.status > 0 and not at_search_bounds(case.loop, parameters):
        return Status.CONVERGED
    return Status.NOT_CONVERGED
