"""`tuning.identify_many`: a fit to each of many logs, by bounded Levenberg-Marquardt."""

import time
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from jaxtank.case import Case, check_case
from tuning.identification.assumptions import best_assumptions
from tuning.identification.confidence import Spread
from tuning.identification.data_checks import checked
from tuning.identification.experiment import Log
from tuning.identification.least_squares import Fit, refine_noise_and_steps, solve
from tuning.identification.problem import Estimation
from tuning.identification.residuals import quality
from tuning.identification.result import Identifications, channels_of

MEMORY = 256 * 2**20  # bytes of sensitivities held at once, in chunks of logs
STATIONARY = 1e-10  # share of the cost below which the predicted gain of a full step ends a fit
STUCK = 1e12  # damping above which a fit has stopped without converging


def identify_many(
    case: Case,
    logs: Sequence[Log],
    free: Mapping[str, Any] | None = None,
    *,
    start: str = "free",
    noise: ArrayLike | None = None,
    substeps: int | None = None,
    iterations: int = 50,
    gap: float = 1.5,
) -> Identifications:
    """Estimate the same parameters from each of many logs separately, in one compiled program.

        min over theta, h(0)   sum over readings ((y_k - y(t_k; theta, h(0))) / sigma)^2,  each log

    For Monte Carlo studies, or data of many days. Every fit starts from the case's own values, so
    these must be reasonable; `identify` tries several starts. Inputs are taken to change at the
    rows: where a controller acts between them, intervals do not hold (those of `identify` do).

    Parameters
    ----------
    case : Case
        The rig.
    logs : sequence of Log
        Experiment data, of any lengths.
    free, start, noise, substeps, gap
        As in `identify`.
    iterations : int
        Most iterations of each fit.

    Returns
    -------
    Identifications

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
    >>> t = np.arange(20.0)
    >>> levels = [4.46 + slope * t for slope in (0.0, 0.02)]
    >>> logs = [tuning.log(t=t, u=0 * t + 3, y=y, tanks=[0]) for y in levels]
    >>> result = tuning.identify_many(
    ...     case, logs, {"plant.pump_gain": (0.01, 0.2)}, start="case", noise=0.1, substeps=1)
    >>> len(result), result.names, bool(result.values[0, 0] < result.values[1, 0])
    (2, ('plant.pump_gain[0]',), True)
    """
    check_case(case)
    began, logs = time.perf_counter(), checked(logs, case.loop, gap)
    first = Estimation(case, logs[:1], free, start, noise, substeps)
    fit = solve(first, first.nominal())
    # of the first log, for all
    [best] = best_assumptions(first, fit, logs[:1], {"free": free, "start": start})
    if any(best):
        logs = [best.applied(log, case) for log in logs]
        first = Estimation(case, logs[:1], free, start, noise, substeps, inflow=best.inflow)
        fit = solve(first, first.nominal())
    refine_noise_and_steps(first, fit, noise, substeps)
    noise = first.noise if noise is None else noise
    problem = Estimation(case, logs, free, start, noise, first.substeps, inflow=best.inflow)
    batch = _Batch(problem)
    z, converged, count = _minimise(batch, iterations)
    rows = (pair for chunk in batch.chunks(z) for pair in zip(*chunk))
    fits = zip(*(_estimates(problem, e, z[e], *pair) for e, pair in enumerate(rows)))
    values, covariance, levels, half, fit = fits
    names, shared = problem.coordinates.names, problem.coordinates.size
    values, levels, half = map(np.stack, (values, levels, half))
    sd = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    levels_sd = np.zeros(levels.shape)
    levels_sd[:, list(problem.tanks)] = sd[:, shared:]
    return Identifications(
        case=case,
        logs=tuple(log.name for log in logs),
        channels=tuple(channels_of(problem)),
        names=names,
        units=tuple(next(b.unit for b in problem.bounds if b.name == n) for n in names),
        values=values,
        sd=sd[:, :shared],
        interval95=np.stack([values - half, values + half], axis=-1),
        covariance=np.stack(covariance)[:, :shared, :shared],
        levels=levels,
        levels_sd=levels_sd,
        rmse=np.array([q["rmse"] for q in fit], dtype=float),
        autocorrelation=np.array([q["residual_autocorrelation"] for q in fit]),
        converged=converged,
        iterations=count,
        wall_s=time.perf_counter() - began,
    )


def _estimates(problem, e, z, residual, jacobian):
    """Return (values, covariance of the unknowns, levels, half intervals, quality) of log e."""
    # NaN in what is not identifiable or ends at its bound.
    alone, coordinates = problem.of_log(e), problem.coordinates
    p, levels = alone.split(z)
    errors = np.where(alone.mask, -residual * problem.noise, np.nan)
    if not np.all(np.isfinite(jacobian)):  # diverged: nothing is identifiable
        residual, jacobian = np.zeros_like(residual), np.zeros_like(jacobian)
    fit = Fit(p, levels, 0.0, residual[alone.mask[0]], jacobian[alone.mask[0]], 0, 0)
    spread, values = Spread(alone, fit), coordinates.values(p)
    covariance = spread.values_covariance
    absent = spread.without_interval
    covariance[absent], covariance[:, absent] = np.nan, np.nan
    half = spread.quantile * np.sqrt(np.diag(covariance))[: coordinates.size]
    of_names, first = np.array([values[n] for n in coordinates.names]), alone.first_levels(z)[0]
    return of_names, covariance, first, half, quality(alone.data.y, errors)


class _Batch:
    """The fits of one problem, one for each log: start, box and normal equations."""

    def __init__(self, problem):
        self.problem, self.count = problem, len(problem.logs)
        shared, free = problem.coordinates.size, len(problem.tanks)

        def by_log(z):
            levels = z[shared:].reshape(self.count, free)
            return np.concatenate([np.tile(z[:shared], (self.count, 1)), levels], axis=1)

        self.begin = by_log(problem.nominal())
        self.low, self.high = (by_log(side) for side in problem.box)
        row = problem.data.y[0].size * (self.begin.shape[1] + 1) * 8
        self.chunk = max(1, min(self.count, MEMORY // row))

    def chunks(self, z):
        """Yield (residual, Jacobian) of each chunk of fits at z (logs, unknowns)."""
        problem, shared = self.problem, self.problem.coordinates.size
        levels = z[:, shared:] * problem.level_scale.reshape(self.count, -1)
        for start in range(0, self.count, self.chunk):
            # the last chunk is filled up: one compiled program
            logs = np.arange(start, start + self.chunk).clip(max=self.count - 1)
            residual, jacobian = problem.by_log(z[logs, :shared], levels[logs], logs)
            mask, size = problem.mask[logs], min(self.chunk, self.count - start)
            jacobian = np.where(mask[..., None], jacobian, 0.0)
            yield np.where(mask, residual, 0.0)[:size], jacobian[:size]

    def normal(self, z):
        """Return cost r'r / 2, gradient J'r and matrix J'J of every fit at z (logs, unknowns)."""
        parts = []
        for residual, jacobian in self.chunks(z):
            r = residual.reshape(len(residual), -1)
            J = jacobian.reshape(*r.shape, -1)
            with np.errstate(all="ignore"):
                transposed = J.transpose(0, 2, 1)
                gradient = (transposed @ r[..., None])[..., 0]
                parts.append((0.5 * np.sum(r * r, axis=1), gradient, transposed @ J))
        return [np.concatenate(part) for part in zip(*parts)]


def _minimise(batch, iterations):
    """Return (unknowns, converged, iterations) of bounded Levenberg-Marquardt."""
    z = np.clip(batch.begin, batch.low, batch.high)
    cost, gradient, matrix = batch.normal(z)
    damping, growth = np.full(len(z), 1e-3), np.full(len(z), 2.0)
    done, stuck, count = np.zeros(len(z), bool), ~np.isfinite(cost), 0
    while count < iterations and not np.all(done | stuck):
        count += 1
        trial = np.clip(z + _step(batch, z, gradient, matrix, damping), batch.low, batch.high)
        step = trial - z
        curved = np.einsum("li,lij,lj->l", step, matrix, step)
        predicted = -np.einsum("li,li->l", gradient, step) - 0.5 * curved
        at = batch.normal(np.where((done | stuck)[:, None], z, trial))
        gain = np.where(np.isfinite(at[0]), cost - at[0], -np.inf)
        ratio = gain / np.maximum(predicted, 1e-300)
        better = (gain > 0) & ~done & ~stuck
        small = predicted <= STATIONARY * cost + 1e-25
        done |= small & (gain >= -1e-12 * cost)
        for new, old in zip((trial, *at), (z, cost, gradient, matrix)):
            old[better] = new[better]
        eased = damping * np.maximum(1 / 10, 1 - (2 * ratio - 1) ** 3)
        damping = np.where(better, eased, np.minimum(damping * growth, STUCK * 10))
        growth = np.where(better, 2.0, np.minimum(2 * growth, STUCK))
        stuck |= damping > STUCK
        damping = np.maximum(damping, 1e-12)
    return z, done, count


def _step(batch, z, gradient, matrix, damping):
    """Return the damped Gauss-Newton step (logs, unknowns); 0 for unknowns at a bound."""
    edge, i = 1e-12 * (batch.high - batch.low), range(z.shape[1])
    fixed = (z <= batch.low + edge) & (gradient > 0)
    fixed |= (z >= batch.high - edge) & (gradient < 0)
    diagonal = np.maximum(matrix[:, i, i], 1e-300)
    matrix = np.where(fixed[:, :, None] | fixed[:, None, :], 0.0, matrix)
    matrix[:, i, i] = np.where(fixed, 1.0, diagonal * (1.0 + damping[:, None]))
    scale = 1.0 / np.sqrt(matrix[:, i, i])  # independent of the units of the unknowns
    right = (scale * np.where(fixed, 0.0, gradient))[..., None]
    matrix = matrix * scale[:, :, None] * scale[:, None, :]
    try:
        return -scale * np.linalg.solve(matrix, right)[..., 0]
    except np.linalg.LinAlgError:
        each = [np.linalg.lstsq(a, b, rcond=None)[0] for a, b in zip(matrix, right[..., 0])]
        return -scale * np.stack(each)
