"""Moving pictures: how many, how large, and that they show the run that they are of."""

from html.parser import HTMLParser

import matplotlib.image
import numpy as np
import pytest
from matplotlib.colors import to_rgb
from PIL import Image

import jaxtank
from jaxtank.core.errors import InputError
from jaxtank.plots import animation, style


@pytest.fixture(scope="module")
def short(gouta):
    case = gouta("backstepping", {"clock.duration": 120, "clock.dt": 0.1})
    return case.loop, jaxtank.simulate(case.loop, case.clock, save_every=20)


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
    assert path.stat().st_size < 1_000_000 and [p.name for p in tmp_path.iterdir()] == ["run.gif"]
    seen = np.array([blue(f) for f in frames(path)])
    assert len(seen) == animation.RATE
    # tanks of one size
    stored = np.asarray(run.x)[np.linspace(0, len(run.t) - 1, len(seen)).round().astype(int)].sum(
        axis=1
    )
    # a straight line: what is not the tanks' water (none) plus pixels per cm; edges and words cost
    # some
    slope = np.polyfit(stored, seen, 1)
    assert stored[-1] > 2 * stored[0] and slope[0] > 0
    assert np.abs(np.polyval(slope, stored) - seen).max() < 0.05 * np.ptp(seen)


class Tags(HTMLParser):
    def __init__(self, page):
        super().__init__()
        self.found = []
        self.feed(page)

    def handle_starttag(self, tag, attrs):
        self.found.append((tag, dict(attrs)))


def test_the_fragment_for_notebooks_asks_nothing_of_the_network_and_is_the_same_twice(short):
    page = animation.to_html(*short, seconds=1)
    assert page == animation.to_html(*short, seconds=1)
    tags = Tags(page).found
    assert not any(
        tag == "link" or str(a.get("src", "")).startswith(("http", "//")) for tag, a in tags
    )
    assert "http" not in page and "fa-" not in page
    buttons = [a["title"] for tag, a in tags if tag == "button"]
    assert {"Play", "Pause", "Next frame"} <= set(buttons)
    assert page.count("data:image/png;base64") == animation.RATE and len(page) < 1_000_000


@pytest.mark.parametrize("seconds", [0, 61, "6", None])
def test_a_length_that_no_laminar_zone_can_have_is_refused(short, tmp_path, seconds):
    with pytest.raises(InputError, match="1 to 60 s"):
        animation.animate(*short, tmp_path / "run.gif", seconds=seconds)
    assert not list(tmp_path.iterdir())


def test_what_is_no_gif_or_another_rig_is_refused(short, tmp_path):
    with pytest.raises(InputError, match="end in"):
        animation.animate(*short, tmp_path / "run.mp4")
    with pytest.raises(InputError, match="the rig has 2 and 2"):
        animation.animate(
            jaxtank.presets.find("gouta2022/enmpc").loop, short[1], tmp_path / "run.gif"
        )


@pytest.mark.slow
def test_simulate_writes_one_where_asked(tmp_path, capsys):
    from tuning.cli import main

    asked = [
        "simulate",
        "gouta2015/backstepping",
        "--set",
        "clock.duration=60",
        "--dt",
        "0.1",
        "--gif",
    ]
    assert main.main(asked) == 2 and "--out DIR" in capsys.readouterr().err
    assert main.main([*asked, "--out", str(tmp_path / "out"), "--quiet"]) == 0
    assert matplotlib.image.imread(tmp_path / "out" / "run.gif").size > 0
