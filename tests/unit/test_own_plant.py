"""A plant and a law that somebody else wrote, with no more than their base classes ask: notebook
10's cone.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import jaxtank
import tuning
from jaxtank import presets
from jaxtank.controllers.base import Controller
from jaxtank.core import numerics
from jaxtank.core.errors import InputError
from jaxtank.core.records import Estimate
from jaxtank.core.tree import component, leaf, number, static
from jaxtank.export.source import export
from jaxtank.instruments.base import Sensor
from jaxtank.observers import DisturbanceObserver, Kalman, Observer
from jaxtank.plants.base import Plant
from jaxtank.plants.runge_kutta import advance


@component
class Cone(Plant):
    """A(h) h' = k u - s sqrt(2 g h), A = pi (R/H)^2 (h + tip)^2."""

    pump_gain: float = leaf("cm^3/(s V)", "flow per volt k", low=0.0, strict=True)
    drain: float = leaf("cm^2", "outlet area s", low=0.0)
    slope: float = leaf("-", "radius over level R/H", low=0.0, strict=True)
    rim: np.ndarray = leaf("cm", "height", low=0.0, strict=True, shape=("tank",))
    outputs: tuple = static(doc="controlled tanks", default=(0,))
    tanks, pumps = 1, 1

    def derivative(self, t, x, u, d):
        width = self.slope * (x[0] + 0.5)
        flow = self.pump_gain * u[0] - self.drain * jnp.sqrt(2.0 * 981.0) * numerics.smooth_sqrt(
            x[0], 0.01
        )
        return (flow / (jnp.pi * width * width),)


@component
class Proportional(Controller):
    """u = bias + Kc (r - h)."""

    Kc: float = leaf("V/cm", "gain", low=0.0)
    bias: float = leaf("V", "voltage at no error")

    def step(self, state, tick, estimate):
        return (self.bias + self.Kc * (tick.r[0] - estimate.x[0]),), state


@pytest.fixture(scope="module")
def case():
    loop = jaxtank.ClosedLoop(
        plant=Cone(pump_gain=30.0, drain=1.2, slope=0.5, rim=[30.0]),
        sensor=jaxtank.instruments.LevelSensor(gain=[6.0], noise=[0.0], full_scale=5.0),
        observer=jaxtank.observers.Direct(),
        controller=Proportional(Kc=1.0, bias=5.0),
        actuator=jaxtank.instruments.PumpBank(low=[0.0], high=[12.0], initial=[0.0]),
        reference=jaxtank.signals.ramps([5.0], [(5.0, 0, 12.0)], ramp=0.0),
        x0=number([5.0]),
    )
    return presets.Case(
        name="cone",
        title="cone",
        loop=loop,
        clock=jaxtank.Clock(dt=0.1, duration=60.0, substeps=4),
        limits={"max_level": "rim", "overflow_volume": 0.0},
        free={"controller.Kc": presets.Free(0.05, 10.0)},
        objective={"mean_square_error": 1.0, "input_travel": 0.01},
        uncertain={"plant.drain": 0.1},
    )


def test_its_levels_are_those_of_another_integrator(case):
    run = jaxtank.simulate(case.loop, case.clock)
    assert np.ptp(np.asarray(run.u)) > 5.0  # it moves, and into its upper limit
    level = [5.0]
    for volts in np.asarray(run.u)[:-1, 0]:
        rate = lambda _, h, volts=volts: (
            (30.0 * volts - 1.2 * np.sqrt(1962.0 * h)) / (np.pi * 0.25 * (h + 0.5) ** 2)
        )
        level.append(solve_ivp(rate, (0.0, 0.1), [level[-1]], rtol=1e-9, atol=1e-11).y[0, -1])
    # the smooth root: 1e-6 of it at 5 cm
    np.testing.assert_allclose(np.asarray(run.x)[:, 0], level, atol=2e-6)


def test_slopes_by_controller_and_plant_are_those_of_differences(case):
    names = ("controller.Kc", "plant.drain", "plant.slope")
    point = np.array([1.0, 1.2, 0.5])

    @jax.jit
    def error(values):
        loop = jaxtank.with_values(case.loop, dict(zip(names, values)))
        return jaxtank.evaluate(loop, case.clock, ["rms_error_total"])["rms_error_total"]

    exact = jax.jacfwd(error)(point)
    for i, step in enumerate(1e-6 * np.diag(point)):
        assert exact[i] == pytest.approx(
            float(error(point + step) - error(point - step)) / (2.0 * step[i]), rel=1e-6
        )


@component
class Several(Controller):
    """Returns `count` inputs, whatever the rig has; a bare number for 0."""

    count: int = static(default=1)

    def step(self, state, tick, estimate):
        return (5.0 * tick.r[0],) * self.count if self.count else 5.0 * tick.r[0], state


KINDS = {
    **{"vectors": True, "columns": True, "texts": True, "complex": True, "array": False},
    "switch": False,
}
"""What Odd returns: whether it is wrong."""


@component
class Odd(Controller):
    """Returns two inputs, of a kind that a run may not take."""

    kind: str = static(default="array", choices=tuple(KINDS))

    def step(self, state, tick, estimate):
        r = jnp.stack(tick.r)
        on = tick.r[0] > 8.0
        return {
            "vectors": (r, r),
            "columns": r[:, None],
            "texts": ("on", "off"),
            "complex": (1j * r[0], r[1]),
            "array": r,
            "switch": (on, on),
        }[self.kind], state


@pytest.mark.extended_for("0-one number")
@pytest.mark.parametrize(("count", "words"), [(0, "one number"), (1, "1 input"), (3, "3 inputs")])
def test_a_controller_returns_one_input_for_each_pump(count, words):
    case = jaxtank.rig.set_values(
        presets.find("gouta2015/backstepping"), {"clock.dt": 0.5, "clock.duration": 10.0}
    )
    case = case.replace(loop=dataclasses.replace(case.loop, controller=Several(count=count)))
    wrong = f"controller Several: its step returns {words} for 2 pumps"
    for run in (
        lambda: jaxtank.evaluate(case.loop, case.clock, ["rms_error"]),
        lambda: jax.jit(lambda loop: jaxtank.evaluate(loop, case.clock, ["rms_error"]))(case.loop),
        lambda: export(case),
    ):
        with pytest.raises(jaxtank.InputError, match=wrong):
            run()
    right = dataclasses.replace(case.loop, controller=Several(count=2))
    assert np.asarray(jaxtank.simulate(right, case.clock).command).shape == (21, 2)


@pytest.mark.parametrize(("kind", "wrong"), KINDS.items())
def test_an_input_of_a_controller_is_one_real_number(kind, wrong):
    case = jaxtank.rig.set_values(
        presets.find("gouta2015/backstepping"), {"clock.dt": 0.5, "clock.duration": 10.0}
    )
    loop = dataclasses.replace(case.loop, controller=Odd(kind=kind))
    if not wrong:
        assert np.isfinite(
            jaxtank.evaluate(loop, case.clock, ["rms_error_total"])["rms_error_total"]
        )
        return
    with pytest.raises(
        jaxtank.InputError,
        match="controller Odd: its step returns an input that is no single real number",
    ):
        jaxtank.evaluate(loop, case.clock, ["rms_error"])


@component
class Metres(Plant):
    """One tank in metres, its pump in %."""

    units = ("m", "%")
    flow: float = leaf("m^3/(s %)", "flow per % of the pump", low=0.0)
    valve: float = leaf("m^2", "outlet area", low=0.0)
    rim: np.ndarray = leaf("m", "height", low=0.0, strict=True, shape=("tank",))
    outputs: tuple = static(doc="controlled tanks", default=(0,))
    tanks, pumps = 1, 1

    def derivative(self, t, x, u, d):
        out = self.valve * jnp.sqrt(2 * 9.81) * numerics.smooth_sqrt(x[0], 1e-4)
        return ((self.flow * u[0] - out) / 0.1,)


@component
class Unsaid(Metres):
    """The same, which does not say that it counts in metres."""

    units = ("cm", "V")


def metres(case, kind=Metres):
    plant = kind(flow=1e-5, valve=1e-4, rim=[0.3])
    controller = Proportional(Kc=100.0, bias=20.0)
    actuator = jaxtank.instruments.PumpBank(low=[0.0], high=[100.0])
    loop = dataclasses.replace(
        case.loop,
        plant=plant,
        controller=controller,
        actuator=actuator,
        sensor=jaxtank.instruments.LevelSensor(noise=[0.0]),
        reference=jaxtank.signals.ramps([0.05], [(5.0, 0, 0.12)], ramp=0.0),
        x0=number([0.05]),
    )
    free = {"controller.Kc": presets.Free(10.0, 1000.0)}
    return case.replace(loop=loop, free=free, uncertain={}, objective={"rms_error_total": 1.0})


def test_a_plant_whose_levels_are_not_in_its_units_is_refused(case):
    with pytest.raises(InputError, match=r'Unsaid.units = .* write units = \("m", "V"\)'):
        jaxtank.check(metres(case, Unsaid).loop, case.clock)


@pytest.mark.slow
def test_runs_of_a_plant_that_does_not_vary_are_no_plants(case):
    assert "8 runs of one plant" in str(tuning.validate(metres(case), samples=8))


def branching(self, state, tick, estimate):
    return ((1.0,) if tick.r[0] > estimate.x[0] else (0.0,)), state


def by_numpy(self, state, tick, estimate):
    return tuple(np.clip(np.array([tick.r[0]]), 0.0, 3.0)), state


STEPS = {
    "an if": (branching, r"controller Wrong: .* jnp\.where"),
    "numpy": (by_numpy, r"controller Wrong: .* jax\.numpy"),
    "no state": (lambda self, *_: (self.Kc, self.Kc, self.Kc), r"3 inputs .* \(inputs, state\)"),
    "nothing": (lambda self, *_: None, r"None .* \(inputs, state\)"),
    "an entry of no state": (lambda self, state, *_: ((state[0],), state), r"IndexError .* init"),
    "a state added": (lambda self, state, *_: ((self.Kc,), (1.0,)), r"form .* no init"),
}


@pytest.mark.parametrize("name", STEPS)
def test_a_wrong_step_is_named_with_its_class(case, name):
    step, words = STEPS[name]
    kind = type("Wrong", (Controller,), {"step": step, "Kc": leaf("V", "k"), "__annotations__": {}})
    kind.__annotations__["Kc"] = float
    loop = dataclasses.replace(case.loop, controller=component(kind)(Kc=1.0))
    for run in (lambda loop: jaxtank.evaluate(loop, case.clock, ["iae"]), jaxtank.simulate):
        with pytest.raises(InputError, match=words):
            run(case.replace(loop=loop) if run is jaxtank.simulate else loop)


def test_a_class_without_the_decorator_is_named(case):
    class Bare(Controller):
        Kc: float = leaf("V/cm", "gain")

        def step(self, state, tick, estimate):
            return (self.Kc,), state

    class Derived(Proportional):
        pass

    with pytest.raises(InputError, match=r"Bare lacks @jaxtank\.component"):
        Bare(Kc=1.0)
    derived = dataclasses.replace(case.loop, controller=Derived(Kc=1.0, bias=1.0))
    with pytest.raises(InputError, match=r"Derived, which lacks @jaxtank\.component"):
        jaxtank.simulate(derived, case.clock)
    with pytest.raises(InputError, match="class Proportional: give Proportional"):
        jaxtank.simulate(dataclasses.replace(case.loop, controller=Proportional), case.clock)


def test_a_run_that_ends_early_is_noted(case):
    with pytest.warns(UserWarning, match="the run ends at 0.9 s"):
        run = jaxtank.simulate(case, jaxtank.Clock(dt=0.3, duration=1.0))
    assert run.t[-1] == pytest.approx(0.9)


def test_a_plant_that_is_drawn_below_its_bottom_is_noted(case):
    """Its pump draws from it, and the derivative does not limit the outflow."""
    plant = jaxtank.with_values(case.loop.plant, {"drain": 0.0})
    bank = jaxtank.instruments.PumpBank(low=[-12.0], high=[12.0], initial=[-12.0])
    law = Proportional(Kc=0.0, bias=-12.0)
    loop = dataclasses.replace(case.loop, plant=plant, actuator=bank, controller=law)
    with pytest.warns(UserWarning, match="tank 1 falls below 0 .* derivative of the plant"):
        jaxtank.simulate(loop, jaxtank.Clock(dt=0.01, duration=0.5))


def own(role, **methods):
    return component(type("Own", (role,), methods))()


ESTIMATE = r"observer Own: its step must return \(Estimate"
PARTS = {
    "readings alone": (Sensor, lambda s, state, x, xi, dt: x, "reading|tuple"),
    "one reading": (Sensor, lambda s, state, x, xi, dt: (x[1:], state), "returns 1 reading"),
    "three readings": (Sensor, lambda s, state, x, xi, dt: ((*x, x[0]), state), "3 readings"),
    "no Estimate": (Observer, lambda s, state, tick, y: (y, state), ESTIMATE),
    "no state": (Observer, lambda s, state, tick, y: Estimate(x=y), ESTIMATE),
    "one level": (Observer, lambda s, state, tick, y: (Estimate(x=y[1:]), state), "1 level"),
    "three levels": (Observer, lambda s, _, tick, y: (Estimate(x=(*y, y[0])), _), "3 levels"),
    "one disturbance": (
        Observer,
        lambda s, state, tick, y: (Estimate(x=y, d=y[1:]), state),
        "returns 1 disturbance",
    ),
}


@pytest.mark.parametrize(("role", "step", "words"), PARTS.values(), ids=PARTS)
def test_sensors_and_observers_return_one_number_for_each_tank(role, step, words):
    case = presets.find("cascaded/pi")
    part = {"sensor" if role is Sensor else "observer": own(role, step=step)}
    with pytest.raises(InputError, match=words):
        jaxtank.evaluate(dataclasses.replace(case.loop, **part), case.clock, ["rms_error"])


RATES = {
    "one number": (lambda u: 0.1 * u, "no tuple of numbers"),
    "too many": (lambda u: (u, u), "2 rates"),
    "an array in a tuple": (lambda u: (jnp.ones(1) * u,), "a rate that is no single real number"),
    "complex": (lambda u: (1j * u,), "a rate that is no single real number"),
}


@pytest.mark.parametrize(("rates", "words"), RATES.values(), ids=RATES)
def test_a_plant_returns_one_rate_for_each_tank(rates, words):
    derivative = lambda self, t, x, u, d: rates(u[0])
    plant = own(Plant, outputs=(0,), tanks=1, pumps=1, rim=np.array([9.0]), derivative=derivative)
    with pytest.raises(InputError, match=f"plant Own: its derivative returns {words}"):
        advance(plant, "rk4", 0.0, (1.0,), (jnp.asarray(1.0),), None, 1.0, 1)


@component
class Wearing(Plant):
    """The outlet of one tank, whose pump wears out."""

    gain: float = leaf("cm/(s V)", "rate per volt of the pump at t = 0", low=0.0)
    wear: float = leaf("1/s", "share of it that is lost per second", low=0.0)
    rim: np.ndarray = leaf("cm", "height", shape="tank")
    outputs: tuple = static(doc="controlled tanks", default=(0,))
    tanks, pumps = 1, 1

    def derivative(self, t, x, u, d):
        return (self.gain * (1.0 - self.wear * t) * u[0] - 0.02 * x[0],)


def test_the_time_of_a_plant_counts_in_data_observers_and_margins():
    """0.1 (1 - 0.001 t) u - 0.02 h, integrated by scipy: with t = 0 residuals are 200 times the
    noise, and the disturbance is 0.04 cm/s.
    """
    plant, rng = Wearing(rim=[30.0], gain=0.1, wear=1e-3), np.random.default_rng(0)
    t, h, levels = np.arange(400.0), 5.0, []
    u = 2.0 + np.repeat(rng.uniform(-1.0, 1.0, 20), 20)
    for k in range(400):
        levels.append(h)
        rate = lambda s, z, k=k: 0.1 * (1.0 - 1e-3 * s) * u[k] - 0.02 * z
        h = solve_ivp(rate, (t[k], t[k] + 1.0), [h], rtol=1e-10, atol=1e-10).y[0, -1]
    log = tuning.log(t=t, u=u, y=np.array(levels) + 0.01 * rng.standard_normal(400))
    assert tuning.predict(plant, log).quality["rmse"][0] < 0.012
    free = {"plant.gain": (0.01, 1.0), "plant.wear": (1e-5, 1e-2)}
    fit = tuning.identify(plant, log, free, starts=1).parameters
    assert fit["plant.gain"]["value"] == pytest.approx(0.1, rel=1e-3)
    assert fit["plant.wear"]["value"] == pytest.approx(1e-3, rel=1e-2)
    loop = dataclasses.replace(
        presets.find("cascaded/pi").loop,
        plant=plant,
        sensor=jaxtank.instruments.LevelSensor(noise=[0.0]),
        observer=DisturbanceObserver(model=plant, l=[0.2], measured=(0,)),
        controller=Proportional(Kc=2.0, bias=1.0),
        actuator=jaxtank.instruments.PumpBank(low=[0.0], high=[50.0]),
        reference=jaxtank.signals.ramps([5.0], [(10.0, 0, 9.0)], ramp=0.0),
        disturbance=None,
        x0=number([5.0]),
    )
    clock = jaxtank.Clock(dt=0.5, duration=200.0)
    assert abs(jaxtank.simulate(loop, clock).d_hat[-1, 0]) < 1e-4
    assert all("depend on time" in p.why for p in jaxtank.stability_margins(loop, clock))
    noise = {"process": [1e-4], "measurement": [1e-4]}
    model = Kalman(model=plant, levels=[5.0], inputs=[1.0], measured=(0,), **noise)
    with pytest.raises(InputError, match=r"observer\.model: its rates depend on time"):
        jaxtank.simulate(dataclasses.replace(loop, observer=model), clock)


def test_data_need_a_sensor_of_levels_and_names_of_what_is_free():
    log = tuning.log(t=np.arange(60.0), u=np.ones(60), y=np.ones(60))
    case = presets.find("cascaded/open-loop")
    sensor = own(Sensor, step=lambda s, state, x, xi, dt: (x, state))
    with pytest.raises(InputError, match="readings of a LevelSensor"):
        tuning.predict(case.replace(loop=dataclasses.replace(case.loop, sensor=sensor)), log)
    plant = Wearing(rim=[30.0], gain=0.1, wear=1e-3)
    with pytest.raises(InputError, match="no parameter is estimated by default"):
        tuning.identify(plant, log)
    with pytest.raises(InputError, match="substeps = 0: must be a whole number"):
        tuning.identify(plant, log, {"plant.gain": (0.01, 1.0)}, substeps=0)
    for data in ({"t": log.t}, "log.csv", None, (log.t, log.u)):
        with pytest.raises(InputError, match=r"must be a Log .* tuning\.log"):
            tuning.predict(plant, data)
