"""The report of Identifications: many records, each fitted separately.

Opened by the result of `tuning.identify_many`.
"""

import csv
import io

import numpy as np

from jaxtank.core.files import check_folder
from jaxtank.plots import responses
from tuning.problem import provenance
from tuning.report import artifacts, html, tables

__all__ = ["figures", "json_of", "lines", "save"]

CAPTION = "Estimate of each record with its 95 % interval; a record without an interval is a cross."
LISTED = 12
"""Most records that are printed one by one; `estimates.csv` has all of them."""


def labels(found):
    """Return a name of each record that no other has."""
    if len(set(found.logs)) == len(found.logs):
        return list(found.logs)
    return [f"{name} {e + 1}" for e, name in enumerate(found.logs)]


def lines(found):
    """Return what is printed of Identifications: lines and tables."""
    count = len(found)
    return [
        f"{found.case.name}: {count} record{'s' * (count != 1)}, each fitted separately;"
        f" {int(found.converged.sum())} converged, {found.iterations} iterations at most",
        "",
        _summary(found),
        *(["", _records(found)] if count <= LISTED else []),
        "",
        *_residuals(found),
        "",
        f"{found.wall_s:.1f} s",
    ]


def _summary(found):
    """Return the table of the parameters over all records."""
    rows = []
    for i, (name, unit) in enumerate(zip(found.names, found.units)):
        values, sd = found.values[:, i], found.sd[:, i]
        certain = sd[np.isfinite(sd)]
        rows.append(
            [
                name,
                unit,
                f"{values.mean():.5g}",
                f"{values.std(ddof=1):.2g}" if len(values) > 1 else "-",
                f"{certain.mean():.2g}" if certain.size else "-",
                f"{certain.size} of {len(found)}",
            ]
        )
    head = ["parameter", "unit", "mean", "sd over records", "mean sd of a fit", "with an interval"]
    return tables.table(rows, head)


def _records(found):
    """Return the table of the estimates of each record, with their standard deviations."""
    heads = [f"{n} [{u}]" for n, u in zip(found.names, found.units)]
    rows = [
        [name, "yes" if found.converged[e] else "NO", *map(_estimate, found.values[e], found.sd[e])]
        for e, name in enumerate(labels(found))
    ]
    return tables.table(rows, ["record", "converged", *heads])


def _estimate(value, sd):
    """Return an estimate with its standard deviation, if it has one."""
    return f"{value:.5g} (sd {sd:.2g})" if np.isfinite(sd) else f"{value:.5g} (no interval)"


def _residuals(found):
    """Return a line a channel: residuals over all records."""
    words = []
    for c, (name, unit) in enumerate(found.channels):
        rmse, rho = (x[:, c][np.isfinite(x[:, c])] for x in (found.rmse, found.autocorrelation))
        if rmse.size:
            words.append(
                f"{name}: residual {rmse.min():.3g} to {rmse.max():.3g} {unit} RMS"
                + (f", mean correlation from sample to sample {rho.mean():.2f}" if rho.size else "")
            )
    return words


def json_of(found):
    """Return a JSON object: the estimates of every record, null where there is no interval."""
    return {
        "case": found.case.name,
        "success": bool(found.converged.all()),
        "channels": [{"name": n, "unit": u} for n, u in found.channels],
        "records": [_record(found, e, name) for e, name in enumerate(labels(found))],
        "iterations": int(found.iterations),
        "wall_s": found.wall_s,
        "provenance": provenance.provenance(found.case, None),
    }


def _record(found, e, name):
    """Return the JSON object of record e."""
    interval = np.isfinite(found.interval95[e]).all(axis=-1)
    return tables.clean(
        {
            "name": name,
            "converged": bool(found.converged[e]),
            "parameters": {
                parameter: {
                    "value": float(found.values[e, i]),
                    "unit": found.units[i],
                    "sd": float(found.sd[e, i]),
                    "interval95": found.interval95[e, i].tolist() if interval[i] else None,
                }
                for i, parameter in enumerate(found.names)
            },
            "covariance": found.covariance[e].tolist(),
            "initial_levels": [
                {"value": float(value), "sd": float(sd)}
                for value, sd in zip(found.levels[e], found.levels_sd[e])
            ],
            "fit": {
                "rmse": found.rmse[e].tolist(),
                "residual_autocorrelation": found.autocorrelation[e].tolist(),
            },
        }
    )


def figures(found):
    """Return {"estimates": matplotlib Figure}: each parameter over the records."""
    import matplotlib.pyplot as plt

    columns = min(3, len(found.names))
    rows = -(-len(found.names) // columns)
    with responses.styled():
        figure, axes = plt.subplots(
            rows, columns, figsize=(3.4 * columns, 2.4 * rows), layout="constrained", squeeze=False
        )
        for i, ax in enumerate(axes.flat):
            if i < len(found.names):
                _estimates(ax, found, i)
            else:
                ax.set_axis_off()
        title = f"{found.case.name}: estimates of {len(found)} records"
        figure.suptitle(responses.plain(title), fontsize=9)
    return {"estimates": figure}


def _estimates(ax, found, i):
    """Draw parameter i of every record with its interval."""
    number = np.arange(1, len(found) + 1)
    certain = np.isfinite(found.interval95[:, i]).all(axis=-1)
    low, high = found.interval95[certain, i].T
    ax.vlines(number[certain], low, high, lw=1.0, color=responses.AFTER)
    ax.plot(number[certain], found.values[certain, i], ".", ms=4, color=responses.AFTER)
    ax.plot(number[~certain], found.values[~certain, i], "x", ms=4, color=responses.BEFORE)
    ax.set_xlabel("record")
    ax.set_ylabel(responses.plain(f"{found.names[i]} [{found.units[i]}]"))


def estimates_csv(found):
    """Return CSV text, a row a record: name, convergence, estimates, deviations, levels."""
    length = found.case.loop.units[0]
    heads = ["record", "converged"]
    for name, unit in zip(found.names, found.units):
        heads += [f"{name} [{unit}]", f"sd of {name} [{unit}]"]
    heads += [f"h{i + 1} at the first sample [{length}]" for i in range(found.levels.shape[1])]
    heads += [f"RMS residual of {name} [{unit}]" for name, unit in found.channels]
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(heads)
    for e, name in enumerate(labels(found)):
        pairs = np.column_stack([found.values[e], found.sd[e]]).ravel()
        numbers = [*pairs, *found.levels[e], *found.rmse[e]]
        cells = ["" if np.isnan(v) else f"{v:.10g}" for v in numbers]
        writer.writerow([name, int(found.converged[e]), *cells])
    return out.getvalue()


def save(found, folder, command=None):
    """Write result.json, estimates.csv, estimates.png and report.html; return their paths."""
    check_folder(folder)
    files = {"result.json": tables.dumps(json_of(found)), "estimates.csv": estimates_csv(found)}

    def page(drawn):
        parts = lines(found)
        converged = int(found.converged.sum())
        return html.document(
            f"{found.case.name}: {len(found)} records identified",
            "",
            "converged" if converged == len(found) else "not every fit converged",
            converged == len(found),
            [("records", str(len(found))), ("converged", str(converged))],
            [parts[0], *_residuals(found)],
            html.drawings(drawn, {"estimates": CAPTION}),
            [part for part in parts if isinstance(part, tables.Table)],
            command,
            provenance.provenance(found.case, None),
        )

    return artifacts.write_result(folder, files, lambda: figures(found), page)
