"""The conditions of the theorems, tank by tank, in plain numbers before a run."""

import math
from typing import Any, NamedTuple

import numpy as np

from jaxtank.core.labels import label_of
from jaxtank.safety.filter import SHALLOW
from jaxtank.safety.known_features import first_failure
from jaxtank.safety.worst_case import PLAIN, Rates, fall, plain_root, rise


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
    draws: bool = False  # whether inflow pulses draw liquid
    predicted: int = 0  # inputs under way over which levels are predicted
    before: tuple = ()  # (m) inputs under way at t = 0, less dead zones [V]; () for none
    weakest: tuple = ()  # (m) least upper limits of the pumps, less dead zones [V]
    beyond: bool = False  # whether inputs under way at t = 0 are beyond the limits of the pumps
    divided: tuple = ()  # tanks whose row is divided among their pumps
    uncovered: tuple = ()  # (n) why a tank has a feature that no theorem covers, ""
    unit: str = "cm"  # of a length
    plant: Any = None  # whose names the reasons have

    def label(self, tank):
        """What a person calls a tank."""
        return label_of(self.plant, "tank", tank)

    def rise(self, tank, level, others):
        """Phi_max(level) [cm/s]; others: limits of all tanks, before volumes that enter besides."""
        return rise(self.rates, tank, level, np.asarray(others) + self.spare, PLAIN)

    def fall(self, tank, level, others):
        """Phi_min(level) [cm/s]."""
        return fall(self.rates, tank, level, others, PLAIN)

    def root(self, level):
        return plain_root(level, self.rates.knee)

    def sources(self, tank):
        """[(j, c_max)] of the orifices into a tank."""
        return [(j, most) for j, sink, _, most in self.rates.links if sink == tank]

    def pumped(self, tank, inputs):
        """What pumps at `inputs` (m,) [V] bring at most [cm/s]; of a divided row by one share."""
        gains = [(j, b) for j, (_, b) in self.rates.pumps[tank].items() if b > 0.0]
        if tank not in self.divided:
            return sum(b * max(inputs[j], 0.0) for j, b in gains)
        full = sum(b * max(self.high[j], 0.0) for j, b in gains)
        shares = [max(inputs[j], 0.0) / max(self.high[j], 1e-300) for j, _ in gains]
        return full * max(shares, default=0.0)

    def unstoppable(self, tank):
        """What pumps with a lower limit above 0 V always bring [cm/s]."""
        return self.pumped(tank, self.low)

    def full_pumps(self, tank):
        """What full pumps, and inputs under way at t = 0, bring at most [cm/s]."""
        return self.pumped(tank, np.maximum(self.high, self.before) if self.before else self.high)

    def under_way(self, tank):
        """What the inputs under way at t = 0 bring at most [cm/s]."""
        return self.pumped(tank, self.before) if self.before else 0.0

    def resting_level(self, tank, others):
        """Level [cm] at which a tank rests with the most that may enter; inf if it never does."""
        full = self.full_pumps(tank)
        level = highest_level(lambda h: full + self.rise(tank, h, others), 1e6)
        return math.inf if level == 1e6 else level * (1.0 + 1e-9)


class Chosen(NamedTuple):
    """kappa, limits, k1, tanks full pumps cannot fill, failed conditions, levels never passed."""

    rate: float
    heights: np.ndarray
    slopes: np.ndarray
    idle: np.ndarray
    reasons: list[str]
    reach: np.ndarray


def highest_level(rate, top):
    """The level [cm] up to which rate(level), which falls with it, is above 0; `top` at most."""
    low, high = 0.0, top
    if rate(top) > 0.0:
        return top
    for _ in range(60):
        mid = 0.5 * (low + high)
        low, high = (mid, high) if rate(mid) > 0.0 else (low, mid)
    return low


def _conditions(setting, tank, limits, bound, start, reach):
    """(holds, reason) of what proves the limit of one tank."""
    # limits : the Chosen of the rig; start : (n,) highest levels at t = 0 [cm], or None; reach :
    # (n,) levels that no tank passes [cm], before volumes that enter besides
    rates, top, kappa, unit = setting.rates, limits.heights[tank], limits.rate, setting.unit
    if start is not None:
        reason = f"start at {start[tank]:.4g} {unit}, above the limit {top:.4g} {unit}"
        yield start[tank] <= top * (1.0 + 1e-12), reason
    if limits.idle[tank]:
        return
    yield not setting.pulse, "a pulse dead zone pays out more than was commanded"
    yield kappa <= bound * (1.0 + 1e-12), f"kappa {kappa:.3g} above its bound {bound:.3g} 1/s"
    if limits.slopes[tank] > 0.0:
        yield from _second_order_begins(setting, tank, limits, start)
        return
    if not rates.pumps[tank]:
        return
    joined = {j for j, _ in setting.sources(tank)} | {j for i, j, *_ in rates.pipes if i == tank}
    for j in sorted(joined):
        readable = reach[j] + setting.spare[j] <= setting.top[j] * (1.0 + 1e-12)
        only = f"up to {setting.top[j]:.4g} {unit} only"
        yield readable, f"relies on {setting.label(j)}, whose sensor reads {only}"
    if setting.delay != 0.0 or setting.lag != 0.0:
        yield from _late_conditions(setting, tank, limits, start, reach)


def _late_conditions(setting, tank, limits, start, reach):
    """(holds, reason) of Theorems 3 to 5 for the row of a tank's own pumps."""
    rates, top, kappa, unit = setting.rates, limits.heights[tank], limits.rate, setting.unit
    begin = limits.heights if start is None else start
    if setting.predicted:
        stays = not _filled_under_way(setting, tank, top, begin, reach)
        yield stays, f"start: inputs under way may fill it above {top:.4g} {unit}"
        return
    yield not any(i == tank for i, *_ in rates.pipes), "a pipe with dead time or lag: not proved"
    steep = steepest(setting, tank, top)
    yield kappa >= steep, f"(N) kappa {kappa:.3g} below c_min sqrt(H)/(H - h_e) = {steep:.3g} 1/s"
    if setting.lag > 0.0:
        shallow = max(rates.empty[tank], rates.knee)
        limited = f"laminar or limited outflow up to {shallow:.3g} {unit}, above 1/4 of the limit"
        yield shallow <= 0.25 * top, f"(F) {limited}"
        entering = setting.full_pumps(tank) + setting.rise(tank, 0.0, reach)
        filled = entering * (2.0 * setting.lag + setting.delay + setting.hold)
        reason = f"(F) {filled:.3g} {unit} may be filled within the lag: above 3/4 of the limit"
        yield filled <= 0.75 * top, reason
    yield _start_allowed(setting, tank, limits, begin, reach)


def _start_allowed(setting, tank, limits, begin, reach):
    """(holds, reason) of (S): the inputs under way obey the row of levels up to the start."""
    top, kappa = limits.heights[tank], limits.rate
    age, others = setting.delay + setting.hold, np.array(reach)
    for k in range(len(reach)) if setting.lag == 0.0 else ():
        fastest = setting.full_pumps(k) + max(setting.rise(k, 0.0, reach), 0.0)
        others[k] = min(reach[k], begin[k] + age * fastest)
    entering, h = setting.under_way(tank), begin[tank]
    # the allowed inflow is concave in the level, except for the step at `empty`
    allowed = kappa * (top - min(h, setting.rates.empty[tank])) - setting.rise(tank, 0.0, others)
    allowed = min(kappa * (top - h) - setting.rise(tank, h, others), allowed)
    reason = f"{entering:.3g} {setting.unit}/s under way, {max(allowed, 0.0):.3g} allowed"
    holds = entering <= max(allowed * (1.0 + 1e-9), setting.unstoppable(tank))
    return holds, f"(S) start: {reason}"


def steepest(setting, tank, top):
    """(N): the least kappa [1/s] with Phi_max(h) - Phi_max(H) <= kappa (H - h) for all h < H."""
    # below h_e = `empty` nothing leaves for certain
    below = max(top - setting.rates.empty[tank], 1e-300)
    return setting.rates.out[tank] * math.sqrt(top) / below


def _filled_under_way(setting, tank, top, start, reach):
    """Whether the inputs under way at the start may fill a tank past its limit."""
    level, steps = float(start[tank]), 200 * setting.predicted
    step, pumped = setting.delay / steps, setting.under_way(tank)
    for _ in range(steps):  # from above: the explicit step where it rises, no change where it falls
        level += step * max(pumped + setting.rise(tank, level, reach), 0.0)
        if level > top * (1.0 + 1e-9):
            return True
    return False


def _second_order_begins(setting, tank, limits, start):
    """(holds, reason) of g >= 0 at t = 0 for a second-order row."""
    reason = "start: not known, and the tanks above may hold more than can be stopped in time"
    yield start is not None, reason
    top, root = limits.heights[tank], setting.root
    a0 = SHALLOW * root(top)
    g = setting.rates.out[tank] * root(start[tank]) + limits.slopes[tank] * (top - start[tank])
    for j, most in setting.sources(tank):
        g -= most * max(root(start[j]), a0)
    yield g >= 0.0, "start: the tanks above hold more than can be stopped in time"


def settle(setting, limits, bound, start, plant):
    """`limits` with the conditions that failed and the levels that no tank passes."""
    reasons = list(limits.reasons)
    while True:
        reach = _reach(setting, limits.heights, reasons, plant, start)
        before = list(reasons)
        for i in (i for i, reason in enumerate(before) if not reason):
            reasons[i] = first_failure(_conditions(setting, i, limits, bound, start, reach))
            reasons[i] = reasons[i] or _relied_on(setting, i, limits, before, reach)
        if reasons == before:
            return limits._replace(reasons=reasons, reach=reach)


def _relied_on(setting, tank, limits, reasons, reach):
    """Which tanks without a certificate the proof of `tank` needs, or "" where it needs none."""
    above = [j for j, _ in setting.sources(tank) if reasons[j]]
    if limits.slopes[tank] == 0.0:
        extra = setting.full_pumps(tank) if limits.idle[tank] else setting.unstoppable(tank)
        excess = setting.rise(tank, limits.heights[tank], reach) + extra
        if excess <= max(1e-9 * setting.rates.out[tank], 1e-12):
            return ""
        above = above or [j for j, reason in enumerate(reasons) if reason]
        if not above:
            return f"rim condition: {excess:.3g} {setting.unit}/s too much may enter at the limit"
    names = ", ".join(map(setting.label, dict.fromkeys(above)))
    return f"relies on {names}, not certified" if above else ""


def _reach(setting, heights, reasons, plant, start):
    """(n,) levels that no tank passes [cm]: H where certified, else its rest or its start."""
    begin = heights if start is None else np.maximum(heights, start)
    rim = np.asarray(plant.rim, dtype=float)
    highest = np.maximum(rim, begin) if plant.overflow else np.full(len(heights), np.inf)
    certified = np.array([not reason for reason in reasons])
    reach = np.where(certified, heights, np.where(np.array(setting.uncovered) == "", begin, np.inf))
    for _ in range(50):
        before = reach.copy()
        for i in np.flatnonzero(~certified):
            reach[i] = min(max(reach[i], setting.resting_level(i, reach)), highest[i])
        if np.allclose(reach, before, rtol=1e-9, atol=0.0):
            return reach
    return np.where(certified, heights, highest)


def spills(setting, plant, limits, start):
    """((n,) what falls at most into each tank from rims [cm^3/s], (n) features not covered)."""
    (least, most), uncovered = plant, list(setting.uncovered)
    falls = np.zeros(len(uncovered))
    for k, (source, sink) in enumerate(least.spills):
        rim, spare = float(least.rim[source]), setting.spare[source]
        dry = not limits.reasons[source] and limits.heights[source] + spare <= rim * (1.0 + 1e-12)
        if dry or not least.overflow:
            continue
        net = setting.full_pumps(source) + setting.rise(source, rim, limits.reach)
        falls[sink] += float(most.caught[k]) * float(most.area[source]) * max(net, 0.0)
        at_once = spare > 0.0 or (start is not None and start[source] > rim)
        if (at_once or setting.uncovered[source]) and not uncovered[sink]:
            uncovered[sink] = f"not covered: volumes that spill from {setting.label(source)}"
    return falls, tuple(uncovered)


def gap_of(setting, nominal, tank, kappa, limit, reach):
    """Fall [cm] of the highest nominal resting level by the filter; nan of a tank without pumps."""
    gains = setting.rates.pumps[tank]
    if not gains:
        return math.nan
    least, most = (sum(b[end] for b in gains.values()) for end in (0, 1))
    full = sum(b * max(setting.high[j], 0.0) for j, (_, b) in nominal.pumps[tank].items())
    gain = sum(b for _, b in nominal.pumps[tank].values())
    others = np.minimum(reach + setting.spare, 1e6)
    unpumped = lambda h: rise(nominal, tank, h, others, PLAIN)
    bounded, steps = setting._replace(spare=0.0), 4 * setting.predicted

    def filtered(h):
        low, high = h - setting.band[tank], h + setting.band[tank]
        u = max(-unpumped(h), 0.0) / gain if steps else 0.0  # the input at rest
        for _ in range(steps):
            low += setting.delay / steps * (least * u + setting.fall(tank, low, 0.0 * others))
            high += setting.delay / steps * (most * u + bounded.rise(tank, high, others))
        cap = max(0.0, kappa * (limit - high) - bounded.rise(tank, low, others))
        return min(full, gain / most * cap) + unpumped(h)

    free = lambda h: full + unpumped(h)
    # the levels are found to about 1e-12 of the limit
    return max(round(float(highest_level(free, limit) - highest_level(filtered, limit)), 9), 0.0)
