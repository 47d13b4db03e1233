"""For which limits a safety filter is proved, tank by tank, and what it costs."""

import dataclasses
import math
from collections.abc import Mapping

import jax
import numpy as np
from numpy.typing import ArrayLike

from jaxtank.core.errors import InputError
from jaxtank.instruments.base import Actuator
from jaxtank.instruments.sensors import LevelSensor
from jaxtank.plants import elements
from jaxtank.plants.faults import Faults
from jaxtank.plants.tank_network import TankNetwork
from jaxtank.safety.box import (
    band_of,
    box_of,
    interval,
    intervals,
    narrow_band,
    spread,
    top_of,
    uncovered,
)
from jaxtank.safety.checker import check
from jaxtank.safety.conditions import Setting, gap_of, spills
from jaxtank.safety.filter import SafetyFilter
from jaxtank.safety.low_limits import check_low, failed_low
from jaxtank.safety.upper_limits import choose, rate_bound
from jaxtank.safety.worst_case import rates_of

UNKNOWN = 1e6  # stands for a level [cm] or a time [s] without a bound


@dataclasses.dataclass(frozen=True)
class TankCertificate:
    """Whether the limit of one tank is proved, and by what.

    tank : counted from 0.  limit : H [cm].  certified : True if no plant of the box passes it: the
    conditions of the design hold, and those of `checker.check`.  starts : the levels at t = 0 for
    which that holds, "limits" or "case" (see `checker.Verdict`), "" where it is not proved.
    reason : the theorem, or the condition that failed with both of its numbers, or "not covered:
    FEATURE".  rate, rate_bound : kappa and the largest that is proved [1/s].  gap : how far below
    the limit the nominal plant rests with its pumps full [cm], nan where they cannot reach it.
    reach : what the level never passes [cm]; inf if unknown.  low : low limit [cm], 0 for none.
    low_certified, low_reason : of the low limit, as above.
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

    def unproved(self, measure: str, value: float) -> str | None:
        """Return why a limit on a level, or on the overflow of a rim, is not proved; None: it is.

        measure : "max_level", "min_level" or "overflow_volume".  value : the level [cm], of an
        overflow the rim.
        """
        if measure == "min_level":
            reason = self.low_reason or "the safety filter keeps no low limit there"
            proved, own, holds = self.low_certified, self.low, self.low >= value * (1 - 1e-9)
        else:
            proved, own, reason = self.certified, self.limit, self.reason
            holds = own <= value * (1 + 1e-9)
        if not proved:
            return reason
        return None if holds else f"the safety filter keeps another limit, {own:.4g}"


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
    draws: bool = False,
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
    draws : whether volumes may leave besides, at any time (no low limit is then proved)
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
    elements.check_plain(plant, "safety_filter", "outlet_design is for rigs with them")
    n, ends = plant.tanks, box_of(plant, widths)
    least, most = ends
    tankwise = lambda v: np.broadcast_to(np.asarray(v, float), (n,))
    inflow, draw, low, volume = map(tankwise, (inflow, draw, low, volume))
    dead = _dead_zone(actuator, widths, offset)
    band = tankwise(band_of(sensor, widths=widths) if band is None else band)
    begin, start = (None, None) if start is None else spread(tankwise(start), "x0", widths)
    rates = lambda entering: _rates(least, most, entering, hold / substeps, draw)
    setting = Setting(
        rates=rates(inflow),
        hold=float(hold),
        band=band,
        top=top_of(sensor, n, widths),
        spare=volume / np.asarray(least.area),
        draws=draws,
        uncovered=("; ".join(f"not covered: uncertain {x}" for x in uncovered(widths)),) * n,
        unit=plant.units[0],
        plant=plant,
        **_of_pumps(actuator, dead, widths),
    )
    setting = setting._replace(
        predicted=predict * _predicted(setting, widths), divided=_divided(setting, actuator, widths)
    )
    bound = rate_bound(hold, 0.0 if setting.predicted else setting.delay, setting.lag)
    requested = _requested_limits(setting, least.rim if limit is None else limit)
    check_low(low, requested, setting.unit)
    noise = np.asarray(sensor.noise, dtype=float)
    at = lambda s: choose(s, noise, most, requested, rate, bound, start)
    setting, chosen, falls = _with_spills(setting, ends, at, rates, inflow, start)
    low_reasons, bottom = failed_low(setting, low, chosen, begin)
    capped, raised = _tanks_with_rows(setting, chosen, low)
    safety_filter = SafetyFilter(
        least=least,
        most=most,
        offset=np.broadcast_to(dead, (actuator.pumps,)),
        rate=np.full(n, chosen.rate),
        inflow=inflow + falls,
        draw=np.array(draw),
        substeps=substeps if setting.predicted else 1,
        divided=setting.divided,
        running=tuple(int(j) for j in np.flatnonzero(setting.low > 0.0)),
        limit=chosen.heights,
        reach=np.minimum(chosen.reach + setting.spare, UNKNOWN),
        spare=setting.spare,
        band=np.array(band),
        slope=chosen.slopes,
        # of a lagged input every older reading is a part: neighbours count with their `reach`; and
        # where inputs beyond the limits of the pumps are under way
        age=UNKNOWN if setting.lag > 0.0 or setting.beyond else setting.delay,
        held=capped,
        predicted=setting.predicted,
        low=np.array(low),
        bottom=bottom,
        kept=raised,
    )
    limits = np.where(chosen.idle, requested, chosen.heights)
    verdicts = check(
        safety_filter,
        plant,
        actuator,
        sensor,
        hold=hold,
        substeps=substeps,
        box=intervals(widths, {"plant": plant, "actuator": actuator, "sensor": sensor})
        | ({} if start is None else {"x0": (begin, start)}),
        inflow=(draw, inflow),
        volume=volume,
        draws=draws,
        start=start,
        faults=faults,
        limits=limits + setting.spare,
    )
    nominal = _rates(plant, plant, inflow + falls, 0.0, None)
    narrow = narrow_band(sensor, band, setting.unit, widths)
    gap = lambda i: gap_of(setting, nominal, i, chosen.rate, limits[i], chosen.reach)
    rows = []
    for i, verdict in enumerate(verdicts):
        numbers = {
            "limit": float(limits[i] + setting.spare[i]),
            "rate": chosen.rate,
            "rate_bound": bound,
            "gap": 0.0 if chosen.idle[i] else gap(i),
            "reach": float(chosen.reach[i] + setting.spare[i]),
            "low": float(low[i]),
        }
        rows.append(_certificate(verdict, numbers, chosen.reasons[i] or narrow[i], low_reasons[i]))
    return safety_filter, tuple(rows)


def _requested_limits(setting, limit):
    """(n,) limits [cm] that the sensors can read, before volumes that enter besides."""
    requested = np.broadcast_to(np.asarray(limit, dtype=float), setting.spare.shape)
    requested = np.minimum(requested, setting.top) - setting.spare
    if np.any(requested <= 0.0):
        raise InputError("safety_filter: inflow disturbances alone fill a tank to its limit")
    return requested


def _with_spills(setting, ends, at, rates, inflow, start):
    """(Setting with what overflows from other tanks, Chosen at it, (n,) that flow [cm^3/s])."""
    n, falls = len(setting.spare), np.zeros(len(setting.spare))
    for _ in range(3 * n + 3):
        chosen = at(setting)
        more, reasons = spills(setting, ends, chosen, start)
        if np.all(more <= falls) and reasons == setting.uncovered:
            return setting, chosen, falls
        falls = np.maximum(falls, more)
        setting = setting._replace(rates=rates(inflow + falls), uncovered=reasons)
    sinks = {sink for _, sink in ends[0].spills}
    ring = [r or "not covered: a ring of spills" * (i in sinks) for i, r in enumerate(reasons)]
    setting = setting._replace(uncovered=tuple(ring))
    return setting, at(setting), falls


def _tanks_with_rows(setting, chosen, low):
    """(Tanks whose limits a row of the filter keeps, tanks whose low limits one keeps)."""
    fed = np.array([bool(gains) for gains in setting.rates.pumps])
    capped = (fed | (chosen.slopes > 0.0)) & ~chosen.idle
    return tuple(tuple(map(int, np.flatnonzero(rows))) for rows in (capped, fed & (low > 0.0)))


def _certificate(verdict, numbers, reason, low_reason):
    """The certificate of a tank; `reason`, `low_reason`: the condition of the design that fails."""
    proved = not reason and verdict.holds
    low_designed = numbers["low"] > 0.0 and not low_reason
    return TankCertificate(
        tank=verdict.tank,
        certified=proved,
        reason=reason or verdict.reason,
        low_certified=bool(low_designed and verdict.low_holds),
        low_reason=verdict.low_reason if low_designed else low_reason,
        starts=verdict.starts if proved else "",
        **numbers,
    )


def _rates(least, most, inflow, step, draw):
    """`rates_of` in plain numbers."""
    plain = lambda value: value if isinstance(value, int) else float(value)
    return jax.tree.map(plain, rates_of(least, most, inflow, step, draw))


def _dead_zone(actuator, widths, offset):
    """`offset`, or the least offset dead zone [V] of each pump, 0 without one."""
    if offset is not None:
        return np.asarray(offset, dtype=float)
    offset = np.asarray(actuator.offset, dtype=float)
    return interval(actuator, "actuator.dead_zone", widths)[0] if offset.ndim else offset


def _predicted(setting, widths):
    """Number of inputs under way over which levels can be predicted; 0: none."""
    samples = math.ceil(setting.delay / setting.hold - 1e-9)
    other = setting.lag > 0.0 or setting.rates.pipes or setting.dead or setting.draws
    other = other or "actuator.delay" in widths
    return 0 if samples < 2 or other or np.any(setting.spare > 0.0) else samples


def _of_pumps(actuator, dead, widths):
    """The fields of Setting that describe the pumps, of dead zones `dead` [V]."""
    leaves = ("low", "high", "initial", "delay", "lag")
    ends = zip(*(interval(actuator, f"actuator.{leaf}", widths) for leaf in leaves))
    least, most = (dict(zip(leaves, end)) for end in ends)
    delay, lag = float(most["delay"]), float(np.max(most["lag"]))
    under_way = delay > 0.0 or lag > 0.0
    above = np.any(most["initial"] > least["high"])
    backwards = np.any(least["initial"] < np.minimum(least["low"], 0.0))
    zoned = getattr(actuator, "dead_zone", None) is not None
    return {
        "delay": delay,
        "lag": lag,
        "low": most["low"],
        "high": most["high"] - dead,
        "weakest": least["high"] - dead,
        "pulse": zoned and getattr(actuator, "dead_zone_kind", "") == "pulse",
        "dead": zoned,
        "before": tuple(most["initial"] - dead) if under_way else (),
        "beyond": under_way and bool(above or backwards),
    }


def _divided(setting, actuator, widths):
    """Tanks that several pumps feed whose lags differ or may differ: Theorem 4 needs a row each."""
    ends = np.stack(interval(actuator, "actuator.lag", widths))
    if setting.lag == 0.0 or not np.all(np.isfinite(setting.high)):
        return ()
    lags = np.broadcast_to(ends.reshape(2, -1), (2, len(setting.high)))
    pumps = [list(gains) for gains in setting.rates.pumps]
    return tuple(i for i, js in enumerate(pumps) if len(js) > 1 and np.ptp(lags[:, js]) > 0.0)
