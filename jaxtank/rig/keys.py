"""Lines and tables of a rig file, before they are text."""

from typing import Any, NamedTuple

from jaxtank.core.units import local
from jaxtank.rig.words import toml

BARE = {"unit": "-", "doc": ""}


class Key(NamedTuple):
    """A line "name = value" of a rig file; on: False where it is only a suggestion, commented out."""

    name: str
    value: Any
    meta: dict = BARE
    on: bool = True


class Section(NamedTuple):
    """A table of a rig file; title: "[values]" or "" for lines that go on; prose: sentences above it; on: False: commented out as a whole."""

    title: str
    keys: list
    prose: tuple = ()
    on: bool = True


def lines_of(section):
    """The lines of a Section in a terse file: its title, and "name = value  # [unit] what it is" of every key that is on."""
    return [section.title] * bool(section.title) + [
        f"{k.name} = {toml(k.value)}" + (f"  # {_note(k.meta)}" if _note(k.meta) else "") for k in section.keys if k.on
    ]


def _note(meta):
    return " ".join(filter(None, ["" if meta["unit"] == "-" else f"[{meta['unit']}]", meta["doc"]]))


def keys_of(found, units, on=True):
    """Keys of [(name, metadata, value)], units as the rig counts."""
    return [Key(name, value, {**meta, "unit": local(meta["unit"], units)}, on) for name, meta, value in found]
