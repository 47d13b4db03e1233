"""Theorem 2: which limits can be kept, and how."""

import math

import numpy as np

from jaxtank.safety.filter import FLOOR
from jaxtank.safety.setting import resting_level, sqrt_of, unstoppable

MARGIN = 0.9
"""Share of D = sum c_j o_j / 2 that the choice of k1 counts on."""
SWEEPS = 500
"""Sweeps over all tanks after which limits that still fall count as not to be kept."""
LEAST = 1e-3
"""Share of a limit below which it is not lowered: a ring of orifices may lower limits to 0."""


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


def limits_for(setting, heights, kappa, unsettled=frozenset()):
    """(limits (n,) [cm], k1 (n,) [1/s], {tank: why it failed}): Theorem 2."""
    # A tank whose inflow alone passes its limit is held by the pumps above it if it has none of its
    # own; otherwise the limits of the tanks above are lowered by one factor until it is not. Every
    # k1 is chosen again after a limit was lowered, so what is returned meets all conditions at
    # once.
    # unsettled : tanks for whose sake no limit is lowered, since that did not come to an end
    n, limits = len(heights), np.array(heights)
    for _ in range(SWEEPS):
        slopes, reasons, lowered = np.zeros(n), list(setting.uncovered), set()
        for i in (i for i in range(n) if not reasons[i]):
            excess = setting.phi(i, limits[i], limits) + unstoppable(setting, i)
            if excess <= 1e-12:
                continue
            slopes[i], why = _second_order(setting, i, limits, kappa)
            if slopes[i] > 0.0:
                continue
            if i in unsettled:
                reasons[i] = f"{_rim_words(setting, i, limits)}; lower limits above do not mend it"
                continue
            factor, above = _lowering(setting, i, limits, excess)
            if not above:
                reasons[i] = _rim_words(setting, i, limits) + (f"; {why}" if why else "")
                continue
            if any(factor * limits[j] < LEAST * heights[j] for j in above):
                return limits_for(setting, heights, kappa, unsettled | lowered | {i})
            for j in above:
                limits[j] = factor * (limits[j] + setting.spare[j]) - setting.spare[j]
            lowered.add(i)
        if not lowered:
            return limits, slopes, reasons
    return limits_for(setting, heights, kappa, unsettled | lowered)


def _lowering(setting, tank, limits, excess):
    """(factor by which the levels of the tanks above must be lower, those tanks), none where that
    does not mend the rim condition of a tank.
    """
    rates, levels = setting.rates, limits + setting.spare
    sources = {j: most for j, sink, _, most in rates.links if sink == tank}
    pressed = sum(
        most * sqrt_of(levels[j], rates.knee) for j, sink, _, most in rates.links if sink == tank
    )
    # what the sources may bring: their inflow less what is too much of it
    margin = pressed - excess
    if margin <= 0.0:
        return 1.0, ()
    factor = (margin / pressed) ** 2 * (1.0 - 1e-12)
    low = any(factor * levels[j] <= setting.spare[j] for j in sources)
    return factor, () if low else tuple(sources)


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
    rates = setting.rates
    if rates.pumps[tank]:
        return 0.0, ""
    sources = [(j, most) for j, sink, _, most in rates.links if sink == tank]
    why = _other_topology(setting, tank, {j for j, _ in sources})
    if not why and kappa * setting.hold > 1.0:
        why = f"k2 T = {kappa * setting.hold:.3g} above 1"
    why = why or _empty_above(setting, tank, heights, sources)
    slope, why = (0.0, why) if why else _slope(setting, tank, heights, sources)
    return slope, why and f"second order: {why}"


def _other_topology(setting, tank, above):
    """Why the proof does not cover a tank below the tanks `above`, or ""."""
    rates = setting.rates
    if setting.delay > 0.0 or setting.lag > 0.0:
        return "not proved with dead time or lag"
    piped = {i for pipe in rates.pipes for i in pipe[:2]}
    if piped & (above | {tank}):
        return "not proved with pipes"
    both = (tank, *above)
    if any(rates.inflow[i] > 0.0 or setting.spare[i] > 0.0 for i in both):
        return "not proved with inflow disturbances"
    if any(sink in above for _, sink, *_ in rates.links) or not all(rates.pumps[j] for j in above):
        return "not proved where the tanks above are fed by others"
    return "not proved for pumps that cannot stop" if any(setting.low > 0.0) else ""


def _empty_above(setting, tank, heights, sources):
    """Why (C3) fails: at g = 0 every tank above holds more than a0; or ""."""
    rates, knee = setting.rates, setting.rates.knee
    a0 = FLOOR * sqrt_of(heights[tank], knee)
    if a0**2 < knee:
        return f"laminar threshold {knee:g} above {a0**2:.3g}"
    full = sum(most * sqrt_of(heights[j], knee) for j, most in sources)
    certain = rates.out[tank] * sqrt_of(heights[tank], knee)
    for j, most in sources:
        left = certain - (full - most * sqrt_of(heights[j], knee))
        if left <= most * a0:
            return f"(C3) {left:.3g} not above {most * a0:.3g} cm/s"
    return ""


def _slope(setting, tank, heights, sources):
    """(the largest k1 [1/s] that meets (C1), (C2) and (C4), "") or (0, why there is none)."""
    rates, hold, top, knee = setting.rates, setting.hold, heights[tank], setting.rates.knee
    full = sum(most * sqrt_of(heights[j], knee) for j, most in sources)
    drained = MARGIN * sum(0.5 * most * rates.out[j] for j, most in sources)
    for k1 in np.geomspace(1.0 / hold, 1e-4, 2000):
        if k1 * top < full:  # (C2)
            break
        level = _crossing(rates.out[tank], k1, top, full)
        lowest = level - hold * full - 2.0 * setting.band[tank]
        lowest -= hold * rates.out_most[tank] * sqrt_of(top, knee)
        steep = rates.out[tank] * 0.5 / math.sqrt(lowest) if lowest > knee else math.inf
        if k1**2 * (top - level) <= drained and k1 > steep:  # (C1), (C4)
            return float(k1), ""
    return 0.0, f"no k1 with (C1) k1^2 (H - h*) <= {drained:.3g} cm/s^2"


def _crossing(out, k1, top, full):
    """h* [cm] with out sqrt(h*) + k1 (H - h*) = F, on the falling side."""
    root = (out + math.sqrt(out**2 + 4.0 * k1 * (k1 * top - full))) / (2.0 * k1)
    return min(root**2, top)
