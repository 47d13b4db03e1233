"""Steady states of many plants at once against those of each alone, and against its rates."""

import dataclasses

import numpy as np
import pytest

from jaxtank import presets, rig
from jaxtank.analysis.steady_batch import SteadyStates
from jaxtank.analysis.steady_state import _roots_of, equilibrium
from jaxtank.core import numerics
from jaxtank.core.errors import InputError
from jaxtank.loop.steady import steady_state
from jaxtank.plants import elements
from jaxtank.plants.network import network
from tuning.feasible.study import of_nominal_plant
from tuning.uncertainty.needs import Needs

DRAWN = ("drain", "orifice", "pipe", "pump_gain")


def drawn(plant, count=4):
    """{name: (count, ...)} parameters 10 % off."""
    rng = np.random.default_rng(0)
    values = {name: np.asarray(getattr(plant, name)) for name in DRAWN}
    return {n: v * rng.uniform(0.9, 1.1, (count, *v.shape)) for n, v in values.items()}


@pytest.mark.parametrize(
    "name, outputs",
    [
        ("gouta2015/ngpc", [[3.0, 3.0], [16.0, 14.0]]),
        ("mirakhorli/sfc", [[12.0, 12.0], [10.0, 12.5]]),
        ("cascaded/pi", [[2.0], [7.0]]),
        ("calofir/backstepping", [[0.2], [0.35]]),
        ("khalid/gpc-mimo", [[0.16, 0.15], [0.15, 0.15]]),
    ],
)
def test_it_is_that_of_each_plant_alone(name, outputs):
    plant = presets.find(name).loop.plant
    values = drawn(plant)
    levels, inputs = SteadyStates(plant, values).at(outputs)
    for s in range(4):
        own = dataclasses.replace(plant, **{n: v[s] for n, v in values.items()})
        for k, y in enumerate(outputs):
            x, u = equilibrium(own, y)
            np.testing.assert_allclose(levels[s, k], x, rtol=1e-9, atol=1e-12)
            np.testing.assert_allclose(inputs[s, k], u, rtol=1e-8, atol=1e-10)


def test_a_steady_inflow_and_a_pump_into_two_tanks_leave_no_rate():
    plant = presets.find("mirakhorli/sfc").loop.plant
    inflow = np.array([1.0, -0.5, 2.0, 0.3])
    levels, inputs = SteadyStates(plant, {}, inflow).at([[12.0, 12.0]])
    rates = plant.derivative(0.0, tuple(levels[0, 0]), tuple(inputs[0, 0]), tuple(inflow))
    np.testing.assert_allclose(np.asarray(rates), 0.0, atol=1e-12)


@pytest.mark.extended_for("0.05")
@pytest.mark.parametrize("level", [0.05, 0.4, 2.0])
def test_below_the_knee_the_flow_at_rest_is_that_of_the_plant(level):
    """A linear outlet is written as one below its knee: the lower tank then stands at the inverse
    of its flow.
    """
    plant = network(
        area=[20.0] * 2, drain=[0.1, 0.2], links=[(0, 1)], orifice=[0.3], pump_gain=[5.0],
        feeds=[(0, None)], rim=30.0, outputs=(0,), knee=1.0,
    )  # fmt: skip
    levels, inputs = SteadyStates(plant, {}).at([[level]])
    for x, u in ((levels[0, 0], inputs[0, 0]), equilibrium(plant, [level])):
        assert x[0] == pytest.approx(level, rel=1e-12)
        np.testing.assert_allclose(np.asarray(plant.rates(tuple(x), tuple(u))), 0.0, atol=1e-12)


def test_a_flow_that_would_run_backwards_is_a_level_below_zero():
    levels, _ = SteadyStates(presets.find("gouta2015/ngpc").loop.plant, {}).at([[16.0, 3.0]])
    assert levels[0, 0, 3] < 0 < levels[0, 0, 2]


def test_a_rig_with_fewer_pumps_than_outputs_is_refused():
    plant = network(
        area=[20.0] * 2, drain=[0.2] * 2, pump_gain=[5.0], feeds=[(0, None)], rim=30.0,
        outputs=(0, 1),
    )  # fmt: skip
    with pytest.raises(InputError, match="as many pumps as outputs"):
        SteadyStates(plant, {})


def test_roots_of_numbers_are_those_of_the_loop():
    levels = np.array([-3.0, -1e-9, 0.0, 1e-4, 0.004, 0.01, 0.0100001, 2.0, 30.0])
    expected = np.asarray(numerics.smooth_sqrt(levels, 0.01))
    np.testing.assert_allclose(_roots_of(levels, 0.01), expected, rtol=1e-15)


FLAT = "curve = [[0.0, 0.0], [60.0, 0.0], [80.0, 500.0], [100.0, 800.0]]"
PAIR = """
units = ["cm", "%"]
tank = [{{ area = 4000.0, rim = 200.0, level = 40.0, drain = 3.0 }}]
pump = [{{ {first}, to = 1, high = 100.0 }}{second}]
controller = {{ {control}, Kc = 1.0, Ti = 60.0 }}
"""
SHARED = 'kind = "split-range", sequence = [1, 2]'


@pytest.mark.parametrize(
    ("first", "second", "flow", "inputs"),
    [
        (FLAT, "", 500.0, [80.0]),
        (FLAT, "gain = 6.0", 500.0, [80.0, 0.0]),
        (FLAT, "gain = 6.0", 1100.0, [100.0, 50.0]),
        ("gain = 6.0", FLAT, 1100.0, [100.0, 80.0]),
        ("gain = 6.0", FLAT, 300.0, [50.0, 0.0]),
    ],
)
def test_a_pump_that_brings_nothing_at_first_has_its_steady_states(first, second, flow, inputs):
    """At points of its curve, with a level by Torricelli."""
    more = f", {{ {second}, to = 1, high = 100.0 }}" if second else ""
    control = SHARED if second else 'kind = "pi"'
    case = rig.loads(PAIR.format(first=first, second=more, control=control))
    level = (flow / 3.0) ** 2 / (2.0 * 981.0)
    np.testing.assert_allclose(steady_state(case.loop, [level])[1], inputs, rtol=1e-6, atol=1e-5)


@pytest.mark.extended_for("orifice", "valve")
@pytest.mark.parametrize(
    "link, opening",
    [
        ("orifice = [{ from = 1, to = 2, area = 0.2, port = 10.0 }]", lambda h: h - 10.0),
        ("pipe = [{ between = [1, 2], area = 0.2, port = 10.0 }]", lambda h: h - 10.0),
        (
            "valve = [{ from = 1, to = 2, area = 0.2, port = 10.0, initial = 1.0 }]",
            lambda h: h - 10,
        ),
    ],
    ids=["orifice", "pipe", "valve"],
)
def test_a_steady_state_above_a_port_is_found(link, opening):
    """Tank 1 feeds tank 2, whose level is 2 cm, through a port at 10 cm: both roots are equal."""
    lead = "lead = [1], " if "valve" in link else ""
    case = rig.loads(f"""
    units = ["cm", "V"]
    tank = [{{ area = 50.0, rim = 40.0, drain = 0.2, level = 12.0 }},
        {{ area = 50.0, rim = 40.0, drain = 0.2, level = 2.0 }}]
    {link}
    pump = [{{ gain = 20.0, to = 1, high = 10.0, initial = 1.0 }}]
    plant = {{ outputs = [2] }}
    reference = {{ initial = [2.0] }}
    controller = {{ kind = "pi", {lead}Kc = 0.5, Ti = 50.0 }}
    """)
    x, u = steady_state(case.loop, (2.0,))
    np.testing.assert_allclose(opening(x[0]), 2.0, rtol=1e-4)
    speed = np.sqrt(2.0 * 981.0)
    flow = 0.2 * speed * (np.sqrt(12.0) + np.sqrt(2.0))
    assert u[0] == pytest.approx(flow / 20.0, rel=1e-4)
    (needs,) = Needs(case, {}).at()[0]
    np.testing.assert_allclose(needs[: 2 + len(u)], [*x, *u], rtol=1e-6)


def test_a_setpoint_that_needs_a_level_below_its_limit_is_out_of_reach():
    case = rig.loads("""
    units = ["cm", "V"]
    tank = [{ area = 50.0, rim = 40.0, drain = 0.0, level = 4.0 },
        { area = 50.0, rim = 40.0, drain = 0.3, level = 4.0 }]
    orifice = [{ from = 1, to = 2, area = 0.3 }]
    pump = [{ gain = 20.0, to = 1, high = 10.0, initial = 1.0 }]
    plant = { outputs = [2] }
    reference = { initial = [4.0] }
    limits = { min_level = [6.0, 3.0] }
    controller = { kind = "pi", Kc = 0.5, Ti = 50.0 }
    """)
    (row,) = of_nominal_plant(case)
    assert (row.tank, row.limit) == (1, 6.0) and row.needed == pytest.approx(4.0)
    assert of_nominal_plant(case.replace(limits={"min_level": [3.9, 3.0]})) == ()


@pytest.mark.parametrize(
    ("second", "tanks"),
    [
        ("valve = [{ from = 1, area = 1.0, initial = 0.5 }]", "tank 2"),
        ("valve = [{ from = 2, area = 1.0, initial = 0.5 }]", None),
        ("valve = [{ from = 2, area = 1.0, initial = 0.5, port = 9.5 }]", None),
        ("valve = [{ from = 2, to = 1, area = 1.0, initial = 0.5, check = true }]", None),
    ],
)
def test_levels_that_no_two_inputs_can_set_apart_are_named(second, tanks):
    """Tank 1 runs into tank 2: what a valve takes from tank 1 changes nothing of tank 2. Valves of
    tank 2 would have to bring water in, or move nothing at these levels alone.
    """
    with pytest.raises(InputError, match="have no steady state") as refused:
        rig.loads(f"""
        units = ["cm", "V"]
        tank = [{{ area = 50.0, rim = 30.0, level = 10.0 }},
            {{ area = 50.0, rim = 30.0, level = 6.4, drain = 0.5 }}]
        orifice = [{{ from = 1, to = 2, area = 0.4 }}]
        pump = [{{ to = 1, gain = 20.0, high = 10.0, initial = 1.0 }}]
        {second}
        plant = {{ outputs = [1, 2] }}
        reference = {{ initial = [10.0, 9.0] }}
        controller = {{ kind = "pi", Kc = [1.0, -10.0], Ti = [60.0, 60.0] }}
        """)
    words = f"changes the net inflow of {tanks}, so that the levels cannot be set independently"
    assert (words in str(refused.value)) == (tanks is not None)


def test_the_cause_is_not_searched_for_in_a_rig_of_many_tanks(monkeypatch):
    """Its slopes are those of one tank after the other, without a compiled program."""
    monkeypatch.setattr(elements, "net_flows", None)
    tanks = 12
    plant = network(
        area=[25.0] * tanks, drain=[0.0] * (tanks - 1) + [0.3], pump_gain=[8.0, 8.0],
        feeds=[(0, None), (0, None)], pipes=[(i, i + 1) for i in range(tanks - 1)],
        pipe=[0.4] * (tanks - 1), rim=[30.0] * tanks, outputs=(0, 1),
    )  # fmt: skip
    with pytest.raises(InputError, match=r"have no steady state$"):
        equilibrium(plant, (12.0, 11.0))


VALVE = "valve = [{ name = 'V', from = 1, area = 0.5, initial = 0.0 }]"
DRAINED = "{ name = 'T2', area = 50.0, rim = 40.0, level = 3.0, drain = 0.2 }"


@pytest.mark.parametrize(
    ("tanks", "inputs"),
    [
        ("", VALVE),
        (DRAINED, "pump = [{ from = 1, to = 2, gain = 10.0, high = 10.0, initial = 0.0 }]"),
        (DRAINED, VALVE.replace("from = 1", "from = 1, to = 2, check = true")),
    ],
)
def test_a_tank_stands_still_without_any_flow(tanks, inputs):
    """What empties it is off or closed, and the tank behind it has run empty."""
    case = rig.loads(f"""
name = "still"
tank = [{{ name = "T1", area = 50.0, rim = 40.0, level = 20.0 }}, {tanks}]
{inputs}
plant = {{ outputs = ["T1"] }}
controller = {{ kind = "p", Kc = -0.2 }}
reference = {{ initial = [20.0], changes = [[1.0, 1, 10.0]], ramp = 0.0 }}
values = {{ "clock.dt" = 0.1, "clock.duration" = 40.0 }}
""")
    levels, input_ = steady_state(case.loop, [12.0])
    assert levels == pytest.approx([12.0, 0.0][: len(levels)], abs=1e-9) and abs(input_) < 1e-9
    assert of_nominal_plant(case) == ()
