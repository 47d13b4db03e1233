"""The box of plants and readings for which limits are to hold."""

import dataclasses
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from jaxtank.core.errors import InputError
from jaxtank.instruments.sensors import LevelSensor
from jaxtank.plants.tank_network import TankNetwork

SIGMAS = 6.0
"""Standard deviations of the sensor noise in the band."""

LEAST_SIGMAS = 5.0
"""Standard deviations of the noise below which a band of the user's own is not relied on."""


def box_of(plant: TankNetwork, widths: Mapping[str, ArrayLike]) -> tuple[TankNetwork, TankNetwork]:
    """Return the plants at the lower and the upper end of a box."""
    ends: tuple[dict, dict] = ({}, {})
    leaves = {f.name for f in dataclasses.fields(plant) if f.metadata.get("kind") == "leaf"}
    for name, width in widths.items():
        field, _, entry = name.removeprefix("plant.").partition("[")
        if "." in field or field == "x0":
            continue
        if field not in leaves:
            raise InputError(f"safety_filter: {name} is no parameter of this plant's flows")
        value = np.array(getattr(plant, field), dtype=float)
        half = np.zeros(value.shape)
        half[int(entry[:-1]) if entry else ...] = width
        for end, sign in zip(ends, (-1.0, 1.0)):
            end[field] = end.get(field, value) + sign * half
        if np.any(ends[0][field] < 0.0) or (
            field not in ("drain", "orifice", "pipe", "split", "caught")
            and np.any(ends[0][field] <= 0.0)
        ):
            raise InputError(f"safety_filter: the interval of {name} reaches below 0")
    for share in {"split", "caught"} & set(ends[1]):
        ends[1][share] = np.minimum(ends[1][share], 1.0)
    least, most = (dataclasses.replace(plant, **end) for end in ends)
    return least, most


COVERED = {
    "actuator": ("low", "high", "dead_zone", "stop", "pulse", "lag", "initial", "delay"),
    "sensor": ("noise", "offset", "gain", "full_scale"),
}
"""Leaves of instruments whose intervals the design counts with."""


def uncovered(widths: Mapping[str, ArrayLike]) -> list[str]:
    """Return the names of `widths` that the design does not count with."""
    fields = (name.split("[")[0].removeprefix("plant.") for name in widths)
    known = {f"{part}.{leaf}" for part, leaves in COVERED.items() for leaf in leaves}
    return [name for name, f in zip(widths, fields) if "." in f and f not in known]


def interval(part: Any, name: str, widths: Mapping[str, ArrayLike]) -> tuple:
    """Return the (least, largest) value of a leaf of an instrument, such as "actuator.lag"; 0 where
    it is not in use.
    """
    value = getattr(part, name.partition(".")[2], None)
    return spread(0.0 if value is None else value, name, widths)


def spread(value: ArrayLike, name: str, widths: Mapping[str, ArrayLike]) -> tuple:
    """Return the (least, largest) value of a parameter over a box."""
    value = np.array(value, dtype=float)
    half = np.zeros(value.shape)
    for key, width in widths.items():
        field, _, entry = key.partition("[")
        if field == name:
            half[int(entry[:-1]) if entry else ...] = width
    return value - half, value + half


def widths_of(part: Any, spread: Mapping[str, float]) -> dict[str, np.ndarray]:
    """Return the half widths of `box_of` for parameters of a plant or an instrument that may be off
    by a share of their value.
    """
    found = {}
    for name, share in spread.items():
        if not 0.0 <= share < 1.0:
            raise InputError(
                f"safety_filter: spread of {name} = {share:g}: must be from 0 to below 1"
            )
        field, _, entry = name.rpartition(".")[2].partition("[")
        value = np.abs(np.asarray(getattr(part, field, 0.0), dtype=float))
        found[name] = share * (value[int(entry[:-1])] if entry else value)
    return found


def narrow_band(
    sensor: LevelSensor, band: np.ndarray, unit: str, widths: Mapping[str, ArrayLike]
) -> list[str]:
    """Return for each tank why a band cannot be relied on, "" where it can."""
    least = band_of(sensor, LEAST_SIGMAS, widths) + 0.0 * band
    words = (
        f"below {LEAST_SIGMAS:g} standard deviations of the noise, half an ADC step and the offset"
    )
    return [
        f"noise band {b:.3g} {unit} {words}, {m:.3g} {unit}" if b < m * (1.0 - 1e-9) else ""
        for b, m in zip(band, least)
    ]


def band_of(
    sensor: LevelSensor,
    sigmas: float = SIGMAS,
    widths: Mapping[str, ArrayLike] = MappingProxyType({}),
) -> np.ndarray:
    """Return the (n,) band of readings [cm]: 6 standard deviations, half an ADC step, offset; each
    the largest over the box.
    """
    ends = lambda leaf: interval(sensor, f"sensor.{leaf}", widths)
    band = sigmas * ends("noise")[1]
    if sensor.offset is not None:
        band = band + np.maximum(*np.abs(ends("offset")))
    if sensor.bits:
        band = band + 0.5 * ends("gain")[1] * ends("full_scale")[1] / 2**sensor.bits
    return band


def top_of(
    sensor: LevelSensor, tanks: int, widths: Mapping[str, ArrayLike] = MappingProxyType({})
) -> np.ndarray:
    """Return the (n,) highest level that sensors read for certain [cm]; inf without an ADC."""
    if not sensor.bits:
        return np.full(tanks, np.inf)
    gain, full = (interval(sensor, f"sensor.{leaf}", widths)[0] for leaf in ("gain", "full_scale"))
    return gain * full
