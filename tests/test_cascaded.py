"""The public two-tank rig: its record, a fit from elsewhere, recorded signals, gradients."""

import dataclasses
import pathlib

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import least_squares

import jaxtank
from jaxtank import presets, rig
from jaxtank.loop import _evaluate
from jaxtank.presets import cascaded
from jaxtank.records import Clock
from jaxtank.signals import Table
from jaxtank.tree import get_value, with_values

CASES = presets.load("cascaded").cases
RECORD = pathlib.Path(__file__).parents[2] / "shared" / "data" / "cascaded_tanks.csv"
recorded = pytest.mark.skipif(
    not RECORD.exists(), reason="the record is not beside this checkout (../shared/data/cascaded_tanks.csv)"
)
FITTED = ["plant.orifice[0]", "plant.drain[1]", "plant.pump_gain[0]", "plant.caught[0]", "disturbance.level[0]", "x0[0]", "x0[1]"]


def playback():
    _, pump, level = np.loadtxt(RECORD, delimiter=",", skiprows=1).T
    return (*cascaded.playback(pump, level), pump, level)


@recorded
def test_the_record_is_simulated():
    """0.2536 V RMS over the whole record, both tanks within their rims."""
    loop, clock, pump, level = playback()
    assert clock.samples == 1024
    t = jaxtank.simulate(loop, clock)
    np.testing.assert_array_equal(t.u[:, 0], pump)
    assert abs(float(np.sqrt(np.mean((t.x[:, 1] - level) ** 2))) - 0.25364) < 1e-5
    assert np.max(t.x) <= 10.0 and float(t.spilled[-1, 0]) > 0.0  # the record does reach the rim of the upper tank


@recorded
def test_until_the_first_overflow_the_levels_are_those_of_scipy():
    """The equations written out, with exact roots, integrated at 1e-10 from sample to sample."""
    loop, clock, pump, _ = playback()
    t = jaxtank.simulate(loop, clock)
    k1, k3, k4 = cascaded.K_UPPER, cascaded.K_LOWER, cascaded.K_PUMP
    end = int(np.argmax(np.asarray(t.x) >= 9.99, axis=0)[0]) or 100
    x = np.array(cascaded.START)
    for k in range(end - 1):
        rate = lambda _, h, u=pump[k]: [k4 * (u + cascaded.OFFSET) - k1 * np.sqrt(h[0]), k1 * np.sqrt(h[0]) - k3 * np.sqrt(h[1])]
        x = solve_ivp(rate, (0, 4), x, rtol=1e-10, atol=1e-12).y[:, -1]
        np.testing.assert_allclose(t.x[k + 1], x, atol=1e-6)


@recorded
def test_a_fit_from_elsewhere_comes_back():
    loop, clock, _, _ = playback()
    there = np.array([float(get_value(loop, n)) for n in FITTED])
    error = jax.jit(lambda z: jaxtank.simulate(with_values(loop, dict(zip(FITTED, z))), clock).e[:, 0])
    slope = jax.jit(jax.jacfwd(lambda z: jaxtank.simulate(with_values(loop, dict(zip(FITTED, z))), clock).e[:, 0]))
    start = there * np.array([1.3, 0.8, 1.2, 0.5, 0.5, 0.8, 1.1])
    low, high = [1e-3, 1e-3, 1e-3, 0.0, -0.2, 0.0, 0.0], [1.0, 1.0, 1.0, 1.0, 0.2, 10.0, 10.0]
    found = least_squares(
        lambda z: np.asarray(error(z)), start, lambda z: np.asarray(slope(z)), (low, high), x_scale="jac", xtol=1e-12, ftol=1e-12
    )
    np.testing.assert_allclose(found.x, there, rtol=2e-3)  # the numbers are rounded, and the valley of the offset is flat


@pytest.mark.parametrize("name, names", [
    ("pi", ["controller.Kc[0]", "controller.Ti[0]", "controller.Tt[0]", "controller.bias[0]"]),
    ("open-loop", ["controller.signal.initial[0]", *(f"controller.signal.targets[{i}]" for i in range(3))]),
])  # fmt: skip
def test_gradients_against_central_differences(name, names):
    case = CASES[name]
    if name == "pi":
        case = rig.set_values(case, {"actuator.high": 3.3})  # so that the anti-windup is at work and Tt is felt
    f = jax.jit(
        lambda z: jaxtank.evaluate(with_values(case.loop, dict(zip(names, jnp.exp(z)))), case.clock, "rms_error")["rms_error"][0]
    )
    z = np.log([float(get_value(case.loop, n)) for n in names])
    differences = [(f(z + d) - f(z - d)) / 2e-5 for d in 1e-5 * np.eye(len(z))]
    slopes = jax.jacfwd(f)(z)
    np.testing.assert_allclose(slopes, differences, rtol=1e-5, atol=1e-9)
    assert np.all(np.abs(slopes) > 1e-7)


def test_the_pi_reaches_its_setpoints_and_open_loop_rests_at_its_own():
    for name, within in (("pi", 0.02), ("open-loop", 0.06)):
        e = np.asarray(jaxtank.simulate(CASES[name].loop, CASES[name].clock).e[:, 0])
        assert np.abs(e[[99, 299, 499, 699]]).max() < within, name


def test_the_share_of_the_overflow_is_caught():
    """At full pump both tanks stand at the rim, and what the basin gets over the rims is what the pump brings less what drains."""
    case = rig.set_values(CASES["open-loop"], {"controller.signal.initial": 10.0, "controller.signal.targets": 10.0})
    t = jaxtank.simulate(case.loop, case.clock)
    np.testing.assert_allclose(t.x[-1], 10.0, atol=1e-9)
    lost = np.asarray(t.spilled[-1] - t.spilled[-2]).sum() / 4.0
    flow = cascaded.K_PUMP * (10.0 + cascaded.OFFSET)
    np.testing.assert_allclose(lost, flow - cascaded.K_LOWER * np.sqrt(10.0), rtol=1e-3)


@pytest.mark.parametrize("name", list(CASES))
def test_the_loop_compiles_to_one_function(name):
    from test_compiled_loop import loops_in

    case = CASES[name]
    assert loops_in(_evaluate.lower(case.loop, case.clock, ("rms_error_total", "max_level"), None, False).compile()) >= 1


@pytest.mark.parametrize("dt", [0.1, 0.25, 1.0, 4.0])
def test_recorded_samples(dt):
    """Against numpy's own search and interpolation; after the record its last value."""
    values, period = np.array([[1.0, 3.0, 2.0, 5.0], [0.0, -1.0, 4.0, 4.0]]), 3 * 0.25 if dt == 0.25 else 0.3 if dt == 0.1 else 4.0
    clock = Clock(dt=dt, duration=dt * 25)
    times = np.arange(clock.samples) * dt
    held = Table(values=values, period=period).sample(clock)
    index = np.minimum(np.array([int(round(t / period * 1e6) // 10**6) for t in times]), 3)
    np.testing.assert_array_equal(np.array(held[0]), values[:, index])
    np.testing.assert_array_equal(np.array(held[1]), 0.0)
    value, rate, _ = Table(values=values, period=period, between="linear").sample(clock)
    for i in range(2):
        np.testing.assert_allclose(value[i], np.interp(times, period * np.arange(4), values[i]), atol=1e-12)
    np.testing.assert_allclose(np.array(rate)[0][:2], 2.0 / period if dt < period else [2.0 / period, -1.0 / period])


def test_a_record_is_a_leaf():
    table = Table(values=np.array([[1.0, 2.0]]), period=1.0)
    total = lambda v: sum(jnp.sum(c) for c in dataclasses.replace(table, values=v).sample(Clock(dt=1.0, duration=3.0))[0])
    np.testing.assert_array_equal(jax.grad(total)(table.values), [[1.0, 3.0]])


def test_what_is_measured():
    preset = presets.load("cascaded")

    def run(name, values=None, save_every=1):
        case = rig.set_values(CASES[name], values or {})
        return case, jax.tree.map(np.asarray, jaxtank.simulate(case.loop, case.clock, save_every=save_every))

    found = preset.measured(run)
    assert set(preset.published) - set(found) == {"RMS error of simulated level"}  # needs a record
    for name, value in found.items():
        np.testing.assert_allclose(value, preset.published[name].value, rtol=preset.published[name].tolerance)
    low = lambda name, values, save_every=1: run(name, {**values, "plant.rim": 8.0}, save_every)
    assert abs(preset.measured(low)["plant.rim"] - 8.0) < 1e-6
