"""Cascade, override, ratio, reference governor and feed-forward of a measured inflow, against
simulations in plain Python whose integrals are lags of what is applied (external reset).
"""

import math
import re
import types

import jax
import numpy as np
import pytest
from helpers import INTEGRATOR, assert_same_case

import jaxtank
from jaxtank import rig
from jaxtank.bounds import bounds, gain_ranges, widened
from jaxtank.controllers import PID
from jaxtank.controllers.cascade import Cascade
from jaxtank.core.errors import InputError
from jaxtank.limits import resolve_limits
from tuning.problem.reported import run_measures
from tuning.report.advice import blocked_setpoints
from tuning.report.verdict import about_controller_limits
from tuning.search.judged import validate
from tuning.uncertainty.distributions import Uniform
from tuning.uncertainty.draws import Draws

DT, SAMPLES, GRAVITY, DEAD = 0.5, 400, 9.81, 2
UPPER, LOWER, ORIFICE, DRAIN, GAIN = 1.0, 0.5, 0.01, 0.01, 0.1
START = 0.01 * math.sqrt(2 * GRAVITY) / GAIN  # the input at which both levels rest at 1 m
PULSE = 0.3 / 20.0  # m^3/s from 110 s to 130 s

RIG = f"""
units = ["m", "-"]
reachable = false
tank = [
    {{ name = "upper", area = {UPPER}, rim = 9.0, level = 1.0 }},
    {{ name = "lower", area = {LOWER}, rim = 9.0, level = 1.0, drain = {DRAIN} }},
]
orifice = [{{ from = 1, to = 2, area = {ORIFICE} }}]
pump = [{{ gain = {GAIN}, to = 1, high = 1.0, initial = {START!r} }}]
plant = {{ gravity = {GRAVITY}, outputs = [2] }}
inflow = [{{ time = 110.0, duration = 20.0, tank = 1, volume = 0.3 }}]
reference = {{ initial = [1.0], changes = [[10.0, 1, 2.2], [80.0, 1, 0.9]], ramp = 0.0 }}
values = {{ "clock.dt" = {DT}, "clock.duration" = {DT * (SAMPLES - 1)} }}
"""


def kind(table):
    return table["kind"]


def loads(text=RIG, **table):
    return rig.loads(f"{text}controller = {rig.toml(table)}")


def rates(h, u, d):
    flow = [a * np.sqrt(2 * GRAVITY * v) for a, v in zip((ORIFICE, DRAIN), h)]
    return (GAIN * u + d - flow[0]) / UPPER, (flow[0] - flow[1]) / LOWER


def after(h, u, d, dt):
    """Levels after dt by the classical method of order 4."""
    k1 = rates(h, u, d)
    k2 = rates([v + 0.5 * dt * s for v, s in zip(h, k1)], u, d)
    k3 = rates([v + 0.5 * dt * s for v, s in zip(h, k2)], u, d)
    k4 = rates([v + dt * s for v, s in zip(h, k3)], u, d)
    return tuple(v + dt / 6 * (a + 2 * b + 2 * c + e) for v, a, b, c, e in zip(h, k1, k2, k3, k4))


def simulated(control, dead=0, pulse=PULSE):
    """(levels, inputs) of the two tanks under control(k, h, r, d, q) -> input and applied(u)."""
    h, line, q = (1.0, 1.0), [START] * (dead + 1), GAIN * START
    levels, inputs = [], []
    for k in range(SAMPLES):
        t = k * DT
        r = 1.0 if t < 10.0 else 2.2 if t < 80.0 else 0.9
        d = pulse if 110.0 <= t < 130.0 else 0.0
        command, reset = control(h, r, d, q)
        u = min(max(command, 0.0), 1.0)
        reset(u)
        levels.append(h)
        inputs.append(u)
        line.append(u)
        acting = line[-1 - dead]
        h = after(h, acting, d, DT)
        q = GAIN * acting
    return np.array(levels), np.array(inputs)


class Reset:
    """A PI as a gain and a positive feedback of what is applied through a lag Ti."""

    def __init__(self, Kc, Ti, bias):
        self.Kc, self.Ti, self.bias, self.lagged = Kc, Ti, bias, bias

    def output(self, e):
        return self.lagged + self.Kc * e

    def reset(self, applied):
        self.lagged += DT / self.Ti * (applied - self.lagged)


def cascaded(outer, inner, low, high, reading):
    """The control of `simulated` of two PI in cascade."""

    def control(h, r, d, q):
        s = min(max(outer.output(r - h[1]), low), high)
        command = inner.output(s - reading(h, q))

        def reset(u):
            inner.reset(u)
            outer.reset(min(max(s + (u - command) / inner.Kc, low), high))

        return command, reset

    return control


CASCADE = {"kind": "cascade", "Kc": 3.0, "Ti": 60.0, "inner": [1], "inner_Kc": 1.5}
CASCADE |= {"inner_Ti": 15.0, "inner_high": 4.0}
FLOW = {"kind": "flow-cascade", "Kc": 0.1, "Ti": 80.0, "inner_Kc": 2.0, "inner_Ti": 1.5}
OVERRIDE = {"kind": "override", "Kc": 2.0, "Ti": 40.0, "limited": ["upper"], "limit": 1.6}
OVERRIDE |= {"limit_Kc": 3.0, "limit_Ti": 10.0}
GOVERNOR = {"kind": "reference-governor", "Kc": 2.0, "Ti": 40.0, "limit": [2.4, math.inf]}
GOVERNOR |= {"lowest": [0.7, -math.inf], "horizon": 60.0, "samples": 30}


def test_a_cascade_of_levels_is_that_of_two_lags_of_what_is_applied():
    case = loads(**CASCADE)
    run = jaxtank.simulate(case.loop, case.clock)
    control = cascaded(
        Reset(3.0, 60.0, 1.0), Reset(1.5, 15.0, START), -math.inf, 4.0, lambda h, q: h[0]
    )
    levels, inputs = simulated(control)
    np.testing.assert_allclose(np.asarray(run.x), levels, rtol=0, atol=1e-10)
    np.testing.assert_allclose(np.asarray(run.applied)[:, 0], inputs, rtol=0, atol=1e-9)
    assert inputs.max() == 1.0 and inputs.min() == 0.0


def test_a_flow_cascade_reads_the_flow_behind_the_dead_time_of_its_pump():
    case = loads(RIG.replace("values = {", f'values = {{ "actuator.delay" = {DEAD * DT},'), **FLOW)
    run = jaxtank.simulate(case.loop, case.clock)
    outer, inner = Reset(0.1, 80.0, GAIN * START), Reset(2.0, 1.5, START)
    control = cascaded(outer, inner, -math.inf, math.inf, lambda h, q: q)
    levels, inputs = simulated(control, DEAD)
    np.testing.assert_allclose(np.asarray(run.x), levels, rtol=0, atol=1e-10)
    np.testing.assert_allclose(np.asarray(run.applied)[:, 0], inputs, rtol=0, atol=1e-9)
    assert inputs.max() == 1.0 and inputs.min() == 0.0


@pytest.mark.extended_for("high")
@pytest.mark.parametrize("select", ["low", "high"])
def test_an_override_resets_both_integrals_by_what_is_applied(select):
    case = loads(**OVERRIDE, select=select)
    run = jaxtank.simulate(case.loop, case.clock)
    main, limiting = Reset(2.0, 40.0, START), Reset(3.0, 10.0, START)
    choices = []

    def control(h, r, d, q):
        both = main.output(r - h[1]), limiting.output(1.6 - h[0])
        choices.append(both[0] < both[1])

        def reset(u):
            main.reset(u)
            limiting.reset(u)

        return (min if select == "low" else max)(both), reset

    levels, inputs = simulated(control)
    np.testing.assert_allclose(np.asarray(run.x), levels, rtol=0, atol=1e-10)
    np.testing.assert_allclose(np.asarray(run.applied)[:, 0], inputs, rtol=0, atol=1e-9)
    assert 20 < sum(choices) < SAMPLES - 20  # each of them is selected for a while


def most_excess(h, lagged, r):
    """Largest excess over 2.4 m or under 0.7 m of the first level in the responses to r (9,)."""
    h, most, period = tuple(v + 0 * r for v in h), -np.inf + 0 * r, 60.0 / 30
    for _ in range(30):
        u = np.clip(lagged + 2.0 * (r - h[1]), 0.0, 1.0)
        lagged = lagged + period / 40.0 * (u - lagged)
        h = after(h, u, 0.0, period)
        most = np.maximum(most, np.maximum(h[0] - 2.4, 0.7 - h[0]))
    return most


def allowed(h, lagged, before, r, least):
    """The governed setpoint: nine shares of the way, then nine where a limit is met.

    Appends the least excess of the last nine to `least`.
    """
    shares = np.arange(9) / 8
    for _ in range(2):
        most = most_excess(h, lagged, before + shares * (r - before))
        over = np.flatnonzero(most > 0.0)
        least.append(most.min())
        if most[0] > 0.0:
            return before + shares[np.argmin(most)] * (r - before)
        if not len(over):
            return before + shares[-1] * (r - before)
        j = over[0] - 1
        share = shares[j] - most[j] * (shares[j + 1] - shares[j]) / (most[j + 1] - most[j])
        shares = shares[j] + np.arange(9) / 8 * (shares[j + 1] - shares[j])
    return before + share * (r - before)


@pytest.mark.extended
def test_a_reference_governor_keeps_levels_within_limits_that_its_pid_passes():
    steps = re.sub("inflow = .*", "", RIG)  # a pulse that cannot be predicted
    case = loads(steps, **GOVERNOR)
    run = jaxtank.simulate(case.loop, case.clock)
    pi, setpoint, least = Reset(2.0, 40.0, START), [1.0], []

    def control(h, r, d, q):
        setpoint.append(allowed(h, pi.lagged, setpoint[-1], r, least))
        return pi.output(setpoint[-1] - h[1]), pi.reset

    levels, inputs = simulated(control, pulse=0.0)
    np.testing.assert_allclose(np.asarray(run.x), levels, rtol=0, atol=1e-9)
    np.testing.assert_allclose(np.asarray(run.applied)[:, 0], inputs, rtol=0, atol=1e-8)
    alone = loads(steps, kind="pi", Kc=2.0, Ti=40.0)
    without = np.asarray(jaxtank.simulate(alone.loop, alone.clock).x)
    assert without[:, 0].max() > 2.9 and without[:, 0].min() < 0.6
    slack = float(jaxtank.evaluate(case, ["limit_slack"])["limit_slack"])
    assert levels[:, 0].max() < 2.4 + slack + 1e-3 and levels[:, 0].min() > 0.7 - slack - 1e-3
    assert 0.0 < slack < 0.005 and slack == pytest.approx(max(least), rel=1e-5)
    assert setpoint[-1] == pytest.approx(0.9, abs=1e-9)  # which the limits allow at last


def test_a_flow_that_a_flow_cascade_may_not_ask_for_is_in_the_way():
    text = re.sub("inflow = .*", "", RIG)
    for change in ({}, {"inner_high": 1e-3}):
        sentences = blocked_setpoints(loads(text, **FLOW | change))
        assert ["which the controller keeps at or below 0.001 m^3/s" in s for s in sentences] == [
            True
        ] * len(change)


def test_limits_of_a_governor_are_limits_of_each_plant():
    """One that predicts too short a time, and passes its limit, holds on no plant."""
    text = re.sub("inflow = .*", "", RIG)
    case = loads(text, **GOVERNOR | {"horizon": 4.0})
    limits = {(limit.measure, limit.index): limit.value for limit in resolve_limits(case)}
    assert limits["max_level", 0] == pytest.approx(2.4 * 1.002)
    assert limits["min_level", 0] == pytest.approx(0.7 * 0.998)
    assert {m for m, i in limits if i == 1} <= {"max_level"}  # what the case itself states
    assert not validate(case, 8).held.any()


def test_a_governor_whose_prediction_is_unstable_is_named():
    """An integrator under P, Kc gain T/A = 4 of a sample T = 20 s, stable below 2."""
    text = INTEGRATOR.replace(', "actuator.delay" = 5.0', "") + (
        'controller = { kind = "reference-governor", Kc = 2.0, Ti = 1000.0, horizon = 200.0,'
        " samples = 10, limit = [1e9] }"
    )
    case = rig.set_values(rig.loads(text), {"controller.Kc": [4.0 / (20.0 * 0.02)]})
    notes = [note for note in rig.case_warnings(case) if "the governor predicts" in note]
    (samples,) = re.findall(r"samples = (\d+) or more", *notes)
    assert 20 <= int(samples) <= 21
    stable = rig.set_values(case, {"controller.samples": int(samples)})
    assert not any("the governor predicts" in note for note in rig.case_warnings(stable))


def test_ranges_of_a_governor_begin_at_its_predicted_sample():
    """A shorter integral time is refused: in a rig, a range and a draw."""
    loop = loads(**GOVERNOR | {"horizon": 37.03}).loop
    sample = 37.03 / 30
    short = jaxtank.with_values(loop, {"controller.Ti": 2.0 * sample})
    ends = gain_ranges(short)["controller.Ti[0]"]
    assert ends.low == pytest.approx(sample) and ends.high == pytest.approx(60.0 * sample, rel=5e-3)
    (bound,) = bounds(short, {"controller.Ti[0]": ends})
    assert bounds(short, gain_ranges(short))
    assert widened(short, bound, "lower", 1e9).low == pytest.approx(sample)
    with pytest.raises(InputError, match=r"free controller.Ti = .* a predicted sample"):
        bounds(short, {"controller.Ti": (0.5 * sample, 60.0)})
    with pytest.raises(InputError, match=r"uncertain controller.Ti.* = .* a predicted sample"):
        Draws(loop, {"controller.Ti": Uniform(low=0.5 * sample, high=60.0)})


@pytest.mark.extended_for("changes0-said0")
@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({}, []),
        ({"horizon": 4.0}, ["upper rises to"]),
        ({"limit": [9.0, 2.0]}, ["2.2 m in lower, which the controller keeps at or below 2 m"]),
    ],
)
def test_a_limit_of_the_controller_that_is_passed_or_in_the_way_is_named(changes, said):
    case = loads(re.sub("inflow = .*", "", RIG), **(GOVERNOR | changes))
    sentences = about_controller_limits(case.loop, run_measures(case.loop, case.clock, None))
    sentences += blocked_setpoints(case)
    assert all(any(words in one for one in sentences) for words in said)
    assert bool(sentences) == bool(said)


@pytest.mark.extended_for("reference-governor")
@pytest.mark.slow_for("flow-cascade", "override")
@pytest.mark.parametrize("table", [CASCADE, FLOW, OVERRIDE, GOVERNOR], ids=kind)
def test_derivatives_are_differences_of_runs_at_the_limits_too(table):
    case = loads(**table)
    third = next((n for n in table if n.endswith("_Kc")), "limit")
    names = ["controller.Kc", "controller.Ti", f"controller.{third}"]

    def error(values):
        loop = jaxtank.with_values(case.loop, dict(zip(names, values)))
        return jaxtank.evaluate(loop, case.clock, ["rms_error_total"])["rms_error_total"]

    first = np.array([float(np.asarray(jaxtank.parameters(case.loop)[n])[0]) for n in names])
    slopes = np.asarray(jax.jit(jax.jacfwd(error))(first))
    run = jax.jit(jax.vmap(error))
    steps = 1e-6 * np.diag(first)
    above, below = run(first + steps), run(first - steps)
    differences = np.asarray(above - below) / (2e-6 * first)
    np.testing.assert_allclose(slopes, differences, rtol=1e-5, atol=1e-9)


def test_a_measured_inflow_that_is_taken_off_the_input_moves_no_level():
    still = RIG.replace("[[10.0, 1, 2.2], [80.0, 1, 0.9]]", "[]")
    case = loads(still, kind="p", Kc=1.0, inflow_gain=-1.0 / GAIN, inflow_of=["upper"])
    run = jaxtank.simulate(case.loop, case.clock)
    np.testing.assert_allclose(np.asarray(run.x), 1.0, rtol=0, atol=1e-12)
    inputs = np.asarray(run.applied)[:, 0]
    np.testing.assert_allclose(inputs.min(), START - PULSE / GAIN, rtol=1e-12)


def test_a_steady_measured_inflow_is_in_the_bias():
    still = RIG.replace("[[10.0, 1, 2.2], [80.0, 1, 0.9]]", "[]")
    lines = [line for line in still.splitlines() if not line.startswith("inflow")]
    steady = "\n".join(lines).replace('"upper", area', '"upper", inflow = 0.01, area') + "\n"
    steady = steady.replace(f"initial = {START!r}", f"initial = {START - 0.1!r}")
    case = loads(steady, kind="p", Kc=1.0, inflow_gain=-2.0, inflow_of=["upper"])
    np.testing.assert_allclose(case.loop.controller.bias, START - 0.1 + 0.02, rtol=1e-9)
    run = jaxtank.simulate(case.loop, case.clock)
    np.testing.assert_allclose(np.asarray(run.x), 1.0, rtol=0, atol=1e-9)


def test_inputs_follow_another_input_and_a_measured_inflow():
    pump = f"pump = [{{ gain = {GAIN}, to = 1, high = 1.0, initial = {START!r} }}"
    dose = "{ gain = 0.02, to = 2, high = 1.0 }"
    text = RIG.replace(pump, f"{pump}, {dose}, {dose}")
    table = {"kind": "ratio", "Kc": 1.0, "Ti": 30.0, "bias": START, "follow": [1], "ratio": [0.5]}
    case = loads(text, **table, follow_inflow=["upper"], inflow_ratio=[20.0])
    run = jaxtank.simulate(case.loop, case.clock)
    lead, second, third = np.asarray(run.applied).T
    assert lead.max() == 1.0 and lead.min() == 0.0
    np.testing.assert_array_equal(second, 0.5 * lead)
    t = np.asarray(run.t)
    np.testing.assert_allclose(third, np.where((t >= 110) & (t < 130), 20.0 * PULSE, 0.0))
    loop, expected = Reset(1.0, 30.0, START), []
    for level, r in zip(np.asarray(run.x)[:, 1], np.asarray(run.r)[:, 0]):
        expected.append(min(max(loop.output(r - level), 0.0), 1.0))
        loop.reset(expected[-1])
    np.testing.assert_allclose(lead, expected, rtol=0, atol=1e-10)


@pytest.mark.slow
def test_a_direct_action_is_a_negative_gain():
    gains = {"Ti": 40.0, "b": 0.6}
    text = RIG.replace("to = 1, high = 1.0", "from = 1, high = 1.0")
    runs = [
        np.asarray(jaxtank.simulate(case.loop, case.clock).x)
        for case in (
            loads(text, kind="pi", Kc=-1.0, **gains),
            loads(text, kind="pi", Kc=1.0, action="direct", **gains),
        )
    ]
    np.testing.assert_array_equal(*runs)
    with pytest.raises(InputError, match="direct"):
        loads(kind="p", Kc=-1.0, action="direct")


RATIO = {"kind": "ratio", "Kc": 1.0, "Ti": 30.0}


@pytest.mark.extended_for("override", "ratio", "reference-governor")
@pytest.mark.parametrize("table", [CASCADE, FLOW, OVERRIDE, RATIO, GOVERNOR], ids=kind)
def test_a_kind_is_written_back_and_has_ranges_to_tune_in(table):
    case = loads(**table)
    assert_same_case(rig.loads(rig.dump(case)), case)
    # a search does not weaken the loop that keeps a limit
    gains = {n for n in table if n.endswith(("Kc", "Ti")) and not n.startswith("limit")}
    assert gain_ranges(case.loop).keys() == {f"controller.{n}[0]" for n in gains}
    # at rest at the start, and so it stays
    first = jaxtank.simulate(case.loop, jaxtank.Clock(dt=DT, duration=9.0))
    np.testing.assert_allclose(np.asarray(first.x), 1.0, rtol=0, atol=1e-9)


@pytest.mark.parametrize(
    ("table", "words"),
    [
        (CASCADE | {"inner": [2]}, r"controller\.inner"),
        (CASCADE | {"inner_low": 5.0}, r"controller\.inner_high"),
        (FLOW | {"inner": [1]}, "'inner'"),
        (OVERRIDE | {"anti_windup": "clamping"}, "clamping"),
        (OVERRIDE | {"limited": [1, 2]}, r"controller\.limited"),
        (GOVERNOR | {"limit": math.inf, "lowest": -math.inf}, "no tank has a limit"),
        (GOVERNOR | {"lowest": 2.5}, r"controller\.lowest"),
        (GOVERNOR | {"samples": 1}, "Ti.* = 40 s: must be at least 60 s, a predicted sample"),
        (GOVERNOR | {"feed_forward": True}, "feed_forward"),
        (RATIO | {"follow": [1]}, r"controller\.follow"),
        ({"kind": "p", "Kc": 1.0, "gap_gain": 0.5}, r"controller\.deadband"),
        ({"kind": "pid", "Kc": 1.0, "N": 5.0}, r"controller\.Td"),
        ({"kind": "p", "Kc": 1.0, "inflow_of": [1]}, r"controller\.inflow_gain"),
    ],
)
def test_what_does_not_go_together_is_refused(table, words):
    with pytest.raises(InputError, match=words):
        loads(**table)


@pytest.mark.parametrize(
    "changes",
    [
        {"inner_Kc": np.array([0.0, 1.0])},
        {"inner_low": np.array([1.0, 3.0]), "inner_high": np.array([2.0, 3.0])},
        {"feed_forward": True},
    ],
)
def test_what_a_cascade_cannot_be_is_refused(changes, monkeypatch):
    monkeypatch.setattr(PID, "check_gains", lambda self: None)
    values = {"inner_Kc": np.ones(2), "inner_low": np.zeros(2), "inner_high": np.ones(2)}
    values |= {"feed_forward": False, "_check_inner": lambda: None}
    Cascade.check_gains(types.SimpleNamespace(**values))
    with pytest.raises(InputError, match=next(reversed(changes))):
        Cascade.check_gains(types.SimpleNamespace(**values | changes))
