"""Tables, JSON and pictures of an ensemble."""

import dataclasses
import io
from pathlib import Path

import numpy as np

from jaxtank import measures as ms
from jaxtank.files import check_folder
from tuning import parts, report, search

WORDS = ("mean", "sd", "p05", "p50", "p95", "cvar95", "max")


def json_of(ensemble):
    """The JSON object of `jaxtank uncertainty --json`."""
    found = {
        "case": ensemble.case.name,
        "samples": ensemble.samples,
        "failed": int(ensemble.failed.sum()),
        "infeasible": None if ensemble.infeasible is None else int(ensemble.infeasible.sum()),
        "draws": ensemble.method,
        "distributions": {
            n: {"kind": type(d).__name__, **report.clean(dataclasses.asdict(d))} for n, d in ensemble.distributions.items()
        },
        "measures": report.clean(ensemble.summary()),
        "units": {m: ms.unit(m, ensemble.case.loop.units) for m in ensemble.measures},
        "violations": report.clean(ensemble.violations()),
        "wall_s": ensemble.wall_s,
        "provenance": search.provenance(ensemble.case, ensemble.seed),
    }
    if ensemble.infeasible is None:
        found["infeasible_reason"] = "the steady states of this rig have no closed form"
    if any(None in np.ravel(np.array(list(m.values()), dtype=object)) for m in found["measures"].values()):
        found["reason"] = "null: no finite number, as of a settling time where some draw never settles"
    return found


def text(ensemble):
    """The ensemble as a page of text."""
    units, rows = ensemble.case.loop.units, []
    for name, found in ensemble.summary().items():
        columns = {w: np.ravel(found[w] if found[w] is not None else np.nan) for w in WORDS}
        for i in range(len(columns["mean"])):
            per = ms.MEASURES[name].per
            label = name if per == "run" else f"{name} of {per} {i + 1}"
            interval = (
                np.ravel([np.ravel(v)[i] for v in found["mean_interval95"]])
                if found["mean_interval95"] is not None
                else [np.nan] * 2
            )
            shown = [report.number(columns[w][i], 4) for w in WORDS]
            rows.append(
                [
                    label,
                    ms.unit(name, units),
                    shown[0],
                    f"{report.number(interval[0], 4)} : {report.number(interval[1], 4)}",
                    *shown[1:],
                ]
            )
    head = ["measure", "unit", "mean", "95 % of the mean", "sd", "5 %", "median", "95 %", "worst 5 %", "worst"]
    spread = ", ".join(f"{n} {_words(d)}" for n, d in ensemble.distributions.items())
    words = [
        f"{ensemble.case.name}: {ensemble.samples} draws ({ensemble.method}, seed {ensemble.seed}), {ensemble.wall_s:.1f} s",
        f"uncertain: {spread}",
        "",
        report.table(rows, head),
        "",
    ]
    if ensemble.limits:
        rows = [
            [
                v["name"],
                report.number(v["limit"]),
                v["count"],
                f"{v['probability']:.4g}",
                "{:.4g} : {:.4g}".format(*v["interval95"]),
            ]
            for v in ensemble.violations()
        ]
        words += [report.table(rows, ["limit", "value", "broken in", "probability", "95 % interval"]), ""]
    words.append(
        f"{int(ensemble.failed.sum())} runs left the numbers; they count as breaking every limit and are in no other figure"
    )
    if ensemble.infeasible is not None:
        words.append(
            f"{int(ensemble.infeasible.sum())} draws have a plateau without a steady state within rims and pumps; they are in all figures"
        )
    return "\n".join(words)


def _words(distribution):
    fields = {n: v for n, v in dataclasses.asdict(distribution).items() if v is not None and v is not False}
    return f"{type(distribution).__name__}({', '.join(f'{n}={v}' for n, v in fields.items())})"


def draws_csv(ensemble):
    """Every draw as CSV: its number, what was drawn, whether the run failed, its measures; units in the header."""
    columns = [("draw", np.arange(ensemble.samples)), ("failed", ensemble.failed.astype(int))]
    for source, unit in ((ensemble.values, None), (ensemble.measures, ms.unit)):
        for name, values in source.items():
            flat = np.asarray(values).reshape(ensemble.samples, -1)
            said = "" if unit is None else f" [{unit(name, ensemble.case.loop.units)}]"
            columns += [(name + (f"[{i}]" if flat.shape[1] > 1 else "") + said, flat[:, i]) for i in range(flat.shape[1])]
    out = io.StringIO()
    out.write(",".join(f'"{head}"' for head, _ in columns) + "\n")
    np.savetxt(out, np.column_stack([v for _, v in columns]), delimiter=",", fmt="%.10g")
    return out.getvalue()


def figures(ensemble):
    """Matplotlib figures {name: figure}: "fan" of the levels, "violations"."""
    from jaxtank import plotting

    drawn = {}
    if ensemble.fan is not None:
        drawn["fan"] = plotting.fan(ensemble.case.loop, ensemble.fan, f"{ensemble.case.name}: {ensemble.fan['draws']} draws")
    if ensemble.limits:
        drawn["violations"] = plotting.violations(ensemble.violations(), ensemble.samples)
    return drawn


def save(ensemble, folder):
    """Write result.json, draws.csv and pictures to `folder`; returns their paths. Finished batches that lie there are removed."""
    check_folder(folder)
    folder = Path(folder)
    files = {"result.json": report.dumps(json_of(ensemble)) + "\n", "draws.csv": draws_csv(ensemble)}
    written = report.write_files(folder, files)
    written += report.write_files(folder, {f"{n}.png": report._png(f) for n, f in figures(ensemble).items()})
    if (folder / parts.MANIFEST).exists():
        for path in folder.glob("part-*.npz"):
            if parts.NAME.fullmatch(path.name):
                path.unlink()
        (folder / parts.MANIFEST).unlink()
    return written
