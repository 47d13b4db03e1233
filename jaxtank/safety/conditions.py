"""The conditions of the theorems, tank by tank, and what a filter costs."""

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


def failed_condition(setting, tank, limits, bound, start, reach):
    """The condition that keeps the limit of one tank from being proved, or ""."""
    # limits : the _Proved of the rig; start : (n,) highest levels at t = 0 [cm], or None; reach :
    # (n,) levels that no tank passes [cm], before volumes that enter besides
    rates, top, kappa = setting.rates, limits.heights[tank], limits.rate
    if start is not None and start[tank] > top * (1.0 + 1e-12):
        return f"start at {start[tank]:.4g} cm, above the limit {top:.4g} cm"
    if limits.idle[tank]:
        return ""
    if setting.pulse:
        return "a pulse dead zone pays out more than was commanded"
    if kappa > bound * (1.0 + 1e-12):
        return f"kappa {kappa:.3g} above its bound {bound:.3g} 1/s"
    if limits.slopes[tank] > 0.0:
        return _too_high_above(setting, tank, limits.heights, limits.slopes, start)
    if not rates.pumps[tank]:
        return ""
    if unread := _beyond_adc(setting, tank, reach):
        return unread
    if setting.delay == 0.0 and setting.lag == 0.0:
        return ""
    begin = limits.heights if start is None else start
    if setting.predicted:
        return _filled_under_way(setting, tank, top, begin, reach)
    if any(i == tank for i, *_ in rates.pipes):
        return "a pipe with dead time or lag: not proved"
    if kappa < (steep := steepest(setting, tank, top)):
        return f"(N) kappa {kappa:.3g} below c_min sqrt(H)/(H - h_e) = {steep:.3g} 1/s"
    if setting.lag > 0.0:
        shallow = max(rates.empty[tank], rates.knee)
        if shallow > 0.25 * top:
            return f"(F) laminar or limited outflow up to {shallow:.3g} cm, above 1/4 of the limit"
        brought = full_pumps(setting, tank) + setting.phi(tank, 0.0, reach)
        filled = brought * (2.0 * setting.lag + setting.delay + setting.hold)
        if filled > 0.75 * top:
            return f"(F) {filled:.3g} cm may be filled within the lag: above 3/4 of the limit"
    return _under_way(setting, tank, top, kappa, begin, reach)


def steepest(setting, tank, top):
    """(N): the least kappa [1/s] with Phi_max(h) - Phi_max(H) <= kappa (H - h) for all h below the
    limit; below h_e = `empty` nothing leaves for certain.
    """
    below = max(top - setting.rates.empty[tank], 1e-300)
    return setting.rates.out[tank] * math.sqrt(top) / below


def _beyond_adc(setting, tank, reach):
    """Why the reading of a neighbour does not bound its level, or ""."""
    rates, levels = setting.rates, reach + setting.spare
    joined = {j for j, sink, *_ in rates.links if sink == tank}
    joined |= {j for i, j, *_ in rates.pipes if i == tank}
    for j in sorted(j for j in joined if levels[j] > setting.top[j] * (1.0 + 1e-12)):
        return f"relies on tank {j + 1}, whose ADC reads up to {setting.top[j]:.4g} cm only"
    return ""


def _under_way(setting, tank, top, kappa, start, reach):
    """Why (S) fails, the inputs under way obey the row of levels up to `start`, or ""."""
    rates, age, others = setting.rates, setting.delay + setting.hold, np.array(reach)
    for k in range(len(reach)) if setting.lag == 0.0 else ():
        fastest = full_pumps(setting, k) + max(setting.phi(k, 0.0, reach), 0.0)
        others[k] = min(reach[k], start[k] + age * fastest)
    brought, h = ran_before(setting, tank), start[tank]
    # what is allowed is concave in the level, but for the step at `empty`
    allowed = min(
        kappa * (top - h) - setting.phi(tank, h, others),
        kappa * (top - min(h, rates.empty[tank])) - setting.phi(tank, 0.0, others),
    )
    if brought <= max(allowed * (1.0 + 1e-9), unstoppable(setting, tank)):
        return ""
    return f"(S) start: {brought:.3g} cm/s under way, {max(allowed, 0.0):.3g} allowed"


def _filled_under_way(setting, tank, top, start, reach):
    """Why the inputs under way at the start may fill a tank past its limit, or ""."""
    level, steps = float(start[tank]), 200 * setting.predicted
    step, brought = setting.delay / steps, ran_before(setting, tank)
    for _ in range(steps):  # from above: the explicit step where it rises, no change where it falls
        level += step * max(brought + setting.phi(tank, level, reach), 0.0)
        if level > top * (1.0 + 1e-9):
            return f"start: inputs under way may fill it above {top:.4g} cm"
    return ""


def _too_high_above(setting, tank, heights, slopes, start):
    """Why the levels `start` do not allow a second-order row to begin (g >= 0), or ""."""
    if start is None:
        return "start: not known, and the tanks above may hold more than can be stopped in time"
    rates, knee = setting.rates, setting.rates.knee
    a0 = FLOOR * sqrt_of(heights[tank], knee)
    g = rates.out[tank] * sqrt_of(start[tank], knee)
    g += slopes[tank] * (heights[tank] - start[tank])
    for j, sink, _, most in rates.links:
        if sink == tank:
            g -= most * max(sqrt_of(start[j], knee), a0)
    return "" if g >= 0.0 else "start: the tanks above hold more than can be stopped in time"


def settle(setting, limits, bound, start, plant):
    """`limits` with the conditions that failed and the levels that no tank passes."""
    reasons = list(limits.reasons)
    while True:
        reach = _reach(setting, limits.heights, reasons, plant, start)
        before = list(reasons)
        for i in (i for i, why in enumerate(before) if not why):
            reasons[i] = failed_condition(setting, i, limits, bound, start, reach)
            reasons[i] = reasons[i] or _relied_on(setting, i, limits, before, reach)
        if reasons == before:
            return limits._replace(reasons=reasons, reach=reach)


def _relied_on(setting, tank, limits, reasons, reach):
    """Which tanks without a certificate the proof of `tank` needs, or "" where it needs none."""
    rates = setting.rates
    above = [j for j, sink, *_ in rates.links if sink == tank and reasons[j]]
    if limits.slopes[tank] == 0.0:
        extra = full_pumps(setting, tank) if limits.idle[tank] else unstoppable(setting, tank)
        excess = setting.phi(tank, limits.heights[tank], reach) + extra
        if excess <= max(1e-9 * rates.out[tank], 1e-12):
            return ""
        above = above or [j for j, why in enumerate(reasons) if why]
        if not above:
            return f"rim condition: {excess:.3g} cm/s too much may enter at the limit"
    names = ", ".join(str(j + 1) for j in above)
    return f"relies on tank {names}, not certified" if above else ""


def _reach(setting, heights, reasons, plant, start):
    """(n,) levels that no tank passes [cm]: H where certified, else where its inflow can rest, or
    its start.
    """
    n, rim = len(heights), np.asarray(plant.rim, dtype=float)
    begin = heights if start is None else np.maximum(heights, start)
    top = np.where(np.array(setting.uncovered) == "", begin, np.inf)
    reach = np.where([not why for why in reasons], heights, top)
    highest = np.maximum(rim, begin) if plant.overflow else np.full(n, np.inf)
    for _ in range(50):
        before = reach.copy()
        for i in (i for i in range(n) if reasons[i]):
            reach[i] = min(max(reach[i], resting_level(setting, i, reach)), highest[i])
        if np.allclose(reach, before, rtol=1e-9, atol=0.0):
            return reach
    return np.where([not why for why in reasons], heights, highest)


def spills(setting, plant, limits, start):
    """((n,) what falls at most into each tank from rims [cm^3/s], (n) features that no theorem
    covers). A tank spills unless it is proved for a limit at or below its rim.
    """
    (least, most), wild = plant, list(setting.uncovered)
    falls = np.zeros(len(wild))
    for k, (source, sink) in enumerate(least.spills):
        rim, spare = float(least.rim[source]), setting.spare[source]
        dry = not limits.reasons[source] and limits.heights[source] + spare <= rim * (1.0 + 1e-12)
        if dry or not least.overflow:
            continue
        net = full_pumps(setting, source) + setting.phi(source, rim, limits.reach)
        falls[sink] += float(most.caught[k]) * float(most.area[source]) * max(net, 0.0)
        at_once = spare > 0.0 or (start is not None and start[source] > rim)
        if (at_once or setting.uncovered[source]) and not wild[sink]:
            wild[sink] = f"not covered: volumes that spill from tank {source + 1}"
    return falls, tuple(wild)


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
