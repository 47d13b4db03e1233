"""What is known of a measure stands in its entry of the catalogue: reports, limits and studies read
it there.
"""

import dataclasses

import numpy as np
import pytest

import tuning
from jaxtank import measures as ms
from jaxtank import presets
from jaxtank.core.errors import InputError
from jaxtank.measures.catalogue import Measure
from tuning.problem.limits import Limit
from tuning.report.tables import reasons
from tuning.uncertainty.sensitivity_study import check_measures

MINE = Measure(
    "cm",
    "tank",
    ("min_level",),
    ms.MEASURES["min_level"].read,
    "lowest level, again",
    sense=-1.0,
    counts=True,
    summary=65,
    shown=45,
    reached="time_of_min_level",
    undefined="no reason of its own",
)


@pytest.fixture
def with_mine(monkeypatch):
    """A measure added from outside the packages: one entry of one table."""
    monkeypatch.setitem(ms.MEASURES, "mine", MINE)
    return "mine"


def test_a_limit_of_a_measure_added_from_outside_has_the_side_that_the_measure_names(with_mine):
    low, high = Limit(with_mine, 0, 2.0), Limit("max_level", 0, 2.0)
    assert [limit.margins([3.0])[0] for limit in (low, high)] == [1.0, -1.0]
    assert Limit("settling_time", 0, 2.0).margins([np.nan])[0] > 0.0  # it never left its band
    assert low.margins([np.nan])[0] < 0.0


def test_a_measure_added_from_outside_is_listed_where_it_asks_to_be(with_mine):
    summary, shown = ms.placed("summary"), ms.placed("shown")
    assert summary[summary.index(with_mine) - 1] == "max_level"
    assert shown[shown.index(with_mine) - 1] == "max_level"


def test_a_settling_time_that_is_none_has_the_one_cause_that_applies():
    outside, inside = (
        reasons({"settling_time": [v, v]})["settling_time"] for v in (np.inf, np.nan)
    )
    assert "the run ended" in outside and "took the output out of its band" in inside
    both = reasons({"settling_time": [np.inf, 2.0, np.nan]})["settling_time"]
    assert both == f"output 1: {outside}, output 3: {inside}"
    assert "settling_time" not in reasons({"settling_time": [1.0, 2.0]})


def test_what_a_measure_added_from_outside_states_is_reported_and_enforced(with_mine):
    case = presets.find("cascaded/pi")
    assert reasons({with_mine: [np.nan, 1.0]})[with_mine] == "no reason of its own"
    with pytest.raises(InputError, match="counts whole samples"):
        check_measures(case, with_mine, "local")
    assert check_measures(case, with_mine, "morris") == (with_mine,)
    with pytest.raises(InputError, match="has no slope in every input"):
        tuning.bound(case, objective={with_mine: 1.0})


def test_an_ensemble_takes_the_worse_side_of_a_measure_added_from_outside(with_mine):
    case = presets.find("cascaded/pi")
    clock = dataclasses.replace(case.clock, duration=20.0 * case.clock.dt)
    found = tuning.ensemble(
        dataclasses.replace(case, clock=clock),
        samples=4,
        measures=[with_mine, "min_level"],
        limits={},
        fan=False,
    )
    summary = found.summary()
    np.testing.assert_array_equal(summary[with_mine]["cvar95"], summary["min_level"]["cvar95"])
    assert np.all(summary[with_mine]["cvar95"] <= summary[with_mine]["mean"])
