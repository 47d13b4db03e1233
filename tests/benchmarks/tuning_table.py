"""Published gains beside tuned ones, on validation plants and noise, with the perfect-information
optimum.

    python tests/benchmarks/tuning_table.py               # every row; an hour or two on two cores
    python tests/benchmarks/tuning_table.py 'khalid*'     # some, by name
    python tests/benchmarks/tuning_table.py --bounds 'gouta2015*'    # bounds alone; --rows for rows
    alone python tests/benchmarks/tuning_table.py --markdown    # writes what is stored into
    README.md here

Rows and bounds are those of tuning_rows.py. Each is stored in tuning_table.json as soon as it is
done, with the versions it was made with.
"""

import fnmatch
import json
import sys
from pathlib import Path

import jax
import measuring
import numpy as np
from tuning_rows import BOUNDS, ROWS, case_of

import jaxtank  # noqa: F401  (before jax starts)
import tuning
from jaxtank.core.files import write_atomic
from tuning.problem import provenance
from tuning.search.result import constraint_rows

HERE = Path(__file__).parent
STORE = HERE / "tuning_table.json"
BEGIN, END = "<!-- tests/benchmarks/tuning_table.py -->", "<!-- end of tuning table -->"
SIDES = ("before", "after")
VERSIONS = ("jaxtank", "python", "jax", "jaxlib", "numpy", "scipy", "optax", "dtype", "xla_option")


def tuned(name):
    """The TuningResult of a row."""
    row = ROWS[name]
    given = {
        "free": row.free,
        "objective": row.objective,
        "limits": row.limits,
        "scenarios": row.scenarios,
    }
    case, options = case_of(row), tuning.Options(**row.options)
    if row.choices:
        return tuning.tune_choices(case, row.choices, options, **given)
    return tuning.tune(tuning.Problem(case, **given), options)


def held_out(row, result):
    """{"runs", "before", "after", ...} on runs that the tuning never saw: means of the objective,
    and the share of runs made better.
    """
    if row.held is None:
        found = result.validation
        return found and {
            "runs": found["samples"],
            "before": found["objective"]["before"]["mean"],
            "after": found["objective"]["after"]["mean"],
            "better_share": found["better_share"],
            "limits_held": found["limits_held"],
        }
    problem = tuning.Problem(
        result.case, free=row.free, objective=row.objective, limits=row.limits, scenarios=row.held()
    )
    rows = {side: [{n: p[side] for n, p in result.parameters.items()}] for side in SIDES}
    points = np.array(
        [[float(b.to_unit(rows[side][0][b.name])) for b in problem.bounds] for side in SIDES]
    )
    costs, margins = problem.screen(points)
    return {
        "runs": len(problem.runs),
        "before": float(costs[0]),
        "after": float(costs[1]),
        "limits_held": {
            "before": bool(np.all(margins[0] >= 0)),
            "after": bool(np.all(margins[1] >= 0)),
        },
    }


def worst(constraints):
    """The limit that is broken most, or nearest to it, with the amount by which it is passed [its
    unit]; None without limits.
    """
    tight = min(constraints, key=lambda c: c["margin"], default=None)
    return tight and {
        "name": tight["name"],
        "unit": tight["unit"],
        "limit": tight["limit"],
        "violation": max(0.0, -tight["margin"]),
    }


def levels(measures):
    """What the levels did on the case's own run: {"highest", "lost"}, in the rig's unit of length
    and its cube.
    """
    return {
        "highest": float(np.max(measures["max_level"])),
        "lost": float(np.sum(measures["overflow_volume"])),
    }


def measure(name):
    """What is stored of a row."""
    row, result = ROWS[name], tuned(name)
    choice = [c for c in result.choices if c["objective"]["after"] == result.objective["after"]]
    return {
        "case": result.case.name,
        "method": result.method,
        "status": result.status,
        "message": result.message,
        "parameters": {
            n: {k: p[k] for k in ("before", "after", "unit", "at_bound")}
            for n, p in result.parameters.items()
        },
        "choices": result.choices,
        "chosen": choice[0]["values"] if choice else {},
        "objective": {
            **result.objective,
            "unit": row.unit,
            "target": row.target and float(row.target),
        },
        "limits": {
            "before": worst(constraint_rows(result.problem, result.tables["before"])),
            "after": worst(result.constraints),
        },
        "levels": {side: levels(result.measures[side]) for side in SIDES},
        "length": result.case.loop.plant.units[0],
        "held_out": held_out(row, result),
        "bound": row.bound,
        "agree": sum(
            s["violation"] == 0.0 and s["cost"] <= result.objective["after"] * 1.001
            for s in result.starts
        ),
        "starts": len(result.starts),
        "evaluations": result.evaluations,
        "wall_s": result.wall_s,
        "versions": {n: result.provenance[n] for n in VERSIONS},
    }


def best_inputs(name):
    """What is stored of a bound."""
    asked = BOUNDS[name]
    case = case_of(asked)
    found = tuning.bound(case, asked.objective, asked.limits)
    made_with = provenance.provenance(case, 0)
    reported = found.to_json()
    kept = ("cost", "objective", "holds", "closed_loop", "source", "interval_s", "grids", "wall_s")
    return {
        "case": case.name,
        **{n: reported[n] for n in kept},
        "versions": {n: made_with[n] for n in VERSIONS},
    }


def load():
    """{"rows": {name: ...}, "bounds": {name: ...}} as stored."""
    return json.loads(STORE.read_text()) if STORE.exists() else {"rows": {}, "bounds": {}}


def keep(kind, name, found):
    """Enter one finished row or bound into the store."""
    stored = load()
    stored[kind][name] = _plain(found)
    order = {"rows": ROWS, "bounds": BOUNDS}
    stored = {
        kind: {n: stored[kind][n] for n in order[kind] if n in stored[kind]} for kind in order
    }
    write_atomic(STORE, json.dumps(stored, indent=1, allow_nan=False) + "\n")


def _plain(value):
    if isinstance(value, dict):
        return {str(k): _plain(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(v) for v in value]
    if isinstance(value, (bool, int, str)) or value is None:
        return value
    return float(value) if np.isfinite(value) else None


def _pair(before, after, digits=4):
    return f"{before:.{digits}g} → {after:.{digits}g}"


def _free(row):
    # entries of one array stand together
    arrays, units = {}, {}
    for name, p in row["parameters"].items():
        base = name.removeprefix("controller.").removeprefix("observer.").split("[")[0]
        arrays.setdefault(base, []).append((p["before"], p["after"]))
        units[base] = p["unit"]
    shown = []
    for base, values in arrays.items():
        sides = [", ".join(f"{v:.3g}" for v in side) for side in zip(*values)]
        shown.append(
            f"{base} {sides[0]} →"
            f" {sides[1]}{' ' + units[base] if units[base] not in ('', '-') else ''}"
        )
    shown += [f"{n.removeprefix('controller.')} = {v}" for n, v in row["chosen"].items()]
    return "; ".join(shown)


def _limits(row):
    side, metres = row["levels"], row["length"] == "m"
    if row["limits"]["after"] is not None:
        return f"passed by {_passed(row, 'before')} → {_passed(row, 'after')}"
    if side["before"]["lost"] > 0:
        return "rims are physics; lost {:.0f} → {:.0f} cm^3".format(
            *(1e6**metres * side[s]["lost"] for s in SIDES)
        )
    return "none; highest {:.1f} → {:.1f} cm".format(
        *(100**metres * side[s]["highest"] for s in SIDES)
    )


def _passed(row, side):
    limit = row["limits"][side]
    factor, unit = {"m": (1e2, "cm"), "m^3": (1e6, "cm^3")}.get(limit["unit"], (1.0, limit["unit"]))
    return f"{factor * limit['violation']:.3f} {unit}"


def _objective(row):
    aim, start = row["objective"], row["limits"]["before"]
    change = f"{100 * (aim['after'] / aim['before'] - 1):+.2g} %".replace("-", "−")
    if start is not None and start["violation"] > 0:
        change = "the first passes a limit"
    return f"{_pair(aim['before'], aim['after'])} {aim['unit']} ({change})"


def _held(row):
    found = row["held_out"]
    if not found:
        return "-"
    shares = [100 * float(found["limits_held"][s]) for s in SIDES]
    kept = (
        ""
        if row["limits"]["after"] is None or min(shares) == 100
        else "; limits hold in {:.0f} → {:.0f} %".format(*shares)
    )
    return _pair(found["before"], found["after"]) + kept


def _bound(row, bounds):
    found = bounds.get(row["bound"])
    return "-" if found is None else f"{found['cost']:.4g}"


def markdown(stored):
    """The table that belongs between the marks."""
    heads = (
        *("row", "published → tuned", "objective", "limits at the true step"),
        *("validation plants and noise", "bound", "s"),
    )
    rows = [
        [name, *(f(row) for f in (_free, _objective, _limits, _held)),
         _bound(row, stored["bounds"]), f"{row['wall_s']:.0f}"]
        for name, row in stored["rows"].items()
    ]  # fmt: skip
    return measuring.markdown(heads, rows)


def picked(patterns, names):
    """Those of `names` that one of the patterns matches; all of them where there is no pattern.
    Raises KeyError where one matches none.
    """
    for pattern in patterns:
        if not fnmatch.filter(names, pattern):
            raise KeyError(f"no row is named {pattern}; there are {', '.join(names)}")
    return [n for n in names if not patterns or any(fnmatch.fnmatch(n, p) for p in patterns)]


def main(words):
    jax.config.update("jax_enable_x64", True)
    patterns = [w for w in words if not w.startswith("--")]
    if "--markdown" in words:
        measuring.store(BEGIN, END, markdown(load()))
        return
    if "--bounds" not in words:
        for name in picked(patterns, ROWS):
            found = measure(name)
            keep("rows", name, found)
            aim = found["objective"]
            print(
                f"{name}: {_pair(aim['before'], aim['after'])}, {found['status']},"
                f" {found['wall_s']:.0f} s",
                flush=True,
            )
    if "--rows" in words:
        return
    needed = (
        picked(patterns, BOUNDS)
        if "--bounds" in words
        else {ROWS[n].bound for n in picked(patterns, ROWS)} - {None}
    )
    for name in sorted(set(needed) - (set() if "--bounds" in words else set(load()["bounds"]))):
        found = best_inputs(name)
        keep("bounds", name, found)
        held = "holds" if found["holds"] else "LIMITS BROKEN"
        print(f"bound {name}: {found['cost']:.5g}, {held}, {found['wall_s']:.0f} s", flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
