"""Pictures of sensitivities: bars for each parameter, and a figure of several such panels."""

import numpy as np

from jaxtank.plots.style import AFTER, BEFORE, REFERENCE, grid, hide, plain, styled

BARS = 14
"""Bars in a picture at most; the smallest are left out, and the title gives their number."""


def tornado(ax, names, effects, unit, title):
    """Draw the change of a measure with each parameter at the two ends of its range."""
    y = _bars(ax, names, title)
    effects = np.asarray(effects)[: len(y)]
    ax.barh(y, effects, color=AFTER, height=0.62, label="parameter high")
    ax.barh(y, -effects, color=BEFORE, height=0.62, label="parameter low")
    ax.axvline(0.0, color=REFERENCE, linewidth=0.8)
    ax.set_xlabel(f"change [{unit}]")
    return ax


def elementary(ax, names, size, intervals, spread, unit, title):
    """Draw the elementary effects of each parameter on a measure (Morris)."""
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
    """Draw the first-order and total shares of the variance of a measure (Sobol)."""
    y = _bars(ax, names, title)
    for values, ends, side, colour, label in (
        (first, first_intervals, -0.2, BEFORE, "first order: alone"),
        (total, total_intervals, 0.2, AFTER, "total: with interactions"),
    ):
        values, ends = np.asarray(values)[: len(y)], np.asarray(ends)[: len(y)]
        ax.barh(y + side, values, color=colour, height=0.36, label=label)
        _whiskers(ax, y + side, values, ends)
    ax.axvline(0.0, color=REFERENCE, linewidth=0.8)
    ax.set_xlabel("share of the variance [-]")
    return ax


def panels(draw, title, rows):
    """Return a figure with one panel for each function in `draw`, and one legend for all."""
    columns = min(3, len(draw))
    lines = -(-len(draw) // columns)
    with styled():
        size = (4.3 * columns, (0.9 + 0.26 * rows) * lines + 0.7)
        figure, axes = grid(lines, columns, size)
        for one, ax in zip(draw, axes.flat):
            one(ax)
        hide(axes.flat[len(draw) :])
        handles, labels = axes.flat[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=len(handles))
        figure.suptitle(plain(title), fontsize=10)
    return figure


def _bars(ax, names, title):
    """Positions of the bars, the first at the top, with the names beside them."""
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
    """Intervals (D, 2) around values (D,)."""
    low, high = np.maximum(0.0, values - ends[:, 0]), np.maximum(0.0, ends[:, 1] - values)
    ax.errorbar(
        values, y, xerr=[low, high], fmt="none", ecolor=REFERENCE, elinewidth=1.0, capsize=2.5
    )
