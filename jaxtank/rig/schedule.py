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

LAW = "controller."


def schedule(case, gains, knots):
    """A copy of `case` whose law has `gains` scheduled: the same run, until the values at the knots
    are changed.

    gains: {dotted name of a gain of the law: operating variable}, as {"controller.k": "r1",
    "controller.k1": "r1"}; an array stands for all its entries; the variable, a setpoint ("r1") or
    a level estimate ("h2"), counted from 1, is one for all. knots: (K,) increasing positions of the
    variable, in the rig's length unit.

    The values, controller.values (gains, K), are the gain's present one at every knot. What was
    free of a scheduled gain becomes free at every knot, within the same range; other names of the
    law are now controller.law.*. Raises InputError for an unknown gain (with the nearest), a static
    one, one that the law uses outside its step (see `Scheduled`), a variable that the rig does not
    have, and knots that do not increase.
    """
    loop, law = case.loop, case.loop.controller
    if isinstance(law, Scheduled):
        raise InputError("the law has a schedule already: name all its gains in one")
    names = [entry for name in gains for entry in _entries(loop, name)]
    check_gains(law, tuple(names))
    if len(set(gains.values())) != 1:
        raise InputError(
            f"schedule variables {', '.join(map(str, gains.values()))}: must be one for all gains"
        )
    variable = next(iter(gains.values()))
    check_variable(variable, len(loop.plant.outputs), loop.plant.tanks)
    check_knots(knots)
    knots = number(knots)
    values = number([[float(get_value(law, name))] * knots.size for name in names])
    numbers = [name for name in names if not split_index(name)[1]]
    law = _emptied(law, numbers)
    controller = Scheduled(
        law=law, knots=knots, values=values, gains=tuple(names), variable=variable
    )
    controller.check(loop.reference)
    free = _free(case, names, knots.size)
    return case.replace(loop=dataclasses.replace(loop, controller=controller), free=free)


def unscheduled(loop):
    """`loop` with the law that a schedule was made for, its gains those of the first knot; `loop`
    itself where there is none.
    """
    law = loop.controller
    if not isinstance(law, Scheduled):
        return loop
    first = dict(zip(law.gains, np.asarray(law.values)[:, 0]))
    return dataclasses.replace(loop, controller=with_values(law.law, first))


def check_not_scheduled(loop, name):
    """Raise InputError if `name` is a gain that a schedule gives, and not the law's own value."""
    law, inner = loop.controller, name.removeprefix(f"{LAW}law.")
    if isinstance(law, Scheduled) and name.startswith(f"{LAW}law.") and inner in law.gains:
        raise InputError(
            f"{name} is scheduled: it is controller.values[{law.gains.index(inner)},j] at knot j,"
            " counted from 0"
        )


def names_of(loop, name):
    """Where `name`, as the law has it without a schedule, is found in `loop`: at every knot of a
    scheduled gain, else under its new name.
    """
    law, inner = loop.controller, name.removeprefix(LAW)
    if (
        not isinstance(law, Scheduled)
        or not name.startswith(LAW)
        or inner.split("[")[0].split(".")[0] in ("law", "values", "knots")
    ):
        return [name]
    rows = [i for i, gain in enumerate(law.gains) if gain == inner or gain.split("[")[0] == inner]
    if rows:
        return [f"{LAW}values[{i},{j}]" for i in rows for j in range(np.size(law.knots))]
    return [f"{LAW}law.{inner}"]


def table_of(loop):
    """{"gains", "variable", "knots"} of a scheduled loop, as in a rig file; empty where there is no
    schedule.
    """
    law = loop.controller
    if not isinstance(law, Scheduled):
        return {}
    return {
        "gains": [LAW + g for g in law.gains],
        "variable": law.variable,
        "knots": np.asarray(law.knots).tolist(),
    }


def from_table(case, table):
    """Return `schedule` of a table as `table_of` makes it.

    Raises
    ------
    InputError for a key that is unknown, missing, or not of its kind.
    """
    values = read_entry(SECTIONS["schedule"], table, sizes_of(case.loop.plant))
    gains, knots = values["gains"], table["knots"]
    for gain in gains:
        if gains.count(gain) > 1:
            raise InputError(f"schedule.gains: {gain} is scheduled twice: name it once")
    if not isinstance(knots, list):
        raise InputError(f"schedule.knots = {knots!r}: must be a list of numbers")
    return schedule(case, dict.fromkeys(gains, table["variable"]), knots)


def known(loop, values):
    """({name: value} that `loop` has a leaf, a static field or a clock's field for, the others):
    what is set before a schedule is made, and what after.
    """
    names = {name for kind in ("leaf", "static") for name, _, _ in walk(loop, kind=kind)}
    before = {n: v for n, v in values.items() if n.split("[")[0] in names or n.startswith("clock.")}
    return before, {n: v for n, v in values.items() if n not in before}


def _entries(loop, name):
    """The scalars that a name stands for, without the "controller."."""
    if not name.startswith(LAW):
        raise unknown("gain", name, [n for n in parameters(loop) if n.startswith(LAW)])
    inner = name.removeprefix(LAW)
    try:
        found = describe(loop, name)
    except InputError:
        raise unknown("gain", name, [n for n in parameters(loop) if n.startswith(LAW)]) from None
    if found["kind"] == "static" or split_index(name)[1]:
        return [inner]
    return [
        inner + (f"[{','.join(map(str, i))}]" if i else "")
        for i in np.ndindex(np.shape(get_value(loop, name)))
    ]


def _emptied(law, names):
    """`law` without the leaves `names`."""
    for name in names:
        law = _without(law, name.split("."))
    return law


def _without(tree, path):
    return dataclasses.replace(
        tree, **{path[0]: _without(getattr(tree, path[0]), path[1:]) if path[1:] else None}
    )


def _free(case, gains, knots):
    """What is free after gains have been scheduled: their values at the knots, and all else under
    its new name.
    """
    free = {}
    for name, spec in case.free.items():
        if not name.startswith(LAW):
            free[name] = spec
            continue
        entries = _entries(case.loop, name)
        untouched = not set(entries) & set(gains)
        for entry in [name.removeprefix(LAW)] if untouched else entries:
            if entry in gains:
                row = gains.index(entry)
                free |= {f"{LAW}values[{row},{j}]": Free(*spec) for j in range(knots)}
            else:
                free[f"{LAW}law.{entry}"] = spec
    return free


__all__ = [
    "check_not_scheduled",
    "from_table",
    "known",
    "names_of",
    "schedule",
    "table_of",
    "unscheduled",
]
