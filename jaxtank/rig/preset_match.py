"""The preset that a case came from, so that its file need only say what is different."""

import dataclasses

import jax
import numpy as np

from jaxtank import presets
from jaxtank.core.tree import is_component, walk
from jaxtank.rig import components, schedule, signals


def origin_of(case):
    """Return the preset that a case came from."""
    if case.names:
        return None, ()
    loop = schedule.unscheduled(case.loop)
    mine, statics = structures(loop), _statics(loop)
    best, found = None, (None, ())
    for paper in presets.PAPERS:
        for other in presets.load(paper).cases.values():
            same = _same_parts(loop, mine, other.loop)
            if same is None:
                continue
            common = sum(a == b for a, b in zip(statics, _statics(other.loop)))
            score = ("controller" in same, "observer" in same, other.name == case.name, common)
            if best is None or score > best:
                best, found = score, (other, same)
    return found


def _same_parts(loop, mine, other):
    """Sections in which `other` is of the kind of `loop`; None where no file makes one of the other."""
    theirs = structures(other)
    if mine["rest"] != theirs["rest"] or not _has_optional(other, "plant", loop):
        return None
    same = tuple(
        name
        for name, role in components.ROLES.items()
        if mine[role.field] == theirs[role.field] and _has_optional(other, role.field, loop)
    )
    for name, role in components.ROLES.items():
        if name not in same and not components.is_written(name, getattr(loop, role.field)):
            return None
    return same


def _has_optional(other, field, loop):
    """Whether the optional leaves that a part of `other` uses are in use in `loop`."""
    return {name for name in _optional(other) if name.startswith(f"{field}.")} <= _optional(loop)


def _statics(loop):
    return [value for _, value, _ in walk(loop, kind="static")] + [
        np.asarray(getattr(loop.plant, "area", ())).tolist()
    ]


def _optional(loop):
    """Names of the optional leaves that are in use."""
    return {name for name, value, meta in walk(loop) if meta.get("like") and value is not None}


def structures(loop):
    """Return pytree structures of the parts of a loop, with what a rig file can set made alike."""

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
    fields = [role.field for role in components.ROLES.values()]
    rest = dataclasses.replace(plain, **dict.fromkeys(fields))
    parts = {field: jax.tree.structure(getattr(plain, field)) for field in fields}
    return {"rest": jax.tree.structure(rest), **parts}
