"""When a result may claim success, and what it says when it may not."""

import json

import numpy as np
import pytest

import tuning
from jaxtank import presets, rig
from tuning import cli
from tuning.objective import Limit, Point, resolve_limits, room_of
from tuning.solvers import Search, downhill, slsqp


class Valley:
    """|z1 - 0.6| + slope * (z2 - 0.3)^2 under z2 >= floor: a kink along z1 = 0.6, where the slope never vanishes."""

    limits = (Limit("min_level", 0, 1.0),)
    rooms = np.ones(1)
    bounds, model = (), None

    def __init__(self, floor=0.0):
        self.floor = floor

    def point(self, z):
        side = 1.0 if z[0] >= 0.6 else -1.0
        cost, g = abs(z[0] - 0.6) + (z[1] - 0.3) ** 2 + 1.0, np.array([side, 2 * (z[1] - 0.3)])
        return Point(z, cost, g, np.eye(2), np.array([z[1] - self.floor]), np.array([[0.0, 1.0]]), {})


def looked_at(valley, z):
    search = Search(valley, valley.point(np.array([0.1, 0.9])), lambda s: None)
    return downhill(search, search.point(np.array(z)))


def test_a_kink_is_told_from_a_slope_that_goes_on():
    assert looked_at(Valley(), (0.6, 0.3)) is None  # its slope is 1, and nothing is lower
    assert looked_at(Valley(), (0.8, 0.3)).cost < 1.2 * (1 - 1e-4)
    assert looked_at(Valley(0.5), (0.6, 0.5)) is None  # held up by the limit and the kink together
    assert looked_at(Valley(0.5), (0.4, 0.5)).margins[0] >= 0.0


def test_slsqp_on_the_kink_is_no_false_success():
    search = Search(Valley(), Valley().point(np.array([0.1, 0.9])), lambda s: None)
    slsqp(search, np.array([0.1, 0.9]), 60)
    assert search.best.cost < 1.0 + 1e-3


@pytest.mark.parametrize("name", ["calofir/backstepping", "cascaded/pi", "gouta2015/backstepping", "khalid/gpc"])
def test_room_of_a_limit_is_of_its_own_size_in_any_unit(name):
    """A back-off of 1e-6 of it must leave room below the limit, which in cubic metres is 1e-8."""
    case = presets.find(name)
    for limits in (None, {"max_level": "rim", "input_travel": 1e-4, "saturated_fraction": 0.0}):
        for limit in resolve_limits(case, limits):
            room = room_of(limit, case.loop)
            assert room > 0 and (limit.value == 0 or 1e-6 * room < 1e-2 * abs(limit.value))


@pytest.mark.slow
def test_a_limit_in_cubic_metres_is_met_where_it_is_tight():
    """Found by a grid of 40 by 40: 0.00597149 m at K = (0.0523, 0.0212) 1/s; a search that scaled the limit by 1 m^3/s ended at 0.00598032."""
    case = presets.find("calofir/backstepping")
    result = tuning.tune(case, limits={"max_level": "rim", "input_travel": 1e-3}, starts=2, screening=16, validation=0)
    assert result.success and result.objective["after"] < 0.0059715
    travel = next(c for c in result.constraints if c["measure"] == "input_travel")
    assert 0 <= travel["margin"] < 1e-3 * travel["limit"] and "tight: input_travel" in result.message


@pytest.fixture(scope="module")
def quick():
    case = presets.find("gouta2015/backstepping")
    return rig.set_values(case, {"clock.dt": 0.5})


@pytest.mark.slow
def test_a_search_cut_short_does_not_say_that_limits_cannot_be_met(quick):
    """The same limit is met with the usual number of iterations."""
    hard = {"max_level": 30.0}
    short = tuning.tune(quick, limits=hard, starts=1, screening=1, iterations=1, validation=0)
    assert short.status == "not_converged" and "before the search ended" in short.message
    assert not all(c["margin"] >= 0 for c in short.constraints)


def test_what_is_missed_is_told_in_full_and_is_the_least_by_one_measure(quick):
    impossible = {"max_level": 20.0, "input_travel": 1.0}
    result = tuning.tune(quick, limits=impossible, starts=1, screening=4, validation=0)
    assert result.status == "infeasible"
    missed = [c for c in result.constraints if c["margin"] < 0]
    assert len(missed) > 1 and all(c["name"] in result.message for c in missed[:4])
    share = max(-c["margin"] / c["limit"] for c in missed)
    start = tuning.Problem(quick, limits=impossible)
    _, margins = start.screen(np.array([start.start()]))
    before = max(-margins[0] / start.rooms)
    assert share <= before * (1 + 1e-9)


@pytest.mark.slow
def test_a_staircase_is_not_called_an_optimum(quick):
    result = tuning.tune(quick, objective={"settling_time": 1.0}, limits={}, starts=1, screening=4, validation=0)
    assert result.status == "not_converged" and "changes in steps" in result.message


@pytest.mark.parametrize(
    "words",
    [
        ["--limit", "max_level=28", "--limit", "max_level=33"],
        ["--free", "controller.k=0.1:1", "--free", "controller.k=0.1:2"],
        ["--objective", "iae=1", "--objective", "iae=2"],
        ["--resume", ""],
    ],
)
def test_what_is_given_twice_or_empty_is_refused(words, capsys):
    assert cli.main(["tune", "gouta2015/backstepping", *words]) == 2
    told = capsys.readouterr().err
    assert told.count("\n") == 1 and words[0] in told


@pytest.mark.slow
def test_a_lowest_level_is_told_with_its_time(quick):
    result = tuning.tune(quick, limits={"min_level": 0.2}, starts=1, screening=1, iterations=2, validation=0)
    assert all(0 <= c["time_s"] <= 1200 for c in result.constraints)


@pytest.mark.slow
def test_a_search_over_choices_is_resumed(tmp_path, capsys):
    """Killed after its first combination: the same answer, and no log is left."""
    words = ["--choose", "controller.pairing=cross,same", "--free", "controller.b=0.5:3", "--scenario", "none", "--dt", "0.5"]
    words += ["--starts", "1", "--screening", "2", "--iterations", "3", "--validation", "0", "--quiet", "--json"]
    whole, halted = tmp_path / "whole", tmp_path / "halted"
    cli.main(["tune", "mirakhorli/hybrid", *words, "--out", str(whole)])
    first = json.loads(capsys.readouterr().out)
    seen = []

    def stop(event):
        seen.append(event)
        if len(seen) == 7:
            raise RuntimeError("killed")

    case = rig.set_values(presets.find("mirakhorli/hybrid"), {"clock.dt": 0.5})
    options = dict(free={"controller.b": (0.5, 3.0)}, scenarios=(), choices={"controller.pairing": ["cross", "same"]})
    options |= dict(starts=1, screening=2, iterations=3, validation=0)
    with pytest.raises(RuntimeError):
        tuning.tune(case, log=halted, progress=stop, **options)
    assert list(halted.glob("choice_*"))
    cli.main(["tune", "mirakhorli/hybrid", *words, "--resume", str(halted)])
    again = json.loads(capsys.readouterr().out)
    assert again["parameters"] == first["parameters"] and again["objective"] == first["objective"]
    assert not list(halted.glob("choice_*"))
