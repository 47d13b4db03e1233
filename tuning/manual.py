"""`jaxtank show`: one case as a page of its manual."""

import dataclasses

import numpy as np

from jaxtank import presets
from jaxtank.presets.base import Free
from jaxtank.records import CLOCK_UNITS
from jaxtank.tree import walk
from tuning import report
from tuning.objective import LOWER


def noisy(case):
    """True if a run of the case draws noise."""
    return bool(np.any(np.asarray(case.loop.sensor.noise) > 0))


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
                "value": report.clean(value),
                "unit": meta["unit"],
                "low": low,
                "high": high,
                "static": kind == "static",
                "about": meta["doc"],
            }
    for name, unit in CLOCK_UNITS.items():
        parameters[f"clock.{name}"] = {
            "value": getattr(case.clock, name),
            "unit": unit,
            "low": None,
            "high": None,
            "static": True,
            "about": "",
        }
    return {
        "case": case.name,
        "title": case.title,
        "citation": preset.citation if preset else None,
        "plant": type(case.loop.plant).__name__,
        "law": _law(case.loop.controller),
        "observer": type(case.loop.observer).__name__,
        "parameters": parameters,
        "free": {n: list(Free(*spec)) for n, spec in case.free.items()},
        "limits": report.clean(dict(case.limits)),
        "objective": dict(case.objective),
        "published": {n: [report.clean(p.value), " ".join(filter(None, [p.unit, p.where]))] for n, p in preset.published.items()}
        if preset
        else {},
        "departures": list(preset.departures) if preset else [],
    }


def text(case):
    """The page of `jaxtank show`."""
    page = json_of(case)
    rows = []
    for name, p in page["parameters"].items():
        if name.startswith(("controller.model.", "controller.law.model.")):
            continue
        value = p["value"]
        shown = _shown(value, p["static"])
        rows.append(
            [
                name + ("*" if p["static"] else ""),
                shown,
                p["unit"],
                f"{p['low']:g} : {p['high']:g}" if p["low"] is not None else "",
                p["about"],
            ]
        )
    law = (type(case.loop.controller).__doc__ or "").strip().split("\n\n")[0]
    parts = [
        f"{page['case']}: {page['title']}",
        page["citation"] or "",
        "",
        f"plant {page['plant']}, observer {page['observer']}, law {page['law']}: {' '.join(law.split())}",
        "",
        report.table(rows, ["parameter", "value", "unit", "tunable in", "what it is"]),
        "",
        "* part of the compiled program: --set and rig files reach it, derivatives do not.",
        "controller.model.* is the law's own copy of the plant, with the same names; --set plant.* changes the rig and leaves the law's belief.",
        "",
        "limits of tune: "
        + (", ".join(f"{m} at {'least' if m in LOWER else 'most'} {v}" for m, v in page["limits"].items()) or "none"),
        "objective of tune: " + " + ".join(f"{w:g} {m}" for m, w in page["objective"].items()),
    ]
    if page["published"]:
        rows = [[n, v, where] for n, (v, where) in page["published"].items()]
        parts += ["", report.table(rows, ["published", "value", "where"])]
    if page["departures"]:
        parts += ["", "departures from the paper", *(f"- {d}" for d in page["departures"])]
    return "\n".join(parts)


def _law(law):
    inner = getattr(law, "law", None)
    return type(law).__name__ + (f"({type(inner).__name__})" if inner is not None else "")


def _shown(value, is_static):
    if value is None:
        return "not in use"
    if is_static:
        return str(value).lower() if isinstance(value, bool) else str(value)
    return " ".join(report.number(v, 6) for v in np.ravel(value))
