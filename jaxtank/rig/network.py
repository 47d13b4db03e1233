"""A rig described tank by tank in a rig file: read to a Case and written from a loop."""

import dataclasses
import functools
import math
from collections import Counter
from typing import Any

import numpy as np

from jaxtank.case import Case
from jaxtank.core.clock import Clock
from jaxtank.core.errors import InputError
from jaxtank.core.labels import name_of as name_of_part
from jaxtank.core.tree import number
from jaxtank.core.units import DEFAULT, check_units, flow_per_input
from jaxtank.instruments.actuators import PumpBank
from jaxtank.instruments.sensors import LevelSensor
from jaxtank.loop.closed_loop import ClosedLoop
from jaxtank.observers import Direct
from jaxtank.plants.elements import full_open
from jaxtank.plants.network import SURPLUS, TankNetwork, network
from jaxtank.rig.components import controller_of, observer_of
from jaxtank.rig.entry import (
    Problems,
    Sizes,
    check_coefficient,
    different,
    name_of,
    read_entries,
    read_entry,
    refusal,
    unit,
)
from jaxtank.rig.schema import INPUTS, LISTS, SECTIONS
from jaxtank.rig.sensors import complete_rows, curve_of, leaves_of, sensor_rows, with_names
from jaxtank.rig.signals import parts_of
from jaxtank.signals.base import Constant
from jaxtank.signals.setpoints import ramps

MOST = 5000  # tanks that a rig file may have; as many pumps, valves, orifices, pipes and spills


def names_in(table):
    """{name: index} of the [[tank]] tables that have a name, and of those of their sensors."""
    is_name = lambda value: isinstance(value, str) and value != ""
    rows = [row for row in table["tank"] if isinstance(row, dict)]
    names = {t["name"]: i for i, t in enumerate(rows) if is_name(t.get("name"))}
    sensors = [row for row in table.get("sensors", []) if isinstance(row, dict)]
    for i, row in enumerate(sensors):
        tank = row.get("tank", i + 1)
        index = names.get(tank) if isinstance(tank, str) else None
        index = tank - 1 if isinstance(tank, int) else index
        if is_name(row.get("name")) and index is not None:
            names.setdefault(row["name"], index)
    return names


def build(table):
    """Return the Case of a table of a rig file that has [[tank]]."""
    table = _with_drains({**table, **{name: _list(table, name) for name in LISTS}})
    units = _units(table.get("units", list(DEFAULT)))
    sizes = Sizes(len(table["tank"]), units=units)
    if flow_per_input(units):  # an input that is a flow: a pump that says nothing has gain = 1
        bare = lambda row: isinstance(row, dict) and not {"gain", "curve"} & row.keys()
        table["pump"] = [row | {"gain": 1.0} if bare(row) else row for row in table["pump"]]
    table["sensors"] = sensor_rows(table, sizes.tanks)
    sizes = sizes._replace(names=names_in(table))
    entries, more = _read(table, sizes)
    _check_areas(table, entries, units)
    rims, noise, levels = ([t[key] for t in entries["tank"]] for key in ("rim", "noise", "level"))
    leaves, levels = leaves_of(entries["sensors"], rims, noise, levels)
    columns = _columns(entries) | {"x0": levels}
    columns |= {f"sensor.{name}": value for name, value in leaves.items()}
    outputs = more.pop("outputs", _usual_outputs(entries))
    if not outputs:
        raise InputError("plant.outputs = []: must be a list of at least one tank")
    if table["spill"]:  # else it would do nothing
        more = {"overflow": True, **more}
    plant = network(**_keywords(columns), **more, outputs=outputs, units=units)
    names = with_names(_names(entries), entries["sensors"], sizes.tanks)
    plant = dataclasses.replace(plant, names=names)
    control = table.get("controller", {})  # or a controller of Python
    kind = control.get("kind", "") if isinstance(control, dict) else type(control).__name__
    return Case(
        name="my rig",
        title=f"{sizes.tanks} tank{'s' * (sizes.tanks > 1)}, {kind}",
        loop=_loop(plant, columns, control, table.get("observer")),
        clock=Clock(dt=1.0, duration=600.0),
        limits={"max_level": "rim"},
        free={},
        objective={"rms_error_total": 1.0},
    )


DRAIN = {  # {key of an [[orifice]] into the basin: key of its [[tank]]}
    "area": "drain",
    "port": "drain_port",
    "exponent": "drain_exponent",
    "linear": "drain_linear",
}


def _with_drains(table):
    """A table whose orifices into the basin are the drains of their tanks."""
    tanks, orifices = [*table["tank"]], []
    for i, row in enumerate(table["orifice"]):
        if "to" in row or not row.keys() - {"from"} <= DRAIN.keys():
            orifices.append(row)
            continue
        names = [tank.get("name") for tank in tanks]
        source = row.get("from")
        at = names.index(source) if source in names else source
        if not (isinstance(at, int) and (source in names or 1 <= at <= len(tanks))):
            orifices.append(row)  # refused with the rest
            continue
        at -= source not in names
        if tanks[at].keys() & set(DRAIN.values()):
            raise InputError(
                f"orifice {i + 1}: tank {source} has another opening into the basin: add their"
                " areas, or name the tank that it flows into (to)"
            )
        tanks[at] = tanks[at] | {DRAIN[key]: v for key, v in row.items() if key in DRAIN}
    return {**table, "tank": tanks, "orifice": orifices}


def _check_areas(table, entries, units):
    """`check_coefficient` of the outlets and orifices of a table."""
    problems = Problems()
    for kind, area, power in (("tank", "drain", "drain_exponent"), ("orifice", "area", "exponent")):
        for i, (row, values) in enumerate(zip(table[kind], entries[kind])):
            with problems.collect():
                label, exponent = f"{kind} {i + 1}: {area}", values.get(power)
                check_coefficient(label, row.get(area), values[area], exponent, units)
    problems.check()


def _read(table, sizes):
    """({list: [values of each table]}, values of [plant]), with all problems in one answer."""
    problems, more = Problems(), {}
    entries: dict[str, list[dict[str, Any]]] = {name: [] for name in (*LISTS, "sensors")}
    for name in entries:
        with problems.collect():
            entries[name] = read_entries(SECTIONS[name], table, sizes)
    with problems.collect():
        more = read_entry(SECTIONS["plant"], table.get("plant", {}), sizes)
    for i, tank in enumerate(entries["tank"]):
        with problems.collect(("tank", i, None)):
            tank |= _vessel(f"tank {i + 1}", tank, sizes.units)
    rows = {name: table[name] if entries[name] else () for name in LISTS}
    with problems.collect():
        complete_rows(entries["sensors"], sizes.tanks, sizes.units[0])
    checks = [
        lambda: _check_names(entries),
        lambda: _check_links(rows, entries, sizes.units),
        lambda: _check_spills(entries["spill"], rows["spill"]),
        lambda: _check_ports(entries["spill"], entries["tank"], sizes.units[0]),
        lambda: _check_pumps(rows["pump"], entries["pump"], sizes.units),
        lambda: _check_valves(entries["valve"], sizes.units),
    ]
    for check in checks:
        with problems.collect():
            check()
    problems.check()
    return entries, more


FORMS: dict[str, tuple[tuple[str, ...], ...]] = {
    "prism": (("area",), ("diameter",)),
    "cone": (("diameter", "height"), ("area", "height")),
    "sphere": (("diameter",), ("area", "height")),
    "horizontal-cylinder": (("diameter", "length"), ("area", "height")),
    "table": ((), ("area", "height")),
}
"""{shape: sets of keys by which a [[tank]] gives its size}."""


def _vessel(where, tank, units):
    """{key: value} of area, shape, height and rim of a [[tank]]; an upright one is a prism."""
    shape, tank = tank.get("shape", "prism"), _with_volume(where, tank)
    kind, title = (shape, f'shape = "{shape}"') if isinstance(shape, str) else ("table", "shape")
    if kind == "prism":
        title = "an upright tank"
        _name_rim(where, tank, units)
    sizes = {key: tank[key] for key in ("area", "diameter", "height", "length") if key in tank}
    if tuple(sorted(sizes)) not in FORMS[kind]:
        if kind == "prism" and not sizes:
            area = unit(SECTIONS["tank"]["area"].meta(units))
            raise InputError(f"{where} needs area{area}: cross-section A; or diameter, or shape")
        forms = ", or ".join(" and ".join(form) or "no other" for form in FORMS[kind])
        raise InputError(
            f"{where}: {title} needs {forms} of area, diameter, height, length, not"
            f" {', '.join(sizes) or 'none'}"
        )
    if kind == "table":
        extent, area, shape = _table_of_sections(where, shape, sizes)
    else:
        extent = tank["rim"] if kind == "prism" else sizes.get("height", sizes.get("diameter"))
        disc = _disc(sizes["diameter"]) if "diameter" in sizes else sizes.get("area", 0.0)
        area = sizes["diameter"] * sizes["length"] if "length" in sizes else disc
    return {"area": area, "shape": shape, "height": extent, "rim": tank.get("rim", extent)}


def _name_rim(where, tank, units):
    """Call the height of an upright tank its rim."""
    if {"height", "rim"} <= tank.keys():
        twice = "height and rim are the same of an upright tank"
        raise InputError(f"{where}: {twice}: give one of them")
    if "height" in tank:
        tank["rim"] = tank.pop("height")
    if "rim" not in tank:
        raise InputError(f"{where} needs rim [{units[0]}]: height")


def _table_of_sections(where, shape, sizes):
    """Return (extent, largest section, points of both as shares of these)."""
    levels, areas = zip(*shape)
    if levels[0] != 0.0 or min(areas) < 0.0 or min(areas[1:]) == 0.0:
        rule = "be [[level, area], ...] from level 0, areas above 0"
        raise refusal(f"{where}: shape", shape, rule)
    points = tuple((h / levels[-1], a / max(areas)) for h, a in shape)
    return sizes.get("height", levels[-1]), sizes.get("area", max(areas)), points


def _with_volume(where, tank):
    """An upright [[tank]] whose volume and one of area, diameter and rim give the other."""
    tank = dict(tank)
    if "volume" not in tank:
        return tank
    if "shape" in tank:
        raise InputError(f"{where}: volume: the sizes of a shape give it: leave it out")
    if "height" in tank and "rim" not in tank:
        tank["rim"] = tank.pop("height")
    area = tank.get("area", _disc(tank["diameter"]) if "diameter" in tank else None)
    if (area is None) == ("rim" not in tank) or {"area", "diameter"} <= tank.keys():
        raise InputError(
            f"{where}: volume is that of an upright tank: give with it one of rim, area, diameter"
        )
    rest = {k: v for k, v in tank.items() if k != "volume"}
    if area is None:
        return rest | {"area": tank["volume"] / tank["rim"]}
    return rest | {"rim": tank["volume"] / area}


def _disc(diameter):
    return math.pi / 4.0 * diameter**2


def _list(table, name):
    """The tables of a list in a rig file; InputError for too many, and for no tank or input."""
    entries = table.get(name, [])
    if not entries and name == "tank":
        raise InputError("a rig needs at least one [[tank]]")
    if not entries and not any(table.get(kind) for kind in INPUTS):
        raise InputError("a rig needs at least one [[pump]] or [[valve]]")
    if len(entries) > MOST:
        raise InputError(f"[[{name}]]: {len(entries)} {name}s: must be at most {MOST}")
    return entries


def _stacked(entries):
    """{target: [value of each table]}; without options that no table has."""
    columns: dict[str, Any] = {}
    for name in LISTS:
        for key in (key for key in SECTIONS[name].keys if key.target):
            column = columns.setdefault(key.target, [])
            column += [entry.get(key.name) for entry in entries[name]]
    for key in (key for name in LISTS for key in SECTIONS[name].keys if key.like):
        if all(value == key.default for value in columns.get(key.target, [0.0])):
            columns.pop(key.target, None)
    return columns


def _columns(entries) -> dict[str, Any]:
    """{target: [value of each table]} of the lists of a rig; of parts of an entry, pairs."""
    columns = _stacked(entries)
    for name in ("plant.links", "plant.spills", "plant.valves"):
        columns[name] = list(zip(columns.pop(f"{name}.0"), columns.pop(f"{name}.1")))
    if all(shape == "prism" for shape in columns["plant.shapes"]):
        del columns["plant.shapes"], columns["plant.extent"]
    if "plant.spill_port" in columns:  # an opening that is left out is the rim
        rims = [columns["plant.rim"][source] for source, _ in columns["plant.spills"]]
        ports = columns["plant.spill_port"]
        columns["plant.spill_port"] = [r if p is None else p for r, p in zip(rims, ports)]
    gains = columns["plant.pump_gain"]
    columns["plant.pump_gain"] = [1.0 if gain is None else gain for gain in gains]
    return columns


def _keywords(columns):
    """Keywords of `network` of the columns of a plant."""
    keywords = _fields(columns, "plant")
    for option in ("port", "exponent", "resistance"):
        names = [name for name in keywords if name.endswith(f"_{option}")]
        of = {name.removesuffix(f"_{option}"): keywords.pop(name) for name in names}
        keywords[f"{option}s"] = of
    return keywords


def _fields(columns, part):
    """{field: [value of each table]} of a part of the loop."""
    start = f"{part}."
    return {k.removeprefix(start): v for k, v in columns.items() if k.startswith(start)}


def _loop(plant, columns, control, observer):
    inputs, levels = _fields(columns, "actuator"), number(columns["x0"])
    inflow = columns["disturbance.level"]
    delays = inputs.pop("delays")  # the least is that of all
    delay = min(delays)
    delays = tuple(more - delay for more in delays)
    unset: Any = None  # the controller needs the loop
    sensor = {"gain": np.ones(plant.tanks), "full_scale": np.max(plant.rim)}
    sensor |= _fields(columns, "sensor")
    # the pulse is of use only above 0, beside a dead zone
    pulse = [high if high > 0 else 1.0 for high in inputs["high"]]
    usual = {"stop": np.zeros(plant.pumps), "pulse": pulse}
    loop = ClosedLoop(
        plant=plant,
        sensor=LevelSensor(**{n: v if n == "display" else number(v) for n, v in sensor.items()}),
        observer=Direct(),
        controller=unset,
        actuator=PumpBank(
            **{n: number(v) for n, v in {**usual, **inputs}.items()},
            delay=delay,
            delays=delays if any(delays) else (),
        ),
        reference=ramps([float(levels[i]) for i in plant.outputs], [], ramp=0.0),
        disturbance=Constant(level=number(inflow)) if any(inflow) else None,
        x0=levels,
    )
    # a bias that is left out is computed once all values are set (rig/read.py)
    controller = controller_of(control, loop, number(inputs["initial"]))
    loop = dataclasses.replace(loop, controller=controller)
    parts = {} if observer is None else {"observer": observer_of(observer, loop)}
    return dataclasses.replace(loop, **parts)


def _units(value):
    good = isinstance(value, list) and len(value) == 2
    if not (good and all(isinstance(v, str) and v for v in value)):
        raise refusal("units", value, 'be [length, pump input], as ["cm", "V"]')
    length, drive = (name_of("units: entry", v) for v in value)
    return check_units("units", (length, drive))


def _names(entries):
    """((kind, names), ...) of the kinds of which one has a name."""
    names = ((kind, tuple(row["name"] for row in entries[kind])) for kind in ("tank", *INPUTS))
    return tuple((kind, each) for kind, each in names if any(each))


def _usual_outputs(entries):
    """The tanks that the pumps fill first, or which they empty; without pumps, the valves."""
    ends = [p.get("from") if p["to"][0] is None else p["to"][0] for p in entries["pump"]]
    return tuple(dict.fromkeys(ends or [valve["from"] for valve in entries["valve"]]))


def _check_names(entries):
    """Raise InputError where two tanks, or two pumps and valves, have the same name."""
    for kinds in (("tank",), INPUTS):
        each = [entry["name"] for kind in kinds for entry in entries[kind] if entry["name"]]
        for name, count in Counter(each).items():
            if count > 1:
                words = " or ".join(f"{kind}s" for kind in kinds)
                raise InputError(f"{count} {words} are called {name!r}: give each its own name")


def _check_links(table, entries, units):
    """Raise InputError for a link of a tank to itself, and for an orifice without a size."""
    for name in ("orifice", "spill", "pump", "valve"):
        for i, (entry, row) in enumerate(zip(entries[name], table[name])):
            if "from" in row and "to" in row:
                ends = entry["to"] if name == "pump" else (entry["to"],)
                tanks = (entry["from"], *(tank for tank in ends if tank is not None))
                different(f"{name} {i + 1}: [from, to]", [row["from"], row["to"]], tanks)
    for i, row in enumerate(table["orifice"]):
        if "area" not in row and "linear" not in row:
            area = unit(SECTIONS["orifice"]["area"].meta(units))
            raise InputError(f"orifice {i + 1} needs area{area}: effective area; or linear")


def _check_spills(spills, rows):
    """Raise InputError for spills of more than 1 in sum."""
    for source in dict.fromkeys(spill["from"] for spill in spills):
        same = [k for k, spill in enumerate(spills) if spill["from"] == source]
        total = sum(spills[k]["caught"] for k in same)
        if any("caught" not in rows[k] for k in same) and len(same) > 1 and total > 1.0 + SURPLUS:
            raise InputError(
                f"spill {' and '.join(str(k + 1) for k in same)}, from tank {source + 1}: caught is"
                f" {total:g} in sum, 1 where it is left out: give each its share of what passes the"
                " rim, from 0 to 1 in sum"
            )


def _check_ports(spills, tanks, length):
    """Raise InputError for an overflow opening above the rim of its tank."""
    for k, spill in enumerate(spills if tanks else ()):  # none where a tank is refused
        rim, port = tanks[spill["from"]].get("rim"), spill.get("port")
        if None not in (rim, port) and port > rim:
            raise InputError(
                f"spill {k + 1}: port = {port:g} {length} is above the rim of tank"
                f" {spill['from'] + 1}, {rim:g} {length}: liquid passes the rim first; give a port"
                " at or below the rim, or leave it out"
            )


FLOW_MARGIN = 2.0
"""Factor by which a pump may deliver more or less than the flow that its input asks for; of the
largest flow of a curve its square."""


def _flow_gain(where, gain, flow, units):
    """The flow per unit of an input that is a flow, of a gain that may be a share of it."""
    length, drive = units
    near = lambda size: 1 / FLOW_MARGIN <= size <= FLOW_MARGIN
    if gain <= 0.0 or (gain != 1.0 and near(gain / flow)):
        return gain
    if near(gain):
        return gain * flow
    raise InputError(
        f"{where}: gain = {gain:g}: an input of 1 {drive} is a flow of {flow:.6g} {length}^3/s:"
        f" must be the share of it that the pump delivers, 1, from {1 / FLOW_MARGIN:g} to"
        f" {FLOW_MARGIN:g}, or the flow itself, from {flow / FLOW_MARGIN:.4g} to"
        f" {flow * FLOW_MARGIN:.4g} {length}^3/s per {drive}"
    )


def _check_flows(where, points, flow, units):
    """Raise InputError for a curve whose flows are far from those that its inputs ask for."""
    length, drive = units
    last, most = abs(points[-1][0]), max(abs(y) for _, y in points)
    if last and not 1 / FLOW_MARGIN**2 <= most / (last * flow) <= FLOW_MARGIN**2:
        raise InputError(
            f"{where}: an input of {last:g} {drive} gives a flow of {most:g} {length}^3/s, which is"
            f" {most / flow:.4g} {drive}: flows without a unit are in {length}^3/s; write"
            f' "{most:g} {drive}" if they are in {drive}'
        )


def _check_pumps(rows, pumps, units):
    """Raise InputError for pumps that cannot be; gains of inputs that are flows are completed."""
    drive, flow = units[1], flow_per_input(units)
    for i, (pump, row) in enumerate(zip(pumps, rows)):
        pump.setdefault("to", (None, None))
        if pump["to"][0] is None and "from" not in pump:
            raise InputError(
                f"pump {i + 1} needs to: the tank that it fills, or [first, second]; or from: the"
                " tank that it empties"
            )
        if ("gain" in pump) == ("curve" in pump):
            gain = unit(SECTIONS["pump"]["gain"].meta(units))
            raise InputError(
                f"pump {i + 1}: gain and curve both give its flow: give one of them"
                if "gain" in pump
                else f"pump {i + 1} needs gain{gain}: flow per unit of the pump's input (Kp); or"
                " curve = [[input, flow], ...]"
            )
        for key, least in (("curve", None), ("curve_head", 0.0)):
            _check_monotone(f"pump {i + 1}: {key}", pump.get(key), least)
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
        if flow and "gain" in pump:
            pump["gain"] = _flow_gain(f"pump {i + 1}", pump["gain"], flow, units)
        elif flow not in (None, 1.0):
            _check_flows(f"pump {i + 1}: curve", pump["curve"], flow, units)


def _check_monotone(label, points, least=None):
    """Raise InputError for points of a curve that rise and fall, or lie below `least`."""
    heights, rows = [y for _, y in points or ()], [list(p) for p in points or ()]
    if heights not in (sorted(heights), sorted(heights, reverse=True)):
        raise refusal(label, rows, "rise or fall all along: a curve that turns")
    if least is not None and min(heights, default=least) < least:
        raise refusal(label, rows, f"be at least {least:g}")


def _check_valves(valves, units):
    """Raise InputError for stops or characteristics that are none; full open is the upper stop."""
    full, drive = full_open(units), unit(SECTIONS["valve"]["high"].meta(units))
    for i, valve in enumerate(valves):
        high = valve.setdefault("high", full)
        if not valve["low"] < high <= full:
            raise InputError(
                f"valve {i + 1}: low, high = {valve['low']:g}, {high:g}{drive}: openings must"
                f" increase, up to {full:g}, full open"
            )
        shares = valve["characteristic"]
        if not isinstance(shares, str):
            label = f"valve {i + 1}: characteristic"
            _check_monotone(label, shares, 0.0)
            if (shares[0][0], shares[-1][0]) != (0.0, 1.0):
                raise refusal(label, [list(p) for p in shares], "have openings from 0 to 1")


def entries_of(loop):
    """Return [(section, number from 1, {key: value})] that describe a loop's rig tank by tank."""
    plant = loop.plant
    if not isinstance(plant, TankNetwork):
        raise InputError(f"its {type(plant).__name__} has no name in a rig file")
    places = [(n, i) for n in LISTS for i in range(len(getattr(plant, SECTIONS[n].per)))]
    entries = [(SECTIONS[name], i + 1, _values_of(loop, name, i)) for name, i in places]
    more = {key.name: getattr(plant, key.name) for key in SECTIONS["plant"].keys}
    tanks = [values for section, _, values in entries if section.name == "tank"]
    return [*entries, *_sensor_entries(loop, tanks), (SECTIONS["plant"], 1, more)]


def _values_of(loop, name, i):
    """{key: value} of table i of a list."""
    plant, section = loop.plant, SECTIONS[name]
    # valves are the inputs after the pumps
    j = i + len(plant.feeds) * (name == "valve")
    entry = lambda target: _entry_of(loop, target, i if target.startswith("plant.") else j)
    values = {key.name: entry(key.target) for key in section.keys if key.target}
    usual = {key.name: key.default for key in section.keys if key.like}
    values = {k: v for k, v in values.items() if k not in usual or v != usual[k]}
    if name in ("tank", *INPUTS):
        values["name"] = name_of_part(plant, name, i)
    if name == "tank":
        values |= _sizes_of(values)
    if name == "pump" and plant.feeds[i][1] is None:
        del values["split"]
    if values.get("to") == (None, None):
        del values["to"]
    if values.get("curve") is not None:
        del values["gain"]  # 1, or one of [values]
    return values


def _sensor_entries(loop, tanks):
    """The tables [[sensor]] of a loop: names, spans, and the noise instead of the tanks'."""
    low, high = (getattr(loop.sensor, end, None) for end in ("low", "high"))
    rows = []
    for i in range(loop.plant.tanks):
        row = {"name": name_of_part(loop.plant, "sensor", i), "tank": i}
        if low is not None and high is not None and np.isfinite([low[i], high[i]]).all():
            row["span"] = [float(low[i]), float(high[i])]
        if (curve := curve_of(loop.sensor, i)) is not None:
            row["curve"] = curve
        if display := (getattr(loop.sensor, "display", ()) or ("",) * len(tanks))[i]:
            row["log_unit"] = display
        if row["name"] or row.keys() & {"span", "curve", "log_unit"}:
            row["noise"] = tanks[i].pop("noise", None)
            for leaf in ("offset", "scale", "filter"):
                values = getattr(loop.sensor, leaf, None)
                row[leaf] = None if values is None else values[i]
            rows.append((SECTIONS["sensors"], len(rows) + 1, row))
    return rows


def _entry_of(loop, target, i):
    """Entry i of the field `target` of a loop, or a part of it; 0 of no steady inflow."""
    if target.startswith("disturbance."):
        _, steady, _ = parts_of(loop.disturbance)
        return steady.level[i] if isinstance(steady, Constant) else 0.0
    if target == "actuator.delays":
        delays = getattr(loop.actuator, "delays", ())
        return loop.actuator.delay + delays[i] if delays else None
    path = target.split(".")
    part = int(path.pop()) if path[-1].isdigit() else None
    # a custom actuator or sensor need not have what the tables of a rig may give
    value = functools.reduce(lambda part, name: getattr(part, name, None), path, loop)
    if value is None or (isinstance(value, tuple) and not value):  # not in use
        return None
    if not isinstance(value, tuple) and np.ndim(value) == 0:  # one number for all tanks
        return value
    return value[i] if part is None else value[i][part]


def _sizes_of(tank):
    """{key: value} of the size of a [[tank]] as people give it, where that is the same numbers."""
    shape, area, extent = tank["shape"], float(tank["area"]), tank.get("height")
    if shape in (None, "prism"):
        return {"shape": None, "height": None}
    extent = float(extent)
    if not isinstance(shape, str):
        points = tuple((_factor(y, extent), _factor(share, area)) for y, share in shape)
        same = points[-1][0] == extent and max(a for _, a in points) == area
        return {"shape": points} | ({"area": None, "height": None} if same else {})
    if shape == "horizontal-cylinder":
        length = _nearby(area / extent, lambda length: extent * length == area)
        sizes = {"diameter": extent, "length": length}
    else:
        diameter = _nearby(math.sqrt(4.0 * area / math.pi), lambda d: _disc(d) == area)
        sizes = {"diameter": diameter, "height": extent}
        if shape == "sphere":
            sizes = {"diameter": diameter if diameter == extent else None}
    return {} if None in sizes.values() else {"area": None, "height": None, **sizes}


def _nearby(value, is_exact):
    """The shortest of the numbers beside `value` that is exact, None without one."""
    rounded = [float(f"{value:.{digits}g}") for digits in (9, 12, 15)]
    near = [value, *(math.nextafter(value, end) for end in (0.0, math.inf))]
    return next((v for v in [*rounded, *near] if is_exact(v)), None)


def _factor(share, whole):
    """The number whose share of `whole` is `share` to the bit, if there is one."""
    exact = _nearby(share * whole, lambda value: value / whole == share)
    return share * whole if exact is None else exact
