"""Lines of a rig file: values as TOML, a section as a block of "key = value" with what
each key is.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from jaxtank.core.toml_schema import Section
from jaxtank.core.units import DEFAULT
from jaxtank.rig.entry import unit, written


class Line(NamedTuple):
    """A line "name = value" of a rig file; on: False where it is a suggestion, commented out."""

    name: str
    value: Any
    meta: Mapping[str, Any]
    on: bool = True


class Block(NamedTuple):
    """A table of a rig file; title: "[values]" or "" for lines that go on; prose: sentences above
    it; on: False: commented out as a whole.
    """

    title: str
    lines: list
    prose: tuple = ()
    on: bool = True


def lines_of(section: Section, values: Mapping[str, Any], units=DEFAULT) -> list[Line]:
    """Return the lines of a section's keys that have a value, in the order of its schema."""
    return [
        Line(k.name, written(k, values[k.name]), k.meta(units))
        for k in section.keys
        if values.get(k.name) is not None
    ]


def block(section: Section, values: Mapping[str, Any], units=DEFAULT) -> Block:
    """Return the Block of a section with `lines_of` its values."""
    return Block(section.title, lines_of(section, values, units))


def suggestion(section: Section, values: Mapping[str, Any], units=DEFAULT) -> Block:
    """Return the Block of a section that could be in a file, commented out."""
    given = {k.name: k.default for k in section.keys if isinstance(k.default, (int, float, str))}
    lines = lines_of(section, {**given, **values}, units)
    return Block(section.title, lines, (section.prose,), False)


def terse(block: Block) -> list[str]:
    """Return the lines of a terse file: title, and "name = value  # [unit] doc" of what is on."""
    return [block.title] * bool(block.title) + [
        f"{line.name} = {toml(line.value)}" + (f"  # {note}" if (note := _note(line.meta)) else "")
        for line in block.lines
        if line.on
    ]


def _note(meta):
    return " ".join(filter(None, [unit(meta).strip(), meta["doc"]]))


def toml(value: Any) -> str:
    """Return `value` as TOML: numbers to their last digit, texts escaped, lists and tuples as
    arrays.

    Parameters
    ----------
    value : number, text, truth value, array, list, tuple or dict of such

    Returns
    -------
    Text of one line.

    Examples
    --------
    >>> toml([0.1, True, "a b"])
    '[0.1, true, "a b"]'
    """
    if isinstance(value, (np.generic, np.ndarray)):
        value = value.tolist()
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        escaped = value.replace("\\", "\\\\").replace('"', '\\"')
        return '"' + "".join(c if c.isprintable() else f"\\U{ord(c):08x}" for c in escaped) + '"'
    if isinstance(value, (list, tuple)):
        return "[" + ", ".join(toml(v) for v in value) + "]"
    if isinstance(value, dict):
        inside = ", ".join(f"{toml(k)} = {toml(v)}" for k, v in value.items())
        return f"{{ {inside} }}" if inside else "{}"
    return repr(value)
