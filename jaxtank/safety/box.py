"""The box of plants and readings for which limits are to hold."""

import dataclasses
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from jaxtank.core.errors import InputError
from jaxtank.core.tree import get_value, split_index
from jaxtank.instruments.sensors import LevelSensor
from jaxtank.plants.tank_network import TankNetwork

SIGMAS = 6.0  # standard deviations of the sensor noise in the band

LEAST_SIGMAS = 5.0
"""Standard deviations of the noise below which a band of the user's own is not relied on."""

COVERED = {  # leaves of instruments whose intervals the design counts with
    "actuator": ("low", "high", "dead_zone", "stop", "pulse", "lag", "initial", "delay"),
    "sensor": ("noise", "offset", "low", "high", "gain", "full_scale"),
}

Widths = Mapping[str, ArrayLike]
NONE: Widths = MappingProxyType({})


def box_of(plant: TankNetwork, widths: Widths) -> tuple[TankNetwork, TankNetwork]:
    """Return the plants at the lower and the upper end of a box."""
    ends: tuple[dict, dict] = ({}, {})
    fields = [f.name for f in dataclasses.fields(plant) if f.metadata.get("kind") == "leaf"]
    leaves = {name for name in fields if getattr(plant, name) is not None}
    for name, width in widths.items():
        field, entry = split_index(name.removeprefix("plant."))
        if "." in field or field == "x0":
            continue
        if field not in leaves:
            raise InputError(f"safety_filter: {name} is no parameter of this plant's flows")
        value = np.array(getattr(plant, field), dtype=float)
        half = np.zeros(value.shape)
        half[entry] = width
        for end, sign in zip(ends, (-1.0, 1.0)):
            end[field] = end.get(field, value) + sign * half
        may_be_zero = field in ("drain", "orifice", "pipe", "split", "caught")
        least = ends[0][field]
        if np.any(least < 0.0) or (not may_be_zero and np.any(least <= 0.0)):
            raise InputError(f"safety_filter: the interval of {name} reaches below 0")
    for share in {"split", "caught"} & set(ends[1]):
        ends[1][share] = np.minimum(ends[1][share], 1.0)
    least, most = (dataclasses.replace(plant, **end) for end in ends)
    return least, most


def uncovered(widths: Widths) -> list[str]:
    """Return the names of `widths` that the design does not count with."""
    covered = {f"{part}.{leaf}" for part, leaves in COVERED.items() for leaf in leaves}
    field = lambda name: split_index(name.removeprefix("plant."))[0]
    return [name for name in widths if "." in field(name) and field(name) not in covered]


def beyond_box(safety_filter: Any, ends: Mapping[str, tuple]) -> list[str]:
    """Return which of {"plant.drain[0]": (least, largest)} a safety filter was not designed for."""
    names: list[str] = []
    for name, (low, high) in ends.items():
        plants = (safety_filter.least, safety_filter.most)
        box = (get_value(plant, name.removeprefix("plant.")) for plant in plants)
        least, most = (np.asarray(v, dtype=float) for v in box)
        slack = 1e-12 * np.maximum(np.abs(least), np.abs(most))
        if np.any(np.asarray(low) < least - slack) or np.any(np.asarray(high) > most + slack):
            names.append(name)
    return names


def interval(part: Any, name: str, widths: Widths) -> tuple:
    """Return the (least, largest) value of a leaf such as "actuator.lag"; 0 where not in use."""
    value = getattr(part, name.partition(".")[2], None)
    return spread(0.0 if value is None else value, name, widths)


def spread(value: ArrayLike, name: str, widths: Widths) -> tuple:
    """Return the (least, largest) value of a parameter over a box."""
    value = np.array(value, dtype=float)
    half = np.zeros(value.shape)
    for key, width in widths.items():
        field, entry = split_index(key)
        if field == name:
            half[entry] = width
    return value - half, value + half


def intervals(widths: Widths, parts: Mapping[str, Any]) -> dict[str, tuple]:
    """Return {dotted name: (lower, upper)} of `widths`, but for the levels at t = 0."""
    ends: dict[str, tuple] = {}
    for name, width in widths.items():
        name = name if "." in name or name.startswith("x0") else f"plant.{name}"
        field, entry = split_index(name)
        part, _, leaf = field.partition(".")
        if part in parts:
            value = getattr(parts[part], leaf, None)
            value = np.asarray(0.0 if value is None else value, dtype=float)[entry]
            ends[name] = (value - np.asarray(width), value + np.asarray(width))
        elif field != "x0":
            ends[name] = (0.0, 0.0)
    return ends


def widths_of(part: Any, spread: Mapping[str, float]) -> dict[str, np.ndarray]:
    """Return the half widths of `box_of` for parameters that may be off by a share."""
    widths = {}
    for name, share in spread.items():
        if not 0.0 <= share < 1.0:
            spread_of = f"safety_filter: spread of {name}"
            raise InputError(f"{spread_of} = {share:g}: must be from 0 to below 1")
        field, entry = split_index(name.rpartition(".")[2])
        value = np.abs(np.asarray(getattr(part, field, 0.0), dtype=float))
        widths[name] = share * value[entry]
    return widths


def narrow_band(sensor: LevelSensor, band: np.ndarray, unit: str, widths: Widths) -> list[str]:
    """Return for each tank why a band cannot be relied on, "" where it can."""
    least = band_of(sensor, LEAST_SIGMAS, widths) + 0.0 * band
    words = (
        f"{LEAST_SIGMAS:g} standard deviations of the noise, half an ADC step, the offset and the"
        " lower end of the span"
    )
    reason = lambda b, m: f"noise band {b:.3g} {unit} below {words}, {m:.3g} {unit}"
    return [reason(b, m) if b < m * (1.0 - 1e-9) else "" for b, m in zip(band, least)]


def band_of(sensor: LevelSensor, sigmas: float = SIGMAS, widths: Widths = NONE) -> np.ndarray:
    """Return the (n,) band of readings [cm]: noise, ADC, offset, lower end; largest of the box."""
    ends = lambda leaf: interval(sensor, f"sensor.{leaf}", widths)
    band = sigmas * ends("noise")[1]
    if sensor.offset is not None:
        band = band + np.maximum(*np.abs(ends("offset")))
    if sensor.low is not None:  # what is read of an empty tank
        band = band + np.maximum(ends("low")[1], 0.0)
    if sensor.bits and sensor.low is not None and sensor.high is not None:
        band = band + 0.5 * (ends("high")[1] - ends("low")[0]) / 2**sensor.bits
    elif sensor.bits:
        band = band + 0.5 * ends("gain")[1] * ends("full_scale")[1] / 2**sensor.bits
    return band


def top_of(sensor: LevelSensor, tanks: int, widths: Widths = NONE) -> np.ndarray:
    """Return the (n,) highest level that sensors read for certain [cm]; inf without an end."""
    least = lambda leaf: interval(sensor, f"sensor.{leaf}", widths)[0]
    top = np.full(tanks, np.inf) if sensor.high is None else least("high") + np.zeros(tanks)
    if sensor.bits and (sensor.low is None or sensor.high is None):
        top = np.minimum(top, least("gain") * least("full_scale"))
    return top
