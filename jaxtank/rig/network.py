"""A rig described tank by tank in a rig file: [[tank]], [[orifice]], [[pipe]], [[spill]], [[pump]]
and [plant]; read to a Case and written from a loop.
"""

import dataclasses
from typing import Any

import numpy as np

from jaxtank.case import Case
from jaxtank.core.clock import Clock
from jaxtank.core.errors import InputError
from jaxtank.core.text import shortened
from jaxtank.core.tree import number
from jaxtank.core.units import DEFAULT, check_units, flow_per_input
from jaxtank.instruments.actuators import PumpBank
from jaxtank.instruments.sensors import LevelSensor
from jaxtank.loop.closed_loop import ClosedLoop
from jaxtank.observers import Direct
from jaxtank.plants.network import SURPLUS, TankNetwork, network
from jaxtank.rig.components import controller_of, observer_of
from jaxtank.rig.entry import Sizes, different, name_of, read_entries, read_entry
from jaxtank.rig.schema import SECTIONS
from jaxtank.signals.base import Constant
from jaxtank.signals.setpoints import ramps

MOST = 5000
"""Tanks that a rig file may have; as many pumps, orifices, pipes and spills."""

LISTS = tuple(name for name, section in SECTIONS.items() if section.per)
"""Sections with a table for each tank, orifice, pipe, spill and pump."""


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
    sizes = Sizes(
        len(table["tank"]), units=_units(table.get("units", list(DEFAULT))), names=names_in(table)
    )
    entries = {name: read_entries(SECTIONS[name], table, sizes) for name in LISTS}
    more = read_entry(SECTIONS["plant"], table.get("plant", {}), sizes)
    _check_names(entries["tank"])
    _check_links(table, entries)
    _check_pumps(table["pump"], entries["pump"], sizes.units[1])
    columns = _columns(entries)
    _check_gains(columns["plant.pump_gain"], sizes.units)
    outputs = more.pop("outputs", tuple(first for first, _ in columns["plant.feeds"]))
    if not outputs:
        raise InputError("plant.outputs = []: must be a list of at least one tank")
    plant = network(**_fields(columns, "plant"), **more, outputs=outputs, units=sizes.units)
    control = table.get("controller", {})
    return Case(
        name="my rig",
        title=f"{sizes.tanks} tank{'s' * (sizes.tanks > 1)}, {control.get('kind', '')}",
        loop=_loop(plant, columns, control, table.get("observer")),
        clock=Clock(dt=1.0, duration=600.0),
        limits={"max_level": "rim"},
        free={},
        objective={"rms_error_total": 1.0},
        names={
            kind: found
            for kind in ("tank", "pump")
            if any(found := tuple(entry["name"] for entry in entries[kind]))
        },
    )


def _columns(entries) -> dict[str, Any]:
    """{target: [value of each table]} of the lists of a rig; of parts of an entry, pairs."""
    found = {}
    for name in LISTS:
        for key in SECTIONS[name].keys:
            if key.target:
                found[key.target] = [entry[key.name] for entry in entries[name]]
    for name in ("plant.links", "plant.spills"):
        found[name] = list(zip(found.pop(f"{name}.0"), found.pop(f"{name}.1")))
    return found


def _fields(columns, part):
    """{field: [value of each table]} of a part of the loop."""
    start = f"{part}."
    return {k.removeprefix(start): v for k, v in columns.items() if k.startswith(start)}


def _loop(plant, columns, control, observer):
    """The ClosedLoop of a plant and of the columns of its tables."""
    pumps, levels = _fields(columns, "actuator"), number(columns["x0"])
    inflow, initial = columns["disturbance.level"], number(pumps["initial"])
    start = [float(levels[i]) for i in plant.outputs]
    still: Any = None  # its place is taken below
    sensor = {"gain": np.ones(plant.tanks), "full_scale": np.max(plant.rim)}
    # the pulse is of use only above 0, beside a dead zone
    pulse = [high if high > 0 else 1.0 for high in pumps["high"]]
    bank = {"stop": np.zeros(plant.pumps), "pulse": pulse, **pumps}
    loop = ClosedLoop(
        plant=plant,
        sensor=LevelSensor(**_numbers({**sensor, **_fields(columns, "sensor")})),
        observer=Direct(),
        controller=still,
        actuator=PumpBank(**_numbers(bank)),
        reference=ramps(start, [], ramp=0.0),
        disturbance=Constant(level=number(inflow)) if any(inflow) else None,
        x0=levels,
    )
    # `rig.from_table` computes a bias that is left out, once all values are set
    loop = dataclasses.replace(loop, controller=controller_of(control, loop, initial))
    if observer is None:
        return loop
    return dataclasses.replace(loop, observer=observer_of(observer, loop))


def _numbers(values):
    return {name: number(value) for name, value in values.items()}


def _units(value):
    if not (
        isinstance(value, list) and len(value) == 2 and all(isinstance(v, str) and v for v in value)
    ):
        raise InputError(
            f'units = {shortened(value)}: must be [length, pump input], as ["cm", "V"]'
        )
    length, drive = (name_of("units: entry", v) for v in value)
    return check_units("units", (length, drive))


FLOW_MARGIN = 2.0
"""Factor by which a pump may deliver more or less than the flow that its input asks for."""


def _check_gains(gains, units):
    """Raise InputError for a gain that is not near the flow of a unit of its input."""
    factor = flow_per_input(units)
    for j, gain in enumerate(gains):
        if factor and gain > 0 and not 1 / FLOW_MARGIN <= gain / factor <= FLOW_MARGIN:
            raise InputError(
                f"pump {j + 1}: gain = {gain:g} {units[0]}^3/s per {units[1]}: an input of 1"
                f" {units[1]} is a flow of {factor:.6g} {units[0]}^3/s: must be {factor:.6g} times"
                f" the share that the pump delivers, from {factor / FLOW_MARGIN:.4g} to"
                f" {factor * FLOW_MARGIN:.4g}"
            )


def _check_names(tanks):
    """Raise InputError where two tanks have the same name."""
    seen: set[str] = set()
    for name in (tank["name"] for tank in tanks if tank["name"]):
        if name in seen:
            raise InputError(f"two tanks have the same name, {name!r}: give each its own")
        seen.add(name)


def _check_links(table, entries):
    """Raise InputError for a link of a tank to itself, and for spills of more than 1 in sum."""
    for name in ("orifice", "spill"):
        for i, (entry, given) in enumerate(zip(entries[name], table[name])):
            value = [given["from"], given["to"]]
            different(f"{name} {i + 1}: [from, to]", value, (entry["from"], entry["to"]))
    spills, given = entries["spill"], table["spill"]
    for source in dict.fromkeys(spill["from"] for spill in spills):
        own = [k for k, spill in enumerate(spills) if spill["from"] == source]
        total = sum(spills[k]["caught"] for k in own)
        without = any("caught" not in given[k] for k in own)
        if without and len(own) > 1 and total > 1.0 + SURPLUS:
            raise InputError(
                f"spill {' and '.join(str(k + 1) for k in own)}, from tank {source + 1}: caught is"
                f" {total:g} in sum, 1 where it is left out: give each its share of what passes the"
                " rim, from 0 to 1 in sum"
            )


def _check_pumps(given, pumps, drive):
    """Raise InputError for limits in the wrong order, and for a split without two tanks."""
    for i, (pump, written) in enumerate(zip(pumps, given)):
        if not pump["high"] > pump["low"]:
            raise InputError(
                f"pump {i + 1}: high = {pump['high']:g} {drive}: must be above its low,"
                f" {pump['low']:g} {drive}"
            )
        if ("split" in written) != (pump["to"][1] is not None):
            raise InputError(
                f"pump {i + 1}: split is the share of the first of two tanks: give it where to ="
                " [first, second], and only there"
            )


def _list(table, name):
    """The tables of a list in a rig file; InputError for too many, and for no tank or pump."""
    entries = table.get(name, [])
    if not entries and name in ("tank", "pump"):
        raise InputError(f"a rig needs at least one [[{name}]]")
    if len(entries) > MOST:
        raise InputError(f"[[{name}]]: {len(entries)} {name}s: must be at most {MOST}")
    return entries


def entries_of(loop, names):
    """Return [(section, number from 1, {key: value})] that describe a loop's rig tank by tank."""
    plant = loop.plant
    if not isinstance(plant, TankNetwork):
        raise InputError(f"its {type(plant).__name__} has no name in a rig file")
    found = []
    for name in LISTS:
        section = SECTIONS[name]
        for i in range(len(getattr(plant, section.per))):
            own = {key.name: _entry_of(loop, key.target, i) for key in section.keys if key.target}
            if name == "pump" and plant.feeds[i][1] is None:
                del own["split"]
            if name in ("tank", "pump"):
                own["name"] = names[name][i] if name in names else ""
            found.append((section, i + 1, own))
    more = {key.name: getattr(plant, key.name) for key in SECTIONS["plant"].keys}
    return [*found, (SECTIONS["plant"], 1, more)]


def _entry_of(loop, target, i):
    """Entry i of the field `target` of a loop, or a part of it; 0 of no steady inflow."""
    if target.startswith("disturbance.") and not isinstance(loop.disturbance, Constant):
        return 0.0
    value: Any = loop
    *path, part = target.split(".")
    for step in [*path, part] if not part.isdigit() else path:
        value = getattr(value, step)
    if not isinstance(value, tuple) and np.ndim(value) == 0:  # one number for all tanks
        return value
    return value[i][int(part)] if part.isdigit() else value[i]
