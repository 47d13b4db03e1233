"""The report of an uncertainty study: text, JSON, pictures, page and folder."""

import dataclasses
import io
import math
from pathlib import Path

import numpy as np

from jaxtank import measures as ms
from jaxtank.core.files import check_folder
from jaxtank.loop import step_size
from tuning.problem import provenance
from tuning.problem.wording import count
from tuning.report import artifacts, html, tables
from tuning.report.panel import panel
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


def json_of(ensemble):
    """The JSON object of `jaxtank uncertainty --json`."""
    found = {
        "case": ensemble.case.name,
        "samples": ensemble.samples,
        "failed": int(ensemble.failed.sum()),
        "infeasible": None if ensemble.infeasible is None else int(ensemble.infeasible.sum()),
        "draws": ensemble.method,
        "distributions": {
            n: {"kind": type(d).__name__, **tables.clean(dataclasses.asdict(d))}
            for n, d in ensemble.distributions.items()
        },
        "measures": tables.clean(ensemble.summary()),
        "units": {m: ms.unit(m, ensemble.case.loop.units) for m in ensemble.measures},
        "violations": tables.clean(ensemble.violations()),
        "wall_s": ensemble.wall_s,
        "provenance": provenance.provenance(ensemble.case, ensemble.seed),
    }
    if ensemble.method != "random":
        found["intervals"] = INTERVALS
    if remarks := remarks_of(ensemble):
        found["remarks"] = remarks
    if ensemble.infeasible is None:
        found["infeasible_reason"] = "the steady states of this rig have no closed form"
    if any(
        None in np.ravel(np.array(list(m.values()), dtype=object))
        for m in found["measures"].values()
    ):
        found["reason"] = (
            "null: not a finite number, as a settling time where some draw never settles, or the"
            " standard deviation of one draw"
        )
    return found


def remarks_of(ensemble):
    """Return warnings on the draws: that the steps are too long for the rig before any is drawn."""
    return [
        f"of the rig as it is, and of draws like it: {line}"
        for line in step_size.step_warnings(ensemble.case.loop, ensemble.case.clock)
    ]


def lines(ensemble):
    """Return what is printed of an Ensemble: lines and Tables."""
    varied = ", ".join(f"{n} {in_words(d)}" for n, d in ensemble.distributions.items())
    found = [
        f"{ensemble.case.name}: {count(ensemble.samples, 'draw')} ({ensemble.method}, seed"
        f" {ensemble.seed}), {ensemble.wall_s:.1f} s",
        f"uncertain: {varied}",
        "",
        _measure_table(ensemble),
        "",
    ]
    finite = int(np.sum(~ensemble.failed))
    if finite < 2:
        found.append(
            f"{count(finite, 'run')} finite: a standard deviation and an interval of the mean need"
            " two finite runs"
        )
        found.append("")
    found += _violation_table(ensemble)
    if ensemble.method != "random":
        found.append(f"{INTERVALS} (these draws are {ensemble.method})")
    found.append(
        f"{count(ensemble.samples - finite, 'run')} diverged: counted as breaking every limit, left"
        " out of all other figures"
    )
    found += remarks_of(ensemble)
    if ensemble.infeasible is not None:
        found.append(
            f"{count(int(ensemble.infeasible.sum()), 'draw')} without a steady state within rims"
            " and pump limits at some plateau of the reference: included in all figures"
        )
    return found


def _measure_table(ensemble):
    """The statistics of every measure, a row for each of its entries."""
    rows, units = [], ensemble.case.loop.units
    for name, found in ensemble.summary().items():
        shape, per = ensemble.measures[name].shape[1:], ms.MEASURES[name].per
        columns = [np.nan if found[q] is None else found[q] for q in QUANTITIES]
        columns = [np.broadcast_to(values, shape).ravel() for values in columns]
        ends = found["mean_interval95"]
        for i in range(len(columns[0])):
            label = name if per == "run" else f"{name} of {per} {i + 1}"
            shown = [tables.number(values[i], 4) for values in columns]
            interval = "-"
            if ends is not None:
                interval = " : ".join(tables.number(np.ravel(end)[i], 4) for end in ends)
            rows.append([label, ms.unit(name, units), shown[0], interval, *shown[1:]])
    heads = ["measure", "unit", "mean", "95 % of the mean", "sd"]
    return tables.table(rows, [*heads, "5 %", "median", "95 %", "mean of worst 5 %", "highest"])


def _violation_table(ensemble):
    """How often each limit is broken."""
    if not ensemble.limits:
        return []
    rows = [
        [
            v["name"],
            f"{tables.number(v['limit'])} {v['unit']}",
            v["count"],
            f"{v['probability']:.4g}",
            "{:.4g} : {:.4g}".format(*v["interval95"]),
        ]
        for v in ensemble.violations()
    ]
    heads = ["limit", "value", "broken in", "probability", "95 % interval"]
    return [tables.table(rows, heads), ""]


def in_words(distribution):
    """Return a distribution in words, in the unit of its parameter."""
    d = distribution
    if isinstance(d, Correlated):
        means = "" if d.mean is None else " and means of their own"
        return f"{count(len(d.names), 'parameter')}, correlated, with a covariance{means}"
    if isinstance(d, Discrete):
        weights = (
            "" if d.weights is None else f" (weights {', '.join(f'{w:g}' for w in d.weights)})"
        )
        return f"one of {', '.join(f'{v:g}' for v in d.values)}{weights}"
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
    from tuning.report import figures as pictures

    drawn = {}
    if ensemble.fan is not None:
        drawn["fan"] = responses.fan(
            ensemble.case.loop, ensemble.fan, f"{ensemble.case.name}: {drawn_of(ensemble)}"
        )
    if ensemble.limits:
        drawn["violations"] = responses.violations(ensemble.violations(), ensemble.samples)
    return drawn | pictures.rig(ensemble.case.loop, None, ensemble.case.name)


def drawn_of(ensemble):
    """Return which draws the fan is of, in words: of the first ones those that are finite."""
    first, kept = ensemble.fan["of"], ensemble.fan["draws"]
    of = count(first, "draw")
    if first < ensemble.samples:
        of = f"the first {first} of {ensemble.samples} draws"
    return of if kept == first else f"{kept} of {of}, the others diverged"


CAPTIONS = {
    "fan": (
        "Levels of the first draws (at most 512): the median, the middle half, and 9 in 10 of them"
        " at each moment."
    ),
    "violations": (
        "The probability that a rig of this spread breaks each limit, with its 95 % interval."
    ),
    "rig": "The rig, drawn from its own topology; a heavier outline is a tank that is controlled.",
}


def page_of(ensemble, drawn, command=None):
    """Return the page report.html of an Ensemble."""
    diverged, broken = int(ensemble.failed.sum()), ensemble.violations() if ensemble.limits else []
    facts = [
        ("draws", str(ensemble.samples)),
        ("runs that diverged", str(diverged)),
        ("time", f"{ensemble.wall_s:.1f} s"),
    ]
    sentences = remarks_of(ensemble)
    for fact, sentence in (_worst_limit(ensemble, broken), _typical_error(ensemble)):
        facts[1:1] = fact
        sentences += sentence
    status = "no limit was broken in any draw" if broken else "no limits were given"
    if diverged:
        status = f"{diverged} of {count(ensemble.samples, 'run')} diverged"
    elif any(v["count"] for v in broken):
        status = "some draws break a limit"
    return html.document(
        f"{ensemble.case.name}: uncertainty",
        ensemble.case.title,
        status,
        status.startswith("no "),
        facts,
        sentences,
        html.drawings(drawn, CAPTIONS),
        lines(ensemble),
        command,
        provenance.provenance(ensemble.case, ensemble.seed),
        live=panel(ensemble),
    )


def _worst_limit(ensemble, broken):
    """(facts, sentences) on the limit that is broken most often."""
    if not broken:
        return [], []
    worst = max(broken, key=lambda v: v["probability"])
    low, high = worst["interval95"]
    which = f"{worst['name']} ({tables.number(worst['limit'])} {worst['unit']})"
    sentence = (
        f"{which} is the limit most often broken: in {worst['count']} of {ensemble.samples} draws,"
        f" a probability between {low:.3g} and {high:.3g} with 95 % confidence"
    )
    if not worst["count"]:
        sentence = (
            f"none of {count(ensemble.samples, 'draw')} breaks a limit: the probability of breaking"
            f" a given one is at most {high:.3g}, with 95 % confidence"
        )
    return [("the limit most often broken", f"{100 * worst['probability']:.3g} %")], [sentence]


def _typical_error(ensemble):
    """(facts, sentences) on the total RMS error."""
    found = ensemble.summary().get("rms_error_total")
    if found is None or found["p50"] is None:
        return [], []
    unit = ms.unit("rms_error_total", ensemble.case.loop.units)
    median, low, high = (tables.number(np.ravel(found[k])[0], 4) for k in ("p50", "p05", "p95"))
    sentence = (
        f"rms_error_total: half of the draws lie below {median} {unit}, 9 in 10 between {low} and"
        f" {high} {unit}"
    )
    return [("median rms_error_total", f"{median} {unit}")], [sentence]


def save(ensemble, folder, command=None):
    """Write result.json, draws.csv, pictures and report.html to `folder`; return their paths."""
    check_folder(folder)
    folder = Path(folder)
    files = {
        "result.json": tables.dumps(json_of(ensemble)) + "\n",
        "draws.csv": draws_csv(ensemble),
    }
    written = artifacts.write_result(
        folder,
        files,
        lambda: figures(ensemble),
        lambda drawn: page_of(ensemble, drawn, command),
        artifacts.earlier(folder, CAPTIONS),
    )
    discard(folder)
    return written
