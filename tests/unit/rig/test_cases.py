"""Rigs of bug threads, textbooks and forums (tests/data/cases): the value in each file's head."""

import math
import pathlib

import numpy as np
import pytest
import scipy.linalg
from scipy.optimize import brentq

import jaxtank
import tuning
from jaxtank import presets, rig
from jaxtank.core.errors import InputError
from jaxtank.rig import write
from jaxtank.safety.of_case import certificates_of
from tuning.identification.csv_log import read_log

CASES = pathlib.Path(__file__).parents[2] / "data" / "cases"
ROOT_2G = math.sqrt(2.0 * 9.81)


def file_of(number):
    """The file of a case by its number."""
    return next(CASES.glob(f"case{number}_*.toml"))


def simulated(case):
    run = jaxtank.simulate(case.loop, case.clock)
    return np.asarray(run.t), np.asarray(run.x), run


def at(t, x, time):
    return x[np.argmin(np.abs(t - time)), 0]


def signs_turned(t, x, run):
    assert x.max() == pytest.approx(0.468712, abs=2e-6)
    for time, level in ((100.0, 0.255050), (200.0, 0.214734), (250.0, 0.252153)):
        assert at(t, x, time) == pytest.approx(level, abs=2e-6)


def outflow_pump(t, x, run):
    assert x.min() >= 0.0
    assert x[-1, 0] == pytest.approx(0.0, abs=1e-9)


def p_only(t, x, run):
    after = t >= 100.0
    right = 2.4 - 0.4 * np.exp(-0.05 * (t[after] - 100.0))
    np.testing.assert_allclose(x[after, 0], right, atol=2e-3)
    assert x[-1, 0] == pytest.approx(2.4, abs=1e-6)


def reservoir(t, x, run):
    full = 2 * 78.53981633974483 * math.sqrt(11.0) / (0.07068583470577035 * ROOT_2G)
    root = np.sqrt(11.0) * (1.0 - t / full)
    filling = t < 0.95 * full
    np.testing.assert_allclose(np.sqrt(11.0 - x[filling, 1]), root[filling], atol=1e-4)
    assert np.all(np.diff(x[:, 1]) >= 0.0) and x[-1, 1] == pytest.approx(11.0, abs=1e-3)


def one_tank(t, x, run):
    spilled = np.asarray(run.spilled)[-1, 0]
    assert (x.max(), spilled) == (1.0, pytest.approx(0.11868, abs=1e-3))
    assert t[np.argmax(x[:, 0] >= 1.0)] == pytest.approx(127.23, abs=0.11)
    assert at(t, x, 300.0) == pytest.approx(0.083184, abs=1e-5)
    assert x[-1, 0] == pytest.approx(0.0, abs=1e-6) and x.min() >= 0.0


def full_tank(t, x, run):
    spilled = np.asarray(run.spilled)[:, 0]
    np.testing.assert_allclose(x, 10.0, atol=1e-12)
    np.testing.assert_allclose(spilled[t >= 1800.0], 36.0, rtol=1e-12)


def relay(t, x, run):
    late = x[t > 100.0, 0]
    assert late.max() - 1.0 == pytest.approx(0.05, abs=2e-3)
    assert 1.0 - late.min() == pytest.approx(0.05, abs=2e-3)
    rises = t[1:][(x[1:, 0] >= 1.0) & (x[:-1, 0] < 1.0)]
    np.testing.assert_allclose(np.diff(rises)[2:], 20.0, atol=0.3)


def p_only_after_saturation(t, x, run):
    assert x[-1, 0] == pytest.approx(1.0, abs=1e-6)
    right = np.clip(0.5 + 10.0 * (1.0 - x[:, 0]), 0.0, 1.0)
    np.testing.assert_allclose(np.asarray(run.u)[:-1, 0], right[:-1], atol=1e-5)


def measured_inflows(t, x, run):
    extremes = (x[-1, 0], x.min(), x.max())
    assert extremes == pytest.approx((13.214751, 13.207825, 13.377), abs=1e-6)


def linear_plant(t, x, run):
    assert x[-1, 0] == pytest.approx(4.0, abs=1e-3)
    for time, level in ((5.0, 2.52848), (10.0, 3.45866)):
        assert at(t, x, time) == pytest.approx(level, abs=4e-3)


def recycle(t, x, run):
    np.testing.assert_allclose(x[:, 0] + 2.0 * x[:, 1], 3.0, rtol=1e-12)
    upper = (0.02 / (0.01 * ROOT_2G)) ** 2
    np.testing.assert_allclose(x[-1], [upper, (3.0 - upper) / 2.0], atol=1e-5)


def ultrasonic(t, x, run):
    np.testing.assert_allclose(np.asarray(run.y), np.floor(x + 0.5), atol=1e-9)
    late = x[t >= t[-1] - 100.0, 0]
    assert (late.min(), late.max()) == pytest.approx((25.451, 25.550), abs=2e-3)


def side_stream(t, x, run):
    before = t < 50.0
    np.testing.assert_allclose(x[before, 0], 20.0, atol=1e-5)
    np.testing.assert_allclose(np.asarray(run.u)[before, 0], 5.90454, atol=1e-5)


def by_hand(t, x, run):
    percent = 0.3 * 0.002 * ROOT_2G * math.sqrt(1.2) * 3600.0 / 0.3
    assert percent == pytest.approx(34.936, abs=1e-3)
    np.testing.assert_allclose(np.asarray(run.u)[-1], [percent, 30.0], atol=1e-4)
    assert x[-1, 1] == pytest.approx(1.2, abs=1e-6)
    flow = np.asarray(run.u)[:-1, 0] * 0.3 / 3600.0
    taken = 2.0 * flow.sum()
    assert (3.0 - x[-1, 0]) * math.pi / 4.0 * 9.0 == pytest.approx(taken, rel=1e-9)


RIGHT = {
    **{"05": signs_turned, "07": outflow_pump, "08": p_only, "09": reservoir, "11": one_tank},
    **{"12": full_tank, "14": relay, "17": p_only_after_saturation, "18": measured_inflows},
    **{"18b": measured_inflows, "23": linear_plant, "24": recycle, "35": ultrasonic},
    **{"37": side_stream, "38": by_hand},
}


@pytest.mark.slow_for("05", "08", "09", "14", "17", "18", "35")
@pytest.mark.parametrize("number", RIGHT)
def test_a_case_of_people_has_the_value_in_its_head(number):
    RIGHT[number](*simulated(rig.load(file_of(number))))


@pytest.mark.slow
def test_margins_of_simc_are_the_published_ones():
    case = rig.load(file_of(13))
    names = ["sensitivity_peak", "gain_margin", "phase_margin", "delay_margin"]
    values = jaxtank.evaluate(case.loop, case.clock, names)
    numbers = [float(np.ravel(values[name])[0]) for name in names]
    assert numbers == pytest.approx([1.70, 2.96, 46.9, 1.59 * 60.0], rel=0.01)


@pytest.mark.slow
def test_the_water_tower_is_identified_with_and_without_its_pump():
    case = rig.load(file_of(19))
    log = read_log(CASES / "case19b_water_tower_log_pump.csv", case.loop)
    fit = tuning.identify(case, log)
    values = fit.to_json()["parameters"]
    assert values["plant.pump_gain[0]"]["value"] == pytest.approx(3.5300, rel=1e-4)
    assert values["disturbance.level[0]"]["value"] == pytest.approx(-0.30406, rel=1e-4)


YEAR = """
units = ["m", "m^3/s"]
tank = [{ area = 500.0, rim = 5.0, drain = 0.02, level = 2.0 }]
pump = [{ gain = 1.0, to = 1, high = 1.0, initial = 0.1 }]
plant = { gravity = 9.81 }
controller = { kind = "pid", Kc = 0.5, Ti = 7200.0, Tt = 3600.0 }
reference = { csv = "year.csv", column = "SP" }
values = { "clock.dt" = 600.0, "clock.duration" = 31536000.0 }
"""


def test_a_year_of_setpoints_is_followed(tmp_path):
    """case27: 8,760 hourly setpoints, of a CSV."""
    hour, day = np.arange(8760), 2 * math.pi / 24
    setpoints = 2 + 0.5 * np.sin(day * hour) + 0.3 * np.sin(day * hour / 365)
    rows = [f"{k},{float(v)!r}" for k, v in zip(hour, setpoints)]
    (tmp_path / "year.csv").write_text("\n".join(["time [h],SP [m]", *rows]))
    (tmp_path / "year.toml").write_text(YEAR)
    _, x, run = simulated(rig.load(tmp_path / "year.toml"))
    np.testing.assert_array_equal(np.asarray(run.r)[:-1:6, 0], setpoints)
    assert abs(x[-1, 0] - setpoints[-1]) < 0.3


def test_two_pumps_on_one_level_are_refused_with_what_to_write():
    with pytest.raises(InputError, match=r"one pump per output.*split-range"):
        rig.load(file_of(30))


@pytest.mark.slow
@pytest.mark.parametrize("gain", [0.045, 0.05, 0.055])
def test_a_filter_on_an_outflow_pump_holds_what_it_claims(gain):
    case = rig.load(file_of(31))
    (row,) = certificates_of(case)
    assert row.certified and row.low_certified
    _, x, _ = simulated(rig.set_values(case, {"plant.pump_gain[0]": gain}))
    assert x.min() >= 0.5 - 1e-9 and x.max() <= 2.0 + 1e-9
    assert x.max() > 1.9 or x.min() < 0.6  # the controller drives it there


def test_a_valve_beside_a_controller_of_one_pump_is_refused_with_what_is_missing():
    with pytest.raises(InputError, match=r"list of 2 finite numbers, one per input \(pumps, then"):
        rig.load(file_of(33))


OUTLET = """
reachable = false
units = ["m", "-"]
tank = [{ name = "LT101", area = 1.0, rim = 0.6, level = 0.3, inflow = 0.02 }]
valve = [{ name = "FV101", from = "LT101", area = 0.01 }]
plant = { gravity = 9.81 }
controller = { kind = "p", Kc = -19.68503937007874, bias = 0.0 }
reference = { initial = [0.3556] }
values = { "clock.dt" = 0.1, "clock.duration" = 600.0 }
"""


def test_a_valve_in_the_outlet_is_manipulated():
    """case33, by P only: open by (h - 14 in) / 2 in."""
    case = rig.loads(OUTLET)
    assert case.names == {"tank": ("LT101",), "valve": ("FV101",)} and case.loop.plant.bottom
    _, x, _ = simulated(case)
    balance = lambda h: 0.01 * (h - 0.3556) / 0.0508 * ROOT_2G * math.sqrt(h) - 0.02
    root = brentq(balance, 0.36, 0.6)
    assert root == pytest.approx(0.392225, abs=1e-6)
    assert x[-1, 0] == pytest.approx(root, abs=1e-6)


@pytest.mark.extended
def test_a_linear_outlet_of_a_file_cancels_the_integral_action():
    """case23 without its derivative, by drain_linear: y = 4 (1 - exp(-0.2 t))."""
    text = """
    units = ["m", "-"]
    tank = [{ area = 10.0, rim = 100.0, drain_linear = 1.0 }]
    pump = [{ gain = 1.0, to = 1, high = 100.0 }]
    plant = { gravity = 9.81 }
    controller = { kind = "pid", Kc = 2.0, Ti = 10.0, Tt = 10.0 }
    reference = { initial = [0.0], changes = [[0.0, 1, 4.0]], ramp = 0.0 }
    values = { "clock.dt" = 0.01, "clock.duration" = 20.0 }
    """
    t, x, _ = simulated(rig.loads(text))
    np.testing.assert_allclose(x[:, 0], 4.0 * (1.0 - np.exp(-0.2 * t)), atol=2e-3)


VESSEL = """
reachable = false
units = ["m", "m^3/s"]
tank = [{{ level = 1.6, {tank} }}]
{inputs}
plant = {{ gravity = 9.81 }}
controller = {{ kind = "open-loop", initial = [{initial}] }}
values = {{ "clock.dt" = 0.25, "clock.duration" = 100.0 }}
"""
TAP = "valve = [{ from = 1, area = 0.01 }]"


def vessel(tank, inputs=TAP, initial=0.0):
    return simulated(rig.loads(VESSEL.format(tank=tank, inputs=inputs, initial=initial)))


def test_a_cone_runs_out_by_its_closed_form_and_stays_empty():
    """h^2.5 falls linearly: A = A0 (h / H)^2, outflow a sqrt(2 g h)."""
    t, x, _ = vessel('shape = "cone", height = 2.0, diameter = 1.5, drain = 0.01')
    slope = 2.5 * 0.01 * ROOT_2G * 4.0 / (math.pi / 4.0 * 1.5**2)
    right = np.maximum(1.6**2.5 - slope * t, 0.0) ** 0.4
    full = right > 0.3
    np.testing.assert_allclose(x[full, 0], right[full], atol=1e-5)
    assert right[-1] == 0.0 and x.min() >= 0.0 and x[-1, 0] < 1e-2


@pytest.mark.extended_for("lying", "sphere", "table")
@pytest.mark.parametrize(
    ("tank", "volume"),
    [
        ("diameter = 2.0, height = 3.0", lambda h: math.pi * h),
        ('shape = "sphere", diameter = 2.0', lambda h: math.pi / 3.0 * h**2 * (3.0 - h)),
        (
            "shape = [[0.0, 1.0], [1.0, 3.0], [4.0, 3.0]]",
            lambda h: np.where(h < 1.0, h + h**2, 3.0 * h - 1.0),
        ),
        (
            'shape = "horizontal-cylinder", diameter = 2.0, length = 2.0',
            lambda h: 2.0 * (np.arccos(1.0 - h) - (1.0 - h) * np.sqrt(h * (2.0 - h))),
        ),
    ],
    ids=["upright", "sphere", "table", "lying"],
)
def test_a_pump_that_takes_out_takes_its_flow_from_a_vessel_of_any_shape(tank, volume):
    t, x, _ = vessel(tank, "pump = [{ from = 1, gain = 1.0, high = 1.0 }]", 0.01)
    taken = volume(x[0, 0]) - volume(x[:, 0])
    np.testing.assert_allclose(taken, 0.01 * t, atol=1e-10)


@pytest.mark.extended
def test_a_port_ends_the_outflow_and_a_check_valve_lets_nothing_back():
    _, x, _ = vessel("area = 1.0, rim = 3.0", TAP.replace("area", "port = 1.5, area"), 1.0)
    assert x[-1, 0] == pytest.approx(1.5, abs=1e-3) and x.min() >= 1.5
    two = """
    units = ["m", "-"]
    reachable = false
    tank = [{ area = 1.0, rim = 3.0, level = 1.0 }, { area = 1.0, rim = 3.0, level = 2.0 }]
    valve = [{ from = 1, to = 2, area = 0.01, check = CHECK, initial = 1.0 }]
    plant = { gravity = 9.81 }
    controller = { kind = "open-loop", initial = [1.0] }
    """
    for check, levels in (("true", [1.0, 2.0]), ("false", [1.5, 1.5])):
        _, x, _ = simulated(rig.loads(two.replace("CHECK", check)))
        np.testing.assert_allclose(x[-1], levels, atol=1e-3)


@pytest.mark.extended
def test_an_equal_percentage_valve_is_open_by_its_rangeability_also_in_percent():
    tap = 'valve = [{ from = 1, area = 0.02, characteristic = "equal-percentage" }]'
    tank = "area = 1.0, rim = 9.0, inflow = 0.01"
    _, x, _ = vessel(tank, tap, 0.7)
    text = VESSEL.format(tank=tank, inputs=tap, initial=70.0).replace("m^3/s", "%")
    case = rig.loads(text)
    assert float(case.loop.actuator.high[0]) == 100.0
    np.testing.assert_allclose(simulated(case)[1], x, rtol=1e-12)
    share = 50.0 ** (0.7 - 1.0)
    rate = (x[-1, 0] - x[-2, 0]) / 0.25
    mean = x[-2:, 0].mean()
    assert rate == pytest.approx(0.01 - 0.02 * share * ROOT_2G * math.sqrt(mean), abs=1e-7)


def test_a_pump_follows_its_curve_and_loses_flow_to_the_lift():
    curves = "curve = [[0.0, 0.0], [0.5, 0.02], [1.0, 0.02]], curve_head = [[0.0, 1.0], [4.0, 0.0]]"
    pump = f"pump = [{{ to = 1, high = 1.0, {curves} }}]"
    t, x, _ = vessel("area = 1.0, rim = 9.0", pump, 0.75)
    right = 4.0 - 2.4 * np.exp(-0.02 / 4.0 * t)
    np.testing.assert_allclose(x[:, 0], right, atol=1e-6)


STORE = """
units = ["m", "m^3/h"]
tank = [
    {{ name = "feed", area = 7.0, rim = 4.0, level = 3.0 }},
    {{ name = "T1", area = 1.0, rim = 2.0, level = 1.0 }},
]
pump = [{{ name = "P1", from = "feed", to = "T1", high = 20.0 }}]
{outlet}
plant = {{ outputs = ["T1"] }}
controller = {{ kind = {controller} }}
reference = {{ initial = ["50 %"] }}
"""
HAND = 'valve = [{ name = "HV1", from = "T1", area = "8 cm^2", initial = 0.5 }]'
TRANSFERS = {
    "circuit": (
        'orifice = [{ from = "T1", to = "feed", area = "4 cm^2" }]',
        '"pi", Kc = 9, Ti = 99',
    ),
    "store": (HAND, '"pi", Kc = 9, Ti = 99, lead = ["P1"]'),
    "switch": ("", '"on-off", on = [0.8], off = [1.2]'),
}


@pytest.mark.extended_for("store")
@pytest.mark.parametrize("kind", TRANSFERS)
def test_a_store_without_a_steady_level_is_no_refusal(kind):
    outlet, controller = TRANSFERS[kind]
    case = rig.loads(STORE.format(outlet=outlet, controller=controller))
    assert case.reachable


def test_the_bias_of_a_pump_that_draws_from_a_store_holds_the_level():
    outlet, controller = TRANSFERS["store"]
    case = rig.loads(STORE.format(outlet=outlet, controller=controller))
    held = 0.5 * 8e-4 * ROOT_2G * 3600.0
    assert float(case.loop.controller.bias[0]) == pytest.approx(held, rel=1e-9)


def test_inputs_and_entries_are_called_by_the_names_of_pumps_and_valves():
    outlet, controller = TRANSFERS["store"]
    text = STORE.format(outlet=outlet, controller=controller)
    case = rig.loads(
        text + 'fault = [{ of = "pump_gain[P1]", start = 10.0, end = 20.0, factor = 0.5 }]'
    )
    assert [name for name, *_ in case.loop.faults.windows] == ["pump_gain[0]"]
    assert rig.dotted_name(case.loop, "plant.valve[HV1]") == "plant.valve[0]"
    assert rig.dotted_name(case.loop, "plant.pump_gain[P1]") == "plant.pump_gain[0]"
    with pytest.raises(InputError, match="P9"):
        rig.loads(text.replace('lead = ["P1"]', 'lead = ["P9"]'))
    with pytest.raises(InputError, match=r"lead = \['P1'\]"):
        rig.loads(text.replace(', lead = ["P1"]', ""))


def test_an_input_without_a_unit_has_gains_in_a_flow():
    text = """
    units = ["m", "{drive}"]
    tank = [{{ area = 1.0, rim = 5.0 }}]
    pump = [{{ to = 1, gain = "{gain}", high = 1.0 }}]
    inputs = {{ initial = [0.0] }}
    """
    for drive, gain in (("-", "72 m3/h"), ("V", "72 m3/(h V)"), ("%", "72 m3/h/%")):
        case = rig.loads(text.format(drive=drive, gain=gain))
        assert float(case.loop.plant.pump_gain[0]) == pytest.approx(0.02, rel=1e-12), drive


def test_a_gain_of_the_measured_inflow_of_a_3600th_is_noted():
    text = STORE.format(outlet="", controller='"p", Kc = 9, inflow_gain = {gain}')
    text = text.replace("rim = 2.0, level", 'rim = 2.0, inflow = "1 m3/h", level')
    text = f"reachable = false\n{text}"  # the pump only fills
    notes = [
        rig.case_warnings(rig.loads(text.replace("{gain}", gain))) for gain in ("1.0", '"100 %"')
    ]
    assert any("inflow_gain" in note for note in notes[0])
    assert not any("inflow_gain" in note for note in notes[1])


SWITCHED = """
units = ["m", "m^3/h"]
tank = [{{ name = "TK5", area = 2.0, rim = 2.5, level = 1.2, drain = "1 cm^2" }}]
pump = [{{ name = "P5", {way} = "TK5", high = 25.0 }}]
controller = {{ kind = "{kind}", {gains} }}
reference = {{ initial = [1.4] }}
values = {{ "clock.dt" = 60.0, "clock.duration" = 6000.0 }}
"""


@pytest.mark.parametrize(
    "way, on, off, end",
    [
        ("to", 2.0, 1.9, "P5 fills TK5, which runs empty"),
        ("to", 0.9, 1.9, ""),
        ("from", 2.0, 1.9, ""),
        ("from", 0.9, 1.9, "P5 empties TK5, which runs full"),
    ],
)
def test_on_and_off_the_wrong_way_round_are_noted(way, on, off, end):
    text = SWITCHED.format(kind="on-off", way=way, gains=f"on = {on}, off = {off}")
    notes = [note for note in rig.case_warnings(rig.loads(text)) if "controller.on" in note]
    assert len(notes) == bool(end) and all(f"{end} while it is off" in note for note in notes)


def test_an_input_that_follows_names_the_one_that_leads():
    text = SWITCHED.format(
        way="to", kind="ratio", gains='lead = ["P5"], follow = ["P6"], ratio = [0.5], Kc = 20.0'
    ).replace("high = 25.0 }", 'high = 25.0 }, { name = "P6", to = "TK5", high = 9.0 }')
    with pytest.raises(InputError, match=r'\("P6"\), .* \("P5"\) .*, as follow = \["P5"\]'):
        rig.loads(text)
    assert rig.loads(text.replace('follow = ["P6"]', 'follow = ["P5"]')).loop.plant.pumps == 2


@pytest.mark.parametrize("table", ["[sensor]", "[[sensor]]"])
def test_an_unknown_key_of_a_sensor_has_the_table_of_the_file_and_a_remedy(table):
    text = SWITCHED.format(way="to", kind="on-off", gains="on = 0.9, off = 1.9")
    with pytest.raises(InputError) as refused:
        rig.loads(f"{text}\n{table}\ndelay = 3.0\nnois = 0.1\n")
    message = str(refused.value)
    assert message.count("unknown key") == 2 and message.count(f"of {table} ") == 2
    assert "write delay of [[pump]] or [[valve]]: dead times of readings" in message


WRONG = """
units = ["m", "-"]
gravity = 9.81
tower = 1
tank = [{ area = 1.0, cone = true }, { shape = "cone", height = 2.0 }, { rim = 1.0, port = 2.0 }]
valve = [{ from = 1, area = 0.1, opening = 0.5, check = 1 }, { to = 2, area = 0.1, high = 2.0 }]
pump = [{ to = 7, gain = 1.0, curve = [[0.0, 1.0], [0.0, 2.0]] }]
controller = { kind = "p", Kc = 1.0 }
"""


def test_all_that_is_wrong_in_the_tables_of_a_rig_is_in_one_answer():
    with pytest.raises(InputError) as refused:
        rig.loads(WRONG)
    message = str(refused.value)
    for words in (
        "unknown key of [[tank]] 'cone'; write [[tank]] shape",
        "unknown key of [[tank]] 'port'; it is a key of [[orifice]]",
        "unknown key of [[valve]] 'opening'; write initial",
        "valve 1: check = 1: must be true or false",
        "valve 2 needs from",
        "pump 1: to = 7: must be a tank",
        "pump 1: curve = ",
        "unknown key 'gravity'; it is a key of [plant]",
        "unknown key 'tower'; nearest: ",
        "pump 1 needs high",
    ):
        assert words in message, words


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"tank": [{"shape": "cone", "height": 2.0}]}, "diameter and height"),
        ({"tank": [{"shape": "cube", "height": 2.0}]}, '"cone", "sphere"'),
        ({"tank": [{"area": 1.0}]}, r"tank 1 needs rim \[m\]"),
        ({"tank": [{"rim": 1.0}]}, r"tank 1 needs area \[m\^2\].*diameter"),
        ({"tank": [{"area": 1.0, "rim": 1.0, "height": 1.0}]}, "give one of them"),
        ({"tank": [{"shape": [[0.5, 1.0], [1.0, 1.0]]}]}, "from level 0"),
        ({"valve": [{"from": 1, "area": 0.1, "high": 2.0}]}, "up to 1, full open"),
        ({"valve": [{"from": 1, "to": 1, "area": 0.1}]}, "two different tanks"),
        ({"valve": [{"from": 1, "area": 0.1, "characteristic": "quick"}]}, '"equal-percentage"'),
        ({"pump": [{"gain": 1.0, "high": 1.0}]}, "needs to"),
        ({"pump": [{"to": 1, "high": 1.0}]}, "needs gain .* or curve"),
        ({"pump": [{"to": 1, "high": 1.0, "curve": [[0, 0], [1, 2], [2, 1]]}]}, "that turns"),
        ({"valve": []}, r"at least one \[\[pump\]\] or \[\[valve\]\]"),
        ({"valve": [{"from": 1, "area": 0.1, "kv": 3.0}]}, "write area"),
    ],
)
def test_an_element_that_cannot_be_is_refused_with_what_to_write(changes, words):
    table = {
        "units": ["m", "-"],
        "tank": [{"area": 1.0, "rim": 1.0}],
        "valve": [{"from": 1, "area": 0.1}],
        "plant": {"gravity": 9.81},
        "controller": {"kind": "open-loop", "initial": [0.0]},
    }
    with pytest.raises(InputError, match=words):
        rig.from_table(table | changes)


LATE = """
units = ["m", "%"]
dt = 5.0
duration = "40 min"
tank = [{ area = 1.0, rim = 2.0, drain = "6 cm^2", level = 0.8 }]
pump = [{ to = 1, gain = "0.05 L/(s %)", high = 100.0, delay = 95.0 }]
controller = { kind = "pi", Kc = 60.0, Ti = "10 min" }
reference = { initial = [0.8] }
"""


@pytest.mark.parametrize(
    "controller",
    [
        'kind = "flow-cascade", Kc = 0.2, Ti = "10 min", inner_Kc = 2e4, inner_Ti = "20 s"',
        'kind = "split-range", Kc = 60.0, Ti = "10 min"',
        'kind = "pi", lead = [1], Kc = 60.0, Ti = "10 min"',
        'kind = "ratio", follow = [1], ratio = [0.5], Kc = 60.0, Ti = "10 min"',
    ],
)
def test_every_kind_of_pid_notes_pumps_that_stood_still(controller):
    text = LATE.replace('kind = "pi", Kc = 60.0, Ti = "10 min"', controller)
    second = '{ to = 1, gain = "0.05 L/(s %)", high = 100.0 }'
    pumps = 1 if "flow" in controller else 2
    if pumps == 2:
        text = text.replace("delay = 95.0 }", f"delay = 95.0 }}, {second}")
    sentences = [s for s in rig.case_warnings(rig.loads(text)) if "keeps it there" in s]
    total = 6e-4 * np.sqrt(2 * 9.81 * 0.8) / 5e-5
    needed = [total / 1.5, total / 3.0] if "ratio" in controller else [total]
    assert len(sentences) == len(needed)
    for sentence, share in zip(sentences, needed):
        assert f"initial = {share:.4g} keeps it there" in sentence


def test_a_pump_that_stood_still_before_a_dead_time_is_noted_with_what_holds_the_start():
    case = rig.loads(LATE)
    (sentence,) = rig.case_warnings(case)
    needed = 6e-4 * np.sqrt(2 * 9.81 * 0.8) / 5e-5  # % of the pump: the outflow at 0.8 m
    assert f"initial = {needed:.4g} keeps it there" in sentence
    begun = rig.loads(LATE.replace("delay = ", f"initial = {needed}, delay = "))
    assert rig.case_warnings(begun) == []
    level = np.asarray(jaxtank.simulate(begun.loop, begun.clock).x)[:, 0]
    assert np.ptp(level) < 1e-3 < np.ptp(np.asarray(jaxtank.simulate(case.loop, case.clock).x))


def test_a_bias_left_out_is_that_of_the_inflow_at_the_start_of_a_table():
    """1 L/s of 6 cm^2 sqrt(2 g 0.8 m) = 2.377 L/s flows in at first, 4 L/s later."""
    table = 'inflow = [{ tank = 1, changes = [[0, "1 L/s"], ["10 min", "4 L/s"]] }]\n'
    plain = rig.loads(LATE + table)
    flow = 6e-4 * np.sqrt(2 * 9.81 * 0.8) - 1e-3  # m^3/s, of the pump
    assert float(plain.loop.controller.bias[0]) == pytest.approx(flow / 5e-5, rel=1e-3)
    gain = LATE.replace('"10 min" }', '"10 min", inflow_gain = "-10 % s/L" }')
    fed = rig.loads(gain + table).loop.controller
    assert float(fed.bias[0]) == pytest.approx(flow / 5e-5 + 10.0, rel=1e-3)


DRAINED = """
units = ["m", "-"]
tank = [{ name = "LT101", area = 0.5, rim = 2.0, level = 1.0, inflow = 0.002 }]
valve = [{ name = "FV101", from = "LT101", area = 1e-3, initial = 0.45 }]
controller = { kind = "pi", Kc = %s, Ti = 60.0 }
"""


def test_the_gain_of_a_valve_that_empties_its_tank_is_negative():
    warned = {Kc: rig.case_warnings(rig.loads(DRAINED % Kc)) for Kc in ("2.0", "-2.0")}
    assert any("Kc" in s and "FV101" in s for s in warned["2.0"])
    assert not any("Kc" in s for s in warned["-2.0"])


@pytest.mark.parametrize(("size", "read"), [(0.05, True), (0.0, True), (-0.05, False)])
def test_noise_of_a_faulty_sensor_may_be_small_but_not_negative(size, read):
    fault = f'fault = [{{ sensor = "LT101", kind = "noise", size = {size}, start = 1.0, end = 9.0'
    text = DRAINED % -2.0 + fault + " }]"
    if read:
        assert float(rig.loads(text).loop.faults.size[0]) == size
    else:
        with pytest.raises(InputError):
            rig.loads(text)


def test_the_value_of_a_template_lies_within_its_range():
    loop = presets.find("cascaded/pi").loop
    of = lambda low, high: write.absent(
        loop, "sensor.more", {"like": "noise", "low": low, "high": high, "strict": True}
    )
    assert of(None, 3.0) == [0.0, 0.0] and of(0.0, None) == of(0.0, 1.0) == [1.0, 1.0]
    assert of(0.0, 0.5) == [0.25, 0.25]


def test_two_pumps_of_a_split_range_that_both_fill_need_no_reverse():
    text = DRAINED.replace("valve = [", "pump = [{ gain = 1e-3, to = 1, high = 1.0 },\n").replace(
        '{ name = "FV101", from = "LT101", area = 1e-3, initial = 0.45 }',
        "{ gain = 1e-3, to = 1, high = 1.0 }",
    )
    text = text.replace("level = 1.0,", "level = 1.0, drain = 6e-4,")
    case = rig.loads(text.replace('"pi", Kc = %s', '"split-range", Kc = 2.0'))
    assert case.loop.plant.pumps == 2 and rig.case_warnings(case) == []


PAIR = """
tank = [{ area = 100.0, drain = 0.3, rim = 60.0, level = 20.0INFLOW },
    { area = 80.0, drain = 0.5, rim = 60.0, level = 15.0 }]
orifice = [{ from = 1, to = 2, area = 0.2 }]
pump = [{ to = 1, gain = 20.0, high = 10.0, initial = 4.95 },
    { to = 2, gain = 20.0, high = 10.0, initial = 2.3 }]
plant = { outputs = [1, 2] }
controller = { CONTROLLER }
reference = { initial = [20.0, 15.0] }
values = { "clock.dt" = 1.0, "clock.duration" = 300.0 }
"""


@pytest.mark.parametrize(
    ("controller", "inflow", "more", "noted"),
    [
        ('kind = "state-feedback", K = [[0.5, 0.1], [0.1, 0.4]]', ", inflow = 20.0", "", True),
        ('kind = "state-feedback", K = [[0.5, 0.1], [0.1, 0.4]]', "", "", False),
        ('kind = "pi", Kc = [0.5, 0.5], Ti = [60.0, 60.0]', ", inflow = 20.0", "", False),
        (
            'kind = "state-feedback", K = [[0.5, 0.1], [0.1, 0.4]]',
            ", inflow = 20.0",
            'observer = { kind = "disturbance", l = [0.5, 0.5] }\n',
            False,
        ),
        (
            'kind = "state-feedback", K = [[0.5, 0.1], [0.1, 0.4]], inflow = [20.0, 0.0]',
            ", inflow = 20.0",
            "",
            False,
        ),
    ],
)
def test_an_inflow_that_a_controller_without_integral_does_not_know_is_noted(
    controller, inflow, more, noted
):
    case = rig.loads(more + PAIR.replace("INFLOW", inflow).replace("CONTROLLER", controller))
    assert any("knows no inflow" in s for s in rig.case_warnings(case)) is noted
    run = jaxtank.simulate(case.loop, case.clock)
    assert bool(np.abs(np.asarray(run.e)[-1]).max() > 0.5) is noted


@pytest.mark.parametrize(
    "kind, words",
    [
        ('kind = "fault-bank"', "taken for a fault"),
        (
            'kind = "extended-kalman", coefficients = ["drain[0]"], coefficient_spread = 0.1,'
            " coefficient_walk = 1e-3",
            "taken for other coefficients",
        ),
    ],
)
def test_an_inflow_that_an_observer_takes_for_something_else_is_noted(kind, words):
    row = f"observer = {{ {kind}, process = [1e-4, 1e-4], measurement = [1e-4, 1e-4] }}\n"
    pi = 'kind = "pi", Kc = [0.5, 0.5], Ti = [60.0, 60.0]'
    for inflow in ("", ", inflow = 20.0"):
        text = row + PAIR.replace("INFLOW", inflow).replace("CONTROLLER", pi)
        notes = rig.case_warnings(rig.loads(text))
        assert any(words in note for note in notes) == bool(inflow)


FED = """
units = ["m", "%"]
tank = [{ area = 1.0, rim = 2.0, level = 1.2, inflow = "4 m3/h" }]
valve = [{ name = "V1", from = 1, area = "6 cm^2", characteristic = "equal-percentage" }]
controller = { kind = "lqi", Q = [1.0, 0.01], R = [0.0016], operating_point = [1.2] }
reference = { initial = [1.2] }
"""


def test_an_lqi_at_an_input_beyond_its_limits_is_refused():
    """The model lacks the inflow: at rest the valve would have to bring liquid."""
    with pytest.raises(InputError, match=r"is at rest with V1 at -\d+\.\d %, outside its limits"):
        rig.loads(FED)


def test_the_model_of_an_lqi_has_the_inflow_that_is_stated():
    """A h' = q - a u sqrt(2 g h), q = 4 m^3/h, u the opening: gains of scipy's Riccati equation."""
    text = FED.replace(', characteristic = "equal-percentage"', "")
    text = text.replace("[1.2] }\nref", '[1.2], inflow = ["4 m3/h"] }\nref')
    text += 'values = { "clock.dt" = 1.0, "clock.duration" = 3000.0 }\n'
    case = rig.loads(
        text.replace("initial = [1.2] }", "initial = [1.2], changes = [[9, 1, 1.0]] }")
    )
    q, a, g = 4.0 / 3600.0, 6e-4, 9.81
    opening = lambda h: 100.0 * q / (a * np.sqrt(2.0 * g * h))  # %
    A = np.array([[-q / (2.0 * 1.2), 0.0], [1.0, 0.0]])
    B = np.array([[-a * np.sqrt(2.0 * g * 1.2) / 100.0], [0.0]])
    P = scipy.linalg.solve_continuous_are(A, B, np.diag([1.0, 0.01]), [[0.0016]])
    np.testing.assert_allclose(case.loop.controller.gain(), B.T @ P / 0.0016, rtol=1e-9)
    run = jaxtank.simulate(case)
    assert run.u[0, 0] == pytest.approx(opening(1.2), rel=1e-9)  # before an integral has grown
    assert run.x[-1, 0] == pytest.approx(1.0, abs=1e-4)
    assert run.u[-1, 0] == pytest.approx(opening(1.0), rel=1e-4)
    again = rig.loads(rig.dump(case)).loop.controller
    np.testing.assert_allclose(again.inflow, [q], rtol=1e-9)


def test_an_inflow_is_not_counted_twice():
    """Disturbances that an observer estimates have the inflow in them."""
    law = 'kind = "state-feedback", K = [[0.5, 0.1], [0.1, 0.4]], inflow = [20.0, 0.0]'
    text = PAIR.replace("INFLOW", ", inflow = 20.0").replace("CONTROLLER", law)
    case = rig.loads('observer = { kind = "disturbance", l = [0.5, 0.5] }\n' + text)
    with pytest.raises(InputError, match=r"controller\.inflow: leave it out beside an observer"):
        jaxtank.simulate(case)


@pytest.mark.parametrize("limits", ['{ "min_level.1" = 0.4 }', "{ min_level = { 1 = 0.4 } }"])
def test_a_low_limit_of_one_tank_leaves_the_other_without(limits):
    text = PAIR.replace("INFLOW", "").replace(
        "CONTROLLER", 'kind = "pi", Kc = [1, 1], Ti = [60, 60]'
    )
    case = rig.loads(f"limits = {limits}\n{text}")
    assert np.asarray(case.limits["min_level"]).tolist() == [0.4, -np.inf]
    with pytest.raises(InputError, match="at least 0 cm"):
        rig.loads(f"limits = {limits}\n{text}".replace("0.4", "-0.4"))
