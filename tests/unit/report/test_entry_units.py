"""Units of measures whose entries are inputs of different kinds."""

import numpy as np
import pytest

from jaxtank import measures, rig
from tuning.report.tables import measure_table, units

RIG = """
units = ["m", "m^3/h"]
tank = [{ area = 0.5, rim = 1.0, level = 0.4 }, { area = 0.5, rim = 1.0, level = 0.4 }]
pump = [{ to = 1, high = 10.0 }]
valve = [{ from = 2, area = 1e-4 }]
orifice = [{ from = 1, to = 2, area = 1e-4 }]
plant = { outputs = [1, 2] }
controller = { kind = "pi", Kc = [2.0, -1.0], Ti = 300.0 }
"""


def test_the_input_of_a_valve_has_no_unit_beside_that_of_a_pump():
    plant = rig.loads(RIG).loop.plant
    assert units(plant)["rms_input"] == ["m^3/h", "-"]
    assert units(plant)["mean_square_travel"] == ["(m^3/h)^2", "-"]
    assert units(plant)["input_deviation"] == ["(m^3/h)^2 s", "s"]
    assert units(plant)["max_level"] == "m" and units(plant)["saturated_fraction"] == "-"
    table = measure_table({"rms_input": np.array([1.0, 0.5])}, plant)
    assert "[m^3/h, -]" in table.rows[0][0]


@pytest.mark.extended
def test_a_valve_in_percent_has_the_unit_of_a_pump_in_percent():
    text = RIG.replace('["m", "m^3/h"]', '["m", "%"]').replace(
        "to = 1, high", "gain = 1e-4, to = 1, high"
    )
    assert measures.entry_units("rms_input", rig.loads(text).loop.plant) == "%"
