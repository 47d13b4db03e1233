"""The live figure of a notebook: its numbers against the library's, one program for all moves."""

import dataclasses

import jax
import numpy as np
import pytest

import jaxtank
import tuning
from jaxtank import presets
from jaxtank.core.errors import InputError
from jaxtank.plots.moving_fan import MovingFan
from tuning.live import live_figure
from tuning.live.fan import CUTS, Fan
from tuning.live.live_figure import LiveFigure
from tuning.live.shown import LivePage

MOVED = {"controller.Kc[0]": 0.7, "controller.Ti[0]": 60.0}


@pytest.fixture(scope="module")
def case():
    """Two tanks with overflow, noise and 400 s: everything that a fan has to carry."""
    found = presets.find("cascaded/pi")
    clock = dataclasses.replace(found.clock, duration=1000.0)
    loop = jaxtank.with_values(found.loop, {"sensor.noise": [0.02, 0.01]})
    return found.replace(loop=loop, clock=clock)


@pytest.fixture(scope="module")
def fan(case):
    return Fan(case, plants=12, seed=3)


def plant(fan, k):
    """The loop of one plant at MOVED, and the key of its noise."""
    own = {name: values[k] for name, values in fan.rows.items()}
    return jaxtank.with_values(jaxtank.with_values(fan.case.loop, own), MOVED), fan.keys[k]


def test_each_plant_has_the_measures_and_the_rows_of_the_library(fan):
    """To 1e-12; the highest level of all plants is that of twelve runs by `simulate`."""
    moved = fan.move(MOVED)
    runs = []
    for k in range(fan.plants):
        loop, key = plant(fan, k)
        for name, value in jaxtank.evaluate(loop, fan.case.clock, fan.measured, key).items():
            np.testing.assert_allclose(moved.measures[name][k], value, rtol=1e-12, atol=1e-14)
        runs.append(jaxtank.simulate(loop, fan.case.clock, key, fan.every))
    np.testing.assert_allclose(moved.t, runs[0].t, rtol=1e-14)
    np.testing.assert_allclose(moved.r, runs[0].r, rtol=1e-14)
    for own, field in ((moved.x, "x"), (moved.u, "u")):
        expected = np.quantile([getattr(run, field) for run in runs], CUTS, axis=0)
        np.testing.assert_allclose(own, expected, rtol=1e-12, atol=1e-13)


def test_the_plants_are_those_of_an_ensemble(case, fan):
    at = case.replace(loop=jaxtank.with_values(case.loop, MOVED))
    found = tuning.ensemble(at, samples=12, key=3, measures=["max_level"], fan=False)
    moved = fan.move(MOVED)
    np.testing.assert_allclose(moved.measures["max_level"], found.measures["max_level"], rtol=1e-12)


def test_twenty_moves_compile_one_program(fan):
    rng = np.random.default_rng(0)
    for _ in range(20):
        fan.move({b.name: float(b.from_unit(rng.uniform())) for b in fan.bounds})
    assert fan.program._cache_size() == 1


def test_the_effect_in_words_is_the_difference_of_two_runs(fan):
    """10 % more of a gain by the derivative, against central differences of `evaluate`."""
    moved, key = fan.move(MOVED), fan.keys[0]

    def error(Kc):
        loop = jaxtank.with_values(fan.case.loop, MOVED | {"controller.Kc[0]": Kc})
        values = jaxtank.evaluate(loop, fan.case.clock, ["rms_error_total"], key)
        return float(values["rms_error_total"])

    step = 1e-5
    slope = (error(0.7 + step) - error(0.7 - step)) / (2 * step)
    (line,) = (s for s in fan.sentences(moved) if s.startswith("10 % more controller.Kc[0]:"))
    assert f"error {0.1 * 0.7 * slope:+.2g} V" in line
    np.testing.assert_allclose(moved.slopes["rms_error_total"][..., 0], slope, rtol=1e-6)


def test_each_parameter_keeps_its_own_effect_whatever_their_order():
    """The slopes by central differences, of parameters that are not in the order of their names."""
    case = presets.find("cascaded/pi")
    case = case.replace(clock=dataclasses.replace(case.clock, duration=400.0))
    at = {"plant.drain[1]": 0.05, "controller.Kc[0]": 0.7}
    fan = Fan(case, {name: (0.5 * value, 2.0 * value) for name, value in at.items()}, plants=1)
    moved = fan.move(at)
    for k, name in enumerate(b.name for b in fan.bounds):
        step, ends = 1e-5 * at[name], []
        for sign in (-1.0, 1.0):
            loop = fan.case_at(at | {name: at[name] + sign * step}).loop
            ends.append(jaxtank.evaluate(loop, case.clock, "rms_error_total")["rms_error_total"])
        np.testing.assert_allclose(
            moved.slopes["rms_error_total"][..., k], (ends[1] - ends[0]) / (2.0 * step), rtol=1e-5
        )


def test_the_share_over_a_rim_counts_plants(fan):
    moved = fan.move(MOVED)
    spilled = np.asarray(moved.measures["overflow_volume"]) > 0
    assert np.array_equal(fan.over(moved), spilled)  # the rims of this rig are physics
    share = 100.0 * spilled.any(axis=1).mean()
    assert f"{share:.3g} % of 12 plants rise above a rim" in fan.sentences(moved)[0]


def test_what_cannot_be_moved_is_refused(case, fan):
    with pytest.raises(InputError, match=r"controller.Kd is not free.*controller.Kc\[0\]"):
        fan.move({"controller.Kd": 1.0})
    with pytest.raises(InputError, match=r"controller.Kc\[0\] = -1 .*must lie within"):
        fan.move({"controller.Kc[0]": -1.0})
    with pytest.raises(InputError, match="plants"):
        case.explore(plants=0)


def test_lines_are_moved_and_not_made_again(fan):
    """A move within the panels draws what moves alone, into the same artists."""
    figure = LiveFigure(fan, widgets=False)
    figure.move(MOVED)
    artists = [[id(a) for a in ax.get_children()] for ax in figure.picture.figure.axes]
    drawn, before = figure.picture.drawn, figure.png
    figure.move(MOVED | {"controller.Kc[0]": 0.71})
    assert [[id(a) for a in ax.get_children()] for ax in figure.picture.figure.axes] == artists
    assert figure.picture.drawn == drawn and figure.png != before
    assert np.asarray(figure.picture.panels[0][2].median.get_ydata()).tolist() == (
        figure.moved.x[2, :, 0].tolist()
    )


def test_nothing_is_read_from_memory_that_was_not_written(case, monkeypatch):
    """What an earlier owner of the memory left there may be 1e308: no axis can hold that, and now
    and then a notebook ended with a singular matrix.
    """
    real, t = np.empty, np.arange(5.0)

    def left_over(shape, *args, **kwargs):
        made = real(shape, *args, **kwargs)
        if made.shape == (2 * len(t), 2) and made.dtype == float:
            made[:] = np.array([1.0, -1.0])[:, None].repeat(len(t), axis=0) * 1.7e308
        return made

    monkeypatch.setattr(np, "empty", left_over)
    x, u = np.ones((6, 5, case.loop.plant.tanks)), np.ones((6, 5, case.loop.plant.pumps))
    picture = MovingFan(case.loop, t, np.ones((5, len(case.loop.plant.outputs))), x, u)
    for _, _, panel in picture.panels:
        assert np.abs(panel.ax.dataLim.get_points()).max() < 1e3


def test_a_pump_without_limits_is_drawn_without_them(case):
    """Its limits are numbers so large that a picture cannot hold them."""
    wide = jaxtank.with_values(case.loop, {"actuator.low": [-1e300], "actuator.high": [1e300]})
    t, ones = np.arange(3.0), np.ones((6, 3, 2))
    fan = MovingFan(wide, t, np.ones((3, 1)), ones, ones[:, :, :1])
    fan.draw(ones, 2.0 * ones[:, :, :1], [0.0, 0.0])
    low, high = fan.panels[-1][2].ax.get_ylim()
    assert 0.0 < low < high < 3.0


def test_elsewhere_it_is_the_page():
    case = presets.find("cascaded/pi")  # whose engine other tests of this process may have kept
    assert isinstance(case.explore(plants=4), LivePage)


def test_sliders_move_the_plants(case, monkeypatch):
    pytest.importorskip("ipywidgets")
    monkeypatch.setattr(live_figure, "in_notebook", lambda: True)
    figure = case.explore(free={"controller.Kc": (0.1, 2.0)}, plants=4)
    slider = figure.sliders["controller.Kc[0]"]
    before = figure.image.value
    # the value of the case is a position of the slider: a browser would move it there
    places = (np.log10(slider.value) - slider.min) / slider.step
    assert places == pytest.approx(round(places), abs=1e-9) and 100 < places < 300
    slider.value = 0.5
    assert figure.moved.values == {"controller.Kc[0]": pytest.approx(0.5)}
    assert figure.image.value == figure.png != before and "10 % more" in figure.text.value
    slider.value = slider.base**slider.max  # the end, which rounding puts beyond it
    assert figure.moved.values["controller.Kc[0]"] == pytest.approx(2.0)
    figure.move({"controller.Kc[0]": 0.4})
    assert slider.value == pytest.approx(0.4) and figure.fan.program._cache_size() == 1
    bundle = figure._repr_mimebundle_()
    assert {"application/vnd.jupyter.widget-view+json", "image/png"} <= set(bundle)


def test_a_long_run_takes_a_longer_step_and_names_it():
    found = Fan(presets.find("gouta2015/backstepping"), plants=200)
    assert found.case.clock.dt == 0.1 and found.given.clock.dt == 0.01
    with jax.enable_x64(True):
        assert found.start == {"controller.k": 0.03, "controller.k1": 0.088}


def test_a_picture_is_saved_whole_or_refused(fan, tmp_path):
    figure = LiveFigure(fan, widgets=False)
    assert figure.save(tmp_path / "fan.svg").read_text().count("<svg") == 1
    with pytest.raises(InputError, match="must end in"):
        figure.save(tmp_path / "fan.jpg")
