"""What is said of an answer besides the answer: what it feels, where it is flat, what it is the
mirror of, how it does on rigs unseen.
"""

import dataclasses
import math
import warnings
from typing import Any

import jax
import numpy as np

from jaxtank import measures as ms
from jaxtank.core.errors import InputError
from jaxtank.core.tree import get_value, with_values
from jaxtank.loop import run as lp
from jaxtank.loop.step_size import StepWarning, check_run, step_warnings
from tuning.problem import scenarios as sc
from tuning.uncertainty.distributions import Correlated
from tuning.uncertainty.draws import Draws

MOST = 16
"""Runs that are made to see whether a level is thrown up in one."""


def of_answer(problem, tuned, values, key=None):
    """[] where the steps of the tuned case and of its scenarios are short enough, else one
    sentence: which run is wrong, for a level was thrown up in it; or, where none was, what would
    happen to a tank that runs empty. Runs are made only where there are doubts.

    values: {parameter: the answer's}; key: of the sensor noise of the case's own run.
    """
    lanes = problem.lanes[:MOST] if problem.scenarios else ()
    runs = [("", tuned.loop, tuned.clock, key)]
    runs += [
        (f"scenario {lane.name}: ", with_values(lane.case.loop, values), lane.case.clock, lane.key)
        for lane in lanes
    ]
    told = []
    for name, loop, clock, own in runs:
        found = step_warnings(loop, clock)
        if found and (why := _unstable(loop, clock, own)):
            return [f"{name}this answer's run is wrong, and so are its numbers: {why}"]
        told += [f"{name}{sentence}" for sentence in found]
    return told[:1]


def _unstable(loop, clock, key):
    """What `check_run` says of the run of a loop; None where it is right."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", StepWarning)  # the sentence says it
        run = lp.simulate(loop, clock, key)
    try:
        check_run(loop, clock, run)
    except InputError as error:
        return str(error)
    return None


STEP = 1e-4
"""Step of the differences of the gradient, in the unit cube [-]."""

LARGEST_CURVATURE = 24
"""Number of parameters up to which the second derivative is looked into."""

HELD_OUT = 1_000_003
"""Offset of the seeds of the validation from those of the search."""


def felt(problem, z):
    """Percent by which the objective changes when each parameter alone goes 10 % up or down (of its
    range where that is linear).
    """
    trials = [z]
    for i, b in enumerate(problem.bounds):
        value = float(b.from_unit(z[i]))
        for factor in (-0.1, 0.1):
            moved = b.to_unit(value * (1 + factor)) if b.scale == "log" else z[i] + factor
            trials.append(np.where(np.arange(len(z)) == i, np.clip(moved, 0.0, 1.0), z))
    costs, _ = problem.screen(np.array(trials))
    with np.errstate(divide="ignore", invalid="ignore"):  # a cost of 0 has no percent
        change = 100 * np.abs(costs[1:] / costs[0] - 1).reshape(-1, 2).max(axis=1)
    return [float(c) if np.isfinite(c) else None for c in change]


def unexercised(problem, search, first):
    """Return (P,) True for each parameter that no run exercises at the best point of a Search.

    Such a parameter (a knot of a schedule outside the range of the setpoints) has no slope in the
    cost, in a limit or in a scenario, and no reported measure changes with its value. The best
    point is replaced by one where these parameters have their values at `first` (P,), the start.
    """
    point = search.best
    flat = ~np.any(np.vstack([point.gradient, point.margin_slopes, point.lane_slopes]), axis=0)
    idle = np.zeros(len(first), dtype=bool)
    if not flat.any():
        return idle
    names, here = (
        tuple(m for m in ms.reported() if ms.serves(m, problem.loop)),
        table_of(problem, problem.values(point.z)),
    )

    def same(which):
        away = np.where(point.z < 0.5, point.z + 0.4, point.z - 0.4)
        tables = [
            table_of(problem, problem.values(np.where(which, z, point.z))) for z in (first, away)
        ]
        return all(
            np.allclose(row[m], old[m], rtol=1e-9, atol=1e-12, equal_nan=True)
            for table in tables
            for row, old in zip(table, here)
            for m in names
        )

    if same(flat):
        idle = flat
    elif flat.sum() > 1:
        idle = np.array([bool(f) and same(np.arange(len(first)) == i) for i, f in enumerate(flat)])
    kept = search.point(np.where(idle, first, point.z))
    if kept.finite and search.violation(kept) <= search.violation(point) * (1 + 1e-9):
        search.best = kept
        return idle
    return np.zeros(len(first), dtype=bool)


def curvature(problem, search, point, idle=None):
    """The second derivative of the scaled cost at an answer, along the directions that active
    limits and bounds leave free.

    By differences of the exact gradient. idle: (P,) True for parameters that are left as they are.
    Returns None where there is nothing to tell, else {"eigenvalues": [...] rising, "directions":
    [{name: component}, ...] in the unit cube, "flattest": {...}}, where "flattest" is a step along
    the first direction that moves its largest component by 10 % (of the range, where the parameter
    is linear): {"factors": {name: ratio or change, as it is printed},
    "changes_percent": of the objective, run with these very numbers}.
    """
    z, count = point.z, len(point.z)
    # nothing is a share of an objective of 0
    if count < 2 or count > LARGEST_CURVATURE or point.cost == 0.0:
        return None
    columns = []
    for i in range(count):
        e = np.eye(count)[i] * STEP
        up, down = problem.point(np.clip(z + e, 0, 1)), problem.point(np.clip(z - e, 0, 1))
        if not (up.finite and down.finite):
            return None
        columns.append((up.gradient - down.gradient) / (up.z - down.z)[i] / search.scale)
    near = point.margins / search.room - search.backoff < 1e-4
    held = list(point.margin_slopes[near])
    still = np.zeros(count, dtype=bool) if idle is None else idle
    held += [np.eye(count)[i] for i in range(count) if z[i] < 1e-6 or z[i] > 1 - 1e-6 or still[i]]
    basis = np.eye(count)
    if held:
        _, sizes, rows = np.linalg.svd(np.array(held))
        basis = rows[np.sum(sizes > 1e-9 * max(sizes[0], 1e-300)) :].T
    if not basis.shape[1]:
        return None
    matrix = 0.5 * (np.array(columns) + np.array(columns).T)
    values, vectors = np.linalg.eigh(basis.T @ matrix @ basis)
    directions = (basis @ vectors).T
    flat = directions[0] * np.sign(directions[0][np.argmax(np.abs(directions[0]))])
    largest = int(np.argmax(np.abs(flat)))
    b = problem.bounds[largest]
    step = np.log(1.1) / np.log(b.high / b.low) if b.scale == "log" else 0.1
    step = step / flat[largest]
    if not 0 <= z[largest] + step * flat[largest] <= 1:
        step = -step
    factors, there = _told(
        problem.bounds, z, np.clip(z + step * flat, 0.0, 1.0), point.gradient / search.scale, matrix
    )
    costs, _ = problem.screen(np.array([z, there]))
    return {
        "eigenvalues": values.tolist(),
        "directions": [dict(zip(problem.names, map(float, d))) for d in directions],
        "flattest": {
            "factors": dict(zip((b.name for b in problem.bounds), factors)),
            "changes_percent": float(100 * abs(costs[1] / costs[0] - 1)),
        },
    }


def _told(bounds, z, there, gradient, matrix):
    """(factors, z of them) of the step from z to `there`, with as few decimals as leave what it
    changes, by the quadratic model, within 5 %: along a flat direction a component of 1e-4 can be
    what makes it flat, for the objective rises steeply beside it.
    """
    model = lambda to: gradient @ (to - z) + 0.5 * (to - z) @ matrix @ (to - z)
    for decimals in range(2, 9):
        factors = [
            _rounded(b, float(old), float(new), decimals) for b, old, new in zip(bounds, z, there)
        ]
        rounded = np.array(
            [_moved(b, float(old), factor) for b, old, factor in zip(bounds, z, factors)]
        )
        if abs(model(rounded) - model(there)) <= 0.05 * abs(model(there)):
            break
    return factors, rounded


def _rounded(b, old, new, decimals):
    """The ratio (a change, where the parameter is linear) that takes z = old to new, to so many
    decimals (of the range) within it.
    """
    before, after = float(b.from_unit(old)), float(b.from_unit(new))
    exact = after / before if b.scale == "log" else after - before
    size = min(exact, 1.0) if b.scale == "log" else b.high - b.low
    places = decimals - math.floor(math.log10(size))
    factor, one = round(exact, places), 10.0**-places
    for other in (round(factor - one, places), round(factor + one, places)):
        if not 0 <= _moved(b, old, factor) <= 1 and 0 <= _moved(b, old, other) <= 1:
            return other
    return factor


def _moved(b, old, factor):
    """z after a ratio or a change; old itself where there is none."""
    if factor == (1 if b.scale == "log" else 0):
        return old
    before = float(b.from_unit(old))
    return float(b.to_unit(before * factor if b.scale == "log" else before + factor))


def flat_words(problem, found):
    """The flattest direction as a sentence."""
    parts = []
    for b, factor in zip(problem.bounds, found["flattest"]["factors"].values()):
        if b.scale == "log" and factor != 1:
            parts.append(f"{b.name} x {factor:.10g}")
        elif b.scale != "log" and factor != 0:
            parts.append(f"{b.name} {factor:+.10g}{'' if b.unit == '-' else f' {b.unit}'}")
    if not parts:
        return ""
    together = parts[0] if len(parts) == 1 else f"{', '.join(parts[:-1])} with {parts[-1]}"
    return (
        f"flattest direction: {together} changes the objective by"
        f" {found['flattest']['changes_percent']:.2g} %"
    )


def mirror_of(problem, outcomes, values):
    """The answer `values` with the gains exchanged that the case's `symmetry` names; None where it
    has none, or outside the ranges.

    Returns {"words", "values" {name: value}, "objective", "starts": indices of the searches that
        ended there rather than here}.
    """
    if problem.case.symmetry is None:
        return None
    image = problem.case.symmetry.image(values)
    if not image or not all(n in values for n in image):
        return None
    there = {**values, **image}
    z = np.array([float(b.to_unit(there[b.name])) for b in problem.bounds])
    if np.any(z < 0) or np.any(z > 1):
        return None

    def apart(a, b):
        return max(abs(np.log(a[n] / b[n])) for n in image)

    half = 0.5 * apart(values, there)
    starts = [
        i
        for i, o in enumerate(outcomes)
        if o["violation"] == 0.0 and half > 0 and apart(o["to"], there) < half
    ]
    cost = float(problem.screen(z[None])[0][0])
    return {
        "words": problem.case.symmetry.words,
        "values": there,
        "objective": cost,
        "starts": starts,
    }


def table_of(problem, values) -> list[Any]:
    """Measures of every scenario at {parameter: value}: a list of {name: value}, with all that is
    reported where it is served.
    """
    points = {n: np.array([v]) for n, v in values.items()}
    table: list[Any] = [None] * len(problem.lanes)
    for group in problem.groups:
        loop = problem.lanes[group.lanes[0]].case.loop
        names = (*(m for m in ms.reported() if ms.serves(m, loop)), *ms.times())
        measures, _ = sc.values_of(group, names, points)
        for j, lane in enumerate(group.lanes):
            table[lane] = {m: np.asarray(v)[0, j] for m, v in measures.items()}
    return table


def perturbed(problem, samples, seed):
    """Lanes that the search never saw: its scenarios in turn, with every uncertain parameter of the
    plant off by its own factor, uniform within the case's spread, what was identified together
    drawn from its covariance, and fresh sensor noise.
    """
    rng, lanes = np.random.default_rng([HELD_OUT, seed]), []
    for i in range(samples):
        lane = problem.lanes[i % len(problem.lanes)]
        loop = lane.case.loop
        for name, spread in problem.case.uncertain.items():
            value = np.asarray(get_value(loop, name))
            loop = with_values(
                loop, {name: value * (1.0 + spread * rng.uniform(-1.0, 1.0, value.shape))}
            )
        if problem.case.covariance is not None:
            names, matrix = problem.case.covariance
            drawn = Draws(loop, {"identified": Correlated(names=names, covariance=matrix)}).values(
                rng.uniform(size=(1, len(names)))
            )
            loop = with_values(loop, {name: value[0] for name, value in drawn.items()})
        key = None if lane.key is None else jax.random.fold_in(jax.random.key(HELD_OUT + seed), i)
        lanes.append(
            lane._replace(
                case=lane.case.replace(loop=loop),
                key=key,
                name=f"held-out {i + 1}",
                weight=1.0 / samples,
            )
        )
    return lanes


def validate(problem, before, after, samples, seed):
    """How the values `before` and `after` do on `samples` runs that the search never saw (see
    `perturbed`).

    Returns what `summary_of` does.
    """
    lanes = perturbed(problem, samples, seed)
    points = {n: np.array([before[n], after[n]]) for n in problem.names}
    costs, held, broken = (
        np.zeros((samples, 2)),
        np.ones((samples, 2), dtype=bool),
        np.zeros(samples, dtype=bool),
    )
    levels, names = (
        np.zeros((samples, 2, problem.loop.plant.tanks)),
        tuple(dict.fromkeys([*problem.needed, "max_level"])),
    )
    for group in sc.groups_of(lanes):
        measures, flags = sc.values_of(group, names, points)
        measures, flags = {m: np.asarray(v) for m, v in measures.items()}, np.asarray(flags)
        for j, i in enumerate(group.lanes):
            mine = [limit for limit in problem.limits if limit.lane == i % len(problem.lanes)]
            broken[i] = flags[:, j].any()
            for side in (0, 1):
                row = {m: v[side, j] for m, v in measures.items()}
                costs[i, side], levels[i, side] = problem.cost(row), row["max_level"]
                held[i, side] = all(limit.margin(row) >= 0 for limit in mine)
    noise, spread = (
        any(lane.key is not None for lane in lanes),
        {n: float(s) for n, s in problem.case.uncertain.items()},
    )
    return summary_of(problem, costs, held, levels, broken, spread, noise)


def summary_of(problem, costs, held, levels, broken, spread, noise):
    """What runs before and after tuning, on the same draws, come to: (summary, cloud).

    costs: (samples, 2) before and after; held: (samples, 2) True where every limit holds; levels:
        (samples, 2, tanks) highest [cm];
    broken: (samples,) True where a run left the numbers; spread: {name: share}; noise: True if the
        runs have noise of their own. The
    summary: {"samples", "spread", "noise", "failed", "objective" {"before"/"after": {"mean", "p05",
    "p50", "p95"}}, "better_share": of the runs in which the tuned values cost less, "limits_held"
    {"before"/"after": share of the runs in which every limit holds},
    "comparable": share of the runs in which both hold them, "better_share_of_comparable"}. The
        cloud, of the runs
    that did not fail: {"objective" (runs, 2), "level" (runs, 2) of the tank that comes highest,
    "limit" [cm] or None, "past": True where the tanks' limits differ and "level" is how far the
    worst is past its own, "held" (runs, 2)}.
    """
    samples, good = len(costs), ~broken & np.isfinite(costs).all(axis=1)
    both = good & held.all(axis=1)

    def summary(column):
        quantiles = np.quantile(column, (0.05, 0.5, 0.95)) if column.size else [np.nan] * 3
        return dict(
            zip(
                ("mean", "p05", "p50", "p95"),
                map(float, (column.mean() if column.size else np.nan, *quantiles)),
            )
        )

    found = {
        "samples": samples,
        "spread": spread,
        "noise": noise,
        "failed": int((~good).sum()),
        "objective": {
            name: summary(costs[good, side]) for side, name in enumerate(("before", "after"))
        },
        "better_share": float(np.mean(costs[good, 1] < costs[good, 0])) if good.any() else None,
        "limits_held": {
            name: float(np.mean(held[good, side])) if good.any() else None
            for side, name in enumerate(("before", "after"))
        },
        "comparable": float(np.mean(both[good])) if good.any() else None,
        "better_share_of_comparable": (
            float(np.mean(costs[both, 1] < costs[both, 0])) if both.any() else None
        ),
    }
    limits = {limit.index: limit.value for limit in problem.limits if limit.measure == "max_level"}
    levels = levels[good][:, :, sorted(limits) if limits else slice(None)]
    one = next(iter(limits.values())) if len(set(limits.values())) == 1 else None
    # tanks with limits of their own: how far past its limit the worst is
    if len(set(limits.values())) > 1:
        levels = levels - np.array([limits[i] for i in sorted(limits)])
    level = levels.max(axis=2) if levels.size else np.zeros((0, 2))
    past = len(set(limits.values())) > 1
    return found, {
        "objective": costs[good],
        "level": level,
        "limit": 0.0 if past else one,
        "past": past,
        "held": held[good],
    }


def changed(case, values):
    """`case` with leaves set, without the checks at the door."""
    return dataclasses.replace(case, loop=with_values(case.loop, values))
