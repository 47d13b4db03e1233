"""A rig described tank by tank in a rig file: [[tank]], [[orifice]], [[pipe]], [[spill]], [[pump]], [plant], [law], [observer]; no Python."""

import dataclasses

import numpy as np

from jaxtank import controllers, observers
from jaxtank.actuators import PumpBank
from jaxtank.analysis import equilibrium
from jaxtank.errors import EquilibriumError, InputError, unknown
from jaxtank.loop import ClosedLoop
from jaxtank.plants.hydraulics import GRAVITY
from jaxtank.plants.network import network
from jaxtank.presets.base import Case
from jaxtank.records import Clock
from jaxtank.sensors import LevelSensor
from jaxtank.signals import Constant, Ramps, ramps
from jaxtank.tree import _short, number
from jaxtank.units import DEFAULT

LAWS = {
    "pid": controllers.PID,
    "state-feedback": controllers.StateFeedback,
    "lqi": controllers.LQI,
    "ngpc": controllers.NGPC,
    "backstepping": controllers.Backstepping,
    "enmpc": controllers.ENMPC,
    "two-tank-backstepping": controllers.TwoTankBackstepping,
    "sliding-mode": controllers.SlidingMode,
    "fuzzy": controllers.FuzzyBlend,
    "gpc": controllers.GPC,
    "laguerre": controllers.Laguerre,
}
OBSERVERS = {"direct": observers.Direct, "disturbance": observers.DisturbanceObserver}
TABLES = ("units", "tank", "orifice", "pipe", "spill", "pump", "plant", "law", "observer")
TANK = {"name": "", "area": None, "rim": None, "drain": 0.0, "level": 0.0, "inflow": 0.0, "noise": 0.0}
PUMP = {"name": "", "gain": None, "to": None, "split": 1.0, "low": 0.0, "high": None, "initial": 0.0}
LINK = {"from": None, "to": None, "area": None}
PIPE = {"between": None, "area": None}
SPILL = {"from": None, "to": None, "caught": 1.0}
PLANT = {"gravity": None, "overflow": False, "bottom": False, "knee": None, "outputs": None}
# what a law needs and a file may leave out: by field
USUAL = {"level_floor": 0.01, "difference_floor": 0.01, "Tt": 30.0}


def build(table):
    """The Case of a table of a rig file that has [[tank]]; reference, values, limits and the rest come after (`rig.from_table`)."""
    length, drive = _units(table.get("units", list(DEFAULT)))
    tanks = [_entry("tank", i, e, TANK) for i, e in enumerate(_list(table, "tank", at_least=1))]
    pumps = [_entry("pump", i, e, PUMP) for i, e in enumerate(_list(table, "pump", at_least=1))]
    links = [_entry("orifice", i, e, LINK) for i, e in enumerate(_list(table, "orifice"))]
    pipes = [_entry("pipe", i, e, PIPE) for i, e in enumerate(_list(table, "pipe"))]
    spills = [_entry("spill", i, e, SPILL) for i, e in enumerate(_list(table, "spill"))]
    more = _entry("plant", None, table.get("plant", {}), PLANT)
    named = {t["name"]: i for i, t in enumerate(tanks) if t["name"]}
    if len(named) < sum(bool(t["name"]) for t in tanks):
        raise InputError("two tanks have the same name")

    def tank(value, where):
        if isinstance(value, str):
            if value not in named:
                raise unknown(f"tank of {where}", value, named or ["1"])
            return named[value]
        if isinstance(value, bool) or not isinstance(value, int) or not 1 <= value <= len(tanks):
            raise InputError(f"{where} = {_short(value)}: must be a tank, by its name or its number from 1 to {len(tanks)}")
        return value - 1

    def pair(value, where, short=False):
        entries = value if isinstance(value, list) else [value]
        if not 1 + (not short) <= len(entries) <= 2:
            raise InputError(f"{where} = {_short(value)}: must name {'one tank, or two' if short else 'two tanks'}")
        found = [tank(v, where) for v in entries]
        if len(set(found)) < len(found):
            raise InputError(f"{where} = {_short(value)}: must be two different tanks")
        return (*found, None) if len(found) == 1 else tuple(found)

    feeds = [pair(p["to"], f"pump {i + 1}: to", short=True) for i, p in enumerate(pumps)]
    outputs = more["outputs"] if more["outputs"] is not None else [first + 1 for first, _ in feeds]
    if not isinstance(outputs, list) or not outputs:
        raise InputError(f"plant.outputs = {_short(outputs)}: must be a list of tanks")
    plant = network(
        area=[t["area"] for t in tanks],
        rim=[t["rim"] for t in tanks],
        drain=[t["drain"] for t in tanks],
        links=[pair([e["from"], e["to"]], f"orifice {i + 1}") for i, e in enumerate(links)],
        orifice=[e["area"] for e in links],
        pipes=[pair(e["between"], f"pipe {i + 1}: between") for i, e in enumerate(pipes)],
        pipe=[e["area"] for e in pipes],
        spills=[pair([e["from"], e["to"]], f"spill {i + 1}") for i, e in enumerate(spills)],
        caught=[e["caught"] for e in spills],
        pump_gain=[p["gain"] for p in pumps],
        split=[p["split"] if feeds[j][1] is not None else 1.0 for j, p in enumerate(pumps)],
        feeds=feeds,
        outputs=[tank(v, "plant.outputs") for v in outputs],
        gravity=_gravity(length) if more["gravity"] is None else more["gravity"],
        overflow=bool(more["overflow"]),
        bottom=bool(more["bottom"]),
        units=(length, drive),
        **({} if more["knee"] is None else {"knee": more["knee"]}),
    )
    levels = number([t["level"] for t in tanks])
    initial = number([p["initial"] for p in pumps])
    start = [float(levels[i]) for i in plant.outputs]
    law = _component("law", table.get("law", {}), LAWS, plant, {"bias": _resting(plant, start, initial)})
    inflow = [t["inflow"] for t in tanks]
    loop = ClosedLoop(
        plant=plant,
        sensor=LevelSensor(
            gain=number(np.ones(len(tanks))), noise=number([t["noise"] for t in tanks]), full_scale=number(np.max(plant.rim))
        ),
        observer=_component("observer", table.get("observer", {"kind": "direct"}), OBSERVERS, plant, {}),
        controller=law,
        actuator=PumpBank(
            low=number([p["low"] for p in pumps]),
            high=number([p["high"] for p in pumps]),
            stop=number(np.zeros(len(pumps))),
            pulse=number([p["high"] for p in pumps]),
            initial=initial,
        ),
        reference=ramps(start, [], ramp=0.0),
        disturbance=Constant(level=number(inflow)) if any(inflow) else None,
        x0=levels,
    )
    return Case(
        name="my rig",
        title=f"{len(tanks)} tank{'s' if len(tanks) > 1 else ''}, {table.get('law', {}).get('kind', '')}",
        loop=loop,
        clock=Clock(dt=1.0, duration=600.0),
        limits={"max_level": "rim"},
        free={},
        objective={"rms_error_total": 1.0},
    )


def _units(value):
    if not (isinstance(value, list) and len(value) == 2 and all(isinstance(v, str) and v for v in value)):
        raise InputError(f'units = {_short(value)}: must be [length, pump input], as ["cm", "V"]')
    return tuple(value)


def _gravity(length):
    if length not in ("cm", "m"):
        raise InputError(f'plant.gravity: must be given for a rig whose length is "{length}" (981 for cm, 9.81 for m)')
    return GRAVITY if length == "cm" else GRAVITY / 100


def _list(table, key, at_least=0):
    entries = table.get(key, [])
    if not isinstance(entries, list) or not all(isinstance(e, dict) for e in entries):
        raise InputError(f"{key}: must be a list of tables, [[{key}]]")
    if len(entries) < at_least:
        raise InputError(f"a rig needs at least one [[{key}]]")
    return entries


def _entry(kind, index, entry, fields):
    """`entry` with what it leaves out; InputError for an unknown key, one that is missing, and what is no number."""
    where = kind if index is None else f"{kind} {index + 1}"
    if not isinstance(entry, dict):
        raise InputError(f"{where}: must be a table")
    for key, value in entry.items():
        if key not in fields:
            raise unknown(f"key of [[{kind}]]" if index is not None else f"key of [{kind}]", key, fields)
        if key == "name" and not isinstance(value, str):
            raise InputError(f"{where}: name = {_short(value)}: must be a text")
        free = key in ("name", "to", "from", "between", "outputs")
        truth = isinstance(fields[key], bool)
        good = isinstance(value, bool) if truth else not isinstance(value, bool) and isinstance(value, (int, float))
        if not free and not (good and abs(value) <= 1e300):
            raise InputError(f"{where}: {key} = {_short(value)}: must be {'true or false' if truth else 'a finite number'}")
    for key, value in fields.items():
        if value is None and key not in entry and kind != "plant":
            raise InputError(f"{where}: {key} is missing")
    return {**fields, **entry}


def _component(kind, table, known, plant, offered):
    """The law or observer of a table: kind, then the fields of the component by their names."""
    if not isinstance(table, dict):
        raise InputError(f"[{kind}]: must be a table")
    if "kind" not in table:
        raise InputError(f"[{kind}] needs kind = one of {', '.join(known)}")
    if table["kind"] not in known:
        raise unknown(f"{kind} kind", str(table["kind"]), known)
    cls, values = known[table["kind"]], {}
    fields = {f.name: f for f in dataclasses.fields(cls)}
    settable = {n: f for n, f in fields.items() if n != "model"}
    for key in table:
        if key != "kind" and key not in settable:
            raise unknown(f"key of [{kind}]", key, ["kind", *settable])
    if "model" in fields:
        values["model"] = plant
    for name, field in settable.items():
        meta = field.metadata
        if name in table:
            value = table[name]
        elif name in offered:
            value = offered[name]
        elif name in USUAL:
            value = USUAL[name]
        elif field.default is not dataclasses.MISSING:
            continue
        else:
            unit = "" if meta.get("unit", "-") == "-" else f" [{meta['unit']}]"
            raise InputError(f"[{kind}] {table['kind']} needs {name}{unit}: {meta.get('doc', '')}")
        values[name] = _shaped(kind, name, value, meta, plant) if meta.get("kind") == "leaf" else value
    return cls(**values)


def _shaped(kind, name, value, meta, plant):
    """A leaf's value as an array; one number for an array of one entry per pump, tank or output fills it."""
    try:
        array = number(value)
    except (TypeError, ValueError, OverflowError):
        raise InputError(f"{kind}.{name} = {_short(value)}: must be a number or a list of numbers") from None
    first = meta["doc"].split(")")[0]
    sizes = {"(m,": plant.pumps, "(n,": plant.tanks, "(outputs,": len(plant.outputs), "(pumps,": plant.pumps, "(2,": 2}
    size = next((n for start, n in sizes.items() if first.startswith(start)), None)
    return np.full(size, array) if size is not None and array.ndim == 0 else array


def _resting(plant, levels, initial):
    """(pumps,) inputs at which the outputs rest where they start; `initial` where they cannot."""
    if len(levels) != plant.pumps:
        return initial
    try:
        return number(equilibrium(plant, np.asarray(levels))[1])
    except (EquilibriumError, InputError, FloatingPointError):
        return initial


def tables(case, toml):
    """The lines that describe the rig of a case tank by tank; toml: how a value is written."""
    loop, plant = case.loop, case.loop.plant
    for part, kind, words in (
        (loop.reference, Ramps, "reference"),
        (loop.disturbance, (Constant, type(None)), "disturbance"),
        (loop.faults, type(None), "fault"),
    ):
        if not isinstance(part, kind):
            raise InputError(
                f"{case.name}: no preset has these components and its {words} has no table, so the case cannot be written as a rig file"
            )
    lines = [f"units = {toml(list(plant.units))}", ""]
    inflow = np.zeros(plant.tanks) if loop.disturbance is None else np.asarray(loop.disturbance.level)
    for i in range(plant.tanks):
        lines += ["[[tank]]", f"area = {toml(float(plant.area[i]))}", f"rim = {toml(float(plant.rim[i]))}"]
        lines += [f"drain = {toml(float(plant.drain[i]))}", f"level = {toml(float(loop.x0[i]))}"]
        lines += [f"inflow = {toml(float(inflow[i]))}"] if inflow[i] else []
        lines += [""]
    for key, pairs, values, words in (
        ("orifice", plant.links, plant.orifice, "area"),
        ("spill", plant.spills, plant.caught, "caught"),
    ):
        for (a, b), v in zip(pairs, np.asarray(values)):
            lines += [f"[[{key}]]", f"from = {a + 1}", f"to = {b + 1}", f"{words} = {toml(float(v))}", ""]
    for (a, b), v in zip(plant.pipes, np.asarray(plant.pipe)):
        lines += ["[[pipe]]", f"between = [{a + 1}, {b + 1}]", f"area = {toml(float(v))}", ""]
    for j, (first, second) in enumerate(plant.feeds):
        to = first + 1 if second is None else [first + 1, second + 1]
        lines += ["[[pump]]", f"gain = {toml(float(plant.pump_gain[j]))}", f"to = {toml(to)}"]
        lines += [f"split = {toml(float(plant.split[j]))}"] if second is not None else []
        lines += [f"{n} = {toml(float(np.asarray(getattr(loop.actuator, n))[j]))}" for n in ("low", "high", "initial")] + [""]
    lines += ["[plant]", f"outputs = {toml([i + 1 for i in plant.outputs])}", f"gravity = {toml(float(plant.gravity))}"]
    lines += [f"overflow = {toml(plant.overflow)}", f"bottom = {toml(plant.bottom)}", f"knee = {toml(plant.knee)}", ""]
    for kind, known, part in (("law", LAWS, loop.controller), ("observer", OBSERVERS, loop.observer)):
        name = next((n for n, cls in known.items() if cls is type(part)), None)
        if name is None:
            raise InputError(f"{case.name}: its {kind} has no name in a rig file, so the case cannot be written as one")
        lines += [f"[{kind}]", f"kind = {toml(name)}"]
        for f in dataclasses.fields(part):
            value = getattr(part, f.name)
            if f.name == "model" or value is None:
                continue
            if f.metadata.get("kind") in ("leaf", "static") and not isinstance(value, tuple):
                lines.append(f"{f.name} = {toml(np.asarray(value).tolist() if f.metadata['kind'] == 'leaf' else value)}")
        lines += [""]
    return lines
