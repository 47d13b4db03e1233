"""A rig described tank by tank in a rig file: [[tank]], [[orifice]], [[pipe]], [[spill]], [[pump]],
[plant]; no Python.
"""

import dataclasses

import numpy as np

from jaxtank.case import Case
from jaxtank.core.checks import check_value
from jaxtank.core.clock import Clock
from jaxtank.core.errors import InputError, unknown
from jaxtank.core.text import shortened
from jaxtank.core.tree import number
from jaxtank.core.units import DEFAULT, check_unit, local
from jaxtank.instruments.actuators import PumpBank
from jaxtank.instruments.sensors import LevelSensor
from jaxtank.loop.closed_loop import ClosedLoop
from jaxtank.observers import Direct
from jaxtank.plants.network import SURPLUS, TankNetwork, network
from jaxtank.rig.components import law_of, observer_of
from jaxtank.rig.schema import is_numeric, name_of
from jaxtank.rig.signals import INFLOW, meta_of
from jaxtank.signals.base import Constant
from jaxtank.signals.setpoints import ramps

TABLES = ("units", "tank", "orifice", "pipe", "spill", "pump", "plant")
TANK = {
    "name": "",
    "area": None,
    "rim": None,
    "drain": 0.0,
    "level": 0.0,
    "inflow": 0.0,
    "noise": 0.0,
}
PUMP = {
    "name": "",
    "gain": None,
    "to": None,
    "split": 1.0,
    "low": 0.0,
    "high": None,
    "initial": 0.0,
}
LINK = {"from": None, "to": None, "area": None}
PIPE = {"between": None, "area": None}
SPILL = {"from": None, "to": None, "caught": 1.0}
PLANT = {"gravity": None, "overflow": False, "bottom": False, "knee": None, "outputs": None}


def _says(doc):
    return {"unit": "-", "doc": doc}


def _like(cls, field, doc=None):
    return {**meta_of(cls, field), **({} if doc is None else {"doc": doc})}


# what each key is, its unit and its range
METAS = {
    "tank": {
        "name": _says("what other tables may call it, instead of its number from 1"),
        "area": _like(TankNetwork, "area", "cross-section A"),
        "rim": _like(TankNetwork, "rim", "height"),
        "drain": _like(TankNetwork, "drain", "effective orifice area to the basin; 0: closed"),
        "level": _like(ClosedLoop, "x0", "level at t = 0"),
        "inflow": {**INFLOW, "doc": "steady inflow that no pump brings; negative: a leak"},
        "noise": _like(LevelSensor, "noise", "standard deviation of the noise of its sensor"),
    },
    "pump": {
        "name": _says("a note; nothing refers to it"),
        "gain": _like(TankNetwork, "pump_gain", "flow per unit of the pump's input (Kp)"),
        "to": _says("the tank that it fills, or [first, second]"),
        "split": _like(TankNetwork, "split", "share that goes to the first of two tanks"),
        "low": _like(PumpBank, "low", "lower limit"),
        "high": _like(PumpBank, "high", "upper limit"),
        "initial": _like(PumpBank, "initial", "input at which it ran before t = 0"),
    },
    "orifice": {
        "from": _says("the tank that it leaves, by name or number from 1"),
        "to": _says("the tank that it pours into"),
        "area": _like(TankNetwork, "orifice", "effective area"),
    },
    "pipe": {
        "between": _says("the two tanks that it joins, below the surface"),
        "area": _like(TankNetwork, "pipe", "effective area"),
    },
    "spill": {
        "from": _says("the tank whose rim is passed"),
        "to": _says("the tank that it falls into"),
        "caught": _like(TankNetwork, "caught", "share that falls into it"),
    },
    "plant": {
        "outputs": _says(
            "the tanks whose levels are controlled; left out: those that the pumps fill first"
        ),
        **{k: meta_of(TankNetwork, k) for k in ("gravity", "overflow", "bottom", "knee")},
    },
}
# parts of the loop whose other fields one looks for in a table
ELSEWHERE = {"pump": ("actuator", PumpBank), "tank": ("sensor", LevelSensor)}


def tank_index(value, where, named, count):
    """Index of a tank given by its name or its number from 1; InputError, naming `where`, for
    another. named: {name: index}.
    """
    if isinstance(value, str):
        if value not in named:
            raise unknown(f"tank of {where}", value, named or ["1"])
        return named[value]
    if isinstance(value, bool) or not isinstance(value, int) or not 1 <= value <= count:
        raise InputError(
            f"{where} = {shortened(value)}: must be a tank, by its name or its number from 1 to"
            f" {count}"
        )
    return value - 1


MOST = 100
"""Tanks that a rig file may have; as many pumps, orifices, pipes and spills."""


def names_in(table):
    """{name: index} of the [[tank]] tables that have a name."""
    return {
        t["name"]: i
        for i, t in enumerate(table.get("tank", []))
        if isinstance(t, dict) and t.get("name")
    }


def build(table):
    """The Case of a table of a rig file that has [[tank]]; reference, values, limits and the rest
    come after (`rig.from_table`).
    """
    units = length, drive = _units(table.get("units", list(DEFAULT)))
    tanks = [
        _entry("tank", i, e, TANK, units) for i, e in enumerate(_list(table, "tank", at_least=1))
    ]
    pumps = [
        _entry("pump", i, e, PUMP, units) for i, e in enumerate(_list(table, "pump", at_least=1))
    ]
    links = [_entry("orifice", i, e, LINK, units) for i, e in enumerate(_list(table, "orifice"))]
    pipes = [_entry("pipe", i, e, PIPE, units) for i, e in enumerate(_list(table, "pipe"))]
    spills = [_entry("spill", i, e, SPILL, units) for i, e in enumerate(_list(table, "spill"))]
    more = _entry("plant", None, table.get("plant", {}), PLANT, units)
    named = names_in(table)
    if len(named) < sum(bool(t["name"]) for t in tanks):
        raise InputError("two tanks have the same name")

    def tank(value, where):
        return tank_index(value, where, named, len(tanks))

    def pair(value, where, short=False):
        entries = value if isinstance(value, list) else [value]
        if not 1 + (not short) <= len(entries) <= 2:
            raise InputError(
                f"{where} = {shortened(value)}: must name"
                f" {'one tank, or two' if short else 'two tanks'}"
            )
        found = [tank(v, where) for v in entries]
        if len(set(found)) < len(found):
            raise InputError(f"{where} = {shortened(value)}: must be two different tanks")
        return (*found, None) if len(found) == 1 else tuple(found)

    for i, (p, written) in enumerate(zip(pumps, table["pump"])):
        if not p["high"] > p["low"]:
            raise InputError(
                f"pump {i + 1}: high = {p['high']:g} {drive}: must be above its low, {p['low']:g}"
                f" {drive}"
            )
        if ("split" in written) != (isinstance(p["to"], list) and len(p["to"]) > 1):
            raise InputError(
                f"pump {i + 1}: split is the share of the first of two tanks: give it where to ="
                " [first, second], and only there"
            )
    feeds = [pair(p["to"], f"pump {i + 1}: to", short=True) for i, p in enumerate(pumps)]
    outputs = more["outputs"] if more["outputs"] is not None else [first + 1 for first, _ in feeds]
    if not isinstance(outputs, list) or not outputs:
        raise InputError(f"plant.outputs = {shortened(outputs)}: must be a list of tanks")
    overflows = [pair([e["from"], e["to"]], f"spill {i + 1}") for i, e in enumerate(spills)]
    _check_shares(overflows, table.get("spill", []), spills)
    plant = network(
        area=[t["area"] for t in tanks],
        rim=[t["rim"] for t in tanks],
        drain=[t["drain"] for t in tanks],
        links=[pair([e["from"], e["to"]], f"orifice {i + 1}") for i, e in enumerate(links)],
        orifice=[e["area"] for e in links],
        pipes=[pair(e["between"], f"pipe {i + 1}: between") for i, e in enumerate(pipes)],
        pipe=[e["area"] for e in pipes],
        spills=overflows,
        caught=[e["caught"] for e in spills],
        pump_gain=[p["gain"] for p in pumps],
        split=[p["split"] if feeds[j][1] is not None else 1.0 for j, p in enumerate(pumps)],
        feeds=feeds,
        outputs=[tank(v, "plant.outputs") for v in outputs],
        gravity=more["gravity"],
        overflow=bool(more["overflow"]),
        bottom=bool(more["bottom"]),
        units=(length, drive),
        knee=more["knee"],
    )
    levels = number([t["level"] for t in tanks])
    initial = number([p["initial"] for p in pumps])
    start = [float(levels[i]) for i in plant.outputs]
    inflow = [t["inflow"] for t in tanks]
    loop = ClosedLoop(
        plant=plant,
        sensor=LevelSensor(
            gain=number(np.ones(len(tanks))),
            noise=number([t["noise"] for t in tanks]),
            full_scale=number(np.max(plant.rim)),
        ),
        observer=(
            observer_of(table["observer"], plant, levels, initial)
            if "observer" in table
            else Direct()
        ),
        controller=law_of(table.get("law", {}), plant, start, initial),
        actuator=PumpBank(
            low=number([p["low"] for p in pumps]),
            high=number([p["high"] for p in pumps]),
            stop=number(np.zeros(len(pumps))),
            # of use only above 0, beside a dead zone
            pulse=number([p["high"] if p["high"] > 0 else 1.0 for p in pumps]),
            initial=initial,
        ),
        reference=ramps(start, [], ramp=0.0),
        disturbance=Constant(level=number(inflow)) if any(inflow) else None,
        x0=levels,
    )
    return Case(
        name="my rig",
        title=(
            f"{len(tanks)} tank{'s' if len(tanks) > 1 else ''},"
            f" {table.get('law', {}).get('kind', '')}"
        ),
        loop=loop,
        clock=Clock(dt=1.0, duration=600.0),
        limits={"max_level": "rim"},
        free={},
        objective={"rms_error_total": 1.0},
        names={
            kind: found
            for kind, own in (("tank", tanks), ("pump", pumps))
            if any(found := tuple(e["name"] for e in own))
        },
    )


def _units(value):
    if not (
        isinstance(value, list) and len(value) == 2 and all(isinstance(v, str) and v for v in value)
    ):
        raise InputError(
            f'units = {shortened(value)}: must be [length, pump input], as ["cm", "V"]'
        )
    return tuple(check_unit("units: entry", name_of("units: entry", v)) for v in value)


def _check_shares(overflows, written, spills):
    """Raise InputError where several spills of a tank leave out a share and come to more than 1:
    which falls where cannot be known.
    """
    for source in dict.fromkeys(source for source, _ in overflows):
        own = [k for k, (tank, _) in enumerate(overflows) if tank == source]
        without = [k for k in own if "caught" not in written[k]]
        total = sum(spills[k]["caught"] for k in own)
        if without and len(own) > 1 and total > 1.0 + SURPLUS:
            raise InputError(
                f"spill {' and '.join(str(k + 1) for k in own)}, from tank {source + 1}: caught is"
                f" {total:g} in sum, 1 where it is left out: give each its share of what passes the"
                " rim, from 0 to 1 in sum"
            )


def _list(table, key, at_least=0):
    entries = table.get(key, [])
    if not isinstance(entries, list) or not all(isinstance(e, dict) for e in entries):
        raise InputError(f"{key}: must be a list of tables, [[{key}]]")
    if len(entries) < at_least:
        raise InputError(f"a rig needs at least one [[{key}]]")
    if len(entries) > MOST:
        raise InputError(
            f"[[{key}]]: {len(entries)} {key}s: must be at most {MOST}, for each is a part of the"
            " compiled loop"
        )
    return entries


def _entry(kind, index, entry, fields, units):
    """`entry` with what it leaves out; InputError for an unknown key, one that is missing, what is
    no number, and what is out of range.
    """
    where = kind if index is None else f"{kind} {index + 1}"
    if not isinstance(entry, dict):
        raise InputError(f"{where}: must be a table")
    for key, value in entry.items():
        if key not in fields:
            part, cls = ELSEWHERE.get(kind, ("", None))
            if cls is not None and key in {f.name for f in dataclasses.fields(cls)}:
                raise InputError(
                    f'{where}: {key} is not a key of [[{kind}]]: it is "{part}.{key}" in [values],'
                    " for all of them at once"
                )
            raise unknown(
                f"key of [[{kind}]]" if index is not None else f"key of [{kind}]", key, fields
            )
        if key == "name":
            name_of(f"{where}: name", value)
        if key in ("name", "to", "from", "between", "outputs"):
            continue
        truth, meta = isinstance(fields[key], bool), METAS[kind][key]
        good = (
            isinstance(value, bool)
            if truth
            else not isinstance(value, bool) and isinstance(value, (int, float))
        )
        if not (good and is_numeric(float(value) if truth else value) and abs(value) <= 1e300):
            huge = good and abs(value) > 1e300 and value not in (float("inf"), -float("inf"))
            wanted = "true or false" if truth else "within +-1e300" if huge else "a finite number"
            raise InputError(f"{where}: {key} = {shortened(value)}: must be {wanted}")
        if not truth:
            check_value(
                f"{where}: {key}",
                value,
                {"low": None, "high": None, **meta, "unit": local(meta["unit"], units)},
            )
    for key, value in fields.items():
        if value is None and key not in entry and kind != "plant":
            raise InputError(f"{where}: {key} is missing")
    return {**fields, **entry}


def entries_of(loop, names):
    """[(title, kind, {key: value})] that describe the rig of a loop tank by tank. A steady inflow
    is the tanks' own. names: those of a Case; "name" is (name, number from 1).

    Raises InputError for a plant of another class than TankNetwork.
    """
    plant, bank, found = loop.plant, loop.actuator, []
    if not isinstance(plant, TankNetwork):
        raise InputError(f"its {type(plant).__name__} has no name in a rig file")
    steady = (
        np.asarray(loop.disturbance.level)
        if isinstance(loop.disturbance, Constant)
        else np.zeros(plant.tanks)
    )
    columns = {
        "area": plant.area,
        "rim": plant.rim,
        "drain": plant.drain,
        "level": loop.x0,
        "inflow": steady,
        "noise": np.broadcast_to(loop.sensor.noise, plant.tanks),
    }
    for i in range(plant.tanks):
        own = {"name": (names["tank"][i] if "tank" in names else "", i + 1)}
        found.append(
            ("[[tank]]", "tank", own | {k: float(np.asarray(v)[i]) for k, v in columns.items()})
        )
    for (a, b), area in zip(plant.links, np.asarray(plant.orifice).tolist()):
        found.append(("[[orifice]]", "orifice", {"from": a + 1, "to": b + 1, "area": area}))
    for (a, b), area in zip(plant.pipes, np.asarray(plant.pipe).tolist()):
        found.append(("[[pipe]]", "pipe", {"between": [a + 1, b + 1], "area": area}))
    for (a, b), caught in zip(plant.spills, np.asarray(plant.caught).tolist()):
        found.append(("[[spill]]", "spill", {"from": a + 1, "to": b + 1, "caught": caught}))
    for j, (first, second) in enumerate(plant.feeds):
        own = {"name": (names["pump"][j] if "pump" in names else "", j + 1)}
        own |= {
            "gain": float(plant.pump_gain[j]),
            "to": first + 1 if second is None else [first + 1, second + 1],
        }
        own |= {} if second is None else {"split": float(plant.split[j])}
        found.append(
            (
                "[[pump]]",
                "pump",
                own
                | {k: float(np.asarray(getattr(bank, k))[j]) for k in ("low", "high", "initial")},
            )
        )
    more = {"outputs": [i + 1 for i in plant.outputs], "gravity": float(plant.gravity)}
    return [
        *found,
        ("[plant]", "plant", more | {k: getattr(plant, k) for k in ("overflow", "bottom", "knee")}),
    ]
