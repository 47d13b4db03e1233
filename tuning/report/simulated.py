"""The report of a simulated run: text, stability margins, pictures, page, film and folder."""

import dataclasses
from pathlib import Path

import jax
import numpy as np

from jaxtank.core.errors import InputError
from jaxtank.core.files import check_folder, write_folder
from jaxtank.core.tree import get_value
from jaxtank.core.units import local
from jaxtank.limits import limited_levels, lowest_levels
from jaxtank.loop import run as lp
from jaxtank.loop.trajectory import csv, stride
from jaxtank.measures import MEASURES
from jaxtank.plants.elements import sections
from tuning.problem import provenance
from tuning.report import advice, safety, tables, verdict as verdicts
from tuning.report.document import Live, Report, Text, failed
from tuning.report.folder import save as save_all
from tuning.uncertainty.needs import inflow_varies

CAPTIONS = {
    "responses": "Levels with setpoints, rims and limits, and the inputs of the pumps.",
    "estimates": "What the observer estimated: levels with their readings, and disturbances of"
    " their rates with the inflow disturbance, where there is one; they hold all errors of the"
    " model.",
    "shares": "The share of each of the two blended controllers in each input: the first acts far"
    " from the setpoint, the second near it.",
}

WORST = 12  # limits that are listed where there are many: the tightest ones

BRIEF = ("rms_error", "settling_time", "overshoot_percent", "max_level", "input_travel")
"""Measures of a run on a terminal, after the objective's; no more than these five in all."""


def run_for_people(case, key=None):
    """A Trajectory of about 3000 rows, as host arrays."""
    every = stride(case.clock.samples)
    return jax.tree.map(np.asarray, lp.simulate(case.loop, case.clock, key, save_every=every))


def json_of_run(case, values, seed, plateaus=None):
    payload = {
        "case": case.name,
        "verdict": verdicts.of_run(case, values).to_json(),
        "advice": list(advice.of_run(case, values)),
        "measures": tables.measures_json(values),
        "units": tables.units(case.loop.plant),
        "reasons": tables.reasons(values),
        "clock": dataclasses.asdict(case.clock),
        "parameters": tables.clean(lp.parameters(case.loop)),
        "provenance": provenance.provenance(case, seed),
    }
    return payload if plateaus is None else {**payload, "margins": margins_json(plateaus)}


def estimates_of_run(case, key):
    """Return {"diagnosis": faults, "coefficients"} that the observer of a case has estimated."""
    observer = case.loop.observer
    has_modes, names = bool(observer.mode_names(case.loop.plant)), observer.coefficients
    if not has_modes and not names:
        return {}
    run = lp.simulate(case.loop, case.clock, key)
    rows = [
        {"name": name, "model": float(get_value(observer.model, name)), "estimate": v, "unit": unit}
        for (name, unit), v in zip(run.coefficient_names, np.ravel(run.coefficients)[-len(names) :])
    ]
    diagnosis = {"diagnosis": run.diagnosis} if has_modes else {}
    return diagnosis | ({"coefficients": tables.clean(rows)} if names else {})


def _coefficients(rows):
    heads = ["estimated coefficient", "in the model", "at the end", "change [%]"]
    table = []
    for row in rows:
        cells = [tables.Value(row[side], 5, row["unit"]) for side in ("model", "estimate")]
        change = 100.0 * (row["estimate"] / row["model"] - 1.0)
        table.append([row["name"], *cells, tables.Value(change, 3)])
    return [tables.Table(table, heads)]


def _diagnosis(diagnosis):
    heads = ["diagnosed fault", "from [s]", "to [s]", "size", "probability [-]"]
    rows = []
    for d in diagnosis:
        size = "" if d["size"] is None else tables.Value(d["size"], 3, d["unit"].strip("-"))
        times = tables.Value(d["from_s"], 5), tables.Value(d["to_s"], 5)
        rows.append([d["fault"], *times, size, tables.Value(d["probability"], 3)])
    return [tables.Table(rows, heads)] if rows else [Text(["no fault is diagnosed"], gap=True)]


def report(case, values, plateaus=None, every=False, estimated=None):
    """Return the Report of a run with the measures `values`; `every`: all of them on a terminal."""
    loop, limits = case.loop, verdicts.limit_rows(case, values)
    facts = [("length", f"{case.clock.duration:g} s"), ("sampled every", f"{case.clock.dt:g} s")]
    sections = [Live(case), Text([case.title], on="terminal")]
    if limits:
        table = advice.limits_of(limits if len(limits) <= tables.MANY else limits[:WORST])
        more = len(limits) - len(table.rows)
        note = [f"{more} further limits have larger margins"][:more]
        sections += [table, Text(note, on="page", top=True)]
    on, none = "" if every else "page", tables.undefined(values, loop.plant)
    whole = tables.measure_table(values, loop.plant, on=on)
    if not every:
        few = _brief(case, values)
        sections += [
            tables.measure_table(few, loop.plant, list(few), "terminal"),
            Text(tables.undefined(few, loop.plant), on="terminal"),
            Text([f"--all prints all {len(whole.rows)} measures"], on="terminal"),
        ]
    sections += [whole, Text(none, on=on)]
    sections += _margins(loop, plateaus) if plateaus is not None else []
    parts = {"diagnosis": _diagnosis, "coefficients": _coefficients}
    for name, rows in (estimated or {}).items():
        sections += parts[name](rows)
    if loop.safety_filter is not None:
        words = "The safety filter is on: jaxtank show prints what is proved of each tank."
        sections.append(Text([words], gap=True, on="terminal"))
        sections.append(Text(safety.passed(case, values)))
    verdict, above = verdicts.of_run(case, values), advice.of_run(case, values)
    return Report(case.name, "", verdict, facts, sections, case.title, advice=above)


def _brief(case, values):
    """The measures of a run on a terminal, without errors where no setpoint is followed."""
    brief = [m for m in dict.fromkeys([*case.objective, *BRIEF]) if m in values]
    if advice.follows_none(case):
        brief = [m for m in brief if MEASURES[m].per != "output" and m != "rms_error_total"]
    return {m: values[m] for m in brief[: len(BRIEF)]}


def margins_json(plateaus):
    rows = []
    for p in plateaus:
        values = {m: v for m, v in p.margins._asdict().items() if m != "stable"}
        row = {"setpoints": p.setpoints, "levels": p.x, "inputs": p.u, "stable": p.stable}
        rows.append(tables.clean({**row, "why": p.why or None, **values}))
    return rows


def _margins(loop, plateaus):
    """Sections on the stability margins at each plateau, the worst one marked."""
    if not plateaus:
        return [Text(["no stability margins: the reference holds no setpoints"], gap=True)]
    linearised = [p for p in plateaus if not p.why]
    worst = None  # where a loop is unstable, none of the stable ones is
    if all(p.stable for p in linearised):
        worst = max(linearised, key=lambda p: float(p.margins.sensitivity_peak), default=None)
    rows, notes = [], []
    for p in plateaus:
        name = f"{tables.Value(p.setpoints, 6, loop.units[0], ', ')}"
        if p.why:
            notes.append(f"{name}: no margins, {p.why}")
        elif not p.stable:
            notes.append(f"{name}: the linearised loop is unstable")
        else:
            m = p.margins
            cells = [tables.Value(v, 3) for v in (m.sensitivity_peak, m.complementary_peak)]
            several = (m.gain_margin, m.phase_margin, m.delay_margin)
            cells += [tables.Value(v, 3, missing="any") for v in several]
            rows.append([name + (" (worst)" if p is worst else ""), *cells])
    heads = ["setpoints", "Ms [-]", "Mt [-]", "gain margin [-]", "phase margin [deg]"]
    heads += ["delay margin [s]"]
    if inflow_varies(loop.disturbance):
        notes.append(
            "The inflow varies: these margins hold at its mean; at other inflows they differ."
        )
    title = "stability margins of the linearised loop, one loop at a time (Ms, Mt: all)"
    return [Text([title], gap=True), *([tables.Table(rows, heads)] if rows else []), Text(notes)]


def responses_of(case, runs, title):
    """Return the figure of {name: Trajectory} with the limits of a case."""
    from jaxtank.plots.responses import responses

    return responses(case.loop, runs, title, limited_levels(case), lowest_levels(case))


def save(case, run, payload, folder, page, command=None, gif=False, against=None, columns=None):
    """Write the files of one simulation; optionally a film and pictures for print."""
    # page(): the Report; against: (Case, Trajectory) of a second rig in run.gif and film.png
    from jaxtank.plots.run import save_for_print
    from jaxtank.plots.style import for_print

    check_folder(folder)
    # trajectory.csv shows an earlier run: its pictures must not remain next to the new ones
    old = (Path(folder) / "trajectory.csv").exists()
    names = "responses.png estimates.png shares.png run.gif film.png report.html print.svg"
    stale = [Path(folder) / name for name in f"{names} print.png".split()] if old else []

    draw = lambda: {
        "responses": responses_of(case, {case.name: run}, case.title),
        **estimates(case.loop, case.clock, run, f"{case.name}: estimates"),
        **shares(run, f"{case.name}: shares of the blended controllers", case.loop.plant),
    }
    files = {"trajectory.csv": csv(run, case.loop.units)}
    written = save_all(folder, payload, files, draw, page, CAPTIONS, command, stale)
    if columns is not None:
        try:
            with for_print(columns):
                figure = responses_of(case, {case.name: run}, "")
            written += save_for_print({"print": figure}, folder, columns)
        except InputError:
            raise
        except Exception as error:
            failed("print.svg", error)
    if gif:
        from jaxtank.plots.animation import film

        cases = [case, *([] if against is None else [against[0]])]
        beside = None if against is None else (against[0].loop, against[1])
        try:
            moving, still = film(case.loop, run, against=beside, titles=_titles(cases))
        except Exception as error:
            failed("run.gif", error)
        else:
            written += write_folder(Path(folder), {"run.gif": moving, "film.png": still})
    return written


def _titles(cases):
    """Names of the cases of a film, with the safety filter where not all of them have one."""
    some = len({case.loop.safety_filter is None for case in cases}) > 1
    filtered = lambda case: some and case.loop.safety_filter is not None
    return tuple(case.name + ", safety filter" * filtered(case) for case in cases)


def estimates(loop, clock, run, title=""):
    """Return {"estimates": levels, disturbances, coefficients as the observer estimated them}."""
    # {} where the controller takes the levels as they are measured.
    from jaxtank.plots import diagnostics, responses, style

    tanks, disturbed = loop.plant.tanks, bool(np.any(run.d_hat))
    estimated = disturbed or len(run.coefficient_names) > 0
    if not estimated and np.array_equal(run.x_hat, run.y):
        return {}
    inflow = [None] * tanks
    if loop.disturbance is not None and not callable(loop.plant.area):
        index = np.clip(np.rint(np.asarray(run.t) / clock.dt).astype(int), 0, clock.samples - 1)
        flows = loop.disturbance.sample(clock)[0]
        areas = sections(loop.plant, np.asarray(run.x).T)
        inflow = [np.asarray(d)[index] / np.asarray(a) for d, a in zip(flows, areas)]

    def draw(axes):
        for i in range(tanks):
            diagnostics.estimate(axes[0, i], run, i, loop.units[0], loop.plant)
            if disturbed:
                rate = local("cm/s", loop.units)
                diagnostics.disturbance(axes[1, i], run, i, inflow[i], rate, loop.plant)
        below = axes[2 if disturbed else 1 :].ravel()
        for k, ((name, _), ax) in enumerate(zip(run.coefficient_names, below)):
            true = get_value(loop, f"plant.{name}") if loop.faults is None else None
            diagnostics.coefficient(ax, run, k, true)
        style.hide(below[len(run.coefficient_names) :])
        responses.label_times(axes)

    rows = (2 if disturbed else 1) - (-len(run.coefficient_names) // tanks)
    size = (max(6.4, 3.2 * tanks), 2.3 * rows + 0.5)
    of = {"legend": 5, "title": title, "sharex": True, "squeeze": False}
    return {"estimates": style.picture(draw, size, rows, tanks, **of)}


def shares(run, title="", plant=None):
    """Return {"shares": share of two blended controllers in each input}; {} without any."""
    from jaxtank.plots import diagnostics, style

    if run.share is None:
        return {}
    pumps = run.share.shape[1]

    def draw(axes):
        for j, ax in enumerate(axes[0]):
            diagnostics.share(ax, run, j, plant=plant)
            style.label_time(ax)

    size, of = (max(6.4, 3.2 * pumps), 2.9), {"legend": 2, "title": title, "squeeze": False}
    return {"shares": style.picture(draw, size, 1, pumps, **of)}
