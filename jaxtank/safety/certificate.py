"""For which limits a safety filter is proved, tank by tank, and what it costs.

Works on plain numbers, before a run. May be imported by the rig files, the command line and tests.
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
from jaxtank.safety.box import band_of, box_of, narrow_band, top_of
from jaxtank.safety.checker import check
from jaxtank.safety.conditions import failed_condition, gap_of, settle, theorem_of
from jaxtank.safety.filter import SafetyFilter
from jaxtank.safety.limits import filled_levels, limits_for
from jaxtank.safety.low_limits import check_low, failed_low
from jaxtank.safety.setting import Setting
from jaxtank.safety.worst_case import rates_of

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
        entry of each lies somewhere in its interval, and may change there in time
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
        the limits, and no tank counts as one that full pumps cannot fill
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
    given = (inflow, draw, low, volume)
    inflow, draw, low, volume = (np.broadcast_to(np.asarray(v, float), (n,)) for v in given)
    dead = np.asarray(actuator.offset if offset is None else offset, dtype=float)
    band = np.broadcast_to(np.asarray(band_of(sensor) if band is None else band, float), (n,))
    setting = Setting(
        rates=jax.tree.map(_plain, rates_of(least, most, inflow, hold / substeps, draw)),
        hold=float(hold),
        band=band,
        top=top_of(sensor, n),
        spare=volume / np.asarray(least.area),
        drawn=drawn,
        **_of_pumps(actuator, dead),
    )
    setting = setting._replace(predicted=predict * _predicted(setting))
    bound = rate_bound(hold, 0.0 if setting.predicted else setting.delay, setting.lag)
    check_low(low, wanted := _wanted(setting, plant, limit), plant.units[0])
    prove = lambda kappa: _proved(setting, plant, wanted, kappa, bound, start)
    kappa = min(FASTEST, SHARE_OF_HOLD / hold, BELOW_BOUND * bound) if rate is None else float(rate)
    found = prove(kappa)
    if rate is None and np.any(np.asarray(sensor.noise) > 0.0):
        kappa = _quiet_rate(setting, sensor, found.heights, kappa)
        found = prove(kappa)
    why, bottom = failed_low(setting, low, found, kappa, start)
    nominal = jax.tree.map(_plain, rates_of(plant, plant, inflow, 0.0))
    narrow = narrow_band(sensor, band, plant.units[0])
    rows = [_row(setting, nominal, found, i, wanted, kappa, bound, narrow[i]) for i in range(n)]
    guard = SafetyFilter(
        least=least,
        most=most,
        offset=np.broadcast_to(dead, (actuator.pumps,)),
        rate=np.full(n, kappa),
        inflow=np.array(inflow),
        draw=np.array(draw),
        substeps=substeps if setting.predicted else 1,
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
        | ({} if start is None else {"x0": (start, start)}),
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


def _quiet_rate(setting, sensor, heights, kappa):
    """kappa [1/s], or less, so that the noise of a capped pump stays within QUIET of its range."""
    rates, noise, quiet, needed = setting.rates, np.asarray(sensor.noise, dtype=float), kappa, 0.0
    for i in (i for i, gains in enumerate(rates.pumps) if gains):
        needed = max(needed, rates.out[i] / math.sqrt(heights[i]))
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


def _predicted(setting):
    """Number of inputs under way over which levels can be predicted; 0: none."""
    samples = math.ceil(setting.delay / setting.hold - 1e-9)
    other = setting.lag > 0.0 or setting.rates.pipes or setting.dead or setting.drawn
    return 0 if samples < 2 or other or np.any(setting.spare > 0.0) else samples


def _upper(setting, found):
    """The fields of SafetyFilter that hold the upper limits."""
    return {
        "limit": found.heights,
        "reach": np.minimum(found.reach + setting.spare, UNKNOWN),
        "spare": setting.spare,
        "band": np.array(setting.band),
        "slope": found.slopes,
        # of a lagged input every older reading is a part: neighbours count with their `reach`
        "age": setting.delay if setting.lag == 0.0 else UNKNOWN,
        "held": _held(setting, found),
        "predicted": setting.predicted,
    }


def _lower(setting, low, bottom):
    """The fields of SafetyFilter that hold the low limits."""
    kept = tuple(i for i, gains in enumerate(setting.rates.pumps) if low[i] > 0.0 and gains)
    return {"low": np.array(low), "bottom": bottom, "kept": kept}


def _of_pumps(actuator, dead):
    """The fields of Setting that describe the pumps, of dead zones `dead` [V]."""
    return {
        "delay": float(actuator.delay),
        "lag": _largest(getattr(actuator, "lag", None)),
        "low": np.asarray(actuator.low, dtype=float),
        "high": np.asarray(actuator.high, dtype=float) - dead,
        "pulse": _pulses(actuator),
        "dead": getattr(actuator, "dead_zone", None) is not None,
        "before": tuple(np.asarray(actuator.initial, dtype=float) - dead),
    }


class _Proved(NamedTuple):
    """Limits (n,) [cm], k1 (n,) [1/s], which tanks full pumps cannot fill, {tank: condition that
    failed, or ""}, and levels that no tank passes (n,) [cm], all before volumes that enter besides.
    """

    heights: np.ndarray
    slopes: np.ndarray
    idle: np.ndarray
    reasons: list[str]
    reach: np.ndarray


def _proved(setting, plant, wanted, kappa, bound, start):
    """Return the _Proved of a rig for the `wanted` limits (n,) [cm]."""
    begin = wanted if start is None else np.broadcast_to(np.asarray(start, float), wanted.shape)
    first = np.minimum(wanted, np.maximum(filled_levels(setting, wanted, begin), begin))
    heights, slopes, reasons = limits_for(setting, first, kappa)
    idle = (heights == first) & (heights < wanted)  # full pumps cannot reach the limit
    for i, why in enumerate(reasons):
        reasons[i] = why or failed_condition(
            setting, i, heights, slopes, idle[i], kappa, bound, start
        )
    reach = settle(setting, heights, slopes, idle, reasons, plant)
    return _Proved(heights, slopes, idle, reasons, reach)


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


def _largest(lag):
    """The longest lag [s] of the pumps, 0 without one."""
    return 0.0 if lag is None else float(np.max(lag))


def _pulses(actuator):
    """Whether dead zones are left by pulses."""
    kind = getattr(actuator, "dead_zone_kind", "")
    return getattr(actuator, "dead_zone", None) is not None and kind == "pulse"


def _plain(value):
    """A number of Rates as a float; an index as it is."""
    return value if isinstance(value, int) else float(value)
