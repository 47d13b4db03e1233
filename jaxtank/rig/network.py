"""A rig described tank by tank in a rig file: [[tank]], [[orifice]], [[pipe]], [[spill]], [[pump]]
and [plant]; read to a Case and written from a loop.
"""

import dataclasses
import functools
from typing import Any

import numpy as np

from jaxtank.case import Case
from jaxtank.core.clock import Clock
from jaxtank.core.errors import InputError
from jaxtank.core.tree import number
from jaxtank.core.units import DEFAULT, check_units, flow_per_input
from jaxtank.instruments.actuators import PumpBank
from jaxtank.instruments.sensors import LevelSensor
from jaxtank.loop.closed_loop import ClosedLoop
from jaxtank.observers import Direct
from jaxtank.plants.network import SURPLUS, TankNetwork, network
from jaxtank.rig.components import controller_of, observer_of
from jaxtank.rig.entry import Sizes, different, name_of, read_entries, read_entry, refusal
from jaxtank.rig.schema import LISTS, SECTIONS
from jaxtank.signals.base import Constant
from jaxtank.signals.setpoints import ramps

MOST = 5000
"""Tanks that a rig file may have; as many pumps, orifices, pipes and spills."""


def names_in(table):
    """{name: index} of the [[tank]] tables that have a name."""
    return {
        t["name"]: i
        for i, t in enumerate(table.get("tank", []))
        if isinstance(t, dict) and isinstance(t.get("name"), str) and t["name"]
    }


def build(table):
    """Return the Case of a table of a rig file that has [[tank]]."""
    table = {**table, **{name: _list(table, name) for name in LISTS}}
    units = _units(table.get("units", list(DEFAULT)))
    sizes = Sizes(len(table["tank"]), units=units, names=names_in(table))
    entries = {name: read_entries(SECTIONS[name], table, sizes) for name in LISTS}
    more = read_entry(SECTIONS["plant"], table.get("plant", {}), sizes)
    names = {kind: tuple(entry["name"] for entry in entries[kind]) for kind in ("tank", "pump")}
    _check_names(names["tank"])
    _check_links(table, entries)
    _check_pumps(table["pump"], entries["pump"], units)
    columns = _columns(entries)
    outputs = more.pop("outputs", tuple(first for first, _ in columns["plant.feeds"]))
    if not outputs:
        raise InputError("plant.outputs = []: must be a list of at least one tank")
    plant = network(**_fields(columns, "plant"), **more, outputs=outputs, units=units)
    control = table.get("controller", {})
    return Case(
        name="my rig",
        title=f"{sizes.tanks} tank{'s' * (sizes.tanks > 1)}, {control.get('kind', '')}",
        loop=_loop(plant, columns, control, table.get("observer")),
        clock=Clock(dt=1.0, duration=600.0),
        limits={"max_level": "rim"},
        free={},
        objective={"rms_error_total": 1.0},
        names={kind: each for kind, each in names.items() if any(each)},
    )


def _list(table, name):
    """The tables of a list in a rig file; InputError for too many, and for no tank or pump."""
    entries = table.get(name, [])
    if not entries and name in ("tank", "pump"):
        raise InputError(f"a rig needs at least one [[{name}]]")
    if len(entries) > MOST:
        raise InputError(f"[[{name}]]: {len(entries)} {name}s: must be at most {MOST}")
    return entries


def _columns(entries) -> dict[str, Any]:
    """{target: [value of each table]} of the lists of a rig; of parts of an entry, pairs."""
    columns = {
        key.target: [entry[key.name] for entry in entries[name]]
        for name in LISTS
        for key in SECTIONS[name].keys
        if key.target
    }
    for name in ("plant.links", "plant.spills"):
        columns[name] = list(zip(columns.pop(f"{name}.0"), columns.pop(f"{name}.1")))
    return columns


def _fields(columns, part):
    """{field: [value of each table]} of a part of the loop."""
    start = f"{part}."
    return {k.removeprefix(start): v for k, v in columns.items() if k.startswith(start)}


def _loop(plant, columns, control, observer):
    """The ClosedLoop of a plant and of the columns of its tables."""
    pumps, levels = _fields(columns, "actuator"), number(columns["x0"])
    inflow = columns["disturbance.level"]
    unset: Any = None  # the controller needs the loop
    sensor = {"gain": np.ones(plant.tanks), "full_scale": np.max(plant.rim)}
    # the pulse is of use only above 0, beside a dead zone
    pulse = [high if high > 0 else 1.0 for high in pumps["high"]]
    loop = ClosedLoop(
        plant=plant,
        sensor=LevelSensor(**_numbers(sensor | _fields(columns, "sensor"))),
        observer=Direct(),
        controller=unset,
        actuator=PumpBank(**_numbers({"stop": np.zeros(plant.pumps), "pulse": pulse, **pumps})),
        reference=ramps([float(levels[i]) for i in plant.outputs], [], ramp=0.0),
        disturbance=Constant(level=number(inflow)) if any(inflow) else None,
        x0=levels,
    )
    # a bias that is left out is computed once all values are set (rig/read.py)
    controller = controller_of(control, loop, number(pumps["initial"]))
    loop = dataclasses.replace(loop, controller=controller)
    return (
        loop
        if observer is None
        else dataclasses.replace(loop, observer=observer_of(observer, loop))
    )


def _numbers(values):
    return {name: number(value) for name, value in values.items()}


def _units(value):
    good = isinstance(value, list) and len(value) == 2
    if not (good and all(isinstance(v, str) and v for v in value)):
        raise refusal("units", value, 'be [length, pump input], as ["cm", "V"]')
    length, drive = (name_of("units: entry", v) for v in value)
    return check_units("units", (length, drive))


def _check_names(names):
    """Raise InputError where two tanks have the same name."""
    for i, name in enumerate(names):
        if name and name in names[:i]:
            raise InputError(f"two tanks have the same name, {name!r}: give each its own")


def _check_links(table, entries):
    """Raise InputError for a link of a tank to itself, and for spills of more than 1 in sum."""
    for name in ("orifice", "spill"):
        for i, (entry, row) in enumerate(zip(entries[name], table[name])):
            ends = [row["from"], row["to"]]
            different(f"{name} {i + 1}: [from, to]", ends, (entry["from"], entry["to"]))
    spills, rows = entries["spill"], table["spill"]
    for source in dict.fromkeys(spill["from"] for spill in spills):
        same = [k for k, spill in enumerate(spills) if spill["from"] == source]
        total = sum(spills[k]["caught"] for k in same)
        without = any("caught" not in rows[k] for k in same)
        if without and len(same) > 1 and total > 1.0 + SURPLUS:
            raise InputError(
                f"spill {' and '.join(str(k + 1) for k in same)}, from tank {source + 1}: caught is"
                f" {total:g} in sum, 1 where it is left out: give each its share of what passes the"
                " rim, from 0 to 1 in sum"
            )


FLOW_MARGIN = 2.0
"""Factor by which a pump may deliver more or less than the flow that its input asks for."""


def _check_pumps(rows, pumps, units):
    """Raise InputError for limits in the wrong order, for a split without two tanks, and for a gain
    that is not near the flow of a unit of the input.
    """
    length, drive = units
    for i, (pump, row) in enumerate(zip(pumps, rows)):
        if not pump["high"] > pump["low"]:
            raise InputError(
                f"pump {i + 1}: high = {pump['high']:g} {drive}: must be above its low,"
                f" {pump['low']:g} {drive}"
            )
        if ("split" in row) != (pump["to"][1] is not None):
            raise InputError(
                f"pump {i + 1}: split is the share of the first of two tanks: give it where to ="
                " [first, second], and only there"
            )
    flow = flow_per_input(units)
    for i, gain in enumerate(pump["gain"] for pump in pumps):
        if flow and gain > 0 and not 1 / FLOW_MARGIN <= gain / flow <= FLOW_MARGIN:
            raise InputError(
                f"pump {i + 1}: gain = {gain:g} {length}^3/s per {drive}: an input of 1 {drive} is"
                f" a flow of {flow:.6g} {length}^3/s: must be {flow:.6g} times the share that the"
                f" pump delivers, from {flow / FLOW_MARGIN:.4g} to {flow * FLOW_MARGIN:.4g}"
            )


def entries_of(loop, names):
    """Return [(section, number from 1, {key: value})] that describe a loop's rig tank by tank."""
    plant = loop.plant
    if not isinstance(plant, TankNetwork):
        raise InputError(f"its {type(plant).__name__} has no name in a rig file")
    entries = []
    for name in LISTS:
        section = SECTIONS[name]
        for i in range(len(getattr(plant, section.per))):
            values = {
                key.name: _entry_of(loop, key.target, i) for key in section.keys if key.target
            }
            if name == "pump" and plant.feeds[i][1] is None:
                del values["split"]
            if name in ("tank", "pump"):
                values["name"] = names[name][i] if name in names else ""
            entries.append((section, i + 1, values))
    more = {key.name: getattr(plant, key.name) for key in SECTIONS["plant"].keys}
    return [*entries, (SECTIONS["plant"], 1, more)]


def _entry_of(loop, target, i):
    """Entry i of the field `target` of a loop, or a part of it; 0 of no steady inflow."""
    if target.startswith("disturbance.") and not isinstance(loop.disturbance, Constant):
        return 0.0
    path = target.split(".")
    part = int(path.pop()) if path[-1].isdigit() else None
    value = functools.reduce(getattr, path, loop)
    if not isinstance(value, tuple) and np.ndim(value) == 0:  # one number for all tanks
        return value
    return value[i] if part is None else value[i][part]
