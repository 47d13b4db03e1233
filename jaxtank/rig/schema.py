"""The schema of a rig file: a Key for each value, a Section of keys for each TOML table.

Reading, writing, `jaxtank init` and validation all follow `SECTIONS`.
"""

import dataclasses
import functools
from typing import Any

from jaxtank.core.units import DEFAULT, local
from jaxtank.instruments.actuators import PumpBank
from jaxtank.instruments.sensors import LevelSensor
from jaxtank.loop.closed_loop import ClosedLoop
from jaxtank.plants.faults import Faults
from jaxtank.plants.network import TankNetwork
from jaxtank.signals.inflows import InflowPulses
from jaxtank.signals.setpoints import Ramps, Sine

NEEDED: Any = object()
"""Default of a key that a file must have."""


@dataclasses.dataclass(frozen=True)
class Key:
    """A key of a section: what it is, which values it may have, and where its value goes."""

    name: str
    doc: str = ""
    kind: str = "number"
    unit: str = "-"
    low: float | None = None
    high: float | None = None
    strict: bool = False
    choices: tuple[Any, ...] | None = None
    default: Any = NEEDED
    shape: tuple[Any, ...] = ()
    target: str = ""

    @classmethod
    def of(cls, owner: type, field: str, doc: str = "", **changes: Any) -> "Key":
        """Return the key of a component's field: unit, description, range and kind are
        the field's.
        """
        found = next(f for f in dataclasses.fields(owner) if f.name == field)
        meta = found.metadata
        own: dict[str, Any] = {
            k: meta[k] for k in ("unit", "doc", "low", "high", "strict", "shape") if k in meta
        }
        if meta["kind"] == "static":
            own |= {"kind": _KINDS.get(type_of(found), "number"), "choices": meta["choices"]}
        if doc:
            own["doc"] = doc
        values: dict[str, Any] = {"name": field, **own, **changes}
        return cls(**values)

    def meta(self, units: tuple[str, str] = DEFAULT) -> dict[str, Any]:
        """Return the metadata of a value, as of a leaf, in the units of a rig."""
        found = {k: getattr(self, k) for k in ("kind", "doc", "low", "high", "strict", "choices")}
        return {**found, "unit": local(self.unit, units)}


@dataclasses.dataclass(frozen=True)
class Section:
    """A table of a rig file, or a list of tables."""

    name: str
    keys: tuple[Key, ...] = ()
    many: bool = False
    prose: str = ""
    per: str = ""
    elsewhere: tuple[Any, ...] = ()

    @property
    def title(self) -> str:
        """The line that begins the table: "[plant]", "[[tank]]"; "" of the top of a file."""
        return f"[[{self.name}]]" if self.many else f"[{self.name}]" if self.name else ""

    @property
    def names(self) -> list[str]:
        """The names of its keys."""
        return [key.name for key in self.keys]

    def __getitem__(self, name: str) -> Key:
        return next(key for key in self.keys if key.name == name)


_KINDS: dict[Any, str] = {bool: "flag", int: "integer", str: "choice", tuple: "tanks"}
_TYPES: dict[Any, Any] = {kind.__name__: kind for kind in (bool, int, float, str, tuple)}


def type_of(field: dataclasses.Field[Any]) -> Any:
    """The type of a field, also where `from __future__ import annotations` makes it a text."""
    kind: Any = field.type
    return _TYPES.get(kind, kind)


def _of(owner, part, field, doc, name="", **changes):
    """The key of a component's field that is a part of the loop."""
    target = f"{part}.{field}" if part else field
    return Key.of(owner, field, doc, name=name or field, target=target, **changes)


_plant = functools.partial(_of, TankNetwork, "plant")
_pump = functools.partial(_of, PumpBank, "actuator")
_sensor = functools.partial(_of, LevelSensor, "sensor")
_optional = functools.partial(Key, default=None)
BY_NAME = "by name or number from 1"

TOP = (
    _optional("case", "the preset that this file starts from", "choice"),
    _optional("name", "what reports call it", "text"),
    _optional(
        "reachable",
        "whether every plateau of the reference must have a steady state",
        "flag",
        choices=(True, False),
    ),
    Key("units", "[length, pump input]", "any", default=list(DEFAULT)),
)
TANK = (
    Key("name", "what other tables may call it, instead of its number from 1", "text", default=""),
    _plant("area", "cross-section A"),
    _plant("rim", "height"),
    _plant("drain", "effective orifice area to the basin; 0: closed", default=0.0),
    _of(ClosedLoop, "", "x0", "level at t = 0", name="level", default=0.0),
    Key(
        "inflow",
        "steady inflow that no pump brings; negative: a leak",
        unit="cm^3/s",
        default=0.0,
        target="disturbance.level",
    ),
    _sensor("noise", "standard deviation of the noise of its sensor", default=0.0),
)
ORIFICE = (
    Key("from", f"the tank that it leaves, {BY_NAME}", "tank", target="plant.links.0"),
    Key("to", f"the tank that it flows into, {BY_NAME}", "tank", target="plant.links.1"),
    _plant("orifice", "effective area", name="area"),
)
PIPE = (
    Key("between", "the two tanks that it joins, below the surface", "pair", target="plant.pipes"),
    _plant("pipe", "effective area", name="area"),
)
SPILL = (
    Key("from", f"the tank whose rim is passed, {BY_NAME}", "tank", target="plant.spills.0"),
    Key("to", f"the tank that it falls into, {BY_NAME}", "tank", target="plant.spills.1"),
    _plant("caught", "share that falls into it", default=1.0),
)
PUMP = (
    Key("name", "a note; nothing refers to it", "text", default=""),
    _plant("pump_gain", "flow per unit of the pump's input (Kp)", name="gain"),
    Key("to", "the tank that it fills, or [first, second]", "feed", target="plant.feeds"),
    _plant("split", "share that goes to the first of two tanks", default=1.0),
    _pump("low", "lower limit", default=0.0),
    _pump("high", "upper limit"),
    _pump("initial", "input at which it ran before t = 0", default=0.0),
)
PLANT = (
    _optional(
        "outputs",
        "the tanks whose levels are controlled; left out: those that the pumps fill first",
        "tanks",
        target="plant.outputs",
    ),
    *(_plant(name, "", default=None) for name in ("gravity", "overflow", "bottom", "knee")),
)
KIND = Key("kind", kind="any")
"""The key that names the class of a controller or an observer; its doc lists the classes."""
FILTER = "time constant of a first-order filter behind the ramps of each; 0: none"
COURSE = tuple(Key.of(Ramps, name, default=None) for name in ("ramp", "shape"))
OPEN_LOOP = (
    KIND,
    _optional(
        "initial", "input of each pump before the first change", "list", "V", shape=("pump",)
    ),
    _optional("changes", "[time in s, pump from 1, input] of each change", "any", "V"),
    *COURSE,
    Key.of(Ramps, "filter", FILTER, kind="array", default=None, shape=("pump",)),
)
"""[controller] of kind "open-loop"; of other kinds the keys are the fields of the class."""
REFERENCE = (
    _optional(
        "initial",
        "setpoint of each output before the first change",
        "list",
        "cm",
        shape=("output",),
    ),
    _optional("changes", "[time in s, output from 1, setpoint] of each change", "any", "cm"),
    *COURSE,
    Key.of(Ramps, "band", default=None),
    Key.of(Ramps, "filter", FILTER, kind="array", default=None, shape=("output",)),
    _optional("sine", "a sine on top: [reference.sine]; {}: none", "table"),
)
SINE = (
    Key.of(Sine, "amplitude"),
    Key.of(Sine, "offset", default=0.0),
    Key.of(Sine, "period"),
    Key.of(Sine, "zero", default=0.0),
    Key.of(Sine, "start", default=0.0),
    Key.of(Sine, "end", default=1e9),
    Key("output", "the output it moves, from 1", "integer", low=1, target="channel"),
)
DISTURBANCE = (
    _optional(
        "inflow",
        "steady inflow of each tank that no pump brings; negative: a leak",
        "list",
        "cm^3/s",
        shape=("tank",),
    ),
    Key.of(InflowPulses, "window", default=None),
)
INFLOW = (
    Key("time", "when it begins", unit="s", low=0.0),
    Key("duration", "how long it lasts", unit="s", low=0.0, strict=True),
    Key("tank", f"the tank, {BY_NAME}", "tank"),
    Key("volume", "volume of the pulse; negative: taken out", unit="cm^3"),
)
FAULT = (
    Key("of", "the entry of the plant that changes, counted from 0", "text"),
    Key("start", "when it begins", unit="s", low=0.0),
    Key("end", "when it is over", unit="s"),
    Key.of(Faults, "factor", "what the entry is multiplied by", default=1.0),
    Key.of(Faults, "extra", "what is added to it, in its own unit", default=0.0),
)
SCHEDULE = (
    Key("gains", "names of the gains that follow the variable", "texts"),
    Key("variable", "a setpoint, r1 .., or a level, h1 ..", "any"),
    Key("knots", "values of the variable at which the gains are given", "array", "cm"),
)
COVARIANCE = (
    Key("names", "parameters, an array's entry by name[i]", "texts"),
    Key("matrix", "their covariance, in their units", "any"),
)
SAFETY_FILTER = (
    _optional(
        "limit",
        "level that each tank may not pass; left out: [limits] max_level, else its rim",
        "list",
        "cm",
        shape=("tank",),
    ),
    _optional(
        "low",
        "level below which no tank may fall, 0: none; left out: [limits] min_level, else none",
        "list",
        "cm",
        shape=("tank",),
    ),
    _optional(
        "band",
        "largest difference of reading and level; left out: 6 standard deviations of the"
        " noise, half an ADC step and the offset",
        "list",
        "cm",
        shape=("tank",),
    ),
    _optional(
        "rate", "how fast a level may approach its limit (kappa)", unit="1/s", low=0.0, strict=True
    ),
    _optional(
        "predict",
        "predict levels over the inputs under way, where that is proved; left out: true",
        "flag",
    ),
    _optional(
        "widths",
        "half width of the interval of each parameter of the plant, by name; left out: those of"
        " [covariance] or [uncertain]",
        "table",
    ),
)
SCENARIO = (
    _optional("name", "what reports call it", "text"),
    Key("seed", "of its sensor noise", "integer", low=0, high=2**31 - 1, default=0),
    Key("weight", "in the mean over scenarios", low=0.0, strict=True, default=1.0),
    Key(
        "values",
        'what is different in it, by name: numbers, or relative to the case "x1.3" (times), "by'
        ' -0.5" (less), "0.02 if zero", and "steady" for x0, actuator.initial and'
        " reference.initial",
        "table",
        default={},
    ),
)
WEIGHT = Key("weight", "weight in the sum that is minimised", low=0.0, default=1.0)
SHARE = Key("share", "share", low=0.0, high=1.0, strict=True, default=0.05)

_ALL = (
    Section("", TOP),
    Section("tank", TANK, many=True, per="area", elsewhere=("sensor", LevelSensor)),
    Section("orifice", ORIFICE, many=True, per="links"),
    Section("pipe", PIPE, many=True, per="pipes"),
    Section("spill", SPILL, many=True, per="spills"),
    Section("pump", PUMP, many=True, per="feeds", elsewhere=("actuator", PumpBank)),
    Section("plant", PLANT),
    Section("controller"),
    Section("observer"),
    Section("sensor"),
    Section("actuator"),
    Section("reference", REFERENCE),
    Section(
        "reference.sine",
        SINE,
        prose="A sine on top of the ramps of one output, for a while; names are then"
        " reference.first.ramp and so on.",
    ),
    Section(
        "disturbance",
        DISTURBANCE,
        prose="A steady inflow of each tank, or pulses of inflow, [[inflow]]: one of the two.",
    ),
    Section(
        "inflow",
        INFLOW,
        many=True,
        prose="A pulse of inflow into a tank, for recovery_time; as many as you like.",
    ),
    Section(
        "fault",
        FAULT,
        many=True,
        prose="A fault of the plant that is unknown to the controller; as many as you like.",
    ),
    Section(
        "schedule",
        SCHEDULE,
        prose="Gains that follow a setpoint or a level, linear between knots; they start from the"
        ' value above. Theirs are then "controller.values", a row per gain; [free] may name the'
        " gain for all its knots.",
    ),
    Section("values"),
    Section("limits"),
    Section("free"),
    Section("objective"),
    Section("uncertain"),
    Section(
        "covariance",
        COVARIANCE,
        prose="Parameters that vary together, as `jaxtank identify` writes them; used in the place"
        " of [uncertain].",
    ),
    Section(
        "safety_filter",
        SAFETY_FILTER,
        prose="Caps on the pumps under which no level passes its limit on any plant of the"
        " intervals; what is proved is in `jaxtank show`.",
    ),
    Section(
        "scenario",
        SCENARIO,
        many=True,
        prose="A run that `tune` judges by, in the place of the case's own; as many as you like.",
    ),
    Section(
        "log",
        prose="Columns of the experiment data for jaxtank identify, where its header does not name"
        " them: [header, unit].",
    ),
)
SECTIONS = {section.name: section for section in _ALL}
"""{name: Section} of a rig file, in the order in which it is written."""

TANKWISE = (*(s.name for s in _ALL if s.per), "plant", "units")
"""What describes a rig tank by tank, and is not given beside `case`."""


def targets(*names):
    """The fields of the loop that keys of these sections hold, such as "actuator.low"."""
    return {key.target for name in names for key in SECTIONS[name].keys if key.target}
