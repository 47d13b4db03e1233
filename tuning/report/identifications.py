"""The report of Identifications: many records, each fitted separately."""

from typing import Any

import numpy as np

from jaxtank.core.labels import reading_label
from jaxtank.core.text import count
from tuning.problem import provenance
from tuning.report import verdict as verdicts
from tuning.report.document import Report, Text
from tuning.report.tables import Table, Value, clean, csv_text

LISTED = 12  # most records that are printed one by one; `estimates.csv` has all of them
CAPTIONS = {
    "estimates": "Estimate of each record with its 95 % interval; a record without an interval is a"
    " cross."
}


def labels(fits):
    """Return a name of each record that no other has."""
    if len(set(fits.logs)) == len(fits.logs):
        return list(fits.logs)
    return [f"{name} {e + 1}" for e, name in enumerate(fits.logs)]


def report(fits):
    converged, records = int(fits.converged.sum()), count(len(fits), "record")
    head = (
        f"{fits.case.name}: {records}, each fitted separately; {converged} converged, at most"
        f" {fits.iterations} iterations"
    )
    sections = [
        Text([head]),
        _summary(fits),
        *([_records(fits)] if len(fits) <= LISTED else []),
        Text(_residuals(fits), gap=True),
        Text([f"{fits.wall_s:.1f} s"], gap=True),
    ]
    facts, what = [("records", len(fits)), ("converged", converged)], f"{records} identified"
    return Report(fits.case.name, what, verdict_of(fits), facts, sections)


def verdict_of(fits):
    converged = int(fits.converged.sum())
    words = f"{converged} of {count(len(fits), 'fit')} converged"
    return verdicts.outcome(words, converged == len(fits))


def _summary(fits):
    rows = []
    for name, unit, values, sd in zip(fits.names, fits.units, fits.values.T, fits.sd.T):
        certain = sd[np.isfinite(sd)]
        spread = values.std(ddof=1) if len(values) > 1 else None
        mean = certain.mean() if certain.size else None
        cells = [Value(values.mean()), Value(spread, 2), Value(mean, 2)]
        rows.append([name, unit, *cells, f"{certain.size} of {len(fits)}"])
    head = ["parameter", "unit", "mean", "sd over records", "mean sd of a fit", "with an interval"]
    return Table(rows, head, gap=True)


def _records(fits):
    """Return the table of the estimates of each record, with their standard deviations."""
    rows = []
    for name, converged, values, sd in zip(labels(fits), fits.converged, fits.values, fits.sd):
        certain = [f"sd {v:.2g}" if np.isfinite(v) else "no interval" for v in sd]
        estimates = [f"{value:.5g} ({v})" for value, v in zip(values, certain)]
        rows.append([name, "yes" if converged else "NO", *estimates])
    heads = [f"{n} [{u}]" for n, u in zip(fits.names, fits.units)]
    return Table(rows, ["record", "converged", *heads], gap=True)


def _residuals(fits):
    """Return a line a channel: residuals over all records."""
    words = []
    for c, (name, unit) in enumerate(fits.channels):
        rmse, rho = (x[:, c][np.isfinite(x[:, c])] for x in (fits.rmse, fits.autocorrelation))
        mean = f", mean correlation from sample to sample {rho.mean():.2f}" if rho.size else ""
        if rmse.size:
            span = f"{rmse.min():.3g} to {rmse.max():.3g}"
            words.append(f"{name}: residual {span} {unit} RMS{mean}")
    return words


def json_of(fits):
    return {
        "case": fits.case.name,
        "verdict": verdict_of(fits).to_json(),
        "success": bool(fits.converged.all()),
        "channels": [{"name": n, "unit": u} for n, u in fits.channels],
        "records": [_record(fits, e, name) for e, name in enumerate(labels(fits))],
        "iterations": int(fits.iterations),
        "wall_s": fits.wall_s,
        "provenance": provenance.provenance(fits.case, None),
    }


def _record(fits, e, name):
    interval = np.isfinite(fits.interval95[e]).all(axis=-1)
    parameters = {}
    for i, parameter in enumerate(fits.names):
        row = {"value": fits.values[e, i], "unit": fits.units[i], "sd": fits.sd[e, i]}
        parameters[parameter] = row | {"interval95": fits.interval95[e, i] if interval[i] else None}
    levels = zip(fits.levels[e], fits.levels_sd[e])
    row = {
        "name": name,
        "converged": fits.converged[e],
        "parameters": parameters,
        "covariance": fits.covariance[e],
        "initial_levels": [{"value": value, "sd": sd} for value, sd in levels],
        "fit": {"rmse": fits.rmse[e], "residual_autocorrelation": fits.autocorrelation[e]},
    }
    return clean(row)


def figures(fits):
    from jaxtank.plots import style

    columns = min(3, len(fits.names))
    rows = -(-len(fits.names) // columns)
    record = np.arange(1, len(fits) + 1)

    def draw(axes):
        style.hide(axes.flat[len(fits.names) :])
        for i, ax in zip(range(len(fits.names)), axes.flat):
            values, ends = fits.values[:, i], fits.interval95[:, i]
            certain = np.isfinite(ends).all(axis=-1)
            ax.vlines(record[certain], *ends[certain].T, lw=1.0, color=style.AFTER)
            ax.plot(record[certain], values[certain], ".", ms=4, color=style.AFTER)
            ax.plot(record[~certain], values[~certain], "x", ms=4, color=style.BEFORE)
            ax.set(xlabel="record", ylabel=style.plain(f"{fits.names[i]} [{fits.units[i]}]"))

    title, size = f"{fits.case.name}: estimates of {len(fits)} records", (3.4 * columns, 2.4 * rows)
    return {"estimates": style.picture(draw, size, rows, columns, title=title, squeeze=False)}


def files_of(fits):
    heads = ["record", "converged"]
    for name, unit in zip(fits.names, fits.units):
        heads += [f"{name} [{unit}]", f"sd of {name} [{unit}]"]
    plant, length = fits.case.loop.plant, fits.case.loop.units[0]
    levels = [reading_label(plant, i) for i in range(fits.levels.shape[1])]
    heads += [f"{label} at the first sample [{length}]" for label in levels]
    heads += [f"RMS residual of {name} [{unit}]" for name, unit in fits.channels]
    rows: list[list[Any]] = [heads]
    for e, name in enumerate(labels(fits)):
        pairs = np.column_stack([fits.values[e], fits.sd[e]]).ravel()
        rows.append([name, int(fits.converged[e]), *pairs, *fits.levels[e], *fits.rmse[e]])
    return {"estimates.csv": csv_text(rows)}
