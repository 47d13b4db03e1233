"""Diagnostics of an answer: sensitivity, curvature, symmetry, length of the steps."""

import functools
import math
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import numpy as np

from jaxtank import measures as ms
from jaxtank.core.errors import InputError
from jaxtank.core.tree import with_values
from jaxtank.loop import run as lp, step_size
from jaxtank.loop.change_windows import windows
from jaxtank.loop.halving import halving_warnings
from tuning.problem.reported import table_of
from tuning.problem.scenarios import ScenarioRun
from tuning.problem.tracking import is_averaging
from tuning.search.result import Lost, Message

CHECKED_RUNS = 16  # scenarios that are run, at most, to look for a step that is too long
STEP = 1e-4  # step of the differences of the gradient, in the unit cube [-]

OFF = 0.1  # distance from a setpoint, in its last change: twice the settling band [-]

WORSE = 2.0  # factor by which that distance must have grown to be called a change for the worse [-]
LATE = 0.1  # share of a plateau, at its end, over which the distance is averaged [-]
COMPARED_RUNS = 8  # scenarios whose trajectories are compared, at most
SAVED = 20_000  # samples of a trajectory that are compared, at most

BUSY, EXCURSIONS, RINGING = 2.0, 2.0, 25.0
"""Growth of an input's total variation, its size in ranges of the pump for each plateau, and the
overshoot [%] above which a run points to a fragile loop: an Ms above 2.5 overshoots by more."""

LARGEST_CURVATURE = 24  # number of parameters up to which the second derivative is computed


TOO_LONG = "step-too-long"
"""Code of a Message on the step; with a headline where the numbers of the run are wrong."""


def step_warnings(tuned, values, key=None, scenarios=()):
    """Return Messages on steps that are unstable near an empty tank, in the case or a scenario."""
    runs = [("", tuned.loop, tuned.clock, key)]
    for run in scenarios[:CHECKED_RUNS]:
        loop = with_values(run.case.loop, values)
        runs.append((f"scenario {run.name}: ", loop, run.case.clock, run.key))
    sentences = []
    for name, loop, clock, noise_key in runs:
        warnings = step_size.step_warnings(loop, clock)
        try:
            if warnings or step_size.narrow_tanks(loop, clock):
                halved = halving_warnings(loop, clock, noise_key)
                warnings = warnings or halved
        except InputError as error:
            text = f"{name}this answer's run is wrong, and so are its numbers: {error}"
            return (Message(TOO_LONG, text, "its steps are too long"),)
        sentences += [f"{name}{sentence}" for sentence in warnings]
    return tuple(Message(TOO_LONG, text) for text in sentences[:1])


def neighbours(problem, z):
    """Return (2 P + 1, P) z (P,) itself, and with 10 % less and 10 % more of each parameter."""
    trials = [z]
    for i, b in enumerate(problem.bounds):
        value = float(b.from_unit(z[i]))
        for factor in (-0.1, 0.1):
            moved = b.to_unit(value * (1 + factor)) if b.scale == "log" else z[i] + factor
            trials.append(np.where(np.arange(len(z)) == i, np.clip(moved, 0.0, 1.0), z))
    return np.array(trials)


def sensitivities(costs):
    """Return the larger change [%] by each parameter, of the costs of `neighbours`."""
    # None where the objective is not finite.
    with np.errstate(divide="ignore", invalid="ignore"):  # a cost of 0 has no percent
        change = 100 * np.abs(costs[1:] / costs[0] - 1).reshape(-1, 2).max(axis=1)
    return [float(c) if np.isfinite(c) else None for c in change]


def unexercised(search, first):
    """Return (P,) True for each parameter that no run exercises at the best point of a Search."""
    problem, point = search.problem, search.best
    flat = ~np.any(np.vstack([point.gradient, point.margin_slopes, point.run_slopes]), axis=0)
    idle = np.zeros(len(first), dtype=bool)
    if not flat.any():
        return idle
    table = table_of(problem, problem.values(point.z))
    away = np.where(point.z < 0.5, point.z + 0.4, point.z - 0.4)

    def same(which):
        """Return True if no measure changes with the parameters `which`."""
        moved = [np.where(which, z, point.z) for z in (first, away)]
        return all(
            np.allclose(row[m], old[m], rtol=1e-9, atol=1e-12, equal_nan=True)
            for z in moved
            for row, old in zip(table_of(problem, problem.values(z)), table)
            for m in ms.reported()
            if m in row
        )

    if same(flat):
        idle = flat
    elif flat.sum() > 1:
        idle = np.array([bool(f) and same(np.arange(len(first)) == i) for i, f in enumerate(flat)])
    at_start = search.point(np.where(idle, first, point.z))
    if at_start.finite and search.violation(at_start) <= search.violation(point) * (1 + 1e-9):
        search.best = at_start
        return idle
    return np.zeros(len(first), dtype=bool)


def curvature(search, point, idle=None):
    """Return the second derivative of the scaled cost along the free directions."""
    problem, z, count = search.problem, point.z, len(point.z)
    # nothing is a share of an objective of 0
    if count < 2 or count > LARGEST_CURVATURE or point.cost == 0.0:
        return None
    matrix = _second_derivative(search, z)
    basis = _free_directions(search, point, idle)
    if matrix is None or not basis.shape[1]:
        return None
    values, vectors = np.linalg.eigh(basis.T @ matrix @ basis)
    directions = (basis @ vectors).T
    direction = directions[0]
    flat = direction * np.sign(direction[np.argmax(np.abs(direction))])
    largest = int(np.argmax(np.abs(flat)))
    b = problem.bounds[largest]
    step = np.log(1.1) / np.log(b.high / b.low) if b.scale == "log" else 0.1
    step = step / flat[largest]  # with it the largest component changes by 10 %
    if not 0 <= z[largest] + step * flat[largest] <= 1:
        step = -step
    there = np.clip(z + step * flat, 0.0, 1.0)
    gradient = point.gradient / search.scale
    # the fewest decimals that change the predicted cost by at most 5 %: across, the cost is steep
    model = lambda to: gradient @ (to - z) + 0.5 * (to - z) @ matrix @ (to - z)
    factors, rounded = [], z
    for decimals in range(2, 9):
        ends = zip(problem.bounds, z.tolist(), there.tolist())
        factors = [_rounded(b, old, new, decimals) for b, old, new in ends]
        rounded = np.array(
            [_moved(b, old, f) for b, old, f in zip(problem.bounds, z.tolist(), factors)]
        )
        if abs(model(rounded) - model(there)) <= 0.05 * abs(model(there)):
            break
    costs, margins = search.evaluator.screen(np.array([z, rounded]))
    if np.all(margins[1] >= 0) and costs[1] < costs[0]:
        search.point(rounded)
    return {
        "eigenvalues": values.tolist(),
        "directions": [dict(zip(problem.names, map(float, d))) for d in directions],
        "least_sensitive": {
            "factors": dict(zip(problem.names, factors)),
            "changes_percent": float(100 * abs(costs[1] / costs[0] - 1)),
        },
    }


def _second_derivative(search, z):
    """Return the (P, P) symmetric second derivative of the scaled cost; None where not finite."""
    columns = []
    for i in range(len(z)):
        e = np.eye(len(z))[i] * STEP
        up, down = search.point(z + e), search.point(z - e)
        if not (up.finite and down.finite):
            return None
        columns.append((up.gradient - down.gradient) / (up.z - down.z)[i] / search.scale)
    return 0.5 * (np.array(columns) + np.array(columns).T)


def _free_directions(search, point, idle):
    """Return an orthonormal basis (P, free) of the directions no active limit or bound fixes."""
    z, count = point.z, len(point.z)
    fixed = list(point.margin_slopes[search.scaled_margins(point)[0] < 1e-4])
    still = np.zeros(count, dtype=bool) if idle is None else idle
    fixed += [np.eye(count)[i] for i in range(count) if z[i] < 1e-6 or z[i] > 1 - 1e-6 or still[i]]
    if not fixed:
        return np.eye(count)
    _, sizes, rows = np.linalg.svd(np.array(fixed))
    return rows[np.sum(sizes > 1e-9 * max(sizes[0], 1e-300)) :].T


def _rounded(b, old, new, decimals):
    """Return the ratio (a change, where the parameter is linear) that takes z = old to new."""
    before, after = float(b.from_unit(old)), float(b.from_unit(new))
    exact = after / before if b.scale == "log" else after - before
    size = min(exact, 1.0) if b.scale == "log" else b.high - b.low
    places = decimals - math.floor(math.log10(size))
    factor, step = round(exact, places), 10.0**-places
    inside = lambda factor: 0 <= _moved(b, old, factor) <= 1
    others = (round(factor + move, places) for move in (0.0, -step, step))
    return next(filter(inside, others), factor)


def _moved(b, old, factor):
    """Return z after a ratio or a change; old itself where there is none."""
    if factor == (1 if b.scale == "log" else 0):
        return old
    before = float(b.from_unit(old))
    return float(b.to_unit(before * factor if b.scale == "log" else before + factor))


def symmetric(evaluator, starts, values):
    """Return the answer with the gains exchanged that the case names as a permutation symmetry."""
    problem = evaluator.problem
    if problem.case.symmetry is None:
        return None
    image = problem.case.symmetry.image(values)
    if not image or not all(n in values for n in image):
        return None
    there = {**values, **image}
    z = np.array([float(b.to_unit(there[b.name])) for b in problem.bounds])
    if np.any(z < 0) or np.any(z > 1):
        return None
    apart = lambda a, b: max(abs(np.log(a[n] / b[n])) for n in image)
    half = 0.5 * apart(values, there)
    close = lambda s: s["violation"] == 0.0 and half > 0 and apart(s["to"], there) < half
    return {
        "words": problem.case.symmetry.words,
        "values": there,
        "objective": float(evaluator.screen(z[None])[0][0]),
        "starts": [i for i, start in enumerate(starts) if close(start)],
    }


def lost_outputs(
    runs: Sequence[ScenarioRun],
    tables: Mapping[str, Sequence[Any]],
    values: Mapping[str, float],
    objective: Mapping[str, float],
) -> tuple[Lost, ...]:
    """Return the outputs that follow their setpoints before tuning, and no longer afterwards."""
    if is_averaging(runs[0].case.loop, objective):
        return ()
    suspects = [_suspect(run, *rows) for run, *rows in zip(runs, *tables.values())]
    weights = np.array([run.weight for run in runs])
    loop = runs[0].case.loop
    lost: list[Lost] = []
    for i in range(len(loop.plant.outputs)):
        doubtful = [k for k, outputs in enumerate(suspects) if i in outputs]
        if weights[doubtful].sum() <= 0.5 * weights.sum():
            continue
        pairs = [_distances(runs[k], values, i) for k in doubtful[:COMPARED_RUNS]]
        bad = [after for before, after in pairs if after[0] > max(OFF, WORSE * before[0])]
        if len(bad) > 0.5 * len(pairs):
            (_, before), (share, after) = max(pairs, key=lambda pair: pair[1][0])
            unit = loop.units[0]
            lost.append(Lost(output=i + 1, share=share, before=before, after=after, unit=unit))
    return tuple(lost)


def _suspect(run, before, after) -> set[int]:
    """Return the outputs (from 0) whose measures give a reason to compare their trajectories."""
    suspect = np.asarray(after["rms_error"]) > WORSE * np.asarray(before["rms_error"])
    if suspect.any():
        setpoints, _ = _setpoints(run.case.loop, run.case.clock)
        size = np.array([float(np.max(np.abs(v))) for v in setpoints])
        suspect &= np.asarray(after["rms_error"]) > 0.5 * OFF * size
    for measure in ("settling_time", "recovery_time"):
        if measure in before:
            suspect |= np.isposinf(after[measure]) & ~np.isposinf(before[measure])
    return set(map(int, np.flatnonzero(suspect)))


@functools.partial(jax.jit, static_argnames="clock")
def _setpoints(loop: Any, clock: Any) -> Any:
    """Return (setpoints of all samples, windows of their changes) by one program."""
    return loop.reference.sample(clock)[0], windows(loop, clock)


def _distances(run, values, i) -> list[tuple[float, float]]:
    """Return [(share of the change, in the unit of level)] of output i, before and after."""
    loops = (run.case.loop, with_values(run.case.loop, values))
    return [_farthest(loop, run.case.clock, run.key, i) for loop in loops]


def _farthest(loop, clock, key, i) -> tuple[float, float]:
    """Return the largest distance of output i from its setpoint at the end of a plateau."""
    every = max(1, clock.samples // SAVED)
    errors = np.asarray(lp.simulate(loop, clock, key, save_every=every).e)[:, i]
    setpoints, changes = _setpoints(loop, clock)
    setpoint = np.asarray(setpoints[i])[::every][: len(errors)]
    target, step = setpoint, 0 * setpoint
    if changes is not None:
        courses = (np.broadcast_to(np.asarray(v), (clock.samples,)) for v in changes[i][:2])
        target, step = (course[::every][: len(errors)] for course in courses)
    ends = [*np.flatnonzero(np.diff(target)), len(errors) - 1] if changes else [len(errors) - 1]
    worst = (0.0, 0.0)
    for first, last in zip([-1, *ends], ends):
        tail = slice(last + 1 - max(1, int(LATE * (last - first))), last + 1)
        off = abs(float(np.mean(errors[tail])))
        size = abs(step[last]) or abs(setpoint[last])
        if size > 0:
            worst = max(worst, (off / float(size), off))
    return worst


def points_to_fragile(loop: Any, before: Mapping[str, Any], after: Mapping[str, Any]) -> bool:
    """Return True if the run of an answer rings: else its margins are not worth a program."""
    old, new = (np.asarray(m["input_travel"]) for m in (before, after))
    ranges = np.asarray(loop.actuator.high) - np.asarray(loop.actuator.low)
    plateaus = loop.reference.held()
    excursions = EXCURSIONS * ranges * (1 if plateaus is None else len(plateaus))
    overshoot = np.asarray(after.get("overshoot_percent", 0.0), dtype=float)
    busy = (new > BUSY * old) | (new > excursions)
    return bool(np.any(busy) or np.any(overshoot > RINGING))
