"""The box of plants and readings for which limits are to hold.

May be imported by the rest of `jaxtank.safety`.
"""

import dataclasses
from collections.abc import Mapping

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


def narrow_band(sensor: LevelSensor, band: np.ndarray, unit: str) -> list[str]:
    """Return for each tank why a band cannot be relied on, "" where it can.

    band : (n,) largest difference of reading and level that is assumed [cm].
    """
    least = band_of(sensor, LEAST_SIGMAS) + 0.0 * band
    words = (
        f"below {LEAST_SIGMAS:g} standard deviations of the noise, half an ADC step and the offset"
    )
    return [
        f"noise band {b:.3g} {unit} {words}, {m:.3g} {unit}" if b < m * (1.0 - 1e-9) else ""
        for b, m in zip(band, least)
    ]


def band_of(sensor: LevelSensor, sigmas: float = SIGMAS) -> np.ndarray:
    """Return the (n,) band of readings [cm]: 6 standard deviations, half an ADC step, offset."""
    band = sigmas * np.asarray(sensor.noise, dtype=float)
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
