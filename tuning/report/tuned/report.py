"""The report of a tuning result: text, JSON, page and folder."""

import warnings
from pathlib import Path

import numpy as np

from jaxtank.core.files import check_folder
from jaxtank.loop.trajectory import csv
from tuning.report import html
from tuning.report.artifacts import earlier, rig_text, run_for_people, write_result
from tuning.report.panel import panel
from tuning.report.tables import clean, cost_unit, dumps, measures_json, number, reasons, units
from tuning.report.tuned import answer
from tuning.report.tuned.figures import CAPTIONS, figures, result_key
from tuning.report.tuned.tables import parts_of, scenario_rows
from tuning.search.result import Message


def json_of(result):
    """The JSON object of `jaxtank tune --json`."""
    return {
        "case": result.tuned.name,
        "method": result.method,
        "success": result.success,
        "status": str(result.status),
        "headline": result.headline,
        "message": result.message,
        "messages": [{"code": m.code, "text": m.text} for m in result.messages],
        "parameters": {n: {**clean(p), "interval": None} for n, p in result.parameters.items()},
        "interval_reason": "no measurements were fitted, so there is no confidence interval",
        "objective": {k: clean(result.objective[k]) for k in ("before", "after", "terms")},
        "measures": {
            "before": measures_json(result.measures["before"]),
            "after": measures_json(result.measures["after"]),
        },
        "reasons": {**reasons(result.measures["before"]), **reasons(result.measures["after"])},
        "units": units(result.tuned.loop.units),
        "constraints": clean([c.to_json() for c in result.constraints]),
        "evaluations": result.evaluations,
        "scenarios": scenario_rows(result),
        "starts": clean(result.starts),
        "symmetry": clean(result.symmetry),
        "choices": clean(result.choices),
        "optimality": clean(result.optimality),
        "slopes": {where: check.to_json() for where, check in result.slopes.items()},
        "curvature": clean(result.curvature),
        "tradeoff": clean(result.tradeoff),
        "certificate": None if result.certificate is None else result.certificate._asdict(),
        "wall_s": result.wall_s,
        **answer.json_parts(result),
        "bound": None if result.bound is None else clean(result.bound.to_json()),
        "validation": clean(result.validation),
        "provenance": result.provenance,
    }


def lines(result):
    """Return what is printed of a TuningResult: lines and Tables."""
    if result.answer is not None:
        return answer.lines_of(result)
    return [*parts_of(result), "\n".join(f"- {m.text}" for m in result.messages)]


def _facts(result, broken):
    """(name, number) of what stands at the top of the page; broken : limits that are violated."""
    # Of a default answer the errors in the unit of the levels, unless the user has minimised
    # something else.
    unit = cost_unit(result).replace("-", "")
    before, after = result.objective["before"], result.objective["after"]
    held = f"{len(result.constraints) - broken} of {len(result.constraints)} hold"
    own = [
        ("objective before", f"{number(before)} {unit}".strip()),
        ("objective after", f"{number(after)} {unit}".strip()),
    ]
    if result.answer and not result.answer.setting.own_objective:
        own = answer.facts_of(result.answer) or own
    facts = [
        *own,
        ("limits", held if result.constraints else "none"),
        ("gains tuned", str(sum(p["exercised"] for p in result.parameters.values()))),
        ("simulations", str(result.evaluations["simulations"])),
        ("time", f"{result.wall_s:.1f} s"),
    ]
    kept = result.validation["limits_held"] if result.validation else {}
    if result.answer and result.constraints and None not in kept.values():
        shares = " -> ".join(f"{100 * share:.3g} %" for share in kept.values())
        facts[2] = ("plants that keep every limit", shares)
    elif np.isfinite(before) and before and not broken:
        facts.insert(2, ("change", f"{100 * (after / before - 1):+.3g} %"))
    return facts


def page_of(result, drawn, command=None):
    """The page report.html of a tuning result, with `drawn`, the figures of `figures`; command: the
    line that made it.
    """
    broken, (rig, _) = [c for c in result.constraints if c["margin"] < 0], rig_of(result)
    return html.document(
        f"{result.tuned.name}: tuned",
        result.case.title,
        result.headline.replace("_", " ")
        + ("; every limit holds" if result.constraints and not broken else ""),
        result.success,
        _facts(result, len(broken)),
        [m.text for m in result.messages],
        html.drawings(drawn, CAPTIONS),
        (answer.parts_of(result) if result.answer else parts_of(result))[1:],
        command,
        result.provenance,
        {"The tuned rig as a file (rig.toml)": rig} if rig else None,
        panel(result),
    )


def rig_of(result):
    """Return (text of rig.toml, None), or (None, why there is none and what to set in Python)."""
    text, why = rig_text(result.tuned)
    if why is None:
        return text, None
    gains = ", ".join(f"{n} = {p['after']!r} {p['unit']}" for n, p in result.parameters.items())
    return None, f"{why}; set in Python what was tuned: {gains}"


def save(result, folder, command=None):
    """Write result.json, rig.toml, trajectory.csv, to `folder`, all or none, then PNG pictures and
    report.html; returns their paths.
    """
    check_folder(folder)
    folder = Path(folder)
    rig, why = rig_of(result)
    if why:
        warnings.warn(why, stacklevel=3)  # the line that called result.save
        result = result.replace(messages=(*result.messages, Message("no-rig-file", why)))
    key = result_key(result)
    runs = {"before": run_for_people(result.case, key), "after": run_for_people(result.tuned, key)}
    files = {
        "result.json": dumps(json_of(result)) + "\n",
        **({"rig.toml": rig} if rig else {}),
        "trajectory.csv": csv(runs["after"], result.tuned.loop.units),
        "before.csv": csv(runs["before"], result.case.loop.units),
    }
    stale = earlier(folder, CAPTIONS)
    if not rig and (folder / "result.json").is_file():
        # of another result: its gains must not be taken for these
        stale.append(folder / "rig.toml")
    return write_result(
        folder,
        files,
        lambda: figures(result, runs),
        lambda drawn: page_of(result, drawn, command),
        stale,
    )
