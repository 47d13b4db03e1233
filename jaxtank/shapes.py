"""Shapes of leaves, read from what their documentation says: "(n,) cross-section of each tank" has one entry per tank.

Inside a compiled function an index past the end of an array is that of its last entry: an array that is too short, or of one entry, would be
a run of another rig, and no error.
"""

import dataclasses
import re

import numpy as np

from jaxtank.core.errors import InputError
from jaxtank.core.tree import is_component
from jaxtank.plants.base import Plant

_SAID = re.compile(r"\(([a-z0-9, +]+)\) ")


def check_shapes(loop):
    """Raise InputError for a leaf of `loop` that has not the shape its documentation begins with. Leaves of a batch may have the axes in front
    that x0 has; sizes that a component knows alone (changes, pours, knots) are its own to check."""
    _check(loop, "", {}, np.shape(loop.x0)[:-1])


def _check(tree, prefix, sizes, batch):
    if hasattr(tree, "plant") and isinstance(tree.plant, Plant):
        sizes = _sizes(tree.plant)
    if isinstance(tree, Plant):
        sizes = _sizes(tree)
    for field in dataclasses.fields(tree):
        value, name = getattr(tree, field.name), f"{prefix}{field.name}"
        if is_component(value):
            _check(value, f"{name}.", sizes, batch)
        elif field.metadata.get("kind") == "leaf" and value is not None:
            said = _SAID.match(field.metadata.get("doc") or "")
            wanted = said and _shape(said.group(1), sizes)
            if wanted is not None and np.shape(value) not in (wanted, batch + wanted):
                raise InputError(f"{name} has shape {np.shape(value)}: must be {wanted}, ({said.group(1)})")


def _sizes(plant):
    more = {name: len(getattr(plant, name, ())) for name in ("links", "pipes", "spills")}
    return {"n": plant.tanks, "tanks": plant.tanks, "m": plant.pumps, "pumps": plant.pumps, "outputs": len(plant.outputs), **more}


def _shape(said, sizes):
    """(4,) of "n,"; None where a size is not of the plant."""
    found = []
    for axis in filter(None, (a.strip() for a in said.split(","))):
        terms = [sizes.get(t, int(t) if t.isdigit() else None) for t in axis.split(" + ")]
        if None in terms:
            return None
        found.append(sum(terms))
    return tuple(found)
