"""Limits that hold with valves, pumps in outlets and between tanks, and inputs of either sign."""

import dataclasses
import tomllib

import element_rigs as er
import jax
import numpy as np
import outlet_attacks
import pytest

import jaxtank
from jaxtank import presets, rig
from jaxtank.core.errors import InputError
from jaxtank.instruments.actuators import PumpBank
from jaxtank.instruments.sensors import LevelSensor
from jaxtank.plants import network
from jaxtank.safety import OutletFilter, SafetyFilter, outlet_checker
from jaxtank.safety.outlet_checker import check
from jaxtank.safety.outlet_design import outlet_design

PUMPED_OUT = """
name = "outlet filter"
units = ["m", "-"]
reachable = false
tank = [{ area = 1.0, rim = 2.0, level = 1.0, inflow = 0.03 }]
pump = [{ gain = 0.05, to = 1, low = -1.0, high = 0.0, initial = -0.6 }]
plant = { gravity = 9.81, overflow = false }
law = { kind = "pid", Kc = -5.0, Ti = 20.0, Tt = 5.0, bias = -0.6 }
reference = { initial = [1.2], changes = [[100.0, 1, 0.8], [300.0, 1, 1.5]], ramp = 0.0 }
values = { "clock.dt" = 0.5, "clock.duration" = 600.0 }
safety_filter = { limit = [2.0], low = [0.5] }
uncertain = { "plant.pump_gain" = 0.1 }
"""


def pumped_out():
    return rig.from_table(tomllib.loads(PUMPED_OUT))


def series(spread=0.05, **options):
    """(rig, settings): a pump fills tank 1, one lifts from it into tank 2, a valve empties that."""
    plant = network(
        area=[60.0, 40.0], drain=[0.1, 0.0], pump_gain=[12.0, 8.0], feeds=[(0, None), (1, None)],
        sources=[None, 0], valves=[(1, None)], valve=[1.2], rim=[40.0, 40.0], bottom=True,
    )  # fmt: skip
    bank = PumpBank(low=np.zeros(3), high=np.array([10.0, 10.0, 1.0]), initial=np.zeros(3))
    sensor = LevelSensor(gain=np.ones(2), noise=np.full(2, 0.01), full_scale=100.0)
    widths = {"pump_gain": spread * plant.pump_gain, "valve": spread * plant.valve}
    settings = {"widths": widths, "limit": 30.0, "low": 5.0, "start": [20.0, 10.0], **options}
    return (plant, bank, sensor, 0.5), settings


def checked(safety_filter, parts, settings, **changes):
    given = {
        "hold": parts[3],
        "box": {
            **{
                f"plant.{k}": (getattr(parts[0], k) - v, getattr(parts[0], k) + v)
                for k, v in settings["widths"].items()
            },
            "x0": (np.array(settings["start"]), np.array(settings["start"])),
        },
    }
    return check(safety_filter, *parts[:3], **{**given, **changes})


def test_an_outflow_pump_is_held_between_both_limits_under_a_controller_of_the_wrong_sign():
    case = pumped_out()
    (row,) = case.safety_design(**case.safety)[1]
    assert row.certified and row.low_certified and row.starts == "limits"
    for gain in (0.045, 0.05, 0.055):
        loop = jaxtank.with_values(case.loop, {"plant.pump_gain": [gain]})
        loop = dataclasses.replace(loop, controller=case.loop.controller)
        x = np.asarray(jaxtank.simulate(loop, case.clock).x)
        assert x.min() >= 0.5 and 1.9 < x.max() <= 2.0
    free = jaxtank.simulate(case.without_safety_filter().loop, case.clock)
    assert np.min(free.x) < 0.1


def test_the_outflow_that_the_filter_demands_is_that_of_the_weakest_pump():
    loop = pumped_out().loop
    for level, kappa in ((1.99, 1.0), (1.999, 1.0)):
        (u,), acts = loop.safety_filter.apply(loop.actuator, (0.0,), None, (level,), 0.5)
        assert acts == 1.0 and np.isclose(u, (kappa * (2.0 - level) - 0.03) / 0.045)
    (u,), acts = loop.safety_filter.apply(loop.actuator, (-1.0,), None, (0.51,), 0.5)
    assert acts == 1.0 and np.isclose(u, -0.01 / 0.055)


def test_a_row_of_an_empty_tank_counts_on_no_outflow():
    parts, settings = series()
    safety_filter, _ = outlet_design(*parts, **settings)
    safety_filter = dataclasses.replace(safety_filter, empty=np.zeros(2))
    _, allowed = safety_filter.row(0, (0, 1), 0.0, [0.0, 0.0], ((0.0,) * 3, (0.0,) * 3), True)
    band, rate = float(safety_filter.band[0]), float(safety_filter.rate[0])
    assert float(allowed) == pytest.approx(rate * 60.0 * (30.0 - band), rel=1e-12)


@pytest.mark.parametrize(("draw", "kept"), [(-20.0, True), (-110.0, False)])
def test_a_low_limit_needs_a_pump_that_brings_more_than_a_disturbance_draws(draw, kept):
    parts, settings = series()  # 0.95 x 120 cm^3/s enter, 9.9 leave by the drain at 5 cm
    _, rows = outlet_design(*parts, **settings, draw=[draw, 0.0])
    assert rows[0].low_certified == kept
    assert kept or rows[0].low_reason.startswith("5.9 ")


@pytest.mark.parametrize("drain", [2.0, 2.02, 2.04, 2.06])
def test_a_tank_may_hold_less_than_it_gives_in_a_step_up_to_the_level_of_the_closed_form(drain):
    plant = network(area=[20.0], drain=[drain], feeds=[(0, None)], pump_gain=[90.0], rim=[40.0])
    bank = PumpBank(low=[0.0], high=[12.0], initial=[0.0])
    sensor = LevelSensor(gain=np.ones(1), noise=np.zeros(1))
    settings = {"widths": {}, "limit": 30.0, "start": [20.0]}
    safety_filter, _ = outlet_design(plant, bank, sensor, 0.5, **settings)
    rig = outlet_checker._Rig(safety_filter, plant, bank, sensor, 0.5, 1, {})
    exact = (0.5 * drain * np.sqrt(2.0 * 981.0) / 20.0) ** 2  # dt c sqrt(h) = A h
    cell = 30.0 / outlet_checker.FINE
    assert exact <= rig.shallow(0) <= exact + 2.0 * cell


@pytest.mark.parametrize(("ends", "leaves"), [((0, 1), True), ((1, 0), False)])
def test_a_valve_that_lets_liquid_one_way_lowers_the_tank_before_it_alone(ends, leaves):
    plant = network(
        area=[60.0, 40.0], drain=[0.1, 0.3], pump_gain=[12.0], feeds=[(0, None)], valves=[ends],
        valve=[2.0], one_way=[True], rim=[40.0, 40.0], bottom=True,
    )  # fmt: skip
    bank = PumpBank(low=np.array([0.0, 1.0]), high=np.array([10.0, 1.0]), initial=np.zeros(2))
    sensor = LevelSensor(gain=np.ones(2), noise=np.zeros(2), full_scale=100.0)
    settings = {"widths": {}, "limit": 30.0, "low": [5.0, 0.0], "start": [20.0, 1.0]}
    _, rows = outlet_design(plant, bank, sensor, 0.5, **settings)
    # 2 sqrt(2 g 5) = 198 and 9.9 cm^3/s may leave at 5 cm, 120 enter
    assert not rows[0].low_certified and rows[0].low_reason.startswith("88 ") == leaves


def test_rigs_without_outlets_have_the_filter_that_they_had():
    case = presets.find("gouta2022/enmpc").with_safety_filter()
    assert type(case.loop.safety_filter) is SafetyFilter


@pytest.mark.parametrize(
    "seed", [0, 1, 4, 17, 23, *(pytest.param(k, marks=pytest.mark.slow) for k in range(600, 640))]
)
def test_no_attack_passes_a_proved_limit(seed):
    rows, passes = outlet_attacks.trial(seed)
    assert not passes and not isinstance(rows, str)


def test_attacks_pass_a_limit_where_the_filter_approaches_it_too_fast():
    parts, settings = series(spread=0.05)
    safety_filter, rows = outlet_design(*parts, **settings)
    assert all(r.certified and r.low_certified for r in rows)
    settings |= {"low": np.full(2, 5.0), "start": np.array([20.0, 10.0]), "substeps": 1}
    settings |= {"inflow": np.zeros(2), "draw": np.zeros(2)}
    attack = lambda f: outlet_attacks.attack((*parts[:3], settings, 0.5), f, rows, 3, samples=120)
    highest, lowest = attack(safety_filter)
    assert np.all(highest <= 30.0 + 1e-9) and np.all(lowest >= 5.0 - 1e-9)
    fast = dataclasses.replace(safety_filter, rate=8.0 * safety_filter.rate)
    highest, lowest = attack(fast)
    assert np.any(highest > 30.01) or np.any(lowest < 4.99)


BROKEN = {
    "rate": lambda f: {"rate": 2.2 * f.rate / f.rate},
    "band": lambda f: {"band": 0.5 * f.band},
    "least": lambda f: {"least": f.most},
    "most": lambda f: {"most": f.least},
    "low rows": lambda f: {"low_rows": ()},
    "upper rows": lambda f: {"upper_rows": ()},
    "empty": lambda f: {"empty": 0.0 * f.empty},
    "inputs of a row": lambda f: {"upper_rows": tuple((i, ()) for i, _ in f.upper_rows)},
    "a number that is none": lambda f: {"limit": np.nan * f.limit},
}


@pytest.mark.parametrize("what", BROKEN)
def test_the_checker_proves_nothing_of_a_filter_with_another(what):
    parts, settings = series()
    safety_filter, _ = outlet_design(*parts, **settings)
    assert all(v.holds and v.low_holds for v in checked(safety_filter, parts, settings))
    broken = dataclasses.replace(safety_filter, **BROKEN[what](safety_filter))
    verdicts = checked(broken, parts, settings)
    assert not all(v.holds and v.low_holds for v in verdicts)


@pytest.mark.parametrize("least", [4.0, 6.0])
def test_a_low_limit_is_proved_of_starts_that_all_lie_above_it(least):
    parts, settings = series()
    safety_filter, _ = outlet_design(*parts, **settings)
    box = {"x0": (np.array([least, 10.0]), np.array([20.0, 10.0]))}
    of_starts = checked(safety_filter, parts, settings, box=box)
    assert [v.holds for v in of_starts] == [True, True]
    assert of_starts[0].low_holds == (least > 5.0)


def joined():
    """(rig, settings) of a pump into each of two tanks that an orifice joins."""
    plant = network(
        area=[60.0, 40.0], drain=[0.2, 0.3], links=[(0, 1)], orifice=[0.2], pump_gain=[12.0, 8.0],
        feeds=[(0, None), (1, None)], rim=[40.0, 40.0], bottom=True,
    )  # fmt: skip
    bank = PumpBank(low=np.zeros(2), high=np.array([10.0, 10.0]), initial=np.zeros(2))
    sensor = LevelSensor(gain=np.ones(2), noise=np.zeros(2), full_scale=100.0)
    settings = {"widths": {}, "limit": 30.0, "start": [20.0, 10.0]}
    return (plant, bank, sensor, 0.5), settings


@pytest.mark.parametrize("what", ["climb", "reach"])
def test_the_checker_proves_nothing_that_relies_on_levels_of_neighbours_that_are_not_bounds(what):
    parts, settings = joined()
    safety_filter, rows = outlet_design(*parts, **settings)
    assert all(row.certified for row in rows)
    wrong = dataclasses.replace(safety_filter, **{what: 0.5 * getattr(safety_filter, what)})
    assert not checked(wrong, parts, settings)[1].holds


def spans(low=None, high=None, orifice=1.5, **options):
    """(rig, settings): inflow fills tank 1, whose level no input moves; an orifice fills tank 2,
    which a valve empties.
    """
    plant = network(
        area=[50.0, 50.0], drain=[0.0, 0.3], links=[(0, 1)], orifice=[orifice], pump_gain=[20.0],
        feeds=[(1, None)], valves=[(1, None)], valve=[2.2], rim=[40.0, 40.0], overflow=True,
        bottom=True,
    )  # fmt: skip
    bank = PumpBank(low=np.zeros(2), high=np.array([20.0, 1.0]), initial=np.zeros(2))
    sensor = LevelSensor(gain=np.ones(2), noise=np.zeros(2), low=low, high=high)
    settings = {"widths": {}, "limit": [40.0, 20.0], "start": [9.0, 10.0], **options}
    return (plant, bank, sensor, 0.5), settings


def runs(parts, settings):
    """(highest, lowest) levels by small steps of this test: of `spans`, first with its inflow and
    full pumps, then without, the valve open.
    """
    (plant, bank, sensor, hold), w, fine = parts, np.sqrt(2.0 * 981.0), 20
    orifice = float(plant.orifice[0])
    safety_filter = outlet_design(*parts, **settings)[0]
    apply = jax.jit(lambda y, command: safety_filter.apply(bank, command, None, y, hold)[0])
    x = np.array(settings["start"])
    seen = [x]
    for inflow, command in ((settings.get("inflow", [0.0])[0], (20.0, 0.0)), (0.0, (0.0, 1.0))):
        for _ in range(150):
            u, v = apply(sensor.read(tuple(x), None), command)
            for _ in range(fine):
                out = w * np.sqrt(np.maximum(x, 0.0))
                flow = np.array([inflow - orifice * out[0], orifice * out[0] + 20.0 * u])
                flow[1] -= (0.3 + 2.2 * v) * out[1]
                x = np.clip(x + hold / fine * flow / 50.0, 0.0, 40.0)
                seen.append(x)
    return np.max(seen, axis=0), np.min(seen, axis=0)


@pytest.mark.slow
def test_a_band_narrower_than_the_lower_end_of_a_sensor_proves_no_low_limit():
    parts, settings = spans(low=np.array([4.0, 4.0]), orifice=0.0, band=[0.0, 0.0])
    settings["low"] = [0.0, 2.0]  # read as 4 cm, where the valve may still open
    assert runs(parts, settings)[1][1] < 1.9
    _, rows = outlet_design(*parts, **settings)
    assert not rows[1].low_certified and "band" in rows[1].low_reason


@pytest.mark.slow
def test_a_neighbour_that_rises_above_its_sensor_proves_no_limit_of_the_next_tank():
    parts, settings = spans(high=np.array([10.0, 40.0]), inflow=[420.0, 0.0])
    assert runs(parts, settings)[0][1] > 39.0
    _, rows = outlet_design(*parts, **settings)
    assert not rows[1].certified and "sensor" in rows[1].reason


@pytest.mark.parametrize(("low", "proved"), [(0.0, False), (5.0, True)])
def test_a_pump_that_runs_back_from_two_tanks_counts_only_where_both_hold_liquid(low, proved):
    plant = network(
        area=[50.0, 50.0, 50.0], drain=[2.0, 0.0, 0.0], pump_gain=[30.0, 20.0, 20.0],
        feeds=[(1, 2), (1, None), (2, None)], sources=[0, None, None], split=[0.4, 1.0, 1.0],
        rim=[60.0, 60.0, 60.0], overflow=True, bottom=True,
    )  # fmt: skip
    bank = PumpBank(  # tank 3 is filled for certain only where it has a low limit
        low=np.array([-10.0, 15.0, 0.0 if low == 0.0 else 15.0]),
        high=np.array([0.0, 20.0, 20.0]),
        initial=np.zeros(3),
    )
    sensor = LevelSensor(gain=np.ones(3), noise=np.zeros(3))
    settings = {"widths": {}, "limit": 60.0, "low": [5.0, 5.0, low], "start": [20.0, 20.0, low]}
    _, rows = outlet_design(plant, bank, sensor, 0.5, **settings)
    # 0.4 of 300 cm^3/s come back where tank 3 is dry, 198 leave tank 1 at 5 cm
    assert rows[1].low_certified and rows[0].low_certified == proved


@pytest.mark.parametrize(
    ("change", "word"),
    [
        ({"delay": np.array(1.0)}, "dead time"),
        ({"lag": np.array(1.0)}, "lag"),
        ({"dead_zone": np.array(1.0)}, "dead zone"),
    ],
)
def test_what_the_theorem_does_not_cover_is_named(change, word):
    parts, settings = series()
    bank = dataclasses.replace(parts[1], **change)
    _, rows = outlet_design(parts[0], bank, *parts[2:], **settings)
    assert not any(r.certified or r.low_certified for r in rows)
    assert all(word in r.reason and r.reason.startswith("not covered") for r in rows)


@pytest.mark.parametrize(
    ("settings", "word"),
    [
        ({"volume": [1.0, 0.0]}, "inflow pulses"),
        ({"widths": {"actuator.high": 0.1}}, "uncertain actuator.high"),
        ({"start": [31.0, 10.0]}, "start"),
    ],
)
def test_disturbances_and_boxes_that_are_not_covered_are_named(settings, word):
    parts, more = series()
    _, rows = outlet_design(*parts, **{**more, **settings})
    assert not rows[0].certified and word in rows[0].reason


def test_two_limits_that_need_one_pump_both_ways_are_not_both_proved():
    parts, settings = series()
    plant = dataclasses.replace(parts[0], valves=(), valve=None, rangeability=None)
    plant = dataclasses.replace(plant, characteristics=(), one_way=())
    bank = PumpBank(low=np.array([3.0, 0.0]), high=np.array([10.0, 10.0]), initial=np.zeros(2))
    settings["widths"] = {}
    _, rows = outlet_design(plant, bank, *parts[2:], **settings)
    # 36 cm^3/s enter tank 1, whose drain takes 24; the rest fills tank 2, which nothing empties
    assert not (rows[0].certified and rows[1].certified)


@pytest.mark.parametrize("name", ["valve", "cone"])
def test_rigs_of_elements_are_proved(name):
    case = er.case(name)
    (row,) = case.safety_design(limit=[25.0], low=[3.0])[1]
    assert row.certified and row.low_certified


def test_a_pump_curve_is_refused_by_name():
    with pytest.raises(InputError, match="not covered: curve of pump 1"):
        er.case("recycle").with_safety_filter()


def test_slopes_through_caps_and_floors_are_those_of_differences():
    case = pumped_out()

    def last(gain):
        loop = jaxtank.with_values(case.loop, {"safety_filter.least.pump_gain": gain})
        return jaxtank.simulate(loop, dataclasses.replace(case.clock, duration=30.0)).x[-1, 0]

    at = np.array([0.045])
    assert type(case.loop.safety_filter) is OutletFilter
    slope = jax.grad(lambda g: last(g))(at)[0]
    difference = (last(at + 1e-6) - last(at - 1e-6)) / 2e-6
    assert np.isclose(slope, difference, rtol=1e-5)
