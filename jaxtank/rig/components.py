"""[law], [observer], [sensor] and [actuator] of a rig file: a component by its kind, and its fields
by their names.
"""

import dataclasses
import inspect
import re
from typing import Any

import numpy as np

from jaxtank import controllers
from jaxtank.analysis.steady_state import equilibrium
from jaxtank.core.errors import EquilibriumError, InputError, unknown
from jaxtank.core.text import shortened
from jaxtank.core.tree import number
from jaxtank.core.units import local
from jaxtank.instruments import Actuator, LevelSensor, PumpBank, Sensor
from jaxtank.observers import Direct, DisturbanceObserver, ExtendedKalman, Kalman, Observer
from jaxtank.plants.hydraulics import in_unit
from jaxtank.rig.schema import is_numeric, static_value
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
OBSERVERS = {
    "direct": Direct,
    "disturbance": DisturbanceObserver,
    "kalman": Kalman,
    "extended-kalman": ExtendedKalman,
}
SENSORS = {"level": LevelSensor}
ACTUATORS = {"pumps": PumpBank}
REGISTERED = set()
"""Kinds that were added by `register`."""

INSTRUMENTS = {"sensor": ("noise",), "actuator": ("low", "high", "initial")}
"""Tables of instruments: what is the case's own where a file leaves it out."""

_KIND = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]*")
_TYPES = {kind.__name__: kind for kind in (bool, int, float, str, tuple)}


def register(kind, cls):
    """Give a controller, observer, sensor or actuator of one's own a name in rig files.

    `kind = "..."` of [law] (a controller), [observer], [sensor] or [actuator] then makes a
    component of the class. Its leaves and static fields are keys of the table; a field `model` is the plant of
    the rig. A static field of type tuple holds tanks, which a file counts from 1. `rig.dump`,
    `rig.complete` and `result.save` write such a case.

    Parameters
    ----------
    kind : text of letters, digits, "-", "_" and "."; a name that no other class has
    cls : class made by `jaxtank.component`, of Controller, Observer, Sensor or Actuator

    Returns
    -------
    The class.

    Raises
    ------
    InputError for a name that is taken, and for a class that a rig file cannot describe.

    Examples
    --------
    >>> import jaxtank
    >>> from jaxtank import rig
    >>> @jaxtank.component
    ... class Proportional(jaxtank.controllers.Controller):
    ...     Kc: float = jaxtank.leaf("V/cm", "gain", low=0.0)
    ...
    ...     def step(self, state, tick, estimate):
    ...         return tuple(self.Kc * (r - h) for r, h in zip(tick.r, estimate.x)), state
    >>> cls = rig.register("proportional", Proportional)
    >>> own = rig.loads('''
    ... case = "cascaded/pi"
    ... [law]
    ... kind = "proportional"
    ... Kc = 2.0
    ... [free]
    ... "controller.Kc" = [0.1, 10.0]
    ... ''')
    >>> float(own.loop.controller.Kc)
    2.0
    """
    if not (isinstance(kind, str) and _KIND.fullmatch(kind)):
        allowed = 'a text of letters, digits, "-", "_" and "."'
        raise InputError(f"kind = {shortened(kind)}: must be {allowed}")
    name = getattr(cls, "__name__", shortened(cls))
    known = _table_of(cls)
    if known is None or "__dataclass_fields__" not in vars(cls) or inspect.isabstract(cls):
        wanted = (
            "a class of Controller, Observer, Sensor or Actuator with its own step, made by"
            " jaxtank.component"
        )
        raise InputError(f"{name} is no component: it must be {wanted}")
    for field in dataclasses.fields(cls):
        why = _unwritable(field)
        if why:
            raise InputError(f"{name}.{field.name}: {why}")
    taken = next((table[kind] for _, table in _roles() if kind in table), None)
    if taken not in (None, cls):
        raise InputError(f"kind {kind!r} is taken, by {taken.__name__}: choose another name")
    other = next((k for k, c in known.items() if c is cls and k != kind), None)
    if other is not None:
        raise InputError(f"{name} has a name in rig files already: {other!r}")
    if taken is None:
        known[kind] = cls
        REGISTERED.add(kind)
    return cls


def _roles():
    """(abstract class, {kind: class}) of every role that a rig file can fill."""
    return (
        (controllers.Controller, LAWS),
        (Observer, OBSERVERS),
        (Sensor, SENSORS),
        (Actuator, ACTUATORS),
    )


def _table_of(cls):
    """The registry of the role of `cls`; None of what has no role."""
    if not isinstance(cls, type):
        return None
    return next((table for role, table in _roles() if issubclass(cls, role)), None)


def _unwritable(field):
    """Why a rig file cannot set the field of a component; "" where it can."""
    kind = field.metadata.get("kind")
    if field.name == "kind":
        return "a rig file has this key for the name of the class: give the field another name"
    if kind == "static" and _type_of(field) not in _TYPES.values():
        return f"a static field must be one of {', '.join(_TYPES)} to be set by a rig file"
    if kind is None and field.name != "model":
        return "a rig file sets fields made by leaf(...) and static(...), and `model`"
    return ""


def _type_of(field):
    """The type of a field, also where `from __future__ import annotations` makes it a text."""
    return _TYPES.get(field.type, field.type)


# what a law or an observer needs and a file may leave out: by field
USUAL = {"Tt": 30.0, "spread": 0.0}
FLOORS = {"level_floor": 0.01, "difference_floor": 0.01}  # [cm]
SIZES = ("(m,", "(n,", "(outputs,", "(pumps,", "(2,", "(tanks + outputs,")


def law_of(table, plant, levels, initial):
    """The law of a [law] table on `plant`; levels: outputs at t = 0, initial: (m,) inputs before
    it, what `bias` is where it is left out.
    """
    if isinstance(table, dict) and table.get("kind") == "open-loop":
        return _open_loop(table, plant, initial)
    return component("law", table, LAWS, plant, {"bias": _resting(plant, levels, initial)})


def observer_of(table, plant, levels, initial):
    """The observer of an [observer] table on `plant`."""
    offered = {"levels": levels, "inputs": initial, "measured": list(range(1, plant.tanks + 1))}
    return component("observer", table, OBSERVERS, plant, offered)


def instrument_of(word, table, loop):
    """The sensor or actuator (`word`) of a [sensor] or [actuator] table in `loop`; noise and limits
    that are left out are those of the loop's own.
    """
    known = {"sensor": SENSORS, "actuator": ACTUATORS}[word]
    offered = {name: getattr(getattr(loop, word), name) for name in INSTRUMENTS[word]}
    return component(word, table, known, loop.plant, offered)


def component(kind, table, known, plant, offered):
    """The component of a table: kind, then the fields of the component by their names."""
    if not isinstance(table, dict):
        raise InputError(f"[{kind}]: must be a table")
    if "kind" not in table:
        raise InputError(f"[{kind}] needs kind = one of {', '.join(known)}")
    if not isinstance(table["kind"], str) or table["kind"] not in known:
        raise unknown(f"{kind} kind", str(table["kind"]), known)
    cls, values, own = known[table["kind"]], {}, table["kind"] in REGISTERED
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
        elif name in offered and (not own or kind in INSTRUMENTS):
            value = offered[name]
        elif name in USUAL and not own:
            value = USUAL[name]
        elif name in FLOORS and not own:
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
        if _type_of(field) is float and array.ndim:
            raise InputError(f"{name} = {shortened(value)}: must be one number")
        return array
    if _type_of(field) is tuple:  # tanks, counted from 1 in a file
        if not (
            isinstance(value, list)
            and all(isinstance(i, int) and not isinstance(i, bool) for i in value)
        ):
            raise InputError(
                f"{name} = {shortened(value)}: must be a list of tanks, counted from 1"
            )
        if not all(1 <= i <= plant.tanks for i in value):
            raise InputError(
                f"{name} = {shortened(value)}: tanks are counted from 1 to {plant.tanks}"
            )
        return tuple(i - 1 for i in value)
    return static_value(name, value, field.metadata, _type_of(field))


def _shaped(name, value, meta, plant):
    """A leaf's value as an array; one number for an array of one entry per pump, tank or output
    fills it.
    """
    if not is_numeric(value):
        raise InputError(f"{name} = {shortened(value)}: must be a number or a list of numbers")
    array = number(value)
    size = size_of(meta, plant)
    return np.full(size, array) if size is not None and array.ndim == 0 else array


def size_of(meta, plant):
    """Number of entries of a leaf that has one per pump, tank or output, by the shape its metadata
    begins with; None of another.
    """
    n, m, outputs = plant.tanks, plant.pumps, len(plant.outputs)
    sizes = dict(zip(SIZES, (m, n, outputs, m, 2, n + outputs)))
    return next(
        (size for start, size in sizes.items() if meta["doc"].split(")")[0].startswith(start)), None
    )


def _open_loop(table, plant, initial):
    keys = RAMP_KEYS[:-1]
    for key in table:
        if key != "kind" and key not in keys:
            raise unknown("key of [law]", key, ["kind", *keys])
    return controllers.OpenLoop(
        signal=ramps_of(
            "law", table, ramps(np.asarray(initial).tolist(), [], ramp=0.0), ("pump", "input")
        )
    )


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


def is_written(word, part):
    """Whether a table `word` of a rig file can describe `part`."""
    known = {"law": LAWS, "observer": OBSERVERS, "sensor": SENSORS, "actuator": ACTUATORS}[word]
    return has_table(word, part) and kind_of(part, known) is not None


def has_table(word, part):
    """Whether a file has a table `word` for a part that is not the preset's: [values] set the fields
    of LevelSensor and PumpBank.
    """
    return word not in INSTRUMENTS or type(part) not in (LevelSensor, PumpBank)


def keys_of(part, known):
    """[(key, metadata, value)] of a [law] or [observer]; value None of an optional one that is not
    in use. InputError where it has no name.
    """
    kind = kind_of(part, known)
    if kind is None:
        raise InputError(f"its {type(part).__name__} has no name in a rig file")
    found: list[tuple[str, Any, Any]] = [
        ("kind", {"unit": "-", "doc": f"one of {', '.join(known)}"}, kind)
    ]
    if isinstance(part, controllers.OpenLoop):
        if not isinstance(part.signal, Ramps):
            raise InputError("its OpenLoop plays a signal that no rig file describes")
        values = {
            k: np.asarray(getattr(part.signal, k)).tolist() for k in ("initial", "ramp", "shape")
        }
        values["changes"] = changes_of(part.signal)
        docs = {
            "initial": PUMPS,
            "changes": {"unit": "-", "doc": "[time [s], pump (from 1), input] of each change"},
        }
        return found + [(k, docs.get(k) or meta_of(Ramps, k), values[k]) for k in RAMP_KEYS[:-1]]
    for field in dataclasses.fields(part):
        value, meta = getattr(part, field.name), field.metadata
        if meta.get("kind") == "leaf":
            found.append((field.name, meta, None if value is None else np.asarray(value).tolist()))
        elif meta.get("kind") == "static":
            if isinstance(value, tuple) and not all(type(i) is int for i in value):
                named = f"its {type(part).__name__}.{field.name}"
                raise InputError(f"{named} = {shortened(value)} is no list of tanks")
            found.append(
                (field.name, meta, [i + 1 for i in value] if isinstance(value, tuple) else value)
            )
    return found


PUMPS = {"unit": "V", "doc": "(m,) input of each pump before the first change"}
