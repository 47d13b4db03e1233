"""`jaxtank show`: one case as the manual of it, 100 columns wide."""

import dataclasses
import inspect
import textwrap

import numpy as np

from jaxtank import presets
from jaxtank.case import Free
from jaxtank.core.clock import CLOCK
from jaxtank.core.tree import walk
from jaxtank.instruments import LevelSensor, PumpBank
from jaxtank.measures import MEASURES, of_loop
from jaxtank.measures import unit as measure_unit
from jaxtank.plots.equations import equations, physics
from jaxtank.signals.base import Constant, Sum
from jaxtank.signals.inflows import Pours
from jaxtank.signals.setpoints import Ramps, Sine
from tuning.report import tables


def own_name(case, kind, i):
    """ " (left)" of the `kind`, "tank" or "pump", that its rig file calls left; nothing of one
    without a name.
    """
    name = case.names.get(kind, {i: ""})[i]
    return f" ({name})" if name else ""


def called(case):
    """What the rig file calls its tanks and pumps."""
    found = [
        f"{kind} {i + 1} is {name!r}"
        for kind in ("tank", "pump")
        for i, name in enumerate(case.names.get(kind, ()))
        if name
    ]
    return [f"The names of its file: {', '.join(found)}."] if found else []


def _list(values):
    found = [f"{float(v):g}" for v in np.ravel(values)]
    return found[0] if len(set(found)) == 1 else ", ".join(found)


def sensor(loop):
    """What is read of the levels."""
    own, length = loop.sensor, loop.units[0]
    if not isinstance(own, LevelSensor):
        return [f"Sensors: {type(own).__name__}."]
    noise = (
        f"noise of {_list(own.noise)} {length} (standard deviation)"
        if np.any(np.asarray(own.noise) > 0)
        else "no noise (sensor.noise)"
    )
    bits = f"an ADC of {own.bits} bits" if own.bits else "no ADC (sensor.bits)"
    offset = "" if own.offset is None else f", offset {_list(own.offset)} {length}"
    return [f"Sensors: one per tank, {noise}, {bits}{offset}."]


def actuator(loop):
    """What the pumps make of a command, in the order in which they do."""
    bank, drive = loop.actuator, loop.units[1]
    if not isinstance(bank, PumpBank):
        limits = f"from {_list(bank.low)} to {_list(bank.high)} {drive}"
        return [f"Pumps: {bank.pumps}, {limits}, a {type(bank).__name__}."]
    words = {"clip": "each clipped", "boxqp": "allocated by the law's own cost"}[bank.saturation]
    found = [f"Pumps: {bank.pumps}, from {_list(bank.low)} to {_list(bank.high)} {drive} ({words})"]
    found += (
        [f"dead zone {_list(bank.dead_zone)} {drive} ({bank.dead_zone_kind})"]
        if bank.dead_zone is not None
        else ["no dead zone"]
    )
    found += [f"lag {_list(bank.lag)} s"] if bank.lag is not None else ["no lag"]
    found += [f"transport delay {bank.delay:g} s" if bank.delay else "no delay"]
    return ["; ".join(found) + "."]


def moved(loop):
    """What moves the loop: reference, disturbances, faults."""
    return [_reference(loop.reference, loop.units[0]), *_disturbance(loop), *_faults(loop)]


def _reference(signal, length):
    if isinstance(signal, Sum):
        return f"{_reference(signal.first, length)} {_reference(signal.second, length)}"
    if isinstance(signal, Ramps):
        course = (
            "steps"
            if signal.ramp == 0
            else f"{'ramps' if signal.shape == 'linear' else 'S-curves'} of {signal.ramp:g} s"
        )
        start = ", ".join(f"r{i + 1} = {float(v):g}" for i, v in enumerate(signal.initial))
        changes = "; ".join(
            f"{t:g} s r{i + 1} to {float(v):g}" for (t, i), v in zip(signal.changes, signal.targets)
        )
        return f"Setpoints [{length}]: {start}" + (f"; {course} at {changes}." if changes else ".")
    if isinstance(signal, Sine):
        size = (
            f"{float(signal.amplitude):g} {length} about {float(signal.offset):g} {length}, period"
            f" {signal.period:g} s"
        )
        return (
            f"On r{signal.channel + 1} a sine of {size}, from {signal.start:g} to {signal.end:g} s."
        )
    return f"Setpoints: {type(signal).__name__} with {signal.channels} channels."


def _disturbance(loop):
    signal, length = loop.disturbance, loop.units[0]
    if signal is None:
        return ["No disturbance."]
    if isinstance(signal, Constant):
        return [
            f"Steady inflow that no pump brings: {', '.join(f'{float(v):g}' for v in signal.level)}"
            f" {length}^3/s, by tank."
        ]
    if isinstance(signal, Pours):
        each = (
            f"{float(v):g} {length}^3 into tank {tank + 1} at {t:g} s over {s:g} s"
            for (t, s, tank), v in zip(signal.events, signal.volume)
        )
        return ["Poured: " + "; ".join(each) + "."]
    return [f"Disturbance: {type(signal).__name__}."]


def _faults(loop):
    if loop.faults is None:
        return []
    rows = zip(loop.faults.windows, loop.faults.factor, loop.faults.extra)
    each = (
        f"plant.{n} times {float(f):g}{f' plus {float(e):g}' if float(e) else ''} from {a:g} to"
        f" {b:g} s"
        for (n, a, b), f, e in rows
    )
    return ["Faults, untold to the law: " + "; ".join(each) + "."]


def sampled(case):
    """When the law samples, and where the levels start."""
    now = case.clock
    words = f"{now.substeps} step{'s' if now.substeps > 1 else ''} of {now.integrator} per sample"
    start = ", ".join(f"{float(v):.4g}" for v in case.loop.x0)
    return [
        f"Sampled every {now.dt:g} s for {now.duration:g} s, {words}; levels start at {start}"
        f" {case.loop.units[0]}."
    ]


WIDTH = 100
BELIEFS = ("controller.model.", "controller.law.model.", "observer.model.")


def clock(clock):
    """The clock as a table."""
    return dataclasses.asdict(clock)


def _preset(case):
    paper = case.name.split("/")[0]
    return presets.load(paper) if paper in presets.PAPERS else None


def json_of(case):
    """The JSON object of `jaxtank show --json`."""
    preset = _preset(case)
    ranges = {**(preset.tunable if preset else {}), **case.free}
    parameters = {}
    for kind in ("leaf", "static"):
        for name, value, meta in walk(case.loop, kind=kind):
            low, high = list(Free(*ranges[name]))[:2] if name in ranges else (None, None)
            parameters[name] = {
                "value": tables.clean(value),
                "unit": meta["unit"],
                "low": low,
                "high": high,
                "static": kind == "static",
                "about": meta["doc"],
            }
    for name, meta in CLOCK.items():
        value = getattr(case.clock, name)
        more = {"low": None, "high": None, "static": True, "about": meta["doc"]}
        parameters[f"clock.{name}"] = {"value": value, "unit": meta["unit"], **more}
    return {
        "case": case.name,
        "title": case.title,
        "citation": preset.citation if preset else None,
        "notes": str(preset.notes) if preset else None,
        "plant": type(case.loop.plant).__name__,
        "names": {kind: list(names) for kind, names in case.names.items()},
        "equations": equations(case.loop.plant, case.loop.disturbance is not None),
        "law": _law(case.loop.controller),
        "observer": type(case.loop.observer).__name__,
        "parameters": parameters,
        "free": {n: list(Free(*spec)) for n, spec in case.free.items()},
        "limits": tables.clean(dict(case.limits)),
        "objective": dict(case.objective),
        "published": (
            {
                n: [tables.clean(p.value), " ".join(filter(None, [p.unit, p.where]))]
                for n, p in preset.published.items()
            }
            if preset
            else {}
        ),
        "departures": list(preset.departures) if preset else [],
    }


def _count(number, thing):
    return f"{number} {thing}{'' if number == 1 else 's'}"


def text(case):
    """The page of `jaxtank show`."""
    page, preset, loop = json_of(case), _preset(case), case.loop
    parts = [
        *textwrap.wrap(f"{page['case']}: {page['title']}", WIDTH),
        *textwrap.wrap(page["citation"] or "", WIDTH),
    ]
    parts += [f"notes: {page['notes']}"] if preset else []
    outputs = ", ".join(f"h{i + 1}{own_name(case, 'tank', i)}" for i in loop.plant.outputs)
    parts += _chapter(
        f"The rig: {_count(loop.plant.tanks, 'tank')}, {_count(loop.plant.pumps, 'pump')};"
        f" controlled: {outputs}"
    )
    parts += [
        line
        for row in page["equations"]
        for line in textwrap.wrap(row, WIDTH, initial_indent="  ", subsequent_indent="      ")
    ]
    parts += ["", *_sentences([*called(case), *physics(loop.plant)])]
    parts += _chapter("The loop")
    parts += _sentences([*sensor(loop), *actuator(loop), *moved(loop), *sampled(case)])
    parts += _chapter(f"The law: {page['law']}") + _docstring(
        getattr(loop.controller, "law", loop.controller)
    )
    if hasattr(loop.controller, "law"):
        parts += ["", *_docstring(loop.controller)]
    parts += _chapter(f"The observer: {page['observer']}") + _docstring(loop.observer)
    parts += _chapter("What is tuned")
    parts += [
        grid(
            _tuned(case, preset),
            ["parameter", "value", "published", "unit", "range", "what it is"],
            (26, 18, 12, 8, 14),
        )
    ]
    limited = (
        f"{m} at {'least' if MEASURES[m].sense < 0 else 'most'} {v}"
        for m, v in page["limits"].items()
    )
    parts += ["", *textwrap.wrap("limits of tune: " + (", ".join(limited) or "none"), WIDTH)]
    parts += textwrap.wrap(
        "objective of tune: " + " + ".join(f"{w:g} {m}" for m, w in page["objective"].items()),
        WIDTH,
    )
    if case.scenarios:
        parts += textwrap.wrap("judged by: " + "; ".join(s.name for s in case.scenarios), WIDTH)
    parts += _chapter("Every parameter")
    parts += [
        grid(
            _every(page),
            ["parameter", "value", "unit", "tunable in", "what it is"],
            (30, 18, 11, 13),
        ),
        "",
    ]
    parts += _sentences(
        [
            "*: part of the compiled program: --set and rig files reach it, derivatives do not.",
            (
                "controller.model.* and observer.model.* are the plant that controller and observer"
                " compute with, by the same names; --set plant.* changes the rig and leaves them,"
                " in a rig file they follow plant.* unless they are set."
            ),
        ]
    )
    parts += _chapter("What is measured") + [
        grid(_measures(case), ["measure", "unit", "of each", "what it is"], (22, 9, 8))
    ]
    if preset and preset.published:
        parts += _chapter(
            f"What the paper prints (`jaxtank compare {preset.paper}` measures it again)"
        )
        parts += [
            grid(_published(case, preset), ["published", "value", "here", "where"], (34, 22, 16))
        ]
    if preset and (preset.uncertain or case.uncertain):
        parts += _chapter("What is uncertain")
        parts += _sentences(
            f"{n}, +-{100 * share:g} %: {why}" for n, (share, why) in preset.uncertain.items()
        )
    if page["departures"]:
        parts += ["", "departures from the paper", *_sentences(page["departures"])]
    return "\n".join(parts)


def grid(rows, head, widths):
    """Rows as a table whose cells are wrapped: widths of all columns but the last, which has what
    is left of WIDTH.
    """
    rows = [[str(c) for c in row] for row in rows]
    widths = [min(w, max(len(row[i]) for row in [head, *rows])) for i, w in enumerate(widths)]
    widths = [*widths, WIDTH - sum(widths) - 2 * len(widths)]
    lines = ["  ".join(h.ljust(w) for h, w in zip(head, widths)).rstrip(), "-" * WIDTH]
    for row in rows:
        cells = [textwrap.wrap(cell, w) or [""] for cell, w in zip(row, widths)]
        for i in range(max(map(len, cells))):
            lines.append(
                "  ".join(
                    (c[i] if i < len(c) else "").ljust(w) for c, w in zip(cells, widths)
                ).rstrip()
            )
    return "\n".join(lines)


def _chapter(title):
    return ["", *textwrap.wrap(title, WIDTH), "=" * min(WIDTH, len(title))]


def _sentences(found):
    """Each sentence as an item, under the first line of which the others stand."""
    return [line for sentence in found for line in _item(sentence)]


def _item(sentence):
    return textwrap.wrap(
        sentence, WIDTH, initial_indent="- ", subsequent_indent="  ", break_on_hyphens=False
    )


def _docstring(part):
    """The docstring of a component's class: prose wrapped anew, equations (indented lines) as they
    stand.
    """
    lines, prose = [], []

    def flush():
        lines.extend(textwrap.wrap(" ".join(prose), WIDTH))
        prose.clear()

    for line in inspect.cleandoc(type(part).__doc__ or "").splitlines():
        if not line.strip() or line.startswith("  "):
            flush()
            lines.extend(
                [line.rstrip()]
                if len(line) <= WIDTH
                else textwrap.wrap(
                    line.strip(), WIDTH, initial_indent="    ", subsequent_indent="        "
                )
            )
        else:
            prose.append(line.strip())
    flush()
    return lines


def _law(law):
    inner = getattr(law, "law", None)
    return type(law).__name__ + (f"({type(inner).__name__})" if inner is not None else "")


def _tuned(case, preset):
    """What the case tunes, then what else could be: value, published, unit, range, what it is."""
    page, rows = json_of(case)["parameters"], []
    ranges = {
        **case.free,
        **{
            n: f
            for n, f in (preset.tunable if preset else {}).items()
            if n not in case.free and n in page
        },
    }
    for name, spec in ranges.items():
        free, own = Free(*spec), page.get(name.split("[")[0])
        if own is None or own["value"] is None:
            continue
        printed = preset.published.get(name) if preset else None
        shown = "" if printed is None else _plain(printed.value)
        words = "" if name in case.free else " (not by this case)"
        rows.append(
            [
                name,
                _shown(own["value"], False),
                shown,
                own["unit"],
                f"{free.low:g} : {free.high:g}",
                own["about"] + words,
            ]
        )
    return rows or [["none", "", "", "", "", ""]]


def _every(page):
    rows = []
    for name, p in page["parameters"].items():
        if name.startswith(BELIEFS) or (
            isinstance(p["value"], (list, tuple)) and (p["static"] or not p["value"])
        ):
            continue  # topology is told by the equations, and a rig without pipes has none to set
        span = f"{p['low']:g} : {p['high']:g}" if p["low"] is not None else ""
        rows.append(
            [name + "*" * p["static"], _shown(p["value"], p["static"]), p["unit"], span, p["about"]]
        )
    return rows


def _measures(case):
    """The measures that a run of the case has."""
    known = {m: MEASURES[m] for m in of_loop(case.loop)}
    return [
        [m, measure_unit(m, case.loop.units), "" if s.per == "run" else s.per, s.doc]
        for m, s in known.items()
    ]


def _published(case, preset):
    """What the paper prints, and beside it what this case has where it is a parameter."""
    page, rows = json_of(case)["parameters"], []
    for name, p in preset.published.items():
        own = page.get(name)
        here = (
            _shown(own["value"], False)
            if own is not None and own["value"] is not None and not own["static"]
            else ""
        )
        here = here or ("" if own is None or own["value"] is None else str(own["value"]))
        why = f"; {p.reason}" if p.reason else ""
        rows.append(
            [
                name,
                f"{_plain(p.value)} {p.unit if p.unit != '-' else ''}".strip(),
                here,
                p.where + why,
            ]
        )
    return rows


def _plain(value):
    if isinstance(value, (tuple, list)):
        return " ".join(_plain(v) for v in value)
    return (
        tables.number(value, 6)
        if isinstance(value, (int, float)) and not isinstance(value, bool)
        else str(value)
    )


def _shown(value, is_static):
    if value is None:
        return "not in use"
    if is_static:
        return str(value).lower() if isinstance(value, bool) else str(value)
    return " ".join(tables.number(v, 6) for v in np.ravel(value))
