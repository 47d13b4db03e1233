"""Tuning rules against closed forms: integrator with dead time, tanks in series, relay cycle."""

import json
import math
import re
import types

import numpy as np
import pytest
from helpers import INTEGRATOR, command
from tanks_in_a_row import rig_text

import jaxtank
from jaxtank import rig
from jaxtank.bounds import gain_ranges
from jaxtank.core.errors import InputError
from jaxtank.loop.saved_rows import simulate_compiled
from tuning.problem import rules
from tuning.problem.controllers import operating_point
from tuning.search.options import Options
from tuning.search.setting import setting_of
from tuning.search.tuner import rule_rows, tune

# Skogestad (2003): integrating process, k' = 0.01 1/s, dead time 60 s
SIMC = """
units = ["m", "%"]
reachable = false
tank = [{ area = 10.0, rim = 100.0, level = 10.0 }]
pump = [{ gain = 0.1, to = 1, low = -100.0, high = 100.0 }]
plant = { gravity = 9.81 }
controller = { kind = "pi", Kc = 0.5, Ti = 600.0 }
reference = { initial = [10.0], changes = [[100.0, 1, 12.0]], ramp = 0.0 }
values = { "clock.dt" = 0.1, "clock.duration" = 4000.0, "actuator.delay" = 60.0 }
"""

# A relay makes a cycle of amplitude 0.01 m/s 5 s for a full swing of 0.5, and period 4 * 5 s
RELAY = INTEGRATOR.replace("300.0", "50.0") + 'controller = { kind = "p", Kc = 1.0 }\n'

# two tanks in series, each of time constant 2 A h/q at level h with flow q
SERIES = """
units = ["m", "-"]
tank = [
    { area = 1.0, rim = 3.0, level = 1.0 },
    { area = 0.5, rim = 3.0, level = 1.0, drain = 0.01 },
]
orifice = [{ from = 1, to = 2, area = 0.01 }]
pump = [{ gain = 0.1, to = 1, high = 1.0, initial = 0.4 }]
plant = { gravity = 9.81, outputs = [2] }
controller = { kind = "pi", Kc = 1.0, Ti = 50.0 }
reference = { initial = [1.0], changes = [[20.0, 1, 1.2]] }
values = { "clock.dt" = 0.5, "clock.duration" = 100.0 }
"""


def test_simc_of_an_integrator_has_the_published_gains():
    gains = rules.rule_gains(rig.loads(SIMC), "simc")
    np.testing.assert_allclose(gains["controller.Kc[0]"], 0.83333, rtol=2e-3)
    np.testing.assert_allclose(gains["controller.Ti[0]"], 480.0, rtol=2e-3)


@pytest.mark.slow
def test_the_ultimate_cycle_of_an_integrator_is_that_of_its_dead_time():
    ultimate = rules.ultimate_of(rules.loop_of(rig.loads(SIMC), 0))
    theta = 60.0 + 0.05  # half a sample more
    np.testing.assert_allclose(ultimate, (math.pi / (2 * 0.01 * theta), 4 * theta), rtol=1e-3)


@pytest.mark.extended
def test_a_relay_experiment_has_the_cycle_of_its_describing_function():
    gain, period = rules.relay_experiment(rig.loads(RELAY), 0)
    np.testing.assert_allclose(gain, 4 * 0.5 / (math.pi * 0.05), rtol=0.01)
    np.testing.assert_allclose(period, 20.0, atol=0.15)


def test_a_relay_experiment_is_not_disturbed_by_the_inflows_of_the_case():
    pulse = "inflow = [{ time = 20.0, duration = 5.0, tank = 1, volume = 0.1 }]\n"
    still, disturbed = (
        rules.relay_experiment(rig.loads(text), 0) for text in (RELAY, pulse + RELAY)
    )
    assert disturbed == still


@pytest.mark.parametrize("rule", ["simc", "ziegler-nichols", "relay"])
def test_gains_of_a_rule_are_those_of_the_reading(rule):
    """Of a sensor that reads twice the level half the gain, and the same times."""
    case = rig.loads(SIMC.replace("60.0 }", "6.0 }").replace("4000.0", "400.0"))
    twice = rig.set_values(case, {"sensor.scale": [2.0], "reference.initial": [20.0]})
    twice = rig.set_values(twice, {"reference.targets": [24.0], "x0": [10.0]})
    gains, expected = rules.rule_gains(twice, rule), rules.rule_gains(case, rule)
    np.testing.assert_allclose(gains["controller.Kc[0]"], 0.5 * expected["controller.Kc[0]"], 5e-3)
    np.testing.assert_allclose(gains["controller.Ti[0]"], expected["controller.Ti[0]"], 5e-3)


@pytest.mark.extended
def test_relay_experiments_of_all_outputs_share_a_program():
    case = rig.loads(rig_text(3))
    runs = len(simulate_compiled.programs), simulate_compiled.compiled._cache_size()
    gains = rules.rule_gains(case, "relay")
    more = len(simulate_compiled.programs), simulate_compiled.compiled._cache_size()
    assert sum(name.startswith("controller.Kc") for name in gains) == 3
    assert sum(more) - sum(runs) <= 1


def test_the_half_rule_shares_the_second_lag():
    case = rig.loads(SERIES)
    flow = 0.01 * math.sqrt(2 * 9.81 * 1.2)
    slow, fast = 2 * 1.0 * 1.2 / flow, 2 * 0.5 * 1.2 / flow
    first = rules.process_of(rules.loop_of(case, 0), 1)
    np.testing.assert_allclose(first.lag, slow + fast / 2, rtol=1e-6)
    np.testing.assert_allclose(first.delay, fast / 2 + 0.25, rtol=1e-6)
    steady = 2 * 1.2 / flow * 0.1  # of the level for a unit of the input
    np.testing.assert_allclose(first.gain * first.lag, steady, rtol=1e-6)
    gains, theta = rules.rule_gains(case, "simc"), fast / 2 + 0.25  # of a PI, by one time constant
    Kc, Ti = (slow + fast / 2) / (2 * theta * steady), min(slow + fast / 2, 8 * theta)
    np.testing.assert_allclose(list(gains.values()), [Kc, Ti], rtol=1e-6)
    second = rules.process_of(rules.loop_of(case, 0), 2)
    np.testing.assert_allclose(second[1:], (slow, fast, 0.25), rtol=1e-6)
    np.testing.assert_allclose(second.gain * second.lag, steady, rtol=1e-6)


FILTERED = """
units = ["m", "%"]
tank = [{area = 0.5, rim = 2.0, drain = 4e-4, level = 0.4}]
sensor = [{tank = 1, filter = 12.0}]
pump = [{to = 1, gain = 3e-5, high = 100.0, initial = 37.0}]
controller = {kind = "pi", Kc = 100.0, Ti = 100.0}
reference = {initial = [0.4], changes = [[20.0, 1, 0.5]]}
values = {"clock.dt" = 2.0, "clock.duration" = 400.0}
"""


def test_a_filter_of_the_reading_is_a_lag_of_its_loop():
    """In series with the process it is what a lag of the pump is."""
    lagged = rig.loads(SERIES.replace("initial = 0.4", "initial = 0.4, lag = 8.0"))
    filtered = rig.loads(
        SERIES.replace("orifice =", "sensor = [{tank = 2, filter = 8.0}]\norifice =")
    )
    for rule in ("simc", "amigo"):
        gains = [rules.rule_gains(case, rule) for case in (rig.loads(SERIES), lagged, filtered)]
        assert gains[2] == pytest.approx(gains[1], rel=1e-9)
        assert gains[1]["controller.Kc[0]"] < 0.9 * gains[0]["controller.Kc[0]"]
    ultimate = rules.ultimate_of(rules.loop_of(filtered, 0))
    half = {"controller.Kc": [0.5 * ultimate.gain], "controller.Ti": [1e9]}
    half = rig.set_values(filtered, half)
    (margins,) = {p.margins.gain_margin[0] for p in jaxtank.stability_margins(half)[-1:]}
    assert margins == pytest.approx(2.0, rel=1e-6)
    cycle = rules.relay_experiment(filtered, 0)
    assert cycle.gain == pytest.approx(ultimate.gain, rel=0.15)
    assert cycle.period == pytest.approx(ultimate.period, rel=0.1)
    # the filter reads the sample of now, and makes up for the half sample of the pump
    alone = rig.loads(FILTERED)
    for rule in ("relay", "ziegler-nichols"):
        with pytest.raises(InputError, match="no ultimate gain below half the sampling frequency"):
            rules.rule_gains(alone, rule)


@pytest.mark.extended_for("lambda", "ziegler-nichols")
@pytest.mark.slow_for("simc")
@pytest.mark.parametrize("rule", rules.RULES)
def test_every_rule_stabilises_an_integrator_with_dead_time(rule):
    case = rig.loads(SIMC)
    loop = jaxtank.with_values(case.loop, rules.rule_gains(case, rule))
    assert all(plateau.stable for plateau in jaxtank.stability_margins(loop, case.clock))


def test_an_input_that_lowers_its_level_has_negative_gains():
    loop = rules.loop_of(rig.loads(SIMC), 0)
    turned = loop._replace(b=-loop.b)
    assert rules.process_of(turned, 1).gain == -rules.process_of(loop, 1).gain
    assert rules.ultimate_of(turned).gain < 0.0


def test_gains_without_ranges_are_free_within_a_factor_of_thirty():
    ranges = gain_ranges(rig.loads(SIMC).loop)
    assert {n: tuple(f) for n, f in ranges.items()} == {
        "controller.Kc[0]": (0.0167, 15.0, "log"),
        "controller.Ti[0]": (20.0, 18000.0, "log"),
    }


CONE = """
units = ["m", "%"]
tank = [{ shape = "cone", diameter = 2.0, height = 2.5, level = 0.8, inflow = "3 L/s" }]
valve = [{ from = 1, area = "20 cm^2", initial = 40.0 }]
plant = { gravity = 9.81 }
controller = { kind = "pi", action = "direct", Kc = 80.0, Ti = 300.0 }
reference = { initial = [0.8], changes = [[60.0, 1, 0.9]] }
values = { "clock.dt" = 2.0, "clock.duration" = 2400.0 }
"""


@pytest.mark.extended
def test_the_lag_of_a_cone_counts_its_inflow():
    """h' = (q - a u sqrt(2 g h))/A(h): at rest the slope is that of the outflow, -q/(2 h A(h))."""
    case = rig.loads(CONE)
    area = math.pi / 4.0 * (2.0 * 0.9 / 2.5) ** 2
    expected = 0.003 / (2.0 * 0.9 * area)
    assert rules.loop_of(case, 0).A[0, 0] == pytest.approx(-expected, rel=1e-6)
    assert rules.process_of(rules.loop_of(case, 0), 1).lag == pytest.approx(1.0 / expected)


@pytest.mark.parametrize("rule", ["ziegler-nichols", "relay"])
def test_an_ultimate_cycle_longer_than_the_run_gives_no_gains(rule):
    words = f"rule {rule}, output 1: .*period of 240.[0-9] s is longer than the run of 200 s.*simc"
    with pytest.raises(InputError, match=words):
        rules.rule_gains(rig.loads(SIMC.replace("4000.0", "200.0")), rule)


@pytest.mark.extended
def test_rules_are_judged_on_the_plants_of_an_answer():
    case = rig.loads(SERIES)
    rows = rule_rows(setting_of(case), 8, 0)
    assert [row["rule"] for row in rows] == list(rules.RULES)
    assert all(row["error"] > 0.0 and row["holds"] is not None for row in rows)


@pytest.mark.extended
def test_a_rule_on_the_command_line_reports_its_gains(tmp_path):
    path = tmp_path / "rig.toml"
    path.write_text(SERIES)
    output = command("tune", str(path), "--rule", "simc", "--validation", "8", "--json")
    assert output.code == 0, output.err
    values = json.loads(output.out)["parameters"]
    expected = rules.rule_gains(rig.load(path), "simc")
    assert {n: v["after"] for n, v in values.items()} == pytest.approx(expected)
    refused = command("tune", str(path), "--rule", "simc", "--nominal")
    assert refused.code == 2 and "--nominal" in refused.err


def test_a_rule_is_refused_for_another_controller():
    case = jaxtank.presets.find("gouta2015/backstepping")
    with pytest.raises(InputError, match="Backstepping"):
        rules.rule_gains(case, "simc")


CASCADE = {"kind": "cascade", "Kc": 2.0, "Ti": 80.0, "inner": [1], "inner_Kc": 2.0}


def series(**table):
    return rig.loads(re.sub("controller = .*", f"controller = {rig.toml(table)}", SERIES))


def test_a_filter_of_the_inner_reading_is_a_lag_of_both_loops():
    control = f"controller = {rig.toml({**CASCADE, 'inner_Ti': 30.0})}"
    text = re.sub("controller = .*", control, SERIES)
    sensor = "sensor = [{tank = 1, filter = 8.0}]\norifice ="
    lagged = rig.loads(text.replace("initial = 0.4", "initial = 0.4, lag = 8.0"))
    filtered = rig.loads(text.replace("orifice =", sensor))
    gains, expected = (rules.rule_gains(case, "simc") for case in (filtered, lagged))
    assert gains == pytest.approx(expected, rel=1e-9)
    assert expected != pytest.approx(rules.rule_gains(rig.loads(text), "simc"), rel=0.1)


def test_the_inner_loop_of_a_cascade_has_the_gains_of_its_own_tank():
    gains = rules.rule_gains(series(**CASCADE, inner_Ti=30.0), "simc")
    flow, theta = 0.01 * math.sqrt(2 * 9.81 * 1.2), 0.25  # half a sample
    lag = 2 * 1.0 * 1.2 / flow
    np.testing.assert_allclose(gains["controller.inner_Kc[0]"], 1.0 / (0.1 * 2 * theta), rtol=1e-6)
    np.testing.assert_allclose(gains["controller.inner_Ti[0]"], min(lag, 8 * theta), rtol=1e-6)


def test_the_outer_loop_of_a_cascade_is_that_of_the_closed_inner_one():
    case = series(**CASCADE)  # P inside: x1' = -x1/lag + 0.1 K (s - x1)
    inner = rules.Gains(Kc=2.0)
    closed = rules.closed_around(rules.loop_of(case, 0), np.eye(2)[0], inner)
    flow = 0.01 * math.sqrt(2 * 9.81 * 1.2)
    first, second = 2 * 1.0 * 1.2 / flow, 2 * 0.5 * 1.2 / flow
    process = rules.process_of(closed, 2)
    times = sorted((second, 1.0 / (1.0 / first + 0.2)), reverse=True)
    np.testing.assert_allclose((process.lag, process.second), times, rtol=1e-6)
    steady = 0.2 * times[1]  # of the lower level, which is that of the upper one
    np.testing.assert_allclose(process.gain * process.lag, steady, rtol=1e-6)


SECOND = {
    "cascade": CASCADE | {"inner_Ti": 30.0},
    "flow-cascade": {"kind": "flow-cascade", "Kc": 0.05, "Ti": 80.0, "inner_Kc": 4.0}
    | {"inner_Ti": 1.0},
    "override": {"kind": "override", "Kc": 1.0, "Ti": 80.0, "limited": [1], "limit": 2.5}
    | {"limit_Kc": 3.0, "limit_Ti": 20.0},
}


@pytest.mark.slow_for("flow-cascade", "cascade")
@pytest.mark.parametrize("kind", SECOND)
def test_simc_stabilises_both_loops_of_a_kind(kind):
    case = series(**SECOND[kind])
    gains = rules.rule_gains(case, "simc")
    assert len(gains) == 4 + ("Tt" in SECOND[kind]) and all(v > 0.0 for v in gains.values())
    if kind != "override":  # whose margins are of a switch
        loop = jaxtank.with_values(case.loop, gains)
        assert all(plateau.stable for plateau in jaxtank.stability_margins(loop, case.clock))


@pytest.mark.slow
def test_a_relay_has_no_gains_for_a_setpoint_and_says_so():
    rows = rule_rows(setting_of(series(**SECOND["cascade"])), 8, 0)
    assert [row["rule"] for row in rows if row["why"]] == ["relay"]
    assert "cascade" in rows[-1]["why"]


@pytest.mark.slow
def test_a_direct_action_turns_the_sign_of_a_rule():
    valve = SERIES.replace("drain = 0.01 }", "inflow = 0.0 }").replace(
        "pump = [", "valve = [{ from = 2, area = 0.02, initial = 0.5 }]\npump = ["
    )
    table = {"kind": "split-range", "Kc": 1.0, "Ti": 50.0, "sequence": [1, 2], "reverse": [2]}
    table |= {"bias": 0.4}
    reverse = rig.loads(re.sub("controller = .*", f"controller = {rig.toml(table)}", valve))
    direct = rig.loads(
        re.sub("controller = .*", f"controller = {rig.toml(table | {'action': 'direct'})}", valve)
    )
    one, other = (rules.rule_gains(case, "simc") for case in (reverse, direct))
    assert one["controller.Kc[0]"] == -other["controller.Kc[0]"]
    assert one["controller.Ti[0]"] == other["controller.Ti[0]"]


CIRCUIT = """
units = ["m", "m^3/s"]
reachable = false
tank = [{ area = 1.0, rim = 5.0, level = 1.0 }, { area = 2.0, rim = 5.0, level = 1.0 }]
orifice = [{ from = 1, to = 2, area = 0.01 }]
pump = [{ gain = 1.0, from = 2, to = 1, high = 0.1, initial = 0.02 }]
plant = { outputs = [1], gravity = 9.81 }
controller = { kind = "pi", Kc = 0.05, Ti = 60.0 }
reference = { initial = [1.0], changes = [[100.0, 1, 1.3]], ramp = 0.0 }
values = { "clock.dt" = 1.0, "clock.duration" = 1000.0 }
"""


def test_a_circuit_rests_with_the_volume_that_it_holds_at_the_start():
    case = rig.loads(CIRCUIT)
    _, levels, inputs = operating_point(case, case.loop.plant)
    np.testing.assert_allclose(levels, (1.3, (3.0 - 1.3) / 2.0), rtol=1e-9)
    np.testing.assert_allclose(inputs, [0.01 * math.sqrt(2 * 9.81 * 1.3)], rtol=1e-9)
    gains = rules.rule_gains(case, "simc")  # slope 1/1 m^2, half a sample of dead time
    np.testing.assert_allclose(gains["controller.Kc[0]"], 1.0, rtol=1e-6)


def test_a_bias_that_a_circuit_leaves_out_is_its_input_at_rest():
    curve = "curve_head = [[-4.0, 1.5], [0.0, 0.5], [4.0, 0.0]]"  # both levels are 1 m
    case = rig.loads(CIRCUIT.replace("initial = 0.02", curve))
    flow = 0.01 * math.sqrt(2 * 9.81 * 1.0)  # at the levels of the start
    np.testing.assert_allclose(case.loop.controller.bias, [flow / 0.5], rtol=1e-6)


@pytest.mark.slow
def test_an_answer_costs_no_more_than_any_rule_from_gains_far_off():
    case = rig.loads(SERIES.replace("Kc = 1.0", "Kc = 0.004").replace("Ti = 50.0", "Ti = 2000.0"))
    result = tune(case, Options(validation=32))
    costs = {row["rule"]: row["objective"] for row in result.rules if row["holds"]}
    assert costs and result.objective["after"] < 1.01 * min(costs.values())
    assert result["controller.Kc[0]"].after > 30.0 * 0.004


def test_the_gains_of_amigo_are_those_of_its_table(monkeypatch):
    """Astrom and Haegglund 2004: K = 2, T = 3 s, L = 1.5 s."""
    process = rules.Process(gain=2.0 / 3.0, lag=3.0, second=0.0, delay=1.5)
    monkeypatch.setattr(rules, "process_of", lambda loop, order: process)
    gains = rules.amigo(None, 0, "pi", None)
    # 0.15/2 + (0.35 - 4.5/20.25) 3/3 and 0.525 + 13 x 13.5/(9 + 54 + 15.75)
    assert gains.Kc == pytest.approx(0.075 + 0.35 - 2.0 / 9.0, rel=1e-12)
    assert gains.Ti == pytest.approx(0.525 + 175.5 / 78.75, rel=1e-12)


def test_a_relay_moves_no_setpoint():
    nested = types.SimpleNamespace(nested=True)
    case = types.SimpleNamespace(loop=types.SimpleNamespace(plant=None))
    with pytest.raises(InputError):
        rules.relay_experiment(case, 0, nested)


def test_a_zero_that_cancels_a_pole_leaves_both_out():
    """1/(s + 1), with a second state that the input does not reach."""
    loop = types.SimpleNamespace(
        A=np.diag([-1.0, -2.0]), b=np.array([1.0, 0.0]), c=np.array([1.0, 1.0])
    )
    zeros, poles = rules._reduced(loop)
    assert zeros == [] and poles == pytest.approx([-1.0])
