"""A rig as a TOML file: a case of a paper and what is different about yours.

case = "gouta2015/backstepping"

[values]                     # any parameter by its dotted name
"controller.k1" = 0.01
"plant.area" = [21.2, 21.2, 21.2, 21.2]
"clock.dt" = 0.01

[reference]                  # ramps between plateaus
initial = [3.0, 3.0]
changes = [[20.0, 1, 8.0]]   # time [s], output (from 1), level
ramp = 60.0

[schedule]                   # gains that follow a setpoint (r1, r2 ..) or a level (h1, h2 ..); their values are "controller.values"
gains = ["controller.k", "controller.k1"]
variable = "r1"
knots = [5.0, 10.0, 15.0]

[limits]                     # hard limits of `tune`
max_level = "rim"

[free]                       # what `tune` may change: [low, high] or [low, high, "log" or "linear"]
"controller.k1" = [0.001, 5.0]

[objective]                  # what it makes small: measure = weight
rms_error_total = 1.0

[uncertain]                  # spread of the plant's parameters, as a share: what answers are validated on
"plant.drain" = 0.05

[covariance]                 # of parameters that vary together, as `identify` writes it
names = ["plant.drain[0]", "plant.drain[1]"]
matrix = [[1e-6, 0.0], [0.0, 1e-6]]

[log]                        # columns of a log of this rig, with their units: a header, or [header, unit]
pump1 = ["pump speed", "V"]
h1 = "level 1 [mm]"

[[scenario]]                 # runs that `tune` judges by, instead of the case's own; scenario = [] at the top: none
name = "noisy"
seed = 1
weight = 2.0
values = { "sensor.noise" = 0.02, "reference.ramp" = 40.0 }
"""

import dataclasses
import math
import tomllib
from pathlib import Path

import jax
import numpy as np

from jaxtank import loop as lp
from jaxtank import presets, record_tables, rig_build, scheduling
from jaxtank.analysis import equilibrium
from jaxtank.errors import EquilibriumError, InputError, unknown
from jaxtank.files import read_text, write_atomic
from jaxtank.measures import check_names, entries
from jaxtank.measures import unit as measure_unit
from jaxtank.presets.base import Case, Free, Scenario
from jaxtank.records import CLOCK_UNITS, check_clock
from jaxtank.signals import Ramps, ramps
from jaxtank.tree import _short, check_value, describe, get_value, is_component, split_index, walk, with_values

TABLES = (
    "case",
    "name",
    "values",
    "reference",
    "schedule",
    "limits",
    "free",
    "objective",
    "uncertain",
    "covariance",
    "log",
    "scenario",
    *rig_build.TABLES,
)
LISTS = ("scenario", "tank", "orifice", "pipe", "spill", "pump")
KINDS = {
    "case": (str, "a text"),
    "name": (str, "a text"),
    "units": (list, "a list"),
    **{k: (list, f"a list of tables, [[{k}]]") for k in LISTS},
}
SCENARIO_KEYS = ("name", "values", "seed", "weight")
REFERENCE_KEYS = ("initial", "changes", "ramp", "shape", "band")


def open_case(name):
    """The Case of "paper/case", or of a rig file where `name` ends in .toml, checked."""
    return load(name) if name.endswith(".toml") else presets.find(name)


def load(path):
    """The Case of a rig file. Raises InputError, naming the file, for anything in it that is unknown, misshapen or out of range."""
    return loads(read_text(path, "rig file"), f"rig file {str(path)!r}")


def loads(text, words):
    """The Case of the text of a rig file, called `words` in errors."""
    try:
        table = tomllib.loads(text)
    except ValueError as error:  # TOMLDecodeError, or a number of thousands of digits
        raise InputError(f"{words} is not TOML: {' '.join(str(error).split())}") from None
    except RecursionError:
        raise InputError(f"{words} is not TOML that can be read: it is nested too deeply") from None
    try:
        return from_table(table)
    except InputError as error:
        raise type(error)(f"{words}: {error}") from None
    except RecursionError:
        raise InputError(f"{words}: a value is nested too deeply") from None


def from_table(table):
    """The Case described by a table of the form of a rig file."""
    for key, value in table.items():
        if key not in TABLES:
            raise unknown("key", key, TABLES)
        wanted, words = KINDS.get(key, (dict, "a table"))
        if not isinstance(value, wanted):
            raise InputError(f"{key} = {_short(value)}: must be {words}")
    if "case" in table and (given := [k for k in rig_build.TABLES if k in table]):
        raise InputError(
            f"{given[0]}: a rig file is either a case or a rig described tank by tank: leave out case, or [{given[0]}]"
        )
    if "case" not in table and "tank" not in table:
        raise InputError(
            'a rig file needs case = "paper/case" to start from (`jaxtank list` prints them), or [[tank]] to describe a rig'
        )
    case = presets.find(table["case"]) if "case" in table else rig_build.build(table)
    case = case.replace(name=table.get("name", case.name))
    if "reference" in table:
        case = case.replace(loop=dataclasses.replace(case.loop, reference=_reference(table["reference"], case.loop.reference)))
    case = set_and_schedule(case, table.get("values", {}), table.get("schedule", {}))
    if "limits" in table:
        case = case.replace(limits=check_limits(case.loop, table["limits"]))
    if "objective" in table:
        case = case.replace(objective=check_objective(table["objective"]))
    if "free" in table:
        case = case.replace(free={name: _free(case.loop, name, spec) for name, spec in table["free"].items()})
    if "uncertain" in table:
        case = case.replace(uncertain=check_uncertain(case.loop, table["uncertain"]))
    if "covariance" in table:
        case = case.replace(covariance=record_tables.check_covariance(case.loop, table["covariance"]))
    if "log" in table:
        case = case.replace(log=record_tables.check_log(case.loop.plant, table["log"]))
    if "scenario" in table:
        case = case.replace(scenarios=tuple(_scenario(case, entry, i) for i, entry in enumerate(table["scenario"])))
    return check(case)


def check_uncertain(loop, uncertain):
    """`uncertain` as a dict, if every one is a parameter in use with a spread above 0 and below 1."""
    for name, share in uncertain.items():
        get_value(loop, name)
        if not (_is_numeric(share) and np.ndim(share) == 0 and 0 < share < 1):
            raise InputError(f"uncertain {name} = {_short(share)}: must be a share between 0 and 1")
    return {name: float(share) for name, share in uncertain.items()}


def has(loop, name):
    """Whether a loop has the leaf `name`, an entry of it for "name[i]"."""
    try:
        get_value(loop, name)
    except InputError:
        return False
    return True


def uncovered(loop, name, share, covered):
    """{name: share} of what [uncertain] says of `name`, less what is in `covered`: entry by entry where that is part of an array; a
    share of nothing is left out."""
    if not any(split_index(c)[0] == split_index(name)[0] for c in covered):
        return {name: share}
    if "[" in name:
        return {} if name in covered else {name: share}
    value = np.asarray(get_value(loop, name))
    entries = [f"{name}[{','.join(map(str, i))}]" for i in np.ndindex(value.shape) if value[i] != 0] if value.shape else []
    return {n: share for n in entries if n not in covered}


def _scenario(case, entry, index):
    """The Scenario of one [[scenario]] table, if it can be run."""
    if not isinstance(entry, dict):
        raise InputError(f"scenario {index + 1} = {_short(entry)}: must be a table")
    for key in entry:
        if key not in SCENARIO_KEYS:
            raise unknown("key of [[scenario]]", key, SCENARIO_KEYS)
    name, values = entry.get("name", f"scenario {index + 1}"), entry.get("values", {})
    seed, weight = entry.get("seed", 0), entry.get("weight", 1.0)
    if not isinstance(name, str) or not isinstance(values, dict):
        raise InputError(f"scenario {index + 1}: name must be a text, and values a table")
    if isinstance(seed, bool) or not isinstance(seed, int) or not 0 <= seed < 2**31:
        raise InputError(f"scenario {name!r}: seed = {_short(seed)} must be a whole number from 0 to {2**31 - 1}")
    if not _is_numeric(weight) or np.ndim(weight) or not (np.isfinite(weight) and weight > 0):
        raise InputError(f"scenario {name!r}: weight = {_short(weight)} must be a finite number above 0")
    try:
        set_values(case, values)
    except InputError as error:
        raise type(error)(f"scenario {name!r}: {error}") from None
    return Scenario(name, {n: tuple(v) if isinstance(v, list) else v for n, v in values.items()}, seed, float(weight))


def check_limits(loop, limits):
    """`limits` as a dict, if every one is a measure with a finite number, one for each of its entries, or "rim" for max_level."""
    check_names(limits)
    for measure, value in limits.items():
        count, unit = entries(measure, loop.plant), measure_unit(measure, loop.units)
        if isinstance(value, str) and value == "rim" and measure == "max_level":
            continue
        good = _is_numeric(value) and np.shape(value) in ((), (count,))
        if not good or not np.all(np.isfinite(np.asarray(value, dtype=float))):
            many = f", or {count} of them" if count > 1 else ""
            rim = ', or "rim"' if measure == "max_level" else ""
            raise InputError(f"limit {measure} = {_short(value)}: must be a finite number [{unit}]{many}{rim}")
    return dict(limits)


def check_objective(objective):
    """`objective` as a dict, if every one is a measure with a finite weight at or above 0, and one of them above."""
    check_names(objective)
    for measure, weight in objective.items():
        if not (_is_numeric(weight) and np.ndim(weight) == 0 and np.isfinite(weight) and weight >= 0):
            raise InputError(f"objective {measure} = {_short(weight)}: must be a finite weight at or above 0")
    if not any(objective.values()):
        raise InputError("the objective has no measure with a weight above 0")
    return {measure: float(weight) for measure, weight in objective.items()}


def check_free(loop, name, low, high, scale="log"):
    """The Free of a parameter, if it is a leaf in use and its range lies within what it allows."""
    if name.startswith("clock.") and name.removeprefix("clock.") in CLOCK_UNITS:
        meta = {"kind": "static"}
    else:
        meta = describe(loop, name)
    if meta["kind"] == "static":
        raise InputError(f"free {name}: cannot be tuned, it is part of the compiled program and not a number with a derivative")
    scheduling.check_not_scheduled(loop, name)
    get_value(loop, name)
    unit = "" if meta["unit"] == "-" else f" {meta['unit']}"
    if not (math.isfinite(low) and math.isfinite(high) and low < high):
        raise InputError(f"free {name} = {low:g}:{high:g}: must be LOW:HIGH with finite LOW below HIGH{unit}")
    for end in (low, high):
        for row in meta.get("rows") or (meta,):  # an array whose rows are different things
            check_value(f"free {name}", end, row)
    if scale not in ("log", "linear"):
        raise InputError(f"free {name}: scale {scale!r} must be log or linear")
    return Free(float(low), float(high), scale if low > 0 else "linear")


def check(case):
    """`case`, after every check at the door: the loop and clock can be run, and every plateau of the reference has a steady state."""
    lp.check(case.loop, case.clock, key=jax.ShapeDtypeStruct((), np.uint32))  # a key will be given where there is noise
    if case.reachable and isinstance(case.loop.reference, Ramps) and case.loop.plant.pumps == len(case.loop.plant.outputs):
        for values in case.loop.reference.plateaus(case.clock.duration):
            try:
                equilibrium(case.loop.plant, values)
            except EquilibriumError as error:
                raise EquilibriumError(f"reference: {error}") from None
    return case


def set_values(case, values):
    """A copy of `case` with leaves, static fields and clock fields set by dotted name.

    values: {name: number, list, text or truth value}. Raises InputError for an unknown name (with the nearest), a value of the wrong
    kind or shape, and a value out of range.
    """
    clock = {name: value for name, value in values.items() if name.startswith("clock.")}
    if clock:
        case = case.replace(clock=_set_clock(case.clock, clock))
    for name, value in values.items():
        if name in clock:
            continue
        meta = describe(case.loop, name)
        if meta["kind"] == "static":
            if "[" in name:
                raise InputError(f"{name}: {name.split('[')[0]} has no entries, set it whole")
            case = case.replace(loop=_set_static(case.loop, name, name.split("."), value, meta))
            continue
        if not _is_numeric(value):
            raise InputError(f"{name} = {_short(value)}: must be a number or a list of numbers{_unit(meta)}")
        scheduling.check_not_scheduled(case.loop, name)
        loop = with_values(case.loop, {name: value})
        check_value(name, get_value(loop, name), meta)
        case = case.replace(loop=loop)
    return case


def set_and_schedule(case, values, table):
    """`set_values`, and a schedule of gains made of `table` (that of a rig file; {} for none). What the case has by name is set before the
    schedule is made, which starts from it; what only the scheduled case has, as controller.values, after."""
    if table:
        before, values = scheduling.known(case.loop, values)
        case = scheduling.from_table(set_values(case, before), table)
    return set_values(case, values)


def dump(case):
    """The complete rig file of `case` as text: every leaf, every static field that a file may set, reference, limits, free, objective."""
    table = scheduling.table_of(case.loop)
    origin = _origin(case)
    lines = [*([] if origin is None else [f"case = {_toml(origin)}"]), f"name = {_toml(case.name)}"]
    lines += [*([] if case.scenarios else ["scenario = []"]), *(rig_build.tables(case, _toml) if origin is None else [""])]
    lines += ["[schedule]", *(f"{key} = {_toml(value)}" for key, value in table.items()), ""] if table else []
    lines += ["[values]"]
    whole = ("controller.knots", "controller.variable") if table else ()
    for name, value, meta in walk(case.loop):
        if (
            value is not None
            and name not in whole
            and not (name.startswith("reference.") and isinstance(case.loop.reference, Ramps))
        ):
            lines.append(_line(name, np.asarray(value).tolist(), meta))
    for name, value, meta in walk(case.loop, kind="static"):
        if (
            not isinstance(value, tuple)
            and name not in whole
            and not (name.startswith("reference.") and isinstance(case.loop.reference, Ramps))
        ):
            lines.append(_line(name, value, meta))
    for name, unit in CLOCK_UNITS.items():
        lines.append(_line(f"clock.{name}", getattr(case.clock, name), {"unit": unit, "doc": ""}))
    reference = case.loop.reference
    if isinstance(reference, Ramps):
        lines += ["", "[reference]", f"initial = {_toml(np.asarray(reference.initial).tolist())}  # [{case.loop.units[0]}]"]
        changes = [[t, i + 1, float(v)] for (t, i), v in zip(reference.changes, np.asarray(reference.targets))]
        lines += [f"changes = {_toml(changes)}  # time [s], output (from 1), level [{case.loop.units[0]}]"]
        lines += [f"ramp = {_toml(reference.ramp)}  # [s]", f"shape = {_toml(reference.shape)}"]
        lines += [f"band = {_toml(reference.band)}  # settling band, as a share of the step"]
    lines += ["", "[limits]"] + [
        f"{m} = {_toml(np.asarray(v).tolist() if not isinstance(v, str) else v)}" for m, v in case.limits.items()
    ]
    lines += ["", "[free]"] + [f"{_toml(n)} = {_toml(list(Free(*spec)))}" for n, spec in case.free.items()]
    lines += ["", "[objective]"] + [f"{m} = {_toml(float(w))}" for m, w in case.objective.items()]
    lines += ["", "[uncertain]"] + [f"{_toml(n)} = {_toml(float(v))}" for n, v in case.uncertain.items()]
    lines += record_tables.lines(case, _toml)
    for s in case.scenarios:
        inside = ", ".join(f"{_toml(n)} = {_toml(v)}" for n, v in s.values.items())
        lines += ["", "[[scenario]]", f"name = {_toml(s.name)}", f"seed = {s.seed}", f"weight = {_toml(float(s.weight))}"]
        lines += [f"values = {{ {inside} }}" if inside else "values = {}"]
    return "\n".join(lines) + "\n"


def save(case, path):
    """Write `dump(case)` to a file, whole or not at all."""
    write_atomic(Path(path), dump(case))


def _origin(case):
    """The preset that a case came from: one with the same components, so that values are all there is to set; None for a rig of its own."""
    loop = scheduling.unscheduled(case.loop)
    structure = jax.tree.structure(_plain(loop))
    alike = [c for p in presets.PAPERS for c in presets.load(p).cases.values() if jax.tree.structure(_plain(c.loop)) == structure]
    if not alike:
        return None
    mine = _statics(loop)
    # its own preset, or the one with the most in common: its title is the one the file will show
    return max(alike, key=lambda c: (c.name == case.name, sum(a == b for a, b in zip(mine, _statics(c.loop))))).name


def _statics(loop):
    return [value for _, value, _ in walk(loop, kind="static")] + [np.asarray(loop.plant.area).tolist()]


def _plain(loop):
    """The loop with what a rig file can set made alike, so that structures compare by their components."""

    def settle(tree):
        changed = {}
        for field in dataclasses.fields(tree):
            value = getattr(tree, field.name)
            if is_component(value):
                changed[field.name] = settle(value)
            elif field.metadata.get("kind") == "static" and not isinstance(value, tuple):
                changed[field.name] = type(value)()
            elif field.metadata.get("like"):
                changed[field.name] = None
        return dataclasses.replace(tree, **changed)

    plain = settle(loop)
    # ramps are written whole, in a table of their own; of another reference only values can be set
    return dataclasses.replace(plain, reference=None) if isinstance(loop.reference, Ramps) else plain


def _reference(table, old):
    for key in table:
        if key not in REFERENCE_KEYS:
            raise unknown("key of [reference]", key, REFERENCE_KEYS)
    if not isinstance(old, Ramps):
        raise InputError("[reference] is for cases whose reference is made of ramps")
    outputs = np.size(old.initial)
    initial = table.get("initial", np.asarray(old.initial).tolist())
    if not (_is_numeric(initial) and np.shape(initial) == (outputs,) and np.all(np.isfinite(initial))):
        raise InputError(f"reference.initial = {_short(initial)}: must be a list of {outputs} finite levels")
    changes = table.get("changes", [[t, i + 1, float(v)] for (t, i), v in zip(old.changes, np.asarray(old.targets))])
    form = f"[time [s], output from 1 to {outputs}, level]"
    if not isinstance(changes, list):
        raise InputError(f"reference.changes = {_short(changes)}: must be a list of {form}")
    for change in changes:
        good = isinstance(change, list) and len(change) == 3 and all(np.ndim(v) == 0 and _is_numeric(v) for v in change)
        if not (good and isinstance(change[1], int) and 1 <= change[1] <= outputs and np.all(np.isfinite(change))):
            raise InputError(f"reference.changes has {_short(change)}: must be {form}, finite numbers")
    ramp = _number("reference.ramp", table.get("ramp", old.ramp))
    check_value("reference.ramp", ramp, describe_field(Ramps, "ramp"))
    band = _number("reference.band", table.get("band", old.band))
    check_value("reference.band", band, describe_field(Ramps, "band"))
    return ramps(initial, [(float(t), i - 1, float(v)) for t, i, v in changes], ramp, table.get("shape", old.shape), band)


def describe_field(cls, name):
    """The metadata of a field of a component class."""
    return next(f.metadata for f in dataclasses.fields(cls) if f.name == name)


def _free(loop, name, spec):
    good = isinstance(spec, list) and len(spec) in (2, 3) and all(_is_numeric(v) and np.ndim(v) == 0 for v in spec[:2])
    if not good or (len(spec) == 3 and spec[2] not in ("log", "linear")):
        raise InputError(f'free {name} = {_short(spec)}: must be [low, high] or [low, high, "log" or "linear"]')
    return check_free(loop, name, *spec)


def _set_clock(clock, values):
    fields = {}
    for name, value in values.items():
        field = name.removeprefix("clock.")
        if field not in CLOCK_UNITS:
            raise unknown("parameter", name, [f"clock.{f}" for f in CLOCK_UNITS])
        if field in ("dt", "duration"):
            value = _number(name, value)
        elif field == "substeps" and isinstance(value, float) and value.is_integer():
            value = int(value)
        fields[field] = value
    clock = dataclasses.replace(clock, **fields)
    check_clock(clock)
    return clock


def _set_static(tree, name, path, value, meta):
    if len(path) > 1:
        return dataclasses.replace(tree, **{path[0]: _set_static(getattr(tree, path[0]), name, path[1:], value, meta)})
    old = getattr(tree, path[0])
    if isinstance(old, tuple):
        raise InputError(f"{name} is the topology of the rig and cannot be set: choose another case")
    if meta["choices"] is not None:
        if value not in meta["choices"] or isinstance(value, bool) != isinstance(old, bool):
            raise InputError(
                f"{name} = {value!r}: must be one of {', '.join(str(c).lower() if isinstance(c, bool) else c for c in meta['choices'])}"
            )
        return dataclasses.replace(tree, **{path[0]: value})
    if isinstance(old, str):  # a text of which the component itself knows what it may be
        if not isinstance(value, str):
            raise InputError(f"{name} = {_short(value)}: must be a text")
        return dataclasses.replace(tree, **{path[0]: value})
    value = _number(name, value)
    check_value(name, value, meta)
    if isinstance(old, int) and not value.is_integer():
        raise InputError(f"{name} = {value:g}: must be a whole number")
    return dataclasses.replace(tree, **{path[0]: type(old)(value)})


def _number(name, value):
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not _is_numeric(value):
        raise InputError(f"{name} = {_short(value)}: must be a number")
    return float(value)


def _is_numeric(value):
    """True for a number that a float can hold, and for lists of such numbers and arrays of a regular shape."""
    if isinstance(value, (np.ndarray, np.generic)):
        return np.issubdtype(value.dtype, np.number)
    if isinstance(value, (list, tuple)):
        return all(_is_numeric(v) for v in value) and len({np.shape(v) for v in value}) <= 1
    try:
        return isinstance(value, (int, float)) and not isinstance(value, bool) and float(value) is not None
    except OverflowError:
        return False


def _unit(meta):
    return "" if meta["unit"] == "-" else f" [{meta['unit']}]"


def _line(name, value, meta):
    note = " ".join(filter(None, ["" if meta["unit"] == "-" else f"[{meta['unit']}]", meta["doc"]]))
    return f"{_toml(name)} = {_toml(value)}" + (f"  # {note}" if note else "")


def _toml(value):
    if isinstance(value, (np.generic, np.ndarray)):
        value = value.tolist()
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        escaped = value.replace("\\", "\\\\").replace('"', '\\"')
        return '"' + "".join(c if c.isprintable() else f"\\U{ord(c):08x}" for c in escaped) + '"'
    if isinstance(value, (list, tuple)):
        return "[" + ", ".join(_toml(v) for v in value) + "]"
    return repr(value)


__all__ = ["Case", "check", "dump", "from_table", "has", "load", "open_case", "save", "set_and_schedule", "set_values", "uncovered"]
