"""The picture of a validation: every plant is counted once, levels and limits where they are."""

import dataclasses
from types import SimpleNamespace

import matplotlib.pyplot as plt
import numpy as np
import pytest
from matplotlib.colors import to_hex

from jaxtank.plots import style
from tuning.search.judged import Judged, drawn


@pytest.fixture
def judged():
    """40 plants of two tanks, one of which diverged; the limit of tank 2 is 30 cm."""
    rng = np.random.default_rng(0)
    zeros, failed = np.zeros(40), np.zeros(40, dtype=bool)
    failed[7] = True
    level = np.column_stack([rng.uniform(10.0, 12.0, 40), rng.uniform(20.0, 33.0, 40)])
    level[7] = np.nan
    return Judged(
        cost=zeros, error=np.where(failed, np.nan, rng.uniform(1.0, 2.0, 40)), level=level,
        travel=zeros, held=level[:, 1] < 30.0, failed=failed, infeasible=None,
        limits=[SimpleNamespace(measure="max_level", index=1, value=30.0)], measures={}, unit="cm",
    )  # fmt: skip


def test_each_plant_that_did_not_diverge_is_counted_once(judged):
    (figure,) = judged.plot().values()
    left, right = figure.axes
    assert sum(bar.get_height() for bar in left.patches) == 39
    assert left.get_ylabel() == "plants of 39" and "[cm]" in left.get_xlabel()
    highest = np.nanmax(judged.level, axis=0)
    (dots,) = [line for line in right.lines if line.get_marker() == "o"]
    np.testing.assert_allclose(dots.get_ydata(), highest)
    lines = {to_hex(c.get_color()[0]): c for c in right.collections}
    ends = lines[style.RIM.lower()].get_segments()
    assert len(ends) == 1 and ends[0].tolist() == [[1.6, 30.0], [2.4, 30.0]]  # of tank 2 alone
    plt.close(figure)


def test_before_and_after_have_the_colours_of_their_roles(judged):
    (figure,) = drawn({"before": judged, "after": judged}).values()
    colours = {to_hex(p.get_facecolor()) for p in figure.axes[0].patches}
    assert colours == {style.PUBLISHED.lower(), style.TUNED.lower()}
    plt.close(figure)


def test_nothing_is_drawn_where_every_plant_diverged(judged):
    assert dataclasses.replace(judged, failed=np.ones(40, dtype=bool)).plot() == {}
