"""`jaxtank show`: the manual of one case, 100 columns wide."""

import inspect
import re
import textwrap
from typing import Any

import numpy as np

from jaxtank import presets
from jaxtank.case import Free
from jaxtank.core.clock import CLOCK
from jaxtank.core.labels import label_of, units_of_inputs
from jaxtank.core.text import count
from jaxtank.core.tree import walk
from jaxtank.core.units import local
from jaxtank.instruments import LevelSensor, PumpBank
from jaxtank.loop.estimate_notes import design_notes
from jaxtank.measures import MEASURES, of_loop, unit as measure_unit
from jaxtank.plots.equations import equations, physics
from jaxtank.signals.base import Constant, Sum
from jaxtank.signals.inflows import InflowPulses, InflowTable
from jaxtank.signals.setpoints import Ramps, Sine
from tuning.report import safety, verdict as verdicts
from tuning.report.document import Report, Text
from tuning.report.tables import Table, Value, clean, columns

# the head of a numpydoc section: a title underlined with dashes
SECTION = re.compile(r"^[A-Z]\w*(?: \w+)*\n-{3,}$", re.M)
BRACKETED = re.compile(r"\[([\w^/(). ]+)\]")
# the plant that controller and observer compute with
MODELS = ("controller.model.", "controller.law.model.", "observer.model.")

NOTES = (
    "*: part of the compiled program: --set and rig files reach it, derivatives do not.",
    "controller.model.* and observer.model.* are the plant that controller and observer compute"
    " with, by the same names; --set plant.* changes the rig and leaves them, in a rig file they"
    " follow plant.* unless they are set.",
)


def _preset(case):
    paper = case.name.split("/")[0]
    return presets.load(paper) if paper in presets.PAPERS else None


def json_of(case):
    preset, loop = _preset(case), case.loop
    published = preset.published if preset else {}
    inner = getattr(loop.controller, "law", None)
    return {
        "case": case.name,
        "title": case.title,
        "verdict": verdicts.outcome(f"{case.name} is a case that can be run").to_json(),
        "citation": preset.citation if preset else None,
        "notes": str(preset.notes) if preset else None,
        "plant": type(loop.plant).__name__,
        "names": {kind: list(names) for kind, names in case.names.items()},
        "equations": equations(loop.plant, loop.disturbance is not None),
        "law": type(loop.controller).__name__ + f"({type(inner).__name__})" * (inner is not None),
        "observer": type(loop.observer).__name__,
        "parameters": _parameters(case, preset),
        "free": {n: list(Free(*spec)) for n, spec in case.free.items()},
        "limits": clean(dict(case.limits)),
        "objective": dict(case.objective),
        "safety_filter": safety.certificates(case),
        "published": {
            n: [clean(p.value), " ".join(filter(None, [p.unit, p.where]))]
            for n, p in published.items()
        },
        "departures": list(preset.departures) if preset else [],
    }


def _parameters(case, preset):
    """{name: {value, unit, low, high, static, about}} of every leaf, static field and the clock."""
    ranges = {**(preset.tunable if preset else {}), **case.free}
    rows = [(kind, *row) for kind in ("leaf", "static") for row in walk(case.loop, kind=kind)]
    rows += [("static", f"clock.{n}", getattr(case.clock, n), meta) for n, meta in CLOCK.items()]
    parameters = {}
    for kind, name, value, meta in rows:
        if value is None and name.rpartition(".")[0].endswith(("plant", "model")):
            continue  # parts that this rig does not have
        low, high = list(Free(*ranges[name]))[:2] if name in ranges else (None, None)
        row = {"value": clean(value), "unit": meta["unit"], "low": low, "high": high}
        parameters[name] = row | {"static": kind == "static", "about": meta["doc"]}
    return parameters


def report(case, word=""):
    """Return the Report of a case; word: its name, or the path of its file."""
    page, preset, loop = json_of(case), _preset(case), case.loop
    title = f"{page['case']}: {page['title']}"
    named = case.names.get("tank") or [""] * loop.plant.tanks
    outputs = ", ".join(f"h{i + 1}" + f" ({named[i]})" * bool(named[i]) for i in loop.plant.outputs)
    valves = len(getattr(loop.plant, "valves", ()))
    counts = {"tank": loop.plant.tanks, "pump": loop.plant.pumps - valves, "valve": valves}
    size = ", ".join(count(n, kind) for kind, n in counts.items() if n)
    indents: dict[str, Any] = {"initial_indent": "  ", "subsequent_indent": "      "}
    rows = [line for row in page["equations"] for line in textwrap.wrap(row, columns(), **indents)]
    words = [_sensor(loop), _actuator(loop), *_signals(loop), _sampled(case)]
    inner = getattr(loop.controller, "law", None)
    described = [(inner or loop.controller, f"The controller: {page['law']}")]
    described += [(loop.controller, "")] if inner is not None else []
    described += [(loop.observer, f"The observer: {page['observer']}")]
    go_on = [f"jaxtank {words} {word or case.name}" for words in ("simulate", "tune --out DIR")]
    sections = [
        Text([title, *([preset.citation, f"notes: {page['notes']}"] if preset else [])]),
        Table([[what, text] for what, text in case.summary()[1:]], gap=True),
        Text(go_on, gap=True),
        Text(rows, heading=f"The rig: {size}; controlled: {outputs}", layout=True),
        Text([*_called(case), *physics(loop.plant)], items=True, gap=True),
        Text(words, items=True, heading="The loop"),
        *(_docstring(part, loop, heading) for part, heading in described),
        Text(design_notes(loop, case.clock), items=True),
        *_tuning(case, preset, page),
    ]
    if page["safety_filter"] is not None:
        sections.append(safety.table_of(case, page["safety_filter"]))
        sections.append(Text(safety.sentences(case), items=True, gap=True))
    notes = Text(NOTES, items=True, gap=True)
    sections += [_every(page), notes, _measures(loop), *_paper(case, preset, page)]
    return Report(title, "", None, (), sections)


def _tuning(case, preset, page):
    """The tuning problem: gains, limits, objective, scenarios."""
    limits = ", ".join(
        f"{m} at {'least' if MEASURES[m].sense < 0 else 'most'} {v}"
        for m, v in page["limits"].items()
    )
    weighted = " + ".join(f"{w:g} {m}" for m, w in page["objective"].items())
    lines = [f"limits of tune: {limits or 'none'}", f"objective of tune: {weighted}"]
    if case.scenarios:
        lines.append(f"scenarios of tune: {'; '.join(s.name for s in case.scenarios)}")
    return [_tuned(case, preset, page["parameters"]), Text(lines, gap=True)]


def _measures(loop):
    specs = {m: MEASURES[m] for m in of_loop(loop)}
    rows = [
        [m, measure_unit(m, loop.units), spec.per.replace("run", ""), spec.doc]
        for m, spec in specs.items()
    ]
    return Table(rows, ["measure", "unit", "of each", "what it is"], heading="What is measured")


def _paper(case, preset, page):
    """Published numbers, uncertain parameters, and departures from the paper."""
    sections: list[Any] = []
    if preset and preset.published:
        sections.append(_published(preset, page["parameters"]))
    if preset and (preset.uncertain or case.uncertain):
        words = [f"{n}, +-{100 * share:g} %: {why}" for n, (share, why) in preset.uncertain.items()]
        sections.append(Text(words, items=True, heading="What is uncertain"))
    if page["departures"]:
        sections.append(Text(["departures from the paper"], gap=True))
        sections.append(Text(page["departures"], items=True))
    return sections


def _docstring(part, loop, heading):
    """The docstring of a component's class up to numpydoc sections, in units of the rig."""
    lines, prose = [], []
    description = SECTION.split(inspect.cleandoc(type(part).__doc__ or ""), maxsplit=1)[0]
    description = BRACKETED.sub(lambda unit: f"[{local(unit[1], loop.units)}]", description)
    indents: dict[str, Any] = {"initial_indent": "    ", "subsequent_indent": "        "}
    for line in [*description.rstrip().splitlines(), ""]:
        if line.strip() and not line.startswith("  "):
            prose.append(line.strip())
            continue
        lines += textwrap.wrap(" ".join(prose), columns())
        prose = []
        long = len(line) > columns()
        lines += textwrap.wrap(line.strip(), columns(), **indents) if long else [line.rstrip()]
    return Text(lines[:-1], gap=True, heading=heading, layout=True)


def _tuned(case, preset, parameters):
    """The table of the free parameters, then of others that could be free."""
    others = {n: spec for n, spec in preset.tunable.items() if n in parameters} if preset else {}
    rows = []
    for name, spec in {**case.free, **others, **case.free}.items():  # in this order, by the case
        free, parameter = Free(*spec), parameters.get(name.split("[")[0])
        if parameter is None or parameter["value"] is None:
            continue
        published = preset.published.get(name) if preset else None
        printed = "" if published is None else _plain(published.value)
        about = parameter["about"] + " (not by this case)" * (name not in case.free)
        span = f"{free.low:g} : {free.high:g}"
        value = _value(parameter["value"], False)
        rows.append([name, value, printed, parameter["unit"], span, about])
    heads = ["parameter", "value", "published", "unit", "range", "what it is"]
    return Table(rows or [["none", "", "", "", "", ""]], heads, heading="What is tuned")


def _every(page):
    rows = []
    for name, p in page["parameters"].items():
        # topology is in the equations, and a rig without pipes has none to set
        hidden = isinstance(p["value"], (list, tuple)) and (p["static"] or not p["value"])
        if not hidden and not name.startswith(MODELS):
            span = f"{p['low']:g} : {p['high']:g}" if p["low"] is not None else ""
            value = _value(p["value"], p["static"])
            rows.append([name + "*" * p["static"], value, p["unit"], span, p["about"]])
    heads = ["parameter", "value", "unit", "tunable in", "what it is"]
    return Table(rows, heads, heading="Every parameter")


def _published(preset, parameters):
    """The table of published numbers, with the value of this case for parameters."""
    rows = []
    for name, p in preset.published.items():
        parameter, value = parameters.get(name), ""
        if parameter is not None and parameter["value"] is not None:
            value = parameter["value"]
            value = str(value if parameter["static"] else Value(value, 6, between=" ")) or value
        printed = f"{_plain(p.value)} {p.unit if p.unit != '-' else ''}".strip()
        rows.append([name, printed, value, p.where + (f"; {p.reason}" if p.reason else "")])
    heading = f"What the paper prints (`jaxtank compare {preset.paper}` measures it again)"
    return Table(rows, ["published", "value", "here", "where"], heading=heading)


def _plain(value):
    if isinstance(value, (tuple, list)):
        return " ".join(_plain(v) for v in value)
    number = isinstance(value, (int, float)) and not isinstance(value, bool)
    return str(Value(value, 6)) if number else str(value)


def _value(value, is_static):
    if value is None:
        return "not in use"
    if is_static:
        return str(value).lower() if isinstance(value, bool) else str(value)
    return Value(value, 6, between=" ")


def _called(case):
    names = [
        f"{kind} {i + 1} is {name!r}"
        for kind in ("tank", "pump", "valve", "sensor")
        for i, name in enumerate(case.names.get(kind, ()))
        if name
    ]
    return [f"The names of its file: {', '.join(names)}."] if names else []


def _list(values):
    texts = [f"{float(v):g}" for v in np.ravel(values)]
    return texts[0] if len(set(texts)) == 1 else ", ".join(texts)


def _sensor(loop):
    sensor, length = loop.sensor, loop.units[0]
    if not isinstance(sensor, LevelSensor):
        return f"Sensors: {type(sensor).__name__}."
    noise = "no noise (sensor.noise)"
    if np.any(np.asarray(sensor.noise) > 0):
        noise = f"noise of {_list(sensor.noise)} {length} (standard deviation)"
    bits = f"an ADC of {sensor.bits} bits" if sensor.bits else "no ADC (sensor.bits)"
    offset = "" if sensor.offset is None else f", offset {_list(sensor.offset)} {length}"
    scale = "" if sensor.scale is None else f", reading {_list(sensor.scale)} of the level"
    curve = "" if sensor.curve_level is None else ", readings by a curve (curve of [[sensor]])"
    return f"Sensors: one per tank, {noise}, {bits}{curve}{scale}{offset}."


def _actuator(loop):
    """Return a sentence on limits, dead zone, lag and delay of the pumps, in this order."""
    bank, drive = loop.actuator, units_of_inputs(loop.plant)
    valves = len(getattr(loop.plant, "valves", ()))
    words = f"Pumps: {bank.pumps - valves}" + f", and {count(valves, 'valve')}" * bool(valves)
    limits = f"from {_list(bank.low)} to {_list(bank.high)} {drive}"
    if not isinstance(bank, PumpBank):
        return f"{words}, {limits}, a {type(bank).__name__}."
    kinds = {"clip": "each clipped", "boxqp": "allocated by the controller's own cost"}
    dead = "no dead zone"
    if bank.dead_zone is not None:
        dead = f"dead zone {_list(bank.dead_zone)} {drive} ({bank.dead_zone_kind})"
    lag = f"lag {_list(bank.lag)} s" if bank.lag is not None else "no lag"
    delay = f"transport delay {bank.delay:g} s" if bank.delay else "no delay"
    if bank.delays:
        delay = f"transport delay {_list([bank.delay + more for more in bank.delays])} s"
    if bank.rate is not None:
        lag = f"at most {_list(bank.rate)} {drive}/s; {lag}"
    return f"{words}, {limits} ({kinds[bank.saturation]}); {dead}; {lag}; {delay}."


def _signals(loop):
    length = loop.units[0]
    disturbance = _disturbance(loop.disturbance, loop.plant, length)
    sentences = [_reference(loop.reference, length), disturbance]
    if loop.faults is not None:
        faults = [
            f"plant.{n} times {float(f):g}{f' plus {float(e):g}' if float(e) else ''} from {a:g} to"
            f" {b:g} s"
            for (n, a, b), f, e in zip(loop.faults.windows, loop.faults.factor, loop.faults.extra)
        ]
        for fault, size in zip(loop.faults.sensors, np.ravel(loop.faults.size)):
            rate = "/s" if fault.kind == "drift" else ""
            amount = "" if fault.kind == "freeze" else f" {float(size):g} {length}{rate}"
            tank = label_of(loop.plant, "tank", fault.tank)
            when = f"from {fault.start:g} to {fault.end:g} s"
            faults.append(f"{fault.kind}{amount} of the sensor of {tank} {when}")
        sentences.append(f"Faults, unknown to the controller: {'; '.join(faults)}.")
    return sentences


def _disturbance(signal, plant, length):
    if signal is None:
        return "No disturbance."
    if isinstance(signal, Sum):
        parts = (_disturbance(part, plant, length) for part in (signal.first, signal.second))
        return " ".join(parts)
    if isinstance(signal, Constant):
        levels = ", ".join(f"{float(v):g}" for v in signal.level)
        return f"Constant inflow disturbance: {levels} {length}^3/s, by tank."
    if isinstance(signal, InflowPulses):
        pulses = (
            f"{float(v):g} {length}^3 into {label_of(plant, 'tank', tank)} at {t:g} s over {s:g} s"
            for (t, s, tank), v in zip(signal.events, signal.volume)
        )
        return f"Inflow disturbance: {'; '.join(pulses)}."
    if isinstance(signal, InflowTable):
        tables = (
            f"{len(times)} rows from {times[0]:g} to {times[-1]:g} s, {np.min(flow):g} to"
            f" {np.max(flow):g} {length}^3/s into {label_of(plant, 'tank', tank)}"
            for tank, _, times, flow in signal.tables()
        )
        return f"Measured inflow: {'; '.join(tables)}."
    return f"Disturbance: {type(signal).__name__}."


def _reference(signal, length):
    if isinstance(signal, Sum):
        return f"{_reference(signal.first, length)} {_reference(signal.second, length)}"
    if isinstance(signal, Ramps):
        kind = "ramps" if signal.shape == "linear" else "S-curves"
        course = "steps" if signal.ramp == 0 else f"{kind} of {signal.ramp:g} s"
        start = ", ".join(f"r{i + 1} = {float(v):g}" for i, v in enumerate(signal.initial))
        times = zip(signal.changes, signal.targets)
        changes = "; ".join(f"{t:g} s r{i + 1} to {float(v):g}" for (t, i), v in times)
        if signal.is_table:
            (first, _), (last, _), ends = signal.changes[0], signal.changes[-1], signal.targets
            values = f"{np.min(ends):g} to {np.max(ends):g}"
            changes = f"{len(ends)} times from {first:g} to {last:g} s, to {values}"
        return f"Setpoints [{length}]: {start}" + (f"; {course} at {changes}." if changes else ".")
    if isinstance(signal, Sine):
        size = f"{float(signal.amplitude):g} {length} about {float(signal.offset):g} {length}"
        time = f"period {signal.period:g} s, from {signal.start:g} to {signal.end:g} s"
        return f"On r{signal.channel + 1} a sine of {size}, {time}."
    return f"Setpoints: {type(signal).__name__} with {signal.channels} channels."


def _sampled(case):
    clock, start = case.clock, ", ".join(f"{float(v):.4g}" for v in case.loop.x0)
    steps = f"{count(clock.substeps, 'step')} of {clock.integrator} per sample"
    sampled = f"Sampled every {clock.dt:g} s for {clock.duration:g} s, {steps}"
    return f"{sampled}; levels start at {start} {case.loop.units[0]}."
