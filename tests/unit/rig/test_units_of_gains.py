"""Units of gains and inputs where valves, whose openings have none, are what a controller moves."""

import pytest

from jaxtank import rig
from jaxtank.core.errors import InputError
from jaxtank.core.labels import signal_units, units_of_inputs
from jaxtank.core.tree import describe, get_value


def tank(controller, units=("m", "m^3/h"), pump=""):
    """A tank with an outlet valve, and with a second tank that a pump fills."""
    second = '{ name = "B", area = 2.0, rim = 3.0, level = 1.5, drain = "15 cm^2" }' if pump else ""
    return rig.loads(f"""
    units = ["{units[0]}", "{units[1]}"]
    dt = 2.0
    duration = 600.0
    tank = [{{ name = "A", area = 2.0, rim = 3.0, level = 1.5, inflow = "12 m3/h" }}, {second}]
    valve = [{{ name = "V", from = "A", area = "15 cm^2" }}]
    {pump}
    sensor = [{{ tank = "A", span = [0.0, 3.0] }}]
    controller = {{ {controller} }}
    """)


PUMP = """pump = [{ name = "P", to = "B", gain = 0.0002777777777777778, high = 40.0 }]
    plant = { outputs = ["B", "A"] }"""


@pytest.mark.extended_for("-1.0--1.0")
@pytest.mark.parametrize(
    ("text", "number"),
    [("-1.0", -1.0), ('"-1 1/m"', -1.0), ('"-0.02 1/cm"', -2.0), ('"-50 %/m"', -0.5)]
    + [('"-2 %/%"', -2.0 / 3.0)],
)
def test_a_gain_of_a_valve_alone_is_an_opening_per_level(text, number):
    case = tank(f'kind = "pi", Kc = {text}, Ti = "10 min"')
    assert get_value(case.loop, "controller.Kc") == pytest.approx([number])
    units = [describe(case.loop, f"controller.{name}")["unit"] for name in ("Kc", "Kc[0]", "bias")]
    assert units == ["1/m", "1/m", "-"]
    assert "[1/m] gain Kc" in rig.dump(case)
    again = rig.loads(rig.dump(case))
    assert get_value(again.loop, "controller.Kc") == pytest.approx([number])


def test_a_gain_of_a_valve_is_in_no_unit_of_a_pump():
    with pytest.raises(InputError, match=r"must be in 1/m, or"):
        tank('kind = "pi", Kc = "-1 (m^3/h)/m", Ti = "10 min"')


@pytest.mark.extended
def test_inputs_in_percent_include_valves():
    case = tank('kind = "pi", Kc = -100.0, Ti = "10 min"', units=("m", "%"))
    assert describe(case.loop, "controller.Kc")["unit"] == "%/m"
    assert units_of_inputs(case.loop.plant) == "%"


@pytest.mark.extended
def test_beside_a_pump_each_gain_has_the_unit_of_its_own_input():
    case = tank('kind = "pi", Kc = [20.0, -1.0], Ti = [600.0, 600.0]', pump=PUMP)
    unit = lambda name: describe(case.loop, f"controller.{name}")["unit"]
    assert [unit("Kc[0]"), unit("Kc[1]")] == ["(m^3/h)/m", "1/m"]
    assert [unit("bias[0]"), unit("bias[1]")] == ["m^3/h", "-"]
    assert units_of_inputs(case.loop.plant) == "m^3/h, -"
    assert signal_units(case.loop.plant, case.loop.units) == ["m", "m^3/h", "-"]


@pytest.mark.extended
def test_the_inner_loop_of_a_cascade_moves_the_valve():
    case = rig.loads("""
    units = ["m", "m^3/h"]
    dt = 2.0
    duration = 600.0
    tank = [
     { name = "A", area = 2.0, rim = 3.0, level = 0.6, inflow = "12 m3/h", drain = "5 cm^2" },
     { name = "B", area = 2.0, rim = 3.0, level = 0.3, drain = "6 cm^2" }]
    valve = [{ name = "V", from = "A", to = "B", area = "15 cm^2" }]
    plant = { outputs = ["B"] }
    controller = { kind = "cascade", inner = ["A"], Kc = 1.0, inner_Kc = -1.0, inner_bias = 0.4 }
    """)
    names = ("Kc", "bias", "inner_Kc", "inner_bias")
    units = [describe(case.loop, f"controller.{name}")["unit"] for name in names]
    assert units == ["-", "m", "1/m", "-"]


TWO_PUMPS = """
units = ["m", "m^3/h"]
tank = [
    { name = "A", area = 0.5, rim = 2.0, level = 1.0, drain = "4 cm^2" },
    { name = "B", area = 0.3, rim = 2.0, level = 0.8, drain = "3 cm^2" },
]
pump = [
    { name = "P2", to = "B", high = 9.0 }, { name = "P1", to = "A", high = 15.0 },
    { name = "P3", to = "A", high = 10.0 },
]
plant = { outputs = ["A", "B"] }
"""


@pytest.mark.parametrize("entry", ["A", "P1"])
def test_a_gain_is_called_by_the_pump_that_its_loop_moves(entry):
    loops = 'controller = { kind = "pi", lead = ["P1", "P2"], Kc = [5.0, 3.0], Ti = 60.0 }'
    case = rig.loads(TWO_PUMPS + loops)
    changed = rig.set_values(case, {f"controller.Kc[{entry}]": 0.77})
    assert changed.loop.controller.Kc.tolist() == [0.77, 3.0]
    with pytest.raises(InputError, match="no loop moves P3"):
        rig.set_values(case, {"controller.Kc[P3]": 0.77})


@pytest.mark.parametrize(
    ("span", "of_loop"), [("", (25.0, 9.0)), ("span = [50, 70, 30],", (100, 50))]
)
def test_a_gain_in_percent_of_a_split_range_is_of_what_its_inputs_take(span, of_loop):
    """2 % of the range of the loop's output for each % of the 2 m that a sensor spans."""
    sequence = 'sequence = [["P1", "P3"], ["P2"]]'
    loops = f'controller = {{ kind = "split-range", {sequence}, {span} Kc = "2 %/%", Ti = 60.0 }}'
    case = rig.loads(TWO_PUMPS + loops)
    expected = pytest.approx([2.0 * size / 2.0 for size in of_loop])
    assert case.loop.controller.Kc.tolist() == expected
    again = rig.set_values(case, {"controller.Kc": "2 %/%"})
    assert again.loop.controller.Kc.tolist() == expected
