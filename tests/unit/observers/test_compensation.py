"""What controllers make of an estimated disturbance: the plant's steady state is theirs, whatever
their model lacks, and errors at the ends of plateaus vanish.
"""

import dataclasses

import jax
import numpy as np
import pytest

import jaxtank
from jaxtank import presets, rig
from jaxtank.analysis.riccati import zero_order_hold
from jaxtank.analysis.steady_state import equilibrium, steady_along, steady_under
from jaxtank.controllers import StateFeedback
from jaxtank.core.records import Estimate, Tick
from jaxtank.core.tree import with_values
from jaxtank.loop.estimate_notes import is_unused
from jaxtank.observers import DisturbanceObserver
from jaxtank.plants import state_coupled_four_tank

# the case, its setpoints [cm], and the largest error of a command [V]: roots in the sliding mode
# are smooth at 0, and a quadratic programme ends its iterations
CASES = {
    "gouta2015/ngpc": ((12.0, 10.0), 1e-9),
    "gouta2015/backstepping": ((12.0, 10.0), 1e-9),
    "gouta2015/backstepping-ff": ((12.0, 10.0), 1e-9),
    "gouta2022/chadpc": ((9.0, 10.0), 1e-9),
    "gouta2022/pi-ff": ((9.0, 10.0), 1e-9),
    "mirakhorli/sfc": ((12.0, 12.0), 1e-9),
    "mirakhorli/lqi": ((12.0, 12.0), 1e-9),
    "mirakhorli/smc": ((12.0, 12.0), 1e-4),
    "mirakhorli/hybrid": ((12.0, 12.0), 1e-9),
    "khalid/gpc": ((0.4,), 1e-9),
    "khalid/laguerre": ((0.4,), 1e-9),
}
OFFSET = [name for name in CASES if not name.startswith("khalid")]


def wrong(plant):
    """A plant whose outlets, orifices and pumps differ from its model, each by its own share."""
    shares = {"drain": 1.1, "orifice": np.array([1.05, 0.97, 1.02, 0.96]), "pump_gain": 0.95}
    values = {n: getattr(plant, n) for n in shares}
    return with_values(
        plant, {n: v * np.resize(shares[n], np.shape(v)) for n, v in values.items() if np.size(v)}
    )


def commanded(case, h, u, r, d):
    """What the controller commands at rest at levels h under inputs u, told of disturbances d."""
    controller, dt = case.loop.controller, case.clock.dt
    still = tuple(np.zeros(1) for _ in r)
    plan = controller.prepare(tuple(np.array([v]) for v in r), still, still)
    plan = jax.tree.map(lambda v: v[0], plan)
    rest = (0.0,) * len(r)
    tick = Tick(t=0.0, r=tuple(r), dr=rest, ddr=rest, dt=dt, plan=plan)
    state = controller.init(tuple(h), tuple(u))
    step = jax.jit(lambda d: controller.step(state, tick, Estimate(x=tuple(h), d=d))[0])
    return np.asarray(step(d))


@pytest.mark.slow_for(*(set(CASES) - {"gouta2015/backstepping-ff", "gouta2022/chadpc"}))
@pytest.mark.parametrize("name", CASES)
def test_the_steady_state_of_a_wrong_plant_is_that_of_the_controller(name):
    """Levels and inputs of the wrong plant at the setpoint, by `equilibrium`, and its d by the mass
    balance of the model: the command is the input that the plant needs, with d alone.
    """
    case, (r, tolerance) = presets.find(name), CASES[name]
    h, u = equilibrium(wrong(case.loop.plant), np.array(r))
    model = case.loop.controller.model
    d = tuple(-v for v in model.derivative(0.0, tuple(h), tuple(u), None))
    np.testing.assert_allclose(commanded(case, h, u, r, d), u, rtol=0, atol=tolerance)
    if name in OFFSET:
        assert np.abs(commanded(case, h, u, r, ()) - u).max() > 0.1


@pytest.mark.extended
def test_the_steady_state_under_disturbances_is_one_of_the_rig():
    """Against the rig's own rates, on the quadruple tank with a leak and an inflow."""
    plant = presets.find("mirakhorli/sfc").loop.plant
    r, d = (np.array(12.0), np.array(9.0)), (0.02, -0.01, 0.03, -0.02)
    h, u = steady_under(plant, *steady_along(plant, r), d)
    inflow = tuple(a * v for a, v in zip(plant.area, d))
    np.testing.assert_allclose(plant.derivative(0.0, h, u, inflow), 0.0, atol=1e-9)
    np.testing.assert_allclose(h[:2], r, rtol=1e-12)


@pytest.mark.slow
def test_the_change_of_the_levels_in_gpc_is_that_of_a_linear_plant():
    """On levels that follow the linear model exactly, the difference of two of them is W (f + g u +
    d): here of the rig near its operating point, to second order.
    """
    case = presets.find("khalid/gpc-mimo")
    controller, dt = case.loop.controller, 0.01
    point, u = np.asarray(controller.operating_point), (1.0, 0.6)
    h, d = point + 1e-6, (1e-4, -2e-4)
    before = controller.init(tuple(h), u)
    tick = Tick(t=0.0, r=(0.0, 0.0), dr=(), ddr=(), dt=dt)
    found = jax.jit(lambda d: controller._change(before, tick, Estimate(x=tuple(h), d=d)))(d)
    A = jaxtank.analysis.linearise(controller.model, point, u)[0]
    rate = np.asarray(controller.model.derivative(0.0, tuple(point), u, None)) + d
    Ad, held = (np.asarray(v) for v in zero_order_hold(A, rate[:, None], dt))
    earlier = np.linalg.solve(Ad, (h - point) - held[:, 0])  # a sample before, x - point
    np.testing.assert_allclose(found, (h - point) - earlier, rtol=1e-4)


@pytest.mark.slow_for("ngpc", "backstepping")
@pytest.mark.parametrize("kind", ["backstepping", "ngpc"])
def test_the_error_at_the_end_of_a_plateau_vanishes(kind):
    """A wrong plant on the first two plateaus of the benchmark, with and without the observer."""
    values = {"clock.dt": 0.1, "clock.duration": 470.0}
    case = rig.set_values(presets.find(f"gouta2015/{kind}-observer"), values)
    loop = dataclasses.replace(case.loop, plant=wrong(case.loop.plant))
    run = jaxtank.simulate(loop, case.clock, save_every=100)
    ends = [27, 47]
    assert np.abs(np.asarray(run.e)[ends]).max() < 1e-3
    direct = dataclasses.replace(loop, observer=presets.find(f"gouta2015/{kind}").loop.observer)
    run = jaxtank.simulate(direct, case.clock, save_every=100)
    assert np.abs(np.asarray(run.e)[ends]).max(axis=1).min() > 0.5


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["kalman", "extended-kalman"])
def test_with_random_walks_in_a_kalman_filter_too(kind):
    """Away from the operating point of the linear filter as well."""
    lines = ['case = "gouta2015/ngpc"', "[observer]", f'kind = "{kind}"', "process = 1e-6"]
    lines += ["measurement = 1e-4", "walk = 1e-4", "disturbed = [1, 2, 3, 4]"]
    case = rig.loads("\n".join(lines))
    case = rig.set_values(case, {"clock.dt": 0.1, "clock.duration": 470.0})
    loop = dataclasses.replace(case.loop, plant=wrong(case.loop.plant))
    run = jaxtank.simulate(loop, case.clock, save_every=100)
    assert np.abs(np.asarray(run.e)[[27, 47]]).max() < 1e-3


@pytest.mark.slow
def test_gains_of_controller_and_observer_are_tuned_together_with_noise_and_delay():
    import tuning

    values = {"clock.dt": 0.1, "sensor.noise": 0.03, "actuator.delay": 1.0}
    case = rig.set_values(presets.find("gouta2015/backstepping-observer"), values)
    loop = dataclasses.replace(case.loop, plant=wrong(case.loop.plant))
    found = tuning.tune(case.replace(loop=loop), limits={}, starts=1)
    before, after = (found.measures[k]["rms_error_total"] for k in ("before", "after"))
    assert after < 0.9 * before
    assert found["observer.l[0]"].after != found["observer.l[0]"].before


@pytest.mark.slow
def test_the_safety_filter_keeps_its_limits_with_an_observer():
    """A plant of the interval whose upper tanks pass their rims without the filter."""
    case = rig.set_values(
        presets.find("gouta2015/ngpc-observer"), {"clock.dt": 0.1, "clock.duration": 470.0}
    )
    safe = case.with_safety_filter()
    scaled = {"plant.drain": 1.05 * case.loop.plant.drain}
    highest = [
        np.max(jaxtank.evaluate(with_values(c.loop, scaled), c.clock, "max_level")["max_level"])
        for c in (case, safe)
    ]
    assert highest[0] > 31.0 and highest[1] < 30.0


def test_a_controller_that_does_not_use_the_estimate_is_named():
    """Of a user's own too: it is found by tracing."""
    loop = presets.find("cascaded/pi").loop
    observer = DisturbanceObserver(model=loop.plant, l=[0.1, 0.1])
    watched = dataclasses.replace(loop, observer=observer)
    assert not is_unused(loop) and is_unused(watched)
    assert not is_unused(presets.find("gouta2022/enmpc").loop)  # its compensation says so

    class Own(StateFeedback):
        def step(self, state, tick, estimate):
            u, state = super().step(state, tick, estimate._replace(d=()))
            return tuple(v - sum(estimate.d) for v in u), state

    plant = state_coupled_four_tank(15.0)
    own = Own(model=plant, K=np.zeros((2, 4)))
    four = presets.find("gouta2015/ngpc-observer").loop
    assert not is_unused(dataclasses.replace(four, controller=own))
    blind = dataclasses.replace(four, controller=Blind(model=plant, K=np.zeros((2, 4))))
    assert is_unused(blind)


class Blind(StateFeedback):
    """State feedback without the estimate."""

    def step(self, state, tick, estimate):
        return super().step(state, tick, estimate._replace(d=()))
