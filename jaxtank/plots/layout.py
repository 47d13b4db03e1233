"""Positions of the parts of a rig in a drawing: tanks in rows, pumps below, pipework between."""

from typing import NamedTuple

import numpy as np

PITCH = 1.7  # from one tank to the next in its row, in heights of the tallest tank
STOREY = 1.75  # from the bottom of one row of tanks to the bottom of the next


class Box(NamedTuple):
    """A tank: its left lower corner, its width and its height, in heights of the tallest tank."""

    x: float
    y: float
    width: float
    height: float
    scale: float  # drawn height of one unit of level [1/cm]

    @property
    def middle(self):
        return self.x + self.width / 2


class Layout(NamedTuple):
    """Positions of all parts of a rig."""

    boxes: tuple
    pumps: tuple
    risers: tuple  # (pump, tank, path)
    suctions: tuple  # (pump, tank that it draws from, path)
    left: float
    right: float
    bottom: float
    top: float


def storeys(plant):
    """Return the row (n,) of each tank, 0 the lowest."""
    # A tank is above every tank that it flows into, and level with those that a pipe joins to it.
    # Tanks that flow in a circle, which gravity does not allow, have the rows that they reach.
    row = [0] * plant.tanks
    joined = [(v, one_way) for v, one_way in zip(plant.valves, plant.one_way) if v[1] is not None]
    for _ in range(plant.tanks):
        for source, sink in (*plant.links, *plant.spills, *(v for v, one_way in joined if one_way)):
            row[source] = min(max(row[source], row[sink] + 1), plant.tanks - 1)
        for a, b in (*plant.pipes, *(v for v, one_way in joined if not one_way)):
            row[a] = row[b] = max(row[a], row[b])
    used = sorted(set(row))
    return tuple(used.index(r) for r in row)


def place(plant):
    rims, areas = (np.asarray(v, dtype=float) for v in (plant.rim, plant.area))
    heights = np.clip(rims / rims.max(), 0.3, 1.0)
    widths = 0.95 * np.clip(np.sqrt(areas / areas.max()), 0.4, 1.0)
    rows = storeys(plant)
    wide = max(rows.count(r) for r in set(rows))
    boxes = [None] * plant.tanks
    for row in sorted(set(rows)):
        tanks = [i for i in range(plant.tanks) if rows[i] == row]
        for k, i in enumerate(tanks):
            x = PITCH * (k + (wide - len(tanks)) / 2) + PITCH / 2
            sizes = (widths[i], heights[i], heights[i] / rims[i])
            boxes[i] = Box(x - widths[i] / 2, row * STOREY, *map(float, sizes))
    return _with_pumps(plant, boxes, rows, wide * PITCH)


def jets(plant, where):
    """Return [(tank, path ((x, y), ...), name of its area)] of the free jets that are open."""
    paths, orifices = [], np.asarray(plant.orifice, dtype=float)
    for i, box in enumerate(where.boxes):
        links = [(sink, k) for k, (source, sink) in enumerate(plant.links) if source == i]
        sinks = [(where.boxes[sink], k) for sink, k in links if orifices[k] > 0]
        sinks.sort(key=lambda one: one[0].middle)
        for k, (below, orifice) in enumerate(sinks):
            x = box.x + box.width * (k + 1) / (len(sinks) + 1)
            end = min(max(x, below.x + 0.35 * below.width), below.x + 0.65 * below.width)
            path = ((x, box.y - 0.06), (x, box.y - 0.12), (end, below.y + 0.97 * below.height))
            paths.append((i, path, f"plant.orifice[{orifice}]"))
        if float(np.asarray(plant.drain)[i]) > 0:
            side = box.x + box.width
            path = ((box.middle, box.y - 0.06), (box.middle, -0.93))
            if sinks:  # past the tanks below
                path = ((side, box.y + 0.05), (side + 0.16, box.y + 0.05), (side + 0.16, -0.93))
            paths.append((i, path, f"plant.drain[{i}]"))
    return paths


def pipes(plant, where):
    """Return [(left end, right end, height, name of its area)] of the pipes that are open."""
    lines = []
    for k, (pair, area) in enumerate(zip(plant.pipes, np.asarray(plant.pipe, dtype=float))):
        if area > 0:
            west, east = sorted((where.boxes[tank] for tank in pair), key=lambda b: b.x)
            height = max(west.y, east.y) + 0.08  # below the surface
            lines.append((west.x + west.width, east.x, height, f"plant.pipe[{k}]"))
    return lines


def valves(plant, where):
    """Return [(tank, path ((x, y), ...), (x, y) of the symbol)] of each valve."""
    lines, number = [], [0] * plant.tanks
    for source, sink in plant.valves:
        box, order = where.boxes[source], number[source]
        number[source] += 1
        side = box.x + box.width
        if sink is None:
            x, y = side + 0.24 + 0.14 * order, box.y + 0.05 + 0.1 * order
            lines.append((source, ((side, y), (x, y), (x, -0.93)), (x, y - 0.17)))
            continue
        other = where.boxes[sink]
        if box.y == other.y:
            west, east = sorted((box, other), key=lambda b: b.x)
            ends = west.x + west.width, east.x
            y = box.y + 0.22 + 0.14 * order
            lines.append((source, ((ends[0], y), (ends[1], y)), (sum(ends) / 2, y)))
        else:
            x, end = box.x + box.width * 0.15, other.y + 0.97 * other.height
            path = ((x, box.y), (x, box.y - 0.3), (other.middle, end))
            lines.append((source, path, (x, box.y - 0.15)))
    return lines


def overflows(plant, where):
    """Return [(tank, path ((x, y), ...))] of what overflows from one tank into another."""
    paths, ports = [], getattr(plant, "spill_port", None)
    for k, (tank, into) in enumerate(plant.spills):
        source, sink = where.boxes[tank], where.boxes[into]
        height = source.height if ports is None else float(ports[k]) * source.scale
        x, brim = source.x - 0.13, source.y + min(height, source.height)
        end = (sink.x + 0.12 * sink.width, sink.y + sink.height * 0.97)
        start = ((source.x, brim), (x, brim - 0.05), (x, sink.y + sink.height + 0.25))
        paths.append((tank, (*start, end)))
    return paths


def _with_pumps(plant, boxes, rows, width):
    """The Layout with pumps in the basin, at the nearer side of the first tank that they fill."""
    sides = [_side(plant, boxes, width, j) for j in range(len(plant.feeds))]
    pumps, risers, suctions, above = [], [], [], {}
    for j, feed in enumerate(plant.feeds):
        order = sides[:j].count(sides[j])  # its number on this side
        x = -0.35 - 0.5 * order if sides[j] == "left" else width + 0.35 + 0.5 * order
        source, level = plant.sources[j] if plant.sources else None, -0.78
        if source is not None:  # above the basin
            level, box = -0.45, boxes[source]
            start = box.x + box.width * (0.1 if sides[j] == "left" else 0.9)
            suctions.append((j, source, ((start, box.y), (start, level), (x, level))))
        pumps.append((x, level))
        targets = [i for i in feed if i is not None]
        if not targets:
            risers.append((j, source, ((x, level), (x, -0.9))))
        # jets of different pumps into one tank side by side, on the side that they come from
        share = 0.2 + 0.15 * min(order, 1) if sides[j] == "left" else 0.8 - 0.15 * min(order, 1)
        for i in targets:
            above[rows[i]] = above.get(rows[i], 0) + 1
            y = rows[i] * STOREY + 1.0 + 0.12 + 0.14 * (above[rows[i]] - 1)
            end = boxes[i].x + boxes[i].width * share
            path = ((x, level), (x, y), (end, y), (end, boxes[i].y + boxes[i].height * 0.93))
            risers.append((j, i, path))
    edge = 0.75 + 0.5 * max(0, max(sides.count("left"), sides.count("right")) - 1)
    top = max([b.y + b.height for b in boxes] + [p[1][1] for _, _, p in risers]) + 0.3
    parts = (tuple(part) for part in (boxes, pumps, risers, suctions))
    return Layout._make((*parts, -edge, width + edge, -1.12, top))


def _side(plant, boxes, width, j):
    first, source = plant.feeds[j][0], plant.sources[j] if plant.sources else None
    middle = boxes[source if first is None else first].middle - width / 2
    if abs(middle) > 1e-9:
        return "left" if middle < 0 else "right"
    return "left" if j % 2 == 0 else "right"
