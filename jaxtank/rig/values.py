"""What a case has by dotted name, set: leaves, static fields, the clock; scenarios; schedules."""

import contextlib
import dataclasses
import re
from collections.abc import Mapping
from typing import Any

import numpy as np

from jaxtank.case import Case, Free
from jaxtank.controllers.gain_schedule import Scheduled, check_gains, check_knots, check_variable
from jaxtank.core.checks import check_value
from jaxtank.core.clock import CLOCK_UNITS, check_clock
from jaxtank.core.errors import EquilibriumError, InputError, unknown
from jaxtank.core.labels import index_of, label_of, names_of
from jaxtank.core.quantities import NUMBER, converted
from jaxtank.core.tree import (
    describe,
    get_value,
    number,
    parameters,
    split_index,
    walk,
    with_values,
)
from jaxtank.loop.closed_loop import ClosedLoop
from jaxtank.loop.steady import steady_state
from jaxtank.loop.tank_bottom import can_withdraw
from jaxtank.plants.tank_network import TankNetwork
from jaxtank.rig.entry import (
    check_areas,
    is_finite,
    is_numeric,
    is_plain,
    plain,
    read_entry,
    refusal,
    sizes_of,
    static_value,
    unit,
)
from jaxtank.rig.schema import SECTIONS
from jaxtank.rig.sensors import TANKS_OF, Manipulated, readings, units_of_gain
from jaxtank.rig.signals import steps

MODELS = ("controller.model.", "controller.law.model.", "observer.model.")
"""Where controller and observer hold the plant's parameters, by the same names."""

STEADY = ("x0", "actuator.initial", "reference.initial")  # what a scenario may have as "steady"

_NUMBER = r"[+-]?(?:[0-9]+(?:\.[0-9]*)?|\.[0-9]+)(?:[eE][+-]?[0-9]+)?"
_RELATIVE = re.compile(
    rf"x *(?P<factor>{_NUMBER})|by +(?P<offset>{_NUMBER})|(?P<default>{_NUMBER}) +if zero"
)


def by_dotted_name(table, where):
    """Return {dotted name: value} of a table in which names may be written without quotes."""
    values = {}
    for key, value in table.items():
        # a name that is quoted is whole: its value is no table
        nested = isinstance(value, dict) and value and "." not in key
        inner = by_dotted_name(value, where) if nested else {"": value}
        for name, each in inner.items():
            name = f"{key}.{name}" if name else key
            if name in values:
                raise InputError(f"[{where}] {name} is given twice")
            values[name] = each
    return values


def dotted_name(loop: ClosedLoop, name: str) -> str:
    """Return the dotted name of a parameter by the rig's own: "x0[0]" for "LT101.level"."""
    plant: Any = loop.plant
    if not plant.names:
        return name
    base, bracket, inner = name.partition("[")
    if bracket and inner.endswith("]") and not re.fullmatch(r"[\d,]*", inner[:-1]):
        return _of_entries(loop, name, base, inner[:-1].split(","))
    part, _, key = name.rpartition(".")
    if part.startswith("plant.") and any(key in names for _, names in plant.names):
        return _of_entries(loop, name, part, [key])
    kind = next((kind for kind, names in plant.names if part and part in names), "")
    return _of_table(plant, kind, part, key) if kind else name


def _of_entries(loop, name, base, inner):
    """`dotted_name` of a parameter and what its brackets hold: names, or numbers from 0."""
    axes = describe(loop, base).get("shape", ())
    plant, entries = loop.plant, []
    for entry, axis in zip(inner, axes):
        axis = "pump" if axis == "feed" else axis
        # a gain of an output is also called by the pump that moves it
        of_pump = entry in names_of(plant, "pump") and entry not in names_of(plant, "output")
        if axis == "output" and of_pump:
            entry = _loop_that_moves(loop, name, index_of(name, plant, "pump", entry))
        if axis in ("tank", "pump", "output", "valve"):
            entries.append(entry if entry.isdigit() else index_of(name, plant, axis, entry))
    return f"{base}[{','.join(map(str, entries))}]" if len(entries) == len(axes) else name


def _loop_that_moves(loop, name, pump):
    """The number, as text, of the output whose loop moves a pump."""
    controller = getattr(loop.controller, "law", loop.controller)
    inputs_of = getattr(controller, "inputs_of", lambda output: (output,))
    outputs = range(len(loop.plant.outputs))
    output = next((i for i in outputs if pump in inputs_of(i)), None)
    if output is None:
        raise InputError(f"{name}: no loop moves {label_of(loop.plant, 'pump', pump)}")
    return str(output)


OF_A_NAME = dict.fromkeys(("tank", "sensor"), ("tank", "sensors"))
"""{what is called by a name: sections of the keys of its parameters}."""


def _of_table(plant, kind, part, key):
    """`dotted_name` of a key of the table of a tank, pump, valve or sensor of that name."""
    sections = [SECTIONS[name] for name in OF_A_NAME.get(kind, (kind,))]
    section = next((s for s in sections if key in s.names), None)
    if section is None:
        names = dict.fromkeys(name for s in sections for name in s.names)
        raise unknown(f"key of {kind} {part}", key, list(names))
    target = section[key].target
    if target == "actuator.delays":
        raise InputError(
            f"{part}.{key} is a part of the compiled program: write it in the rig file's [[{kind}]]"
            " (actuator.delay is the dead time of all inputs)"
        )
    if not target or section[key].kind not in ("number", "reading"):
        raise InputError(f"{part}.{key} is the topology of the rig and cannot be set")
    i = dict(plant.names)[kind].index(part)
    # limits of valves come after those of the pumps
    i += len(plant.feeds) if kind == "valve" and target.startswith("actuator.") else 0
    return f"{target}[{i}]"


def in_unit(loop: ClosedLoop, label: str, name: str, value: Any) -> Any:
    """Return the value of a parameter with texts, as "5 min" or "80 %", as numbers of its unit."""
    meta = describe(loop, name)
    texts: Any = value if isinstance(value, (list, tuple)) else [value]
    part, _, field = split_index(name)[0].rpartition(".")
    level = part.split(".")[0] not in ("actuator", "plant") and "signal" not in part
    if level and str in map(type, texts):
        controller = getattr(loop.controller, "law", loop.controller)
        of_controller = part.partition(".")[0] == "controller" and field in TANKS_OF
        tanks = tuple(getattr(controller, TANKS_OF[field], ())) if of_controller else ()
        leads = tuple((j,) for j in getattr(controller, "lead", ()))
        rows = getattr(controller, "sequence", ()) or leads
        manipulated = Manipulated(rows, getattr(controller, "span", None))
        index = split_index(name)[1]
        if tanks and index and index[0] < len(tanks):
            entries = [0.0] * index[0] + [value]
            value = readings(label, field, entries, meta["unit"], tanks, loop, manipulated)[-1]
        else:
            axes = tanks or _axes(loop, name, meta)
            value = readings(label, field, value, meta["unit"], axes, loop, manipulated)
    numbers = converted(label, value, meta["unit"])
    if part == "plant" and str in map(type, texts):
        check_areas(loop.plant, name.removeprefix("plant."), label, texts, numbers)
    return numbers


def _axes(loop, name, meta):
    """Of which a parameter has one entry each, "tank" or "output"; of an entry its index."""
    axis = (meta.get("shape") or ("output",))[0]
    index: list[int] = list(split_index(name)[1])
    if len(index) != 1:
        return "tank" if axis == "tank" else "output"
    changes: Any = getattr(steps(loop.reference), "changes", ())
    if axis == "change":
        index = [changes[index[0]][1] if index[0] < len(changes) else 0]
    if axis == "tank" or meta["unit"] in units_of_gain(loop):
        return index[0]
    return loop.plant.outputs[index[0]] if index[0] < len(loop.plant.outputs) else 0


def by_rig_name(
    loop: ClosedLoop, values: Mapping[str, Any], convert: bool = True
) -> dict[str, Any]:
    """Return {`dotted_name`: value}, in units of the rig; not `convert`: values are shares."""
    renamed = {}
    for name, value in values.items():
        dotted = dotted_name(loop, name)
        if dotted in renamed:
            raise InputError(f"{name} is given twice, as {dotted} too: give it once")
        if convert and name != dotted and _relative(value) is None:
            value = in_unit(loop, name, dotted, value)
        renamed[dotted] = value
    return renamed


def set_values(case: Case, values: Mapping[str, Any]) -> Case:
    """Return a copy of `case` with leaves, static fields and clock fields set by dotted name.

    Parameters
    ----------
    case : Case
    values : {name: number, list, text or truth value}, numbers in the parameter's unit

    Returns
    -------
    Case.

    Raises
    ------
    InputError for an unknown name (with the nearest), a value of the wrong kind or shape, and a
    value out of range.

    Examples
    --------
    >>> from jaxtank import presets, rig
    >>> case = rig.set_values(presets.find("cascaded/pi"), {"clock.duration": 400.0, "x0[1]": 3.0})
    >>> case.clock.duration, case.loop.x0[1].item()
    (400.0, 3.0)
    """
    values = by_rig_name(case.loop, values)
    clock = {name: value for name, value in values.items() if name.startswith("clock.")}
    if clock:
        case = case.replace(clock=_set_clock(case.clock, clock))
    for name, value in values.items():
        if name in clock:
            continue
        meta = describe(case.loop, name)
        if meta["kind"] == "static":
            if is_plain(_static_of(case.loop, name)):
                value = converted(name, value, meta["unit"])
            if "[" in name:
                raise InputError(f"{name}: {name.split('[')[0]} has no entries, set it whole")
            case = case.replace(loop=_set_static(case.loop, name, name.split("."), value, meta))
            continue
        value = in_unit(case.loop, name, name, value)
        if not is_numeric(value):
            raise refusal(name, value, f"be a number or a list of numbers{unit(meta)}")
        check_not_scheduled(case.loop, name)
        loop = with_values(case.loop, {name: value})
        if parameters(loop).get(split_index(name)[0]) is not None:  # an infinite Ti is none
            check_value(name, get_value(loop, name), meta)
        case = case.replace(loop=loop)
    return case


def with_models(loop, values):
    """Return `values` with those of the plant for the models that follow it."""
    names = {name for kind in ("leaf", "static") for name, _, _ in walk(loop, kind=kind)}
    followers = {"plant.": MODELS, **dict.fromkeys(MODELS[:-1], MODELS[-1:])}
    copies = {}
    for owner, models in followers.items():
        for name, value in values.items():
            inner = name.removeprefix(owner)
            for model in models if inner != name else ():
                base = (model + inner).split("[")[0]
                if base in names and base not in values:
                    copies[model + inner] = value
    plants = {name: value for name, value in values.items() if name.startswith("plant.")}
    return {**plants, **{n: v for n, v in copies.items() if n not in values}, **values}


def set_scenario(case: Case, values: Mapping[str, Any]) -> Case:
    """Return a copy of `case` with the values of a Scenario, which may be relative to the case.

    Parameters
    ----------
    case : Case
    values : {dotted name: value} as in `set_values`, or a text for a number: "x1.3" (times 1.3),
        "by -0.5" (0.5 less, in the unit of the parameter), "0.02 if zero" (0.02 where the case has
        0 in every entry, else the case's own), and for x0, actuator.initial and reference.initial
        "steady" (the steady state of the case's plant at the setpoints of t = 0)

    Raises
    ------
    InputError as `set_values` does, and for another text; EquilibriumError without a steady state.

    Examples
    --------
    >>> from jaxtank import presets, rig
    >>> case = presets.find("mirakhorli/sfc")
    >>> rig.set_scenario(case, {"plant.split[0]": "x0.5"}).loop.plant.split.tolist()
    [0.21, 0.34]
    """
    values = by_rig_name(case.loop, values)
    numbers = {name: _absolute(case, name, value) for name, value in values.items()}
    steady = [name for name in numbers if _is_steady(name, numbers[name])]
    if steady:
        start = set_values(case, {n: v for n, v in numbers.items() if n not in steady})
        first = dataclasses.replace(start.clock, duration=start.clock.dt)
        setpoints = [float(np.asarray(v)[0]) for v in start.loop.reference.sample(first)[0]]
        try:
            levels, inputs = steady_state(start.loop, setpoints, case.loop.plant)
        except EquilibriumError as error:
            raise EquilibriumError(f'{steady[0]} = "steady": {error}') from None
        rest: dict[str, Any] = dict(zip(STEADY, (levels.tolist(), inputs.tolist(), setpoints)))
        numbers |= {name: rest[name] for name in steady}
    return set_values(case, numbers)


def overridden(case: Case, values: Mapping[str, Any]) -> tuple[Case, dict[str, list[str]]]:
    """Return (case with `values` in place of its scenarios' own, {name: scenarios that had it})."""
    scenarios, replaced = [], {}
    for s in case.scenarios:
        changes = {}
        for name, value in s.values.items():
            over = [n for n in values if overlap(n, name)] if not is_change(value) else []
            for n in over:
                replaced.setdefault(n, []).append(s.name)
            if not any(n in (name, split_index(name)[0]) for n in over):
                # an entry of an array that the scenario sets whole: after it
                changes |= {name: value, **{n: values[n] for n in over}}
        scenarios.append(s._replace(values=changes))
    return case.replace(scenarios=tuple(scenarios)), replaced


def overlap(name: str, other: str) -> bool:
    """Return whether two dotted names, of leaves or of entries, have an entry in common."""
    return name == other or split_index(name)[0] == other or name == split_index(other)[0]


def is_change(value: Any) -> bool:
    """Return whether the value of a scenario is a factor or an offset on the case's own."""
    match = _relative(value)
    return match is not None and match["default"] is None


def _relative(value):
    return _RELATIVE.fullmatch(value.strip()) if isinstance(value, str) else None


def _is_steady(name, value):
    return name in STEADY and isinstance(value, str) and value.strip() == "steady"


def _absolute(case, name, value):
    """The number that a value relative to the case comes to; any other, and "steady", unchanged."""
    current, meta = _number_of(case, name) if isinstance(value, str) else (None, {})
    if current is None or _is_steady(name, value):
        return value
    match = _relative(value)
    if match is None and NUMBER.match(value.strip()):
        with contextlib.suppress(InputError):  # the refusal below names relative changes too
            if name.startswith("clock."):
                return converted(name, value, meta["unit"])
            return in_unit(case.loop, name, name, value)
    if match is None:
        more = ', or "steady"' if name in STEADY else ""
        numbers = f"a number or a list of numbers{unit(meta)}"
        relative = f'"x1.3" (times), "by -0.5" (less), "0.02 if zero"{more}'
        raise refusal(name, value, f"be {numbers}, or relative to the case's own: {relative}")
    current = np.asarray(current, dtype=float)
    if match["factor"] is not None:
        return (float(match["factor"]) * current).tolist()
    if match["offset"] is not None:
        return (current + float(match["offset"])).tolist()
    return current.tolist() if np.any(current) else float(match["default"])


def _number_of(case, name):
    """(number or array that `name` is in a case, None where it is no number; its metadata)."""
    if name.startswith("clock."):
        field = name.removeprefix("clock.")
        value, meta = getattr(case.clock, field, None), {"unit": CLOCK_UNITS.get(field, "-")}
    else:
        meta: dict[str, Any] = describe(case.loop, name)
        if meta["kind"] == "leaf":
            return get_value(case.loop, name), meta
        value = _static_of(case.loop, name)
    return value if is_plain(value) else None, meta


def _static_of(loop, name):
    return next(v for n, v, _ in walk(loop, kind="static") if n == name.split("[")[0])


def set_and_schedule(case: Case, values: Mapping[str, Any], table: Mapping[str, Any]) -> Case:
    """Return `set_values` of a case with the schedule of a [schedule] table; {}: none."""
    if table:
        # names of the schedule exist only after it
        names = {name for kind in ("leaf", "static") for name, _, _ in walk(case.loop, kind=kind)}
        first = [n for n in values if n.split("[")[0] in names or n.startswith("clock.")]
        case = set_values(case, {n: values[n] for n in first})
        table = _with_knots(case.loop, table)
        gains = read_entry(SECTIONS["schedule"], table, sizes_of(case.loop))["gains"]
        if twice := [gain for gain in gains if gains.count(gain) > 1]:
            raise InputError(f"schedule.gains: {twice[0]} is scheduled twice: name it once")
        case = schedule(case, dict.fromkeys(gains, table["variable"]), table["knots"])
        values = {n: v for n, v in values.items() if n not in first}
    return set_values(case, values)


def _with_knots(loop, table):
    """A [schedule] whose knots are numbers, "80 %" of the span of the tank of its variable."""
    plant, knots, variable = loop.plant, table.get("knots"), table.get("variable")
    if knots is None or not isinstance(variable, str):
        return table  # refused when it is read
    check_variable(variable, len(plant.outputs), plant.tanks)
    tank = int(variable[1:]) - 1
    tank = plant.outputs[tank] if variable[0] == "r" else tank
    length, label = loop.units[0], "schedule.knots"
    numbers = readings(label, "knots", knots, length, tank, loop)
    numbers = converted(label, numbers, length)
    if not is_finite(numbers, 1):
        raise refusal(label, knots, f"be a list of finite numbers [{length}]")
    return {**table, "knots": numbers}


def with_bottom(case: Case) -> Case:
    """Return the case with `plant.bottom` where liquid can be drawn out of its tanks."""
    plant: Any = case.loop.plant
    if not isinstance(plant, TankNetwork) or plant.bottom:
        return case
    drawing = ("actuator.", "disturbance.")
    each = [{n: v for n, v in s.values.items() if n.startswith(drawing)} for s in case.scenarios]
    each = [c for c in each if c and not any(_is_steady(n, v) for n, v in c.items())]
    if not any(can_withdraw(set_scenario(case, changes).loop) for changes in [*each, {}]):
        return case
    return set_values(case, with_models(case.loop, {"plant.bottom": True}))


def has(loop: ClosedLoop, name: str) -> bool:
    """Return whether a loop has a leaf, or an entry of one, of this dotted name."""
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
            value = plain(name, converted(name, value, CLOCK_UNITS[field]))
        elif field == "substeps" and isinstance(value, float) and value.is_integer():
            value = int(value)
        fields[field] = value
    clock = dataclasses.replace(clock, **fields)
    check_clock(clock)
    return clock


def _set_static(tree, name, path, value, meta):
    old = getattr(tree, path[0])
    if len(path) > 1:
        new = _set_static(old, name, path[1:], value, meta)
    elif isinstance(old, tuple):
        raise InputError(
            f"{name} is the topology of the rig and cannot be set: choose another case"
        )
    else:
        new = static_value(name, value, meta, type(old))
    return dataclasses.replace(tree, **{path[0]: new})


CONTROLLER = "controller."


def schedule(case, gains, knots):
    """Return `case` with scheduled gains {name: variable}: the same run until values change."""
    loop, part = case.loop, case.loop.controller
    if isinstance(part, Scheduled):
        raise InputError("the controller has a schedule already: name all its gains in one")
    names = [entry for name in gains for entry in _entries(loop, name)]
    check_gains(part, tuple(names))
    variable, *others = dict.fromkeys(gains.values())
    if others:
        variables = ", ".join(map(str, gains.values()))
        raise InputError(f"schedule variables {variables}: must be one for all gains")
    check_variable(variable, len(loop.plant.outputs), loop.plant.tanks)
    check_knots(knots)
    knots = number(knots)
    values = number([[float(get_value(part, name))] * knots.size for name in names])
    for name in names:
        if not split_index(name)[1]:
            part = _without(part, name.split("."))
    gains_at = {"knots": knots, "values": values, "gains": tuple(names)}
    controller = Scheduled(law=part, **gains_at, variable=variable)
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
    part, inner = loop.controller, name.removeprefix(f"{CONTROLLER}law.")
    if isinstance(part, Scheduled) and inner != name and inner in part.gains:
        raise InputError(
            f"{name} is scheduled: it is controller.values[{part.gains.index(inner)},j] at knot j,"
            " counted from 0"
        )


def scheduled_names(loop, name):
    """Return the names in `loop` of what an unscheduled controller calls `name`."""
    part, inner = loop.controller, name.removeprefix(CONTROLLER)
    of_schedule = inner.split("[")[0].split(".")[0] in ("law", "values", "knots")
    if not isinstance(part, Scheduled) or inner == name or of_schedule:
        return [name]
    rows = [i for i, gain in enumerate(part.gains) if inner in (gain, gain.split("[")[0])]
    if rows:
        return [f"{CONTROLLER}values[{i},{j}]" for i in rows for j in range(np.size(part.knots))]
    return [f"{CONTROLLER}law.{inner}"]


def schedule_table(loop):
    """Return {"gains", "variable", "knots"} of a scheduled loop; empty without a schedule."""
    part = loop.controller
    if not isinstance(part, Scheduled):
        return {}
    gains, knots = [CONTROLLER + g for g in part.gains], np.asarray(part.knots).tolist()
    return {"gains": gains, "variable": part.variable, "knots": knots}


def _entries(loop, name):
    """The scalars that a name stands for, without the "controller."."""
    try:
        kind = describe(loop, name)["kind"]
    except InputError:
        kind = None
    if kind is None or not name.startswith(CONTROLLER):
        raise unknown("gain", name, [n for n in parameters(loop) if n.startswith(CONTROLLER)])
    inner = name.removeprefix(CONTROLLER)
    if kind == "static" or split_index(name)[1]:
        return [inner]
    places = np.ndindex(np.shape(get_value(loop, name)))
    return [inner + (f"[{','.join(map(str, i))}]" if i else "") for i in places]


def _without(tree, path):
    inner = _without(getattr(tree, path[0]), path[1:]) if path[1:] else None
    return dataclasses.replace(tree, **{path[0]: inner})


def _free(case, gains, knots):
    """What is free with scheduled gains: their values at knots, the rest under new names."""
    free = {}
    for name, spec in case.free.items():
        if not name.startswith(CONTROLLER):
            free[name] = spec
            continue
        entries = _entries(case.loop, name)
        untouched = not set(entries) & set(gains)
        for entry in [name.removeprefix(CONTROLLER)] if untouched else entries:
            if entry in gains:
                row = gains.index(entry)
                free |= {f"{CONTROLLER}values[{row},{j}]": Free(*spec) for j in range(knots)}
            else:
                free[f"{CONTROLLER}law.{entry}"] = spec
    return free
