"""What a section of a TOML file may hold: a Key, and a Section of keys.

`jaxtank.rig.schema` makes the schema of a rig file of them; may import the rest of `core`.
"""

import dataclasses
from typing import Any

from jaxtank.core.units import DEFAULT, local

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
