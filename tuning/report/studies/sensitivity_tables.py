"""Tables and notes of a sensitivity study; imported by its report."""

import csv
import dataclasses
import io

import numpy as np

from jaxtank.core.tree import describe
from tuning.problem.wording import count
from tuning.report import tables
from tuning.uncertainty.sensitivity_study import NORMAL_WIDTH

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


def parts_of(result):
    """Return what is printed of a SensitivityResult but for its notes: lines and Tables."""
    varied = ", ".join(f"{n} {_in_words(d)}" for n, d in result.distributions.items())
    parts = [_headline(result), f"varied: {varied}", ""]
    for c in result.columns:
        parts += [*_column_table(result, c), ""]
    return parts


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


def _column_table(result, c):
    """The most influential parameters of a Column, under its title."""
    title = f"{c.label} [{c.unit}], {tables.number(c.nominal)} in the case's own run"
    if c.empty:
        return [f"{title}: no indices, {c.reason}"]
    rows = [[result.parameters[i], *_cells(result, c, i)] for i in result.order(c)[:SHOWN]]
    found = [title, tables.table(rows, ["parameter", *_heads(result.method, c.unit)])]
    more = len(result.parameters) - len(rows)
    if more > 0:
        found.append(f"and {count(more, 'more parameter')}, each of less influence")
    if result.method == "sobol":
        found.append(
            f"first-order shares sum to {np.sum(c.effects['first']):.3f} (1 without interactions)"
        )
    return found


def _in_words(distribution):
    """A distribution by its fields."""
    fields = dataclasses.asdict(distribution).items()
    given = ", ".join(f"{n} {v}" for n, v in fields if v is not None and v is not False)
    return f"{type(distribution).__name__.lower()} ({given})"


def _cells(result, c, i):
    """The cells of parameter `i`; a derivative with its unit, which differs from row to row."""
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
