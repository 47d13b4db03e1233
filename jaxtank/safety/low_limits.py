"""The conditions on low limits: least inputs that keep levels up, and caps that allow them."""

import numpy as np

from jaxtank.core.errors import InputError
from jaxtank.safety.known_features import first_failure
from jaxtank.safety.worst_case import PLAIN, rise

INTERVALS = 400  # intervals of readings on which least inputs and caps are compared


def check_low(low, limits, length):
    """Raise InputError for a low limit that is not between 0 and the upper one (n,) [cm]."""
    for i, (value, top) in enumerate(zip(low, limits)):
        if not 0.0 <= value < top:
            raise InputError(
                f"safety_filter.low[{i}] = {value:g} {length}: must be from 0 to below the upper"
                f" limit of the tank, {top:.6g} {length}"
            )


def failed_low(setting, low, chosen, start):
    """[failed condition of each low limit, or ""], (n,) guaranteed lower bounds of levels [cm]."""
    tanks = range(len(low))
    alone = lambda i: first_failure(_alone(setting, i, low, chosen, start))
    reasons = [alone(i) if low[i] > 0.0 else "" for i in tanks]
    while True:
        bottom = np.array([0.0 if reasons[i] else low[i] for i in tanks])
        before, reasons = reasons, list(reasons)
        for i in (i for i in tanks if low[i] > 0.0 and not before[i]):
            reasons[i] = first_failure(_beside_others(setting, i, low, bottom, chosen))
        if reasons == before:
            return reasons, bottom


def _alone(setting, tank, low, chosen, start):
    """(holds, reason) of the conditions whatever the other tanks hold."""
    top, gains = chosen.heights[tank], setting.rates.pumps[tank]
    yield low[tank] < top, f"above the upper limit that can be kept, {top:.4g} {setting.unit}"
    if start is not None:
        reason = f"start at {start[tank]:.4g} {setting.unit}, below the low limit"
        yield start[tank] >= low[tank], reason
    yield not setting.uncovered[tank], setting.uncovered[tank]
    yield not setting.draws, "not proved with inflow pulses that draw liquid"
    if not gains:
        return
    yield setting.delay == 0.0 and setting.lag == 0.0, "not proved with dead time or lag"
    yield not setting.dead, "not proved with a dead zone"
    kappa_hold = chosen.rate * setting.hold
    yield kappa_hold <= 1.0 + 1e-12, f"kappa T = {kappa_hold:.3g} above 1"
    forwards = len(gains) == 1 or all(setting.low[j] >= 0.0 for j in gains)
    yield forwards, "not proved for several pumps that may run backwards"


def _beside_others(setting, tank, low, bottom, chosen):
    """(holds, reason) of the conditions while the other tanks hold at least `bottom` (n,) [cm]."""
    gains, band = setting.rates.pumps[tank], setting.band[tank]
    full = sum(least * max(setting.weakest[j], 0.0) for j, (least, _) in gains.items())
    falling = -setting.fall(tank, low[tank], bottom)
    leaves = f"{falling:.3g} {setting.unit}/s may leave at the low limit"
    yield falling <= full * (1.0 + 1e-12), f"{leaves}, {full:.3g} enter for certain"
    if not gains:
        return
    edges = np.linspace(low[tank] - band, chosen.heights[tank] + band, INTERVALS + 1)
    falls = [-setting.fall(tank, y + band, bottom) for y in edges[1:]]
    needed = np.array(falls) - chosen.rate * (edges[:-1] - band - low[tank])
    needed = np.minimum(needed, full)  # what full pumps bring is enough: the condition above
    caps = certain_share(gains) * _caps(setting, tank, chosen, edges)
    yield np.all(needed <= caps + 1e-12), "floor above cap: the upper limit is kept first"
    yield from _caps_of_others(setting, tank, float(needed.max()), chosen)


def _caps_of_others(setting, tank, needed, chosen):
    """(holds, reason) of no cap of another tank stopping a pump on which `needed` [cm/s] relies."""
    pumps = setting.rates.pumps
    gains = pumps[tank]
    stops = lambda k: f"the cap for {setting.label(k)} may stop a pump that the floor relies on"
    if needed <= 0.0:
        return
    for k, others in enumerate(pumps):
        if k == tank or chosen.idle[k] or not (common := set(others) & set(gains)):
            continue
        edges = np.linspace(0.0, chosen.heights[k] + setting.band[k], INTERVALS + 1)
        asking = sum(others[j][1] / gains[j][0] * needed for j in common if gains[j][0] > 0.0)
        allowed = asking <= float(_caps(setting, k, chosen, edges).min())
        yield len(gains) == len(others) == 1 and allowed, stops(k)
    fed = {k for k, others in enumerate(pumps) if set(others) & set(gains)}
    for k in sorted({sink for source, sink, *_ in setting.rates.links if source in fed}):
        yield chosen.slopes[k] <= 0.0 or chosen.idle[k], stops(k)


def _caps(setting, tank, chosen, edges):
    """(intervals,) the least that the cap may allow in each interval of readings [cm/s]."""
    if chosen.idle[tank]:
        return np.full(len(edges) - 1, np.inf)
    others, eps = np.minimum(chosen.reach + setting.spare, 1e6), setting.band[tank]
    rises = [rise(setting.rates, tank, y - eps, others, PLAIN) for y in edges[:-1]]
    allowed = chosen.rate * (chosen.heights[tank] - edges[1:] - eps)
    return np.maximum(allowed - np.array(rises), 0.0)


def certain_share(gains):
    """What is certain to arrive of the most that may arrive, of the weakest of a tank's pumps."""
    return min(least / most for least, most in gains.values() if most > 0.0)
