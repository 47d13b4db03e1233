"""The report of an attack: text, JSON, pictures, page and folder."""

import dataclasses
import shlex

import numpy as np

from jaxtank import rig as rigs
from jaxtank.core.labels import label_of, labels_of, short
from jaxtank.core.text import count
from jaxtank.core.tree import describe
from jaxtank.loop import run as lp
from jaxtank.loop.trajectory import csv
from jaxtank.safety.checker import CASE
from tuning.falsification.study import beyond_filter
from tuning.problem import provenance
from tuning.report import advice, verdict as verdicts
from tuning.report.document import Report, Text
from tuning.report.folder import earlier, rig_text, save as save_all
from tuning.report.safety import start_of
from tuning.report.simulated import run_for_people
from tuning.report.tables import Table, Value, clean, fields

REPRODUCED = 1e-9  # share of a level to which the rig file must give it again
CAPTIONS = {
    "worst": "The case itself (dashed), and the run with the smallest margin to its limit.",
    "ascent": "The highest level of each tank after each step of the ascent, over its limit.",
}

PUMPS = {
    "own": "the case's controller",
    "full": "pumps at full command",
    "random": "pumps that switch",
}


def json_of(attack):
    case, attacked = attack.case, attack.attacked
    return {
        "case": case.name,
        "verdict": verdict_of(attack).to_json(),
        "advice": list(advice_of(attack)),
        "passed": bool(attack.passed or attack.below),
        "worst": [_row(attack, tank) for tank in attack.found],
        "unit": case.loop.units[0],
        "safety_filter": case.loop.safety_filter is not None,
        "coefficients": {
            c.name: fields(c, "nominal low high varies") for c in attacked.coefficients
        },
        **fields(attacked, "windows pumps start reading_band=band"),
        **fields(attack, "starts draws history wall_s"),
        "remarks": remarks_of(attack),
        "provenance": provenance.provenance(case, attack.seed),
    }


def _row(attack, tank):
    return {
        "tank": tank.tank + 1,
        **fields(tank, "level limit time_s margin passed certified nominal drawn"),
        "parameters": clean(attack.parameters(tank)),
        "why": tank.reason or None,
        "starts": tank.starts or None,
        **fields(tank, "rise_between_samples=rise"),
    }


def remarks_of(attack):
    """Return sentences that the figures need."""
    unit, attacked = attack.case.loop.units[0], attack.attacked
    remarks, rises = [], [tank.rise for tank in attack.found if np.isfinite(tank.rise)]
    if rises:
        remarks.append(
            f"Levels are taken at the samples; between two samples a level can rise by at most"
            f" {max(rises):.3g} {unit} (b_max u_max dt, and what flows in from other tanks)."
        )
    if attacked.physical_rims:
        remarks.append(
            "Overflow is simulated in this rig: no level passes a rim. The attack is on the same"
            " rig without overflow, whose levels show what would overflow."
        )
    if beyond := [tank.tank for tank in attack.found if _starts_elsewhere(attack, tank)]:
        tanks = labels_of(attack.case.loop.plant, "tank", beyond)
        remarks.append(
            f"Proved {start_of([CASE])} only: {tanks}. This attack starts anywhere below the"
            " limits; --start own keeps to the case's start."
        )
    if attack.lowest is not None:
        remarks.append("Limits from below (min_level) are not attacked.")
    return [
        *remarks,
        *beyond_filter(attacked),
        "What an attack finds is a lower bound of the worst: a limit that is not passed here may be"
        " passed by a plant that was not tried, unless it is proved (jaxtank show).",
    ]


def _starts_elsewhere(attack, tank):
    """Whether a limit is proved from the case's start only, and the attack has others."""
    return tank.starts == CASE and attack.attacked.start == "any"


def _proved(attack):
    """The tanks whose limit is proved for the starts of the attack."""
    certified = (tank for tank in attack.found if tank.certified)
    return [tank.tank for tank in certified if not _starts_elsewhere(attack, tank)]


def report(attack):
    worst, case = attack.worst, attack.case
    head = (
        f"{case.name}: attack from {count(attack.draws, 'draw')}, ascent of"
        f" {count(attack.starts, 'start')} for each tank in {len(attack.history) - 1} steps (seed"
        f" {attack.seed}), {attack.wall_s:.1f} s"
    )
    several = any(
        isinstance(v, list) and len(set(v)) > 1 for v in attack.parameters(worst).values()
    )
    window = ", the values of the window of the peak in all" * several
    options = [f"as options{window}: {settings(attack, worst)}"]
    if case.loop.safety_filter is not None:
        _, why = rig_text(attack.rig(worst))
        file = why or "worst.toml of --out keeps them, as faults of the nominal plant"
        options.append(
            f"(--set also moves the intervals that the safety filter is designed for; {file})"
        )
    name = label_of(case.loop.plant, "tank", worst.tank)
    verdict, advised, time = verdict_of(attack), advice_of(attack), f"{attack.wall_s:.1f} s"
    sections = [
        Text([head, *_scope(attack)]),
        _levels(attack),
        Text([f"The run with the least margin to a limit, {name}:"], gap=True),
        _parameters(attack, worst),
        Text(options, gap=True),
        Text(remarks_of(attack), items=True, gap=True),
    ]
    facts = [("time", time)]
    return Report(case.name, "attack", verdict, facts, sections, case.title, advice=advised)


def _scope(attack):
    """Lines on the quantities that the attack may change."""
    attacked, loop = attack.attacked, attack.case.loop
    clock, varying = attack.case.clock, attacked.shapes["varying"][0]
    words = [f"{count(len(attacked.coefficients), 'coefficient')} in their intervals"]
    if attacked.windows > 1 and varying:
        words.append(
            f"{varying} of them with a separate value in each of {attacked.windows} windows,"
            f" which begin every {(clock.duration + clock.dt) / attacked.windows:.5g} s"
        )
    safe = loop.safety_filter is not None
    start = f"any start {'from which the filter can keep' if safe else 'up to'} the limits"
    words.append(start if attacked.start == "any" else "the case's start")
    if "bias" in attacked.shapes:
        band = ", ".join(f"{b:.3g}" for b in attacked.band)
        kind = "at each sample" if "noise" in attacked.shapes else "constant"
        words.append(f"reading errors ({kind}) within +-({band}) {loop.units[0]}")
    filtered = "with the safety filter" if safe else "no safety filter"
    return [f"over: {', '.join(words)}", f"commands: {PUMPS[attacked.pumps]}, {filtered}"]


def _levels(attack):
    unit, proved = attack.case.loop.units[0], {None: "-", True: "yes", False: "no"}
    rows = []
    for tank in attack.found:
        name = short(attack.case.loop.plant, "tank", tank.tank)
        reached = [Value(v, 6) for v in (tank.nominal, tank.drawn, tank.level)]
        end = [Value(tank.margin, 3), Value(tank.time_s), "passed" if tank.passed else "holds"]
        certified = "start" if _starts_elsewhere(attack, tank) else proved[tank.certified]
        rows.append([name, Value(tank.limit, 6), certified, *reached, *end])
    levels = [f"{name} [{unit}]" for name in ("nominal", "draws", "highest", "margin")]
    heads = ["tank", f"limit [{unit}]", "proved", *levels, "at [s]", ""]
    return Table(rows, heads, gap=True, top=True)


def advice_of(attack):
    worst, loop = attack.worst, attack.case.loop
    name, unit = label_of(loop.plant, "tank", worst.tank), loop.units[0]
    level = f"{name} reaches {advice.amount(worst.level, unit, 4)}"
    where = f"{advice.amount(worst.time_s, 's', 5)}, its limit is"
    to_set = "Nothing to set: no level was driven past its limit."
    if attack.passed and loop.safety_filter is None:
        to_set = "Set --safety-filter or lower setpoints: a level was driven past its limit."
    elif attack.passed:
        to_set = "Set lower limits or wider tolerances of the safety filter: a level passed one."
    elif attack.below:
        to_set = "Set other gains or setpoints: the case's own run falls below a limit."
    proved = _proved(attack)
    beyond = "Nothing is proved: a plant that was not tried may pass a limit."
    if proved:
        tanks = labels_of(loop.plant, "tank", proved)
        beyond = f"Proved whatever the gains: no plant of the box passes the limits of {tanks}."
    bound = advice.amount(worst.limit, unit, 4)
    return advice.Advice(to_set, f"The worst run: {level} at {where} {bound}.", beyond)


def verdict_of(attack):
    words = []
    for tank in attack.passed:
        loop = attack.case.loop
        name, by = label_of(loop.plant, "tank", tank.tank), verdicts.shown(-tank.margin)
        words.append(f"{name} by {by} {loop.units[0]} at {verdicts.shown(tank.time_s, 5)} s")
        if tank.certified is False:
            words[-1] += f" ({tank.reason})"
        if _starts_elsewhere(attack, tank):
            words[-1] += f" (proved {start_of([CASE])} only)"
    proved = _proved(attack)
    upper = "" if attack.lowest is None else "upper "
    sentence = f"limits are passed: {', '.join(words)}" if words else f"no {upper}limit was passed"
    if proved and not words:
        sentence += f", proved for {labels_of(attack.case.loop.plant, 'tank', proved)}"
    for tank, level in attack.below.items():
        name, unit = label_of(attack.case.loop.plant, "tank", tank), attack.case.loop.units[0]
        level = f"{verdicts.shown(level)} {unit}"
        sentence += f"; in the case's own run {name} falls to {level}, below its limit"
    return verdicts.Verdict(limits=verdicts.Part(sentence, not words and not attack.below))


def _parameters(attack, tank):
    """The table of the coefficients, start and mean reading errors of one run."""
    attacked, loop, length = attack.attacked, attack.case.loop, attack.case.loop.units[0]
    entries = {}  # {name: (nominal, ends, unit)}
    for i, (start, top, band) in enumerate(zip(loop.x0, attacked.ceiling, attacked.band)):
        ends = None if attacked.start == "own" else (0.0, top)
        entries[f"x0[{i}]"] = (float(start), ends, length)
        entries[f"sensor.offset[{i}]"] = (0.0, (-band, band), length)
    for c in attacked.coefficients:
        unit = describe(attacked.original.loop, c.name)["unit"]
        entries[c.name] = (c.nominal, (c.low, c.high), unit)
    rows = []
    for name, value in attack.parameters(tank).items():
        nominal, ends, unit = entries[name]
        rows.append([name, unit, Value(nominal), Value(ends, 4, between=" : "), Value(value)])
    return Table(rows, ["", "unit", "nominal", "interval", "value (in each window)"])


def settings(attack, tank):
    """Return the run of `tank` as --set options, coefficients as in the window of its peak."""
    clock, windows = attack.case.clock, attack.attacked.windows
    at = min(int(tank.time_s * windows / (clock.duration + clock.dt)), windows - 1)
    every = attack.parameters(tank).items()
    options = {name: value for name, value in every if not name.startswith("sensor.")}
    values = {n: value[at] if isinstance(value, list) else value for n, value in options.items()}
    return " ".join(f"--set {shlex.quote(f'{name}={value:.6g}')}" for name, value in values.items())


def _runs(attack):
    original = attack.attacked.original
    sensor = original.loop.sensor.without_noise()
    quiet = original.replace(loop=dataclasses.replace(original.loop, sensor=sensor))
    worst = attack.case.replace(loop=attack.loop(attack.worst))
    return {"nominal": run_for_people(quiet), "worst": run_for_people(worst)}


def figures(attack, runs=None):
    from jaxtank.plots import responses
    from jaxtank.plots.style import FORBIDDEN, picture, plain

    worst, loop = attack.worst, attack.case.loop
    limits = np.array([tank.limit for tank in attack.found])
    title = f"{attack.case.name}: the worst run for {label_of(loop.plant, 'tank', worst.tank)}"

    def ascent(ax):
        for i, limit in enumerate(limits):
            label = plain(label_of(loop.plant, "tank", i))
            ax.plot(attack.history[:, i] / limit, marker=".", label=label)
        ax.axhline(1.0, color=FORBIDDEN, linewidth=1.0, label="limit")
        ax.set(xlabel="step of the ascent", ylabel="highest level / limit [-]")
        ax.legend()

    runs = responses.responses(loop, runs or _runs(attack), title, limits)
    return {"worst": runs, "ascent": picture(ascent, (6.0, 3.4))}


def rig_of(attack):
    """Return (worst.toml or None, {"level" and "difference" [cm], "same", "missing" in it})."""
    worst = attack.worst
    text, why = rig_text(attack.rig(worst))
    missing = attack.not_in_rig(worst)
    if text is None:
        return None, {"level": None, "difference": None, "same": False, "missing": [why, *missing]}
    case = rigs.loads(text)
    run, _ = lp.simulate_compiled(case.loop, case.clock, None, 1)
    level = np.asarray(run.x)[:, worst.tank]
    rising = level[1:][level[1:] > level[:-1]]
    highest = float(rising.max()) if rising.size else float(level[-1])
    difference = highest - worst.level
    same = abs(difference) <= REPRODUCED * worst.limit
    if not same and not missing:
        missing = ["the safety filter, which is designed anew for this start"]
    return text, {"level": highest, "difference": difference, "same": same, "missing": missing}


def save(attack, folder, command=None):
    text, checked = rig_of(attack)
    runs, worst, loop = _runs(attack), attack.worst, attack.case.loop
    files = {"trajectory.csv": csv(runs["worst"], loop.units)}
    if text is not None:
        unit, lacks = loop.units[0], ", ".join(checked["missing"])
        rest = f"; this file gives {checked['level']:.10g} {unit}: it lacks {lacks}"
        rest = ", which `jaxtank simulate` of this file gives again" if checked["same"] else rest
        level = f"{label_of(loop.plant, 'tank', worst.tank)} at {worst.level:.10g} {unit}"
        files["worst.toml"] = f"# the worst found by jaxtank attack: {level}{rest}\n{text}"
    payload, stale = {**json_of(attack), "rig": checked}, earlier(folder, CAPTIONS)
    draw, page = lambda: figures(attack, runs), lambda: report(attack)
    return save_all(folder, payload, files, draw, page, CAPTIONS, command, stale)
