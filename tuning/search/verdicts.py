"""How a search ended: its status, whether the loop still follows, and the Messages about both."""

import functools
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import jax
import numpy as np

from jaxtank.core.tree import with_values
from jaxtank.loop import run as lp
from jaxtank.loop.change_windows import windows
from tuning.problem.point import DIVERGED
from tuning.problem.problem import Problem
from tuning.problem.slopes import unusable_words
from tuning.problem.status import Status
from tuning.search.kkt import SLOPING, UNSTABLE
from tuning.search.result import ConstraintRow, Lost, Message, TuningResult
from tuning.search.stages import RENEWED, Outcome, without_slope

LISTED = 4
"""Limits that one message names at most."""

OFF = 0.1
"""Distance from the setpoint at the end of a plateau, as a share of the change that led to it,
from which an output does not follow: twice the band of the settling time [-]."""

WORSE = 2.0
"""Factor by which that distance must have grown to be called a change for the worse [-]."""

LATE = 0.1
"""Share of a plateau, at its end, over which the distance is averaged [-]."""

CHECKED_RUNS = 8
"""Scenarios whose trajectories are compared, at most."""

SAVED = 20_000
"""Samples of a trajectory that are compared, at most."""

FRAGILE = 2.5
"""Sensitivity peak Ms above which a loop is near the edge of its stability [-]: textbooks recommend
1.4 to 2."""

BUSY, EXCURSIONS, RINGING = 2.0, 2.0, 25.0
"""Growth of an input's total variation, its size in ranges of the pump for each plateau, and the
overshoot [%] above which a run points to a fragile loop: an Ms above FRAGILE overshoots by more."""

Found = Iterator[Message]
ENDED = (Status.CONVERGED, Status.NOT_CONVERGED)


def status_of(found: Outcome, feasible: bool, lost: Sequence[Lost] = ()) -> Status:
    """Return how the stages ended; feasible : whether every limit holds at the answer."""
    if found.interrupted:
        return Status.INTERRUPTED
    if found.search is None or found.best is None:
        return Status.NOT_CONVERGED
    if not feasible:
        return Status.INFEASIBLE if found.least else Status.NOT_CONVERGED
    done = found.confirmed and not without_slope(found.search) and not lost
    return Status.CONVERGED if done else Status.NOT_CONVERGED


def lost_outputs(
    problem: Problem, tables: Mapping[str, Sequence[Any]], values: Mapping[str, float]
) -> tuple[Lost, ...]:
    """Return the outputs that follow their setpoints before tuning, and no longer afterwards."""
    suspects = [_suspect(run, *rows) for run, *rows in zip(problem.runs, *tables.values())]
    weights = np.array([run.weight for run in problem.runs])
    lost: list[Lost] = []
    for i in range(len(problem.loop.plant.outputs)):
        runs = [k for k, outputs in enumerate(suspects) if i in outputs]
        if weights[runs].sum() <= 0.5 * weights.sum():
            continue
        runs = runs[:CHECKED_RUNS]
        pairs = [_distances(problem.runs[k], values, i) for k in runs]
        bad = [after for before, after in pairs if after[0] > max(OFF, WORSE * before[0])]
        if len(bad) > 0.5 * len(runs):
            worst = max(range(len(pairs)), key=lambda k: pairs[k][1][0])
            (_, before), (share, after) = pairs[worst]
            unit = problem.loop.units[0]
            lost.append(Lost(output=i + 1, share=share, before=before, after=after, unit=unit))
    return tuple(lost)


def _suspect(run, before, after) -> set[int]:
    """Return the outputs (from 0) whose measures give a reason to compare their trajectories."""
    suspect = np.asarray(after["rms_error"]) > WORSE * np.asarray(before["rms_error"])
    if suspect.any():
        setpoints, _ = _followed(run.case.loop, run.case.clock)
        size = np.array([float(np.max(np.abs(v))) for v in setpoints])
        suspect &= np.asarray(after["rms_error"]) > 0.5 * OFF * size
    for measure in ("settling_time", "recovery_time"):
        if measure in before:
            suspect |= np.isposinf(after[measure]) & ~np.isposinf(before[measure])
    return set(map(int, np.flatnonzero(suspect)))


@functools.partial(jax.jit, static_argnames="clock")
def _followed(loop: Any, clock: Any) -> Any:
    """Return (setpoints of all samples, windows of their changes): one program, not one for each of
    some eighty operations.
    """
    return loop.reference.sample(clock)[0], windows(loop, clock)


def _distances(run, values, i) -> list[tuple[float, float]]:
    """Return [(share of the change, in the unit of level)] of output i, before and after."""
    loop = run.case.loop
    return [
        _farthest(here, run.case.clock, run.key, i) for here in (loop, with_values(loop, values))
    ]


def _farthest(loop, clock, key, i) -> tuple[float, float]:
    """Return the largest distance of output i from its setpoint at the end of a plateau."""
    every = max(1, clock.samples // SAVED)
    errors = np.asarray(lp.simulate(loop, clock, key, save_every=every).e)[:, i]
    setpoints, found = _followed(loop, clock)
    setpoint = np.asarray(setpoints[i])[::every][: len(errors)]
    target, step = (
        (setpoint, 0 * setpoint)
        if found is None
        else (
            np.broadcast_to(np.asarray(v), (clock.samples,))[::every][: len(errors)]
            for v in found[i][:2]
        )
    )
    ends = [*np.flatnonzero(np.diff(target)), len(errors) - 1] if found else [len(errors) - 1]
    worst = (0.0, 0.0)
    for first, last in zip([-1, *ends], ends):
        tail = slice(last + 1 - max(1, int(LATE * (last - first))), last + 1)
        off = abs(float(np.mean(errors[tail])))
        size = abs(step[last]) or abs(setpoint[last])
        if size > 0:
            worst = max(worst, (off / float(size), off))
    return worst


def violated(result: TuningResult) -> list[ConstraintRow]:
    return [c for c in result.constraints if c.margin < 0]


def first_of(parts: list[str], joint: str = ", ") -> str:
    """Return the first LISTED parts, and how many more there are."""
    more = len(parts) - LISTED
    return joint.join(parts[:LISTED]) + (f" (and {more} more)" if more > 0 else "")


def points_to_fragile(loop: Any, before: Mapping[str, Any], after: Mapping[str, Any]) -> bool:
    """Return True if the run with an answer rings: only then are its margins worth a program, which
    takes as long to compile as those of a search.
    """
    old, new = (np.asarray(m["input_travel"]) for m in (before, after))
    ranges = np.asarray(loop.actuator.high) - np.asarray(loop.actuator.low)
    held = loop.reference.held()
    excursions = EXCURSIONS * ranges * (1 if held is None else len(held))
    overshoot = np.asarray(after.get("overshoot_percent", 0.0), dtype=float)
    busy = (new > BUSY * old) | (new > excursions)
    return bool(np.any(busy) or np.any(overshoot > RINGING))


def near_the_edge(result: TuningResult) -> Found:
    """The answer's linearised loop is unstable, or nearly so."""
    sides = (result.measures[side] for side in ("before", "after"))
    before, after = (float(m.get("sensitivity_peak", np.nan)) for m in sides)
    if not after > FRAGILE:  # NaN: it has none
        return
    where = f"{'beyond' if np.isinf(after) else 'at'} the edge of sampled stability"
    peak = "the linearised loop is unstable" if np.isinf(after) else f"Ms = {after:.3g}"
    old = "unstable" if np.isinf(before) else f"{before:.3g}"
    yield Message(
        "edge-of-stability",
        f"{where}: {peak} at a plateau, {old} before (sensitivity peak of the sampled loop, at most"
        " 2 is usual): --limit sensitivity_peak=2 bounds it, a smaller step or narrower ranges"
        " (--free) may help",
        f"{where} ({peak})",
    )


def _no_feasible_point(result: TuningResult) -> Found:
    missed = violated(result)
    if result.status == Status.NOT_CONVERGED and missed:
        c = missed[0]
        yield Message(
            "no-feasible-point-found",
            "no point that meets every limit was found before the search ended"
            f" ({c.name} is {c.amount()}, limit {c.limit:.6g} {c.unit}): more --iterations,"
            " --starts or --screening may find one",
        )


def _infeasible(result: TuningResult) -> Found:
    if result.status != Status.INFEASIBLE:
        return
    scales = result.problem.limit_scales
    shares = [c.margin / scale for c, scale in zip(result.constraints, scales)]
    order = [i for i in np.argsort(shares, kind="stable") if shares[i] < 0]
    worst = [result.constraints[i] for i in order]
    missed = [
        f"{c.name} is {c.amount()}, limit {c.limit:.6g} {c.unit}"
        + ("" if c.reason else f", missed by {-c.margin:.3g} {c.unit}")
        for c in worst
    ]
    least = (
        ""
        if worst[0].reason
        else f"; the largest violation, {-100 * shares[order[0]]:.3g} % of its limit, is the least"
        " that was found"
    )
    yield Message(
        "infeasible", f"no point was found that meets every limit: {first_of(missed)}{least}"
    )


def _interrupted(result: TuningResult) -> Found:
    if result.status == Status.INTERRUPTED:
        yield Message("interrupted", "interrupted: this is the best point so far")


def slope_not_usable(result: TuningResult) -> Found:
    """At the answer and at the values before tuning; once where these are the same."""
    places = {"answer": "the answer", "start": "the values before tuning"}
    same = all(p["before"] == p["after"] for p in result.parameters.values())
    for where, words in places.items():
        check = result.slopes.get(where)
        if check is None or check.usable or (same and where == "start"):
            continue
        role = "judged the answer" if where == "answer" else "searched on"
        yield Message(
            "slope-not-usable",
            f"the slope of the objective at {words} is that of a chaotic or exploding loop:"
            f" {unusable_words(check)}; it was not used: other starts and differential evolution"
            f" {role}",
        )


def _flat(result: TuningResult) -> bool:
    """Return True if the gradient is exactly zero at an objective that is not."""
    return result.optimality["gradient_norm"] == 0.0 and result.objective["after"] != 0.0


def _without_slope(result: TuningResult) -> Found:
    if result.status != Status.INFEASIBLE and _flat(result):
        yield Message(
            "objective-without-slope",
            "the gradient of the objective is zero here: the objective changes in steps, as times"
            " and counts do, and a search by gradients cannot show that this is its minimum; add a"
            " smooth measure to the objective",
        )


def _gradient_left(result: TuningResult) -> Found:
    residual = result.optimality["kkt_residual"]
    if _flat(result) or result.status not in ENDED or violated(result):
        return
    if residual is not None and residual > SLOPING:
        kink = result.status == Status.CONVERGED
        yield Message(
            "kink" if kink else "gradient-not-zero",
            "the objective has a slope in a direction that no active limit blocks (KKT residual"
            f" {residual:.2g} of the objective per range of a parameter): "
            + (
                "a kink, because no lower value was found along it within the limits"
                if kink
                else "not yet an optimum"
            ),
        )


def _not_converged(result: TuningResult) -> Found:
    zero = result.optimality["gradient_norm"] == 0.0
    ended = result.status != Status.NOT_CONVERGED or bool(result.lost)
    if not ended and not violated(result) and not zero:
        yield Message("not-converged", _why_not_converged(result))


def _why_not_converged(result: TuningResult) -> str:
    """Return why a search that violates no limit did not converge, and the remedy."""
    if all(not np.isfinite(violation) for _, _, violation, _ in result.history):
        return (
            f"no search could begin: the objective, a limit or a derivative exceeds {DIVERGED:.0e}"
            " at every point that was tried, as where noise and delay make the loop unstable;"
            " start from other values (--set) or narrow the ranges (--free)"
        )
    check = result.slopes.get("answer")
    useless = check is not None and not check.usable
    if useless or (result.optimality["kkt_residual"] or 0.0) >= UNSTABLE:
        return (
            "the gradient at this point is that of an unstable or chaotic run (noise and delay at"
            " a high gain give one), and points along it are not lower; try more --starts, or"
            " other ranges (--free)"
        )
    if any(o["exhausted"] for o in result.starts):
        return (
            "no search met the conditions of an optimum before its iterations were used up: raise"
            " --iterations, or try other starts"
        )
    if result.probe and result.probe["lower"] >= RENEWED:
        return (
            f"{result.probe['lower']} searches from points of differential evolution each ended"
            " lower than what was found before, and there may be better points still: raise"
            " --starts and --screening"
        )
    return (
        "the searches stopped before their iterations were used up, at a kink or in the noise of"
        " the objective: no line search found a lower point, and the conditions of an optimum do"
        " not hold there; try more --starts or other starting values"
    )


def _no_longer_follows(result: TuningResult) -> Found:
    forced = any(c.active for c in result.constraints)
    remedy = (
        "the active limits force it: loosen them or change the setpoints (--limit, --set)"
        if forced
        else "weigh the error in the objective or narrow the ranges (--objective, --free)"
    )
    for x in result.lost:
        yield Message(
            "no-longer-follows",
            f"output {x.output} no longer follows its setpoint: at the end of a plateau it is"
            f" {x.after:.3g} {x.unit} off ({100 * x.share:.3g} % of the setpoint change),"
            f" {x.before:.3g} {x.unit} before tuning; {remedy}",
        )


def _nothing_better(result: TuningResult) -> Found:
    if result.status == Status.CONVERGED and result.probe:
        yield Message(
            "nothing-better-found",
            f"differential evolution found nothing better in {result.probe['runs']} runs",
        )


ENDINGS: tuple[Callable[[TuningResult], Found], ...] = (
    _no_feasible_point,
    _infeasible,
    _no_longer_follows,
    _interrupted,
    slope_not_usable,
    _without_slope,
    _gradient_left,
    _not_converged,
    _nothing_better,
)
"""Rules on how a search ended, most important first."""
