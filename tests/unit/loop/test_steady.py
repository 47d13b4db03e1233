"""The steady state of a loop as it is, against closed forms of one and two tanks."""

import json

import jax
import numpy as np
import pytest

import jaxtank
from jaxtank import rig
from jaxtank.core.tree import with_values
from tuning.cli.main import main
from tuning.uncertainty.needs import Needs

STREAM = """
name = "side stream"
tank = [{ area = 100.0, rim = 60.0, drain = 0.5, level = 20.0, inflow = 40.0 }]
pump = [{ gain = 10.0, to = 1, high = 12.0 }]
law = { kind = "pid", Kc = 1.0, Ti = 20.0, Tt = 10.0 }
reference = { initial = [20.0], changes = [[50.0, 1, 22.0]], ramp = 0.0 }
values = { "clock.dt" = 0.1, "clock.duration" = 60.0 }
"""
OUTFLOW = (0.5 * np.sqrt(2 * 981.0 * 20.0) - 40.0) / 10.0  # [V]: drain less side stream

PROPORTIONAL = """
name = "p only, saturated"
units = ["m", "-"]
tank = [{ area = 1.0, rim = 5.0, level = 0.5 }]
pump = [{ gain = 0.02, to = 1, low = 0.0, high = 1.0, initial = 0.5 }]
plant = { gravity = 9.81 }
law = { kind = "pid", Kc = 10.0, Ti = inf, Tt = 5.0, bias = 0.5 }
reference = { initial = [1.0], changes = [] }
disturbance = { inflow = [-0.01] }
values = { "clock.dt" = 0.1, "clock.duration" = 1000.0 }
"""


@pytest.mark.parametrize("zone", [0.0, 2.0])
def test_nothing_moves_at_a_known_inflow_before_the_setpoint_does(zone):
    more = f'values = {{ "actuator.dead_zone" = {zone}, "actuator.dead_zone_kind" = "offset", '
    case = rig.loads(STREAM.replace("values = {", more) if zone else STREAM)
    assert case.loop.controller.bias == pytest.approx([OUTFLOW + zone], rel=1e-12)
    levels = np.asarray(jaxtank.simulate(case.loop, case.clock).x)[:500]
    assert np.abs(levels - 20.0).max() < 1e-9


def test_the_bias_does_not_override_the_initial_input_of_a_file():
    written = rig.loads(STREAM.replace("high = 12.0", "high = 12.0, initial = 5.5"))
    assert written.loop.controller.bias.tolist() == [5.5]


def test_a_pump_that_takes_out_holds_a_level_against_an_inflow():
    text = STREAM.replace("drain = 0.5", "drain = 0.0").replace(
        "gain = 10.0", "low = -5.0, gain = 10.0"
    )
    assert rig.loads(text).loop.controller.bias == pytest.approx([-4.0], rel=1e-12)
    with pytest.raises(jaxtank.EquilibriumError, match="below its low limit of -3 V"):
        rig.loads(text.replace("low = -5.0", "low = -3.0"))


@pytest.mark.slow
def test_margins_are_those_at_the_inflow(capsys, tmp_path):
    """The inflow into the lower tank sets the level of the upper one, and so its time constant."""
    path = tmp_path / "two.toml"
    path.write_text("""
name = "two"
tank = [
    { area = 50.0, rim = 60.0, level = 4.0 },
    { area = 50.0, rim = 60.0, drain = 0.5, level = 20.0, inflow = 85.0 },
]
orifice = [{ from = 1, to = 2, area = 0.5 }]
pump = [{ gain = 10.0, to = 1, high = 12.0 }]
plant = { outputs = [2] }
law = { kind = "pid", Kc = 1.0, Ti = 20.0, Tt = 10.0 }
reference = { initial = [20.0], changes = [] }
values = { "clock.dt" = 0.01, "clock.duration" = 1.0 }
""")
    assert main(["simulate", str(path), "--margins", "--json"]) == 0
    delay = json.loads(capsys.readouterr().out)["margins"][0]["delay_margin"]
    a, g = 0.5, 981.0
    upper = ((a * np.sqrt(2 * g * 20.0) - 85.0) / a) ** 2 / (2 * g)
    k1, k2 = (a * np.sqrt(2 * g) / (2 * np.sqrt(h)) / 50.0 for h in (upper, 20.0))
    w = np.geomspace(1e-3, 10.0, 400_001)
    s = 1j * w
    loop = (1.0 + 1.0 / (20.0 * s)) * (10.0 / 50.0) * k1 / ((s + k1) * (s + k2))
    cross = np.flatnonzero(np.diff(np.sign(np.abs(loop) - 1.0)))[-1]
    # the loop holds its input for a sample: half a sample is used up
    expected = (np.pi + np.angle(loop[cross])) / w[cross] - 0.005
    assert np.ravel(delay)[0] == pytest.approx(expected, rel=1e-3)


@pytest.mark.parametrize("Ti", ["Ti = 1e9, Tt = 5.0, ", ""])
def test_a_proportional_controller_keeps_its_bias_after_saturation(Ti):
    case = rig.loads(PROPORTIONAL.replace("Ti = inf, Tt = 5.0, ", Ti))
    assert np.asarray(jaxtank.simulate(case.loop, case.clock).x)[-1, 0] == pytest.approx(1.0)
    assert rig.loads(rig.dump(case)).loop.controller.Ti is None


@pytest.mark.extended
@pytest.mark.slow_for("1e9")
@pytest.mark.parametrize("Ti", ["inf", "1e9"])
def test_infinity_on_the_command_line_is_a_proportional_controller(Ti, capsys, tmp_path):
    path = tmp_path / "p.toml"
    path.write_text(PROPORTIONAL.replace("Ti = inf", "Ti = 5.0"))
    assert main(["simulate", str(path), "--set", f"controller.Ti={Ti}", "--json"]) == 0
    printed = json.loads(capsys.readouterr().out, parse_constant=pytest.fail)
    # u = 1 until the level is 0.95 m, then the error decays with k = 0.2 1/s
    late = 0.05**2 / 0.4
    early = (0.5**3 - 0.05**3) / 3 / 0.01
    assert np.ravel(printed["measures"]["ise"])[0] == pytest.approx(early + late, rel=0.01)


def test_an_observer_takes_the_model_of_the_controller():
    file = 'case = "gouta2015/ngpc"\n[observer]\nkind = "disturbance"\nl = 0.5\n[values]\n'
    case = rig.loads(file + '"controller.model.pump_gain" = [3.0, 3.0]')
    assert case.loop.observer.model.pump_gain.tolist() == [3.0, 3.0]
    assert case.loop.plant.pump_gain.tolist() != [3.0, 3.0]
    again = rig.loads(rig.dump(case))
    assert again.loop.observer.model.pump_gain.tolist() == [3.0, 3.0]
    own = rig.loads(file + '"controller.model.gravity" = 900.0\n"observer.model.gravity" = 950.0')
    assert float(own.loop.observer.model.gravity) == 950.0
    assert float(rig.loads(rig.dump(own)).loop.observer.model.gravity) == 950.0


@pytest.mark.slow_for("1e9")
@pytest.mark.parametrize("Ti", ["inf", "1e9"])
def test_of_several_loops_an_infinite_integral_time_counts_for_its_own(Ti):
    """The first tank a PI, the second a P controller with Kc e = -bias offset after saturation."""
    text = """
name = "a PI and a P"
units = ["m", "-"]
tank = [
    { area = 1.0, rim = 5.0, level = 0.5, inflow = -0.01 },
    { area = 1.0, rim = 5.0, level = 0.5, inflow = -0.01 },
]
pump = [{ gain = 0.02, to = 1, high = 1.0 }, { gain = 0.02, to = 2, high = 1.0 }]
plant = { gravity = 9.81 }
law = { kind = "pid", Kc = 10.0, Ti = [60.0, %s], Tt = 5.0, bias = 0.4 }
reference = { initial = [1.0, 1.0], changes = [] }
values = { "clock.dt" = 0.1, "clock.duration" = 1000.0 }
"""
    case = rig.loads(text % Ti)
    ends = np.asarray(jaxtank.simulate(case.loop, case.clock).x)[-1]
    # demand 0.5: the P controller rests where 0.4 + 10 (1 - h) = 0.5
    assert ends == pytest.approx([1.0, 0.99], abs=2e-5)


def test_the_gradient_is_right_where_inputs_saturate():
    """Saturated until the level is 0.95 m: of the closed form, by Kc away from the kink."""
    case = rig.loads(PROPORTIONAL)

    def ise(Kc):
        loop = with_values(case.loop, {"controller.Kc": Kc})
        return jaxtank.evaluate(loop, case.clock, ["ise"])["ise"][0]

    # Kc = 10.1 leaves saturation between two samples: no kink within the difference
    central = (ise(10.1001) - ise(10.0999)) / 2e-4
    assert float(jax.grad(ise)(10.1)) == pytest.approx(float(central), rel=1e-5)


def test_the_input_that_holds_a_setpoint_has_the_inflow_and_the_dead_zone():
    """At rest on it the input does not deviate; without the inflow it would by 4 V."""
    more = 'values = { "actuator.dead_zone" = 2.0, "actuator.dead_zone_kind" = "offset", '
    case = rig.loads(STREAM.replace("values = {", more).replace("[[50.0, 1, 22.0]]", "[]"))
    deviation = jaxtank.evaluate(case.loop, case.clock, ["input_deviation"])["input_deviation"]
    assert float(deviation[0]) == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize("inflow, follows", [(40.0, True), (0.0, False)])
def test_feasibility_counts_the_inflow_and_the_dead_zone(inflow, follows):
    """22 cm need 103.88 cm^3/s; of 9.9 V, 1 V in the dead zone, 89 are pumped."""
    more = 'values = { "actuator.dead_zone" = 1.0, "actuator.dead_zone_kind" = "offset", '
    text = STREAM.replace("values = {", more).replace("inflow = 40.0", f"inflow = {inflow}")
    text = text.replace("level = 20.0", "level = 10.0").replace("[20.0]", "[10.0]")
    case = rig.loads(text.replace("high = 12.0", "high = 9.9"))
    needs = Needs(case, {})
    assert needs.at()[0, -1] == pytest.approx([22.0, (drained(22.0) - inflow) / 10.0 + 1.0])
    assert needs.feasible().tolist() == [follows]


@pytest.mark.slow
@pytest.mark.parametrize(
    "change, reason",
    [
        (("rim = 60.0", "rim = 21.0"), "rim"),
        (("high = 12.0", "high = 6.2"), "limits"),
        (("inflow = 40.0", "inflow = 110.0"), "limits"),
    ],
)
def test_margins_name_the_limit_that_a_plateau_meets(change, reason, capsys, tmp_path):
    """At 22 cm the drain takes 103.88 cm^3/s: 6.39 V beside 40 cm^3/s."""
    path = tmp_path / "rig.toml"
    overflow = "reachable = false\nplant = { overflow = true }"
    path.write_text(overflow + STREAM.replace(*change))
    main(["simulate", str(path), "--margins", "--json"])
    printed = json.loads(capsys.readouterr().out)["margins"][-1]
    assert reason in json.dumps(printed) and "switch" not in json.dumps(printed)


def drained(level):
    """Flow out of the tank of STREAM [cm^3/s]."""
    return 0.5 * np.sqrt(2 * 981.0 * level)
