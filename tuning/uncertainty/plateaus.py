"""The plateaus of a reference: when each is held, and the names of the setpoints that make it."""

from typing import Any, NamedTuple

import numpy as np

from jaxtank.case import Case
from jaxtank.signals.base import Constant
from jaxtank.signals.setpoints import Ramps


class Plateau(NamedTuple):
    """Setpoints that are held for a while."""

    time_s: float
    """From when on [s]."""
    names: tuple[str, ...]
    """(outputs,) dotted name of each setpoint."""
    values: tuple[float, ...]
    """(outputs,) each setpoint [cm]."""


def plateaus_of(case: Case) -> list[Plateau] | None:
    """Return the plateaus of a case in order of time, or None where its reference has none."""
    reference: Any = case.loop.reference
    if isinstance(reference, Ramps):
        return _of_ramps(reference, case.clock.duration)
    if isinstance(reference, Constant):
        names = tuple(f"reference.level[{i}]" for i in range(reference.channels))
        return [Plateau(0.0, names, tuple(map(float, reference.level)))]
    return None


def _of_ramps(reference, duration):
    """The plateaus of Ramps."""
    ramp = float(reference.ramp)
    names = [f"reference.initial[{i}]" for i in range(reference.channels)]
    values = [float(v) for v in reference.initial]
    starts = sorted({time for time, _ in reference.changes})
    found = [] if starts and starts[0] <= 0.0 else [Plateau(0.0, tuple(names), tuple(values))]
    for start, following in zip(starts, [*starts[1:], np.inf]):
        for j, (time, i) in enumerate(reference.changes):
            if time == start:
                names[i], values[i] = f"reference.targets[{j}]", float(reference.targets[j])
        if start + ramp <= min(following, duration):
            found.append(Plateau(start + ramp, tuple(names), tuple(values)))
    return found
