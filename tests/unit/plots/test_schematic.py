"""The rig as a drawing: what is where, what is drawn of it, to what height, and whether it can be
read.
"""

import itertools

import matplotlib.pyplot as plt
import numpy as np
import pytest
from matplotlib.colors import to_rgb
from matplotlib.patches import Rectangle

from jaxtank import presets
from jaxtank.plants.network import network
from jaxtank.plots import style
from jaxtank.plots.layout import overflows, place, storeys
from jaxtank.plots.schematic import schematic

NAMES = "gouta2015/ngpc gouta2022/enmpc mirakhorli/sfc calofir/backstepping cascaded/pi"
RIGS = (*NAMES.split(), "khalid/gpc", "khalid/gpc-mimo")


@pytest.fixture
def ax():
    figure = plt.figure(figsize=(4.8, 5.0))
    yield figure.add_axes((0.01, 0.01, 0.98, 0.98))
    plt.close(figure)


def plant_of(name):
    return presets.find(name).loop.plant


def water(ax):
    """The patches in the colour of water but for the basin, which is pale."""
    return [
        p
        for p in ax.patches
        if isinstance(p, Rectangle) and p.get_facecolor() == (*to_rgb(style.WATER), 1.0)
    ]


def words(ax):
    return [t.get_text() for t in ax.texts]


@pytest.mark.parametrize("name", RIGS)
def test_every_part_of_a_papers_rig_is_drawn_and_nothing_is_drawn_over(ax, name):
    plant = plant_of(name)
    schematic(ax, plant)
    printed = words(ax)
    counts = {"tank ": plant.tanks, "pump ": plant.pumps, "overflow": len(plant.spills)}
    assert {w: sum(t.startswith(w) for t in printed) for w in counts} == counts
    assert sum("controlled" in t for t in printed) == len(plant.outputs)
    dashes = [line for line in ax.lines if line.get_linestyle() == "--"]
    falling = sum(np.count_nonzero(np.asarray(area)) for area in (plant.drain, plant.orifice))
    assert len(dashes) == falling + len(plant.spills)  # a jet, or liquid past a rim
    boxes = place(plant).boxes
    beyond = lambda a, b: a.x + a.width < b.x or a.y + a.height < b.y
    assert all(beyond(a, b) or beyond(b, a) for a, b in itertools.combinations(boxes, 2))
    ax.figure.draw_without_rendering()
    extents = [t.get_window_extent() for t in ax.texts]
    assert not any(a.overlaps(b) for a, b in itertools.combinations(extents, 2))
    inside = ax.figure.bbox.padded(1.0)
    assert all(inside.contains(e.x0, e.y0) and inside.contains(e.x1, e.y1) for e in extents)


@pytest.mark.parametrize("name", RIGS)
def test_water_falls_down_and_pipes_lie_level(name):
    plant, where = plant_of(name), place(plant_of(name))
    for source, sink in (*plant.links, *plant.spills):
        assert where.boxes[source].y > where.boxes[sink].y + where.boxes[sink].height
    for one, other in plant.pipes:
        assert where.boxes[one].y == where.boxes[other].y
    fed = {(j, i) for j, feed in enumerate(plant.feeds) for i in feed if i is not None}
    assert {(j, i) for j, i, _ in where.risers} == fed
    for j, i, path in where.risers:
        box, (x, y) = where.boxes[i], path[-1]
        assert path[0] == where.pumps[j]
        assert box.x < x < box.x + box.width and box.y < y < box.y + box.height


def test_tanks_are_filled_to_scale_and_setpoints_stand_at_their_height(ax):
    plant = plant_of("gouta2015/ngpc")
    schematic(ax, plant, [3.0, 15.0, 30.0, 0.0], [10.0, 25.0])
    boxes = place(plant).boxes
    for patch, box, share in zip(water(ax), boxes, (0.1, 0.5, 1.0, 0.0), strict=True):
        assert patch.get_height() == pytest.approx(share * box.height)
        assert (patch.get_x(), patch.get_y()) == (box.x, box.y)
    marks = [float(line.get_ydata()[0]) for line in ax.lines if line.get_marker() == "<"]
    np.testing.assert_allclose(
        marks, [boxes[0].y + boxes[0].height / 3, boxes[1].y + boxes[1].height * 25 / 30]
    )
    assert {"tank 1\n3 cm", "tank 3\n30 cm"} <= set(words(ax))


def test_the_shares_of_a_pump_are_written_at_its_branches(ax):
    plant = plant_of("mirakhorli/sfc")
    schematic(ax, plant)
    split = np.asarray(plant.split)
    wanted = {f"{100 * v:.3g} %" for v in (*split, *(1 - split))}
    assert {t for t in words(ax) if t.endswith("%")} == wanted


def test_a_closed_orifice_is_not_drawn_and_a_level_past_a_rim_stays_in_the_picture(ax):
    flows = {"pump_gain": 3.0, "feeds": [(1, None)], "links": [(1, 0)], "orifice": [0.0]}
    rig = network(area=[10.0, 10.0], drain=[0.1, 0.0], rim=[10.0, 20.0], **flows)
    schematic(ax, rig, [99.0, 5.0])
    assert sum(line.get_linestyle() == "--" for line in ax.lines) == 1  # the drain of tank 1
    short, tall = place(rig).boxes
    assert short.height == tall.height / 2 and water(ax)[0].get_height() < 1.1 * short.height


def test_a_rig_whose_tanks_feed_each_other_is_drawn_all_the_same(ax):
    links = {"links": [(0, 1), (1, 2), (2, 0)], "orifice": [0.1] * 3}
    rig = network(area=[1.0] * 3, drain=0.1, pump_gain=1.0, feeds=[(0, 2)], rim=5.0, **links)
    assert len(storeys(rig)) == 3
    schematic(ax, rig)
    assert sum(t.startswith("tank ") for t in words(ax)) == 3


def test_an_overflow_begins_at_its_opening():
    """Half of the height of its tank, whose rim is where a level may rise to."""
    plant = network(
        area=[1.0, 1.0], drain=[0.1, 0.1], rim=[20.0, 20.0], pump_gain=1.0, feeds=[(0, None)],
        spills=[(0, 1)], caught=1.0, ports={"spill": [10.0]}, overflow=True,
    )  # fmt: skip
    where = place(plant)
    ((tank, path),) = overflows(plant, where)
    box = where.boxes[tank]
    assert path[0][1] == pytest.approx(box.y + 0.5 * box.height)
