"""The preset that a case came from, so that its file need only say what is different."""

import dataclasses

import jax
import numpy as np

from jaxtank import presets
from jaxtank.core.tree import is_component, walk
from jaxtank.rig import components, schedule, signals


PARTS = (("law", "controller", components.LAWS), ("observer", "observer", components.OBSERVERS))
"""(section, part of the loop, its classes) of what a file may have another one of."""


def origin_of(case):
    """Return the preset that a case came from.

    Of several, the one with the same controller and observer, then of the same name, then with the
    most static fields in common: its title is the one that the file will show. What a file has
    tables of its own for (reference, disturbances, faults) may differ.

    Returns
    -------
    (Case of a preset with the same rig, which of "law" and "observer" are of the same kind as its
    own), or (None, ()): also of a rig whose tanks have names, which only a file that describes it
    tank by tank can have.
    """
    if case.names:
        return None, ()
    loop = schedule.unscheduled(case.loop)
    best, found = None, (None, ())
    for paper in presets.PAPERS:
        for other in presets.load(paper).cases.values():
            same = _same_parts(loop, other.loop)
            if same is None:
                continue
            common = sum(a == b for a, b in zip(_statics(loop), _statics(other.loop)))
            score = ("law" in same, "observer" in same, other.name == case.name, common)
            if best is None or score > best:
                best, found = score, (other, same)
    return found


def _same_parts(loop, other):
    """Which of "law" and "observer" two loops have of the same kind; None where a file cannot make
    one loop of the other.
    """
    mine, theirs = structures(loop), structures(other)
    if mine["rest"] != theirs["rest"] or not _has_optional(
        other, ("plant", "sensor", "actuator"), loop
    ):
        return None
    same = tuple(
        section
        for section, field, _ in PARTS
        if mine[field] == theirs[field] and _has_optional(other, (field,), loop)
    )
    for section, field, known in PARTS:
        if section not in same and components.kind_of(getattr(loop, field), known) is None:
            return None
    return same


def _has_optional(other, fields, loop):
    """Whether the optional leaves that parts of `other` use are in use in `loop`."""
    used = {name for name in _optional(other) if name.split(".")[0] in fields}
    return used <= _optional(loop)


def _statics(loop):
    return [value for _, value, _ in walk(loop, kind="static")] + [
        np.asarray(getattr(loop.plant, "area", ())).tolist()
    ]


def _optional(loop):
    """Names of the optional leaves that are in use."""
    return {name for name, value, meta in walk(loop) if meta.get("like") and value is not None}


def structures(loop):
    """Pytree structures of controller, observer and the rest, with what a rig file can set made
    alike: they compare by their components.
    """

    def settle(tree):
        changed = {}
        for field in dataclasses.fields(tree):
            value = getattr(tree, field.name)
            if is_component(value):
                changed[field.name] = settle(value)
            elif field.metadata.get("kind") == "static" and not isinstance(value, tuple):
                changed[field.name] = type(value)()
            elif field.metadata.get("like"):
                changed[field.name] = None
        return dataclasses.replace(tree, **changed)

    described = {"faults": None}
    if signals.steps(loop.reference) is not None:
        described["reference"] = None
    if signals.disturbance_tables(loop.disturbance) is not None:
        described["disturbance"] = None
    plain = settle(dataclasses.replace(loop, **described))
    rest = dataclasses.replace(plain, controller=None, observer=None)
    return {
        "rest": jax.tree.structure(rest),
        "controller": jax.tree.structure(plain.controller),
        "observer": jax.tree.structure(plain.observer),
    }
