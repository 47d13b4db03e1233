"""Setting what a case has by dotted name: leaves, static fields, the clock."""

import dataclasses

from jaxtank import scheduling
from jaxtank.errors import InputError, unknown
from jaxtank.records import CLOCK_UNITS, check_clock
from jaxtank.rig.words import is_numeric, plain, static_value, unit
from jaxtank.tree import _short, check_value, describe, get_value, with_values


def by_dotted_name(table, where):
    """{dotted name: value} of a table in which names may be written without quotation marks: `clock.dt = 0.5` and [values.controller]
    are tables in tables to TOML. InputError, naming the table `where`, for a name that is given both ways."""
    found = {}
    for key, value in table.items():
        nested = isinstance(value, dict) and value and "." not in key  # a name that is quoted is whole: its value is no table
        inner = {f"{key}.{k}": v for k, v in by_dotted_name(value, where).items()} if nested else {key: value}
        for name in inner:
            if name in found:
                raise InputError(f"[{where}] {name} is given twice")
        found |= inner
    return found


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
        if not is_numeric(value):
            raise InputError(f"{name} = {_short(value)}: must be a number or a list of numbers{unit(meta)}")
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


def has(loop, name):
    """Whether a loop has the leaf `name`, an entry of it for "name[i]"."""
    try:
        get_value(loop, name)
    except InputError:
        return False
    return True


def _set_clock(clock, values):
    fields = {}
    for name, value in values.items():
        field = name.removeprefix("clock.")
        if field not in CLOCK_UNITS:
            raise unknown("parameter", name, [f"clock.{f}" for f in CLOCK_UNITS])
        if field in ("dt", "duration"):
            value = plain(name, value)
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
    return dataclasses.replace(tree, **{path[0]: static_value(name, value, meta, type(old))})
