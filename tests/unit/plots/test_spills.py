"""Liquid above a rim: counted as the library counts it, drawn to scale, named with its unit."""

import dataclasses
import re
from types import SimpleNamespace

import numpy as np
import pytest
from helpers import ROOT
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

import jaxtank
from jaxtank import presets
from jaxtank.plots import responses, spills, style
from jaxtank.plots.layout import place
from jaxtank.plots.schematic import schematic


@pytest.fixture(scope="module")
def runs(gouta):
    """{whether overflow is simulated: (loop, run, clock)} of backstepping: tanks 3, 4 pass their
    rims.
    """
    case = gouta("backstepping", {"clock.dt": 0.5, "clock.duration": 900.0})
    found = {}
    for overflow in (False, True):
        plant = dataclasses.replace(case.loop.plant, overflow=overflow)
        loop = dataclasses.replace(case.loop, plant=plant)
        found[overflow] = (loop, jaxtank.simulate(loop, case.clock), case.clock)
    return found


def hatched(ax):
    return [p for p in ax.patches if isinstance(p, Rectangle) and p.get_hatch()]


def test_a_level_of_48_cm_in_a_tank_of_30_cm_stands_18_cm_above_its_rim():
    """Drawn to the scale of the levels, and counted: 15.5 cm^2 times 18 cm."""
    plant = presets.find("gouta2015/backstepping").loop.plant
    ax = schematic(Figure().gca(), plant, [10.0, 10.0, 10.0, 48.0])
    box, (patch,) = place(plant).boxes[3], hatched(ax)
    assert (patch.get_x(), patch.get_width()) == (box.x, box.width)
    assert patch.get_y() == pytest.approx(box.y + box.height)
    assert patch.get_height() == pytest.approx(box.height * 18.0 / 30.0)
    volume = float(np.asarray(plant.area)[3]) * 18.0
    (words,) = (t.get_text() for t in ax.texts if t.get_gid() == "above")
    assert words == f"{volume:.0f} cm^3 above"


def test_full_to_the_rim_is_not_above_it():
    plant = presets.find("gouta2015/backstepping").loop.plant
    assert hatched(schematic(Figure().gca(), plant, [30.0] * 4)) == []


@pytest.mark.slow
def test_what_is_on_the_floor_is_the_overflow_volume_of_the_library(runs):
    loop, run, clock = runs[True]
    volume = np.asarray(jaxtank.evaluate(loop, clock, ["overflow_volume"])["overflow_volume"])
    found = spills.spilled(loop.plant, run)
    assert volume[3] > 100.0 and found.simulated
    np.testing.assert_allclose(found.most, volume, rtol=1e-12, atol=1e-12)
    assert found.words() == f"overflow simulated: {volume.sum():.0f} cm^3 on the floor"
    ax = schematic(Figure().gca(), loop.plant, run.x[-1], lost=run.spilled[-1])
    words = {t.get_text() for t in ax.texts if t.get_gid() == "above"}
    assert f"{volume[3]:.0f} cm^3 spilled" in words
    assert hatched(ax) == []  # it is gone, and stands nowhere


@pytest.mark.extended
def test_what_stands_above_a_rim_follows_from_the_highest_level(runs):
    loop, run, clock = runs[False]
    highest = np.asarray(jaxtank.evaluate(loop, clock, ["max_level"])["max_level"])
    past = np.maximum(0.0, highest - np.asarray(loop.plant.rim)) * np.asarray(loop.plant.area)
    found = spills.spilled(loop.plant, run)
    np.testing.assert_allclose(found.most, past, rtol=1e-9, atol=1e-9)
    assert found.words().startswith("no overflow in the model: up to ")


@pytest.mark.parametrize("overflow", [False, True])
def test_levels_over_time_are_hatched_counted_and_say_which_model_it_is(runs, overflow):
    loop, run, _ = runs[overflow]
    figure = responses.responses(loop, {"one": run})
    said = "overflow simulated" if overflow else "no overflow in the model"
    assert said in figure._suptitle.get_text()
    (panel,) = (ax for ax in figure.axes if ax.get_title().startswith("tank 4"))
    volume = spills.spilled(loop.plant, run).most[3]
    assert spills.amount(volume, "cm^3") in panel.get_title()
    assert [c for c in panel.collections if c.get_hatch()]
    (dry,) = (ax for ax in figure.axes if ax.get_title() == "tank 1")
    assert not [c for c in dry.collections if c.get_hatch()]


def test_a_run_below_all_rims_has_no_word_of_it(runs):
    loop, run, _ = runs[False]
    low = run.replace(x=np.minimum(run.x, 20.0))
    assert responses.responses(loop, {"one": low}, "a title")._suptitle.get_text() == "a title"
    assert "no level above its rim" in spills.spilled(loop.plant, low).words()


@pytest.mark.parametrize(
    ("volume", "text"), [(0.0, "0 L"), (0.0929, "0.0929 L"), (774.4, "774 L"), (2e-7, "2e-07 L")]
)
def test_volumes_have_three_figures_and_a_unit(volume, text):
    assert spills.amount(volume, "L") == text


def test_no_two_roles_share_a_colour_and_the_live_page_has_the_same():
    roles = {
        "run": style.TUNED,
        "pin0": style.PUBLISHED,
        "pin1": style.FILTERED,
        "limit": style.RIM,
        "water": style.WATER,
        **{f"pump{j}": colour for j, colour in enumerate(style.PUMPS)},
    }
    assert len({to_rgba(c) for c in (*roles.values(), style.REFERENCE)}) == len(roles) + 1
    sheet = (ROOT / "jaxtank" / "live" / "page.css").read_text().split("@media")[0]
    for role, colour in roles.items():
        assert re.search(rf"--{role}: {colour.lower()};", sheet), role


def test_a_plant_whose_area_is_a_function_of_the_level_has_no_counted_volume():
    cone = SimpleNamespace(area=lambda h: 2.0 * h, rim=np.array([1.0]))
    found = spills.spilled(cone, SimpleNamespace(x=np.array([[0.5], [2.0]])))
    assert not found.any and found.volume.shape == (2, 1)
