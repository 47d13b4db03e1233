"""Pictures, page and folder of a tuning result."""

import warnings
from pathlib import Path

import numpy as np

from jaxtank import measures as ms
from jaxtank import rig
from jaxtank.core.errors import InputError
from jaxtank.core.files import check_folder
from jaxtank.loop.trajectory import csv
from tuning.report.artifacts import earlier, run_for_people, write_result
from tuning.report.tables import dumps, number, objective_unit
from tuning.report.tuning import json_of, parts_of, worst_of_scenarios


def result_key(result):
    """The key of the sensor noise of the case's own run, None where it has none."""
    import jax

    return (
        jax.random.key(result.problem.seed)
        if bool(np.any(np.asarray(result.case.loop.sensor.noise) > 0))
        else None
    )


def figures(result, runs=None):
    """Matplotlib figures of a tuning result: those of CAPTIONS that have something to show."""
    import matplotlib.pyplot as plt

    from jaxtank.plots import responses
    from tuning.report import figures as pictures

    key = result_key(result)
    runs = runs or {
        "before": run_for_people(result.case, key),
        "after": run_for_people(result.tuned, key),
    }
    unit = objective_unit(result.objective["terms"], result.tuned.loop.units)
    tanks = {
        limit.index: limit.value
        for limit in result.problem.limits
        if limit.measure == "max_level" and limit.lane == 0
    }
    limits = [
        tanks.get(i, np.asarray(result.tuned.loop.plant.rim)[i])
        for i in range(result.tuned.loop.plant.tanks)
    ]
    told = {"before": "", "after": ""}
    if result.problem.limits:
        told = {
            k: ", breaks a limit" if (result.problem.margins(t) < 0).any() else ", holds all limits"
            for k, t in result.tables.items()
        }
    title = (
        f"{result.tuned.name}: objective"
        f" {number(result.objective['before'], 4)}{told['before']} -> "
        f"{number(result.objective['after'], 4)}{'' if unit == '-' else f' {unit}'}{told['after']}\n("
        + ", ".join(
            f"{n.removeprefix('controller.')} {number(p['before'], 4)} -> {number(p['after'], 4)}"
            f" {p['unit']}"
            for n, p in list(result.parameters.items())[:4]
        )
        + ")"
    )
    drawn = {
        "responses": responses.responses(result.tuned.loop, runs, title, limits),
        **pictures.rig(
            result.tuned.loop, runs["after"], f"{result.tuned.name} at the end of the tuned run"
        ),
        **pictures.margins(worst_of_scenarios(result.constraints)),
        **pictures.inner(result.tuned.loop, runs),
        **pictures.saturation(result.tuned.loop, runs),
        **pictures.estimates(
            result.tuned.loop,
            result.tuned.clock,
            runs["after"],
            f"{result.tuned.name}, tuned: what its observer saw",
        ),
    }
    with responses.styled():
        if result.cloud is not None and len(result.cloud["objective"]):
            drawn["clouds"] = _clouds(plt, result, unit)
        if result.history:
            figure, ax = plt.subplots(figsize=(6.4, 3.8), layout="constrained")
            responses.convergence(ax, result.history, unit, bool(result.problem.limits))
            drawn["convergence"] = figure
        figure, ax = plt.subplots(figsize=(6.4, 4.8), layout="constrained")
        _landscape(ax, result, unit)
        drawn["landscape"] = figure
    if result.tradeoff:
        of = ms.unit(result.tradeoff["measure"], result.tuned.loop.units)
        drawn |= pictures.tradeoff(result.tradeoff, of, unit)
    return drawn


CAPTIONS = {
    "responses": (
        "The run before tuning (orange, dashed) and after (blue): controlled levels with their"
        " setpoints, tracking errors, the other tanks, and what the pumps were given. Shaded: past"
        " a limit."
    ),
    "margins": (
        "Room that the tuned run leaves to each limit; a bar to the left of zero is a limit that is"
        " broken."
    ),
    "inner": (
        "The tanks that are not controlled, one against the other, from the dot to the square."
    ),
    "saturation": (
        "When pumps were commanded past their limits: up past the upper, down past the lower, as"
        " tall as the share of the time."
    ),
    "estimates": "What the observer believed beside what was true, in the tuned run.",
    "clouds": (
        "Runs that the search never saw, on perturbed plants and fresh noise where the case has"
        " them: a dot each, before across, after up."
    ),
    "convergence": "Every evaluation of the search in its order.",
    "landscape": "The objective around the answer, at the case's own step.",
    "tradeoff": "The least objective that each value of the limit leaves.",
    "rig": (
        "The rig, drawn from its own topology; triangles are setpoints, a heavier outline is a tank"
        " that is controlled."
    ),
}


def page_of(result, drawn, command=None):
    """The page report.html of a tuning result, with `drawn`, the figures of `figures`; command: the
    line that made it.
    """
    from tuning.report import html

    unit = objective_unit(result.objective["terms"], result.tuned.loop.units).replace("-", "")
    before, after = result.objective["before"], result.objective["after"]
    broken, (rig_text, _) = [c for c in result.constraints if c["margin"] < 0], rig_of(result)
    limits = (
        f"{len(result.constraints) - len(broken)} of {len(result.constraints)} hold"
        if result.constraints
        else "none"
    )
    facts = [
        ("objective before", f"{number(before)} {unit}".strip()),
        ("objective after", f"{number(after)} {unit}".strip()),
        ("limits", limits),
        ("gains tuned", str(sum(p["exercised"] for p in result.parameters.values()))),
        ("simulations", str(result.evaluations["simulations"])),
        ("time", f"{result.wall_s:.1f} s"),
    ]
    if np.isfinite(before) and before and not broken:
        facts.insert(2, ("change", f"{100 * (after / before - 1):+.3g} %"))
    return html.document(
        f"{result.tuned.name}: tuned",
        result.case.title,
        result.status.replace("_", " ")
        + ("; every limit holds" if result.constraints and not broken else ""),
        result.success,
        facts,
        result.message.split("; "),
        html.drawings(drawn, CAPTIONS),
        parts_of(result)[1:],
        command,
        result.provenance,
        {"The tuned rig as a file (rig.toml)": rig_text} if rig_text else None,
    )


def _clouds(plt, result, unit):
    """The runs that the search never saw, before against after: the objective, and the level that
    comes nearest to its limit.
    """
    from jaxtank.plots import responses

    found, length = result.cloud, result.tuned.loop.units[0]
    figure, (left, right) = plt.subplots(1, 2, figsize=(8.6, 4.9), layout="constrained")
    responses.cloud(left, found["objective"], found["held"], "objective", unit)
    name = "highest level over its limit" if found["past"] else "highest level"
    responses.cloud(right, found["level"], found["held"], name, length, found["limit"])
    handles, labels = right.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=3)
    figure.suptitle(
        responses.plain(
            f"{result.tuned.name}: {len(found['objective'])} runs that the search never saw"
        ),
        fontsize=10,
    )
    return figure


def _landscape(ax, result, unit):
    """The objective around the answer at the case's own step: along one parameter, or over the two
    that it feels most.
    """
    from jaxtank.plots import responses

    problem = result.problem
    z = np.array(
        [float(b.to_unit(p["after"])) for b, p in zip(problem.bounds, result.parameters.values())]
    )
    z0 = problem.start()
    if len(z) == 1:
        grid = np.linspace(0.0, 1.0, 128)
        costs, margins = problem.screen(grid[:, None])
        violation = np.maximum(0.0, -margins).max(axis=1, initial=0.0)
        b = problem.bounds[0]
        return responses.curve(
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
    first, second = sorted(
        np.argsort(
            [-(p["felt_percent"] or 0.0) for p in result.parameters.values()], kind="stable"
        )[:2]
    )
    side = np.linspace(0.0, 1.0, 24)
    a, c = np.meshgrid(side, side)
    points = np.tile(z, (a.size, 1))
    points[:, first], points[:, second] = a.ravel(), c.ravel()
    costs, margins = problem.screen(points)
    worst = -margins.min(axis=1) if margins.size else np.zeros(len(costs))
    x, y = problem.bounds[first], problem.bounds[second]
    responses.contours(
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


def rig_of(result):
    """Return (text of rig.toml, None), or (None, why there is none).

    A class of one's own has no name in a rig file.
    """
    try:
        return rig.dump(result.tuned), None
    except InputError as error:
        gains = ", ".join(f"{n} = {p['after']!r} {p['unit']}" for n, p in result.parameters.items())
        return None, f"rig.toml is not written ({error}); set in Python what was tuned: {gains}"


def save(result, folder, command=None):
    """Write result.json, rig.toml, trajectory.csv, to `folder`, all or none, then PNG pictures and
    report.html; returns their paths.

    command: the line that made the result, for the report, where there is one. A case that no rig
    file can describe (with a plant or a controller class of one's own) has no rig.toml: a
    UserWarning, result.json and the report give the reason, and the rig.toml of an earlier result
    is removed.
    """
    check_folder(folder)
    folder = Path(folder)
    rig_text, why = rig_of(result)
    if why:
        warnings.warn(why, stacklevel=3)  # the line that called result.save
        result = result.replace(message=f"{result.message}; {why}")
    key = result_key(result)
    runs = {"before": run_for_people(result.case, key), "after": run_for_people(result.tuned, key)}
    files = {
        "result.json": dumps(json_of(result)) + "\n",
        **({"rig.toml": rig_text} if rig_text else {}),
        "trajectory.csv": csv(runs["after"], result.tuned.loop.units),
        "before.csv": csv(runs["before"], result.case.loop.units),
    }
    stale = earlier(folder, CAPTIONS)
    if not rig_text and (folder / "result.json").is_file():
        # of another result: its gains must not be taken for these
        stale.append(folder / "rig.toml")
    return write_result(
        folder,
        files,
        lambda: figures(result, runs),
        lambda drawn: page_of(result, drawn, command),
        stale,
    )
