"""`jaxtank compare`: what a paper prints beside what is measured here, with a verdict.

Imported by the command line and the benchmarks.
"""

import textwrap
from collections import Counter
from pathlib import Path
from typing import cast

import jax
import numpy as np

import jaxtank
from jaxtank import presets, rig
from jaxtank.core.files import check_folder
from jaxtank.core.tree import get_value
from jaxtank.loop import run as lp
from jaxtank.plants.network import TankNetwork
from jaxtank.presets.paper import Claim
from tuning.problem.scenarios import noisy
from tuning.report import artifacts, figures, tables
from tuning.report.html import document, drawings
from tuning.report.panel import panel

REPRODUCED, FITTED, DIFFERS = "reproduced", "fitted", "differs"
IMPOSSIBLE, INPUT = "not reproducible", "input"
VERDICTS = {
    REPRODUCED: "within the tolerance of its row, or a claim that holds",
    FITTED: "near the printed number, for which an assumption of ours was chosen: no evidence",
    DIFFERS: "measured, and different or true in part only: the row says why",
    IMPOSSIBLE: "cannot be measured: the row says what is missing",
    INPUT: "a number that our case has from the paper",
}
"""{verdict of a row: what it means}."""


def runner(paper):
    """Return run(case name, values={}, save_every=1) of a paper; each run is made once.

    It returns (Case with `values` set, Trajectory as host arrays).
    """
    preset, known = presets.load(paper), {}

    def run(name, values=None, save_every=1):
        key = (name, repr(values), save_every)
        if key not in known:
            case = rig.set_values(preset.cases[name], values or {})
            found = lp.simulate(
                case.loop, case.clock, jax.random.key(0) if noisy(case) else None, save_every
            )
            known[key] = case, jax.tree.map(np.asarray, found)
        return known[key]

    return run


def verdict(published, measured):
    """Return (verdict, measured value or text, reason) of one published quantity.

    measured: number, tuple, Claim or None. The verdict is one of VERDICTS.
    """
    reason = published.reason
    if isinstance(measured, Claim):
        near = measured.verdict != "not reproduced"
        if near and published.fitted:
            return FITTED, measured.text, f"{published.fitted}; {reason}".rstrip("; ")
        if measured.verdict == REPRODUCED:
            return REPRODUCED, measured.text, ""  # the text has the numbers
        return DIFFERS, measured.text, f"in part: {reason}" if near else reason
    if measured is None:
        return IMPOSSIBLE, None, reason
    if published.tolerance is None:
        same = isinstance(published.value, str) or _same(published.value, measured)
        return (INPUT, measured, VERDICTS[INPUT]) if same else (DIFFERS, measured, reason)
    printed, found = np.ravel(published.value).astype(float), np.ravel(measured).astype(float)
    near = printed.shape == found.shape and np.all(
        np.abs(found - printed) <= published.tolerance * np.abs(printed)
    )
    if not near:
        return DIFFERS, measured, reason
    within = f"within {100 * published.tolerance:g} %"
    chosen = published.fitted
    return (FITTED, measured, chosen) if chosen else (REPRODUCED, measured, within)


def measure(paper):
    """Return the comparison of a paper: {"paper", "citation", "notes", "rows"}.

    The keys of a row: quantity, unit, where, published, measured, verdict, reason.

    A parameter that the paper prints is compared with the value in the preset's first case that has
    it. Raises InputError for an unknown paper, and KeyError if the preset measures something that
    it does not list as published.
    """
    preset = presets.load(paper)
    found = preset.measured(runner(paper))
    stray = set(found) - set(preset.published)
    if stray:
        raise KeyError(
            f"{paper} measures what is not in its published quantities: {', '.join(sorted(stray))}"
        )
    rows = []
    for name, printed in preset.published.items():
        value = found.get(name)
        word, value, reason = verdict(printed, _set_in(preset, name) if value is None else value)
        rows.append(
            {
                "quantity": name,
                "unit": printed.unit,
                "where": printed.where,
                "published": tables.clean(printed.value),
                "measured": tables.clean(value),
                "verdict": word,
                "reason": reason,
            }
        )
    return {"paper": paper, "citation": preset.citation, "notes": str(preset.notes), "rows": rows}


def _set_in(preset, name):
    """The value of parameter `name` in the first case that has it, or None where it is no
    parameter.
    """
    for case in preset.cases.values():
        if name.startswith("clock."):
            return getattr(case.clock, name.removeprefix("clock."), None)
        try:
            value = np.asarray(get_value(case.loop, name))
        except ValueError:  # InputError
            continue
        return value.item() if value.ndim == 0 else tuple(value.ravel().tolist())
    return None


def _same(printed, found):
    """Return whether the preset's value is the printed one (equal entries count as one number)."""
    if found is None or isinstance(found, str):
        return False
    a, b = np.ravel(printed).astype(float), np.ravel(found).astype(float)
    return a.size in (1, b.size) and bool(np.all(np.abs(b - a) <= 1e-9 * np.abs(a)))


def _cell(value):
    if value is None:
        return "-"
    return (
        value
        if isinstance(value, str)
        else (
            ", ".join(tables.number(v, 4) for v in np.unique(np.ravel(value)))
            if _flat(value)
            else (", ".join(tables.number(v, 4) for v in np.ravel(value)))
        )
    )


def _flat(value):
    return np.unique(np.ravel(value)).size == 1


def text(page):
    """Return the page of `jaxtank compare PAPER`."""
    rows = [
        [r["quantity"], r["unit"], _cell(r["published"]), _cell(r["measured"]), r["verdict"]]
        for r in page["rows"]
    ]
    wrapped = [
        [row[0], row[1], *(textwrap.shorten(c, 60, placeholder=" ...") for c in row[2:4]), row[4]]
        for row in rows
    ]
    lines = [
        page["citation"],
        f"notes: {presets.load(page['paper']).notes}",
        "",
        tables.table(wrapped, ["quantity", "unit", "published", "measured", "verdict"]),
    ]
    for row, cells in zip(page["rows"], rows):
        note = "; ".join(
            filter(None, [cells[3] if isinstance(row["measured"], str) else "", row["reason"]])
        )
        if note:
            lines.append(f"- {row['quantity']} ({row['where']}): {note}")
    return "\n".join(lines)


def save(pages, folder, command=None):
    """Write result.json, report.html and the rigs of {paper: page}; return their paths."""
    check_folder(folder)
    captions = {"published": OVERVIEW}

    def draw():
        drawn = overview(pages)
        for paper, found in pages.items():
            seen = []
            for name, case in presets.load(paper).cases.items():
                plant = cast(TankNetwork, case.loop.plant)  # as every preset's
                drawing = (
                    plant.links,
                    plant.pipes,
                    plant.feeds,
                    plant.spills,
                    plant.outputs,
                    np.asarray(plant.rim).tolist(),
                )
                if drawing not in seen:  # cases of one paper share their rig, but for some
                    seen.append(drawing)
                    of = f"rig-{paper}" + ("" if len(seen) == 1 else f"-{len(seen)}")
                    drawn[of] = figures.rig(case.loop, None, f"{paper}/{name}")["rig"]
                    captions[of] = f"The rig of {paper}/{name}. {found['citation']}"
        return drawn

    rows = [row for found in pages.values() for row in found["rows"]]
    count = Counter(row["verdict"] for row in rows)
    parts = [part for found in pages.values() for part in (found["citation"], *_in_full(found))]

    def page_of(drawn):
        return document(
            f"{', '.join(pages)}: published and measured",
            "Published numbers, those of the same rigs and controllers here, and why they differ.",
            f"{count[REPRODUCED]} of {count.total() - count[INPUT] - count[IMPOSSIBLE]} measured"
            f" quantities and claims reproduced, {count[FITTED]} fitted",
            True,
            [(word, str(count[word])) for word in VERDICTS if count[word]],
            [f"{word}: {VERDICTS[word]}" for word in VERDICTS if count[word]],
            drawings(drawn, captions),
            parts,
            command,
            {"jaxtank": jaxtank.__version__, "jax": jax.__version__, "numpy": np.__version__},
            live="\n".join(panel(next(iter(presets.load(p).cases.values()))) for p in pages),
            live_last=True,
        )

    old = [path.stem for paper in presets.PAPERS for path in Path(folder).glob(f"rig-{paper}*.png")]
    stale = artifacts.earlier(folder, [*old, "published"])
    table = pages if len(pages) > 1 else next(iter(pages.values()))
    return artifacts.write_result(
        folder, {"result.json": tables.dumps(table) + "\n"}, draw, page_of, stale
    )


OVERVIEW = (
    "Measured over published, for every number that was measured: at the line the two agree."
    " Numbers of both signs, and those that are 0, are in the table alone."
)


def overview(pages):
    """Return {"published": figure of measured over published numbers}, {} without any."""
    import matplotlib.pyplot as plt

    from jaxtank.plots import responses

    rows = [(paper, row, _ratios(row)) for paper, page in pages.items() for row in page["rows"]]
    rows = [one for one in rows if one[2].size]
    if not rows:
        return {}
    styles = {
        REPRODUCED: (responses.AFTER, "o"),
        FITTED: ("#E69F00", "s"),
        DIFFERS: (responses.BEFORE, "X"),
    }
    with responses.styled():
        figure, ax = plt.subplots(
            figsize=(7.2 if len(pages) > 1 else 6.0, 0.8 + 0.2 * len(rows)), layout="constrained"
        )
        styles = {
            word: styles[word] for word in styles if word in {r["verdict"] for _, r, _ in rows}
        }
        for k, (_, row, ratios) in enumerate(rows):
            colour, marker = styles[row["verdict"]]
            ax.plot(ratios, [k] * len(ratios), marker, color=colour, markersize=5, alpha=0.8)
        ax.axvline(1.0, color=responses.REFERENCE, linewidth=1.0)
        ax.set_xscale("log")
        ax.set(xlabel="measured / published [-]", ylim=(len(rows) - 0.4, -0.6))
        start = (lambda paper: f"{paper}: ") if len(pages) > 1 else (lambda paper: "")
        names = [start(paper) + responses.plain(row["quantity"]) for paper, row, _ in rows]
        ax.set_yticks(range(len(rows)), names, fontsize=7)
        for word, (colour, marker) in styles.items():
            ax.plot([], [], marker, color=colour, label=word)
        figure.legend(
            *ax.get_legend_handles_labels(), loc="outside lower center", ncols=len(styles)
        )
    return {"published": figure}


def _ratios(row):
    """Measured over published numbers of a row, one for each entry; none for claims."""
    given = (row["published"], row["measured"])
    if row["verdict"] in (INPUT, IMPOSSIBLE) or any(v is None or isinstance(v, str) for v in given):
        return np.zeros(0)
    printed, found = (np.ravel(np.asarray(v, dtype=float)) for v in given)
    if printed.size not in (1, found.size):
        return np.zeros(0)
    with np.errstate(divide="ignore", invalid="ignore"):
        ratios = found / printed
    ratios = ratios[np.isfinite(ratios) & (ratios > 0.0)]
    # Entries that differ by rounding alone are one point, whatever the processor.
    return np.unique([float(f"{ratio:.6g}") for ratio in ratios])


def _in_full(found):
    """The table of a page with where each number is printed and the reason for a difference."""
    rows = [
        [
            r["quantity"],
            r["unit"],
            _cell(r["published"]),
            _cell(r["measured"]),
            r["verdict"],
            r["where"],
            r["reason"],
        ]
        for r in found["rows"]
    ]
    return [
        tables.table(rows, ["quantity", "unit", "published", "measured", "verdict", "where", "why"])
    ]


def markdown(pages):
    """Return the table of tests/benchmarks/README.md: every measured quantity of {paper: page}.

    Parameters that are only quoted are left out.
    """
    lines = ["| paper | quantity | published | measured | verdict |", "|---|---|---|---|---|"]
    for paper, page in pages.items():
        for r in page["rows"]:
            if r["verdict"] in (INPUT, IMPOSSIBLE):
                continue
            unit = f" {r['unit']}" if r["unit"] else ""
            mine = _cell(r["measured"]) + ("" if isinstance(r["measured"], str) else unit)
            theirs = _cell(r["published"]) + ("" if isinstance(r["published"], str) else unit)
            why = f": {r['reason']}" if r["reason"] and r["verdict"] != REPRODUCED else ""
            lines.append(
                "| "
                + " | ".join(
                    c.replace("|", "\\|")
                    for c in (paper, r["quantity"], theirs, mine, r["verdict"] + why)
                )
                + " |"
            )
    return "\n".join(lines)
