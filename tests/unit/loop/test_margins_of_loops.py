"""Margins of loops that move several inputs, and beside inputs that no loop moves."""

import numpy as np
import pytest

import jaxtank
from jaxtank import rig

NAMES = ("sensitivity_peak", "complementary_peak")
ONE_BY_ONE = ("gain_margin", "phase_margin", "delay_margin")

TANKS = """
units = ["cm", "cm^3/s"]
tank = [
    { area = 200.0, rim = 40.0, drain = 0.8, level = 10.0, inflow = INFLOW },
    { area = 200.0, rim = 40.0, drain = 0.8, level = 10.0 },
]
orifice = [{ from = 1, to = 2, area = 0.5 }]
plant = { outputs = [2] }
reference = { initial = [10.0], changes = [[100.0, 1, 12.0]], ramp = 0.0 }
values = { "clock.dt" = 1.0, "clock.duration" = 200.0 }
"""
FIRST = "{ to = 1, high = 400.0, initial = 291.3 },"
LEVEL = """
units = ["cm", "V"]
tank = [{ area = 100.0, rim = 30.0, drain = 0.5, level = 9.0 }]
plant = { outputs = [1] }
reference = { initial = [9.0] }
values = { "clock.dt" = 1.0, "clock.duration" = 100.0 }
"""


def margins_of(*lines):
    """The plateaus of a rig of these lines, all of them stable."""
    plateaus = jaxtank.stability_margins(rig.loads("\n".join(lines)))
    assert all(p.stable and p.why == "" for p in plateaus), [p.why for p in plateaus]
    return plateaus


def assert_alike(some, others, entry=0):
    """The loop of `others` is that of input `entry` of `some`."""
    assert len(some) == len(others) > 0
    for a, b in zip(some, others):
        for name in NAMES:
            assert getattr(a.margins, name) == pytest.approx(getattr(b.margins, name), rel=1e-6)
        for name in ONE_BY_ONE:
            values = getattr(a.margins, name)[entry], getattr(b.margins, name)[0]
            assert values[0] == pytest.approx(values[1], rel=1e-6)


@pytest.mark.extended
@pytest.mark.slow_for("0.0")
@pytest.mark.parametrize("held", [0.0, 60.0])  # at its limit, and within
def test_a_pump_that_runs_by_hand_counts_as_an_inflow_does(held):
    alone = TANKS.replace("INFLOW", f"{held}")
    gains = 'kind = "pi", Kc = [20.0], Ti = [60.0]'
    pump = f"pump = [{FIRST} {{ to = 1, high = 900.0, initial = {held} }}]"
    beside = margins_of(
        TANKS.replace("INFLOW", "0.0"), pump, f"controller = {{ {gains}, lead = [1] }}"
    )
    assert_alike(beside, margins_of(alone, f"pump = [{FIRST}]", f"controller = {{ {gains} }}"))
    assert np.all(np.isinf([getattr(beside[0].margins, name)[1] for name in ONE_BY_ONE]))


@pytest.mark.slow
def test_staged_pumps_have_the_margins_of_the_one_that_moves():
    gains = "Kc = [5.0], Ti = [60.0]"
    tank = LEVEL.replace("initial = [9.0]", "initial = [4.0], changes = [[50.0, 1, 16.0]]")
    pump = "{ to = 1, gain = 10.0, high = HIGH, initial = 5.0 }"
    first, both = pump.replace("HIGH", "6.0"), pump.replace("HIGH", "16.0")
    staged = margins_of(
        tank, f"pump = [{first}, {first}]", f'controller = {{ kind = "split-range", {gains} }}'
    )
    assert staged[0].u[1] == 0.0 and staged[1].u[0] == pytest.approx(6.0)
    single = margins_of(tank, f"pump = [{both}]", f'controller = {{ kind = "pi", {gains} }}')
    for entry in range(2):
        assert_alike(staged, single, entry)


@pytest.mark.extended_for("0")
@pytest.mark.parametrize("more", [0, 4])
def test_pumps_in_a_ratio_are_one_loop_also_with_a_dead_time_of_the_follower(more):
    control = pytest.importorskip("control", reason="python-control is the independent answer")
    pump = "{ to = 1, gain = 6.0, high = 12.0, delay = 2.0 },"
    follower = f"{{ to = 1, gain = 8.0, high = 50.0, delay = {2.0 + more} }}"
    blend = 'kind = "ratio", Kc = [2.0], Ti = [30.0], follow = [1], ratio = [0.5]'
    (plateau,) = margins_of(LEVEL, f"pump = [{pump} {follower}]", f"controller = {{ {blend} }}")
    pole = 0.5 * np.sqrt(2.0 * 981.0) / (2.0 * 100.0 * np.sqrt(9.0))
    keep = np.exp(-pole)
    tank = control.ss([[keep]], [[(1.0 - keep) / pole / 100.0]], [[1.0]], [[0.0]], 1.0)
    pi = control.ss([[1.0]], [[1.0]], [[2.0 / 30.0]], [[2.0]], 1.0)
    late = lambda k: control.tf([1.0], [1.0] + [0.0] * k, 1.0)
    loop = control.tf(tank * pi) * late(2) * (6.0 + 0.5 * 8.0 * late(more))
    gain, phase, distance, _, crossover, _ = control.stability_margins(loop)
    assert plateau.margins.sensitivity_peak == pytest.approx(1.0 / distance, rel=1e-4)
    assert plateau.margins.gain_margin == pytest.approx([gain, gain], rel=1e-4)
    assert plateau.margins.phase_margin == pytest.approx([phase, phase], rel=1e-4)
    delay = np.radians(phase) / crossover
    assert plateau.margins.delay_margin == pytest.approx([delay, delay], rel=1e-4)


def test_margins_of_coupled_loops_do_not_depend_on_the_units_of_an_input():
    def coupled(share):
        tanks = TANKS.replace("INFLOW", "0.0").replace("[2]", "[1, 2]")
        tanks = tanks.replace('"cm^3/s"]', '"V"]')
        first = FIRST.replace("{", "{ gain = 1.0,")
        pumps = f"pump = [{first} {{ to = 2, gain = {1 / share}, high = {400 * share} }}]"
        gains = f"Kc = [20.0, {30 * share}], Ti = [60.0, 40.0]"
        rows = "initial = [10.0, 10.0], changes = [[100.0, 1, 9.0], [100.0, 2, 12.0]]"
        tanks = tanks.replace("initial = [10.0], changes = [[100.0, 1, 12.0]]", rows)
        return margins_of(tanks, pumps, f'controller = {{ kind = "pi", {gains} }}')

    assert_alike(coupled(1.0), coupled(0.01))


@pytest.mark.slow
def test_a_valve_with_a_lag_beside_a_pump_by_hand_has_its_steady_state():
    """The valve of an equal-percentage curve at h = 1 m: 0.004 m^2 30^(u - 1) sqrt(2 g h) = q."""
    (plateau,) = margins_of(
        """
        units = ["m", "%"]
        tank = [{ shape = "cone", diameter = 2.0, height = 2.0, level = 1.0 }]
        pump = [{ to = 1, gain = 1e-4, high = 100.0, initial = 30.0, delay = 20.0 }]
        [[valve]]
        from = 1
        area = 0.004
        characteristic = "equal-percentage"
        rangeability = 30.0
        high = 100.0
        initial = 50.0
        lag = 6.0
        [controller]
        kind = "pi"
        lead = [2]
        action = "direct"
        Kc = [60.0]
        Ti = [120.0]
        [plant]
        outputs = [1]
        [reference]
        initial = [1.0]
        [values]
        "clock.dt" = 2.0
        "clock.duration" = 100.0
        """
    )
    opening = 100.0 * (1.0 + np.log(0.003 / 0.004 / np.sqrt(2.0 * 9.81)) / np.log(30.0))
    np.testing.assert_allclose(plateau.u, [30.0, opening], rtol=1e-3)


OVERRIDDEN = """
units = ["cm", "V"]
tank = [{{ area = 200.0, rim = 60.0, drain = 0.1, inflow = 60.0, level = 15.0 }},
    {{ area = 80.0, rim = 60.0, drain = 0.5, level = 10.0 }}]
pump = [{{ from = 1, to = 2, gain = 20.0, high = 10.0, delay = 1.0, lag = 1.0, initial = 2.5 }}]
plant = {{ outputs = [{output}] }}
reference = {{ initial = [{setpoint}] }}
controller = {{ {controller} }}
values = {{ "clock.dt" = 0.5, "clock.duration" = 4000.0 }}
reachable = false
"""


@pytest.mark.extended
def test_an_override_in_force_has_the_margins_of_its_loop_on_the_limit():
    gains = "limited = [1], limit = [8.0], limit_Kc = [-0.8], limit_Ti = [60.0]"
    override = f'kind = "override", {gains}, Kc = [0.6], Ti = [40.0], bias = [2.5]'
    text = OVERRIDDEN.format(output=2, setpoint=10.0, controller=override)
    alone = 'kind = "pi", Kc = [-0.8], Ti = [60.0]'
    overridden = margins_of(text)
    assert_alike(
        overridden, margins_of(OVERRIDDEN.format(output=1, setpoint=8.0, controller=alone))
    )
    case = rig.loads(text)
    rests = np.asarray(jaxtank.simulate(case.loop, case.clock).x)[-1]
    np.testing.assert_allclose(overridden[0].x, rests, rtol=1e-4)
    assert overridden[0].x[0] == pytest.approx(8.0, rel=1e-6)


@pytest.mark.slow
def test_an_override_of_one_of_two_outputs_in_force_is_found():
    """A third tank with a pump of its own, whose limit is far away, changes nothing."""
    third = ", { area = 50.0, rim = 60.0, drain = 0.4, level = 10.0 }]"
    pump = ", { to = 3, gain = 20.0, high = 10.0, initial = 2.8 }]"
    gains = "limited = [1, 3], limit = [8.0, 50.0], limit_Kc = [-0.8, 0.8], limit_Ti = [60.0, 60.0]"
    override = f'kind = "override", {gains}, Kc = [0.6, 0.5], Ti = [40.0, 40.0], bias = [2.5, 2.8]'
    alone = 'kind = "pi", Kc = [-0.8, 0.5], Ti = [60.0, 40.0]'

    def margins(output, setpoint, controller):
        text = OVERRIDDEN.format(output=output, setpoint=setpoint, controller=controller)
        lines = text.replace("level = 10.0 }]", "level = 10.0 }" + third)
        return margins_of(lines.replace("initial = 2.5 }]", "initial = 2.5 }" + pump))

    overridden = margins("2, 3", "10.0, 9.0", override)
    assert_alike(overridden, margins("1, 3", "8.0, 9.0", alone))
    assert overridden[0].x[0] == pytest.approx(8.0, rel=1e-6)


DRUM = """
units = ["m", "m^3/h"]
plant = { outputs = ["drum"] }
controller = { kind = "pi", Kc = 40.0, Ti = 600.0, action = "direct" }
reference = { initial = [2.0], changes = [[100.0, 1, 2.5]] }
values = { "clock.dt" = 5.0, "clock.duration" = 3000.0 }
"""
INTO = """
tank = [
    { name = "store", area = 9.0, rim = 9.0, level = 1.0, inflow = "STORE m3/h" },
    { name = "drum", area = 4.5, rim = 4.0, level = 2.0, inflow = "40 m3/h" },
]
pump = [{ from = "drum", to = "store", high = 100.0 }]
"""
OUT = """
tank = [{ name = "drum", area = 4.5, rim = 4.0, level = 2.0, inflow = "40 m3/h" }]
pump = [{ from = "drum", high = 100.0 }]
"""


@pytest.mark.extended_for("0", "-40")
@pytest.mark.parametrize("flow", [0, -40, -70])
def test_a_tank_that_only_stores_what_a_pump_brings_takes_no_margins_and_no_bias(flow):
    """Whether it fills, stays or runs empty: the loop is that of a pump to the basin."""
    into, out = INTO.replace("STORE", str(flow)), OUT
    assert_alike(margins_of(DRUM, into), margins_of(DRUM, out))
    bias = [float(rig.loads(DRUM + tanks).loop.controller.bias[0]) for tanks in (into, out)]
    assert bias == pytest.approx([40.0, 40.0])
