"""Tables, JSON and pictures of an ensemble."""

import dataclasses
import io
from pathlib import Path

import numpy as np

from jaxtank import measures as ms
from jaxtank.core.files import check_folder
from jaxtank.loop import step_size
from tuning.report import artifacts, html, tables
from tuning.search import provenance
from tuning.storage import batch_store
from tuning.uncertainty.distributions import Correlated, Discrete, LogUniform, Normal, Uniform

WORDS = ("mean", "sd", "p05", "p50", "p95", "cvar95", "max")


INTERVALS = (
    "intervals are those of independent draws: exact for random ones, for others an indication that"
    " is mostly too wide"
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
            "null: no finite number, as of a settling time where some draw never settles, or of a"
            " spread of one draw"
        )
    return found


def remarks_of(ensemble):
    """Sentences on what to doubt of the draws: that steps are too long for the rig as it is, before
    anything is drawn.
    """
    return [
        f"of the rig as it is, and of draws like it: {line}"
        for line in step_size.step_warnings(ensemble.case.loop, ensemble.case.clock)
    ]


def lines(ensemble):
    """What is printed of an Ensemble: lines and tables."""
    units, rows = ensemble.case.loop.units, []
    for name, found in ensemble.summary().items():
        shape, per = ensemble.measures[name].shape[1:], ms.MEASURES[name].per
        columns = {
            w: np.broadcast_to(np.nan if found[w] is None else found[w], shape).ravel()
            for w in WORDS
        }
        ends = (
            None
            if found["mean_interval95"] is None
            else [np.ravel(v) for v in found["mean_interval95"]]
        )
        for i in range(len(columns["mean"])):
            label = name if per == "run" else f"{name} of {per} {i + 1}"
            interval = "-" if ends is None else " : ".join(tables.number(end[i], 4) for end in ends)
            shown = [tables.number(columns[w][i], 4) for w in WORDS]
            rows.append([label, ms.unit(name, units), shown[0], interval, *shown[1:]])
    head = [
        "measure",
        "unit",
        "mean",
        "95 % of the mean",
        "sd",
        "5 %",
        "median",
        "95 %",
        "worst 5 %",
        "highest",
    ]
    spread = ", ".join(f"{n} {_words(d)}" for n, d in ensemble.distributions.items())
    words = [
        (
            f"{ensemble.case.name}: {ensemble.samples} draws ({ensemble.method}, seed"
            f" {ensemble.seed}), {ensemble.wall_s:.1f} s"
        ),
        f"uncertain: {spread}",
        "",
        tables.table(rows, head),
        "",
    ]
    finite = int(np.sum(~ensemble.failed))
    if finite < 2:
        words.append("one run has no spread: " if finite else "no run is left: ")
        words[-1] += (
            "a standard deviation and an interval of the mean need two draws that end in numbers"
        )
        words.append("")
    if ensemble.limits:
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
        words += [
            tables.table(rows, ["limit", "value", "broken in", "probability", "95 % interval"]),
            "",
        ]
    if ensemble.method != "random":
        words.append(f"{INTERVALS} (here draws are {ensemble.method})")
    words.append(
        f"{int(ensemble.failed.sum())} runs left the numbers; they count as breaking every limit"
        " and are in no other figure"
    )
    words += remarks_of(ensemble)
    if ensemble.infeasible is not None:
        words.append(
            f"{int(ensemble.infeasible.sum())} draws have a plateau without a steady state within"
            " rims and pumps; they are in all figures"
        )
    return words


def _words(distribution):
    """A distribution in words, in the units of its parameter."""
    d = distribution
    if isinstance(d, Correlated):
        return f"{len(d.names)} of them together, with a covariance" + (
            "" if d.mean is None else " and means of their own"
        )
    if isinstance(d, Discrete):
        return (
            "one of "
            + ", ".join(f"{v:g}" for v in d.values)
            + ("" if d.weights is None else f" (weights {', '.join(f'{w:g}' for w in d.weights)})")
        )
    kind = {
        Uniform: "even",
        LogUniform: "even in the logarithm",
        Normal: f"normal, cut at {getattr(d, 'cut', 0):g} sd",
    }[type(d)]
    if getattr(d, "relative", None) is not None:
        extent = f"{100 * d.relative:g} %" + (" sd" if isinstance(d, Normal) else "")
        extent = extent if isinstance(d, Normal) else f"+-{extent}"
    elif getattr(d, "factor", None) is not None:
        extent = f"within a factor {d.factor:g}"
    elif isinstance(d, Normal):
        extent = (f"{d.mean:g} " if d.mean is not None else "") + f"sd {d.sd:g}"
    else:
        extent = f"{d.low:g} to {d.high:g}"
    return f"{extent} ({kind}{', all entries together' if d.tied else ''})"


def draws_csv(ensemble):
    """Every draw as CSV: its number, what was drawn, whether the run failed, its measures; units in
    the header.
    """
    columns = [("draw", np.arange(ensemble.samples)), ("failed", ensemble.failed.astype(int))]
    for source, unit in ((ensemble.values, None), (ensemble.measures, ms.unit)):
        for name, values in source.items():
            flat = np.asarray(values).reshape(ensemble.samples, -1)
            said = "" if unit is None else f" [{unit(name, ensemble.case.loop.units)}]"
            columns += [
                (name + (f"[{i}]" if flat.shape[1] > 1 else "") + said, flat[:, i])
                for i in range(flat.shape[1])
            ]
    out = io.StringIO()
    out.write(",".join(f'"{head}"' for head, _ in columns) + "\n")
    np.savetxt(out, np.column_stack([v for _, v in columns]), delimiter=",", fmt="%.10g")
    return out.getvalue()


def figures(ensemble):
    """Matplotlib figures {name: figure}: "fan" of the levels, "violations", "rig"."""
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
    """Which draws the fan is of, in words: the first are kept whole, and of these the ones that
    stayed finite.
    """
    first, kept = ensemble.fan["of"], ensemble.fan["draws"]
    whole = f"{first} draw{'' if first == 1 else 's'}"
    of = f"the first {first} of {ensemble.samples} draws" if first < ensemble.samples else whole
    return of if kept == first else f"{kept} of {of}, the rest left the numbers"


CAPTIONS = {
    "fan": (
        "Levels over the draws that were kept whole (at most the first 512): the median, the middle"
        " half, and 9 in 10 of them at each moment."
    ),
    "violations": (
        "The probability that a rig of this spread breaks each limit, with its 95 % interval."
    ),
    "rig": "The rig, drawn from its own topology; a heavier outline is a tank that is controlled.",
}


def page_of(ensemble, drawn, command=None):
    """The page report.html of an ensemble, with `drawn`, the figures of `figures`; command: the
    line that made it.
    """
    failed, broken = int(ensemble.failed.sum()), ensemble.violations() if ensemble.limits else []
    facts = [
        ("draws", str(ensemble.samples)),
        ("runs that left the numbers", str(failed)),
        ("time", f"{ensemble.wall_s:.1f} s"),
    ]
    said = remarks_of(ensemble)
    if broken:
        worst = max(broken, key=lambda v: v["probability"])
        low, high = worst["interval95"]
        facts.insert(1, ("the limit most often broken", f"{100 * worst['probability']:.3g} %"))
        which = f"{worst['name']} ({tables.number(worst['limit'])} {worst['unit']})"
        said.append(
            f"{which} is the limit most often broken: in {worst['count']} of {ensemble.samples}"
            f" draws, a probability between {low:.3g} and {high:.3g} with 95 % confidence"
            if worst["count"]
            else (
                f"a limit that none of {ensemble.samples} draws breaks is broken with a probability"
                f" of at most {high:.3g}, with 95 % confidence"
            )
        )
    found = ensemble.summary().get("rms_error_total")
    if found is not None and found["p50"] is not None:
        unit = ms.unit("rms_error_total", ensemble.case.loop.units)
        shown = [tables.number(np.ravel(found[k])[0], 4) for k in ("p50", "p05", "p95")]
        facts.insert(1, ("median rms_error_total", f"{shown[0]} {unit}"))
        said.append(
            f"rms_error_total: half of the draws lie below {shown[0]} {unit}, 9 in 10 between"
            f" {shown[1]} and {shown[2]} {unit}"
        )
    status = "no limits were asked for" if not broken else "no limit was broken in any draw"
    if failed:
        status = f"{failed} of {ensemble.samples} runs left the numbers"
    elif any(v["count"] for v in broken):
        status = "some draws break a limit"
    return html.document(
        f"{ensemble.case.name}: uncertainty",
        ensemble.case.title,
        status,
        status.startswith("no "),
        facts,
        said,
        html.drawings(drawn, CAPTIONS),
        lines(ensemble),
        command,
        provenance.provenance(ensemble.case, ensemble.seed),
    )


def save(ensemble, folder, command=None):
    """Write result.json, draws.csv, pictures and report.html to `folder`; returns their paths.
    Finished batches that lie there are removed.

    command: the line that made the ensemble, for the report, where there is one.
    """
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
    if (folder / batch_store.MANIFEST).exists():
        for path in folder.glob("part-*.npz"):
            if batch_store.NAME.fullmatch(path.name):
                path.unlink()
        (folder / batch_store.MANIFEST).unlink()
    return written
