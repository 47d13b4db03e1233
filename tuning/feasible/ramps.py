"""The shortest ramps with which the nominal run of a case holds its limits."""

import math

from jaxtank import rig
from jaxtank.case import Case
from jaxtank.core.errors import InputError
from jaxtank.loop import run as lp
from jaxtank.signals.setpoints import Ramps
from tuning.feasible.result import Mend
from tuning.problem.limits import resolve_limits
from tuning.problem.scenarios import runs_of

STEPS = 9
"""Runs of a bisection: to 1/500 of its first interval."""


def mended_ramp(case: Case) -> Mend | None:
    """Return the shortest `reference.ramp` with which the case's own run holds its limits."""
    reference = case.loop.reference
    if not isinstance(reference, Ramps) or not reference.changes:
        raise InputError(f"{case.name}: its reference has no ramps to mend")
    now, most = float(reference.ramp), _longest(reference, case.clock.duration)
    if _holds(case, now):
        return Mend(what="ramps", set={}, share=None, words="the ramps need no change")
    bad, good = now, max(now, 1.0)
    while good < most:
        good = min(1.6 * good, most)
        if _holds(case, good):
            break
        bad = good
    else:
        return None
    for _ in range(STEPS):
        middle = 0.5 * (bad + good)
        bad, good = (bad, middle) if _holds(case, middle) else (middle, good)
    rounded = _up(good)
    good = rounded if rounded <= most and _holds(case, rounded) else good
    words = f"ramps of {good:g} s"
    return Mend(what="ramps", set={"reference.ramp": good}, share=None, words=words)


def _longest(reference, duration):
    """The shortest time between two changes of an output, or to the end of the run [s]."""
    gaps = []
    for channel in range(reference.channels):
        times = [t for t, i in reference.changes if i == channel]
        gaps += [b - a for a, b in zip(times, [*times[1:], duration])]
    return min(gap for gap in gaps if gap > 0)


def _up(value):
    """`value` [s] rounded up to three digits."""
    scale = 10.0 ** (2 - math.floor(math.log10(value)))
    return math.ceil(value * scale - 1e-9) / scale


def _holds(case, ramp):
    """Whether the nominal run with ramps of `ramp` [s] holds every limit of the case."""
    mended = rig.set_values(case.replace(scenarios=()), {"reference.ramp": float(ramp)})
    limits = resolve_limits(mended)
    if not limits:
        return True
    key = runs_of(mended, (), 0)[0].key
    names = tuple(dict.fromkeys(limit.measure for limit in limits))
    measured, diverged = lp.evaluate_and_flag(mended.loop, mended.clock, names, key)
    return not bool(diverged) and all(limit.margin(measured) >= 0 for limit in limits)
