"""From a rig file to a Case."""

import dataclasses
import re
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from jaxtank import presets
from jaxtank.case import Case
from jaxtank.controllers.base import Controller
from jaxtank.core.clock import CLOCK
from jaxtank.core.errors import InputError
from jaxtank.core.files import read_text
from jaxtank.core.quantities import converted
from jaxtank.core.text import shortened
from jaxtank.core.tree import describe, get_value
from jaxtank.measures import check_names
from jaxtank.observers.base import Observer
from jaxtank.rig import components, network, signals, tables, validation
from jaxtank.rig.components import ROLES, with_kind
from jaxtank.rig.entry import (
    Problems,
    Sizes,
    is_finite,
    read_entries,
    read_entry,
    read_value,
    refusal,
    sizes_of,
    unit,
    unknown_key,
    unknown_keys,
)
from jaxtank.rig.schema import INPUTS, LISTS, SECTIONS, TANKWISE
from jaxtank.rig.sensors import check_stated, complete_rows, sensor_rows, stated_units, with_sensors
from jaxtank.rig.values import (
    by_dotted_name,
    by_rig_name,
    dotted_name,
    has,
    set_and_schedule,
    set_values,
    with_bottom,
    with_models,
)

MOST_PROBLEMS = 20  # problems of a file that its error message lists

_HEADER = re.compile(r"\s*\[(\[?)\s*\"?([\w.-]+)\"?\s*\]")
_KEY = re.compile(r"\s*\"?([\w.\[\]-]+)\"?\s*=")
_TEXT = re.compile(r"\"(?:\\.|[^\"\\])*\"|'[^']*'")

Place = tuple[str, int | None, str | None]
"""(section, index of its table from 0, key); None where there is none."""


def lines_of(text: str) -> dict[Place, int]:
    """Return {place: number of its line, from 1} of a rig file, as far as a scan by lines finds."""
    lines: dict[Place, int] = {}
    counts: dict[str, int] = {}
    section, index, depth = "", None, 0
    for number, line in enumerate(text.splitlines(), 1):
        bare = _TEXT.sub('""', line).partition("#")[0]
        header, key = _HEADER.match(line), _KEY.match(line)
        if header and depth == 0:
            section, index = header[2], None
            if header[1]:
                index = counts[section] = counts.get(section, -1) + 1
            lines.setdefault((section, index, None), number)
        elif key and depth == 0:
            lines.setdefault((section, index, key[1]), number)
        if depth == 0 and key and not section:
            inline = key[1]
        if not section and (key or depth):  # tank = [{ ... }, { ... }]
            for _ in range(bare.count("{")):
                counts[inline] = counts.get(inline, -1) + 1
                lines.setdefault((inline, counts[inline], None), number)
            lines.setdefault((inline, None, None), number)
        depth = max(depth + bare.count("[") - bare.count("]") if not header else 0, 0)
    return lines


def line_of(lines: dict[Place, int], place: Any) -> int | None:
    """Return the line of a place, else of its table; None where that is not known."""
    section, index, key = place
    names = [section, "sensor"] if section == "sensors" else [section]
    names += {"controller": ["law"], "inflow": ["pour"]}.get(section, [])
    tries = [(n, i, k) for k in (key, None) for n in names for i in (index, None)]
    tries += [("", None, section), ("", None, key)]
    return next((lines[t] for t in tries if t in lines), None)


def open_case(name: str, duration: Any = None) -> Case:
    """Return the Case of "paper/case", or of the rig file `name` if it ends in .toml, checked."""
    return load(name, duration) if name.endswith(".toml") else presets.find(name)


def load(path: str | Path, duration: Any = None) -> Case:
    """Return the Case of a rig file.

    Parameters
    ----------
    path : of a TOML file, UTF-8, of at most 4 MiB
    duration : to which its tables with `repeat` go on, in s or with a unit; None: as it states

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
    text, words = read_text(path, "rig file"), f"rig file {str(path)!r}"
    return loads(text, words, Path(path).parent, duration)


def loads(
    text: str, words: str = "rig file", folder: str | Path = "", duration: Any = None
) -> Case:
    """Return the Case of the text of a rig file.

    Parameters
    ----------
    text : TOML
    words : what errors call it
    folder : from which the names of its tables in files (csv) are read
    duration : as in `load`

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
        return from_table(table, folder, duration)
    except InputError as error:
        lines, parts = lines_of(text), error.parts or (error,)
        at = [(line_of(lines, part.place) if part.place else None, part) for part in parts]
        sentences = [f"line {line}: {part}" if line else str(part) for line, part in at]
        if len(sentences) > MOST_PROBLEMS:
            more = len(sentences) - MOST_PROBLEMS
            sentences = [*sentences[:MOST_PROBLEMS], f"and {more} more problems"]
        located = type(error)(f"{words}: {'; '.join(sentences)}")
        located.parts = error.parts
        raise located from None
    except RecursionError:
        raise InputError(f"{words}: a value is nested too deeply") from None


def from_table(table: Mapping[str, Any], folder: str | Path = "", duration: Any = None) -> Case:
    """Return the Case of a rig file's table {key or section: value}; the rest as in `loads`."""
    table = with_clock(with_inputs(tables.resolved(renamed(table), Path(folder))))
    table = tables.with_repeats(table, _duration(table) if duration is None else duration)
    case = start_of(table)
    for key in ("values", "free", "uncertain"):
        if key in table:
            dotted = by_dotted_name(table[key], key)
            table = {**table, key: by_rig_name(case.loop, dotted, key != "uncertain")}
    values = with_models(case.loop, table.get("values", {}))
    case, values = _with_bias(case, values, table)
    case = set_and_schedule(case, values, table.get("schedule", {}))
    problems = Problems()
    fields = {"safety_filter": "safety", "scenario": "scenarios"}
    for name, read in TUNING.items():
        if name in table:
            with problems.collect((name, None, None)):
                case = case.replace(**{fields.get(name, name): read(case, table[name])})
    problems.check()
    if "covariance" in table:
        case = case.replace(rejected=table["covariance"].get("rejected", False))
    if "bottom" not in table.get("plant", {}) and "plant.bottom" not in values:
        case = with_bottom(case)
    return filtered(validation.check(case))


def with_clock(table):
    """A table of a rig file with dt, duration, .. of its top or of [clock] among its [values]."""
    if isinstance(table.get("clock"), dict):
        rest = {name: value for name, value in table.items() if name != "clock"}
        return with_clock({**rest, "values": {"clock": table["clock"], **table.get("values", {})}})
    clock = {f"clock.{name}": table[name] for name in CLOCK if name in table}
    if not clock:
        return table
    values = by_dotted_name(table.get("values", {}), "values")
    twice = (f"{name} is given twice, also in [values]" for name in clock if name in values)
    Problems(map(InputError, twice)).check()
    rest = {name: value for name, value in table.items() if name not in CLOCK}
    return {**rest, "values": values | clock}


def _duration(table):
    """The duration of a run as its file states it, None where it does not."""
    values = table.get("values")
    return (
        by_dotted_name(values, "values").get("clock.duration") if isinstance(values, dict) else None
    )


FORMER = {"law": "controller", "pour": "inflow"}
"""Sections of older files, which are read under their present names."""


def renamed(table):
    """A table of a rig file with the sections of FORMER under their present names."""
    for old, new in FORMER.items():
        if old in table and new in table:
            raise InputError(f"[{old}] is an older name of [{new}]: give one of them")
    table = {str(FORMER.get(name, name)): value for name, value in table.items()}
    table |= {name: with_kind(name, table[name]) for name in ROLES if name in table}
    sensor = table.get("sensor")
    if isinstance(sensor, list) or (isinstance(sensor, dict) and "kind" not in sensor):
        table["sensors"] = table.pop("sensor")  # [[sensor]], or one [sensor] for all tanks
    return table


def with_inputs(table):
    """A table of a rig file whose [inputs] are those of an open loop."""
    if not isinstance(table.get("inputs"), dict):
        return table
    control = table.get("controller", {"kind": "open-loop"})
    if control != {"kind": "open-loop"}:
        raise InputError("[inputs] are those of an open loop, and [controller] another: give one")
    rest = {name: value for name, value in table.items() if name != "inputs"}
    return {**rest, "controller": {**table["inputs"], **control}}


def filtered(case: Case, on: bool | None = None, changes: Mapping[str, Any] | None = None) -> Case:
    """Return the case with the safety filter of its settings and `changes`, or without it."""
    changes = _filter_settings(case, changes or {})
    if (case.safety is None and not on) or on is False:
        if changes:
            raise InputError(
                f"safety_filter.{next(iter(changes))}: the safety filter is off;"
                " --safety-filter turns it on"
            )
        return case.without_safety_filter()
    return case.with_safety_filter(**{**(case.safety or {}), **changes})


def _filter_settings(case, table):
    values = read_entry(SECTIONS["safety_filter"], table, sizes_of(case.loop))
    if "widths" in values:
        rows = values["widths"].items()
        values["widths"] = {name: _width(case.loop, name, value) for name, value in rows}
    return values


def _width(loop, name, value):
    """The half width of the interval of a parameter in its unit, checked."""
    full = name if "." in name or name.startswith("x0") else f"plant.{name}"
    meta, label = describe(loop, full), f"safety_filter.widths {name}"
    value = converted(label, value, meta["unit"])
    shape = np.shape(get_value(loop, full)) if has(loop, full) else np.shape(value)
    if not (is_finite(value) and np.min(value) >= 0.0 and np.shape(value) in ((), shape)):
        each = f", or {shape[0]} of them" if shape else ""
        raise refusal(label, value, f"be a number of at least 0{unit(meta)}{each}")
    return value


TUNING = {  # {section: value of a case's field by the section's table}, read after the values
    "limits": lambda case, table: validation.check_limits(case.loop, table, case.limits),
    "objective": lambda case, table: validation.check_objective(table),
    "free": lambda case, table: validation.free_of(case.loop, table),
    "uncertain": lambda case, table: validation.check_uncertain(case.loop, table),
    "covariance": lambda case, table: validation.check_covariance(case.loop, table),
    "log": lambda case, table: validation.check_log(case.loop.plant, table),
    "safety_filter": _filter_settings,
    "scenario": validation.scenarios_of,
}


def _stated(table, field):
    """What a section states for the numbers of rows: of `delays` also one `delay` of all."""
    return table.get(field, table.get("delay") if field == "delays" else None)


def _check_twice(table):
    """Raise InputError for numbers that [[tank]] or [[pump]] and another section both give."""
    problems = []
    for name in ("tank", *INPUTS):
        entries = table.get(name, [])
        before = len(table.get("pump", [])) if name == "valve" else 0
        inputs = sum(len(table.get(kind, [])) for kind in INPUTS)
        for key in SECTIONS[name].keys:
            section, _, field = key.target.partition(".")
            field = "inflow" if section == "disturbance" else field
            whole = _stated(table.get(section, {}), field)
            count = inputs if section == "actuator" else len(entries)
            each = whole[before:] if isinstance(whole, list) and len(whole) == count else None
            for i, entry in enumerate(entries if whole is not None else ()):
                other = whole if each is None else each[i]
                if key.name in entry and entry[key.name] != other:
                    problems.append(
                        f"{name} {i + 1}: {key.name} = {shortened(entry[key.name])}, and"
                        f" [{section}] {field} has {shortened(other)} for it: give one of them"
                    )
    if problems:
        raise InputError("; ".join(problems))


def start_of(table):
    """Return the Case of the tables that build it, before any value is set."""
    problems = Problems()
    case, top = _start(table, problems)
    loop, changes = case.loop, {}
    with problems.collect():
        _check_twice(table)
    if "sensors" in table:
        with problems.collect():
            check_stated(table, loop)
            tables.check_setpoints(
                table.get("reference"), stated_units(table, loop), loop.plant, loop.units[0]
            )
    parts = {
        "sensor": lambda row: components.instrument_of("sensor", row, loop),
        "actuator": lambda row: components.instrument_of(
            "actuator", row, loop, "case" not in table
        ),
        "reference": lambda row: signals.reference_of(row, loop),
        "disturbance": lambda _: signals.disturbance_of(table, loop),
        "inflow": lambda _: signals.disturbance_of(table, loop),
        "fault": lambda rows: signals.faults_of(rows, loop, dotted_name),
    }
    fields = {"inflow": "disturbance", "fault": "faults"}
    for name, read in parts.items():
        field = fields.get(name, name)
        if name in table and field not in changes:
            with problems.collect():
                changes[field] = read(table[name])
    problems.check()
    top.pop("units", None)
    return case.replace(loop=dataclasses.replace(loop, **changes), **top)


def _start(table, problems):
    """(Case of the tables of the rig and its controller, values at the top of a file)."""
    top = {}
    with problems.collect():
        top = _top(table)
    lists = all(isinstance(table.get(name, []), list) for name in LISTS)
    if problems and lists and "tank" in table and "case" not in table:
        with problems.collect():
            network.build(table)
    _check_others(table, problems)
    if "case" in top:
        case = presets.find(top.pop("case"))
        if "sensors" in table:
            rows, sizes = sensor_rows(table, case.loop.plant.tanks), sizes_of(case.loop)
            rows = read_entries(SECTIONS["sensors"], {"sensors": rows}, sizes)
            rows = complete_rows(rows, sizes.tanks, sizes.units[0])
            case = case.replace(loop=with_sensors(case.loop, rows))
        case = _with_parts(case, table)
    else:
        with problems.collect():
            case = network.build(table)
        _check_others(table, problems)
    return case, top


def _check_others(table, problems):
    """Raise the problems of a rig, if any, with what is wrong in the other tables of its file."""
    if not problems:
        return
    for name in ("controller", "observer"):
        with problems.collect((name, None, None)):
            components.check_keys(name, table)
    for name in ("reference", "limits", "objective"):
        row = table.get(name, {})
        for key in row if isinstance(row, dict) else ():
            with problems.collect((name, None, key)):
                if name != "reference":
                    check_names([key.partition(".")[0]])
                elif key not in SECTIONS[name].names:
                    raise unknown_key(SECTIONS[name], key, name)
    problems.check()


def _top(table):
    """The values at the top of a rig file; InputError for unknown or misplaced sections or keys."""
    first = SECTIONS[""]
    sections = {n: section for n, section in SECTIONS.items() if n and "." not in n}
    problems, top = Problems(), {}
    if isinstance(table.get("sensors", []), dict):  # one [sensor] for all tanks
        section = dataclasses.replace(SECTIONS["sensors"], many=False)
        problems += unknown_keys(section, table["sensors"], "sensor", ("sensor", None))
        table = {n: v for n, v in table.items() if n != "sensors"}
    for name, value in table.items():
        if name in first.names:
            with problems.collect():
                top[name] = read_value(first[name], name, value, Sizes(0))
        elif name not in sections:
            problems.append(unknown_key(first, name))
            problems[-1].place = ("", None, name)
        elif not isinstance(value, list if sections[name].many else (dict, Controller, Observer)):
            tables = f"a list of tables, [[{name}]]" if sections[name].many else "a table"
            problems.append(refusal(name, value, f"be {tables}"))
    problems.check()
    _check_start(table)
    return top


def _check_start(table):
    """Raise InputError unless a file has either a case or tanks."""
    tables = [name for name in TANKWISE if name in table]
    if "case" in table and tables:
        raise InputError(
            f"{tables[0]}: a rig file is either a case or a rig described tank by tank: leave out"
            f" case, or [{tables[0]}]"
        )
    if "case" not in table and "tank" not in table:
        raise InputError(
            'a rig file needs case = "paper/case" to start from (`jaxtank list` prints them), or'
            " [[tank]] to describe a rig"
        )


def _with_parts(case, table):
    """A case whose controller or observer is replaced by that of a table."""
    loop = case.loop
    if "controller" in table:
        controller = components.controller_of(table["controller"], loop, loop.actuator.initial)
        if type(controller) is not type(loop.controller):
            case = case.replace(symmetry=None)
        loop = dataclasses.replace(loop, controller=controller)
    if "observer" in table:
        loop = dataclasses.replace(loop, observer=components.observer_of(table["observer"], loop))
    replaced = tuple(f"{name}." for name in ("controller", "observer") if name in table)
    free = {n: f for n, f in case.free.items() if not n.startswith(replaced) or has(loop, n)}
    return case.replace(loop=loop, free=free)


def _with_bias(case, values, table):
    """(case with the bias that its [controller] leaves out, the values still to be set)."""
    names = components.leaves_out(table.get("controller", {}), values)
    if not names:
        return case, values
    parts = ("plant.", "actuator.", "disturbance.", "x0")
    case = set_values(case, {n: v for n, v in values.items() if n.startswith(parts)})
    name, rows = "actuator.initial", [row for kind in INPUTS for row in table.get(kind, [])]
    rows = rows or [{}] * case.loop.plant.pumps
    whole = "initial" in table.get("actuator", {}) or name in values
    known = [whole or "initial" in row or f"{name}[{j}]" in values for j, row in enumerate(rows)]
    controller: Any = case.loop.controller
    steady = components.steady_bias(case.loop, known)
    controller = components.with_bias(controller, case.loop, steady, names)
    later = {n: v for n, v in values.items() if not n.startswith(parts)}
    return case.replace(loop=dataclasses.replace(case.loop, controller=controller)), later
