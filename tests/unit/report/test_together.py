"""Several cases on one page: under the conditions of the first, and only where they fit."""

import csv
import dataclasses
import json

import numpy as np
import pytest
from helpers import command

import jaxtank
from jaxtank import presets, rig
from jaxtank.core.tree import with_values
from tuning.report.document import terminal
from tuning.report.together import report, run_together

SHORT = ["--set", "clock.duration=40", "--dt", "0.2"]
PAIR = ["gouta2022/pi", "gouta2022/pid"]


@pytest.mark.slow
def test_each_run_is_that_of_its_case_alone(tmp_path):
    """The same disturbances and the same noise, as both cases have them; numbers and trajectory."""
    noise = ["--set", "sensor.noise=0.05", "--seed", "3"]
    both = command("simulate", *PAIR, *SHORT, *noise, "--json", "--out", str(tmp_path), "--quiet")
    assert both.code == 0, both.err
    rows = json.loads(both.out)["cases"]
    assert [row["case"] for row in rows] == PAIR and all(row["differs"] == [] for row in rows)
    for name, row in zip(PAIR, rows):
        alone = command("simulate", name, *SHORT, *noise, "--json", "--quiet")
        one = json.loads(alone.out)
        assert {key: one[key] for key in ("measures", "units", "clock", "parameters")} == {
            key: row[key] for key in ("measures", "units", "clock", "parameters")
        }
        with open(tmp_path / f"{name.replace('/', '-')}.csv") as file:
            head, *numbers = csv.reader(file)
        levels = np.array(numbers, dtype=float)[:, head.index("h1 [cm]")]
        assert levels.max() == pytest.approx(one["measures"]["max_level"][0], abs=1e-3)
    files = {path.name for path in tmp_path.iterdir()}
    assert {"result.json", "report.html", "responses.png"} < files
    page = (tmp_path / "report.html").read_text()
    assert all(name in page for name in PAIR)
    assert json.loads((tmp_path / "result.json").read_text()) == json.loads(both.out)


@pytest.mark.slow
def test_all_have_the_disturbances_of_the_first_and_what_differs_is_said():
    short = {"clock.duration": 40.0, "clock.dt": 0.2}
    first, other = (rig.set_values(presets.find(name), short) for name in PAIR)
    still = dataclasses.replace(other.loop, disturbance=None)
    still = with_values(still, {"plant.drain": 1.1 * np.asarray(still.plant.drain)})
    runs = run_together([first, other.replace(loop=still)])
    wanted = dataclasses.replace(still, disturbance=first.loop.disturbance)
    found = jaxtank.evaluate(wanted, other.clock, ["rms_error"])["rms_error"]
    np.testing.assert_array_equal(runs[1].measures["rms_error"], found)
    words = ("plant", "disturbances (those of gouta2022/pi are used)")
    assert runs[0].differs == () and runs[1].differs == words
    text = terminal(report(runs))
    assert f"gouta2022/pid has its own {words[0]}, {words[1]}" in text
