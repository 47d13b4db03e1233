"""The limits that a filter can keep: lowered for the tanks below, or held by pumps above."""

import math

import numpy as np

from jaxtank.safety.conditions import Chosen, settle, steepest
from jaxtank.safety.filter import SHALLOW
from jaxtank.safety.known_features import first_failure

MARGIN = 0.9  # share of D = sum c_j o_j / 2 that the choice of k1 counts on
SWEEPS = 500  # sweeps over all tanks after which limits that still fall count as not to be kept
LEAST = 1e-3
"""Share of a limit below which it is not lowered: a ring of orifices may lower limits to 0."""
FASTEST = 2.0
"""Default of kappa at most [1/s]: faster approaches gain less than they move the pumps."""
SHARE_OF_HOLD = 0.5  # kappa T of the default; proved up to 1
QUIET = 0.01
"""Standard deviation of the change of a capped pump's input that noise may cause from sample to
sample, as a share of its range, at the default."""
BELOW_BOUND = 0.9  # share of the largest rate that is proved, of the default


def rate_bound(hold: float, delay: float = 0.0, lag: float = 0.0) -> float:
    """Return the largest kappa [1/s] that is proved for a hold, a dead time and a lag [s]."""
    # Without lag, d = delay/hold whole samples: kappa T <= d^d/(d + 1)^(d + 1) (1 for d = 0). With
    # a lag tau and an age a = delay + hold: the largest sigma (1 - tau sigma) exp(-sigma a).
    if lag > 0.0:
        age = delay + hold
        sigma = 2.0 / (2.0 * lag + age + math.sqrt(4.0 * lag**2 + age**2))
        return sigma * (1.0 - lag * sigma) * math.exp(-sigma * age)
    d = math.ceil(delay / hold - 1e-9)
    return d**d / (d + 1) ** (d + 1) / hold


def choose(setting, noise, plant, requested, rate, bound, start):
    """Return the Chosen of a rig for the limits `requested` (n,) [cm] and a `rate`, or None for the
    default, with sensor noise (n,) [cm].
    """
    begin = requested if start is None else start
    first = np.minimum(requested, np.maximum(_filled_levels(setting, requested, begin), begin))

    def at(kappa):
        heights, slopes, reasons = _limits(setting, first, kappa)
        idle = (heights == first) & (heights < requested)  # full pumps cannot reach the limit
        chosen = Chosen(kappa, heights, slopes, idle, reasons, heights)
        return settle(setting, chosen, bound, start, plant)

    if rate is not None:
        return at(float(rate))
    chosen = at(min(FASTEST, SHARE_OF_HOLD / setting.hold, BELOW_BOUND * bound))
    if not np.any(noise > 0.0):
        return chosen
    return at(_quiet_rate(setting, noise, chosen.heights, chosen.rate))


def _filled_levels(setting, requested, start):
    """(n,) levels [cm] to which full pumps fill the tanks at most; inf for tanks with pipes."""
    filled, rates = np.full(len(requested), np.inf), setting.rates
    piped = {tank for tank, *_ in rates.pipes}
    for _ in filled:
        others = np.minimum(requested, np.maximum(filled, start))
        for i in (i for i in range(len(filled)) if i not in piped):
            filled[i] = max(setting.resting_level(i, others), rates.empty[i])
    return filled


def _quiet_rate(setting, noise, heights, kappa):
    """kappa [1/s], or less, so that the noise of a capped pump stays within QUIET of its range."""
    quiet, needed = kappa, 0.0
    for i, gains in enumerate(setting.rates.pumps):
        needed = max(needed, steepest(setting, i, heights[i])) if gains else needed
        for j, (_, b) in gains.items() if noise[i] > 0.0 else ():
            # the cap M/b moves by kappa dy/b, and two readings differ by sqrt(2) sigma
            span = b * (setting.high[j] - max(setting.low[j], 0.0))
            quiet = min(quiet, QUIET * span / (math.sqrt(2.0) * noise[i]))
    return float(min(kappa, max(quiet, needed)))


def _limits(setting, heights, kappa, unsettled=frozenset()):
    """(limits (n,) [cm], k1 (n,) [1/s], [why each tank failed, or ""]): Theorem 2."""
    # Limits above a tank whose inflow alone passes its own are lowered by one factor, and every k1
    # is chosen again, so that the result meets all conditions at once.
    # unsettled: tanks for which no limit above is lowered, since that did not come to an end
    n, limits = len(heights), np.array(heights)
    for _ in range(SWEEPS):
        slopes, reasons, lowered = np.zeros(n), list(setting.uncovered), set()
        for i in (i for i in range(n) if not reasons[i]):
            excess = setting.rise(i, limits[i], limits) + setting.unstoppable(i)
            if excess <= 1e-12:
                continue
            slopes[i], failure = _second_order(setting, i, limits, kappa)
            if slopes[i] > 0.0:
                continue
            if i in unsettled:
                rim = _rim_condition(setting, i, limits)
                reasons[i] = f"{rim}; lower limits above do not mend it"
                continue
            factor, above = _lowering(setting, i, limits, excess)
            if not above:
                rim = _rim_condition(setting, i, limits)
                reasons[i] = f"{rim}; second order: {failure}" if failure else rim
                continue
            if any(factor * limits[j] < LEAST * heights[j] for j in above):
                return _limits(setting, heights, kappa, unsettled | lowered | {i})
            for j in above:
                limits[j] = factor * (limits[j] + setting.spare[j]) - setting.spare[j]
            lowered.add(i)
        if not lowered:
            return limits, slopes, reasons
    return _limits(setting, heights, kappa, unsettled | lowered)


def _lowering(setting, tank, limits, excess):
    """(factor on the levels of the tanks above, those tanks); none where that does not help."""
    levels, sources = limits + setting.spare, setting.sources(tank)
    pressed = sum(most * setting.root(levels[j]) for j, most in sources)
    margin = pressed - excess  # what the sources may bring
    if margin <= 0.0:
        return 1.0, ()
    factor = (margin / pressed) ** 2 * (1.0 - 1e-12)
    above = dict.fromkeys(j for j, _ in sources)
    low = any(factor * levels[j] <= setting.spare[j] for j in above)
    return factor, () if low else tuple(above)


def _rim_condition(setting, tank, heights):
    """The rim condition with both of its numbers."""
    leaves = setting.rates.out[tank] * setting.root(heights[tank])
    enters = setting.rise(tank, heights[tank], heights) + leaves + setting.unstoppable(tank)
    certain = f"{leaves:.3g} leave for certain"
    return f"rim condition: {enters:.3g} {setting.unit}/s may enter at the limit, {certain}"


def _second_order(setting, tank, heights, kappa):
    """(k1 [1/s], "") for a tank that pumps above can hold, else (0, the failed condition)."""
    if setting.rates.pumps[tank]:
        return 0.0, ""
    failure = first_failure(_second_order_conditions(setting, tank, heights, kappa))
    return (0.0, failure) if failure else _slope(setting, tank, heights)


def _second_order_conditions(setting, tank, heights, kappa):
    """(holds, reason) of all but the choice of k1."""
    rates, root, sources = setting.rates, setting.root, setting.sources(tank)
    above = {j for j, _ in sources}
    both = above | {tank}
    yield setting.delay == 0.0 and setting.lag == 0.0, "not proved with dead time or lag"
    yield not both & {i for pipe in rates.pipes for i in pipe[:2]}, "not proved with pipes"
    still = all(rates.inflow[i] <= 0.0 and setting.spare[i] <= 0.0 for i in both)
    yield still, "not proved with inflow disturbances"
    pumped = all(rates.pumps[j] and not setting.sources(j) for j in above)
    yield pumped, "not proved where the tanks above are fed by others"
    yield not any(setting.low > 0.0), "not proved for pumps that cannot stop"
    yield kappa * setting.hold <= 1.0, f"k2 T = {kappa * setting.hold:.3g} above 1"
    a0 = SHALLOW * root(heights[tank])
    yield a0**2 >= rates.knee, f"laminar threshold {rates.knee:g} above {a0**2:.3g}"
    full = sum(most * root(heights[j]) for j, most in sources)
    for j, most in sources:  # (C3): at g = 0 every tank above holds more than a0
        rest = rates.out[tank] * root(heights[tank]) - (full - most * root(heights[j]))
        yield rest > most * a0, f"(C3) {rest:.3g} not above {most * a0:.3g} {setting.unit}/s"


def _slope(setting, tank, heights):
    """(the largest k1 [1/s] that meets (C1), (C2) and (C4), "") or (0, why there is none)."""
    rates, hold, top, sources = setting.rates, setting.hold, heights[tank], setting.sources(tank)
    out, full = rates.out[tank], sum(most * setting.root(heights[j]) for j, most in sources)
    drained = MARGIN * sum(0.5 * most * rates.out[j] for j, most in sources)
    for k1 in np.geomspace(1.0 / hold, 1e-4, 2000):
        if k1 * top < full:  # (C2)
            break
        # h* with c_min sqrt(h*) + k1 (H - h*) = F, on the falling side
        root = (out + math.sqrt(out**2 + 4.0 * k1 * (k1 * top - full))) / (2.0 * k1)
        level = min(root**2, top)
        lowest = level - hold * full - 2.0 * setting.band[tank]
        lowest -= hold * rates.out_most[tank] * setting.root(top)
        steep = out * 0.5 / math.sqrt(lowest) if lowest > rates.knee else math.inf
        if k1**2 * (top - level) <= drained and k1 > steep:  # (C1), (C4)
            return float(k1), ""
    return 0.0, f"no k1 with (C1) k1^2 (H - h*) <= {drained:.3g} {setting.unit}/s^2"
