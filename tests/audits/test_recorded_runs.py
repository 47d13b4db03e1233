"""Trajectories and measures of the cases are as recorded: see recorded_runs.py."""

import json

import pytest
import recorded_runs

from jaxtank import presets

RECORD = json.loads(recorded_runs.FILE.read_text())
QUICK = ("cascaded/pi",)


def test_every_case_is_recorded():
    assert set(RECORD["cases"]) == set(presets.names())


def test_a_change_is_found():
    found = RECORD["cases"]["cascaded/pi"]
    moved = json.loads(json.dumps(found))
    moved["points"]["x"][3][0] *= 1.0 + 1e-9
    assert recorded_runs.differences("cascaded/pi", moved, found, exact=False) != []
    assert recorded_runs.differences("cascaded/pi", found | {"bits": ""}, found, exact=True) != []


@pytest.mark.parametrize(
    "name", [n if n in QUICK else pytest.param(n, marks=pytest.mark.slow) for n in presets.names()]
)
def test_a_case_runs_as_recorded(name):
    exact = RECORD["machine"] == recorded_runs.machine()
    assert (
        recorded_runs.differences(name, recorded_runs.run(name), RECORD["cases"][name], exact) == []
    )
