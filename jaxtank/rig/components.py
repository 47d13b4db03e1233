"""[controller], [observer], [sensor] and [actuator] of a rig file: a component by its kind."""

import dataclasses
import inspect
import re
from typing import NamedTuple

import numpy as np

from jaxtank import controllers, observers
from jaxtank.controllers.pid import SharedPID
from jaxtank.core.errors import EquilibriumError, InputError, unknown
from jaxtank.core.installed import imported, installed
from jaxtank.core.text import shortened
from jaxtank.core.tree import number
from jaxtank.core.units import DEFAULT
from jaxtank.instruments import Actuator, LevelSensor, PumpBank, Sensor
from jaxtank.loop.steady import circulating, start_inflow, steady_state
from jaxtank.plants.elements import input_flows
from jaxtank.plants.hydraulics import in_unit
from jaxtank.rig.entry import Problems, hyphened, is_texts, read_entry, sizes_of, unknown_keys
from jaxtank.rig.schema import NEEDED, OPEN_LOOP, Key, Section, type_of
from jaxtank.rig.signals import entry_named, ramp_values, ramps_of
from jaxtank.rig.values import dotted_name
from jaxtank.signals.setpoints import Ramps, ramps


class Role(NamedTuple):
    """A part of the loop; `kept`: fields its section may leave out; `default`: needs no section."""

    base: type
    classes: dict
    kept: tuple = ()
    default: type | None = None


ROLES = {  # {section, which is also the field of the loop: Role}; `register` adds classes
    "controller": Role(
        controllers.Controller,
        {
            "pid": controllers.PID,
            "pi": controllers.PID,
            "p": controllers.PID,
            "split-range": controllers.SplitRange,
            "cascade": controllers.Cascade,
            "flow-cascade": controllers.FlowCascade,
            "override": controllers.Override,
            "ratio": controllers.Ratio,
            "reference-governor": controllers.ReferenceGovernor,
            "on-off": controllers.OnOff,
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
            "nmpc": controllers.NMPC,
            "open-loop": controllers.OpenLoop,
        },
    ),
    "observer": Role(
        observers.Observer,
        {
            "direct": observers.Direct,
            "disturbance": observers.DisturbanceObserver,
            "kalman": observers.Kalman,
            "extended-kalman": observers.ExtendedKalman,
            "unscented-kalman": observers.UnscentedKalman,
            "moving-horizon": observers.MovingHorizon,
            "fault-bank": observers.FaultBank,
        },
    ),
    "sensor": Role(Sensor, {"level": LevelSensor}, ("noise",), LevelSensor),
    "actuator": Role(Actuator, {"pumps": PumpBank}, ("low", "high", "initial"), PumpBank),
}

REGISTERED: set[str] = set()  # kinds that were added by `register`

GROUP = "jaxtank.components"
"""Entry points by which an installed package names its classes: kind = "package.module:Class"."""

_KIND = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]*")
_FIELDS = (bool, int, float, str, tuple)


def register(kind: str, cls: type) -> type:
    """Give a controller, observer, sensor or actuator of yours a name in rig files.

    `kind = "..."` of [controller] (a controller), [observer], [sensor] or [actuator] then makes a
    component of the class. Its leaves and static fields are keys of the table; a field `model` is
    the plant of the rig. A static field of type tuple holds tanks, which a file counts from 1.
    `rig.dump`, `rig.complete` and `result.save` write such a case.

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
    ... [controller]
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
    known = _classes_of(cls)
    taken = next((r.classes[kind] for r in ROLES.values() if kind in r.classes), None)
    if taken not in (None, cls):
        raise InputError(f"kind {kind!r} is taken, by {taken.__name__}: choose another name")
    other = next((k for k, c in known.items() if c is cls), None)
    if other is not None and taken is None:
        raise InputError(f"{cls.__name__} has a name in rig files already: {other!r}")
    if taken is None:
        known[kind] = cls
        REGISTERED.add(kind)
    return cls


def _classes_of(cls):
    """The {kind: class} of the role of `cls`; InputError for what a rig file cannot describe."""
    name = getattr(cls, "__name__", shortened(cls))
    roles = [r for r in ROLES.values() if isinstance(cls, type) and issubclass(cls, r.base)]
    if not roles or "__dataclass_fields__" not in vars(cls) or inspect.isabstract(cls):
        raise InputError(
            f"{name} is no component: it must be a class of Controller, Observer, Sensor or"
            " Actuator with its own step, made by jaxtank.component"
        )
    for field in dataclasses.fields(cls):
        if why := _unwritable(field):
            raise InputError(f"{name}.{field.name}: {why}")
    return roles[0].classes


def _unwritable(field):
    """Why a rig file cannot set the field of a component; "" where it can."""
    kind = field.metadata.get("kind")
    if field.name == "kind":
        return "a rig file has this key for the name of the class: give the field another name"
    if kind == "static" and type_of(field) not in _FIELDS:
        types = ", ".join(kind.__name__ for kind in _FIELDS)
        return f"a static field must be one of {types} to be set by a rig file"
    if kind is None and field.name != "model":
        return "a rig file sets fields made by leaf(...) and static(...), and `model`"
    return ""


USUAL = {"spread": 0.0}  # defaults of fields that a rig file may leave out

WITHOUT = {
    "pumps": ("delays",),
    "p": ("Ti", "Td", "order", "Tt", "b", "anti_windup", "N"),
    "pi": ("Td", "order", "N"),
    "ratio": ("feed_forward",),
    "reference-governor": ("feed_forward", "order"),
    "cascade": ("feed_forward", "order"),
    "flow-cascade": ("feed_forward", "order", "inner"),
}
"""{kind: fields that its table has not}: of a PID under a name of its own; keys of [[pump]]."""

INPUTS = ("sequence", "reverse", "lead", "follow")  # static fields that hold inputs, not tanks

LIMITED = ("on-off", "split-range", "ratio", "reference-governor", "nmpc")
"""Kinds whose `low` and `high` are by default the limits of the actuator."""

LENGTHS = {"level_floor": 0.01, "difference_floor": 0.01, "penalty": 1e3}
"""Such defaults in centimetres [cm], converted to the rig's unit of length."""


def section_of(name, kind, units=DEFAULT):
    """Return the Section of a kind of component: the leaves and static fields of its class."""
    classes = ROLES[name].classes
    cls, first = classes[kind], Key("kind", f"one of {', '.join(classes)}", "any")
    if cls is controllers.OpenLoop:
        return Section(name, (first, *OPEN_LOOP[1:]))
    settable = [f for f in dataclasses.fields(cls) if f.metadata.get("kind") in ("leaf", "static")]
    settable = [f for f in settable if f.name not in WITHOUT.get(kind, ())]
    return Section(name, (first, *(_key(cls, f, kind, units) for f in settable)))


def _key(cls, field, kind, units):
    """The Key of a field of a class; a registered class has no defaults of ours."""
    default = NEEDED if field.default is dataclasses.MISSING else None
    if kind not in REGISTERED:
        default = USUAL.get(field.name, default)
        if field.name in LENGTHS:
            default = in_unit(LENGTHS[field.name], units[0])
    if kind == "pi" and field.name == "Ti":
        default = NEEDED
    changes = {}
    if issubclass(cls, observers.ExtendedKalman) and field.name == "coefficients":
        changes["kind"] = "texts"
    if issubclass(cls, controllers.PID) and field.name in INPUTS:
        changes["kind"] = "sequence" if field.name == "sequence" else "inputs"
    if field.metadata["kind"] == "leaf":
        changes["kind"] = "array" if field.metadata["shape"] else "scalar"
    doc = field.metadata["doc"].replace("counted from 0", "counted from 1")  # as a file has tanks
    return Key.of(cls, field.name, doc=doc, default=default, **changes)


def controller_of(table, loop, bias=None):
    if isinstance(table, controllers.Controller):  # of Python
        return table
    if isinstance(table, dict) and table.get("kind") == "open-loop":
        start = ramps(np.asarray(loop.actuator.initial).tolist(), [], ramp=0.0)
        section, sizes = section_of("controller", "open-loop"), sizes_of(loop)
        section = dataclasses.replace(section, name="inputs")  # as its table may be called
        signal = ramps_of(section, table, start, ("pump", "input"), sizes)
        return controllers.OpenLoop(signal=signal)
    steady = steady_bias(loop) if bias is None else bias
    offered = _offered(table, loop, steady)
    controller = component("controller", table, loop, offered, model_of(loop))
    if isinstance(controller, controllers.PID | controllers.OnOff):
        controller.check_inputs()
    if isinstance(controller, controllers.PID):
        return with_bias(controller, loop, steady, [name for name in BIASES if name not in table])
    return controller


def _offered(table, loop, steady):
    """The values that a [controller] table may leave out: bias, limits, inputs that stand still."""
    bank, kind = loop.actuator, table.get("kind") if isinstance(table, dict) else None
    limited = kind in LIMITED
    cls = ROLES["controller"].classes.get(kind) if isinstance(kind, str) else None
    if cls is None or not issubclass(cls, controllers.PID):
        offered = {"bias": steady}
    else:  # a bias of a PID is known once its inputs are
        offered = {name: np.zeros(len(loop.plant.outputs)) for name in BIASES}
        if not {"follow", "follow_inflow"} & table.keys():
            offered["held"] = bank.initial
        limited = limited or "lead" in table
    if limited:
        offered |= {"low": bank.low, "high": bank.high}
    return offered


BIASES = ("bias", "inner_bias")
"""Fields that follow from the steady state at t = 0 where a file leaves them out."""


def with_bias(controller, loop, inputs, names=BIASES):
    """Return a controller whose fields `names` of BIASES are those of steady inputs (m,)."""
    biases = {"bias": inputs}
    inflow = start_inflow(loop)
    if isinstance(controller, SharedPID):
        biases["bias"] = controller.total(inputs)
    if isinstance(controller, controllers.Cascade):
        steady = _steady(loop)
        levels = np.asarray(loop.x0 if steady is None else steady[0], dtype=float)
        readings = levels[list(controller.inner)]
        if isinstance(controller, controllers.FlowCascade):
            readings = input_flows(loop.plant, levels, loop.actuator.driving(tuple(inputs)))
        biases = {"bias": readings, "inner_bias": inputs}
    if getattr(controller, "inflow_gain", None) is not None and inflow is not None:
        measured = np.asarray(inflow)[list(controller.inflow_tanks)]
        biases["bias"] = np.asarray(biases["bias"]) - controller.inflow_gain * measured
    known = {name: number(value) for name, value in biases.items() if name in names}
    return dataclasses.replace(controller, **known)


def _steady(loop):
    """(levels (n,), inputs (m,)) of the steady state with the outputs of x0, None without one."""
    try:
        outputs = np.asarray(loop.x0, dtype=float)[list(loop.plant.outputs)]
        closed = circulating(loop, loop.plant, outputs, start_inflow)
        return closed or steady_state(loop, outputs, inflow=start_inflow)
    except (EquilibriumError, InputError, FloatingPointError):
        return None


def observer_of(table, loop):
    """Return the observer of an [observer] table, whose model is that of the loop's controller."""
    offered = {
        "levels": np.asarray(loop.x0),
        "inputs": loop.actuator.initial,
        "measured": list(range(1, loop.plant.tanks + 1)),
    }
    if isinstance(table, dict) and is_texts(table.get("coefficients")):
        names = [entry_named(name, loop.plant) for name in table["coefficients"]]
        names = [dotted_name(loop, name).removeprefix("plant.") for name in names]
        table = {**table, "coefficients": names}
    return component("observer", table, loop, offered, model_of(loop))


def model_of(loop):
    """Return the model of the loop's controller, the plant where it has none that fits."""
    plant, model = loop.plant, getattr(getattr(loop.controller, "law", loop.controller), "model", 0)
    fits = (getattr(model, "tanks", 0), getattr(model, "pumps", 0)) == (plant.tanks, plant.pumps)
    return model if fits else plant


OF_ROWS = ("dead_zone", "rate", "lag", "delay", "delays")
"""Fields of an actuator that [[pump]] and [[valve]] have given where [actuator] leaves them out."""


def instrument_of(name, table, loop, of_rows=False):
    """Return the sensor or actuator of a table; `kept` fields that it leaves out are the loop's,
    and those of OF_ROWS of an actuator that rows of the same file made."""
    part = getattr(loop, name)
    unchanged = {key: getattr(part, key) for key in ROLES[name].kept}
    more = {key: getattr(part, key, None) for key in (OF_ROWS if of_rows else ())}
    unchanged |= {key: v for key, v in more.items() if v is not None and np.size(v)}
    return component(name, table, loop, unchanged)


def component(name, table, loop, offered, model=None):
    """Return the component of a table, by default `offered`; model: its plant, or the loop's."""
    role, plant = ROLES[name], loop.plant if model is None else model
    if isinstance(table, role.base):  # of Python
        return table
    kind = _kind_in(name, table)
    section, cls = section_of(name, kind, plant.units), role.classes[kind]
    if kind not in REGISTERED or role.kept:
        table = {**{k: v for k, v in offered.items() if k in section.names}, **table}
    values = read_entry(section, table, sizes_of(loop), title=f"{section.title} {kind}")
    del values["kind"]
    return cls(**values, **({"model": plant} if "model" in cls.__dataclass_fields__ else {}))


def _kind_in(name, table):
    role = ROLES[name]
    if not isinstance(table, dict):
        raise InputError(f"[{name}]: must be a table")
    if "kind" not in table:
        raise InputError(f"[{name}] needs kind = one of {', '.join(role.classes)}")
    kind, kinds = table["kind"], role.classes
    if isinstance(kind, str) and kind not in kinds:
        points = installed(GROUP)
        if kind in points:
            register(kind, imported(points[kind]))
        kinds = kinds | points
    if not isinstance(kind, str) or kind not in role.classes:
        raise unknown(f"{name} kind", str(kind), kinds)
    # a ratio of which no input follows: those that do not lead stand still
    return "ratio" if role.classes[kind] is controllers.PID and "lead" in table else kind


def with_kind(name, table):
    """A table of a component with its kind as it is registered: "PI" is "pi"."""
    kind, known = table.get("kind") if isinstance(table, dict) else None, ROLES[name].classes
    if isinstance(kind, str) and kind not in known and hyphened(kind) in known:
        return {**table, "kind": hyphened(kind)}
    return table


def check_keys(name, table):
    """Raise InputError for a kind or keys of a table that are unknown, whatever its rig is."""
    if name not in table or isinstance(table[name], ROLES[name].base):
        return
    problems, row = Problems(), table[name]
    if isinstance(row, dict) and row.get("kind") == "open-loop":  # `controller_of` checks them
        return
    with problems.collect((name, None, "kind")):
        section = section_of(name, _kind_in(name, row))
        problems += unknown_keys(section, row, name, (name, None))
    problems.check()


def steady_bias(loop, known: bool | list[bool] = False):
    """Return (m,) inputs that hold the outputs at x0; those before t = 0 if `known`."""
    bank, steady = loop.actuator, _steady(loop)
    if steady is None:
        return bank.initial
    return number(np.where(known, bank.initial, np.clip(steady[1], bank.low, bank.high)))


def leaves_out(table, values):
    """The names of BIASES that a [controller] table and {name: value} of [values] leave out."""
    kind = table.get("kind") if isinstance(table, dict) else None
    cls = None if kind in REGISTERED else ROLES["controller"].classes.get(kind)
    fields = getattr(cls, "__dataclass_fields__", ())
    stated = {name.split("[")[0].removeprefix("controller.") for name in values}
    return [n for n in BIASES if n in fields and n not in table and n not in stated]


def kind_of(name, part):
    """The kind of a component in a section of a rig file, None where it has none."""
    if type(part) is controllers.PID:
        if part.Td is not None or part.order is not None:
            return "pid"
        return "pi" if part.Ti is not None else "p" if part.Tt is None else "pid"
    return next((kind for kind, cls in ROLES[name].classes.items() if cls is type(part)), None)


def values_of(name, part):
    """Return (section, {key: value}) of a component; InputError where no rig file describes it."""
    kind, cls = kind_of(name, part), type(part).__name__
    if kind is None:
        raise InputError(f"its {cls} has no name in a rig file")
    section = section_of(name, kind)
    if isinstance(part, controllers.OpenLoop):
        if not isinstance(part.signal, Ramps):
            raise InputError("its OpenLoop plays a signal that no rig file describes")
        return section, {"kind": kind, **ramp_values(part.signal)}
    values = {key.name: getattr(part, key.name) for key in section.keys[1:]}
    values = {n: v for n, v in values.items() if section[n].kind != "texts" or v}
    for key in section.keys:
        tanks = values.get(key.name)
        if key.kind == "tanks" and not all(type(i) is int for i in tanks or ()):
            raise InputError(f"its {cls}.{key.name} = {shortened(tanks)} is no list of tanks")
    return section.on(getattr(part, "model", None)), {"kind": kind, **values}
