"""The report of an attack: text, JSON, pictures, page and folder."""

import dataclasses
import shlex
from pathlib import Path

import jax
import numpy as np

from jaxtank import rig as rigs
from jaxtank.core.files import check_folder
from jaxtank.core.tree import describe, get_value
from jaxtank.core.units import local
from jaxtank.loop import run as lp
from jaxtank.loop.trajectory import csv
from tuning.problem.wording import count
from tuning.report import artifacts, html, tables
from tuning.search import provenance

REPRODUCED = 1e-9
"""Share of a level to which the rig file must give it again."""

BOUND = (
    "What an attack finds is a lower bound of the worst: a limit that is not passed here may be"
    " passed by a plant that was not tried, unless it is proved (jaxtank show)."
)


def json_of(attack):
    """The JSON object of `jaxtank attack --json`."""
    case, attacked = attack.case, attack.attacked
    return {
        "case": case.name,
        "passed": bool(attack.passed),
        "worst": [_row(attack, one) for one in attack.found],
        "unit": case.loop.units[0],
        "safety_filter": case.loop.safety_filter is not None,
        "coefficients": {
            c.name: {"nominal": c.nominal, "low": c.low, "high": c.high, "varies": c.varies}
            for c in attacked.coefficients
        },
        "windows": attacked.windows,
        "reading_band": tables.clean(attacked.band),
        "pumps": attacked.pumps,
        "start": attacked.start,
        "starts": attack.starts,
        "draws": attack.draws,
        "history": tables.clean(attack.history),
        "remarks": remarks_of(attack),
        "wall_s": attack.wall_s,
        "provenance": provenance.provenance(case, attack.seed),
    }


def _row(attack, one):
    """The JSON object of one tank."""
    return tables.clean(
        {
            "tank": one.tank + 1,
            "level": one.level,
            "limit": one.limit,
            "time_s": one.time_s,
            "parameters": attack.parameters(one),
            "margin": one.margin,
            "passed": one.passed,
            "certified": one.certified,
            "why": one.reason or None,
            "nominal": one.nominal,
            "drawn": one.drawn,
            "rise_between_samples": one.rise,
        }
    )


def remarks_of(attack):
    """Return sentences that the figures need."""
    unit = attack.case.loop.units[0]
    found, rises = [], [one.rise for one in attack.found if np.isfinite(one.rise)]
    if rises:
        found.append(
            f"Levels are those at the samples; between two samples a level can rise by at most"
            f" {max(rises):.3g} {unit} (b_max u_max dt, and what flows in from other tanks)."
        )
    if attack.attacked.physical_rims:
        found.append(
            "The rims of this rig are physics: no level passes them, and the rest overflows. The"
            " attack is on the same rig without overflow, whose levels show what would overflow."
        )
    if outside := _outside(attack):
        found.append(
            f"The intervals of {', '.join(outside)} are wider than those that the safety filter"
            " was designed for: nothing is proved there."
        )
    guard = attack.case.loop.safety_filter
    if guard is not None and np.any(attack.attacked.band > np.asarray(guard.band) * (1.0 + 1e-12)):
        bands = (attack.attacked.band, np.asarray(guard.band))
        wide, band = (", ".join(f"{v:.3g}" for v in values) for values in bands)
        found.append(
            f"Readings may be off by ({wide}) {unit}, more than the band ({band}) {unit} of the"
            " safety filter: nothing is proved of such readings."
        )
    return [*found, BOUND]


def _outside(attack):
    """Names of coefficients of the plant whose interval reaches beyond the filter's box."""
    guard = attack.case.loop.safety_filter
    if guard is None:
        return []
    found = []
    for c in attack.attacked.coefficients:
        if c.name.startswith("plant."):
            name = c.name.removeprefix("plant.")
            least, most = (float(get_value(p, name)) for p in (guard.least, guard.most))
            slack = 1e-12 * abs(c.nominal)
            if c.low < least - slack or c.high > most + slack:
                found.append(c.name)
    return found


def lines(attack):
    """Return what is printed of an Attack: lines and Tables."""
    worst = attack.worst
    found = [
        f"{attack.case.name}: attack from {count(attack.draws, 'draw')}, ascent of"
        f" {count(attack.starts, 'start')} for each tank in {len(attack.history) - 1} steps (seed"
        f" {attack.seed}), {attack.wall_s:.1f} s",
        *_scope(attack),
        "",
        _table(attack),
        "",
        _verdict(attack),
        "",
        f"The run that brings tank {worst.tank + 1} highest by its limit:",
        _parameters(attack, worst),
        "",
        f"as options: {settings(attack, worst)}",
    ]
    if attack.case.loop.safety_filter is not None:
        found.append(
            "(--set also moves the intervals that the safety filter is designed for; worst.toml of"
            " --out keeps them, as faults of the nominal plant)"
        )
    return [*found, "", *(f"- {line}" for line in remarks_of(attack))]


def _scope(attack):
    """Lines on what the attack may change."""
    attacked, loop = attack.attacked, attack.case.loop
    clock, varying = attack.case.clock, attacked.shapes["varying"][0]
    words = [f"{count(len(attacked.coefficients), 'coefficient')} in their intervals"]
    if attacked.windows > 1 and varying:
        words.append(
            f"{varying} of them with a value of its own in each of {attacked.windows} windows of"
            f" {(clock.duration + clock.dt) / attacked.windows:.4g} s"
        )
    words.append("any start up to the limits" if attacked.start == "any" else "the case's start")
    if "bias" in attacked.shapes:
        band = ", ".join(f"{b:.3g}" for b in attacked.band)
        kind = "at each sample" if "noise" in attacked.shapes else "constant"
        words.append(f"reading errors ({kind}) within +-({band}) {loop.units[0]}")
    pumps = {
        "own": "the case's controller",
        "full": "pumps at full command",
        "random": "pumps that switch",
    }[attacked.pumps]
    guard = "with the safety filter" if loop.safety_filter is not None else "no safety filter"
    return [f"over: {', '.join(words)}", f"commands: {pumps}, {guard}"]


def _table(attack):
    """The levels of each tank."""
    unit = attack.case.loop.units[0]
    rows = [
        [
            one.tank + 1,
            tables.number(one.limit, 6),
            {None: "-", True: "yes", False: "no"}[one.certified],
            *(tables.number(v, 6) for v in (one.nominal, one.drawn, one.level)),
            f"{one.margin:.3g}",
            tables.number(one.time_s),
            "passed" if one.passed else "holds",
        ]
        for one in attack.found
    ]
    heads = ["tank", f"limit [{unit}]", "proved", f"nominal [{unit}]", f"draws [{unit}]"]
    heads += [f"highest [{unit}]", f"margin [{unit}]", "at [s]", ""]
    return tables.table(rows, heads)


def _verdict(attack):
    """One sentence on the limits."""
    unit = attack.case.loop.units[0]
    if not attack.passed:
        return "No limit was passed."
    words = ", ".join(
        f"tank {one.tank + 1} by {-one.margin:.3g} {unit}"
        + (f" ({one.reason})" if one.certified is False else "")
        for one in attack.passed
    )
    return f"Limits are passed: {words}."


def _parameters(attack, one):
    """The Table of the coefficients, start and mean reading errors of one run."""
    known = {c.name: c for c in attack.attacked.coefficients}
    loop, rows = attack.case.loop, []
    for name, value in attack.parameters(one).items():
        values = value if isinstance(value, list) else [value]
        if name in known:
            c = known[name]
            own, ends = c.nominal, f"{c.low:.4g} : {c.high:.4g}"
            unit = describe(attack.attacked.original.loop, name)["unit"]
        else:
            part, index = name.rstrip("]").split("[")
            band = attack.attacked.band[int(index)]
            top = attack.attacked.ceiling[int(index)]
            own = float(loop.x0[int(index)]) if part == "x0" else 0.0
            ends = f"0 : {top:.4g}" if part == "x0" else f"{-band:.4g} : {band:.4g}"
            ends = "-" if part == "x0" and attack.attacked.start == "own" else ends
            unit = local("cm", loop.units)
        shown = "  ".join(tables.number(v) for v in values)
        rows.append([name, unit, tables.number(own), ends, shown])
    return tables.table(rows, ["", "unit", "nominal", "interval", "value (in each window)"])


def settings(attack, one):
    """Return the run of `one` as --set options, coefficients as in the window of its peak."""
    clock, windows = attack.case.clock, attack.attacked.windows
    at = min(int(one.time_s * windows / (clock.duration + clock.dt)), windows - 1)
    words = []
    for name, value in attack.parameters(one).items():
        if not name.startswith("sensor."):
            number = value[at] if isinstance(value, list) else value
            words.append(shlex.quote(f"{name}={number:.6g}"))
    return " ".join(f"--set {word}" for word in words)


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
    """Return the page report.html of an Attack.

    drawn: the figures of `figures`; command: the command line that made it.
    """
    worst, unit = attack.worst, attack.case.loop.units[0]
    return html.document(
        f"{attack.case.name}: attack",
        attack.case.title,
        _verdict(attack),
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
