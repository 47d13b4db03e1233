"""The report of an Identification: message, tables, JSON, files and the page report.html.

Opened by `Identification` and by the command `identify`.
"""

import io
import warnings
from pathlib import Path

import numpy as np

from jaxtank import rig as rigs
from jaxtank.core.files import check_folder
from jaxtank.core.units import local
from tuning.identification.confidence import at_search_bounds
from tuning.problem import provenance
from tuning.report import artifacts, html, tables
from tuning.report import figures as pictures
from tuning.report.identification_figures import CAPTIONS, figures

__all__ = ["figures", "json_of", "lines", "message", "save"]


def not_identifiable(direction):
    """Return what a direction leaves open: a parameter's name, or a step of several together."""
    names = list(direction["parameters"])
    return names[0] if len(names) == 1 else direction["words"]


def message(found):
    """Return how an identification ended, sentences separated by "; "."""
    agree = sum(s["agrees"] for s in found.starts)
    return "; ".join(
        [
            *_ending(found),
            f"{agree} of {len(found.starts)} starts ended in the same place",
            *_residuals(found),
            *_prior(found),
            *(
                f"{n} ends at its bound, {p['value']:.4g} {p['unit']}: no interval"
                for n, p in found.parameters.items()
                if p["at_bound"]
            ),
            *_next_step(found),
        ]
    )


def _ending(found):
    """Return sentences: why the result is not a converged one."""
    words = []
    if found.status == "interrupted":
        words.append("interrupted: the best of the searches that had ended")
    ended = at_search_bounds(found.case.loop, found.parameters)
    if found.status == "not_converged" and ended:
        words.append(
            f"{', '.join(ended)} {'ends' if len(ended) == 1 else 'end'} at the bound of the search:"
            " check the ranges (--free), and units and columns of the data"
        )
    if found.status == "not_converged" and found.fit.status <= 0:
        words.append("the best search did not converge in its iterations: raise --iterations")
    for d in found.directions:
        alone = len(d["parameters"]) == 1
        what = f"{not_identifiable(d)} is not" if alone else "not separately"
        words.append(f"{what} identifiable: {d['words']} changes no reading noticeably")
    if found.status == "not_identifiable":
        words.append("of the values that fit equally well, some near the case's own are printed")
    return words


def _residuals(found):
    """Return sentences: the residual of each channel, and what its correlation means."""
    q, words = found.quality, []
    for (name, unit), rmse, share, rho in zip(
        found.channels, q["rmse"], q["nrmse_percent"], q["residual_autocorrelation"]
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
    return words


def _prior(found):
    """Return a sentence: the covariance that the case brings is not used."""
    if found.case.covariance is None:
        return []
    count = len(found.case.covariance[0])
    return [
        f"the [covariance] of {count} parameter{'s' * (count > 1)} of an earlier identification, in"
        f" {found.case.name!r}, is not used: values and intervals are those of these data alone;"
        " give the earlier log too, with another --data"
    ]


def _next_step(found):
    """Return sentences: what the identified rig needs before it is tuned."""
    words = []
    if not found.identifiable:
        return words
    if found.case.reachable and (why := rigs.unreachable(found.identified)):
        words.append(
            f"{why}; rig.toml has reachable = false for it: choose other setpoints before tuning"
        )
    if found.law:
        words.append(_proposal(found))
    return words


def _proposal(found):
    """Return a sentence: the controller that is proposed."""
    case, why = found.proposed
    if why:
        return f"no {found.law} controller is proposed: {why}"
    pi = case.loop.controller
    Kc, Ti = (", ".join(f"{v:.4g}" for v in np.asarray(values)) for values in (pi.Kc, pi.Ti))
    unit = local("V/cm", case.loop.units)
    return (
        f"proposed: PI with controller.Kc = {Kc} {unit}, controller.Ti = {Ti} s, from the"
        " identified model (T-sum rule), to be tuned"
    )


def lines(found):
    """Return what is printed of an Identification: lines and tables."""
    simulations = sum(s["evaluations"] for s in found.starts)
    return [
        f"{found.case.name}: {found.status.replace('_', ' ')}",
        _data(found.estimation),
        "",
        _parameters(found),
        "",
        _levels(found),
        "",
        tables.wrap(message(found)),
        *(["", *_validation(found)] if found.validation else []),
        *(["", *_remedies(found)] if found.remedies else []),
        *(["", _profile(found.profile)] if found.profile else []),
        "",
        f"{found.wall_s:.1f} s, {simulations} simulations with sensitivities",
    ]


def _data(est):
    """Return a line: how much experiment data, and how it is simulated."""
    readings = int(est.mask.sum())
    steps = np.concatenate([np.diff(one.t) for one in est.logs])
    even = np.ptp(steps) < 1e-6 * steps.mean()
    pace = (
        f"every {np.median(steps):g} s" if even else f"{steps.min():g} to {steps.max():g} s apart"
    )
    missing = sum(one.y.size for one in est.logs) - readings
    return (
        f"{', '.join(one.name for one in est.logs)}: {sum(one.samples for one in est.logs)} samples"
        f" {pace}, {readings} readings"
        + (f" ({missing} missing)" if missing else "")
        + f", {est.size} unknowns, {est.substeps} Runge-Kutta step{'s' if est.substeps > 1 else ''}"
        " a sample"
    )


def _parameters(found):
    """Return the table of estimates."""
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


def _levels(found):
    """Return lines: the levels at the first sample of each log."""
    unit, rows = found.case.loop.units[0], []
    for e, row in enumerate(found.levels):
        levels = []
        for i, level in enumerate(row):
            ends = level["interval95"]
            interval = f" ({ends[0]:.4g} .. {ends[1]:.4g})" if ends else ""
            levels.append(f"h{i + 1} {level['value']:.4g}{interval}")
        which = f" of log {e + 1}" if len(found.levels) > 1 else ""
        rows.append(f"levels at the first sample{which} [{unit}]: " + ", ".join(levels))
    return "\n".join(rows)


def _validation(found):
    """Return a line and a table: prediction of the validation set."""
    v, rows = found.validation, []
    for c, (name, unit) in enumerate(found.channels):
        for side, words in (("fitted", "fitted"), ("held_back", "validation")):
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
        f"fit to the first {', '.join(map(str, v['samples']))} samples, validated on the rest by"
        " one simulation from the same start"
    )
    return [head, tables.table(rows, ["reading", "part", "RMS", "fit"])]


def _remedies(found):
    """Return lines: which experiments would identify what is not identifiable."""
    alone = all(len(d["parameters"]) == 1 for d in found.directions)
    what = "it" if alone and len(found.directions) == 1 else "them" if alone else "them separately"
    return [f"What would identify {what}:", *(f"- {words}" for words in found.remedies)]


def _profile(p):
    """Return a line: the interval of the profile likelihood."""
    unit = "" if p["unit"] == "-" else f" {p['unit']}"
    ends = [
        f"{e:.5g}{unit}" if e is not None else f"beyond the {side} one tried"
        for e, side in zip(p["interval95"], ("lowest", "highest"))
    ]
    return f"profile likelihood of {p['name']}: 95 % from {ends[0]} to {ends[1]}"


def json_of(found):
    """Return the JSON object of `jaxtank identify --json`."""
    names, correlation = found.correlation
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
            for (n, u), s in zip(found.channels, quality["noise"])
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


def fit_csv(found):
    """Return CSV text: number of the log, time, inputs, measured and simulated readings."""
    est = found.estimation
    simulated = est.predicted(est.unknowns(found.fit))
    drive, pumps = found.case.loop.units[1], est.data.u.shape[-1]
    heads = ["log", "t [s]", *(f"pump{j + 1} [{drive}]" for j in range(pumps))]
    for name, unit in found.channels:
        heads += [f"{name} measured [{unit}]", f"{name} simulated [{unit}]"]
    out = io.StringIO()
    out.write(",".join(heads) + "\n")
    for e, one in enumerate(est.logs):
        for k in range(one.samples):
            cells = [str(e + 1), f"{one.t[k]:.10g}", *(f"{v:.10g}" for v in one.u[k])]
            for y, model in zip(est.data.y[e, k], simulated[e, k]):
                cells += ["" if np.isnan(y) else f"{y:.10g}", f"{model:.10g}"]
            out.write(",".join(cells) + "\n")
    return out.getvalue()


def page_of(found, drawn, command=None):
    """Return the page report.html with `drawn`, {name: figure}, and the command line, if any."""
    certain = sum(p["interval95"] is not None for p in found.parameters.values())
    facts = [
        ("parameters with an interval", f"{certain} of {len(found.parameters)}"),
        ("samples", str(sum(one.samples for one in found.estimation.logs))),
    ]
    for (name, unit), rmse, share in zip(
        found.channels, found.quality["rmse"], found.quality["nrmse_percent"]
    ):
        percent = "" if share is None else f" ({share:.1f} %)"
        facts.append((f"residual of {name}", f"{rmse:.3g} {unit}{percent}"))
    sentences = message(found)
    refused = found.status == "not_identifiable"
    rig, why = (None, None) if refused else artifacts.rig_text(found.identified)
    return html.document(
        f"{found.case.name}: identified",
        ", ".join(one.name for one in found.estimation.logs),
        found.status.replace("_", " "),
        found.status == "converged",
        facts,
        [*sentences.split("; "), *([why] if why else [])],
        html.drawings(drawn, {n: CAPTIONS[n.split("_")[0]] for n in drawn}),
        [part for part in lines(found)[1:] if part != tables.wrap(sentences)],
        command,
        provenance.provenance(found.case, found.seed),
        {"The identified rig as a file (rig.toml)": rig} if rig else None,
    )


def save(found, folder, command=None):
    """Write result.json, fit.csv, figures, report.html and, if identifiable, rig.toml to
    `folder`.
    """
    check_folder(folder)
    rig, why = artifacts.rig_text(found.identified) if found.identifiable else (None, None)
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
    """Return files of an earlier identification in the folder that this one does not write."""
    # A rig file of the earlier one must not be taken for that of this one.
    if not (folder / "fit.csv").exists():
        return []
    ours = [folder / n for n in ("rig.toml", "fit.png", "correlation.png", "profile.png")]
    ours += sorted(folder.glob("fit_[0-9]*.png"))
    return [path for path in ours if path.name not in files and path.is_file()]
