"""The report of a sensitivity study: text, JSON, CSV, picture, page and folder."""

import dataclasses
from typing import NamedTuple

import numpy as np

from jaxtank.core.text import count
from jaxtank.core.tree import describe, get_value
from tuning.problem import provenance
from tuning.report import advice, verdict as verdicts
from tuning.report.document import Report, Text
from tuning.report.tables import Table, Value, clean, csv_text, fields, number
from tuning.report.uncertainty import in_words
from tuning.report.verdict import shown
from tuning.uncertainty.distributions import Correlated, Normal
from tuning.uncertainty.sensitivity_study import NORMAL_WIDTH, RANKED_BY

WIDE = 0.2  # width of an interval of a variance's share that asks for more samples [-]
LISTED = 8  # parameters in the table of a measure
PANELS = 12  # measures in the picture


class Method(NamedTuple):
    """How the results of a method are reported; heads: {quantity: column of its table}."""

    title: str
    words: str
    heads: dict[str, str]
    left_out: str = ""
    samples: str = ""


METHODS = {
    "local": Method(
        "change of each measure for the half-width of each parameter, by derivatives",
        "effect: derivative at the case's own values times the half-width of the distribution"
        f" (half its range; {NORMAL_WIDTH:g} standard deviations of a normal one); tied entries"
        " have one effect together and no derivative each; there is no percentage of a measure that"
        " is 0; where a measure is not differentiable (total variation of a constant input, a"
        " maximum reached twice) the derivative is one-sided",
        {"effect": "effect", "derivative": "derivative", "elasticity": "% per %"},
    ),
    "morris": Method(
        "elementary effects of each parameter on each measure (Morris)",
        "mu: mean change of the measure over the whole range of the parameter, 1.5 times that"
        " between quantiles two thirds apart, at random values of the others; mu*: mean size of it;"
        " sigma: its standard deviation (large where it interacts or the response is curved);"
        " intervals of Student",
        {"mu_star": "mu*", "mu_star_interval95": "95 % interval", "mu": "mu", "sigma": "sigma"},
        "steps that begin or end there are left out",
        "trajectories",
    ),
    "sobol": Method(
        "shares of the variance of each measure (Sobol)",
        "first: share of the variance that the parameter has alone; total: with all its"
        " interactions; intervals by bootstrap",
        {
            **{"first": "first", "first_interval95": "95 % interval"},
            **{"total": "total", "total_interval95": "95 % interval"},
        },
        "their base points are left out, so shares are those among the others",
        "base points",
    ),
}


def per(unit, of):
    """Return the unit of a derivative: of a measure in `unit` by a parameter in the unit `of`."""
    return unit if of == "-" else f"{'1' if unit == '-' else unit} per {of}"


def derivative_unit(result, c, name):
    return per(c.unit, describe(result.case.loop, name)["unit"])


def notes_of(result):
    """Return sentences on the numbers: meaning, omitted parameters, too few samples."""
    method, columns = METHODS[result.method], result.columns
    notes = [method.words, *result.notes]
    if result.failed:
        notes.append(f"{result.failed} of {count(result.runs, 'run')} diverged")
    if result.method == "local":
        return notes + [f"-: {why}" for why in dict.fromkeys(c.reason for c in columns) if why]
    if bad := ", ".join(f"{c.label} {c.not_finite}" for c in columns if c.not_finite):
        notes.append(f"runs in which a measure is not finite: {bad}; {method.left_out}")
        if short := [c.label for c in columns if not c.empty and c.reason]:
            notes.append(f"too few finite steps for some parameters: {', '.join(short)}")
    return notes + (_sobol_notes(result) if result.method == "sobol" else [])


def _sobol_notes(result):
    notes, columns = [], result.columns
    fewest = min((c.effects["kept"] for c in columns), default=result.samples)
    if fewest < result.samples:
        where = "base points used, at the measure with fewest"
        notes.append(f"{where}: {fewest} of {result.samples}")
    intervals = [c.effects["total_interval95"] for c in columns if not c.empty]
    widest = max((np.ptp(v, axis=1).max() for v in intervals), default=0.0)
    if widest > WIDE:
        words = f"the widest interval of a total share is {widest:.2g}"
        notes.append(f"{words}: more --samples narrow it")
    return notes


def report(result):
    varied = ", ".join(f"{n} {in_words(d)}" for n, d in result.distributions.items())
    samples, runs = METHODS[result.method].samples, count(result.runs, "run")
    samples = f", {result.samples} {samples}" if samples else ""
    derivatives = " with derivatives" if result.method == "local" else ""
    case, time, advised = result.case, f"{result.wall_s:.1f} s", advice_of(result)
    head = (
        f"{case.name}: sensitivity, {result.method}{samples}, {runs}{derivatives},"
        f" {result.failed} not finite, seed {result.seed}, {time}"
    )
    facts = [("parameters", len(result.parameters)), ("runs", result.runs), ("time", time)]
    sections = [
        Text([head], on="terminal"),
        Text([f"varied: {varied}"]),
        *(section for c in result.columns for section in _column(result, c)),
        Text(notes_of(result), items=True, gap=True),
    ]
    verdict = verdict_of(result)
    return Report(case.name, "sensitivity", verdict, facts, sections, case.title, advice=advised)


def advice_of(result):
    columns = [c for c in result.columns if _first(result, c)]
    if not columns:
        return advice.Advice(
            f"Nothing to set: {_none(result)}.",
            f"It gives: no effect in {count(result.runs, 'run')}.",
            "Setpoints out of reach of every gain were not studied here.",
        )
    quantity = RANKED_BY[result.method]
    effects: dict[str, list[str]] = {}  # of the first parameter of each measure
    for c in columns:
        first = result.order(c)[0]
        size = abs(float(c.effects[quantity][first]))
        words = f"{c.label} by {shown(size)} of {advice.amount(c.nominal, c.unit)}"
        if result.method == "sobol":
            words = f"{c.label} with {advice.amount(100 * size, '%')} of its variance"
        effects.setdefault(result.parameters[first], []).extend([words] if size else [])
    moves = [f"{name} moves {advice.listed(words)}" for name, words in effects.items() if words]
    gains = [n for n in result.parameters if n.split(".")[0] in ("controller", "observer")]
    varied = f"{len(gains)} of {count(len(result.parameters), 'parameter')} are gains"
    return advice.Advice(
        f"Nothing to set; know these parameters best: {advice.listed(list(effects))}.",
        f"Within its spread {advice.listed(moves) or 'no parameter moves a measure'}.",
        f"The effects of the rig's parameters ({varied if gains else 'no gain was varied'}) become"
        " smaller by a measurement (jaxtank identify) or by other equipment only.",
    )


def _first(result, c):
    """The parameter with the largest effect on a Column; None where there is none."""
    if c.empty:
        return None
    i = result.order(c)[0]
    return result.parameters[i] if c.effects[RANKED_BY[result.method]][i] != 0.0 else None


def _none(result):
    """A sentence on measures without an effect."""
    if result.method != "local":
        return "no measure depends on a parameter"
    return (
        "no measure changes with a parameter at the case's values, to first order (--method sobol"
        " varies them over their spread)"
    )


def verdict_of(result):
    first = {c.label: name for c in result.columns if (name := _first(result, c))}
    words = [f"{label} is most sensitive to {name}" for label, name in first.items()]
    if result.failed:
        words.insert(0, f"{count(result.failed, 'run')} diverged")
    words = words or [_none(result)]
    return verdicts.outcome("; ".join(words), not result.failed)


def _column(result, c):
    """The most influential parameters of a Column, under its title."""
    title = f"{c.label} [{c.unit}], {number(c.nominal)} in the case's own run"
    if c.empty:
        return [Text([f"{title}: no indices, {c.reason}"], gap=True)]
    rows, quantities = [], METHODS[result.method].heads
    for i in result.order(c)[:LISTED]:
        name = result.parameters[i]
        rows.append([name])
        for q in quantities:
            v, unit = c.effects[q][i], derivative_unit(result, c, name) * (q == "derivative")
            rows[-1].append(Value(v, 3, between=" : ") if np.ndim(v) else Value(v, 4, unit))
    notes, more = [], len(result.parameters) - len(rows)
    if more > 0:
        notes.append(f"and {count(more, 'more parameter')}, each of less influence")
    shares = {"elasticity", "derivative"}  # quantities that are not in the unit of the measure
    if result.method == "sobol":
        total, shares = np.sum(c.effects["first"]), {*METHODS["sobol"].heads}
        notes.append(f"first-order shares sum to {total:.3f} (1 without interactions)")
    heads = [head if q in shares else f"{head} [{c.unit}]" for q, head in quantities.items()]
    return [Text([title], gap=True), Table(rows, ["parameter", *heads]), Text(notes)]


def json_of(result):
    distributions = {}
    for name, d in result.distributions.items():
        settings = {k: v for k, v in dataclasses.asdict(d).items() if v is not None}
        distributions[name] = {"kind": type(d).__name__, **settings}
    loop, parameters = result.case.loop, {}
    for name in result.parameters:
        row = {"value": clean(np.asarray(get_value(loop, name)))}
        parameters[name] = row | {"unit": describe(loop, name)["unit"]}
        if result.half_width:
            row = {"half_width": result.half_width[name], "half_width_is": _width(result, name)}
            parameters[name] |= row
    return {
        "case": result.case.name,
        "verdict": verdict_of(result).to_json(),
        "advice": list(advice_of(result)),
        **fields(result, "method samples runs failed wall_s"),
        "distributions": distributions,
        "parameters": parameters,
        "measures": {c.label: _column_json(result, c) for c in result.columns},
        "notes": notes_of(result),
        "provenance": provenance.provenance(result.case, result.seed),
    }


def _width(result, label):
    for name, d in result.distributions.items():
        if label in getattr(d, "names", (name,)) or label.split("[")[0] == name:
            if isinstance(d, (Normal, Correlated)):
                return f"{min(NORMAL_WIDTH, d.cut):g} standard deviations"
            return "half the range"
    return ""


def _column_json(result, c):
    entry, rows = {**fields(c, "measure unit nominal not_finite"), "reason": c.reason or None}, {}
    if result.method == "sobol":
        entry |= {"sd": clean(float(c.effects["sd"])), "base_points_used": int(c.effects["kept"])}
        entry["sum_of_first"] = clean(float(np.sum(c.effects["first"])))
    for i in result.order(c):
        name = result.parameters[i]
        rows[name] = row = {q: clean(c.effects[q][i]) for q in METHODS[result.method].heads}
        if result.method == "local":
            row["derivative_unit"] = derivative_unit(result, c, name)
        if result.method == "morris":
            row["mu_interval95"] = clean(c.effects["mu_interval95"][i])
            row["effects_used"] = int(c.effects["kept"][i])
    return {**entry, "parameters": rows}


def figures(result):
    """Return {"tornado" or "sobol": Figure} with a panel for each measure, at most PANELS."""
    from jaxtank.plots import responses as plots

    columns = [c for c in result.columns if not c.empty][:PANELS]
    if not columns:
        return {}

    def panel(ax, c):
        order, title = result.order(c), f"{c.label} ({number(c.nominal, 4)} {c.unit})"
        names = [result.parameters[i] for i in order]
        effects = {q: np.asarray(c.effects[q])[order] for q in METHODS[result.method].heads}
        if result.method == "local":
            return plots.tornado(ax, names, effects["effect"], c.unit, title)
        if result.method == "morris":
            size, ends, spread = (effects[q] for q in ("mu_star", "mu_star_interval95", "sigma"))
            return plots.elementary(ax, names, size, ends, spread, c.unit, title)
        first, total = ((effects[q], effects[f"{q}_interval95"]) for q in ("first", "total"))
        return plots.shares(ax, names, first, total, title)

    name = "sobol" if result.method == "sobol" else "tornado"
    rows = min(len(result.parameters), plots.BARS)
    title = f"{result.case.name}: {METHODS[result.method].title}"
    return {name: plots.panels([lambda ax, c=c: panel(ax, c) for c in columns], title, rows)}


def captions_of(result):
    title = METHODS[result.method].title
    return dict.fromkeys(("tornado", "sobol"), f"{title[0].upper()}{title[1:]}.")


def files_of(result):
    quantities, heads = list(METHODS[result.method].heads), []
    for q in quantities:
        ends = ("low", "high") if "interval95" in q else ("interval95",)
        heads += [q.replace("interval95", end) for end in ends]
    local = ["derivative unit"] if result.method == "local" else []
    rows = [["measure", "unit", "parameter", "parameter unit", "rank", *heads, *local]]
    for c in result.columns:
        for rank, i in enumerate(result.order(c), start=1):
            name = result.parameters[i]
            values = np.concatenate([np.ravel(c.effects[q][i]) for q in quantities])
            numbers = np.where(np.isfinite(values), values, np.nan)
            unit = describe(result.case.loop, name)["unit"]
            more = [derivative_unit(result, c, name) for _ in local]
            rows.append([c.label, c.unit, name, unit, rank, *numbers, *more])
    return {"sensitivity.csv": csv_text(rows)}
