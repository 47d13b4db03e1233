"""The task of a search for gains that hold on uncertain plants: its cost and its sensor noise.

`jaxtank tune` and the live page take both from here.
"""

import numpy as np

from jaxtank import rig
from jaxtank.case import Case
from jaxtank.core.errors import InputError
from jaxtank.core.tree import with_values
from jaxtank.loop import run as lp
from jaxtank.loop.closed_loop import without_noise
from jaxtank.presets import find

NOISE = 1e-3
"""Standard deviation of the sensor noise where the case states none, as a share of the rim [-]."""

PRICE = (5e-3, 1e-2)
"""The cost weighs an RMS error of the first share of the height equal to an RMS change of the
inputs per sample of the second share of their range [-]."""

COST = ("mean_square_error", "mean_square_jitter")  # measures of the default cost

RELATIVE = "mean_square_relative_jitter"  # the second of them where the ranges of the pumps differ


def height(case: Case) -> float:
    """Return the highest rim [unit of length], or setpoint where no rim is finite."""
    rims = np.asarray(getattr(case.loop.plant, "rim", np.inf), dtype=float)
    if np.isfinite(rims).any():
        return float(rims[np.isfinite(rims)].max())
    plateaus = case.loop.reference.plateaus()
    return float(np.max(np.abs(plateaus))) if plateaus is not None else 1.0


IN_USE = 0.02  # share of the limits of an input from which they are its range [-]


def input_range(case: Case) -> np.ndarray:
    """Return the (pumps,) range of each pump's input."""
    # Limits that are infinite, or that begin below 0 and of which the case's run uses less than
    # IN_USE, are those of a model: the range is then what the run uses, twice its rms input.
    actuator = case.loop.actuator
    shape = (case.loop.plant.pumps,)
    low, high = (
        np.broadcast_to(np.asarray(v, float), shape) for v in (actuator.low, actuator.high)
    )
    if np.all(low >= 0.0) and np.all(np.isfinite(high)):
        return high - low
    quiet = without_noise(case.loop)
    used = 2.0 * np.asarray(lp.evaluate(quiet, case.clock, ["rms_input"])["rms_input"])
    limits = high - low
    return np.where(np.isfinite(limits) & ((low >= 0.0) | (used >= IN_USE * limits)), limits, used)


def default_cost(case: Case, span: np.ndarray) -> dict[str, float]:
    """Return the default cost: mean square error, and a price on the mean square change of the
    inputs per sample, without the change at a jump of a setpoint.
    """
    error, change = PRICE[0] * height(case), PRICE[1]
    limits = np.asarray(case.loop.actuator.high) - np.asarray(case.loop.actuator.low)
    if np.ptp(span) > 0.0 and np.all(limits == span):
        return {COST[0]: 1.0, RELATIVE: error**2 / (len(span) * change**2)}
    return {COST[0]: 1.0, COST[1]: error**2 / (len(span) * (change * float(np.mean(span))) ** 2)}


def has_own_objective(case: Case) -> bool:
    """Return True for a custom objective: neither the default nor the objective of a preset."""
    objective = dict(case.objective)
    if objective == {"rms_error_total": 1.0}:
        return False
    try:
        return objective != dict(find(case.name).objective)
    except InputError:
        return True


def sensor_noise(case: Case) -> tuple[np.ndarray, bool]:
    """Return ((tanks,) standard deviation of the sensor noise, True if neither case nor scenario
    has it).
    """
    noise = float(np.max(np.asarray(case.loop.sensor.noise)))
    loops = [rig.set_scenario(case, s.values).loop for s in case.scenarios]
    stated = max([noise, *(float(np.max(np.asarray(loop.sensor.noise))) for loop in loops)])
    rims = np.asarray(getattr(case.loop.plant, "rim", np.inf), dtype=float)
    rims = np.broadcast_to(np.where(np.isfinite(rims), rims, height(case)), case.loop.plant.tanks)
    return (np.full(rims.shape, stated), False) if stated > 0.0 else (NOISE * rims, True)


def with_noise(case: Case, noise: np.ndarray) -> Case:
    """Return the case with sensor noise (tanks,) where it has none."""
    stated = np.asarray(case.loop.sensor.noise, dtype=float)
    if np.any(stated > 0.0):
        return case
    noise = np.asarray(noise, dtype=float) if stated.ndim else np.max(noise)
    return case.replace(loop=with_values(case.loop, {"sensor.noise": noise}))
