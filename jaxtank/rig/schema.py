"""How values are written in a rig file, and what may be said of them: numbers, ranges, units."""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from jaxtank.core.checks import check_value
from jaxtank.core.errors import InputError
from jaxtank.core.text import shortened
from jaxtank.core.units import local

BARE = {"unit": "-", "doc": ""}


class Key(NamedTuple):
    """A line "name = value" of a rig file; on: False where it is only a suggestion, commented out."""

    name: str
    value: Any
    meta: Mapping[str, Any] = BARE
    on: bool = True


class Section(NamedTuple):
    """A table of a rig file; title: "[values]" or "" for lines that go on; prose: sentences above
    it; on: False: commented out as a whole.
    """

    title: str
    keys: list
    prose: tuple = ()
    on: bool = True


def lines_of(section):
    """The lines of a Section in a terse file: its title, and "name = value  # [unit] what it is" of
    every key that is on.
    """
    return [section.title] * bool(section.title) + [
        f"{k.name} = {toml(k.value)}" + (f"  # {_note(k.meta)}" if _note(k.meta) else "")
        for k in section.keys
        if k.on
    ]


def _note(meta):
    return " ".join(filter(None, ["" if meta["unit"] == "-" else f"[{meta['unit']}]", meta["doc"]]))


def keys_of(found, units, on=True):
    """Keys of [(name, metadata, value)], units as the rig counts."""
    return [
        Key(name, value, {**meta, "unit": local(meta["unit"], units)}, on)
        for name, meta, value in found
    ]


SMALL_INT = (int, np.integer)


def toml(value: Any) -> str:
    """`value` as TOML: numbers to their last digit, texts escaped, lists and tuples as arrays."""
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


def name_of(where, value):
    """`value` if it can be a name: a text of one line without control characters, which a terminal
    would obey.
    """
    if not isinstance(value, str) or not value.isprintable():
        raise InputError(
            f"{where} = {shortened(value)}: must be a text"
            + " of printable characters" * isinstance(value, str)
        )
    return value


def is_numeric(value):
    """True for a number that a float can hold, and for lists of such numbers and arrays of a
    regular shape.
    """
    if isinstance(value, (np.ndarray, np.generic)):
        return np.issubdtype(value.dtype, np.number)
    if isinstance(value, (list, tuple)):
        return all(is_numeric(v) for v in value) and len({np.shape(v) for v in value}) <= 1
    try:
        return (
            isinstance(value, (int, float))
            and not isinstance(value, bool)
            and float(value) is not None
        )
    except OverflowError:
        return False


def is_finite(value):
    """True for what `is_numeric` is true for, if every number is finite. A whole number is taken as
    the float next to it: numpy's own answer to one of 2^64 and more is a TypeError.
    """
    return is_numeric(value) and bool(np.all(np.isfinite(np.asarray(value, dtype=float))))


def plain(name, value):
    """`value` as a float; InputError, naming it `name`, unless it is a number."""
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not is_numeric(value):
        raise InputError(f"{name} = {shortened(value)}: must be a number")
    return float(value)


def static_value(name, value, meta, kind):
    """`value` for a static field of type `kind` (bool, int, float or str); InputError where it is
    another, out of range, or no choice.
    """
    if meta["choices"] is not None:
        if (
            isinstance(value, (list, dict))
            or value not in meta["choices"]
            or isinstance(value, bool) != (kind is bool)
        ):
            raise InputError(
                f"{name} = {shortened(value)}: must be one of {_choices(meta['choices'])}"
            )
        return value
    if kind is str:  # a text of which the component itself knows what it may be
        if not isinstance(value, str):
            raise InputError(f"{name} = {shortened(value)}: must be a text")
        return value
    value = plain(name, value)
    check_value(name, value, meta)
    if kind is int and not value.is_integer():
        raise InputError(f"{name} = {value:g}: must be a whole number")
    return kind(value)


def _choices(choices):
    return ", ".join(str(c).lower() if isinstance(c, bool) else c for c in choices)


def unit(meta):
    """ " [cm]" of metadata, or nothing where there is no unit."""
    return "" if meta["unit"] == "-" else f" [{meta['unit']}]"


def allowed(meta, value=0.0):
    """The range in `meta` in words, "above 0" for one; value: tells a whole number from another.
    Empty where all numbers are allowed.
    """
    if meta.get("choices") is not None:
        return " or ".join(toml(c) for c in meta["choices"])
    low, high = meta.get("low"), meta.get("high")
    above = "" if low is None else f"{'above' if meta['strict'] else 'at least'} {low:g}"
    below = "" if high is None else f"at most {high:g}"
    whole = "whole number" if isinstance(value, SMALL_INT) and not isinstance(value, bool) else ""
    return ", ".join(filter(None, [whole, above, below]))
