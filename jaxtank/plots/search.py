"""Pictures of a search: its convergence, and the objective over one and two parameters.

Each function draws on given matplotlib axes and returns them.
"""

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.colors import BoundaryNorm

from jaxtank.plots.style import AFTER, BEFORE, FORBIDDEN, plain


def convergence(ax, history, unit, limited):
    """Draw the objective of every evaluation in the order of the search, one colour per start."""
    start, cost, violation = (np.array([h[k] for h in history]) for k in range(3))
    broken, index = violation > 0, np.arange(1, len(history) + 1)
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
    if broken.any():
        ax.plot([], [], "x", color="0.4", label="violates a limit")
    for s in np.unique(start)[1:]:
        ax.axvline(index[start == s][0] - 0.5, color="0.85", linewidth=0.8, zorder=0)
    ax.set(
        xlabel="evaluation (grey lines: next start)",
        ylabel=f"objective [{unit}]",
        title="convergence",
    )
    _limit_height(ax, cost[np.isfinite(cost)])
    ax.legend(loc="best", framealpha=0.8, frameon=True, edgecolor="none")
    return ax


def _limit_height(ax, cost):
    """Cut the axis above the first and most of the costs: outliers would compress the rest."""
    top = max(float(np.quantile(cost, 0.95)), float(cost[0]))
    high = min(float(cost.max()), 1.5 * top) if top > 0 else float(cost.max())
    if high > 5 * cost.min() > 0:
        ax.set_yscale("log")
    if high < cost.max():
        low = None if ax.get_yscale() == "log" else cost.min() - 0.05 * (high - cost.min())
        ax.set_ylim(low, high)
        ax.set_title(f"convergence ({int((cost > high).sum())} evaluations above the picture)")


def curve(ax, values, cost, violation, name, unit, cost_unit, before, after, logarithmic):
    """Draw the objective along one parameter; the part that violates a limit is shaded."""
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
            label="a limit is violated",
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
    """Draw the objective over two parameters; beyond the pink line a limit is violated."""
    finite = np.where(np.isfinite(cost), cost, np.nan)
    low, high = np.nanmin(finite), np.nanquantile(finite, 0.98)
    # a colour for each factor in the distance from the minimum, so that its surroundings are seen
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
            [],
            [],
            color=FORBIDDEN,
            linewidth=2.0,
            label="a limit is reached; violated where hatched",
        )
    point = {"markeredgecolor": "white", "clip_on": False, "zorder": 5}
    ax.plot(*before, "s", color=BEFORE, markersize=8, label="before", **point)
    ax.plot(*after, "o", color=AFTER, markersize=9, label="after", **point)
    ax.set(
        xlabel=plain(f"{names[0]} [{units[0]}]"),
        ylabel=plain(f"{names[1]} [{units[1]}]"),
        title="landscape",
    )
    ax.set_xscale("log" if logarithmic[0] else "linear")
    ax.set_yscale("log" if logarithmic[1] else "linear")
    ax.legend(loc="upper center", bbox_to_anchor=(0.5, -0.16), ncols=2)
    return ax
