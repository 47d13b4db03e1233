"""The report of an Inspection: a file of experiment data before any fit."""

from typing import Any

import numpy as np

from tuning.report import verdict as verdicts
from tuning.report.document import Report, Text
from tuning.report.folder import save as save_all
from tuning.report.identification import oddities_json, sentences_on
from tuning.report.tables import Table, Value, clean, fields

MOST = 12  # columns that are drawn
CAPTIONS = {"log": "The columns of the file, over time."}


def json_of(result):
    return clean(
        {
            "file": result.name,
            "verdict": verdict_of(result).to_json(),
            "time": {"header": result.time, "samples": len(result.t), **_steps(result)},
            "columns": _columns(result),
            "log": result.table,
            "oddities": oddities_json(result.oddities),
            **fields(result, "notes problems"),
        }
    )


def _columns(result):
    return [
        {
            **fields(c, "header values=count"),
            "slot": c.slot or None,
            "unit": c.unit or None,
            "missing": len(c.values) - c.count,
            "low": np.nanmin(c.values) if c.count else None,
            "high": np.nanmax(c.values) if c.count else None,
            "step": float(np.median(np.diff(c.t))) if result.timed and len(c.t) > 1 else None,
        }
        for c in result.columns
    ]


def _steps(result) -> dict[str, Any]:
    """Return {"length", "step", "longest_step"} of the times [s]."""
    if not result.timed:
        return dict.fromkeys(("length", "step", "longest_step"))
    if len(result.t) < 2:
        return {"length": 0.0, "step": None, "longest_step": None}
    steps = np.diff(result.t)
    length = float(result.t[-1] - result.t[0])
    return {"length": length, "step": float(np.median(steps)), "longest_step": float(steps.max())}


def report(result):
    steps = _steps(result)
    pace = "" if steps["step"] is None else f", every {steps['step']:g} s"
    if steps["step"] is not None and steps["longest_step"] > 1.01 * steps["step"]:
        pace += f" (at most {steps['longest_step']:g} s apart)"
    span = (
        f" over {steps['length']:g} s{pace}" if result.timed else "; their times could not be read"
    )
    rows = []
    for c in _columns(result):
        names = [c["header"], c["slot"] or "-", c["unit"] or "-", c["values"], c["missing"]]
        ends = Value([c["low"], c["high"]], between=" .. ")
        rows.append([*names, ends, Value(c["step"], 4, "s")])
    sections = [
        Text([f"{result.name}: {len(result.t)} samples{span}"]),
        Text(sentences_on(result.oddities), items=True),
        Text(result.problems, items=True),
        Text(result.notes, items=True),
        Table(rows, ["column", "is", "unit", "values", "missing", "range", "step"], gap=True),
        Text(result.table.splitlines(), gap=True, layout=True),
    ]
    facts = [("samples", len(result.t))]
    return Report(result.name, "inspected", verdict_of(result), facts, sections)


def verdict_of(result):
    problems = result.problems
    words = f"cannot be read yet: {problems[0]}" if problems else "can be read"
    return verdicts.outcome(words, not problems)


def figures(result):
    from jaxtank.plots import fit as plots
    from jaxtank.plots.style import label_time, picture

    columns = [c for c in result.columns if c.count][:MOST]
    if not columns:
        return {}

    def draw(axes):
        for ax, column in zip(axes[:, 0], columns):
            plots.column(ax, column.t, column.values, column.slot or column.header, column.unit)
        label_time(axes[-1, 0])

    title = {"title": result.name, "sharex": True, "squeeze": False}
    return {"log": picture(draw, (7.0, 0.8 + 1.3 * len(columns)), len(columns), **title)}


def save(result, folder, command=None):
    draw, page = (lambda: figures(result)), (lambda: report(result))
    files = {"log.toml": result.table + "\n"}
    return save_all(folder, json_of(result), files, draw, page, CAPTIONS, command)
