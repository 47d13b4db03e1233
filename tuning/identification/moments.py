"""Inputs that change between the rows of a log: when, is a random number within each step."""

import copy
import dataclasses
import itertools
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from scipy.linalg import cholesky, solve_triangular

from tuning.identification import simulation
from tuning.identification.data_checks import assuming
from tuning.identification.experiment import Log
from tuning.identification.least_squares import Fit, solve
from tuning.identification.problem import Estimation
from tuning.identification.residuals import at_samples, autocorrelation, rms_of, weighting_noise

MEAN, SD = 0.5, 12.0**-0.5  # of a moment anywhere in the step before its row [steps]
FEWEST, MOST = 3, 2000  # changes of the inputs of a log whose moments are estimated
LARGEST = 8_000_000  # readings times changes, and readings squared, of a log
SHARE = 0.25  # share of the rows with a change, above which a controller sets the inputs
PART, LONGEST = 500, 20_000  # rows of a part of a longer log of a controller; of that log, at most
SLOW = ("rate", "lag", "delay", "delays")  # of a pump that does not follow its input at once
TURN = 0.25  # autocorrelation of the changes of an input below minus which it turns back [-]
JUMP = 5.0  # median changes of an input, above which a change is a jump
BETWEEN = 1.25  # sampling periods of the rig, above which a controller acts between two rows
GAP, EVEN = 1.5, 0.7  # usual steps, above which rows are missing; least share of usual steps [-]
MOST_GAPS = 50  # at which a log is cut
STEP = 0.1  # change of a moment by which slopes are computed [steps]
LANES = 16  # runs side by side, one program
CORRELATED = 0.3  # autocorrelation at lag 1 below which residuals count as noise [-]
ROUNDS, SETTLED = 5, 0.02  # most linearisations; change of a moment that ends them [steps]


class OfLog(NamedTuple):
    """Slopes of the readings of one log by the moments of its changes."""

    slopes: np.ndarray  # (readings, changes) per step
    shares: np.ndarray  # (changes,) moments at which the slopes are [steps]
    channels: np.ndarray  # (readings,)
    groups: np.ndarray  # (changes,) those of a group may all come at one part of a step


class Moments:
    """Slopes of the readings of an Estimation by the moments of its changes, at some moments.

        r = L^-1 (y(theta, s) - S (s - 1/2) - y_k)/sigma,   L L' = 1 + S R R' S'

    With these residuals least squares are those of theta alone, over all moments s of a normal
    distribution of covariance R R': 1/12 for each, as of a uniform one, and 1/12 for the mean of
    each group of each log, whose changes may all come at one part of a step.
    """

    def __init__(self, logs: Sequence[OfLog]):
        self.logs = logs
        self.rows = np.cumsum([len(log.channels) for log in logs])[:-1]  # at which logs begin
        self.changes = np.cumsum([len(log.shares) for log in logs])[:-1]
        self.shares = np.concatenate([log.shares for log in logs])
        self.factors: dict[bytes, Any] = {}

    def _factors(self, noise):
        """[(slopes in standard deviations, L)] of each log."""
        if (key := np.asarray(noise).tobytes()) not in self.factors:
            self.factors = {}
            weighted = [log.slopes / np.asarray(noise)[log.channels, None] for log in self.logs]
            self.factors[key] = [(v, _root(v, log)) for v, log in zip(weighted, self.logs)]
        return self.factors[key]

    def whitened(self, rows: np.ndarray, noise: np.ndarray) -> np.ndarray:
        """Return L^-1 times rows (rows, ...) that are weighted by the noise."""
        parts = zip(self.roots(noise), np.split(rows, self.rows))
        solved = [solve_triangular(root, part, lower=True) for root, part in parts if len(part)]
        return np.concatenate(solved)

    def roots(self, noise: np.ndarray) -> list[np.ndarray]:
        """Return L (readings, readings) of each log."""
        return [root for _, root in self._factors(noise)]

    def shift(self, noise: np.ndarray) -> np.ndarray:
        """Return (rows,) by which readings at these moments differ from those at mean moments."""
        parts = zip(self._factors(noise), self.logs)
        return np.concatenate([slopes @ (log.shares - MEAN) for (slopes, _), log in parts])

    def penalty(self, noise: np.ndarray) -> float:
        """Return log det(1 + S R R' S'), what the freedom of the moments costs in likelihood."""
        return float(sum(2.0 * np.sum(np.log(np.diag(root))) for root in self.roots(noise)))

    def most_likely(self, whitened: np.ndarray, noise: np.ndarray) -> np.ndarray:
        """Return (changes,) moments in [0, 1] of a whitened residual (rows,)."""
        shares = []
        parts = zip(self.logs, self._factors(noise), np.split(whitened, self.rows))
        for log, (slopes, root), part in parts:
            apart = slopes.T @ solve_triangular(root, part, lower=True, trans=1)
            shares.append(MEAN - SD**2 * (apart + _together(log) @ (_together(log).T @ apart)))
        return np.clip(np.concatenate(shares), 0.0, 1.0)


def _together(log):
    """(changes, groups) 1 where a change is of a group."""
    return (log.groups[:, None] == np.unique(log.groups)).astype(float)


def _root(slopes, log):
    """L (readings, readings) of weighted slopes (readings, changes): R = SD (1, _together)."""
    means = slopes @ _together(log)
    covariance = SD**2 * (slopes @ slopes.T + means @ means.T)
    covariance[np.diag_indices_from(covariance)] += 1.0
    return cholesky(covariance, lower=True, overwrite_a=True)


def changes(log: Log) -> np.ndarray:
    """Return (changes, 2) row and input of each change of a Log."""
    return np.argwhere(np.diff(log.u, axis=0) != 0.0) + [1, 0]


def groups_of(log: Log) -> np.ndarray:
    """Return (changes,) a number of each group: of each input the jumps, which may be those of
    setpoints, and the other changes.
    """
    rows, inputs = changes(log).T
    sizes = np.abs(log.u[rows, inputs] - log.u[rows - 1, inputs])
    usual = [np.median(sizes[inputs == j]) if j in inputs else 0.0 for j in range(log.u.shape[1])]
    return 2 * inputs + (sizes > JUMP * np.array(usual)[inputs])


def are_open(log: Log, case: Any) -> bool:
    """Whether inputs of a Log may have changed between its rows, at moments that can be told."""
    stated = log.hold and log.assumed.get("inputs") != "lines"
    slow = getattr(case.loop.actuator, "rate", None) is not None
    return not stated and not slow and len(changes(log)) >= FEWEST and not _too_large(log)


def _too_large(log):
    readings, count = int(np.isfinite(log.y).sum()), len(changes(log))
    return count > MOST or readings * max(readings, count) > LARGEST


def too_many(log: Log) -> bool:
    """Whether a Log has more changes between its rows than moments are estimated."""
    return log.hold == "" and len(changes(log)) >= FEWEST and _too_large(log)


def of_controller(log: Log) -> bool:
    """Whether a controller sets the inputs of a Log: they change from row to row."""
    return len(np.unique(changes(log)[:, 0])) > SHARE * log.samples


def acts_between(log: Log, case: Any) -> bool:
    """Whether a controller sets the inputs of a Log, more often than it has rows."""
    often = float(np.median(np.diff(log.t))) > BETWEEN * case.clock.dt
    return often and of_controller(log)


def in_parts(logs: Sequence[Log], case: Any) -> list[Log]:
    """Return Logs, each of a controller that acts between its rows in parts with levels of their
    own at their first rows, where it has more changes than moments are estimated of at once.
    """
    return [part for log in logs for part in _parts(log, case)]


def _parts(log, case):
    if log.hold or log.samples > LONGEST or not _may_begin_anywhere(log, case):
        return [log]
    if not (_too_large(log) and acts_between(log, case)):
        return [log]
    ends = np.linspace(0, log.samples, -(-log.samples // PART) + 1).round().astype(int).tolist()
    return _cut(assuming(log, "parts", "own levels"), itertools.pairwise(ends))


def _cut(log, pairs):
    """Parts of a Log, rows a to b - 1 of each pair, with levels of their own at their first."""
    return [
        dataclasses.replace(log.part(a, b), name=f"{log.name}, rows {a + 1} to {b}")
        for a, b in pairs
        if b - a > 1
    ]


def _may_begin_anywhere(log, case):
    """Whether levels at the first row of a part of a Log are all that rows before it decide."""
    loop = case.loop
    # t = 0 of a varying inflow, or of the plant, is the first row where no date says another
    moved = simulation.varies(loop.disturbance)
    moved = moved and simulation.time_between(case.begins, log) is None
    numbers = [getattr(loop.actuator, name, None) for name in SLOW]
    slow = any(value is not None and np.any(value) for value in numbers)
    return not (moved or loop.plant.depends_on_time or slow)


def without_gaps(logs: Sequence[Log], case: Any) -> list[Log]:
    """Return Logs, cut where rows are missing in which an input has changed: when is not told."""
    return [part for log in logs for part in _without_gaps(log, case)]


def _without_gaps(log, case):
    steps = np.diff(log.t)
    usual = np.median(steps)
    even = np.abs(steps - usual) < 0.01 * usual
    on_change = np.mean(even) < EVEN  # rows of such a log are far apart
    if on_change or log.samples > LONGEST or of_controller(log):
        return [log]
    changed = np.any(np.diff(log.u, axis=0) != 0.0, axis=1)
    lost, ends = _held_over(log)
    ends = np.union1d(ends, 1 + np.flatnonzero(changed & (steps > GAP * usual))).astype(int)
    lines = log.hold == "first-order" and log.assumed.get("inputs") != "lines"  # as stated
    if not ends.size or lines:
        return [log]
    if len(ends) > MOST_GAPS or not _may_begin_anywhere(log, case):
        return [assuming(log, "gaps", "at rows")]
    begins, known = [0, *ends.tolist()], ~lost
    stops = [a + int(np.argmin([*known[a:b], False])) for a, b in zip(begins, [*ends, len(known)])]
    return _cut(assuming(log, "parts", "gaps"), zip(begins, stops))


def _held_over(log):
    """((samples,) whether a missing value hides when an input changed, the samples after these)."""
    lost, ends = np.zeros(log.samples, dtype=bool), list[int]()
    for u, unknown in zip(log.u.T, [] if log.unknown is None else log.unknown.T):
        edges = np.flatnonzero(np.diff(unknown, prepend=False, append=False)).reshape(-1, 2)
        for a, b in edges.tolist():
            if a > 0 and b < log.samples and u[a - 1] != u[b]:
                lost[a:b] = True
                ends.append(b)
    return lost, ends


def turns_back(log: Log) -> bool:
    """Whether inputs that a controller sets jump and return from row to row."""
    moves = np.diff(log.u, axis=0)
    together, size = np.sum(moves[1:] * moves[:-1], axis=0), np.sum(moves**2, axis=0)
    return of_controller(log) and bool(np.any(together < -TURN * size))


def with_shares(log: Log, shares: np.ndarray) -> Log:
    """Return a Log whose changes came by shares (changes,) of a step before their rows."""
    early = np.zeros(log.u.shape)
    rows, inputs = changes(log).T
    early[rows, inputs] = shares * np.diff(log.t)[rows - 1]
    assumed = {**log.assumed, "inputs": "moments"}
    return dataclasses.replace(log, early=early, hold="zero-order", assumed=assumed)


def shares_of(log: Log) -> np.ndarray:
    """Return (changes,) shares of a step by which the changes of a Log came before their rows."""
    rows, inputs = changes(log).T
    if log.early is None:
        return np.zeros(len(rows))
    return log.early[rows, inputs] / np.diff(log.t)[rows - 1]


def _moments_of(estimation, z):
    """The Moments of an Estimation at unknowns z and at the moments of its logs."""
    logs = []
    for e, log in enumerate(estimation.logs):
        channels, count = np.nonzero(estimation.mask[e])[1], 0
        slopes, shares, groups = np.zeros((channels.size, count)), np.zeros(count), np.zeros(count)
        if log.early is not None:
            slopes, shares, groups = _slopes(estimation, e, z), shares_of(log), groups_of(log)
        logs.append(OfLog(slopes, shares, channels, groups))
    return Moments(logs)


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


def fitted(
    estimation: Estimation, fit: Fit, rounds: int = ROUNDS, **settings: Any
) -> tuple[Estimation, Fit]:
    """Return the Estimation over the moments of its logs, and its Fit, from another Fit."""
    if all(log.early is None for log in estimation.logs):
        return estimation, fit
    for turn in range(rounds):
        z = estimation.unknowns(fit)
        estimation = _with_logs(estimation, estimation.logs)
        estimation.moments = moments = _moments_of(estimation, z)
        fit = solve(estimation, z, **settings)
        if not np.isfinite(fit.cost) or turn == rounds - 1:
            break
        shares = moments.most_likely(fit.residual, estimation.noise)
        if np.max(np.abs(shares - moments.shares)) < SETTLED:
            break
        parts = zip(estimation.logs, np.split(shares, moments.changes))
        logs = [log if log.early is None else with_shares(log, of_log) for log, of_log in parts]
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
        shares = np.where(changes(log)[:, 0] < count, shares_of(log), MEAN)
        logs.append(log if log.early is None else with_shares(log, shares))
    return _with_logs(estimation, logs)


def misfit(alone: Estimation, z: np.ndarray, log: Log, **settings: Any) -> tuple[float, Log, Any]:
    """Return (half the sum of squares in the noise of `alone`, times what the freedom of the
    moments costs; the Log with the most likely moments; (channels,) RMS residual with these) of one
    log, from unknowns z; infinite where what they leave is no noise.
    """
    first = with_shares(log, np.full(len(changes(log)), MEAN))
    other = _with_logs(alone, [first])
    estimation, fit = fitted(other, solve(other, z, **settings), rounds=1, **settings)
    if not np.isfinite(fit.cost) or not _leaves_noise(estimation, fit):
        return np.inf, first, np.inf  # more rounds are many runs, and hardly ever change this
    estimation, fit = fitted(estimation, fit, **settings)
    if np.isfinite(fit.cost):  # without the misfit the noise is seen
        estimation.noise = weighting_noise(estimation, fit)
        estimation, fit = fitted(estimation, fit, **settings)
    if not np.isfinite(fit.cost) or not _leaves_noise(estimation, fit):
        return np.inf, first, np.inf
    readings = alone.mask.sum(axis=(0, 1))
    penalty = estimation.moments.penalty(estimation.noise)
    penalty += 2.0 * float(readings @ np.log(estimation.noise / alone.noise))
    cost = 0.5 * float(fit.residual @ fit.residual)
    cost *= float(np.exp(min(penalty / readings.sum(), 700.0)))
    return cost, estimation.logs[0], rms_of(estimation, fit)
