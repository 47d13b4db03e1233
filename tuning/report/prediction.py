"""The report of a Prediction: an unchanged rig on experiment data."""

import dataclasses

import numpy as np

from tuning.identification.experiment import names_of, remarks_on
from tuning.identification.prediction import WIDE
from tuning.problem import provenance
from tuning.report import verdict as verdicts
from tuning.report.document import Report, Text
from tuning.report.identification import data_json, draw_log, fit_csv
from tuning.report.tables import Table, Value, clean

ROUNDING = 1e-3  # share of the noise below which residuals are rounding [-]
FAR = 3.0  # correlation, in sd, above which residuals depend on an input
CHANCE = 0.01  # probability below which residuals are called correlated
CAPTIONS = {"fit": "Measured readings (dots), the rig as it is (line), and the inputs."}
SIDES = ("measured", "simulated")
ROWS = 12  # times at which readings are printed side by side


def sentences_of(result):
    q, words = result.quality, []
    for c, (name, unit) in enumerate(result.channels):
        rmse, wide = q["rmse"][c], q["level_sd_in_noise"][c]
        if rmse is None:
            continue
        noise = float(result.estimation.noise[c])
        mean = q["bias"][c] if abs(q["bias"][c]) > 1e-4 * noise else 0.0  # else rounding
        bias = f"{name}: mean residual {mean:.3g} {unit}, noise {noise:.3g} {unit}"
        tests = []
        if rmse < ROUNDING * noise:
            tests.append("residuals are rounding")
        elif q["white"][c] is not None:
            white = q["white"][c] > CHANCE
            tests.append("residuals are white" if white else "residuals are correlated in time")
        if rmse >= ROUNDING * noise and (q["input_correlation"][c] or 0.0) > FAR:
            tests.append("and follow an input: part of its effect is not in the rig")
        words.append(", ".join([bias, " ".join(tests)] if tests else [bias]))
        if not wide > WIDE:
            words.append(
                f"{name} moves by {wide:.2g} standard deviations of its noise: its fit in %"
                " compares the residual with that and says nothing; read the RMSE"
            )
    return words


def verdict_of(result):
    errors = zip(result.channels, result.quality["rmse"])
    words = [f"{name} {verdicts.shown(rmse)} {unit}" for (name, unit), rmse in errors if rmse]
    more = f" and {len(words) - ROWS} others" if len(words) > ROWS else ""
    return verdicts.outcome(f"RMS errors of the prediction: {', '.join(words[:ROWS])}{more}")


def report(result):
    q, logs, n = result.quality, result.estimation.logs, result.start_samples
    start = "all readings" if n is None else f"the first {n} samples"
    columns = zip(result.channels, q["rmse"], q["after_start"]["rmse"], q["nrmse_percent"])
    rows = [
        [name, Value(whole, 4, unit), Value(after, 4, unit), Value(share, 3, "%")]
        for (name, unit), whole, after, share in columns
    ]
    names = names_of(logs)
    samples = sum(log.samples for log in logs)
    early = any(log.early is not None for log in logs)
    fitted = "first levels" + " and moments of the inputs" * early
    facts = [(f"RMSE of {row[0]}", row[1]) for row in rows]
    sections = [
        Text(remarks_on(logs), items=True),
        Text([f"{names}: {samples} samples; no parameter fitted, {fitted} from {start}"]),
        Table(rows, ["reading", "RMSE", "RMSE after the start", "fit"], gap=True),
        Text(sentences_of(result), items=True, gap=True),
    ]
    return Report(result.case.name, f"prediction of {names}", verdict_of(result), facts, sections)


def with_data(report, compared):
    """Return the Report of a run with measured beside simulated readings."""
    t, channels = compared["t"], compared["channels"]
    rows = [
        [f"{t[k]:.6g}", *(Value(c[side][k]) for c in channels for side in SIDES)]
        for k in np.unique(np.linspace(0, len(t) - 1, ROWS).astype(int))
    ]
    heads = [f"{c['name']} {side} [{c['unit']}]" for c in channels for side in SIDES]
    quality = []
    for c in channels:
        values = [Value(c["rmse"], 4, c["unit"]), Value(c["bias"], 3, c["unit"])]
        quality.append([c["name"], *values, Value(c["nrmse_percent"], 3, "%")])
    head = Text([f"inputs of {compared['name']}, from its first readings on"], gap=True)
    errors = Table(quality, ["reading", "RMSE", "mean residual", "fit"])
    tables = [head, errors, Table(rows, ["t [s]", *heads], gap=True)]
    return dataclasses.replace(report, sections=[*report.sections, *tables])


def achieved_table(rows):
    """Return the Table of `achieved` rows: predicted and measured values side by side."""
    cells = []
    for row in rows:
        three = (row[n] for n in ("error", "highest", "lowest"))
        pairs = [values and [values["predicted"], values["achieved"]] for values in three]
        both = ["-" if pair is None else Value(pair, 4, between=" : ") for pair in pairs]
        limit = "-" if row["limit"] is None else Value(row["limit"])
        cells.append([row["name"], row["unit"], *both, limit])
    return Table(cells, ["predicted : achieved", "unit", "rms error", "highest", "lowest", "limit"])


def setpoints_used(rows):
    """Return a sentence: to which setpoints the errors of `achieved` rows are."""
    rows = [row for row in rows if row["error"] is not None]
    columns = dict.fromkeys(repr(row["setpoints"]) for row in rows if row["setpoints"] is not None)
    if not columns:
        return "errors: to the setpoints of the rig, whatever those of the batch were"
    others = dict.fromkeys(row["name"] for row in rows if row["setpoints"] is None)
    rest = f"; of {', '.join(others)}: to those of the rig" if others else ""
    return (
        f"errors achieved: to the setpoints of the batch, {', '.join(columns)}{rest}; predicted:"
        " to those of the rig"
    )


def json_of(result):
    q = result.quality
    tests = ("bias", "residual_autocorrelation", "white", "input_correlation", "level_sd_in_noise")
    return clean(
        {
            "case": result.case.name,
            "verdict": verdict_of(result).to_json(),
            "fit": {name: q[name] for name in ("rmse", "nrmse_percent")},
            "after_start": q["after_start"],
            "tests": {name: q[name] for name in tests},
            "start_samples": result.start_samples,
            "initial_levels": np.asarray(result.levels).tolist(),
            "channels": [{"name": name, "unit": unit} for name, unit in result.channels],
            "data": [data_json(log) for log in result.estimation.logs],
            "message": "; ".join(sentences_of(result)),
            "provenance": provenance.provenance(result.case, None),
        }
    )


def figures(result):
    return draw_log(result, "measured and predicted")


def files_of(result):
    return {"fit.csv": fit_csv(result)}
