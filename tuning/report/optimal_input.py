"""The report of an InputBound: text, JSON, the response to the optimal inputs, files.

Opened by `tuning.bound`'s result.
"""

import io

import jax
import numpy as np

from jaxtank.core.files import check_folder
from tuning.problem import provenance
from tuning.report import artifacts, html, tables

NOTE = (
    "a numerical optimum of a problem with more than one, on a grid of inputs, for a run known in"
    " advance and without noise: not a certificate"
)
CAPTION = "Levels and inputs of the run with the optimal inputs."


def lines(found):
    """Return what is printed of an InputBound: lines and tables."""
    terms = " + ".join(f"{w:g} {m}" if w != 1 else m for m, w in found.objective.items())
    rows = [[f"{g['interval_s']:g}", f"{g['cost']:.6g}", f"{g['excess']:.1e}"] for g in found.grids]
    return [
        f"perfect-information open-loop optimum: {terms} = {found.cost:.6g} with the best inputs"
        f" found, each held for {found.interval:g} s ({len(found.u)} intervals)",
        *_comparison(found),
        *_limits(found),
        *([tables.table(rows, ["interval [s]", "cost", "excess over limits"])] if rows else []),
        f"largest free slope {found.slope:.1e}; {found.gradients} gradients,"
        f" {found.simulations} simulations, {found.wall_s:.1f} s"
        + "; INTERRUPTED"
        * found.interrupted,
        NOTE,
    ]


def _comparison(found):
    """Return sentences: the case's own controller beside the optimum."""
    if found.closed_loop is None:
        return ["the run of the case's own controller diverges"]
    gain = found.gain_percent
    saving = "" if gain is None else f": another controller could save at most {gain:.3g} %"
    broken = (
        "" if found.closed_loop["holds"] else ", which breaks a limit: the two cannot be compared"
    )
    sentences = [
        f"the case's own controller, without noise: {found.closed_loop['cost']:.6g}{saving}{broken}"
    ]
    if found.source == "closed loop":
        sentences.append(
            "no search found a lower cost than the controller: its own inputs are the bound"
        )
    return sentences


def _limits(found):
    """Return a sentence on the limits, none without limits."""
    worst = found.worst
    if worst is None:
        return []
    when = "" if worst["time_s"] is None else f" at {worst['time_s']:.2f} s"
    return [
        f"limits {'held' if found.holds else 'NOT HELD'}; tightest: {worst['name']}"
        f" {worst['value']:.6g} against {worst['limit']:g}{when}"
    ]


def json_of(found):
    """Return the JSON object of an InputBound, without inputs and case."""
    return {
        "cost": found.cost,
        "objective": found.objective,
        "measures": {m: _plain(v) for m, v in found.measures.items()},
        "constraints": found.constraints,
        "holds": found.holds,
        "closed_loop": found.closed_loop,
        "gain_percent": found.gain_percent,
        "source": found.source,
        "interval_s": found.interval,
        "intervals": len(found.u),
        "grids": found.grids,
        "slope": _plain(found.slope),
        "evaluations": {
            "simulations": found.simulations,
            "gradients": found.gradients,
            "iterations": found.iterations,
        },
        "interrupted": found.interrupted,
        "wall_s": found.wall_s,
        "note": NOTE,
    }


def _plain(value):
    """Return a number or a list of numbers; None for what is not finite."""
    value = np.asarray(value, dtype=float)
    if value.ndim:
        return [_plain(v) for v in value]
    return float(value) if np.isfinite(value) else None


def figures(found):
    """Return {"responses": matplotlib Figure} of the run with the optimal inputs."""
    from jaxtank.plots import responses

    every = max(1, found.case.clock.samples // 3000)
    run = found.trajectory(save_every=every)
    run = jax.tree.map(np.asarray, run)
    title = f"{found.case.name}: perfect-information open-loop optimum"
    return {"responses": responses.responses(found.case.loop, {"optimal inputs": run}, title)}


def inputs_csv(found):
    """Return CSV text: the time from which each input is held, and the inputs."""
    drive, out = found.case.loop.units[1], io.StringIO()
    pumps = range(found.u.shape[1])
    out.write(",".join(["t [s]", *(f"pump{j + 1} [{drive}]" for j in pumps)]) + "\n")
    t = np.arange(len(found.u)) * found.interval
    np.savetxt(out, np.column_stack([t, found.u]), delimiter=",", fmt="%.10g")
    return out.getvalue()


def save(found, folder, command=None):
    """Write result.json, inputs.csv, responses.png and report.html; return their paths."""
    check_folder(folder)
    files = {"result.json": tables.dumps(json_of(found)), "inputs.csv": inputs_csv(found)}

    def page(drawn):
        parts = lines(found)
        return html.document(
            f"{found.case.name}: perfect-information open-loop optimum",
            "",
            "limits held" if found.holds else "limits not held",
            found.holds,
            [("cost", f"{found.cost:.6g}"), ("intervals", str(len(found.u)))],
            [part for part in parts if not isinstance(part, tables.Table)],
            html.drawings(drawn, dict.fromkeys(drawn, CAPTION)),
            [part for part in parts if isinstance(part, tables.Table)],
            command,
            provenance.provenance(found.case, 0),
        )

    return artifacts.write_result(folder, files, lambda: figures(found), page)
