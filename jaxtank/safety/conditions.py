"""The conditions of the theorems, tank by tank, and what a filter costs.

May be imported by `safety.certificate`.
"""

import math

import numpy as np

from jaxtank.safety.filter import FLOOR
from jaxtank.safety.setting import (
    full_pumps,
    highest_level,
    phi,
    phi_min,
    ran_before,
    resting_level,
    sqrt_of,
    unstoppable,
)


def theorem_of(setting, tank):
    """What proves the limit of a tank without a second-order row."""
    if not setting.rates.pumps[tank]:
        return "no pump, and its inflow cannot pass the limit"
    if setting.lag > 0.0:
        return "Theorem 4"
    if setting.predicted:
        return "Theorem 5"
    return "Theorem 3" if setting.delay > 0.0 else "Theorem 1"


def failed_condition(setting, tank, heights, slopes, idle, kappa, bound, start):
    """The condition that keeps the limit of one tank from being proved, or ""."""
    rates = setting.rates
    if start is not None and np.asarray(start)[tank] > heights[tank] * (1.0 + 1e-12):
        return f"start at {np.asarray(start)[tank]:.4g} cm, above the limit {heights[tank]:.4g} cm"
    if idle:
        return ""
    if setting.pulse:
        return "a pulse dead zone pays out more than was commanded"
    if kappa > bound * (1.0 + 1e-12):
        return f"kappa {kappa:.3g} above its bound {bound:.3g} 1/s"
    if slopes[tank] > 0.0:
        return _too_high_above(setting, tank, heights, slopes, start)
    if not rates.pumps[tank] or (setting.delay == 0.0 and setting.lag == 0.0):
        return ""
    if setting.predicted:
        return "" if start is None else _filled_under_way(setting, tank, heights, np.asarray(start))
    if any(i == tank for i, *_ in rates.pipes):
        return "a pipe with dead time or lag: not proved"
    steep = rates.out[tank] / math.sqrt(heights[tank])
    if kappa < steep:
        return f"(N) kappa {kappa:.3g} below c_min/sqrt(H) = {steep:.3g} 1/s"
    if setting.lag > 0.0:
        brought = full_pumps(setting, tank) + setting.phi(tank, 0.0, heights)
        filled = brought * (2.0 * setting.lag + setting.delay + setting.hold)
        if filled > 0.75 * heights[tank]:
            return f"(F) {filled:.3g} cm may be filled within the lag: above 3/4 of the limit"
    return "" if start is None else _under_way(setting, tank, heights, kappa, np.asarray(start))


def _under_way(setting, tank, heights, kappa, start):
    """Why (S) fails, the inputs under way obey the row of the levels `start`, or ""."""
    age, others = setting.delay + setting.hold, np.array(heights)
    for k in range(len(heights)) if setting.lag == 0.0 else ():
        fastest = full_pumps(setting, k) + max(setting.phi(k, 0.0, heights), 0.0)
        others[k] = min(heights[k], start[k] + age * fastest)
    brought = ran_before(setting, tank)
    allowed = kappa * (heights[tank] - start[tank]) - setting.phi(tank, start[tank], others)
    if brought <= allowed * (1.0 + 1e-9):
        return ""
    return f"(S) start: {brought:.3g} cm/s under way, {max(allowed, 0.0):.3g} allowed"


def _filled_under_way(setting, tank, heights, start):
    """Why the inputs under way at the start may fill a tank past its limit, or ""."""
    level, steps = float(start[tank]), 200 * setting.predicted
    step, brought = setting.delay / steps, ran_before(setting, tank)
    for _ in range(steps):  # from above: the explicit step where it rises, no change where it falls
        level += step * max(brought + setting.phi(tank, level, heights), 0.0)
        if level > heights[tank] * (1.0 + 1e-9):
            return f"start: inputs under way may fill it above {heights[tank]:.4g} cm"
    return ""


def _too_high_above(setting, tank, heights, slopes, start):
    """Why the levels `start` do not allow a second-order row to begin (g >= 0), or ""."""
    if start is None:
        return ""
    start, rates, knee = np.asarray(start), setting.rates, setting.rates.knee
    a0 = FLOOR * sqrt_of(heights[tank], knee)
    g = rates.out[tank] * sqrt_of(start[tank], knee)
    g += slopes[tank] * (heights[tank] - start[tank])
    for j, sink, _, most in rates.links:
        if sink == tank:
            g -= most * max(sqrt_of(start[j], knee), a0)
    return "" if g >= 0.0 else "start: the tanks above hold more than can be stopped in time"


def settle(setting, heights, slopes, idle, reasons, plant):
    """(n,) levels that no tank passes [cm]. A tank that relies on one which is not certified loses
    its certificate (in `reasons`) unless its condition holds for what that one may reach.
    """
    while True:
        reach = _reach(setting, heights, [not why for why in reasons], plant)
        before = list(reasons)
        for i, why in enumerate(before):
            others = [] if why else _relied_on(setting, i, heights, slopes, idle, reasons, reach)
            if others:
                names = ", ".join(str(j + 1) for j in others)
                reasons[i] = f"relies on tank {names}, not certified"
        if reasons == before:
            return reach


def _relied_on(setting, tank, heights, slopes, idle, reasons, reach):
    """[tanks without a certificate that the proof of `tank` needs], [] where it holds as it is."""
    rates = setting.rates
    above = [j for j, sink, *_ in rates.links if sink == tank and reasons[j]]
    if slopes[tank] > 0.0:
        return above
    extra = full_pumps(setting, tank) if idle[tank] else unstoppable(setting, tank)
    if setting.phi(tank, heights[tank], reach) + extra <= 1e-9 * max(rates.out[tank], 1e-9):
        return []
    return above or [j for j, why in enumerate(reasons) if why]


def _reach(setting, heights, certified, plant):
    """(n,) levels that no tank passes [cm]: H where certified, else where its inflow can rest."""
    n, rim = len(heights), np.asarray(plant.rim, dtype=float)
    reach = np.array(heights)
    for _ in range(50):
        before = reach.copy()
        for i in (i for i in range(n) if not certified[i]):
            reach[i] = max(reach[i], resting_level(setting, i, reach))
            if plant.overflow:
                reach[i] = min(reach[i], max(rim[i], heights[i]))
        if np.allclose(reach, before, rtol=1e-9, atol=0.0):
            return reach
    return np.where(certified, heights, rim if plant.overflow else np.inf)


def gap_of(setting, nominal, tank, kappa, limit, reach):
    """By how much [cm] the filter lowers the level at which the nominal plant rests with its pumps
    full, or its limit where that is lower; nan for a tank without a pump.
    """
    rates, eps = setting.rates, setting.band[tank]
    if not rates.pumps[tank]:
        return math.nan
    most = sum(b for _, b in rates.pumps[tank].values())
    full = sum(b * max(setting.high[j], 0.0) for j, (_, b) in nominal.pumps[tank].items())
    gain = sum(b for _, b in nominal.pumps[tank].values())
    others = np.minimum(reach + setting.spare, 1e6)

    def filtered(h):
        low, high = h - eps, h + eps
        if setting.predicted:
            brought = max(-phi(nominal, tank, h, others), 0.0) / gain  # at rest
            low, high = _under_way_at_rest(setting, tank, (low, high), brought, others)
        cap = max(0.0, kappa * (limit - high) - phi(rates, tank, low, others))
        return min(full, gain / most * cap) + phi(nominal, tank, h, others)

    free = lambda h: full + phi(nominal, tank, h, others)
    # the levels are found to about 1e-12 of the limit
    return max(round(float(highest_level(free, limit) - highest_level(filtered, limit)), 9), 0.0)


def _under_way_at_rest(setting, tank, levels, brought, others):
    """(least, largest) level [cm] predicted from `levels` with pumps that bring `brought` times
    their gain.
    """
    rates, (low, high), steps = setting.rates, levels, 4 * setting.predicted
    least, most = (sum(b[end] for b in rates.pumps[tank].values()) for end in (0, 1))
    for _ in range(steps):
        low += setting.delay / steps * (least * brought + phi_min(rates, tank, low, 0.0 * others))
        high += setting.delay / steps * (most * brought + phi(rates, tank, high, others))
    return low, high
