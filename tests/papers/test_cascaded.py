"""The public two-tank rig: its record, a fit from elsewhere, recorded signals, gradients."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import CASCADED_TANKS
from scipy.integrate import solve_ivp
from scipy.optimize import least_squares

import jaxtank
from jaxtank import presets, rig
from jaxtank.core.clock import Clock
from jaxtank.core.tree import get_value, with_values
from jaxtank.presets import cascaded
from jaxtank.signals.base import Table

CASES = presets.load("cascaded").cases
recorded = pytest.mark.skipif(
    not CASCADED_TANKS.exists(),
    reason="the record is not beside the tests (data/cascaded_tanks.csv)",
)
FITTED = [
    *("plant.orifice[0]", "plant.drain[1]", "plant.pump_gain[0]", "plant.caught[0]"),
    *("disturbance.level[0]", "x0[0]", "x0[1]"),
]


def playback():
    _, pump, level = np.loadtxt(CASCADED_TANKS, delimiter=",", skiprows=1).T
    return (*cascaded.playback(pump, level), pump, level)


@pytest.mark.extended
@recorded
def test_the_record_is_simulated():
    """0.2536 V RMS over the whole record, both tanks within their rims."""
    loop, clock, pump, level = playback()
    assert clock.samples == 1024
    t = jaxtank.simulate(loop, clock)
    np.testing.assert_array_equal(t.u[:, 0], pump)
    assert abs(float(np.sqrt(np.mean((t.x[:, 1] - level) ** 2))) - 0.25364) < 1e-5
    # the record does reach the rim of the upper tank
    assert np.max(t.x) <= 10.0 and float(t.spilled[-1, 0]) > 0.0


@recorded
def test_until_the_first_overflow_the_levels_are_those_of_scipy():
    """The equations written out, with exact roots, integrated at 1e-10 from sample to sample."""
    loop, clock, pump, _ = playback()
    t = jaxtank.simulate(loop, clock)
    k1, k3, k4 = cascaded.K_UPPER, cascaded.K_LOWER, cascaded.K_PUMP
    end = int(np.argmax(np.asarray(t.x) >= 9.99, axis=0)[0]) or 100
    x = np.array(cascaded.START)
    for k in range(end - 1):
        rate = lambda _, h, u=pump[k]: [
            k4 * (u + cascaded.OFFSET) - k1 * np.sqrt(h[0]),
            k1 * np.sqrt(h[0]) - k3 * np.sqrt(h[1]),
        ]
        x = solve_ivp(rate, (0, 4), x, rtol=1e-10, atol=1e-12).y[:, -1]
        np.testing.assert_allclose(t.x[k + 1], x, atol=1e-6)


@pytest.mark.slow
@recorded
def test_a_fit_from_elsewhere_comes_back():
    loop, clock, _, _ = playback()
    there = np.array([float(get_value(loop, n)) for n in FITTED])
    error = jax.jit(
        lambda z: jaxtank.simulate(with_values(loop, dict(zip(FITTED, z))), clock).e[:, 0]
    )
    slope = jax.jit(
        jax.jacfwd(
            lambda z: jaxtank.simulate(with_values(loop, dict(zip(FITTED, z))), clock).e[:, 0]
        )
    )
    start = there * np.array([1.3, 0.8, 1.2, 0.5, 0.5, 0.8, 1.1])
    low, high = [1e-3, 1e-3, 1e-3, 0.0, -0.2, 0.0, 0.0], [1.0, 1.0, 1.0, 1.0, 0.2, 10.0, 10.0]
    found = least_squares(
        lambda z: np.asarray(error(z)),
        start,
        lambda z: np.asarray(slope(z)),
        (low, high),
        x_scale="jac",
        xtol=1e-12,
        ftol=1e-12,
    )
    # the numbers are rounded, and the valley of the offset is flat; the share of the overflow that
    # enters tank 2 was fitted with overflow that left at the end of a step: 0.928, and 0.932 now
    rounded = np.arange(len(there)) != 3
    np.testing.assert_allclose(found.x[rounded], there[rounded], rtol=2e-3)
    np.testing.assert_allclose(found.x[3], there[3], rtol=5e-3)


@pytest.mark.extended
def test_the_share_of_the_overflow_is_caught():
    """At full pump both tanks stand at the rim, and what the basin gets over the rims is what the
    pump brings less what drains.
    """
    case = rig.set_values(
        CASES["open-loop"], {"controller.signal.initial": 10.0, "controller.signal.targets": 10.0}
    )
    t = jaxtank.simulate(case.loop, case.clock)
    np.testing.assert_allclose(t.x[-1], 10.0, atol=1e-9)
    lost = np.asarray(t.spilled[-1] - t.spilled[-2]).sum() / 4.0
    flow = cascaded.K_PUMP * (10.0 + cascaded.OFFSET)
    np.testing.assert_allclose(lost, flow - cascaded.K_LOWER * np.sqrt(10.0), rtol=1e-3)


@pytest.mark.parametrize("dt", [0.1, 0.25, 1.0, 4.0])
def test_recorded_samples(dt):
    """Against numpy's own search and interpolation; after the record its last value."""
    values, period = (
        np.array([[1.0, 3.0, 2.0, 5.0], [0.0, -1.0, 4.0, 4.0]]),
        (3 * 0.25 if dt == 0.25 else 0.3 if dt == 0.1 else 4.0),
    )
    clock = Clock(dt=dt, duration=dt * 25)
    times = np.arange(clock.samples) * dt
    held = Table(values=values, period=period).sample(clock)
    index = np.minimum(np.array([int(round(t / period * 1e6) // 10**6) for t in times]), 3)
    np.testing.assert_array_equal(np.array(held[0]), values[:, index])
    np.testing.assert_array_equal(np.array(held[1]), 0.0)
    value, rate, _ = Table(values=values, period=period, between="linear").sample(clock)
    for i in range(2):
        np.testing.assert_allclose(
            value[i], np.interp(times, period * np.arange(4), values[i]), atol=1e-12
        )
    np.testing.assert_allclose(
        np.array(rate)[0][:2], 2.0 / period if dt < period else [2.0 / period, -1.0 / period]
    )


def test_a_record_is_a_leaf():
    table = Table(values=np.array([[1.0, 2.0]]), period=1.0)
    total = lambda v: sum(
        jnp.sum(c)
        for c in dataclasses.replace(table, values=v).sample(Clock(dt=1.0, duration=3.0))[0]
    )
    np.testing.assert_array_equal(jax.grad(total)(table.values), [[1.0, 3.0]])


STIFF = {
    "plant.area": [3.24, 3.79],
    "plant.orifice": 0.328,
    "plant.drain": [0.0, 0.00456],
    "plant.pump_gain": 0.00625,
}


def levels_for(loop, inputs, start, dt):
    """(samples, 2) levels by scipy's Radau with `inputs` held for dt [s] each: nothing flows out of
    an empty tank, and a negative inflow takes nothing from it (an event ends the first part, in
    which its level falls).
    """
    plant, knee = loop.plant, loop.plant.knee
    (a1, a2), k1, k2 = plant.area, float(plant.orifice[0]), float(plant.drain[1])
    film = lambda h: (
        np.sqrt(h)
        if h >= knee
        else knee**0.5 * (1.5 * max(h, 0.0) / knee - 0.5 * (max(h, 0.0) / knee) ** 2)
    )
    path, x = [], np.array(start, dtype=float)
    empty = lambda t, h: h[0]
    empty.terminal, empty.direction = True, -1
    for u in inputs:
        path.append(x)
        into = float(plant.pump_gain[0]) * u + float(loop.disturbance.level[0])
        t = 0.0
        while t < dt:
            dry = x[0] <= 0.0 and into <= 0.0
            rate = lambda _, h, dry=dry, into=into: [
                0.0 if dry else (into - k1 * film(h[0])) / a1,
                ((0.0 if dry else k1 * film(h[0])) - k2 * film(h[1])) / a2,
            ]
            found = solve_ivp(
                rate,
                (t, dt),
                x,
                method="Radau",
                rtol=1e-8,
                atol=1e-10,
                events=None if dry else empty,
            )
            t, x = found.t[-1], found.y[:, -1]
            if found.status == 1:
                x = np.array([0.0, x[1]])
    return np.array(path)


@pytest.mark.extended
@pytest.mark.slow_for("1-4.0", "2-4.0", "3-4.0", "10-4.0", "10-0.4")
@pytest.mark.parametrize(
    "substeps, dt", [(1, 4.0), (2, 4.0), (3, 4.0), (4, 4.0), (10, 4.0), (10, 0.4)]
)
def test_a_negative_inflow_draws_nothing_from_the_tank_below(substeps, dt):
    """A stiff rig with an inflow that is negative for most of the run: the lower level at 600 s
    does not depend on the step.
    """
    case = rig.set_values(CASES["pi"], STIFF)
    clock = Clock(dt=dt, duration=600.0, substeps=substeps)
    run = jax.tree.map(np.asarray, jaxtank.simulate(case.loop, clock))
    assert run.x[-1, 0] == 0.0 and abs(run.x[-1, 1] - 5.69) < 0.02
    if (substeps, dt) == (4, 4.0):
        exact = levels_for(case.loop, run.u[:, 0], case.loop.x0, dt)
        assert exact[:, 0].min() == 0.0 and np.abs(run.x - exact).max() < 0.05  # 0.5 % of the rim


@pytest.mark.slow_for("1-0.003", "2-0.001", "10-3e-05", "4-0.0003")
@pytest.mark.parametrize("substeps, within", [(1, 3e-3), (2, 1e-3), (4, 3e-4), (10, 3e-5)])
def test_with_the_pump_off_the_lower_tank_empties_through_its_own_outlet(substeps, within):
    case = rig.set_values(CASES["pi"], {"actuator.high": 1e-9})
    clock = Clock(dt=4.0, duration=100.0, substeps=substeps)
    run = jaxtank.simulate(case.loop, clock)
    exact = levels_for(case.loop, np.zeros(26), case.loop.x0, 4.0)[-1]
    assert abs(exact[1] - 0.421) < 1e-3 and abs(float(run.x[-1, 1]) - exact[1]) < within
