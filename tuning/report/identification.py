"""The report of an Identification, and of a planned experiment: text, JSON, pictures and files."""

import dataclasses
import warnings
from pathlib import Path
from typing import Any

import numpy as np

from jaxtank import rig as rigs
from jaxtank.core.labels import label_of, labels_of, reading_label, signal_units, units_of_inputs
from jaxtank.core.text import count
from jaxtank.core.tree import describe, get_value
from tuning.identification import residuals
from tuning.identification.confidence import at_search_bounds
from tuning.identification.experiment import NAMED, names_of, remarks_on
from tuning.identification.identified_case import LACKS, rounded_delays
from tuning.identification.moments import too_many
from tuning.problem import provenance
from tuning.report import verdict as verdicts
from tuning.report.advice import Advice, changes, listed
from tuning.report.document import Report, Text
from tuning.report.folder import earlier, rig_text, save as save_all
from tuning.report.tables import Table, Value, clean, csv_text, fields

CAPTIONS = {
    "fit": "Measured readings (dots), the fitted rig (line), and the inputs of the pumps.",
    "residuals": "Residuals of the fitted rig: over time, and their autocorrelation. What lies"
    " beyond the band is not noise.",
    "correlation": "Correlation of the estimates: near 1 or -1, the data determine a combination of"
    " the two better than each.",
    "profile": "Increase of the misfit when one parameter is fixed away from its estimate and all"
    " others are fitted again.",
    "rig": "The rig, drawn from its own topology; a heavier outline is a tank that is controlled.",
}

DOUBT = 1e-3  # probability of a change below which data and prior contradict each other

ODD = {  # {kind of an oddity in experiment data: sentence}
    "frozen": "{log}: {where} is frozen at {value:.6g} {unit} for {count} from {first:g} s on,"
    " while inputs or other levels move: leave these cells empty",
    "saturated": "{log}: {where} stays at {value:.6g} {unit} for {count} from {first:g} s on, an"
    " end of what its sensor reads: leave these cells empty where the level went on",
    "spike": "{log}: {where} has {count} that jump away and back, the first {value:.6g} {unit} at"
    " {first:g} s: leave them empty, or --loss huber",
    "held": "{log}: {where} repeats {count} until it has changed by {value:.6g} {unit}, written on"
    " change: leave the repeated cells empty",
    "off": "{log}: {where} is off throughout: these data tell nothing of its gain",
    "still": "{log}: {where} is {value:.6g} {unit} throughout: its gain is known only from the"
    " balance with the other flows",
}

CAUSES = {  # {kind of a cause: what the data need}
    "pump-delay": "a dead time of {pump}",
    "pump-lag": "a lag of {pump}",
    "dead-zone": "a dead zone of {pump}",
    "pump-curve": "a curve of {pump}, by its exponent at half input",
    "sensor-offset": "an offset of the sensor of {tank}",
    "sensor-scale": "a scale error of the sensor of {tank}",
    "leak": "a leak of {tank}",
    "outlet-exponent": "another exponent of the outlet of {tank}",
    "inflow": "a constant inflow into {tank}",
    "area": "an area of {tank} that differs from the rig's",
    "rangeability": "another rangeability of {pump}",
    "swapped": "the columns of {tank} exchanged",
    "swapped-inputs": "the columns of {pump} exchanged",
}

EXPERIMENTS = {  # {kind of a cause: experiment that distinguishes it}
    "pump-delay": "steps of the pump, sampled faster",
    "pump-lag": "steps of the pump, sampled faster",
    "dead-zone": "the pump held at three inputs or more, one of them near 0",
    "pump-curve": "the pump held at three inputs or more, one of them near 0",
    "sensor-offset": "a reading of the empty tank",
    "sensor-scale": "a level measured by hand near the rim, with its reading",
    "leak": "the level recorded with pumps off and outlets shut",
    "outlet-exponent": "a drain test from near the rim to near empty",
    "inflow": "all pumps off, and levels that settle",
    "area": "a known volume added with the outlets shut",
    "rangeability": "the valve held at three openings or more, one of them near 0",
    "swapped": "a step of one pump, and which reading moves first",
    "swapped-inputs": "a step of one pump, and which reading moves first",
}

PUMPS = ("pump-delay", "pump-lag", "dead-zone", "pump-curve", "rangeability", "swapped-inputs")
"""Kinds of causes located at inputs."""
FROM_RIG = ("leak", "area", "outlet-exponent", "inflow", "rangeability")
"""Kinds of which the rig has a value."""
FIT = ("rmse", "nrmse_percent", "residual_autocorrelation")
LATE = ("pump-delay", "pump-lag")  # look like inputs on no line from row to row

PARTS = {  # {kind of a part that was added to a rig: what it is}
    "sensor-curve": "a curve of the sensor of {}",
    "outlet-exponent": "an exponent of an outlet of {}",
    "outlet-linear": "a linear outlet of {}, beside the other",
    "area": "the cross-section of {}",
}

SAME = 5e-4  # relative change of a value below which it is not to be set [-]
LEGEND: dict[str, Any] = {"loc": "lower right", "bbox_to_anchor": (1.0, 0.98)}  # above the axes


def not_identifiable(direction):
    """Return an unidentifiable direction: the name of a parameter, or a step of several."""
    names = list(direction["parameters"])
    return names[0] if len(names) == 1 else direction["words"]


def sentences_of(fit):
    """Return sentences: the outcome of an identification, and the next step."""
    agree = sum(s["agrees"] for s in fit.starts)
    words = [*_ending(fit), f"{agree} of {len(fit.starts)} starts ended in the same place"]
    for sentences in (_residuals, _likelihood, _refinements, _prior, _posterior):
        words += sentences(fit)
    words += [
        f"{n} ends at its bound, {p['value']:.4g} {p['unit']}: no interval"
        for n, p in fit.parameters.items()
        if p["at_bound"]
    ]
    if fit.identifiable:
        words += [
            f"{name} = {value:.4g} s is {whole:g} s in the identified rig, whole samples of"
            f" clock.dt = {fit.identified.clock.dt:g} s: a shorter clock.dt comes nearer"
            for name, value, whole in rounded_delays(fit)
        ]
        if fit.case.reachable and (why := rigs.unreachable(fit.identified)):
            other = "rig.toml has reachable = false for it: choose other setpoints before tuning"
            words.append(f"{why}; {other}")
        words += [_proposal(fit)] if fit.law else []
    if fit.identifiable and _is_rejected(fit):
        words.append(
            "these data reject the structure of the rig: intervals and [covariance] are those of a"
            " rejected structure (rejected = true in rig.toml) and hold for no plant of another"
        )
    return words


def oddities_json(oddities):
    """Return the JSON objects of oddities, each with its sentence."""
    pairs = zip(oddities, sentences_on(oddities))
    return [clean(odd._asdict() | {"sentence": sentence}) for odd, sentence in pairs]


def sentences_on(oddities):
    return [
        ODD[odd.kind].format(**odd._asdict() | {"count": count(odd.count, "reading")})
        for odd in oddities
    ]


def data_json(log):
    """Return the JSON object of a log."""
    return {"name": log.name, "samples": log.samples, "notes": list(log.remarks)}


def diagnosis_of(fit):
    """Return {"clean", "causes", "sentence"}: whether the structure of the rig is right."""
    if fit.status == "interrupted":
        return {"clean": None, "causes": [], "sentence": "not tested: interrupted"}
    causes = []
    for cause in fit.structure.causes:
        row = {name: value for name, value in cause._asdict().items() if name != "name"}
        row["interval95"] = row["interval95"] if fit.structure.white else None
        alike = [{"kind": kind, "where": where} for kind, where in cause.equivalent]
        causes.append(clean(row | {"equivalent": alike}))
    return {"clean": fit.structure.clean, "causes": causes, "sentence": "; ".join(_structure(fit))}


def _structure(fit):
    """Return sentences: causes that the rig lacks, and those equivalent to them."""
    causes, words = fit.structure.causes, []
    if fit.structure.clean:
        return ["no test rejects the structure of the rig"]
    for cause in causes:
        to_add = f"to add it to the rig: --accept {_option(cause)}"
        words.append(f"the data require {_needed(fit, cause)}; {to_add}")
        others = _indistinguishable(fit, cause)
        if others:
            words.append(
                f"these data cannot distinguish it from {' or '.join(others)}; an experiment that"
                f" can: {EXPERIMENTS[cause.kind]}"
            )
    if not fit.structure.white:
        words.append(_not_white(fit))
    return words


def _indistinguishable(fit, cause):
    """Return the other explanations of the effect of a cause."""
    others = [_named(fit, kind, where) for kind, where in cause.equivalent]
    logs = [log for log in fit.estimation.logs if log.hold == "first-order"]
    late = cause.value if cause.kind in LATE and cause.value is not None else np.inf
    # the longest time between rows over which an input changes
    gap = lambda log: np.diff(log.t)[np.any(np.diff(log.u, axis=0) != 0, axis=1)]
    if any(late < np.max(gap(log), initial=0.0) for log in logs):
        others.append("inputs that step at each row (--hold zero-order)")
    if _assumed(fit, "lines", "steps") or any(map(too_many, fit.estimation.logs)):
        others.append("inputs that change between rows, at moments that the log does not give")
    if any(log.assumed.get("inflow") == "left out" for log in fit.estimation.logs):
        others.append("an inflow that no column gives")
    return others


def _assumed(fit, *courses):
    """Whether inputs between the rows of a log are assumed to be one of some courses."""
    return any(log.assumed.get("inputs") in courses for log in fit.estimation.logs)


def _not_white(fit):
    """Return the sentence on a residual that the causes do not explain, or only in part."""
    residual = (
        "the residual after these causes is not white: fit again with --accept; if it is not white"
        " then"
    )
    if not fit.structure.causes:
        shares = zip(fit.channels, fit.quality["nrmse_percent"])
        fits = ", ".join(f"fit of {n} {v:.0f} %" for (n, _), v in shares if v is not None)
        residual = f"the residual ({fits}) is not white, and no tested cause explains it"
    moments = " inputs may change between rows (log a row at each change);"
    untold = _assumed(fit, "lines") or any(map(too_many, fit.estimation.logs))
    moments = moments if untold else ""
    return (
        f"{residual},{moments} an inflow may vary without a column, or"
        " the rig may lack a part (--refine tests curves of sensors, outlets and areas)"
    )


def _option(cause):
    return f"{cause.kind}:{','.join(map(str, np.ravel(cause.where)))}"


def lacking(fit):
    """Return the causes that the data require and the rig does not have, as --accept takes them."""
    causes = [] if fit.status == "interrupted" else fit.structure.causes
    return [_option(cause) for cause in causes]


def marked(fit):
    """Return the identified case with the missing parts in its name, and `rejected` set."""
    case, lacks = fit.identified, lacking(fit)
    case = dataclasses.replace(case, rejected=_is_rejected(fit))
    return dataclasses.replace(case, name=f"{case.name}{LACKS}{listed(lacks)}") if lacks else case


def _is_rejected(fit):
    return fit.status != "interrupted" and (not fit.structure.clean or contradicted(fit))


def contradicted(fit):
    """Whether these data alone differ from the prior, with a probability below DOUBT."""
    return fit.prior is not None and fit.prior["probability"] < DOUBT


def _named(fit, kind, where):
    plant, at = fit.case.loop.plant, [int(i) - 1 for i in np.ravel(where)]
    part = "pump" if kind in PUMPS else "tank"
    return CAUSES[kind].format(**{part: labels_of(plant, part, at)})


def _needed(fit, cause):
    """Return a cause in words, with its value and interval where it has one."""
    need = _named(fit, cause.kind, cause.where)
    if cause.value is None:
        return need
    unit = "" if cause.unit == "-" else f" {cause.unit}"
    present = cause.present if cause.kind in FROM_RIG else 0.0
    beside = f" instead of {present:.4g}" if present else ""
    if not fit.structure.white:
        return f"{need}, about {cause.value:.2g}{unit}{beside}"  # an interval would not hold
    words = "between inputs " if cause.interval95 is None else ""
    low, high = cause.interval95 or cause.between
    return f"{need}, {cause.value:.4g}{unit}{beside} ({words}{low:.4g} .. {high:.4g})"


def verdict_of(fit):
    kinds = dict.fromkeys(odd.kind for odd in fit.oddities if odd.alters_fit)
    names = ["spikes" if kind == "spike" else f"{kind} readings" for kind in kinds]
    words = [f"data with {' and '.join(names)}"] if names else []
    converged = fit.status == "converged"
    words += [fit.status.replace("_", " ")] if not converged or fit.structure.clean else []
    words += [_structure(fit)[0]] if fit.status != "interrupted" else []
    words += ["these data contradict the prior"] if contradicted(fit) else []
    return verdicts.outcome("; ".join(words), converged and not _is_rejected(fit))


def _ending(fit):
    """Return sentences: the reasons why the fit has not converged."""
    words = []
    if fit.status == "interrupted":
        words.append("interrupted: the best of the searches that had ended")
    if fit.status == "not_converged":
        if ended := at_search_bounds(fit.case.loop, fit.parameters):
            words.append(
                f"{', '.join(ended)} {'ends' if len(ended) == 1 else 'end'} at the bound of the"
                " search: check the ranges (--free), and units and columns of the data; the other"
                " intervals hold only for that value"
            )
        if fit.fit.status <= 0:
            words.append("the best search did not converge in its iterations: raise --iterations")
    for d in fit.directions:
        alone = len(d["parameters"]) == 1
        name = f"{not_identifiable(d)} is not" if alone else "not separately"
        words.append(f"{name} identifiable: {d['words']} changes no reading noticeably")
    if fit.status == "not_identifiable":
        words.append("of the values that fit equally well, some near the case's own are printed")
    return words


def _residuals(fit):
    """Return sentences: the residual of each channel, and the effect of its correlation."""
    q, words = fit.quality, []
    for (name, unit), rmse, share, rho in zip(fit.channels, *(q[n] for n in FIT)):
        percent = "" if share is None else f", fit {share:.1f} %"
        correlation = f"correlation from sample to sample {rho:.2f}"
        words.append(f"{name}: residual {rmse:.3g} {unit} RMS{percent}, {correlation}")
    if q["widened"] > 1.05:
        words.append(f"intervals are {q['widened']:.1f} times wider, for correlated residuals")
    return words


def _likelihood(fit):
    chosen = fit.likelihood
    if chosen.get("asked", "output-error") == "output-error":
        return []
    why = {"asked": "as asked", "white": "as the residuals are white"}.get(chosen["reason"])
    if chosen["bic"]:
        values = ", ".join(f"{v:.1f} for {kind}" for kind, v in chosen["bic"].items())
        why = f"by the lower BIC, {values}"
    words = f"likelihood: {chosen['kind']}, {why}"
    if chosen["kind"] == "innovations":
        unit, plant = fit.case.loop.units[0], fit.case.loop.plant
        gained = enumerate(chosen["process_noise"])
        process = ", ".join(f"{label_of(plant, 'tank', i)} {sd:.2g}" for i, sd in gained)
        readings = zip(fit.channels, fit.quality["noise"])
        noise = ", ".join(f"{name} {sd:.3g} {of}" for (name, of), sd in readings)
        words += f"; process noise [{unit}/s^0.5]: {process}; noise of the readings: {noise}"
    return [words]


def _refinements(fit):
    noise, words = fit.estimation.noise, []
    scale, unit = (noise[0], fit.channels[0][1]) if len(noise) == 1 else (1.0, "times the noise")
    for part in fit.refinements:
        plant, tank = fit.case.loop.plant, part.where
        read = part.kind == "sensor-curve"
        label = reading_label(plant, tank) if read else label_of(plant, "tank", tank)
        what = PARTS[part.kind].format(label)
        words.append(
            f"added: {what}: RMS error in left-out quarters of the data {scale * part.after:.3g}"
            f" {unit}, {scale * part.before:.3g} without it (linearised cross-validation)"
        )
    return words


def _prior(fit):
    """Return sentences: what an earlier identification, the [covariance] of the case, counts."""
    if fit.case.covariance is None:
        return []
    if fit.prior is None:
        names = count(len(fit.case.covariance[0]), "parameter")
        return [
            f"the [covariance] of {names} of an earlier identification, in {fit.case.name!r}, is"
            " not used: values and intervals follow from these data alone"
        ]
    words = [
        f"prior: the [covariance] of {', '.join(fit.prior['names'])} in {fit.case.name!r}, which"
        " must follow from other data than these (--no-prior: these data alone)"
        + "; those data rejected the structure with which it was estimated"
        * fit.case.rejected
    ]
    if contradicted(fit):
        words.append(
            f"these data contradict the prior (probability {fit.prior['probability']:.1g}): the rig"
            " has changed, or one of the two logs does not describe it; compare with --no-prior"
        )
    return words


def _posterior(fit):
    if fit.posterior is None:
        return []
    rhat, size = max(fit.posterior.rhat.values()), min(fit.posterior.effective.values())
    ends = "" if fit.posterior.mixed else "; the chains disagree: do not use the intervals"
    return [
        f"posterior: intervals and covariance from {len(fit.posterior.values)} draws of the"
        f" No-U-Turn sampler; largest R-hat {rhat:.3f}, smallest effective sample size"
        f" {size:.0f}{ends}"
    ]


def draws_csv(fit):
    """Return the draws of the posterior as CSV text: `--vary NAME=draws:FILE` reads it."""
    rows = (",".join(f"{v:.10g}" for v in row) for row in fit.posterior.values)
    return "\n".join([",".join(f'"{name}"' for name in fit.posterior.names), *rows]) + "\n"


def _proposal(fit):
    case, why = fit.proposed
    if why:
        return f"no {fit.law} controller is proposed: {why}"
    pi = case.loop.controller
    Kc, Ti = (", ".join(f"{v:.4g}" for v in np.asarray(values)) for values in (pi.Kc, pi.Ti))
    unit = describe(case.loop, "controller.Kc")["unit"]
    return (
        f"proposed: PI with controller.Kc = {Kc} {unit}, controller.Ti = {Ti} s, from the"
        " identified model (T-sum rule), to be tuned"
    )


def report(fit, page=False):
    """Return the Report of an Identification; `page`: with the rig file."""
    certain = sum(p["interval95"] is not None for p in fit.parameters.values())
    facts: list[tuple[str, Any]] = [
        ("parameters with an interval", f"{certain} of {len(fit.parameters)}"),
        ("samples", sum(log.samples for log in fit.estimation.logs)),
    ]
    rig, why = rig_text(marked(fit)) if page and fit.identifiable else (None, None)
    simulations = sum(s["evaluations"] for s in fit.starts)
    more = [] if fit.status == "interrupted" else _structure(fit)[1:]
    sections = [
        Text([*sentences_on(fit.oddities), *more], items=True),
        Text(remarks_on(fit.estimation.logs), items=True),
        Text([_data(fit.estimation)]),
        _parameters(fit),
        Text(_levels(fit), gap=True),
        Text([*sentences_of(fit), *([why] if why else [])], items=True, gap=True),
        *(*_validation(fit), *_remedies(fit), *_profile(fit.profile)),
        Text([f"{fit.wall_s:.1f} s, {simulations} simulations with sensitivities"], gap=True),
    ]
    verdict, names = verdict_of(fit), names_of(fit.estimation.logs)
    files, advice = {"The identified rig as a file (rig.toml)": rig} if rig else {}, advice_of(fit)
    return Report(fit.case.name, "identified", verdict, facts, sections, names, files, advice)


def advice_of(fit):
    errors = zip(fit.channels, fit.quality["rmse"])
    rest = [f"{n} {verdicts.shown(rmse)} {unit}" for (n, unit), rmse in errors if rmse is not None]
    gives = f"It gives: residuals {listed(rest)} RMS."
    return Advice(f"Diagnosis: {_short_diagnosis(fit)}; {_to_set(fit)}.", gives, _open(fit))


def _to_set(fit):
    """The values to set, as part of a sentence."""
    changed = [
        f"{n} {changes(p['before'], p['value'], p['unit'], 4)}"
        for n, p in fit.parameters.items()
        if p["interval95"] and abs(p["value"] - p["before"]) > SAME * abs(p["before"])
    ]
    if fit.status in ("not_converged", "interrupted"):
        ended = "was interrupted" if fit.status == "interrupted" else "has not converged"
        return f"set nothing: the search {ended}"
    if lacking(fit):
        return "set nothing: the values below are those of a rig without what the data require"
    if not fit.identifiable:
        return "set nothing from these data"
    if contradicted(fit):
        return "set nothing: the values below are a mean of data that contradict each other"
    return f"set {listed(changed)}" if changed else "set nothing: the values of the rig stand"


def _open(fit):
    """The sentence on parameters or structure that the data do not determine."""
    unknown = [n for n, p in fit.parameters.items() if not p["interval95"]]
    if ends := [n for n in unknown if fit.parameters[n]["at_bound"]]:
        return f"Stays open: {listed(ends)}, at an end of its range: state a wider one (--free)."
    if unknown:
        return f"These data cannot tell: {listed(unknown)} (no interval); another experiment can."
    if contradicted(fit):
        return "It stays open which of the two logs describes the rig, or whether it has changed."
    if _is_rejected(fit):
        return (
            "The structure of the rig stays open: the intervals are those of one that the data"
            " reject."
        )
    return (
        "Nothing stays open: every parameter has an interval, which holds if areas and scales of"
        " sensors are as the rig states them."
    )


def _short_diagnosis(fit):
    """The diagnosis of an identification as part of a sentence."""
    if fit.status == "interrupted":
        return "not tested, interrupted"
    if contradicted(fit):
        return "these data contradict the prior (--no-prior: these data alone)"
    if fit.structure.clean:
        return "the structure of the rig explains the data"
    if not fit.structure.causes:
        return "the residual is more than noise, and no tested cause explains it"
    words = [_needed(fit, cause) for cause in fit.structure.causes]
    return f"the data require {' and '.join(words[:2])}{' and more' * (len(words) > 2)} (--accept)"


def _data(est):
    """Return a line: how much experiment data, and how it is simulated."""
    readings = int(est.mask.sum())
    steps = np.concatenate([np.diff(log.t) for log in est.logs])
    pace = f"{steps.min():g} to {steps.max():g} s apart"
    if np.ptp(steps) < 1e-6 * steps.mean():
        pace = f"every {np.median(steps):g} s"
    missing = sum(log.y.size for log in est.logs) - readings
    return (
        f"{names_of(est.logs)}: {sum(log.samples for log in est.logs)} samples"
        f" {pace}, {readings} readings{f' ({missing} missing)' if missing else ''}, {est.size}"
        f" unknowns, {count(est.substeps, 'Runge-Kutta step')} a sample"
    )


def _parameters(fit):
    """Return the table of estimates."""
    rows = []
    for n, p in fit.parameters.items():
        interval = "none: " + ("at a bound" if p["at_bound"] else "not identifiable")
        if p["interval95"]:
            interval = Value(p["interval95"], between=" .. ")
        share = None if p["sd"] is None or not p["value"] else 100 * p["sd"] / abs(p["value"])
        cells = [Value(p["before"]), Value(p["value"]), interval, Value(share, 2, "%")]
        rows.append([n, p["unit"], *cells])
    heads = ["parameter", "unit", "before", "estimate", "95 % interval", "sd"]
    return Table(rows, heads, gap=True, top=True)


def _levels(fit):
    """Return lines: the levels at the first sample of each log, up to NAMED."""
    rows = []
    for e, row in enumerate(fit.levels[:NAMED]):
        which = f" of log {e + 1}" if len(fit.levels) > 1 else ""
        levels = [
            f"{reading_label(fit.case.loop.plant, i)} {level['value']:.4g}"
            + (" ({:.4g} .. {:.4g})".format(*ends) if (ends := level["interval95"]) else "")
            for i, level in enumerate(row)
        ]
        head = f"levels at the first sample{which} [{fit.case.loop.units[0]}]"
        rows.append(f"{head}: {', '.join(levels)}")
    if (more := len(fit.levels) - NAMED) > 0:
        rows.append(f"those of {more} more: --json")
    return rows


def _validation(fit):
    """Return sections: prediction of the validation set."""
    v = fit.validation
    if not v:
        return []
    rows = [
        [name, side, Value(q["rmse"][c], 4, unit), Value(q["nrmse_percent"][c], 3, "%")]
        for c, (name, unit) in enumerate(fit.channels)
        for side, q in {"fitted": v["fitted"], "validation": v["held_back"]}.items()
    ]
    early = any(log.early is not None for log in fit.estimation.logs)
    counts = ", ".join(map(str, sorted(set(v["samples"]))))
    each = " of each log" if len(v["samples"]) > 1 else ""
    head = (
        f"fit to the first {counts} samples{each}, validated on the rest by"
        " one simulation from the same start"
        + ", in which inputs change in the middle of their steps"
        * early
    )
    return [Text([head], gap=True), Table(rows, ["reading", "part", "RMS", "fit"])]


def _remedies(fit):
    """Return sections: experiments that would identify the other parameters."""
    alone = all(len(d["parameters"]) == 1 for d in fit.directions)
    names = "it" if alone and len(fit.directions) == 1 else "them" + " separately" * (not alone)
    head = Text([f"What would identify {names}:"], gap=True)
    return [head, Text(fit.remedies, items=True)] if fit.remedies else []


def _profile(p):
    """Return a section: the interval of the profile likelihood."""
    if not p:
        return []
    ends = [
        f"beyond the {side} one tried" if e is None else str(Value(e, 5, p["unit"].strip("-")))
        for e, side in zip(p["interval95"], ("lowest", "highest"))
    ]
    words = f"profile likelihood of {p['name']}: 95 % from {ends[0]} to {ends[1]}"
    return [Text([words], gap=True)]


def json_of(fit):
    names, correlation = fit.correlation
    quality, est, free = fit.quality, fit.estimation, fit.covariance
    noise, draws = zip(fit.channels, quality["noise"]), fit.posterior
    readings = lambda log: {"readings": int(np.isfinite(log.y).sum())}
    return {
        "case": fit.case.name,
        "verdict": verdict_of(fit).to_json(),
        "advice": list(advice_of(fit)),
        "status": str(fit.status),
        "success": fit.status == "converged",
        "message": "; ".join(sentences_of(fit)),
        "diagnosis": diagnosis_of(fit),
        **fields(fit, "parameters remedies validation profile starts wall_s prior likelihood"),
        **fields(fit, "initial_levels=levels free_combinations=directions"),
        "fit": {n: clean(quality[n]) for n in FIT},
        "channels": [{"name": n, "unit": u, "noise": s} for (n, u), s in noise],
        "intervals_widened": quality["widened"],
        "refinements": [clean(p._asdict() | {"where": p.where + 1}) for p in fit.refinements],
        "posterior": draws and {"draws": len(draws.values), **fields(draws, "rhat effective")},
        "oddities": oddities_json(fit.oddities),
        "covariance": {"names": list(free[0]), "matrix": np.asarray(free[1]).tolist()},
        "correlation": {"names": list(names), "matrix": correlation.tolist()},
        "data": [data_json(log) | readings(log) for log in est.logs],
        "substeps": est.substeps,
        "provenance": provenance.provenance(fit.case, fit.seed),
    }


def fit_csv(fit):
    """Return CSV text: number of the log, time, inputs, measured and simulated readings."""
    est, units = fit.estimation, signal_units(fit.case.loop.plant, fit.case.loop.units)[1:]
    simulated = est.predicted(est.unknowns(fit.fit))
    heads = ["log", "t [s]", *(f"pump{j + 1} [{unit}]" for j, unit in enumerate(units))]
    for name, unit in fit.channels:
        heads += [f"{name} measured [{unit}]", f"{name} simulated [{unit}]"]
    rows: list[list[Any]] = [heads]
    for e, log in enumerate(est.logs):
        for k in range(log.samples):
            readings = np.column_stack([est.data.y[e, k], simulated[e, k]]).ravel()
            rows.append([e + 1, log.t[k], *log.u[k], *readings])
    return csv_text(rows)


def save(fit, folder, command=None):
    from jaxtank.plots import run as plots

    rig, why = rig_text(marked(fit)) if fit.identifiable else (None, None)
    payload = json_of(fit)
    if why:
        warnings.warn(why, stacklevel=3)  # the line that called fit.save
        payload["message"] += f"; {why}"
    files = {"fit.csv": fit_csv(fit), **({"rig.toml": rig} if rig else {})}
    files |= {} if fit.posterior is None else {"draws.csv": draws_csv(fit)}
    stale, old = earlier(folder, ["residuals", "rig"]), Path(folder)
    if (old / "fit.csv").exists():  # the rig file of an earlier result must not remain
        names = ["rig.toml", "fit.png", "correlation.png", "profile.png"]
        paths = [*(old / name for name in names), *old.glob("fit_[0-9]*.png")]
        stale += [path for path in paths if path.name not in files and path.is_file()]
    draw = lambda: figures(fit) | plots.rig(fit.identified.loop.plant, None, fit.case.name)
    page = lambda: report(fit, page=True)
    return save_all(folder, payload, files, draw, page, CAPTIONS, command, stale)


def figures(fit):
    """Return {name: matplotlib Figure}: "fit" (or "fit_1", ..), "residuals", "correlation", .."""
    from jaxtank.plots import fit as plots
    from jaxtank.plots.style import picture

    est, rows = fit.estimation, len(fit.channels)
    title = lambda words: f"{fit.case.name}: {words}"
    drawings = draw_log(fit, "measured and simulated with the fitted rig", fit.validation)
    of = f" (the first of {len(est.logs)} logs; correlations of all)" if len(est.logs) > 1 else ""
    words, size = title(f"measured less simulated{of}"), (8.4, 0.9 + 1.9 * rows)
    draw = lambda axes: _residual_axes(axes, fit)
    drawings["residuals"] = picture(draw, size, rows, 2, title=words, squeeze=False)
    names, matrix = fit.correlation
    if len(names) > 1:
        side, words = 2.6 + 0.42 * len(names), title("correlation of the estimates")
        draw = lambda ax: plots.correlation(ax, names, matrix)
        drawings["correlation"] = picture(draw, (side + 1.0, side), title=words)
    if fit.profile:
        draw, words = lambda ax: plots.profile(ax, fit.profile), title("profile likelihood")
        drawings["profile"] = picture(draw, (5.2, 3.4), title=words)
    return drawings


def draw_log(fit, words, validation=None):
    """Return {"fit": matplotlib Figure}, or "fit_1", .., of the logs of a fit or a prediction."""
    from jaxtank.plots.style import picture

    est, rows, drawings = fit.estimation, len(fit.channels), {}
    simulated = est.predicted(est.unknowns(fit.fit))
    for e, log in enumerate(est.logs):
        draw = lambda axes, e=e: _fit(axes, fit, e, simulated[e], validation)
        title = f"{fit.case.name}: {log.name}, {words}"
        name = f"fit_{e + 1}" if len(est.logs) > 1 else "fit"
        size = (7.0, 1.0 + 1.7 * (rows + 1))
        drawings[name] = picture(draw, size, rows + 1, title=title, sharex=True)
    return drawings


def _fit(axes, fit, e, simulated, validation):
    """Draw log e: readings, simulated (samples, channels), and inputs."""
    from jaxtank.plots import fit as plots

    est, log = fit.estimation, fit.estimation.logs[e]
    n, validated = log.samples, validation and validation["samples"][e]
    begin = log.t[validated] if validation and validated < n else None
    for c, (name, unit) in enumerate(fit.channels):
        plots.measured(axes[c], log.t, est.data.y[e, :n, c], simulated[:n, c], name, unit, begin)
    axes[0].legend(ncols=3, **LEGEND)
    plots.inputs(axes[-1], log.t, log.u, units_of_inputs(fit.case.loop.plant))
    if log.u.shape[1] > 1:
        axes[-1].legend(ncols=log.u.shape[1], **LEGEND)
    axes[0].figure.align_ylabels(axes)


def _residual_axes(axes, fit):
    """Draw the residuals over time and their autocorrelation."""
    from jaxtank.plots import fit as plots

    differences, log = residuals.residuals_of(fit.estimation, fit.fit), fit.estimation.logs[0]
    for c, (name, unit) in enumerate(fit.channels):
        r, noise = differences[..., c], fit.quality["noise"][c]
        plots.residual(axes[c, 0], log.t, r[0, : log.samples], name, unit, noise)
        acf, readings = residuals.autocorrelation(r), int(np.isfinite(r).sum())
        plots.autocorrelation(axes[c, 1], acf, readings, name)
        for ax in axes[c] if c < len(axes) - 1 else ():
            ax.set_xlabel("")
    for ax in axes[0]:
        ax.legend(**LEGEND)
    axes[0, 0].figure.align_ylabels(axes)


def plan_report(case, experiments, best, plan):
    """Return the Report of `identify --plan`: a table of `compare_experiments` and the best one."""
    # plan: {"duration" [s], "dt" [s], "noise", "levels": measured tanks or None}.
    letters, rows = dict(zip("ABCDEFGH", experiments)), []
    for name in next(iter(experiments.values()))["sd"]:
        value = float(np.asarray(get_value(case.loop, name)))
        deviations = [experiment["sd"][name] for experiment in experiments.values()]
        rows.append([name, Value(value), *(_share(sd, value) for sd in deviations)])
    conditions = [experiment["condition"] for experiment in experiments.values()]
    numbers = [None if c is None or c > 1e15 else c for c in conditions]
    rows.append(["condition of J'J", "", *(Value(c, 3) for c in numbers)])
    levels = plan["levels"]
    labels = [reading_label(case.loop.plant, i) for i in levels or ()]
    measured = "every level" if levels is None else ", ".join(labels)
    head = (
        f"{case.name}: standard deviations that {plan['duration']:g} s, {measured} read every"
        f" {plan['dt']:g} s with noise of {plan['noise']:g} {case.loop.units[0]} would leave"
    )
    inputs = "; ".join(map(_working, experiments.inputs))
    sections = [
        Text([head]),
        Table(rows, ["parameter", "value", *letters], gap=True),
        Text([f"{letter}  {name}" for letter, name in letters.items()], gap=True),
        Text([f"inputs of the operating point: {inputs}"], gap=True),
    ]
    return Report(case.name, "planned experiments", plan_verdict(best), (), sections)


def _working(row):
    """An input at the operating point of planned experiments, with its small change."""
    value, change = Value(row["value"], 4, row["unit"]), Value(row["change"], 3, row["unit"])
    return f"{row['input']} {value} (small changes {change})"


def plan_verdict(best):
    """Return the Verdict on planned experiments: the most informative one."""
    words = f"most informative: {best}" if best else "none identifies all of these parameters"
    return verdicts.outcome(words, bool(best))


def _share(sd, value):
    """A standard deviation in per cent of a value, or in its unit where that is 0."""
    if sd is None:
        return "open"
    return Value(100 * sd / abs(value), 2, "%") if value else Value(sd, 2)
