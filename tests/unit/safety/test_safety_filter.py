"""The safety filter against plants simulated by a code of its own: corners of the box, pumps full
or switching at random, readings off by the whole band.
"""

import dataclasses
import math

import jax
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from jaxtank import evaluate, presets, with_values
from jaxtank.instruments.actuators import PumpBank
from jaxtank.instruments.sensors import LevelSensor
from jaxtank.plants import network
from jaxtank.safety import design
from jaxtank.safety.box import box_of, widths_of
from jaxtank.safety.certificate import rate_bound
from jaxtank.safety.setting import phi
from jaxtank.safety.worst_case import rates_of, rise

NAMES = ("drain", "orifice", "pipe", "pump_gain", "split")


def of(plant, share):
    """Half widths of the box of plants whose flows are off by up to `share`."""
    return widths_of(plant, dict.fromkeys(NAMES, share))


def root(h, knee):
    h = np.maximum(h, 0.0)
    x = h / knee
    return np.where(h >= knee, np.sqrt(h), math.sqrt(knee) * (1.5 * x - 0.5 * x * x))


def derivative(plant, p, x, u):
    """Rates (P, n) [cm/s] of P plants with parameters p, levels x (P, n), inputs u (P, m)."""
    w, n = math.sqrt(2.0 * float(plant.gravity)), plant.tanks
    q = np.stack([root(x[:, i], plant.knee) for i in range(n)], axis=1) * w
    flow = -p["drain"] * q
    for k, (i, j) in enumerate(plant.links):
        flow[:, i] -= p["orifice"][:, k] * q[:, i]
        flow[:, j] += p["orifice"][:, k] * q[:, i]
    for k, (i, j) in enumerate(plant.pipes):
        z = x[:, i] - x[:, j]
        s = w * p["pipe"][:, k] * z / (z * z + plant.knee**2) ** 0.25
        flow[:, i] -= s
        flow[:, j] += s
    for k, (i, j) in enumerate(plant.feeds):
        pumped = p["pump_gain"][:, k] * u[:, k]
        share = p["split"][:, k] if j is not None else 1.0
        flow[:, i] += share * pumped
        if j is not None:
            flow[:, j] += (1.0 - share) * pumped
    return flow / np.asarray(plant.area)


def attack(
    plant,
    actuator,
    found,
    hold,
    spread,
    *,
    seconds,
    start=None,
    count=60,
    seed=0,
    substeps=4,
    delay=0,
    lag=0.0,
    eps=0.0,
):
    """Highest level (n,) [cm] over plants at random corners of the box, starts at or below `start`
    and readings off by +-eps; a third with pumps full, the rest switching at random.
    """
    rng = np.random.default_rng(seed)
    n, m, limit = plant.tanks, plant.pumps, np.asarray(found.limit)
    p = {}
    for name in NAMES:
        value = np.asarray(getattr(plant, name), dtype=float)
        off = rng.choice([-1.0, 1.0], (count, *value.shape)) * spread
        p[name] = value * (1.0 + off)
    p["split"] = np.minimum(p["split"], 1.0)
    low, high = np.asarray(actuator.low, float), np.asarray(actuator.high, float)

    @jax.jit
    @jax.vmap
    def filtered(y, u):
        caps, shared = found.limits(tuple(y), hold, tuple(low), tuple(high))
        u = tuple(jax.numpy.clip(u[j], low[j], caps[j]) for j in range(m))
        return jax.numpy.stack(found.scaled(u, shared))

    start = limit if start is None else np.minimum(start, limit)
    x = rng.uniform(0.2, 1.0, (count, 1)) * start * rng.uniform(0.0, 1.0, (count, n)) ** 0.3
    x[: count // 4] = start
    line, turning = [np.zeros((count, m)) for _ in range(delay)], np.zeros((count, m))
    want, highest = np.broadcast_to(high, (count, m)).copy(), x.max(0)
    for k in range(int(seconds / hold)):
        if k % max(1, int(2.0 / hold)) == 0:
            switched = np.where(rng.random((count, m)) < 0.5, low, high)
            want = np.where((np.arange(count) % 3 == 0)[:, None], high, switched)
        y = x + eps * rng.choice([-1.0, 1.0], (count, n))
        u = np.asarray(filtered(y, want))
        line.append(u)
        u = line.pop(0)
        h = hold / substeps
        for _ in range(substeps):
            if lag:
                after = u + (turning - u) * math.exp(-h / lag)
                v = u + lag / h * (1.0 - math.exp(-h / lag)) * (turning - u)
                turning = after
            else:
                v = u
            a = derivative(plant, p, x, v)
            b = derivative(plant, p, x + 0.5 * h * a, v)
            c = derivative(plant, p, x + 0.5 * h * b, v)
            d = derivative(plant, p, x + h * c, v)
            x = x + h / 6.0 * (a + 2 * b + 2 * c + d)
            highest = np.maximum(highest, x.max(0))
    return highest


def random_rig(rng):
    """A rig of 1 to 4 tanks with random orifices, pipes, splits and pumps, and its PumpBank."""
    n = int(rng.integers(1, 5))
    links = [(i, j) for i in range(n) for j in range(i + 1, n) if rng.random() < 0.5]
    free = [(i, j) for i in range(n) for j in range(i + 1, n) if (i, j) not in links]
    pipes = [pair for pair in free if rng.random() < 0.3]
    feeds = []
    for _ in range(int(rng.integers(1, 3))):
        first, second = int(rng.integers(n)), int(rng.integers(n))
        feeds.append((first, second if n > 1 and second != first and rng.random() < 0.5 else None))
    plant = network(
        area=rng.uniform(10, 60, n),
        drain=rng.uniform(0.05, 0.6, n),
        links=links,
        orifice=rng.uniform(0.05, 0.4, len(links)),
        pipes=pipes,
        pipe=rng.uniform(0.05, 0.4, len(pipes)),
        feeds=feeds,
        pump_gain=rng.uniform(2, 15, len(feeds)),
        split=rng.uniform(0.2, 0.8, len(feeds)),
        rim=rng.uniform(15, 40, n),
        outputs=(0,),
    )
    return plant, PumpBank(low=np.zeros(len(feeds)), high=np.full(len(feeds), 12.0))


def certified_or_below(found, rows, highest):
    return [r.tank for r in rows if r.certified and highest[r.tank] > r.limit + 1e-9]


def trial(seed):
    """(rows of the certificate, highest levels under attack [cm]) of a random rig."""
    rng = np.random.default_rng(seed)
    plant, actuator = random_rig(rng)
    hold, spread = float(rng.choice([0.1, 0.5, 1.0])), float(rng.choice([0.05, 0.2]))
    eps, start = float(rng.choice([0.0, 0.1])), plant.rim * rng.uniform(0.05, 0.9, plant.tanks)
    delay, lag = [(0, 0.0), (0, 0.0), (3, 0.0), (2, 0.7)][seed % 4]
    actuator = dataclasses.replace(actuator, delay=delay * hold)
    if delay:
        start = 0.02 * start
    if lag:
        actuator = dataclasses.replace(actuator, lag=np.full(plant.pumps, lag))
    kappa = 0.999 * min(2.0, rate_bound(hold, delay * hold, lag))
    given = {"widths": of(plant, spread), "band": eps, "rate": kappa, "start": start}
    sensor = LevelSensor(noise=np.zeros(plant.tanks))
    found, rows = design(plant, actuator, sensor, hold, **given)
    how = {"seconds": 400 * hold, "count": 30, "seed": seed, "start": start}
    how |= {"delay": delay, "lag": lag, "eps": eps}
    return rows, attack(plant, actuator, found, hold, spread, **how)


@pytest.mark.parametrize("seed", range(12))
def test_random_rigs_stay_below_what_is_certified(seed):
    rows, highest = trial(seed)
    passed = [r for r in rows if r.certified and highest[r.tank] > min(r.limit, r.reach) + 1e-9]
    assert passed == []


PRESETS = {
    "gouta2015/backstepping": (0.05, 0.1, 80.0),
    "gouta2022/enmpc": (0.05, 0.1, 150.0),
    "mirakhorli/sfc": (0.1, 0.1, 300.0),
    "calofir/backstepping": (1.0, 0.001, 1500.0),
    "khalid/gpc": (2.0, 0.001, 2000.0),
    "cascaded/pi": (4.0, 0.02, 2000.0),
}


@pytest.mark.parametrize("name", PRESETS)
def test_every_tank_of_a_preset_is_certified_and_holds(name):
    hold, eps, seconds = PRESETS[name]
    loop = presets.find(name).loop
    start = 0.5 * np.asarray(loop.plant.rim)
    given = {"widths": of(loop.plant, 0.05), "band": eps, "start": start}
    found, rows = design(loop.plant, loop.actuator, loop.sensor, hold, **given)
    assert all(r.certified for r in rows)
    low, high = np.maximum(loop.actuator.low, 0.0), np.minimum(loop.actuator.high, 50.0)
    actuator = dataclasses.replace(loop.actuator, low=low, high=high)
    how = {"seconds": seconds, "count": 30, "eps": eps, "start": start}
    highest = attack(loop.plant, actuator, found, hold, 0.05, **how)
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
    highest = attack(plant, actuator, found, 0.5, spread, seconds=200, count=60, **how)
    return highest > np.asarray(found.limit) + 1e-6


def sensor_of(plant):
    return LevelSensor(noise=np.zeros(plant.tanks))


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
    given = {"widths": {}, "limit": 30.0}
    _, (row,) = design(plant, delayed, sensor_of(plant), 0.5, **given)
    assert row.rate_bound == pytest.approx(delay**delay / (delay + 1) ** (delay + 1) / 0.5)
    at_bound, _ = design(plant, delayed, sensor_of(plant), 0.5, rate=row.rate_bound, **given)
    start = np.array([0.5])
    assert not passes(plant, delayed, at_bound, 0.0, delay=delay, start=start).any()
    forgotten, (row,) = design(plant, actuator, sensor_of(plant), 0.5, **given)
    assert row.certified  # for a rig without it
    assert passes(plant, delayed, forgotten, 0.0, delay=delay, start=start).any()


@pytest.mark.parametrize("seed", range(6))
def test_filter_and_certificate_reckon_with_the_same_rates(seed):
    """`worst_case.rise`, compiled into the loop, and `setting.phi`, in numbers before a run."""
    rng = np.random.default_rng(seed)
    plant, _ = random_rig(rng)
    plant = dataclasses.replace(plant, bottom=seed % 2 == 0)
    inflow = rng.uniform(0.0, 5.0, plant.tanks)
    rates = rates_of(*box_of(plant, of(plant, 0.1)), inflow, 0.5)
    for _ in range(20):
        others = rng.uniform(0.0, 40.0, plant.tanks)
        tank, level = int(rng.integers(plant.tanks)), float(rng.choice([0.0, 0.005, 0.1, 12.0]))
        expected = float(rise(rates, tank, level, tuple(others)))
        assert phi(rates, tank, level, others) == pytest.approx(expected, rel=1e-12, abs=1e-12)


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
    for _ in range(300):
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


@pytest.mark.parametrize("name", ["gouta2015/ngpc", "cascaded/pi"])
def test_the_filtered_loop_has_the_errors_of_an_independent_prototype(name):
    case = presets.find(name)
    loop = case.loop
    given = {"widths": of(loop.plant, 0.05), "start": loop.x0}
    found, _ = design(loop.plant, loop.actuator, loop.sensor, case.clock.dt, **given)

    @jax.jit
    def error(loop):
        of = evaluate(loop, case.clock, ["mean_square_error", "max_level"])
        return jax.numpy.sqrt(of["mean_square_error"].sum()), of["max_level"].max()

    clipped = dataclasses.replace(found, allocate=False)
    without, by_clip, by_qp = ROWS[name]
    assert float(error(loop)[0]) == pytest.approx(without, abs=2e-4)
    value, highest = error(dataclasses.replace(loop, safety_filter=clipped))
    assert float(value) == pytest.approx(by_clip, abs=1e-4) and highest <= loop.plant.rim.max()
    value, highest = error(dataclasses.replace(loop, safety_filter=found))
    assert float(value) == pytest.approx(by_qp, abs=1e-4) and highest <= loop.plant.rim.max()


@pytest.mark.parametrize(
    ("name", "gain", "value", "duration"),
    [
        ("gouta2015/ngpc", "controller.Tp", 9.0, 600.0),
        ("cascaded/pi", "controller.Kc", 2.0, 4000.0),
    ],
)
def test_gradients_through_the_filter_are_central_differences(name, gain, value, duration):
    case = presets.find(name)
    loop, clock = case.loop, dataclasses.replace(case.clock, duration=duration)
    found, _ = design(loop.plant, loop.actuator, loop.sensor, clock.dt, widths=of(loop.plant, 0.05))
    loop = dataclasses.replace(loop, safety_filter=found)

    @jax.jit
    def cost(theta):
        rate = theta[1] * np.ones(loop.plant.tanks)
        values = {gain: theta[0], "safety_filter.rate": rate}
        found = evaluate(with_values(loop, values), clock, ["mean_square_error"])
        return found["mean_square_error"].sum()

    theta = np.array([value, 0.85 * float(found.rate[0])])
    slopes = jax.jacfwd(cost)(theta)
    for i, step in enumerate([1e-4, 1e-5]):
        e = np.eye(2)[i] * step
        central = float(cost(theta + e) - cost(theta - e)) / (2 * step)
        assert float(slopes[i]) == pytest.approx(central, rel=2e-5, abs=1e-9)
    assert abs(slopes[1]) > 1e-7


if __name__ == "__main__":
    import sys

    jax.config.update("jax_enable_x64", True)
    for seed in range(int(sys.argv[1]), int(sys.argv[2])):
        rows, highest = trial(seed)
        bad = [r for r in rows if r.certified and highest[r.tank] > min(r.limit, r.reach) + 1e-9]
        print(
            seed,
            [
                (
                    r.certified,
                    round(r.limit, 2),
                    round(float(highest[r.tank] / min(r.reach, r.limit)), 4),
                    r.reason[:70],
                )
                for r in rows
            ],
            "BAD" if bad else "",
        )
