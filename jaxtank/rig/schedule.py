"""Turning gains of a case into a schedule, and back: what rig files and the command line do with
`controllers.Scheduled`.
"""

import dataclasses

import numpy as np

from jaxtank.case import Free
from jaxtank.controllers.gain_schedule import Scheduled, check_gains, check_knots, check_variable
from jaxtank.core.errors import InputError, unknown
from jaxtank.core.tree import (
    describe,
    get_value,
    number,
    parameters,
    split_index,
    walk,
    with_values,
)
from jaxtank.rig.entry import read_entry, sizes_of
from jaxtank.rig.schema import SECTIONS

START = "controller."


def schedule(case, gains, knots):
    """Return a copy of `case` with scheduled gains: the same run, until values at knots change."""
    loop, part = case.loop, case.loop.controller
    if isinstance(part, Scheduled):
        raise InputError("the controller has a schedule already: name all its gains in one")
    names = [entry for name in gains for entry in _entries(loop, name)]
    check_gains(part, tuple(names))
    if len(set(gains.values())) != 1:
        raise InputError(
            f"schedule variables {', '.join(map(str, gains.values()))}: must be one for all gains"
        )
    variable = next(iter(gains.values()))
    check_variable(variable, len(loop.plant.outputs), loop.plant.tanks)
    check_knots(knots)
    knots = number(knots)
    values = number([[float(get_value(part, name))] * knots.size for name in names])
    numbers = [name for name in names if not split_index(name)[1]]
    part = _emptied(part, numbers)
    controller = Scheduled(
        law=part, knots=knots, values=values, gains=tuple(names), variable=variable
    )
    controller.check(loop.reference)
    free = _free(case, names, knots.size)
    return case.replace(loop=dataclasses.replace(loop, controller=controller), free=free)


def unscheduled(loop):
    """Return `loop` with its controller without a schedule, its gains those of the first knot."""
    part = loop.controller
    if not isinstance(part, Scheduled):
        return loop
    first = dict(zip(part.gains, np.asarray(part.values)[:, 0]))
    return dataclasses.replace(loop, controller=with_values(part.law, first))


def check_not_scheduled(loop, name):
    """Raise InputError if `name` is a gain that a schedule gives, and not the controller's own."""
    part, inner = loop.controller, name.removeprefix(f"{START}law.")
    if isinstance(part, Scheduled) and name.startswith(f"{START}law.") and inner in part.gains:
        raise InputError(
            f"{name} is scheduled: it is controller.values[{part.gains.index(inner)},j] at knot j,"
            " counted from 0"
        )


def names_of(loop, name):
    """Return the names in `loop` of what an unscheduled controller calls `name`."""
    part, inner = loop.controller, name.removeprefix(START)
    if (
        not isinstance(part, Scheduled)
        or not name.startswith(START)
        or inner.split("[")[0].split(".")[0] in ("law", "values", "knots")
    ):
        return [name]
    rows = [i for i, gain in enumerate(part.gains) if gain == inner or gain.split("[")[0] == inner]
    if rows:
        return [f"{START}values[{i},{j}]" for i in rows for j in range(np.size(part.knots))]
    return [f"{START}law.{inner}"]


def table_of(loop):
    """Return {"gains", "variable", "knots"} of a scheduled loop; empty without a schedule."""
    part = loop.controller
    if not isinstance(part, Scheduled):
        return {}
    return {
        "gains": [START + g for g in part.gains],
        "variable": part.variable,
        "knots": np.asarray(part.knots).tolist(),
    }


def from_table(case, table):
    """Return `schedule` of a table as `table_of` makes it."""
    values = read_entry(SECTIONS["schedule"], table, sizes_of(case.loop.plant))
    gains, knots = values["gains"], table["knots"]
    for gain in gains:
        if gains.count(gain) > 1:
            raise InputError(f"schedule.gains: {gain} is scheduled twice: name it once")
    if not isinstance(knots, list):
        raise InputError(f"schedule.knots = {knots!r}: must be a list of numbers")
    return schedule(case, dict.fromkeys(gains, table["variable"]), knots)


def known(loop, values):
    """Return (values of names that `loop` or a clock has, the others)."""
    names = {name for kind in ("leaf", "static") for name, _, _ in walk(loop, kind=kind)}
    before = {n: v for n, v in values.items() if n.split("[")[0] in names or n.startswith("clock.")}
    return before, {n: v for n, v in values.items() if n not in before}


def _entries(loop, name):
    """The scalars that a name stands for, without the "controller."."""
    if not name.startswith(START):
        raise unknown("gain", name, [n for n in parameters(loop) if n.startswith(START)])
    inner = name.removeprefix(START)
    try:
        found = describe(loop, name)
    except InputError:
        raise unknown("gain", name, [n for n in parameters(loop) if n.startswith(START)]) from None
    if found["kind"] == "static" or split_index(name)[1]:
        return [inner]
    return [
        inner + (f"[{','.join(map(str, i))}]" if i else "")
        for i in np.ndindex(np.shape(get_value(loop, name)))
    ]


def _emptied(part, names):
    """`part` without the leaves `names`."""
    for name in names:
        part = _without(part, name.split("."))
    return part


def _without(tree, path):
    return dataclasses.replace(
        tree, **{path[0]: _without(getattr(tree, path[0]), path[1:]) if path[1:] else None}
    )


def _free(case, gains, knots):
    """What is free after gains are scheduled: their values at the knots, the rest under new names."""
    free = {}
    for name, spec in case.free.items():
        if not name.startswith(START):
            free[name] = spec
            continue
        entries = _entries(case.loop, name)
        untouched = not set(entries) & set(gains)
        for entry in [name.removeprefix(START)] if untouched else entries:
            if entry in gains:
                row = gains.index(entry)
                free |= {f"{START}values[{row},{j}]": Free(*spec) for j in range(knots)}
            else:
                free[f"{START}law.{entry}"] = spec
    return free
