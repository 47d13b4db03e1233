"""Inputs that change between the rows of a log: when, is a random number within each step."""

import copy
import dataclasses
from typing import Any

import numpy as np
from scipy.linalg import block_diag

from tuning.identification import simulation
from tuning.identification.experiment import Log
from tuning.identification.least_squares import Fit, solve
from tuning.identification.problem import Estimation
from tuning.identification.residuals import at_samples, autocorrelation, weighting_noise

MEAN, SD = 0.5, 12.0**-0.5  # of a moment anywhere in the step before its row [steps]
FEWEST, MOST = 3, 300  # changes of the inputs of a log whose moments are estimated
SHARE = 0.25  # share of the rows with a change, above which a controller sets the inputs
STEP = 0.1  # change of a moment by which slopes are computed [steps]
LANES = 16  # runs side by side, one program
CORRELATED = 0.3  # autocorrelation at lag 1 below which residuals count as noise [-]
ROUNDS, SETTLED = 5, 0.02  # most linearisations; change of a moment that ends them [steps]


class Moments:
    """Slopes of the readings of an Estimation by the moments of its changes, at some moments.

        r = W^(1/2) (y(theta, s) - S (s - 1/2) - y_k)/sigma,   W = (1 + S R R' S')^-1

    With these residuals least squares are those of theta alone, over all moments s of a normal
    distribution of covariance R R': 1/12 for each, as of a uniform one, and 1/12 for the mean of
    each input of each log, whose changes may all come at one part of a step.
    """

    def __init__(self, slopes, shares, channels, groups):
        self.slopes, self.shares = slopes, shares  # (rows, changes), (changes,) [steps]
        self.channels, apart = channels, np.eye(len(groups))  # (rows,) of each reading
        together = groups[:, None] == np.unique(groups)  # (changes,) input and log of each
        self.root = SD * np.concatenate([apart, together], axis=1)  # R
        self.factors: dict[bytes, Any] = {}

    def _factors(self, noise):
        """(weighted slopes, Q (rows, k), singular values (k,)) of slopes in standard deviations."""
        if (key := np.asarray(noise).tobytes()) not in self.factors:
            weighted = self.slopes / np.asarray(noise)[self.channels, None]
            q, values, _ = np.linalg.svd(weighted @ self.root, full_matrices=False)
            self.factors[key] = weighted, q, values
        return self.factors[key]

    def whitened(self, rows: np.ndarray, noise: np.ndarray) -> np.ndarray:
        """Return W^(1/2) times rows (rows, ...) that are weighted by the noise."""
        q, shrink = self.whitening(noise)
        return rows - q @ (shrink.reshape(-1, *[1] * (rows.ndim - 1)) * (q.T @ rows))

    def whitening(self, noise: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return (Q (rows, k), d (k,)) of W^(1/2) = 1 - Q d Q'."""
        _, q, values = self._factors(noise)
        return q, 1.0 - 1.0 / np.sqrt(1.0 + values**2)

    def shift(self, noise: np.ndarray) -> np.ndarray:
        """Return (rows,) by which readings at these moments differ from those at mean moments."""
        return self._factors(noise)[0] @ (self.shares - MEAN)

    def penalty(self, noise: np.ndarray) -> float:
        """Return log det(1 + S R R' S'), what the freedom of the moments costs in likelihood."""
        return float(np.sum(np.log1p(self._factors(noise)[2] ** 2)))

    def most_likely(self, whitened: np.ndarray, noise: np.ndarray) -> np.ndarray:
        """Return (changes,) moments in [0, 1] of a whitened residual (rows,)."""
        # R R' S' W r = R R' S' W^(1/2) (W^(1/2) r)
        slopes = self.whitened(self._factors(noise)[0], noise)
        return np.clip(MEAN - self.root @ (self.root.T @ (slopes.T @ whitened)), 0.0, 1.0)


def changes(log: Log) -> list[tuple[int, int]]:
    """Return [(row, input)] of the changes of a Log."""
    return [(int(k) + 1, int(j)) for k, j in np.argwhere(np.diff(log.u, axis=0) != 0.0)]


def are_open(log: Log, case: Any) -> bool:
    """Whether inputs of a Log may have changed between its rows, at moments that can be told."""
    count = len(changes(log))
    stated = log.hold and log.assumed.get("inputs") != "lines"
    few = FEWEST <= count <= min(MOST, SHARE * log.samples)
    return few and not stated and getattr(case.loop.actuator, "rate", None) is None


def too_many(log: Log) -> bool:
    """Whether a Log has more changes between its rows than moments are estimated."""
    return log.hold == "" and MOST < len(changes(log)) <= SHARE * log.samples


def with_shares(log: Log, shares: np.ndarray) -> Log:
    """Return a Log whose changes came by shares (changes,) of a step before their rows."""
    early = np.zeros(log.u.shape)
    for (k, j), share in zip(changes(log), shares):
        early[k, j] = share * (log.t[k] - log.t[k - 1])
    assumed = {**log.assumed, "inputs": "moments"}
    return dataclasses.replace(log, early=early, hold="zero-order", assumed=assumed)


def shares_of(log: Log) -> np.ndarray:
    """Return (changes,) shares of a step by which the changes of a Log came before their rows."""
    if log.early is None:
        return np.full(len(changes(log)), 0.0)
    return np.array([log.early[k, j] / (log.t[k] - log.t[k - 1]) for k, j in changes(log)])


def _moments_of(estimation, z):
    """The Moments of an Estimation at unknowns z and at the moments of its logs."""
    blocks, shares, groups = [], [], []
    for e, log in enumerate(estimation.logs):
        if log.early is None:
            blocks.append(np.zeros((int(estimation.mask[e].sum()), 0)))
            continue
        blocks.append(_slopes(estimation, e, z))
        shares.append(shares_of(log))
        groups += [e * log.u.shape[1] + j for _, j in changes(log)]
    channels = np.nonzero(estimation.mask)[2]
    return Moments(block_diag(*blocks), np.concatenate(shares), channels, np.array(groups))


def _slopes(estimation, e, z):
    """(readings, changes) slopes of the readings of log e by the shares of its changes."""
    log, alone = estimation.logs[e], estimation.of_log(e)
    shares = shares_of(log)
    steps = np.where(shares > 0.5, -STEP, STEP)
    others = [with_shares(log, shares + step * row) for step, row in zip(steps, np.eye(len(steps)))]
    p, levels = estimation.split(z)
    at = np.concatenate([p, levels[e] / alone.level_scale])
    base, rows = _played(alone, [log], at)[0], []
    for begin in range(0, len(others), LANES):
        lanes = [*others[begin : begin + LANES], *[log] * LANES][:LANES]
        rows += [*_played(alone, lanes, at)][: len(others) - begin]
    slopes = np.stack([(y - base) / step for y, step in zip(rows, steps)], axis=-1)
    return slopes[alone.mask[0]]


def _played(alone, logs, z):
    """(logs, samples, channels) readings of the Estimation of one log for other inputs of it."""
    data = _data(alone, logs)
    u, first = alone.inputs_at(alone.split(z)[0], data), alone.first_levels(z)
    run = (alone.rig_at(z), data.dt, u, np.repeat(first, len(logs), axis=0))
    channels = alone.data.channels
    return np.asarray(simulation.play(*run, channels=channels, substeps=alone.substeps))


def _data(estimation, logs):
    """The PaddedData of an Estimation with other logs, as many or all in place of its one."""
    loop, dt, flows = estimation.case.loop, estimation.case.clock.dt, estimation.data.flows
    courses = simulation.courses_of(logs, loop.actuator, dt)
    delays, samples = simulation.delays_of(loop.actuator), estimation.mask.shape[1]
    if flows is not None:
        flows = np.repeat(flows, len(logs) // len(flows), axis=0)
    return simulation.padded(logs, delays, samples, courses)._replace(flows=flows)


def _with_logs(estimation, logs):
    """A copy of an Estimation with the same readings at other moments of the inputs."""
    other = copy.copy(estimation)
    other.logs, other.data, other.moments = logs, _data(estimation, logs), None
    return other


def fitted(estimation: Estimation, fit: Fit, **settings: Any) -> tuple[Estimation, Fit]:
    """Return the Estimation over the moments of its logs, and its Fit, from another Fit."""
    if all(log.early is None for log in estimation.logs):
        return estimation, fit
    for turn in range(ROUNDS):
        z = estimation.unknowns(fit)
        estimation = _with_logs(estimation, estimation.logs)
        estimation.moments = moments = _moments_of(estimation, z)
        fit = solve(estimation, z, **settings)
        if not np.isfinite(fit.cost) or turn == ROUNDS - 1:
            break
        shares = moments.most_likely(fit.residual, estimation.noise)
        if np.max(np.abs(shares - moments.shares)) < SETTLED:
            break
        logs, parts = [], iter(shares)
        for log in estimation.logs:
            of_log = [next(parts) for _ in changes(log)] if log.early is not None else []
            logs.append(with_shares(log, np.array(of_log)) if of_log else log)
        estimation = _with_logs(estimation, logs)
    return estimation, fit


def _leaves_noise(estimation, fit):
    """Whether the whitened residuals of every channel are hardly correlated."""
    rows = np.moveaxis(at_samples(estimation, fit.residual), -1, 0)
    return all(autocorrelation(r, 1)[1] < CORRELATED for r in rows)


def with_mean(estimation: Estimation, counts: list[int]) -> Estimation:
    """Return an Estimation whose changes from sample `counts` of each log on come at mean moments,
    where their readings have determined none.
    """
    if all(log.early is None for log in estimation.logs):
        return estimation
    logs = []
    for log, count in zip(estimation.logs, counts):
        rows = np.array([k for k, _ in changes(log)])
        shares = np.where(rows < count, shares_of(log), MEAN)
        logs.append(log if log.early is None else with_shares(log, shares))
    return _with_logs(estimation, logs)


def misfit(alone: Estimation, z: np.ndarray, log: Log, **settings: Any) -> tuple[float, Log]:
    """Return (half the sum of squares in the noise of `alone`, times what the freedom of the
    moments costs; the Log with the most likely moments) of one log, from unknowns z; infinite where
    what they leave is no noise.
    """
    first = with_shares(log, np.full(len(changes(log)), MEAN))
    other = _with_logs(alone, [first])
    estimation, fit = fitted(other, solve(other, z, **settings), **settings)
    if np.isfinite(fit.cost):  # without the misfit the noise is seen
        estimation.noise = weighting_noise(estimation, fit)
        estimation, fit = fitted(estimation, fit, **settings)
    if not np.isfinite(fit.cost) or not _leaves_noise(estimation, fit):
        return np.inf, first
    readings = alone.mask.sum(axis=(0, 1))
    penalty = estimation.moments.penalty(estimation.noise)
    penalty += 2.0 * float(readings @ np.log(estimation.noise / alone.noise))
    cost = 0.5 * float(fit.residual @ fit.residual)
    return cost * float(np.exp(min(penalty / readings.sum(), 700.0))), estimation.logs[0]
