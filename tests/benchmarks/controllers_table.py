"""Every controller that fits a rig, one rig of each paper: tables and picture for README.md here.

    python tests/benchmarks/controllers_table.py               # rows that are not stored; an hour
    python tests/benchmarks/controllers_table.py 'calofir*'    # of some rigs, by name
    python tests/benchmarks/controllers_table.py --again 'calofir*'  # stored rows too
    python tests/benchmarks/controllers_table.py --markdown    # tables and picture of stored rows

Rows are those of `jaxtank compare --controllers RIG --samples 64`. Those of a controller are stored
in tests/data/controllers.json as soon as they are finished.
"""

import argparse
import dataclasses
import fnmatch
import json
import time
from pathlib import Path
from typing import Any

import jax
from measuring import markdown, store

import jaxtank
import tuning
from jaxtank import presets
from jaxtank.core.files import write_atomic
from jaxtank.plots.style import picture
from tuning.problem import provenance
from tuning.report import controllers as report
from tuning.search import comparison

ROOT = Path(__file__).parents[2]
STORE, PICTURE = ROOT / "tests/data/controllers.json", ROOT / "notebooks/images/controllers.png"
BEGIN, END = "<!-- tests/benchmarks/controllers_table.py -->", "<!-- end of controllers -->"
SAMPLES, SEED = 64, 0
RIGS = {
    "gouta2015/backstepping": "backstepping ngpc lqi backstepping-ff pi gpc nmpc state-feedback"
    " laguerre pid ngpc-observer backstepping-observer",
    "gouta2022/chadpc": "chadpc enmpc pi fopi pi-ff fopi-ff gpc pid pid-ff laguerre nmpc",
    "mirakhorli/hybrid": "hybrid sfc smc lqi gpc laguerre nmpc",
    "calofir/backstepping": "backstepping pi gpc laguerre pid nmpc",
    "khalid/laguerre-mimo": "laguerre-mimo gpc-mimo pi enmpc pid nmpc",
}
"""{rig: the controllers that fit it, in the order in which they run}."""

VERSIONS = ("jaxtank", "python", "jax", "jaxlib", "numpy", "scipy", "dtype", "xla_option")
KEYS = "name gains filter error violations failed input_travel sensitivity_peak step_us parameters"


@dataclasses.dataclass(frozen=True)
class Row:
    """A stored row, with what the report reads of a Rival."""

    name: str
    gains: str
    filter: bool
    error: float | None
    violations: int
    failed: int
    input_travel: float | None
    sensitivity_peak: float | None
    step_us: float | None
    parameters: dict[str, Any]

    words = comparison.Rival.words
    tuned = property(lambda self: self.gains == "tuned")
    filtered = property(lambda self: self.filter)
    holds = property(lambda self: self.violations == 0)
    travel = property(lambda self: self.input_travel)


def stored_comparison(rig, entry):
    """The ControllerComparison of stored rows."""
    rows = [Row(**row) for found in entry["controllers"].values() for row in found]
    return tuning.ControllerComparison(
        case=presets.find(rig),
        rivals=tuple(sorted(rows, key=comparison.order)),
        refused={},
        samples=entry["samples"],
        seed=SEED,
    )


def load():
    """{rig: {"unit", "samples", "controllers": {name: rows}, ...}} as stored."""
    return json.loads(STORE.read_text()) if STORE.exists() else {}


def keep(stored):
    """Store all rigs, a line for each row."""
    rigs = []
    for rig in [r for r in RIGS if r in stored]:
        entry = stored[rig]
        names = [n for n in RIGS[rig].split() if n in entry["controllers"]]
        rows = [f"   {json.dumps(n)}: [\n{_lines(entry['controllers'][n])}\n   ]" for n in names]
        facts = {**entry, "core_s": {n: entry["core_s"][n] for n in names}}
        facts.pop("controllers")
        text = ",\n".join(f"  {json.dumps(k)}: {json.dumps(v)}" for k, v in facts.items())
        controllers = ",\n".join(rows)
        rigs.append(
            f' {json.dumps(rig)}: {{\n{text},\n  "controllers": {{\n{controllers}\n  }}\n }}'
        )
    write_atomic(STORE, "{\n" + ",\n".join(rigs) + "\n}\n")


def _lines(rows):
    short = ({key: row[key] for key in KEYS.split()} for row in rows)
    return ",\n".join(f"    {json.dumps(row, allow_nan=False)}" for row in short)


def run(rig, name):
    """Compare one controller of a rig, and store its rows."""
    case, began = presets.find(rig), time.process_time()
    result = tuning.compare_controllers(case, kinds=[name], samples=SAMPLES, seed=SEED)
    stored, made_with = load(), provenance.provenance(case, SEED)
    length, drive = case.loop.units
    entry = stored.setdefault(rig, {"controllers": {}, "core_s": {}})
    entry |= {"samples": SAMPLES, "unit": length, "input_unit": drive}
    entry["versions"] = {n: made_with[n] for n in VERSIONS}
    rows = report.json_of(result)["controllers"]
    entry["controllers"][name] = rows
    entry["core_s"][name] = round(time.process_time() - began)
    keep(stored)


def _number(value, digits):
    if value is None:
        return "-"
    return f"{value:,.0f}" if value >= 10**digits else f"{value:.{digits}g}"


def _cells(rows, entry):
    """The cells of one controller with one set of gains: without and with the filter."""
    plain, *others = sorted(rows, key=lambda row: row.filter)
    sides = [plain, *others]
    same = len({(r.error, r.violations) for r in sides}) == 1
    sides = [plain] if same else sides
    joined = lambda words: " / ".join(words)
    errors = joined(_number(r.error, 4) for r in sides)
    broken = joined(f"{r.violations}" for r in sides)
    travel = joined(_number(r.input_travel, 3) for r in sides)
    peak, step = _number(plain.sensitivity_peak, 3), _number(plain.step_us, 2)
    return [plain.name, plain.gains, errors, broken, travel, peak, step]


def table(rig, entry):
    """The sentence and the table of a rig."""
    result, groups = stored_comparison(rig, entry), {}
    for row in result.rivals:
        groups.setdefault((row.name, row.gains), []).append(row)
    heads = ["controller", "gains", f"error [{entry['unit']}]"]
    heads += [f"limit broken on, of {entry['samples']}", f"total travel [{entry['input_unit']}]"]
    heads += ["Ms [-]", "C [us/step]"]
    rows = markdown(heads, [_cells(rows, entry) for rows in groups.values()])
    sentence = report.sentence(result)
    return f"`{rig}`: {sentence}.\n\n{rows}"


def tables(stored):
    """The text that belongs between the marks."""
    return "\n\n".join(table(rig, entry) for rig, entry in stored.items())


def draw(stored):
    """The picture of all rigs."""

    def panels(axes):
        for ax, (rig, entry) in zip(axes.flat, stored.items(), strict=False):
            report.draw_errors(ax, stored_comparison(rig, entry))
            ax.set_title(rig, fontsize=9)
        for ax in axes.flat[len(stored) :]:
            ax.set_axis_off()
        axes.flat[-1].legend(*report.legend(), loc="center")

    return picture(panels, (9.0, 9.0), rows=3, columns=2)


def main():
    """Run what is missing, or write what is stored."""
    jax.config.update("jax_enable_x64", True)
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("rigs", nargs="*", default=["*"])
    parser.add_argument("--only", nargs="*", help="names of controllers")
    parser.add_argument("--again", action="store_true")
    parser.add_argument("--markdown", action="store_true")
    asked = parser.parse_args()
    if asked.markdown:
        stored = load()
        store(BEGIN, END, tables(stored))
        draw(stored).savefig(PICTURE, dpi=70)
        return
    for rig, names in RIGS.items():
        if not any(fnmatch.fnmatch(rig, pattern) for pattern in asked.rigs):
            continue
        for name in names.split():
            done = name in load().get(rig, {}).get("controllers", {})
            if (asked.only and name not in asked.only) or (done and not asked.again):
                continue
            try:
                run(rig, name)
                print(f"{rig}: {name}, {load()[rig]['core_s'][name]} core-s", flush=True)
            except jaxtank.InputError as error:  # gains that this rig does not admit
                print(f"{rig}: {name}: {error}", flush=True)


if __name__ == "__main__":
    main()
