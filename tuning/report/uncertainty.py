"""The report of an uncertainty study: text, JSON, pictures, page and folder."""

import dataclasses
import io
import math
from pathlib import Path
from typing import Any

import numpy as np

from jaxtank import measures as ms
from jaxtank.bounds import is_tunable
from jaxtank.core.labels import entry_label
from jaxtank.core.text import count, csv_line
from jaxtank.core.tree import describe, get_value
from jaxtank.loop import step_size
from tuning.problem import provenance
from tuning.problem.tracking import UNJUDGED, not_tracking
from tuning.report import advice, verdict as verdicts
from tuning.report.document import Live, Report, Text
from tuning.report.folder import earlier, save as save_all
from tuning.report.tables import Table, Value, clean, fields
from tuning.storage.columns import row_blocks
from tuning.storage.store import discard
from tuning.uncertainty import distributions
from tuning.uncertainty.sampling import clopper_pearson

LINES = 1 << 12  # draws that are written as CSV at once
RARE = 6.0  # cut of a normal distribution that leaves out no event that is asked about [sd]
LIKELY = 3  # most likely failures that are printed
QUANTITIES = ("mean", "sd", "p05", "p50", "p95", "cvar95", "max")

INTERVALS = (
    "intervals assume independent draws: exact for random draws, mostly too wide for latin"
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
    summary, feasible = clean(ensemble.summary()), ensemble.infeasible
    fields_of = lambda d: {k: v for k, v in dataclasses.asdict(d).items() if k != "draws"}
    stated = lambda d: {"kind": type(d).__name__, **clean(fields_of(d))}
    payload = {
        "case": ensemble.case.name,
        "verdict": verdict_of(ensemble).to_json(),
        "advice": list(advice_of(ensemble)),
        "failed": int(ensemble.failed.sum()),
        "infeasible": None if feasible is None else int(feasible.sum()),
        "draws": ensemble.method,
        "distributions": {n: stated(d) for n, d in ensemble.distributions.items()},
        "measures": summary,
        "units": {m: ms.entry_units(m, ensemble.case.loop.plant) for m in ensemble.measures},
        "violations": clean(ensemble.violations()),
        **fields(ensemble, "samples wall_s"),
        "provenance": provenance.provenance(ensemble.case, ensemble.seed),
    }
    if ensemble.promise is not None:
        sentence = promise_sentence(ensemble.promise)
        payload["promise"] = {**clean(dataclasses.asdict(ensemble.promise)), "sentence": sentence}
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
    """Return warnings on the draws: steps too long for the rig, and a rejected structure."""
    from_identification = ensemble.case.rejected and "identified" in ensemble.distributions
    rejected = (
        f"draws are from the [covariance] of {ensemble.case.name}, of a structure that the data of"
        " its identification reject: they say nothing of a plant of another structure; identify"
        " again with --accept or --refine"
    )
    return [rejected] * from_identification + [
        f"of the rig before any draw: {line}"
        for line in step_size.step_warnings(ensemble.case.loop, ensemble.case.clock)
    ]


def report(ensemble):
    varied = ", ".join(f"{n} {in_words(d)}" for n, d in ensemble.distributions.items())
    remarks, diverged = remarks_of(ensemble), int(ensemble.failed.sum())
    draws, time = count(ensemble.samples, "draw"), f"{ensemble.wall_s:.1f} s"
    head = f"{ensemble.case.name}: {draws} ({ensemble.method}, seed {ensemble.seed}), {time}"
    sections = [Live(ensemble), Text([head, f"uncertain: {varied}"]), _measure_table(ensemble)]
    if (finite := ensemble.samples - diverged) < 2:
        words = f"{count(finite, 'run')} finite: a standard deviation and an interval of the mean"
        sections.append(Text([f"{words} need two finite runs"], gap=True))
    if ensemble.limits:
        rows = [
            [v["name"], Value(v["limit"], unit=v["unit"]), v["count"], Value(v["probability"], 4)]
            + [Value(v["interval95"], 4, between=" : ")]
            for v in ensemble.violations()
        ]
        heads = ["limit", "value", "broken in", "probability", "95 % interval"]
        sections.append(Table(rows, heads, gap=True, top=True))
    lines = [f"{INTERVALS} (these draws are {ensemble.method})"] * (ensemble.method != "random")
    lines.append(
        f"{count(diverged, 'run')} diverged: counted as breaking every limit, left out of all"
        " other figures"
    )
    sections += [Text(lines, gap=True), Text(remarks)]
    if ensemble.infeasible is not None:
        lost = count(int(ensemble.infeasible.sum()), "draw")
        words = (
            f"{lost} without a steady state within rims and pump limits at some plateau of the"
            " reference: included in all figures"
        )
        sections.append(Text([words]))
    if ensemble.promise is not None:
        sections += _promise_sections(ensemble)
    facts = [("draws", ensemble.samples), ("runs that diverged", diverged), ("time", time)]
    case, verdict, advised = ensemble.case, verdict_of(ensemble), advice_of(ensemble)
    return Report(case.name, "uncertainty", verdict, facts, sections, case.title, advice=advised)


def advice_of(ensemble):
    samples, words = ensemble.samples, []
    if violations := ensemble.violations():
        words.append(f"limits hold on {int(ensemble.held.sum())} of {count(samples, 'draw')}")
        worst = max(violations, key=lambda v: v["count"])
        bound = advice.amount(worst["limit"], worst["unit"], 5)
        if worst["count"]:
            often = f"{worst['words']} passes its limit of {bound}"
            words.append(f"most often {often}, in {worst['count']}")
    error = ensemble.summary().get("rms_error_total")
    if error is not None and error["p50"] is not None:
        unit = ms.unit("rms_error_total", ensemble.case.loop.units)
        words.append(f"median RMS error {advice.amount(error['p50'], unit)}")
    lost = ensemble.infeasible
    gives = f"It gives: {'; '.join(words) or 'no limit and no error to judge by'}."
    if advice.follows_none(ensemble.case):
        return advice.Advice(advice.NO_GAINS, gives, advice.NO_SETPOINTS)
    if lost is None or not lost.any():
        where = None if lost is None else f"each of {count(samples, 'draw')}"
        beyond = advice.reachable(ensemble.case, where)
    else:
        which = "; jaxtank tune says which" if is_tunable(ensemble.case) else ""
        beyond = (
            f"{advice.beyond_gains(ensemble.case)}: on {int(lost.sum())} of"
            f" {count(samples, 'draw')} one needs a level above a rim or an input outside"
            f" its range{which}.{advice.blocked_too(ensemble.case)}"
        )
    on_such_plants = "jaxtank tune searches for gains that hold on such plants"
    search = on_such_plants if violations and not ensemble.held.all() else advice.BETTER
    return advice.Advice(advice.nothing_to_set(ensemble.case, search), gives, beyond)


def verdict_of(ensemble):
    samples, violations = ensemble.samples, ensemble.violations()
    diverged, parts = int(ensemble.failed.sum()), {}
    if diverged:
        parts["outcome"] = verdicts.Part(f"{diverged} of {count(samples, 'run')} diverged", False)
    if (part := _tracking(ensemble)) is not None:
        parts["tracking"] = part
    if violations:
        worst = max(violations, key=lambda v: v["count"])
        holding, share = int(ensemble.held.sum()), verdicts.shown(100 * worst["probability"])
        of = f"{worst['words']} (limit {verdicts.shown(worst['limit'], 5)} {worst['unit']})"
        most = f"most often broken: {of}, in {share} % of the draws"
        none = not worst["count"]
        parts["limits"] = verdicts.Part("no limit is broken" if none else most, none)
        interval = clopper_pearson(holding, samples)
        parts["plants"] = verdicts.plants(holding, samples, "draws", interval=interval)
    if promise := ensemble.promise:  # of its own, weighted runs
        sentence = promise_sentence(promise)
        parts["plants"] = verdicts.Part(
            sentence[0].lower() + sentence[1:], promise.answer == "kept"
        )
    if not parts:
        return verdicts.outcome(f"{count(samples, 'draw')}, no limits to judge them by")
    return verdicts.Verdict(**parts)


def _tracking(ensemble):
    """Whether every draw keeps to its setpoints; None where none are followed."""
    loop, measures = ensemble.case.loop, ensemble.measures
    missing = [n for n in ms.TRACKED if n not in measures and ms.serves(n, loop)]
    if missing and not isinstance(loop.controller, UNJUDGED):
        return verdicts.Part(f"setpoints are not judged without {' and '.join(missing[:2])}")
    columns = {n: np.asarray(measures[n]) for n in ms.TRACKED if n in measures}
    lost = not_tracking(loop, columns, ensemble.failed)
    if lost is None:
        return None
    if not lost.any():
        return verdicts.Part("every draw keeps to its setpoints")
    example = verdicts.tracking(loop, {n: v[np.argmax(lost)] for n, v in columns.items()})
    many = verdicts.astray(lost, "draws", ensemble.infeasible, loop)
    return verdicts.Part(many if example is None else f"{many}, as: {example.words}", False)


def _measure_table(ensemble):
    """The statistics of every measure, a row for each of its entries."""
    rows = []
    for name, summary in ensemble.summary().items():
        each = ms.entry_units(name, ensemble.case.loop.plant)
        shape, per = ensemble.measures[name].shape[1:], ms.MEASURES[name].per
        columns = [np.nan if summary[q] is None else summary[q] for q in QUANTITIES]
        columns = [np.broadcast_to(values, shape).ravel() for values in columns]
        ends = summary["mean_interval95"]
        for i in range(len(columns[0])):
            label = entry_label(ensemble.case.loop.plant, name, per, i)
            mean, *others = (Value(values[i], 4) for values in columns)
            interval = "-"
            if ends is not None:
                interval = Value([np.ravel(end)[i] for end in ends], 4, between=" : ")
            unit = each if isinstance(each, str) else each[i]
            rows.append([label, unit, mean, interval, *others])
    heads = ["measure", "unit", "mean", "95 % of the mean", "sd", "5 %", "median", "95 %"]
    return Table(rows, [*heads, "mean of worst 5 %", "highest"], gap=True)


def promise_sentence(promise):
    inverse = 1.0 / promise.promise
    rate = f"{100 * promise.promise:g} %"
    if abs(inverse - round(inverse)) < 1e-6 * inverse:
        rate = f"1 in {round(inverse):,}"
    runs = f"{promise.runs:,} runs, {promise.gradients:,} of them with derivatives"
    interval = Value(promise.interval95, 3, between=" to ")
    estimate = f"probability {Value(promise.probability, 3)}, 95 % interval {interval}, from {runs}"
    condition = "given that the parameters are distributed as stated"
    if promise.cut is not None and promise.cut < RARE:
        condition += f", normal ones within {promise.cut:g} standard deviations"
    if promise.answer == "undecided":
        return (
            f"Undecided: a share of {rate} plants that break any limit, {condition}, lies within"
            f" the 95 % interval ({estimate}); more --samples allow more runs"
        )
    fewer = "fewer" if promise.answer == "kept" else "more"
    return (
        f"With 95 % confidence {fewer} than {rate} plants break any limit, {condition} ({estimate})"
    )


def _promise_sections(ensemble):
    """The sentence on the promise, how often each limit is the one broken, likely failures."""
    promise, loop = ensemble.promise, ensemble.case.loop
    lines = [
        "A kind of failure that search and runs missed would be among the plain draws with 95 %"
        f" confidence if its probability were above {Value(promise.unseen, 2)}."
    ]
    if promise.subset_simulation is not None:
        size = Value(promise.subset_simulation, 3)
        lines.append(
            f"The slopes of the margins led to no failure; subset simulation estimates {size}."
        )
    sections: list[Any] = [Text(lines, heading="Promise", gap=True)]
    if promise.limits:
        rows = [[name, Value(100 * share, 3, "%")] for name, share in promise.limits.items()]
        sections.append(Table(rows, ["limit", "share of failures that break it most"], gap=True))
    likely = promise.failures[:LIKELY]
    if likely and likely[0]["values"]:
        rows = [
            [name, describe(loop, name)["unit"], Value(get_value(loop, name))]
            + [Value(failure["values"][name]) for failure in likely]
            for name in likely[0]["values"]
        ]
        heads = [f"failure at {failure['distance']:.2f} sd" for failure in likely]
        sections.append(Table(rows, ["parameter", "unit", "nominal", *heads], gap=True))
    return sections


def in_words(d):
    if isinstance(d, distributions.Empirical):
        return f"{count(len(d.names), 'parameter')}, {count(len(d.draws), 'draw')} of all together"
    if isinstance(d, distributions.Correlated):
        means = "" if d.mean is None else " and custom means"
        return f"{count(len(d.names), 'parameter')}, correlated, with a covariance{means}"
    if isinstance(d, distributions.Discrete):
        weights = "" if d.weights is None else ", ".join(f"{w:g}" for w in d.weights)
        values = ", ".join(f"{v:g}" for v in d.values)
        return f"one of {values}" + (f" (weights {weights})" if weights else "")
    kind = {
        distributions.Uniform: "uniform",
        distributions.LogUniform: "uniform in the logarithm",
        distributions.Normal: f"normal, truncated at {getattr(d, 'cut', 0):g} sd",
    }[type(d)]
    return f"{_extent(d)} ({kind}{', all entries together' if d.tied else ''})"


def _extent(d):
    """How wide a Uniform, LogUniform or Normal is."""
    if getattr(d, "relative", None) is not None:
        share = f"{100 * d.relative:g} %"
        return f"{share} sd" if isinstance(d, distributions.Normal) else f"+-{share}"
    if getattr(d, "factor", None) is not None:
        return f"within a factor {d.factor:g}"
    if isinstance(d, distributions.Normal):
        return (f"{d.mean:g} " if d.mean is not None else "") + f"sd {d.sd:g}"
    return f"{d.low:g} to {d.high:g}"


def draws_csv(ensemble):
    """Yield every draw as CSV, some lines at a time."""
    units = {m: f" [{ms.unit(m, ensemble.case.loop.units)}]" for m in ensemble.measures}
    columns = [(table, name) for table in (ensemble.values, ensemble.measures) for name in table]
    heads = ["draw", "failed"]
    for table, name in columns:
        entries = math.prod(table[name].shape[1:])
        index = [f"[{i}]" if entries > 1 else "" for i in range(entries)]
        heads += [f"{name}{i}{units.get(name, '')}" for i in index]
    yield csv_line(heads)
    for rows in row_blocks(ensemble.samples, LINES):
        numbers = [np.arange(rows.start, rows.stop), ensemble.failed[rows]]
        numbers += [table[name][rows].reshape(len(numbers[0]), -1) for table, name in columns]
        out = io.StringIO()
        np.savetxt(out, np.column_stack(numbers), delimiter=",", fmt="%.10g")
        yield out.getvalue()


def figures(ensemble):
    from jaxtank.plots import run as plots
    from jaxtank.plots.uncertainty import fan, violations

    drawings, loop = {}, ensemble.case.loop
    if ensemble.fan is not None:
        first, finite = ensemble.fan["of"], ensemble.fan["draws"]
        some = f"the first {first} of {ensemble.samples} draws"
        of = some if first < ensemble.samples else count(first, "draw")
        of = of if finite == first else f"{finite} of {of}, the others diverged"
        limits = {lim.index: lim.value for lim in ensemble.limits if lim.measure == "max_level"}
        drawings["fan"] = fan(loop, ensemble.fan, f"{ensemble.case.name}: {of}", limits)
    if ensemble.limits:
        drawings["violations"] = violations(ensemble.violations(), ensemble.samples)
    return drawings | plots.rig(loop.plant, None, ensemble.case.name)


def save(ensemble, folder, command=None):
    files, stale = {"draws.csv": draws_csv(ensemble)}, earlier(folder, CAPTIONS)
    draw, page = lambda: figures(ensemble), lambda: report(ensemble)
    written = save_all(folder, json_of(ensemble), files, draw, page, CAPTIONS, command, stale)
    discard(Path(folder))
    return written
