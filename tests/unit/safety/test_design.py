"""Rigs on which limits were called proved and passed: each is certified and holds under attack, or
is not certified and says why. Levels by a Runge-Kutta method of its own, inputs from the filter.
"""

import dataclasses
import math

import jax
import numpy as np
import pytest

from jaxtank import presets, rig
from jaxtank.instruments.actuators import PumpBank
from jaxtank.instruments.sensors import LevelSensor
from jaxtank.plants import network
from jaxtank.safety import design

HEAD = 'name = "{0}"\nvalues = {{ "clock.dt" = 0.1, "clock.duration" = 200.0{1} }}\n'
LAW = 'law = {{ kind = "open-loop", initial = {0} }}\nplant = {{ outputs = {1}{2} }}\n'
UNTOUCHED = "reachable = false\n"


def case_of(text, values="", pumps=2, outputs="[1, 2]", plant=""):
    """The Case of a rig file with the lines `text`, under a law that the attack replaces."""
    head = HEAD.format("rig", values) + LAW.format([0.0] * pumps, outputs, plant)
    return rig.loads(head + UNTOUCHED + text)


def root(h):
    return np.sqrt(np.maximum(h, 0.0))


def rates(plant, p, x, v):
    """Rates (P, n) [cm/s] of plants with flows p, by Torricelli's law."""
    w, flow = math.sqrt(2.0 * float(plant.gravity)), np.zeros_like(x)
    q = w * root(x)
    flow -= p["drain"] * q
    for k, (i, j) in enumerate(plant.links):
        passed = p["orifice"][:, k] * q[:, i]
        flow[:, i] -= passed
        flow[:, j] += passed
    for k, (i, j) in enumerate(plant.feeds):
        pumped = p["pump_gain"][:, k] * v[:, k]
        share = 1.0 if j is None else float(plant.split[k])
        flow[:, i] += share * pumped
        if j is not None:
            flow[:, j] += (1.0 - share) * pumped
    for k, (i, j) in enumerate(plant.spills):  # a full tank passes on what it cannot take
        over = np.where(x[:, i] >= float(plant.rim[i]) - 1e-9, np.maximum(flow[:, i], 0.0), 0.0)
        flow[:, i] -= over
        flow[:, j] += float(plant.caught[k]) * over
    return flow / np.asarray(plant.area)


def highest(case, guard, seconds, lag=None, off=0.0, spread=0.05, count=24, substeps=5, seed=0):
    """((n,) highest levels [cm], (m,) least inputs [V]): pumps at full, and switching at random, on
    corners of the box from the case's start, with readings lower than the levels by `off` [cm].
    """
    rng = np.random.default_rng(seed)
    loop, hold = case.loop, case.clock.dt
    plant, pumps = loop.plant, loop.actuator
    p = {}
    for name, worst in (("drain", -1.0), ("orifice", 1.0), ("pump_gain", 1.0)):
        value = np.asarray(getattr(plant, name), float)
        sign = rng.choice([-1.0, 1.0], (count, len(value)))
        sign[::2] = worst
        sign[::2, 1:] *= -1.0 if name == "orifice" else 1.0  # much in at the top, little out
        p[name] = value * (1.0 + spread * sign)
    low, high = np.asarray(pumps.low, float), np.asarray(pumps.high, float)

    @jax.jit
    @jax.vmap
    def filtered(y, u):
        clipping = dataclasses.replace(guard, allocate=False)
        return jax.numpy.stack(clipping.apply(pumps, tuple(u), None, tuple(y), hold)[0])

    x = np.tile(np.asarray(loop.x0, float), (count, 1))
    v = np.tile(np.asarray(pumps.initial, float), (count, 1))
    line = [v] * round(pumps.delay / hold)
    lag = np.zeros(len(low)) if lag is None else np.asarray(lag, float)
    first = (np.arange(count) // 2 % len(low))[:, None] == np.arange(len(low))
    joins = rng.uniform(0.6 * seconds, seconds, (count, 1))
    top, least, step = x.copy(), np.full(len(low), np.inf), hold / substeps
    keep = np.where(lag > 0.0, np.exp(-step / np.where(lag > 0.0, lag, 1.0)), 0.0)
    for k in range(round(seconds / hold)):
        if k % 30 == 0:
            want = np.where(rng.random((count, len(low))) < 0.5, low, high)
            # a third with all pumps at full, a third with one, and later the others in its place
            one = np.where(first == (k * hold < joins), high, low)
            part = (3 * np.arange(count) // count)[:, None]
            want = np.where(part == 0, high, np.where(part == 1, one, want))
        u = np.asarray(filtered(x - off, want))
        least = np.minimum(least, u.min(0))
        line.append(u)
        u = line.pop(0)
        for _ in range(substeps):
            before, v = v, u + keep * (v - u)
            mean = u + np.where(lag > 0.0, lag / step * (before - v), 0.0)
            a = rates(plant, p, x, mean)
            b = rates(plant, p, x + 0.5 * step * a, mean)
            c = rates(plant, p, x + 0.5 * step * b, mean)
            d = rates(plant, p, x + step * c, mean)
            x = x + step / 6.0 * (a + 2.0 * b + 2.0 * c + d)
            x = np.minimum(x, plant.rim) if plant.overflow else x
            top = np.maximum(top, x)
    return top.max(0), least


def designed(case, **settings):
    return case.safety_design(**settings)


CHAIN = """
tank = [
  { area = 21.2, rim = 30.0, drain = 0.0, level = 0.5 },
  { area = 21.2, rim = 30.0, drain = 0.1857, level = 4.0 },
  { area = 21.2, rim = 30.0, drain = 0.0, level = 0.5 },
]
orifice = [{ from = 3, to = 1, area = 0.19 }, { from = 1, to = 2, area = 0.2059 }]
pump = [{ gain = 7.7, to = 3, low = 0.0, high = 12.0, initial = 1.0 }]
"""


@pytest.mark.parametrize(("third", "drain"), [(0.19, 0.1857), (0.18, 0.12)])
def test_k1_is_chosen_again_where_a_limit_is_lowered(third, drain):
    """With k1 for 30 cm and a limit of 19.98 cm the level of tank 1 rose 0.64 cm above it."""
    text = CHAIN.replace("0.1857", f"{drain}").replace("0.19 }", f"{third} }}")
    case = case_of(text, pumps=1, outputs="[2]")
    guard, rows = designed(case)
    assert all(r.certified for r in rows)
    top, _ = highest(case, guard, 300.0)
    assert np.all(top <= [r.limit + 1e-9 for r in rows])
    w = math.sqrt(2 * 981.0) / 21.2
    for tank, source, orifice in ((0, 2, third), (1, 0, 0.2059)):  # by hand: C2, or the rim
        limit = np.array([r.limit for r in rows])
        enters = 1.05 * orifice * w * math.sqrt(limit[source])
        leaves = 0.95 * (0.2059 if tank == 0 else drain) * w * math.sqrt(limit[tank])
        assert enters <= max(leaves, guard.slope[tank] * limit[tank]) * (1.0 + 1e-9)


RING = """
tank = [
  { area = 50.0, rim = 40.0, drain = 0.02, level = 4.56 },
  { area = 50.0, rim = 40.0, drain = 0.0, level = 5.57 },
]
orifice = [{ from = 1, to = 2, area = 0.3 }, { from = 2, to = 1, area = 0.3 }]
pump = [{ gain = 20.0, to = 1, low = 0.0, high = 10.0, initial = 0.0 }]
"""


def test_a_ring_of_orifices_without_a_limit_that_can_be_kept_is_not_certified():
    _, rows = designed(case_of(RING, pumps=1, outputs="[1]"))
    assert not any(r.certified for r in rows)
    assert all("rim condition" in r.reason for r in rows)
    assert [r.limit for r in rows] == [40.0, 40.0]  # not what the sweeps have come to


def test_a_ring_of_orifices_that_meets_the_rim_condition_is_certified_and_holds():
    """H2 = f^2 H1 with f = .95 (.3 + .2)/(1.05 .3) > 1: both rims can be kept."""
    case = case_of(
        RING.replace("drain = 0.02", "drain = 0.2").replace("0.0, lev", "0.2, lev"), pumps=1
    )
    guard, rows = designed(case)
    assert all(r.certified for r in rows)
    assert np.all(highest(case, guard, 200.0)[0] <= [r.limit + 1e-9 for r in rows])


LAGS = """
tank = [
  { area = 200.0, rim = 40.0, drain = 0.5, level = 5.0 },
  { area = 200.0, rim = 60.0, drain = 0.3, level = 5.0 },
]
pump = [
  { gain = 20.0, to = 1, low = 0.0, high = 10.0, initial = 0.0 },
  { gain = 20.0, to = [1, 2], split = 0.3, low = 0.0, high = 10.0, initial = 0.0 },
]
"""


@pytest.mark.parametrize("lag", [[2.0, 0.01], [2.0, 0.0], [0.5, 3.0]])
def test_pumps_with_different_lags_have_a_row_each(lag):
    case = case_of(LAGS, f', "actuator.lag" = {lag}')
    guard, rows = designed(case)
    assert guard.divided == (0,) and all(r.certified for r in rows)
    top, _ = highest(case, guard, 200.0, lag=lag)
    assert np.all(top <= [r.limit + 1e-9 for r in rows]) and top[0] > 0.97 * rows[0].limit
    together = dataclasses.replace(guard, divided=())  # one row bounds the commands only
    assert lag[1] > 1.0 or highest(case, together, 200.0, lag=lag)[0][0] > rows[0].limit + 0.05


def test_a_divided_row_gives_each_pump_its_share_of_full_pumps():
    case = case_of(LAGS, ', "actuator.lag" = [2.0, 0.01]')
    guard, _ = designed(case, rate=0.1)
    y, w = (39.0, 5.0), math.sqrt(2 * 981.0) / 200.0
    caps, shared = guard.limits(y, 0.1, (0.0, 0.0), (10.0, 10.0))
    m = 0.95 * 0.5 * w * math.sqrt(39.0) + 0.1 * (40.0 - 39.0)
    full = 10.0 * 1.05 * 20.0 * (1.0 + 1.05 * 0.3) / 200.0
    assert shared == []
    assert [float(c) for c in caps] == pytest.approx([10.0 * m / full] * 2, rel=1e-12)


SPILL = """
tank = [
  { area = 50.0, rim = 20.0, drain = 0.1, level = 5.0 },
  { area = 50.0, rim = 40.0, drain = DRAIN, level = 5.0 },
]
spill = [{ from = 1, to = 2, caught = 1.0 }]
"""
BOTH = """
pump = [
  { gain = 20.0, to = 1, low = 0.0, high = 10.0, initial = 0.0 },
  { gain = 20.0, to = 2, low = 0.0, high = 10.0, initial = 0.0 },
]
"""


@pytest.mark.parametrize(("drain", "proved"), [(0.3, False), (1.5, True)])
def test_what_spills_from_a_limit_above_the_rim_counts_as_inflow(drain, proved):
    """210 cm^3/s of full pumps less .095 s(2 g 20) = 18.8 cm^3/s over the rim of 20 cm, by hand."""
    text = SPILL.replace("DRAIN", str(drain)) + BOTH
    case = case_of(text, plant=", overflow = true")
    guard, rows = designed(case, limit=[25.0, 20.0])
    assert rows[1].certified == proved
    assert guard.inflow[1] == pytest.approx(210.0 - 0.095 * math.sqrt(2 * 981.0 * 20.0), rel=1e-9)
    top, _ = highest(case, guard, 200.0)
    assert (top[1] <= 20.0 + 1e-9) == proved
    dry = dataclasses.replace(guard, inflow=np.zeros(2))
    assert highest(case, dry, 200.0)[0][1] > 20.1


def test_a_tank_that_is_not_proved_spills():
    plant = network(
        area=50.0,
        drain=[0.2, 0.3],
        feeds=[(1, None)],
        pump_gain=[20.0],
        rim=[20.0, 40.0],
        spills=[(0, 1)],
        caught=[1.0],
        overflow=True,
    )
    given = {"widths": {"drain": [0.01, 0.015]}, "limit": 20.0, "start": [5.0, 5.0]}
    sensor = LevelSensor(noise=np.zeros(2))
    pumps = PumpBank(low=[0.0], high=[10.0])
    guard, rows = design(plant, pumps, sensor, 0.1, inflow=[150.0, 0.0], **given)
    assert [r.certified for r in rows] == [False, False]
    assert guard.inflow[1] == pytest.approx(150.0 - 0.19 * math.sqrt(2 * 981.0 * 20.0), rel=1e-9)
    _, rows = design(plant, pumps, sensor, 0.1, inflow=[30.0, 0.0], **given)
    assert [r.certified for r in rows] == [True, True]


START = """
tank = [
  { area = 50.0, rim = 100.0, drain = 0.0, level = 80.0 },
  { area = 10.0, rim = 100.0, drain = 0.34, level = 19.0 },
]
orifice = [{ from = 1, to = 2, area = 0.3 }]
pump = [
  { gain = 5.0, to = 1, low = 0.0, high = 5.0, initial = 0.0 },
  { gain = 5.0, to = 2, low = 0.0, high = 5.0, initial = 0.0 },
]
limits = { max_level = [20.0, 20.0] }
"""


def test_a_start_above_the_limit_counts_for_the_tanks_below():
    case = case_of(START)
    guard, rows = designed(case)
    assert not any(r.certified for r in rows) and rows[0].reach >= 80.0
    assert "relies on tank 1" in rows[1].reason
    top, _ = highest(case, guard, 100.0)
    assert np.all(top <= [r.reach + 1e-9 for r in rows])


ONE = "tank = [{ area = 100.0, rim = 40.0, drain = 0.5, level = 5.0 }]\n"
ONE += "pump = [{ gain = 20.0, to = 1, low = 0.0, high = 10.0, initial = INITIAL }]\n"


def test_the_lag_is_the_largest_of_the_stated_tolerance():
    uncertain = (
        'uncertain = { "actuator.lag" = 0.9, "plant.drain" = 0.05, "plant.pump_gain" = 0.05 }\n'
    )
    text = ONE.replace("INITIAL", "0.0") + uncertain
    case = case_of(text, ', "actuator.lag" = [2.0]', 1, "[1]")
    guard, (row,) = designed(case)
    tau, a = 3.8, 0.1  # the bound by hand: max of sigma (1 - tau sigma) e^(-sigma a)
    sigma = np.linspace(1e-3, 1.0, 100001)
    bound = np.max(sigma * (1.0 - tau * sigma) * np.exp(-sigma * a))
    assert row.certified and row.rate_bound == pytest.approx(bound, rel=1e-6)
    assert highest(case, guard, 200.0, lag=[3.8])[0][0] <= 40.0 + 1e-9
    fast, _ = designed(case.replace(uncertain={"plant.drain": 0.05, "plant.pump_gain": 0.05}))
    assert highest(case, fast, 200.0, lag=[3.8])[0][0] > 40.0 + 0.05


def test_the_band_is_that_of_the_largest_noise():
    uncertain = (
        'uncertain = { "sensor.noise" = 0.5, "plant.drain" = 0.05, "plant.pump_gain" = 0.05 }\n'
    )
    text = ONE.replace("INITIAL", "0.0") + uncertain
    case = case_of(text, ', "sensor.noise" = [0.05]', 1, "[1]")
    guard, (row,) = designed(case)
    assert row.certified and float(guard.band[0]) == pytest.approx(6 * 0.05 * 1.5, rel=1e-12)
    assert highest(case, guard, 200.0, off=0.45)[0][0] <= 40.0 + 1e-9


def test_sensor_and_pumps_count_with_the_ends_of_their_tolerances():
    """ADC of 10 bits: half a step of gain and range 5 % larger, range read 5 % smaller, by hand."""
    plant = network(area=[50.0], drain=[0.5], feeds=[(0, None)], pump_gain=[20.0], rim=[40.0])
    sensor = LevelSensor(noise=[0.0], gain=[10.0], full_scale=5.0, bits=10, offset=[-0.2])
    pumps = PumpBank(low=[0.0], high=[10.0], dead_zone=[2.0], dead_zone_kind="offset")
    widths = {"sensor.gain": [0.5], "sensor.offset": [0.1], "actuator.dead_zone[0]": 0.5}
    guard, (row,) = design(plant, pumps, sensor, 0.1, widths=widths, limit=[48.0])
    assert float(guard.band[0]) == pytest.approx(0.3 + 0.5 * 10.5 * 5.0 / 1024, rel=1e-12)
    assert row.limit == pytest.approx(47.5) and guard.offset[0] == 1.5


def test_an_interval_that_is_not_counted_with_is_not_proved():
    case = presets.find("gouta2022/enmpc")
    case = case.replace(uncertain={"disturbance.volume": 0.2, "controller.Tp": 0.2})
    plain, _ = case.replace(uncertain={}).safety_design()
    guard, _ = case.safety_design()
    np.testing.assert_allclose(guard.spare, 1.2 * plain.spare, rtol=1e-12)
    plant = network(area=[50.0], drain=[0.5], feeds=[(0, None)], pump_gain=[20.0], rim=[40.0])
    pumps, sensor = PumpBank(low=[0.0], high=[10.0]), LevelSensor(noise=[0.0])
    _, (row,) = design(plant, pumps, sensor, 0.1, widths={"disturbance.period": 0.1})
    assert not row.certified and "uncertain disturbance.period" in row.reason


@pytest.mark.parametrize(("initial", "proved"), [(40.0, False), (4.0, True)])
def test_inputs_under_way_above_the_limits_of_the_pumps_count(initial, proved):
    text = ONE.replace("INITIAL", str(initial)).replace("high = 10.0", "high = 4.0")
    text = text.replace("100.0", "50.0")
    case = case_of(text, ', "actuator.delay" = 5.0', 1, "[1]")
    _, (row,) = designed(case)
    assert row.certified == proved


LOW = """
tank = [
  { area = 50.0, rim = 20.0, drain = 0.5, level = 15.0 },
  { area = 50.0, rim = 60.0, drain = 0.3, level = 5.0 },
]
pump = [
  { gain = 20.0, to = 1, low = 1.0, high = 10.0, initial = 1.0 },
  { gain = 20.0, to = [1, 2], split = 0.3, low = 0.5, high = 10.0, initial = 1.0 },
]
"""


def test_a_shared_row_lowers_no_pump_below_its_lower_limit():
    case = case_of(LOW)
    guard, rows = designed(case)
    assert all(r.certified for r in rows)
    top, least = highest(case, guard, 200.0)
    assert np.all(top <= [r.limit + 1e-9 for r in rows])
    assert np.all(least >= [1.0, 0.5]) and top[0] > 0.999 * rows[0].limit
    # what is left of M = 0.3 above the lower limits, 0.2 + 0.1 x 0.5 = 0.25, in proportion
    u = guard.scaled((3.0, 4.5), [({0: 0.2, 1: 0.1}, 0.3)], (1.0, 0.5))
    assert [float(v) for v in u] == pytest.approx([1.0 + 2.0 * 0.05 / 0.8, 0.5 + 4.0 * 0.05 / 0.8])
    u = guard.scaled((3.0, 4.5), [({0: 0.2, 1: 0.1}, 0.1)], (1.0, 0.5))
    assert [float(v) for v in u] == [1.0, 0.5]  # lower limits win


def test_lower_limits_that_a_tank_cannot_lose_are_a_failed_condition():
    text = LOW.replace("low = 1.0", "low = 8.0").replace("initial = 1.0", "initial = 8.0", 1)
    _, rows = designed(case_of(text))
    assert not rows[0].certified and "rim condition" in rows[0].reason


def test_second_order_rows_need_a_start():
    loop = presets.find("gouta2015/backstepping").loop
    widths = {"drain": 0.05 * loop.plant.drain, "orifice": 0.05 * loop.plant.orifice}
    given = {"widths": widths}
    _, rows = design(loop.plant, loop.actuator, loop.sensor, 0.05, **given)
    assert [r.certified for r in rows] == [False, False, True, True]
    _, rows = design(loop.plant, loop.actuator, loop.sensor, 0.05, start=loop.x0, **given)
    assert all(r.certified for r in rows)


def test_dead_time_with_a_bottom_needs_a_larger_rate():
    """(N): c_min s(H) <= kappa (H - h_e), h_e = (T c_max)^2, both by hand."""
    plant = network(
        area=[10.0], drain=[0.4], feeds=[(0, None)], pump_gain=[1.0], rim=[5.0], bottom=True
    )
    c, hold = 0.4 * math.sqrt(2 * 981.0) / 10.0, 0.25
    needed = c * math.sqrt(5.0) / (5.0 - (hold * c) ** 2)
    pumps, sensor = PumpBank(low=[0.0], high=[100.0], delay=hold), LevelSensor(noise=[0.0])
    given = {"widths": {}, "limit": [5.0], "predict": False}
    for factor, proved in ((1.001, True), (0.99, False)):
        _, (row,) = design(plant, pumps, sensor, hold, rate=factor * needed, **given)
        assert row.certified == proved and ("(N)" in row.reason) != proved
