"""Controllers of rig files by the kinds that people know: p, pi, pid, on-off, split-range."""

import dataclasses

import jax
import numpy as np
import pytest
from helpers import INTEGRATOR as ONE, assert_same_case, command

import jaxtank
from jaxtank import rig
from jaxtank.core.errors import InputError
from jaxtank.core.tree import with_values
from jaxtank.loop.steady import steady_state
from jaxtank.loop.trajectory import columns
from jaxtank.measures import serves
from jaxtank.plants import network

STAGED = """
units = ["m", "%"]
tank = [{ area = 10.0, rim = 5.0, drain = 0.01, level = 1.0 }]
pump = [
    { gain = 0.0005, to = 1, high = 100.0, initial = 88.6 },
    { gain = 0.0005, to = 1, high = 100.0 },
]
plant = { outputs = [1], gravity = 9.81 }
reference = { initial = [1.0], changes = [[100.0, 1, 2.0]], ramp = 0.0 }
values = { "clock.dt" = 1.0, "clock.duration" = 2000.0 }
"""


def loads(text, **table):
    return rig.loads(f"{text}controller = {rig.toml(table)}")


@pytest.mark.parametrize(
    ("table", "kind"),
    [
        ({"kind": "p", "Kc": 2.0}, "p"),
        ({"kind": "pid", "Kc": 2.0}, "p"),
        ({"kind": "pi", "Kc": 2.0, "Ti": 20.0}, "pi"),
        ({"kind": "pid", "Kc": 2.0, "Ti": 20.0, "Tt": 5.0}, "pi"),
        ({"kind": "pid", "Kc": 2.0, "Ti": 20.0, "Td": 1.0}, "pid"),
        ({"kind": "pi", "Kc": 2.0, "Ti": 9.0, "anti_windup": "clamping", "b": 0.5}, "pi"),
        ({"kind": "on-off", "on": 0.9, "off": 1.1}, "on-off"),
    ],
)
def test_a_kind_builds_its_controller_and_is_written_back(table, kind):
    case = loads(ONE, **table)
    text = rig.dump(case)
    assert f'kind = "{kind}"' in text
    assert_same_case(rig.loads(text), case)


@pytest.mark.extended_for("pid-more1")
@pytest.mark.parametrize("kind, more", [("pi", {}), ("pid", {"Td": 2.0})])
def test_a_tracking_time_that_is_left_out_is_the_integral_time_also_a_new_one(kind, more):
    table = {"kind": kind, "Kc": 20.0, "Ti": 5.0, **more}
    case, same = loads(ONE, **table), loads(ONE, **table, Tt=5.0)
    assert case.loop.controller.Tt is None
    runs = [jaxtank.simulate(c.loop, c.clock) for c in (case, same)]
    assert np.any(np.asarray(runs[0].u) == case.loop.actuator.high)  # it winds up
    np.testing.assert_allclose(runs[0].x, runs[1].x, rtol=1e-12)
    faster = [rig.set_values(c, {"controller.Ti": [1.0]}) for c in (case, same)]
    faster[1] = rig.set_values(faster[1], {"controller.Tt": [1.0]})
    runs = [jaxtank.simulate(c.loop, c.clock).x for c in faster]
    np.testing.assert_allclose(*runs, rtol=1e-12)
    stated = rig.set_values(case, {"controller.Tt": [50.0]})  # also of a rig without
    assert np.abs(jaxtank.simulate(stated.loop, stated.clock).x - runs[0]).max() > 1e-3
    assert loads(ONE, kind="p", Kc=2.0).loop.controller.Ti is None


@pytest.mark.parametrize(
    ("table", "words"),
    [
        ({"kind": "p", "Kc": 1.0, "Ti": 5.0}, "'Ti'"),
        ({"kind": "pi", "Kc": 1.0}, "needs Ti"),
        ({"kind": "pi", "Kc": 1.0, "Ti": 5.0, "Td": 1.0}, "'Td'"),
        ({"kind": "on-off", "on": 1.0, "off": 1.0}, "controller.on = controller.off"),
    ],
)
def test_a_key_that_a_kind_does_not_have_is_refused(table, words):
    with pytest.raises(InputError, match=words):
        loads(ONE, **table)


def test_on_off_with_dead_time_has_the_limit_cycle_of_an_integrator():
    case = loads(ONE, kind="on-off", on=0.9, off=1.1)
    run = jaxtank.simulate(case.loop, case.clock)
    level, pump = np.asarray(run.x)[:, 0], np.asarray(run.applied)[:, 0]
    settled, slack = level[len(level) // 3 :], 0.01 * 2 * case.clock.dt
    assert abs(settled.max() - (1.1 + 0.01 * 5.0)) < slack
    assert abs(settled.min() - (0.9 - 0.01 * 5.0)) < slack
    starts = np.flatnonzero(np.diff(pump) > 0.5) * case.clock.dt
    np.testing.assert_allclose(
        np.diff(starts[1:]), 2 * (0.2 + 2 * 0.05) / 0.01, atol=4 * case.clock.dt
    )


def test_duty_and_standby_pumps_control_one_tank_twice():
    """Two outputs of one tank, in a plain rig: measures, and a column for each."""
    text = STAGED.replace("outputs = [1]", 'outputs = ["A", "A"]').replace(
        "{ area", '{ name = "A", area'
    )
    text = text.replace("initial = [1.0], changes = [[100.0, 1, 2.0]]", "initial = [1.0, 1.0]")
    case = loads(text, kind="on-off", on=[0.9, 0.7], off=[1.1, 1.2])
    run, measures = jaxtank.simulate(case), jaxtank.evaluate(case, ["rms_error", "input_travel"])
    assert np.ptp(np.asarray(run.x)[:, 0]) > 0.1 and np.isfinite(measures["rms_error"]).all()
    assert not serves("input_deviation", case.loop)
    assert [n for n in columns(run, case.loop.units) if n.startswith("r")] == [
        "r_A [m]",
        "r_A_2 [m]",
    ]


def test_on_off_has_no_derivative_and_says_so():
    case = loads(ONE, kind="on-off", on=0.9, off=1.1)

    def error(on):
        loop = jaxtank.with_values(case.loop, {"controller.on": on})
        return jaxtank.evaluate(loop, case.clock, ["rms_error_total"])["rms_error_total"]

    with pytest.raises(InputError, match="on-off"):
        jax.grad(error)(np.array([0.9]))


@pytest.mark.extended
@pytest.mark.slow_for("options0")
@pytest.mark.parametrize("options", [(), ("--method", "slsqp")])
def test_tuning_an_on_off_controller_is_one_line_of_refusal(tmp_path, options):
    path = tmp_path / "rig.toml"
    path.write_text(f"{ONE}controller = {rig.toml({'kind': 'on-off', 'on': 0.9, 'off': 1.1})}")
    output = command("tune", str(path), "--free", "controller.on=0.5:1.0", *options)
    assert output.code == 2
    assert len(output.err.strip().splitlines()) == 1 and "on-off" in output.err


@pytest.mark.extended
def test_split_range_starts_the_second_pump_where_the_first_is_at_its_limit():
    case = loads(STAGED, kind="split-range", Kc=50.0, Ti=200.0, Tt=100.0)
    for setpoint in (1.0, 2.0, 4.0):  # drain 0.01 sqrt(2 g h) by 0.0005 per %
        total = 0.01 * np.sqrt(2.0 * 9.81 * setpoint) / 0.0005
        _, inputs = steady_state(case.loop, (setpoint,))
        np.testing.assert_allclose(inputs, [min(total, 100.0), max(total - 100.0, 0.0)], atol=1e-6)
    run = jaxtank.simulate(case.loop, case.clock)
    assert abs(np.asarray(run.x)[-1, 0] - 2.0) < 0.03
    first, second = np.asarray(run.applied).T
    assert np.all((second == 0.0) | (first == 100.0)) and second.max() > 20.0
    assert_same_case(rig.loads(rig.dump(case)), case)


def test_split_range_winds_up_by_the_total():
    """Two pumps in sequence are one pump of twice the range."""
    two = loads(STAGED, kind="split-range", Kc=400.0, Ti=50.0, Tt=20.0)
    single = STAGED.replace("{ gain = 0.0005, to = 1, high = 100.0 },", "").replace(
        "high = 100.0", "high = 200.0"
    )
    one = loads(single, kind="pi", Kc=400.0, Ti=50.0, Tt=20.0)
    runs = [np.asarray(jaxtank.simulate(case.loop, case.clock).x) for case in (two, one)]
    np.testing.assert_allclose(*runs, rtol=0, atol=1e-9)


@pytest.mark.extended
def test_sequences_of_different_lengths_are_written_back():
    text = STAGED.replace(
        "level = 1.0 }]", "level = 1.0 }, { area = 10.0, rim = 5.0, drain = 0.01 }]"
    )
    text = text.replace(
        "high = 100.0 },\n]", "high = 100.0 }, { gain = 0.0005, to = 2, high = 100.0 },\n]"
    )
    text = text.replace("outputs = [1]", "outputs = [1, 2]").replace("[1.0], c", "[1.0, 1.0], c")
    case = loads(text, kind="split-range", Kc=[50.0, 50.0], Ti=200.0, sequence=[[1, 2], [3]])
    assert "sequence = [[1, 2], [3]]" in rig.dump(case)
    assert_same_case(rig.loads(rig.dump(case)), case)


def test_split_range_of_a_pump_and_a_valve_in_the_outlet():
    text = STAGED.replace('"%"', '"-"').replace(
        "0.0005, to = 1, high = 100.0", "0.02, to = 1, high = 1.0"
    )
    text = text.replace("initial = 88.6", "initial = 0.0").replace(
        "units =", "reachable = false\nunits ="
    )
    table = {
        "kind": "split-range",
        "Kc": 5.0,
        "Ti": 500.0,
        "bias": 1.0,
        "sequence": [2, 1],
        "reverse": [2],
    }
    case = loads(text.replace("[100.0, 1, 2.0]", "[100.0, 1, 1.3], [500.0, 1, 0.6]"), **table)
    rest = {"area": 1.0, "drain": 0.0, "rim": 2.0, "units": ("m", "-")}
    plant = network(pump_gain=0.02, feeds=[(0, None)], valves=[(0, None)], valve=0.01, **rest)

    def on_plant(Kc):
        controller = dataclasses.replace(case.loop.controller, model=plant, Kc=np.array([Kc]))
        return case.replace(loop=dataclasses.replace(case.loop, plant=plant, controller=controller))

    right, wrong = on_plant(5.0), on_plant(-5.0)
    run = jaxtank.simulate(right.loop, case.clock)
    pump, valve = np.asarray(run.applied).T
    assert np.all((pump == 0.0) | (valve == 0.0)) and pump.max() > 0.0 and valve.max() > 0.0
    assert abs(np.asarray(run.x)[-1, 0] - 0.6) < 0.02
    assert not any("Kc" in sentence for sentence in rig.case_warnings(right))
    assert sum("Kc" in sentence for sentence in rig.case_warnings(wrong)) == 2


@pytest.mark.parametrize(
    "Kc, reverse, write",
    [
        (300.0, (), 'reverse = ["DRAIN"]'),
        (-300.0, (), 'reverse = ["DRAIN"], and change the sign'),
        (300.0, (1, 2), 'reverse = ["DRAIN"]'),
        (300.0, (2,), ""),
        (-300.0, (2,), "change the sign"),
    ],
)
def test_split_range_of_inputs_that_fill_and_empty_is_told_what_to_reverse(Kc, reverse, write):
    case = rig.loads(f"""
        units = ["m", "%"]
        reachable = false
        tank = [{{ name = "T1", area = 1.5, rim = 2.5, level = 1.0 }}]
        pump = [{{ name = "FILL", to = "T1", gain = "0.03 L/(s %)", high = 100.0 }}]
        valve = [{{ name = "DRAIN", from = "T1", area = "8 cm^2", initial = 0.0 }}]
        [controller]
        kind = "split-range"
        sequence = ["DRAIN", "FILL"]
        reverse = {list(reverse)}
        Kc = {Kc}
        Ti = "5 min"
        bias = 100.0
        [reference]
        initial = [1.0]
    """)
    sentences = [s for s in rig.case_warnings(case) if "controller." in s]
    assert bool(sentences) == bool(write) and all(write in s for s in sentences)


def test_a_pid_with_more_pumps_than_levels_says_what_to_write():
    with pytest.raises(InputError, match=r'kind = "split-range"'):
        loads(STAGED, kind="pid", Kc=50.0, Ti=200.0)


def test_each_input_of_a_split_range_takes_its_range_above_its_lower_end():
    controller = loads(STAGED, kind="split-range", Kc=50.0, Ti=200.0, Tt=100.0).loop.controller
    ends = {"low": np.array([1.0, 2.0]), "high": np.array([5.0, 6.0])}
    controller = dataclasses.replace(controller, **ends)
    for total, inputs in ((3.0, (4.0, 2.0)), (5.0, (5.0, 3.0)), (9.0, (5.0, 7.0))):
        assert controller.shared((total,)) == inputs


LOCKED = """
tank = [{ area = 100.0, drain = 0.5, rim = 200.0, level = 10.0 }]
pump = [{ to = 1, gain = 20.0, high = 5.0, initial = 3.5 }]
controller = { kind = "lqi", Q = [1.0, 0.001], R = [10000.0], operating_point = [10.0] }
reference = { initial = [10.0], changes = [[100.0, 1, 50.0]] }
values = { "clock.dt" = 1.0, "clock.duration" = 4000.0 }
reachable = false
"""


def test_integrals_of_lqi_take_a_pump_back_from_its_limit():
    """The pump brings 1.8 times what the model says: it is at its limit past the setpoint."""
    case = rig.loads(LOCKED)
    run = jaxtank.simulate(with_values(case.loop, {"plant.pump_gain": [36.0]}), case.clock)
    assert run.u[600, 0] == 5.0 and run.x[600, 0] > 60.0
    assert abs(run.x[-1, 0] - 50.0) < 1e-3
