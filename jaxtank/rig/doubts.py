"""What a rig file may say, though it is seldom meant: told in a line each, and not refused, for a run cut short or a pump that was
weakened by `--set` says the same on purpose."""

import numpy as np

from jaxtank.rig.signals import steps
from jaxtank.signals import Pours
from jaxtank.tree import is_component, split_index, walk


def doubts(case):
    """Sentences on what of a case can hardly be meant: a clock of broken samples, changes and pours after the end of the run, changes
    that overlap, levels and setpoints above the rim, pumps that start outside their limits, models
    that differ from the plant. (Steps that are too long: `step_length`.)"""
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
    """Return a sentence for each parameter in a model of controller or observer that differs from
    the plant's by more than its uncertainty.

    The uncertainty is the share in [uncertain], or two standard deviations of [covariance]; nothing
    but rounding where neither has the parameter. Rims count only in a model in which they are physics,
    and no model that its law does not read (PID without feed-forward).
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
                    f"{here} = {_listed(other)}{unit}, and plant.{name} = {_listed(own)}{unit}: the "
                    f"model of the {holder} differs from the plant{words}; unless that is meant, set "
                    f"{here} = {_listed(own)} too (in a rig file a model that is left out follows the plant)"
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
