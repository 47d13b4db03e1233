"""Tuning rules against closed forms: integrator with dead time, tanks in series, relay cycle."""

import json
import math

import numpy as np
import pytest
from helpers import command

import jaxtank
from jaxtank import rig
from jaxtank.bounds import gain_ranges
from jaxtank.core.errors import InputError
from tuning.problem import rules
from tuning.search.setting import setting_of
from tuning.search.tuner import rule_rows

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
RELAY = """
units = ["m", "-"]
reachable = false
tank = [{ area = 1.0, rim = 5.0, level = 0.98, inflow = -0.01 }]
pump = [{ gain = 0.02, to = 1, low = 0.0, high = 1.0, initial = 0.5 }]
plant = { gravity = 9.81 }
controller = { kind = "p", Kc = 1.0 }
reference = { initial = [1.0], changes = [] }
values = { "clock.dt" = 0.05, "clock.duration" = 50.0, "actuator.delay" = 5.0 }
"""

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


def test_the_ultimate_cycle_of_an_integrator_is_that_of_its_dead_time():
    ultimate = rules.ultimate_of(rules.loop_of(rig.loads(SIMC), 0))
    theta = 60.0 + 0.05  # half a sample more
    np.testing.assert_allclose(ultimate, (math.pi / (2 * 0.01 * theta), 4 * theta), rtol=1e-3)


def test_a_relay_experiment_has_the_cycle_of_its_describing_function():
    gain, period = rules.relay_experiment(rig.loads(RELAY), 0)
    np.testing.assert_allclose(gain, 4 * 0.5 / (math.pi * 0.05), rtol=0.01)
    np.testing.assert_allclose(period, 20.0, atol=0.15)


def test_the_half_rule_shares_the_second_lag():
    case = rig.loads(SERIES)
    flow = 0.01 * math.sqrt(2 * 9.81 * 1.2)
    slow, fast = 2 * 1.0 * 1.2 / flow, 2 * 0.5 * 1.2 / flow
    first = rules.process_of(rules.loop_of(case, 0), 1)
    np.testing.assert_allclose(first.lag, slow + fast / 2, rtol=1e-6)
    np.testing.assert_allclose(first.delay, fast / 2 + 0.25, rtol=1e-6)
    steady = 2 * 1.2 / flow * 0.1  # of the level for a unit of the input
    np.testing.assert_allclose(first.gain * first.lag, steady, rtol=1e-6)
    second = rules.process_of(rules.loop_of(case, 0), 2)
    np.testing.assert_allclose(second[1:], (slow, fast, 0.25), rtol=1e-6)
    np.testing.assert_allclose(second.gain * second.lag, steady, rtol=1e-6)


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


def test_rules_are_judged_on_the_plants_of_an_answer():
    case = rig.loads(SERIES)
    rows = rule_rows(setting_of(case), 8, 0)
    assert [row["rule"] for row in rows] == list(rules.RULES)
    assert all(row["error"] > 0.0 and row["holds"] is not None for row in rows)


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
