"""What the page of an ensemble says, beside numbers worked out from its draws."""

import dataclasses

import numpy as np
import pytest

import tuning
from jaxtank import presets, rig

SHORT = {"clock.dt": 1.0, "clock.duration": 200.0}
OPTIONS = {"key": 0, "fan": False}


@pytest.fixture(scope="module")
def case():
    return rig.set_values(presets.load("cascaded").cases["pi"], SHORT)


def row(page, label):
    """The cells of one row of the table of measures: unit, mean, its interval, sd, ..."""
    line = next(line for line in page.splitlines() if line.startswith(label))
    return [cell.strip() for cell in line.removeprefix(label).split("  ") if cell.strip()]


def test_a_single_draw_is_told_without_a_spread(case):
    """The rig has two tanks: a measure of several entries has no spread either."""
    one = tuning.ensemble(case, samples=1, **OPTIONS)
    page = repr(one)
    for tank in (0, 1):
        unit, mean, interval, sd, *others = row(page, f"max_level of tank {tank + 1}")
        assert interval == sd == "-" and {mean, *others} == {f"{one.measures['max_level'][0, tank]:.4g}"} and unit == "V"
    assert "one run has no spread" in page


@pytest.mark.parametrize("failed, words", [([True, False], "one run has no spread"), ([True, True], "no run is left")])
def test_runs_that_left_the_numbers_leave_no_spread(case, failed, words):
    two = dataclasses.replace(tuning.ensemble(case, samples=2, **OPTIONS), failed=np.array(failed))
    page = repr(two)
    assert words in page
    for tank in (1, 2):
        assert row(page, f"max_level of tank {tank}")[2:4] == ["-", "-"]


def test_two_draws_have_a_spread(case):
    assert "spread:" not in repr(tuning.ensemble(case, samples=2, **OPTIONS))
