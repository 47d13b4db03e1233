"""`jaxtank compare`: what a paper prints beside what is measured here, with a verdict.

Imported by the command line and the benchmarks.
"""

import numbers
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

QUOTED, REPRODUCED, DIFFERS, UNMEASURED = "quoted", "reproduced", "differs", "not measured"


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
    """Return (verdict, measured value or text) of one published quantity.

    measured: number, tuple, Claim or None.
    """
    if isinstance(measured, Claim):
        return measured.verdict, measured.text
    if measured is None:
        return UNMEASURED, None
    if published.tolerance is None:
        return QUOTED, measured
    printed, found = np.ravel(published.value).astype(float), np.ravel(measured).astype(float)
    near = printed.shape == found.shape and np.all(
        np.abs(found - printed) <= published.tolerance * np.abs(printed)
    )
    return (REPRODUCED if near else DIFFERS), measured


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
        word, value = verdict(printed, _set_in(preset, name) if value is None else value)
        reason = printed.reason
        if (
            word == QUOTED
            and isinstance(printed.value, numbers.Number | tuple)
            and not _same(printed.value, value)
        ):
            word = DIFFERS
        if word in (QUOTED, REPRODUCED):
            reason = ""
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
    captions = {}

    def draw():
        drawn = {}
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
            f"{count[REPRODUCED]} of {count.total() - count[QUOTED] - count[UNMEASURED]} measured"
            " quantities and claims reproduced",
            True,
            [(word, str(n)) for word, n in count.most_common()],
            [],
            drawings(drawn, captions),
            parts,
            command,
            {"jaxtank": jaxtank.__version__, "jax": jax.__version__, "numpy": np.__version__},
            live="\n".join(panel(next(iter(presets.load(p).cases.values()))) for p in pages),
        )

    old = [path.stem for paper in presets.PAPERS for path in Path(folder).glob(f"rig-{paper}*.png")]
    stale = artifacts.earlier(folder, old)
    table = pages if len(pages) > 1 else next(iter(pages.values()))
    return artifacts.write_result(
        folder, {"result.json": tables.dumps(table) + "\n"}, draw, page_of, stale
    )


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
        tables.table(
            rows,
            ["quantity", "unit", "published", "measured", "verdict", "where", "why it differs"],
        )
    ]


def markdown(pages):
    """Return the table of tests/benchmarks/README.md: every measured quantity of {paper: page}.

    Parameters that are only quoted are left out.
    """
    lines = ["| paper | quantity | published | measured | verdict |", "|---|---|---|---|---|"]
    for paper, page in pages.items():
        for r in page["rows"]:
            if r["verdict"] in (QUOTED, UNMEASURED):
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
