"""Pictures: one function each, drawn on given matplotlib axes and returning them. The only room
here that imports matplotlib.
"""

import contextlib
import itertools
import textwrap
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.colors import BoundaryNorm
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from jaxtank.core.errors import InputError

BEFORE, AFTER, REFERENCE, FORBIDDEN, OTHER = (
    "#D55E00",
    "#0072B2",
    "#000000",
    "#CC79A7",
    "#009E73",
)  # Okabe and Ito, colour-blind safe
RUNS = (
    (BEFORE, "--"),
    (AFTER, "-"),
    (OTHER, "-."),
    ("#E69F00", "-"),
    ("#56B4E9", "--"),
    ("0.45", "-."),
)
"""(colour, line style) of the runs that are drawn over each other; from the seventh on the colours
return in other styles.
"""

WATER, GLASS = "#9CCEEB", "0.35"
"""What is in a tank and what it is made of, in drawings of a rig."""

COLUMNS, SHOWN = 4, 16  # panels side by side; tanks between pumps and outputs that are drawn
PUMPS = ("#D55E00", "#009E73", "#CC79A7", "#E69F00")
"""One colour for each pump and its pipework, of the same colour-blind safe set."""

STYLE: dict[Any, Any] = {
    "font.size": 9,
    "axes.titlesize": 9,
    "axes.grid": True,
    "grid.color": "0.9",
    "grid.linewidth": 0.6,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "legend.frameon": False,
    "legend.fontsize": 8,
    "figure.dpi": 110,
    "savefig.dpi": 130,
    "svg.fonttype": "none",
}


@contextlib.contextmanager
def styled(more=None):
    """STYLE, and `more` {setting: value} of matplotlib's, for what is drawn inside.

    Afterwards these settings are as before, and only these: `plt.rc_context` puts all of them back.
    Where the first figure of a notebook is drawn inside it, that takes back the interactive mode
    which the notebook's backend has just switched on, and no later figure is shown.
    """
    settings = STYLE | (more or {})
    before: dict[Any, Any] = {name: plt.rcParams[name] for name in settings}
    plt.rcParams.update(settings)
    try:
        yield
    finally:
        plt.rcParams.update(before)


def plain(text):
    """`text` for matplotlib, which would otherwise set what stands between two dollar signs as
    mathematics.
    """
    return text.replace("$", r"\$")


def level(ax, trajectories, tank, output=None, rim=None, limit=None, unit="cm"):
    """Levels of one tank [unit] over time [s], one line per {name: (Trajectory, colour, style)};
    its setpoint, rim and limit.
    """
    for name, (run, colour, style) in trajectories.items():
        ax.plot(
            run.t, run.x[:, tank], color=colour, linestyle=style, linewidth=1.4, label=plain(name)
        )
    last = next(iter(trajectories.values()))[0]
    if output is not None:
        ax.plot(
            last.t,
            last.r[:, output],
            color=REFERENCE,
            linestyle=":",
            linewidth=1.2,
            label="setpoint",
        )
    highest = max(float(np.max(run.x[:, tank])) for run, _, _ in trajectories.values())
    # a rim far above all levels would only flatten the picture
    for bound, words in ((rim, "rim"), (limit if limit != rim else None, "limit")):
        if bound is not None and (highest > 0.6 * bound):
            top = max(highest * 1.03, bound * 1.05)
            ax.axhspan(bound, top, color=FORBIDDEN, alpha=0.18, linewidth=0)
            ax.axhline(bound, color=FORBIDDEN, linewidth=1.0, label=f"{words} {bound:g} {unit}")
            ax.set_ylim(top=top)
    ax.set_ylim(bottom=min(0.0, ax.get_ylim()[0]) if output is None else None)
    ax.set(title=f"tank {tank + 1}", ylabel=f"level [{unit}]")
    return ax


def voltage(ax, trajectories, pump, low, high, unit="V"):
    """Input of one pump [unit], within its limits, over time [s], what lies outside its limits
    shaded.
    """
    for name, (run, colour, style) in trajectories.items():
        ax.plot(
            run.t, run.u[:, pump], color=colour, linestyle=style, linewidth=1.2, label=plain(name)
        )
    ax.set(title=f"pump {pump + 1}", ylabel=f"input [{unit}]" if unit != "V" else "voltage [V]")
    lowest, highest = (
        f([f(run.u[:, pump]) for run, _, _ in trajectories.values()]) for f in (np.min, np.max)
    )
    if highest - lowest < 0.1 * (high - low):  # limits far away say nothing
        return ax
    margin = 0.06 * (high - low)
    ax.axhspan(low - margin, low, color=FORBIDDEN, alpha=0.18, linewidth=0)
    ax.axhspan(high, high + margin, color=FORBIDDEN, alpha=0.18, linewidth=0)
    ax.set_ylim(low - margin, high + margin)
    return ax


def error(ax, trajectories, output, tank, unit="cm"):
    """Tracking error of one output [unit] over time [s]."""
    for name, (run, colour, style) in trajectories.items():
        ax.plot(
            run.t, run.e[:, output], color=colour, linestyle=style, linewidth=1.2, label=plain(name)
        )
    ax.axhline(0.0, color=REFERENCE, linewidth=0.8, linestyle=":")
    ax.set(title=f"tracking error of tank {tank + 1}", ylabel=f"h - r [{unit}]")
    return ax


def responses(loop, trajectories, title="", limits=None):
    """Figure of a run, or of several over each other: outputs with setpoints, errors, other tanks
    with rims, voltages with limits.

    trajectories: {name: Trajectory}, the first drawn dashed where there are several; limits:
        (tanks,) level limits [cm] or None.
    """
    if not trajectories:
        raise InputError("trajectories = {}: there is no run to draw")
    count = len(RUNS)
    again = [
        (colour, RUNS[(i + i // count) % count][1])
        for i, (colour, _) in zip(range(len(trajectories)), itertools.cycle(RUNS))
    ]
    styles = [(AFTER, "-")] if len(trajectories) == 1 else again
    drawn = {
        name: (run, *style) for (name, run), style in zip(trajectories.items(), styles, strict=True)
    }
    outputs = list(loop.plant.outputs)
    others = [i for i in range(loop.plant.tanks) if i not in outputs]
    if len(others) > SHOWN:
        near = {
            i: (
                max(float(np.max(run.x[:, i])) for run in trajectories.values())
                / _at(loop.plant.rim, i)
            )
            for i in others
        }
        title += (
            f"\nof the {len(others)} tanks between, the {SHOWN} that come nearest to their rims"
        )
        others = sorted(sorted(others, key=near.__getitem__)[-SHOWN:])
    length, drive = loop.units
    rows = [
        [
            lambda ax, i=i, k=k: level(
                ax, drawn, i, k, _at(loop.plant.rim, i), _at(limits, i), length
            )
            for k, i in enumerate(outputs)
        ],
        [lambda ax, i=i, k=k: error(ax, drawn, k, i, length) for k, i in enumerate(outputs)],
        [
            lambda ax, i=i: level(
                ax, drawn, i, None, _at(loop.plant.rim, i), _at(limits, i), length
            )
            for i in others
        ],
        [
            lambda ax, j=j: voltage(
                ax, drawn, j, float(loop.actuator.low[j]), float(loop.actuator.high[j]), drive
            )
            for j in range(loop.plant.pumps)
        ],
    ]
    rows = [row[i : i + COLUMNS] for row in rows for i in range(0, len(row), COLUMNS)]
    columns = max(len(row) for row in rows)
    width = max(4.6 * columns, 6.4)
    with styled():
        figure, axes = plt.subplots(
            len(rows),
            columns,
            figsize=(width, 2.05 * len(rows) + 0.5),
            sharex=True,
            squeeze=False,
            layout="constrained",
        )
        for row, line in zip(rows, axes):
            for draw, ax in zip(row, line):
                draw(ax)
            for ax in line[len(row) :]:
                ax.set_visible(False)
        for column in axes.T:
            last = [ax for ax in column if ax.get_visible()][-1]
            last.set_xlabel("time [s]")
            last.tick_params(labelbottom=True)
        handles = {}
        for ax in axes.flat:
            for handle, label in zip(*ax.get_legend_handles_labels()):
                handles.setdefault(label, handle)
        # entries beside each other
        across = len(handles) if len(handles) <= 6 else max(4, round(width / 2))
        figure.legend(handles.values(), handles.keys(), loc="outside lower center", ncols=across)
        figure.suptitle(
            "\n".join(plain(textwrap.fill(line, int(12 * width))) for line in title.splitlines()),
            fontsize=10,
        )
    return figure


def convergence(ax, history, unit, limited):
    """Cost of every evaluation in the order of the search, one colour per start; crosses break a
    limit, the line is the best so far.
    """
    cost = np.array([h[1] for h in history])
    broken = np.array([h[2] > 0 for h in history])
    start = np.array([h[0] for h in history])
    index = np.arange(1, len(history) + 1)
    for s in np.unique(start):
        here, colour = start == s, plt.get_cmap("cividis")(0.1 + 0.8 * s / max(1, start.max()))
        ax.plot(index[here & ~broken], cost[here & ~broken], "o", color=colour, markersize=3.5)
        ax.plot(index[here & broken], cost[here & broken], "x", color=colour, markersize=4)
    best = np.minimum.accumulate(np.where(broken, np.inf, cost))
    shown = np.isfinite(best)
    ax.plot(
        index[shown],
        best[shown],
        color=AFTER,
        linewidth=1.4,
        drawstyle="steps-post",
        label="best that holds every limit" if limited else "best",
    )
    ax.plot([], [], "x", color="0.4", label="breaks a limit") if broken.any() else None
    for s in np.unique(start)[1:]:
        ax.axvline(index[start == s][0] - 0.5, color="0.85", linewidth=0.8, zorder=0)
    ax.set(
        xlabel="evaluation (grey lines: next start)",
        ylabel=f"objective [{unit}]",
        title="convergence",
    )
    finite = cost[np.isfinite(cost)]
    # a few wild trials would press all the rest into one line
    top = max(float(np.quantile(finite, 0.95)), float(finite[0]))
    high = min(float(finite.max()), 1.5 * top) if top > 0 else float(finite.max())
    if high > 5 * finite.min() > 0:
        ax.set_yscale("log")
    if high < finite.max():
        ax.set_ylim(
            None if ax.get_yscale() == "log" else finite.min() - 0.05 * (high - finite.min()), high
        )
        ax.set_title(f"convergence ({int((finite > high).sum())} evaluations above the picture)")
    ax.legend(loc="best", framealpha=0.8, frameon=True, edgecolor="none")
    return ax


def curve(ax, values, cost, violation, name, unit, cost_unit, before, after, logarithmic):
    """Objective along one parameter; the part that breaks a limit is shaded."""
    ax.plot(values, cost, color="0.3", linewidth=1.3)
    broken = np.asarray(violation) > 0
    if broken.any():
        low, high = ax.get_ylim()
        ax.fill_between(
            values,
            low,
            high,
            where=broken,
            color=FORBIDDEN,
            alpha=0.18,
            linewidth=0,
            label="a limit is broken",
        )
        ax.set_ylim(low, high)
    ax.plot(*before, "s", color=BEFORE, label="before")
    ax.plot(*after, "o", color=AFTER, label="after")
    ax.set(
        xlabel=plain(f"{name} [{unit}]"),
        ylabel=f"objective [{cost_unit}]",
        title="landscape",
        xscale="log" if logarithmic else "linear",
    )
    ax.legend()
    return ax


def contours(ax, x, y, cost, violation, names, units, cost_unit, before, after, logarithmic):
    """Objective over two parameters as filled contours; beyond the pink line a limit is broken."""
    finite = np.where(np.isfinite(cost), cost, np.nan)
    low, high = np.nanmin(finite), np.nanquantile(finite, 0.98)
    # a colour for each factor in the distance from the least, so that the valley shows and not the
    # slopes alone
    levels = np.unique(np.append(low, low + max(high - low, 1e-12) * np.geomspace(1e-3, 1.0, 16)))
    filled = ax.contourf(
        x,
        y,
        finite,
        levels=levels,
        cmap="cividis_r",
        extend="both",
        norm=BoundaryNorm(levels, 256, extend="both"),
    )
    ax.figure.colorbar(
        filled, ax=ax, label=f"objective [{cost_unit}]", format="%.4g", ticks=levels[::3]
    )
    if np.nanmax(violation) > 0 and np.nanmin(violation) <= 0:
        ax.contour(x, y, violation, levels=[0.0], colors=[FORBIDDEN], linewidths=2.0)
        ax.contourf(x, y, violation, levels=[0.0, np.inf], colors="none", hatches=["///"])
        ax.plot(
            [], [], color=FORBIDDEN, linewidth=2.0, label="a limit is reached; broken where hatched"
        )
    ax.plot(
        *before,
        "s",
        color=BEFORE,
        markeredgecolor="white",
        markersize=8,
        label="before",
        clip_on=False,
        zorder=5,
    )
    ax.plot(
        *after,
        "o",
        color=AFTER,
        markeredgecolor="white",
        markersize=9,
        label="after",
        clip_on=False,
        zorder=5,
    )
    ax.set(
        xlabel=plain(f"{names[0]} [{units[0]}]"),
        ylabel=plain(f"{names[1]} [{units[1]}]"),
        title="landscape",
    )
    ax.set_xscale("log" if logarithmic[0] else "linear")
    ax.set_yscale("log" if logarithmic[1] else "linear")
    ax.legend(loc="upper center", bbox_to_anchor=(0.5, -0.16), ncols=2)
    return ax


BARS = 14
"""Bars in a picture of sensitivities at most; the smallest are left out, which the picture says."""


def tornado(ax, names, effects, unit, title):
    """Change of a measure [unit] with each parameter, the largest first, at the two ends of its
    half-width. effects: (D,) signed.
    """
    y = _bars(ax, names, title)
    effects = np.asarray(effects)[: len(y)]
    ax.barh(y, effects, color=AFTER, height=0.62, label="parameter high")
    ax.barh(y, -effects, color=BEFORE, height=0.62, label="parameter low")
    ax.axvline(0.0, color=REFERENCE, linewidth=0.8)
    ax.set_xlabel(f"change [{unit}]")
    return ax


def elementary(ax, names, size, intervals, spread, unit, title):
    """Mean size (D,) of the elementary effects on a measure [unit], with 95 % intervals (D, 2), and
    their standard deviation (D,).
    """
    y = _bars(ax, names, title)
    size, intervals, spread = (np.asarray(v)[: len(y)] for v in (size, intervals, spread))
    ax.barh(y, size, color=AFTER, height=0.62, label="mean size, mu*")
    _whiskers(ax, y, size, intervals)
    ax.plot(
        spread,
        y,
        "D",
        color=BEFORE,
        markeredgecolor="white",
        markersize=6,
        label="standard deviation, sigma",
    )
    ax.set_xlim(left=0.0)
    ax.set_xlabel(f"change over the range [{unit}]")
    return ax


def shares(ax, names, first, total, first_intervals, total_intervals, title):
    """First-order and total shares (D,) of the variance of a measure [-], with 95 % intervals (D,
    2), the largest total first.
    """
    y = _bars(ax, names, title)
    for values, ends, side, colour, words in (
        (first, first_intervals, -0.2, BEFORE, "first order: alone"),
        (total, total_intervals, 0.2, AFTER, "total: with interactions"),
    ):
        values, ends = np.asarray(values)[: len(y)], np.asarray(ends)[: len(y)]
        ax.barh(y + side, values, color=colour, height=0.36, label=words)
        _whiskers(ax, y + side, values, ends)
    ax.axvline(0.0, color=REFERENCE, linewidth=0.8)
    ax.set_xlabel("share of the variance [-]")
    return ax


def panels(draw, title, rows):
    """A figure with one panel for each function in `draw`, which is given the axes; `rows` bars in
    each; one legend for all.
    """
    columns = min(3, len(draw))
    lines = -(-len(draw) // columns)
    with styled():
        size = (4.3 * columns, (0.9 + 0.26 * rows) * lines + 0.7)
        figure, axes = plt.subplots(
            lines, columns, figsize=size, squeeze=False, layout="constrained"
        )
        for one, ax in zip(draw, axes.flat):
            one(ax)
        for ax in axes.flat[len(draw) :]:
            ax.set_visible(False)
        handles, labels = axes.flat[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=len(handles))
        figure.suptitle(plain(title), fontsize=10)
    return figure


def _bars(ax, names, title):
    """Places of the bars, the first at the top, with the names beside them."""
    y = np.arange(min(len(names), BARS))
    ax.set_yticks(y, names[:BARS])
    ax.invert_yaxis()
    ax.grid(False, axis="y")
    ax.set_axisbelow(True)
    ax.set_title(
        title + (f"; {len(names) - BARS} smaller ones not shown" if len(names) > BARS else "")
    )
    return y


def _whiskers(ax, y, values, ends):
    low, high = np.maximum(0.0, values - ends[:, 0]), np.maximum(0.0, ends[:, 1] - values)
    ax.errorbar(
        values, y, xerr=[low, high], fmt="none", ecolor=REFERENCE, elinewidth=1.0, capsize=2.5
    )


def _at(array, i) -> Any:
    return None if array is None else float(np.asarray(array)[i])


def fan(loop, bands, title):
    """A figure of the quantiles of levels over many draws: the middle 90 and 50 % and the median,
    with setpoints and rims.

    bands: {"t" (rows,) [s], "r" (rows, outputs), "x" (5, rows, tanks)}: quantiles 5, 25, 50, 75, 95
        %.
    """
    tanks, rims = loop.plant.tanks, np.asarray(loop.plant.rim)
    with styled():
        rows, columns = -(-tanks // 2), min(2, tanks)
        figure, axes = plt.subplots(
            rows,
            columns,
            figsize=(9.6, 2.7 * rows),
            sharex=True,
            layout="constrained",
            squeeze=False,
        )
        for i, ax in enumerate(axes.ravel()[:tanks]):
            low, first, middle, third, high = bands["x"][:, :, i]
            ax.fill_between(
                bands["t"], low, high, color="#0072B2", alpha=0.2, linewidth=0, label="5 to 95 %"
            )
            ax.fill_between(
                bands["t"],
                first,
                third,
                color="#0072B2",
                alpha=0.35,
                linewidth=0,
                label="25 to 75 %",
            )
            ax.plot(bands["t"], middle, color="#0072B2", linewidth=1.2, label="median")
            if i in loop.plant.outputs:
                ax.plot(
                    bands["t"],
                    bands["r"][:, loop.plant.outputs.index(i)],
                    color="black",
                    linewidth=0.8,
                    linestyle="--",
                    label="setpoint",
                )
            if high.max() > 0.25 * rims[i]:
                ax.axhline(rims[i], color="#D55E00", linewidth=1.0, label="rim")
            else:  # a rim far above all levels would only flatten the picture
                ax.plot(
                    [],
                    [],
                    color="#D55E00",
                    linewidth=1.0,
                    label=f"rim {rims[i]:g} {loop.units[0]}, above the picture",
                )
            ax.set_title(f"tank {i + 1}")
            ax.set_ylabel(f"level [{loop.units[0]}]")
            ax.legend(loc="best", fontsize="x-small")
        # the lowest panel of each column, above one that stays empty too
        for ax in axes.ravel()[max(0, tanks - columns) : tanks]:
            ax.set_xlabel("time [s]")
            ax.tick_params(labelbottom=True)
        for ax in axes.ravel()[tanks:]:
            ax.set_visible(False)
        figure.suptitle(plain(title))
    return figure


def cloud(ax, pairs, held, name, unit, limit=None):
    """One dot for each run: `name` [unit] before tuning across, after tuning up, on the same plant
    and noise; below the diagonal it fell.

    pairs: (runs, 2) before and after; held: (runs, 2) True where every limit holds; limit: [unit],
    drawn on both axes. Blue dots hold every limit on both sides, orange squares broke one before
    and none after, pink crosses break one after, whatever they did before.
    """
    pairs, held = np.asarray(pairs, dtype=float), np.asarray(held)
    sorts = (
        (held[:, 1] & ~held[:, 0], "s", BEFORE, 7, "broke a limit before, none after"),
        (held[:, 0] & held[:, 1], "o", AFTER, 7, "holds every limit, before and after"),
        (~held[:, 1], "x", FORBIDDEN, 22, "breaks a limit after"),
    )
    for mine, marker, colour, size, words in sorts:
        if mine.any():
            look = {
                "s": size,
                "marker": marker,
                "color": colour,
                "alpha": 1.0 if marker == "x" else 0.55,
                "linewidths": 0.9,
            }
            ax.scatter(
                *pairs[mine].T,
                **look,
                label=f"{words} ({mine.sum()} of {len(pairs)})",
                rasterized=True,
            )
    # a limit far above all runs would only squeeze them into a corner
    limit = limit if limit is not None and (limit <= 0 or np.max(pairs) > 0.6 * limit) else None
    shown = pairs if limit is None else np.append(pairs.ravel(), limit)
    low, high = float(np.min(shown)), float(np.max(shown))
    low, high = (
        (low / 1.1, high * 1.1)
        if high > 8 * low > 0
        else (low - 0.05 * (high - low), high + 0.05 * (high - low))
    )
    ax.plot(
        [low, high], [low, high], color=REFERENCE, linewidth=0.9, linestyle="--", label="no change"
    )
    if limit is not None:
        ax.axvline(limit, color=FORBIDDEN, linewidth=1.0)
        ax.axhline(limit, color=FORBIDDEN, linewidth=1.0, label=f"limit {limit:g} {unit}")
    ax.set(xlabel=f"{name} before [{unit}]", ylabel=f"{name} after [{unit}]")
    if low > 0 and high > 8 * low:
        ax.set(xscale="log", yscale="log")
        # 0.2, 0.5, 1 ...: powers of ten alone would leave a decade without a number
        for axis in (ax.xaxis, ax.yaxis):
            axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
            axis.set_major_formatter(FuncFormatter(lambda v, _: f"{v:g}"))
            axis.set_minor_formatter(NullFormatter())
    ax.set(xlim=(low, high), ylim=(low, high), aspect="equal")
    ax.set_axisbelow(True)
    return ax


def violations(rows, samples):
    """A figure of the probability that each limit is broken, with its 95 % interval. rows: as
    `Ensemble.violations` gives them.
    """
    with styled():
        figure, ax = plt.subplots(figsize=(6.4, 0.9 + 0.35 * len(rows)), layout="constrained")
        y, p = np.arange(len(rows)), np.array([r["probability"] for r in rows])
        ends = np.array([r["interval95"] for r in rows])
        ax.barh(y, p, color="#56B4E9", height=0.6)
        ax.errorbar(
            p,
            y,
            xerr=np.maximum(0.0, [p - ends[:, 0], ends[:, 1] - p]),
            fmt="none",
            ecolor="black",
            capsize=3,
        )
        ax.set_yticks(
            y,
            [
                plain(f"{r['name']} ({r['limit']:g} {r.get('unit', '')})".replace(" )", ")"))
                for r in rows
            ],
        )
        ax.invert_yaxis()
        ax.set_xlim(0.0, max(0.05, min(1.0, 1.15 * ends[:, 1].max())))
        ax.set_xlabel(f"probability of breaking the limit [-], {samples} draws")
    return figure
