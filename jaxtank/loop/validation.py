"""Input validation of a loop and a clock, before anything is compiled."""
# pyright: reportUnknownMemberType=false

import dataclasses
import hashlib
from collections.abc import Iterator, Mapping
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from jaxtank.core.checks import check_leaves, check_order
from jaxtank.core.clock import Clock, check_clock
from jaxtank.core.errors import InputError
from jaxtank.core.records import check_key
from jaxtank.core.tree import is_component, sizes_of_shape
from jaxtank.instruments.base import Actuator
from jaxtank.loop.closed_loop import ClosedLoop, draws_bursts
from jaxtank.loop.of_case import check_is_loop, takes_case
from jaxtank.loop.step_size import check_step
from jaxtank.plants.base import Plant
from jaxtank.plants.elements import check_plain
from jaxtank.plants.faults import Faults
from jaxtank.plants.network import check_caught
from jaxtank.safety.filter import SafetyFilter

KEPT = 64
"""Loops that have passed and are remembered, by structure and values, so that the next call of
`evaluate` or `simulate` need not look again: the checks take longer than a short run.
"""

_PASSED: dict[Any, None] = {}


@takes_case
def check(
    loop: ClosedLoop, clock: Clock, key: jax.Array | jax.ShapeDtypeStruct | None = None
) -> None:
    """Raise InputError for a loop or clock that cannot be run: values out of range, wrong shapes, a
    reference that the controller cannot serve.

    Only concrete leaves are looked at, so that it costs nothing inside a trace.

    Parameters
    ----------
    loop : ClosedLoop; or a Case, whose clock is then used
    clock : Clock; none after a Case
    key : jax random key, optional
        As it will be given to the run.

    Raises
    ------
    InputError
        With a message of one line that names the leaf, its value, its unit and its allowed range.

    Examples
    --------
    >>> import jaxtank
    >>> from jaxtank import presets
    >>> case = presets.load("cascaded/pi")
    >>> jaxtank.check(case.loop, case.clock)
    >>> jaxtank.check(case.loop, jaxtank.Clock(dt=-1.0))
    Traceback (most recent call last):
    jaxtank.core.errors.InputError: clock.dt = -1.0 s: must be a finite number above 0 s
    """
    check_is_loop(loop)
    check_clock(clock)
    check_key(key)
    signature = _signature(loop, clock, key is None)
    if signature is None or signature not in _PASSED:
        _check_parts(loop, clock, key)
        if signature is not None:
            _PASSED[signature] = None
            if len(_PASSED) > KEPT:
                _PASSED.pop(next(iter(_PASSED)), None)  # the oldest
    if not _traced(loop.plant):
        check_step(loop, clock)  # it may warn, every time


def _signature(loop: ClosedLoop, clock: Clock, keyless: bool) -> Any:
    """Return a hashable key of everything that the checks use; None inside a trace."""
    leaves, structure = cast(tuple[list[Any], Any], jax.tree.flatten(loop))
    digest = hashlib.blake2b(digest_size=16)
    for value in leaves:
        if isinstance(value, Tracer) or not isinstance(value, np.ndarray | jax.Array | float):
            return None
        # an array of random keys is no array of numbers
        if jnp.issubdtype(getattr(cast(Any, value), "dtype", np.float64), jax.dtypes.extended):
            return None
        array = np.asarray(value)
        if array.dtype.hasobject:
            return None
        digest.update(f"{array.shape}{array.dtype.str}".encode())
        digest.update(array.tobytes())
    signature = structure, clock, keyless, digest.digest()
    try:
        hash(signature)
    except TypeError:  # a static field of a user's own
        return None
    return signature


def _check_parts(
    loop: ClosedLoop, clock: Clock, key: jax.Array | jax.ShapeDtypeStruct | None
) -> None:
    """Every check that looks at the loop."""
    _check_components(loop)
    _check_sizes(loop)
    _check_units(loop.plant)
    if loop.actuator.allocates and (loop.plant.pumps != 2 or not loop.controller.allocates):
        raise InputError(
            "actuator.saturation = 'boxqp': needs two pumps and a controller with a cost to"
            " allocate by (its input_metric)"
        )
    _check_delay(loop.actuator, clock)
    _check_shapes(loop, "", {}, np.shape(loop.x0)[:-1])
    gains: tuple[str, ...] = getattr(loop.controller, "gains", ())
    check_leaves(loop, vacant=[f"controller.law.{gain}" for gain in gains])
    for name, model in _plants(loop):
        check_caught(model, name)
    if isinstance(loop.safety_filter, SafetyFilter):
        check_plain(loop.plant, "safety_filter", "run without the filter")
    _check_faults(loop, clock)
    for lower, upper, equal in loop.actuator.orders():
        check_order("actuator", loop.actuator, lower, upper, loop.units[1], equal)
    loop.actuator.check()
    if not _traced(loop.controller, loop.reference):
        loop.controller.check(loop.reference)
        if not _traced(loop.actuator):
            loop.controller.check_pumps(loop.actuator)
        if not _traced(loop.sensor):
            loop.controller.check_sensor(loop.sensor)
    loop.observer.check(loop.plant)
    if not _traced(loop.observer):
        loop.observer.check_clock(clock)
    if key is None:
        _check_noise(loop)


def _check_components(loop: ClosedLoop) -> None:
    """Raise InputError for a part of the loop whose class was not made by `component`."""
    wrong: list[str] = []
    for field in dataclasses.fields(cast(Any, loop)):
        part = getattr(loop, field.name)
        if field.name == "x0" or part is None:
            continue
        if isinstance(part, type):
            wrong.append(f"{field.name} is the class {part.__name__}: give {part.__name__}(...)")
        elif jax.tree_util.all_leaves([part]):  # jax does not know its class
            wrong.append(
                f"{field.name} is of the class {type(part).__name__}, which lacks"
                " @jaxtank.component: write this line above the class"
            )
    if wrong:
        raise InputError("; ".join(wrong))


def _check_faults(loop: ClosedLoop, clock: Clock) -> None:
    faults = loop.faults if isinstance(loop.faults, Faults) else None
    if faults and not _traced(faults, loop.plant) and (wrong := faults.problems(loop.plant, clock)):
        raise InputError("; ".join(wrong))
    if faults and faults.noisy and np.ndim(loop.sensor.noise) == 0:
        raise InputError(
            f"a fault is noise of a sensor, and the class {type(loop.sensor).__name__} has none:"
            " choose another kind, or give the sensor a leaf noise"
        )


def _check_noise(loop: ClosedLoop) -> None:
    """Raise InputError for a noisy sensor, of a run without a key."""
    noise = loop.sensor.noise
    if draws_bursts(loop):
        raise InputError("a fault is noise of a sensor: give a key (or --seed)")
    if not _traced(noise) and np.any(np.asarray(noise) > 0):
        raise InputError(
            f"sensor.noise = {np.asarray(noise)} {loop.units[0]}: give a key (or --seed), or set it"
            " to 0"
        )


def _check_sizes(loop: ClosedLoop) -> None:
    """Raise InputError unless the components have as many tanks, pumps and outputs as the plant."""
    plant = loop.plant
    if np.shape(loop.x0)[-1:] != (plant.tanks,):
        raise InputError(
            f"x0 has shape {np.shape(loop.x0)}: must be ({plant.tanks},), one level per tank"
        )
    if loop.reference.channels != len(plant.outputs):
        raise InputError(
            f"the reference has {loop.reference.channels} channels for {len(plant.outputs)} outputs"
        )
    if loop.actuator.pumps != plant.pumps:
        raise InputError(f"the actuator has {loop.actuator.pumps} pumps, the plant {plant.pumps}")
    if loop.disturbance is not None and loop.disturbance.channels != plant.tanks:
        raise InputError(
            f"the disturbance has {loop.disturbance.channels} channels for {plant.tanks} tanks:"
            " give one inflow per tank"
        )


def _check_units(plant: Plant) -> None:
    """Raise InputError where the levels of a plant are in a length that is not its `units`'."""
    length, drive = plant.units
    fields = cast(Any, getattr(plant, "__dataclass_fields__", {}))
    unit = fields["rim"].metadata.get("unit", "cm") if "rim" in fields else "cm"
    if unit not in ("cm", length):  # metadata in cm are translated
        raise InputError(
            f"plant.rim is in {unit} and {type(plant).__name__}.units = {plant.units}: must be the"
            f' same length; write units = ("{unit}", "{drive}") in the class, with the unit of its'
            " pump inputs second"
        )


def _check_delay(actuator: Actuator, clock: Clock) -> None:
    if actuator.delays and len(actuator.delays) != actuator.pumps:
        raise InputError(
            f"actuator.delays = {actuator.delays}: must be {actuator.pumps} dead times [s], one per"
            " pump"
        )
    for j, more in enumerate(actuator.delays or (0.0,)):
        delay = actuator.delay + more
        samples = delay / clock.dt
        whole = abs(samples - round(samples)) <= 1e-6 * max(1.0, samples)
        if not whole or not 0.0 <= more <= delay <= clock.duration:
            of = f" of pump {j + 1}" if actuator.delays else ""
            raise InputError(
                f"actuator.delay{of} = {delay:g} s: must be a whole number of samples of"
                f" {clock.dt:g} s, from 0 to {clock.duration:g} s"
            )


def _check_shapes(tree: Any, prefix: str, sizes: Mapping[str, int], batch: tuple[int, ...]) -> None:
    """Raise InputError for a leaf that has not the shape of its class; sizes: of its plant."""
    plant = getattr(tree, "plant", tree)
    if isinstance(plant, Plant):
        sizes = _sizes(plant)
    for field in dataclasses.fields(tree):
        value, name = getattr(tree, field.name), f"{prefix}{field.name}"
        if is_component(value):
            _check_shapes(value, f"{name}.", sizes, batch)
        elif field.metadata.get("kind") == "leaf" and value is not None:
            expected = sizes_of_shape(field.metadata["shape"], sizes)
            if expected is not None and np.shape(value) not in (expected, batch + expected):
                shape = field.metadata["shape"]
                words = f"{expected}, one entry per {' and '.join(map(str, shape))}"
                if not shape:
                    words = 'one number; of an array its class says so: leaf(..., shape=("pump",))'
                raise InputError(f"{name} has shape {np.shape(value)}: must be {words}")


def _sizes(plant: Plant) -> dict[str, int]:
    """{name in the shape of a leaf: count} of a plant."""
    parts = {"orifice": "links", "pipe": "pipes", "spill": "spills"}
    parts |= {"feed": "feeds", "valve": "valves"}
    counts = {name: len(getattr(plant, field, ())) for name, field in parts.items()}
    return {"tank": plant.tanks, "pump": plant.pumps, "output": len(plant.outputs), **counts}


def _plants(tree: Any, prefix: str = "") -> Iterator[tuple[str, Plant]]:
    """(dotted name, plant) of the loop's plant and of the models of controller and observer."""
    for field in dataclasses.fields(tree):
        value, name = getattr(tree, field.name), f"{prefix}{field.name}"
        if isinstance(value, Plant):
            yield name, value
        elif is_component(value):
            yield from _plants(value, f"{name}.")


def _traced(*trees: Any) -> bool:
    leaves: list[Any] = jax.tree.leaves(trees)
    return any(isinstance(v, Tracer) for v in leaves)
