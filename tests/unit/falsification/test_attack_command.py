"""`jaxtank attack`: exit codes, JSON, and the files of the worst run."""

import json
from types import SimpleNamespace

import numpy as np
import pytest
from helpers import RIGS, command

import jaxtank
from jaxtank import presets
from tuning.report.falsification import _scope

CASE = [str(RIGS / "watertank.toml"), "--dt", "0.2", "--set", "reference.targets=[30.0]"]
SHORT = ["--set", "clock.duration=10"]
FEW = ["--starts", "1", "--iterations", "0", "--windows", "2", "--quiet"]


@pytest.fixture(scope="module")
def passing(tmp_path_factory):
    """(output of an attack whose limit is passed, its folder)."""
    folder = tmp_path_factory.mktemp("attack") / "out"
    words = ["--vary", "plant.drain=uniform:10%", "--set", "sensor.noise=[0.02]"]
    words += ["--constant-errors", "--set", "plant.rim=[31.0]"]
    return command("attack", *CASE, *words, *FEW, "--json", "--out", str(folder)), folder


def test_a_passed_limit_is_exit_code_4_and_the_json_has_the_worst_of_each_tank(passing):
    found, _ = passing
    assert found.code == 4 and found.json["passed"]
    (row,) = found.json["worst"]
    assert row["tank"] == 1 and row["limit"] == 31.0 and row["level"] > 31.0
    assert 0.0 < row["time_s"] <= 40.0 and row["rise_between_samples"] > 0.0
    assert {"plant.drain[0]", "x0[0]", "sensor.offset[0]"} == set(row["parameters"])
    assert abs(row["parameters"]["sensor.offset[0]"]) <= 0.12


@pytest.mark.extended
def test_the_rig_file_of_the_worst_run_gives_its_level_again(passing):
    found, folder = passing
    names = {p.name for p in folder.iterdir()}
    assert names >= {"result.json", "worst.toml", "trajectory.csv", "worst.png", "report.html"}
    level = found.json["worst"][0]["level"]
    again = command("simulate", str(folder / "worst.toml"), "--json", "--quiet")
    assert again.json["measures"]["max_level"] == [pytest.approx(level, rel=1e-9)]
    checked = json.loads((folder / "result.json").read_text())["rig"]
    assert checked["same"] and checked["missing"] == []
    rows = np.loadtxt(folder / "trajectory.csv", delimiter=",", skiprows=1)
    assert rows[:, 1].max() == pytest.approx(level, rel=1e-9)


@pytest.mark.slow
def test_a_limit_that_holds_is_exit_code_0_and_the_rig_file_keeps_the_filter(tmp_path):
    words = ["--safety-filter", "--set", "sensor.noise=[0.02]", "--constant-errors", *SHORT]
    found = command("attack", *CASE, *words, *FEW, "--out", str(tmp_path / "out"))
    assert found.code == 0 and "no limit was passed" in found.out
    assert "between two samples a level can rise by at most" in " ".join(found.out.split())
    assert "--set 'plant.drain[0]=" in found.out
    assert max(map(len, found.out.splitlines())) <= 80
    assert json.loads((tmp_path / "out/result.json").read_text())["rig"]["same"]


@pytest.mark.slow
def test_errors_that_change_in_time_are_named_where_the_rig_file_lacks_them(tmp_path):
    words = ["--safety-filter", "--set", "sensor.noise=[0.2]", "--draws", "4", "--starts", "1"]
    words += ["--iterations", "1", "--quiet", *SHORT, "--out", str(tmp_path / "out")]
    found = command("attack", *CASE, *words)
    assert found.code == 0
    checked = json.loads((tmp_path / "out/result.json").read_text())["rig"]
    assert not checked["same"] and "change from sample to sample" in checked["missing"][0]
    head = (tmp_path / "out/worst.toml").read_text().splitlines()[0]
    assert "it lacks reading errors that change" in head


def test_windows_begin_at_equal_distances_and_end_after_the_last_sample():
    """4 windows of a run of 400 s and its last sample of 5 s begin at 0, 101.25, .. s."""
    case = presets.find("cascaded/pi").replace(clock=jaxtank.Clock(dt=5.0, duration=400.0))
    shapes = {"varying": (3, 4)}
    attacked = {"windows": 4, "coefficients": [None] * 3, "start": "own", "pumps": "own"}
    attack = SimpleNamespace(attacked=SimpleNamespace(**attacked, shapes=shapes), case=case)
    assert "in each of 4 windows, which begin every 101.25 s" in _scope(attack)[0]
