"""`jaxtank.notebook()`: precision, style and resolution, and small pictures below results."""

import base64
import io
import re

import jax
import matplotlib.pyplot as plt
import numpy as np
import pytest
from PIL import Image

import jaxtank
import tuning
from jaxtank import presets
from jaxtank.core import text
from jaxtank.core.errors import InputError
from jaxtank.plots.style import STYLE


@pytest.fixture
def restored():
    """Settings of this process as they were."""
    style, pictures = dict(STYLE), text.PICTURES[0]
    precision = jax.config.jax_enable_x64
    with plt.rc_context():
        yield
    STYLE.clear()
    STYLE.update(style)
    text.PICTURES[0] = pictures
    jax.config.update("jax_enable_x64", precision)


def pictures_of(page):
    """The pictures of a fragment of HTML, decoded."""
    found = re.findall(r'src="data:image/png;base64,([^"]+)"', page)
    return [Image.open(io.BytesIO(base64.b64decode(one))) for one in found]


def test_one_call_sets_precision_style_and_resolution(restored):
    jaxtank.notebook(dpi=75)
    assert jax.config.jax_enable_x64 and plt.rcParams["figure.dpi"] == 75
    assert plt.rcParams["axes.spines.top"] is False
    figure = presets.find("cascaded/pi").plot()["rig"]
    assert figure.dpi == 75
    plt.close(figure)


@pytest.mark.slow
def test_a_case_a_run_and_a_study_have_one_small_picture_each(restored):
    case = presets.find("cascaded/pi")
    clock = jaxtank.Clock(dt=4.0, duration=80.0)
    run = jaxtank.simulate(case.loop, clock)
    study = tuning.ensemble(
        case.replace(clock=clock), {"plant.drain": 0.05}, samples=4, measures=["max_level"]
    )
    assert [pictures_of(v._repr_html_()) for v in (case, run, study)] == [[], [], []]
    jaxtank.notebook()
    before = plt.get_fignums()  # of other tests
    for shown in (case, run, study):
        page = shown._repr_html_()
        (picture,) = pictures_of(page)
        assert "<table" in page and 200 < picture.width < 700 and len(page) < 150_000
        assert np.ptp(np.asarray(picture.convert("L"))) > 100  # not blank
    assert plt.get_fignums() == before


def test_numbers_are_shown_where_a_picture_fails(restored, monkeypatch):
    case = presets.find("cascaded/pi")
    jaxtank.notebook()
    monkeypatch.setattr("jaxtank.plots.run.small", lambda _: 1 / 0)
    page = case._repr_html_()
    assert "<table" in page and "no picture: division by zero" in page


@pytest.mark.parametrize("dpi", [0, 1000, 90.5, True])
def test_a_resolution_that_is_none_is_refused(dpi):
    with pytest.raises(InputError, match="dpi"):
        jaxtank.notebook(dpi=dpi)
