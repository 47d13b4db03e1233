"""Sensitivity of any function on the unit cube: designs and estimators, plain arrays in and out.

Elementary effects: Morris, Technometrics 33(2) 1991, 161; their absolute mean: Campolongo, Cariboni
and Saltelli, Environ. Model. Softw. 22(10) 2007, 1509. Shares of the variance: Saltelli et al.,
Comput. Phys. Commun. 181(2) 2010, 259, first order by its table 2 (b), total order by Jansen's
estimator, its table 2 (f).
"""

import numpy as np
from scipy import stats

LEVELS = 4  # of Morris' grid; with a step of 2/3 all levels are equally likely

RESAMPLES = 1000  # bootstrap resamples of an interval
BLOCK = 1 << 22  # bootstrap weights held at once
FLAT = 1e-10  # standard deviation of an output, as a share of its size, that is rounding alone [-]


def sobol_points(dimensions, samples, seed):
    """Return the points that `sobol_indices` needs."""
    sequence = stats.qmc.Sobol(2 * dimensions, scramble=True, rng=np.random.default_rng(seed))
    base = sequence.random(samples)
    a, b = base[:, :dimensions], base[:, dimensions:]
    points = np.repeat(a[:, None], dimensions + 2, axis=1)
    points[:, -1] = b
    for j in range(dimensions):
        points[:, j + 1, j] = b[:, j]
    return points


def sobol_indices(y, seed=0):
    """Return the shares of the variance of y that each input has: alone and in all."""
    # S_j = mean(f(B) (f(A_Bj) - f(A))) / V, T_j = mean((f(A) - f(A_Bj))^2) / (2 V), V the variance
    # over A and B. A row with an output that is not finite is left out whole, so that what remains
    # stays paired. Source: Saltelli et al. 2010, table 2 (b) and (f).
    y = np.asarray(y, dtype=float)
    dimensions, rows = y.shape[1] - 2, y[np.isfinite(y).all(axis=1)]
    unknown = {"": np.full(dimensions, np.nan), "_interval95": np.full((dimensions, 2), np.nan)}
    indices: dict = {f"{n}{part}": v for n in ("first", "total") for part, v in unknown.items()}
    indices["kept"] = len(rows)
    if len(rows) < 2:
        return {**indices, "sd": np.nan}
    size = np.abs(rows).max() or 1.0
    rows = rows / size  # what is squared must not overflow
    rows = rows - rows.mean()  # an output far from 0 would spoil the first-order products
    a, mixed, b = rows[:, :1], rows[:, 1:-1], rows[:, -1:]
    terms = np.hstack(
        [b * (mixed - a), 0.5 * (a - mixed) ** 2, 0.5 * (a + b), 0.5 * (a * a + b * b)]
    )

    def shares(means):
        variance = means[..., -1:] - means[..., -2:-1] ** 2
        return means[..., :-2] / np.where(variance > 0, variance, np.nan), variance

    point, variance = shares(terms.mean(axis=0))
    if not variance[0] > FLAT**2:
        return {**indices, "sd": 0.0}
    ends = np.nanquantile(shares(bootstrap_means(terms, seed))[0], (0.025, 0.975), axis=0).T
    for name, entries in (("first", slice(dimensions)), ("total", slice(dimensions, None))):
        indices |= {name: point[entries], f"{name}_interval95": ends[entries]}
    return {**indices, "sd": float(size * np.sqrt(variance[0]))}


def bootstrap_means(terms, seed, resamples=RESAMPLES):
    """Return (resamples, ...) means of `terms` (n, ...) over n rows drawn with replacement."""
    n, rng, means = len(terms), np.random.default_rng(seed), []
    rows = max(1, BLOCK // n)
    for start in range(0, resamples, rows):
        count = min(rows, resamples - start)
        picks = rng.integers(n, size=(count, n)) + n * np.arange(count)[:, None]
        weights = np.bincount(picks.ravel(), minlength=count * n).reshape(count, n)
        means.append(weights @ terms / n)
    return np.concatenate(means)


def morris_points(dimensions, trajectories, seed, levels=LEVELS):
    """Return the points that `morris_effects` needs."""
    rng, step = np.random.default_rng(seed), levels / (2.0 * (levels - 1))
    base = rng.integers(levels, size=(trajectories, dimensions)) / (levels - 1)
    moved = np.clip(np.where(base < 0.5, base + step, base - step), 0.0, 1.0)
    # when each coordinate moves
    turn = rng.permuted(np.tile(np.arange(dimensions), (trajectories, 1)), axis=1)
    return np.where(
        np.arange(dimensions + 1)[:, None] > turn[:, None, :], moved[:, None, :], base[:, None, :]
    )


# outputs near the largest number come out as not finite
@np.errstate(over="ignore", invalid="ignore")
def morris_effects(points, y):
    """Return the elementary effects: change of y over the step, per unit of the cube."""
    y = np.where(np.isfinite(y), y, np.nan)
    change = np.diff(points, axis=1)
    mover = np.abs(change).argmax(axis=2)
    step = np.take_along_axis(change, mover[..., None], axis=2)[..., 0]
    effects = np.empty(mover.shape)
    np.put_along_axis(effects, mover, np.diff(y, axis=1) / step, axis=1)
    return effects


@np.errstate(over="ignore", invalid="ignore")
def morris_indices(effects):
    """Return mean, mean size and standard deviation of the elementary effects of each input."""
    dimensions = effects.shape[1]
    indices = {k: np.full(dimensions, np.nan) for k in ("mu", "mu_star", "sigma")}
    indices |= {
        k: np.full((dimensions, 2), np.nan) for k in ("mu_interval95", "mu_star_interval95")
    }
    indices["kept"] = np.isfinite(effects).sum(axis=0)
    for j, column in enumerate(effects.T):
        finite = column[np.isfinite(column)]
        if len(finite) < 2:
            continue
        half = stats.t.ppf(0.975, len(finite) - 1) / np.sqrt(len(finite))
        indices["sigma"][j] = finite.std(ddof=1)
        for name, values in (("mu", finite), ("mu_star", np.abs(finite))):
            mean, sd = values.mean(), values.std(ddof=1)
            indices[name][j] = mean
            indices[f"{name}_interval95"][j] = mean - half * sd, mean + half * sd
    indices["mu_star_interval95"] = np.maximum(indices["mu_star_interval95"], 0.0)
    return indices
