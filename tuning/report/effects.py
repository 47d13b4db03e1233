"""The report of a sensitivity study: text, JSON, CSV, picture, page and folder."""

import csv
import dataclasses
import functools
import io

import numpy as np

from jaxtank.core.tree import describe, get_value
from tuning.problem import provenance
from tuning.problem.wording import count
from tuning.report.document import Report, Text, figures_of
from tuning.report.folder import earlier
from tuning.report.folder import save as save_all
from tuning.report.tables import Table, Value, clean, number
from tuning.report.uncertainty import in_words
from tuning.uncertainty.distributions import Correlated, Normal
from tuning.uncertainty.sensitivity_study import NORMAL_WIDTH

PANELS = 12
"""Measures in the picture."""

SHOWN = 8
"""Parameters in the table of a measure."""

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
        f" (half its range; {NORMAL_WIDTH:g} standard deviations of a normal one); tied entries"
        " have one effect together and no derivative each; there is no percentage of a measure that"
        " is 0; where a measure is not differentiable (total variation of a constant input, a"
        " maximum reached twice) the derivative is one-sided"
    ),
    "morris": (
        "mu: mean change of the measure over the whole range of the parameter, at random values of"
        " the others; mu*: mean size of it; sigma: its standard deviation (large where it interacts"
        " or the response is curved); intervals of Student"
    ),
    "sobol": (
        "first: share of the variance that the parameter has alone; total: with all its"
        " interactions; intervals by bootstrap"
    ),
}
LEFT_OUT = {
    "local": "",
    "morris": "steps that begin or end there are left out",
    "sobol": "their base points are left out, so shares are those among the others",
}


def per(unit, of):
    """Return the unit of a derivative: of a measure in `unit` by a parameter in the unit `of`."""
    return unit if of == "-" else f"{'1' if unit == '-' else unit} per {of}"


def derivative_unit(result, c, name):
    """The unit of the derivative of a Column by a parameter."""
    return per(c.unit, describe(result.case.loop, name)["unit"])


def _heads(method, unit):
    """Headings of the table of a measure in `unit`: what is in that unit says so."""
    shares = {"elasticity", "derivative"} if method == "local" else set(HEADS["sobol"])
    return [head if q in shares else f"{head} [{unit}]" for q, head in HEADS[method].items()]


def notes_of(result):
    """Return sentences on the numbers: what they are, what was left out, where samples are few."""
    found = [WORDS[result.method], *result.notes]
    if result.failed:
        found.append(f"{result.failed} of {count(result.runs, 'run')} diverged")
    if result.method != "local":
        found += _left_out(result)
    else:
        reasons = dict.fromkeys(c.reason for c in result.columns if c.reason)
        found += [f"-: {reason}" for reason in reasons]
    if result.method == "sobol":
        found += _precision(result)
    return found


def _left_out(result):
    """Sentences on runs in which a measure is not finite."""
    bad = [f"{c.label} {c.not_finite}" for c in result.columns if c.not_finite]
    if not bad:
        return []
    listed = ", ".join(bad)
    found = [f"runs in which a measure is not finite: {listed}; {LEFT_OUT[result.method]}"]
    short = [c.label for c in result.columns if not c.empty and c.reason]
    if short:
        found.append(f"too few finite steps for some parameters: {', '.join(short)}")
    return found


def _precision(result):
    """Sentences on the base points of Sobol's method and the widest interval."""
    found = []
    fewest = min((c.effects["kept"] for c in result.columns), default=result.samples)
    if fewest < result.samples:
        found.append(f"base points used, at the measure with fewest: {fewest} of {result.samples}")
    intervals = [c.effects["total_interval95"] for c in result.columns if not c.empty]
    widest = max((np.ptp(v, axis=1).max() for v in intervals), default=0.0)
    if widest > WIDE:
        found.append(
            f"the widest interval of a total share is {widest:.2g}: more --samples narrow it"
        )
    return found


def report(result, drawn=None):
    """Return the Report of a SensitivityResult."""
    varied = ", ".join(f"{n} {in_words(d)}" for n, d in result.distributions.items())
    facts = [
        ("parameters", len(result.parameters)),
        ("runs", result.runs),
        ("time", f"{result.wall_s:.1f} s"),
    ]
    first = next((c for c in result.columns if not c.empty), None)
    if first is not None:
        most = result.parameters[result.order(first)[0]]
        facts.insert(0, (f"{first.label} is most sensitive to", most))
    diverged = f"{count(result.failed, 'run')} diverged"
    title = TITLES[result.method]
    captions = dict.fromkeys(drawn or {}, f"{title[0].upper()}{title[1:]}.")
    return Report(
        f"{result.case.name}: sensitivity",
        f"{result.method}: {diverged if result.failed else 'every run is finite'}",
        facts,
        [
            Text([_headline(result)], on="terminal"),
            Text([f"varied: {varied}"]),
            *(section for c in result.columns for section in _column(result, c)),
            Text(notes_of(result), items=True, gap=True),
            *figures_of(drawn or {}, captions),
        ],
        not result.failed,
        result.case.title,
    )


def _headline(result):
    """The case, the method, and what it took."""
    samples = ""
    if result.samples is not None:
        kind = "trajectories" if result.method == "morris" else "base points"
        samples = f", {result.samples} {kind}"
    runs = count(result.runs, "run") + (" with derivatives" if result.method == "local" else "")
    return (
        f"{result.case.name}: sensitivity, {result.method}{samples}, {runs}, {result.failed} not"
        f" finite, seed {result.seed}, {result.wall_s:.1f} s"
    )


def _column(result, c):
    """The most influential parameters of a Column, under its title."""
    title = f"{c.label} [{c.unit}], {number(c.nominal)} in the case's own run"
    if c.empty:
        return [Text([f"{title}: no indices, {c.reason}"], gap=True)]
    rows = [[result.parameters[i], *_cells(result, c, i)] for i in result.order(c)[:SHOWN]]
    notes, more = [], len(result.parameters) - len(rows)
    if more > 0:
        notes.append(f"and {count(more, 'more parameter')}, each of less influence")
    if result.method == "sobol":
        total = np.sum(c.effects["first"])
        notes.append(f"first-order shares sum to {total:.3f} (1 without interactions)")
    heads = ["parameter", *_heads(result.method, c.unit)]
    return [Text([title], gap=True), Table(rows, heads), Text(notes)]


def _cells(result, c, i):
    """The cells of parameter `i`; a derivative with its unit, which differs from row to row."""
    unit = derivative_unit(result, c, result.parameters[i])
    units = {"derivative": unit} if result.method == "local" else {}
    effects = {q: c.effects[q][i] for q in HEADS[result.method]}
    return [
        Value(v, 3, between=" : ") if np.ndim(v) else Value(v, 4, units.get(q, ""))
        for q, v in effects.items()
    ]


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
        "parameters": {n: _parameter_json(result, n) for n in result.parameters},
        "measures": {c.label: _column_json(result, c) for c in result.columns},
        "notes": notes_of(result),
        "wall_s": result.wall_s,
        "provenance": provenance.provenance(result.case, result.seed),
    }


def _parameter_json(result, name):
    found = {
        "value": clean(np.asarray(get_value(result.case.loop, name))),
        "unit": describe(result.case.loop, name)["unit"],
    }
    if result.half_width:
        words = _width_in_words(result, name)
        found |= {"half_width": result.half_width[name], "half_width_is": words}
    return found


def _width_in_words(result, label):
    for name, d in result.distributions.items():
        if label in getattr(d, "names", (name,)) or label.split("[")[0] == name:
            normal = isinstance(d, (Normal, Correlated))
            width = f"{min(NORMAL_WIDTH, d.cut):g} standard deviations" if normal else ""
            return width or "half the range"
    return ""


def _column_json(result, c):
    extra, rows = {}, {}
    if result.method == "sobol":
        extra = {
            "sd": clean(float(c.effects["sd"])),
            "sum_of_first": clean(float(np.sum(c.effects["first"]))),
            "base_points_used": int(c.effects["kept"]),
        }
    for i in result.order(c):
        name = result.parameters[i]
        rows[name] = row = {q: clean(c.effects[q][i]) for q in HEADS[result.method]}
        if result.method == "local":
            row["derivative_unit"] = derivative_unit(result, c, name)
        if result.method == "morris":
            row["mu_interval95"] = clean(c.effects["mu_interval95"][i])
            row["effects_used"] = int(c.effects["kept"][i])
    return {
        "measure": c.measure,
        "unit": c.unit,
        "nominal": clean(c.nominal),
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
    title = f"{c.label} ({number(c.nominal, 4)} {unit})"
    if method == "local":
        return plotting.tornado(ax, names, effects["effect"], unit, title)
    if method == "morris":
        size, spread = effects["mu_star"], effects["sigma"]
        interval = effects["mu_star_interval95"]
        return plotting.elementary(ax, names, size, interval, spread, unit, title)
    shares = [effects[q] for q in ("first", "total", "first_interval95", "total_interval95")]
    return plotting.shares(ax, names, *shares, title)


def table_csv(result):
    """Return every measure and parameter as CSV, one row each; empty where there is no number."""
    quantities, heads = list(HEADS[result.method]), []
    for q in quantities:
        ends = ("low", "high") if "interval95" in q else ()
        heads += [q.replace("interval95", end) for end in ends] or [q]
    local = ["derivative unit"] if result.method == "local" else []
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(["measure", "unit", "parameter", "parameter unit", "rank", *heads, *local])
    for c in result.columns:
        for rank, i in enumerate(result.order(c), start=1):
            name = result.parameters[i]
            values = np.concatenate([np.ravel(c.effects[q][i]) for q in quantities])
            numbers = [f"{v:.10g}" if np.isfinite(v) else "" for v in values]
            unit = describe(result.case.loop, name)["unit"]
            more = [derivative_unit(result, c, name) for _ in local]
            writer.writerow([c.label, c.unit, name, unit, rank, *numbers, *more])
    return out.getvalue()


def save(result, folder, command=None):
    """Write result.json, sensitivity.csv, tornado.png or sobol.png, and report.html to `folder`."""
    files, stale = {"sensitivity.csv": table_csv(result)}, earlier(folder, ["tornado", "sobol"])
    draw, page = lambda: figures(result), lambda drawn: report(result, drawn)
    return save_all(folder, json_of(result), files, draw, page, command, stale)
