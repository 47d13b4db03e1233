"""The bottom of a tank: a level stops at 0 where liquid can be drawn out, or it is reported."""

import dataclasses
import warnings

import jax
import numpy as np
import pytest

import jaxtank
import tuning
from jaxtank import component, leaf, presets, rig
from jaxtank.loop import tank_bottom
from jaxtank.plants import Plant, TankNetwork
from tuning.cli.main import main

DRY = """
name = "outflow pump"
units = ["m", "-"]
tank = [{ area = 1.0, rim = 5.0, level = 1.0 }]
pump = [{ gain = 0.05, to = 1, low = -1.0, high = 0.0, initial = 0.0 }]
plant = { gravity = 9.81 }
law = { kind = "pid", Kc = 5.0, Ti = 20.0, Tt = 5.0 }
reference = { initial = [0.5], changes = [[100.0, 1, 0.0]], ramp = 0.0 }
values = { "clock.dt" = 0.1, "clock.duration" = 300.0 }
uncertain = { "plant.pump_gain" = 0.1 }
"""
"""Ribasim issues 1771 and 428: a pump takes liquid out of a basin that has 1 m^3 of it."""
OPEN = DRY.replace("gravity = 9.81", "gravity = 9.81, bottom = false")

QUIET = """
units = ["m", "-"]
tank = [{ area = 1.0, rim = 5.0, level = 1.0, drain = 0.01 }]
pump = [{ gain = 0.05, to = 1, high = 1.0 }]
plant = { gravity = 9.81 }
law = { kind = "open-loop" }
"""
DRAWN = {  # every way in which a rig file can draw liquid out of a tank
    "inflow of a tank": QUIET.replace("drain = 0.01", "drain = 0.01, inflow = -0.02"),
    "disturbance": QUIET + "disturbance = { inflow = [-0.02] }",
    "pour": QUIET + "inflow = [{ time = 1.0, duration = 1.0, tank = 1, volume = -5.0 }]",
    "pump": QUIET.replace("high = 1.0", "low = -1.0, high = 1.0"),
    "initial": QUIET.replace("high = 1.0", "high = 1.0, initial = -1.0"),
    "actuator": QUIET + 'actuator = { kind = "pumps", low = [-1.0] }',
    "values": QUIET + 'values = { "actuator.low" = [-1.0] }',
    "scenario": QUIET + 'scenario = [{ values = { "actuator.low" = [-1.0] } }]',
    "preset": 'case = "gouta2015/ngpc"\nvalues = { "actuator.low" = -1.0 }',
}


@pytest.mark.parametrize("way", DRAWN)
def test_a_rig_file_that_can_draw_liquid_has_a_tank_bottom(way):
    case = rig.loads(DRAWN[way])
    assert case.loop.plant.bottom
    again = rig.loads(rig.dump(case)).loop
    assert again.plant.bottom
    model = getattr(again.controller, "model", None)
    assert model is None or model.bottom  # a controller knows the plant as it is


def test_a_bottom_that_is_left_out_on_purpose_stays_out():
    assert not rig.loads(QUIET).loop.plant.bottom  # nothing can be drawn
    assert not rig.loads(OPEN).loop.plant.bottom
    assert not rig.loads(rig.dump(rig.loads(OPEN))).loop.plant.bottom


def test_presets_that_cannot_draw_keep_their_bits():
    """Presets whose disturbance draws have a bottom of their own: none is changed."""
    for paper in presets.PAPERS:
        for case in presets.load(paper).cases.values():
            assert rig.with_bottom(case) is case


@pytest.mark.slow
def test_no_pump_takes_more_than_a_tank_holds(tmp_path, capsys):
    (tmp_path / "dry.toml").write_text(DRY)
    assert main(["simulate", str(tmp_path / "dry.toml"), "--out", str(tmp_path / "out")]) == 0
    assert "falls below" not in capsys.readouterr().err
    case = rig.loads(DRY)
    run = jaxtank.simulate(case.loop, case.clock)
    missing = jaxtank.evaluate(case.loop, case.clock, ["inflow_shortfall"])["inflow_shortfall"]
    taken = -0.05 * 0.1 * float(np.asarray(run.u)[:-1].sum()) - float(missing[0])
    assert np.asarray(run.x).min() >= 0.0 and taken <= 1.0 + 1e-12
    np.testing.assert_allclose(1.0 - taken, np.asarray(run.x)[-1, 0], atol=1e-12)


def test_the_command_line_brings_a_bottom_too(tmp_path, capsys):
    (tmp_path / "quiet.toml").write_text(QUIET)
    words = ["simulate", str(tmp_path / "quiet.toml"), "--set", "actuator.low=-1"]
    draw = ["--set", "controller.signal.initial=-1", "--set", "clock.duration=60", "--dt", "0.1"]
    assert main([*words, *draw, "--json"]) == 0
    found = capsys.readouterr()
    assert '"min_level": [\n      0.0' in found.out and "falls below" not in found.err
    assert main([*words, *draw, "--set", "plant.bottom=false"]) == 0
    note = capsys.readouterr().err
    # 0.05 m^3/s leave by the pump, and what is above 0 by the drain as well
    assert "note: plant.bottom = false, and liquid can be drawn out" in note
    assert "note: the level of tank 1 falls below 0 at t = " in note
    assert "plant.bottom = true" in note


@pytest.mark.slow
def test_draws_below_an_empty_tank_break_a_limit():
    found = tuning.ensemble(rig.loads(OPEN), samples=4)
    rows = {row["name"]: row for row in found.violations()}
    assert rows["min_level of tank 1"]["count"] == 4
    assert "broken in 4" not in str(rows) and rows["max_level of tank 1"]["count"] == 0
    kept = tuning.ensemble(rig.loads(DRY), samples=4)
    assert [row["count"] for row in kept.violations()] == [0]


@component
class Leaky(Plant):
    """A user's plant that takes no care of its bottom: 0.01 m/s leave whatever it holds."""

    units = ("m", "-")
    outputs = (0,)
    tanks = pumps = 1
    rim: jax.Array = leaf("cm", "height", shape=("tank",))
    area: jax.Array = leaf("cm^2", "area", shape=("tank",))

    def derivative(self, t, x, u, d):
        return (0.1 * u[0] - 0.01,)


def test_a_plant_of_a_user_says_when_it_is_below_its_bottom():
    loop = rig.loads(QUIET).loop
    loop = dataclasses.replace(
        loop, plant=Leaky(rim=[5.0], area=[2.0]), sensor=loop.sensor, x0=np.array([1.0])
    )
    assert tank_bottom.is_open(loop) and not isinstance(loop.plant, TankNetwork)
    with pytest.warns(
        tank_bottom.TankBottomWarning,
        match=r"tank 1 falls below 0 at t = 101 s and reaches -1 m at t = 200 s, 2 m\^3",
    ):
        jaxtank.simulate(loop, jaxtank.Clock(dt=1.0, duration=200.0))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        jaxtank.simulate(loop, jaxtank.Clock(dt=1.0, duration=90.0))
