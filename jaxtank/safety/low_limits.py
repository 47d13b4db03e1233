"""The conditions under which low limits on levels are proved, tank by tank."""

import numpy as np

from jaxtank.core.errors import InputError
from jaxtank.safety.setting import phi, phi_min

INTERVALS = 400
"""Intervals of readings on which floor and cap are compared."""


def check_low(low, limits, length):
    """Raise InputError for a low limit that is not between 0 and the upper one (n,) [cm]."""
    for i, (value, top) in enumerate(zip(low, limits)):
        if not 0.0 <= value < top:
            raise InputError(
                f"safety_filter.low[{i}] = {value:g} {length}: must be from 0 to below the upper"
                f" limit of the tank, {top:.6g} {length}"
            )


def failed_low(setting, low, found, kappa, start):
    """[the condition that keeps the low limit of each tank from being proved, or ""; "" too where
    there is none] and (n,) the levels below which no tank falls for certain [cm].
    """
    own = [
        _own_condition(setting, i, low, found, kappa, start) if low[i] > 0.0 else ""
        for i in _all(low)
    ]
    while True:
        bottom = np.array([0.0 if own[i] else low[i] for i in _all(low)])
        reasons = [
            own[i] or (_by_others(setting, i, low, bottom, found, kappa) if low[i] > 0.0 else "")
            for i in _all(low)
        ]
        if reasons == own:
            return reasons, bottom
        own = reasons


def _all(values):
    return range(len(values))


def _own_condition(setting, tank, low, found, kappa, start):
    """What fails whatever the other tanks hold, or ""."""
    if low[tank] >= found.heights[tank]:
        return f"above the upper limit that can be kept, {found.heights[tank]:.4g} cm"
    if start is not None and np.asarray(start)[tank] < low[tank]:
        return f"start at {np.asarray(start)[tank]:.4g} cm, below the low limit"
    if setting.uncovered[tank]:
        return setting.uncovered[tank]
    if setting.drawn:
        return "not proved with inflow pulses that draw liquid"
    if not setting.rates.pumps[tank]:
        return ""
    if setting.delay > 0.0 or setting.lag > 0.0:
        return "not proved with dead time or lag"
    if setting.dead:
        return "not proved with a dead zone"
    if kappa * setting.hold > 1.0 + 1e-12:
        return f"kappa T = {kappa * setting.hold:.3g} above 1"
    several = len(setting.rates.pumps[tank]) > 1
    if several and any(setting.low[j] < 0.0 for j in setting.rates.pumps[tank]):
        return "not proved for several pumps that may run backwards"
    return ""


def _by_others(setting, tank, low, bottom, found, kappa):
    """What fails while the other tanks hold at least `bottom` (n,) [cm], or ""."""
    gains = setting.rates.pumps[tank]
    full = sum(least * max(setting.weakest[j], 0.0) for j, (least, _) in gains.items())
    falling = -phi_min(setting.rates, tank, low[tank], bottom)
    if falling > full * (1.0 + 1e-12):
        return f"{falling:.3g} cm/s may leave at the low limit, {full:.3g} enter for certain"
    if not gains:
        return ""
    edges = np.linspace(
        low[tank] - setting.band[tank], found.heights[tank] + setting.band[tank], INTERVALS + 1
    )
    needed = _floors(setting, tank, low, bottom, kappa, edges)
    needed = np.minimum(needed, full)  # what full pumps bring is enough: the condition above
    if np.any(needed > _share(gains) * _caps(setting, tank, found, kappa, edges) + 1e-12):
        return "floor above cap: the upper limit is kept first"
    return _other_caps(setting, tank, float(needed.max()), found, kappa)


def _other_caps(setting, tank, needed, found, kappa):
    """Which cap of another tank may stop a pump that the floor `needed` [cm/s] relies on."""
    gains = setting.rates.pumps[tank]
    if needed <= 0.0:
        return ""
    for k, others in enumerate(setting.rates.pumps):
        if k == tank or found.idle[k] or not (common := set(others) & set(gains)):
            continue
        edges = np.linspace(0.0, found.heights[k] + setting.band[k], INTERVALS + 1)
        least = float(_caps(setting, k, found, kappa, edges).min())
        alone = len(gains) == len(others) == 1
        wanted = sum(others[j][1] / gains[j][0] * needed for j in common if gains[j][0] > 0.0)
        if not alone or wanted > least:
            return f"the cap for tank {k + 1} may stop a pump that the floor relies on"
    sinks = {
        sink
        for j in gains
        for k, fed in enumerate(setting.rates.pumps)
        if j in fed
        for source, sink, *_ in setting.rates.links
        if source == k
    }
    for k in sorted(sinks):
        if found.slopes[k] > 0.0 and not found.idle[k]:
            return f"the cap for tank {k + 1} may stop a pump that the floor relies on"
    return ""


def _floors(setting, tank, low, bottom, kappa, edges):
    """(intervals,) the most that the floor may ask for in each interval of readings [cm/s]."""
    eps = setting.band[tank]
    falls = [-phi_min(setting.rates, tank, y + eps, bottom) for y in edges[1:]]
    return np.array(falls) - kappa * (edges[:-1] - eps - low[tank])


def _caps(setting, tank, found, kappa, edges):
    """(intervals,) the least that the cap may allow in each interval of readings [cm/s]."""
    eps, others = setting.band[tank], np.minimum(found.reach + setting.spare, 1e6)
    rises = [phi(setting.rates, tank, y - eps, others) for y in edges[:-1]]
    allowed = kappa * (found.heights[tank] - edges[1:] - eps) - np.array(rises)
    cap = np.maximum(allowed, 0.0)
    return np.full_like(cap, np.inf) if found.idle[tank] else cap


def _share(gains):
    """What is certain to arrive of the most that may arrive, of the weakest of a tank's pumps."""
    return min(least / most for least, most in gains.values() if most > 0.0)
