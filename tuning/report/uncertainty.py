"""The report of an uncertainty study: text, JSON, pictures, page and folder."""

import dataclasses
import io
import math
from pathlib import Path

import numpy as np

from jaxtank import measures as ms
from jaxtank.loop import step_size
from tuning.problem import provenance
from tuning.problem.wording import count
from tuning.report.document import Live, Report, Text, figures_of
from tuning.report.folder import earlier
from tuning.report.folder import save as save_all
from tuning.report.tables import Table, Value, clean, number
from tuning.storage.columns import row_blocks
from tuning.storage.store import discard
from tuning.uncertainty.distributions import Correlated, Discrete, LogUniform, Normal, Uniform

QUANTITIES = ("mean", "sd", "p05", "p50", "p95", "cvar95", "max")
LINES = 1 << 12
"""Draws that are written as CSV at once."""

INTERVALS = (
    "intervals are those of independent draws: exact for random draws, mostly too wide for latin"
    " and sobol ones"
)

CAPTIONS = {
    "fan": "Levels of the first draws (at most 512): the median, the middle half, and 9 in 10 of"
    " them at each moment.",
    "violations": "The probability that a rig of this spread breaks each limit, with its 95 %"
    " interval.",
    "rig": "The rig, drawn from its own topology; a heavier outline is a tank that is controlled.",
}


def json_of(ensemble):
    """The JSON object of `jaxtank uncertainty --json`."""
    summary, feasible = clean(ensemble.summary()), ensemble.infeasible
    payload = {
        "case": ensemble.case.name,
        "samples": ensemble.samples,
        "failed": int(ensemble.failed.sum()),
        "infeasible": None if feasible is None else int(feasible.sum()),
        "draws": ensemble.method,
        "distributions": {
            n: {"kind": type(d).__name__, **clean(dataclasses.asdict(d))}
            for n, d in ensemble.distributions.items()
        },
        "measures": summary,
        "units": {m: ms.unit(m, ensemble.case.loop.units) for m in ensemble.measures},
        "violations": clean(ensemble.violations()),
        "wall_s": ensemble.wall_s,
        "provenance": provenance.provenance(ensemble.case, ensemble.seed),
    }
    if ensemble.method != "random":
        payload["intervals"] = INTERVALS
    if remarks := remarks_of(ensemble):
        payload["remarks"] = remarks
    if feasible is None:
        payload["infeasible_reason"] = "the steady states of this rig have no closed form"
    if any(None in np.ravel(np.array(list(m.values()), dtype=object)) for m in summary.values()):
        payload["reason"] = (
            "null: not a finite number, as a settling time where some draw never settles, or the"
            " standard deviation of one draw"
        )
    return payload


def remarks_of(ensemble):
    """Return warnings on the draws: that the steps are too long for the rig before any is drawn."""
    return [
        f"of the rig as it is, and of draws like it: {line}"
        for line in step_size.step_warnings(ensemble.case.loop, ensemble.case.clock)
    ]


def report(ensemble, drawn=None):
    """Return the Report of an Ensemble."""
    varied = ", ".join(f"{n} {in_words(d)}" for n, d in ensemble.distributions.items())
    broken = ensemble.violations() if ensemble.limits else []
    remarks, diverged = remarks_of(ensemble), int(ensemble.failed.sum())
    finite = ensemble.samples - diverged
    head = (
        f"{ensemble.case.name}: {count(ensemble.samples, 'draw')} ({ensemble.method}, seed"
        f" {ensemble.seed}), {ensemble.wall_s:.1f} s"
    )
    sections = [Live(ensemble), Text([head, f"uncertain: {varied}"]), _measure_table(ensemble)]
    if finite < 2:
        words = f"{count(finite, 'run')} finite: a standard deviation and an interval of the mean"
        sections.append(Text([f"{words} need two finite runs"], gap=True))
    if broken:
        rows = [
            [
                v["name"],
                Value(v["limit"], unit=v["unit"]),
                v["count"],
                Value(v["probability"], 4),
                Value(v["interval95"], 4, between=" : "),
            ]
            for v in broken
        ]
        heads = ["limit", "value", "broken in", "probability", "95 % interval"]
        sections.append(Table(rows, heads, gap=True))
    lines = [f"{INTERVALS} (these draws are {ensemble.method})"] * (ensemble.method != "random")
    lines.append(
        f"{count(diverged, 'run')} diverged: counted as breaking every limit, left out of all"
        " other figures"
    )
    sections += [Text(lines, gap=True), Text(remarks, on="terminal")]
    if ensemble.infeasible is not None:
        words = (
            f"{count(int(ensemble.infeasible.sum()), 'draw')} without a steady state within rims"
            " and pump limits at some plateau of the reference: included in all figures"
        )
        sections.append(Text([words]))
    facts = [
        ("draws", ensemble.samples),
        ("runs that diverged", diverged),
        ("time", f"{ensemble.wall_s:.1f} s"),
    ]
    sentences = list(remarks)
    for fact, sentence in (_worst_limit(ensemble, broken), _typical_error(ensemble)):
        facts[1:1] = fact
        sentences += sentence
    verdict = "no limit was broken in any draw" if broken else "no limits were given"
    if diverged:
        verdict = f"{diverged} of {count(ensemble.samples, 'run')} diverged"
    elif any(v["count"] for v in broken):
        verdict = "some draws break a limit"
    good = not diverged and not any(v["count"] for v in broken)
    sections += [Text(sentences, items=True, on="page"), *figures_of(drawn or {}, CAPTIONS)]
    title = f"{ensemble.case.name}: uncertainty"
    return Report(title, verdict, facts, sections, good, ensemble.case.title)


def _measure_table(ensemble):
    """The statistics of every measure, a row for each of its entries."""
    rows, units = [], ensemble.case.loop.units
    for name, summary in ensemble.summary().items():
        shape, per = ensemble.measures[name].shape[1:], ms.MEASURES[name].per
        columns = [np.nan if summary[q] is None else summary[q] for q in QUANTITIES]
        columns = [np.broadcast_to(values, shape).ravel() for values in columns]
        ends = summary["mean_interval95"]
        for i in range(len(columns[0])):
            label = name if per == "run" else f"{name} of {per} {i + 1}"
            mean, *others = (Value(values[i], 4) for values in columns)
            interval = "-"
            if ends is not None:
                interval = Value([np.ravel(end)[i] for end in ends], 4, between=" : ")
            rows.append([label, ms.unit(name, units), mean, interval, *others])
    heads = ["measure", "unit", "mean", "95 % of the mean", "sd", "5 %", "median", "95 %"]
    return Table(rows, [*heads, "mean of worst 5 %", "highest"], gap=True)


def in_words(d):
    """Return a distribution in words, in the unit of its parameter."""
    if isinstance(d, Correlated):
        means = "" if d.mean is None else " and means of their own"
        return f"{count(len(d.names), 'parameter')}, correlated, with a covariance{means}"
    if isinstance(d, Discrete):
        weights = "" if d.weights is None else ", ".join(f"{w:g}" for w in d.weights)
        values = ", ".join(f"{v:g}" for v in d.values)
        return f"one of {values}" + (f" (weights {weights})" if weights else "")
    kind = {
        Uniform: "uniform",
        LogUniform: "uniform in the logarithm",
        Normal: f"normal, truncated at {getattr(d, 'cut', 0):g} sd",
    }[type(d)]
    return f"{_extent(d)} ({kind}{', all entries together' if d.tied else ''})"


def _extent(d):
    """How wide a Uniform, LogUniform or Normal is."""
    if getattr(d, "relative", None) is not None:
        share = f"{100 * d.relative:g} %"
        return f"{share} sd" if isinstance(d, Normal) else f"+-{share}"
    if getattr(d, "factor", None) is not None:
        return f"within a factor {d.factor:g}"
    if isinstance(d, Normal):
        return (f"{d.mean:g} " if d.mean is not None else "") + f"sd {d.sd:g}"
    return f"{d.low:g} to {d.high:g}"


def draws_csv(ensemble):
    """Return every draw as CSV, some lines at a time: number, whether it diverged, parameters,
    measures.
    """
    sources = ((ensemble.values, None), (ensemble.measures, ms.unit))
    heads = ["draw", "failed"]
    for source, unit in sources:
        for name in source:
            units = "" if unit is None else f" [{unit(name, ensemble.case.loop.units)}]"
            entries = math.prod(source[name].shape[1:])
            heads += [name + (f"[{i}]" if entries > 1 else "") + units for i in range(entries)]
    yield ",".join(f'"{head}"' for head in heads) + "\n"
    for rows in row_blocks(ensemble.samples, LINES):
        columns = [np.arange(rows.start, rows.stop), ensemble.failed[rows]]
        for source, _ in sources:
            columns += [source[name][rows].reshape(len(columns[0]), -1) for name in source]
        out = io.StringIO()
        np.savetxt(out, np.column_stack(columns), delimiter=",", fmt="%.10g")
        yield out.getvalue()


def figures(ensemble):
    """Return matplotlib figures {name: Figure}: "fan" of the levels, "violations", "rig"."""
    from jaxtank.plots import responses
    from jaxtank.plots import run as plots

    drawn, loop = {}, ensemble.case.loop
    if ensemble.fan is not None:
        title = f"{ensemble.case.name}: {_draws_of_fan(ensemble)}"
        drawn["fan"] = responses.fan(loop, ensemble.fan, title)
    if ensemble.limits:
        drawn["violations"] = responses.violations(ensemble.violations(), ensemble.samples)
    return drawn | plots.rig(loop.plant, None, ensemble.case.name)


def _draws_of_fan(ensemble):
    """Which draws the fan is of, in words: of the first ones those that are finite."""
    first, kept = ensemble.fan["of"], ensemble.fan["draws"]
    of = count(first, "draw")
    if first < ensemble.samples:
        of = f"the first {first} of {ensemble.samples} draws"
    return of if kept == first else f"{kept} of {of}, the others diverged"


def _worst_limit(ensemble, broken):
    """(facts, sentences) on the limit that is broken most often."""
    if not broken:
        return [], []
    worst = max(broken, key=lambda v: v["probability"])
    low, high = worst["interval95"]
    which = f"{worst['name']} ({number(worst['limit'])} {worst['unit']})"
    sentence = (
        f"{which} is the limit most often broken: in {worst['count']} of {ensemble.samples} draws,"
        f" a probability between {low:.3g} and {high:.3g} with 95 % confidence"
    )
    if not worst["count"]:
        sentence = (
            f"none of {count(ensemble.samples, 'draw')} breaks a limit: the probability of breaking"
            f" a given one is at most {high:.3g}, with 95 % confidence"
        )
    return [("the limit most often broken", Value(100 * worst["probability"], 3, "%"))], [sentence]


def _typical_error(ensemble):
    """(facts, sentences) on the total RMS error."""
    summary = ensemble.summary().get("rms_error_total")
    if summary is None or summary["p50"] is None:
        return [], []
    unit = ms.unit("rms_error_total", ensemble.case.loop.units)
    median, low, high = (number(np.ravel(summary[k])[0], 4) for k in ("p50", "p05", "p95"))
    sentence = (
        f"rms_error_total: half of the draws lie below {median} {unit}, 9 in 10 between {low} and"
        f" {high} {unit}"
    )
    return [("median rms_error_total", f"{median} {unit}")], [sentence]


def save(ensemble, folder, command=None):
    """Write result.json, draws.csv, pictures and report.html to `folder`; return their paths."""
    files, stale = {"draws.csv": draws_csv(ensemble)}, earlier(folder, CAPTIONS)
    draw, page = lambda: figures(ensemble), lambda drawn: report(ensemble, drawn)
    written = save_all(folder, json_of(ensemble), files, draw, page, command, stale)
    discard(Path(folder))
    return written
