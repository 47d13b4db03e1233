"""Attacks on what the safety filter proves, by the simulation of `safety_attacks`: rigs whose
limits were once passed though they counted as proved, random ones; and what the design chooses.
"""

import math
import tomllib

import jax
import numpy as np
import pytest
import rig_files
from safety_attacks import attack, filtered, in_numpy, outcome_of, passed, trial

from jaxtank import presets, rig
from jaxtank.instruments.actuators import PumpBank
from jaxtank.instruments.sensors import LevelSensor
from jaxtank.plants import network
from jaxtank.safety import design
from jaxtank.safety.checker import CASE, LIMITS

ONE = """
tank = [{ area = 100.0, rim = 40.0, drain = 0.5, level = 5.0 }]
pump = [{ gain = 20.0, to = 1, low = 0.0, high = 10.0, initial = 0.0 }]
"""
HALF = ONE.replace("100.0", "50.0")
PAIR = """
pump = [{ gain = 20.0, to = 1, low = 0.0, high = 10.0, initial = 0.0 },
        { gain = 20.0, to = 2, low = 0.0, high = 10.0, initial = 0.0 }]
"""
SHARED = """
pump = [{ gain = 20.0, to = 1, low = 1.0, high = 10.0, initial = 1.0 },
        { gain = 20.0, to = [1, 2], split = 0.3, low = 0.5, high = 10.0, initial = 1.0 }]
"""
SPILL = """
tank = [{ area = 50.0, rim = 20.0, drain = 0.2, level = 5.0 },
        { area = 50.0, rim = 40.0, drain = 0.3, level = 5.0 }]
spill = [{ from = 1, to = 2, caught = 1.0 }]
plant = { outputs = [1], overflow = true }
"""
CHAIN = """
tank = [{ area = 21.2, rim = 30.0, drain = 0.0, level = 0.5 },
        { area = 21.2, rim = 30.0, drain = 0.1857, level = 4.0 },
        { area = 21.2, rim = 30.0, drain = 0.0, level = 0.5 }]
orifice = [{ from = 3, to = 1, area = 0.19 }, { from = 1, to = 2, area = 0.2059 }]
pump = [{ gain = 7.7, to = 3, low = 0.0, high = 12.0, initial = 1.0 }]
"""
RING = """
tank = [{ area = 50.0, rim = 40.0, drain = 0.02, level = 4.56 },
        { area = 50.0, rim = 40.0, drain = 0.0, level = 5.57 }]
orifice = [{ from = 1, to = 2, area = 0.3 }, { from = 2, to = 1, area = 0.3 }]
pump = [{ gain = 20.0, to = 1, low = 0.0, high = 10.0, initial = 0.0 }]
"""
WIDER = RING.replace("0.02, lev", "0.2, lev").replace("0.0, level = 5", "0.2, level = 5")
LAGS = """
tank = [{ area = 200.0, rim = 40.0, drain = 0.5, level = 5.0 },
        { area = 200.0, rim = 60.0, drain = 0.3, level = 5.0 }]
pump = [{ gain = 20.0, to = 1, low = 0.0, high = 10.0, initial = 0.0 },
        { gain = 20.0, to = [1, 2], split = 0.3, low = 0.0, high = 10.0, initial = 0.0 }]
"""
START = """
tank = [{ area = 50.0, rim = 100.0, drain = 0.0, level = 80.0 },
        { area = 10.0, rim = 100.0, drain = 0.34, level = 19.0 }]
orifice = [{ from = 1, to = 2, area = 0.3 }]
limits = { max_level = [20.0, 20.0] }
"""
LOW = """
tank = [{ area = 50.0, rim = 20.0, drain = 0.5, level = 15.0 },
        { area = 50.0, rim = 60.0, drain = 0.3, level = 5.0 }]
"""
FAULT = 'fault = [{ of = "drain[0]", start = 60.0, end = 180.0, factor = 0.5 }]'
BEFORE = HALF.replace("high = 10.0, initial = 0.0", "high = 4.0, initial = 40.0")
LIMIT = "safety_filter = { limit = [25.0, 20.0] }"
UNCERTAIN = 'uncertain = { "%s" = %g, "plant.drain" = 0.05 }'
RIGS = {  # {what is attacked: (rig file, values, which limits are proved)}
    "k1 of a tank whose limit was lowered afterwards": (CHAIN, {}, [True] * 3),
    "a ring of orifices": (RING, {}, [False, False]),
    "a ring of orifices whose rims can be kept": (WIDER, {}, [True, True]),
    "lags of 2 and 0.01 s into one tank": (LAGS, {"actuator.lag": [2.0, 0.01]}, [True, True]),
    "a limit above the rim of a tank that spills": (SPILL + PAIR + LIMIT, {}, [True, False]),
    "a tank that is not proved spills": (SPILL.replace("level = 5.0 }", "level = 5.0, inflow = 150"
     " }", 1) + PAIR + "limits = { max_level = [20.0, 20.0] }", {}, [False, False]),
    "a start above the limit of the tank above": (START + PAIR, {}, [False, False]),
    "an uncertain lag": (ONE + UNCERTAIN % ("actuator.lag", 0.9), {"actuator.lag": [2.0]}, [True]),
    "an uncertain noise": (
        ONE + UNCERTAIN % ("sensor.noise", 0.5), {"sensor.noise": [0.05]}, [True]
    ),
    "inputs under way above the limits": (BEFORE, {"actuator.delay": 5.0}, [False]),
    "pumps that cannot stop in one row": (LOW + SHARED, {}, [True, True]),
    "a fault of its own": (HALF + FAULT, {}, [False]),
}  # fmt: skip
PASSED_ONCE = {
    **{"start above the limit upstream": 56, "spill": 135, "spill ring under Theorem 2": 267},
    **{"different lags": 383, "uncertain lag": 180, "uncertain noise": 138},
    **{"uncertain inflow": 422, "uncertain start": 44, "inputs under way beyond limits": 199},
    **{"low above 0": 89, "fault": 71, "leak": 298, "inflow pulses": 303},
    **{"two lower limits": 411, "pipes": 137},
}
"""{feature: seed of a rig that passed a level that was proved before the checker}"""


def table_of(text, values=()):
    """The table of a rig file with the lines `text`, under commands that the attack replaces."""
    table = {"plant": {"outputs": [1]}, "reachable": False, "safety_filter": {}}
    table |= tomllib.loads(text)
    table["controller"] = {"kind": "open-loop", "initial": [0.0] * len(table["pump"])}
    return table | {"values": {"clock.dt": 0.1, "clock.duration": 200.0} | dict(values)}


@pytest.mark.parametrize("name", RIGS)
def test_no_level_passes_what_is_proved_of_a_complete_rig(name):
    """Each of these was proved, and passed, by up to 32 cm; those that are proved come near it."""
    text, values, proved = RIGS[name]
    outcome = outcome_of(table_of(text, values), count=32)
    assert [r.certified for r in outcome.rows] == proved and passed(outcome) == []
    near = [outcome.highest[r.tank] > 0.99 * r.limit for r in outcome.rows if r.certified]
    assert any(near) or not any(proved)


@pytest.mark.parametrize("name", PASSED_ONCE)
def test_no_level_passes_what_is_proved_of_a_rig_that_did_so_before(name):
    outcome = trial(PASSED_ONCE[name], count=32)
    assert not outcome.refused and passed(outcome) == []


@pytest.mark.parametrize("low", [False, True])
def test_random_rig_files_stay_within_what_is_proved(low):
    """Of rigs of which some limits are proved, and that come near them."""
    outcomes = [trial(seed, low, count=32) for seed in range(5000, 5004)]
    assert [passed(o) for o in outcomes if passed(o)] == []
    near = [o.highest[r.tank] > 0.99 * r.limit for o in outcomes for r in o.rows if r.certified]
    assert sum(near) >= 2
    assert any(r.low_certified for o in outcomes for r in o.rows) == low


@pytest.mark.slow
@pytest.mark.parametrize("low", [False, True])
def test_hundreds_of_random_rig_files_stay_within_what_is_proved(low):
    over = {seed: passed(trial(seed, low)) for seed in range(6000, 6400)}
    assert {seed: tanks for seed, tanks in over.items() if tanks} == {}


@pytest.mark.parametrize("name", ["gouta2015/backstepping-ff", "mirakhorli/lqi"])
def test_a_limit_holds_from_the_starts_for_which_it_is_proved(name):
    """From the limits tanks 1 and 2 of gouta2015 rose by 0.5 cm above theirs, tank 1 of mirakhorli
    by 1.3 cm.
    """
    case = rig.set_values(presets.find(name), {"clock.dt": 0.1}).with_safety_filter()
    safety_filter, rows = case.safety_design()
    assert all(row.certified for row in rows) and {row.starts for row in rows} == {LIMITS, CASE}
    loop, limit = case.loop, np.array([row.limit for row in rows])
    highest = lambda start: attack(
        loop.plant, loop.actuator, safety_filter, 0.1, 0.05, seconds=60.0, count=24, start=start
    )[0]
    assert np.all(highest(loop.x0) <= limit + 1e-9)
    over = highest(limit) > limit + 1e-9
    assert over.any() and all(row.starts == CASE for row in rows if over[row.tank])


@pytest.mark.parametrize("seed", [1, 10])
def test_the_filter_computes_the_same_in_numpy_as_compiled(seed):
    """What the attacks drive is `apply` as the loop runs it."""
    table, _ = rig_files.draw(seed)
    case = rig.from_table(table)
    safety_filter, loop, hold = case.loop.safety_filter, case.loop, case.clock.dt
    rng = np.random.default_rng(seed)
    count, pumps = 20, loop.plant.pumps
    y = np.asarray(safety_filter.limit) * rng.uniform(0.0, 1.02, (count, loop.plant.tanks))
    command = rng.uniform(-5.0, 20.0, (count, pumps))
    line = rng.uniform(0.0, 5.0, (max(safety_filter.predicted, 1), count, pumps))
    way = tuple(np.moveaxis(line, 2, 0)) if safety_filter.predicted else None
    apply = jax.jit(
        lambda c, y, way: safety_filter.apply(loop.actuator, tuple(c), None, tuple(y), hold, way)
    )
    compiled = np.stack(np.broadcast_arrays(*apply(command.T, y.T, way)[0]), axis=1)
    with in_numpy():
        plain = filtered(safety_filter, loop.actuator, y, command, hold, line)
    np.testing.assert_allclose(plain, compiled, rtol=1e-9, atol=1e-9)


# --------------------------------------------------------------------------- the design


W = math.sqrt(2 * 981.0)
TANK = network(area=[50.0], drain=[0.5], feeds=[(0, None)], pump_gain=[20.0], rim=[40.0])
SENSOR = LevelSensor(noise=[0.0])


def case_of(text, values=()):
    return rig.from_table(table_of(text, values))


@pytest.mark.parametrize(("third", "drain"), [(0.19, 0.1857), (0.18, 0.12)])
def test_k1_is_chosen_again_where_a_limit_is_lowered(third, drain):
    """With k1 for 30 cm and a limit of 19.98 cm the level of tank 1 rose 0.64 cm above it."""
    text = CHAIN.replace("0.1857", f"{drain}").replace("0.19 }", f"{third} }}")
    safety_filter, rows = case_of(text).safety_design()
    assert all(r.certified for r in rows)
    limit = np.array([r.limit for r in rows])
    for tank, source, orifice in ((0, 2, third), (1, 0, 0.2059)):  # by hand: C2, or the rim
        enters = 1.05 * orifice * W / 21.2 * math.sqrt(limit[source])
        outlets = 0.2059 if tank == 0 else drain
        leaves = 0.95 * outlets * W / 21.2 * math.sqrt(limit[tank])
        assert enters <= max(leaves, safety_filter.slope[tank] * limit[tank]) * (1.0 + 1e-9)


def test_a_ring_of_orifices_without_a_limit_that_can_be_kept_keeps_the_limits_asked_for():
    _, rows = case_of(RING).safety_design()
    assert not any(r.certified for r in rows) and all("rim condition" in r.reason for r in rows)
    assert [r.limit for r in rows] == [40.0, 40.0]  # not what the sweeps have come to


@pytest.mark.parametrize("lag", [[2.0, 0.01], [0.5, 3.0]])
def test_pumps_with_different_lags_have_a_row_each(lag):
    """Each has its share of what full pumps bring; one row would bound the commands only."""
    case = case_of(LAGS, {"actuator.lag": lag})
    safety_filter, rows = case.safety_design()
    assert safety_filter.divided == (0,) and all(r.certified for r in rows)
    caps, shared = safety_filter.limits((39.0, 5.0), 0.1, (0.0, 0.0), (10.0, 10.0))
    m = 0.95 * 0.5 * W / 200.0 * math.sqrt(39.0) + rows[0].rate * (40.0 - 39.0)
    full = 10.0 * 1.05 * 20.0 * (1.0 + 1.05 * 0.3) / 200.0
    assert shared == []
    assert [float(c) for c in caps] == pytest.approx([10.0 * m / full] * 2, rel=1e-12)


@pytest.mark.parametrize(("drain", "proved"), [(0.3, False), (1.5, True)])
def test_what_spills_from_a_limit_above_the_rim_counts_as_inflow(drain, proved):
    """210 cm^3/s of full pumps less what leaves tank 1 at its rim of 20 cm, by hand."""
    case = case_of(SPILL.replace("0.3", str(drain)) + PAIR)
    safety_filter, rows = case.safety_design(limit=[25.0, 20.0])
    assert rows[1].certified == proved
    assert safety_filter.inflow[1] == pytest.approx(210.0 - 0.19 * W * math.sqrt(20.0), rel=1e-9)


def test_a_tank_that_is_not_proved_spills():
    pumps, plant = PumpBank(low=[0.0], high=[10.0]), network(
        area=50.0, drain=[0.2, 0.3], feeds=[(1, None)], pump_gain=[20.0], rim=[20.0, 40.0],
        spills=[(0, 1)], caught=[1.0], overflow=True,
    )  # fmt: skip
    for inflow, proved in ((150.0, False), (30.0, True)):
        safety_filter, rows = design(
            plant, pumps, LevelSensor(noise=np.zeros(2)), 0.1, inflow=[inflow, 0.0],
            widths={"drain": [0.01, 0.015]}, limit=20.0, start=[5.0, 5.0],
        )  # fmt: skip
        assert [r.certified for r in rows] == [proved, proved]
        spilled = 0.0 if proved else 150.0 - 0.19 * W * math.sqrt(20.0)
        assert safety_filter.inflow[1] == pytest.approx(spilled, rel=1e-9)


def test_a_start_above_the_limit_counts_for_the_tanks_below():
    _, rows = case_of(START + PAIR).safety_design()
    assert not any(r.certified for r in rows) and rows[0].reach >= 80.0
    assert "relies on tank 1" in rows[1].reason


def test_the_lag_is_the_largest_of_the_stated_tolerance():
    uncertain = {"actuator.lag": 0.9, "plant.drain": 0.05, "plant.pump_gain": 0.05}
    case = case_of(ONE, {"actuator.lag": [2.0]}).replace(uncertain=uncertain)
    safety_filter, (row,) = case.safety_design()
    tau, a = 3.8, 0.1  # the bound by hand: max of sigma (1 - tau sigma) e^(-sigma a)
    sigma = np.linspace(1e-3, 1.0, 100001)
    bound = np.max(sigma * (1.0 - tau * sigma) * np.exp(-sigma * a))
    assert row.certified and row.rate_bound == pytest.approx(bound, rel=1e-6)
    del uncertain["actuator.lag"]
    fast, _ = case.replace(uncertain=uncertain).safety_design()
    how = {"seconds": 60.0, "count": 12, "lag": tau, "start": np.array([30.0])}
    for f, holds in ((safety_filter, True), (fast, False)):
        (highest,), _ = attack(case.loop.plant, case.loop.actuator, f, 0.1, 0.05, **how)
        assert (highest <= 40.0 + 1e-9) == holds


def test_sensor_and_pumps_count_with_the_ends_of_their_tolerances():
    """ADC of 10 bits: half a step of gain and range 5 % larger, range read 5 % smaller, by hand."""
    sensor = LevelSensor(noise=[0.0], gain=[10.0], full_scale=5.0, bits=10, offset=[-0.2])
    pumps = PumpBank(low=[0.0], high=[10.0], dead_zone=[2.0], dead_zone_kind="offset")
    widths = {"sensor.gain": [0.5], "sensor.offset": [0.1], "actuator.dead_zone[0]": 0.5}
    safety_filter, (row,) = design(TANK, pumps, sensor, 0.1, widths=widths, limit=[48.0])
    assert float(safety_filter.band[0]) == pytest.approx(0.3 + 0.5 * 10.5 * 5.0 / 1024, rel=1e-12)
    assert row.limit == pytest.approx(47.5) and safety_filter.offset[0] == 1.5
    uncertain = {"sensor.noise": 0.5, "plant.drain": 0.05}
    noisy = case_of(ONE, {"sensor.noise": [0.05]}).replace(uncertain=uncertain)
    assert float(noisy.safety_design()[0].band[0]) == pytest.approx(6 * 0.05 * 1.5, rel=1e-12)


def test_an_interval_that_is_not_counted_with_is_not_proved():
    case = presets.find("gouta2022/enmpc")
    uncertain = {"disturbance.volume": 0.2, "controller.Tp": 0.2}
    plain, _ = case.replace(uncertain={}).safety_design()
    wide, _ = case.replace(uncertain=uncertain).safety_design()
    np.testing.assert_allclose(wide.spare, 1.2 * plain.spare, rtol=1e-12)
    pumps = PumpBank(low=[0.0], high=[10.0])
    _, (row,) = design(TANK, pumps, SENSOR, 0.1, widths={"disturbance.period": 0.1})
    assert not row.certified and "uncertain disturbance.period" in row.reason


@pytest.mark.parametrize(("initial", "proved"), [(40.0, False), (4.0, True)])
def test_inputs_under_way_above_the_limits_of_the_pumps_count(initial, proved):
    case = case_of(BEFORE.replace("40.0 }]", f"{initial} }}]"), {"actuator.delay": 5.0})
    assert case.loop.actuator.initial == initial
    assert case.safety_design()[1][0].certified == proved


def test_a_shared_row_lowers_no_pump_below_its_lower_limit():
    safety_filter, rows = case_of(LOW + SHARED).safety_design()
    assert all(r.certified for r in rows)
    # what is left of M = 0.3 above the lower limits, 0.2 + 0.1 x 0.5 = 0.25, in proportion
    scaled = lambda m: [
        float(v) for v in safety_filter.scaled((3.0, 4.5), [({0: 0.2, 1: 0.1}, m)], (1.0, 0.5))
    ]
    assert scaled(0.3) == pytest.approx([1.0 + 2.0 * 0.05 / 0.8, 0.5 + 4.0 * 0.05 / 0.8])
    assert scaled(0.1) == [1.0, 0.5]  # lower limits win
    pumps = SHARED.replace("low = 1.0", "low = 8.0").replace("initial = 1.0", "initial = 8.0", 1)
    _, rows = case_of(LOW + pumps).safety_design()
    assert not rows[0].certified and "rim condition" in rows[0].reason


def test_second_order_rows_need_a_start():
    loop = presets.find("gouta2015/backstepping").loop
    widths = {"drain": 0.05 * loop.plant.drain, "orifice": 0.05 * loop.plant.orifice}
    for start, proved in ((None, [False, False, True, True]), (loop.x0, [True] * 4)):
        _, rows = design(loop.plant, loop.actuator, loop.sensor, 0.05, widths=widths, start=start)
        assert [r.certified for r in rows] == proved


def test_dead_time_with_a_bottom_needs_a_larger_rate():
    """(N): c_min s(H) <= kappa (H - h_e), h_e = (T c_max)^2, both by hand."""
    plant = network(
        area=[10.0], drain=[0.4], feeds=[(0, None)], pump_gain=[1.0], rim=[5.0], bottom=True
    )
    c, hold = 0.4 * W / 10.0, 0.25
    needed = c * math.sqrt(5.0) / (5.0 - (hold * c) ** 2)
    pumps = PumpBank(low=[0.0], high=[100.0], delay=hold)
    for factor, proved in ((1.001, True), (0.99, False)):
        how = {"widths": {}, "limit": [5.0], "predict": False, "rate": factor * needed}
        _, (row,) = design(plant, pumps, SENSOR, hold, **how)
        assert row.certified == proved and ("(N)" in row.reason) != proved
