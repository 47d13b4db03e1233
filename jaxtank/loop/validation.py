"""Input validation of a loop and a clock: what cannot be run is refused before anything is
compiled.
"""

import dataclasses
import re
from typing import Any, cast

import jax
import numpy as np
from jax.core import Tracer

from jaxtank.core.checks import check_leaves
from jaxtank.core.clock import Clock, check_clock
from jaxtank.core.errors import InputError
from jaxtank.core.records import check_key
from jaxtank.core.tree import is_component
from jaxtank.loop.closed_loop import ClosedLoop
from jaxtank.loop.step_size import check_step
from jaxtank.plants.base import Plant
from jaxtank.plants.network import check_caught

_SAID = re.compile(r"\(([a-z0-9, +]+)\) ")


def check_shapes(loop):
    """Raise InputError for a leaf of `loop` that has not the shape its documentation begins with.
    Leaves of a batch may have the axes in front that x0 has; sizes that a component knows alone
    (changes, pours, knots) are its own to check.
    """
    _check(loop, "", {}, np.shape(loop.x0)[:-1])


def _check(tree, prefix, sizes, batch):
    if hasattr(tree, "plant") and isinstance(tree.plant, Plant):
        sizes = _sizes(tree.plant)
    if isinstance(tree, Plant):
        sizes = _sizes(tree)
    for field in dataclasses.fields(cast(Any, tree)):
        value, name = getattr(tree, field.name), f"{prefix}{field.name}"
        if is_component(value):
            _check(value, f"{name}.", sizes, batch)
        elif field.metadata.get("kind") == "leaf" and value is not None:
            said = _SAID.match(field.metadata.get("doc") or "")
            wanted = said and _shape(said.group(1), sizes)
            if said and wanted is not None and np.shape(value) not in (wanted, batch + wanted):
                raise InputError(
                    f"{name} has shape {np.shape(value)}: must be {wanted}, ({said.group(1)})"
                )


def _sizes(plant):
    more = {name: len(getattr(plant, name, ())) for name in ("links", "pipes", "spills")}
    return {
        "n": plant.tanks,
        "tanks": plant.tanks,
        "m": plant.pumps,
        "pumps": plant.pumps,
        "outputs": len(plant.outputs),
        **more,
    }


def _shape(said, sizes):
    """(4,) of "n,"; None where a size is not of the plant."""
    found = []
    for axis in filter(None, (a.strip() for a in said.split(","))):
        terms = [sizes.get(t, int(t) if t.isdigit() else None) for t in axis.split(" + ")]
        if None in terms:
            return None
        found.append(sum(terms))
    return tuple(found)


def check(
    loop: ClosedLoop, clock: Clock, key: jax.Array | jax.ShapeDtypeStruct | None = None
) -> None:
    """Raise InputError for a loop or clock that cannot be run: values out of range, wrong shapes, a
    reference the law cannot serve.

    Only concrete leaves are looked at, so that it costs nothing inside a trace.
    """
    if not hasattr(loop, "plant"):
        raise InputError(
            f"loop is a {type(loop).__name__}: must be a ClosedLoop, as case.loop (first the loop,"
            " then the clock)"
        )
    check_clock(clock)
    check_key(key)
    plant, actuator = loop.plant, loop.actuator
    if np.shape(loop.x0)[-1:] != (plant.tanks,):
        raise InputError(
            f"x0 has shape {np.shape(loop.x0)}: must be ({plant.tanks},), one level per tank"
        )
    if loop.reference.channels != len(plant.outputs):
        raise InputError(
            f"the reference has {loop.reference.channels} channels for {len(plant.outputs)} outputs"
        )
    if actuator.pumps != plant.pumps:
        raise InputError(f"the actuator has {actuator.pumps} pumps, the plant {plant.pumps}")
    if loop.disturbance is not None and loop.disturbance.channels != plant.tanks:
        raise InputError(
            f"the disturbance has {loop.disturbance.channels} channels for {plant.tanks} tanks:"
            " give one inflow per tank"
        )
    if actuator.allocates and (plant.pumps != 2 or not loop.controller.allocates):
        raise InputError(
            "actuator.saturation = 'boxqp': needs two pumps and a law with a cost to allocate by"
            " (its input_metric)"
        )
    samples = actuator.delay / clock.dt
    if actuator.delay > clock.duration or abs(samples - round(samples)) > 1e-6 * max(1.0, samples):
        raise InputError(
            f"actuator.delay = {actuator.delay:g} s: must be a whole number of samples of"
            f" {clock.dt:g} s, at most {clock.duration:g} s"
        )
    check_shapes(loop)
    check_leaves(
        loop, vacant=[f"controller.law.{gain}" for gain in getattr(loop.controller, "gains", ())]
    )
    for name, own in _plants(loop):
        check_caught(own, name)
    if not _traced(plant):
        check_step(loop, clock)
    actuator.check()
    if not _traced(loop.controller, loop.reference):
        loop.controller.check(loop.reference)
        if not _traced(actuator):
            loop.controller.check_pumps(actuator)
    loop.observer.check(plant)
    if key is None and not _traced(loop.sensor.noise) and np.any(np.asarray(loop.sensor.noise) > 0):
        raise InputError(
            f"sensor.noise = {np.asarray(loop.sensor.noise)} {plant.units[0]}: give a key (or"
            " --seed), or set it to 0"
        )


def _plants(tree, prefix=""):
    """(dotted name, plant) of every plant below `tree`: that of the loop, and the models of law and
    observer.
    """
    for field in dataclasses.fields(cast(Any, tree)):
        value = getattr(tree, field.name)
        if is_component(value):
            yield from (
                [(f"{prefix}{field.name}", value)]
                if isinstance(value, Plant)
                else _plants(value, f"{prefix}{field.name}.")
            )


def _traced(*trees):
    return any(isinstance(v, Tracer) for v in jax.tree.leaves(trees))
