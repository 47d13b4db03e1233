"""`tuning.identify`: estimation of plant parameters by Gauss-Newton from several starts."""

import copy
import dataclasses
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.stats import chi2

from jaxtank.bounds import Bound
from jaxtank.case import Case, check_case
from jaxtank.core.checks import check_choice, check_whole
from jaxtank.core.errors import DataError, InputError, unknown
from jaxtank.plants.base import Plant
from jaxtank.rig.validation import log_keys
from tuning.identification import diagnosis, moments
from tuning.identification.assumptions import best_assumptions, named, needs_inflow
from tuning.identification.candidates import AugmentedEstimation, with_leaves
from tuning.identification.confidence import Spread, at_search_bounds
from tuning.identification.data_checks import check_distinct, checked, first_samples
from tuning.identification.design import remedies
from tuning.identification.experiment import Log
from tuning.identification.identified_case import bare, check_kind
from tuning.identification.innovations import LIKELIHOODS, choose_likelihood
from tuning.identification.least_squares import (
    Fit,
    profile_likelihood,
    refine_noise_and_steps,
    solve,
)
from tuning.identification.problem import Estimation
from tuning.identification.refinement import refined
from tuning.identification.residuals import at_samples, quality, residuals_of, validate
from tuning.identification.result import Identification
from tuning.identification.sanity import oddities
from tuning.problem.status import Status
from tuning.storage.evaluation_log import EvaluationCache, EvaluationLog
from tuning.storage.fingerprint import digest, fingerprint
from tuning.storage.store import check_resume

SWAPS = ("swapped", "swapped-inputs")  # readings of two tanks, inputs of two pumps
CAUSE_KINDS = (
    *("pump-delay", "pump-lag", "dead-zone", "pump-curve", "sensor-offset", "sensor-scale"),
    *("leak", "outlet-exponent", "inflow", "area", "rangeability", *SWAPS),
)


def place_of(text: str) -> tuple[str, tuple]:
    """Return (kind, place from 1 or ()) of a text such as "pump-delay" or "swapped:1,2"."""
    kind, _, place = str(text).partition(":")
    numbers = place.split(",") if place else []
    if kind not in CAUSE_KINDS:
        raise unknown("cause to accept", kind, CAUSE_KINDS)
    if not all(number.isascii() and number.isdigit() for number in numbers):
        raise InputError(
            f"accept {text!r}: the place must be the number of an input or tank, from 1, as"
            f" {kind}:1; swapped takes two tanks, swapped:1,2"
        )
    return kind, tuple(map(int, numbers))


def accept_causes(
    estimation: Estimation, fit: Fit, places: list[tuple[str, tuple]]
) -> tuple[Case, list[Log], dict[str, Any]]:
    """Return (Case, Logs, options of an Estimation) with causes at (kind, place from 1 or ())."""
    weighted, logs = copy.copy(estimation), list(estimation.logs)
    weighted.noise = diagnosis.noise_of_tests(estimation, fit)
    problem = AugmentedEstimation(weighted, estimation.unknowns(fit), fit.loss)
    trial = diagnosis.trial_at(problem, (), problem.begin)
    # an exchange is fitted without the other causes, so it comes first
    for kind, where in sorted(places, key=lambda place: place[0] not in SWAPS):
        if kind in SWAPS:
            trial = _best_exchange(trial, kind, where)
            logs = [_exchanged(log, *trial.problem.swapped) for log in logs]
        else:
            trial = _best_of_kind(trial, kind, where)
    chosen = [trial.problem.candidates[i] for i in trial.chosen]
    of = trial.problem.coordinates
    values = of.values(trial.point[: of.size])
    known = {*estimation.coordinates.names, *(c.name for c in chosen)}
    loop = with_leaves(estimation.case.loop, [c.name for c in chosen])
    loop = _with_thresholds(loop, chosen, values)
    bound = lambda c: Bound(c.name, c.low, c.high, "linear", diagnosis.unit_of(loop, c))
    way = lambda c: (c.field, c.where, c.null)
    inputs = [(bound(c), way(c)) for c in chosen if c.field not in ("", "threshold")]
    free = {b.name: (b.low, b.high, b.scale) for b in estimation.bounds}
    free |= {c.name: (c.low, c.high, "linear") for c in chosen if not c.field}
    begin = {n: float(v) for n, v in values.items() if n in known}
    case = estimation.case.replace(loop=loop, log=_columns(estimation, logs))
    return case, logs, {"free": free, "inputs": inputs, "begin": begin}


def _with_thresholds(loop, chosen, values):
    """Return a loop with the thresholds among the chosen Candidates, which no search estimates."""
    if not (rows := [c for c in chosen if c.field == "threshold"]):
        return loop
    zone = np.zeros(loop.actuator.pumps)
    zone[[c.where for c in rows]] = [values[c.name] for c in rows]
    actuator = dataclasses.replace(loop.actuator, dead_zone=zone, dead_zone_kind="plain")
    return dataclasses.replace(loop, actuator=actuator)


def _best_of_kind(trial, kind, where):
    """Return the Trial with a Candidate of a kind at a place from 1, or at the best one."""
    candidates = trial.problem.candidates
    options = [i for i, c in enumerate(candidates) if c.kind == kind]
    chosen = [i for i in options if where in ((), (candidates[i].where + 1,))]
    if not chosen:
        places = ", ".join(f"{kind}:{candidates[i].where + 1}" for i in options)
        raise InputError(
            f"accept {':'.join([kind, *map(str, where)])}: "
            + (f"must be one of {places}" if places else "already free, or of no part of this rig")
        )
    best = min((diagnosis.with_candidate(trial, i) for i in chosen), key=lambda t: t.loss)
    while kind == "pump-curve":  # with all coefficients of the curve that the data ask for
        place = candidates[best.chosen[-1]].where
        others = [i for i in options if candidates[i].where == place and i not in best.chosen]
        trials = (diagnosis.with_candidate(best, i) for i in others)
        larger = min(trials, key=lambda t: t.loss, default=best)
        if not diagnosis.passes(larger, best):
            break
        best = larger
    return best


def _best_exchange(trial, kind, where):
    """Return the Trial with an exchange of a kind: at `where`, or of the best pair."""
    options = [t for t in diagnosis.exchanges(trial, always=True) if t.problem.swapped[0] == kind
               and sorted(where) in ([], sorted(i + 1 for i in t.problem.swapped[1]))]  # fmt: skip
    if not options:
        place = f":{','.join(map(str, where))}" if where else ""
        two = "measured levels in the same unit" if kind == "swapped" else "pumps"
        raise InputError(f"accept {kind}{place}: needs two {two}")
    return min(options, key=lambda t: t.loss)


def _exchanged(log, kind, places):
    """Return a Log with two tanks, or inputs with their headers and units, exchanged."""
    a, b = places
    if kind == "swapped":
        other = {a: b, b: a}
        return dataclasses.replace(log, tanks=tuple(other.get(i, i) for i in log.tanks))
    order = list(range(1 + log.u.shape[1] + len(log.tanks)))  # of t, u, y
    order[1 + a], order[1 + b] = 1 + b, 1 + a
    moved = lambda words: None if words is None else tuple(words[i] for i in order)
    columns = np.array(order[1 : 1 + log.u.shape[1]]) - 1
    early = None if log.early is None else log.early[:, columns]
    heads = {"headers": moved(log.headers), "units": moved(log.units)}
    return dataclasses.replace(log, u=log.u[:, columns], early=early, **heads)


def _columns(estimation, logs):
    """Return the [log] table of a case with the headers of the columns that were exchanged."""
    table, slots = estimation.case.log, log_keys(estimation.case.loop.plant)
    key_of = {slots[key]: key for key in table if key in slots}
    columns = dict(table)
    for old, log in zip(estimation.logs, logs):
        if log.headers is None:
            continue
        slot_of = {header: old.slot(i) for i, header in enumerate(old.headers)}
        for i, header in enumerate(log.headers):
            before, after = slot_of[header], log.slot(i)
            if before != after:
                spec = table.get(key_of.get(before), header)
                unit = None if isinstance(spec, str) else spec[1]
                columns[key_of.get(after, after)] = (header, unit) if unit else header
    return columns


LOSSES = ("linear", "soft_l1", "huber")
AGREE = 1.001  # ratio of the sums of squares of two searches with the same minimum


def identify(
    case: Case | Plant,
    log: Log | Sequence[Log],
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
    prior: bool = True,
    accept: Sequence[str] = (),
    refine: bool = False,
    likelihood: str = "output-error",
) -> Identification:
    """Estimate parameters of a rig from experiment data, by least squares on simulated readings.

        min over theta, h(0)   sum over readings ((y_k - y(t_k; theta, h(0))) / sigma)^2

    Parameters
    ----------
    case : Case or Plant
        The rig; a plant stands for one with ideal pumps and sensors.
    log : Log or sequence of Log
        Experiment data, of `tuning.log` or `tuning.read_log`; several have first levels each. Time
        counts from the first row. A log polled under control may be taken in parts of 500 rows.
    free : mapping, optional
        {name: (low, high)} or {name: (low, high, "log" or "linear")} of plant, sensor, actuator or
        a constant disturbance; by default pump gains, splits, orifices and pipes.
    start : {"free", "measured", "case"}
        Levels at the first sample: estimated, measured, or from the case.
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
    prior : bool
        Whether the `covariance` of a case that was identified before counts as what is known of
        its parameters; each log is then given once.
    accept : sequence of str
        Causes of a `diagnosis` to put into the rig and estimate: "pump-delay", or with its place
        from 1, "pump-delay:2", "swapped:1,2", "swapped-inputs:1,2".
    refine : bool
        Whether parts that the rig lacks are added where blocks of the data are then predicted
        better by fits to the others: a curve of a sensor, the exponent of an outlet or a linear
        one beside it, the area of a tank without a reading.
    likelihood : {"output-error", "innovations", "auto"}
        "output-error": readings are simulated levels with white noise. "innovations": noise also
        drives each level, and an extended Kalman filter predicts each reading from those before, so
        that intervals hold where the rig differs a little from its equations. "auto": by the
        autocorrelation of the residuals, then by Schwarz's criterion (BIC).

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
    together = {"refine": refine, "accept": bool(accept)}
    _check_settings(loss, likelihood, together, starts=starts, iterations=iterations)
    check_resume(checkpoint, resume)
    places = [place_of(text) for text in accept]
    if refine:
        same: dict[str, Any] = {"start": start, "hold_back": hold_back, "noise": noise}
        same |= {"seed": seed, "loss": loss, "substeps": substeps, "iterations": iterations}
        same |= {"gap": gap, "prior": prior}
        more = {"checkpoint": checkpoint, "resume": resume, "progress": progress, "ready": ready}
        first = identify(case, log, free, starts=starts, **same, **more)
        same |= {"profile": profile, "law": law, "likelihood": likelihood}
        return _refined(first, log, same, began)
    case = _checked_case(case, seed, law)
    logs = _logs(log, case, gap, loss, likelihood)
    options: dict[str, Any] = {"start": start, "noise": noise, "substeps": substeps}
    options |= {"free": free, "samples": max(log.samples for log in logs), "prior": prior}
    options["inflow"] = needs_inflow(case, logs, options)
    settings = {"loss": loss, "iterations": iterations}
    counts, partial = _partial(case, logs, hold_back, options)
    cache = EvaluationCache()
    if checkpoint is not None:
        what = _what(case, logs, partial, start=start, gap=gap, **settings)
        cache = EvaluationLog(checkpoint, what, resume)
    if ready is not None:
        ready()
    search: Any = (starts, seed, settings, progress)
    (fits, interrupted), fitted = _all(cache, partial, logs, counts, options, search)
    refit = {"hold_back": hold_back, "seed": seed, "settings": settings}
    if not interrupted:
        between = likelihood != "innovations"  # whose noise of the levels is of it as well
        case, logs, fitted = _under_best_assumptions(case, logs, fitted, options, refit, between)
    if places and not interrupted:
        case, logs, accepted = accept_causes(*fitted[:2], places)
        options |= accepted
        fitted = _again(case, logs, options, fitted[0], **refit)
    estimation, best, validation = fitted
    spread, fit_quality = _spread(estimation, best)
    if spread.open_axes.any():
        best = _nearest(estimation, best, spread.scale, settings)
        spread, fit_quality = _spread(estimation, best)
    simulated, sd = best, estimation.noise
    filtered, report = choose_likelihood(likelihood, estimation, simulated, iterations)
    if filtered is not None:
        best, sd = filtered
        spread, fit_quality = _spread(estimation, best, whitened=True)
    parameters = spread.parameters()
    status = _status(case, best, parameters, interrupted)
    return Identification(
        case=case,
        estimation=estimation,
        fit=best,
        status=status,
        parameters=parameters,
        levels=spread.levels(),
        covariance=spread.covariance_of_parameters(),
        directions=spread.directions(),
        oddities=[odd for log in logs for odd in oddities(log, estimation.case.loop)],
        remedies=remedies(estimation, best, spread) if status is Status.NOT_IDENTIFIABLE else [],
        quality=fit_quality | {"widened": spread.widened, "noise": sd.tolist()},
        likelihood=report,
        simulated=simulated,
        starts=_starts(fits),
        validation=validation,
        profile=profile_likelihood(estimation, best, spread, loss)
        if all((profile, not interrupted, best is simulated))
        else None,
        wall_s=time.perf_counter() - began,
        seed=seed,
        law=law,
        accepted=tuple(accept),
    )


def _logs(log, case, gap, loss, likelihood):
    """Checked Logs, in parts where moments of more changes are open than are estimated at once."""
    logs = moments.without_gaps(checked(log, case.loop, gap), case)
    check_distinct(logs)
    moments_open = loss == "linear" and likelihood != "innovations"
    return moments.in_parts(logs, case) if moments_open else logs


def _checked_case(case, seed, law):
    case = bare(case) if isinstance(case, Plant) else case
    check_case(case, seed)
    check_kind(law, case)
    return case


def _partial(case, logs, hold_back, options):
    """Return (number of samples of each log that are fitted first, Estimation of these)."""
    counts = [first_samples(log, hold_back) for log in logs]
    parts = [log.part(0, count) for log, count in zip(logs, counts)]
    longest, shorter = (max(np.diff(log.t).max() for log in each) for each in (logs, parts))
    if options["substeps"] is None and longest > 1.01 * shorter:
        # of the validation set
        options = options | {"substeps": Estimation(case, logs, **options).substeps}
    return counts, Estimation(case, parts, **options)


def _all(cache, partial, logs, counts, options, search):
    """Return (Fits, whether interrupted), (Estimation of all data, its Fit, validation or None)."""
    starts, seed, settings, progress = search
    fits, interrupted = _searches(cache, partial, starts, seed, settings, progress)
    best = min(fits, key=lambda fit: fit.cost if np.isfinite(fit.cost) else np.inf)
    if not np.isfinite(best.cost):
        raise DataError(f"{logs[0].name}: no search ended with finite readings")
    best = solve(partial, partial.unknowns(best), **settings)
    if not interrupted:
        best = refine_noise_and_steps(
            partial, best, options["noise"], options["substeps"], **settings
        )
    estimation, best, validation = _of_all(partial, best, logs, counts, options, settings)
    estimation, best = _within_ranges(estimation, best, settings)
    estimation, best = moments.fitted(estimation, best, **settings)
    if not np.isfinite(best.cost):
        raise DataError(
            f"{logs[0].name}: the fit to the first {counts[0]} samples diverges when simulated over"
            " all of them"
        )
    return (fits, interrupted), (estimation, best, validation)


def _again(case, logs, options, before, hold_back, seed, settings):
    """Return (Estimation of all data, its Fit, validation) of one search, in steps as before."""
    counts, partial = _partial(case, logs, hold_back, options | {"substeps": before.substeps})
    if [log.tanks for log in logs] == [log.tanks for log in before.logs]:  # no readings exchanged
        partial.noise = before.noise
    return _all(EvaluationCache(), partial, logs, counts, options, (1, seed, settings, None))[1]


def _under_best_assumptions(case, logs, fitted, options, refit, between):
    """Return (Case, Logs, fitted) under the assumptions on the logs that the data fit best."""
    estimation, fit, _ = fitted
    best = best_assumptions(estimation, fit, logs, options, moments=between, **refit["settings"])
    best = best if between else [named(a, log, case) for a, log in zip(best, logs)]
    logs = estimation.logs = [a.applied(log, case) for a, log in zip(best, logs)]
    if any(a.inputs == "steps" for a in best):
        case = case.replace(log={**case.log, "hold": "zero-order"})
    options["inflow"] = tuple(a.inflow for a in best)
    if any(map(any, best)):
        fitted = _again(case, logs, options, estimation, **refit)
    return case, logs, fitted


def _refined(first, log, settings, began):
    """Return the Identification of the rig of a first one with the parts that it lacks."""
    if first.status is Status.INTERRUPTED:
        return first
    case, free, added = refined(first, {name: settings[name] for name in ("loss", "iterations")})
    again = identify(case, log, free, starts=1, **settings)
    return dataclasses.replace(again, refinements=added, wall_s=time.perf_counter() - began)


def _check_settings(loss, likelihood, together, **counts):
    check_choice("loss", loss, LOSSES)
    check_choice("likelihood", likelihood, LIKELIHOODS)
    if loss != "linear" and likelihood != "output-error":
        raise InputError(
            f"loss = {loss!r} beside likelihood = {likelihood!r}: the filter is that of normal"
            " noise: leave one of them out"
        )
    if all(together.values()):
        raise InputError(
            f"{' and '.join(together)} each change the rig: accept a cause first, and refine the"
            " rig file that is written"
        )
    for name, count in counts.items():
        check_whole(name, count, 1)


def _of_all(partial, best, logs, counts, options, settings):
    """Return (Estimation, Fit, validation or None) of whole logs, after a Fit to first parts."""
    estimation, validation = partial, None
    if any(count < log.samples for count, log in zip(counts, logs)):
        options = options | {"substeps": partial.substeps, "noise": partial.noise}
        estimation = Estimation(partial.case, logs, **options)
        validation = validate(moments.with_mean(estimation, counts), partial, best, counts)
    if estimation is not partial or partial.prior is not None:
        if estimation.prior is not None:
            # its weight by these data alone: in conflict with it they would have a large residual
            estimation.prior_weight = 0.0
            alone = solve(estimation, partial.unknowns(best), **settings)
            estimation.alone = _spread(estimation, alone)[0]
            estimation.prior_weight = float(np.std(alone.residual))
        best = solve(estimation, partial.unknowns(best), **settings)
    return estimation, best, validation


def _starts(fits):
    """Cost and effort of each search, and whether it has found the minimum of the best."""
    least = min(fit.cost for fit in fits if np.isfinite(fit.cost)) * AGREE + 1e-12
    rows = [{"cost": fit.cost, "evaluations": fit.evaluations} for fit in fits]
    return [row | {"agrees": bool(row["cost"] <= least)} for row in rows]


def _what(case, logs, partial, **options):
    """Return the fingerprint of the searches: case, experiment data and what decides a number."""
    return fingerprint(
        case,
        command="identify",
        logs=digest(*(v for log in logs for v in (log.t, log.u, log.y))),
        hold=[log.hold for log in logs],
        free=partial.bounds,
        held_back=[log.samples for log in partial.logs],
        prior=partial.prior is not None,
        noise=partial.noise,
        substeps=partial.substeps,
        **options,
    )


def _searches(cache, estimation, starts, seed, settings, progress):
    """Return (Fits of the searches that ended, whether they were interrupted)."""
    fits = []
    try:
        for z in estimation.starts(starts, seed):
            fits.append(_search(cache, estimation, z, settings))
            if progress is not None:
                progress(fits[-1])
    except KeyboardInterrupt:
        if not fits:
            raise
        return fits, True
    return fits, False


def _search(cache, estimation, z, settings):
    """Return the Fit of a search from z, or of the checkpoint where it ended (without Jacobian)."""
    new = []

    def compute():
        new.append(fit := solve(estimation, z, tolerance=1e-8, **settings))
        return fit.p, fit.levels, fit.cost, float(fit.evaluations), float(fit.status)

    p, levels, cost, evaluations, status = cache.recall("search", [z], compute)
    if new:
        return new[0]
    rows, counts = (np.zeros(0), np.zeros((0, estimation.size))), (int(evaluations), int(status))
    return Fit(p, levels, cost, *rows, *counts, loss=settings["loss"])


def _within_ranges(estimation, fit, settings):
    """Return (Estimation, Fit) with every value in its range."""
    # branch gains may leave the ranges of gain and split: the same search in these themselves
    values = estimation.coordinates.values(fit.p)
    within = lambda b, rest: b.low - rest <= values[b.name] <= b.high + rest
    if all(within(b, 1e-9 * abs(b.high)) for b in estimation.bounds):
        return estimation, fit
    plain = estimation.without_branch_gains()
    levels = fit.levels.ravel() / plain.level_scale
    start = np.concatenate([plain.coordinates.point(values), levels])
    return plain, solve(plain, np.clip(start, *plain.box), **settings)


def _spread(estimation, fit, whitened=False):
    """Return (Spread, quality) of a Fit; `whitened`: its residual are innovations."""
    fit_quality = quality(estimation.data.y, residuals_of(estimation, fit))
    correlation = fit_quality["residual_autocorrelation"]
    if whitened:
        residual = at_samples(estimation, fit.residual)
        correlation = quality(estimation.data.y, residual)["residual_autocorrelation"]
    return Spread(estimation, fit, correlation), fit_quality


def _nearest(estimation, best, scale, settings):
    """Return a Fit in the 95 % region about `best` that is near the case's own values."""
    nominal = estimation.nominal()
    most = best.residual @ best.residual + chi2.ppf(0.95, estimation.size) * scale
    for strength in (100.0, 30.0, 10.0, 3.0, 1.0):
        near = solve(estimation, nominal, tolerance=1e-8, prior=(nominal, strength), **settings)
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
