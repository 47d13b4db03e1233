"""The report of an InputBound: text, JSON, the response to the optimal inputs, files."""

import io

import jax
import numpy as np

from tuning.problem import provenance
from tuning.report.document import Report, Text, figures_of
from tuning.report.folder import save as save_all
from tuning.report.tables import Table, Value, clean, number

NOTE = (
    "a numerical optimum of a problem with more than one, on a grid of inputs, for a run known in"
    " advance and without noise: not a certificate"
)
CAPTIONS = {"responses": "Levels and inputs of the run with the optimal inputs."}


def report(bound, drawn=None):
    """Return the Report of an InputBound."""
    terms = " + ".join(f"{w:g} {m}" if w != 1 else m for m, w in bound.objective.items())
    rows = [
        [Value(g["interval_s"], 6), Value(g["cost"], 6), f"{g['excess']:.1e}"] for g in bound.grids
    ]
    first = [
        f"perfect-information open-loop optimum: {terms} = {number(bound.cost, 6)} with the best"
        f" inputs found, each held for {bound.interval:g} s ({len(bound.u)} intervals)",
        *_comparison(bound),
    ]
    if bound.worst is not None:
        worst, held = bound.worst, "held" if bound.holds else "NOT HELD"
        when = "" if worst["time_s"] is None else f" at {worst['time_s']:.2f} s"
        first.append(
            f"limits {held}; tightest: {worst['name']} {worst['value']:.6g} against"
            f" {worst['limit']:g}{when}"
        )
    last = (
        f"largest free slope {bound.slope:.1e}; {bound.gradients} gradients, {bound.simulations}"
        f" simulations, {bound.wall_s:.1f} s" + "; INTERRUPTED" * bound.interrupted
    )
    grids = [Table(rows, ["interval [s]", "cost", "excess over limits"])] if rows else []
    return Report(
        f"{bound.case.name}: perfect-information open-loop optimum",
        "limits held" if bound.holds else "limits not held",
        [("cost", Value(bound.cost, 6)), ("intervals", len(bound.u))],
        [Text(first), *grids, Text([last, NOTE]), *figures_of(drawn or {}, CAPTIONS)],
        bound.holds,
    )


def _comparison(bound):
    """Return sentences: the case's own controller beside the optimum."""
    if bound.closed_loop is None:
        return ["the run of the case's own controller diverges"]
    gain, cost = bound.gain_percent, bound.closed_loop["cost"]
    saving = "" if gain is None else f": another controller could save at most {gain:.3g} %"
    broken = ", which breaks a limit: the two cannot be compared"
    broken = "" if bound.closed_loop["holds"] else broken
    words = f"the case's own controller, without noise: {number(cost, 6)}{saving}{broken}"
    if bound.source != "closed loop":
        return [words]
    return [words, "no search found a lower cost than the controller: its own inputs are the bound"]


def json_of(bound):
    """Return the JSON object of an InputBound, without inputs and case."""
    return {
        "cost": bound.cost,
        "objective": bound.objective,
        "measures": clean(dict(bound.measures)),
        "constraints": bound.constraints,
        "holds": bound.holds,
        "closed_loop": bound.closed_loop,
        "gain_percent": bound.gain_percent,
        "source": bound.source,
        "interval_s": bound.interval,
        "intervals": len(bound.u),
        "grids": bound.grids,
        "slope": clean(bound.slope),
        "evaluations": {
            "simulations": bound.simulations,
            "gradients": bound.gradients,
            "iterations": bound.iterations,
        },
        "interrupted": bound.interrupted,
        "wall_s": bound.wall_s,
        "note": NOTE,
    }


def figures(bound):
    """Return {"responses": matplotlib Figure} of the run with the optimal inputs."""
    from jaxtank.plots import responses

    run = bound.trajectory(save_every=max(1, bound.case.clock.samples // 3000))
    runs = {"optimal inputs": jax.tree.map(np.asarray, run)}
    title = f"{bound.case.name}: perfect-information open-loop optimum"
    return {"responses": responses.responses(bound.case.loop, runs, title)}


def save(bound, folder, command=None):
    """Write result.json, inputs.csv, responses.png and report.html; return their paths."""
    drive, out = bound.case.loop.units[1], io.StringIO()
    heads = ["t [s]", *(f"pump{j + 1} [{drive}]" for j in range(bound.u.shape[1]))]
    rows = np.column_stack([np.arange(len(bound.u)) * bound.interval, bound.u])
    # the time from which each input is held, and the inputs
    np.savetxt(out, rows, "%.10g", ",", header=",".join(heads), comments="")
    files, made = {"inputs.csv": out.getvalue()}, provenance.provenance(bound.case, 0)
    draw, page = lambda: figures(bound), lambda drawn: report(bound, drawn)
    return save_all(folder, json_of(bound), files, draw, page, command, provenance=made)
