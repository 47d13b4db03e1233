"""Pictures of many runs: quantiles of levels, runs before and after tuning, limits violated."""

import numpy as np
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from jaxtank.core.labels import label_of
from jaxtank.plots import style
from jaxtank.plots.style import grid, hide, picture, plain, styled

CUT = 0.05  # share of the plants below a bar, and above it [-]


def fan(loop, bands, title, limits=None):
    """Return a figure of quantiles of levels over many draws, with limits {tank: highest level}."""
    tanks = loop.plant.tanks
    columns = style.beside(min(2, tanks))
    rows = -(-tanks // columns)
    with styled():
        size = style.width(9.6), style.height(2.7 * rows, rows)
        figure, axes = grid(rows, columns, size, sharex=True)
        for i, ax in enumerate(axes.ravel()[:tanks]):
            _band(ax, loop, bands, i, (limits or {}).get(i))
        # the lowest panel of each column, above one that stays empty too
        for ax in axes.ravel()[max(0, tanks - columns) : tanks]:
            style.label_time(ax)
            ax.tick_params(labelbottom=True)
        hide(axes.ravel()[tanks:])
        figure.suptitle("" if style.printing() else plain(title))
    return figure


def _band(ax, loop, bands, i, limit):
    t, rim, unit = bands["t"], float(loop.plant.rim[i]), loop.units[0]
    low, first, middle, third, high = bands["x"][:, :, i]
    band = {"color": style.AFTER, "linewidth": 0}
    ax.fill_between(t, low, high, alpha=0.2, label="5 to 95 %", **band)
    ax.fill_between(t, first, third, alpha=0.35, label="25 to 75 %", **band)
    ax.plot(t, middle, color=style.AFTER, linewidth=1.2, label="median")
    if i in loop.plant.outputs:
        setpoint = bands["r"][:, loop.plant.outputs.index(i)]
        ax.plot(t, setpoint, color=style.REFERENCE, linewidth=0.8, linestyle="--", label="setpoint")
    if high.max() > 0.25 * rim:
        ax.axhline(rim, color=style.RIM, linewidth=1.2, label="rim")
    else:  # a rim far above all levels would only compress the picture
        label = f"rim {rim:g} {unit}, above the picture"
        ax.plot([], [], color=style.RIM, linewidth=1.2, label=label)
    if limit is not None and limit != rim and high.max() > 0.25 * limit:
        look = {"color": style.FORBIDDEN, "linewidth": 1.2, "linestyle": "-."}
        ax.axhline(limit, label=f"limit {limit:g} {unit}", **look)
    ax.set(title=plain(label_of(loop.plant, "tank", i)), ylabel=f"level [{unit}]")
    ax.legend(loc="best", fontsize="x-small")


def cloud(ax, pairs, feasible, name, unit, limit=None):
    """Draw one point for each run: a measure before tuning across, after tuning up."""
    pairs, feasible = np.asarray(pairs, dtype=float), np.asarray(feasible)
    before, after = feasible.T
    sorts = (
        (after & ~before, "s", style.BEFORE, 7, "violated a limit before, none after"),
        (before & after, "o", style.AFTER, 7, "holds every limit, before and after"),
        (~after, "x", style.FORBIDDEN, 22, "violates a limit after"),
    )
    for chosen, marker, colour, size, label in sorts:
        if chosen.any():
            points = {"s": size, "marker": marker, "color": colour, "linewidths": 0.9}
            points |= {"alpha": 1.0 if marker == "x" else 0.55, "rasterized": True}
            label = f"{label} ({chosen.sum()} of {len(pairs)})"
            ax.scatter(*pairs[chosen].T, label=label, **points)
    # a limit far above all runs would only move them into a corner
    limit = limit if limit is not None and (limit <= 0 or np.max(pairs) > 0.6 * limit) else None
    low, high = _square(ax, pairs if limit is None else np.append(pairs.ravel(), limit))
    diagonal = {"color": style.REFERENCE, "linewidth": 0.9, "linestyle": "--", "label": "no change"}
    ax.plot([low, high], [low, high], **diagonal)
    if limit is not None:
        ax.axvline(limit, color=style.FORBIDDEN, linewidth=1.0)
        ax.axhline(limit, color=style.FORBIDDEN, linewidth=1.0, label=f"limit {limit:g} {unit}")
    ax.set(xlabel=f"{name} before [{unit}]", ylabel=f"{name} after [{unit}]")
    if low < high:  # else matplotlib's own, about the one number
        ax.set(xlim=(low, high), ylim=(low, high))
    ax.set(aspect="equal")
    ax.set_axisbelow(True)
    return ax


def _square(ax, values):
    """Ends of both axes, which are logarithmic where the values need it."""
    low, high = float(np.min(values)), float(np.max(values))
    if not high > 8 * low > 0:
        margin = 0.05 * (high - low)
        return low - margin, high + margin
    ax.set(xscale="log", yscale="log")
    # 0.2, 0.5, 1 ...: powers of ten alone would leave a decade without a number
    for axis in (ax.xaxis, ax.yaxis):
        axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axis.set_major_formatter(FuncFormatter(lambda v, _: f"{v:g}"))
        axis.set_minor_formatter(NullFormatter())
    return low / 1.1, high * 1.1


def violations(rows, samples):
    """Return a figure of the probability that each limit is violated, with its 95 % interval."""
    y, p = np.arange(len(rows)), np.array([r["probability"] for r in rows])
    low, high = np.array([r["interval95"] for r in rows]).T
    names = [f"{r['name']} ({r['limit']:g} {r.get('unit', '')})".replace(" )", ")") for r in rows]

    def draw(ax):
        ax.barh(y, p, color=style.SHARE, height=0.6)
        ends = np.maximum(0.0, [p - low, high - p])
        ax.errorbar(p, y, xerr=ends, fmt="none", ecolor=style.REFERENCE, capsize=3)
        ax.set_yticks(y, map(plain, names))
        ax.invert_yaxis()
        ax.set_xlim(0.0, max(0.05, min(1.0, 1.15 * high.max())))
        ax.set_xlabel(f"probability of violating the limit [-], {samples} draws")

    return picture(draw, (6.4, 0.9 + 0.35 * len(rows)))


def plants(sides, limits, unit):
    """Return a figure of many plants: distribution of their errors, and their highest levels."""
    colours = [style.TUNED] if len(sides) == 1 else [style.PUBLISHED, style.TUNED]
    every = np.concatenate([error for error, _ in sides.values()])
    bins = np.linspace(every.min(), max(every.max(), every.min() * 1.01 + 1e-12), 25)
    tanks = np.arange(len(limits)) + 1

    def draw(axes):
        errors, highest = axes
        for k, (colour, (name, (error, levels))) in enumerate(zip(colours, sides.items())):
            errors.hist(error, bins, color=colour, alpha=0.55, label=name)
            errors.axvline(error.mean(), color=colour, linewidth=1.2)
            x = tanks + (k - 0.5 * (len(sides) - 1)) * 0.25
            low, high = np.quantile(levels, (CUT, 1.0 - CUT), axis=0)
            highest.vlines(x, low, high, color=colour, linewidth=5, alpha=0.55)
            highest.plot(x, levels.max(axis=0), "o", color=colour, markersize=4)
            errors.set_ylabel(f"plants of {len(error)}")
        for tank, limit in zip(tanks, limits):
            if np.isfinite(limit):
                highest.hlines(limit, tank - 0.4, tank + 0.4, color=style.RIM, linewidth=1.6)
        errors.set_xlabel(f"total rms error [{unit}]")
        errors.set_title("line: mean", loc="left")
        highest.set(xlabel="tank", ylabel=f"highest level [{unit}]", xticks=tanks)
        highest.set_title("5 to 95 % of plants, highest of all, limit", loc="left")
        if len(sides) > 1:
            errors.legend()

    return picture(draw, (style.width(8.0), style.height(2.8, 2)), 1, 2)
