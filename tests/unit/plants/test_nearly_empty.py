"""Pumps that draw from a tank which holds less than they take in a step."""

import numpy as np
import pytest

import jaxtank
from jaxtank import rig

SUMP = """
units = ["m", "m^3/h"]
dt = 5.0
duration = "20 min"
tank = [{ name = "SUMP", area = 0.1, rim = 2.0, level = LEVEL },
    { name = "T2", area = 10.0, rim = 2.0, level = 0.2 }]
pump = [{ name = "P1", to = "SUMP", high = 10.0, initial = 9.0 },
    { name = "P2", from = "SUMP", to = "T2", high = 10.0, initial = 9.0 }]
controller = { kind = "open-loop" }
inputs = { initial = [9.0, TAKEN] }
"""


def end(level, taken):
    text = SUMP.replace("LEVEL", str(level)).replace("TAKEN", str(taken))
    case = rig.loads(text)
    x = np.asarray(jaxtank.simulate(case.loop, case.clock).x)
    assert np.all(x >= -1e-12)
    return x[-1]


def test_a_pump_passes_on_what_a_low_sump_gets():
    """9 m^3/h in and out: the level stays, though a step takes 0.125 m of it."""
    np.testing.assert_allclose(end(0.1, 9.0), [0.1, 0.2 + 9.0 / 3600 * 1200 / 10.0], rtol=1e-9)


@pytest.mark.parametrize("taken", [9.5, 10.0])
def test_a_pump_that_wants_more_gets_what_arrives(taken):
    """The sump is empty in the end, and all that came and was there is in the other tank."""
    empty, full = end(0.1, taken)
    assert empty == pytest.approx(0.0, abs=1e-12)
    assert full == pytest.approx(0.2 + (0.1 * 0.1 + 9.0 / 3600 * 1200) / 10.0, rel=1e-9)
