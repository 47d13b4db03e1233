"""The rig's own names of tanks and pumps stand wherever a person reads or writes."""

import json
import re

import numpy as np
import pytest
from helpers import no_live_page

from jaxtank import rig
from jaxtank.core.labels import label_of, labels_of
from jaxtank.limits import resolve_limits
from jaxtank.plots import responses
from tuning import read_log
from tuning.cli import main

RIG = """
units = ["m", "%"]
tank = [
    {{ {}area = 0.5, rim = 1.2, drain = 4e-4, level = 0.4 }},
    {{ {}area = 0.25, rim = 1.0, drain = 4.15e-4, level = 0.3 }},
]
orifice = [{{ from = 1, to = 2, area = 3.2e-4 }}]
pump = [{{ {}gain = 2.6e-5, to = 1, high = 100.0 }}]
controller = {{ kind = "pid", Kc = 50.0, Ti = 300.0 }}
reference = {{ initial = [0.4], changes = [[5.0, 1, 0.45]] }}
values = {{ clock.duration = 40.0 }}
"""
NAMED = RIG.format(*(f'name = "{name}", ' for name in ("LT101", "LT102", "P101")))
PLAIN = RIG.format("", "", "")


def test_a_label_is_a_name_or_a_number_from_1():
    named, plain = (rig.loads(text).loop.plant for text in (NAMED, PLAIN))
    assert [label_of(named, *of) for of in (("tank", 1), ("pump", 0), ("output", 0))] == [
        "LT102",
        "P101",
        "LT101",
    ]
    assert labels_of(named, "tank", [0, 1]) == "LT101, LT102"
    assert labels_of(plain, "tank", [0, 1]) == "tanks 1, 2"
    assert label_of(plain, "pump", 0) == ("pump 1")
    assert [limit.label for limit in resolve_limits(rig.loads(NAMED))] == [
        "max_level of LT101",
        "max_level of LT102",
    ]


def test_names_change_no_number():
    runs = [responses_of(text) for text in (NAMED, PLAIN)]
    np.testing.assert_array_equal(*(np.asarray(run.x) for _, run in runs))


def responses_of(text):
    from jaxtank import simulate

    case = rig.loads(text)
    return case, simulate(case.loop, case.clock)


@pytest.mark.parametrize(("text", "titles"), [(NAMED, "LT101 P101 LT102"), (PLAIN, "")])
def test_panels_of_responses_have_the_names(text, titles):
    case, run = responses_of(text)
    figure = responses.responses(case.loop, {"run": run})
    words = " ".join(ax.get_title() for ax in figure.axes)
    for title in titles.split() or ["tank 1", "pump 1", "tank 2"]:
        assert title in words


def simulated(tmp_path, text, *options):
    file = tmp_path / "rig.toml"
    file.write_text(text)
    return main.main(["simulate", str(file), *options])


def test_a_run_is_printed_with_names_and_its_columns_are_read_again(tmp_path, capsys):
    with no_live_page():
        assert simulated(tmp_path, NAMED, "--out", str(tmp_path / "out")) == 0
    out = capsys.readouterr().out
    assert re.search(r"highest level \[m\] +LT101 0\.\d+ +LT102 0\.\d+", out)
    header = (tmp_path / "out" / "trajectory.csv").read_text().partition("\n")[0].split(",")
    assert header[:3] == ["t [s]", "h_LT101 [m]", "h_LT102 [m]"] and "u_P101 [%]" in header
    named = read_log(tmp_path / "out" / "trajectory.csv", rig.loads(NAMED).loop)
    assert named.tanks == (0, 1) and named.u.shape[1] == 1
    with no_live_page():
        assert simulated(tmp_path, PLAIN, "--out", str(tmp_path / "plain")) == 0
    assert re.search(r"highest level \[m\] +tank 1 0\.\d+ +tank 2 0\.\d+", capsys.readouterr().out)
    header = (tmp_path / "plain" / "trajectory.csv").read_text().partition("\n")[0].split(",")
    assert header[:3] == ["t [s]", "h1 [m]", "h2 [m]"]


LIMITS = [
    (["--limit", "max_level.LT102=0.8"], [1.2, 0.8]),
    (["--limit", "max_level[LT102]=80 cm"], [1.2, 0.8]),
    (["--limit", "max_level.2=0.8"], [1.2, 0.8]),
    (["--limit", "max_level=90%"], [1.08, 0.9]),
    (["--limit", "max_level=90%", "--limit", "max_level.LT101=1 m"], [1.0, 0.9]),
    (["--limit", "none", "--limit", "max_level.LT101=1"], [1.0, np.inf]),
]


@pytest.mark.parametrize(("options", "expected"), LIMITS)
def test_limits_by_name_and_in_percent_of_the_rim(options, expected):
    from tuning.cli.parser import arguments
    from tuning.cli.steps import limits_of

    limits = limits_of(arguments(["uncertainty", "rig.toml", *options]), rig.loads(NAMED))
    assert limits["max_level"] == pytest.approx(expected)
    case = rig.loads(NAMED).replace(limits=limits)
    assert [limit.value for limit in resolve_limits(case)] == pytest.approx(
        [value for value in expected if np.isfinite(value)]
    )


@pytest.mark.extended
def test_a_setpoint_of_an_output_by_name_and_a_note_by_name(tmp_path, capsys):
    text = NAMED.replace("[5.0, 1, 0.45]", '["0.1 min", "LT101", "45 cm"]')
    assert rig.loads(text).loop.reference.changes == ((6.0, 0),)
    assert simulated(tmp_path, text, "--set", "LT102.level=1.1", "--json") == 0
    out, err = capsys.readouterr()
    assert "LT102 starts at 1.1 m" in err and "tank 2" not in err
    assert json.loads(out)["parameters"]["x0"] == [0.4, 1.1]
