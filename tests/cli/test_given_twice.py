"""What is said twice on a command line, or beside what it contradicts: one line that names it,
before anything is run.
"""

import argparse

import pytest

from tuning.cli import main, parser

CASE = "cascaded/pi"
IDENTIFY = ("identify", "mirakhorli/sfc")


@pytest.fixture
def refused(tmp_path, monkeypatch, capsys):
    """refused(words) -> the one line on stderr."""

    def run(*words):
        monkeypatch.chdir(tmp_path)
        code = main.main(list(words))
        printed = capsys.readouterr()
        (line,) = printed.err.splitlines()
        assert code == 2 and printed.out == "" and list(tmp_path.iterdir()) == []
        return line

    return run


@pytest.mark.parametrize(
    ("command", "option", "first", "second", "name"),
    [
        ("simulate", "--set", "controller.Kc=1", "controller.Kc=9", "controller.Kc"),
        ("simulate", "--set", "plant.area[0]=1", " plant.area[0] =1", "plant.area[0]"),
        ("simulate", "--schedule", "controller.Kc=r1:1,2", "controller.Kc=r1:1,2", "controller.Kc"),
        ("tune", "--free", "controller.Kc=1:2", "controller.Kc=1:3", "controller.Kc"),
        ("tune", "--limit", "max_level=9", "max_level=8", "max_level"),
        ("tune", "--objective", "ise=1", "ise=2", "ise"),
        ("tune", "--choose", "clock.substeps=1,2", "clock.substeps=4", "clock.substeps"),
        ("identify", "--free", "plant.area=1:2", "plant.area=1:3", "plant.area"),
        ("uncertainty", "--vary", "plant.area=uniform:5%", "plant.area=uniform:9%", "plant.area"),
    ],
)
def test_a_name_that_is_given_twice(refused, command, option, first, second, name):
    line = refused(command, CASE, option, first, option, second)
    assert line == f"jaxtank: {option} {name} is given twice: give it once"


def test_a_name_twice_within_a_scenario(refused):
    line = refused("tune", CASE, "--scenario", "sensor.noise=0.1;sensor.noise=0.2")
    assert line == "jaxtank: --scenario sensor.noise is given twice: give it once"


def test_every_option_is_made_to_be_repeated_or_refuses_it(refused):
    assert refused("bench", "--rounds", "3", "--rounds", "4") == (
        "jaxtank: --rounds is given twice: give it once"
    )
    top = parser.parser()
    for command in parser.COMMANDS:
        for action in top.options(command).values():
            kinds = (parser.Once, parser.Pairs, argparse._AppendAction)
            assert action.nargs == 0 or isinstance(action, kinds)


def test_one_thing_by_two_names(refused):
    assert (
        refused("simulate", CASE, "--dt", "1", "--set", "clock.dt=2")
        == "jaxtank: --dt 1 beside --set clock.dt=2: give one of them"
    )


def test_a_plan_has_no_log(refused):
    line = refused(*IDENTIFY, "--plan", "--data", "nope.csv", "--out", "folder")
    assert "leave it out to fit --data 'nope.csv'" in line and "--plan writes no files" in line


@pytest.mark.parametrize(
    ("option", "value"), [("--duration", "300"), ("--voltage", "3,3"), ("--measure", "h1")]
)
def test_a_log_has_no_plan(refused, option, value):
    line = refused(*IDENTIFY, "--data", "nope.csv", option, value)
    assert f"{option} " in line and "belongs to a planned experiment" in line
