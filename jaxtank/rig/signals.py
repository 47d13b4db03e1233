"""[reference], [inputs], [disturbance], [[inflow]] and [[fault]] of a rig file as signals."""

import dataclasses
import math

import numpy as np

from jaxtank.core.errors import InputError
from jaxtank.core.labels import index_of, input_unit, label_of
from jaxtank.core.quantities import converted
from jaxtank.core.text import shortened
from jaxtank.core.tree import describe, number, split_index
from jaxtank.core.units import flow_per_input
from jaxtank.plants.faults import KINDS, SensorFault, faults
from jaxtank.rig import tables
from jaxtank.rig.entry import (
    Problems,
    check_areas,
    is_finite,
    is_numeric,
    is_plain,
    read_entries,
    read_entry,
    read_value,
    refusal,
    sizes_of,
    written,
)
from jaxtank.rig.schema import INFLOW_TABLE, SECTIONS, Key
from jaxtank.rig.sensors import readings, spans_of
from jaxtank.signals.base import Constant, Sum
from jaxtank.signals.inflows import InflowPulses, InflowTable, inflow_pulses, inflow_table
from jaxtank.signals.setpoints import Ramps, Sine, ramps

COURSE = ("ramp", "shape", "band", "filter")


def steps(reference):
    """Return the `Ramps` of a reference that [reference] can describe; None of another."""
    if isinstance(reference, Sum) and isinstance(reference.second, Sine):
        reference = reference.first
    return reference if isinstance(reference, Ramps) else None


def reference_of(table, loop):
    """The reference of a [reference] table; what the table leaves out is as in the loop's own."""
    old, sizes = loop.reference, sizes_of(loop)
    start = steps(old)
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
    of = section["changes"].meta(sizes.units)["unit"]
    initial, begins, repeat = values["initial"].tolist(), (), values.get("repeat")
    if repeat is not None and not {"csv", "changes"} & table.keys():
        raise InputError(f"{section.name}.repeat: is for changes or csv, and there is neither")
    if columns := _columns_of(section.name, table):
        times, rows = _rows_of(columns, table.get("column"), words, len(initial), of, sizes)
        courses = {i: tables.course(section.name, times, v, repeat) for i, v in rows.items()}
        rows = {channel: values for channel, (_, values) in courses.items()}
        (times, _), *_ = courses.values()
        begins = (float(times[0]),)
        if "initial" not in table:  # the first row holds before its time
            initial = [float(rows[i][0]) if i in rows else v for i, v in enumerate(initial)]
        changes = tables.changes_of(times, rows, initial)
    else:
        label = f"{section.name}.changes"
        changes = _named(label, values["changes"], words[0], sizes, of)
        changes = _changes(label, changes, words, len(initial))
        changes = repeat.changes(label, changes) if repeat is not None else changes
    course = {name: values.get(name, getattr(old, name)) for name in COURSE}
    if course["filter"] is not None and course["shape"] != "linear":
        raise InputError(
            f"{section.name}.filter: is for ramps, and {section.name}.shape ="
            f' "{course["shape"]}": set the shape to "linear", or leave the filter out'
        )
    return dataclasses.replace(ramps(initial, changes, **course), begins=begins)


def _rows_of(columns, column, words, channels, of, sizes):
    """(times [s], {channel: values}) of the columns of a file."""
    names = columns.chosen(column, words[0], sizes.plant, channels)
    units, spans = {i: of for i in range(channels)}, None
    if words[0] == "pump":
        units = {i: input_unit(sizes.plant, i, of) for i in units}
    else:
        spans = [spans_of(sizes.loop)[i] for i in sizes.plant.outputs]
    return columns.read(names, units, spans)


def _columns_of(where, table):
    """The Columns that a table names by `csv` in place of `changes`; None without."""
    if "csv" not in table:
        extra = [name for name in tables.KEYS if name in table]
        if extra:
            raise InputError(f"{where}: {extra[0]} is for a table in a file: needs csv")
        return None
    if "changes" in table:
        raise InputError(f"{where}: changes and csv are the same: give one of them")
    return tables.columns_of(where, table)


def _named(label, changes, kind, sizes, unit):
    """Changes with numbers for the names of outputs or pumps, and for texts with a unit."""
    rows, alone = [], (sizes.outputs if kind == "output" else sizes.pumps) == 1
    for change in changes if isinstance(changes, list) else ():
        if isinstance(change, list) and len(change) == 2 and alone:
            change = [change[0], 1, change[1]]
        if isinstance(change, list) and len(change) == 3 and str in map(type, change):
            time, channel, value = change
            if isinstance(channel, str):
                channel = index_of(label, sizes.plant, kind, channel) + 1
            if kind == "output" and isinstance(channel, int) and 1 <= channel <= sizes.outputs:
                tank = sizes.plant.outputs[channel - 1]
                value = readings(label, "changes", value, unit, tank, sizes.loop)
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
        good = good and all(map(_is_number, change))
        if not (good and change[1] in range(1, channels + 1)):  # 1.0 of an array too
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
    return [(float(t), int(i) - 1, float(v)) for t, i, v in changes]


def _is_number(value):
    # a number of Python first: a year of hours has 26,000
    return (is_plain(value) or (np.ndim(value) == 0 and is_numeric(value))) and math.isfinite(value)


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
        if isinstance(name := table.get("output"), str):
            number_of = index_of("reference.sine", sizes.plant, "output", name) + 1
            table = {**table, "output": number_of}
        if (number_of := table.get("output")) in range(1, sizes.outputs + 1):
            tank, length = sizes.plant.outputs[number_of - 1], sizes.units[0]
            texts = {key: table[key] for key in ("amplitude", "offset") if key in table}
            of_span = lambda key, v: readings("reference.sine", key, v, length, tank, sizes.loop)
            table = {**table, **{key: of_span(key, v) for key, v in texts.items()}}
    values = read_entry(section, table, sizes)
    output = values.pop("output")
    if output > sizes.outputs:
        raise refusal("reference.sine.output", output, f"be an output, from 1 to {sizes.outputs}")
    leaves = {key: number(values.pop(key)) for key in ("amplitude", "offset")}
    return Sine(**leaves, **values, channel=output - 1, width=sizes.outputs)


def sine_values(sine):
    keys = SECTIONS["reference.sine"].keys
    values = {key.name: getattr(sine, key.target or key.name) for key in keys}
    return {**values, "output": sine.channel + 1}


def parts_of(disturbance):
    """(pulses, steady inflow, table) of a disturbance, None for what it has not."""
    parts = [disturbance]
    if isinstance(disturbance, Sum):
        parts = [disturbance.first, disturbance.second]
    pulses = next((part for part in parts if isinstance(part, InflowPulses)), None)
    table = next((part for part in parts if isinstance(part, InflowTable)), None)
    return pulses, next((p for p in parts if p is not pulses and p is not table), None), table


def disturbance_of(table, loop):
    """What [disturbance] and [[inflow]] of a rig file make of a loop's disturbance."""
    (pulses, steady, rows), sizes = parts_of(loop.disturbance), sizes_of(loop)
    values = read_entry(SECTIONS["disturbance"], table.get("disturbance", {}), sizes)
    if "inflow" in values:
        pulses, steady = None, Constant(level=values["inflow"])
    if "inflow" in table:
        pulses, steady, rows = _inflows(table["inflow"], steady, sizes)
    if "window" in values:
        if pulses is None:
            raise InputError(
                f"disturbance.window = {values['window']:g} s: is how long tanks are watched after"
                " a pulse of [[inflow]], and there is none: leave it out"
            )
        pulses = dataclasses.replace(pulses, window=values["window"])
    first, *more = [part for part in (pulses, steady, rows) if part is not None] or [None]
    return Sum(first=first, second=more[0]) if more else first


def _inflows(entries, steady, sizes):
    """(pulses, steady inflow, table) of the [[inflow]] tables, None for what there is not."""
    problems, courses, pulses = Problems(), [], [e for e in entries if not _is_course(e)]
    for i, entry in enumerate(entries):
        with problems.collect():
            if _is_course(entry):
                courses.append(_course(entry, sizes, i))
    with problems.collect():
        pulses = read_entries(SECTIONS["inflow"], {"inflow": pulses}, sizes)
    problems.check()
    first, names = None, ("time", "duration", "tank", "volume")
    if pulses:
        first = inflow_pulses(sizes.tanks, [tuple(e[name] for name in names) for e in pulses])
        flows = np.asarray(steady.level).tolist() if isinstance(steady, Constant) else []
        steady = steady if any(flows) and not courses else None
        if courses:  # beside pulses and a table it is a table of one row
            steady_flows = [(tank, flow) for tank, flow in enumerate(flows) if flow]
            courses += [(tank, [0.0], [flow], "hold", False) for tank, flow in steady_flows]
    return first, steady, _tabulated(sizes.tanks, courses)


def _tabulated(tanks, courses):
    """The InflowTable of what `_course` gives, None of nothing."""
    if not courses:
        return None
    *columns, between, in_file = zip(*courses)
    table = inflow_table(tanks, [*zip(*columns)], between)
    return dataclasses.replace(table, records=tuple(np.flatnonzero(in_file).tolist()))


def _is_course(entry):
    """Whether a table of [[inflow]] is a measured inflow, and no pulse."""
    return isinstance(entry, dict) and bool({"csv", "changes", "column", "flow"} & entry.keys())


def _course(entry, sizes, index):
    """(tank, times [s], flows, what is between, whether in a file) of a table of [[inflow]]."""
    if sizes.tanks == 1:
        entry = {"tank": 1, **entry}
    values, label = read_entry(INFLOW_TABLE, entry, sizes, index), f"inflow {index + 1}"
    tank, between, factor = values["tank"], values["interpolate"], values["factor"]
    repeat = values.get("repeat")
    of = INFLOW_TABLE["changes"].meta(sizes.units)["unit"]
    if columns := _columns_of(label, entry):
        names = columns.chosen(entry.get("column"), "tank", sizes.plant, 1)
        if list(names) != [0]:
            raise refusal(f"{label}: column", entry["column"], "be one column")
        _check_flow_unit(label, columns, names[0], of, sizes.units)
        times, rows = columns.read(names, {0: of})
        flows = rows[0]
    else:
        times, flows = _changes_of(f"{label}: changes", values["changes"], of, between, repeat)
    times, flows = tables.course(label, times, flows, repeat, between)
    return tank, times, factor * flows, between, columns is not None or repeat is not None


def _changes_of(label, changes, of, between, repeat):
    """(times [s], flows in the unit `of`) of the changes of an inflow."""
    good = isinstance(changes, list) and bool(changes)
    good = good and all(isinstance(row, list) and len(row) == 2 for row in changes)
    rows = [[converted(label, t, "s"), converted(label, q, of)] for t, q in changes] if good else []
    if not (good and is_finite(rows)):
        raise refusal(label, changes, f"be a list of [time [s], inflow [{of}]], finite numbers")
    times, flows = np.array(rows, dtype=float).T
    if times[0] < 0.0 or np.any(np.diff(times) <= 0.0):
        raise refusal(label, changes, "have times that increase from 0 s or later")
    # unlike a record, whose first row also holds before its time
    if times[0] > 0.0 and repeat is None:
        if between == "linear":
            raise refusal(label, changes, 'begin with a row at 0 s, as interpolate = "linear"')
        times, flows = np.insert(times, 0, 0.0), np.insert(flows, 0, 0.0)
    return times, flows


def _check_flow_unit(label, columns, text, flow, units):
    """Raise InputError for a column of flows without a unit, where inputs are in another flow."""
    if flow_per_input(units) not in (None, 1.0) and columns.unit(text) is None:
        raise InputError(
            f"{label}: {columns.table.where(columns.index_of(text))}: has no unit: write it in the"
            f" header or in column, '{text} [{units[1]}]', as the inputs of this rig, or"
            f" '{text} [{flow}]'"
        )


def faults_of(entries, loop, dotted):
    """The Faults of the [[fault]] tables; None of none. dotted: name in the rig -> dotted name."""
    plant, sizes, problems, events, sensors = loop.plant, sizes_of(loop), Problems(), [], []
    for i, e in enumerate(read_entries(SECTIONS["fault"], {"fault": entries}, sizes)):
        with problems.collect(("fault", i, None)):
            try:
                _check_kind(entries[i])
                if "sensor" in e:
                    size = _size_of(e["kind"], e["sensor"], entries[i], sizes)
                    row = (e["sensor"], e["kind"], e["start"], e["end"], e.get("every", 0.0))
                    sensors.append((SensorFault(*row), size))
                    faults(plant, (), sensors[-1:])
                    continue
                of = dotted(loop, entry_named(e["of"], plant)).removeprefix("plant.")
                key = Key("extra", unit=describe(plant, of)["unit"])
                extra = read_value(key, "extra", e["extra"], sizes)
                field, index = split_index(of)
                curves = plant.curves if field == "pump_gain" and extra else ()
                if curves and curves[index[0]] is not None:
                    raise InputError(
                        f"extra = {extra:g}: the flow of {label_of(plant, 'pump', index[0])} is a"
                        " curve, of which a fault changes the share: give factor"
                    )
                check_areas(plant, of, "extra", e["extra"], extra)
                events.append((of, e["start"], e["end"], e["factor"], extra))
                faults(plant, events[-1:])
            except InputError as error:
                raise type(error)(f"fault {i + 1}: {error}") from None
    problems.check()
    return faults(plant, events, sensors) if events or sensors else None


OF_SENSORS = {kind: ("size",) for kind in KINDS} | {"freeze": (), "spikes": ("size", "every")}
"""{kind of a fault of a sensor: keys that it needs}."""


def _check_kind(entry):
    """Raise InputError unless an entry of [[fault]] has the keys of its kind, and no others."""
    keys = {"of", "sensor", "kind", "size", "every", "factor", "extra"} & set(entry)
    if ("of" in keys) == ("sensor" in keys):
        raise InputError("needs either of, an entry of the plant, or sensor, a tank")
    kind = entry.get("kind")
    if "sensor" in keys and kind is None:
        raise InputError(f"needs kind = one of {', '.join(KINDS)}")
    needed = {"sensor", "kind", *OF_SENSORS[kind]} if "sensor" in keys else {"of"}
    more = keys - needed - ({"factor", "extra"} if "of" in keys else set())
    words = f"{kind} of a sensor" if "sensor" in keys else "an entry of the plant"
    if needed - keys:
        raise InputError(f"{words} needs {' and '.join(sorted(needed - keys))}")
    if more:
        raise InputError(f"{' and '.join(sorted(more))} is not for {words}: leave it out")


def _size_of(kind, tank, entry, sizes):
    if kind == "freeze":
        return 0.0
    unit, low = "cm/s" if kind == "drift" else "cm", 0.0 if kind == "noise" else None
    size = readings("size", "size", entry["size"], sizes.units[0], tank, sizes.loop)
    return read_value(Key("size", unit=unit, low=low), "size", size, sizes)


def entry_named(of, plant):
    """A name of an entry: "P101" is the gain of that pump, "FV101" the area of that valve."""
    kind = next((kind for kind, names in plant.names if of in names), "")
    if kind in ("tank", "sensor"):
        raise InputError(f'{of} is a {kind}: must be one of its numbers, as of = "{of}.drain"')
    if kind:
        return f"{of}.{'area' if kind == 'valve' else 'gain'}"
    named = any(of.partition(".")[0] in names for _, names in plant.names)
    return of if named or of.startswith("plant.") else f"plant.{of}"


def disturbance_tables(disturbance):
    """[(section, {key: value})] of a disturbance that a rig file can describe, None of another."""
    if disturbance is None:
        return []
    steady, pulse = SECTIONS["disturbance"], SECTIONS["inflow"]
    if isinstance(disturbance, Sum):
        parts = [disturbance_tables(part) for part in (disturbance.first, disturbance.second)]
        return None if None in parts else _merged([row for part in parts for row in part])
    if isinstance(disturbance, Constant):
        return [(steady, {"inflow": disturbance.level})]
    if isinstance(disturbance, InflowTable):
        rows = lambda *columns: np.array(columns, dtype=float).T.tolist()
        keys = ("tank", "interpolate", "changes")
        tables = ((i, between, rows(t, q)) for i, between, t, q in disturbance.from_start())
        return [(INFLOW_TABLE, dict(zip(keys, table))) for table in tables]
    if not isinstance(disturbance, InflowPulses):
        return None
    rows = zip(disturbance.events, np.asarray(disturbance.volume).tolist())
    pulses = [dict(zip(pulse.names, (*event, volume))) for event, volume in rows]
    return [(steady, {"window": disturbance.window}), *((pulse, values) for values in pulses)]


def _merged(tables):
    """Tables of a disturbance with one [disturbance], of the keys of all."""
    steady, keys = SECTIONS["disturbance"], {}
    for section, values in tables:
        keys |= values if section is steady else {}
    others = [row for row in tables if row[0] is not steady]
    return [(steady, keys), *others] if keys else others


def fault_tables(part):
    """[(section, {key: value})] of a Faults."""
    if part is None:
        return []
    section = SECTIONS["fault"]
    names = ("of", "start", "end", "factor", "extra")
    rows = zip(part.windows, np.asarray(part.factor).tolist(), np.asarray(part.extra).tolist())
    plants = [dict(zip(names, (*window, factor, extra))) for window, factor, extra in rows]
    sizes = np.zeros(0) if part.size is None else np.asarray(part.size)
    of_sensors = []
    for fault, size in zip(part.sensors, sizes.tolist()):
        row = {"sensor": fault.tank, **fault._asdict(), "size": size}
        keys = ("sensor", "kind", "start", "end", *OF_SENSORS[fault.kind])
        of_sensors.append({key: row[key] for key in keys})
    return [(section, values) for values in (*plants, *of_sensors)]
