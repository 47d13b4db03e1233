"""The report of a sensitivity study: text, JSON, picture, page and folder."""

import dataclasses
import functools

import numpy as np

from jaxtank.core.files import check_folder
from jaxtank.core.tree import describe, get_value
from tuning.problem import provenance
from tuning.problem.wording import count
from tuning.report import artifacts, html, tables
from tuning.report.studies.sensitivity_tables import (
    HEADS,
    TITLES,
    derivative_unit,
    notes_of,
    parts_of,
    table_csv,
)
from tuning.uncertainty.distributions import Correlated, Normal
from tuning.uncertainty.sensitivity_study import NORMAL_WIDTH

PANELS = 12
"""Measures in the picture."""


def lines(result):
    """Return what is printed of a SensitivityResult: lines and Tables."""
    return [*parts_of(result), *(f"- {note}" for note in notes_of(result))]


def json_of(result):
    """Return the JSON object of `jaxtank sensitivity --json`."""
    return {
        "case": result.case.name,
        "method": result.method,
        "samples": result.samples,
        "runs": result.runs,
        "failed": result.failed,
        "distributions": {
            n: {
                "kind": type(d).__name__,
                **{k: v for k, v in dataclasses.asdict(d).items() if v is not None},
            }
            for n, d in result.distributions.items()
        },
        "parameters": {
            n: {
                "value": tables.clean(np.asarray(get_value(result.case.loop, n))),
                "unit": describe(result.case.loop, n)["unit"],
                **(
                    {
                        "half_width": result.half_width[n],
                        "half_width_is": _width_in_words(result, n),
                    }
                    if result.half_width
                    else {}
                ),
            }
            for n in result.parameters
        },
        "measures": {c.label: _column_json(result, c) for c in result.columns},
        "notes": notes_of(result),
        "wall_s": result.wall_s,
        "provenance": provenance.provenance(result.case, result.seed),
    }


def _width_in_words(result, label):
    for name, d in result.distributions.items():
        if label in getattr(d, "names", (name,)) or label.split("[")[0] == name:
            normal = isinstance(d, (Normal, Correlated))
            return (
                f"{min(NORMAL_WIDTH, d.cut):g} standard deviations" if normal else "half the range"
            )
    return ""


def _column_json(result, c):
    extra = {}
    if result.method == "sobol":
        extra = {
            "sd": tables.clean(float(c.effects["sd"])),
            "sum_of_first": tables.clean(float(np.sum(c.effects["first"]))),
            "base_points_used": int(c.effects["kept"]),
        }
    rows = {}
    for i in result.order(c):
        rows[result.parameters[i]] = {
            q: tables.clean(c.effects[q][i]) for q in HEADS[result.method]
        }
        if result.method == "local":
            rows[result.parameters[i]]["derivative_unit"] = derivative_unit(
                result, c, result.parameters[i]
            )
        if result.method == "morris":
            rows[result.parameters[i]]["mu_interval95"] = tables.clean(
                c.effects["mu_interval95"][i]
            )
            rows[result.parameters[i]]["effects_used"] = int(c.effects["kept"][i])
    return {
        "measure": c.measure,
        "unit": c.unit,
        "nominal": tables.clean(c.nominal),
        "not_finite": c.not_finite,
        "reason": c.reason or None,
        **extra,
        "parameters": rows,
    }


def figures(result):
    """Return {"tornado" or "sobol": Figure} with a panel for each measure, at most PANELS."""
    from jaxtank.plots import responses as plotting

    shown = [c for c in result.columns if not c.empty][:PANELS]
    if not shown:
        return {}
    draws = [functools.partial(_panel, plotting, result, c) for c in shown]
    name = "sobol" if result.method == "sobol" else "tornado"
    rows = min(len(result.parameters), plotting.BARS)
    title = f"{result.case.name}: {TITLES[result.method]}"
    return {name: plotting.panels(draws, title, rows)}


def _panel(plotting, result, c, ax):
    """Draw the sensitivities of one Column."""
    order, method, unit = result.order(c), result.method, c.unit
    names = [result.parameters[i] for i in order]
    effects = {q: np.asarray(c.effects[q])[order] for q in HEADS[method]}
    title = f"{c.label} ({tables.number(c.nominal, 4)} {unit})"
    if method == "local":
        return plotting.tornado(ax, names, effects["effect"], unit, title)
    if method == "morris":
        size, spread = effects["mu_star"], effects["sigma"]
        interval = effects["mu_star_interval95"]
        return plotting.elementary(ax, names, size, interval, spread, unit, title)
    shares = [effects[q] for q in ("first", "total", "first_interval95", "total_interval95")]
    return plotting.shares(ax, names, *shares, title)


def page_of(result, drawn, command=None):
    """Return the page report.html of a SensitivityResult."""
    first = next((c for c in result.columns if not c.empty), None)
    facts = [
        ("parameters", str(len(result.parameters))),
        ("runs", str(result.runs)),
        ("time", f"{result.wall_s:.1f} s"),
    ]
    if first is not None:
        facts.insert(
            0, (f"{first.label} is most sensitive to", result.parameters[result.order(first)[0]])
        )
    return html.document(
        f"{result.case.name}: sensitivity",
        result.case.title,
        (
            f"{result.method}: {count(result.failed, 'run')} diverged"
            if result.failed
            else f"{result.method}: every run is finite"
        ),
        not result.failed,
        facts,
        notes_of(result),
        html.drawings(
            drawn,
            dict.fromkeys(
                drawn, TITLES[result.method][0].upper() + TITLES[result.method][1:] + "."
            ),
        ),
        parts_of(result)[1:],
        command,
        provenance.provenance(result.case, result.seed),
    )


def save(result, folder, command=None):
    """Write result.json, sensitivity.csv, tornado.png or sobol.png, and report.html to `folder`."""
    check_folder(folder)
    files = {
        "result.json": tables.dumps(json_of(result)) + "\n",
        "sensitivity.csv": table_csv(result),
    }
    stale = artifacts.earlier(folder, ["tornado", "sobol"])
    return artifacts.write_result(
        folder, files, lambda: figures(result), lambda drawn: page_of(result, drawn, command), stale
    )
