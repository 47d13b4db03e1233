"""The report of `jaxtank compare --controllers`: every controller that fits a rig, side by side."""

from typing import Any

import numpy as np

from jaxtank.core.labels import units_of_inputs
from tuning.problem import provenance
from tuning.report import verdict as verdicts
from tuning.report.advice import Advice, amount, of_nominal_plant
from tuning.report.document import Report, Text
from tuning.report.tables import Table, Value, clean, fields

TIE = 0.01  # controllers whose errors differ by less are as good as each other
CAPTIONS = {
    "controllers": "Mean error of each controller on the plants where every setpoint is reachable."
    " Red: a limit is broken on some plant."
}

OUTCOMES = {  # {place of what a paper calls the best: words at published gains, and of all}
    "first": ("holds among published gains", "holds once all are tuned"),
    "tie": ("is undecided (within 1 %) among published gains", "is undecided once all are tuned"),
    "behind": ("fails among published gains", "fails once all are tuned"),
}


def json_of(result):
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
    numbers = rival.judged.to_json()
    return {
        **fields(rival, "name kind gains tuned error violations step_us parameters"),
        **fields(rival, "filter=filtered sensitivity_peak=peak input_travel=travel"),
        **{name: numbers[name] for name in ("objective", "failed", "travel_percent")},
        "why": rival.why or None,
    }


def sentence(result):
    """Return who wins, by how much, and whether the claim of the paper survives tuning."""
    if result.best.error is None:
        return "no controller has a finite run on a plant where every setpoint is reachable"
    return "; ".join([_winner(result), _margin(result), *_claims(result)])


def place(rivals, name):
    """Return where a controller stands among Rivals, best first: a key of OUTCOMES."""
    best, of_name = rivals[0], next(r for r in rivals if r.name == name)
    near = [r for r in rivals if _as_good(r, best)]
    if of_name not in near:
        return "behind"
    return "first" if all(r.name == name for r in near) else "tie"


def _as_good(rival, best):
    if rival.violations != best.violations or None in (rival.error, best.error):
        return rival is best
    return rival.error <= (1.0 + TIE) * best.error


def _winner(result):
    best, error = result.best, amount(result.best.error, result.unit)
    first = place(result.rivals, best.name) == "first"
    wins = "wins" if first else "is first, within 1 % of another"
    if best.holds:
        return f"{best.words()}, {wins}: error {error}, every limit held on {result.samples} plants"
    return (
        f"no controller holds every limit; {best.words()}, {wins}: a limit broken on"
        f" {best.violations} of {result.samples} plants, error {error}"
    )


def _margin(result):
    """By how much the winner is better than the next controller."""
    best = result.best
    other = next((r for r in result.rivals if r.name != best.name and r.error is not None), None)
    if other is None:
        return "no other controller was compared, or none has a finite run"
    if other.violations > best.violations:
        return f"next: {_stands(other, result.unit)}"
    less = 100.0 * (1.0 - best.error / other.error)
    words = f"that is {less:.2g} % less than the next controller, {_stands(other, result.unit)}"
    if not (best.travel and other.travel):
        return words
    return f"{words}, at {best.travel / other.travel:.2g} times its total variation of the inputs"


def _stands(rival, unit):
    """A Rival with its error and the plants on which it breaks a limit."""
    error = "no finite run" if rival.error is None else amount(rival.error, unit)
    broken = f", a limit broken on {rival.violations} plants" if rival.violations else ""
    return f"{rival.words()} ({error}{broken})"


def _claims(result):
    """Whether each claim of the paper survives; without a paper, where the case's own stands."""
    names = list(dict.fromkeys(rival.name for rival in result.rivals))
    if len(names) == 1:
        return
    claims = {n: w for n, w in (result.claims or {}).items() if n in names}
    for name, section in claims.items():
        yield from _claim(result, name, section, names)
    if result.claims == {}:
        yield "its paper calls no controller the best"
    if not claims and result.own is not None and result.own.name != result.best.name:
        yield f"the case's own controller at its best: {_stands(result.own, result.unit)}"


def _claim(result, name, section, names):
    """Whether the claim that a controller is the best holds at published gains, and of all."""
    published = [r for r in result.rivals if r.gains == "published" and not r.filtered]
    at_published, of_all = OUTCOMES[place(result.rivals, name)][1], ""
    if len({r.name for r in published}) > 1:
        at_published, of_all = OUTCOMES[place(published, name)][0], f", and {at_published}"
    yield f"the paper's claim that {name} is the best ({section}) {at_published}{of_all}"
    if name != result.best.name:
        stands = _stands(next(r for r in result.rivals if r.name == name), result.unit)
        yield f"{stands}, is number {names.index(name) + 1} of {len(names)} controllers"


def verdict_of(result):
    return verdicts.outcome(sentence(result), result.best.holds)


def report(result):
    case, inputs = result.case, units_of_inputs(result.case.loop.plant)
    heads = ["controller", "gains", "filter", f"error [{result.unit}]", "limits broken"]
    heads += ["travel [%]", f"total [{inputs}]", "Ms [-]", "C [us/step]"]
    rows = []
    for rival in result.rivals:
        travel = rival.judged.to_json()["travel_percent"]
        outcome = [Value(rival.error, 4), f"{rival.violations} of {result.samples}"]
        numbers = [Value(v, 3) for v in (travel, rival.travel, rival.peak, rival.step_us)]
        filtered = "yes" if rival.filtered else "no"
        rows.append([rival.name, rival.gains, filtered, *outcome, *numbers])
    notes = [
        "error: mean total rms error of the plants where every setpoint is reachable; rows are"
        " ordered by limits broken, then by it; tuning weighs the changes of the inputs too",
        "travel: rms change of the inputs per sample, as a share of their range",
        "total: total variation of all inputs over the run, mean of the same plants as the error",
        "Ms: largest sensitivity peak at the plateaus of the nominal plant",
        "C: time of a step of the controller alone, without the filter",
    ]
    if result.refused:
        notes.append(f"not for this rig: {', '.join(result.refused)} (reasons: --json)")
    facts = [("plants", result.samples), ("controllers", len({r.name for r in result.rivals}))]
    sections = [Table(rows, heads, gap=True, top=True), Text(notes, items=True, gap=True)]
    verdict, advised = verdict_of(result), advice_of(result)
    return Report(case.name, "controllers", verdict, facts, sections, case.title, advice=advised)


def advice_of(result):
    best, samples = result.best, result.samples
    gives = f"It gives: no finite run on {samples} plants."
    if best.error is not None:
        error, holding = amount(best.error, result.unit), samples - best.violations
        gives = f"It gives: mean RMS error {error}; limits hold on {holding} of {samples} plants."
    gains = ", ".join(f"{n} = {_listed(v)}" for n, v in best.parameters.items())
    to_set = f"Set the controller {best.words()}{': ' * bool(gains)}{gains}."
    return Advice(to_set, gives, of_nominal_plant(result.case))


def _listed(value):
    if np.ndim(value):
        return f"[{', '.join(map(_listed, value))}]"
    return verdicts.shown(value)


def figures(result):
    from jaxtank.plots.style import picture

    def draw(ax):
        draw_errors(ax, result)
        ax.legend(*legend(), loc="upper left", bbox_to_anchor=(1.0, 1.0))

    count = len({rival.name for rival in result.rivals})
    return {"controllers": picture(draw, (7.6, max(1.9, 0.8 + 0.32 * count)))}


def _point(tuned, filtered, colour="0.3") -> dict[str, Any]:
    face = colour if tuned else "none"
    return {"marker": "s" if filtered else "o", "color": colour, "markerfacecolor": face}


def legend():
    from matplotlib.lines import Line2D

    sides = ((False, False), (True, False), (False, True), (True, True))
    words = ("first gains", "tuned", "first gains, safety filter", "tuned, safety filter")
    points = [_point(*side) for side in sides] + [_point(True, False, "C3")]
    lines = [Line2D([], [], linestyle="none", **point) for point in points]
    return lines, (*words, "red: a limit is broken")


def draw_errors(ax, result):
    """Draw the errors of all Rivals, a row for each controller."""
    from matplotlib.ticker import LogLocator, NullFormatter

    from jaxtank.plots.style import plain

    names = list(dict.fromkeys(rival.name for rival in result.rivals))
    rivals = [rival for rival in result.rivals if rival.error is not None]
    for rival in rivals:
        style = _point(rival.tuned, rival.filtered, "C0" if rival.holds else "C3")
        ax.plot(rival.error, names.index(rival.name), linestyle="none", **style)
    ax.set_yticks(np.arange(len(names)), map(plain, names))
    ax.set_ylim(len(names) - 0.5, -0.5)
    values = [rival.error for rival in rivals]
    if values and max(values) > 10.0 * min(values):
        ax.set_xscale("log")
        ax.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        ax.xaxis.set_major_formatter(lambda value, _: f"{value:g}")
        ax.xaxis.set_minor_formatter(NullFormatter())
    else:
        ax.locator_params(axis="x", nbins=5)
    ax.set_xlabel(f"mean total rms error [{result.unit}]")
    ax.grid(True, axis="x", alpha=0.3)
