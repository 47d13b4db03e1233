"""Whether runs keep to their setpoints: of verdicts, plants and tuning rules."""
# numbers of loops whose types are open
# pyright: reportUnknownMemberType=false, reportUnknownArgumentType=false
# pyright: reportUnknownVariableType=false, reportUnknownLambdaType=false

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from jaxtank import measures as ms
from jaxtank.controllers import OnOff, OpenLoop
from jaxtank.loop.closed_loop import ClosedLoop
from jaxtank.signals.base import Constant
from jaxtank.signals.setpoints import Ramps

UNJUDGED = (OpenLoop, OnOff)  # controllers that are not judged on tracking

OFF = 0.05  # share of a tank's height by which a settled level may miss its setpoint

SHARE = 0.5  # share of an output's largest step by which it may miss, where steps are above SMALL
SMALL = 0.005  # share of a tank's height from which a step is one to be followed, and not noise
SATURATED = 0.5  # share of the samples at a pump limit from which a large RMS error is no transient


OF_INPUTS = (
    "rms_input input_travel mean_square_travel mean_square_jitter mean_square_relative_jitter"
)
"""Measures of an objective that leaves the levels free."""


def is_averaging(loop: ClosedLoop, objective: Mapping[str, float]) -> bool:
    """Return whether inputs alone are penalised and no setpoint changes (averaging control)."""
    reference: Any = loop.reference
    still = isinstance(reference, Constant | Ramps) and not reference.changes
    weighed = {name for name, weight in objective.items() if weight}
    return still and bool(weighed) and weighed <= set(OF_INPUTS.split())


class Tracked(NamedTuple):
    """Tracking of runs: (..., outputs) numbers, and where they are too large."""

    swing: Any  # to either side of the setpoint at the end of a plateau
    missed: Any  # larger of swing and error at the end of a plateau, NaN where there is none
    rms: Any
    heights: Any
    allowed: Any
    off: Any  # misses its setpoint at the end of a plateau
    loose: Any  # large RMS error, with no plateau
    stuck: Any  # large RMS error, with a pump at a limit in most samples


def tracked_of(loop: ClosedLoop, values: Mapping[str, Any]) -> Tracked | None:
    """Return the Tracked of one run or many; None of a controller that follows no setpoint."""
    if isinstance(loop.controller, UNJUDGED) or not set(ms.TRACKED) <= set(values):
        return None
    plant: Any = loop.plant
    outputs = list(plant.outputs)
    row = lambda name: np.atleast_1d(np.asarray(values[name], dtype=float))
    rims = np.broadcast_to(plant.rim, plant.tanks)[outputs]
    heights = np.where(np.isfinite(rims), rims, np.abs(row("max_level")[..., outputs]))
    heights = np.where(heights > 0.0, heights, 1.0)  # of tanks without a rim their highest levels
    swing, rms = row("steady_state_swing"), row("rms_error")
    missed, allowed = np.maximum(row("steady_state_error"), swing), _allowed(loop, heights)
    large, moving = rms > OFF * heights, np.isnan(missed)
    busy = np.max(row("saturated_fraction"), axis=-1, keepdims=True, initial=0.0) > SATURATED
    masks = ~moving & (missed > allowed), moving & large, large & busy
    return Tracked(swing, missed, rms, heights, allowed, *masks)


def _allowed(loop: ClosedLoop, heights: Any) -> Any:
    """(..., outputs) errors that may stay: OFF of a height, and SHARE of the largest step."""
    reference: Any = loop.reference
    allowed = OFF * heights
    if not isinstance(reference, Ramps):
        return allowed
    outputs = heights.shape[-1]
    steps = np.ptp(np.array([np.broadcast_to(v, outputs) for v in reference.held()]), axis=0)
    return np.where(steps > SMALL * heights, np.minimum(allowed, SHARE * steps), allowed)


def not_tracking(
    loop: ClosedLoop, values: Mapping[str, Any], failed: np.ndarray
) -> np.ndarray | None:
    """Return (N,) which of many runs that have not failed do not track; None where unjudged."""
    tracked = tracked_of(loop, values)
    if tracked is None or failed.all():
        return None
    unknown = ~np.isfinite(tracked.rms)
    return np.any(unknown | tracked.off | tracked.loose | tracked.stuck, axis=-1) & ~failed


def lost_runs(loop: ClosedLoop, values: Mapping[str, Any], failed: np.ndarray) -> np.ndarray:
    """Return `not_tracking`, False where it is None."""
    lost = not_tracking(loop, values, failed)
    return np.zeros(np.shape(failed), dtype=bool) if lost is None else lost
