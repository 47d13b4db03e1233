"""Rigs that are not plain, under everything that reads a rig: a right number against runs, or a
refusal that names the element.
"""

import dataclasses

import element_rigs as er
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxtank
import tuning
from jaxtank import controllers, observers
from jaxtank.analysis.linear_model import linearise
from jaxtank.analysis.steady_batch import SteadyStates
from jaxtank.analysis.steady_state import equilibrium, steady_along, steady_flows
from jaxtank.core.clock import Clock
from jaxtank.core.errors import EquilibriumError, InputError
from jaxtank.export.source import export
from jaxtank.loop import step_size
from jaxtank.loop.steady import steady_inflow, steady_state
from jaxtank.plants import elements
from jaxtank.plants.network import network
from jaxtank.plants.runge_kutta import advance
from jaxtank.plots.equations import equations
from jaxtank.plots.layout import place, valves

WITH_STEADY_STATE = ("valve", "cone")
NAMED = {"valve": "valve", "recycle": "pump that draws from a tank", "cone": "tank with a shape"}


def at_rest(case, x, u, duration=50.0):
    """Levels after a while with the inputs held."""
    step = jax.jit(
        lambda x: advance(case.loop.plant, "rk4", 0.0, x, u, steady_inflow(case.loop), 0.5, 1).x
    )
    x = tuple(jnp.asarray(v) for v in x)
    for _ in range(int(duration / 0.5)):
        x = step(x)
    return np.array(x)


@pytest.mark.extended
@pytest.mark.slow_for("valve")
@pytest.mark.parametrize("rig", WITH_STEADY_STATE)
def test_a_rig_stays_where_its_steady_state_is(rig):
    case = er.case(rig)
    x, u = steady_state(case.loop, [13.0])
    assert np.allclose(at_rest(case, x, tuple(u)), x, rtol=1e-11)
    assert x[0] == 13.0
    plant, inflow = case.loop.plant, steady_inflow(case.loop)
    _, inputs = steady_along(plant, (jnp.array([13.0, 15.0]),), inflow)
    assert np.allclose(inputs[0][0], u[0], rtol=1e-12)
    values = {"pump_gain": plant.pump_gain[None]}
    states = SteadyStates(plant, values, 0.0 if inflow is None else inflow)
    assert np.allclose(states.at(np.array([[13.0]]))[1][0, 0], u, rtol=1e-12)


def test_valves_and_pumps_of_two_tanks_have_the_inputs_that_hold_their_levels():
    """As many inputs as outputs: the third input, a valve, is replaced by an orifice."""
    plant, _, _ = er.joined()
    plant = network(
        area=plant.area, drain=[0.0, 0.3], pump_gain=plant.pump_gain, feeds=plant.feeds,
        valves=plant.valves[:1], valve=plant.valve[:1], characteristics="equal-percentage",
        rangeability=30.0, ports={"valve": [0.5]}, rim=plant.rim, outputs=(0, 1),
    )  # fmt: skip
    _, u = equilibrium(plant, (20.0, 12.0))
    w = np.sqrt(2.0 * 981.0)
    outflow = 0.3 * w * np.sqrt(12.0)
    assert np.isclose(12.0 * u[0], outflow, rtol=1e-9)
    root = 8.0 / (64.0 + plant.knee**2) ** 0.25
    assert np.isclose(1.2 * 30.0 ** (u[1] - 1.0) * w * root, outflow, rtol=1e-9)


def test_steady_states_that_no_opening_gives_name_the_valve():
    plant, _, _ = er.valve()
    with pytest.raises(EquilibriumError, match="valve 1 would have to open to"):
        equilibrium(plant, (15.0,), inflow=(-60.0,))


def test_a_closed_circuit_has_no_unique_steady_state():
    case = er.case("recycle")
    assert elements.closed_circuit(case.loop.plant) == [0, 1]
    for of in (
        lambda: equilibrium(case.loop.plant, (12.0,)),
        lambda: tuning.feasibility(case, {"plant.rim": 0.1}),
    ):
        with pytest.raises(InputError, match="basin"):
            of()


@pytest.mark.slow
def test_slopes_of_a_steady_state_are_those_of_its_balance():
    plant, _, _ = er.cone()

    def needed(drain):
        return steady_flows(dataclasses.replace(plant, drain=drain), (14.0,))[1][0]

    slope = jax.grad(lambda v: needed(v))(jnp.array([0.2]))[0]
    assert np.isclose(slope, np.sqrt(2.0 * 981.0) * 12.0**0.6 / 10.0, rtol=1e-9)


def lqi(plant, level):
    weights = {"Q": np.ones(plant.tanks + 1), "R": np.ones(1)}
    return controllers.LQI(model=plant, operating_point=level[:1], **weights)


def gpc(plant, level):
    limits = {"du_limit": [1.0], "u_low": [0.0], "u_high": [1.0 if plant.valves else 12.0]}
    sizes = {"Nc": 5, "Np": 20, "mode": "clipped", "q": [1.0], **limits}
    r_w = 100.0 if plant.valves else 1.0
    return controllers.GPC(model=plant, operating_point=level, r_w=r_w, **sizes)


@pytest.mark.slow_for("recycle-gpc", "valve-lqi", "cone-gpc", "cone-lqi", "valve-gpc")
@pytest.mark.parametrize(
    ("rig", "kind"), [(r, k) for r in er.RIGS for k in (lqi, gpc) if (r, k) != ("recycle", lqi)]
)
def test_controllers_on_linear_models_have_no_steady_error(rig, kind):
    start = er.case(rig)
    case = er.case(rig, controller=kind(start.loop.plant, start.loop.x0), free={})
    run = jaxtank.simulate(case.loop, case.clock)
    assert abs(run.x[-1, 0] - run.r[-1, 0]) < 1e-4


REFUSED = {
    "enmpc": lambda plant: controllers.ENMPC(model=plant, Tp=2.0),
    "feed-forward": lambda plant: controllers.PID(
        model=plant, Kc=[1.0], bias=[0.0], feed_forward=True
    ),
    "two-tank backstepping": lambda plant: controllers.TwoTankBackstepping(
        model=plant, K_phi=1.0, K_y=1.0, level_floor=0.1, difference_floor=0.1
    ),
}


@pytest.mark.parametrize("kind", REFUSED)
@pytest.mark.parametrize("rig", er.RIGS)
def test_controllers_with_formulas_of_a_plain_rig_refuse(rig, kind):
    plant, _, _ = er.RIGS[rig]()
    with pytest.raises(InputError, match=f"not covered: .*{NAMED[rig]}"):
        case = er.case(rig, controller=REFUSED[kind](plant), free={})
        jaxtank.check(case.loop, case.clock)


def test_a_filter_of_another_rig_is_refused_and_the_checker_names_the_field():
    from jaxtank.safety.checker import check

    plain = network(area=[50.0], drain=[0.2], pump_gain=[10.0], feeds=[(0, None)], rim=[40.0])
    case = er.case("cone")
    loop = dataclasses.replace(
        case.loop, plant=plain, controller=dataclasses.replace(case.loop.controller, model=plain)
    )
    safety_filter = case.replace(loop=loop).with_safety_filter().loop.safety_filter
    with pytest.raises(InputError, match="safety_filter: not covered: tank with a shape"):
        jaxtank.check(dataclasses.replace(case.loop, safety_filter=safety_filter), case.clock)
    parts = case.loop.plant, case.loop.actuator, case.loop.sensor
    (row,) = check(safety_filter, *parts, hold=0.5, box={})
    assert not row.holds and row.reason.startswith("not covered: plant.")


def test_steps_near_empty_are_judged_by_the_same_number_as_a_plain_drain():
    plain = network(area=[20.0], drain=[0.5], pump_gain=[8.0], feeds=[(0, None)], rim=[20.0])
    valve = network(
        area=[20.0], drain=[0.0], pump_gain=[8.0], feeds=[(0, None)], rim=[20.0],
        valves=[(0, None)], valve=[0.5],
    )  # fmt: skip
    pair = network(
        area=[20.0, 30.0], drain=0.0, pipes=[(0, 1)], pipe=[0.4], pump_gain=[8.0],
        feeds=[(0, None)], rim=20.0,
    )  # fmt: skip
    joined = network(
        area=[20.0, 30.0], drain=0.0, pump_gain=[8.0], feeds=[(0, None)], rim=20.0, valves=[(0, 1)],
        valve=[0.4],
    )  # fmt: skip
    for one, other in ((plain, valve), (pair, joined)):
        rates = (step_size.emptying_rates(plant) for plant in (one, other))
        assert np.allclose(*rates, rtol=1e-6)


def test_a_run_that_empties_a_valve_tank_in_one_step_is_refused():
    case = er.case("valve")
    plant = dataclasses.replace(case.loop.plant, valve=np.array([500.0]))
    controller = dataclasses.replace(case.loop.controller, model=plant)
    loop = dataclasses.replace(case.loop, plant=plant, controller=controller)
    with pytest.raises(InputError, match="runs empty in"):
        jaxtank.check(loop, Clock(dt=1.0, duration=10.0))


@pytest.mark.extended
def test_the_volume_of_a_run_is_what_flows_in_in_a_cone_and_in_a_closed_circuit():
    case = er.case("recycle")
    run = jaxtank.simulate(case.loop, case.clock)
    volume = np.asarray(run.x) @ np.asarray(case.loop.plant.area)
    assert np.ptp(volume) < 1e-11 * volume[0]
    plant, _, _ = er.cone()
    plant = dataclasses.replace(
        plant, drain=np.zeros(1), drain_resistance=np.array([np.inf]), rim=np.array([12.0])
    )
    case = er.case("cone")
    controller = dataclasses.replace(case.loop.controller, model=plant)
    loop = dataclasses.replace(case.loop, plant=plant, controller=controller, x0=np.array([1e-3]))
    run = jaxtank.simulate(loop, case.clock)
    stored = np.asarray(plant.stored((run.x[:, 0],))[0])
    entered = np.concatenate([[0.0], np.cumsum(0.5 * 10.0 * np.asarray(run.u)[:-1, 0])])
    balance = stored + np.asarray(run.spilled)[:, 0] - entered
    assert run.spilled[-1, 0] > 100.0
    assert np.ptp(balance) < 1e-11 * entered[-1]


@pytest.mark.extended
def test_the_lowest_setpoint_that_is_feasible_is_that_of_the_open_valve():
    lowest = (60.0 / (0.8 * np.sqrt(2.0 * 981.0))) ** 2
    for factor, feasible in ((1.01, True), (0.99, False)):
        low = er.case("valve", step=factor * lowest / 15.0)
        assert tuning.can_follow(low, {"plant.valve": np.array([[0.8]])}).tolist() == [feasible]


@pytest.mark.slow
def test_an_extended_kalman_filter_finds_an_unmeasured_level():
    start = er.case("recycle")
    observer = observers.ExtendedKalman(
        model=start.loop.plant,
        process=np.full(2, 1e-2),
        measurement=np.full(2, 1e-2),
        spread=np.full(2, 1.0),
        measured=(0,),
    )
    case = er.case("recycle", observer=observer)
    run = jaxtank.simulate(case.loop, case.clock)
    assert np.allclose(run.x, run.x_hat, atol=1e-6)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (er.valve, ["35.44 u1 q(h1)"]),
        (er.recycle, ["1 f1(u1) e1(h1 - h2)"]),
        (er.cone, ["8.859 (h1 - 2)^0.6", "(h1 - 2)/4", "cone"]),
        (er.joined, ["53.15 30^(u2 - 1) w("]),
    ],
)
def test_equations_and_the_drawing_have_every_element(make, words):
    plant, _, _ = make()
    text = "\n".join(equations(plant))
    assert all(part in text for part in words)
    where = place(plant)
    assert len(valves(plant, where)) == len(plant.valves)
    assert len(where.suctions) == sum(source is not None for source in plant.sources)


@pytest.mark.parametrize("rig", er.RIGS)
def test_pi_is_exported_and_lqi_refused_by_name(rig):
    case = er.case(rig)
    assert "Kc" in export(case, "m") or len(export(case, "c")) > 1000
    if rig in WITH_STEADY_STATE:
        other = er.case(rig, controller=lqi(case.loop.plant, case.loop.x0), free={})
        with pytest.raises(InputError, match="LQI as code: not covered"):
            export(other)


@pytest.mark.slow_for("recycle", "cone")
@pytest.mark.parametrize("rig", er.RIGS)
def test_slopes_of_a_run_are_those_of_differences(rig):
    case = er.case(rig, duration=30.0)
    names = [n for n in SLOPES if n in jaxtank.parameters(case.loop)]
    values = {n: np.asarray(jaxtank.parameters(case.loop)[n], float) for n in names}

    def cost(values):
        loop = jaxtank.with_values(case.loop, values)
        return jaxtank.evaluate(loop, case.clock, ["rms_error_total"])["rms_error_total"].sum()

    slopes = jax.grad(cost)(values)
    for name, value in values.items():
        for i in np.flatnonzero(value):
            step = 1e-4 * value[i] * np.eye(len(value))[i]

            def at(k, name=name, step=step):
                return float(cost({**values, name: values[name] + k * step}))

            difference = (8 * (at(1) - at(-1)) - (at(2) - at(-2))) / (12 * step[i])
            assert np.isclose(slopes[name][i], difference, rtol=1e-6, atol=1e-9), name


SLOPES = [
    *("plant.area", "plant.orifice", "plant.pump_gain", "plant.valve", "plant.extent"),
    *("plant.drain_port", "plant.drain_exponent", "plant.drain_resistance", "controller.Kc", "x0"),
]


@pytest.mark.extended
@pytest.mark.slow_for("recycle", "cone")
@pytest.mark.parametrize("rig", er.RIGS)
def test_the_page_computes_what_the_library_does(rig):
    from helpers import NODE, node

    from jaxtank.live.engine import engine

    if NODE is None:
        pytest.skip("no node on this machine")
    case = er.case(rig)
    script = """const e = makeEngine(), r = e.run({}, { every: 10, seed: 0 });
    const rows = (part) => part.map((column) => Array.from(column));
    console.log(JSON.stringify({ h: rows(r.h), u: rows(r.u) }));"""
    page = node(engine(case) + script)
    run = jaxtank.simulate(case.loop, case.clock, save_every=10)
    assert np.allclose(np.array(page["h"]).T, run.x, rtol=1e-9)
    assert np.allclose(np.array(page["u"]).T, run.u, rtol=1e-9)


@pytest.mark.slow
def test_a_default_tune_of_a_valve_in_the_outlet_holds_its_limits():
    free = {"controller.Kc[0]": (-2.0, -0.005), "controller.Ti[0]": (1.0, 500.0)}
    result = tuning.tune(er.case("valve", free=free, duration=150.0))
    assert result.success
    assert result.to_json()["holds"]["limits_on_validation"] == 1.0
    assert result["controller.Kc[0]"].after < 0.0


@pytest.mark.slow
def test_an_attack_on_a_valve_finds_a_level_that_no_draw_passes():
    case = er.case("valve", uncertain={"plant.valve": 0.1})
    attack = tuning.attack(case, starts=2).to_json()["worst"][0]
    draws = tuning.ensemble(case, {"plant.valve": tuning.Uniform(relative=0.1)}, samples=16)
    assert attack["level"] >= draws.to_json()["measures"]["max_level"]["max"][0] - 1e-9


def test_the_linear_model_of_a_valve_is_its_slope():
    plant, _, _ = er.valve()
    A, B, _ = linearise(plant, (15.0,), (0.4,))
    flow = 0.8 * np.sqrt(2.0 * 981.0 * 15.0)
    assert np.isclose(B[0, 0], -flow / 50.0) and np.isclose(A[0, 0], -0.4 * flow / 2 / 15.0 / 50.0)


@pytest.mark.slow_for("valve-off0", "cone-off1")
@pytest.mark.parametrize(
    ("rig", "off"),
    [
        ("valve", {"plant.valve[0]": 0.7}),
        ("cone", {"plant.drain[0]": 0.17, "plant.drain_exponent[0]": 0.66}),
    ],
)
def test_parameters_of_elements_are_identified(rig, off):
    case = er.case(rig, step=1.3)
    run = jaxtank.simulate(case.loop, case.clock)
    data = tuning.log(t=run.t, u=run.u, y=run.y, tanks=[0])
    start = case.replace(loop=jaxtank.with_values(case.loop, off))
    free = {name: (0.5 * value, 2.0 * value) for name, value in off.items()}
    fit = tuning.identify(start, data, free, start="case", starts=1, noise=0.01)
    for name in off:
        right = float(jaxtank.parameters(case.loop)[name.split("[")[0]][0])
        assert np.isclose(fit.parameters[name]["value"], right, rtol=1e-4)
