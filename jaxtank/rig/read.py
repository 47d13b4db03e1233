"""From a rig file to a Case."""

import dataclasses
import re
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from jaxtank import presets
from jaxtank.case import Case
from jaxtank.core.errors import InputError, unknown
from jaxtank.core.files import read_text
from jaxtank.core.text import shortened
from jaxtank.rig import components, network, signals, validation
from jaxtank.rig.entry import Sizes, read_entry, read_value, sizes_of
from jaxtank.rig.schema import SECTIONS, TANKWISE
from jaxtank.rig.values import (
    by_dotted_name,
    has,
    set_and_schedule,
    set_values,
    with_bottom,
    with_models,
)

MOST = 100
"""Parts of a dotted key; the names of a rig have four."""

MOST_WORDS = 250_000
"""Keys (each part of one), numbers (those with a point twice), texts, lists and tables of a file:
it is parsed and checked in seconds.
"""

_PART = r"""(?:[A-Za-z0-9_-]++|"(?:[^"\\\n]|\\[^\n])*+"|'[^'\n]*+')"""
# Every alternative is possessive: nothing is read twice, whatever is left open. A value has two
# such parts at most, those of a float.
_TOKEN = re.compile(
    r'''(?P<text>"""(?:[^"\\]|\\.|"{1,2}(?!"))*+"{3,5}|\'\'\'(?:[^']|'{1,2}(?!'))*+'{3,5})'''
    rf"""|(?P<open>\"\"\"|''')|(?P<key>{_PART}(?:[ \t]*+\.[ \t]*+{_PART})*+)"""
    r"""|(?P<quote>["'])|[\[{]|(?:\#[^\n]*+\s*+)++""",
    re.DOTALL,
)
_ONE = re.compile(_PART)


def check_keys(text):
    """Raise InputError for a key of more than `MOST` dotted parts, and for a file of more than
    `MOST_WORDS` words. Dots of numbers, texts and comments are none of a key's.
    """
    words = 0
    for token in _TOKEN.finditer(text):
        if token.lastgroup in ("open", "quote"):
            return  # a text without an end: the parser gets no further either
        parts = (
            sum(1 for _ in _ONE.finditer(token.group()))
            if token.lastgroup == "key" and "." in token.group()
            else 1
        )
        if parts > MOST:
            line = text.count("\n", 0, token.start()) + 1
            raise InputError(
                f"line {line}: a key of {parts} parts joined by dots: must be at most {MOST}"
            )
        words += parts
        if words > MOST_WORDS:
            raise InputError(f"has more than {MOST_WORDS} keys and values")


def open_case(name: str) -> Case:
    """Return the Case of "paper/case", or of the rig file `name` if it ends in .toml, checked."""
    return load(name) if name.endswith(".toml") else presets.find(name)


def load(path: str | Path) -> Case:
    """Return the Case of a rig file.

    Parameters
    ----------
    path : of a TOML file, UTF-8, of at most 4 MiB

    Returns
    -------
    Case, checked.

    Raises
    ------
    InputError, naming the file, for anything in it that is unknown, misshapen or out of range.

    Examples
    --------
    >>> import pathlib, tempfile
    >>> from jaxtank import rig
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = pathlib.Path(folder, "rig.toml")
    ...     count = path.write_text('case = "cascaded/pi"')
    ...     rig.load(path).clock.dt
    4.0
    """
    return loads(read_text(path, "rig file"), f"rig file {str(path)!r}")


def loads(text: str, words: str = "rig file") -> Case:
    """Return the Case of the text of a rig file.

    Parameters
    ----------
    text : TOML
    words : what errors call it

    Returns
    -------
    Case, checked.

    Raises
    ------
    InputError as `load`.

    Examples
    --------
    >>> from jaxtank import rig
    >>> case = rig.loads('''
    ... case = "cascaded/pi"
    ... [values]
    ... clock.duration = 400.0
    ... ''')
    >>> case.clock.duration
    400.0
    """
    try:
        check_keys(text)
    except InputError as error:
        raise InputError(f"{words}: {error}") from None
    try:
        # a byte-order mark, as some editors write
        table = tomllib.loads(text.removeprefix("\ufeff"))
    except tomllib.TOMLDecodeError as error:
        raise InputError(f"{words} is not TOML: {' '.join(str(error).split())}") from None
    except ValueError:  # of Python, which reads no whole number of thousands of digits
        raise InputError(
            f"{words}: a whole number in it has more digits than can be read: write it with an"
            " exponent, as 1e30"
        ) from None
    except RecursionError:
        raise InputError(f"{words} is not TOML that can be read: it is nested too deeply") from None
    try:
        return from_table(table)
    except InputError as error:
        raise type(error)(f"{words}: {error}") from None
    except RecursionError:
        raise InputError(f"{words}: a value is nested too deeply") from None


def from_table(table: Mapping[str, Any]) -> Case:
    """Return the Case of a table of the form of a rig file, {key or section: value}, checked."""
    table = renamed(table)
    case = start_of(table)
    dotted = ("values", "free", "uncertain")
    named = {key: by_dotted_name(table[key], key) for key in dotted if key in table}
    table = {**table, **named}
    values = with_models(case.loop, table.get("values", {}))
    case, values = _with_bias(case, values, table)
    case = set_and_schedule(case, values, table.get("schedule", {}))
    for name, read in TUNING.items():
        if name in table:
            case = case.replace(**{FIELDS.get(name, name): read(case, table[name])})
    if "bottom" not in table.get("plant", {}) and "plant.bottom" not in values:
        case = with_bottom(case)
    return filtered(validation.check(case))


FORMER = {"law": "controller", "pour": "inflow"}
"""Sections of older files, which are read under their present names."""


def renamed(table):
    """A table of a rig file with the sections of FORMER under their present names."""
    for old, new in FORMER.items():
        if old in table and new in table:
            raise InputError(f"[{old}] is an older name of [{new}]: give one of them")
    return {FORMER.get(name, name): value for name, value in table.items()}


def filtered(case: Case, on: bool | None = None, changes: Mapping[str, Any] | None = None) -> Case:
    """Return the case with the safety filter of its settings and `changes`, or without it."""
    changes = read_entry(SECTIONS["safety_filter"], changes or {}, sizes_of(case.loop.plant))
    if (case.safety is None and not on) or on is False:
        if changes:
            raise InputError(
                f"safety_filter.{next(iter(changes))}: the safety filter is off;"
                " --safety-filter turns it on"
            )
        return case.without_safety_filter()
    return case.with_safety_filter(**{**(case.safety or {}), **changes})


TUNING = {
    "limits": lambda case, table: validation.check_limits(case.loop, table),
    "objective": lambda case, table: validation.check_objective(table),
    "free": lambda case, table: validation.free_of(case.loop, table),
    "uncertain": lambda case, table: validation.check_uncertain(case.loop, table),
    "covariance": lambda case, table: validation.check_covariance(case.loop, table),
    "log": lambda case, table: validation.check_log(case.loop.plant, table),
    "safety_filter": lambda case, table: read_entry(
        SECTIONS["safety_filter"], table, sizes_of(case.loop.plant)
    ),
    "scenario": lambda case, table: tuple(
        validation.scenario(case, entry, i) for i, entry in enumerate(table)
    ),
}
"""{section: function (case, its table)} of what is read after the values are set."""

FIELDS = {"scenario": "scenarios", "safety_filter": "safety"}
"""{section: field of Case}, where it has another name."""


def _check_twice(table):
    """Raise InputError for numbers of tanks and pumps that their own tables and the section of what
    they belong to, [disturbance], [sensor] or [actuator], give differently; all at once.
    """
    wrong = []
    for name in ("tank", "pump"):
        entries = table.get(name, [])
        for key in SECTIONS[name].keys:
            section, _, field = key.target.partition(".")
            field = "inflow" if section == "disturbance" else field
            if field not in table.get(section, {}):
                continue
            whole = table[section][field]
            each = isinstance(whole, list) and len(whole) == len(entries)
            for i, entry in enumerate(entries):
                other = whole[i] if each else whole
                if key.name in entry and entry[key.name] != other:
                    wrong.append(
                        f"{name} {i + 1}: {key.name} = {shortened(entry[key.name])}, and"
                        f" [{section}] {field} has {shortened(other)} for it: give one of them"
                    )
    if wrong:
        raise InputError("; ".join(wrong))


def start_of(table):
    """Return the Case of the tables that build: case or tanks, controller, observer,
    instruments, reference, disturbance and faults; before any value is set.
    """
    top = _top(table)
    case = (
        _with_parts(presets.find(table["case"]), table) if "case" in table else network.build(table)
    )
    loop, changed = case.loop, {}
    _check_twice(table)
    for name in ("sensor", "actuator"):
        if name in table:
            changed[name] = components.instrument_of(name, table[name], loop)
    if "reference" in table:
        changed["reference"] = signals.reference_of(table["reference"], loop.reference, loop.plant)
    if "disturbance" in table or "inflow" in table:
        names = network.names_in(table)
        changed["disturbance"] = signals.disturbance_of(table, loop, names)
    if "fault" in table:
        changed["faults"] = signals.faults_of(table["fault"], loop.plant)
    if changed:
        case = case.replace(loop=dataclasses.replace(loop, **changed))
    own = {key: top[key] for key in top if key not in ("case", "units")}
    return case.replace(**own)


def _top(table):
    """The values at the top of a rig file; InputError for a section or key that is unknown or of
    another kind, and unless there is either a case or a tank.
    """
    _check_sections(table)
    first = SECTIONS[""]
    top = {
        k.name: read_value(k, k.name, table[k.name], Sizes(0))
        for k in first.keys
        if k.name in table
    }
    given = [name for name in TANKWISE if name in table]
    if "case" in table and given:
        raise InputError(
            f"{given[0]}: a rig file is either a case or a rig described tank by tank: leave out"
            f" case, or [{given[0]}]"
        )
    if "case" not in table and "tank" not in table:
        raise InputError(
            'a rig file needs case = "paper/case" to start from (`jaxtank list` prints them), or'
            " [[tank]] to describe a rig"
        )
    return top


def _check_sections(table):
    """Raise InputError for a key at the top that is unknown, and for one that is no table."""
    sections = {name: section for name, section in SECTIONS.items() if name and "." not in name}
    for key, value in table.items():
        if key in SECTIONS[""].names:
            continue
        if key not in sections:
            raise unknown("key", key, [*SECTIONS[""].names, *sections])
        many = sections[key].many
        if not isinstance(value, list if many else dict):
            words = f"a list of tables, [[{key}]]" if many else "a table"
            raise InputError(f"{key} = {shortened(value)}: must be {words}")


def _with_parts(case, table):
    """A case whose controller or observer is replaced by that of a table."""
    loop, changed = case.loop, []
    if "controller" in table:
        controller = components.controller_of(table["controller"], loop, loop.actuator.initial)
        if type(controller) is not type(loop.controller):
            case = case.replace(symmetry=None)
        loop = dataclasses.replace(loop, controller=controller)
        changed.append("controller.")
    if "observer" in table:
        observer = components.observer_of(table["observer"], loop)
        loop = dataclasses.replace(loop, observer=observer)
        changed.append("observer.")
    kept = lambda name: not name.startswith(tuple(changed)) or has(loop, name)
    return case.replace(loop=loop, free={n: f for n, f in case.free.items() if kept(n)})


def _with_bias(case, values, table):
    """(case with the bias that its [controller] leaves out, the values still to be set)."""
    control = table.get("controller", {})
    if not components.leaves_bias(control) or any(n.startswith("controller.bias") for n in values):
        return case, values
    parts = ("plant.", "actuator.", "disturbance.", "x0")
    case = set_values(case, {n: v for n, v in values.items() if n.startswith(parts)})
    name, pumps = "actuator.initial", table.get("pump", [{}] * case.loop.plant.pumps)
    whole = "initial" in table.get("actuator", {}) or name in values
    known = [whole or "initial" in pump or f"{name}[{j}]" in values for j, pump in enumerate(pumps)]
    bias = components.steady_bias(case.loop, known)
    controller: Any = case.loop.controller
    controller = dataclasses.replace(controller, bias=bias)
    loop = dataclasses.replace(case.loop, controller=controller)
    later = {n: v for n, v in values.items() if not n.startswith(parts)}
    return case.replace(loop=loop), later
