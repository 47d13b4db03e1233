"""A rig drawn from its topology: tanks, pumps and their splits, outlets, pipes, overflow, basin.

Draws on given matplotlib axes.
"""

import numpy as np
from matplotlib.patches import Circle, Polygon, Rectangle
from matplotlib.patheffects import AbstractPathEffect, withStroke

from jaxtank.core.units import local
from jaxtank.plots.layout import jets, overflows, pipes, place
from jaxtank.plots.overview import LARGEST, overview
from jaxtank.plots.spills import Stack, amount, headroom
from jaxtank.plots.style import AFTER, GLASS, PUMPS, REFERENCE, WATER

JET = {"color": AFTER, "linewidth": 1.1, "linestyle": (0, (3, 1.5)), "zorder": 2}
"""Style of water in free fall."""

HALO: list[AbstractPathEffect] = [withStroke(linewidth=2.2, foreground="white")]
"""Outline of text that a level may pass behind."""


def schematic(ax, plant, levels=None, setpoints=None, lost=None):
    """Draw a rig: each tank above those that it flows into, heights to scale."""
    # Controlled tanks have a heavier outline. A closed orifice (area 0) is not drawn. Dashed lines
    # are free jets, dotted lines overflow, double lines pipes below the surface. Hatched is what is
    # above a rim: what the tank cannot hold, or has lost, in its own cross-section. A rig of more
    # than 24 tanks is drawn by `overview.overview`.
    if plant.tanks > LARGEST:
        return overview(ax, plant, levels)
    where, unit = place(plant), plant.units[0]
    _basin(ax, where)
    for pump, _, path in where.risers:
        ax.plot(
            *np.array(path).T, color=_colour(pump), linewidth=1.6, solid_joinstyle="round", zorder=1
        )
        ax.plot(*path[-1], marker="v", color=_colour(pump), markersize=5, zorder=4)
    for pipe in pipes(plant, where):
        _pipe(ax, *pipe)
    _jets(ax, plant, where)
    for _, path in overflows(plant, where):
        _overflow(ax, path)
    for i, box in enumerate(where.boxes):
        controlled = i in plant.outputs
        ax.add_patch(
            Rectangle(
                (box.x, box.y),
                box.width,
                box.height,
                facecolor="white",
                edgecolor="none",
                zorder=1.5,
            )
        )
        if levels is not None:
            ax.add_patch(
                Rectangle(
                    (box.x, box.y),
                    box.width,
                    depth(box, levels[i]),
                    facecolor=WATER,
                    edgecolor="none",
                    zorder=1.6,
                )
            )
        x, y = box.x + box.width, box.y + box.height
        ax.plot(
            [box.x, box.x, x, x],
            [y, box.y, box.y, y],
            color=REFERENCE if controlled else GLASS,
            linewidth=2.2 if controlled else 1.4,
            zorder=3,
        )
        _label(ax, plant, i, box, None if levels is None else float(levels[i]), unit)
    if setpoints is not None:
        for k, i in enumerate(plant.outputs):
            mark(ax, where.boxes[i], float(setpoints[k]))
    for j, (x, y) in enumerate(where.pumps):
        crowded = sum((other > 0) == (x > 0) for other, _ in where.pumps) > 1
        _pump(ax, x, y, j, str(j + 1) if crowded else f"pump {j + 1}")
    _shares(ax, plant, where)
    ax.set(xlim=(where.left, where.right), ylim=(where.bottom, where.top), aspect="equal")
    if levels is not None:
        _above(ax, plant, where, np.asarray(levels, dtype=float), lost)
    ax.axis("off")
    return ax


def mark(ax, box, setpoint):
    """Mark a setpoint [cm] with a line and a triangle at the right of a tank; return both
    artists.
    """
    y, x = mark_height(box, setpoint), box.x + box.width
    (line,) = ax.plot([x - 0.1 * box.width, x], [y, y], color=REFERENCE, linewidth=1.3, zorder=4)
    (triangle,) = ax.plot([x + 0.07], [y], marker="<", color=REFERENCE, markersize=5, zorder=4)
    return line, triangle


def mark_height(box, setpoint):
    """Return the height of the mark of a setpoint [cm], at most 5 % above the rim."""
    return box.y + min(max(setpoint, 0.0) * box.scale, 1.05 * box.height)


def depth(box, level):
    """Return the drawn depth of a level [cm], at most up to the rim; `spills` draws the rest."""
    return min(max(float(level), 0.0) * box.scale, box.height)


def _above(ax, plant, where, levels, lost):
    """What is above the rims, hatched and counted: lost volumes, or what the tanks cannot hold."""
    area, rim = (np.asarray(v, dtype=float) for v in (plant.area, plant.rim))
    volumes, what = area * (levels - rim), "above"
    if lost is not None:
        volumes, what = np.asarray(lost, dtype=float), "spilled"
    for i in np.flatnonzero(volumes > 1e-9 * area * rim):
        box, volume = where.boxes[i], float(volumes[i])
        found = Stack(ax, box, float(area[i]))
        found.set(volume)
        headroom(ax, [(found, volume)])
        y = box.y + box.height + min(0.5 * found.height(volume), 0.2)
        style = {"ha": "center", "va": "center", "fontsize": 7, "zorder": 6, "gid": "above"}
        text = f"{amount(volume, local('cm^3', plant.units))} {what}"
        ax.text(box.middle, y, text, path_effects=HALO, **style)


def _colour(pump):
    return PUMPS[pump % len(PUMPS)]


def _basin(ax, where):
    low, high = where.left + 0.06, where.right - 0.06
    ax.add_patch(
        Rectangle(
            (low, where.bottom + 0.06),
            high - low,
            0.14,
            facecolor=WATER,
            alpha=0.5,
            edgecolor="none",
            zorder=0,
        )
    )
    ax.plot(
        [low, low, high, high],
        [-0.82, where.bottom + 0.06, where.bottom + 0.06, -0.82],
        color=GLASS,
        linewidth=1.4,
    )
    ax.text(
        (low + high) / 2,
        where.bottom + 0.13,
        "basin",
        ha="center",
        va="center",
        fontsize=7,
        color="0.25",
    )


def _pump(ax, x, y, pump, label):
    ax.add_patch(
        Circle((x, y), 0.17, facecolor="white", edgecolor=_colour(pump), linewidth=1.8, zorder=4)
    )
    ax.add_patch(
        Polygon(
            [(x - 0.1, y - 0.08), (x + 0.1, y - 0.08), (x, y + 0.13)],
            facecolor=_colour(pump),
            zorder=5,
        )
    )
    away, side = (-0.23, "right") if x > 0 else (0.23, "left")
    ax.text(x + away, y + 0.12, label, fontsize=8, ha=side, va="center", zorder=5)


def _shares(ax, plant, where):
    """The share of a pump beside each of its two branches."""
    for pump, tank, path in where.risers:
        first, second = plant.feeds[pump]
        if second is None:
            continue
        ax.plot(*path[1], marker="o", color=_colour(pump), markersize=3.5, zorder=2)
        share = float(np.asarray(plant.split)[pump])
        share = share if tank == first else 1.0 - share
        (x, y), (end, _) = path[1], path[2]
        ax.text(
            x + (0.06 if end > x else -0.06),
            y + 0.02,
            f"{100 * share:.3g} %",
            fontsize=7,
            ha="left" if end > x else "right",
            va="bottom",
            color="0.15",
        )


def _label(ax, plant, tank, box, level, unit):
    rim = float(np.asarray(plant.rim)[tank])
    what = (
        f"{level:.3g} {unit}"
        if level is not None
        else ("controlled" if tank in plant.outputs else "")
    )
    label = "\n".join(line for line in (f"tank {tank + 1}", what) if line)
    small = box.width < 0.7
    text = ax.text(
        box.middle,
        box.y + 0.5 * box.height,
        label,
        ha="center",
        va="center",
        fontsize=7 if small else 8,
        zorder=5,
    )
    if level is not None:
        text.set_path_effects(HALO)
    ax.text(
        box.x + box.width + 0.05,
        box.y + box.height,
        f"{rim:g} {unit}",
        ha="left",
        va="center",
        fontsize=6.5,
        color="0.25",
        zorder=5,
    )


def _jets(ax, plant, where):
    """Free jets from the floor of each tank: into the tanks below it, and into the basin."""
    for tank, path in jets(plant, where):
        ax.plot(*np.array(path).T, **JET)
        if path[0][1] < where.boxes[tank].y:  # from an orifice in the floor
            _spout(ax, path[0][0], where.boxes[tank].y)


def _spout(ax, x, y):
    ax.add_patch(
        Polygon(
            [(x - 0.06, y), (x + 0.06, y), (x + 0.025, y - 0.07), (x - 0.025, y - 0.07)],
            facecolor=GLASS,
            zorder=3,
        )
    )


def _pipe(ax, left, right, y):
    for wide, colour, layer in ((6.5, GLASS, 1.7), (3.5, WATER, 1.8)):
        ax.plot(
            [left, right], [y, y], color=colour, linewidth=wide, solid_capstyle="butt", zorder=layer
        )


def _overflow(ax, path):
    ax.plot(*np.array(path).T, color=AFTER, linewidth=1.3, linestyle=(0, (1, 1.2)), zorder=2)
    ax.text(
        path[1][0] - 0.04,
        (path[1][1] + path[2][1]) / 2,
        "overflow",
        fontsize=6.5,
        color="0.25",
        rotation=90,
        ha="right",
        va="center",
    )
