"""The report of an InputBound: text, JSON, the response to the optimal inputs, files."""

import jax
import numpy as np

from jaxtank.core.labels import signal_units
from tuning.report import verdict as verdicts
from tuning.report.document import Report, Text
from tuning.report.simulated import responses_of
from tuning.report.tables import Table, Value, csv_text, fields, number

TITLE = "perfect-information open-loop optimum"
NOTE = (
    "a numerical optimum of a problem with more than one, on a grid of inputs, for a run known in"
    " advance and without noise: not a certificate"
)
CAPTIONS = {"responses": "Levels and inputs of the run with the optimal inputs."}


def report(bound):
    terms = " + ".join(f"{w:g} {m}" if w != 1 else m for m, w in bound.objective.items())
    rows = [
        [Value(g["interval_s"], 6), Value(g["cost"], 6), f"{g['excess']:.1e}"] for g in bound.grids
    ]
    first = [
        f"{TITLE}: {terms} = {number(bound.cost, 6)} with the best inputs found, each held for"
        f" {bound.interval:g} s ({len(bound.u)} intervals)",
        *_comparison(bound),
    ]
    if bound.worst is not None:
        worst, words = bound.worst, "held" if bound.holds else "NOT HELD"
        when = "" if worst["time_s"] is None else f" at {worst['time_s']:.2f} s"
        first.append(
            f"limits {words}; tightest: {worst['name']} {worst['value']:.6g} against"
            f" {worst['limit']:g}{when}"
        )
    last = (
        f"largest free slope {bound.slope:.1e}; {bound.gradients} gradients, {bound.simulations}"
        f" simulations, {bound.wall_s:.1f} s" + "; INTERRUPTED" * bound.interrupted
    )
    grids = [Table(rows, ["interval [s]", "cost", "excess over limits"])] if rows else []
    facts = [("cost", Value(bound.cost, 6)), ("intervals", len(bound.u))]
    sections = [Text(first), *grids, Text([last, NOTE])]
    return Report(bound.case.name, TITLE, verdict_of(bound), facts, sections)


def verdict_of(bound):
    words = "the best inputs keep every limit" if bound.holds else "the best inputs break a limit"
    return verdicts.outcome(words, bound.holds)


def _comparison(bound):
    """Return sentences: the case's own controller beside the optimum."""
    if bound.closed_loop is None:
        return ["the run of the case's own controller diverges"]
    gain, cost = bound.gain_percent, bound.closed_loop["cost"]
    saving = "" if gain is None else f": another controller could save at most {gain:.3g} %"
    if not bound.closed_loop["holds"]:
        saving += ", which violates a limit: the two cannot be compared"
    words = [f"the case's own controller, without noise: {number(cost, 6)}{saving}"]
    if bound.source == "closed loop":
        words.append("no search found a lower cost than the controller: its inputs are the bound")
    return words


def json_of(bound):
    names = "cost objective measures constraints holds closed_loop gain_percent source grids slope"
    return {
        "verdict": verdict_of(bound).to_json(),
        **fields(bound, f"{names} interrupted wall_s interval_s=interval"),
        "intervals": len(bound.u),
        "evaluations": fields(bound, "simulations gradients iterations"),
        "note": NOTE,
    }


def figures(bound):
    run = bound.trajectory(save_every=max(1, bound.case.clock.samples // 3000))
    runs = {"optimal inputs": jax.tree.map(np.asarray, run)}
    return {"responses": responses_of(bound.case, runs, f"{bound.case.name}: {TITLE}")}


def files_of(bound):
    units = signal_units(bound.case.loop.plant, bound.case.loop.units)[1:]
    heads = ["t [s]", *(f"pump{j + 1} [{unit}]" for j, unit in enumerate(units))]
    rows = np.column_stack([np.arange(len(bound.u)) * bound.interval, bound.u])
    return {"inputs.csv": csv_text([heads, *rows])}
