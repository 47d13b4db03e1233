"""What the conditions of the theorems are computed from, in plain numbers."""

import math
from typing import Any, NamedTuple

import numpy as np

from jaxtank.safety.worst_case import Rates


class Setting(NamedTuple):
    """What the conditions need: coefficients over the box, times [s], pumps' limits [V], bands."""

    rates: Rates
    hold: float
    delay: float
    lag: float
    low: np.ndarray
    high: np.ndarray
    band: np.ndarray
    top: np.ndarray
    spare: np.ndarray
    pulse: bool
    dead: bool = False  # whether a pump stands still for inputs above 0
    drawn: bool = False  # whether inflow pulses draw liquid
    predicted: int = 0  # inputs under way over which levels are predicted
    before: tuple = ()  # (m) inputs under way at t = 0, less dead zones [V]; () for none
    weakest: tuple = ()  # (m) least upper limits of the pumps, less dead zones [V]
    beyond: bool = False  # whether inputs under way at t = 0 are beyond the limits of the pumps
    divided: tuple = ()  # tanks whose row is divided among their pumps
    uncovered: tuple = ()  # (n) why a tank has a feature that no theorem covers, ""

    def phi(self, tank, level, others):
        """Phi_max(level) [cm/s]; others: limits of all tanks, before volumes that enter besides."""
        return phi(self.rates, tank, level, np.asarray(others) + self.spare)


def phi(rates: Rates, tank: int, level: float, others: Any) -> float:
    """Phi_max(level) [cm/s] in plain numbers; see `worst_case.rise`."""
    knee, h = rates.knee, max(level, 0.0)
    empty = h < rates.empty[tank]
    rate = rates.inflow[tank] - (0.0 if empty else rates.out[tank] * sqrt_of(h, knee))
    for i, j, least, most in rates.pipes:
        if i == tank:
            z = others[j] - h
            s = math.copysign(math.sqrt(abs(z)), z) if not math.isinf(z) else z
            s = z / (z * z + knee * knee) ** 0.25 if abs(z) < 1e6 else s
            rate += most * s if s >= 0.0 else (0.0 if empty else least * s)
    for source, sink, _, most in rates.links:
        if sink == tank:
            rate += most * sqrt_of(max(others[source], 0.0), knee)
    return rate


def phi_min(rates: Rates, tank: int, level: float, others: Any) -> float:
    """Phi_min(level) [cm/s] in plain numbers; see `worst_case.fall`."""
    knee, h = rates.knee, max(level, 0.0)
    rate = rates.draw[tank] - rates.out_most[tank] * sqrt_of(h, knee)
    for i, j, least, most in rates.pipes:
        if i == tank:
            z = others[j] - h
            s = z / (z * z + knee * knee) ** 0.25
            rate += (0.0 if others[j] < rates.empty[j] else least * s) if s >= 0.0 else most * s
    for source, sink, least, _ in rates.links:
        if sink == tank and others[source] >= rates.empty[source]:
            rate += least * sqrt_of(max(others[source], 0.0), knee)
    return rate


def sqrt_of(h, knee):
    """The root of the plant's flows (`numerics.root`) of a level h >= 0 in plain numbers."""
    return math.sqrt(h) if h >= knee else math.sqrt(knee) * (1.5 * h / knee - 0.5 * (h / knee) ** 2)


def brought(setting, tank, inputs):
    """What pumps at `inputs` (m,) [V] bring at most [cm/s]; with a divided row the total at which
    the pump that needs most of its share has it.
    """
    gains = [(j, b) for j, (_, b) in setting.rates.pumps[tank].items() if b > 0.0]
    if tank not in setting.divided:
        return sum(b * max(inputs[j], 0.0) for j, b in gains)
    full = sum(b * max(setting.high[j], 0.0) for j, b in gains)
    return max(
        [full * max(inputs[j], 0.0) / max(setting.high[j], 1e-300) for j, _ in gains], default=0.0
    )


def unstoppable(setting, tank):
    """What pumps with a lower limit above 0 V always bring [cm/s]."""
    return brought(setting, tank, setting.low)


def full_pumps(setting, tank):
    """What full pumps, and inputs under way at t = 0, bring at most [cm/s]."""
    high = np.maximum(setting.high, setting.before) if setting.before else setting.high
    return brought(setting, tank, high)


def ran_before(setting, tank):
    """What the inputs under way at t = 0 bring at most [cm/s]."""
    return brought(setting, tank, setting.before) if setting.before else 0.0


def resting_level(setting, tank, others):
    """Level [cm] at which a tank rests with the most that may enter; inf if it never does."""
    full = full_pumps(setting, tank)
    level = highest_level(lambda h: full + setting.phi(tank, h, others), 1e6)
    return math.inf if level == 1e6 else level * (1.0 + 1e-9)


def highest_level(rate, top):
    """The level [cm] up to which rate(level), which falls with it, is above 0; `top` at most."""
    low, high = 0.0, top
    if rate(top) > 0.0:
        return top
    for _ in range(60):
        mid = 0.5 * (low + high)
        low, high = (mid, high) if rate(mid) > 0.0 else (low, mid)
    return low
