"""Gain schedules: the numbers they give, the run they leave alone, their derivatives, and what
cannot be scheduled.
"""

import dataclasses
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import assert_same_case as assert_same, command as say

import jaxtank
from jaxtank import presets, rig
from jaxtank.bounds import gain_ranges
from jaxtank.case import Free
from jaxtank.controllers import Backstepping, Controller, Scheduled
from jaxtank.controllers.gain_schedule import interpolate
from jaxtank.core.errors import InputError
from jaxtank.core.numerics import portion
from jaxtank.core.tree import component, describe, get_value, leaf, with_values
from jaxtank.loop.run import evaluate_and_flag, evaluate_compiled, evaluate_for_reverse
from jaxtank.rig.values import schedule
from jaxtank.xla.reachability import use_of

# 8 cm is a plateau of the reference: on a knot for minutes. The ramps have no sample within
# rounding of the others, where the slope would
# be that of one side and a difference that of both (at one sample of 24,001: 6e-4 of that slope).
KNOTS = (4.317, 8.0, 11.137, 15.071)
VALUES = np.array([[0.02, 0.05, 0.03, 0.08], [0.06, 0.12, 0.09, 0.05]])
MEASURES = ("rms_error_total", "max_level")


def on(case, gains, variable, knots=KNOTS, values=None):
    case = schedule(case, {f"controller.{g}": variable for g in gains}, knots)
    return (
        case
        if values is None
        else case.replace(loop=with_values(case.loop, {"controller.values": values}))
    )


# interpolation


def test_it_interpolates_as_numpy_does():
    rng = np.random.default_rng(1)
    knots, values = np.cumsum(rng.uniform(0.1, 5.0, 7)), rng.normal(size=(3, 7))
    at = np.concatenate([knots, rng.uniform(-3.0, knots[-1] + 3.0, 200)])
    found = jax.jit(jax.vmap(lambda s: jnp.stack(interpolate(s, knots, values))))
    got = np.asarray(found(at))
    np.testing.assert_allclose(
        got, np.stack([np.interp(at, knots, row) for row in values], axis=1), rtol=1e-13, atol=1e-13
    )


def test_equal_values_give_exactly_that_value():
    g = interpolate(7.3, np.array(KNOTS), np.full((1, 4), 0.1))[0]
    assert float(g) == 0.1


def test_slopes_are_central_differences_also_on_a_knot():
    f = jax.jit(lambda x: interpolate(x[0], x[1:5], x[5:].reshape(2, 4))[1])
    for at in (1.0, 4.9, 8.0, 9.7, 15.071, 20.0, 4.317):
        x, step = np.array([at, *KNOTS, *VALUES.ravel()]), 1e-6 * np.eye(13)
        differences = [(f(x + h) - f(x - h)) / 2e-6 for h in step]
        # on a knot: half the difference of the second derivatives of both sides (below 0.1) times
        # the step; elsewhere round-off, 1e-10
        np.testing.assert_allclose(
            jax.grad(f)(x), differences, rtol=0, atol=1e-7 if at in KNOTS else 1e-9
        )


def test_portion_has_half_slopes_at_its_ends():
    slopes = [jax.grad(portion, argnums=(0, 1, 2))(x, 1.0, 3.0) for x in (0.0, 1.0, 2.0, 3.0, 4.0)]
    np.testing.assert_array_equal(
        slopes, [(0, 0, 0), (0.5, -0.5, 0), (1, -1, 0), (0.5, -1, 0.5), (0, -1, 1)]
    )


# the run


@pytest.mark.slow_for(
    "gouta2015/backstepping-boxqp-gains1-h2-knots1",
    "gouta2015/backstepping-gains0-r1-knots0",
    "mirakhorli/smc-printed-gains2-h4-knots2",
)
@pytest.mark.parametrize(
    ("name", "gains", "variable", "knots"),
    [
        ("gouta2015/backstepping", ("k", "k1"), "r1", KNOTS),
        ("gouta2015/backstepping-boxqp", ("k", "k1"), "h2", KNOTS),
        ("mirakhorli/smc-printed", ("surface", "ks", "phi"), "h4", (1.0, 3.0)),
        pytest.param("gouta2015/ngpc", ("Tp",), "r2", KNOTS, marks=pytest.mark.slow),
        pytest.param("gouta2022/pid", ("Kc", "Ti", "Td"), "h1", (5.0, 9.0), marks=pytest.mark.slow),
        pytest.param("gouta2022/fopi", ("Kc[1]",), "r2", (5.0, 9.0), marks=pytest.mark.slow),
        pytest.param("mirakhorli/sfc", ("K",), "r1", (11.0, 13.0), marks=pytest.mark.slow),
        pytest.param(
            "mirakhorli/hybrid", ("K[0,1]", "b", "ks"), "h3", (1.0, 3.0), marks=pytest.mark.slow
        ),
        pytest.param(
            "calofir/backstepping", ("K_phi", "K_y"), "h2", (0.05, 0.1), marks=pytest.mark.slow
        ),
    ],
)
def test_with_equal_values_it_is_the_plain_controller(name, gains, variable, knots):
    """Knots within the range of the run. 1e-11: the laws amplify a last digit of a product that is
    formed in another order.
    """
    case = presets.find(name)
    case = case.replace(
        clock=dataclasses.replace(case.clock, duration=min(case.clock.duration, 150.0))
    )
    plain, other = (
        jaxtank.simulate(c.loop, c.clock, save_every=10)
        for c in (case, on(case, gains, variable, knots))
    )
    for field in ("x", "command", "u"):
        np.testing.assert_allclose(
            getattr(other, field), getattr(plain, field), rtol=1e-11, atol=1e-11
        )


@pytest.mark.extended
@pytest.mark.slow_for("h2")
@pytest.mark.parametrize("variable", ["r1", "h2"])
def test_at_every_sample_the_controller_has_the_gains_of_that_sample(gouta, variable):
    case = on(
        gouta("backstepping", {"clock.duration": 150.0}), ("k", "k1"), variable, values=VALUES
    )
    run = jaxtank.simulate(case.loop, case.clock, save_every=500)
    law, at = (
        gouta("backstepping").loop.controller,
        {"r1": np.asarray(run.r)[:, 0], "h2": np.asarray(run.x)[:, 1]}[variable],
    )
    assert at.min() < KNOTS[0] and at.max() > 7.0
    for row in range(len(run.t)):
        k, k1 = (np.interp(at[row], KNOTS, v) for v in VALUES)
        now = jaxtank.core.records.Tick(t=0.0, r=tuple(run.r[row]), dr=(0.0, 0.0), ddr=(0.0, 0.0))
        there = jaxtank.core.records.Estimate(x=tuple(run.x[row]))
        command, _ = dataclasses.replace(law, k=k, k1=k1).step((), now, there)
        np.testing.assert_allclose(run.command[row], command, rtol=1e-9, atol=1e-9)


@pytest.mark.extended
def test_the_anti_windup_has_them_too():
    """PI in NumPy: the integral grows with the gain of the level at that sample."""
    case = rig.set_values(presets.find("gouta2022/pi"), {"clock.duration": 60.0})
    knots, gains = np.array([2.0, 5.0, 9.0]), np.array([[2.0, 1.0, 4.0], [1.0, 3.0, 2.0]])
    law = case.loop.controller
    run = jaxtank.simulate((case := on(case, ("Kc",), "h1", knots, gains)).loop, case.clock)
    x, r, applied = np.asarray(run.x_hat), np.asarray(run.r), np.asarray(run.applied)
    integral, commands = np.zeros(2), []
    for k in range(len(x)):
        Kc = np.array([np.interp(x[k, 0], knots, row) for row in gains])
        e = r[k] - x[k]
        commands.append(law.bias + Kc * e + integral)
        integral = integral + case.clock.dt * Kc / law.Ti * (
            e + law.Ti / (law.Tt * Kc) * (applied[k] - commands[-1])
        )
    assert x[:, 0].min() < 3.0 and x[:, 0].max() > 6.0 and np.ptp(commands) > 1.0
    np.testing.assert_allclose(run.command, commands, rtol=1e-9, atol=1e-9)


@pytest.mark.extended
@pytest.mark.parametrize(
    ("name", "gains", "variable"),
    [
        ("gouta2015/backstepping", ("k", "k1"), "h3"),
        pytest.param("gouta2022/pi", ("Kc", "Ti"), "h1", marks=pytest.mark.slow),
        pytest.param("mirakhorli/sfc", ("K",), "r2", marks=pytest.mark.slow),
    ],
)
def test_the_loop_is_still_one_function(name, gains, variable):
    case = on(presets.find(name), gains, variable)
    text = evaluate_compiled.lower(case.loop, case.clock, MEASURES, None, False).compile().as_text()
    assert 'xla_cpu_small_call="true"' in text


def test_other_values_and_knots_do_not_recompile(gouta):
    case = on(gouta("backstepping", {"clock.duration": 20.0}), ("k",), "r1")
    jaxtank.evaluate(case.loop, case.clock, MEASURES)
    before = evaluate_compiled._cache_size()
    for values in ({"controller.values[0,1]": 0.5}, {"controller.knots": [1.0, 2.0, 3.0, 4.0]}):
        jaxtank.evaluate(with_values(case.loop, values), case.clock, MEASURES)
    assert evaluate_compiled._cache_size() == before


# derivatives of a closed loop


@pytest.mark.slow_for("h1-8.353", "r1-8.0")
@pytest.mark.parametrize(("variable", "plateau"), [("r1", 8.0), ("h1", 8.353)])
def test_slopes_of_a_run_for_every_knot(gouta, variable, plateau):
    """Values and positions of the knots. The steps are relative and the best of three counts: on a
    knot a central difference is of first order, and elsewhere every sample whose level passes the
    knot within the step bends the cost a little. A level, unlike a setpoint, comes to rest beside 8
    cm by less than any step, so that no difference tells the slope of its side: there the knot is
    elsewhere.
    """
    case = on(
        gouta("backstepping", {"clock.dt": 0.1, "clock.duration": 560.0}),
        ("k", "k1"),
        variable,
        values=VALUES,
    )
    point = jnp.concatenate([VALUES.ravel(), jnp.array([KNOTS[0], plateau, *KNOTS[2:]])])

    def cost(v, run=jaxtank.evaluate):
        loop = with_values(
            case.loop, {"controller.values": v[:8].reshape(2, 4), "controller.knots": v[8:]}
        )
        return run(loop, case.clock, MEASURES[:1])[MEASURES[0]]

    slopes = np.asarray(jax.jit(jax.jacfwd(cost))(point))
    batch = jax.jit(jax.vmap(cost))
    found = []
    for h in (1e-5, 1e-6, 1e-7):
        steps = h * np.diag(point)
        found.append(np.asarray(batch(point + steps) - batch(point - steps)) / (2 * h * point))
    error = np.abs(np.array(found) - slopes).min(axis=0) / np.abs(slopes)
    assert np.all(np.abs(slopes) > 1e-5)
    assert error.max() < 1e-5
    if variable == "h1":  # the one that goes through the state
        reverse = jax.jit(jax.grad(lambda v: cost(v, evaluate_for_reverse)))(point)
        np.testing.assert_allclose(reverse, slopes, rtol=1e-8)


# names, units, ranges


def test_names_units_and_ranges_are_those_of_the_gains():
    case = on(presets.find("gouta2022/pi"), ("Kc[0]", "Ti"), "h1", (5.0, 9.0))
    loop = case.loop
    assert loop.controller.gains == ("Kc[0]", "Ti[0]", "Ti[1]")
    assert [describe(loop, f"controller.values[{i},1]")["unit"] for i in range(3)] == [
        "V/cm",
        "s",
        "s",
    ]
    assert describe(loop, "controller.values")["unit"] == "V/cm, s"
    assert "Kc[0]" in describe(loop, "controller.values[0,0]")["doc"]
    assert describe(loop, "controller.knots")["unit"] == "cm"
    assert describe(loop, "controller.law.Tt")["unit"] == "s"
    with pytest.raises(InputError, match=r"free controller.values\[2,0\] = 0 s: must be above 0 s"):
        rig.check_free(loop, "controller.values[2,0]", 0.0, 3.0)
    # a gain Kc may be negative, a time may not
    rig.check_free(loop, "controller.values[0,0]", -1.0, 3.0)
    with pytest.raises(InputError, match=r"free controller.values = -1 s: must be above 0 s"):
        rig.check_free(loop, "controller.values", -1.0, 3.0)
    in_metres = on(presets.find("calofir/backstepping"), ("K_phi",), "r1", (0.1, 0.2)).loop
    assert describe(in_metres, "controller.knots")["unit"] == "m"
    assert describe(in_metres, "controller.values[0,0]")["unit"] == "1/s"


def test_what_is_free_follows(gouta):
    case = gouta("backstepping").replace(
        free={
            "plant.area": Free(10.0, 30.0),
            "controller.k": Free(0.1, 2.0),
            "controller.k1": (1, 3),
        }
    )
    found = schedule(case, {"controller.k1": "r1"}, (5.0, 10.0)).free
    assert found == {
        "plant.area": Free(10.0, 30.0),
        "controller.law.k": Free(0.1, 2.0),
        "controller.values[0,0]": Free(1, 3),
        "controller.values[0,1]": Free(1, 3),
    }
    pi = presets.find("gouta2022/pi")
    found = on(
        pi.replace(free={"controller.Kc": Free(0.1, 9.0)}), ("Kc[1]",), "h1", (5.0, 9.0)
    ).free
    assert set(found) == {
        "controller.law.Kc[0]",
        "controller.values[0,0]",
        "controller.values[0,1]",
    }


# errors at the door


@pytest.mark.parametrize(
    ("gains", "knots", "words"),
    [
        ({"controller.kk": "r1"}, KNOTS, ["unknown gain 'controller.kk'", "nearest: controller.k"]),
        ({"plant.area[0]": "r1"}, KNOTS, ["unknown gain 'plant.area[0]'", "controller.model.area"]),
        (
            {"controller.reference_rates": "r1"},
            KNOTS,
            ["controller.reference_rates", "compiled program"],
        ),
        ({"controller.k": "r3"}, KNOTS, ["'r3'", "r1 to r2", "h1 to h4"]),
        ({"controller.k": "r1", "controller.k1": "r2"}, KNOTS, ["r1, r2", "one for all"]),
        ({"controller.k": "r1"}, (5.0, 5.0), ["knots [5.0, 5.0]", "above the one before"]),
        ({"controller.k": "r1"}, (5.0,), ["at least two"]),
        ({"controller.k[0]": "r1"}, KNOTS, ["k[0]", "shape ()"]),
        ({}, KNOTS, ["at least one gain"]),
        (
            {"controller.model.area": "r1", "controller.model.area[2]": "r1"},
            KNOTS,
            ["model.area[2] is scheduled twice"],
        ),
    ],
)
def test_a_bad_schedule_is_reported(gouta, gains, knots, words):
    with pytest.raises(InputError) as caught:
        schedule(gouta("backstepping"), gains, knots)
    assert all(word in str(caught.value) for word in words), str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("name", "gain", "words"),
    [
        ("cascaded/open-loop", "signal.initial", "before the loop starts (in its inputs)"),
        ("gouta2015/backstepping", "level_floor", "input_metric"),
        ("khalid/gpc", "r_w", "repeated at every sample"),
        ("gouta2022/pi-ff", "bias", "does not use it"),
    ],
)
def test_a_gain_that_acts_outside_the_step_is_refused(name, gain, words):
    with pytest.raises(InputError, match="cannot be scheduled") as caught:
        on(presets.find(name), (gain,), "r1", (5.0, 9.0))
    assert words in str(caught.value)


@component
class Odd(Controller):
    """A law that uses `start` for its state, and `branch` with Python's if."""

    start: float = leaf("V", "voltage at first")
    branch: float = leaf("-", "which way")

    def init(self, x0, u0):
        return tuple(u + self.start for u in u0)

    def step(self, state, tick, estimate):
        return tuple(u if self.branch > 0 else -u for u in state), state


@pytest.mark.parametrize(("gain", "words"), [("start", "in its init"), ("branch", "Python's if")])
def test_a_controller_of_ones_own_is_looked_at_too(gouta, gain, words):
    case = gouta("backstepping")
    loop = dataclasses.replace(case.loop, controller=Odd(start=1.0, branch=1.0))
    case = case.replace(loop=loop, free={})
    with pytest.raises(InputError, match=words):
        on(case, (gain,), "r1")


@pytest.mark.extended
def test_where_nothing_is_checked_a_gain_used_before_the_loop_gives_nan():
    case = presets.find("mirakhorli/smc")
    table = dict(knots=[1.0, 2.0], values=[[3.0, 3.0]], gains=("model.drain[0]",), variable="r1")
    law = Scheduled(law=case.loop.controller, **table)
    loop = dataclasses.replace(case.loop, controller=law)
    with pytest.raises(InputError, match="in its prepare"):
        jaxtank.evaluate(loop, case.clock, MEASURES)
    assert evaluate_and_flag(loop, case.clock, MEASURES)[1]  # not finite


def test_a_scheduled_loop_is_checked_before_it_runs(gouta):
    case = on(gouta("backstepping"), ("k", "k1"), "r1")
    bad = {
        "controller.values[1,2]": (-1.0, r"controller.values\[1,2\] = -1 1/s: must be above 0 1/s"),
        "controller.knots[2]": (3.0, "knots"),
        "controller.law.k": (0.1, r"controller.law.k is scheduled: set controller.values\[0,0\]"),
    }
    for name, (value, words) in bad.items():
        with pytest.raises(InputError, match=words):
            jaxtank.evaluate(with_values(case.loop, {name: value}), case.clock, MEASURES)
    with pytest.raises(InputError, match="not in use"):
        get_value(case.loop, "controller.law.k")
    with pytest.raises(InputError, match="has a schedule already"):
        schedule(case, {"controller.law.level_floor": "h1"}, KNOTS)
    entry = on(presets.find("gouta2022/pi"), ("Kc[0]",), "h1").loop
    with pytest.raises(InputError, match=r"controller.law.Kc\[0\] is scheduled"):
        rig.check_free(entry, "controller.law.Kc[0]", 1.0, 2.0)
    with pytest.raises(InputError, match="input_metric"):
        case = on(presets.find("gouta2022/pi"), ("Kc",), "h1")
        rig.check(rig.set_values(case, {"actuator.saturation": "boxqp"}))


def test_dependence_is_followed_into_calls_and_loops():
    def f(a, b):
        inner = jax.jit(lambda p, q: (p * 2.0, q * 3.0))(a, b)
        return inner[1], jax.lax.fori_loop(0, 3, lambda i, c: c + 1.0, b)

    assert not use_of(f, 1.0, 2.0).reached
    assert use_of(lambda a, b: f(b, a), 1.0, 2.0) == (True, 0, True)
    assert use_of(lambda a: jnp.sum(a * jnp.ones((3, 4))), 1.0) == (True, 12, False)


# rig files and the command


@pytest.mark.slow_for("mirakhorli/sfc-gains1-h4")
@pytest.mark.parametrize(
    ("name", "gains", "variable"),
    [("gouta2022/pid", ("Kc[1]", "Ti"), "h1"), ("mirakhorli/sfc", ("K",), "h4")],
)
def test_a_rig_file_keeps_the_schedule(name, gains, variable, tmp_path):
    case = on(presets.find(name), gains, variable, (0.1, 0.25, 1 / 3))
    case = case.replace(name="mine", loop=with_values(case.loop, {"controller.values[0,2]": 0.7}))
    rig.save(case, tmp_path / "rig.toml")
    again = rig.load(tmp_path / "rig.toml")
    assert_same(again, case)
    assert isinstance(again.loop.controller, Scheduled)


HEAD = 'case = "gouta2015/backstepping"\n'
TABLE = '[schedule]\ngains = ["controller.k1"]\nvariable = "r1"\nknots = [5.0, 10.0]\n'


def test_a_rig_file_may_set_gains_before_and_values_after(tmp_path):
    path = tmp_path / "rig.toml"
    path.write_text(
        HEAD
        + TABLE
        + '[values]\n"controller.k1" = 0.05\n"controller.values[0,1]" = 0.2\n"controller.law.k" ='
        " 0.04\n"
    )
    law = rig.load(path).loop.controller
    assert isinstance(law.law, Backstepping) and law.law.k1 is None
    np.testing.assert_array_equal(law.values, [[0.05, 0.2]])
    assert law.law.k == 0.04


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (TABLE.replace("knots", "knot"), ["knot", "nearest: knots"]),
        (TABLE.replace('variable = "r1"\n', ""), ["needs variable"]),
        (TABLE.replace("[5.0, 10.0]", '"5"'), ["knots = '5'"]),
        (TABLE.replace('"r1"', "1"), ["schedule.variable = 1", "text"]),
        (TABLE.replace('["controller.k1"]', '"controller.k1"'), ["schedule.gains", "list"]),
        ("schedule = 3\n", ["schedule = 3", "table"]),
        (TABLE + '[values]\n"controller.law.k1" = 1.0\n', ["controller.law.k1 is scheduled"]),
        (TABLE + '[values]\n"controller.variable" = 3\n', ["controller.variable = 3", "text"]),
        (
            TABLE + '[free]\n"controller.values[0,1]" = [0.0, 1.0]\n',
            ["controller.values[0,1]", "above 0"],
        ),
    ],
)
def test_a_bad_schedule_in_a_file_is_reported_in_one_line(text, words, tmp_path):
    path = tmp_path / "rig.toml"
    path.write_text(HEAD + text)
    with pytest.raises(InputError) as caught:
        rig.load(path)
    message = str(caught.value)
    assert all(word in message for word in [*words, repr(str(path))]) and "\n" not in message, (
        message
    )


@pytest.mark.slow
def test_the_command_schedules():
    case = ("gouta2015/backstepping", "--set", "clock.duration=60", "--dt", "0.1")
    gains = ("--schedule", "controller.k=r1:4,8", "--schedule", "controller.k1=r1:4,8")
    plain = rig.set_values(presets.find(case[0]), {"clock.duration": 60, "clock.dt": 0.1})
    total = jaxtank.evaluate(plain.loop, plain.clock, MEASURES)["rms_error_total"]
    search = ("--limit", "none", "--starts", "1", "--screening", "4", "--iterations", "6")
    code, out, _ = say(
        "tune", *case, *gains, "--set", "controller.values[1,0]=0.088", "--json", "--quiet", *search
    )
    found = json.loads(out)
    assert code in (0, 3)
    assert set(found["parameters"]) == {
        f"controller.values[{i},{j}]" for i in (0, 1) for j in (0, 1)
    }
    assert found["measures"]["before"]["rms_error_total"] == pytest.approx(float(total), rel=1e-12)
    assert found["objective"]["after"] < 0.5 * found["objective"]["before"]
    assert "Scheduled(Backstepping)" in say("show", *case, *gains)[1]
    assert "[schedule]" in say("init", *case, *gains)[1]
    for wrong, words in {
        "controller.k=r1": "NAME=VARIABLE:K1",
        "controller.kk=r1:4,8": "nearest: controller.k",
        "controller.k=r1:8,4": "knots [8.0, 4.0]",
        "controller.k=r1:4,x": "schedule.knots",
    }.items():
        code, out, err = say("simulate", *case, "--schedule", wrong)
        assert code == 2 and not out and words in err and err.count("\n") == 1
    assert (
        "the same for all"
        in say("show", *case, *gains[:2], "--schedule", "controller.k1=r2:4,8")[2]
    )


def test_scheduled_gains_are_tuned_where_nothing_is_named():
    """A factor of 30 either way from their values at each knot."""
    loop = on(presets.find("cascaded/pi"), ["Kc"], "r1", (2.0, 8.0)).loop
    ranges = gain_ranges(loop)
    values = np.asarray(loop.controller.values)
    assert list(ranges) == ["controller.values[0,0]", "controller.values[0,1]"]
    for free, value in zip(ranges.values(), values[0]):
        np.testing.assert_allclose([free.low, free.high], [value / 30, value * 30], rtol=5e-3)
