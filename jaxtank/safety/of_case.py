"""A safety filter for a case: its box of plants, its limits and its disturbances.

May be imported by `jaxtank.case` and everything above it.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
import scipy  # its parts are imported when they are first used
from numpy.typing import ArrayLike

from jaxtank.core.errors import InputError
from jaxtank.instruments.sensors import LevelSensor
from jaxtank.plants.tank_network import TankNetwork
from jaxtank.safety.box import widths_of
from jaxtank.safety.certificate import TankCertificate, design
from jaxtank.safety.filter import SafetyFilter
from jaxtank.signals.inflows import InflowPulses

FLOWS = ("drain", "orifice", "pipe", "pump_gain", "split")
SPREAD = 0.05
"""Share by which every flow may be off where a case does not say what is uncertain."""
PROBABILITY = 0.99
"""Share of a normal distribution in the ellipsoid whose box stands for a covariance."""


def design_for(
    case: Any,
    *,
    widths: Mapping[str, ArrayLike] | None = None,
    limit: ArrayLike | None = None,
    band: ArrayLike | None = None,
    rate: float | None = None,
    low: ArrayLike | None = None,
    predict: bool = True,
) -> tuple[SafetyFilter, tuple[TankCertificate, ...]]:
    """Return a safety filter for a case, and the certificate of each tank.

    Parameters
    ----------
    case : jaxtank.Case
    widths : {parameter of the plant: half width of its interval, in its unit}, the box of plants;
        left out: `case.uncertain`, or the box of 99 % of `case.covariance`, or 5 % of every flow
    limit : (n,) levels not to be passed [cm]; left out: the limit on max_level, else the rims
    band : (n,) largest difference of reading and level [cm]; left out: 6 standard deviations of the
        noise, half an ADC step and the offset
    rate : kappa, how fast a level may approach its limit [1/s]
    low : (n,) levels below which no tank may fall [cm], 0: none; left out: the limit on min_level,
        else none
    predict : predict levels over the inputs under way where that is proved (see `design`)

    Returns
    -------
    (SafetyFilter, TankCertificate of each tank)

    Raises
    ------
    InputError
        where the plant is no TankNetwork, the sensor no LevelSensor, or a value is out of its range

    Examples
    --------
    >>> from jaxtank import presets
    >>> found, rows = design_for(presets.find("gouta2015/ngpc"))
    >>> [round(float(k), 3) for k in found.slope[:2]], [row.certified for row in rows]
    ([0.19, 0.19], [True, True, True, True])
    """
    loop = case.loop
    if not isinstance(loop.plant, TankNetwork) or not isinstance(loop.sensor, LevelSensor):
        raise InputError("safety_filter: needs a TankNetwork as the plant and a LevelSensor")
    inflow, volume = _disturbances(loop, case.clock)
    draw, drawn = _withdrawn(loop, case.clock)
    share = max((s for n, s in case.uncertain.items() if n == "actuator.dead_zone"), default=0.0)
    return design(
        loop.plant,
        loop.actuator,
        loop.sensor,
        case.clock.dt,
        widths=_widths(case) if widths is None else widths,
        limit=_level_limits(case) if limit is None else limit,
        inflow=inflow,
        volume=volume,
        offset=np.asarray(loop.actuator.offset) * (1.0 - share),
        band=band,
        rate=rate,
        substeps=case.clock.substeps,
        start=loop.x0,
        low=case.limits.get("min_level", 0.0) if low is None else low,
        draw=draw,
        drawn=drawn,
        predict=predict,
        faults=loop.faults,
    )


def _widths(case):
    """{parameter: half width} of the box of plants that the case itself describes."""
    if case.covariance is not None:
        names, matrix = case.covariance
        flows = [i for i, n in enumerate(names) if n.startswith("plant.")]
        sigma = np.sqrt(np.diag(np.asarray(matrix, dtype=float)))[flows]
        reach = np.sqrt(2.0 * scipy.special.gammaincinv(0.5 * max(len(flows), 1), PROBABILITY))
        return {names[i]: reach * s for i, s in zip(flows, sigma)}
    shares = {n: s for n, s in case.uncertain.items() if n.startswith("plant.")}
    return widths_of(case.loop.plant, shares or dict.fromkeys(FLOWS, SPREAD))


def _level_limits(case):
    """(n,) upper limits on the levels of a case [cm]: of max_level, or the rims."""
    rim = np.asarray(case.loop.plant.rim, dtype=float)
    limit = case.limits.get("max_level", "rim")
    return rim if isinstance(limit, str) else np.minimum(rim, np.asarray(limit, dtype=float))


def _disturbances(loop, clock):
    """((n,) largest inflow [cm^3/s], (n,) volume that comes in pulses besides [cm^3])."""
    none = np.zeros(loop.plant.tanks)
    if loop.disturbance is None:
        return none, none
    if isinstance(loop.disturbance, InflowPulses):
        volume = none.copy()
        for added, (_, _, tank) in zip(loop.disturbance.volume, loop.disturbance.events):
            volume[tank] += max(float(added), 0.0)
        return none, volume
    flows = loop.disturbance.sample(clock)[0]
    return np.array([max(float(np.max(flow)), 0.0) for flow in flows]), none


def _withdrawn(loop, clock):
    """((n,) least inflow, 0 or negative [cm^3/s], whether inflow pulses draw liquid)."""
    none = np.zeros(loop.plant.tanks)
    if loop.disturbance is None:
        return none, False
    if isinstance(loop.disturbance, InflowPulses):
        return none, bool(np.any(np.asarray(loop.disturbance.volume) < 0.0))
    flows = loop.disturbance.sample(clock)[0]
    return np.array([min(float(np.min(flow)), 0.0) for flow in flows]), False


def beyond(case: Any) -> list[str]:
    """Return the names of [uncertain] whose intervals are wider than those in the settings of the
    case's safety filter, which take their place.
    """
    guard = case.loop.safety_filter
    if guard is None or "widths" not in (case.safety or {}):
        return []
    found = []
    for name in (name for name in case.uncertain if name.startswith("plant.")):
        field, _, entry = name.removeprefix("plant.").partition("[")
        at = int(entry[:-1]) if entry else ...
        own, least, most = (
            np.asarray(getattr(plant, field), dtype=float)[at]
            for plant in (case.loop.plant, guard.least, guard.most)
        )
        half = case.uncertain[name] * own * (1.0 - 1e-9)
        if np.any(own - half < least) or np.any(own + half > most):
            found.append(name)
    return found
