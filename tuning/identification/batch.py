"""`identify_many`: one fit to each of many logs, in one batch, by bounded Levenberg-Marquardt on
normal equations. Imported as `tuning.identify_many`.
"""

import dataclasses
import functools
import time
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike
from scipy.stats import t as student

from jaxtank.case import Case
from jaxtank.core.tree import with_values
from tuning.identification import simulation
from tuning.identification.confidence import ROUND_OFF, VAGUE
from tuning.identification.experiment import Log, check_data, check_float64, check_length
from tuning.identification.problem import Estimation
from tuning.identification.result import Identifications

MEMORY = 256 * 2**20
"""Bytes of sensitivities held at once: the logs are simulated in chunks that fit."""
STATIONARY = 1e-10
"""Share of the cost below which the predicted gain of a full step ends a fit."""
STUCK = 1e12
"""Damping above which a fit has stopped without converging."""


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
    these must be reasonable; `identify` tries several starts.

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
    began, logs = time.perf_counter(), list(logs)
    check_float64()
    check_data(logs, case.loop, gap)
    check_length(logs)
    first = Estimation(case, logs[:1], free, start, noise, substeps)
    problem = Estimation(
        case, logs, free, start, first.noise if noise is None else noise, first.substeps
    )
    batch = _Batch(problem)
    z, end, converged, count = _minimise(batch, iterations)
    return _result(case, batch, z, end, converged=converged, iterations=count, began=began)


def _result(case, batch, z, end, *, converged, iterations, began):
    """Return the Identifications at the unknowns z (logs, unknowns)."""
    problem, logs = batch.problem, len(z)
    names, shared, tanks = problem.coordinates.names, problem.coordinates.size, list(problem.tanks)
    levels = problem.initial.copy()
    levels[:, tanks] = (z * batch.scale)[:, shared:]
    spread = np.stack([_spread(batch, e, z[e], end.cost[e], end.matrix[e]) for e in range(logs)])
    by_name = [problem.coordinates.values(one[:shared]) for one in z]
    values = np.stack([np.array([one[n] for n in names]) for one in by_name])
    sd = np.sqrt(np.diagonal(spread, axis1=1, axis2=2))
    levels_sd = np.zeros(levels.shape)
    levels_sd[:, tanks] = sd[:, shared:]
    half = student.ppf(0.975, np.maximum(batch.readings - z.shape[1], 1))[:, None] * sd[:, :shared]
    with np.errstate(invalid="ignore", divide="ignore"):  # a channel without a reading in some log
        rmse = np.sqrt(end.squares / problem.mask.sum(axis=1)) * problem.noise
        autocorrelation = end.products / end.squares
    length = case.loop.units[0]
    return Identifications(
        case=case,
        logs=tuple(log.name for log in problem.logs),
        channels=tuple((f"h{i + 1}", "V" if v else length) for i, v in problem.data.channels),
        names=names,
        units=tuple(next(b.unit for b in problem.bounds if b.name == n) for n in names),
        values=values,
        sd=sd[:, :shared],
        interval95=np.stack([values - half, values + half], axis=-1),
        covariance=spread[:, :shared, :shared],
        levels=levels,
        levels_sd=levels_sd,
        rmse=rmse,
        autocorrelation=autocorrelation,
        converged=converged,
        iterations=iterations,
        wall_s=time.perf_counter() - began,
    )


class _Normal(NamedTuple):
    """Normal equations of every fit, residual r = weight (readings - y) and Jacobian J."""

    cost: Any  # (logs,) r'r / 2
    gradient: Any  # (logs, unknowns) J'r
    matrix: Any  # (logs, unknowns, unknowns) J'J
    squares: Any  # (logs, channels) sums of r^2
    products: Any  # (logs, channels) sums of r_k r_{k+1}


class _Batch:
    """The fits of one problem, one for each log: start, box and scale of the unknowns."""

    def __init__(self, problem):
        self.problem, self.count = problem, len(problem.logs)
        shared, tanks = problem.coordinates.size, len(problem.tanks)

        def by_log(z):
            levels = z[shared:].reshape(self.count, tanks)
            return np.concatenate([np.tile(z[:shared], (self.count, 1)), levels], axis=1)

        self.begin = by_log(problem.nominal())
        self.low, self.high = (by_log(side) for side in problem.box)
        self.scale = np.concatenate([np.ones(shared), problem.level_scale[:tanks]])
        self.weight = problem.mask / problem.noise
        self.readings = problem.mask.sum(axis=(1, 2))
        row = problem.data.y[0].size * (self.begin.shape[1] + 1) * 8
        self.chunk = max(1, min(self.count, MEMORY // row))

    def normal(self, z):
        """Return the _Normal of every fit at z (logs, unknowns)."""
        chunks = [self._normal(z, i) for i in range(0, self.count, self.chunk)]
        return _Normal(*(np.concatenate(part) for part in zip(*chunks)))

    def _normal(self, z, start):
        """Return the _Normal of the chunk of fits that begins at `start`."""
        problem, data = self.problem, self.problem.data
        size = min(self.chunk, self.count - start)
        # the last chunk is filled up: one compiled program
        pick = np.arange(start, start + self.chunk).clip(max=self.count - 1)
        y = np.where(problem.mask, data.y, 0.0)
        found = normal_equations(
            problem.rig,
            data.dt[pick],
            data.u[pick],
            y[pick],
            self.weight[pick],
            z[pick] * self.scale,
            problem.initial[pick],
            self.scale,
            coordinates=problem.coordinates,
            tanks=problem.tanks,
            channels=data.channels,
            substeps=problem.substeps,
        )
        return tuple(np.asarray(part)[:size] for part in found)


@functools.partial(jax.jit, static_argnames=("coordinates", "tanks", "channels", "substeps"))
def normal_equations(
    rig, dt, u, y, weight, q, initial, scale, *, coordinates, tanks, channels, substeps
):
    """Return the _Normal of every log by unknowns q / scale."""
    shared = coordinates.size

    def one(dt, u, y, weight, q, initial):
        def residual(q):
            own = dict(zip(tanks, [q[shared + i] for i in range(len(tanks))]))
            x0 = jnp.stack([jnp.asarray(own.get(i, initial[i])) for i in range(initial.shape[0])])
            r = dataclasses.replace(with_values(rig, coordinates.values(q[:shared])), x0=x0)
            return (simulation.readings(r, dt, u, channels, substeps) - y) * weight

        tangents = jnp.diag(scale)
        r, slopes = jax.vmap(
            lambda tangent: jax.jvp(residual, (q,), (tangent,)), out_axes=(None, 0)
        )(tangents)
        r, slopes = r.reshape(-1), slopes.reshape(q.shape[0], -1)
        left = r.reshape(y.shape)
        sums = jnp.sum(left * left, axis=0), jnp.sum(left[1:] * left[:-1], axis=0)
        return _Normal(0.5 * (r @ r), slopes @ r, slopes @ slopes.T, *sums)

    return jax.vmap(one)(dt, u, y, weight, q, initial)


def _minimise(batch, iterations):
    """Return (unknowns, _Normal, converged, iterations) of bounded Levenberg-Marquardt."""
    z = np.clip(batch.begin, batch.low, batch.high)
    here = batch.normal(z)
    damping, growth = np.full(len(z), 1e-3), np.full(len(z), 2.0)
    done, stuck, count = np.zeros(len(z), bool), ~np.isfinite(here.cost), 0
    while count < iterations and not np.all(done | stuck):
        count += 1
        trial = np.clip(z + _step(batch, z, here, damping), batch.low, batch.high)
        step = trial - z
        curved = np.einsum("li,lij,lj->l", step, here.matrix, step)
        predicted = -np.einsum("li,li->l", here.gradient, step) - 0.5 * curved
        at = batch.normal(np.where((done | stuck)[:, None], z, trial))
        gain = np.where(np.isfinite(at.cost), here.cost - at.cost, -np.inf)
        ratio = gain / np.maximum(predicted, 1e-300)
        better = (gain > 0) & ~done & ~stuck
        small = predicted <= STATIONARY * here.cost + 1e-25
        done |= small & (gain >= -1e-12 * here.cost)
        for new, old in zip((trial, *at), (z, *here)):
            old[better] = new[better]
        eased = damping * np.maximum(1 / 10, 1 - (2 * ratio - 1) ** 3)
        damping = np.where(better, eased, np.minimum(damping * growth, STUCK * 10))
        growth = np.where(better, 2.0, np.minimum(2 * growth, STUCK))
        stuck |= damping > STUCK
        damping = np.maximum(damping, 1e-12)
    return z, here, done, count


def _step(batch, z, here, damping):
    """Return the damped Gauss-Newton step (logs, unknowns) of what no bound holds."""
    edge, i = 1e-12 * (batch.high - batch.low), range(z.shape[1])
    held = ((z <= batch.low + edge) & (here.gradient > 0)) | (
        (z >= batch.high - edge) & (here.gradient < 0)
    )
    diagonal = np.maximum(here.matrix[:, i, i], 1e-300)
    left = np.where(held[:, :, None] | held[:, None, :], 0.0, here.matrix)
    left[:, i, i] = np.where(held, 1.0, diagonal * (1.0 + damping[:, None]))
    scale = 1.0 / np.sqrt(left[:, i, i])  # independent of the units of the unknowns
    right = (scale * np.where(held, 0.0, here.gradient))[..., None]
    left = left * scale[:, :, None] * scale[:, None, :]
    try:
        return -scale * np.linalg.solve(left, right)[..., 0]
    except np.linalg.LinAlgError:
        each = [np.linalg.lstsq(a, b, rcond=None)[0] for a, b in zip(left, right[..., 0])]
        return -scale * np.stack(each)


def _spread(batch, e, z, cost, matrix):
    """Return (unknowns, unknowns) covariance of the values of fit e."""
    # NaN in the rows of what is not identifiable or at its bound (see confidence.Spread).
    problem, size, shared = batch.problem, len(z), batch.problem.coordinates.size
    edge = 1e-6 * (batch.high[e] - batch.low[e])
    held = (z < batch.low[e] + edge) | (z > batch.high[e] - edge)
    moving = np.flatnonzero(~held)
    scale = 2 * cost / max(batch.readings[e] - moving.size, 1)
    full, hidden = np.zeros((size, size)), held.copy()
    if moving.size and np.all(np.isfinite(matrix)):
        block = cast(Any, np.ix_)(moving, moving)  # numpy's stubs know lists only
        squares, axes = np.linalg.eigh(matrix[block])
        singular = np.sqrt(np.maximum(squares, 0.0))
        sd = np.sqrt(scale) / np.maximum(singular, 1e-300)
        # squares have half of the digits of a singular value
        open_ = (sd > VAGUE) | (singular < np.sqrt(ROUND_OFF) * 1e-3 * singular.max())
        full[block] = scale * (axes[:, ~open_] / squares[~open_]) @ axes[:, ~open_].T
        own = np.sqrt(np.diag(full))[moving]
        for axis, reach in zip(axes[:, open_].T, np.minimum(sd[open_], 1.0)):
            hidden[moving[np.abs(axis) * reach > np.maximum(0.5 * own, 1e-6)]] = True
    else:
        hidden[:] = True
    slopes = np.diag(batch.scale)
    slopes[:shared, :shared] = problem.coordinates.slopes(z[:shared])
    for pair in problem.coordinates.pairs:
        hidden[list(pair)] = hidden[list(pair)].any()
    full = slopes @ full @ slopes.T
    full[hidden], full[:, hidden] = np.nan, np.nan
    return full
