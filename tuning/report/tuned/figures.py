"""Pictures of a tuning result; imported by its report."""

import numpy as np

from jaxtank import measures as ms
from tuning.report.artifacts import run_for_people
from tuning.report.tables import cost_unit, number
from tuning.report.tuned.tables import worst_of_scenarios


def result_key(result):
    """Return the key of the sensor noise of the case's own run, None where it has none."""
    import jax

    noise = np.asarray(result.case.loop.sensor.noise)
    return jax.random.key(result.problem.seed) if bool(np.any(noise > 0)) else None


def figures(result, runs=None):
    """Return matplotlib figures of a TuningResult: those of CAPTIONS that have something
    to show.
    """
    from jaxtank.plots import responses
    from tuning.report import figures as pictures

    if runs is None:
        key = result_key(result)
        runs = {s: run_for_people(c, key) for s, c in _sides(result).items()}
    loop, name = result.tuned.loop, result.tuned.name
    observed = f"{name}, tuned: what its observer estimated"
    drawn = {
        "responses": responses.responses(loop, runs, _title(result), _level_limits(result)),
        **pictures.rig(loop, runs["after"], f"{name} at the end of the tuned run"),
        **pictures.margins(worst_of_scenarios(result.constraints)),
        **pictures.inner(loop, runs),
        **pictures.saturation(loop, runs),
        **pictures.estimates(loop, result.tuned.clock, runs["after"], observed),
        **_search_figures(result),
    }
    if result.tradeoff:
        unit = cost_unit(result)
        limited = ms.unit(result.tradeoff["measure"], loop.units)
        drawn |= pictures.tradeoff(result.tradeoff, limited, unit)
    return drawn


def _sides(result):
    return {"before": result.case, "after": result.tuned}


def _level_limits(result):
    """The highest allowed level of each tank: its limit, or else its rim."""
    limits = {
        limit.index: limit.value
        for limit in result.problem.limits
        if limit.measure == "max_level" and limit.run == 0
    }
    rims = np.asarray(result.tuned.loop.plant.rim)
    return [limits.get(i, rims[i]) for i in range(result.tuned.loop.plant.tanks)]


def _title(result):
    """The objective and the first gains before and after, as the title of the responses."""
    held = {"before": "", "after": ""}
    if result.problem.limits:
        for side, table in result.tables.items():
            broken = (result.problem.margins(table) < 0).any()
            held[side] = ", breaks a limit" if broken else ", holds all limits"
    unit = cost_unit(result)
    unit = "" if unit == "-" else f" {unit}"
    before, after = (number(result.objective[side], 4) for side in ("before", "after"))
    gains = ", ".join(
        f"{n.removeprefix('controller.')} {number(p['before'], 4)} -> {number(p['after'], 4)}"
        f" {p['unit']}"
        for n, p in list(result.parameters.items())[:4]
    )
    first = f"{before}{held['before']} -> {after}{unit}{held['after']}"
    return f"{result.tuned.name}: objective {first}\n({gains})"


def _search_figures(result):
    """The validation runs, the course of the search, and the objective around its answer."""
    import matplotlib.pyplot as plt

    from jaxtank.plots import responses

    unit = cost_unit(result)
    drawn = {}
    with responses.styled():
        if result.cloud is not None and len(result.cloud["objective"]):
            drawn["clouds"] = _clouds(plt, result, unit)
        if result.history:
            figure, ax = plt.subplots(figsize=(6.4, 3.8), layout="constrained")
            responses.convergence(ax, result.history, unit, bool(result.problem.limits))
            drawn["convergence"] = figure
        figure, ax = plt.subplots(figsize=(6.4, 4.8), layout="constrained")
        (_curve if len(result.parameters) == 1 else _contours)(ax, result, unit)
        drawn["landscape"] = figure
    return drawn


CAPTIONS = {
    "responses": (
        "The run before tuning (orange, dashed) and after (blue): controlled levels with their"
        " setpoints, tracking errors, the other tanks, and the pump inputs. Shaded: beyond a"
        " limit."
    ),
    "margins": (
        "Margin of the tuned run to each limit; a bar to the left of zero is a broken limit."
    ),
    "inner": (
        "The tanks that are not controlled, one against the other, from the dot to the square."
    ),
    "saturation": (
        "When pumps were commanded beyond their limits: upwards above the upper limit, downwards"
        " below the lower one; the height is the share of the time."
    ),
    "estimates": "Estimates of the observer and true values, in the tuned run.",
    "clouds": (
        "Validation runs, on perturbed plants and with new sensor noise where the case has them:"
        " one dot a run, before tuning on the horizontal axis, after it on the vertical one."
    ),
    "convergence": "Every evaluation of the search in its order.",
    "landscape": "The objective around the tuned values, at the case's own step.",
    "tradeoff": "The least objective that was found under each value of the limit.",
    "rig": (
        "The rig, drawn from its own topology; triangles are setpoints, a heavier outline is a tank"
        " that is controlled."
    ),
}


def _clouds(plt, result, unit):
    """Validation runs before against after: the objective, and the level nearest to its limit."""
    from jaxtank.plots import responses

    found, length = result.cloud, result.tuned.loop.units[0]
    figure, (left, right) = plt.subplots(1, 2, figsize=(8.6, 4.9), layout="constrained")
    responses.cloud(left, found["objective"], found["held"], "objective", unit)
    name = "highest level over its limit" if found["past"] else "highest level"
    responses.cloud(right, found["level"], found["held"], name, length, found["limit"])
    handles, labels = right.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=3)
    figure.suptitle(
        responses.plain(f"{result.tuned.name}: {len(found['objective'])} validation runs"),
        fontsize=10,
    )
    return figure


def _unit_values(result):
    """The tuned values in the unit box of the search."""
    rows = zip(result.problem.bounds, result.parameters.values())
    return np.array([float(b.to_unit(p["after"])) for b, p in rows])


def _curve(ax, result, unit):
    """The objective along the only free parameter, at the case's own step."""
    from jaxtank.plots import responses

    grid, b = np.linspace(0.0, 1.0, 128), result.problem.bounds[0]
    costs, margins = result.problem.screen(grid[:, None])
    violation = np.maximum(0.0, -margins).max(axis=1, initial=0.0)
    before, after = ((result.parameters[b.name][s], result.objective[s]) for s in _sides(result))
    axis = (b.name, b.unit, unit)
    log = b.scale == "log"
    responses.curve(ax, b.from_unit(grid), costs, violation, *axis, before, after, log)


def _contours(ax, result, unit):
    """The objective over the two parameters that it is most sensitive to, the others as tuned."""
    from jaxtank.plots import responses

    problem, tuned, start = result.problem, _unit_values(result), result.problem.start()
    effect = [-(p["sensitivity_percent"] or 0.0) for p in result.parameters.values()]
    pair = sorted(np.argsort(effect, kind="stable")[:2])
    side = np.linspace(0.0, 1.0, 24)
    across, up = np.meshgrid(side, side)
    points = np.tile(tuned, (across.size, 1))
    points[:, pair[0]], points[:, pair[1]] = across.ravel(), up.ravel()
    costs, margins = problem.screen(points)
    worst = -margins.min(axis=1) if margins.size else np.zeros(len(costs))
    x, y = (problem.bounds[i] for i in pair)
    responses.contours(
        ax,
        x.from_unit(across),
        y.from_unit(up),
        costs.reshape(across.shape),
        worst.reshape(across.shape),
        (x.name, y.name),
        (x.unit, y.unit),
        unit,
        (x.from_unit(start[pair[0]]), y.from_unit(start[pair[1]])),
        (x.from_unit(tuned[pair[0]]), y.from_unit(tuned[pair[1]])),
        (x.scale == "log", y.scale == "log"),
    )
    if len(tuned) > 2:
        ax.set_title("landscape (the other parameters as tuned)")
