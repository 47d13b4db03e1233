"""The report of an attack: text, JSON, pictures, page and folder."""

import dataclasses
import shlex

import numpy as np

from jaxtank import rig as rigs
from jaxtank.core.tree import describe, get_value
from jaxtank.core.units import local
from jaxtank.loop import run as lp
from jaxtank.loop.trajectory import csv
from jaxtank.safety.checker import CASE
from tuning.problem import provenance
from tuning.problem.wording import count, numbered
from tuning.report.document import Report, Text, figures_of
from tuning.report.folder import earlier, rig_text
from tuning.report.folder import save as save_all
from tuning.report.safety import start_of
from tuning.report.simulated import run_for_people
from tuning.report.tables import Table, Value, clean

REPRODUCED = 1e-9
"""Share of a level to which the rig file must give it again."""

CAPTIONS = {
    "worst": "The case itself (dashed), and the run with the smallest margin to its limit.",
    "ascent": "The highest level of each tank after each step of the ascent, over its limit.",
}


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
        "reading_band": clean(attacked.band),
        "pumps": attacked.pumps,
        "start": attacked.start,
        "starts": attack.starts,
        "draws": attack.draws,
        "history": clean(attack.history),
        "remarks": remarks_of(attack),
        "wall_s": attack.wall_s,
        "provenance": provenance.provenance(case, attack.seed),
    }


def _row(attack, one):
    """The JSON object of one tank."""
    return clean(
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
            "starts": one.starts or None,
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
    if beyond := [one.tank + 1 for one in attack.found if _starts_elsewhere(attack, one)]:
        found.append(
            f"Proved {start_of([CASE])} only: {numbered('tank', beyond)}. This attack starts"
            " anywhere below the limits; --start own keeps to the case's start."
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


def _starts_elsewhere(attack, one):
    """Whether a limit is proved from the case's start only, and the attack has others."""
    return one.starts == CASE and attack.attacked.start == "any"


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


def report(attack, drawn=None):
    """Return the Report of an Attack."""
    worst, case = attack.worst, attack.case
    head = (
        f"{case.name}: attack from {count(attack.draws, 'draw')}, ascent of"
        f" {count(attack.starts, 'start')} for each tank in {len(attack.history) - 1} steps (seed"
        f" {attack.seed}), {attack.wall_s:.1f} s"
    )
    options = [f"as options: {settings(attack, worst)}"]
    if case.loop.safety_filter is not None:
        options.append(
            "(--set also moves the intervals that the safety filter is designed for; worst.toml of"
            " --out keeps them, as faults of the nominal plant)"
        )
    return Report(
        f"{case.name}: attack",
        verdict(attack),
        [
            ("highest level", f"{worst.level:.5g} {case.loop.units[0]} (tank {worst.tank + 1})"),
            ("its limit", Value(worst.limit, unit=case.loop.units[0])),
            ("time", f"{attack.wall_s:.1f} s"),
        ],
        [
            Text([head, *_scope(attack)]),
            _levels(attack),
            Text([verdict(attack)], gap=True),
            Text(
                [f"The run with the smallest margin to its limit, in tank {worst.tank + 1}:"],
                gap=True,
            ),
            _parameters(attack, worst),
            Text(options, gap=True),
            Text(remarks_of(attack), items=True, gap=True),
            *figures_of(drawn or {}, CAPTIONS),
        ],
        not attack.passed,
        case.title,
    )


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
    kept = "any start up to the limits"
    if loop.safety_filter is not None:
        kept = "any start from which the filter can keep the limits"
    words.append(kept if attacked.start == "any" else "the case's start")
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


def _levels(attack):
    """The table of the levels of each tank."""
    unit, proved = attack.case.loop.units[0], {None: "-", True: "yes", False: "no"}
    rows = [
        [
            one.tank + 1,
            Value(one.limit, 6),
            proved[one.certified],
            *(Value(v, 6) for v in (one.nominal, one.drawn, one.level)),
            Value(one.margin, 3),
            Value(one.time_s),
            "passed" if one.passed else "holds",
        ]
        for one in attack.found
    ]
    heads = ["tank", f"limit [{unit}]", "proved", f"nominal [{unit}]", f"draws [{unit}]"]
    heads += [f"highest [{unit}]", f"margin [{unit}]", "at [s]", ""]
    return Table(rows, heads, gap=True)


def verdict(attack):
    """Return one sentence on the limits."""
    unit = attack.case.loop.units[0]
    if not attack.passed:
        return "No limit was passed."
    words = ", ".join(
        f"tank {one.tank + 1} by {-one.margin:.3g} {unit}"
        + (f" ({one.reason})" if one.certified is False else "")
        + (f" (proved {start_of([CASE])} only)" if _starts_elsewhere(attack, one) else "")
        for one in attack.passed
    )
    return f"Limits are passed: {words}."


def _parameters(attack, one):
    """The table of the coefficients, start and mean reading errors of one run."""
    attacked, loop, rows = attack.attacked, attack.case.loop, []
    entries = {}  # {name: (nominal, ends, unit)}
    for i, (start, top, band) in enumerate(zip(loop.x0, attacked.ceiling, attacked.band)):
        ends = None if attacked.start == "own" else (0.0, top)
        entries[f"x0[{i}]"] = (float(start), ends, local("cm", loop.units))
        entries[f"sensor.offset[{i}]"] = (0.0, (-band, band), local("cm", loop.units))
    for c in attacked.coefficients:
        unit = describe(attacked.original.loop, c.name)["unit"]
        entries[c.name] = (c.nominal, (c.low, c.high), unit)
    for name, value in attack.parameters(one).items():
        nominal, ends, unit = entries[name]
        rows.append([name, unit, Value(nominal), Value(ends, 4, between=" : "), Value(value)])
    return Table(rows, ["", "unit", "nominal", "interval", "value (in each window)"])


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
    return {"nominal": run_for_people(quiet), "worst": run_for_people(worst)}


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


def rig_of(attack):
    """Return (text of worst.toml or None, {"level" of its run [cm], "difference" to the level that
    was found [cm], "same": within REPRODUCED of it, "missing": what no rig file can describe}).
    """
    one = attack.worst
    text, why = rig_text(attack.rig(one))
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
    """Write result.json, worst.toml, trajectory.csv of the worst run, pictures and report.html."""
    text, checked = rig_of(attack)
    runs = runs_of(attack)
    files = {"trajectory.csv": csv(runs["worst"], attack.case.loop.units)}
    if text is not None:
        files["worst.toml"] = f"# {_head(attack, checked)}\n{text}"
    payload, stale = {**json_of(attack), "rig": checked}, earlier(folder, CAPTIONS)
    draw, page = lambda: figures(attack, runs), lambda drawn: report(attack, drawn)
    return save_all(folder, payload, files, draw, page, command, stale)


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
