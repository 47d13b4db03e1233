"""What is proved is proved of the box that the case states, and of the filter in its loop."""

import dataclasses

import numpy as np
import pytest
from helpers import command

import jaxtank
import tuning
from jaxtank import presets, rig
from jaxtank.core.errors import InputError
from jaxtank.safety.of_case import certificates_of
from tuning.report.safety import certificates

TANKS = """
name = "two"
tank = [
    { area = 50.0, rim = 20.0, drain = 0.6, level = 5.0 },
    { area = 50.0, rim = 20.0, drain = 0.6, level = 5.0 },
]
pump = [
    { gain = 20.0, to = 1, low = 0.0, high = 20.0, initial = 0.0 },
    { gain = 20.0, to = 2, low = 0.0, high = 20.0, initial = 0.0 },
]
plant = { outputs = [1, 2] }
law = { kind = "pid", Kc = [1.0, 1.0], Ti = [50.0, 50.0], Tt = [20.0, 20.0] }
reference = { initial = [5.0, 5.0], changes = [[1.0, 1, 30.0], [1.0, 2, 30.0]], ramp = 0.0 }
values = { "clock.dt" = 0.5, "clock.duration" = 100.0 }
reachable = false
"""
COVARIANCE = """
uncertain = { "plant.drain[1]" = 0.3, "plant.pump_gain" = 0.3 }
covariance = { names = ["plant.drain[0]"], matrix = [[1e-8]] }
safety_filter = {}
"""
NARROW = """
uncertain = { "plant.drain" = 0.3, "plant.pump_gain" = 0.3 }
safety_filter = { widths = { "plant.drain" = 0.001 } }
"""


def test_the_box_is_that_of_the_covariance_and_of_the_spreads_beside_it():
    """With the extreme plant of the spreads in the loop, the level passes no proved limit."""
    case = rig.loads(TANKS + COVARIANCE)
    least, most = case.loop.safety_filter.least, case.loop.safety_filter.most
    np.testing.assert_allclose(least.drain[1], 0.7 * 0.6)
    np.testing.assert_allclose([least.pump_gain, most.pump_gain], [[14.0] * 2, [26.0] * 2])
    assert 0.0 < 0.6 - least.drain[0] < 0.001
    assert all(row["certified"] for row in certificates(case))
    plant = dataclasses.replace(
        case.loop.plant, drain=np.array([0.6, 0.45]), pump_gain=np.array([25.0, 25.0])
    )
    loop = dataclasses.replace(case.loop, plant=plant)
    highest = jaxtank.evaluate(loop, case.clock, ["max_level"])["max_level"]
    assert np.all(highest <= 20.0) and np.all(highest > 19.0)


@pytest.mark.parametrize("words", [("show",), ("attack", "--starts", "1")])
def test_widths_below_the_spreads_are_not_called_proved(words, tmp_path):
    path = tmp_path / "rig.toml"
    path.write_text(TANKS + NARROW)
    (row, _) = certificates(rig.loads(path.read_text()))
    assert not row["certified"] and row["starts"] is None
    assert row["why"].startswith("not covered: plant.drain, plant.pump_gain")
    result = command(words[0], str(path), *words[1:], "--json")
    assert "not covered: plant.drain, plant.pump_gain" in result.err
    if words == ("show",):
        assert [row["certified"] for row in result.json["safety_filter"]] == [False, False]


@pytest.mark.parametrize(
    "changes", [{"safety_filter.rate": np.array([30.0, 30.0])}, {"plant.pump_gain": [60.0, 60.0]}]
)
def test_a_filter_that_was_designed_for_another_rig_is_not_certified(changes):
    case = rig.loads(TANKS + "safety_filter = {}")
    assert all(row.certified for row in certificates_of(case))
    changed = case.replace(loop=jaxtank.with_values(case.loop, changes))
    assert not any(row.certified for row in certificates_of(changed))
    assert all("not designed for this rig" in row["why"] for row in certificates(changed))


def test_numbers_of_the_filter_are_not_tuned():
    case = presets.find("cascaded/pi").with_safety_filter()
    with pytest.raises(InputError, match=r"safety_filter\.rate: .* \[safety_filter\]"):
        tuning.Problem(case, free={"safety_filter.rate": (0.1, 1.0)})
