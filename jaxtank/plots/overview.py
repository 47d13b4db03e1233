"""A large rig at a glance: tanks as cells in reading order, the fullest ones named."""

import math

import numpy as np
from matplotlib.collections import LineCollection, PatchCollection
from matplotlib.patches import Rectangle

from jaxtank.plots.style import AFTER, FORBIDDEN, GLASS, PUMPS, WATER, write

LARGEST = 24  # tanks up to which a rig is drawn part by part
NAMED = 12  # tanks, outputs or pumps that a picture of many names at most: the worst ones
CELL, PITCH = 0.62, 1.0  # side of a cell, and distance from one to the next


def worst(values, most=NAMED):
    """Return the places of the largest of some values, in the order of their places."""
    order = np.argsort(-np.asarray(values, dtype=float), kind="stable")
    return sorted(int(i) for i in order[:most])


def per_line(tanks):
    """Return the number of cells in a line, for about twice as many as there are lines."""
    return math.ceil(math.sqrt(2.0 * tanks))


def size(tanks):
    """Return (width, height) of the figure of `overview` [inch]."""
    columns = per_line(tanks)
    return 7.2, 7.2 * (math.ceil(tanks / columns) + 1.2) / (columns + 0.6) + 0.35


def overview(ax, plant, levels=None):
    """Draw a rig of many tanks: a cell for each, in their order, filled as a share of its rim."""
    n, columns = plant.tanks, per_line(plant.tanks)
    corners = np.array([(i % columns, -(i // columns)) for i in range(n)], dtype=float) * PITCH
    centres, full = corners + 0.5 * CELL, np.ones(n)
    _flows(ax, plant, centres)
    shares = np.zeros(n)
    if levels is not None:
        shares = np.clip(np.asarray(levels, dtype=float) / np.asarray(plant.rim), 0.0, 1.0)
    _cells(ax, corners, full, facecolors="white", zorder=2)
    _cells(ax, corners, shares, facecolors=WATER, zorder=3)
    outline = {"facecolors": "none", "edgecolors": GLASS, "zorder": 4}
    outline["linewidths"] = np.where(np.isin(np.arange(n), plant.outputs), 1.8, 0.6)
    _cells(ax, corners, full, **outline)
    for j, feed in enumerate(plant.feeds):
        for i in (i for i in feed if i is not None):
            x, y = corners[i] + (0.5 * CELL, CELL + 0.08)
            ax.plot(x, y, marker="v", color=PUMPS[j % len(PUMPS)], markersize=4, zorder=5)
    if levels is not None:
        fullest = worst(shares)
        outline |= {"edgecolors": FORBIDDEN, "linewidths": 1.6, "zorder": 6}
        _cells(ax, corners[fullest], full[fullest], **outline)
        for i in fullest:
            x, y = centres[i]
            write(ax, x, y, str(i + 1), colour="black", gid="fullest", zorder=7)
    for line in range(math.ceil(n / columns)):
        y = -line * PITCH + 0.5 * CELL
        write(ax, -0.2, y, str(line * columns + 1), 6, "right center", "0.3")
    ax.set(xlim=(-0.9, columns * PITCH - 0.2), ylim=(corners[:, 1].min() - 0.3, 1.0))
    ax.set_aspect("equal")
    ax.axis("off")
    return ax


def _flows(ax, plant, centres):
    transfers = [(a, b) for a, (b, _) in zip(plant.sources, plant.feeds) if None not in (a, b)]
    valves = [pair for pair in plant.valves if None not in pair]
    flows = ((plant.pipes, GLASS, "-"), (plant.links, AFTER, "-"), (plant.spills, AFTER, ":"))
    flows = (*flows, (valves, GLASS, "-"), (transfers, AFTER, "--"))
    for pairs, colour, style in flows:
        look = {"colors": colour, "linestyles": style, "linewidths": 0.8, "zorder": 1}
        ax.add_collection(LineCollection([(centres[a], centres[b]) for a, b in pairs], **look))


def _cells(ax, corners, heights, **style):
    """Draw rectangles of the width of a cell; heights: as a share of a cell's."""
    cells = [Rectangle(corner, CELL, CELL * h) for corner, h in zip(corners, heights)]
    ax.add_collection(PatchCollection(cells, **{"edgecolors": "none", **style}))
