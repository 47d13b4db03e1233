"""Moving pictures: how many, how large, and that they show the run that they are of."""

import dataclasses
import io
from types import SimpleNamespace

import matplotlib.image
import numpy as np
import pytest
from matplotlib.colors import to_rgb
from PIL import Image

import jaxtank
from jaxtank.core.errors import InputError
from jaxtank.plants import network
from jaxtank.plots import animation, style
from tuning.report import simulated


@pytest.fixture(scope="module")
def short(gouta):
    case = gouta("backstepping", {"clock.duration": 120, "clock.dt": 0.5})
    return case.loop, jaxtank.simulate(case.loop, case.clock, save_every=4)


@pytest.fixture(autouse=True)
def few_pictures(monkeypatch):
    monkeypatch.setattr(animation, "RATE", 4)


def frames(path):
    with Image.open(path) as film:
        for k in range(film.n_frames):
            film.seek(k)
            yield np.asarray(film.convert("RGB"), dtype=float) / 255


def blue(picture):
    """Pixels in the colour of water."""
    return np.count_nonzero(np.abs(picture - to_rgb(style.WATER)).max(axis=2) < 0.03)


def test_the_tanks_of_the_gif_hold_what_the_run_says(short, tmp_path):
    loop, run = short
    path = animation.animate(loop, run, tmp_path / "run.gif", seconds=1)
    assert [p.name for p in tmp_path.iterdir()] == ["run.gif"]
    seen = np.array([blue(f) for f in frames(path)])
    assert len(seen) == animation.RATE
    # tanks of one size; in between rows the one before is shown
    times = np.linspace(0.0, run.t[-1], len(seen))
    rows = np.searchsorted(run.t, times + 1e-6, side="right") - 1
    stored = np.asarray(run.x)[rows].sum(axis=1)
    # a straight line: what is not the tanks' water (none) plus pixels per cm; edges and words cost
    # some
    slope = np.polyfit(stored, seen, 1)
    assert stored[-1] > 2 * stored[0] and slope[0] > 0
    assert np.abs(np.polyval(slope, stored) - seen).max() < 0.05 * np.ptp(seen)


@pytest.mark.slow
def test_two_rigs_stand_beside_each_other_and_the_shorter_run_stays_at_its_end(short):
    loop, run = short
    other = jaxtank.presets.find("cascaded/pi").loop
    brief = jaxtank.simulate(other, jaxtank.Clock(dt=4.0, duration=40.0, substeps=4))
    one, _ = animation.film(loop, run, 1)
    two, still = animation.film(loop, run, 1, (other, brief), ("four $tanks", "two <tanks>"))
    sizes = [Image.open(io.BytesIO(data)).size for data in (one, two)]
    assert sizes[1][0] > 1.5 * sizes[0][0]
    # two of them in a row
    assert Image.open(io.BytesIO(still)).size == (2 * sizes[1][0], 2 * sizes[1][1])


@pytest.mark.extended
def test_liquid_above_a_rim_is_in_the_film_and_a_rig_of_many_tanks_is_refused(short, tmp_path):
    loop, run = short
    high = run.replace(x=np.where(np.arange(4) == 3, 48.0, run.x))
    path = animation.animate(loop, high, tmp_path / "run.gif", seconds=1)
    first = next(frames(path))
    pink = np.count_nonzero(np.abs(first - to_rgb(style.RIM)).max(axis=2) < 0.06)
    dry = animation.animate(loop, run, tmp_path / "dry.gif", seconds=1)
    none = np.count_nonzero(np.abs(next(frames(dry)) - to_rgb(style.RIM)).max(axis=2) < 0.06)
    assert pink > 200 and none < 0.05 * pink
    many = network(area=np.full(30, 15.0), drain=0.1, pump_gain=5.0, feeds=[(0, None)], rim=20.0)
    with pytest.raises(InputError, match="at most 24 tanks"):
        animation.animate(dataclasses.replace(loop, plant=many), run, tmp_path / "many.gif")


@pytest.mark.parametrize("seconds", [0, 61, "6"])
def test_a_length_that_no_film_can_have_is_refused(short, tmp_path, seconds):
    with pytest.raises(InputError, match="1 to 60 s"):
        animation.animate(*short, tmp_path / "run.gif", seconds=seconds)
    assert not list(tmp_path.iterdir())


def test_what_is_no_gif_or_another_rig_is_refused(short, tmp_path):
    with pytest.raises(InputError, match="end in"):
        animation.animate(*short, tmp_path / "run.mp4")
    other = jaxtank.presets.find("gouta2022/enmpc").loop
    with pytest.raises(InputError, match="the rig has 2 and 2"):
        animation.animate(other, short[1], tmp_path / "run.gif")


@pytest.mark.slow
def test_simulate_writes_one_where_asked(tmp_path, capsys):
    from tuning.cli import main

    asked = ["simulate", "gouta2015/backstepping", "--set", "clock.duration=60", "--gif"]
    asked += ["--dt", "0.1"]
    assert main.main(asked) == 2 and "--out DIR" in capsys.readouterr().err
    asked += ["--out", str(tmp_path / "out"), "--quiet"]
    assert main.main(asked) == 0
    alone = matplotlib.image.imread(tmp_path / "out" / "run.gif").shape
    assert main.main([*asked, "--against", "cascaded/pi"]) == 0
    assert matplotlib.image.imread(tmp_path / "out" / "run.gif").shape[1] > 1.5 * alone[1]
    assert matplotlib.image.imread(tmp_path / "out" / "film.png").size > 0


def test_titles_of_a_film_mention_the_safety_filter_where_one_rig_has_it():
    case = lambda safety: SimpleNamespace(name="a/b", loop=SimpleNamespace(safety_filter=safety))
    assert simulated._titles([case(None), case(1)]) == ("a/b", "a/b, safety filter")
    assert simulated._titles([case(1), case(1)]) == ("a/b", "a/b")
    assert simulated._titles([case(None)]) == ("a/b",)
