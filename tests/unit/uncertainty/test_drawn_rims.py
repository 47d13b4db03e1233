"""Limits at rims that are uncertain: those of each plant."""

import numpy as np
import pytest

import tuning
from jaxtank import rig

RIG = """
units = ["cm", "V"]
tank = [{ area = 100.0, rim = 20.0, drain = 0.6, level = 12.0 }]
pump = [{ to = 1, gain = 30.0, high = 10.0, initial = 3.0 }]
controller = { kind = "pi", Kc = [1.5], Ti = [10.0] }
reference = { initial = [12.0] }
limits = { max_level = "rim" }
values = { "clock.dt" = 0.5, "clock.duration" = 20.0 }
"""
RIMS = {"plant.rim": tuning.Uniform(low=10.0, high=14.0)}


def test_each_plant_is_judged_by_its_own_rim():
    study = tuning.ensemble(rig.loads(RIG), RIMS, samples=200, promise=0.01)
    above = np.max(study.measures["max_level"], axis=1) > np.ravel(study.values["plant.rim"])
    assert 60 < above.sum() < 140
    assert np.array_equal(~study.held, above)
    assert study.promise.answer == "not kept"
    assert study.promise.probability == pytest.approx(0.5, abs=0.12)


@pytest.mark.parametrize("overflow", ["", "plant = { overflow = true }"])
def test_a_limit_above_a_drawn_rim_does_not_let_that_plant_overflow(overflow):
    case = rig.loads(RIG.replace('"rim"', "[19.0]") + overflow)
    study = tuning.ensemble(case, RIMS, samples=100)
    rim = np.ravel(study.values["plant.rim"])
    clear = np.abs(rim - 12.0) > 0.1  # where the level starts
    assert 20 < np.sum(clear & (rim < 12.0)) < 80
    np.testing.assert_array_equal(~study.held[clear], rim[clear] < 12.0)
