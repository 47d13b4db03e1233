"""The rows of an `OutletFilter`: which inputs keep each limit, and how fast."""

import dataclasses
from collections.abc import Mapping
from typing import Any

import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from jaxtank.core.errors import InputError
from jaxtank.instruments.base import Actuator
from jaxtank.instruments.sensors import LevelSensor
from jaxtank.plants.tank_network import TankNetwork
from jaxtank.safety.box import band_of, box_of, intervals, spread, top_of
from jaxtank.safety.certificate import UNKNOWN, TankCertificate
from jaxtank.safety.low_limits import check_low
from jaxtank.safety.outlet_checker import check
from jaxtank.safety.outlets import OutletFilter
from jaxtank.safety.upper_limits import FASTEST, SHARE_OF_HOLD

PARTS = 400  # levels at which a tank is tested for holding what it gives in a step


def outlet_design(
    plant: TankNetwork,
    actuator: Actuator,
    sensor: LevelSensor,
    hold: float,
    *,
    widths: Mapping[str, ArrayLike],
    limit: ArrayLike,
    inflow: ArrayLike = 0.0,
    volume: ArrayLike = 0.0,
    band: ArrayLike | None = None,
    rate: float | None = None,
    substeps: int = 1,
    start: ArrayLike,
    low: ArrayLike = 0.0,
    draw: ArrayLike = 0.0,
    draws: bool = False,
    faults: Any = None,
) -> tuple[OutletFilter, tuple[TankCertificate, ...]]:
    """Return a filter for a rig of outlets, and its certificates; arguments as of `design`."""
    n = plant.tanks
    _check_inverses(plant)
    least, most = box_of(plant, widths)
    tankwise = lambda v: np.array(np.broadcast_to(np.asarray(v, dtype=float), (n,)))
    inflow, draw, low, limit = map(tankwise, (inflow, draw, low, limit))
    limit = np.minimum(limit, top_of(sensor, n, widths))
    check_low(low, limit, plant.units[0])
    begin, highest = spread(tankwise(start), "x0", widths)
    kappa = min(FASTEST, SHARE_OF_HOLD / hold) if rate is None else float(rate)
    shaped = np.array([kind != "prism" for kind in plant.shapes or ("prism",) * n])
    base = OutletFilter(
        least=least,
        most=most,
        limit=limit,
        low=low,
        reach=limit,
        bottom=low,
        rate=np.full(n, kappa),
        band=tankwise(band_of(sensor, widths=widths) if band is None else band),
        inflow=inflow,
        draw=draw,
        climb=np.full(n, UNKNOWN),
        drop=np.full(n, UNKNOWN),
        empty=np.zeros(n),
    )
    ranges = _ranges(base, actuator)
    base = dataclasses.replace(base, empty=_empty(base, ranges, hold / substeps))
    overflowing = np.maximum(np.asarray(most.rim, dtype=float), highest)
    loose = overflowing if plant.overflow else np.full(n, UNKNOWN)
    # upper and low limits that other tanks may count on
    relied = np.array([limit > 0.0, low > 0.0])
    check_of = lambda finished: check(
        finished,
        plant,
        actuator,
        sensor,
        hold=hold,
        substeps=substeps,
        box=intervals(widths, {"plant": plant, "actuator": actuator, "sensor": sensor})
        | {"x0": (begin, highest)},
        inflow=(draw, inflow),
        pulses=bool(np.any(tankwise(volume) > 0.0) or draws),
        faults=faults,
    )
    lost: dict = {}  # {(tank, upper): why a limit was given up, while the others were relied on}
    while True:
        reach = np.where(relied[0], limit, loose)
        base = dataclasses.replace(base, reach=reach, bottom=np.where(relied[1], low, 0.0))
        finished = _finished(base, ranges, hold, shaped)
        verdicts = check_of(finished)
        proved = np.array([[v.holds for v in verdicts], [v.low_holds for v in verdicts]])
        reasons = {v.reason for v in verdicts}
        whole = len(reasons) == 1 and reasons.pop().startswith("not covered: ")
        if whole or np.all(proved | ~relied):
            break
        lost = _reasons(verdicts) | lost
        relied &= proved
    return finished, tuple(_certificate(finished, v, hold, lost) for v in verdicts)


def _reasons(verdicts):
    """{(tank, upper): why} of the limits that do not hold."""
    return {(v.tank, up): why for v in verdicts for up, why in _failures(v)}


def _failures(verdict):
    """[(upper, why)] of the limits of a tank that do not hold."""
    rows = (True, verdict.holds, verdict.reason), (False, verdict.low_holds, verdict.low_reason)
    return [(upper, why) for upper, holds, why in rows if not holds]


def _certificate(finished, verdict, hold, lost):
    """The certificate of a tank."""
    i = verdict.tank
    reasons = {True: verdict.reason, False: verdict.low_reason}
    reasons |= {up: lost.get((i, up), why) for up, why in _failures(verdict)}
    return TankCertificate(
        tank=i,
        limit=float(finished.limit[i]),
        certified=verdict.holds,
        reason=reasons[True],
        rate=float(finished.rate[i]),
        rate_bound=1.0 / hold,
        gap=float("nan"),
        reach=float(finished.reach[i]),
        low=float(finished.low[i]),
        low_certified=verdict.low_holds,
        low_reason=reasons[False],
        starts=verdict.starts if verdict.holds else "",
    )


def _finished(base, ranges, hold, shaped):
    """The filter with rows and the changes of levels in a hold."""
    tanks = range(base.least.tanks)
    able = {(i, True): _able(base, i, ranges, True) for i in tanks}
    able |= {(i, False): _able(base, i, ranges, False) for i in tanks if base.low[i] > 0.0}
    chosen = _chosen(base, able)
    rows = lambda upper: tuple((i, m) for (i, u), m in chosen.items() if u == upper and m)
    step = lambda up: [_step(base, i, ranges, up, hold) for i in tanks]
    changes = {"climb": step(True), "drop": step(False)}
    steps = {name: np.where(shaped, UNKNOWN, change) for name, change in changes.items()}
    return dataclasses.replace(base, upper_rows=rows(True), low_rows=rows(False), **steps)


def _check_inverses(plant):
    points = [f"curve of pump {j + 1}" for j, curve in enumerate(plant.curves) if curve]
    kinds = enumerate(plant.characteristics)
    points += [f"characteristic of valve {k + 1}" for k, kind in kinds if not isinstance(kind, str)]
    if points:
        raise InputError(
            f"safety_filter: not covered: {', '.join(points)}: run without the filter, or give a"
            " gain, and a linear or equal-percentage characteristic"
        )


def _ranges(base, actuator):
    """([low], [high]) demands of the inputs."""
    demands = lambda end: [float(base.demand(j, end[j])) for j in range(actuator.pumps)]
    return [demands(actuator.low), demands(actuator.high)]


def _worst(effects, ranges, movers=()):
    """What inputs do at most, `movers` at the harmless ends of their ranges [cm^3/s]."""
    total = 0.0
    for j, effect in effects.items():
        ends = [float(effect.of(end[j])) for end in ranges]
        total += min(ends) if j in movers else max(ends)
    return total


def _able(base, tank, ranges, upper):
    """[inputs that keep a limit, those that close first]; [()] where it needs none."""
    h, others = (base.limit[tank], base.reach) if upper else (base.low[tank], base.bottom)
    effects = base.effects(tank, h, others, upper)
    rest = float(base.harmful(tank, h, others, upper))
    down = tuple(j for j, effect in effects.items() if not effect.up)
    up = tuple(j for j, effect in effects.items() if effect.up)
    sets = dict.fromkeys([(), down, up, tuple(effects)])
    slack = 1e-12 * abs(rest)
    return [m for m in sets if rest + _worst(effects, ranges, m) <= slack]


def _chosen(base, able):
    """{(tank, upper): inputs that its row moves}, if possible none that another row opposes."""
    chosen: dict = {}
    directions: dict = {}
    for (tank, upper), sets in sorted(able.items(), key=lambda item: len(item[1]) or 99):
        effects = base.effects(tank, base.limit[tank], np.zeros(base.least.tanks), upper)
        known = {j: directions.get(j, effect.up) == effect.up for j, effect in effects.items()}
        movers = next((m for m in sets if all(known[j] for j in m)), (sets or [tuple(effects)])[0])
        chosen[tank, upper] = movers
        directions |= {j: effects[j].up for j in movers if j not in directions}
    # of two rows that oppose each other the last holds: those that no input can keep come first
    return dict(sorted(chosen.items(), key=lambda item: (bool(able[item[0]]), item[0])))


def _step(base, tank, ranges, upper, hold):
    """Largest change of a level [cm] in a hold, of a tank with one cross-section."""
    h, others = (0.0, base.reach) if upper else (base.reach[tank], base.bottom)
    rate = float(base.harmful(tank, h, others, upper))
    rate += _worst(base.effects(tank, h, others, upper), ranges)
    return hold * max(rate, 0.0) / float(base.least.area[tank])


def _empty(base, ranges, step):
    """(n,) levels [cm] below which a tank may hold less than it gives in a step."""
    if not base.least.bottom:
        return np.zeros(base.least.tanks)
    found = []
    for i in range(base.least.tanks):
        levels = np.linspace(0.0, float(base.limit[i]), PARTS + 1)
        others = [jnp.zeros(len(levels))] * base.least.tanks
        gives = base.harmful(i, levels, others, False) + base.draw[i]
        for j, effect in base.effects(i, levels, others, False).items():
            gives = gives + jnp.maximum(0.0, jnp.maximum(*(effect.of(end[j]) for end in ranges)))
        holds = base._volume(i, 0.0, levels)
        short = np.flatnonzero(np.asarray(step * gives > holds))
        found.append(levels[min(short.max(initial=0) + 1, PARTS)])
    return np.array(found)
