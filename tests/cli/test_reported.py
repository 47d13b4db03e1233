"""Words of the commands that are true of some rigs only: of those without limits, without spread,
with one tank.
"""

from pathlib import Path

import pytest
from helpers import RIGS

import tuning
from jaxtank import rig
from tuning.cli import main

ONE_TANK = str(RIGS / "watertank.toml")
QUICK = {"starts": 1, "screening": 1, "iterations": 1, "validation": 2}


@pytest.mark.parametrize(
    "words",
    [["uncertainty", "--samples", "2"], ["sensitivity"], ["uncertainty", "--spread", "0.1"]],
)
def test_a_rig_with_nothing_uncertain_is_answered_with_how_to_vary(words, capsys):
    assert main.main([words[0], ONE_TANK, *words[1:]]) == 2
    reported = capsys.readouterr().err
    assert reported.count("\n") == 1 and "--vary NAME=" in reported and "[uncertain]" in reported


def test_the_advice_is_taken(tmp_path, capsys):
    """Both ways that the refusal names."""
    assert main.main(["sensitivity", ONE_TANK, "--vary", "plant.drain=uniform:10%", "--quiet"]) == 0
    file = tmp_path / "rig.toml"
    file.write_text(Path(ONE_TANK).read_text() + '\n[uncertain]\n"plant.drain" = 0.1\n')
    assert main.main(["sensitivity", str(file), "--quiet"]) == 0


LEVELS = {
    "none": ({"nominal": True, "limits": {}}, ("a level above its rim is not reported",)),
    "rims": (
        {"nominal": True, "limits": {"max_level": "rim"}},
        ("all limits held", "rims are limits only"),
    ),
    "filter": ({}, ("a safety filter caps the pumps",)),
}


@pytest.mark.slow_for("rims", "filter")
@pytest.mark.parametrize("kind", LEVELS)
def test_without_limits_nothing_is_reported_to_hold(kind):
    case = rig.load(ONE_TANK).replace(uncertain={"plant.drain": 0.1})
    if kind == "filter":  # the rims are left to it
        case = case.replace(limits={"max_level": "rim"}).with_safety_filter()
    options, words = LEVELS[kind]
    page = repr(tuning.tune(case, **options, **QUICK))
    assert all(word in page for word in words)
    assert ("is not reported" in page) == (kind == "none") != ("all limits held" in page) or (
        kind == "filter"
    )


def test_one_tank_is_one_tank(capsys):
    assert main.main(["show", ONE_TANK]) == 0
    assert "The rig: 1 tank, 1 pump; " in capsys.readouterr().out


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
