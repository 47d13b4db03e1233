"""The schema of a rig file, from schema.toml: a Key for each value, a Section for each table."""

import dataclasses
import tomllib
from pathlib import Path
from typing import Any

from jaxtank.core.labels import OF_OPENINGS
from jaxtank.core.units import DEFAULT, local
from jaxtank.instruments.actuators import PumpBank
from jaxtank.instruments.sensors import LevelSensor
from jaxtank.loop.closed_loop import ClosedLoop
from jaxtank.plants.elements import full_open
from jaxtank.plants.faults import Faults
from jaxtank.plants.network import TankNetwork
from jaxtank.signals.inflows import InflowPulses
from jaxtank.signals.setpoints import Ramps, Sine

NEEDED: Any = object()  # default of a key that a file must have

PARTS: dict[str, Any] = {"plant": TankNetwork, "actuator": PumpBank, "sensor": LevelSensor}
"""{part of the loop: class} whose fields a rig that is described tank by tank gives."""

OWNERS = PARTS | {"loop": ClosedLoop, "ramps": Ramps, "sine": Sine, "faults": Faults}
OWNERS |= {"inflows": InflowPulses}

_KINDS: dict[Any, str] = {bool: "flag", int: "integer", str: "choice", tuple: "tanks"}
_TYPES: dict[Any, Any] = {kind.__name__: kind for kind in (bool, int, float, str, tuple)}


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
    like: str | None = None
    infinite: bool = False

    @classmethod
    def of(cls, owner: type, field: str, **changes: Any) -> "Key":
        """Return the key of a component's field, with the unit, range and kind of the field."""
        spec = next(f for f in dataclasses.fields(owner) if f.name == field)
        names = ("unit", "doc", "low", "high", "strict", "shape", "like", "infinite")
        meta: dict[str, Any] = {k: spec.metadata[k] for k in names if k in spec.metadata}
        if spec.metadata["kind"] == "static":
            meta["kind"] = _KINDS.get(type_of(spec), "number")
            meta["choices"] = spec.metadata["choices"]
        return cls(**{"name": field, **meta, **changes})

    def meta(self, units: tuple[str, str] = DEFAULT) -> dict[str, Any]:
        """Return the metadata of a value, as of a leaf, in the units of a rig."""
        names = ("kind", "doc", "low", "high", "strict", "choices", "infinite")
        return {**{k: getattr(self, k) for k in names}, "unit": self.local_unit(units)}

    def local_unit(self, units: tuple[str, str]) -> str:
        """Return its unit in the units of a rig; of a curve, those of its two columns."""
        if self.unit.startswith("opening"):  # of a valve, a share
            unit = "%" if full_open(units) > 1.0 else "-"
            return self.unit.replace("opening", unit).replace("-/", "1/")
        columns = [local(unit, units) for unit in self.unit.split(", ")]
        return ", ".join(columns) if set(columns) != {"-"} else "-"


@dataclasses.dataclass(frozen=True)
class Section:
    """A table of a rig file, or a list of tables; its fields are explained in schema.toml."""

    name: str
    keys: tuple[Key, ...] = ()
    many: bool = False
    prose: str = ""
    per: str = ""
    elsewhere: str = ""
    called: str = ""

    @property
    def title(self) -> str:
        """The line that begins the table: "[plant]", "[[tank]]"; "" of the top of a file."""
        name = self.called or self.name
        return f"[[{name}]]" if self.many else f"[{name}]" if name else ""

    def on(self, plant: Any) -> "Section":
        """Return the section of a controller that has only valves to move, with its units."""
        if not getattr(plant, "valves", ()) or plant.feeds or plant.units[1] == "%":
            return self
        of_opening = lambda key: dataclasses.replace(key, unit=OF_OPENINGS.get(key.unit, key.unit))
        keys = (of_opening(key) if key.shape == ("output",) else key for key in self.keys)
        return dataclasses.replace(self, keys=tuple(keys))

    @property
    def names(self) -> list[str]:
        return [key.name for key in self.keys]

    def __getitem__(self, name: str) -> Key:
        return next(key for key in self.keys if key.name == name)


def type_of(field: dataclasses.Field[Any]) -> Any:
    """The type of a field, also where `from __future__ import annotations` makes it a text."""
    kind: Any = field.type
    return _TYPES.get(kind, kind)


def _key(name: str, row: dict[str, Any]) -> Key:
    values: dict[str, Any] = row | {n: tuple(row[n]) for n in {"shape", "choices"} & row.keys()}
    if values.pop("optional", False):
        values["default"] = None
    if "of" not in values:
        return Key(name, **values)
    part, field = values.pop("of").split(".")
    if part in PARTS or part == "loop":
        values["target"] = f"{part}.{field}".removeprefix("loop.")
    return Key.of(OWNERS[part], field, name=name, **values)


def _sections() -> dict[str, Section]:
    tables = tomllib.loads(Path(__file__).with_name("schema.toml").read_text("utf-8"))
    keys = {n: tuple(_key(*row) for row in t.get("keys", {}).items()) for n, t in tables.items()}
    return {name: Section(name, **table | {"keys": keys[name]}) for name, table in tables.items()}


SECTIONS = _sections()  # {name: Section} of a rig file, in the order in which it is written

OPEN_LOOP = SECTIONS.pop("open-loop").keys
"""[controller] of kind "open-loop"; of other kinds the keys are the fields of the class."""

INFLOW_TABLE = dataclasses.replace(SECTIONS.pop("inflow-table"), name="inflow")
"""A table of [[inflow]] that is a measured inflow and no pulse."""

WEIGHT = Key("weight", "weight in the sum that is minimised", low=0.0, default=1.0)
SHARE = Key("share", "share", low=0.0, high=1.0, strict=True, default=0.05)

LISTS = tuple(name for name, section in SECTIONS.items() if section.per)
"""Sections with a table for each tank, orifice, pipe, spill, pump and valve."""

INPUTS = ("pump", "valve")  # lists whose tables are the inputs of a rig, in this order

TANKWISE = (*LISTS, "plant", "units")
"""What describes a rig tank by tank, and is not given beside `case`."""


def targets(*names: str) -> set[str]:
    """The fields of the loop that keys of these sections hold, such as "actuator.low"."""
    return {key.target for name in names for key in SECTIONS[name].keys if key.target}
