"""Tests of the model structure of a fitted rig: score tests, fits of what passes them."""

import copy
import itertools
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from scipy.stats import chi2

from jaxtank.core.tree import describe
from tuning.identification.candidates import AugmentedEstimation, with_leaves
from tuning.identification.least_squares import Fit, solve
from tuning.identification.problem import Estimation
from tuning.identification.residuals import (
    ROBUST_LIMIT,
    WHITE,
    at_samples,
    autocorrelation,
    fast_noise,
)
from tuning.identification.simulation import Inputs

ALPHA = 0.02  # significance level of a round of tests, divided among the candidates
EQUIVALENT = 6.0  # 2 log of the likelihood ratio below which two fits count as equivalent
MAX_CAUSES = 3  # most causes that are named
MAX_FITTED = 10  # most candidates that are fitted at once
ITERATIONS = 15
LEAST_GAIN = 0.01  # reduction of the sum of squares, in its mean, below which a fit has converged
STRIDE = 5  # stride through the distinct inputs in the first search for a threshold [-]
BAD_FIT = 3.0  # RMS of a residual, in noise, from which exchanged columns are tried
EXCHANGE_RATIO = 0.5  # largest ratio of sums of squares that keeps an exchange [-]


class Trial(NamedTuple):
    """A fit with some Candidates as further unknowns."""

    problem: AugmentedEstimation
    chosen: tuple[int, ...]
    point: np.ndarray  # (unknowns,)
    residual: np.ndarray  # (rows,) weighted
    jacobian: np.ndarray  # (rows, unknowns)
    loss: float  # weighted sum of squares, or twice the cost of a robust loss [-]
    effective: float  # readings that are independent of each other, by their autocorrelation [-]

    def better(self, other):
        """Return 2 log of the likelihood ratio to another Trial."""
        return self.effective * float(np.log(other.loss / self.loss))


class Cause(NamedTuple):
    """What the structure lacks: kind, place from 1, its value, and causes equivalent to it."""

    kind: str
    where: Any
    name: str
    unit: str
    value: float | None
    interval95: list[float] | None
    between: list[float] | None  # of a threshold: the inputs of the data about it
    present: float | None  # value in the rig
    delta_bic: float
    equivalent: Sequence[tuple[str, Any]]


class Diagnosis(NamedTuple):
    """Whether the structure of a rig is right."""

    clean: bool
    causes: list[Cause]
    white: bool  # whether, of each channel, autocorrelation leaves half of all readings or more


def diagnose(estimation: Estimation, fit: Fit) -> Diagnosis:
    weighted = copy.copy(estimation)
    weighted.noise = noise_of_tests(estimation, fit)
    z = estimation.unknowns(fit)
    weighted.substeps = weighted.substeps_for(z)  # fewer than of noise that was stated too small
    problem = AugmentedEstimation(weighted, z, loss=fit.loss)
    # the prior is left out of the tests: it would hide a wrong structure
    same = estimation.prior is None and weighted.substeps == estimation.substeps
    trial = trial_at(problem, (), problem.begin) if same else _fit(problem, ())
    causes, trial = _causes(trial)
    causes = [_with_value(cause, trial) for cause in causes]
    white = all(share > 0.5 for _, share in _shares(trial.problem, trial.residual))
    return Diagnosis(not causes and white, causes, white)


def explained(estimation: Estimation, z: np.ndarray) -> tuple[float, set[str]]:
    """Return (half the sum of squares with the causes that tests find from z, their kinds)."""
    problem = AugmentedEstimation(estimation, z, "linear")
    causes, trial = _causes(trial_at(problem, (), problem.begin))
    return 0.5 * trial.loss, {cause.kind for cause in causes}


def _causes(trial):
    """Return (Causes without their values, the Trial with them), one after the other."""
    causes: list[Cause] = []
    while len(causes) <= MAX_CAUSES:
        options = _fitted(trial) + ([] if causes else exchanges(trial))
        best = min(options, key=lambda t: t.loss, default=None)
        if best is None or not passes(best, trial):
            break
        cause = _cause(best, trial, options)
        same = [i for i, c in enumerate(causes) if (c.kind, c.where) == (cause.kind, cause.where)]
        if same:  # another coefficient of it
            bic = causes[same[0]].delta_bic + cause.delta_bic
            causes[same[0]] = causes[same[0]]._replace(delta_bic=bic)
        elif len(causes) == MAX_CAUSES:
            break
        else:
            causes.append(cause)
        trial = best
    return causes, trial


def unit_of(loop, candidate):
    if candidate.kind == "pump-delay":
        return "s"
    if candidate.field == "threshold":
        return loop.units[1]
    return "-" if candidate.kind == "pump-curve" else describe(loop, candidate.name)["unit"]


def noise_of_tests(estimation, fit):
    """Return (channels,) noise from sample to sample, at least a tenth of the readings'."""
    fast, noise = fast_noise(estimation, fit), estimation.noise
    return np.where(np.isfinite(fast), np.maximum(fast, 0.1 * noise), noise)


def trial_at(problem, chosen, point):
    """Return the Trial at a point, with the slopes of all unknowns."""
    problem.columns = np.arange(problem.size)
    residual, jacobian = problem.residual_and_jacobian(point)
    loss = _loss(problem.loss, residual)
    effective = max(sum(n * share for n, share in _shares(problem, residual)), 4.0)
    return Trial(problem, chosen, point, residual, jacobian, loss, effective)


def _loss(kind, residual):
    """Return twice the cost of a loss."""
    size = np.abs(residual)
    if kind == "huber":
        over = ROBUST_LIMIT * (2 * size - ROBUST_LIMIT)
        return float(np.sum(np.where(size > ROBUST_LIMIT, over, size**2)))
    if kind == "soft_l1":
        return float(2 * ROBUST_LIMIT**2 * np.sum(np.sqrt(1 + (size / ROBUST_LIMIT) ** 2) - 1))
    return float(residual @ residual)


def _fit(problem, chosen, start=None):
    """Return the Trial of a bounded search with the Candidates `chosen`."""
    z = problem.begin if start is None else start
    problem.columns = np.sort([*problem.usual, *(problem.known + i for i in chosen)])
    fixed = {i: z[i] for i in range(problem.size) if i not in problem.columns}
    least = LEAST_GAIN / int(problem.mask.sum())  # of the sum of squares, as a share of it
    return trial_at(problem, chosen, solve(problem, z, problem.loss, ITERATIONS, fixed, least).z)


def _by_channel(problem, residual):
    """Yield residuals (logs, samples) of each channel."""
    yield from np.moveaxis(at_samples(problem, residual), -1, 0)


def _shares(problem, residual):
    """Yield (readings, share of them that is independent, by their autocorrelation) by channel."""
    for r in _by_channel(problem, residual):
        n = int(np.isfinite(r).sum())
        rho = float(autocorrelation(r, 1)[1]) if n > 3 else 0.0
        rho = rho if rho > WHITE / np.sqrt(max(n, 1)) else 0.0
        yield n, (1.0 - min(rho, 0.999)) / (1.0 + rho)


def _thresholds(problem, candidate):
    """Return inputs between those that occur, below the range of a Candidate's top."""
    levels = np.unique(problem.data.u[..., candidate.where])
    between = 0.5 * (levels[1:] + levels[:-1])
    return between[(between > candidate.low) & (between < candidate.high)]


def _best_threshold(trial, i, options, basis=None):
    """Return (reduction of the sum of squares to first order, value) of the best threshold."""
    problem, c = trial.problem, trial.problem.candidates[i]
    if not len(options):
        return 0.0, c.null
    if basis is None:
        inside = [*problem.usual, *(problem.known + k for k in trial.chosen)]
        basis, _ = np.linalg.qr(trial.jacobian[:, inside])
    points = np.tile(trial.point, (1 + len(options), 1))
    points[1:, problem.known + i] = (options - c.low) / (c.high - c.low)
    y = problem.simulated(points)
    rows = trial.residual + (y - y[0])
    squares = np.sum(rows**2, axis=1) - np.sum((rows @ basis) ** 2, axis=1)
    best = int(np.argmin(squares[1:]))
    return max(float(squares[0] - squares[1 + best]), 0.0), float(options[best])


def _limit(problem):
    """Return the score that noise exceeds with probability ALPHA in a round of all candidates."""
    return chi2.isf(ALPHA / max(len(problem.candidates), 1), 1)


def passes(trial, before):
    """Whether a likelihood-ratio test prefers a Trial to one with a cause less."""
    return trial.better(before) > _limit(trial.problem)


def _fitted(trial):
    """Return Trials with one more Candidate each, those of the largest scores that pass."""
    problem, J, r = trial.problem, trial.jacobian, trial.residual
    extra = np.delete(np.arange(problem.size), problem.usual)
    basis, _ = np.linalg.qr(J[:, [*problem.usual, *extra[list(trial.chosen)]]])
    columns = J[:, extra]
    # twice: once leaves round-off in columns that are nearly in the basis
    orthogonal = columns - basis @ (basis.T @ columns)
    orthogonal -= basis @ (basis.T @ orthogonal)
    r = r - basis @ (basis.T @ r)
    size, whole = np.sum(orthogonal**2, axis=0), np.sum(columns**2, axis=0)
    apart = size > 1e-9 * np.maximum(whole, 1e-300)
    steps = np.where(apart, -(orthogonal.T @ r) / np.where(apart, size, 1.0), 0.0)
    share = trial.point[extra]
    outside = (share < 1e-9) & (steps < 0.0) | (share > 1 - 1e-9) & (steps > 0.0)
    steps[outside | np.isin(np.arange(len(extra)), trial.chosen)] = 0.0
    gains = steps**2 * size
    for i, c in enumerate(problem.candidates):
        if c.field == "threshold" and i not in trial.chosen:
            gains[i] = _best_threshold(trial, i, _thresholds(problem, c)[::STRIDE], basis)[0]
    variance = trial.loss / max(len(trial.residual) - trial.problem.size, 1)
    promising = [i for i in np.argsort(-gains) if gains[i] > variance * _limit(trial.problem)]
    return [with_candidate(trial, int(i)) for i in promising[:MAX_FITTED]]


def with_candidate(trial, i):
    problem, start = trial.problem, trial.point
    if problem.candidates[i].name in problem.by_exponent:
        z = start[problem.usual]
        problem = AugmentedEstimation(problem.original, z, problem.loss, exponents=True)
    if problem.candidates[i].field == "threshold":
        problem, c, at = trial.problem, trial.problem.candidates[i], trial.problem.known + i
        options, chosen = _thresholds(problem, c), (*trial.chosen, i)
        value = _best_threshold(trial, i, options[::STRIDE])[1]
        for _ in range(3):
            near = np.argmin(np.abs(options - value))
            value = _best_threshold(trial, i, options[max(near - STRIDE, 0) : near + STRIDE + 1])[1]
            start = trial.point.copy()
            start[at] = (value - c.low) / (c.high - c.low)
            if trial.chosen == chosen and np.isclose(trial.point[at], start[at]):
                break
            trial = _fit(problem, chosen, start)
        return trial
    return _fit(problem, (*trial.chosen, i), start)


def exchanges(trial, always=False):
    """Return Trials with two channels, or inputs, of a bad fit exchanged; `always`: of any."""
    problem, trials = trial.problem, []
    rms = [float(np.sqrt(np.nanmean(r**2))) for r in _by_channel(problem, trial.residual)]
    channels, z, pairs = problem.data.channels, trial.point[problem.usual], itertools.combinations
    others = [
        problem.exchanged(a, b, z)
        for a, b in pairs(range(len(channels)), 2)
        if channels[a][1] == channels[b][1] and (always or max(rms[a], rms[b]) >= BAD_FIT)
    ]
    if always or max(rms) >= BAD_FIT:
        pumps = range(problem.data.u.shape[-1])
        others += [problem.exchanged_inputs(a, b, z) for a, b in pairs(pumps, 2)]
    for other in others:
        nominal = other.begin.copy()
        nominal[other.usual] = other.original.nominal()
        best = min((_fit(other, (), z) for z in (nominal, other.begin)), key=lambda t: t.loss)
        trials += [best] * (always or best.loss < EXCHANGE_RATIO * trial.loss)
    return trials


def _place(trial):
    """Return (kind, place from 1) of the last cause of a Trial."""
    if not trial.chosen:
        kind, places = trial.problem.swapped
        return kind, tuple(i + 1 for i in places)
    c = trial.problem.candidates[trial.chosen[-1]]
    return c.kind, c.where + 1


def _cause(best, before, options):
    """Return the Cause of the best Trial, without its value."""
    kind, where = _place(best)
    alike = [t for t in options if t is not best and best.better(t) < EQUIVALENT]
    alike = sorted(alike, key=lambda t: t.loss)
    equivalent = [place for place in dict.fromkeys(map(_place, alike)) if place != (kind, where)]
    name, unit, present = "", "", None
    if best.chosen:
        c = best.problem.candidates[best.chosen[-1]]
        name, present = c.name, c.null
        unit = unit_of(with_leaves(best.problem.case.loop, [c.name]), c)
    bic = best.better(before) - float(np.log(best.effective)) * bool(best.chosen)
    return Cause(kind, where, name, unit, None, None, None, present, bic, equivalent)


def _with_value(cause, trial):
    """Return a Cause with its value and interval, from the Trial with all causes."""
    problem = trial.problem
    names = [c.name for c in problem.candidates]
    if cause.name not in names:
        return cause
    i = names.index(cause.name)
    inside = np.sort([*problem.usual, *(problem.known + k for k in trial.chosen)])
    J, r = trial.jacobian[:, inside], trial.residual
    scale = np.linalg.norm(J, axis=0)
    scale = np.where(scale > 0, scale, 1.0)
    covariance = np.linalg.pinv((J / scale).T @ (J / scale)) / np.outer(scale, scale)
    covariance *= float(r @ r) / max(len(r) - len(inside), 1) * len(r) / trial.effective
    at = list(inside).index(problem.known + i)
    c = problem.candidates[i]
    value = c.low + trial.point[problem.known + i] * (c.high - c.low)
    if c.kind == "pump-curve":
        return _with_exponent(cause, trial, covariance, list(inside))
    if c.field == "threshold":
        levels = np.unique(problem.data.u[..., c.where])
        ends = [float(levels[levels < value].max()), float(levels[levels > value].min())]
        return cause._replace(value=float(value), between=ends)
    half = 1.96 * float(np.sqrt(covariance[at, at])) * (c.high - c.low)
    return cause._replace(value=float(value), interval95=[float(value - half), float(value + half)])


def _with_exponent(cause, trial, covariance, inside):
    """Return a Cause with the exponent that gives the flow of its curve at half the input."""
    problem, chosen = trial.problem, [trial.problem.candidates[i] for i in trial.chosen]
    rows = [c for c in chosen if c.kind == cause.kind and c.where + 1 == cause.where]
    names = [c.name for c in problem.candidates]
    at = [problem.known + names.index(c.name) for c in rows]
    ranges = np.array([c.high - c.low for c in rows])
    values = np.array([c.low for c in rows]) + trial.point[at] * ranges
    exponent = lambda v: -float(np.log2(Inputs(**{c.field: x for c, x in zip(rows, v)}).curve(0.5)))
    value, steps = exponent(values), 1e-6 * np.eye(len(rows))
    slopes = np.array([exponent(values + step) - value for step in steps]) / 1e-6 * ranges
    entries = [inside.index(i) for i in at]
    sd = float(np.sqrt(slopes @ covariance[np.ix_(entries, entries)] @ slopes))
    return cause._replace(value=value, interval95=[value - 1.96 * sd, value + 1.96 * sd])
