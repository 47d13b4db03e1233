"""The report of `jaxtank compare --controllers`: every controller that fits a rig, side by side."""

from typing import Any

import numpy as np

from tuning.problem import provenance
from tuning.report import verdict as verdicts
from tuning.report.advice import Advice, amount, of_nominal_plant
from tuning.report.document import Report, Text
from tuning.report.tables import Table, Value, clean, fields

CAPTIONS = {
    "controllers": "Mean error of each controller on the plants where every setpoint is reachable."
    " Red: a limit is broken on some plant."
}


def json_of(result):
    """The JSON object of `jaxtank compare --controllers --json`."""
    return clean(
        {
            "case": result.case.name,
            "verdict": verdict_of(result).to_json(),
            "advice": list(advice_of(result)),
            "samples": result.samples,
            "unit": result.case.loop.units[0],
            "controllers": [_row(rival) for rival in result.rivals],
            "refused": result.refused,
            "sentence": sentence(result),
            "provenance": provenance.provenance(result.case, result.seed),
        }
    )


def _row(rival):
    """The JSON object of a Rival."""
    judged = rival.judged.to_json()
    return {
        **fields(rival, "name kind gains tuned error violations step_us"),
        **fields(rival, "filter=filtered sensitivity_peak=peak"),
        **{name: judged[name] for name in ("objective", "failed", "travel_percent")},
        "why": rival.why or None,
    }


def sentence(result):
    """Return who wins, by how much, and where the case's own controller stands."""
    unit, best, own = result.case.loop.units[0], result.best, result.own
    if best.error is None:
        return "no controller has a finite run on a plant where every setpoint is reachable"
    words = f"{best.words()}: least error ({best.error:.3g} {unit}) of those that hold every limit"
    words += f" on {result.samples} of {result.samples} plants"
    if not best.holds:
        words = f"no controller holds every limit; {best.words()} breaks one on fewest plants"
        words += f" ({best.violations} of {result.samples}), error {best.error:.3g} {unit}"
    if best.name == own.name:
        rivals = [r for r in result.rivals if r.name != own.name and r.holds == best.holds]
        if rivals and rivals[0].error is not None:
            return f"{words}; next: {rivals[0].words()} ({rivals[0].error:.3g} {unit})"
        return f"{words}; no other controller does as well"
    stands = "no finite run" if own.error is None else f"{own.error:.3g} {unit}"
    if own.violations:
        stands += f", a limit broken on {own.violations} plants"
    return f"{words}; the case's own controller at its best ({own.words()}): {stands}"


def verdict_of(result):
    """Return the Verdict of a ControllerComparison: which controller is best."""
    return verdicts.outcome(sentence(result), result.best.holds)


def report(result):
    unit = result.case.loop.units[0]
    heads = ["controller", "gains", "filter", f"error [{unit}]", "limits broken", "travel [%]"]
    heads += ["Ms [-]", "C [us/step]"]
    rows = []
    for rival in result.rivals:
        travel = rival.judged.to_json()["travel_percent"]
        outcome = [Value(rival.error, 4), f"{rival.violations} of {result.samples}"]
        numbers = [Value(v, 3) for v in (travel, rival.peak, rival.step_us)]
        filtered = "yes" if rival.filtered else "no"
        rows.append([rival.name, rival.gains, filtered, *outcome, *numbers])
    notes = [
        "error: mean total rms error of the plants where every setpoint is reachable",
        "travel: rms change of the inputs per sample, as a share of their range",
        "Ms: largest sensitivity peak at the plateaus of the nominal plant",
        "C: time of a step of the controller alone, without the filter",
    ]
    if result.refused:
        notes.append(f"not for this rig: {', '.join(result.refused)} (reasons: --json)")
    return Report(
        result.case.name,
        "controllers",
        verdict_of(result),
        [("plants", result.samples), ("controllers", len({r.name for r in result.rivals}))],
        [Table(rows, heads, gap=True, top=True), Text(notes, items=True, gap=True)],
        result.case.title,
        advice=advice_of(result),
    )


def advice_of(result):
    """Return the Advice on a ControllerComparison: which controller, its error, lost setpoints."""
    best, unit, samples = result.best, result.case.loop.units[0], result.samples
    gives = f"It gives: no finite run on {samples} plants."
    if best.error is not None:
        holding = samples - best.violations
        gives = (
            f"It gives: mean RMS error {amount(best.error, unit)}; limits hold on {holding} of"
            f" {samples} plants."
        )
    return Advice(f"Set the controller {best.words()}.", gives, of_nominal_plant(result.case))


def figures(result):
    """Return matplotlib figures {"controllers": errors of all Rivals}."""
    from matplotlib.lines import Line2D

    from jaxtank.plots.style import picture

    names = list(dict.fromkeys(rival.name for rival in result.rivals))
    rivals = [rival for rival in result.rivals if rival.error is not None]

    def point(tuned, filtered, colour="0.3") -> dict[str, Any]:
        face = colour if tuned else "none"
        return {"marker": "s" if filtered else "o", "color": colour, "markerfacecolor": face}

    def errors(ax):
        for rival in rivals:
            style = point(rival.tuned, rival.filtered, "C0" if rival.holds else "C3")
            ax.plot(rival.error, names.index(rival.name), linestyle="none", **style)
        sides = ((False, False), (True, False), (False, True), (True, True))
        words = ("first gains", "tuned", "first gains, safety filter", "tuned, safety filter")
        handles = [Line2D([], [], linestyle="none", **point(*side)) for side in sides]
        ax.legend(handles, words, loc="upper left", bbox_to_anchor=(1.0, 1.0))
        ax.set_yticks(np.arange(len(names)), names)
        ax.set_ylim(len(names) - 0.5, -0.5)
        values = [rival.error for rival in rivals]
        if values and max(values) > 10.0 * min(values):
            ax.set_xscale("log")
        ax.set_xlabel(f"mean total rms error [{result.case.loop.units[0]}]")
        ax.grid(True, axis="x", alpha=0.3)

    return {"controllers": picture(errors, (7.6, max(1.9, 0.8 + 0.32 * len(names))))}
