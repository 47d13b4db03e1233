"""The preset that a case came from, so that its file need only say what is different."""

import dataclasses

import jax
import numpy as np

from jaxtank import presets
from jaxtank.core.tree import is_component, walk
from jaxtank.rig import components, schedule, signals

# table of a rig file, field of the loop
PARTS = (
    ("law", "controller"),
    ("observer", "observer"),
    ("sensor", "sensor"),
    ("actuator", "actuator"),
)


def origin_of(case):
    """(Case of a preset with the same rig, which of PARTS are of the same kind as its own), or (None, ()): of a rig whose tanks have names too, which only a file that describes
    it tank by tank can say.

    Of several, the one with the same law and observer, then of the same name, then with the most
    static fields in common: its title is the one that the file will show. What a file can say in a
    table of its own (reference, disturbances, faults) may differ.
    """
    if case.names:
        return None, ()
    loop = schedule.unscheduled(case.loop)
    mine, statics, best, found = structures(loop), _statics(loop), None, (None, ())
    for paper in presets.PAPERS:
        for other in presets.load(paper).cases.values():
            theirs = structures(other.loop)
            if mine["rest"] != theirs["rest"] or not _optional(other.loop, ("plant",)) <= _optional(
                loop
            ):
                continue
            same = tuple(
                word
                for word, field in PARTS
                if mine[field] == theirs[field]
                and _optional(other.loop, (field,)) <= _optional(loop)
            )
            if any(
                word not in same and not components.is_written(word, getattr(loop, field))
                for word, field in PARTS
            ):
                continue
            common = sum(a == b for a, b in zip(statics, _statics(other.loop)))
            score = ("law" in same, "observer" in same, other.name == case.name, common)
            if best is None or score > best:
                best, found = score, (other, same)
    return found


def _statics(loop):
    return [value for _, value, _ in walk(loop, kind="static")] + [
        np.asarray(getattr(loop.plant, "area", ())).tolist()
    ]


def _optional(loop, fields=None):
    """Names of the optional leaves that are in use; fields: of which parts of the loop."""
    named = {name for name, value, meta in walk(loop) if meta.get("like") and value is not None}
    return named if fields is None else {name for name in named if name.split(".")[0] in fields}


def structures(loop):
    """Pytree structures of law, observer and the rest, with what a rig file can set made alike:
    they compare by their components.
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

    told = {"faults": None}
    if signals.steps(loop.reference) is not None:
        told["reference"] = None
    if signals.disturbance_tables(loop.disturbance) is not None:
        told["disturbance"] = None
    plain = settle(dataclasses.replace(loop, **told))
    fields = [field for _, field in PARTS]
    rest = dataclasses.replace(plain, **dict.fromkeys(fields))
    return {
        "rest": jax.tree.structure(rest),
        **{field: jax.tree.structure(getattr(plain, field)) for field in fields},
    }
