"""What a rig file may say, though it is seldom meant: told in a line each, and not refused, for a run cut short or a pump that was
weakened by `--set` says the same on purpose."""

import numpy as np

from jaxtank.rig.signals import steps
from jaxtank.signals import Pours
from jaxtank.tree import is_component, split_index, walk


def doubts(case):
    """Sentences on what of a case can hardly be meant: a clock of broken samples, changes and pours after the end of the run, changes
    that overlap, levels and setpoints above the rim, pumps that start outside their limits, models that are not the plant's. (Steps that
    are too long: `step_length`.)"""
    loop, (length, drive) = case.loop, case.loop.units
    found, end, rim = clock_doubts(case.clock), case.clock.duration, np.asarray(loop.plant.rim)
    reference, bank = steps(loop.reference), loop.actuator
    events = [] if reference is None else list(reference.changes)
    _late(found, "changes of the reference", [t for t, _ in events], end)
    if isinstance(loop.disturbance, Pours):
        _late(found, "pours", [t for t, *_ in loop.disturbance.events], end)
    over, early = {}, []
    for t, i in events:
        early += [(i, t)] if t < over.get(i, 0.0) - 1e-7 * case.clock.dt else []
        over[i] = t + reference.ramp
    if early:
        found.append(
            f"reference: {len(early)} of {len(events)} changes begin before the one before is over (ramp {reference.ramp:g} s), the first "
            f"of output {early[0][0] + 1} at {early[0][1]:g} s: each starts from where that one has got to"
        )
    lost = "what is above it is lost at once" if loop.plant.overflow else "rims are limits here and not physics"
    for i, level in enumerate(np.asarray(loop.x0)):
        if level > rim[i]:
            found.append(f"{_tank(case, i)} starts at {level:g} {length}, above its rim at {rim[i]:g} {length}: {lost}")
    never = "a level cannot get there" if loop.plant.overflow else lost
    for i, tank in enumerate(loop.plant.outputs if reference is not None else ()):
        asked = [reference.initial[i], *(v for (_, j), v in zip(events, np.asarray(reference.targets)) if j == i)]
        if max(asked) > rim[tank]:
            found.append(
                f"reference: output {i + 1} is asked for {max(asked):g} {length}, above the rim of {_tank(case, tank)} at "
                f"{rim[tank]:g} {length}: {never}"
            )
    for j, (low, volts, high) in enumerate(zip(*(np.asarray(v) for v in (bank.low, bank.initial, bank.high)))):
        if not low <= volts <= high:
            found.append(f"pump {j + 1} runs at {volts:g} {drive} before t = 0, outside its limits of {low:g} and {high:g} {drive}")
    return [*found, *model_doubts(case)]


def model_doubts(case):
    """Sentences on the parameters in the models of controller and observer that differ from the plant's by more than its uncertainty:
    the share in [uncertain], or two standard deviations of [covariance]; by more than rounding where neither has them."""
    found, plant = [], case.loop.plant
    for holder, part in (("controller", case.loop.controller), ("observer", case.loop.observer)):
        inner = f"{holder}.law." if is_component(getattr(part, "law", None)) else f"{holder}."
        model = getattr(getattr(part, "law", part), "model", None)
        if model is None:
            continue
        # without rims as physics no level depends on them
        vacant = () if getattr(model, "overflow", False) else ("rim", "caught")
        theirs = {name: value for name, value, _ in walk(model)}
        for name, value, meta in walk(plant):
            if name in vacant or value is None or theirs.get(name) is None or np.shape(theirs[name]) != np.shape(value):
                continue
            own, other = np.asarray(value, dtype=float), np.asarray(theirs[name], dtype=float)
            allowed, words = _uncertainty(case, f"plant.{name}", own)
            if np.any(np.abs(other - own) > np.maximum(allowed, 1e-9 * np.abs(own))):
                unit = "" if meta["unit"] == "-" else f" {meta['unit']}"
                found.append(
                    f"{inner}model.{name} = {_listed(other)}{unit}, and plant.{name} = {_listed(own)}{unit}: the {holder} computes with "
                    f"another plant than the one that it runs on{words}; where that is not meant, set it to the plant's, "
                    f"{inner}model.{name} = {_listed(own)} (a rig file without it follows the plant)"
                )
    return found


def _uncertainty(case, name, value):
    """(how far a model may be off the parameter `name` of the plant, in its unit and shape, in words)."""
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


def clock_doubts(clock):
    """Sentences on a clock: where the run does not end when it is asked to, for it is made of whole samples."""
    end = (clock.samples - 1) * clock.dt
    if abs(end - clock.duration) <= 1e-6 * clock.dt:
        return []
    return [
        f"clock.duration = {clock.duration:.9g} s is no whole number of samples of clock.dt = {clock.dt:.9g} s: the run ends at {end:.9g} s"
    ]


def _tank(case, i):
    name = case.names.get("tank", {i: ""})[i]
    return f"tank {i + 1} ({name!r})" if name else f"tank {i + 1}"


def _late(found, what, times, end):
    late = [t for t in times if t >= end]
    if late:
        found.append(f"{len(late)} of {len(times)} {what} come after the end of the run at {end:g} s")
