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
    ],
)
def test_a_name_that_is_given_twice(refused, command, option, first, second, name):
    assert refused(command, CASE, option, first, option, second).startswith(
        f"jaxtank: {option} {name} is given 2 times: give it once"
    )


def test_a_name_twice_within_a_scenario(refused):
    line = refused("tune", CASE, "--scenario", "sensor.noise=0.1;sensor.noise=0.2")
    assert line == "jaxtank: --scenario sensor.noise is given 2 times: give it once"


def test_names_of_an_identification(refused):
    line = refused(*IDENTIFY, "--plan", "--free", "plant.area=1:2", "--free", "plant.area=1:3")
    assert line == "jaxtank: --free plant.area is given 2 times: give it once"


def options():
    """(command, option) of every option of every command that takes one value and is not made to be
    repeated.
    """
    top = parser.parser()
    (commands,) = (a for a in top._actions if isinstance(a, argparse._SubParsersAction))
    for command, one in commands.choices.items():
        for action in one._actions:
            if (
                action.option_strings
                and action.nargs is None
                and not isinstance(action, argparse._AppendAction)
            ):
                yield command, action.option_strings[0]


def test_every_option_that_is_not_made_to_be_repeated(refused):
    seen = list(options())
    assert {
        ("simulate", "--dt"),
        ("identify", "--duration"),
        ("bench", "--rounds"),
        ("tune", "--seed"),
    } <= set(seen)
    for command, option in seen:
        line = refused(command, "x", f"{option}=3", option, "4")
        assert line.startswith(f"jaxtank: {option} is given twice, the second time as ")


def test_one_thing_by_two_names(refused):
    assert (
        refused("simulate", CASE, "--dt", "1", "--set", "clock.dt=2")
        == "jaxtank: --dt 1 beside --set clock.dt=2: give one of them"
    )


def test_a_plan_has_no_log(refused):
    assert "leave it out to fit --data 'nope.csv'" in refused(
        *IDENTIFY, "--plan", "--data", "nope.csv"
    )
    assert "--plan writes no files" in refused(*IDENTIFY, "--plan", "--out", "here")


@pytest.mark.parametrize(
    ("option", "value"), [("--duration", "300"), ("--voltage", "3,3"), ("--measure", "h1")]
)
def test_a_log_has_no_plan(refused, option, value):
    line = refused(*IDENTIFY, "--data", "nope.csv", option, value)
    assert f"{option} " in line and "belongs to a planned experiment" in line
