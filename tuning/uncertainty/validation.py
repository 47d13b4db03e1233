"""Values before and after tuning on a validation set: perturbed plants with other noise."""

import jax
import numpy as np

from jaxtank import measures as ms
from jaxtank.core.tree import get_value, with_values
from tuning.problem.scenarios import ScenarioRun, groups_of, values_of
from tuning.problem.tracking import lost_runs
from tuning.uncertainty.distributions import Correlated
from tuning.uncertainty.draws import Draws

SEED_OFFSET = 1_000_003  # between the seeds of validation and search

SIDES = ("before", "after")


def perturbed(problem, samples, seed):
    """Return `samples` ScenarioRuns that the search does not use."""
    rng, case, runs = np.random.default_rng([SEED_OFFSET, seed]), problem.case, []
    for i in range(samples):
        run = problem.runs[i % len(problem.runs)]
        loop, key = run.case.loop, run.key
        for name, spread in case.uncertain.items():
            value = np.asarray(get_value(loop, name))
            factor = 1.0 + spread * rng.uniform(-1.0, 1.0, value.shape)
            loop = with_values(loop, {name: value * factor})
        if case.covariance is not None:
            names, matrix = case.covariance
            draws = Draws(loop, {"identified": Correlated(names=names, covariance=matrix)})
            values = draws.values(rng.uniform(size=(1, len(names))))
            loop = with_values(loop, {name: value[0] for name, value in values.items()})
        if key is not None:
            key = jax.random.fold_in(jax.random.key(SEED_OFFSET + seed), i)
        perturbed_case = run.case.replace(loop=loop)
        runs.append(ScenarioRun(f"validation {i + 1}", perturbed_case, key, 1.0 / samples))
    return runs


def validate(problem, before, after, samples, seed):
    """Run the values `before` and `after` on `samples` perturbed runs; returns as `summary_of`."""
    runs, scenarios = perturbed(problem, samples, seed), len(problem.runs)
    points = {n: np.array([before[n], after[n]]) for n in problem.names}
    costs, feasible = np.zeros((samples, 2)), np.ones((samples, 2), dtype=bool)
    diverged, astray = np.zeros(samples, dtype=bool), np.zeros((samples, 2), dtype=bool)
    levels = np.zeros((samples, 2, problem.loop.plant.tanks))
    tracked = [name for name in ms.TRACKED if ms.serves(name, problem.loop)]
    names = tuple(dict.fromkeys([*problem.needed, "max_level", *tracked]))
    for group in groups_of(runs):
        measures, flags = values_of(group, names, points)
        measures, flags = {m: np.asarray(v) for m, v in measures.items()}, np.asarray(flags)
        for j, i in enumerate(group.runs):
            limits = [limit for limit in problem.limits if limit.run == i % scenarios]
            diverged[i] = flags[:, j].any()
            for side in (0, 1):
                row = {m: v[side, j] for m, v in measures.items()}
                costs[i, side], levels[i, side] = problem.cost(row), row["max_level"]
                feasible[i, side] = all(limit.margin(row) >= 0 for limit in limits)
                astray[i, side] = lost_runs(runs[i].case.loop, row, diverged[i])
    noise = any(run.key is not None for run in runs)
    spread = {n: float(s) for n, s in problem.case.uncertain.items()}
    return summary_of(problem.limits, costs, feasible, levels, diverged, spread, noise, astray)


def summary_of(limits, costs, feasible, levels, diverged, spread, noise, astray):
    """Return (summary, cloud) of runs before and after tuning, on the same draws."""
    good = ~diverged & np.isfinite(costs).all(axis=1)
    both = good & feasible.all(axis=1)
    summary = {
        "samples": len(costs),
        "spread": spread,
        "noise": noise,
        "failed": int((~good).sum()),
        "objective": {name: _quantiles(costs[good, side]) for side, name in enumerate(SIDES)},
        "better_share": _share(costs[good, 1] < costs[good, 0]),
        "limits_held": {name: _share(feasible[good, side]) for side, name in enumerate(SIDES)},
        "setpoints_kept": {name: _share(~astray[good, side]) for side, name in enumerate(SIDES)},
        "comparable": _share(both[good]),
        "better_share_of_comparable": _share(costs[both, 1] < costs[both, 0]),
    }
    limits = {limit.index: limit.value for limit in limits if limit.measure == "max_level"}
    levels = levels[good][:, :, sorted(limits) if limits else slice(None)]
    differ = len(set(limits.values())) > 1
    if differ:  # tanks with different limits: the largest excess over a limit
        levels = levels - np.array([limits[i] for i in sorted(limits)])
    return summary, {
        "objective": costs[good],
        "level": levels.max(axis=2) if levels.size else np.zeros((0, 2)),
        "limit": 0.0 if differ else next(iter(limits.values()), None),
        "past": differ,
        "held": feasible[good],
    }


def _quantiles(column):
    """Return the mean and quantiles of the costs of one side; NaN where there are none."""
    column = column if column.size else np.array([np.nan])
    values = (column.mean(), *np.quantile(column, (0.05, 0.5, 0.95)))
    return dict(zip(("mean", "p05", "p50", "p95"), map(float, values)))


def _share(flags):
    """Return the share of True among flags; None where there are none."""
    return float(np.mean(flags)) if flags.size else None
