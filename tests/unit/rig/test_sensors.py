"""Sensors in % of a span and in mA, in a rig file: values against hand calculation."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import ONE_TANK, PROCESS

import jaxtank
from jaxtank import rig
from jaxtank.core.errors import InputError
from jaxtank.instruments.sensors import LevelSensor
from jaxtank.rig.components import ROLES

TEXT = """
units = ["m", "m^3/h"]
tank = [
    {{ name = "TK101", area = 0.5, rim = 1.2, level = "40 %", drain = "4 cm^2" }},
    {{ name = "TK102", area = 0.3, rim = 1.0, level = "12 mA" }},
]
pump = [{{ name = "P101", to = "LT101", low = 2.0, high = 10.0, initial = 4.0 }}]
valve = [{{ name = "FV102", from = "TK102", area = "3 cm^2", initial = 0.4 }}]
orifice = [{{ from = "TK101", to = "TK102", area = "1 cm^2" }}]
plant = {{ outputs = ["LT101", "LT102"] }}
reference = {{ initial = ["40 %", "50 %"], changes = [["5 min", "LT101", "60 %"]], ramp = 0.0 }}
controller = {{ kind = "pi", Kc = ["2 %/%", "-3 %/%"], Ti = "5 min", {more} }}
limits = {{ max_level = {{ LT101 = "90 %" }}, rms_error = "1 %" }}
values = {{ clock.dt = 5.0, clock.duration = 600.0 }}
free = {{ "controller.Kc[LT101]" = ["0.1 %/%", "10 %/%"] }}
[[sensor]]
name = "LT101"
tank = "TK101"
unit = "%"
span = [0.1, 1.1]
noise = "0.5 %"
[[sensor]]
name = "LT102"
tank = "TK102"
unit = "mA"
span = ["10 cm", "90 cm"]
"""


def case_of(more="Tt = 300.0"):
    return rig.loads(TEXT.format(more=more))


@pytest.mark.extended
def test_percent_and_milliampere_are_levels_of_the_span():
    case, loop = case_of(), case_of().loop
    np.testing.assert_allclose(loop.x0, [0.1 + 0.4 * 1.0, 0.1 + 0.5 * 0.8])
    np.testing.assert_allclose(loop.reference.initial, [0.5, 0.5])
    np.testing.assert_allclose(loop.reference.targets, [0.7])
    np.testing.assert_allclose(loop.sensor.noise, [0.005, 0.0])
    np.testing.assert_allclose(case.limits["max_level"], [1.0, 1.0])  # the other keeps its rim
    np.testing.assert_allclose(case.limits["rms_error"], [0.01, 0.008])


def test_a_gain_per_percent_moves_the_same_share_of_the_range():
    loop = case_of().loop
    # 1 % of 1 m is 0.01 m: 2 % of the pump's 8 m^3/h; 1 % of 0.8 m moves the valve by 3 %
    np.testing.assert_allclose(loop.controller.Kc, [2 * 0.08 / 0.01, -3 * 0.01 / 0.008])
    low, high, _ = case_of().free["controller.Kc[0]"]
    assert (low, high) == pytest.approx((0.8, 80.0))
    case = rig.set_values(case_of(), {"controller.Kc[LT101]": "1 m3/h/%", "LT101.level": "10 %"})
    assert case.loop.controller.Kc[0] == pytest.approx(100.0)
    assert case.loop.x0[0] == pytest.approx(0.2)


def test_the_loop_is_that_of_numbers_and_is_written_back():
    case = case_of()
    numbers = rig.loads(rig.dump(case))
    again = jaxtank.parameters(numbers.loop)
    for name, value in jaxtank.parameters(case.loop).items():
        np.testing.assert_array_equal(again[name], value)
    assert numbers.names == case.names and numbers.limits == case.limits
    assert rig.dump(numbers) == rig.dump(case)


def test_a_sensor_saturates_at_the_ends_of_its_span():
    sensor = LevelSensor(noise=[0.0, 0.0], low=[0.1, -np.inf], high=[1.1, np.inf])
    y = lambda h: np.array(sensor.read((h, h), None))
    np.testing.assert_allclose(y(0.5), [0.5, 0.5])
    np.testing.assert_allclose(y(0.02), [0.1, 0.02])
    np.testing.assert_allclose(y(1.4), [1.1, 1.4])
    slope = jax.jacfwd(lambda h: jnp.stack(sensor.read((h, h), None)))
    for h, expected in ((0.5, [1, 1]), (0.02, [0, 1]), (1.4, [0, 1])):
        np.testing.assert_array_equal(slope(h), expected)


def test_the_adc_of_a_sensor_with_a_span_divides_the_span():
    sensor = LevelSensor(noise=[0.0], low=[0.1], high=[1.1], bits=8, gain=[1.0], full_scale=1.0)
    h = np.linspace(0.0, 1.2, 601)
    y = np.asarray(sensor.read((h,), None)[0])
    inside = np.clip(h, 0.1, 1.1)
    np.testing.assert_allclose(y, 0.1 + np.round((inside - 0.1) * 256) / 256, atol=1e-12)


@pytest.mark.extended
def test_the_controller_does_not_see_a_level_above_the_span():
    case = case_of()
    loop = dataclasses.replace(case.loop, x0=np.array([1.15, 0.5]))
    loop = jaxtank.with_values(loop, {"sensor.noise": [0.0, 0.0]})
    run = jaxtank.simulate(loop, case.clock)
    above = np.asarray(run.x[:, 0]) > 1.1
    assert above.any()
    np.testing.assert_allclose(np.asarray(run.y[:, 0])[above], 1.1)


@pytest.mark.parametrize(
    "old, new, words",
    [
        ('"2 %/%", "-3 %/%"', "2.0, -3.0", ("LT101", "LT102", '"2 %/%"')),
        ('"40 %", "50 %"', "0.4, 50", ("0.4 %", "LT101", "50 %", "LT102")),
        ("[0.1, 1.1]", "[1.1, 0.1]", ("span", "below")),
        ('unit = "mA"', 'unit = "mV"', ("sensor 2", "mA")),
        ('tank = "TK102"', 'tank = "TK101"', ("sensors 1 and 2",)),
    ],
)
def test_what_is_ambiguous_or_wrong_is_refused_with_what_to_write(old, new, words):
    text = TEXT.format(more="Tt = 300.0")
    start = text.index("[[sensor]]") if old.startswith(("tank", "unit", "[")) else 0
    assert old in text[start:]
    with pytest.raises(InputError) as refusal:
        rig.loads(text[:start] + text[start:].replace(old, new))
    assert all(word in str(refusal.value) for word in words)


@pytest.mark.parametrize(
    "old, new, words",
    [
        ('"50 %"]', '"20 mA"]', ()),
        ('"50 %"]', '"22 mA"]', ("LT102", "1 m", "22 mA", "from 0 s", "0.1 to 0.9 m", "span")),
        ('"LT101", "60 %"', '"LT101", "-5 %"', ("LT101", "0.05 m", "from 300 s", "0.1 to 1.1 m")),
        ('"5 min", "LT101", "60 %"', '"11 min", "LT101", "150 %"', ()),  # after the run
    ],
)
def test_a_setpoint_that_a_sensor_cannot_read_is_refused(old, new, words):
    text = TEXT.format(more="Tt = 300.0")
    assert old in text
    if not words:
        rig.loads("reachable = false\n" + text.replace(old, new))
        return
    with pytest.raises(InputError) as refusal:
        rig.loads(text.replace(old, new))
    assert all(word in str(refusal.value) for word in words)


def test_one_sensor_table_is_for_all_tanks_of_a_preset():
    text = 'case = "cascaded/pi"\n[sensor]\nunit = "%"\nnoise = "1 %"\n'
    case = rig.loads(text + '[reference]\ninitial = ["50 %"]\nchanges = []\n')
    np.testing.assert_allclose(case.loop.sensor.noise, [0.1, 0.1])
    np.testing.assert_allclose(case.loop.sensor.high, [10.0, 10.0])
    np.testing.assert_allclose(case.loop.reference.initial, [5.0])
    again = rig.loads(rig.dump(case))
    np.testing.assert_array_equal(again.loop.sensor.low, case.loop.sensor.low)


def test_setpoints_of_a_file_are_in_percent_of_the_span(tmp_path):
    (tmp_path / "day.csv").write_text("t [s],LT101 [%],LT102 [mA]\n0,40,12\n100,60,20\n")
    text = TEXT.format(more="Tt = 300.0")
    line = next(line for line in text.splitlines() if line.startswith("reference"))
    table = f'reference = {{ csv = "{tmp_path}/day.csv", ramp = 0.0 }}'
    signal = rig.loads(text.replace(line, table)).loop.reference
    np.testing.assert_allclose(signal.initial, [0.5, 0.5])
    np.testing.assert_allclose(signal.targets, [0.7, 0.9])


def test_the_unit_of_a_reading_is_no_name(tmp_path):
    """A value is not set by it; a file that is written has levels in lengths, and the unit of the
    reading's column in a log.
    """
    case = rig.loads(
        'units = ["m", "%"]\ntank = [{ name = "T", area = 1.0, rim = 2.0, drain = 1e-3 }]'
        '\npump = [{ gain = 1e-4, to = "T", high = 100.0 }]\nsensor = [{ unit = "%" }]'
        '\ncontroller = { kind = "pi", Kc = "2 %/%", Ti = 9.0 }'
    )
    assert case.loop.sensor.display == ("%",) and "%" not in str(case.names)
    text = rig.dump(case)
    assert 'log_unit = "%"' in text and rig.loads(text).loop.sensor.display == ("%",)
    with pytest.raises(InputError, match="log_unit of sensor 1"):
        rig.loads(text.replace('log_unit = "%"', 'log_unit = "cm"'))
    with pytest.raises(InputError, match="unknown"):
        rig.set_values(case, {"%.level": 1.5})


def test_a_limit_beyond_the_span_is_not_certified():
    """The filter cannot hold a limit that the sensor does not see."""
    text = """
    tank = [{ area = 100.0, rim = 30.0, drain = 1.0, level = 5.0 }]
    pump = [{ gain = 50.0, to = 1, high = 10.0, initial = 1.0 }]
    controller = { kind = "p", Kc = 1.0 }
    safety_filter = { limit = [25.0] }
    [[sensor]]
    tank = 1
    span = [0.0, %s]
    """
    whole, short = (rig.loads(text % top).loop.safety_filter for top in ("30.0", "20.0"))
    assert float(whole.limit[0]) == pytest.approx(25.0)
    assert float(short.limit[0]) <= 20.0


def test_a_sensor_reads_a_share_of_the_level_and_a_file_keeps_it():
    """y = scale h + offset, and its inverse; through a file and back."""
    table = PROCESS + '[[sensor]]\ntank = 2\nname = "LT2"\nscale = 0.9\noffset = 0.02\n'
    sensor = rig.loads(rig.dump(rig.loads(table))).loop.sensor
    assert [float(y) for y in sensor.read((0.5, 0.5), None)] == pytest.approx([0.5, 0.47])
    assert sensor.level_of(1, sensor.reading_of(1, 0.3)) == pytest.approx(0.3, rel=1e-12)


def test_a_filter_is_refused_by_controllers_that_keep_limits_and_noted_below_observers():
    filtered = "[[sensor]]\ntank = 1\nname = 'LT1'\nfilter = '20 s'\n"
    case = rig.set_values(rig.loads(PROCESS + filtered), {"LT1.filter": "30 s"})
    assert case.loop.sensor.filter.tolist() == [30.0, 0.0]
    noted = lambda case: [s for s in rig.case_warnings(case) if "sensor.filter = 30 s" in s]
    assert noted(case) == []
    observer = jaxtank.observers.DisturbanceObserver(model=case.loop.plant, l=[0.1, 0.1])
    below = case.replace(loop=dataclasses.replace(case.loop, observer=observer))
    assert len(noted(below)) == 1
    for kind in ("nmpc", "reference-governor"):
        cls = ROLES["controller"].classes[kind]
        with pytest.raises(InputError, match=r"sensor\.filter = 30 s"):
            cls.check_sensor(None, case.loop.sensor)
        cls.check_sensor(None, rig.set_values(case, {"sensor.filter": 0.0}).loop.sensor)


def test_ends_of_a_pump_that_are_turned_have_the_unit_of_the_rig():
    case = rig.loads(PROCESS)
    loop = jaxtank.with_values(case.loop, {"actuator.low[0]": 150.0})
    high = float(case.loop.actuator.high[0])
    with pytest.raises(InputError, match=f"= 150 {loop.units[1]}: .* = {high:g} {loop.units[1]}"):
        jaxtank.check(loop, case.clock)
    assert loop.units[1] != "V"


CURVES = [[[1.0, 0.8], [4.0, 2.4], [9.0, 8.9], [15.0, 15.0]], [[0.0, 0.5], [20.0, 18.0]]]
CURVED = """
tank = [{ area = 20.0, rim = 30.0, drain = 0.3 }, { area = 15.0, rim = 30.0, drain = 0.2 }]
pump = [{ to = [1, 2], gain = 4.0, split = 0.5, high = 12.0 }]
inputs = { initial = [5.0] }
[[sensor]]
tank = 1
curve = [[1.0, 0.8], [4.0, 2.4], [9.0, 8.9], [15.0, 15.0]]
[[sensor]]
tank = 2
curve = [[0.0, 0.5], [20.0, 18.0]]
"""


@pytest.mark.extended
def test_a_curve_of_a_sensor_is_that_of_numpy_and_straight_beyond_its_ends():
    case = rig.loads(CURVED)
    sensor, levels = case.loop.sensor, np.linspace(-1.0, 25.0, 53)
    for tank, points in enumerate(CURVES):
        h, y = np.array(points).T
        expected = np.interp(levels, h, y)
        for end, side in ((0, levels < h[0]), (-1, levels > h[-1])):
            slope = np.diff(y)[end] / np.diff(h)[end]
            expected[side] = y[end] + slope * (levels[side] - h[end])
        tuples = [float(sensor.read((h, h), None)[tank]) for h in levels]
        arrays = [float(sensor.read(jnp.array([h, h]), None)[tank]) for h in levels]
        np.testing.assert_allclose(tuples, expected, atol=1e-12)
        np.testing.assert_allclose(arrays, expected, atol=1e-12)
        np.testing.assert_allclose(sensor.level_of(tank, expected), levels, atol=1e-12)
        slope = jax.grad(lambda h, tank=tank: sensor.read((h, h), None)[tank])(6.0)
        assert slope == pytest.approx(np.interp(6.5, h, y) - np.interp(5.5, h, y))


@pytest.mark.parametrize("preset", ["", 'case = "cascaded/pi"\n'])
def test_a_curve_of_a_sensor_is_written_back(preset):
    text = preset + CURVED[CURVED.index("[[sensor]]") :] if preset else CURVED
    case = rig.loads(text)
    again = rig.loads(rig.dump(case))
    levels = np.linspace(0.0, 12.0, 7)
    for tank in range(2):
        reading = case.loop.sensor.reading_of(tank, levels)
        assert np.max(np.abs(reading - levels)) > 0.3
        np.testing.assert_allclose(again.loop.sensor.reading_of(tank, levels), reading, atol=1e-12)


def test_a_curve_of_a_sensor_that_turns_is_refused():
    with pytest.raises(InputError, match="sensor 2: curve: its readings must increase"):
        rig.loads(CURVED.replace("[20.0, 18.0]", "[20.0, 0.4]"))


def test_the_safety_filter_does_not_cover_a_curve_of_a_sensor():
    with pytest.raises(InputError, match="not covered: curve"):
        rig.loads(CURVED).with_safety_filter()


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("level = 1.0", 'level = "12 mA"'),
        ("max_level = 2.7", 'max_level = "12 mA"'),
        ("initial = [1.0]", 'initial = ["12 mA"]'),
    ],
)
def test_a_current_needs_a_sensor_that_says_what_it_is(old, new):
    """It was read as a share of the height; in % that is what is meant."""
    assert ONE_TANK.count(old) == 1
    with pytest.raises(InputError, match=r"12 mA: no \[\[sensor\]\]"):
        rig.loads(ONE_TANK.replace(old, new))
    case = rig.loads(ONE_TANK.replace(old, new.replace("mA", "%")))
    numbers = [*case.loop.x0, *np.ravel(case.limits["max_level"]), *case.loop.reference.initial]
    assert 0.36 in np.round(numbers, 12)
    with pytest.raises(InputError, match=r"50 mA: must be from 3\.6 to 22 mA"):
        sensor = "[[sensor]]\ntank = 1\nspan = [0.0, 2.8]\n"
        rig.loads(ONE_TANK.replace(old, new.replace("12", "50")) + sensor)
