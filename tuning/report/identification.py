"""What an identification says: tables, JSON, pictures, the rig that goes on to `tune`."""

import io
import warnings
from pathlib import Path

import numpy as np

from jaxtank import rig as rigs
from jaxtank.core.files import check_folder
from jaxtank.core.units import local
from tuning.identification import confidence as idf
from tuning.identification.confidence import stopped
from tuning.report import artifacts, html, tables
from tuning.report import figures as pictures
from tuning.search import provenance

FEW = 0.5
"""Share of the starts that must agree for the answer not to say that few did."""


def channel_names(found):
    """[(name, unit)] of the channels."""
    length = found.case.loop.units[0]
    return [
        (f"h{tank + 1}", "V" if volts else length)
        for tank, volts in found.estimation.record.channels
    ]


def untold(direction):
    """What the data leave open: one parameter (its name), or several that stand in for each other
    ("apart", by how much).
    """
    names = list(direction["parameters"])
    return names[0] if len(names) == 1 else f"apart {direction['words']}"


def message(found):
    """How it ended, in words."""
    words, names = [], channel_names(found)
    if found.status == "interrupted":
        words.append("interrupted: the best of the searches that had ended")
    ended = stopped(found.case.loop, found.parameters)
    if found.status == "not_converged" and ended:
        words.append(
            f"{', '.join(ended)} {'ends' if len(ended) == 1 else 'end'} at the bound of the search:"
            " ranges (--free), units or columns of the log are not this rig's"
        )
    if found.status == "not_converged" and found.fit.status <= 0:
        words.append(
            "the best search had not converged when its iterations ended: more of them with"
            " --iterations"
        )
    for d in found.directions:
        whom = next(iter(d["parameters"])) if len(d["parameters"]) == 1 else "apart"
        words.append(
            f"the data cannot tell {whom}: {d['words']} changes no reading that could be seen"
        )
    if found.status == "not_identifiable":
        words.append("of the values that fit alike some near to the case's own are printed")
    agree = sum(s["agrees"] for s in found.starts)
    words.append(f"{agree} of {len(found.starts)} starts ended in the same place")
    q = found.quality
    for (name, unit), rmse, share, rho in zip(
        names, q["rmse"], q["nrmse_percent"], q["residual_autocorrelation"]
    ):
        fit = "" if share is None else f", fit {share:.1f} %"
        words.append(
            f"{name}: residual {rmse:.3g} {unit} RMS{fit}, correlation from sample to sample"
            f" {rho:.2f}"
        )
    if q["widened"] > 1.05:
        words.append(
            "residuals are correlated, so that the model and not the noise limits the fit:"
            f" intervals are widened {q['widened']:.1f} times for it"
        )
    for n, p in found.parameters.items():
        if p["at_bound"]:
            words.append(f"{n} ends at its bound, {p['value']:.4g} {p['unit']}: no interval")
    if identifiable(found) and found.case.reachable and (why := rigs.unreachable(found.identified)):
        words.append(
            f"{why}; rig.toml says reachable = false for it: choose other setpoints before tuning"
        )
    if identifiable(found) and found.law:
        words.append(_proposal(found))
    return "; ".join(words)


def _proposal(found):
    """The controller that is proposed, in words."""
    case, why = found.proposed
    if why:
        return f"no {found.law} controller is proposed: {why}"
    law, (length, drive) = case.loop.controller, case.loop.units
    Kc, Ti = (", ".join(f"{v:.4g}" for v in np.asarray(values)) for values in (law.Kc, law.Ti))
    unit = local("V/cm", (length, drive))
    return (
        f"proposed: PI with controller.Kc = {Kc} {unit}, controller.Ti = {Ti} s, from the"
        " identified model (T-sum rule), to be tuned"
    )


def identifiable(found):
    """Whether every parameter is identified, so that a rig may be written."""
    return all(p["identifiable"] for p in found.parameters.values())


def _table(found):
    rows = []
    for n, p in found.parameters.items():
        interval = (
            f"{p['interval95'][0]:.5g} .. {p['interval95'][1]:.5g}"
            if p["interval95"]
            else "none: " + ("at a bound" if p["at_bound"] else "not identifiable")
        )
        sd = (
            f"{100 * p['sd'] / abs(p['value']):.2g} %"
            if p["sd"] is not None and p["value"]
            else "-"
        )
        rows.append([n, p["unit"], f"{p['before']:.5g}", f"{p['value']:.5g}", interval, sd])
    return tables.table(rows, ["parameter", "unit", "before", "estimate", "95 % interval", "sd"])


def lines(found):
    """What is printed of an Identification: lines and tables."""
    est = found.estimation
    readings = int(est.mask.sum())
    steps = np.concatenate([np.diff(one.t) for one in est.logs])
    even = np.ptp(steps) < 1e-6 * steps.mean()
    pace = (
        f"every {np.median(steps):g} s" if even else f"{steps.min():g} to {steps.max():g} s apart"
    )
    missing = sum(one.y.size for one in est.logs) - readings
    parts = [
        f"{found.case.name}: {found.status.replace('_', ' ')}",
        f"{', '.join(one.name for one in est.logs)}: {sum(one.samples for one in est.logs)} samples"
        f" {pace}, {readings} readings"
        + (f" ({missing} missing)" if missing else "")
        + f", {est.size} unknowns, {est.substeps} Runge-Kutta step{'s' if est.substeps > 1 else ''}"
        " a sample",
        "",
        _table(found),
        "",
        _levels(found),
        "",
        tables.wrap(message(found)),
    ]
    if found.validation:
        parts += ["", *_validation(found)]
    if found.remedies:
        alone = all(len(d["parameters"]) == 1 for d in found.directions)
        whom = "it" if alone and len(found.directions) == 1 else "them" if alone else "them apart"
        parts += ["", f"What would tell {whom}:"]
        parts += [f"- {w}" for w in found.remedies]
    if found.profile:
        p = found.profile
        unit = "" if p["unit"] == "-" else f" {p['unit']}"
        ends = [
            f"{e:.5g}{unit}" if e is not None else f"beyond the {side} one tried"
            for e, side in zip(p["interval95"], ("lowest", "highest"))
        ]
        parts += ["", f"profile likelihood of {p['name']}: 95 % from {ends[0]} to {ends[1]}"]
    parts += ["", f"{found.wall_s:.1f} s, {sum(s['evaluations'] for s in found.starts)} passes"]
    return parts


def _levels(found):
    unit, rows = found.case.loop.units[0], []
    for e, row in enumerate(found.levels):
        said = []
        for i, level in enumerate(row):
            ends = level["interval95"]
            said.append(
                f"h{i + 1} {level['value']:.4g}"
                + (f" ({ends[0]:.4g} .. {ends[1]:.4g})" if ends else "")
            )
        rows.append(
            f"levels at the first sample{f' of log {e + 1}' if len(found.levels) > 1 else ''}"
            f" [{unit}]: " + ", ".join(said)
        )
    return "\n".join(rows)


def _validation(found):
    v, rows = found.validation, []
    for c, (name, unit) in enumerate(channel_names(found)):
        for side, words in (("fitted", "fitted to"), ("held_back", "held back")):
            rmse, share = v[side]["rmse"][c], v[side]["nrmse_percent"][c]
            rows.append(
                [
                    name,
                    words,
                    "-" if rmse is None else f"{rmse:.4g} {unit}",
                    "-" if share is None else f"{share:.1f} %",
                ]
            )
    head = (
        f"fit to the first {', '.join(map(str, v['samples']))} samples, the rest predicted from the"
        " same start"
    )
    return [head, tables.table(rows, ["reading", "part", "RMS", "fit"])]


def json_of(found):
    """The JSON object of `jaxtank identify --json`."""
    names, correlation = correlation_of(found)
    quality, est = found.quality, found.estimation
    return {
        "case": found.case.name,
        "status": str(found.status),
        "success": found.status == "converged",
        "message": message(found),
        "parameters": {n: tables.clean(p) for n, p in found.parameters.items()},
        "fit": tables.clean(
            {k: quality[k] for k in ("rmse", "nrmse_percent", "residual_autocorrelation")}
        ),
        "channels": [
            {"name": n, "unit": u, "noise": s}
            for (n, u), s in zip(channel_names(found), quality["noise"])
        ],
        "intervals_widened": quality["widened"],
        "initial_levels": [[tables.clean(v) for v in row] for row in found.levels],
        "covariance": {
            "names": list(found.covariance[0]),
            "matrix": np.asarray(found.covariance[1]).tolist(),
        },
        "correlation": {"names": list(names), "matrix": correlation.tolist()},
        "free_combinations": tables.clean(found.directions),
        "remedies": found.remedies,
        "validation": tables.clean(found.validation),
        "profile": tables.clean(found.profile),
        "starts": tables.clean(found.starts),
        "data": [
            {"name": one.name, "samples": one.samples, "readings": int(np.isfinite(one.y).sum())}
            for one in est.logs
        ],
        "substeps": est.substeps,
        "wall_s": found.wall_s,
        "provenance": provenance.provenance(found.case, found.seed),
    }


def correlation_of(found):
    """(names, (n, n)) correlation of the estimates that have an interval."""
    names, matrix = found.covariance
    sd = np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    return names, np.asarray(matrix) / np.outer(sd, sd)


def figures(found):
    """{"fit" or "fit_1" ..: readings and inputs of each log; "residuals", "correlation",
    "profile"}: matplotlib Figures.
    """
    import matplotlib.pyplot as plt

    from jaxtank.plots import fit as record_plots
    from jaxtank.plots import responses

    est, made = found.estimation, {}
    told = est.predicted(est.unknowns(found.fit))
    names = channel_names(found)
    with responses.styled():
        for e, one in enumerate(est.logs):
            count = len(names) + 1
            figure, axes = plt.subplots(
                count, 1, figsize=(7.0, 1.0 + 1.7 * count), sharex=True, layout="constrained"
            )
            for c, (name, unit) in enumerate(names):
                held = None
                if found.validation and found.validation["samples"][e] < one.samples:
                    held = one.t[found.validation["samples"][e]]
                record_plots.measured(
                    axes[c],
                    one.t,
                    est.record.y[e, : one.samples, c],
                    told[e, : one.samples, c],
                    name,
                    unit,
                    held,
                )
                if c == 0:
                    axes[c].legend(loc="lower right", bbox_to_anchor=(1.0, 0.98), ncols=3)
            record_plots.inputs(axes[-1], one.t, one.u, found.case.loop.units[1])
            if one.u.shape[1] > 1:
                axes[-1].legend(loc="lower right", bbox_to_anchor=(1.0, 0.98), ncols=one.u.shape[1])
            figure.align_ylabels(axes)
            title = responses.plain(
                f"{found.case.name}: {one.name}, measured and simulated with the fitted rig"
            )
            figure.suptitle(title, fontsize=9)
            made["fit" if len(est.logs) == 1 else f"fit_{e + 1}"] = figure
        left = idf.residuals_of(est, found.fit)
        figure, axes = plt.subplots(
            len(names),
            2,
            figsize=(8.4, 0.9 + 1.9 * len(names)),
            squeeze=False,
            layout="constrained",
        )
        for c, (name, unit) in enumerate(names):
            one = est.logs[0]
            record_plots.residual(
                axes[c, 0], one.t, left[0, : one.samples, c], name, unit, found.quality["noise"][c]
            )
            acf = idf.autocorrelation(left[..., c])
            record_plots.autocorrelation(
                axes[c, 1], acf, int(np.isfinite(left[..., c]).sum()), name
            )
            for ax in axes[c] if c < len(names) - 1 else ():
                ax.set_xlabel("")
        for ax in axes[0]:
            ax.legend(loc="lower right", bbox_to_anchor=(1.0, 0.98))
        figure.align_ylabels(axes)
        more = (
            f" (the first of {len(est.logs)} logs; correlations of all)"
            if len(est.logs) > 1
            else ""
        )
        figure.suptitle(
            responses.plain(f"{found.case.name}: measured less simulated{more}"), fontsize=9
        )
        made["residuals"] = figure
        kept, matrix = correlation_of(found)
        if len(kept) > 1:
            side = 2.6 + 0.42 * len(kept)
            figure, ax = plt.subplots(figsize=(side + 1.0, side), layout="constrained")
            record_plots.correlation(ax, kept, matrix)
            figure.suptitle(
                responses.plain(f"{found.case.name}: correlation of the estimates"), fontsize=9
            )
            made["correlation"] = figure
        if found.profile:
            figure, ax = plt.subplots(figsize=(5.2, 3.4), layout="constrained")
            record_plots.profile(ax, found.profile)
            figure.suptitle(responses.plain(f"{found.case.name}: profile likelihood"), fontsize=9)
            made["profile"] = figure
    return made


def fit_csv(found):
    """Every log's readings beside the simulated ones, as text; the first column tells the log."""
    est = found.estimation
    told = est.predicted(est.unknowns(found.fit))
    names = channel_names(found)
    out = io.StringIO()
    heads = [
        "log",
        "t [s]",
        *(f"pump{j + 1} [{found.case.loop.units[1]}]" for j in range(est.record.u.shape[2])),
    ]
    for name, unit in names:
        heads += [f"{name} measured [{unit}]", f"{name} simulated [{unit}]"]
    out.write(",".join(heads) + "\n")
    for e, one in enumerate(est.logs):
        for k in range(one.samples):
            cells = [str(e + 1), f"{one.t[k]:.10g}", *(f"{v:.10g}" for v in one.u[k])]
            for c in range(len(names)):
                y = est.record.y[e, k, c]
                cells += ["" if np.isnan(y) else f"{y:.10g}", f"{told[e, k, c]:.10g}"]
            out.write(",".join(cells) + "\n")
    return out.getvalue()


CAPTIONS = {
    "fit": (
        "What was measured (dots) and what the fitted rig says (line), with what the pumps were"
        " given."
    ),
    "residuals": (
        "What the fitted rig leaves of the readings: over time, and from sample to sample. Beyond"
        " the band it is not noise."
    ),
    "correlation": (
        "Correlation of the estimates: near 1 or -1, the record tells a combination of the two"
        " better than each."
    ),
    "profile": (
        "How much worse the record fits when one parameter is held away from its estimate and all"
        " others are fitted again."
    ),
    "rig": "The rig, drawn from its own topology; a heavier outline is a tank that is controlled.",
}


def page_of(found, drawn, command=None):
    """The page report.html of an identification, with `drawn`, figures by name; command: the line
    that made it.
    """
    told = sum(p["interval95"] is not None for p in found.parameters.values())
    facts = [
        ("parameters with an interval", f"{told} of {len(found.parameters)}"),
        ("samples", str(sum(one.samples for one in found.estimation.logs))),
    ]
    for (name, unit), rmse, share in zip(
        channel_names(found), found.quality["rmse"], found.quality["nrmse_percent"]
    ):
        facts.append(
            (
                f"residual of {name}",
                f"{rmse:.3g} {unit}" + ("" if share is None else f" ({share:.1f} %)"),
            )
        )
    captions = {n: CAPTIONS[n.split("_")[0]] for n in drawn}
    said = message(found)
    refused = found.status == "not_identifiable"
    rig, why = (None, None) if refused else artifacts.rig_text(found.identified)
    return html.document(
        f"{found.case.name}: identified",
        ", ".join(one.name for one in found.estimation.logs),
        found.status.replace("_", " "),
        found.status == "converged",
        facts,
        [*said.split("; "), *([why] if why else [])],
        html.drawings(drawn, captions),
        [part for part in lines(found)[1:] if part != tables.wrap(said)],
        command,
        provenance.provenance(found.case, found.seed),
        {"The identified rig as a file (rig.toml)": rig} if rig else None,
    )


def save(found, folder, command=None):
    """Write result.json, fit.csv, pictures, report.html and, where every parameter is identified,
    rig.toml to `folder`; returns their paths.

    command: the line that made it, for the report, where there is one.
    """
    check_folder(folder)
    rig, why = artifacts.rig_text(found.identified) if identifiable(found) else (None, None)
    payload = json_of(found)
    if why:
        warnings.warn(why, stacklevel=3)  # the line that called found.save
        payload["message"] += f"; {why}"
    files = {"result.json": tables.dumps(payload), "fit.csv": fit_csv(found)}
    if rig:
        files["rig.toml"] = rig
    stale = [*_left_over(Path(folder), files), *artifacts.earlier(folder, ["residuals", "rig"])]

    def draw():
        return figures(found) | pictures.rig(found.identified.loop, None, found.case.name)

    return artifacts.write_result(
        folder, files, draw, lambda drawn: page_of(found, drawn, command), stale
    )


def _left_over(folder, files):
    """What an earlier identification wrote to the folder and this one does not: a rig that this one
    refuses must not be taken for its own.
    """
    if not (folder / "fit.csv").exists():
        return []
    ours = [
        folder / name for name in ("rig.toml", "fit.png", "correlation.png", "profile.png")
    ] + sorted(folder.glob("fit_[0-9]*.png"))
    return [path for path in ours if path.name not in files and path.is_file()]
