"""Building a `TankNetwork` from plain numbers, and checking its topology."""

import dataclasses
import functools
from collections.abc import Mapping, Sequence
from types import MappingProxyType
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
    sources: Sequence = (),
    curves: Sequence = (),
    lift_curves: Sequence = (),
    valves: Sequence = (),
    valve: ArrayLike = (),
    characteristics: Sequence | str = "linear",
    rangeability: ArrayLike = 50.0,
    one_way: Sequence[bool] | bool = False,
    shapes: Sequence = (),
    extent: ArrayLike | None = None,
    ports: Mapping[str, ArrayLike] = MappingProxyType({}),
    exponents: Mapping[str, ArrayLike] = MappingProxyType({}),
    resistances: Mapping[str, ArrayLike] = MappingProxyType({}),
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
    feeds : m pairs (first tank, second tank or None), tanks counted from 0; (None, None) for a pump
        that only takes out
    links, orifice : pairs (from, to) of tanks, and the area of the orifice of each [cm^2]
    pipes, pipe : pairs (one, other) of tanks, and the area of the pipe of each [cm^2]
    spills, caught : pairs (from, to), and the share of the overflow that falls into `to` [-]
    sources : the tank from which each pump draws, None for the basin
    curves : of each pump None, or ((input, flow), ...): its flow is pump_gain times the curve
    lift_curves : of each pump None, or ((lift [cm], share of the flow), ...): lift is the level
        that it pumps to less the level that it draws from
    valves, valve : pairs (from, to or None), and the area full open [cm^2]; valves are the inputs
        after those of the pumps
    characteristics, rangeability : of each valve "linear", "equal-percentage" or ((opening, share),
        ...), and the ratio of flows full open and closed of an equal-percentage one [-]
    one_way : whether a valve lets nothing back
    shapes, extent : of each tank "prism" or another shape of `jaxtank.plants.vessels`, and the
        level at which it ends [cm]; area is then the largest cross-section
    ports : heights of openings above the bottom [cm], {"drain", "orifice", "pipe", "valve",
        "spill": an entry each}
    exponents : of the head in the flow of "drain" and "orifice" [-]; 0.5 is Torricelli's
    resistances : R of a flow head/R in parallel to "drain" and "orifice" [s/cm^2]
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
    joined = _joined(links, pipes, spills, feeds, valves)
    links, pipes, spills, feeds, valves = joined.values()
    sources = tuple(map(_tank, sources))
    joined["sources"] = [(source,) for source in sources]
    named = (i for pairs in joined.values() for pair in pairs for i in pair if i is not None)
    n = np.size(area) if np.ndim(area) else 1 + max(named, default=0)
    _check_tanks({**joined, "outputs": [outputs]}, n)
    _check_feeds(feeds, sources, lift_curves)
    m, sizes = len(feeds), {"drain": n, "orifice": len(links), "pipe": len(pipes)}
    sizes |= {"spill": len(spills), "valve": len(valves)}
    options = _options(sizes, port=ports, exponent=exponents, resistance=resistances)
    for_valves = functools.partial(_fitted, size=len(valves)) if valves else lambda *_: None
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
        valve=for_valves("plant.valve", valve),
        rangeability=for_valves("plant.rangeability", rangeability),
        extent=None if extent is None else _fitted("plant.extent", extent, n),
        **options,
        links=joined["links"],
        pipes=joined["pipes"],
        feeds=joined["feeds"],
        sources=sources if set(sources) - {None} else (),
        curves=_points(curves),
        lift_curves=_points(lift_curves),
        valves=joined["valves"],
        characteristics=_names_or_points(_each(characteristics, len(valves))),
        one_way=tuple(map(bool, _each(one_way, len(valves)))),
        shapes=_names_or_points(shapes),
        spills=joined["spills"],
        outputs=tuple(map(int, outputs)),
        overflow=bool(overflow),
        bottom=bool(bottom),
        units=tuple(units),
        knee=_threshold(knee, units[0]),
    )
    check_caught(plant)
    return plant


def _tank(i: Any) -> int | None:
    """Return the number of a tank, or None for the basin."""
    return None if i is None else int(i)


def _joined(
    links: Sequence, pipes: Sequence, spills: Sequence, feeds: Sequence, valves: Sequence
) -> dict[str, Any]:
    """Return the pairs of tanks by what joins them; pumps and valves may end in the basin."""
    between = {"links": links, "pipes": pipes, "spills": spills}
    joined = {name: tuple((int(a), int(b)) for a, b in pairs) for name, pairs in between.items()}
    return joined | {
        "feeds": tuple(tuple(map(_tank, pair)) for pair in feeds),
        "valves": tuple((int(a), _tank(b)) for a, b in valves),
    }


def _options(sizes: dict[str, int], **options: Mapping[str, ArrayLike]) -> dict[str, Any]:
    """Return {"drain_port": an array, ...} of the ports, exponents and resistances of openings."""
    return {
        f"{name}_{option}": _fitted(f"plant.{name}_{option}", value, sizes[name])
        for option, values in options.items()
        for name, value in values.items()
    }


def _each(value: Any, count: int) -> Sequence:
    """Return a word or a truth value once for each valve, others as they are."""
    return (value,) * count if isinstance(value, str | bool) else value


def _names_or_points(values: Sequence) -> tuple:
    """Return names as they are, and lists of points as hashable tuples."""
    return tuple(v if isinstance(v, str) else _points([v])[0] for v in values)


def _check_tanks(named: dict[str, Sequence], n: int) -> None:
    """Raise InputError for a tank that does not exist."""
    for name, groups in named.items():
        for i in (i for group in groups for i in group if i is not None):
            if not 0 <= i < n:
                raise InputError(f"plant.{name} names tank {i}: there are {n}, counted from 0")


def _check_feeds(feeds: Sequence, sources: Sequence, lift_curves: Sequence) -> None:
    """Raise InputError for a pump that joins no tank, and for one with a lift to each of two."""
    for j, (first, second) in enumerate(feeds):
        if second is not None and any(lift_curves[j : j + 1]):
            raise InputError(
                f"pump {j + 1}: curve_head gives its flow by one lift, and it fills two tanks: give"
                " it one tank to fill and another pump the other, or leave curve_head out"
            )
        source = sources[j] if j < len(sources) else None
        if first is None and (source is None or second is not None):
            raise InputError(f"plant.feeds: pump {j + 1} joins no tank: give it a source or a tank")


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


def _points(curves: Sequence) -> tuple:
    """Curves as hashable tuples of points; () where there is none."""
    points = tuple(
        None if curve is None else tuple((float(a), float(b)) for a, b in curve) for curve in curves
    )
    return points if any(curve is not None for curve in points) else ()


def _threshold(value: float | None, length: str) -> float:
    """The laminar threshold of a rig, checked; the default in its unit of length where None."""
    value = float(default_threshold(length) if value is None else value)
    meta = next(f.metadata for f in dataclasses.fields(TankNetwork) if f.name == "knee")
    check_value("plant.knee", value, {**meta, "unit": length})
    return value
