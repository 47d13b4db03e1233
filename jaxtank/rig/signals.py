"""What moves a rig besides its controller, as tables of a rig file: [reference], [reference.sine],
[disturbance], [[inflow]] and [[fault]].
"""

import dataclasses

import numpy as np

from jaxtank.core.errors import InputError
from jaxtank.core.labels import index_of
from jaxtank.core.quantities import converted
from jaxtank.core.text import shortened
from jaxtank.core.tree import number
from jaxtank.plants.faults import faults
from jaxtank.rig.entry import is_finite, read_entries, read_entry, refusal, sizes_of, written
from jaxtank.rig.schema import SECTIONS
from jaxtank.signals.base import Constant, Sum
from jaxtank.signals.inflows import InflowPulses, inflow_pulses
from jaxtank.signals.setpoints import Ramps, Sine, ramps

COURSE = ("ramp", "shape", "band", "filter")


def steps(reference):
    """Return the `Ramps` of a reference that [reference] can describe; None of another."""
    if isinstance(reference, Sum) and isinstance(reference.second, Sine):
        reference = reference.first
    return reference if isinstance(reference, Ramps) else None


def reference_of(table, old, plant):
    """The reference of a [reference] table; what the table leaves out is as in `old`."""
    start, sizes = steps(old), sizes_of(plant)
    if start is None:
        raise InputError("[reference] is for cases whose reference is made of ramps")
    first = ramps_of(SECTIONS["reference"], table, start, ("output", "level"), sizes)
    sine = old.second if isinstance(old, Sum) else None
    if "sine" in table:
        sine = _sine(table["sine"], sine, sizes)
    return first if sine is None else Sum(first=first, second=sine)


def _over(section, values, table):
    """A table with what it leaves out from {key: value}."""
    old = {k.name: written(k, values[k.name]) for k in section.keys if k.name in values}
    return {**{name: value for name, value in old.items() if value is not None}, **table}


def ramps_of(section, table, old, words, sizes):
    """Return the Ramps of a table; what it leaves out is as in `old`. words: channel and value."""
    values = read_entry(section, _over(section, ramp_values(old), table), sizes)
    label, of = f"{section.name}.changes", section["changes"].meta(sizes.units)["unit"]
    changes = _named(label, values["changes"], words[0], sizes.plant, of)
    changes = _changes(label, changes, words, np.size(old.initial))
    course = {name: values.get(name, getattr(old, name)) for name in COURSE}
    return ramps(values["initial"].tolist(), changes, **course)


def _named(label, changes, kind, plant, unit):
    """Changes with the numbers of outputs or pumps for their names, and of times and values with a
    unit.
    """
    rows = []
    for change in changes if isinstance(changes, list) else ():
        if isinstance(change, list) and len(change) == 3 and str in map(type, change):
            time, channel, value = change
            if isinstance(channel, str):
                channel = index_of(label, plant, kind, channel) + 1
            change = [converted(label, time, "s"), channel, converted(label, value, unit)]
        rows.append(change)
    return rows if isinstance(changes, list) else changes


def _changes(label, changes, words, channels):
    """[(time [s], channel from 0, value)] of a list as in a file, in order of time."""
    form = f"[time [s], {words[0]} from 1 to {channels}, {words[1]}]"
    if not isinstance(changes, list):
        raise refusal(label, changes, f"be a list of {form}")
    for change in changes:
        good = isinstance(change, list) and len(change) == 3
        good = good and all(np.ndim(v) == 0 and is_finite(v) for v in change)
        if not (good and isinstance(change[1], int) and 1 <= change[1] <= channels):
            raise InputError(f"{label} has {shortened(change)}: must be {form}, finite numbers")
    known = set()
    for i, (time, channel, _) in enumerate(changes):
        if i and time < changes[i - 1][0]:
            raise InputError(
                f"{label} has {shortened(changes[i])} after {shortened(changes[i - 1])}: must be in"
                " order of time"
            )
        if (time, channel) in known:
            raise InputError(
                f"{label} has two changes of {words[0]} {channel} at {time:g} s: must be one"
            )
        known.add((time, channel))
    return [(float(t), i - 1, float(v)) for t, i, v in changes]


def ramp_values(signal):
    """{key: value} of a Ramps; changes as in a file, [[time [s], channel from 1, value], ...]."""
    changes = zip(signal.changes, np.asarray(signal.targets))
    values = {name: getattr(signal, name) for name in ("initial", *COURSE)}
    values["ramp"] = float(signal.ramp)
    return {**values, "changes": [[t, i + 1, float(v)] for (t, i), v in changes]}


def _sine(table, old, sizes):
    """The Sine of a [reference.sine] table, None of an empty one."""
    section = SECTIONS["reference.sine"]
    if isinstance(table, dict):
        if not table:
            return None
        table = _over(section, sine_values(old) if old else {}, table)
    values = read_entry(section, table, sizes)
    output = values.pop("output")
    if output > sizes.outputs:
        raise refusal("reference.sine.output", output, f"be an output, from 1 to {sizes.outputs}")
    leaves = {key: number(values.pop(key)) for key in ("amplitude", "offset")}
    return Sine(**leaves, **values, channel=output - 1, width=sizes.outputs)


def sine_values(sine):
    """{key of [reference.sine]: value} of a Sine."""
    keys = SECTIONS["reference.sine"].keys
    values = {key.name: getattr(sine, key.target or key.name) for key in keys}
    return {**values, "output": sine.channel + 1}


def disturbance_of(table, loop):
    """What [disturbance] and [[inflow]] of a rig file make of a loop's disturbance."""
    disturbance, sizes = loop.disturbance, sizes_of(loop.plant)
    values = read_entry(SECTIONS["disturbance"], table.get("disturbance", {}), sizes)
    if "inflow" in values:
        if table.get("inflow"):
            raise InputError("[disturbance] inflow and [[inflow]]: give one of them")
        disturbance = Constant(level=values["inflow"])
    if "inflow" in table:
        entries = read_entries(SECTIONS["inflow"], table, sizes)
        disturbance = _pulses(entries, disturbance, loop.plant.tanks)
    if "window" in values:
        if not isinstance(disturbance, InflowPulses):
            raise InputError(
                f"disturbance.window = {values['window']:g} s: is how long tanks are watched after"
                " a [[inflow]], and there is none: leave it out"
            )
        disturbance = dataclasses.replace(disturbance, window=values["window"])
    return disturbance


def _pulses(entries, old, tanks):
    """The disturbance of the [[inflow]] tables; without any, `old` if it is no pulses."""
    if not entries:
        return None if isinstance(old, InflowPulses) else old
    if isinstance(old, Constant) and np.any(np.asarray(old.level) != 0.0):
        raise InputError(
            "[[inflow]]: this rig has a steady inflow already: a rig file can have one of the two"
        )
    return inflow_pulses(
        tanks, [(e["time"], e["duration"], e["tank"], e["volume"]) for e in entries]
    )


def faults_of(entries, plant):
    """The Faults of the [[fault]] tables; None of none."""
    events = []
    for i, e in enumerate(read_entries(SECTIONS["fault"], {"fault": entries}, sizes_of(plant))):
        values = (e[name] for name in ("start", "end", "factor", "extra"))
        events.append((e["of"].removeprefix("plant."), *values))
        try:
            faults(plant, events[-1:])
        except InputError as error:
            raise type(error)(f"fault {i + 1}: {error}") from None
    return faults(plant, events) if events else None


def disturbance_tables(disturbance):
    """[(section, {key: value})] of a disturbance that a rig file can describe, None of another."""
    if disturbance is None:
        return []
    steady, pulse = SECTIONS["disturbance"], SECTIONS["inflow"]
    if isinstance(disturbance, Constant):
        return [(steady, {"inflow": disturbance.level})]
    if not isinstance(disturbance, InflowPulses):
        return None
    rows = zip(disturbance.events, np.asarray(disturbance.volume).tolist())
    pulses = [dict(zip(pulse.names, (*event, volume))) for event, volume in rows]
    return [(steady, {"window": disturbance.window}), *((pulse, values) for values in pulses)]


def fault_tables(part):
    """[(section, {key: value})] of a Faults."""
    if part is None:
        return []
    section = SECTIONS["fault"]
    rows = zip(part.windows, np.asarray(part.factor).tolist(), np.asarray(part.extra).tolist())
    return [
        (section, dict(zip(section.names, (*window, factor, extra))))
        for window, factor, extra in rows
    ]
