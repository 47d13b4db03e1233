"""What moves a rig besides its law, as tables: [reference], [reference.sine], [disturbance],
[[pour]], [[fault]]; and a law's [[change]]s.
"""

import dataclasses

import numpy as np

from jaxtank.core.checks import check_value
from jaxtank.core.errors import InputError, unknown
from jaxtank.core.text import shortened
from jaxtank.core.tree import number
from jaxtank.plants.faults import Faults, faults
from jaxtank.rig.schema import is_finite, plain, static_value
from jaxtank.signals.base import Constant, Sum
from jaxtank.signals.inflows import Pours, pours
from jaxtank.signals.setpoints import Ramps, Sine, ramps

RAMP_KEYS = ("initial", "changes", "ramp", "shape", "band")
SINE_KEYS = ("amplitude", "offset", "period", "zero", "start", "end", "output")
SINE = {"offset": 0.0, "zero": 0.0, "start": 0.0, "end": 1e9}
POUR = {"time": None, "duration": None, "tank": None, "volume": None}
FAULT = {"of": None, "start": None, "end": None, "factor": 1.0, "extra": 0.0}


def meta_of(cls, name):
    """The metadata of a field of a component class."""
    return next(f.metadata for f in dataclasses.fields(cls) if f.name == name)


def steps(reference):
    """The `Ramps` of a reference that [reference] can describe: itself, or what a sine is added to;
    None of another.
    """
    if (
        isinstance(reference, Sum)
        and isinstance(reference.first, Ramps)
        and isinstance(reference.second, Sine)
    ):
        return reference.first
    return reference if isinstance(reference, Ramps) else None


def reference_of(table, old):
    """The reference of a [reference] table; what the table leaves out is as in `old`."""
    for key in table:
        if key not in (*RAMP_KEYS, "sine"):
            raise unknown("key of [reference]", key, (*RAMP_KEYS, "sine"))
    if steps(old) is None:
        raise InputError("[reference] is for cases whose reference is made of ramps")
    found = ramps_of("reference", table, steps(old), ("output", "level"))
    sine = old.second if isinstance(old, Sum) else None
    if "sine" in table:
        sine = _sine(table["sine"], sine, found.channels)
    return found if sine is None else Sum(first=found, second=sine)


def ramps_of(where, table, old, words):
    """The Ramps of the keys of RAMP_KEYS in `table`, called `where` in errors; words: what a
    channel and its value are called.
    """
    channels = np.size(old.initial)
    initial = table.get("initial", np.asarray(old.initial).tolist())
    if not (is_finite(initial) and np.shape(initial) == (channels,)):
        raise InputError(
            f"{where}.initial = {shortened(initial)}: must be a list of {channels} finite"
            f" {words[1]}s"
        )
    changes = table.get("changes", changes_of(old))
    form = f"[time [s], {words[0]} from 1 to {channels}, {words[1]}]"
    if not isinstance(changes, list):
        raise InputError(f"{where}.changes = {shortened(changes)}: must be a list of {form}")
    for change in changes:
        good = (
            isinstance(change, list)
            and len(change) == 3
            and all(np.ndim(v) == 0 and is_finite(v) for v in change)
        )
        if not (good and isinstance(change[1], int) and 1 <= change[1] <= channels):
            raise InputError(
                f"{where}.changes has {shortened(change)}: must be {form}, finite numbers"
            )
    for before, after in zip(changes, changes[1:]):
        if after[0] < before[0]:
            raise InputError(
                f"{where}.changes has {shortened(after)} after {shortened(before)}: must be in"
                " order of time"
            )
    taken = set()
    for time, channel, _ in changes:
        if (time, channel) in taken:
            raise InputError(
                f"{where}.changes has two changes of {words[0]} {channel} at {time:g} s: must"
                " be one"
            )
        taken.add((time, channel))
    ramp = plain(f"{where}.ramp", table.get("ramp", old.ramp))
    check_value(f"{where}.ramp", ramp, meta_of(Ramps, "ramp"))
    band = plain(f"{where}.band", table.get("band", old.band))
    check_value(f"{where}.band", band, meta_of(Ramps, "band"))
    shape = static_value(
        f"{where}.shape", table.get("shape", old.shape), meta_of(Ramps, "shape"), str
    )
    return ramps(initial, [(float(t), i - 1, float(v)) for t, i, v in changes], ramp, shape, band)


def changes_of(signal):
    """[[time [s], channel from 1, value], ...] of a Ramps."""
    return [[t, i + 1, float(v)] for (t, i), v in zip(signal.changes, np.asarray(signal.targets))]


def _sine(table, old, channels):
    """The Sine of a [reference.sine] table, None of an empty one."""
    if not isinstance(table, dict):
        raise InputError(f"reference.sine = {shortened(table)}: must be a table")
    if not table:
        return None
    values = {} if old is None else {k: v for k, _, v in sine_keys(old)}
    for key, value in {**SINE, **values, **table}.items():
        if key not in SINE_KEYS:
            raise unknown("key of [reference.sine]", key, SINE_KEYS)
        values[key] = value
    for key in SINE_KEYS:
        if key not in values:
            raise InputError(f"[reference.sine] needs {key}")
    output = values.pop("output")
    if isinstance(output, bool) or not isinstance(output, int) or not 1 <= output <= channels:
        raise InputError(
            f"reference.sine.output = {shortened(output)}: must be an output, from 1 to {channels}"
        )
    for key, value in values.items():
        values[key] = plain(f"reference.sine.{key}", value)
        check_value(f"reference.sine.{key}", values[key], meta_of(Sine, key))
    leaves = {key: number(values.pop(key)) for key in ("amplitude", "offset")}
    return Sine(**leaves, **values, channel=output - 1, width=channels)


def sine_keys(sine):
    """[(key of [reference.sine], metadata, value)] of a Sine."""
    named = [(k, meta_of(Sine, k), np.asarray(getattr(sine, k)).tolist()) for k in SINE_KEYS[:-1]]
    return [
        *named,
        ("output", {"unit": "-", "doc": "the output it moves, from 1"}, sine.channel + 1),
    ]


def disturbance_of(table, loop, tank):
    """What [disturbance] and [[pour]] of a rig file's `table` make of a loop's disturbance; tank:
    index of a tank's name or number.
    """
    old, plant = loop.disturbance, loop.plant
    more = table.get("disturbance", {})
    for key in more:
        if key not in ("inflow", "window"):
            raise unknown("key of [disturbance]", key, ("inflow", "window"))
    if "inflow" in more:
        if table.get("pour"):
            raise InputError("[disturbance] inflow and [[pour]]: give one of them")
        inflow = more["inflow"]
        if not (is_finite(inflow) and np.shape(inflow) == (plant.tanks,)):
            raise InputError(
                f"disturbance.inflow = {shortened(inflow)}: must be a list of {plant.tanks} finite"
                " flows, one per tank"
            )
        old = Constant(level=number(inflow))
    if "pour" in table:
        if isinstance(old, Constant) and np.any(np.asarray(old.level) != 0.0) and table["pour"]:
            raise InputError(
                "[[pour]]: this rig has a steady inflow already, and a rig file can have one of"
                " the two"
            )
        entries = [_entry("pour", i, e, POUR, ("tank",)) for i, e in enumerate(table["pour"])]
        events = [
            (e["time"], e["duration"], tank(e["tank"], f"pour {i + 1}: tank"), e["volume"])
            for i, e in enumerate(entries)
        ]
        for i, e in enumerate(entries):
            for key, meta, _ in pour_keys(None, None, None, None)[:2]:
                check_value(
                    f"pour {i + 1} into tank {shortened(e['tank'])}: {key}",
                    e[key],
                    {"high": None, **meta},
                )
        if entries or isinstance(old, Pours):
            old = (
                pours(plant.tanks, [(float(a), float(b), c, float(d)) for a, b, c, d in events])
                if entries
                else None
            )
    if "window" in more:
        window = plain("disturbance.window", more["window"])
        check_value("disturbance.window", window, meta_of(Pours, "window"))
        if not isinstance(old, Pours):
            raise InputError(
                "disturbance.window: is how long tanks are watched after a [[pour]], and there is"
                " none"
            )
        old = dataclasses.replace(old, window=window)
    return old


def faults_of(entries, plant):
    """The Faults of the [[fault]] tables; None of none."""
    found = []
    for i, e in enumerate(entries):
        e = _entry("fault", i, e, FAULT, ("of",))
        if not isinstance(e["of"], str):
            raise InputError(
                f"fault {i + 1}: of = {shortened(e['of'])}: must name an entry of the plant, as"
                ' "pump_gain[0]"'
            )
        check_value(f"fault {i + 1}: factor", float(e["factor"]), meta_of(Faults, "factor"))
        values = (float(e[k]) for k in ("start", "end", "factor", "extra"))
        try:
            found.append((e["of"].removeprefix("plant."), *values))
            faults(plant, found[-1:])
        except InputError as error:
            raise type(error)(f"fault {i + 1}: {error}") from None
    return faults(plant, found) if found else None


def _entry(kind, index, entry, fields, free):
    """`entry` of [[kind]] with what it leaves out; InputError for an unknown key, one that is
    missing, and what is no number.
    """
    where = f"{kind} {index + 1}"
    if not isinstance(entry, dict):
        raise InputError(f"{where} = {shortened(entry)}: must be a table")
    for key, value in entry.items():
        if key not in fields:
            raise unknown(f"key of [[{kind}]]", key, fields)
        if key not in free and not np.isfinite(plain(f"{where}: {key}", value)):
            raise InputError(f"{where}: {key} = {value}: must be a finite number")
    for key, value in fields.items():
        if value is None and key not in entry:
            raise InputError(f"{where}: {key} is missing")
    return {**fields, **entry}


def disturbance_tables(disturbance):
    """[(title, [(key, metadata, value)])] of a disturbance that a rig file can describe, None of
    another.
    """
    if disturbance is None:
        return []
    if isinstance(disturbance, Constant):
        return [("[disturbance]", [("inflow", INFLOW, np.asarray(disturbance.level).tolist())])]
    if not isinstance(disturbance, Pours):
        return None
    found = [("[disturbance]", [("window", meta_of(Pours, "window"), disturbance.window)])]
    for (time, duration, tank), volume in zip(
        disturbance.events, np.asarray(disturbance.volume).tolist()
    ):
        found.append(("[[pour]]", pour_keys(time, duration, tank + 1, volume)))
    return found


def pour_keys(time, duration, tank, volume):
    """[(key, metadata, value)] of a [[pour]]."""
    return [
        ("time", {"unit": "s", "doc": "when it begins", "low": 0.0, "strict": False}, time),
        (
            "duration",
            {"unit": "s", "doc": "how long it lasts", "low": 0.0, "strict": True},
            duration,
        ),
        ("tank", {"unit": "-", "doc": "the tank, from 1"}, tank),
        ("volume", {"unit": "cm^3", "doc": "what is poured in all; negative: taken out"}, volume),
    ]


def fault_keys(of, start, end, factor, extra):
    """[(key, metadata, value)] of a [[fault]]."""
    return [
        ("of", {"unit": "-", "doc": "the entry of the plant that changes, counted from 0"}, of),
        ("start", {"unit": "s", "doc": "when it begins", "low": 0.0, "strict": False}, start),
        ("end", {"unit": "s", "doc": "when it is over"}, end),
        (
            "factor",
            {"unit": "-", "doc": "what the entry is multiplied by", "low": 0.0, "strict": False},
            factor,
        ),
        ("extra", {"unit": "-", "doc": "what is added to it, in its own unit"}, extra),
    ]


def fault_tables(found):
    """[(title, [(key, metadata, value)])] of a Faults."""
    if found is None:
        return []
    rows = zip(found.windows, np.asarray(found.factor).tolist(), np.asarray(found.extra).tolist())
    return [
        ("[[fault]]", fault_keys(of, start, end, factor, extra))
        for (of, start, end), factor, extra in rows
    ]


INFLOW = {
    "unit": "cm^3/s",
    "doc": "(n,) steady inflow of each tank that no pump brings; negative: a leak",
}
