"""Custom sensors and actuators in a run, a Gymnasium environment and a rig file."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import registries_kept
from scipy.integrate import solve_ivp

import jaxtank
from jaxtank import rig
from jaxtank.case import Case
from jaxtank.controllers import Controller, OpenLoop
from jaxtank.core.clock import Clock, sample_times
from jaxtank.core.errors import InputError
from jaxtank.core.tree import component, leaf, with_values
from jaxtank.instruments import Actuator, LevelSensor, PumpBank, Sensor
from jaxtank.loop.closed_loop import ClosedLoop
from jaxtank.observers import Direct
from jaxtank.plants import network
from jaxtank.signals import Constant, Signal, ramps

DT, DURATION = 0.5, 60.0
CLOCK = Clock(dt=DT, duration=DURATION, substeps=4)


@component
class RateLimited(Actuator):
    """Pumps whose input changes at a limited rate."""

    low: np.ndarray = leaf("V", "lower limit of each pump", shape=("pump",))
    high: np.ndarray = leaf("V", "upper limit of each pump", shape=("pump",))
    initial: np.ndarray = leaf("V", "input before t = 0", shape=("pump",))
    rate: float = leaf("V/s", "largest rate of change", low=0.0, strict=True)

    def init(self, clock):
        return tuple(self.initial)

    def step(self, state, applied, dt):
        most = self.rate * dt
        u = tuple(v + jnp.clip(a - v, -most, most) for v, a in zip(state, applied))
        return u, u


@component
class Quantised(Sensor):
    """Readings that are whole multiples of a resolution."""

    resolution: float = leaf("cm", "least difference of two readings", low=0.0, strict=True)

    def step(self, state, x, xi, dt):
        return tuple(jnp.round(h / self.resolution) * self.resolution for h in x), state


@component
class Lagged(Sensor):
    """Readings that follow the level with a lag, and noise."""

    noise: np.ndarray = leaf("cm", "standard deviation of the noise", low=0.0, shape=("tank",))
    tau: float = leaf("s", "time constant", low=0.0, strict=True)

    def init(self, x0):
        return tuple(x0)

    def step(self, state, x, xi, dt):
        keep = jnp.exp(-dt / self.tau)
        state = tuple(h + keep * (s - h) for s, h in zip(state, x))
        if xi is None:
            return state, state
        return tuple(s + self.noise[i] * xi[i] for i, s in enumerate(state)), state


@component
class Proportional(Controller):
    Kc: float = leaf("V/cm", "gain", low=0.0)

    def step(self, state, tick, estimate):
        return tuple(self.Kc * (r - h) for r, h in zip(tick.r, estimate.x)), state


TANK = dict(area=[25.0], drain=[0.3], pump_gain=[8.0], feeds=[(0, None)], rim=[30.0])


def loop_of(**parts):
    usual = dict(
        plant=network(**TANK), sensor=LevelSensor(noise=[0.0]), observer=Direct(),
        controller=Proportional(Kc=2.0), actuator=PumpBank(low=[0.0], high=[12.0]),
        reference=ramps([4.0], [(10.0, 0, 9.0)], ramp=0.0), x0=np.array([3.3]),
    )  # fmt: skip
    return ClosedLoop(**{**usual, **parts})


LIMITED = RateLimited(low=[0.0], high=[12.0], initial=[2.0], rate=0.4)


@pytest.fixture(autouse=True)
def registry():
    """The registry of rig files is put back after each test."""
    with registries_kept():
        yield


@pytest.mark.extended
def test_a_run_with_an_own_rate_limit_is_that_of_another_integrator():
    """Input: a ramp from 2 V to the limit of 12 V, in closed form; level: scipy's solution."""
    loop = loop_of(actuator=LIMITED, controller=OpenLoop(signal=Constant(level=[20.0])))
    run = jaxtank.simulate(loop, CLOCK)
    k = np.arange(CLOCK.samples)
    u = np.minimum(2.0 + 0.4 * DT * (k + 1), 12.0)
    np.testing.assert_allclose(run.u[:, 0], u, rtol=1e-12)
    level, levels = 3.3, []
    for held in u:
        levels.append(level)
        rate = lambda t, h, held=held: (8.0 * held - 0.3 * math.sqrt(2 * 981 * h[0])) / 25.0
        level = solve_ivp(rate, (0.0, DT), [level], rtol=1e-10, atol=1e-12).y[0, -1]
    np.testing.assert_allclose(run.x[:, 0], levels, rtol=1e-7)
    travel = jaxtank.evaluate(loop, CLOCK, ["input_travel"])["input_travel"]
    np.testing.assert_allclose(travel, 12.0 - u[0], rtol=1e-12)


@pytest.mark.slow
def test_the_gradient_passes_through_an_own_actuator():
    loop = loop_of(actuator=LIMITED)
    cost = jax.jit(
        lambda rate: jnp.sum(
            jaxtank.evaluate(with_values(loop, {"actuator.rate": rate}), CLOCK, ["ise"])["ise"]
        )
    )
    slope, h = float(jax.grad(cost)(0.4)), 1e-6
    central = (float(cost(0.4 + h)) - float(cost(0.4 - h))) / (2 * h)
    assert abs(slope) > 1.0 and slope == pytest.approx(central, rel=1e-5)


@pytest.mark.extended
def test_an_own_quantised_sensor_reads_as_an_adc_of_the_same_step():
    """A 12-bit ADC over 16 volts at 8 cm per volt has steps of 8 * 16 / 2^12 = 1/32 cm."""
    own = loop_of(sensor=Quantised(resolution=1 / 32))
    adc = loop_of(sensor=LevelSensor(noise=[0.0], gain=[8.0], full_scale=16.0, bits=12))
    one, other = jaxtank.simulate(own, CLOCK), jaxtank.simulate(adc, CLOCK)
    np.testing.assert_array_equal(np.asarray(one.y) % (1 / 32), 0.0)
    assert 0.0 < np.max(np.abs(one.y - one.x)) <= 1 / 64 + 1e-12
    np.testing.assert_array_equal(one.y, other.y)
    np.testing.assert_array_equal(one.x, other.x)


def test_an_own_sensor_has_memory_and_noise():
    loop = loop_of(sensor=Lagged(noise=[0.05], tau=3.0))
    with pytest.raises(InputError, match=r"sensor\.noise"):
        jaxtank.simulate(loop, CLOCK)
    key = jax.random.key(3)
    run = jaxtank.simulate(loop, CLOCK, key=key)
    xi = np.asarray(jax.random.normal(key, (1, CLOCK.samples), dtype=float))[0]
    lagged, read = 3.3, []
    for level, deviate in zip(np.asarray(run.x)[:, 0], xi):
        lagged = level + math.exp(-DT / 3.0) * (lagged - level)
        read.append(lagged + 0.05 * deviate)
    np.testing.assert_allclose(run.y[:, 0], read, rtol=1e-12)
    np.testing.assert_allclose(run.command[:, 0], 2.0 * (run.r[:, 0] - run.y[:, 0]), rtol=1e-12)


@pytest.mark.slow
def test_the_environment_plays_a_case_with_instruments_of_ones_own():
    environment = pytest.importorskip("jaxtank.interop.gymnasium")
    loop = loop_of(sensor=Lagged(noise=[0.05], tau=3.0), actuator=LIMITED)
    run = jaxtank.simulate(loop, CLOCK, key=jax.random.key(5))
    env = environment.TankEnv(
        Case(name="own", title="", loop=loop, clock=CLOCK, limits={}, free={}, objective={})
    )
    _, info = env.reset(seed=5)
    for k in range(CLOCK.samples - 1):
        np.testing.assert_allclose(info["x"], run.x[k], rtol=1e-10)
        np.testing.assert_allclose(info["y"], run.y[k], rtol=1e-10)
        *_, info = env.step(2.0 * run.applied[k] / 12.0 - 1.0)
        np.testing.assert_allclose(info["u"], run.u[k], rtol=1e-10)


def test_a_preset_takes_registered_instruments_and_keeps_its_limits():
    rig.register("quantised", Quantised)
    rig.register("rate-limited", RateLimited)
    text = (
        'case = "gouta2015/backstepping"\n[sensor]\nkind = "quantised"\nresolution = 0.01\n'
        '[actuator]\nkind = "rate-limited"\nrate = 5.0\n'
    )
    own = rig.loads(text)
    preset = jaxtank.presets.find("gouta2015/backstepping")
    np.testing.assert_array_equal(own.loop.actuator.high, preset.loop.actuator.high)
    again = rig.loads(rig.dump(own))
    assert 'case = "gouta2015' in rig.dump(own)
    assert jax.tree.structure(again.loop) == jax.tree.structure(own.loop)
    assert float(again.loop.sensor.resolution) == 0.01
    with pytest.raises(InputError, match=r"\[actuator\] rate-limited needs rate \[V/s\]"):
        rig.loads(text.replace("rate = 5.0\n", ""))
    with pytest.raises(InputError, match="unknown sensor kind 'rate-limited'"):
        rig.loads(text.replace('kind = "quantised"', 'kind = "rate-limited"'))


def test_roles_without_their_own_step_are_refused():
    for role in (Sensor, Actuator):
        with pytest.raises(TypeError, match="abstract"):
            role()


@component
class Steps(Signal):
    """A custom setpoint that jumps, without windows."""

    @property
    def channels(self):
        return 1

    def sample(self, clock):
        t = sample_times(clock)
        return (jnp.where(t < 10.0, 4.0, 9.0),), (0.0 * t,), (0.0 * t,)


@component
class Windowed(Steps):
    """The same setpoint, which also answers what its steps refer to."""

    changes = ((10.0, 0),)

    def windows(self, clock):
        t = sample_times(clock)
        after = t >= 10.0
        step = jnp.where(after, 5.0, 0.0)
        target = jnp.where(after, 9.0, 4.0)
        return ((target, step, jnp.where(after, t - 10.0, 0.0), 0.05 * step),)


@pytest.mark.extended
def test_a_signal_without_changes_answers_none_and_with_them_gives_overshoot():
    steps, windowed = (loop_of(reference=cls()) for cls in (Steps, Windowed))
    assert Steps().windows(CLOCK) is Steps().since(CLOCK) is Steps().plateaus() is None
    with pytest.raises(InputError, match="need a reference that changes"):
        jaxtank.evaluate(steps, CLOCK, ["overshoot_percent"])
    names = ["overshoot_percent", "rise_time", "settling_time"]
    own = jaxtank.evaluate(windowed, CLOCK, names)
    for name, value in jaxtank.evaluate(loop_of(), CLOCK, names).items():
        np.testing.assert_array_equal(own[name], value)
