"""Tables, JSON and pictures of a result."""

import io
import json
import math
import tempfile
from pathlib import Path

import numpy as np

from jaxtank import loop as lp
from jaxtank import measures as ms
from jaxtank import rig
from jaxtank.errors import InputError
from jaxtank.files import check_folder, write_together
from jaxtank.neighbours import columns
from jaxtank.units import DEFAULT
from tuning.objective import LOWER

SHOWN = (
    "rms_error",
    "rms_error_total",
    "max_error",
    "max_level",
    "min_level",
    "overshoot_percent",
    "settling_time",
    "rms_input",
    "input_travel",
    "saturated_fraction",
)
REASONS = {
    "overshoot_percent": "the reference does not change",
    "rise_time": "no change of the setpoint was followed to 90 % of its height",
    "settling_time": "an output was still outside the band when its setpoint changed again or the run ended, or its setpoint never changes",
    "recovery_time": "an output was still outside the band when it was watched no longer",
}
ABSENT = "the value is not a finite number"
UNSERVED = {
    "overshoot_percent": "the reference has no changes that end",
    "rise_time": "the reference has no changes that end",
    "settling_time": "the reference has no changes that end",
    "recovery_time": "this case has no disturbance to recover from",
}


def number(value, digits=5):
    """A number for people: at most `digits` significant digits, a dash where there is none."""
    value = float(value)
    if not math.isfinite(value):
        return "-"
    if value == 0:
        return "0"
    text = f"{value:.{digits}g}"
    return text if "e" not in text else f"{value:.{digits - 1}e}"


def numbers(value, digits=5):
    """The entries of a measure, side by side."""
    return "  ".join(number(v, digits) for v in np.ravel(value))


def clean(value):
    """`value` for JSON: arrays as lists, NaN and infinity as null."""
    if isinstance(value, dict):
        return {k: clean(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [clean(v) for v in value]
    if isinstance(value, (np.ndarray, np.generic)) or hasattr(value, "__jax_array__") or type(value).__module__.startswith("jax"):
        return clean(np.asarray(value).tolist())
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return value


def reasons(measures):
    """{measure: why} for every measure that is absent or has an entry that is not a number."""
    found = {m: REASONS.get(m, ABSENT) for m, v in measures.items() if not np.all(np.isfinite(np.asarray(v, dtype=float)))}
    return {**found, **{m: why for m, why in UNSERVED.items() if m not in measures}}


def measures_json(measures):
    """Measures as JSON; null for those that mean nothing for the case (`reasons` says why)."""
    return {**dict.fromkeys(UNSERVED), **clean({m: v for m, v in measures.items() if m not in ms.TIMES.values()})}


def dumps(table):
    """One JSON object as text; refuses NaN."""
    return json.dumps(table, indent=2, allow_nan=False)


def units(rig_units):
    """{measure: unit} of everything that is reported, on a rig with these (length, pump input) units."""
    return {m: ms.unit(m, rig_units) for m in ms.MEASURES}


class Table(str):
    """Aligned columns as text, which still knows its `head` and `rows`, so that a page may set them in its own way."""

    head: list
    rows: list


def table(rows, head=None):
    """Rows of text as aligned columns, the first to the left: a Table."""
    body = [[str(c) for c in row] for row in rows]
    rows = ([head] if head else []) + body
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]
    lines = ["  ".join(c.ljust(w) for c, w in zip(row, widths)).rstrip() for row in rows]
    found = Table("\n".join(lines[:1] + ["-" * min(100, len(max(lines, key=len)))] + lines[1:] if head else lines))
    found.head, found.rows = head or [], body
    return found


def json_of(result):
    """The JSON object of `jaxtank tune --json`."""
    return {
        "case": result.tuned.name,
        "method": result.method,
        "success": result.success,
        "status": result.status,
        "message": result.message,
        "parameters": {n: {**clean(p), "interval": None} for n, p in result.parameters.items()},
        "interval_reason": "no measurements were fitted, so there is no confidence interval",
        "objective": {k: clean(result.objective[k]) for k in ("before", "after", "terms")},
        "measures": {"before": measures_json(result.measures["before"]), "after": measures_json(result.measures["after"])},
        "reasons": {**reasons(result.measures["before"]), **reasons(result.measures["after"])},
        "units": units(result.tuned.loop.units),
        "constraints": clean(result.constraints),
        "evaluations": result.evaluations,
        "scenarios": scenario_rows(result),
        "starts": clean(result.starts),
        "mirror": clean(result.mirrored),
        "choices": clean(result.choices),
        "optimality": clean(result.optimality),
        "curvature": clean(result.curvature),
        "tradeoff": clean(result.tradeoff),
        "certificate": None if result.certificate is None else result.certificate._asdict(),
        "wall_s": result.wall_s,
        "bound": None if result.bound is None else clean(result.bound.to_json()),
        "validation": clean(result.validation),
        "provenance": result.provenance,
    }


def text(result):
    """The result as a page of text."""
    return "\n".join([*parts_of(result), _wrap(result.message)])


def parts_of(result):
    """What `text` says but for the message: a list of lines and Tables."""
    unit = objective_unit(result.objective["terms"], result.tuned.loop.units)
    head = [
        f"{result.tuned.name}: {result.status} ({result.method}, {result.evaluations['simulations']} simulations, "
        f"{result.evaluations['gradients']} of them with gradients, {result.wall_s:.1f} s)",
        "",
    ]
    rows = [
        [
            n,
            p["unit"],
            number(p["before"]),
            number(p["after"]),
            f"{number(p['lower'])} : {number(p['upper'])}",
            "-" if p["felt_percent"] is None else f"{number(p['felt_percent'], 2)} %",
            f"at {p['at_bound']} bound" if p["at_bound"] else "",
        ]
        for n, p in result.parameters.items()
    ]
    parts = [table(rows, ["parameter", "unit", "before", "after", "range", "10 % of it moves the objective by", ""]), ""]
    rows = [["objective", unit, number(result.objective["before"]), number(result.objective["after"])]]
    for m in SHOWN:
        if m in result.measures["after"] and not (m == "rms_error_total" and set(result.objective["terms"]) == {m}):
            rows.append(
                [
                    m,
                    ms.unit(m, result.tuned.loop.units),
                    numbers(result.measures["before"][m], 4),
                    numbers(result.measures["after"][m], 5 if "level" in m else 4),
                ]
            )
    parts += [table(rows, ["measure", "unit", "before", "after"]), ""]
    if result.constraints:
        shown = worst_of_scenarios(result.constraints)
        rows = [
            [
                c["name"],
                c["unit"],
                (">= " if c["measure"] in LOWER else "<= ") + number(c["limit"], 7),
                number(c["value"], 7),
                number(c["margin"], 3),
                f"{c['time_s']:.2f} s" if c["time_s"] is not None else "-",
            ]
            for c in shown
        ]
        parts += [
            table(
                rows,
                [
                    "limit",
                    "unit",
                    "limit",
                    "value",
                    "margin",
                    "reached at",
                ],
            ),
            "",
        ]
    parts += _scenario_table(result) + _validation_table(result) + _choice_table(result) + _tradeoff_table(result)
    if result.bound is not None:
        parts += [result.bound.text(), ""]
    rims = (
        "rims are physics: liquid past them is lost"
        if result.tuned.loop.plant.overflow
        else "rims are limits: a level may rise past one"
    )
    return [*head, *parts, f"{rims}; checked at dt = {result.tuned.clock.dt:g} s"]


def worst_of_scenarios(constraints):
    """The rows of `constraints`, of those that differ by their scenario alone the one with the least margin."""
    worst = {}
    for c in constraints:
        same = (c["measure"], c["tank"], c["name"].removesuffix(f" in {c['scenario']}"))
        if same not in worst or c["margin"] < worst[same]["margin"]:
            worst[same] = c
    return list(worst.values())


def scenario_rows(result):
    """One dict for each scenario: {name, weight, objective {before, after}, limits_held {before, after}}; [] for the case's own run alone."""
    problem = result.problem
    if not problem.scenarios:
        return []
    rows = []
    for i, lane in enumerate(problem.lanes):
        mine = [limit for limit in problem.limits if limit.lane == i]
        sides = {k: t[i] for k, t in result.tables.items()}
        rows.append(
            {
                "name": lane.name,
                "weight": lane.weight,
                "objective": clean({k: problem.cost(row) for k, row in sides.items()}),
                "limits_held": {k: all(limit.margin(row) >= 0 for limit in mine) for k, row in sides.items()},
            }
        )
    return rows


COSTLIEST = 5
"""Scenarios that a table shows of many: all of a dozen, else the costliest."""


def _scenario_table(result):
    scenarios = scenario_rows(result)
    many = len(scenarios) > 12
    worst = sorted(scenarios, key=lambda s: -np.inf if s["objective"]["after"] is None else -s["objective"]["after"])
    rows = [
        [
            s["name"],
            number(s["weight"], 3),
            *(number(s["objective"][k]) if s["objective"][k] is not None else "-" for k in ("before", "after")),
            "yes" if s["limits_held"]["after"] else "no",
        ]
        for s in (worst[:COSTLIEST] if many else scenarios)
    ]
    head = ["scenario", "weight", "objective before", "after", "limits held after"]
    held = sum(s["limits_held"]["after"] for s in scenarios)
    more = [f"the {COSTLIEST} costliest of {len(scenarios)} scenarios; limits held after in {held}"] if many else []
    return [table(rows, head), *more, ""] if rows else []


def _validation_table(result):
    found = result.validation
    if not found:
        return []
    spread = ", ".join(n if s is None else f"{n} +-{100 * s:g} %" for n, s in found["spread"].items()) or "the plant as it is"
    noise = ", fresh noise" if found["noise"] else ""
    rows = [
        [
            side,
            *(number(found["objective"][side][k]) for k in ("mean", "p05", "p50", "p95")),
            f"{100 * found['limits_held'][side]:.0f} %",
        ]
        for side in ("before", "after")
        if found["limits_held"][side] is not None
    ]
    if not rows:
        return [f"held-out runs: all {found['samples']} failed", ""]
    head = [f"on {found['samples']} held-out runs", "mean objective", "5 %", "median", "95 %", "all limits held in"]
    failed = f"; {found['failed']} runs failed and are left out" if found["failed"] else ""
    share = f"{_better(found)}; perturbed: {spread}{noise}{failed}"
    return [table(rows, head), share, ""]


def _better(found):
    """In how many held-out runs tuning gained: a lower cost than that of a run which breaks a limit is no gain, and a higher no loss."""
    if found["comparable"] == 1.0:
        return f"tuned is better in {100 * found['better_share']:.0f} % of them"
    part = f"before and after both hold every limit in {100 * found['comparable']:.3g} % of them"
    if found["better_share_of_comparable"] is None:
        return f"{part}, so their objectives are not to be compared"
    return f"{part}, and of those tuned is better in {100 * found['better_share_of_comparable']:.0f} %"


def _choice_table(result):
    if not result.choices:
        return []
    rows = [
        [
            ", ".join(f"{n} = {v}" for n, v in c["values"].items()),
            c["status"],
            number(c["objective"]["before"]),
            number(c["objective"]["after"]),
        ]
        for c in result.choices
    ]
    return [table(rows, ["choice", "status", "objective before", "after"]), ""]


def _tradeoff_table(result):
    if not result.tradeoff:
        return []
    unit = ms.unit(result.tradeoff["measure"], result.tuned.loop.units)
    rows = [
        [
            number(p["limit"]),
            p["status"],
            number(p["objective"]),
            ", ".join(f"{n} {number(v, 4)}" for n, v in p["parameters"].items()),
        ]
        for p in result.tradeoff["points"]
    ]
    return [table(rows, [f"limit of {result.tradeoff['measure']} [{unit}]", "status", "objective", "at"]), ""]


def _wrap(message):
    return "\n".join(f"- {part}" for part in message.split("; "))


def objective_unit(terms, rig_units=DEFAULT):
    """Unit of a weighted sum: that of its only measure, or a plain number."""
    found = {ms.unit(m, rig_units) for m in terms}
    return found.pop() if len(found) == 1 else "-"


def trajectory_csv(run, rig_units=DEFAULT):
    """A trajectory as CSV with units in the header; estimates of disturbances where there are any."""
    known = bool(np.asarray(run.d_hat).any())
    kept = {n: v for n, v in columns(run, rig_units).items() if not n.startswith("h_hat") and (known or not n.startswith("d_hat"))}
    out = io.StringIO()
    out.write(",".join(kept) + "\n")
    np.savetxt(out, np.column_stack(list(kept.values())), delimiter=",", fmt="%.10g")
    return out.getvalue()


def run_for_people(case, key=None, rows=3000):
    """A Trajectory of about `rows` rows, as host arrays."""
    steps = case.clock.samples - 1
    least = max(1, steps // rows)
    # an odd stride, so that a pump that chatters from sample to sample is not drawn as one that rests; one that ends at the end, if any
    every = next((k for k in range(least, 2 * least + 1) if k % 2 and steps % k == 0), least | 1)
    run = lp.simulate(case.loop, case.clock, key, save_every=every)
    return type(run)(*(np.asarray(v) for v in run))


def _png(figure):
    import matplotlib.pyplot as plt

    out = io.BytesIO()
    figure.savefig(out, format="png", metadata={"Software": None})
    plt.close(figure)
    return out.getvalue()


def pngs(drawn):
    """{file name: bytes} of {name: figure}; the figures are closed."""
    return {f"{name}.png": _png(figure) for name, figure in drawn.items()}


def result_key(result):
    """The key of the sensor noise of the case's own run, None where it has none."""
    import jax

    return jax.random.key(result.problem.seed) if bool(np.any(np.asarray(result.case.loop.sensor.noise) > 0)) else None


def figures(result, runs=None):
    """Matplotlib figures of a tuning result: those of CAPTIONS that have something to show."""
    import matplotlib.pyplot as plt

    from jaxtank import plotting
    from tuning import pictures

    key = result_key(result)
    runs = runs or {"before": run_for_people(result.case, key), "after": run_for_people(result.tuned, key)}
    unit = objective_unit(result.objective["terms"], result.tuned.loop.units)
    tanks = {limit.index: limit.value for limit in result.problem.limits if limit.measure == "max_level" and limit.lane == 0}
    limits = [tanks.get(i, np.asarray(result.tuned.loop.plant.rim)[i]) for i in range(result.tuned.loop.plant.tanks)]
    told = {"before": "", "after": ""}
    if result.problem.limits:
        told = {
            k: ", breaks a limit" if (result.problem.margins(t) < 0).any() else ", holds all limits"
            for k, t in result.tables.items()
        }
    title = (
        f"{result.tuned.name}: objective {number(result.objective['before'], 4)}{told['before']} -> "
        f"{number(result.objective['after'], 4)}{'' if unit == '-' else f' {unit}'}{told['after']}\n("
        + ", ".join(
            f"{n.removeprefix('controller.')} {number(p['before'], 4)} -> {number(p['after'], 4)} {p['unit']}"
            for n, p in list(result.parameters.items())[:4]
        )
        + ")"
    )
    drawn = {
        "responses": plotting.responses(result.tuned.loop, runs, title, limits),
        **pictures.rig(result.tuned.loop, runs["after"], f"{result.tuned.name} at the end of the tuned run"),
        **pictures.margins(worst_of_scenarios(result.constraints)),
        **pictures.inner(result.tuned.loop, runs),
        **pictures.saturation(result.tuned.loop, runs),
        **pictures.estimates(
            result.tuned.loop, result.tuned.clock, runs["after"], f"{result.tuned.name}, tuned: what its observer saw"
        ),
    }
    with plotting.styled():
        if result.cloud is not None and len(result.cloud["objective"]):
            drawn["clouds"] = _clouds(plt, result, unit)
        if result.history:
            figure, ax = plt.subplots(figsize=(6.4, 3.8), layout="constrained")
            plotting.convergence(ax, result.history, unit, bool(result.problem.limits))
            drawn["convergence"] = figure
        figure, ax = plt.subplots(figsize=(6.4, 4.8), layout="constrained")
        _landscape(ax, result, unit)
        drawn["landscape"] = figure
    if result.tradeoff:
        of = ms.unit(result.tradeoff["measure"], result.tuned.loop.units)
        drawn |= pictures.tradeoff(result.tradeoff, of, unit)
    return drawn


CAPTIONS = {
    "responses": "The run before tuning (orange, dashed) and after (blue): controlled levels with their setpoints, tracking errors, the other "
    "tanks, and what the pumps were given. Shaded: past a limit.",
    "margins": "Room that the tuned run leaves to each limit; a bar to the left of zero is a limit that is broken.",
    "inner": "The tanks that are not controlled, one against the other, from the dot to the square.",
    "saturation": "When pumps were commanded past their limits: up past the upper, down past the lower, as tall as the share of the time.",
    "estimates": "What the observer believed beside what was true, in the tuned run.",
    "clouds": "Runs that the search never saw, on perturbed plants and fresh noise where the case has them: a dot each, before across, after up.",
    "convergence": "Every evaluation of the search in its order.",
    "landscape": "The objective around the answer, at the case's own step.",
    "tradeoff": "The least objective that each value of the limit leaves.",
    "rig": "The rig, drawn from its own topology; triangles are setpoints, a heavier outline is a tank that is controlled.",
}


def page_of(result, drawn, command=None):
    """The page report.html of a tuning result, with `drawn`, the figures of `figures`; command: the line that made it."""
    from tuning import page

    unit = objective_unit(result.objective["terms"], result.tuned.loop.units).replace("-", "")
    before, after = result.objective["before"], result.objective["after"]
    broken = [c for c in result.constraints if c["margin"] < 0]
    limits = f"{len(result.constraints) - len(broken)} of {len(result.constraints)} hold" if result.constraints else "none"
    facts = [
        ("objective before", f"{number(before)} {unit}".strip()),
        ("objective after", f"{number(after)} {unit}".strip()),
        ("limits", limits),
        ("gains tuned", str(len(result.parameters))),
        ("simulations", str(result.evaluations["simulations"])),
        ("time", f"{result.wall_s:.1f} s"),
    ]
    if np.isfinite(before) and before and not broken:
        facts.insert(2, ("change", f"{100 * (after / before - 1):+.3g} %"))
    return page.document(
        f"{result.tuned.name}: tuned",
        result.case.title,
        result.status.replace("_", " ") + ("; every limit holds" if result.constraints and not broken else ""),
        result.success,
        facts,
        result.message.split("; "),
        [(n, page.svg(f, n, CAPTIONS[n]), CAPTIONS[n]) for n, f in drawn.items()],
        parts_of(result)[1:],
        command,
        result.provenance,
        {"The tuned rig as a file (rig.toml)": rig.dump(result.tuned)},
    )


def _clouds(plt, result, unit):
    """The runs that the search never saw, before against after: the objective, and the level that comes nearest to its limit."""
    from jaxtank import plotting

    found, length = result.cloud, result.tuned.loop.units[0]
    figure, (left, right) = plt.subplots(1, 2, figsize=(8.6, 4.9), layout="constrained")
    plotting.cloud(left, found["objective"], found["held"], "objective", unit)
    name = "highest level over its limit" if found["past"] else "highest level"
    plotting.cloud(right, found["level"], found["held"], name, length, found["limit"])
    handles, labels = right.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=3)
    figure.suptitle(plotting.plain(f"{result.tuned.name}: {len(found['objective'])} runs that the search never saw"), fontsize=10)
    return figure


def _landscape(ax, result, unit):
    """The objective around the answer at the case's own step: along one parameter, or over the two that it feels most."""
    from jaxtank import plotting

    problem = result.problem
    z = np.array([float(b.to_unit(p["after"])) for b, p in zip(problem.bounds, result.parameters.values())])
    z0 = problem.start()
    if len(z) == 1:
        grid = np.linspace(0.0, 1.0, 128)
        costs, margins = problem.screen(grid[:, None])
        violation = np.maximum(0.0, -margins).max(axis=1, initial=0.0)
        b = problem.bounds[0]
        return plotting.curve(
            ax,
            b.from_unit(grid),
            costs,
            violation,
            b.name,
            b.unit,
            unit,
            (result.parameters[b.name]["before"], result.objective["before"]),
            (result.parameters[b.name]["after"], result.objective["after"]),
            b.scale == "log",
        )
    first, second = sorted(np.argsort([-(p["felt_percent"] or 0.0) for p in result.parameters.values()], kind="stable")[:2])
    side = np.linspace(0.0, 1.0, 24)
    a, c = np.meshgrid(side, side)
    points = np.tile(z, (a.size, 1))
    points[:, first], points[:, second] = a.ravel(), c.ravel()
    costs, margins = problem.screen(points)
    worst = -margins.min(axis=1) if margins.size else np.zeros(len(costs))
    x, y = problem.bounds[first], problem.bounds[second]
    plotting.contours(
        ax,
        x.from_unit(a),
        y.from_unit(c),
        costs.reshape(a.shape),
        worst.reshape(a.shape),
        (x.name, y.name),
        (x.unit, y.unit),
        unit,
        (x.from_unit(z0[first]), y.from_unit(z0[second])),
        (x.from_unit(z[first]), y.from_unit(z[second])),
        (x.scale == "log", y.scale == "log"),
    )
    if len(z) > 2:
        ax.set_title("landscape (slice through the answer)")
    return ax


def save(result, folder, command=None):
    """Write result.json, rig.toml, trajectory.csv, PNG pictures and report.html to `folder`, each whole or not at all; returns their paths.

    command: the line that made the result, for the report, where there is one.
    """
    check_folder(folder)
    folder = Path(folder)
    key = result_key(result)
    runs = {"before": run_for_people(result.case, key), "after": run_for_people(result.tuned, key)}
    files = {
        "result.json": dumps(json_of(result)) + "\n",
        "rig.toml": rig.dump(result.tuned),
        "trajectory.csv": trajectory_csv(runs["after"], result.tuned.loop.units),
        "before.csv": trajectory_csv(runs["before"], result.case.loop.units),
    }
    drawn = figures(result, runs)
    return write_files(folder, files | {"report.html": page_of(result, drawn, command)} | pngs(drawn))


def save_run(case, run, payload, folder, gif=False):
    """Write result.json, trajectory.csv, responses.png and, if asked, run.gif of one simulation to `folder`."""
    from jaxtank import plotting

    check_folder(folder)
    picture = plotting.responses(case.loop, {case.name: run}, case.title)
    files = {
        "result.json": dumps(payload) + "\n",
        "trajectory.csv": trajectory_csv(run, case.loop.units),
        "responses.png": _png(picture),
    }
    if gif:
        from jaxtank.animation import animate

        with tempfile.TemporaryDirectory() as aside:
            files["run.gif"] = animate(case.loop, run, Path(aside) / "run.gif").read_bytes()
    return write_files(Path(folder), files)


def write_files(folder, files):
    """Write {name: text or bytes} to `folder`, made if need be, all of them or none; returns the paths."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        write_together(folder, files)
    except OSError as error:
        raise InputError(f"--out {str(folder)!r}: cannot be written to ({error.strerror}); give a folder that can") from None
    return [folder / name for name in files]
