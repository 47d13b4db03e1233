"""Theorem 2: which limits can be kept, and how.

May be imported by `safety.certificate`.
"""

import math

import numpy as np

from jaxtank.safety.filter import FLOOR
from jaxtank.safety.setting import resting_level, sqrt_of, unstoppable

MARGIN = 0.9
"""Share of D = sum c_j o_j / 2 that the choice of k1 counts on."""


def filled_levels(setting, wanted, start):
    """(n,) levels [cm] to which full pumps fill the tanks at most, no tank above its wanted limit
    or its start; inf for tanks with pipes.
    """
    filled, rates = np.full(len(wanted), np.inf), setting.rates
    for _ in filled:
        others = np.minimum(wanted, np.maximum(filled, start))
        for i in range(len(filled)):
            if not any(tank == i for tank, *_ in rates.pipes):
                rest = resting_level(setting, i, others)
                filled[i] = max(rest, rates.empty[i])
    return filled


def limits_for(setting, heights, kappa):
    """(limits (n,) [cm], k1 (n,) [1/s], {tank: why it failed}): Theorem 2.

    A tank whose inflow alone passes its limit is held by the pumps above it if it has none of its
    own; otherwise the limits of the tanks above are lowered by one factor until it is not.
    """
    n, rates = len(heights), setting.rates
    heights, slopes, reasons = np.array(heights), np.zeros(n), [""] * n
    for _ in range(4 * n):
        changed = False
        for i in range(n):
            excess = setting.phi(i, heights[i], heights) + unstoppable(setting, i)
            if excess <= 1e-12 or slopes[i] > 0.0 or reasons[i]:
                continue
            slopes[i], why = _second_order(setting, i, heights, kappa)
            if slopes[i] > 0.0:
                continue
            sources = [(j, most) for j, sink, _, most in rates.links if sink == i]
            pressed = sum(
                most * sqrt_of(heights[j] + setting.spare[j], rates.knee) for j, most in sources
            )
            margin = rates.out[i] * sqrt_of(heights[i], rates.knee) - (
                excess + rates.out[i] * sqrt_of(heights[i], rates.knee) - pressed
            )
            if not sources or margin <= 0.0:
                reasons[i] = _rim_words(setting, i, heights) + (f"; {why}" if why else "")
                continue
            for j, _ in sources:
                heights[j] *= (margin / pressed) ** 2 * (1.0 - 1e-12)
            changed = True
        if not changed:
            break
    return heights, slopes, reasons


def _rim_words(setting, tank, heights):
    """The rim condition with both of its numbers."""
    rates = setting.rates
    leaves = rates.out[tank] * sqrt_of(heights[tank], rates.knee)
    enters = setting.phi(tank, heights[tank], heights) + leaves + unstoppable(setting, tank)
    return (
        f"rim condition: {enters:.3g} cm/s may enter at the limit, {leaves:.3g} leave for certain"
    )


def _second_order(setting, tank, heights, kappa):
    """(k1 [1/s], "") for a tank that the pumps above it can hold, or (0, the failed condition)."""
    rates, hold = setting.rates, setting.hold
    sources = [(j, least, most) for j, sink, least, most in rates.links if sink == tank]
    above = {j for j, *_ in sources}
    if rates.pumps[tank]:
        return 0.0, ""
    if setting.delay > 0.0 or setting.lag > 0.0:
        return 0.0, "second order: not proved with dead time or lag"
    others = {i for pipe in rates.pipes for i in pipe[:2]}
    if others & (above | {tank}) or any(rates.inflow[i] > 0.0 for i in (tank, *above)):
        return 0.0, "second order: not proved with pipes or inflow disturbances"
    if any(sink in above for _, sink, *_ in rates.links) or not all(rates.pumps[j] for j in above):
        return 0.0, "second order: not proved where the tanks above are fed by others"
    if any(setting.low > 0.0):
        return 0.0, "second order: not proved for pumps that cannot stop"
    if kappa * hold > 1.0:
        return 0.0, f"second order: k2 T = {kappa * hold:.3g} above 1"
    top, knee = heights[tank], rates.knee
    full = sum(most * sqrt_of(heights[j], knee) for j, _, most in sources)
    drained = MARGIN * sum(0.5 * most * rates.out[j] for j, _, most in sources)
    a0 = FLOOR * sqrt_of(top, knee)
    if a0**2 < knee:
        return 0.0, f"second order: laminar threshold {knee:g} above {a0**2:.3g}"
    for j, _, most in sources:
        left = rates.out[tank] * sqrt_of(top, knee) - (full - most * sqrt_of(heights[j], knee))
        if left <= most * a0:
            return 0.0, f"second order: (C3) {left:.3g} not above {most * a0:.3g} cm/s"
    for k1 in np.geomspace(1.0 / hold, 1e-4, 2000):
        if k1 * top < full:  # (C2)
            break
        level = _crossing(rates.out[tank], k1, top, full)
        lowest = level - hold * full - 2.0 * setting.band[tank]
        lowest -= hold * rates.out_most[tank] * sqrt_of(top, knee)
        steep = rates.out[tank] * 0.5 / math.sqrt(lowest) if lowest > knee else math.inf
        if k1**2 * (top - level) <= drained and k1 > steep:  # (C1), (C4)
            return float(k1), ""
    return 0.0, f"second order: no k1 with (C1) k1^2 (H - h*) <= {drained:.3g} cm/s^2"


def _crossing(out, k1, top, full):
    """h* [cm] with out sqrt(h*) + k1 (H - h*) = F, on the falling side."""
    root = (out + math.sqrt(out**2 + 4.0 * k1 * (k1 * top - full))) / (2.0 * k1)
    return min(root**2, top)
