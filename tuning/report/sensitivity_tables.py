"""Tables, JSON, CSV and the picture of a sensitivity study."""

import csv
import dataclasses
import io

import numpy as np

from jaxtank.core.files import check_folder
from jaxtank.core.tree import describe, get_value
from tuning.report import artifacts, html, tables
from tuning.search import provenance
from tuning.uncertainty.distributions import Correlated, Normal
from tuning.uncertainty.local import NORMAL_WIDTH

SHOWN = 8
"""Parameters in the table of a measure."""

PANELS = 12
"""Measures in the picture."""

WIDE = 0.2
"""Width of an interval of a share of the variance above which more samples are advised [-]."""

HEADS = {
    "local": {"effect": "effect", "derivative": "derivative", "elasticity": "% per %"},
    "morris": {
        "mu_star": "mu*",
        "mu_star_interval95": "95 % interval",
        "mu": "mu",
        "sigma": "sigma",
    },
    "sobol": {
        "first": "first",
        "first_interval95": "95 % interval",
        "total": "total",
        "total_interval95": "95 % interval",
    },
}
TITLES = {
    "local": "change of each measure for the half-width of each parameter, by derivatives",
    "morris": "elementary effects of each parameter on each measure (Morris)",
    "sobol": "shares of the variance of each measure (Sobol)",
}
WORDS = {
    "local": (
        "effect: derivative at the case's own values times the half-width of the distribution"
        f" (half its range; {NORMAL_WIDTH:g} standard deviations of a normal one); entries that are"
        " tied have an effect together and no derivative each; no percentage of a measure that is"
        " 0; at a kink (travel of a pump that rests, a maximum reached twice) a slope is of one"
        " side"
    ),
    "morris": (
        "mu: mean change of the measure over the whole range of the parameter, at random values of"
        " the others; mu*: mean size of it; sigma: its standard deviation (large where it interacts"
        " or is curved); intervals of Student"
    ),
    "sobol": (
        "first: share of the variance that the parameter has alone; total: with all its"
        " interactions; intervals by bootstrap"
    ),
}
LOST = {
    "local": "",
    "morris": "steps with such an end are left out",
    "sobol": "a base point with such a run is left out whole, so shares are those among the others",
}


def per(unit, of):
    """The unit of a derivative: of a measure in `unit` by a parameter in the unit `of`."""
    return unit if of == "-" else f"{'1' if unit == '-' else unit} per {of}"


def derivative_unit(result, c, name):
    """The unit of the derivative of a Column by a parameter."""
    return per(c.unit, describe(result.case.loop, name)["unit"])


def _heads(method, unit):
    """Headings of the table of a measure in `unit`: what is in that unit says so."""
    shares = {"elasticity", "derivative"} if method == "local" else set(HEADS["sobol"])
    return [head if q in shares else f"{head} [{unit}]" for q, head in HEADS[method].items()]


def notes_of(result):
    """Sentences that go with the numbers: what they are, what was left out, where more samples are
    advised.
    """
    found = [WORDS[result.method], *result.notes]
    if result.failed:
        found.append(f"{result.failed} of {result.runs} runs stopped being finite")
    lost = {
        c.label: c.not_finite for c in result.columns if c.not_finite and result.method != "local"
    }
    if lost:
        found.append(
            "runs in which a measure is no finite number: "
            + ", ".join(f"{label} {count}" for label, count in lost.items())
            + f"; {LOST[result.method]}"
        )
        short = [c.label for c in result.columns if not c.empty and c.reason]
        if short:
            found.append(f"too few finite steps for some parameters: {', '.join(short)}")
    if result.method == "sobol":
        fewest = min((c.effects["kept"] for c in result.columns), default=result.samples)
        if fewest < result.samples:
            found.append(f"base points used: {fewest} of {result.samples} where fewest")
        widest = max(
            (
                np.ptp(c.effects["total_interval95"], axis=1).max()
                for c in result.columns
                if not c.empty
            ),
            default=0.0,
        )
        if widest > WIDE:
            found.append(
                f"the widest interval of a total share is {widest:.2g}: more samples would"
                " narrow it"
            )
    return found


def json_of(result):
    """The JSON object of `jaxtank sensitivity --json`; measures by name and entry, each with every
    parameter, the one that moves it most first.
    """
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
                    {"half_width": result.half_width[n], "half_width_is": _width_words(result, n)}
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


def _width_words(result, label):
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
        rows[result.parameters[i]] = {q: tables.clean(c.effects[q][i]) for q in HEADS[result.method]}
        if result.method == "local":
            rows[result.parameters[i]]["derivative_unit"] = derivative_unit(
                result, c, result.parameters[i]
            )
        if result.method == "morris":
            rows[result.parameters[i]]["mu_interval95"] = tables.clean(c.effects["mu_interval95"][i])
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


def lines(result):
    """What is printed of a SensitivityResult: lines and tables."""
    return [*parts_of(result), *(f"- {note}" for note in notes_of(result))]


def parts_of(result):
    """What `lines` has but for the notes."""
    asked = (
        ""
        if result.samples is None
        else f", {result.samples} {'trajectories' if result.method == 'morris' else 'base points'}"
    )
    runs = f"{result.runs} run{'s' if result.runs > 1 else ''}" + (
        " with derivatives" if result.method == "local" else ""
    )
    spread = ", ".join(f"{n} {_said(d)}" for n, d in result.distributions.items())
    parts = [
        (
            f"{result.case.name}: sensitivity, {result.method}{asked}, {runs}, {result.failed} not"
            f" finite, seed {result.seed}, {result.wall_s:.1f} s"
        ),
        f"varied: {spread}",
        "",
    ]
    for c in result.columns:
        title = f"{c.label} [{c.unit}], {tables.number(c.nominal)} in the case's own run"
        if c.empty:
            parts += [f"{title}: no indices, {c.reason}", ""]
            continue
        rows = [[result.parameters[i], *_cells(result, c, i)] for i in result.order(c)[:SHOWN]]
        more = len(result.parameters) - len(rows)
        tail = [f"and {more} more parameters, each below these"] if more > 0 else []
        if result.method == "sobol":
            tail.append(
                f"first-order shares sum to {np.sum(c.effects['first']):.3f}; to 1 where nothing"
                " interacts"
            )
        parts += [
            title,
            tables.table(rows, ["parameter", *_heads(result.method, c.unit)]),
            *tail,
            "",
        ]
    return parts


def _said(distribution):
    fields = {
        n: v
        for n, v in dataclasses.asdict(distribution).items()
        if v is not None and v is not False
    }
    return (
        f"{type(distribution).__name__.lower()}"
        f" ({', '.join(f'{n} {v}' for n, v in fields.items())})"
    )


def _cells(result, c, i):
    """What a table says of parameter `i`; a derivative with its unit, which differs from row to
    row.
    """
    cells = {q: _cell(c.effects[q][i]) for q in HEADS[result.method]}
    if "derivative" in cells and np.isfinite(c.effects["derivative"][i]):
        cells["derivative"] += f" {derivative_unit(result, c, result.parameters[i])}"
    return cells.values()


def _cell(value):
    return (
        " : ".join(tables.number(v, 3) for v in value)
        if np.ndim(value)
        else tables.number(value, 4)
    )


def table_csv(result):
    """Every measure and parameter as CSV, one row each; empty where there is no number."""
    quantities = list(HEADS[result.method])
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    local = ["derivative unit"] if result.method == "local" else []
    heads = [
        h
        for q in quantities
        for h in (
            [q.replace("interval95", "low"), q.replace("interval95", "high")]
            if "interval95" in q
            else [q]
        )
    ]
    writer.writerow(["measure", "unit", "parameter", "parameter unit", "rank", *heads, *local])
    for c in result.columns:
        for rank, i in enumerate(result.order(c), start=1):
            name = result.parameters[i]
            numbers = [
                f"{v:.10g}" if np.isfinite(v) else ""
                for q in quantities
                for v in np.ravel(c.effects[q][i])
            ]
            writer.writerow(
                [
                    c.label,
                    c.unit,
                    name,
                    describe(result.case.loop, name)["unit"],
                    rank,
                    *numbers,
                    *(derivative_unit(result, c, name) for _ in local),
                ]
            )
    return out.getvalue()


def figures(result):
    """{"tornado" or "sobol": figure} with one panel for each measure that has indices, at most
    PANELS of them.
    """
    from jaxtank.plots import responses as plotting

    shown = [c for c in result.columns if not c.empty][:PANELS]
    draws = []
    for c in shown:
        order = result.order(c)
        names = [result.parameters[i] for i in order]
        felt = {q: np.asarray(c.effects[q])[order] for q in HEADS[result.method]}
        title = f"{c.label} ({tables.number(c.nominal, 4)} {c.unit})"
        draws.append(
            lambda ax, n=names, f=felt, u=c.unit, t=title: _panel(
                plotting, result.method, ax, n, f, u, t
            )
        )
    name = "sobol" if result.method == "sobol" else "tornado"
    rows = min(len(result.parameters), plotting.BARS)
    return (
        {name: plotting.panels(draws, f"{result.case.name}: {TITLES[result.method]}", rows)}
        if draws
        else {}
    )


def _panel(plotting, method, ax, names, felt, unit, title):
    if method == "local":
        return plotting.tornado(ax, names, felt["effect"], unit, title)
    if method == "morris":
        return plotting.elementary(
            ax, names, felt["mu_star"], felt["mu_star_interval95"], felt["sigma"], unit, title
        )
    return plotting.shares(
        ax,
        names,
        felt["first"],
        felt["total"],
        felt["first_interval95"],
        felt["total_interval95"],
        title,
    )


def page_of(result, drawn, command=None):
    """The page report.html of a sensitivity study, with `drawn`, the figures of `figures`; command:
    the line that made it.
    """
    first = next((c for c in result.columns if not c.empty), None)
    facts = [
        ("parameters", str(len(result.parameters))),
        ("runs", str(result.runs)),
        ("time", f"{result.wall_s:.1f} s"),
    ]
    if first is not None:
        facts.insert(
            0, (f"what moves {first.label} most", result.parameters[result.order(first)[0]])
        )
    return html.document(
        f"{result.case.name}: sensitivity",
        result.case.title,
        (
            f"{result.method}: {result.failed} runs stopped being finite"
            if result.failed
            else f"{result.method}: every run stayed finite"
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
    """Write result.json, sensitivity.csv, tornado.png or sobol.png, and report.html to `folder`;
    returns their paths.

    command: the line that made the result, for the report, where there is one.
    """
    check_folder(folder)
    files = {
        "result.json": tables.dumps(json_of(result)) + "\n",
        "sensitivity.csv": table_csv(result),
    }
    stale = artifacts.earlier(folder, ["tornado", "sobol"])
    return artifacts.write_result(
        folder, files, lambda: figures(result), lambda drawn: page_of(result, drawn, command), stale
    )
