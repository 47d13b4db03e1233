"""Building a `TankNetwork` from plain numbers, and checking its topology."""

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np
from jax.core import Tracer
from numpy.typing import ArrayLike

from jaxtank.core.checks import check_value
from jaxtank.core.errors import InputError
from jaxtank.core.tree import number
from jaxtank.core.units import DEFAULT, check_units
from jaxtank.plants.base import Plant
from jaxtank.plants.hydraulics import default_gravity, default_threshold
from jaxtank.plants.tank_network import TankNetwork

SURPLUS = 1e-6
"""Margin by which the shares `caught` of one tank may exceed 1 in sum: rounding in float32."""


def check_caught(plant: Plant, name: str = "plant") -> None:
    """Check that no tank's overflow is caught more than once: volume would come from nowhere."""
    shares: Any = getattr(plant, "caught", None)
    if isinstance(shares, Tracer) or np.ndim(shares) != 1:
        return
    spills: tuple = getattr(plant, "spills", ())
    for tank in dict.fromkeys(source for source, _ in spills):
        parts = [float(share) for share, (source, _) in zip(shares, spills) if source == tank]
        if sum(parts) > 1.0 + SURPLUS:
            raise InputError(
                f"{name}.caught: the {len(parts)} spills of tank {tank + 1} catch"
                f" {' + '.join(f'{v:g}' for v in parts)} = {sum(parts):g} of what passes its rim:"
                " must be from 0 to 1 in sum"
            )


def network(
    *,
    area: ArrayLike,
    drain: ArrayLike,
    pump_gain: ArrayLike,
    feeds: Sequence,
    rim: ArrayLike,
    links: Sequence = (),
    orifice: ArrayLike = (),
    pipes: Sequence = (),
    pipe: ArrayLike = (),
    spills: Sequence = (),
    caught: ArrayLike = (),
    split: ArrayLike | None = None,
    gravity: float | None = None,
    outputs: Sequence[int] = (0,),
    overflow: bool = False,
    bottom: bool = False,
    units: tuple[str, str] = DEFAULT,
    knee: float | None = None,
) -> TankNetwork:
    """Return a `TankNetwork` built from plain numbers; a number fills an array.

    Parameters
    ----------
    area, drain, rim : (n,) cross-section [cm^2], outlet to the basin [cm^2] and height [cm]
    pump_gain, split : (m,) flow per unit of input [cm^3/(s V)], and its share to the first tank [-]
    feeds : m pairs (first tank, second tank or None), tanks counted from 0
    links, orifice : pairs (from, to) of tanks, and the area of the orifice of each [cm^2]
    pipes, pipe : pairs (one, other) of tanks, and the area of the pipe of each [cm^2]
    spills, caught : pairs (from, to), and the share of the overflow that falls into `to` [-]
    gravity : acceleration [cm/s^2]; 981 cm/s^2 in the length of `units` where None
    outputs : tanks whose levels are controlled, counted from 0
    overflow, bottom : as in `TankNetwork`
    units : (length, pump input), in which the other numbers are then given
    knee : laminar threshold [cm]; 0.01 cm in the length of `units` where None

    Returns
    -------
    TankNetwork

    Raises
    ------
    InputError where shapes and topology do not agree, and for no gravity beside levels in volts.

    Examples
    --------
    >>> rig = network(
    ...     area=15.0,
    ...     drain=[0.2, 0.2],
    ...     links=[(1, 0)],
    ...     orifice=0.1,
    ...     pump_gain=5.0,
    ...     feeds=[(1, None)],
    ...     rim=30.0,
    ... )
    >>> rig.tanks, rig.area
    (2, array([15., 15.]))
    """
    units = check_units("plant.units", units)
    feeds = tuple((int(a), None if b is None else int(b)) for a, b in feeds)
    links, pipes, spills = (
        tuple((int(a), int(b)) for a, b in pairs) for pairs in (links, pipes, spills)
    )
    joined = {"links": links, "pipes": pipes, "spills": spills, "feeds": feeds}
    n = np.size(area) if np.ndim(area) else 1 + _last_tank(joined)
    _check_tanks({**joined, "outputs": [outputs]}, n)
    m = len(feeds)
    plant = TankNetwork(
        area=_fitted("plant.area", area, n),
        drain=_fitted("plant.drain", drain, n),
        orifice=_fitted("plant.orifice", orifice, len(links)),
        pipe=_fitted("plant.pipe", pipe, len(pipes)),
        pump_gain=_fitted("plant.pump_gain", pump_gain, m),
        split=_fitted("plant.split", 1.0 if split is None else split, m),
        gravity=number(default_gravity(units[0]) if gravity is None else gravity),
        rim=_fitted("plant.rim", rim, n),
        caught=_fitted("plant.caught", caught, len(spills)),
        links=links,
        pipes=pipes,
        feeds=feeds,
        spills=spills,
        outputs=tuple(int(i) for i in outputs),
        overflow=bool(overflow),
        bottom=bool(bottom),
        units=tuple(units),
        knee=_threshold(knee, units[0]),
    )
    check_caught(plant)
    return plant


def _last_tank(joined: dict[str, Sequence]) -> int:
    """The highest tank that an orifice, pipe, overflow or pump names; 0 without any."""
    named = (i for pairs in joined.values() for pair in pairs for i in pair if i is not None)
    return max(named, default=0)


def _check_tanks(named: dict[str, Sequence], n: int) -> None:
    """Raise InputError for a tank that does not exist."""
    for name, groups in named.items():
        for i in (i for group in groups for i in group if i is not None):
            if not 0 <= i < n:
                raise InputError(f"plant.{name} names tank {i}: there are {n}, counted from 0")


def _fitted(name: str, value: ArrayLike, size: int) -> np.ndarray:
    """`value` as an array (size,); a number fills it."""
    array = number(value)
    if array.ndim == 0:
        return np.full(size, array)
    if array.shape != (size,):
        raise InputError(
            f"{name} has {array.size} entries for {size}; give one each, or one number for all"
        )
    return array


def _threshold(value: float | None, length: str) -> float:
    """The laminar threshold of a rig, checked; the default in its unit of length where None."""
    value = float(default_threshold(length) if value is None else value)
    meta = next(f.metadata for f in dataclasses.fields(TankNetwork) if f.name == "knee")
    check_value("plant.knee", value, {**meta, "unit": length})
    return value
