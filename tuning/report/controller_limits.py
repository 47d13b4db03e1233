"""Setpoints that the plant of a case can hold, but its controller or safety filter prevents."""

from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxtank.case import Case
from jaxtank.core.labels import input_unit, label_of
from jaxtank.xla.jit import compiled
from tuning.feasible.study import can_judge
from tuning.problem.tracking import tracked_of
from tuning.report.tables import Value
from tuning.uncertainty.needs import Needs, plateaus_of

NEAR = 1e-3  # share of a height within which a level has settled on its setpoint [-]
TOLERANCE = 1e-6  # share of a limit or range above which a difference counts [-]


def blocked_setpoints(case: Case, values: Mapping[str, Any] | None = None) -> list[str]:
    """Return a sentence on each limit of the controller or of the safety filter that keeps the
    outputs off a setpoint; values: measures of its run, where known.
    """
    plateaus, plant = plateaus_of(case) or [], case.loop.plant
    if not plateaus or not hasattr(plant, "links") or _settles(case, values or {}):
        return []
    if can_judge(case):
        needed = Needs(case, {}).at()[0]
    else:  # of the levels only the setpoints are known
        needed = np.full((len(plateaus), plant.tanks + plant.pumps), np.nan)
        needed[:, list(plant.outputs)] = [plateau.values for plateau in plateaus]
    words = [f"setpoints {Value(p.values, 4, case.loop.units[0], ', ')}" for p in plateaus]
    levels, inputs = needed[:, : plant.tanks], needed[:, plant.tanks :]
    return [*_by_controller(case, words, levels), *_by_filter(case, words, levels, inputs)]


def _settles(case, values):
    """Whether the outputs of a run come near all setpoints, so that nothing is in their way."""
    tracked = tracked_of(case.loop, values)
    return tracked is not None and bool(np.all(tracked.missed < NEAR * tracked.heights))


def _by_controller(case, words, levels):
    unit = case.loop.units[0]
    for tank, least, most in case.loop.controller.level_limits():
        level = levels[:, tank]
        beyond = np.nan_to_num(np.maximum(level - most, least - level))
        k = int(np.argmax(beyond))
        if beyond[k] > TOLERANCE * abs(level[k]):
            side, limit = ("above", least) if level[k] < least else ("below", most)
            name = label_of(case.loop.plant, "tank", tank)
            yield (
                f"{words[k]} need {level[k]:.4g} {unit} in {name}, which the controller keeps at or"
                f" {side} {limit:.4g} {unit}"
            )


def _by_filter(case, words, levels, inputs):
    """On plateaus whose inputs the safety filter changes, as if they were commanded there."""
    loop, plant = case.loop, case.loop.plant
    if loop.safety_filter is None:
        return
    low, high = (np.asarray(end, dtype=float) for end in (loop.actuator.low, loop.actuator.high))
    possible = np.isfinite(levels).all(axis=1) & ((low <= inputs) & (inputs <= high)).all(axis=1)
    with jax.enable_x64(True):
        hold = np.asarray(case.clock.dt)
        passed = _filtered(loop.safety_filter, loop.actuator, inputs, levels, hold)
    span = np.where(np.isfinite(high - low), high - low, np.maximum(np.abs(inputs), 1.0))
    share = np.where(possible[:, None], (np.asarray(passed) - inputs) / span, 0.0)
    k, j = map(int, np.unravel_index(np.argmax(np.abs(share)), share.shape))
    if abs(share[k, j]) > TOLERANCE:
        unit = input_unit(plant, j, loop.units[1])
        yield (
            f"{words[k]} need {inputs[k, j]:.4g} {unit} of {label_of(plant, 'pump', j)}, which the"
            f" safety filter sets to {float(passed[k, j]):.4g} {unit} at these levels"
        )


@compiled(keep=True)
def _filtered(safety_filter, actuator, inputs, levels, hold):
    """(plateaus, m) what the filter makes of inputs (plateaus, m) at levels (plateaus, n)."""

    def at(u, y):
        line = [jnp.full(getattr(safety_filter, "predicted", 0), v) for v in u]
        return jnp.stack(safety_filter.apply(actuator, tuple(u), None, tuple(y), hold, line)[0])

    return jax.vmap(at)(jnp.asarray(inputs), jnp.asarray(levels))
