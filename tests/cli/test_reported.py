"""Words of the commands that are true of some rigs only: of those without limits, without spread,
with one tank.
"""

import numpy as np
import pytest
from helpers import RIGS

import tuning
from jaxtank import presets, rig
from tuning.cli import main
from tuning.problem import reported
from tuning.search.result import ConstraintRow

ONE_TANK = str(RIGS / "watertank.toml")


@pytest.mark.slow
def test_the_advice_is_taken(capsys):
    assert main.main(["sensitivity", ONE_TANK, "--vary", "plant.drain=uniform:10%", "--quiet"]) == 0


@pytest.mark.slow
def test_without_limits_nothing_is_reported_to_hold():
    case = rig.load(ONE_TANK).replace(uncertain={"plant.drain": 0.1})
    quick = tuning.Options(starts=1, screening=1, iterations=1, validation=2)
    result = tuning.tune(case, quick, limits={})
    page = " ".join(repr(result).split())
    assert "validation runs" in page and "all limits held" not in page
    assert "rims are limits" not in page and "a level above its rim is not reported" in page
    limit = {"limit": 1.0, "value": 0.5, "margin": 0.5}
    row = ConstraintRow(name="rim", measure="max_level", unit="m", **limit)
    limited = result.replace(constraints=[row])
    page = " ".join(repr(limited).split())
    assert "rims are limits only" in page and "limits hold on 2 of 2" in page
    filtered = repr(limited.replace(tuned=case.with_safety_filter()))
    assert "a safety filter limits the pump inputs" in filtered


def test_one_tank_is_one_tank(capsys):
    assert main.main(["show", ONE_TANK]) == 0
    assert "The rig: 1 tank, 1 pump; " in capsys.readouterr().out
    assert main.main(["show", "cascaded/pi"]) == 0
    assert "The rig: 2 tanks, 1 pump; " in capsys.readouterr().out


@pytest.mark.slow
def test_a_moving_picture_of_an_earlier_run_does_not_stay(tmp_path):
    words = ["simulate", ONE_TANK, "--set", "clock.duration=4", "--out", str(tmp_path), "--quiet"]
    foreign = tmp_path / "other"
    foreign.mkdir()
    (foreign / "run.gif").write_bytes(b"GIF89a")
    assert main.main([*words, "--gif"]) == 0 and (tmp_path / "run.gif").exists()
    assert main.main([*words, "--set", "controller.Kc=3"]) == 0
    assert not (tmp_path / "run.gif").exists() and (tmp_path / "trajectory.csv").exists()
    assert main.main([*words[:-2], str(foreign), "--quiet"]) == 0
    assert (foreign / "run.gif").exists()  # no run of this program lay there


@pytest.mark.extended
def test_simulate_says_that_inputs_chatter(capsys):
    assert main.main(["simulate", "mirakhorli/smc-printed"]) == 0
    assert "the input of pump 1 chatters: it changes by 100 %" in capsys.readouterr().err
    assert main.main(["simulate", "mirakhorli/smc"]) == 0
    assert "chatters" not in capsys.readouterr().err


def test_an_open_loop_does_not_chatter_whatever_it_plays():
    case = presets.find("mirakhorli/smc-printed")
    busy = {"input_travel": np.array([1e6, 1e6])}
    (sentence,) = reported.chatter(case.loop, case.clock, busy)
    assert "chatters" in sentence and "dead_zone" not in sentence
    zones = rig.set_values(case, {"actuator.dead_zone": [1.0, 1.0]})
    assert "below its dead_zone, 1 V" in reported.chatter(zones.loop, zones.clock, busy)[0]
    case = presets.find("cascaded/open-loop")
    assert reported.chatter(case.loop, case.clock, {"input_travel": np.array([1e6])}) == []
