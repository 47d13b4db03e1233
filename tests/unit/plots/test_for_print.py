"""Figures for journals: widths in inches, 300 dpi, letters without LaTeX, the same bytes twice."""

import io
import re

import matplotlib.pyplot as plt
import numpy as np
import pytest
from helpers import command
from PIL import Image

import jaxtank
from jaxtank import presets
from jaxtank.core.errors import InputError
from jaxtank.plots import responses, style, uncertainty
from jaxtank.plots.run import for_journal, save_for_print


@pytest.fixture(scope="module")
def run():
    loop = presets.find("cascaded/pi").loop
    return loop, jaxtank.simulate(loop, jaxtank.Clock(dt=4.0, duration=400.0, substeps=4))


def drawn(run, columns):
    with style.for_print(columns):
        return {"run": responses.responses(run[0], {"PI": run[1]}, "a title")}


@pytest.mark.extended
@pytest.mark.slow_for("1-3.5")
@pytest.mark.parametrize(("columns", "inches"), [(1, 3.5), (2, 7.16)])
def test_a_figure_is_as_wide_as_the_columns_at_300_dpi(run, columns, inches):
    files = for_journal(drawn(run, columns), columns)
    picture = Image.open(io.BytesIO(files["run.png"]))
    assert picture.width == pytest.approx(300 * inches, abs=1) and picture.height <= 2700
    assert picture.info["dpi"][0] == pytest.approx(300, abs=0.1)
    width = re.search(r'width="([\d.]+)pt"', files["run.svg"].decode())[1]
    assert float(width) == pytest.approx(72 * inches, abs=0.1)


def test_letters_are_outlines_of_7_to_8_points_and_there_is_no_title(run):
    figure = drawn(run, 1)["run"]
    texts = [t for ax in figure.axes for t in (ax.title, ax.yaxis.label, *ax.get_xticklabels())]
    assert {t.get_fontsize() for t in texts} <= {7.5, 8.0}
    assert {t.get_fontname() for t in texts} == {"STIXGeneral"}
    assert "a title" not in figure._suptitle.get_text()
    assert len({ax.get_position().x0.round(3) for ax in figure.axes}) == 1  # one panel a row
    svg = for_journal({"run": figure}, 1)["run.svg"].decode()
    assert "<text" not in svg and not plt.rcParams["text.usetex"]


@pytest.mark.slow
def test_the_same_figure_gives_the_same_bytes_and_settings_are_taken_back(run):
    before = plt.rcParams["font.family"], plt.rcParams["savefig.dpi"]
    assert for_journal(drawn(run, 2), 2) == for_journal(drawn(run, 2), 2)
    assert (plt.rcParams["font.family"], plt.rcParams["savefig.dpi"]) == before
    assert not style.printing() and style.width(5.0) == 5.0


def test_a_fan_for_one_column_has_its_tanks_below_each_other():
    bands = {"t": np.arange(3.0), "r": np.ones((3, 1)), "x": np.ones((5, 3, 2))}
    with style.for_print(1):
        figure = uncertainty.fan(presets.find("cascaded/pi").loop, bands, "many runs")
    first, second = (ax.get_position() for ax in figure.axes)
    assert figure.get_size_inches()[0] == 3.5 and first.y0 > second.y1
    plt.close(figure)


@pytest.mark.parametrize("columns", [0, 3, True, "1"])
def test_another_number_of_columns_is_refused(columns, tmp_path):
    with pytest.raises(InputError, match="1 or 2 columns"):
        save_for_print({}, tmp_path / "figures", columns)
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_the_command_writes_both_files(tmp_path):
    asked = ["simulate", "cascaded/pi", "--set", "clock.duration=400", "--quiet", "--columns", "1"]
    found = command(*asked)
    assert found.code == 2 and "--columns needs --out DIR" in found.err
    assert command(*asked, "--out", str(tmp_path / "out")).code == 0
    assert Image.open(tmp_path / "out" / "print.png").width == 1050
    assert (tmp_path / "out" / "print.svg").read_text().startswith("<?xml")
