"""A safety filter for a case: its box of plants, its limits and its disturbances."""

import dataclasses
from collections.abc import Mapping
from typing import Any

import jax
import numpy as np
import scipy  # its parts are imported when they are first used
from numpy.typing import ArrayLike

from jaxtank.core.clock import Clock
from jaxtank.core.errors import InputError
from jaxtank.core.tree import split_index
from jaxtank.instruments.sensors import LevelSensor
from jaxtank.plants.elements import features
from jaxtank.plants.tank_network import TankNetwork
from jaxtank.safety.box import spread, widths_of
from jaxtank.safety.certificate import TankCertificate, design
from jaxtank.safety.filter import SafetyFilter
from jaxtank.safety.known_features import HARMLESS
from jaxtank.safety.outlet_design import outlet_design
from jaxtank.safety.outlets import OutletFilter
from jaxtank.signals.inflows import InflowPulses

FLOWS = ("drain", "orifice", "pipe", "pump_gain", "split", "valve")
"""Leaves of a plant that may change in time: the volume in a tank does not depend on them."""
UNKNOWN = (*FLOWS, "extent")  # leaves that are uncertain by SPREAD where a case names none
SPREAD = 0.05  # share by which every flow may be off where a case does not say what is uncertain
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
) -> tuple[SafetyFilter | OutletFilter, tuple[TankCertificate, ...]]:
    """Return a safety filter for a case, and the certificate of each tank.

    Parameters
    ----------
    case : jaxtank.Case
    widths : {parameter of the plant: half width of its interval, in its unit}, the box of plants;
        left out: `case.uncertain`, or the box of 99 % of `case.covariance`, or 5 % of every flow.
        What `case.uncertain` has of pumps, sensors, starts and disturbances counts in any case
    limit : (n,) levels not to be passed [cm]; left out: the limit on max_level, else the rims
    band : (n,) largest difference of reading and level [cm]; left out: 6 standard deviations of the
        noise, half an ADC step, the offset and the lower end of the span
    rate : kappa, how fast a level may approach its limit [1/s]
    low : (n,) levels below which no tank may fall [cm], 0: none; left out: the limit on min_level,
        else none
    predict : predict levels over the inputs under way where that is proved (see `design`)

    Returns
    -------
    (SafetyFilter, or OutletFilter of a rig with outlets; TankCertificate of each tank)

    Raises
    ------
    InputError
        where the plant is no TankNetwork, the sensor no LevelSensor, or a value is out of its range

    Examples
    --------
    >>> from jaxtank import presets
    >>> safety_filter, rows = design_for(presets.find("gouta2015/ngpc"))
    >>> [round(float(k), 3) for k in safety_filter.slope[:2]], [row.certified for row in rows]
    ([0.19, 0.19], [True, True, True, True])
    """
    loop = case.loop
    if not isinstance(loop.plant, TankNetwork) or not isinstance(loop.sensor, LevelSensor):
        raise InputError("safety_filter: needs a TankNetwork as the plant and a LevelSensor")
    if loop.sensor.curve_level is not None:
        raise InputError(
            "safety_filter: not covered: curve of [[sensor]]; give readings as levels, without it"
        )
    box, more = _box(case, widths)
    draw, inflow, volume, draws = inflow_bounds(loop, case.clock)
    rim, top = spread(loop.plant.rim, "plant.rim", box)[0], case.limits.get("max_level", "rim")
    if limit is None:
        limit = rim if isinstance(top, str) else np.minimum(rim, np.asarray(top, dtype=float))
    settings = {
        "widths": box,
        "limit": limit,
        "inflow": inflow * more,
        "volume": volume * more,
        "band": band,
        "rate": rate,
        "substeps": case.clock.substeps,
        "start": loop.x0,
        "low": np.maximum(case.limits.get("min_level", 0.0), 0.0) if low is None else low,
        "draw": draw * more,
        "draws": draws,
        "faults": loop.faults,
    }
    safety_filter, rows = _design(loop, case.clock.dt, settings, predict)
    names = [] if widths is None else _beyond(case, safety_filter)
    if names:
        reason = f"not covered: {', '.join(names)} beyond the widths of the filter"
        rows = tuple(_not_proved(row, reason) for row in rows)
    return safety_filter, rows


def _design(loop, hold, settings, predict):
    """(filter, certificates); an OutletFilter of a rig with elements, or where it proves more."""
    rig = loop.plant, loop.actuator, loop.sensor, hold
    if features(loop.plant):
        return outlet_design(*rig, **settings)
    answer = design(*rig, **settings, predict=predict)
    if not np.any(np.asarray(loop.actuator.low) < 0.0):
        return answer
    proved = lambda rows: sum(row.certified + row.low_certified for row in rows)
    other = outlet_design(*rig, **settings)
    return other if proved(other[1]) > proved(answer[1]) else answer


def certificates_of(case: Any) -> tuple[TankCertificate, ...]:
    """Return the certificates of the filter in the loop; without one, of the filter that fits it.

    A filter whose numbers were changed after its design is not certified.
    """
    safety_filter, rows = design_for(case, **(case.safety or {}))
    present = case.loop.safety_filter
    if present is None or _equal(present, safety_filter):
        return rows
    reason = "not covered: a filter that was not designed for this rig (with_safety_filter)"
    return tuple(_not_proved(row, reason) for row in rows)


def _not_proved(row, reason):
    """The certificate of a tank without its claims."""
    low = {"low_certified": False, "low_reason": reason} if row.low_certified else {}
    upper = {"certified": False, "starts": "", "reason": reason} if row.certified else {}
    return dataclasses.replace(row, **upper, **low)


def _equal(first, second):
    """Whether two filters have the same structure and, to rounding, the same numbers."""
    (a, structure), (b, other) = jax.tree.flatten(first), jax.tree.flatten(second)
    near = lambda x, y: np.allclose(x, y, rtol=1e-9, atol=0.0, equal_nan=True)
    same = lambda x, y: np.shape(x) == np.shape(y) and near(x, y)
    return structure == other and all(map(same, a, b))


def _box(case, widths):
    """({parameter: half width} of the case's box, `widths` for the plant's, factor on inflows)."""
    box = {}
    if case.covariance is not None:  # the ellipsoid of estimates that holds with PROBABILITY
        names, matrix = case.covariance
        at = [i for i, name in enumerate(names) if not name.startswith(HARMLESS)]
        sigma = np.sqrt(np.diag(np.asarray(matrix, dtype=float)))[at]
        reach = np.sqrt(2.0 * scipy.special.gammaincinv(0.5 * max(len(at), 1), PROBABILITY))
        box = dict(zip([names[i] for i in at], reach * sigma))
    if widths is None:
        for name, half in widths_of(case.loop.plant, _plant_shares(case)).items():
            box[name] = np.maximum(half, box.get(name, 0.0))
    else:
        box = {n: w for n, w in box.items() if not n.startswith("plant.")} | dict(widths)
    more = 1.0
    for name, share in dict(case.uncertain).items():
        field, _ = split_index(name)
        part = field.rpartition(".")[0]
        if name.startswith(("plant.", *HARMLESS)) or name in box:
            continue
        if field in ("disturbance.level", "disturbance.volume"):  # linear in both
            more = max(more, 1.0 + share)
            continue
        owner = case.loop if name.startswith("x0") else getattr(case.loop, part, None)
        box |= widths_of(owner, {name: share})
    return box, more


def _plant_shares(case):
    """{parameter of the plant: share by which it is uncertain}."""
    shares = {n: s for n, s in dict(case.uncertain).items() if n.startswith("plant.")}
    if shares or case.covariance is not None:  # what a covariance leaves out is exact
        return shares
    return {name: SPREAD for name in UNKNOWN if getattr(case.loop.plant, name) is not None}


def inflow_bounds(loop: Any, clock: Clock) -> tuple[Any, Any, Any, bool]:
    """((n,) least inflow <= 0, (n,) largest [cm^3/s], (n,) volume of pulses [cm^3], any draws)."""
    none = np.zeros(loop.plant.tanks)
    if loop.disturbance is None:
        return none, none, none, False
    if isinstance(loop.disturbance, InflowPulses):
        volume, added = none.copy(), np.asarray(loop.disturbance.volume)
        for entering, (_, _, tank) in zip(added, loop.disturbance.events):
            volume[tank] += max(float(entering), 0.0)
        return none, none, volume, bool(np.any(added < 0.0))
    flows = [np.asarray(flow) for flow in loop.disturbance.sample(clock)[0]]
    least = np.array([min(float(np.min(flow)), 0.0) for flow in flows])
    return least, np.array([max(float(np.max(flow)), 0.0) for flow in flows]), none, False


def _beyond(case, safety_filter):
    """Names of the plant's parameters that the case calls uncertain beyond the box of a filter."""
    if case.covariance is None and not any(n.startswith("plant.") for n in case.uncertain):
        return []
    beyond = []
    for name, half in _box(case, None)[0].items():
        part, _, leaf = name.partition(".")
        if part != "plant":
            continue
        field, entry = split_index(leaf)
        plants = case.loop.plant, safety_filter.least, safety_filter.most
        leaves = (np.asarray(getattr(plant, field), dtype=float) for plant in plants)
        value, least, most = (leaf[entry] for leaf in leaves)
        half = np.asarray(half) * (1.0 - 1e-9)
        top = np.minimum(value + half, 1.0) if field in ("split", "caught") else value + half
        if np.any(value - half < least) or np.any(top > most):
            beyond.append(name)
    return beyond
