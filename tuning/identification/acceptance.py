"""Causes of a Diagnosis that are accepted: the rig, its unknowns and its logs with them."""

import copy
import dataclasses
from typing import Any, NamedTuple

import numpy as np

from jaxtank.bounds import Bound
from jaxtank.core.errors import InputError, unknown
from tuning.identification.candidates import AugmentedEstimation, with_leaves
from tuning.identification.diagnosis import (
    exchanges,
    fast_noise,
    passes,
    trial_at,
    unit_of,
    with_candidate,
)
from tuning.identification.least_squares import Fit
from tuning.identification.problem import Estimation

CAUSE_KINDS = (
    *("pump-delay", "pump-lag", "dead-zone", "pump-curve", "sensor-offset", "sensor-scale"),
    *("leak", "outlet-exponent", "inflow", "area", "swapped"),
)


def place_of(text: str) -> tuple[str, tuple]:
    """Return (kind, place from 1 or ()) of a text such as "pump-delay" or "swapped:1,2"."""
    kind, _, place = str(text).partition(":")
    numbers = place.split(",") if place else []
    if kind not in CAUSE_KINDS:
        raise unknown("cause to accept", kind, CAUSE_KINDS)
    if not all(number.isascii() and number.isdigit() for number in numbers):
        raise InputError(
            f"accept {text!r}: the place must be the number of a pump or tank, from 1, as {kind}:1;"
            " swapped takes two tanks, swapped:1,2"
        )
    return kind, tuple(map(int, numbers))


class AcceptedStructure(NamedTuple):
    """A structure that was accepted: what to identify again, and from where."""

    case: Any
    logs: list
    free: dict[str, tuple]
    inputs: list[tuple[Bound, tuple]]
    begin: dict[str, float]


def accept_causes(
    estimation: Estimation, fit: Fit, places: list[tuple[str, tuple]]
) -> AcceptedStructure:
    """Return what `places`, (kind, place from 1 or ()) each, make of an identification."""
    weighted, logs = copy.copy(estimation), list(estimation.logs)
    weighted.noise = fast_noise(estimation, fit)
    problem = AugmentedEstimation(weighted, estimation.unknowns(fit), fit.loss)
    trial = trial_at(problem, (), problem.begin)
    # an exchange is fitted without the other causes, so it comes first
    for kind, where in sorted(places, key=lambda place: place[0] != "swapped"):
        if kind == "swapped":
            trial = _best_exchange(trial, where)
            logs = [_exchanged_log(log, trial.problem.swapped) for log in logs]
        else:
            trial = _best_of_kind(trial, kind, where)
    chosen = [trial.problem.candidates[i] for i in trial.chosen]
    of = trial.problem.coordinates
    values = of.values(trial.point[: of.size])
    known = {*estimation.coordinates.names, *(c.name for c in chosen)}
    loop = with_leaves(estimation.case.loop, [c.name for c in chosen])
    inputs = [c for c in chosen if c.field not in ("", "threshold")]
    leaves = {c.name: (c.low, c.high, "linear") for c in chosen if not c.field}
    loop = _with_thresholds(loop, chosen, values)
    bound = lambda c: Bound(c.name, c.low, c.high, "linear", unit_of(loop, c))
    return AcceptedStructure(
        case=estimation.case.replace(loop=loop, log=_columns(estimation, logs)),
        logs=logs,
        free={b.name: (b.low, b.high, b.scale) for b in estimation.bounds} | leaves,
        inputs=[(bound(c), (c.field, c.where, c.null)) for c in inputs],
        begin={n: float(v) for n, v in values.items() if n in known},
    )


def _with_thresholds(loop, chosen, values):
    """Return a loop with the thresholds among the chosen Candidates, which no search estimates."""
    rows = [c for c in chosen if c.field == "threshold"]
    if not rows:
        return loop
    dead_zone = np.zeros(loop.actuator.pumps)
    for c in rows:
        dead_zone[c.where] = values[c.name]
    actuator = dataclasses.replace(loop.actuator, dead_zone=dead_zone, dead_zone_kind="plain")
    return dataclasses.replace(loop, actuator=actuator)


def _best_of_kind(trial, kind, where):
    """Return the Trial with a Candidate of a kind at a place from 1, or at the best one."""
    candidates = trial.problem.candidates
    options = [i for i, c in enumerate(candidates) if c.kind == kind]
    chosen = [i for i in options if where in ((), (candidates[i].where + 1,))]
    if not chosen:
        places = ", ".join(f"{kind}:{candidates[i].where + 1}" for i in options)
        raise InputError(
            f"accept {':'.join([kind, *map(str, where)])}: "
            + (f"must be one of {places}" if places else "already free, or of no part of this rig")
        )
    best = min((with_candidate(trial, i) for i in chosen), key=lambda t: t.loss)
    return _with_all(best) if kind == "pump-curve" else best


def _with_all(trial):
    """Return the Trial with all coefficients of its last cause that the data ask for."""
    candidates = trial.problem.candidates
    place = candidates[trial.chosen[-1]][:2]
    while True:
        others = [i for i, c in enumerate(candidates) if c[:2] == place and i not in trial.chosen]
        larger = min(
            (with_candidate(trial, i) for i in others), key=lambda t: t.loss, default=trial
        )
        if not passes(larger, trial):
            return trial
        trial = larger


def _best_exchange(trial, where):
    """Return the Trial with two channels exchanged: those of tanks `where`, or the best pair."""
    options = [t for t in exchanges(trial, always=True)
               if sorted(where) in ([], sorted(i + 1 for i in t.problem.swapped))]  # fmt: skip
    if not options:
        place = f":{','.join(map(str, where))}" if where else ""
        raise InputError(f"accept swapped{place}: needs two measured levels in the same unit")
    return min(options, key=lambda t: t.loss)


def _columns(estimation, logs):
    """Return the [log] table of a case with the headers of the columns that were exchanged."""
    columns = dict(estimation.case.log)
    for old, log in zip(estimation.logs, logs):
        moved = log.headers is not None and log.tanks != old.tanks
        for header, a, b in zip((log.headers or ())[1 + log.u.shape[1] :], old.tanks, log.tanks):
            if moved and a != b:
                columns[f"h{b + 1}"] = header
    return columns


def _exchanged_log(log, tanks):
    """Return a Log whose readings of two tanks are each the other's."""
    other = dict(zip(tanks, tanks[::-1]))
    return dataclasses.replace(log, tanks=tuple(other.get(i, i) for i in log.tanks))
