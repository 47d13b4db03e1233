"""The closed list of features of a loop that the independent checkers know, and their readings."""

import dataclasses
from collections.abc import Iterable, Mapping
from itertools import chain
from typing import Any, NamedTuple

import numpy as np

from jaxtank.instruments.actuators import PumpBank
from jaxtank.instruments.sensors import LevelSensor
from jaxtank.plants.faults import Faults
from jaxtank.plants.tank_network import TankNetwork

FLOWS = ("area", "drain", "orifice", "pipe", "pump_gain", "split", "gravity")
SHAPE = ("links", "pipes", "feeds", "spills", "overflow", "bottom", "knee")
KNOWN = {
    "plant": {*FLOWS, *SHAPE, "rim", "caught", "outputs", "units", "names"},
    "actuator": {"low", "high", "dead_zone", "stop", "pulse", "lag", "initial", "delay"}
    | {"saturation", "dead_zone_kind"},
    "sensor": {"gain", "noise", "offset", "low", "high", "full_scale", "bits", "display"},
    "faults": {"factor", "extra", "windows"},
    "safety_filter": {"least", "most", "limit", "reach", "rate", "band", "inflow", "slope"}
    | {"spare", "age", "offset", "low", "bottom", "draw", "held", "kept", "predicted", "substeps"}
    | {"allocate", "divided", "running"},
}
"""{part: fields that the checker knows}; a field that is not listed must be None, False or ()."""
ABSENT = ("filter",)  # fields that are as good as None where all their entries are 0
CLASSES = {"plant": TankNetwork, "actuator": PumpBank, "sensor": LevelSensor, "faults": Faults}
UNCERTAIN = {
    *(f"plant.{name}" for name in (*FLOWS, "rim", "caught")),
    *(f"actuator.{name}" for name in ("low", "high", "dead_zone", "stop", "pulse", "lag")),
    *("actuator.initial", "actuator.delay", "x0"),
    *(f"sensor.{name}" for name in ("noise", "offset", "low", "high", "gain", "full_scale")),
}


SIGMAS = 5.0  # standard deviations of the noise that a band must have at least


class Known(NamedTuple):
    """What a checker knows; `fixed`: fields in which the filter's two plants equal the plant."""

    filter: tuple[str, str]
    fields: Mapping[str, set[str]]
    uncertain: set[str]
    static: tuple[str, ...] = ()
    fixed: tuple[str, ...] = ()


PLAIN = Known(("jaxtank.safety.filter", "SafetyFilter"), KNOWN, UNCERTAIN)
STATIC = ("sources", "curves", "lift_curves", "valves", "characteristics", "one_way", "shapes")
FIXED = ("rangeability", "spill_port", "valve_port", "pipe_port")
FIXED += ("drain_port", "drain_exponent", "drain_resistance")
FIXED += ("orifice_port", "orifice_exponent", "orifice_resistance")
OUTLETS = Known(
    filter=("jaxtank.safety.outlets", "OutletFilter"),
    fields={
        "plant": {*KNOWN["plant"], *STATIC, *FIXED, "valve", "extent"},
        "actuator": KNOWN["actuator"],
        "sensor": KNOWN["sensor"],
        "faults": KNOWN["faults"],
        "safety_filter": {"least", "most", "limit", "low", "reach", "bottom", "rate", "band"}
        | {"inflow", "draw", "climb", "drop", "empty", "upper_rows", "low_rows", "predicted"},
    },
    uncertain={
        *(f"plant.{name}" for name in (*FLOWS, "rim", "valve", "extent")),
        *(name for name in UNCERTAIN if name.startswith("sensor.")),
        "x0",
    },
    static=(*SHAPE, *STATIC),
    fixed=FIXED,
)
HARMLESS = ("controller.", "observer.", "reference.")
"""Prefixes of uncertain parameters that do not affect the limits: these hold for any controller."""


def first_failure(conditions: Iterable[tuple[Any, str]]) -> str:
    """The reason of the first of [(holds, reason)] that does not hold, or ""."""
    return next((why for holds, why in conditions if not holds), "")


def unknown_feature(parts: Mapping[str, Any], box: Mapping[str, Any], known: Known = PLAIN) -> str:
    """The first feature that is not on the closed list, or a number that is none; or ""."""
    return first_failure(chain(_features(parts, known), _known_names(box, known)))


def _features(parts, known):
    """(holds, reason) of the classes of all parts, and of their fields."""
    for part, kind in CLASSES.items():
        value = parts.get(part)
        if part in parts:
            yield type(value) is kind, f"not covered: {part} of class {type(value).__name__}"
    safety_filter = parts["safety_filter"]
    kind = type(safety_filter)
    same = (kind.__module__, kind.__name__) == known.filter
    yield same, f"not covered: safety filter of class {kind.__name__}"
    ends = {f"safety_filter.{end}": getattr(safety_filter, end) for end in ("least", "most")}
    for end, plant in ends.items():
        yield type(plant) is TankNetwork, f"not covered: {end} of class {type(plant).__name__}"
    for part, value in {**parts, **ends}.items():
        fields = known.fields["plant" if part in ends else part]
        for name in (field.name for field in dataclasses.fields(value)):
            entry = getattr(value, name)
            yield name in fields or _is_absent(name, entry), f"not covered: {part}.{name}"
            number = name not in fields or not _has_nan(entry)
            yield number, f"not covered: {part}.{name} is no number"


def _is_absent(name, entry):
    """Whether a field that is not on the list has no effect."""
    neutral = entry is None or entry is False or (isinstance(entry, tuple) and not entry)
    return neutral or (name in ABSENT and not np.any(entry))


def _known_names(box, known):
    for name, interval in box.items():
        covered = name.partition("[")[0] in known.uncertain or name.startswith(HARMLESS)
        yield covered, f"not covered: uncertain {name}"
        yield not any(map(_has_nan, interval)), f"not covered: uncertain {name} is no number"


def span_of(box, name, value):
    """(lower, upper) of a leaf over the {name or name[i]: (lower, upper)} of a box."""
    value = np.asarray(0.0 if value is None else value, dtype=float)
    low, high = value.copy(), value.copy()
    for other, (lower, upper) in box.items():
        base, _, entry = other.partition("[")
        if base == name:
            at = int(entry.rstrip("]")) if entry else ...
            low[at] = np.minimum(low[at], np.asarray(lower, dtype=float))
            high[at] = np.maximum(high[at], np.asarray(upper, dtype=float))
    return low, high


def _has_nan(entry):
    if entry is None or isinstance(entry, tuple):  # left out; pairs of tanks
        return False
    try:
        return bool(np.isnan(np.asarray(entry, dtype=float)).any())
    except (TypeError, ValueError):  # names, another component
        return False


def readable(sensor, span, full):
    """((n,) least band, (n,) highest level that is read for certain [cm])."""
    names = ("noise", "offset", "low", "high", "gain", "full_scale")
    ends = {name: span(f"sensor.{name}", getattr(sensor, name)) for name in names}
    needed = full(SIGMAS * ends["noise"][1]) + np.maximum(*map(np.abs, ends["offset"]))
    top = full(np.inf if sensor.high is None else ends["high"][0])
    if sensor.low is not None:  # a lower level is read as this one
        needed = needed + np.maximum(full(ends["low"][1]), 0.0)
    if sensor.bits and sensor.low is not None and sensor.high is not None:
        needed = needed + 0.5 * full(ends["high"][1] - ends["low"][0]) / 2**sensor.bits
    elif sensor.bits:
        gain, scale = ends["gain"], ends["full_scale"]
        needed = needed + 0.5 * full(gain[1]) * scale[1] / 2**sensor.bits
        top = np.minimum(top, full(gain[0]) * scale[0])
    return needed, top
