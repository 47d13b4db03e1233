"""`jaxtank show`: one case as the manual of it, 100 columns wide."""

import dataclasses
import inspect
import itertools
import re
import textwrap

import numpy as np

from jaxtank import presets
from jaxtank.case import Free
from jaxtank.core.clock import CLOCK
from jaxtank.core.tree import walk
from jaxtank.core.units import local
from jaxtank.loop.estimate_notes import design_notes
from jaxtank.measures import MEASURES, of_loop
from jaxtank.measures import unit as measure_unit
from jaxtank.plots.equations import equations, physics
from tuning.problem.wording import count
from tuning.report import safety, tables
from tuning.report.case_loop import actuator, called, own_name, sampled, sensor, signals

WIDTH = 100
# the head of a numpydoc section: a title underlined with dashes
SECTION = re.compile(r"^[A-Z]\w*(?: \w+)*\n-{3,}$", re.M)
BRACKETED = re.compile(r"\[([\w^/(). ]+)\]")
MODELS = ("controller.model.", "controller.law.model.", "observer.model.")
"""Names of the plant that controller and observer compute with."""


def clock(clock):
    """Return the clock as a dict."""
    return dataclasses.asdict(clock)


def _preset(case):
    paper = case.name.split("/")[0]
    return presets.load(paper) if paper in presets.PAPERS else None


def json_of(case):
    """Return the JSON object of `jaxtank show --json`."""
    preset, loop = _preset(case), case.loop
    published = preset.published if preset else {}
    return {
        "case": case.name,
        "title": case.title,
        "citation": preset.citation if preset else None,
        "notes": str(preset.notes) if preset else None,
        "plant": type(loop.plant).__name__,
        "names": {kind: list(names) for kind, names in case.names.items()},
        "equations": equations(loop.plant, loop.disturbance is not None),
        "law": _class_of(loop.controller),
        "observer": type(loop.observer).__name__,
        "parameters": _parameters(case, preset),
        "free": {n: list(Free(*spec)) for n, spec in case.free.items()},
        "limits": tables.clean(dict(case.limits)),
        "objective": dict(case.objective),
        "safety_filter": safety.certificates(case),
        "published": {
            n: [tables.clean(p.value), " ".join(filter(None, [p.unit, p.where]))]
            for n, p in published.items()
        },
        "departures": list(preset.departures) if preset else [],
    }


def _parameters(case, preset):
    """{name: {value, unit, low, high, static, about}} of every leaf, static field and the clock."""
    ranges = {**(preset.tunable if preset else {}), **case.free}
    found = {}
    for kind in ("leaf", "static"):
        for name, value, meta in walk(case.loop, kind=kind):
            low, high = list(Free(*ranges[name]))[:2] if name in ranges else (None, None)
            found[name] = {
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
        found[f"clock.{name}"] = {"value": value, "unit": meta["unit"], **more}
    return found


def text(case):
    """Return the page of `jaxtank show`."""
    page, preset = json_of(case), _preset(case)
    head = [
        *textwrap.wrap(f"{page['case']}: {page['title']}", WIDTH),
        *textwrap.wrap(page["citation"] or "", WIDTH),
        *([f"notes: {page['notes']}"] if preset else []),
    ]
    chapters = [
        _rig(case, page),
        _loop(case, page),
        _tuning(case, preset, page),
        _safety(case, page),
        _all_parameters(page),
        _measured(case),
        _paper(case, preset, page),
    ]
    return "\n".join([*head, *(line for chapter in chapters for line in chapter)])


def _rig(case, page):
    """The chapter on the plant: its equations and its physics."""
    plant = case.loop.plant
    outputs = ", ".join(f"h{i + 1}{own_name(case, 'tank', i)}" for i in plant.outputs)
    size = f"{count(plant.tanks, 'tank')}, {count(plant.pumps, 'pump')}"
    lines = _chapter(f"The rig: {size}; controlled: {outputs}")
    for row in page["equations"]:
        lines += textwrap.wrap(row, WIDTH, initial_indent="  ", subsequent_indent="      ")
    return [*lines, "", *_sentences([*called(case), *physics(plant)])]


def _loop(case, page):
    """The chapters on sensors, pumps and signals, on the controller and on the observer."""
    loop, lines = case.loop, _chapter("The loop")
    lines += _sentences([*sensor(loop), *actuator(loop), *signals(loop), *sampled(case)])
    lines += _chapter(f"The controller: {page['law']}")
    lines += _docstring(getattr(loop.controller, "law", loop.controller), loop.units)
    if hasattr(loop.controller, "law"):
        lines += ["", *_docstring(loop.controller, loop.units)]
    return (
        lines
        + _chapter(f"The observer: {page['observer']}")
        + _docstring(loop.observer, loop.units)
        + _sentences(design_notes(loop, np.stack(loop.reference.sample(case.clock)[0], axis=-1)))
    )


def _tuning(case, preset, page):
    """The chapter on what is tuned: gains, limits, objective, scenarios."""
    heads = ["parameter", "value", "published", "unit", "range", "what it is"]
    lines = _chapter("What is tuned")
    lines.append(grid(_tuned(case, preset, page["parameters"]), heads, (26, 18, 12, 8, 14)))
    limited = (
        f"{m} at {'least' if MEASURES[m].sense < 0 else 'most'} {v}"
        for m, v in page["limits"].items()
    )
    weighed = " + ".join(f"{w:g} {m}" for m, w in page["objective"].items())
    lines += ["", *textwrap.wrap("limits of tune: " + (", ".join(limited) or "none"), WIDTH)]
    lines += textwrap.wrap(f"objective of tune: {weighed}", WIDTH)
    if case.scenarios:
        names = "; ".join(s.name for s in case.scenarios)
        lines += textwrap.wrap(f"scenarios of tune: {names}", WIDTH)
    return lines


def _safety(case, page):
    """The chapter on the safety filter: which limits on levels are proved."""
    if page["safety_filter"] is None:
        return []
    heads, rows = safety.rows_of(case, page["safety_filter"])
    table = grid(rows, heads, (4, 12, 6, 6, 11, 13, 10))
    return [*_chapter("Limits on levels"), table, "", *_sentences(safety.sentences(case))]


def _all_parameters(page):
    """The chapter on every parameter."""
    heads = ["parameter", "value", "unit", "tunable in", "what it is"]
    notes = [
        "*: part of the compiled program: --set and rig files reach it, derivatives do not.",
        "controller.model.* and observer.model.* are the plant that controller and observer"
        " compute with, by the same names; --set plant.* changes the rig and leaves them, in a rig"
        " file they follow plant.* unless they are set.",
    ]
    table = grid(_every(page), heads, (30, 18, 11, 13))
    return [*_chapter("Every parameter"), table, "", *_sentences(notes)]


def _measured(case):
    """The chapter on the measures."""
    heads = ["measure", "unit", "of each", "what it is"]
    return [*_chapter("What is measured"), grid(_measures(case), heads, (22, 9, 8))]


def _paper(case, preset, page):
    """The chapters on what the paper prints, what is uncertain, and departures from the paper."""
    lines = []
    if preset and preset.published:
        compared = f"`jaxtank compare {preset.paper}` measures it again"
        heads = ["published", "value", "here", "where"]
        rows = _published(preset, page["parameters"])
        lines += [*_chapter(f"What the paper prints ({compared})"), grid(rows, heads, (34, 22, 16))]
    if preset and (preset.uncertain or case.uncertain):
        uncertain = preset.uncertain.items()
        lines += _chapter("What is uncertain")
        lines += _sentences(f"{n}, +-{100 * share:g} %: {why}" for n, (share, why) in uncertain)
    if page["departures"]:
        lines += ["", "departures from the paper", *_sentences(page["departures"])]
    return lines


def grid(rows, head, widths):
    """Return rows as a table whose cells are wrapped."""
    rows = [[str(c) for c in row] for row in rows]
    widths = [min(w, max(len(row[i]) for row in [head, *rows])) for i, w in enumerate(widths)]
    widths = [*widths, WIDTH - sum(widths) - 2 * len(widths)]
    lines = ["  ".join(h.ljust(w) for h, w in zip(head, widths)).rstrip(), "-" * WIDTH]
    for row in rows:
        cells = [textwrap.wrap(cell, w) or [""] for cell, w in zip(row, widths)]
        for parts in itertools.zip_longest(*cells, fillvalue=""):
            lines.append("  ".join(c.ljust(w) for c, w in zip(parts, widths)).rstrip())
    return "\n".join(lines)


def _chapter(title):
    return ["", *textwrap.wrap(title, WIDTH), "=" * min(WIDTH, len(title))]


def _sentences(found):
    """Each sentence as an item of a list, wrapped."""
    return [line for sentence in found for line in _item(sentence)]


def _item(sentence):
    return textwrap.wrap(
        sentence, WIDTH, initial_indent="- ", subsequent_indent="  ", break_on_hyphens=False
    )


def _docstring(part, units):
    """Return the description of a component's class: its docstring up to the numpydoc sections,
    units in brackets in those of the rig.
    """
    lines, prose = [], []
    description = SECTION.split(inspect.cleandoc(type(part).__doc__ or ""), maxsplit=1)[0]
    description = BRACKETED.sub(lambda found: f"[{local(found[1], units)}]", description)

    def flush():
        lines.extend(textwrap.wrap(" ".join(prose), WIDTH))
        prose.clear()

    for line in description.rstrip().splitlines():
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


def _class_of(controller):
    inner = getattr(controller, "law", None)
    return type(controller).__name__ + (f"({type(inner).__name__})" if inner is not None else "")


def _tuned(case, preset, parameters):
    """What the case tunes, then what else could be: value, published, unit, range, what it is."""
    ranges, rows = dict(case.free), []
    for name, spec in (preset.tunable if preset else {}).items():
        if name in parameters:
            ranges.setdefault(name, spec)
    for name, spec in ranges.items():
        free, own = Free(*spec), parameters.get(name.split("[")[0])
        if own is None or own["value"] is None:
            continue
        published = preset.published.get(name) if preset else None
        about = own["about"] + ("" if name in case.free else " (not by this case)")
        rows.append(
            [
                name,
                _shown(own["value"], False),
                "" if published is None else _plain(published.value),
                own["unit"],
                f"{free.low:g} : {free.high:g}",
                about,
            ]
        )
    return rows or [["none", "", "", "", "", ""]]


def _every(page):
    rows = []
    for name, p in page["parameters"].items():
        if name.startswith(MODELS) or (
            isinstance(p["value"], (list, tuple)) and (p["static"] or not p["value"])
        ):
            continue  # topology is in the equations, and a rig without pipes has none to set
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


def _published(preset, parameters):
    """What the paper prints, and beside it what this case has where it is a parameter."""
    rows = []
    for name, p in preset.published.items():
        own, here = parameters.get(name), ""
        if own is not None and own["value"] is not None:
            value = own["value"]
            here = str(value) if own["static"] else _shown(value, False) or str(value)
        printed = f"{_plain(p.value)} {p.unit if p.unit != '-' else ''}".strip()
        rows.append([name, printed, here, p.where + (f"; {p.reason}" if p.reason else "")])
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
