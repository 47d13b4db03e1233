"""[law] and [observer] of a rig file: a component by its kind, and its fields by their names."""

import dataclasses
from typing import Any

import numpy as np

from jaxtank import controllers
from jaxtank.analysis.steady_state import equilibrium
from jaxtank.core.errors import EquilibriumError, InputError, unknown
from jaxtank.core.tree import number, shortened
from jaxtank.core.units import local
from jaxtank.observers import Direct, DisturbanceObserver, ExtendedKalman, Kalman
from jaxtank.plants.hydraulics import in_unit
from jaxtank.rig.schema import static_value
from jaxtank.rig.signals import RAMP_KEYS, changes_of, meta_of, ramps_of
from jaxtank.signals.setpoints import Ramps, ramps

LAWS = {
    "pid": controllers.PID,
    "state-feedback": controllers.StateFeedback,
    "lqi": controllers.LQI,
    "ngpc": controllers.NGPC,
    "backstepping": controllers.Backstepping,
    "enmpc": controllers.ENMPC,
    "two-tank-backstepping": controllers.TwoTankBackstepping,
    "sliding-mode": controllers.SlidingMode,
    "fuzzy": controllers.FuzzyBlend,
    "gpc": controllers.GPC,
    "laguerre": controllers.Laguerre,
    "open-loop": controllers.OpenLoop,
}
OBSERVERS = {"direct": Direct, "disturbance": DisturbanceObserver, "kalman": Kalman, "extended-kalman": ExtendedKalman}
# what a law or an observer needs and a file may leave out: by field
USUAL = {"Tt": 30.0, "spread": 0.0}
FLOORS = {"level_floor": 0.01, "difference_floor": 0.01}  # [cm]
SIZES = ("(m,", "(n,", "(outputs,", "(pumps,", "(2,", "(tanks + outputs,")


def law_of(table, plant, levels, initial):
    """The law of a [law] table on `plant`; levels: outputs at t = 0, initial: (m,) inputs before it, what `bias` is where it is left out."""
    if isinstance(table, dict) and table.get("kind") == "open-loop":
        return _open_loop(table, plant, initial)
    return component("law", table, LAWS, plant, {"bias": _resting(plant, levels, initial)})


def observer_of(table, plant, levels, initial):
    """The observer of an [observer] table on `plant`."""
    offered = {"levels": levels, "inputs": initial, "measured": list(range(1, plant.tanks + 1))}
    return component("observer", table, OBSERVERS, plant, offered)


def component(kind, table, known, plant, offered):
    """The law or observer of a table: kind, then the fields of the component by their names."""
    if not isinstance(table, dict):
        raise InputError(f"[{kind}]: must be a table")
    if "kind" not in table:
        raise InputError(f"[{kind}] needs kind = one of {', '.join(known)}")
    if not isinstance(table["kind"], str) or table["kind"] not in known:
        raise unknown(f"{kind} kind", str(table["kind"]), known)
    cls, values = known[table["kind"]], {}
    fields = {f.name: f for f in dataclasses.fields(cls)}
    settable = {n: f for n, f in fields.items() if n != "model"}
    for key in table:
        if key != "kind" and key not in settable:
            raise unknown(f"key of [{kind}]", key, ["kind", *settable])
    if "model" in fields:
        values["model"] = plant
    for name, field in settable.items():
        meta = field.metadata
        if name in table:
            value = table[name]
        elif name in offered:
            value = offered[name]
        elif name in USUAL:
            value = USUAL[name]
        elif name in FLOORS:
            value = in_unit(FLOORS[name], plant.units[0])
        elif field.default is not dataclasses.MISSING:
            continue
        else:
            unit = "" if meta.get("unit", "-") == "-" else f" [{local(meta['unit'], plant.units)}]"
            raise InputError(f"[{kind}] {table['kind']} needs {name}{unit}: {meta.get('doc', '')}")
        values[name] = _value(f"{kind}.{name}", value, field, plant)
    return cls(**values)


def _value(name, value, field, plant):
    if field.metadata.get("kind") == "leaf":
        array = _shaped(name, value, field.metadata, plant)
        if field.type is float and array.ndim:
            raise InputError(f"{name} = {shortened(value)}: must be one number")
        return array
    if field.type is tuple:  # tanks, counted from 1 in a file
        if not (isinstance(value, list) and all(isinstance(i, int) and not isinstance(i, bool) for i in value)):
            raise InputError(f"{name} = {shortened(value)}: must be a list of tanks, counted from 1")
        if not all(1 <= i <= plant.tanks for i in value):
            raise InputError(f"{name} = {shortened(value)}: tanks are counted from 1 to {plant.tanks}")
        return tuple(i - 1 for i in value)
    return static_value(name, value, field.metadata, field.type)


def _shaped(name, value, meta, plant):
    """A leaf's value as an array; one number for an array of one entry per pump, tank or output fills it."""
    try:
        array = number(value)
    except (TypeError, ValueError, OverflowError):
        raise InputError(f"{name} = {shortened(value)}: must be a number or a list of numbers") from None
    size = size_of(meta, plant)
    return np.full(size, array) if size is not None and array.ndim == 0 else array


def size_of(meta, plant):
    """Number of entries of a leaf that has one per pump, tank or output, by the shape its metadata begins with; None of another."""
    n, m, outputs = plant.tanks, plant.pumps, len(plant.outputs)
    sizes = dict(zip(SIZES, (m, n, outputs, m, 2, n + outputs)))
    return next((size for start, size in sizes.items() if meta["doc"].split(")")[0].startswith(start)), None)


def _open_loop(table, plant, initial):
    keys = RAMP_KEYS[:-1]
    for key in table:
        if key != "kind" and key not in keys:
            raise unknown("key of [law]", key, ["kind", *keys])
    return controllers.OpenLoop(signal=ramps_of("law", table, ramps(np.asarray(initial).tolist(), [], ramp=0.0), ("pump", "input")))


def _resting(plant, levels, initial):
    """(pumps,) inputs at which the outputs rest where they start; `initial` where they cannot."""
    if len(levels) != plant.pumps:
        return initial
    try:
        return number(equilibrium(plant, np.asarray(levels))[1])
    except (EquilibriumError, InputError, FloatingPointError):
        return initial


def kind_of(part, known):
    """The name of a law or observer in a rig file, None where it has none."""
    return next((name for name, cls in known.items() if cls is type(part)), None)


def keys_of(part, known):
    """[(key, metadata, value)] of a [law] or [observer]; value None of an optional one that is not in use. InputError where it has no name."""
    kind = kind_of(part, known)
    if kind is None:
        raise InputError(f"its {type(part).__name__} has no name in a rig file")
    found: list[tuple[str, Any, Any]] = [("kind", {"unit": "-", "doc": f"one of {', '.join(known)}"}, kind)]
    if isinstance(part, controllers.OpenLoop):
        if not isinstance(part.signal, Ramps):
            raise InputError("its OpenLoop plays a signal that no rig file describes")
        values = {k: np.asarray(getattr(part.signal, k)).tolist() for k in ("initial", "ramp", "shape")}
        values["changes"] = changes_of(part.signal)
        docs = {"initial": PUMPS, "changes": {"unit": "-", "doc": "[time [s], pump (from 1), input] of each change"}}
        return found + [(k, docs.get(k) or meta_of(Ramps, k), values[k]) for k in RAMP_KEYS[:-1]]
    for field in dataclasses.fields(part):
        value, meta = getattr(part, field.name), field.metadata
        if meta.get("kind") == "leaf":
            found.append((field.name, meta, None if value is None else np.asarray(value).tolist()))
        elif meta.get("kind") == "static":
            found.append((field.name, meta, [i + 1 for i in value] if isinstance(value, tuple) else value))
    return found


PUMPS = {"unit": "V", "doc": "(m,) input of each pump before the first change"}
