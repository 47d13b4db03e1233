"""What an estimate contains besides inflows: dead zones, and the error of a linear model."""

import dataclasses

import jax
import numpy as np
import pytest

import jaxtank
from jaxtank import presets, rig
from jaxtank.core.tree import with_values
from jaxtank.loop.estimate_notes import linear_distance, withheld
from jaxtank.rig.components import model_of
from jaxtank.signals.base import Constant
from tuning.cli.main import main
from tuning.problem.controllers import with_kind

TWO = """
name = "two"
tank = [
    { area = 50.0, rim = 60.0, level = 8.0 },
    { area = 50.0, rim = 60.0, drain = 0.5, level = 8.0 },
]
orifice = [{ from = 1, to = 2, area = 0.5 }]
pump = [{ gain = 10.0, to = 1, high = 22.0 }]
plant = { outputs = [2] }
law = { kind = "pid", Kc = 0.2, Ti = 20.0, Tt = 10.0 }
reference = { initial = [8.0], changes = [[20.0, 1, 24.0]] }
values = { "clock.dt" = 0.1, "clock.duration" = 200.0 }

[observer]
kind = "kalman"
levels = [8.0, 8.0]
process = 1e-4
measurement = 1e-2
measured = [2]
"""


def flow(h):
    """Flow through 0.5 cm^2 [cm^3/s] at a level of h cm."""
    return 0.5 * np.sqrt(2 * 981.0 * h)


def test_the_estimate_is_the_inflow_less_what_the_dead_zones_withhold():
    """d = q/A - Kp z/A for an inflow q and an offset dead zone of z volts, Kp = 34.717."""
    case = presets.find("gouta2022/chadpc")
    loop = with_values(case.loop, {"x0": [8.0, 10.0], "actuator.initial": [4.0, 9.0]})
    loop = dataclasses.replace(
        loop,
        reference=Constant(level=np.array([8.0, 10.0])),
        disturbance=Constant(level=np.array([15.0, 0.0])),
    )
    clock = dataclasses.replace(case.clock, duration=10.0)
    estimate = np.asarray(jaxtank.simulate(loop, clock).d_hat)[-1]
    zones = -34.717 * np.array([2.7538, 4.3248]) / 225.0
    np.testing.assert_allclose(withheld(loop), zones, rtol=1e-12)
    np.testing.assert_allclose(estimate, zones + [15.0 / 225.0, 0.0], atol=1e-3)


@pytest.mark.slow
def test_the_command_says_that_the_estimate_contains_the_dead_zones(capsys):
    short = ["--set", "clock.duration=5"]
    assert main(["simulate", "gouta2022/chadpc", *short]) == 0
    assert "-0.425, -0.667 cm/s" in capsys.readouterr().err


def test_the_distance_of_a_linear_filter_is_that_of_its_square_root():
    observer = rig.loads(TWO).loop.observer
    u = flow(8.0) / 10.0
    distance, error, _ = linear_distance(observer, [[24.0, 8.0], [8.0, 8.0]], [[u], [u]])
    slope = flow(8.0) / 16.0
    lacking = (flow(8.0) + slope * 16.0 - flow(24.0)) / 50.0
    np.testing.assert_allclose(distance, [[16.0, 0.0], [0.0, 0.0]])
    np.testing.assert_allclose(error, [[lacking, lacking], [0.0, 0.0]], atol=1e-12)


@pytest.mark.slow
def test_a_linear_filter_far_from_its_operating_point_is_named(capsys, tmp_path):
    path = tmp_path / "two.toml"
    path.write_text(TWO)
    case = rig.load(path)
    run = jaxtank.simulate(case.loop, case.clock)
    far = np.abs(np.asarray(run.x) - 8.0).max()
    assert main(["simulate", str(path)]) == 0
    assert f"up to {far:.3g} cm from the operating level 8 cm" in capsys.readouterr().err
    assert main(["show", str(path)]) == 0
    at_rest = (2.0 * flow(8.0) - flow(24.0)) / 50.0
    printed = " ".join(capsys.readouterr().out.split())
    assert "up to 16 cm from the operating level 8 cm" in printed
    assert f"wrong by up to {at_rest:.3g} cm/s in the rate of tank 1" in printed
    path.write_text(TWO.replace("1, 24.0]", "1, 8.5]"))
    for command in ("simulate", "show"):
        assert main([command, str(path)]) == 0
        printed = capsys.readouterr()
        assert "observer.levels:" not in printed.err + printed.out


@pytest.mark.slow
def test_an_observer_of_a_file_compensates_as_one_of_the_preset_does():
    """Coefficients of the plant 10 % off the model of the controller, at the end of a plateau."""
    plant = presets.find("gouta2015/ngpc").loop.plant
    values = {
        "drain": 1.1 * np.asarray(plant.drain),
        "pump_gain": 0.9 * np.asarray(plant.pump_gain),
    }
    wrong = "".join(f'"controller.model.{n}" = {v.tolist()}\n' for n, v in values.items())
    text = 'case = "gouta2015/ngpc"\n{}[values]\n"clock.dt" = 0.1\n"clock.duration" = 200.0\n'
    errors = []
    for observer in ("", '[observer]\nkind = "disturbance"\nl = 0.5\n'):
        loaded = rig.loads(text.format(observer) + wrong)
        run = jaxtank.simulate(loaded.loop, loaded.clock, save_every=100)
        errors.append(np.abs(np.asarray(run.e)[-1]).max())
    assert errors[0] > 0.1 and errors[1] < 1e-3


@pytest.mark.slow_for("cascaded/pi-state-feedback")
@pytest.mark.parametrize(
    "name, kind", [("cascaded/pi", "state-feedback"), ("gouta2022/enmpc", "pid")]
)
def test_another_controller_takes_the_model_of_the_one_it_replaces(name, kind):
    """Gains computed from the model, and gains published by the paper."""
    case = presets.find(name)
    gains = 0.9 * np.asarray(case.loop.controller.model.pump_gain)
    case = with_kind(rig.set_values(case, {"controller.model.pump_gain": gains}), kind)
    assert model_of(case.loop).pump_gain.tolist() == gains.tolist()


def test_a_controller_of_a_file_takes_the_model_of_its_preset():
    law = '[controller]\nkind = "pid"\nKc = 4.0\nTi = 6.0\nTt = 36.0\nfeed_forward = true\n'
    case = rig.loads('case = "gouta2022/enmpc-fitted"\n' + law)
    theirs = presets.find("gouta2022/enmpc-fitted").loop
    assert float(case.loop.controller.model.drain[0]) == float(theirs.controller.model.drain[0])
    assert float(case.loop.controller.model.drain[0]) != float(theirs.plant.drain[0])
    again = rig.loads(rig.dump(case))
    assert jax.tree.all(
        jax.tree.map(np.array_equal, again.loop.controller.model, case.loop.controller.model)
    )
