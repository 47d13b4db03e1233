"""For which limits a safety filter is proved, tank by tank, and what it costs.

Works on plain numbers, before a run. May be imported by the rig files, the command line and tests.
"""

import dataclasses
import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import numpy as np
from numpy.typing import ArrayLike

from jaxtank.core.errors import InputError
from jaxtank.instruments.base import Actuator
from jaxtank.instruments.sensors import LevelSensor
from jaxtank.plants.tank_network import TankNetwork
from jaxtank.safety.filter import FLOOR, SafetyFilter
from jaxtank.safety.worst_case import Rates, rates_of

FASTEST = 2.0
"""Default of kappa at most [1/s]: faster approaches gain less than they move the pumps."""
SHARE_OF_HOLD = 0.5
"""kappa T of the default; proved up to 1."""
MARGIN = 0.9
"""Share of D = sum c_j o_j / 2 that the choice of k1 counts on."""
SIGMAS = 6.0
"""Standard deviations of the sensor noise in the band."""


@dataclasses.dataclass(frozen=True)
class TankCertificate:
    """Whether the limit of one tank is proved, and by what.

    tank : counted from 0.  limit : H [cm].  certified : True if no plant of the box passes it.
    reason : the condition that failed with both of its numbers, or the theorem.  rate, rate_bound :
    kappa and the largest that is proved [1/s].  gap : how far below the limit the nominal plant
    rests with its pumps full [cm], nan where they cannot reach it.  reach : what the level never
    passes [cm]; inf if unknown.
    """

    tank: int
    limit: float
    certified: bool
    reason: str
    rate: float
    rate_bound: float
    gap: float
    reach: float


class _Setting(NamedTuple):
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

    def phi(self, tank, level, others):
        """Phi_max(level) [cm/s]; others: limits of all tanks, before volumes that enter besides."""
        return phi(self.rates, tank, level, np.asarray(others) + self.spare)


def rate_bound(hold: float, delay: float = 0.0, lag: float = 0.0) -> float:
    """Return the largest kappa [1/s] that is proved for a hold, a dead time and a lag [s].

    Without lag, d = delay/hold whole samples: kappa T <= d^d/(d + 1)^(d + 1) (1 for d = 0).
    With a lag tau and age a = delay + hold: max over sigma of sigma (1 - tau sigma) exp(-sigma a).

    Examples
    --------
    >>> rate_bound(0.1), round(rate_bound(0.1, delay=0.1), 3)
    (10.0, 2.5)
    """
    if lag > 0.0:
        age = delay + hold
        sigma = 2.0 / (2.0 * lag + age + math.sqrt(4.0 * lag**2 + age**2))
        return sigma * (1.0 - lag * sigma) * math.exp(-sigma * age)
    d = math.ceil(delay / hold - 1e-9)
    return d**d / (d + 1) ** (d + 1) / hold


def box_of(plant: TankNetwork, widths: Mapping[str, ArrayLike]) -> tuple[TankNetwork, TankNetwork]:
    """Return the plants at the lower and the upper end of a box.

    Parameters
    ----------
    widths : {parameter of the plant: half width of its interval, in its unit}; "drain", or
        "plant.drain", or one entry, "plant.drain[1]"

    Raises
    ------
    InputError
        for a name that the plant's flows do not have, or an interval that reaches 0
    """
    ends: tuple[dict, dict] = ({}, {})
    flows = {f.name for f in dataclasses.fields(plant) if f.metadata.get("kind") == "leaf"}
    for name, width in widths.items():
        field, _, entry = name.removeprefix("plant.").partition("[")
        if field not in flows - {"rim", "caught"}:
            raise InputError(f"safety_filter: {name} is no parameter of this plant's flows")
        value = np.array(getattr(plant, field), dtype=float)
        half = np.zeros(value.shape)
        half[int(entry[:-1]) if entry else ...] = width
        for end, sign in zip(ends, (-1.0, 1.0)):
            end[field] = end.get(field, value) + sign * half
        if np.any(ends[0][field] < 0.0) or (
            field not in ("drain", "orifice", "pipe", "split") and np.any(ends[0][field] <= 0.0)
        ):
            raise InputError(f"safety_filter: the interval of {name} reaches below 0")
    if "split" in ends[1]:
        ends[1]["split"] = np.minimum(ends[1]["split"], 1.0)
    least, most = (dataclasses.replace(plant, **end) for end in ends)
    return least, most


def widths_of(plant: TankNetwork, spread: Mapping[str, float]) -> dict[str, np.ndarray]:
    """Return the half widths of `box_of` for parameters that may be off by a share of their value.

    Raises InputError for a share outside [0, 1).
    """
    found = {}
    for name, share in spread.items():
        if not 0.0 <= share < 1.0:
            raise InputError(
                f"safety_filter: spread of {name} = {share:g}: must be from 0 to below 1"
            )
        field, _, entry = name.removeprefix("plant.").partition("[")
        value = np.asarray(getattr(plant, field, 0.0), dtype=float)
        found[name] = share * (value[int(entry[:-1])] if entry else value)
    return found


def band_of(sensor: LevelSensor) -> np.ndarray:
    """Return the (n,) band of readings [cm]: 6 standard deviations, half an ADC step, offset."""
    band = SIGMAS * np.asarray(sensor.noise, dtype=float)
    if sensor.offset is not None:
        band = band + np.abs(np.asarray(sensor.offset, dtype=float))
    if sensor.bits:
        band = band + 0.5 * np.asarray(sensor.gain) * float(sensor.full_scale) / 2**sensor.bits
    return band


def top_of(sensor: LevelSensor, tanks: int) -> np.ndarray:
    """Return the (n,) highest level that the sensors can read [cm]; inf without an ADC."""
    if not sensor.bits:
        return np.full(tanks, np.inf)
    return np.asarray(sensor.gain, dtype=float) * float(sensor.full_scale)


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
) -> tuple[SafetyFilter, tuple[TankCertificate, ...]]:
    """Return a safety filter for a rig, and the certificate of each tank.

    Parameters
    ----------
    plant, actuator, sensor : the rig
    hold : longest time for which an input is held [s]
    widths : {parameter: half width of its interval, in its unit}, the box (see `widths_of`): each
        entry of each lies somewhere in its interval, and may change there in time
    limit : (n,) wanted limits [cm]; the rims where it is left out. Limits may come out lower
    inflow : (n,) largest inflow disturbance [cm^3/s]
    volume : (n,) volume that may enter besides, at any time and rate, in all [cm^3]; limits are
        lowered by it
    offset : (m,) least input that moves liquid [V]; the pumps' offset dead zone where left out
    band : (n,) largest difference of reading and level [cm]; from the sensor where it is left out
    rate : kappa [1/s]; min(2, 0.5/hold, 0.9 of its bound) where it is left out
    substeps : integration steps of a hold
    start : (n,) highest levels at t = 0 [cm]. Without it a certificate holds for starts at or below
        the limits, and no tank counts as one that full pumps cannot fill

    Raises
    ------
    InputError
        for a plant that is no TankNetwork, or a value out of its range
    """
    if not isinstance(plant, TankNetwork):
        raise InputError("safety_filter: is for tank networks (plants.network) only")
    n = plant.tanks
    least, most = box_of(plant, widths)
    inflow = np.broadcast_to(np.asarray(inflow, dtype=float), (n,))
    eps = band_of(sensor) if band is None else np.broadcast_to(np.asarray(band, dtype=float), (n,))
    coefficients = jax.tree.map(_plain, rates_of(least, most, inflow, hold / substeps))
    lags, zone = getattr(actuator, "lag", None), getattr(actuator, "dead_zone", None)
    lag = 0.0 if lags is None else float(np.max(lags))
    dead = np.asarray(actuator.offset if offset is None else offset, dtype=float)
    dead = np.broadcast_to(dead, (actuator.pumps,))
    setting = _Setting(
        rates=coefficients,
        hold=float(hold),
        delay=float(actuator.delay),
        lag=lag,
        low=np.asarray(actuator.low, dtype=float),
        high=np.asarray(actuator.high, dtype=float) - dead,
        band=eps,
        top=top_of(sensor, n),
        spare=np.broadcast_to(np.asarray(volume, dtype=float), (n,)) / np.asarray(least.area),
        pulse=zone is not None and getattr(actuator, "dead_zone_kind", "") == "pulse",
    )
    bound = rate_bound(setting.hold, setting.delay, lag)
    kappa = min(FASTEST, SHARE_OF_HOLD / hold, MARGIN * bound) if rate is None else float(rate)
    wanted = np.asarray(plant.rim if limit is None else limit, dtype=float)
    wanted = np.minimum(np.broadcast_to(wanted, (n,)), setting.top) - setting.spare
    if np.any(wanted <= 0.0):
        raise InputError("safety_filter: inflow disturbances alone fill a tank to its limit")
    x0 = wanted if start is None else np.broadcast_to(np.asarray(start, dtype=float), (n,))
    heights = np.minimum(wanted, np.maximum(_filled(setting, wanted, x0), x0))
    before = heights.copy()
    heights, slopes, reasons = _limits(setting, heights, kappa)
    idle = (heights == before) & (heights < wanted)  # full pumps cannot reach the limit
    for i in range(n):
        reasons[i] = reasons[i] or _failed(
            setting, i, heights, slopes, idle[i], kappa, bound, start
        )
    reach = _settle(setting, heights, slopes, idle, reasons, plant)
    nominal = jax.tree.map(_plain, rates_of(plant, plant, inflow, 0.0))
    proved = _theorem(setting)
    rows = tuple(
        TankCertificate(
            tank=i,
            limit=float((wanted if idle[i] else heights)[i] + setting.spare[i]),
            certified=not reasons[i],
            reason=reasons[i]
            or ("full pumps stay below" if idle[i] else "Theorem 2" if slopes[i] > 0.0 else proved),
            rate=kappa,
            rate_bound=bound,
            gap=0.0 if idle[i] else _gap(setting, nominal, i, kappa, heights[i], reach),
            reach=float(reach[i] + setting.spare[i]),
        )
        for i in range(n)
    )
    found = SafetyFilter(
        least=least,
        most=most,
        limit=heights,
        reach=np.minimum(reach + setting.spare, 1e6),
        spare=setting.spare,
        offset=dead,
        rate=np.full(n, kappa),
        band=np.array(eps),
        inflow=np.array(inflow),
        slope=slopes,
        age=setting.delay + lag,
        held=tuple(
            i for i in range(n) if not idle[i] and (coefficients.pumps[i] or slopes[i] > 0.0)
        ),
    )
    return found, rows


def _plain(value):
    """A number of Rates as a float; an index as it is."""
    return value if isinstance(value, int) else float(value)


def phi(rates: Rates, tank: int, level: float, others: Any) -> float:
    """Phi_max(level) [cm/s] in plain numbers; see `worst_case.rise`."""
    knee, h = rates.knee, max(level, 0.0)
    empty = h < rates.empty[tank]
    rate = rates.inflow[tank] - (0.0 if empty else rates.out[tank] * _root(h, knee))
    for i, j, least, most in rates.pipes:
        if i == tank:
            z = others[j] - h
            s = math.copysign(math.sqrt(abs(z)), z) if not math.isinf(z) else z
            s = z / (z * z + knee * knee) ** 0.25 if abs(z) < 1e6 else s
            rate += most * s if s >= 0.0 else (0.0 if empty else least * s)
    for source, sink, _, most in rates.links:
        if sink == tank:
            rate += most * _root(max(others[source], 0.0), knee)
    return rate


def _root(h, knee):
    """The root of the plant's flows (`numerics.root`) of a level h >= 0 in plain numbers."""
    return math.sqrt(h) if h >= knee else math.sqrt(knee) * (1.5 * h / knee - 0.5 * (h / knee) ** 2)


def _unstoppable(setting, tank):
    """What pumps with a lower limit above 0 V always bring [cm/s]."""
    return sum(b * max(setting.low[j], 0.0) for j, (_, b) in setting.rates.pumps[tank].items())


def _filled(setting, wanted, start):
    """(n,) levels [cm] to which full pumps fill the tanks at most, no tank above its wanted limit
    or its start; inf for tanks with pipes.
    """
    filled, rates = np.full(len(wanted), np.inf), setting.rates
    for _ in filled:
        others = np.minimum(wanted, np.maximum(filled, start))
        for i in range(len(filled)):
            if not any(tank == i for tank, *_ in rates.pipes):
                rest = _rest(setting, i, others)
                filled[i] = max(rest, rates.empty[i])
    return filled


def _full(setting, tank):
    """What full pumps bring at most [cm/s]."""
    return sum(b * max(setting.high[j], 0.0) for j, (_, b) in setting.rates.pumps[tank].items())


def _limits(setting, heights, kappa):
    """(limits (n,) [cm], k1 (n,) [1/s], {tank: why it failed}): Theorem 2.

    A tank whose inflow alone passes its limit is held by the pumps above it if it has none of its
    own; otherwise the limits of the tanks above are lowered by one factor until it is not.
    """
    n, rates = len(heights), setting.rates
    heights, slopes, reasons = np.array(heights), np.zeros(n), [""] * n
    for _ in range(4 * n):
        changed = False
        for i in range(n):
            excess = setting.phi(i, heights[i], heights) + _unstoppable(setting, i)
            if excess <= 1e-12 or slopes[i] > 0.0 or reasons[i]:
                continue
            slopes[i], why = _second_order(setting, i, heights, kappa)
            if slopes[i] > 0.0:
                continue
            sources = [(j, most) for j, sink, _, most in rates.links if sink == i]
            pressed = sum(
                most * _root(heights[j] + setting.spare[j], rates.knee) for j, most in sources
            )
            margin = rates.out[i] * _root(heights[i], rates.knee) - (
                excess + rates.out[i] * _root(heights[i], rates.knee) - pressed
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
    leaves = rates.out[tank] * _root(heights[tank], rates.knee)
    enters = setting.phi(tank, heights[tank], heights) + leaves + _unstoppable(setting, tank)
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
    full = sum(most * _root(heights[j], knee) for j, _, most in sources)
    drained = MARGIN * sum(0.5 * most * rates.out[j] for j, _, most in sources)
    a0 = FLOOR * _root(top, knee)
    if a0**2 < knee:
        return 0.0, f"second order: laminar threshold {knee:g} above {a0**2:.3g}"
    for j, _, most in sources:
        left = rates.out[tank] * _root(top, knee) - (full - most * _root(heights[j], knee))
        if left <= most * a0:
            return 0.0, f"second order: (C3) {left:.3g} not above {most * a0:.3g} cm/s"
    for k1 in np.geomspace(1.0 / hold, 1e-4, 2000):
        if k1 * top < full:  # (C2)
            break
        level = _crossing(rates.out[tank], k1, top, full)
        lowest = level - hold * full - 2.0 * setting.band[tank]
        lowest -= hold * rates.out_most[tank] * _root(top, knee)
        steep = rates.out[tank] * 0.5 / math.sqrt(lowest) if lowest > knee else math.inf
        if k1**2 * (top - level) <= drained and k1 > steep:  # (C1), (C4)
            return float(k1), ""
    return 0.0, f"second order: no k1 with (C1) k1^2 (H - h*) <= {drained:.3g} cm/s^2"


def _crossing(out, k1, top, full):
    """h* [cm] with out sqrt(h*) + k1 (H - h*) = F, on the falling side."""
    root = (out + math.sqrt(out**2 + 4.0 * k1 * (k1 * top - full))) / (2.0 * k1)
    return min(root**2, top)


def _theorem(setting):
    """The theorem that proves the limit of a tank with a pump."""
    if setting.lag > 0.0:
        return "Theorem 4"
    return "Theorem 3" if setting.delay > 0.0 else "Theorem 1"


def _failed(setting, tank, heights, slopes, idle, kappa, bound, start):
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
    if any(i == tank for i, *_ in rates.pipes):
        return "a pipe with dead time or lag: not proved"
    steep = rates.out[tank] / math.sqrt(heights[tank])
    if kappa < steep:
        return f"(N) kappa {kappa:.3g} below c_min/sqrt(H) = {steep:.3g} 1/s"
    if setting.lag > 0.0:
        brought = _full(setting, tank) + setting.phi(tank, 0.0, heights)
        filled = brought * (2.0 * setting.lag + setting.delay + setting.hold)
        if filled > 0.75 * heights[tank]:
            return f"(F) {filled:.3g} cm may be filled within the lag: above 3/4 of the limit"
    return ""


def _too_high_above(setting, tank, heights, slopes, start):
    """Why the levels `start` do not allow a second-order row to begin (g >= 0), or ""."""
    if start is None:
        return ""
    start, rates, knee = np.asarray(start), setting.rates, setting.rates.knee
    a0 = FLOOR * _root(heights[tank], knee)
    g = rates.out[tank] * _root(start[tank], knee)
    g += slopes[tank] * (heights[tank] - start[tank])
    for j, sink, _, most in rates.links:
        if sink == tank:
            g -= most * max(_root(start[j], knee), a0)
    return "" if g >= 0.0 else "start: the tanks above hold more than can be stopped in time"


def _settle(setting, heights, slopes, idle, reasons, plant):
    """(n,) levels that no tank passes [cm]. A tank that relies on one which is not certified loses
    its certificate (in `reasons`) unless its condition holds for what that one may reach.
    """
    rates, n = setting.rates, len(heights)
    while True:
        reach = _reach(setting, heights, [not why for why in reasons], plant)
        before = list(reasons)
        for i in (i for i in range(n) if not reasons[i]):
            extra = _full(setting, i) if idle[i] else _unstoppable(setting, i)
            above = [j + 1 for j, sink, *_ in rates.links if sink == i and reasons[j]]
            fails = setting.phi(i, heights[i], reach) + extra > 1e-9 * max(rates.out[i], 1e-9)
            if above if slopes[i] > 0.0 else fails:
                others = above or [j + 1 for j in range(n) if reasons[j]]
                reasons[i] = f"relies on tank {', '.join(map(str, others))}, not certified"
        if reasons == before:
            return reach


def _reach(setting, heights, certified, plant):
    """(n,) levels that no tank passes [cm]: H where certified, else where its inflow can rest."""
    n, rim = len(heights), np.asarray(plant.rim, dtype=float)
    reach = np.array(heights)
    for _ in range(50):
        before = reach.copy()
        for i in (i for i in range(n) if not certified[i]):
            reach[i] = max(reach[i], _rest(setting, i, reach))
            if plant.overflow:
                reach[i] = min(reach[i], max(rim[i], heights[i]))
        if np.allclose(reach, before, rtol=1e-9, atol=0.0):
            return reach
    return np.where(certified, heights, rim if plant.overflow else np.inf)


def _rest(setting, tank, others):
    """Level [cm] at which a tank rests with the most that may enter; inf if it never does."""
    full = _full(setting, tank)
    level = _highest(lambda h: full + setting.phi(tank, h, others), 1e6)
    return math.inf if level == 1e6 else level * (1.0 + 1e-9)


def _gap(setting, nominal, tank, kappa, limit, reach):
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
        cap = max(0.0, kappa * (limit - h - eps) - phi(rates, tank, h - eps, others))
        return min(full, gain / most * cap) + phi(nominal, tank, h, others)

    free = lambda h: full + phi(nominal, tank, h, others)
    return float(_highest(free, limit) - _highest(filtered, limit))


def _highest(rate, top):
    """The level [cm] up to which rate(level), which falls with it, is above 0; `top` at most."""
    low, high = 0.0, top
    if rate(top) > 0.0:
        return top
    for _ in range(60):
        mid = 0.5 * (low + high)
        low, high = (mid, high) if rate(mid) > 0.0 else (low, mid)
    return low
