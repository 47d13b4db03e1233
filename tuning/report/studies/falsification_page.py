"""The report of an attack: pictures, page and folder; its text and JSON are those of
`falsification_tables`.
"""

import dataclasses
from pathlib import Path

import jax
import numpy as np

from jaxtank import rig as rigs
from jaxtank.core.files import check_folder
from jaxtank.loop import run as lp
from jaxtank.loop.trajectory import csv
from tuning.problem import provenance
from tuning.report import artifacts, html, tables
from tuning.report.studies.falsification_tables import json_of, lines, verdict

__all__ = ["figures", "json_of", "lines", "page_of", "rig_of", "runs_of", "save"]

REPRODUCED = 1e-9
"""Share of a level to which the rig file must give it again."""


def runs_of(attack):
    """Return {"nominal": Trajectory, "worst": Trajectory}, of about 3000 rows each."""
    case, original = attack.case, attack.attacked.original
    sensor = original.loop.sensor.without_noise()
    quiet = original.replace(loop=dataclasses.replace(original.loop, sensor=sensor))
    worst = case.replace(loop=attack.loop(attack.worst))
    return {"nominal": artifacts.run_for_people(quiet), "worst": artifacts.run_for_people(worst)}


def figures(attack, runs=None):
    """Return matplotlib figures {name: Figure}: "worst" run beside the nominal one, "ascent"."""
    import matplotlib.pyplot as plt

    from jaxtank.plots import responses

    runs, worst = runs or runs_of(attack), attack.worst
    limits = np.array([one.limit for one in attack.found])
    title = (
        f"{attack.case.name}: tank {worst.tank + 1} reaches {worst.level:.4g}"
        f" {attack.case.loop.units[0]}, limit {worst.limit:.4g}"
    )
    drawn = {"worst": responses.responses(attack.case.loop, runs, title, limits)}
    with responses.styled():
        figure, ax = plt.subplots(figsize=(6.0, 3.4), layout="constrained")
        for i, limit in enumerate(limits):
            ax.plot(attack.history[:, i] / limit, marker=".", label=f"tank {i + 1}")
        ax.axhline(1.0, color=responses.FORBIDDEN, linewidth=1.0, label="limit")
        ax.set(xlabel="step of the ascent", ylabel="highest level / limit [-]")
        ax.legend()
    return drawn | {"ascent": figure}


CAPTIONS = {
    "worst": "The case as it is (dashed), and the run that comes highest by its limit.",
    "ascent": "The highest level of each tank after each step of the ascent, by its limit.",
}


def page_of(attack, drawn, command=None):
    """Return the page report.html of an Attack."""
    worst, unit = attack.worst, attack.case.loop.units[0]
    return html.document(
        f"{attack.case.name}: attack",
        attack.case.title,
        verdict(attack),
        not attack.passed,
        [
            ("highest level", f"{worst.level:.5g} {unit} (tank {worst.tank + 1})"),
            ("its limit", f"{worst.limit:.5g} {unit}"),
            ("time", f"{attack.wall_s:.1f} s"),
        ],
        [],
        html.drawings(drawn, CAPTIONS),
        lines(attack),
        command,
        provenance.provenance(attack.case, attack.seed),
    )


def rig_of(attack):
    """Return (text of worst.toml or None, {"level" of its run [cm], "difference" to the level that
    was found [cm], "same": within REPRODUCED of it, "missing": what no rig file can describe}).
    """
    one = attack.worst
    text, why = artifacts.rig_text(attack.rig(one))
    missing = attack.not_in_rig(one)
    if text is None:
        return None, {"level": None, "difference": None, "same": False, "missing": [why, *missing]}
    case = rigs.loads(text)
    run, _ = lp.simulate_compiled(case.loop, case.clock, None, 1)
    level = np.asarray(run.x)[:, one.tank]
    rising = level[1:][level[1:] > level[:-1]]
    highest = float(rising.max()) if rising.size else float(level[-1])
    difference = highest - one.level
    same = abs(difference) <= REPRODUCED * one.limit
    if not same and not missing:
        missing = ["the safety filter, which is designed anew for this start"]
    return text, {"level": highest, "difference": difference, "same": same, "missing": missing}


def save(attack, folder, command=None):
    """Write result.json, worst.toml, trajectory.csv of the worst run, pictures and report.html to
    `folder`; return their paths. command: the command line that made the attack.
    """
    check_folder(folder)
    folder = Path(folder)
    text, checked = rig_of(attack)
    runs = runs_of(attack)
    files = {
        "result.json": tables.dumps({**json_of(attack), "rig": checked}) + "\n",
        "trajectory.csv": csv(jax.tree.map(np.asarray, runs["worst"]), attack.case.loop.units),
    }
    if text is not None:
        files["worst.toml"] = f"# {_head(attack, checked)}\n{text}"
    return artifacts.write_result(
        folder,
        files,
        lambda: figures(attack, runs),
        lambda drawn: page_of(attack, drawn, command),
        artifacts.earlier(folder, CAPTIONS),
    )


def _head(attack, checked):
    """The comment of worst.toml."""
    one, unit = attack.worst, attack.case.loop.units[0]
    words = f"the worst found by jaxtank attack: tank {one.tank + 1} at {one.level:.10g} {unit}"
    if checked["same"]:
        return f"{words}, which `jaxtank simulate` of this file gives again"
    return (
        f"{words}; this file gives {checked['level']:.10g} {unit}: it lacks"
        f" {', '.join(checked['missing'])}"
    )
