"""Checks of what a rig file says of a tuning: limits, objective, what is free, what is uncertain,
scenarios.
"""

import math
from collections.abc import Iterable, Mapping
from typing import Any

import jax
import numpy as np

from jaxtank.analysis.steady_state import equilibrium
from jaxtank.case import Case, Free, Scenario
from jaxtank.core.checks import check_value
from jaxtank.core.clock import CLOCK_UNITS, Clock
from jaxtank.core.errors import EquilibriumError, InputError, unknown
from jaxtank.core.text import shortened
from jaxtank.core.tree import describe, get_value, is_component, split_index, walk
from jaxtank.loop import run as lp
from jaxtank.loop.closed_loop import ClosedLoop
from jaxtank.measures import check_names, entries
from jaxtank.measures import unit as measure_unit
from jaxtank.rig import schedule
from jaxtank.rig.schema import is_finite, is_numeric, name_of
from jaxtank.rig.signals import steps
from jaxtank.rig.values import by_dotted_name, set_scenario
from jaxtank.signals.inflows import Pours
from jaxtank.signals.setpoints import Ramps


def doubts(case: Case) -> list[str]:
    """Sentences on what of a case can hardly be meant: a clock of broken samples, changes and pours
    after the end of the run, changes that overlap, levels and setpoints above the rim, pumps that
    start outside their limits, models that differ from the plant. (Steps that are too long:
    `step_length`.)
    """
    loop, (length, drive) = case.loop, case.loop.units
    found, end, rim = clock_doubts(case.clock), case.clock.duration, np.asarray(loop.plant.rim)
    reference, bank = steps(loop.reference), loop.actuator
    events = [] if reference is None else list(reference.changes)
    _late(found, "changes of the reference", [t for t, _ in events], end)
    if isinstance(loop.disturbance, Pours):
        _late(found, "pours", [t for t, *_ in loop.disturbance.events], end)
    over, early, ramp = {}, [], 0.0 if reference is None else reference.ramp
    for t, i in events:
        early += [(i, t)] if t < over.get(i, 0.0) - 1e-7 * case.clock.dt else []
        over[i] = t + ramp
    if early:
        found.append(
            f"reference: {len(early)} of {len(events)} changes begin before the one before is over"
            f" (ramp {ramp:g} s), the first of output {early[0][0] + 1} at {early[0][1]:g} s: each"
            " starts from where that one has got to"
        )
    lost = (
        "what is above it is lost at once"
        if loop.plant.overflow
        else "rims are limits here and not physics"
    )
    for i, level in enumerate(np.asarray(loop.x0)):
        if level > rim[i]:
            found.append(
                f"{_tank(case, i)} starts at {level:g} {length}, above its rim at {rim[i]:g}"
                f" {length}: {lost}"
            )
    never = "a level cannot get there" if loop.plant.overflow else lost
    for i, tank in enumerate(loop.plant.outputs):
        if reference is None:
            break
        asked = [
            reference.initial[i],
            *(v for (_, j), v in zip(events, np.asarray(reference.targets)) if j == i),
        ]
        if max(asked) > rim[tank]:
            found.append(
                f"reference: output {i + 1} is asked for {max(asked):g} {length}, above the rim of"
                f" {_tank(case, tank)} at {rim[tank]:g} {length}: {never}"
            )
    for j, (low, volts, high) in enumerate(
        zip(*(np.asarray(v) for v in (bank.low, bank.initial, bank.high)))
    ):
        if not low <= volts <= high:
            found.append(
                f"pump {j + 1} runs at {volts:g} {drive} before t = 0, outside its limits of"
                f" {low:g} and {high:g} {drive}"
            )
    return [*found, *model_doubts(case)]


def model_doubts(case: Case) -> list[str]:
    """Return a sentence for each parameter in a model of controller or observer that differs from
    the plant's by more than its uncertainty.

    The uncertainty is the share in [uncertain], or two standard deviations of [covariance]; nothing
    but rounding where neither has the parameter. Rims count only in a model in which they are
    physics, and no model that its law does not read (PID without feed-forward).
    """
    found, plant = [], case.loop.plant
    for holder in ("controller", "observer"):
        part = getattr(case.loop, holder)
        inner = f"{holder}.law." if is_component(getattr(part, "law", None)) else f"{holder}."
        law = getattr(part, "law", part)
        model = getattr(law, "model", None)
        if model is None or not getattr(law, "reads_model", True):
            continue
        # no level depends on rims that are no physics
        vacant = () if getattr(model, "overflow", False) else ("rim", "caught")
        theirs = {name: value for name, value, _ in walk(model)}
        for name, value, meta in walk(plant):
            other = None if name in vacant else theirs.get(name)
            if value is None or other is None or np.shape(other) != np.shape(value):
                continue
            own, other = np.asarray(value, dtype=float), np.asarray(other, dtype=float)
            allowed, words = _uncertainty(case, f"plant.{name}", own)
            if np.any(np.abs(other - own) > np.maximum(allowed, 1e-9 * np.abs(own))):
                unit = "" if meta["unit"] == "-" else f" {meta['unit']}"
                here = f"{inner}model.{name}"
                found.append(
                    f"{here} = {_listed(other)}{unit}, and plant.{name} = {_listed(own)}{unit}: the"
                    f" model of the {holder} differs from the plant{words}; unless that is meant,"
                    f" set {here} = {_listed(own)} too (in a rig file a model that is left out"
                    " follows the plant)"
                )
    return found


def _uncertainty(case, name, value):
    """(how far a model may be off the plant's parameter `name`, in its unit; the same in words)."""
    allowed, words = np.zeros(np.shape(value)), ""
    for key, share in case.uncertain.items():
        base, index = split_index(key)
        if base == name:
            allowed[index or ...] = share * np.abs(value[index or ...])
            words = f" by more than [uncertain] has ({100 * share:g} %)"
    for i, key in enumerate(case.covariance[0] if case.covariance else ()):
        base, index = split_index(key)
        if base == name:
            allowed[index or ...] = 2.0 * np.sqrt(case.covariance[1][i][i])
            words = " by more than two standard deviations of [covariance]"
    return allowed, words


def _listed(value):
    return "[" + ", ".join(f"{v:.6g}" for v in value) + "]" if np.ndim(value) else f"{value:.6g}"


def clock_doubts(clock: Clock) -> list[str]:
    """Sentences on a clock: where the run does not end when it is asked to, for it is made of whole
    samples.
    """
    end = (clock.samples - 1) * clock.dt
    if abs(end - clock.duration) <= 1e-6 * clock.dt:
        return []
    return [
        f"clock.duration = {clock.duration:.9g} s is no whole number of samples of clock.dt ="
        f" {clock.dt:.9g} s: the run ends at {end:.9g} s"
    ]


def _tank(case, i):
    name = case.names.get("tank", {i: ""})[i]
    return f"tank {i + 1} ({name!r})" if name else f"tank {i + 1}"


def _late(found, what, times, end):
    late = [t for t in times if t >= end]
    if late:
        found.append(
            f"{len(late)} of {len(times)} {what} come after the end of the run at {end:g} s"
        )


SCENARIO_KEYS = ("name", "values", "seed", "weight")


def check(case: Case) -> Case:
    """`case`, after input validation: the loop and clock can be run, and every plateau of the
    reference has a steady state.
    """
    # a key will be given where there is noise
    lp.check(case.loop, case.clock, key=jax.ShapeDtypeStruct((), np.uint32))
    if case.reachable and (why := unreachable(case)):
        raise EquilibriumError(why)
    return case


def unreachable(case: Case) -> str | None:
    """Which plateau of the reference has no steady state on this plant, and why, in a sentence;
    None where all of them have one.
    """
    plant, reference = case.loop.plant, case.loop.reference
    if isinstance(reference, Ramps) and plant.pumps == len(plant.outputs):
        for values in reference.plateaus(case.clock.duration):
            try:
                equilibrium(plant, values)
            except EquilibriumError as error:
                return f"reference: {error}"
    return None


def check_uncertain(loop: ClosedLoop, uncertain: Mapping[str, Any]) -> dict[str, float]:
    """`uncertain` as a dict, if every one is a parameter in use with a spread above 0 and below 1."""
    for name, share in uncertain.items():
        get_value(loop, name)
        if not (is_numeric(share) and np.ndim(share) == 0 and 0 < share < 1):
            raise InputError(
                f"uncertain {name} = {shortened(share)}: must be a share between 0 and 1"
            )
    return {name: float(share) for name, share in uncertain.items()}


def uncovered(
    loop: ClosedLoop, name: str, share: float, covered: Iterable[str]
) -> dict[str, float]:
    """{name: share} of what [uncertain] says of `name`, less what is in `covered`: entry by entry
    where that is part of an array; a share of nothing is left out.
    """
    if not any(split_index(c)[0] == split_index(name)[0] for c in covered):
        return {name: share}
    if "[" in name:
        return {} if name in covered else {name: share}
    value = np.asarray(get_value(loop, name))
    entries = (
        [f"{name}[{','.join(map(str, i))}]" for i in np.ndindex(value.shape) if value[i] != 0]
        if value.shape
        else []
    )
    return {n: share for n in entries if n not in covered}


def check_limits(loop: ClosedLoop, limits: Mapping[str, Any]) -> dict[str, Any]:
    """`limits` as a dict, if every one is a measure with a finite number, one for each of its
    entries, or "rim" for max_level.
    """
    check_names(limits)
    for measure, value in limits.items():
        count, unit = entries(measure, loop.plant), measure_unit(measure, loop.units)
        if isinstance(value, str) and value == "rim" and measure == "max_level":
            continue
        if not (is_finite(value) and np.shape(value) in ((), (count,))):
            many = f", or {count} of them" if count > 1 else ""
            rim = ', or "rim"' if measure == "max_level" else ""
            raise InputError(
                f"limit {measure} = {shortened(value)}: must be a finite number [{unit}]{many}{rim}"
            )
        if measure == "max_level" and np.min(value) < 0:
            raise InputError(
                f"limit {measure} = {shortened(value)} {unit}: must be at least 0 {unit}, no level"
                " is below empty"
            )
    return dict(limits)


def check_objective(objective: Mapping[str, Any]) -> dict[str, float]:
    """`objective` as a dict, if every one is a measure with a finite weight at or above 0, and one
    of them above.
    """
    check_names(objective)
    for measure, weight in objective.items():
        if not (is_finite(weight) and np.ndim(weight) == 0 and weight >= 0):
            raise InputError(
                f"objective {measure} = {shortened(weight)}: must be a finite weight at or above 0"
            )
    if not any(objective.values()):
        raise InputError("the objective has no measure with a weight above 0")
    return {measure: float(weight) for measure, weight in objective.items()}


def check_free(loop: ClosedLoop, name: str, low: Any, high: Any, scale: str = "log") -> Free:
    """The Free of a parameter, if it is a leaf in use and its range lies within what it allows."""
    if name.startswith("clock.") and name.removeprefix("clock.") in CLOCK_UNITS:
        meta = {"kind": "static"}
    else:
        meta = describe(loop, name)
    if meta["kind"] == "static":
        raise InputError(
            f"free {name}: cannot be tuned, it is part of the compiled program and not a number"
            " with a derivative"
        )
    schedule.check_not_scheduled(loop, name)
    get_value(loop, name)
    unit = "" if meta["unit"] == "-" else f" {meta['unit']}"
    if not (math.isfinite(low) and math.isfinite(high) and low < high):
        raise InputError(
            f"free {name} = {low:g}:{high:g}: must be LOW:HIGH with finite LOW below HIGH{unit}"
        )
    for end in (low, high):
        for row in meta.get("rows") or (meta,):  # an array whose rows are different things
            check_value(f"free {name}", end, row)
    if scale not in ("log", "linear"):
        raise InputError(f"free {name}: scale {scale!r} must be log or linear")
    return Free(float(low), float(high), scale if low > 0 else "linear")


def free_of(loop, table):
    """{name: Free} of a [free] table. A gain that a schedule gives is free at every knot, and other
    names of the scheduled law are found.
    """
    found = {}
    for name, spec in table.items():
        good = (
            isinstance(spec, list)
            and len(spec) in (2, 3)
            and all(is_numeric(v) and np.ndim(v) == 0 for v in spec[:2])
        )
        if not good or (len(spec) == 3 and spec[2] not in ("log", "linear")):
            raise InputError(
                f'free {name} = {shortened(spec)}: must be [low, high] or [low, high, "log" or'
                ' "linear"]'
            )
        for own in schedule.names_of(loop, name):
            found[own] = check_free(loop, own, *spec)
    return found


def scenario(case, entry, index):
    """The Scenario of one [[scenario]] table, if it can be run."""
    if not isinstance(entry, dict):
        raise InputError(f"scenario {index + 1} = {shortened(entry)}: must be a table")
    for key in entry:
        if key not in SCENARIO_KEYS:
            raise unknown("key of [[scenario]]", key, SCENARIO_KEYS)
    name, values = entry.get("name", f"scenario {index + 1}"), entry.get("values", {})
    seed, weight = entry.get("seed", 0), entry.get("weight", 1.0)
    name_of(f"scenario {index + 1}: name", name)
    if not isinstance(values, dict):
        raise InputError(f"scenario {name!r}: values = {shortened(values)}: must be a table")
    if isinstance(seed, bool) or not isinstance(seed, int) or not 0 <= seed < 2**31:
        raise InputError(
            f"scenario {name!r}: seed = {shortened(seed)} must be a whole number from 0 to"
            f" {2**31 - 1}"
        )
    if not (is_finite(weight) and np.ndim(weight) == 0 and weight > 0):
        raise InputError(
            f"scenario {name!r}: weight = {shortened(weight)} must be a finite number above 0"
        )
    try:
        values = by_dotted_name(values, "scenario.values")
        set_scenario(case, values)
    except EquilibriumError:
        pass  # `check` names the plateau without one; where that is allowed, `tune` refuses
    except InputError as error:
        raise type(error)(f"scenario {name!r}: {error}") from None
    return Scenario(
        name,
        {n: tuple(v) if isinstance(v, list) else v for n, v in values.items()},
        seed,
        float(weight),
    )
