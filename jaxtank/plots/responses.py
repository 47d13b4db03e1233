"""Pictures of runs over time, of a search and its objective, and of sensitivities."""

import textwrap
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.colors import BoundaryNorm

from jaxtank.core.errors import InputError
from jaxtank.core.labels import input_unit, label_of
from jaxtank.core.text import count
from jaxtank.plots import style
from jaxtank.plots.overview import NAMED, worst
from jaxtank.plots.spills import above_rim, spill_note, spilled
from jaxtank.plots.style import add_legend, grid, hide, lines, picture, plain, styled

BARS = 14  # bars in a picture at most; the smallest are left out, and the title gives their number
COLUMNS = 4  # panels beside each other
SHOWN = 16  # tanks between, outputs and pumps that are drawn each; of more, those that matter
HEADROOM = 1.05  # end of the axis of a level over what it has to show [-]


def level(
    ax, runs, tank, output, rim=None, *, plant, unit, limit=None, low=None, spills=None, top=0.0
):
    """Draw the level of one tank, with its setpoint, rim and limits; top: end of the axis."""
    lines(ax, runs, "x", tank, linewidth=1.4)
    if output is not None:
        last = next(iter(runs.values()))[0]
        dots = {"color": style.REFERENCE, "linestyle": ":", "linewidth": 1.2, "label": "setpoint"}
        ax.plot(last.t, last.r[:, output], **dots)
    highest = max(_highest(runs, tank), top / HEADROOM)
    highest_bound = 0.0
    # a rim far above all levels would only compress the picture
    for bound, name in ((rim, "rim"), (limit if limit != rim else None, "limit")):
        if bound is not None and (highest > 0.6 * bound):
            highest_bound = max(highest_bound, bound)
            top = max(highest * 1.03, highest_bound * HEADROOM, top)
            ax.axhspan(bound, top, **style.BEYOND)
            label = f"{name} {bound:g} {unit}"
            ax.axhline(bound, color=style.FORBIDDEN, linewidth=1.0, label=label)
    lowest = min(float(np.min(run.x[:, tank])) for run, _, _ in runs.values())
    bottom = None
    if low is not None and lowest < 2.0 * low:
        bottom = max(0.0, min(lowest, low) - 0.05 * highest)
        ax.axhspan(bottom, low, **style.BEYOND)
        ax.axhline(low, color=style.FORBIDDEN, linewidth=1.0, label=f"low limit {low:g} {unit}")
    if top:
        ax.set_ylim(top=top)
    ax.set_ylim(bottom=min(0.0, ax.get_ylim()[0]) if output is None else bottom)
    ax.set(title=f"{plain(label_of(plant, 'tank', tank))}{above_rim(ax, runs, tank, rim, spills)}")
    ax.set_ylabel(f"level [{unit}]")


def _highest(runs, tank):
    return max(float(np.max(run.x[:, tank])) for run, _, _ in runs.values())


def voltage(ax, runs, pump, low, high, unit="V", plant=None):
    """Draw the input of one pump; what lies outside its limits is shaded."""
    lines(ax, runs, "u", pump)
    label = f"input [{unit}]" if unit != "V" else "voltage [V]"
    ax.set(title=plain(label_of(plant, "pump", pump)), ylabel=label)
    drawn = [run.u[:, pump] for run, _, _ in runs.values()]
    lowest, highest = min(map(np.min, drawn)), max(map(np.max, drawn))
    if highest - lowest >= 0.1 * (high - low):  # limits far away are not shown
        margin = 0.06 * (high - low)
        ax.axhspan(low - margin, low, **style.BEYOND)
        ax.axhspan(high, high + margin, **style.BEYOND)
        ax.set_ylim(low - margin, high + margin)


def error(ax, runs, output, tank, unit="cm", plant=None):
    lines(ax, runs, "e", output)
    ax.axhline(0.0, color=style.REFERENCE, linewidth=0.8, linestyle=":")
    name = plain(label_of(plant, "tank", tank))
    ax.set(title=f"tracking error of {name}", ylabel=f"h - r [{unit}]")


def responses(loop, trajectories, title="", limits=None, lows=None):
    """Return a figure of a run, or of several in the same panels; limits, lows: of the levels."""
    if not trajectories:
        raise InputError("trajectories = {}: there is no run to draw")
    runs = with_looks(trajectories)
    others, note = _other_tanks(loop, trajectories)
    outputs, pumps, more = _worst_outputs(loop, trajectories)
    rows = _rows(loop, runs, (outputs, pumps, others), limits, lows)
    note += more + spill_note(loop.plant, trajectories)
    columns = max(len(row) for row in rows)
    wide = style.width(max(4.6 * columns, 6.4))
    with styled():
        high = style.height(2.05 * len(rows) + 0.5, len(rows))
        figure, axes = grid(len(rows), columns, (wide, high), sharex=True)
        for row, line in zip(rows, axes):
            for draw, ax in zip(row, line):
                draw(ax)
            hide(line[len(row) :])
        label_times(axes)
        most = max(2, round(wide))
        few = lambda labels: labels if labels <= 6 else max(4, round(wide / 2))
        add_legend(figure, lambda labels: min(few(labels), most))
        text = ("" if style.printing() else title) + note  # a journal has captions
        text = [plain(textwrap.fill(line, int(12 * wide))) for line in text.strip().splitlines()]
        figure.suptitle("\n".join(text), fontsize=None if style.printing() else 10)
    return figure


def label_times(axes):
    """Label the time axis of the lowest visible panel of each column."""
    for column in axes.T:
        last = [ax for ax in column if ax.get_visible()][-1]
        style.label_time(last)
        last.tick_params(labelbottom=True)


def with_looks(trajectories):
    """Return {name: (run, colour, line style)} of {name: run}."""
    if len(trajectories) == 1:
        return {name: (run, style.AFTER, "-") for name, run in trajectories.items()}
    looks, n = style.RUNS, len(style.RUNS)
    runs = enumerate(trajectories.items())
    return {name: (run, looks[i % n][0], looks[(i + i // n) % n][1]) for i, (name, run) in runs}


def _other_tanks(loop, trajectories):
    """(tanks besides the outputs, at most SHOWN, a line of the title on those left out)."""
    others = [i for i in range(loop.plant.tanks) if i not in loop.plant.outputs]
    if len(others) <= SHOWN:
        return others, ""
    highest = lambda i: max(float(np.max(run.x[:, i])) for run in trajectories.values())
    near = {i: highest(i) / _at(loop.plant.rim, i) for i in others}
    note = f"\nof the {len(others)} tanks between, the {SHOWN} that come nearest to their rims"
    return sorted(sorted(others, key=near.__getitem__)[-SHOWN:]), note


def _worst_outputs(loop, trajectories):
    """([(output, its tank)], pumps, a line of the title on those left out), the worst of many."""
    outputs, pumps = list(enumerate(loop.plant.outputs)), list(range(loop.plant.pumps))
    note = ""
    if len(outputs) > SHOWN:
        off = [np.sqrt(np.mean(run.e**2, axis=0)) for run in trajectories.values()]
        note += f"\nof {len(outputs)} outputs, the {NAMED} with the largest errors"
        outputs = [outputs[k] for k in worst(np.max(off, axis=0))]
    if len(pumps) > SHOWN:
        moved = [np.sum(np.abs(np.diff(run.u, axis=0)), axis=0) for run in trajectories.values()]
        note += f"\nof {len(pumps)} pumps, the {NAMED} that move most"
        pumps = worst(np.max(moved, axis=0))
    return outputs, pumps, note


def _rows(loop, runs, which, limits, lows):
    """Rows of functions that draw one panel each, of (outputs, pumps, other tanks)."""
    (outputs, pumps, others), (length, drive) = which, loop.units
    rims, low, high = loop.plant.rim, loop.actuator.low, loop.actuator.high
    lost = {name: spilled(loop.plant, run) for name, (run, *_) in runs.items()}

    def level_of(i, k=None, top=0.0):
        bounds = {"rim": _at(rims, i), "limit": _at(limits, i), "low": _at(lows, i)}
        about = {"unit": length, "spills": lost, "plant": loop.plant, "top": top}
        return lambda ax: level(ax, runs, i, k, **bounds, **about)

    def top_of(tanks):  # tanks without a setpoint have one axis
        highest = max((_highest(runs, i) for i in tanks), default=0.0)
        bounds = (_at(array, i) for array in (rims, limits) for i in tanks)
        top = HEADROOM * max([highest, *(b for b in bounds if b and highest > 0.6 * b)])
        return top if np.isfinite(top) else 0.0

    ends = lambda j: (float(low[j]), float(high[j]), input_unit(loop.plant, j, drive))
    error_of = lambda i, k: lambda ax: error(ax, runs, k, i, length, loop.plant)
    voltage_of = lambda j: lambda ax: voltage(ax, runs, j, *ends(j), loop.plant)
    kinds = [
        [level_of(i, k) for k, i in outputs],
        [error_of(i, k) for k, i in outputs],
        [level_of(i, top=top_of(others)) for i in others],
        [voltage_of(j) for j in pumps],
    ]
    most = style.beside(COLUMNS)
    return [row[i : i + most] for row in kinds for i in range(0, len(row), most)]


def _at(array, i) -> Any:
    return None if array is None else float(np.asarray(array)[i])


def convergence(ax, history, unit, limited):
    """Draw the objective of every evaluation in the order of the search, one colour per start."""
    start, cost, violation = (np.array([h[k] for h in history]) for k in range(3))
    broken, index = violation > 0, np.arange(1, len(history) + 1)
    for s in np.unique(start):
        colour = plt.get_cmap("cividis")(0.1 + 0.8 * s / max(1, start.max()))
        for mask, marker, size in ((~broken, "o", 3.5), (broken, "x", 4)):
            rows = (start == s) & mask
            ax.plot(index[rows], cost[rows], marker, color=colour, markersize=size)
    best = np.minimum.accumulate(np.where(broken, np.inf, cost))
    finite = np.isfinite(best)
    step: dict[str, Any] = {"color": style.AFTER, "linewidth": 1.4, "drawstyle": "steps-post"}
    step["label"] = "best that holds every limit" if limited else "best"
    ax.plot(index[finite], best[finite], **step)
    if broken.any():
        ax.plot([], [], "x", color="0.4", label="violates a limit")
    for s in np.unique(start)[1:]:
        ax.axvline(index[start == s][0] - 0.5, color="0.85", linewidth=0.8, zorder=0)
    ax.set(xlabel="evaluation (grey lines: next start)", ylabel=f"objective [{unit}]")
    ax.set_title("convergence")
    cost = cost[np.isfinite(cost)]
    # outliers would compress the rest: the first and most of the costs are in the picture
    top = max(float(np.quantile(cost, 0.95)), float(cost[0]))
    high = min(float(cost.max()), 1.5 * top) if top > 0 else float(cost.max())
    if high > 5 * cost.min() > 0:
        ax.set_yscale("log")
    if high < cost.max():
        low = None if ax.get_yscale() == "log" else cost.min() - 0.05 * (high - cost.min())
        ax.set_ylim(low, high)
        above = count(int((cost > high).sum()), "evaluation")
        ax.set_title(f"convergence ({above} above the picture)")
    ax.legend(loc="best", framealpha=0.8, frameon=True, edgecolor="none")


def _set_scale(set_scale, bound):
    """Give an axis the scale of a parameter's range; of negative values one of their sizes."""
    if bound.scale == "log" and bound.high < 0.0:
        set_scale("symlog", linthresh=-bound.high, linscale=0.1)
    else:
        set_scale(bound.scale)


def curve(ax, values, cost, violation, bound, unit, before, after):
    """Draw the objective along one parameter; the part that violates a limit is shaded."""
    # bound: has the name, unit and scale ("log" or "linear") of the parameter
    ax.plot(values, cost, color="0.3", linewidth=1.3)
    broken = np.asarray(violation) > 0
    if broken.any():
        low, high = ax.get_ylim()
        look = style.BEYOND | {"label": "a limit is violated"}
        ax.fill_between(values, low, high, where=broken, **look)
        ax.set_ylim(low, high)
    ax.plot(*before, "s", color=style.BEFORE, label="before")
    ax.plot(*after, "o", color=style.AFTER, label="after")
    ax.set(xlabel=plain(f"{bound.name} [{bound.unit}]"), ylabel=f"objective [{unit}]")
    ax.set(title="landscape")
    _set_scale(ax.set_xscale, bound)
    ax.legend()


def contours(ax, grid, cost, violation, bounds, unit, before, after):
    """Draw the objective over two parameters; beyond the pink line a limit is violated."""
    x, y = grid
    finite = np.where(np.isfinite(cost), cost, np.nan)
    low, high = np.nanmin(finite), np.nanquantile(finite, 0.98)
    # a colour for each factor in the distance from the minimum, so that its surroundings are seen
    levels = np.unique(np.append(low, low + max(high - low, 1e-12) * np.geomspace(1e-3, 1.0, 16)))
    norm = BoundaryNorm(levels, 256, extend="both")
    colours = {"cmap": "cividis_r", "extend": "both", "norm": norm}
    filled = ax.contourf(x, y, finite, levels=levels, **colours)
    label = f"objective [{unit}]"
    ax.figure.colorbar(filled, ax=ax, label=label, format="%.4g", ticks=levels[::3])
    if np.nanmax(violation) > 0 and np.nanmin(violation) <= 0:
        ax.contour(x, y, violation, levels=[0.0], colors=[style.FORBIDDEN], linewidths=2.0)
        ax.contourf(x, y, violation, levels=[0.0, np.inf], colors="none", hatches=["///"])
        label = "a limit is reached; violated where hatched"
        ax.plot([], [], color=style.FORBIDDEN, linewidth=2.0, label=label)
    point = {"markeredgecolor": "white", "clip_on": False, "zorder": 5}
    ax.plot(*before, "s", color=style.BEFORE, markersize=8, label="before", **point)
    ax.plot(*after, "o", color=style.AFTER, markersize=9, label="after", **point)
    across, up = bounds
    ax.set(xlabel=plain(f"{across.name} [{across.unit}]"), title="landscape")
    ax.set(ylabel=plain(f"{up.name} [{up.unit}]"))
    _set_scale(ax.set_xscale, across)
    _set_scale(ax.set_yscale, up)
    ax.legend(loc="upper center", bbox_to_anchor=(0.5, -0.16), ncols=2)


def tornado(ax, names, effects, unit, title):
    """Draw the change of a measure with each parameter at the two ends of its range."""
    y = _bars(ax, names, title)
    effects = np.asarray(effects)[: len(y)]
    ax.barh(y, effects, color=style.AFTER, height=0.62, label="parameter high")
    ax.barh(y, -effects, color=style.BEFORE, height=0.62, label="parameter low")
    ax.axvline(0.0, color=style.REFERENCE, linewidth=0.8)
    ax.set_xlabel(f"change [{unit}]")
    return ax


def elementary(ax, names, size, intervals, spread, unit, title):
    """Draw the elementary effects of each parameter on a measure (Morris)."""
    y = _bars(ax, names, title)
    size, intervals, spread = (np.asarray(v)[: len(y)] for v in (size, intervals, spread))
    ax.barh(y, size, color=style.AFTER, height=0.62, label="mean size, mu*")
    _whiskers(ax, y, size, intervals)
    point = {"color": style.BEFORE, "markeredgecolor": "white", "markersize": 6}
    ax.plot(spread, y, "D", label="standard deviation, sigma", **point)
    ax.set_xlim(left=0.0)
    ax.set_xlabel(f"change over the range [{unit}]")
    return ax


def shares(ax, names, first, total, title):
    """Draw first-order and total shares of a measure's variance (Sobol), as (values, intervals)."""
    y = _bars(ax, names, title)
    for (values, ends), side, colour, label in (
        (first, -0.2, style.BEFORE, "first order: alone"),
        (total, 0.2, style.AFTER, "total: with interactions"),
    ):
        values, ends = np.asarray(values)[: len(y)], np.asarray(ends)[: len(y)]
        ax.barh(y + side, values, color=colour, height=0.36, label=label)
        _whiskers(ax, y + side, values, ends)
    ax.axvline(0.0, color=style.REFERENCE, linewidth=0.8)
    ax.set_xlabel("share of the variance [-]")
    return ax


def panels(draws, title, rows):
    """Return a figure with one panel for each function in `draws`, and one legend for all."""
    columns = min(3, len(draws))
    lines = -(-len(draws) // columns)

    def draw(axes):
        for panel, ax in zip(draws, axes.flat):
            panel(ax)
        hide(axes.flat[len(draws) :])

    size = (4.3 * columns, (0.9 + 0.26 * rows) * lines + 0.7)
    return picture(draw, size, lines, columns, legend=2, title=title, squeeze=False)


def _bars(ax, names, title):
    """Positions of the bars, the first at the top, with the names beside them."""
    y, more = np.arange(min(len(names), BARS)), len(names) - BARS
    ax.set_yticks(y, map(plain, names[:BARS]))
    ax.invert_yaxis()
    ax.grid(False, axis="y")
    ax.set_axisbelow(True)
    ax.set_title(plain(title) + (f"; {more} smaller ones not shown" if more > 0 else ""))
    return y


def _whiskers(ax, y, values, ends):
    """Intervals (D, 2) around values (D,)."""
    low, high = np.maximum(0.0, values - ends[:, 0]), np.maximum(0.0, ends[:, 1] - values)
    look = {"fmt": "none", "ecolor": style.REFERENCE, "elinewidth": 1.0, "capsize": 2.5}
    ax.errorbar(values, y, xerr=[low, high], **look)
