"""A rig drawn from its topology: tanks, pumps and splits, outlets, pipes, overflow, basin."""

from typing import Any

import numpy as np
from matplotlib.patches import Circle, Polygon
from matplotlib.patheffects import AbstractPathEffect, withStroke

from jaxtank.core.labels import label_of, name_of
from jaxtank.core.units import local
from jaxtank.plants.vessels import shape_name
from jaxtank.plots.layout import jets, overflows, pipes, place, valves
from jaxtank.plots.overview import LARGEST, overview
from jaxtank.plots.spills import Lost, Stack, amount, headroom, volume_above
from jaxtank.plots.style import AFTER, GLASS, PUMPS, REFERENCE, WATER, box, write

JET = {"color": AFTER, "linewidth": 1.1, "linestyle": (0, (3, 1.5)), "zorder": 2}  # free fall
HALO: list[AbstractPathEffect] = [withStroke(linewidth=2.2, foreground="white")]  # of text


def schematic(ax, plant, levels=None, setpoints=None, lost=None):
    """Draw a rig: each tank above those that it flows into, heights to scale."""
    # Controlled tanks have a heavier outline. A closed orifice (area 0) is not drawn. Dashed lines
    # are free jets, dotted lines overflow, double lines pipes below the surface. Hatched is what is
    # above a rim: what the tank cannot hold, or has lost, in its own cross-section. A rig of more
    # than 24 tanks is drawn by `overview.overview`.
    if plant.tanks > LARGEST:
        return overview(ax, plant, levels)
    where = place(plant)
    low, high, bottom = where.left + 0.06, where.right - 0.06, where.bottom + 0.06
    box(ax, (low, bottom), (high - low, 0.14), facecolor=WATER, alpha=0.5, zorder=0)
    ax.plot([low, low, high, high], [-0.82, bottom, bottom, -0.82], color=GLASS, linewidth=1.4)
    write(ax, (low + high) / 2, bottom + 0.07, "basin")
    _pipework(ax, plant, where)
    for start, end, y, _ in pipes(plant, where):
        for wide, colour, layer in ((6.5, GLASS, 1.7), (3.5, WATER, 1.8)):
            line = {"color": colour, "linewidth": wide, "zorder": layer}
            ax.plot([start, end], [y, y], solid_capstyle="butt", **line)
    for tank, path, _ in jets(plant, where):  # into the tanks below, and into the basin
        ax.plot(*np.array(path).T, **JET)
        (x, start), y = path[0], where.boxes[tank].y
        if start < y:  # from an orifice in the bottom
            spout = [(x - 0.06, y), (x + 0.06, y), (x + 0.025, y - 0.07), (x - 0.025, y - 0.07)]
            ax.add_patch(Polygon(spout, facecolor=GLASS, zorder=3))
    for _, path in overflows(plant, where):
        ax.plot(*np.array(path).T, color=AFTER, linewidth=1.3, linestyle=(0, (1, 1.2)), zorder=2)
        x, y = path[1][0] - 0.04, (path[1][1] + path[2][1]) / 2
        write(ax, x, y, "overflow", 6.5, "right center", rotation=90)
    for i in range(plant.tanks):
        _tank(ax, plant, i, where.boxes[i], None if levels is None else float(levels[i]))
    if setpoints is not None:
        for k, i in enumerate(plant.outputs):
            mark(ax, where.boxes[i], float(setpoints[k]))
    _pumps(ax, plant, where)
    _shares(ax, plant, where)
    ax.set(xlim=(where.left, where.right), ylim=(where.bottom, where.top), aspect="equal")
    if levels is not None:
        _above(ax, plant, where, np.asarray(levels, dtype=float), lost)
    ax.axis("off")
    return ax


def _pipework(ax, plant, where):
    """Lines of the pumps and of the valves, each in the colour of its input."""
    for pump, _, path in where.risers:
        line = {"color": _colour(pump), "solid_joinstyle": "round", "zorder": 1}
        ax.plot(*np.array(path).T, linewidth=1.6, **line)
        ax.plot(*path[-1], marker="v", color=_colour(pump), markersize=5, zorder=4)
    for pump, _, path in where.suctions:
        ax.plot(*np.array(path).T, color=_colour(pump), linewidth=1.6, linestyle="--", zorder=1)
    for k, (_, path, at) in enumerate(valves(plant, where)):
        j = len(plant.feeds) + k
        _valve(ax, path, at, _colour(j), label_of(plant, "pump", j))


def _pumps(ax, plant, where):
    """Pumps with their names; by number alone where several stand on one side."""
    for j, (x, y) in enumerate(where.pumps):
        label = label_of(plant, "pump", j)
        if sum((other > 0) == (x > 0) for other, _ in where.pumps) > 1:
            label = name_of(plant, "pump", j) or str(j + 1)
        circle = {"facecolor": "white", "edgecolor": _colour(j), "linewidth": 1.8, "zorder": 4}
        ax.add_patch(Circle((x, y), 0.17, **circle))
        arrow = [(x - 0.1, y - 0.08), (x + 0.1, y - 0.08), (x, y + 0.13)]
        ax.add_patch(Polygon(arrow, facecolor=_colour(j), zorder=5))
        away, side = (-0.23, "right") if x > 0 else (0.23, "left")
        outside = x + away, y + 0.12, f"{side} center"
        x, y, at = (x, y - 0.26, "center center") if y > -0.6 else outside  # above the basin
        write(ax, x, y, label, 8, at, "black", zorder=5)


def mark(ax, tank, setpoint):
    """Mark a setpoint [cm] by a line and a triangle at the right of a tank; return both."""
    y, x = mark_height(tank, setpoint), tank.x + tank.width
    (line,) = ax.plot([x - 0.1 * tank.width, x], [y, y], color=REFERENCE, linewidth=1.3, zorder=4)
    (triangle,) = ax.plot([x + 0.07], [y], marker="<", color=REFERENCE, markersize=5, zorder=4)
    return line, triangle


def mark_height(tank, setpoint):
    """Return the height of the mark of a setpoint [cm], at most 5 % above the rim."""
    return tank.y + min(max(setpoint, 0.0) * tank.scale, 1.05 * tank.height)


def depth(tank, level):
    """Return the drawn depth of a level [cm], at most up to the rim; `spills` draws the rest."""
    return min(max(float(level), 0.0) * tank.scale, tank.height)


def _above(ax, plant, where, levels, lost):
    """Volumes that are lost, or those above the rims where no overflow is simulated, hatched."""
    area, rim = (np.asarray(v, dtype=float) for v in (plant.area, plant.rim))
    volumes = volume_above(plant, levels) if lost is None else np.asarray(lost, dtype=float)
    unit = local("cm^3", plant.units)
    for i in np.flatnonzero(volumes > 1e-9 * area * rim):
        tank, volume = where.boxes[i], float(volumes[i])
        if lost is not None:
            gone = Lost(ax, tank, unit)
            gone.set(volume)
            headroom(ax, [(gone, volume)])
            continue
        stack = Stack(ax, tank, float(area[i]))
        stack.set(volume)
        headroom(ax, [(stack, volume)])
        y = tank.y + tank.height + min(0.5 * stack.height(volume), 0.2)
        look = {"colour": "black", "path_effects": HALO, "zorder": 6, "gid": "above"}
        write(ax, tank.middle, y, f"{amount(volume, unit)} above", **look)


def _colour(pump):
    return PUMPS[pump % len(PUMPS)]


def _tank(ax, plant, i, tank, level):
    unit, controlled = plant.units[0], i in plant.outputs
    x, y = tank.x + tank.width, tank.y + tank.height
    box(ax, (tank.x, tank.y), (tank.width, tank.height), facecolor="white", zorder=1.5)
    text = "controlled" if controlled else ""
    if level is not None:
        size, text = (tank.width, depth(tank, level)), f"{level:.3g} {unit}"
        box(ax, (tank.x, tank.y), size, facecolor=WATER, zorder=1.6)
    wall = {"color": REFERENCE, "linewidth": 2.2} if controlled else {"color": GLASS}
    ax.plot([tank.x, tank.x, x, x], [y, tank.y, tank.y, y], **{"linewidth": 1.4, **wall}, zorder=3)
    halo: dict[str, Any] = {} if level is None else {"path_effects": HALO}
    shape, name = shape_name(plant, i), label_of(plant, "tank", i)
    label = "\n".join(part for part in (name, shape, text) if part)
    size = 7 if tank.width < 0.7 else 8
    middle = tank.y + 0.5 * tank.height
    write(ax, tank.middle, middle, label, size, colour="black", zorder=5, **halo)
    rim = f"{float(np.asarray(plant.rim)[i]):g} {unit}"
    write(ax, x + 0.05, y, rim, 6.5, "left center", zorder=5)


def _valve(ax, path, at, colour, label):
    """A pipe with a valve: two triangles, tip to tip."""
    ax.plot(*np.array(path).T, color=AFTER, linewidth=1.6, solid_joinstyle="round", zorder=2)
    x, y = at
    across = path[0][1] == path[1][1] == y
    for sign in (-1, 1):
        wide = [(x, y), (x + sign * 0.1, y + 0.07), (x + sign * 0.1, y - 0.07)]
        tall = [(x, y), (x + 0.07, y + sign * 0.1), (x - 0.07, y + sign * 0.1)]
        face = {"facecolor": "white", "edgecolor": colour, "linewidth": 1.4, "zorder": 4}
        ax.add_patch(Polygon(wide if across else tall, **face))
    place = (x, y + 0.16, "center center") if across else (x + 0.14, y, "left center")
    write(ax, place[0], place[1], label, 7, place[2], "black", zorder=5)


def _shares(ax, plant, where):
    """The share of a pump beside each of its two branches."""
    for pump, tank, path in where.risers:
        first, second = plant.feeds[pump]
        if second is None or len(path) < 3:
            continue
        ax.plot(*path[1], marker="o", color=_colour(pump), markersize=3.5, zorder=2)
        share = float(np.asarray(plant.split)[pump])
        share = share if tank == first else 1.0 - share
        (x, y), (end, _) = path[1], path[2]
        away, side = (0.06, "left") if end > x else (-0.06, "right")
        write(ax, x + away, y + 0.02, f"{100 * share:.3g} %", 7, f"{side} bottom", "0.15")
