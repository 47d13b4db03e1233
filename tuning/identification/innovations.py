"""The likelihood of experiment data by an extended Kalman filter: noise drives the levels too."""

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxtank.core.errors import InputError
from jaxtank.core.tree import with_values
from jaxtank.xla.hoist import scan
from tuning.identification.least_squares import Fit, solve
from tuning.identification.problem import LARGEST_SLOPE, Estimation
from tuning.identification.residuals import WHITE, autocorrelation, residuals_of
from tuning.identification.simulation import player

LIKELIHOODS = ("output-error", "innovations", "auto")
REACH = 3.0  # largest change of log(noise of the readings) from its first value
PROCESS = (1e-8, 1e-1)  # range of the process noise, in rims per root of a second
PROCESS_SD = 0.5  # prior sd of a tank's log(process noise) about the mean of all


def innovations(rig, dt, u, y, present, process, variance, channels, substeps):
    """Return (samples, channels) innovations and their variances, in the channels' units."""
    # process: variance that each level gains per second; variance: of each channel's readings
    n = range(rig.plant.tanks)
    x, state, stepped, pieces = player(rig, dt, u, substeps)
    zero, one = 0.0 * x[0], 1.0 + 0.0 * x[0]
    steps = dt if dt.ndim == 1 else dt.sum(axis=-1)
    unit = tuple(jnp.eye(len(n), dtype=one.dtype))

    def corrected(x, P, c, y, present):
        tank, volts = channels[c]
        read = lambda h: rig.sensor.reading_of(tank, h, volts)
        reading, slope = jax.jvp(read, (x[tank],), (one,))
        along = [slope * P[i][tank] for i in n]
        S, v = slope * along[tank] + variance[c], y - reading
        K = [jnp.where(present, a / S, 0.0) for a in along]
        x = tuple(x[i] + K[i] * v for i in n)
        return x, [[P[i][j] - K[i] * along[j] for j in n] for i in n], (v, S)

    def sample(carry, now):
        (x, P, state), (pieces, step, y, present), rows = carry, now, []
        for c in range(len(channels)):
            x, P, row = corrected(x, P, c, y[c], present[c])
            rows.append(row)
        onward = lambda x: stepped(x, state, pieces)[0]
        # columns of the transition matrix F = d x(next) / d x
        slope = lambda tangent: jax.jvp(onward, (x,), (tangent,))[1]
        F = jax.vmap(slope)(unit)
        after, state = stepped(x, state, pieces)
        FP = [[sum(F[i][k] * P[k][j] for k in n) for j in n] for i in n]
        P = [[sum(FP[i][k] * F[j][k] for k in n) for j in n] for i in n]
        # the upper half of both: round-off would make them differ
        P = [[P[min(i, j)][max(i, j)] + (i == j) * process[i] * step for j in n] for i in n]
        return (after, P, state), tuple(rows)

    columns = lambda values: tuple(values[:, c] for c in range(len(channels)))
    start = (x, [[zero for _ in n] for _ in n], state)
    now = (pieces, steps, columns(y), columns(present))
    rows = scan(sample, start, now, length=dt.shape[0])[1]
    return tuple(jnp.stack(v, axis=-1) for v in zip(*rows))


@functools.partial(jax.jit, static_argnames=("coordinates", "tanks", "channels", "substeps"))
def sensitivities(
    rig, dt, u, y, present, p, first, noises, *, coordinates, tanks, channels, substeps
):
    """Return innovations, variances (logs, samples, channels), slopes by p, `first`, `noises`."""
    shared, n = coordinates.size, rig.plant.tanks

    def of_log(dt, u, y, present, first):
        def run(q):
            r = with_values(rig, coordinates.values(q[:shared]))
            levels = q[shared : shared + len(tanks)]
            r = with_values(r, {f"x0[{tank}]": h for tank, h in zip(tanks, levels)})
            variances = jnp.exp(2.0 * q[shared + len(tanks) :])
            parts = (variances[:n], variances[n:], channels, substeps)
            return innovations(r, dt, u, y, present, *parts)

        q = jnp.concatenate([p, first[: len(tanks)], noises])
        slope = lambda tangent: jax.jvp(run, (q,), (tangent,))
        return jax.vmap(slope, out_axes=(None, -1))(jnp.eye(q.size, dtype=q.dtype))

    return jax.vmap(of_log)(dt, u, y, present, first)


class Likelihood:
    """Minus twice the logarithm of the likelihood as a sum of squares, for `solve`.

    sum v^2/S + log S = sum (v/root S)^2 + (root(log S + c))^2 - c: with c = 1 - log S the
    Gauss-Newton matrix is Fisher's information; c of the least S, so that every row is real.
    """

    def __init__(self, estimation: Estimation):
        self.estimation, self.coordinates = estimation, estimation.coordinates
        self.prior, self.evaluations = estimation.prior, 0
        rim = np.asarray(estimation.case.loop.plant.rim, dtype=float)
        noise = np.log(estimation.noise)
        low, high = estimation.box
        ends = [np.log(rim * end) for end in PROCESS]
        sides = ([low, ends[0], noise - REACH], [high, ends[1], noise + REACH])
        self.box = tuple(map(np.concatenate, sides))
        self.size: int = self.box[0].size
        self.shift = 1.0 - 2.0 * (noise - REACH)
        # else the noise of a tank of which few readings tell would often be estimated as 0
        first, n = estimation.size, rim.size
        self.alike = np.zeros((n, self.size))
        self.alike[:, first : first + n] = (np.eye(n) - 1.0 / n) / PROCESS_SD

    def split(self, z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return self.estimation.split(z[: self.estimation.size])

    def prior_rows(self, p: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return (residual, Jacobian) of the prior at coordinates p."""
        rows, slopes = self.estimation.prior_rows(p)
        return rows, np.pad(slopes, ((0, 0), (0, self.size - slopes.shape[1])))

    def at(self, z: np.ndarray) -> tuple[np.ndarray, ...]:
        """Return innovations v (rows,), variances S, and their Jacobians (rows, unknowns)."""
        est, data = self.estimation, self.estimation.data
        levels, tanks = est.first_levels(z[: est.size]), est.tanks
        rig, shared = est.rig, est.coordinates.size
        tanks = tanks or tuple(range(levels.shape[1]))
        run = (rig, data.dt, data.inputs_and_flows(), np.where(est.mask, data.y, 0.0), est.mask)
        at = (self.split(z)[0], levels, z[est.size :])
        static = {"tanks": tanks, "channels": data.channels, "substeps": est.substeps}
        results, slopes = sensitivities(*run, *at, coordinates=est.coordinates, **static)
        self.evaluations += 1
        parts, free = [np.asarray(v)[est.mask] for v in results], len(est.tanks)
        for slope in map(np.array, slopes):
            levels = slope[..., shared : shared + free] * est.level_scale[:free]
            first = np.concatenate([slope[..., :shared], levels], axis=-1)
            jacobian = [est.jacobian_of(first), slope[..., shared + len(tanks) :]]
            parts.append(np.concatenate(jacobian, axis=-1)[est.mask])
        return tuple(parts)

    def residual_and_jacobian(self, z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return (residual (rows,), Jacobian (rows, unknowns)) of the sum of squares."""
        with np.errstate(all="ignore"):
            v, S, dv, dS = self.at(z)
            a, dS = v / np.sqrt(S), dS / S[:, None]
            b = np.sqrt(np.log(S) + self.shift[np.nonzero(self.estimation.mask)[2]])
            da = dv / np.sqrt(S)[:, None] - 0.5 * a[:, None] * dS
            rows = np.concatenate([a, b, self.alike @ z])
            jacobian = np.concatenate([da, 0.5 * dS / b[:, None], self.alike])
        if not np.all(np.abs(jacobian) < LARGEST_SLOPE):  # also where it is NaN
            return np.full_like(rows, np.nan), np.zeros_like(jacobian)
        return rows, jacobian

    def start(self, fit: Fit) -> np.ndarray:
        """Return the start: the process noise that explains changes of a Fit's residuals."""
        est = self.estimation
        residual, steps = residuals_of(est, fit), est.data.steps[:, :-1, None]
        with np.errstate(divide="ignore", invalid="ignore"):
            gained = np.diff(residual, axis=1) ** 2 / np.where(steps > 0, steps, np.nan)
        usual = np.median(steps[steps > 0])
        noise = est.noise**2
        rates = np.nanmean(gained, axis=(0, 1)) - 2 * noise / usual
        rates = np.maximum(rates, 0.01 * noise / usual)
        gain = est.rig.sensor.gain
        gains = [float(gain[tank]) if volts else 1.0 for tank, volts in est.data.channels]
        process = 0.5 * np.log(np.mean(rates * np.square(gains)))
        tanks = est.case.loop.plant.tanks
        z = np.concatenate([est.unknowns(fit), np.full(tanks, process), np.log(est.noise)])
        return np.clip(z, *self.box)


def choose_likelihood(
    kind: str, estimation: Estimation, fit: Fit, iterations: int
) -> tuple[Any, dict]:
    """Return ((Fit, noise of the readings (channels,)), or None where `fit` stays; a report)."""
    report = {"kind": "output-error", "asked": kind, "reason": "asked", "bic": None}
    report["process_noise"] = None
    if kind == "output-error":
        return None, report
    if estimation.coordinates.inputs:
        names = ", ".join(estimation.of_inputs)
        raise InputError(
            f"likelihood = {kind!r} cannot estimate {names}: accept it with output-error first,"
            " then identify with the rig.toml that is written"
        )
    count, channels = int(estimation.mask.sum()), np.moveaxis(residuals_of(estimation, fit), -1, 0)
    limit = WHITE / np.sqrt(count / len(channels))
    if kind == "auto" and all(abs(autocorrelation(r, 1)[1]) < limit for r in channels):
        return None, report | {"reason": "white"}
    problem, size = Likelihood(estimation), estimation.size
    best = solve(problem, problem.start(fit), iterations=iterations, tolerance=1e-10)
    v, S, dv, _ = problem.at(best.z)
    process, noise = np.split(np.exp(best.z[size:]), [estimation.case.loop.plant.tanks])
    report["process_noise"] = process.tolist()
    if kind == "auto":
        present = [r[np.isfinite(r)] for r in channels]
        simple = sum(r.size * (np.log(2 * np.pi * np.mean(r**2)) + 1) for r in present)
        k = estimation.size + len(channels)
        likelihood = -0.5 * float(np.sum(v**2 / S + np.log(2 * np.pi * S)))
        more = -2 * likelihood + (k + process.size) * np.log(count)
        bic = {"output-error": float(simple + k * np.log(count)), "innovations": float(more)}
        report |= {"reason": "bic", "bic": bic}
        if bic["output-error"] <= bic["innovations"]:
            return None, report
    # of the mean of the readings alone: that of S tells little of the parameters
    root = np.sqrt(S)
    parts = {"residual": v / root, "jacobian": dv[:, :size] / root[:, None], "z": best.z[:size]}
    return (dataclasses.replace(best, **parts), noise), report | {"kind": "innovations"}
