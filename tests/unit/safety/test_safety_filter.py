"""The safety filter against plants simulated by a code of its own (`safety_attacks`): corners of
the box, pumps full or switching at random, readings off by the whole band.
"""

import dataclasses
import math

import jax
import numpy as np
import pytest
from safety_attacks import attack, of, random_rig, sensor_of
from scipy.integrate import solve_ivp

from jaxtank import evaluate, presets, rig, with_values
from jaxtank.instruments.actuators import PumpBank
from jaxtank.instruments.sensors import LevelSensor
from jaxtank.plants import network
from jaxtank.safety import design
from jaxtank.safety.box import box_of
from jaxtank.safety.worst_case import PLAIN, fall, rates_of, rise

PRESETS = {
    "gouta2015/backstepping": (0.05, 0.1, 80.0),
    "gouta2022/enmpc": (0.05, 0.1, 150.0),
    "mirakhorli/sfc": (0.1, 0.1, 300.0),
    "calofir/backstepping": (1.0, 0.001, 1500.0),
    "khalid/gpc": (2.0, 0.001, 2000.0),
    "cascaded/pi": (4.0, 0.02, 2000.0),
}


@pytest.mark.slow_for("mirakhorli/sfc", "gouta2022/enmpc", "calofir/backstepping", "khalid/gpc")
@pytest.mark.parametrize("name", PRESETS)
def test_every_tank_of_a_preset_is_certified_and_holds(name):
    hold, eps, seconds = PRESETS[name]
    case = presets.find(name)
    loop, start = case.loop, 0.5 * np.asarray(case.loop.plant.rim)
    given = {"widths": of(loop.plant, 0.05), "band": eps, "start": start}
    given["substeps"] = case.clock.substeps  # a longer step would limit the outflow of cascaded
    found, rows = design(loop.plant, loop.actuator, loop.sensor, hold, **given)
    assert all(r.certified for r in rows)
    low, high = np.maximum(loop.actuator.low, 0.0), np.minimum(loop.actuator.high, 50.0)
    actuator = dataclasses.replace(loop.actuator, low=low, high=high)
    how = {"seconds": seconds, "count": 12, "eps": eps, "start": start}
    highest, _ = attack(loop.plant, actuator, found, hold, 0.05, **how)
    assert np.all(highest <= np.asarray(found.limit) + 1e-9)
    assert np.any(highest > 0.98 * np.asarray(found.limit))  # the attack is one


def test_second_order_rows_and_gaps_are_those_worked_out_by_hand():
    """Of gouta2015: k1 = 0.19 1/s, gap 2 delta c s(H)/kappa = 0.108 cm; of cascaded: k1 = 0.110."""
    loop = presets.find("gouta2015/backstepping").loop
    found, rows = design(loop.plant, loop.actuator, loop.sensor, 0.01, widths=of(loop.plant, 0.05))
    assert found.slope[:2] == pytest.approx(0.19, abs=0.005)
    c = (
        math.sqrt(2 * 981.0)
        * (
            loop.plant.drain[2]
            + sum(loop.plant.orifice[k] for k, (i, _) in enumerate(loop.plant.links) if i == 2)
        )
        / loop.plant.area[2]
    )
    # b_max/b c - c_min = (1.05 - 0.95) c
    assert rows[2].gap == pytest.approx(0.1 * c * math.sqrt(30.0) / 2.0, rel=0.01)
    loop = presets.find("cascaded/pi").loop
    found, _ = design(loop.plant, loop.actuator, loop.sensor, 4.0, widths=of(loop.plant, 0.05))
    assert found.slope[1] == pytest.approx(0.110, abs=0.002)


def one_tank(drain=0.0, inflow=None):
    """A tank with a pump, and above it another with a pump if `inflow` is the orifice between."""
    if inflow is None:
        return network(
            area=[20.0], drain=[drain], feeds=[(0, None)], pump_gain=[8.0], rim=[30.0]
        ), PumpBank(low=[0.0], high=[12.0])
    return network(
        area=20.0,
        drain=[drain, 0.0],
        links=[(1, 0)],
        orifice=[inflow],
        feeds=[(0, None), (1, None)],
        pump_gain=8.0,
        rim=30.0,
    ), PumpBank(low=[0.0, 0.0], high=[12.0, 12.0])


def passes(plant, actuator, found, spread, **how):
    highest, _ = attack(plant, actuator, found, 0.5, spread, seconds=150, count=24, **how)
    return highest > np.asarray(found.limit) + 1e-6


def test_a_rate_above_its_bound_is_not_certified_and_passes_the_limit():
    plant, actuator = one_tank()
    given = {"widths": {}, "limit": 30.0}
    found, (row,) = design(plant, actuator, sensor_of(plant), 0.5, rate=2.0, **given)
    assert row.certified and not passes(plant, actuator, found, 0.0).any()
    found, (row,) = design(plant, actuator, sensor_of(plant), 0.5, rate=2.2, **given)
    assert not row.certified and "2.2 above its bound 2" in row.reason
    assert passes(plant, actuator, found, 0.0).any()


def test_an_inflow_above_the_certain_outflow_lowers_the_tank_above_or_passes():
    plant, actuator = one_tank(drain=0.3, inflow=0.33)
    found, rows = design(plant, actuator, sensor_of(plant), 0.5, widths=of(plant, 0.05))
    assert [r.certified for r in rows] == [True, True]
    expected = 30.0 * (0.95 * 0.3 / (1.05 * 0.33)) ** 2
    assert found.limit[1] == pytest.approx(expected, rel=1e-6)
    assert not passes(plant, actuator, found, 0.05).any()
    raised = dataclasses.replace(found, limit=[30.0, 30.0], reach=[30.0, 30.0])
    assert passes(plant, actuator, raised, 0.05)[0]


def test_swapped_ends_of_the_box_pass_the_limit():
    plant, actuator = one_tank(drain=0.3)
    found, _ = design(plant, actuator, sensor_of(plant), 0.5, widths=of(plant, 0.1))
    wrong = dataclasses.replace(
        found, least=dataclasses.replace(found.least, drain=found.most.drain)
    )
    assert not passes(plant, actuator, found, 0.1).any()
    assert passes(plant, actuator, wrong, 0.1).any()


@pytest.mark.parametrize("delay", [1, 5])
def test_a_dead_time_needs_a_smaller_rate(delay):
    plant, actuator = one_tank()
    delayed = dataclasses.replace(actuator, delay=0.5 * delay)
    given = {"widths": {}, "limit": 30.0, "predict": False}
    _, (row,) = design(plant, delayed, sensor_of(plant), 0.5, **given)
    assert row.rate_bound == pytest.approx(delay**delay / (delay + 1) ** (delay + 1) / 0.5)
    at_bound, _ = design(plant, delayed, sensor_of(plant), 0.5, rate=row.rate_bound, **given)
    start = np.array([0.5])
    assert not passes(plant, delayed, at_bound, 0.0, delay=delay, start=start).any()
    forgotten, (row,) = design(plant, actuator, sensor_of(plant), 0.5, **given)
    assert row.certified  # for a rig without it
    assert passes(plant, delayed, forgotten, 0.0, delay=delay, start=start).any()


@pytest.mark.parametrize("seed", range(3))
def test_filter_and_certificate_reckon_with_the_same_rates(seed):
    """Compiled into the loop, and in plain numbers before a run."""
    rng = np.random.default_rng(seed)
    plant, _ = random_rig(rng)
    plant = dataclasses.replace(plant, bottom=seed % 2 == 0)
    inflow = rng.uniform(0.0, 5.0, plant.tanks)
    rates = rates_of(*box_of(plant, of(plant, 0.1)), inflow, 0.5, draw=-inflow)
    for _ in range(20):
        others = rng.uniform(0.0, 40.0, plant.tanks)
        tank, level = int(rng.integers(plant.tanks)), float(rng.choice([0.0, 0.005, 0.1, 12.0]))
        expected = float(rise(rates, tank, level, tuple(others)))
        assert rise(rates, tank, level, others, PLAIN) == pytest.approx(
            expected, rel=1e-12, abs=1e-12
        )
        expected = float(fall(rates, tank, level, tuple(others)))
        assert fall(rates, tank, level, others, PLAIN) == pytest.approx(
            expected, rel=1e-12, abs=1e-12
        )


@pytest.mark.parametrize("delay", [3, 20])
def test_inputs_under_way_at_the_start_can_pass_the_limit(delay):
    """(S): pumps at full before t = 0, of which `delay` samples are under way."""
    plant, actuator = one_tank()
    given = {"widths": {}, "limit": 30.0, "start": [29.0], "predict": False}
    for before, proved in ((0.0, True), (12.0, False)):
        pumps = dataclasses.replace(actuator, delay=0.5 * delay, initial=np.array([before]))
        found, (row,) = design(plant, pumps, sensor_of(plant), 0.5, **given)
        assert row.certified == proved and row.reason.startswith("Theorem 3" if proved else "(S)")
        how = {"delay": delay, "start": np.array([29.0]), "before": before}
        assert passes(plant, pumps, found, 0.0, **how).any() != proved
    assert "4.8 cm/s under way" in row.reason


def test_the_default_rate_follows_from_the_noise_of_the_readings():
    """1 % of the range from sample to sample: 0.01 x 12 V x b_max/(sqrt(2) sigma), by hand; and the
    spread of the caps of readings at one level is that. Never below c_min/sqrt(H).
    """
    plant, actuator = one_tank(drain=0.3)
    b_max, sigma = 8.8 / 20.0, 0.03
    rate = lambda noise, **given: design(
        plant, actuator, LevelSensor(noise=[noise]), 0.1, widths=of(plant, 0.1), band=0.1, **given
    )
    assert rate(0.0)[1][0].rate == 2.0 and rate(sigma, rate=1.7)[1][0].rate == 1.7
    found, (row,) = rate(sigma)
    assert row.rate == pytest.approx(0.01 * 12.0 * b_max / (math.sqrt(2.0) * sigma), rel=1e-12)
    y = 29.5 + sigma * np.random.default_rng(0).standard_normal(2000)
    cap = jax.vmap(lambda y: found.limits((y,), 0.1, (0.0,), (12.0,))[0][0])(y)
    assert np.std(np.diff(cap)) / 12.0 == pytest.approx(0.01, rel=0.06)
    slowest = 0.27 * math.sqrt(2 * 981.0) / 20.0 / math.sqrt(30.0)
    assert rate(100.0)[1][0].rate == pytest.approx(slowest, rel=1e-12)


def rate_by_hand(c, area, pumped):
    """(rate for scipy) of one tank: pumped [cm^3/s] less what leaves, c in cm^2.5/s."""
    return lambda t, h: [(pumped - c * math.sqrt(max(h[0], 0.0))) / area]


def test_one_tank_with_scipy_and_the_cap_written_apart():
    """The worst plant of the box (least drain, strongest pump) under the cap as printed in the
    README of jaxtank/safety, integrated by scipy, is the run of `attack` and stays below.
    """
    plant, actuator = one_tank(drain=0.3)
    found, _ = design(plant, actuator, sensor_of(plant), 0.5, widths=of(plant, 0.1))
    w, kappa = math.sqrt(2 * 981.0), float(found.rate[0])
    c_min, b_max, h = 0.27 * w / 20.0, 8.8 / 20.0, 1.0
    for _ in range(150):
        cap = max(0.0, c_min * math.sqrt(h) + kappa * (30.0 - h)) / b_max
        caps, _ = found.limits((h,), 0.5, (0.0,), (12.0,))
        assert float(caps[0]) == pytest.approx(min(cap, 12.0), rel=1e-12)
        u = min(12.0, cap)
        field = rate_by_hand(0.27 * w, 20.0, 8.8 * u)
        h = solve_ivp(field, (0.0, 0.5), [h], rtol=1e-10, atol=1e-12).y[0, -1]
        assert h <= 30.0 + 1e-9
    assert h == pytest.approx(30.0, abs=1e-3)  # the worst plant comes to rest at its limit


ROWS = {
    # nominal error [cm] of the published gains by clipping and by box QP (a prototype of its own)
    "gouta2015/backstepping": (0.5063, 0.5166, None),
    "gouta2015/backstepping-ff": (0.1160, 0.1817, None),
    "gouta2015/ngpc": (0.0821, 0.1683, 0.0866),
    "cascaded/pi": (0.7415, 0.7534, 0.7534),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", ["gouta2015/ngpc", "cascaded/pi"])
def test_the_filtered_loop_has_the_errors_of_an_independent_prototype(name):
    case = presets.find(name)
    loop = case.loop
    given = {"widths": of(loop.plant, 0.05), "start": loop.x0}
    found, _ = design(loop.plant, loop.actuator, loop.sensor, case.clock.dt, **given)

    @jax.jit
    def error(loop):
        names = ["mean_square_error", "max_level", "filter_active_fraction"]
        of = evaluate(loop, case.clock, names)
        found = of["mean_square_error"].sum(), of["max_level"].max(), of[names[2]]
        return jax.numpy.sqrt(found[0]), *found[1:]

    clipped = dataclasses.replace(found, allocate=False)
    without, by_clip, by_qp = ROWS[name]
    value, _, acts = error(loop)
    assert float(value) == pytest.approx(without, abs=2e-4) and acts == 0.0
    value, highest, acts = error(dataclasses.replace(loop, safety_filter=clipped))
    assert 0.0 < acts < 1.0
    assert float(value) == pytest.approx(by_clip, abs=1e-4) and highest <= loop.plant.rim.max()
    value, highest, _ = error(dataclasses.replace(loop, safety_filter=found))
    assert float(value) == pytest.approx(by_qp, abs=1e-4) and highest <= loop.plant.rim.max()


@pytest.mark.parametrize(
    ("name", "gain", "value", "duration"),
    [
        pytest.param("gouta2015/ngpc", "controller.Tp", 9.0, 600.0, marks=pytest.mark.slow),
        ("cascaded/pi", "controller.Kc", 2.0, 2000.0),
    ],
)
def test_gradients_through_the_filter_are_central_differences(name, gain, value, duration):
    case = presets.find(name)
    loop, clock = case.loop, dataclasses.replace(case.clock, duration=duration)
    found, _ = design(loop.plant, loop.actuator, loop.sensor, clock.dt, widths=of(loop.plant, 0.05))
    loop = dataclasses.replace(loop, safety_filter=found)

    def cost(theta):
        rate = theta[1] * np.ones(loop.plant.tanks)
        values = {gain: theta[0], "safety_filter.rate": rate}
        found = evaluate(with_values(loop, values), clock, ["mean_square_error"])
        return found["mean_square_error"].sum()

    theta = np.array([value, 0.85 * float(found.rate[0])])
    both = jax.jit(jax.vmap(lambda t, e: jax.jvp(cost, (t,), (e,)), in_axes=(None, 0)))
    at = lambda theta: both(theta, np.eye(2))  # one program for the cost and its slopes
    slopes = at(theta)[1]
    for i, step in enumerate([1e-4, 1e-5]):
        e = np.eye(2)[i] * step
        central = float(at(theta + e)[0][0] - at(theta - e)[0][0]) / (2 * step)
        assert float(slopes[i]) == pytest.approx(central, rel=2e-5, abs=1e-9)
    assert abs(slopes[1]) > 1e-7


SENSOR_RIG = """
name = "one tank"
tank = [{ area = 10.0, rim = 20.0, drain = 0.05, level = 5.0 }]
pump = [{ gain = 3.0, to = 1, high = 10.0, initial = 1.5 }]
controller = { kind = "pi", Kc = 5.0, Ti = 20.0 }
reference = { initial = [5.0], changes = [[5.0, 1, 19.0]] }
values = { "clock.dt" = 0.5, "clock.duration" = 200.0, "sensor.noise" = [0.01] }
limits = { max_level = 19.5 }
safety_filter = {}
"""


@pytest.mark.parametrize(
    "fault",
    [
        'kind = "offset", size = -4.0',
        'kind = "drift", size = -0.05',
        'kind = "noise", size = 2.0',
        'kind = "spikes", size = -4.0, every = 10.0',
        'kind = "freeze"',
    ],
)
def test_nothing_is_proved_where_a_sensor_is_faulty(fault):
    faulty = f"fault = [{{ sensor = 1, start = 20.0, end = 200.0, {fault} }}]\n"
    case = rig.loads(SENSOR_RIG + faulty)
    (row,) = case.safety_design()[1]
    assert not row.certified and "faults" in row.reason
    (sound,) = rig.loads(SENSOR_RIG).safety_design()[1]
    assert sound.certified
    if "offset" in fault:  # the filter believes the reading, and the limit is passed
        highest = evaluate(case.loop, case.clock, ["max_level"], key=jax.random.key(0))
        assert float(np.max(highest["max_level"])) > 19.5 + 1.0
