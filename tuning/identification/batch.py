"""Many logs of one rig, fitted each by itself in one batch: bounded Levenberg-Marquardt on normal
equations, all fits abreast.
"""

import dataclasses
import functools
import time
from collections.abc import Mapping, Sequence
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike
from scipy.stats import t as student

from jaxtank.case import Case
from jaxtank.core.errors import InputError
from jaxtank.core.tree import with_values
from tuning.identification import experiment as lg
from tuning.identification import simulation as pb
from tuning.identification.confidence import ROUND_OFF, VAGUE
from tuning.identification.experiment import Log
from tuning.identification.problem import Estimation, check_length

ROOM = 256 * 2**20
"""Bytes of slopes held at once: the logs go through in shares that fit."""
STILL = 1e-10
"""Share of the cost below which what a full step could still gain is nothing."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Identifications:
    """What `identify_many` found: arrays with one row per log.

    names: of the parameters; units: theirs; values, sd: (logs, parameters); interval95: (logs,
    parameters, 2); covariance: (logs, parameters, parameters); levels, levels_sd: (logs, tanks) at
    the first sample; NaN in sd, interval and covariance where the data leave a parameter open or it
    ends at its bound. rmse, autocorrelation: (logs, channels), the latter from sample to sample:
    intervals are those of white
    noise. converged: (logs,); iterations: of the slowest; wall_s: [s].
    """

    names: tuple
    units: tuple
    values: np.ndarray
    sd: np.ndarray
    interval95: np.ndarray
    covariance: np.ndarray
    levels: np.ndarray
    levels_sd: np.ndarray
    rmse: np.ndarray
    autocorrelation: np.ndarray
    converged: np.ndarray
    iterations: int
    wall_s: float

    def __len__(self):
        return len(self.values)


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
    """Estimate the same parameters from each of many logs by itself, in one compiled program: Monte
    Carlo, a log a day, a rig of each kind.

        min over theta, h(0)   sum over readings ((y_k - y(t_k; theta, h(0))) / sigma)^2      for
        each log

    case: a Case; logs: list of `tuning.Log`, of any lengths; free, start, noise, substeps, gap: as
    in `identify`; iterations: most of each fit. Every fit starts from the case's own values, so
    these must be fair; `identify` tries several starts.

    Returns Identifications. Raises InputError for what cannot be estimated, DataError for a log
    that cannot be used.
    """
    began, logs = time.perf_counter(), list(logs)
    if not jax.config.read("jax_enable_x64"):
        raise InputError(
            "identification needs float64: call jax.config.update('jax_enable_x64', True) first"
        )
    if not logs:
        raise InputError("no log is given")
    for one in logs:
        lg.check_gaps(one, gap)
        lg.check_fits(one, case.loop)
    check_length(logs)
    first = Estimation(case, logs[:1], free, start, noise, substeps)
    problem = Estimation(
        case, logs, free, start, first.noise if noise is None else noise, first.substeps
    )
    lanes = _Lanes(problem)
    z, here, converged, count = _descend(lanes, iterations)
    p, levels = z[:, : problem.coordinates.size], problem.first.copy()
    levels[:, list(problem.tanks)] = (z * lanes.scale)[:, problem.coordinates.size :]
    spread = np.stack([_spread(lanes, e, z[e], here[0][e], here[2][e]) for e in range(len(logs))])
    names, shared = problem.coordinates.names, problem.coordinates.size
    values = np.stack([np.array([problem.coordinates.values(one)[n] for n in names]) for one in p])
    covariance, sd = spread[:, :shared, :shared], np.sqrt(np.diagonal(spread, axis1=1, axis2=2))
    levels_sd = np.zeros(levels.shape)
    levels_sd[:, list(problem.tanks)] = sd[:, shared:]
    half = student.ppf(0.975, np.maximum(lanes.readings - z.shape[1], 1))[:, None] * sd[:, :shared]
    with np.errstate(invalid="ignore", divide="ignore"):  # a channel without a reading in some log
        rmse, autocorrelation = (
            np.sqrt(here[3] / problem.mask.sum(axis=1)) * problem.noise,
            here[4] / here[3],
        )
    return Identifications(
        names=names,
        units=tuple(next(b.unit for b in problem.bounds if b.name == n) for n in names),
        values=values,
        sd=sd[:, :shared],
        interval95=np.stack([values - half, values + half], axis=-1),
        covariance=covariance,
        levels=levels,
        levels_sd=levels_sd,
        rmse=rmse,
        autocorrelation=autocorrelation,
        converged=converged,
        iterations=count,
        wall_s=time.perf_counter() - began,
    )


class _Lanes:
    """The fits side by side: what each one's unknowns (lanes, unknowns) cost, with gradient and
    J'J.
    """

    def __init__(self, problem):
        self.problem, self.count = problem, len(problem.logs)
        shared, tanks, origin = problem.coordinates.size, len(problem.tanks), problem.origin()
        own = origin[shared:].reshape(self.count, tanks)
        self.begin = np.concatenate([np.tile(origin[:shared], (self.count, 1)), own], axis=1)
        self.scale = np.concatenate([np.ones(shared), problem.level_scale[:tanks]])
        self.low, self.high = (
            np.concatenate(
                [np.tile(side[:shared], (self.count, 1)), side[shared:].reshape(self.count, tanks)],
                axis=1,
            )
            for side in problem.box
        )
        self.weight = problem.mask / problem.noise
        self.readings = problem.mask.sum(axis=(1, 2))
        row = problem.record.y[0].size * (self.begin.shape[1] + 1) * 8
        self.share = max(1, min(self.count, ROOM // row))

    def normal(self, z):
        """What `normal_equations` tells of every fit at z (lanes, unknowns)."""
        parts = [
            self._normal(z, slice(i, i + self.share)) for i in range(0, self.count, self.share)
        ]
        return tuple(np.concatenate(part) for part in zip(*parts))

    def _normal(self, z, lanes):
        problem, record = self.problem, self.problem.record
        size = len(range(*lanes.indices(self.count)))
        # the last share is filled up: one program
        pick = np.arange(lanes.start, lanes.start + self.share).clip(max=self.count - 1)
        y = np.where(problem.mask, record.y, 0.0)
        found = normal_equations(
            problem.rig,
            record.dt[pick],
            record.u[pick],
            y[pick],
            self.weight[pick],
            z[pick] * self.scale,
            problem.first[pick],
            self.scale,
            coordinates=problem.coordinates,
            tanks=problem.tanks,
            channels=record.channels,
            substeps=problem.substeps,
        )
        return tuple(np.asarray(part)[:size] for part in found)


@functools.partial(jax.jit, static_argnames=("coordinates", "tanks", "channels", "substeps"))
def normal_equations(
    rig, dt, u, y, weight, q, first, scale, *, coordinates, tanks, channels, substeps
):
    """(r'r / 2 (lanes,), J'r (lanes, unknowns), J'J (lanes, unknowns, unknowns), sums of r^2 and of
    r_k r_{k+1} (lanes, channels)), r = weight (readings - y), by unknowns q / scale.

    dt: (lanes, samples) [s]; u: (lanes, samples, pumps); y, weight: (lanes, samples, channels); q:
    (lanes, unknowns) coordinates, then levels of `tanks`; first: (lanes, all tanks) levels of the
    others.
    """
    shared = coordinates.size

    def one(dt, u, y, weight, q, first):
        def residual(q):
            own = dict(zip(tanks, [q[shared + i] for i in range(len(tanks))]))
            x0 = jnp.stack([jnp.asarray(own.get(i, first[i])) for i in range(first.shape[0])])
            r = dataclasses.replace(with_values(rig, coordinates.values(q[:shared])), x0=x0)
            return (pb.readings(r, dt, u, channels, substeps) - y) * weight

        tangents = jnp.diag(scale)
        r, slopes = jax.vmap(
            lambda tangent: jax.jvp(residual, (q,), (tangent,)), out_axes=(None, 0)
        )(tangents)
        r, slopes = r.reshape(-1), slopes.reshape(q.shape[0], -1)
        left = r.reshape(y.shape)
        sums = jnp.sum(left * left, axis=0), jnp.sum(left[1:] * left[:-1], axis=0)
        return 0.5 * (r @ r), slopes @ r, slopes @ slopes.T, *sums

    return jax.vmap(one)(dt, u, y, weight, q, first)


def _descend(lanes, iterations):
    """Levenberg and Marquardt within bounds, every fit with its own damping (Nielsen's rule): a
    trial that gains is kept.
    """
    z = np.clip(lanes.begin, lanes.low, lanes.high)
    here = lanes.normal(z)
    size = z.shape[1]
    damping, growth = np.full(len(z), 1e-3), np.full(len(z), 2.0)
    done, stuck, count = np.zeros(len(z), bool), ~np.isfinite(here[0]), 0
    while count < iterations and not np.all(done | stuck):
        count += 1
        cost, gradient, matrix = here[:3]
        edge = 1e-12 * (lanes.high - lanes.low)
        held = ((z <= lanes.low + edge) & (gradient > 0)) | (
            (z >= lanes.high - edge) & (gradient < 0)
        )
        diagonal = np.maximum(matrix[:, range(size), range(size)], 1e-300)
        left = np.where(held[:, :, None] | held[:, None, :], 0.0, matrix)
        left[:, range(size), range(size)] = np.where(held, 1.0, diagonal * (1.0 + damping[:, None]))
        # by columns, so that solving does not mind their units
        scale = 1.0 / np.sqrt(left[:, range(size), range(size)])
        step = -scale * _solve(
            left * scale[:, :, None] * scale[:, None, :], scale * np.where(held, 0.0, gradient)
        )
        trial = np.clip(z + step, lanes.low, lanes.high)
        step = trial - z
        hoped = -np.einsum("li,li->l", gradient, step) - 0.5 * np.einsum(
            "li,lij,lj->l", step, matrix, step
        )
        at = lanes.normal(np.where((done | stuck)[:, None], z, trial))
        gain = np.where(np.isfinite(at[0]), cost - at[0], -np.inf)
        ratio = gain / np.maximum(hoped, 1e-300)
        better = (gain > 0) & ~done & ~stuck
        small = hoped <= STILL * cost + 1e-25
        done |= small & (gain >= -1e-12 * cost)
        z[better] = trial[better]
        here = tuple(
            np.where(better.reshape(-1, *[1] * (new.ndim - 1)), new, old)
            for new, old in zip(at, here)
        )
        damping = np.where(
            better, damping * np.maximum(1 / 10, 1 - (2 * ratio - 1) ** 3), damping * growth
        )
        growth = np.where(better, 2.0, 2 * growth)
        stuck |= damping > 1e12
        damping = np.maximum(damping, 1e-12)
    return z, here, done, count


def _solve(matrix, right):
    try:
        return np.linalg.solve(matrix, right[..., None])[..., 0]
    except np.linalg.LinAlgError:
        return np.stack([np.linalg.lstsq(a, b, rcond=None)[0] for a, b in zip(matrix, right)])


def _spread(lanes, e, z, cost, matrix):
    """(unknowns, unknowns) covariance of the values of fit e; NaN in the rows of what is open or at
    its bound (see identifiability.Spread).
    """
    problem, size, shared = lanes.problem, len(z), lanes.problem.coordinates.size
    edge = 1e-6 * (lanes.high[e] - lanes.low[e])
    held = (z < lanes.low[e] + edge) | (z > lanes.high[e] - edge)
    moving = np.flatnonzero(~held)
    scale = 2 * cost / max(lanes.readings[e] - moving.size, 1)
    full, hidden = np.zeros((size, size)), held.copy()
    if moving.size and np.all(np.isfinite(matrix)):
        block = cast(Any, np.ix_)(moving, moving)  # numpy's stubs know lists only
        squares, axes = np.linalg.eigh(matrix[block])
        singular = np.sqrt(np.maximum(squares, 0.0))
        sd = np.sqrt(scale) / np.maximum(singular, 1e-300)
        # squares know a singular value to half of the digits only
        open_ = (sd > VAGUE) | (singular < np.sqrt(ROUND_OFF) * 1e-3 * singular.max())
        full[block] = scale * (axes[:, ~open_] / squares[~open_]) @ axes[:, ~open_].T
        own = np.sqrt(np.diag(full))[moving]
        for axis, reach in zip(axes[:, open_].T, np.minimum(sd[open_], 1.0)):
            hidden[moving[np.abs(axis) * reach > np.maximum(0.5 * own, 1e-6)]] = True
    else:
        hidden[:] = True
    turn = np.diag(lanes.scale)
    turn[:shared, :shared] = problem.coordinates.slopes(z[:shared])
    for pair in problem.coordinates.pairs:
        hidden[list(pair)] = hidden[list(pair)].any()
    full = turn @ full @ turn.T
    full[hidden], full[:, hidden] = np.nan, np.nan
    return full
