"""`tuning.predict`: a rig as it is, played over experiment data that it has not seen."""

import dataclasses
import math
from collections.abc import Sequence
from typing import Any, cast

import numpy as np
from scipy.stats import chi2

from jaxtank.case import Case, check_case
from jaxtank.controllers import OpenLoop
from jaxtank.core.checks import check_whole
from jaxtank.core.labels import reading_label
from jaxtank.core.tree import number
from jaxtank.limits import resolve_limits
from jaxtank.loop.closed_loop import without_noise
from jaxtank.loop.run import simulate
from jaxtank.plants.base import Plant
from jaxtank.signals.base import Table
from tuning.identification import moments as between_rows
from tuning.identification.assumptions import best_assumptions, open_assumptions
from tuning.identification.data_checks import checked
from tuning.identification.experiment import Log
from tuning.identification.identified_case import bare
from tuning.identification.least_squares import Fit, refine_noise_and_steps, solve
from tuning.identification.problem import Estimation
from tuning.identification.residuals import autocorrelation, fit_of, residuals_of
from tuning.identification.result import channels_of
from tuning.identification.simulation import disturbance_at
from tuning.views import Result

LAGS = 20  # lags of the test of whiteness
WIDE = 3.0  # sd of a level, in noise, below which its fit in per cent says nothing


@dataclasses.dataclass(frozen=True, kw_only=True, repr=False)
class Prediction(Result):
    """Result of `tuning.predict`; `print(result)` for a table.

    Attributes
    ----------
    case : Case
        The rig, unchanged.
    estimation : Estimation
        Experiment data, and levels at the first sample as the only unknowns.
    fit : Fit
        These levels.
    start_samples : int or None
        Samples of each log that the levels follow from; None: all.
    quality : dict
        {"rmse", "nrmse_percent", "bias", "after_start", "residual_autocorrelation", "white",
        "input_correlation", "level_sd_in_noise"} of each channel.
    levels : (logs, tanks) array
        Levels at the first sample of each log.
    """

    case: Case
    estimation: Estimation
    fit: Fit
    start_samples: int | None
    quality: dict[str, Any]
    levels: np.ndarray

    @property
    def channels(self) -> list[tuple[str, str]]:
        """(name, unit) of every channel of readings."""
        return channels_of(self.estimation)


def predict(
    case: Case | Plant,
    log: Log | Sequence[Log],
    *,
    start_samples: int | None = None,
    gap: float = 1.5,
) -> Prediction:
    """Predict experiment data with a rig whose parameters stay as they are.

    Only the levels at the first sample are estimated, from all readings or from the first ones;
    the rest is one simulation under the inputs of the log.

    Parameters
    ----------
    case, log, gap
        As in `identify`.
    start_samples : int, optional
        Samples at the beginning of each log that its first levels follow from; all by default.

    Returns
    -------
    Prediction

    Raises
    ------
    InputError
        For `start_samples` that a log does not have.
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
    >>> result = tuning.predict(case, data, start_samples=5)
    >>> len(result.quality["rmse"])
    1
    """
    case = bare(case) if isinstance(case, Plant) else case
    check_case(case)
    logs = checked(log, case.loop, gap)
    if start_samples is not None:  # at most the samples of the shortest log
        check_whole("start_samples", start_samples, 1, min(data.samples for data in logs))
    if start_samples is None:
        logs = between_rows.in_parts(between_rows.without_gaps(logs, case), case)
    logs, inflow = _under_best_assumptions(case, logs, start_samples, moments=start_samples is None)
    estimation = Estimation(case, logs, {}, inflow=inflow)
    fit = solve(estimation, estimation.nominal())
    fit = refine_noise_and_steps(estimation, fit, None, None)
    estimation, fit = between_rows.fitted(estimation, fit)
    if start_samples is not None:
        settings: dict[str, Any] = {"noise": estimation.noise, "substeps": estimation.substeps}
        settings |= {"samples": estimation.mask.shape[1], "inflow": inflow}
        first = Estimation(case, [data.part(0, start_samples) for data in logs], {}, **settings)
        fit = solve(first, first.nominal())
    residual = residuals_of(estimation, fit)
    start = start_samples or 0
    y, quality = estimation.data.y, fit_of(estimation.data.y, residual)
    after = fit_of(y[:, start:], residual[:, start:])
    tests = {"bias": [], "residual_autocorrelation": [], "white": [], "input_correlation": []}
    sd = np.nanstd(np.where(np.isnan(residual), np.nan, y), axis=(0, 1)) / estimation.noise
    for r in np.moveaxis(residual, -1, 0):
        rho, n = autocorrelation(r, LAGS), int(np.isfinite(r).sum())
        # Ljung and Box (Biometrika 65, 1978, 297)
        statistic = n * (n + 2) * np.sum(rho[1:] ** 2 / np.maximum(n - np.arange(1, len(rho)), 1))
        tests["bias"].append(float(np.nanmean(r)) if n else None)
        tests["residual_autocorrelation"].append(float(rho[1]) if len(rho) > 1 else None)
        tests["white"].append(float(chi2.sf(statistic, len(rho) - 1)) if n > LAGS else None)
        tests["input_correlation"].append(_input_correlation(estimation, r))
    return Prediction(
        case=case,
        estimation=estimation,
        fit=fit,
        start_samples=start_samples,
        quality={**quality, **tests, "after_start": after, "level_sd_in_noise": sd.tolist()},
        levels=estimation.first_levels(estimation.unknowns(fit)),
    )


def _under_best_assumptions(case, logs, samples=None, acts=False, moments=False):
    """(Logs, whether the inflow acts in each) under the assumptions that fit best."""
    every = [open_assumptions(case, log, acts) for log in logs]
    best = [assumptions[0] for assumptions in every]
    between = moments and any(between_rows.are_open(log, case) for log in logs)
    if between or any(len(assumptions) > 1 for assumptions in every):
        parts = [log.part(0, samples) for log in logs]
        first = Estimation(case, parts, {}, inflow=acts)
        fit = solve(first, first.nominal())
        best = best_assumptions(first, fit, parts, {"free": {}}, acts, moments, loss="linear")
    return [a.applied(log, case) for a, log in zip(best, logs)], [a.inflow for a in best]


def as_played(case: Case, log: Log) -> Log:
    """Return a checked Log whose inputs step at irregular rows or follow lines, as it fits."""
    [log] = _under_best_assumptions(case, checked(log, case.loop, np.inf), acts=True)[0]
    of_inputs = {topic: value for topic, value in log.assumed.items() if topic == "inputs"}
    return dataclasses.replace(log, assumed=of_inputs)  # the inflow of a rig that is played acts


def played(case: Case, log: Log) -> Case:
    """Return a case whose inputs are those of experiment data, before them the first ones."""
    log = log if log.assumed else as_played(case, log)
    loop, dt, step = case.loop, case.clock.dt, np.diff(log.t)
    t, u, linear = log.t - log.t[0], log.u, log.hold == "first-order"
    if np.ptp(step) > 1e-6 * step.mean():
        grid = dt * np.arange(int(t[-1] / dt + 1e-9) + 1)
        rows = np.searchsorted(t, grid + 1e-9 * dt, side="right") - 1
        u = np.stack([np.interp(grid, t, v) for v in u.T], axis=-1) if linear else u[rows]
    period = float(np.mean(step)) if u is log.u else dt
    signal = Table(values=number(u.T), period=period, between="linear" if linear else "hold")
    x0 = np.array(loop.x0, dtype=float)
    for readings, tank, volts in zip(log.y.T, log.tanks, log.in_volts):
        for y in readings[np.isfinite(readings)][:1]:
            x0[tank] = max(float(loop.sensor.level_of(tank, y, volts)), 0.0)
    first = np.clip(log.u[0], np.asarray(loop.actuator.low), np.asarray(loop.actuator.high))
    pumps = dataclasses.replace(cast(Any, loop.actuator), initial=number(first))
    parts = {"controller": OpenLoop(signal=signal), "actuator": pumps}
    loop = dataclasses.replace(loop, x0=number(x0), disturbance=disturbance_at(case, log), **parts)
    clock = dataclasses.replace(case.clock, duration=dt * int(t[-1] / dt + 1e-9))
    return case.replace(loop=loop, clock=clock)


def beside(case: Case, log: Log, run: Any) -> dict[str, Any]:
    """Return {"name", "t", "channels"}: measured beside simulated readings, and their errors."""
    t, sensor, channels = log.t - log.t[0], case.loop.sensor, []
    inside = t <= float(run.t[-1]) * (1 + 1e-9)
    for y, tank, volts in zip(log.y[inside].T, log.tanks, log.in_volts):
        level = np.interp(t[inside], np.asarray(run.t), np.asarray(run.x)[:, tank])
        simulated = np.asarray(sensor.reading_of(tank, level, volts))
        fit = fit_of(y[None, :, None], (y - simulated)[None, :, None])
        unit = "V" if volts else case.loop.units[0]
        row = {"name": reading_label(case.loop.plant, tank), "unit": unit}
        row |= {name: value for name, (value,) in fit.items()}
        bias = float(np.nanmean(y - simulated)) if np.isfinite(y).any() else None
        channels.append(row | {"bias": bias, "measured": y, "simulated": simulated})
    return {"name": log.name, "t": t[inside], "channels": channels}


def achieved(case: Case, log: Log) -> list[dict[str, Any]]:
    """Return the levels of experiment data beside those that the rig predicts of its own loop."""
    # "achieved" is to the log's setpoints where it has them, else to the rig's; no "error" without
    t, loop, clock, rows = log.t - log.t[0], case.loop, case.clock, []
    samples = max(clock.samples, math.ceil(float(t[-1]) / clock.dt))
    run = simulate(without_noise(loop), dataclasses.replace(clock, duration=samples * clock.dt))
    limits = {v.index: v.value for v in resolve_limits(case) if v.measure == "max_level"}
    for y, tank, volts in zip(log.y.T, log.tanks, log.in_volts):
        predicted = np.interp(t, np.asarray(run.t), np.asarray(run.x)[:, tank])
        measured = np.asarray(loop.sensor.level_of(tank, y, volts))
        sides = {"predicted": predicted, "achieved": measured}
        row: dict[str, Any] = {"name": reading_label(loop.plant, tank), "unit": loop.units[0]}
        row |= {"limit": limits.get(tank), "setpoints": None, "error": None}
        if tank in loop.plant.outputs:
            r = np.asarray(run.r)[:, list(loop.plant.outputs).index(tank)]
            r = np.interp(t, np.asarray(run.t), r)
            setpoints = {"predicted": r, "achieved": r}
            if tank in log.setpoints:
                row["setpoints"], setpoints["achieved"] = log.setpoints[tank]
            error = {side: np.nanmean((h - setpoints[side]) ** 2) for side, h in sides.items()}
            row["error"] = {side: float(np.sqrt(square)) for side, square in error.items()}
        row["highest"] = {s: float(np.nanmax(h)) for s, h in sides.items()}
        row["lowest"] = {s: float(np.nanmin(h)) for s, h in sides.items()}
        rows.append(row)
    return rows


def _input_correlation(estimation, residual):
    """Return the largest correlation of residuals with earlier inputs [sd], or None."""
    u = estimation.data.u
    u, largest = (u[:, :, 0] if u.ndim == 4 else u), 0.0
    for j in range(u.shape[-1]):
        for lag in range(LAGS + 1):
            a, b = residual[:, lag:], u[:, : u.shape[1] - lag, j]
            present = np.isfinite(a)
            a, b = a[present], b[present]
            if len(a) > 2 * LAGS and np.std(a) > 0 and np.std(b) > 0:
                rho = float(np.corrcoef(a, b)[0, 1])
                largest = max(largest, abs(rho) * float(np.sqrt(len(a))))
    return largest or None
