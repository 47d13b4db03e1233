"""Pumps and valves with a limited rate, a lag and a dead time each, in a rig of a file."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import NODE, node

import jaxtank
from jaxtank import rig
from jaxtank.analysis import margins as am
from jaxtank.analysis.frequency import OpenLoop
from jaxtank.core.errors import InputError
from jaxtank.export.source import export
from jaxtank.instruments.actuators import PumpBank
from jaxtank.live.engine import engine
from jaxtank.loop.margins import stability_margins
from jaxtank.safety.of_case import certificates_of

RIG = """
units = ["m", "-"]
tank = [
  {{ name = "LT101", area = 0.8, rim = 9.0, level = 1.0, inflow = -0.02 }},
  {{ name = "LT102", area = 0.5, rim = 9.0, level = 1.0, inflow = 0.03 }},
]
pump = [{{ gain = 0.1, to = 1, high = 1.0, initial = 0.2{pump} }}]
valve = [{{ from = 2, area = 0.01, initial = 0.5{valve} }}]
plant = {{ gravity = 9.81, outputs = [1, 2] }}
controller = {{ kind = "pi", Kc = [1.5, -1.5], Ti = 40.0, anti_windup = "{windup}"{more} }}
reference = {{ initial = [1.0, 1.0], changes = [[4.0, 1, 3.0], [8.0, 2, 1.2]], ramp = 0.0 }}
values = {{ "clock.dt" = 0.5, "clock.duration" = 120.0, "clock.substeps" = 4 }}
"""
PUMP = {"rate": 0.03, "lag": 2.0, "delay": 1.5}
VALVE = {"rate": 0.05, "lag": 1.0, "delay": 3.0}


def keys(values):
    return "".join(f", {name} = {value}" for name, value in values.items())


def case_of(windup="conditioned", pump=PUMP, valve=VALVE):
    more = ", Tt = 5.0" if windup == "back-calculation" else ""
    text = RIG.format(pump=keys(pump), valve=keys(valve), windup=windup, more=more)
    return rig.loads(text)


def independent(windup, pump=PUMP, valve=VALVE, dt=0.5, samples=241):
    """(levels, inputs within limits and rate, inputs at the plant) of the same loop by hand."""
    h, I = np.array([1.0, 1.0]), np.zeros(2)
    Kc, Ti, Tt = np.array([1.5, -1.5]), 40.0, 5.0
    bias = np.array(case_of(windup, pump, valve).loop.controller.bias)
    u, lagged = np.array([0.2, 0.5]), np.array([0.2, 0.5])
    rate, lag, delay = (
        np.array([part[k] for part in (pump, valve)]) for k in ("rate", "lag", "delay")
    )
    lines = [[v] * round(d / dt) for v, d in zip(u, delay)]
    rows = []
    for k in range(samples):
        r = np.array([3.0 if k * dt >= 4.0 else 1.0, 1.2 if k * dt >= 8.0 else 1.0])
        e = r - h
        v = bias + Kc * e + I
        u = np.clip(np.clip(v, 0.0, 1.0), u - rate * dt, u + rate * dt)
        if windup == "conditioned":
            w = e + (u - v) / Kc
        elif windup == "clamping":
            w = np.where(Kc * e * (v - u) > 0.0, 0.0, e)
        else:
            w = e + Ti / (Tt * Kc) * (u - v)
        I = I + dt * Kc / Ti * w
        keep = np.exp(-dt / lag)
        mean = u + lag / dt * (1.0 - keep) * (lagged - u)
        lagged = u + keep * (lagged - u)
        acting = []
        for line, m in zip(lines, mean):
            line.append(m)
            acting.append(line.pop(0))
        rows.append((h.copy(), u.copy(), np.array(acting)))
        h[0] += dt * (0.1 * acting[0] - 0.02) / 0.8
        a = 0.01 * acting[1] * np.sqrt(2 * 9.81) / 0.5
        for _ in range(200):  # by Heun
            first = 0.06 - a * np.sqrt(h[1])
            h[1] += dt / 400 * (first + 0.06 - a * np.sqrt(h[1] + dt / 200 * first))
    return tuple(np.array(column) for column in zip(*rows))


@pytest.mark.extended
@pytest.mark.slow_for("clamping", "conditioned")
@pytest.mark.parametrize("windup", ["back-calculation", "clamping", "conditioned"])
def test_rate_lag_and_dead_time_of_each_act_and_anti_windup_has_the_inputs_that_are_reached(windup):
    case = case_of(windup)
    run = jaxtank.simulate(case.loop, case.clock)
    x, applied, u = independent(windup)
    np.testing.assert_allclose(run.applied, applied, atol=2e-7)
    np.testing.assert_allclose(run.u, u, atol=2e-7)
    np.testing.assert_allclose(run.x, x, atol=2e-7)
    step = np.abs(np.diff(np.asarray(run.applied), axis=0)) / 0.5
    assert step.max(axis=0) == pytest.approx([0.03, 0.05], rel=1e-9)


@pytest.mark.slow
def test_a_long_ramp_of_the_pump_does_not_wind_the_integral_up():
    """Back-calculation, told of the rate, overshoots no more than the conditioned integral."""
    highest = {}
    for windup in ("back-calculation", "conditioned"):
        case = case_of(windup, {"rate": 0.01}, {})
        highest[windup] = float(np.asarray(jaxtank.simulate(case.loop, case.clock).x)[:, 0].max())
    assert highest["back-calculation"] <= 1.02 * highest["conditioned"]
    quick = {"lag": 1e-9, "delay": 0.0}
    x, *_ = independent("conditioned", {"rate": 0.01, **quick}, {"rate": 9.0, **quick})
    assert highest["conditioned"] == pytest.approx(x[:, 0].max(), abs=1e-6)


@pytest.mark.slow
def test_slopes_by_rate_lag_and_gains_are_those_of_differences_while_the_rate_acts():
    case = case_of()
    clock = jaxtank.Clock(dt=0.5, duration=15.0)
    names = ["actuator.rate", "actuator.lag", "controller.Kc"]
    start = jaxtank.simulate(case.loop, clock)
    assert np.all(np.asarray(start.applied) != np.asarray(start.command), axis=1).any()

    def cost(values):
        loop = jaxtank.with_values(case.loop, dict(zip(names, values)))
        return jnp.sum(jaxtank.evaluate(loop, clock, ["ise"])["ise"] * jnp.array([1.0, 3.0]))

    point = [jnp.asarray(jaxtank.parameters(case.loop)[name]) for name in names]
    slope = np.concatenate([np.asarray(v) for v in jax.jacfwd(cost)(point)])
    flat = np.concatenate([np.asarray(v) for v in point])
    f = lambda flat: cost(np.split(flat, 3))
    right = []
    for k, size in enumerate(flat):
        move = np.zeros(6)
        move[k] = 1e-5 * abs(size)
        right.append((f(flat + move) - f(flat - move)) / (2e-5 * abs(size)))
    np.testing.assert_allclose(slope, right, rtol=1e-6, atol=1e-9)
    assert np.all(slope[:4] != 0.0)


def test_a_rate_that_is_infinite_and_delays_that_are_equal_cost_nothing():
    plain = case_of(pump={}, valve={})
    none = case_of(pump={"rate": "inf", "lag": 0.0, "delay": 2.0}, valve={"delay": 2.0})
    assert none.loop.actuator.rate is None and none.loop.actuator.lag is None
    assert (none.loop.actuator.delay, none.loop.actuator.delays) == (2.0, ())
    assert jax.tree.structure(none.loop.controller) == jax.tree.structure(plain.loop.controller)


@pytest.mark.extended
def test_a_written_rig_has_rate_lag_and_delay_and_runs_alike():
    case = case_of()
    run = jaxtank.simulate(case.loop, case.clock)
    for text in (rig.dump(case), rig.complete(case)):
        again = rig.loads(text)
        assert again.loop.actuator.delays == (0.0, 1.5)
        assert np.array_equal(jaxtank.simulate(again.loop, again.clock).x, run.x)


@pytest.mark.extended
def test_keys_take_units_and_a_valve_in_percent_has_a_rate_in_percent():
    text = RIG.replace('"-"]', '"%"]').replace("initial = 0.5{", "initial = 50.0{")
    valve = ', rate = "1 %/s", delay = "0.05 min"'
    text = text.format(pump=', rate = "3 %/s"', valve=valve, windup="conditioned", more="")
    bank = rig.loads("reachable = false\n" + text).loop.actuator
    assert bank.rate.tolist() == [3.0, 1.0] and bank.delays == (0.0, 3.0)


@pytest.mark.parametrize(
    ("keys", "words"),
    [
        ("rate = 0.0", "pump 1: rate = .*above 0"),
        ("rate = -1.0", "pump 1: rate"),
        ("lag = -1.0", "pump 1: lag"),
        ("delay = 0.7", "whole number of samples"),
        ("delay = -1.0", "pump 1: delay"),
        ("delay = 130.0", "to 120 s"),
        ('rate = "3 m"', "pump 1: rate"),
    ],
)
def test_values_that_no_pump_has_are_refused(keys, words):
    with pytest.raises(InputError, match=words):
        rig.loads(RIG.format(pump=f", {keys}", valve="", windup="conditioned", more=""))


@pytest.mark.slow
def test_margins_have_the_lag_and_the_dead_time_of_each_input():
    """The two loops do not meet: each has the margins of its integrator with lag and dead time."""
    case = case_of()
    plateau = stability_margins(case.loop, case.clock)[0]
    assert not plateau.why and plateau.stable
    h, dt = 1.0, 0.5
    root = np.sqrt(2 * 9.81 * h)
    opening = 0.03 / (0.01 * root)
    plants = [
        (0.0, 0.1 / 0.8, 1.5),
        (-0.01 * opening * root / (2 * h) / 0.5, -0.01 * root / 0.5, -1.5),
    ]
    for i, ((a, b, Kc), part) in enumerate(zip(plants, (PUMP, VALVE))):
        keep = np.exp(-dt / part["lag"])
        share = (
            part["lag"] / dt * (1.0 - keep)
        )  # of the mean over a sample that is still the old one
        advance, enters = np.exp(a * dt), (np.expm1(a * dt) / a if a else dt) * b
        # level, lagged input, integral
        A = np.array(
            [[advance, enters * share, 0.0], [0.0, keep, 0.0], [-dt * Kc / 40.0, 0.0, 1.0]]
        )
        B = np.array([[enters * (1.0 - share)], [1.0 - keep], [0.0]])
        C = np.array([[Kc, 0.0, -1.0]])
        right = am.margins(OpenLoop(A, B, C, round(part["delay"] / dt), dt), False)
        for name in ("gain_margin", "phase_margin", "delay_margin"):
            value = float(getattr(plateau.margins, name)[i])
            assert value == pytest.approx(float(getattr(right, name)[0]), rel=1e-5), name


def test_no_limit_is_proved_of_pumps_with_a_rate_or_dead_times_that_differ():
    pumps = [{"rate": 0.03}, {"delay": 1.0}]
    text = """
    units = ["m", "-"]
    tank = [{{ area = 0.8, rim = 9.0, level = 1.0, drain = 0.01 }},
            {{ area = 0.8, rim = 9.0, level = 1.0, drain = 0.01 }}]
    pump = [{{ gain = 0.1, to = 1, high = 1.0{keys} }}, {{ gain = 0.1, to = 2, high = 1.0 }}]
    plant = {{ gravity = 9.81 }}
    controller = {{ kind = "pi", Kc = 8.0, Ti = 20.0 }}
    values = {{ "clock.dt" = 0.5 }}
    """
    for changes, name in zip(pumps, ("rate", "delays")):
        rows = certificates_of(rig.loads(text.format(keys=keys(changes))))
        assert [row.certified for row in rows] == [False, False]
        assert all(row.reason == f"not covered: actuator.{name}" for row in rows)


def test_arrays_and_scalars_of_a_rate_are_the_same():
    bank = PumpBank(low=[0.0] * 3, high=[1.0] * 3, rate=[0.1, np.inf, 0.5], delays=(0.0, 1.0, 2.0))
    clock = jaxtank.Clock(dt=1.0, duration=9.0)
    rng = np.random.default_rng(0)
    before, other = (0.5,) * 3, jnp.full(3, 0.5)
    state, states = bank.init(clock), bank.init_arrays(clock)
    for _ in range(5):
        command = rng.uniform(-0.5, 1.5, 3)
        before = bank.reachable(before, 1.0).limit(tuple(command))
        other = bank.reachable(other, 1.0).limit(jnp.asarray(command))
        u, state = bank.step(state, before, 1.0)
        v, states = bank.step(states, other, 1.0)
        np.testing.assert_array_equal(before, other)
        np.testing.assert_array_equal(u, v)


REPLAY = """
const law = module.exports, e = makeEngine().run({}, { every: 1 });
const s = law.init(GIVEN.y[0], GIVEN.u), none = [0, 0];
const u = GIVEN.y.map((y, k) => law.step(s, 0.5 * k, y, GIVEN.r[k], none, none));
const part = (a) => a.map((column) => Array.from(column));
console.log(JSON.stringify({ u, h: part(e.h), p: part(e.u) }));
"""


@pytest.mark.slow
@pytest.mark.skipif(NODE is None, reason="node runs the exported code")
def test_exported_code_and_the_page_limit_the_rate_as_the_simulation_does():
    case = case_of()
    run = jaxtank.simulate(case.loop, case.clock)
    given = {"y": np.asarray(run.y).tolist(), "r": np.asarray(run.r).tolist(), "u": [0.2, 0.5]}
    out = node(export(case, "js", name="tanks") + engine(case) + REPLAY, given)
    np.testing.assert_allclose(out["u"], run.applied, atol=1e-12)
    np.testing.assert_allclose(np.transpose(out["h"]), run.x, atol=1e-10)
    np.testing.assert_allclose(np.transpose(out["p"]), run.u, atol=1e-10)


@pytest.mark.extended
def test_the_safety_filter_takes_what_a_pump_reaches_at_its_rate():
    """A rig of pumps and orifices, and one with a valve: each has a filter of its own."""
    plain = """
tank = [{ area = 100.0, rim = 30.0, drain = 0.5, level = 10.0 }]
pump = [{ to = 1, gain = 30.0, high = 10.0, initial = 2.3, rate = 0.4 }]
controller = { kind = "p", Kc = 4.0, bias = 2.3 }
reference = { initial = [10.0], changes = [[5.0, 1, 27.0]], ramp = 0.0 }
values = { "clock.dt" = 0.5, "clock.duration" = 60.0 }
limits = { max_level = 25.0 }
"""
    for case, pump in ((rig.loads(plain), 0), (case_of(), 0)):
        case = rig.filtered(case, True)
        run = jaxtank.simulate(case)
        steps = np.abs(np.diff(np.asarray(run.u)[:, pump])) / case.clock.dt
        assert np.isfinite(run.x).all() and steps.max() <= case.loop.actuator.rate[pump] + 1e-9
        assert all("rate" in c.reason for c in certificates_of(case) if c.limit)
