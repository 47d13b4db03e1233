"""For which limits a safety filter is proved, tank by tank, and what it costs.

Works on plain numbers, before a run.
"""

import dataclasses
import math
import re
from collections.abc import Mapping
from typing import NamedTuple

import jax
import numpy as np
from numpy.typing import ArrayLike

from jaxtank.core.errors import InputError
from jaxtank.instruments.base import Actuator
from jaxtank.instruments.sensors import LevelSensor
from jaxtank.plants.faults import Faults
from jaxtank.plants.tank_network import TankNetwork
from jaxtank.safety.box import band_of, box_of, interval, narrow_band, spread, top_of, uncovered
from jaxtank.safety.checker import check
from jaxtank.safety.conditions import gap_of, settle, spills, steepest, theorem_of
from jaxtank.safety.filter import FLOOR, SafetyFilter
from jaxtank.safety.setting import Setting, phi, phi_min, resting_level, sqrt_of, unstoppable
from jaxtank.safety.worst_case import rates_of

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


UNKNOWN = 1e6
"""Stands for a level [cm] or a time [s] without a bound."""
FASTEST = 2.0
"""Default of kappa at most [1/s]: faster approaches gain less than they move the pumps."""
SHARE_OF_HOLD = 0.5
"""kappa T of the default; proved up to 1."""
QUIET = 0.01
"""Standard deviation of the change of a capped pump's input that noise may cause from sample to
sample, as a share of its range, at the default."""
BELOW_BOUND = 0.9
"""Share of the largest rate that is proved, of the default."""


@dataclasses.dataclass(frozen=True)
class TankCertificate:
    """Whether the limit of one tank is proved, and by what.

    tank : counted from 0.  limit : H [cm].  certified : True if no plant of the box passes it: the
    conditions of the design hold, and those of `checker.check`.  starts : the levels at t = 0 for
    which that holds (`checker.ANY` or `checker.OWN`), "" where it is not proved.  reason : the
    theorem, or the condition that failed with both of its numbers, or "not covered: FEATURE".
    rate, rate_bound : kappa and the largest that is proved [1/s].  gap : how far below the limit
    the nominal plant rests with its pumps full [cm], nan where they cannot reach it.  reach : what
    the level never passes [cm]; inf if unknown.  low : low limit [cm], 0 for none.  low_certified,
    low_reason : of the low limit, as above.
    """

    tank: int
    limit: float
    certified: bool
    reason: str
    rate: float
    rate_bound: float
    gap: float
    reach: float
    low: float = 0.0
    low_certified: bool = False
    low_reason: str = ""
    starts: str = ""


def rate_bound(hold: float, delay: float = 0.0, lag: float = 0.0) -> float:
    """Return the largest kappa [1/s] that is proved for a hold, a dead time and a lag [s]."""
    # Without lag, d = delay/hold whole samples: kappa T <= d^d/(d + 1)^(d + 1) (1 for d = 0). With
    # a lag tau and age a = delay + hold: max over sigma of sigma (1 - tau sigma) exp(-sigma a).
    if lag > 0.0:
        age = delay + hold
        sigma = 2.0 / (2.0 * lag + age + math.sqrt(4.0 * lag**2 + age**2))
        return sigma * (1.0 - lag * sigma) * math.exp(-sigma * age)
    d = math.ceil(delay / hold - 1e-9)
    return d**d / (d + 1) ** (d + 1) / hold


def design(
    plant: TankNetwork,
    actuator: Actuator,
    sensor: LevelSensor,
    hold: float,
    *,
    widths: Mapping[str, ArrayLike],
    limit: ArrayLike | None = None,
    inflow: ArrayLike = 0.0,
    volume: ArrayLike = 0.0,
    offset: ArrayLike | None = None,
    band: ArrayLike | None = None,
    rate: float | None = None,
    substeps: int = 1,
    start: ArrayLike | None = None,
    low: ArrayLike = 0.0,
    draw: ArrayLike = 0.0,
    drawn: bool = False,
    predict: bool = True,
    faults: Faults | None = None,
) -> tuple[SafetyFilter, tuple[TankCertificate, ...]]:
    """Return a safety filter for a rig, and the certificate of each tank.

    Parameters
    ----------
    plant, actuator, sensor : the rig
    hold : longest time for which an input is held [s]
    widths : {parameter: half width of its interval, in its unit}, the box (see `widths_of`): each
        entry of each lies somewhere in its interval, and may change there in time. Parameters of
        the plant, with or without "plant."; "actuator.lag", "sensor.noise", ..; "x0"
    limit : (n,) wanted limits [cm]; the rims where it is left out. Limits may come out lower
    inflow : (n,) largest inflow disturbance [cm^3/s]
    volume : (n,) volume that may enter besides, at any time and rate, in all [cm^3]; limits are
        lowered by it
    offset : (m,) least input that moves liquid [V]; the pumps' offset dead zone where left out
    band : (n,) largest difference of reading and level [cm]; from the sensor where it is left out
    rate : kappa [1/s]; where it is left out min(2, 0.5/hold, 0.9 of its bound), and with a noisy
        sensor so small that the noise moves a capped pump by 1 % of its range from sample to sample
    substeps : integration steps of a hold
    start : (n,) highest levels at t = 0 [cm]. Without it a certificate holds for starts at or below
        the limits, and no tank counts as one that full pumps cannot fill or that pumps above hold
    low : (n,) levels below which no tank may fall [cm]; 0: none
    draw : (n,) least inflow disturbance, 0 or negative [cm^3/s]
    drawn : whether volumes may leave besides, at any time (no low limit is then proved)
    predict : predict levels over the inputs under way where the dead time is longer than a hold,
        and the rig has no pipes, lag, dead zone or volumes that enter besides
    faults : of the case: nothing is proved where they leave the box

    Raises
    ------
    InputError
        for a plant that is no TankNetwork, or a value out of its range
    """
    if not isinstance(plant, TankNetwork):
        raise InputError("safety_filter: is for tank networks (plants.network) only")
    n, (least, most) = plant.tanks, box_of(plant, widths)
    tankwise = lambda v: np.broadcast_to(np.asarray(v, float), (n,))
    inflow, draw, low, volume = map(tankwise, (inflow, draw, low, volume))
    dead = _dead_zone(actuator, widths) if offset is None else np.asarray(offset, dtype=float)
    band = tankwise(band_of(sensor, widths=widths) if band is None else band)
    begin, start = (None, None) if start is None else spread(tankwise(start), "x0", widths)
    flows = lambda enters: _rates(least, most, enters, hold / substeps, draw)
    setting = Setting(
        rates=flows(inflow),
        hold=float(hold),
        band=band,
        top=top_of(sensor, n, widths),
        spare=volume / np.asarray(least.area),
        drawn=drawn,
        uncovered=("; ".join(f"not covered: uncertain {x}" for x in uncovered(widths)),) * n,
        **_of_pumps(actuator, dead, widths),
    )
    setting = setting._replace(
        predicted=predict * _predicted(setting, widths), divided=_divided(setting, actuator, widths)
    )
    bound = rate_bound(hold, 0.0 if setting.predicted else setting.delay, setting.lag)
    check_low(low, wanted := _wanted(setting, least, limit), plant.units[0])
    falls, prove = np.zeros(n), lambda s: _proved(s, sensor, most, wanted, rate, bound, start)
    for _ in range(3 * n + 3):
        found = prove(setting)
        more, wild = spills(setting, (least, most), found, start)
        if np.all(more <= falls) and wild == setting.uncovered:
            break
        falls = np.maximum(falls, more)
        setting = setting._replace(rates=flows(inflow + falls), uncovered=wild)
    else:
        sinks = {sink for _, sink in least.spills}
        ring = [why or "not covered: a ring of spills" * (i in sinks) for i, why in enumerate(wild)]
        setting = setting._replace(uncovered=tuple(ring))
        found = prove(setting)
    kappa = found.rate
    why, bottom = failed_low(setting, low, found, kappa, begin)
    nominal = _rates(plant, plant, inflow + falls, 0.0, None)
    narrow = narrow_band(sensor, band, plant.units[0], widths)
    rows = [_row(setting, nominal, found, i, wanted, kappa, bound, narrow[i]) for i in range(n)]
    guard = SafetyFilter(
        least=least,
        most=most,
        offset=np.broadcast_to(dead, (actuator.pumps,)),
        rate=np.full(n, kappa),
        inflow=inflow + falls,
        draw=np.array(draw),
        substeps=substeps if setting.predicted else 1,
        divided=setting.divided,
        running=tuple(int(j) for j in np.flatnonzero(setting.low > 0.0)),
        **_upper(setting, found),
        **_lower(setting, low, bottom),
    )
    rows = [_completed(row, low[row.tank], why[row.tank]) for row in rows]
    verdicts = check(
        guard,
        plant,
        actuator,
        sensor,
        hold=hold,
        substeps=substeps,
        box=_intervals(widths, {"plant": plant, "actuator": actuator, "sensor": sensor})
        | ({} if start is None else {"x0": (begin, start)}),
        inflow=(draw, inflow),
        volume=volume,
        drawn=drawn,
        start=start,
        faults=faults,
        limits=[row.limit for row in rows],
    )
    return guard, tuple(_checked(*pair, plant.units[0]) for pair in zip(rows, verdicts))


def _intervals(widths, parts):
    """{dotted name: (lower, upper)} of `widths`; those of levels at t = 0 are in the start."""
    found = {}
    for name, width in widths.items():
        name = name if "." in name or name.startswith("x0") else f"plant.{name}"
        part, _, rest = name.partition(".")
        if part not in parts:
            if not name.startswith("x0"):
                found[name] = (0.0, 0.0)
            continue
        field, _, entry = rest.partition("[")
        value = getattr(parts[part], field, 0.0)
        value = np.asarray(0.0 if value is None else value, dtype=float)
        value = value[int(entry[:-1])] if entry else value
        found[name] = (value - np.asarray(width), value + np.asarray(width))
    return found


def _checked(row, verdict, length):
    """A TankCertificate with the verdict of the checker: a limit is proved where design and checker
    agree. Reasons in the rig's unit of length.
    """
    own = lambda text: re.sub(r"\bcm\b", length, text)
    proved, low_proved = row.certified and verdict.holds, row.low_certified and verdict.low_holds
    return dataclasses.replace(
        row,
        certified=proved,
        reason=own(verdict.reason if row.certified else row.reason),
        starts=verdict.starts if proved else "",
        low_certified=low_proved,
        low_reason=own(verdict.low_reason if row.low_certified else row.low_reason),
    )


def _rates(least, most, inflow, step, draw):
    """`rates_of` in plain numbers."""
    return jax.tree.map(_plain, rates_of(least, most, inflow, step, draw))


def _dead_zone(actuator, widths):
    """The least offset dead zone [V] of each pump, 0 without one."""
    offset = np.asarray(actuator.offset, dtype=float)
    return interval(actuator, "actuator.dead_zone", widths)[0] if offset.ndim else offset


def _quiet_rate(setting, sensor, heights, kappa):
    """kappa [1/s], or less, so that the noise of a capped pump stays within QUIET of its range."""
    rates, noise, quiet, needed = setting.rates, np.asarray(sensor.noise, dtype=float), kappa, 0.0
    for i in (i for i, gains in enumerate(rates.pumps) if gains):
        needed = max(needed, steepest(setting, i, heights[i]))
        for j, (_, b) in rates.pumps[i].items() if noise[i] > 0.0 else ():
            # the cap M/b moves by kappa dy/b, and two readings differ by sqrt(2) sigma
            span = b * (setting.high[j] - max(setting.low[j], 0.0))
            quiet = min(quiet, QUIET * span / (math.sqrt(2.0) * noise[i]))
    return float(min(kappa, max(quiet, needed)))


def _wanted(setting, plant, limit):
    """(n,) limits to keep [cm], before volumes that enter besides."""
    given = np.asarray(plant.rim if limit is None else limit, dtype=float)
    wanted = np.minimum(np.broadcast_to(given, setting.top.shape), setting.top) - setting.spare
    if np.any(wanted <= 0.0):
        raise InputError("safety_filter: inflow disturbances alone fill a tank to its limit")
    return wanted


def _predicted(setting, widths):
    """Number of inputs under way over which levels can be predicted; 0: none."""
    samples = math.ceil(setting.delay / setting.hold - 1e-9)
    other = setting.lag > 0.0 or setting.rates.pipes or setting.dead or setting.drawn
    other = other or "actuator.delay" in widths
    return 0 if samples < 2 or other or np.any(setting.spare > 0.0) else samples


def _upper(setting, found):
    """The fields of SafetyFilter that hold the upper limits."""
    return {
        "limit": found.heights,
        "reach": np.minimum(found.reach + setting.spare, UNKNOWN),
        "spare": setting.spare,
        "band": np.array(setting.band),
        "slope": found.slopes,
        # of a lagged input every older reading is a part: neighbours count with their `reach`; and
        # where inputs beyond the limits of the pumps are under way
        "age": UNKNOWN if setting.lag > 0.0 or setting.beyond else setting.delay,
        "held": _held(setting, found),
        "predicted": setting.predicted,
    }


def _lower(setting, low, bottom):
    """The fields of SafetyFilter that hold the low limits."""
    kept = tuple(i for i, gains in enumerate(setting.rates.pumps) if low[i] > 0.0 and gains)
    return {"low": np.array(low), "bottom": bottom, "kept": kept}


def _of_pumps(actuator, dead, widths):
    """The fields of Setting that describe the pumps, of dead zones `dead` [V]."""
    leaves = ("low", "high", "initial", "delay", "lag")
    least, most = (
        dict(zip(leaves, ends))
        for ends in zip(*(interval(actuator, f"actuator.{leaf}", widths) for leaf in leaves))
    )
    delay, lag = float(most["delay"]), float(np.max(most["lag"]))
    under_way = delay > 0.0 or lag > 0.0
    above = np.any(most["initial"] > least["high"])
    return {
        "delay": delay,
        "lag": lag,
        "low": most["low"],
        "high": most["high"] - dead,
        "weakest": least["high"] - dead,
        "pulse": _pulses(actuator),
        "dead": getattr(actuator, "dead_zone", None) is not None,
        "before": tuple(most["initial"] - dead) if under_way else (),
        "beyond": under_way
        and bool(above or np.any(least["initial"] < np.minimum(least["low"], 0.0))),
    }


def _divided(setting, actuator, widths):
    """Tanks that several pumps feed whose lags differ or may differ: Theorem 4 needs a row each."""
    ends = np.stack(interval(actuator, "actuator.lag", widths))
    if setting.lag == 0.0 or not np.all(np.isfinite(setting.high)):
        return ()
    lags = np.broadcast_to(ends.reshape(2, -1), (2, len(setting.high)))
    fed = [list(gains) for gains in setting.rates.pumps]
    return tuple(i for i, js in enumerate(fed) if len(js) > 1 and np.ptp(lags[:, js]) > 0.0)


class _Proved(NamedTuple):
    """kappa [1/s], limits (n,) [cm], k1 (n,) [1/s], which tanks full pumps cannot fill, {tank:
    condition that failed, or ""}, and levels that no tank passes (n,) [cm], all before volumes that
    enter besides.
    """

    rate: float
    heights: np.ndarray
    slopes: np.ndarray
    idle: np.ndarray
    reasons: list[str]
    reach: np.ndarray


def _proved(setting, sensor, plant, wanted, rate, bound, start):
    """Return the _Proved of a rig for the `wanted` limits (n,) [cm] and a `rate`, or None for the
    default.
    """
    begin = wanted if start is None else start
    first = np.minimum(wanted, np.maximum(filled_levels(setting, wanted, begin), begin))

    def at(kappa):
        heights, slopes, reasons = limits_for(setting, first, kappa)
        idle = (heights == first) & (heights < wanted)  # full pumps cannot reach the limit
        return settle(
            setting, _Proved(kappa, heights, slopes, idle, reasons, heights), bound, start, plant
        )

    if rate is not None:
        return at(float(rate))
    found = at(min(FASTEST, SHARE_OF_HOLD / setting.hold, BELOW_BOUND * bound))
    if not np.any(np.asarray(sensor.noise) > 0.0):
        return found
    return at(_quiet_rate(setting, sensor, found.heights, found.rate))


def _held(setting, found):
    """Tanks that need a row: with a pump or a k1 of their own, where full pumps can fill them."""
    pumps = setting.rates.pumps
    return tuple(
        i for i, idle in enumerate(found.idle) if not idle and (pumps[i] or found.slopes[i] > 0.0)
    )


def _row(setting, nominal, found, tank, wanted, kappa, bound, narrow):
    """Return the TankCertificate of one tank; narrow : why its band is not relied on, or ""."""
    why = found.reasons[tank] or narrow
    idle, spare = found.idle[tank], setting.spare[tank]
    limit = (wanted if idle else found.heights)[tank]
    theorem = "Theorem 2" if found.slopes[tank] > 0.0 else theorem_of(setting, tank)
    return TankCertificate(
        tank=tank,
        limit=float(limit + spare),
        certified=not why,
        reason=why or ("full pumps stay below" if idle else theorem),
        rate=kappa,
        rate_bound=bound,
        gap=0.0 if idle else gap_of(setting, nominal, tank, kappa, limit, found.reach),
        reach=float(found.reach[tank] + spare),
    )


def _completed(row, low, why):
    """A TankCertificate with its low limit [cm] and why that is not proved."""
    return dataclasses.replace(
        row,
        low=float(low),
        low_certified=bool(low > 0.0 and not why),
        low_reason=why or ("Low limits" if low > 0.0 else ""),
    )


def _pulses(actuator):
    """Whether dead zones are left by pulses."""
    kind = getattr(actuator, "dead_zone_kind", "")
    return getattr(actuator, "dead_zone", None) is not None and kind == "pulse"


def _plain(value):
    """A number of Rates as a float; an index as it is."""
    return value if isinstance(value, int) else float(value)
