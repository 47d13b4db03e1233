"""When a result may claim success, and what it says when it may not."""

import ast
import dataclasses
import json
import re
from pathlib import Path

import numpy as np
import pytest
from helpers import RIGS

import jaxtank
import tuning
from jaxtank import presets, rig
from jaxtank.limits import limit_scale, resolve_limits
from jaxtank.signals.setpoints import ramps
from tuning.cli import main


@pytest.mark.parametrize(
    "name", ["calofir/backstepping", "cascaded/pi", "gouta2015/backstepping", "khalid/gpc"]
)
def test_limit_scale_a_limit_is_of_its_own_size_in_any_unit(name):
    """A back-off of 1e-6 of it must leave room below the limit, which in cubic metres is 1e-8."""
    case = presets.find(name)
    for limits in (None, {"max_level": "rim", "input_travel": 1e-4, "saturated_fraction": 0.0}):
        for limit in resolve_limits(case, limits):
            room = limit_scale(limit, case.loop)
            assert room > 0 and (limit.value == 0 or 1e-6 * room < 1e-2 * abs(limit.value))


@pytest.mark.slow
def test_a_limit_in_cubic_metres_is_met_where_it_is_tight():
    """Found by a grid of 40 by 40: 0.00597149 m at K = (0.0523, 0.0212) 1/s; a search that scaled
    the limit by 1 m^3/s ended at 0.00598032.
    """
    case = presets.find("calofir/backstepping")
    result = tuning.tune(
        case,
        tuning.Options(starts=2, screening=16, validation=0),
        limits={"max_level": "rim", "input_travel": 1e-3},
    )
    assert result.success and result.objective["after"] < 0.0059715
    travel = next(c for c in result.constraints if c["measure"] == "input_travel")
    assert 0 <= travel["margin"] < 1e-3 * travel["limit"] and travel.active


@pytest.mark.slow
def test_what_is_missed_is_told_in_full_and_is_the_least_by_one_measure():
    """Levels below the setpoints, with small errors from them."""
    small = rig.set_values(presets.find("cascaded/pi"), {"clock.duration": 1200.0})
    impossible = {"max_level": [4.5, 4.0], "max_error": 0.5}
    few = tuning.Options(starts=1, screening=4, validation=0)
    result = tuning.tune(small, few, limits=impossible)
    assert result.status == "infeasible"
    assert "no point was found that meets every limit" in result.message
    missed = [c for c in result.constraints if c["margin"] < 0]
    assert len(missed) > 1 and all(c["name"] in result.message for c in missed[:4])
    share = max(-c["margin"] / c["limit"] for c in missed)
    start = tuning.Problem(small, limits=impossible)
    _, margins = start.screen(np.array([start.start()]))
    before = max(-margins[0] / start.limit_scales)
    assert share <= before * (1 + 1e-9)


@pytest.mark.slow
def test_a_search_over_choices_is_resumed(tmp_path, capsys):
    """Killed after its first combination: the same answer, and no log is left."""
    words = ["--choose", "controller.pairing=cross,same", "--free", "controller.b=0.5:3"]
    words += ["--scenario", "none", "--dt", "0.5", "--starts", "1", "--screening", "2"]
    words += ["--iterations", "3", "--validation", "0", "--quiet", "--json"]
    whole, halted = tmp_path / "whole", tmp_path / "halted"
    main.main(["tune", "mirakhorli/hybrid", *words, "--out", str(whole)])
    first = json.loads(capsys.readouterr().out)
    seen = []

    def stop(event):
        seen.append(event)
        if len(seen) == 7:
            raise RuntimeError("killed")

    case = rig.set_values(presets.find("mirakhorli/hybrid"), {"clock.dt": 0.5})
    choices = {"controller.pairing": ["cross", "same"]}
    few = tuning.Options(starts=1, screening=2, iterations=3, validation=0)
    options = dict(free={"controller.b": (0.5, 3.0)}, scenarios=(), limits=dict(case.limits))
    with pytest.raises(RuntimeError):
        tuning.tune_choices(case, choices, few, checkpoint=halted, progress=stop, **options)
    assert list(halted.glob("choice_*"))
    main.main(["tune", "mirakhorli/hybrid", *words, "--resume", str(halted)])
    again = json.loads(capsys.readouterr().out)
    assert again["parameters"] == first["parameters"] and again["objective"] == first["objective"]
    assert not list(halted.glob("choice_*"))


WATERTANK = str(RIGS / "watertank.toml")


def told(capsys, *words):
    """(exit code, JSON object or None, stderr) of a command with --json and --quiet.

    Of `tune`: with --nominal, unless --robust is among the words.
    """
    capsys.readouterr()
    nominal = ["--nominal"] if words[0] == "tune" and "--robust" not in words else []
    code = main.main([*words, *nominal, "--json", "--quiet"])
    out = capsys.readouterr()
    return code, json.loads(out.out) if out.out else None, out.err


def edited(tmp_path, **lines):
    """The path of watertank.toml with the values of some keys replaced; None drops the line."""
    text = Path(WATERTANK).read_text()
    for key, value in lines.items():
        text, count = re.subn(
            rf"(?m)^{key} = .*$", "" if value is None else f"{key} = {value}", text
        )
        assert count == 1
    path = tmp_path / "rig.toml"
    path.write_text(text)
    return str(path)


@pytest.mark.slow
def test_a_trade_off_starts_from_what_was_screened(capsys):
    """A grid of 150 by 150, refined once, finds 0.18913 without overshoot."""
    words = ["--starts", "1", "--validation", "0", "--tradeoff", "overshoot_percent=0:5:4"]
    code, found, _ = told(capsys, "tune", WATERTANK, *words)
    points = found["tradeoff"]["points"]
    assert code == 0 and [p["status"] for p in points] == ["converged"] * 4
    costs = [p["objective"] for p in points]
    assert costs == sorted(costs) and costs[0] < 0.1872 and costs[-1] < 0.18941
    case = rig.load(WATERTANK)
    loop = jaxtank.with_values(case.loop, points[-1]["parameters"])
    held = jaxtank.evaluate(loop, case.clock, ["overshoot_percent", "rise_time", "settling_time"])
    assert held["overshoot_percent"][0] == 0.0
    assert held["rise_time"][0] <= 2.5 and held["settling_time"][0] <= 20.0


@pytest.mark.slow
def test_a_trade_off_of_the_highest_level_ends_at_the_rim():
    """At the rim of 12 V the limit is one on what spills, which other values do not measure."""
    sweep = tuning.tradeoff(presets.find("cascaded/pi"), "max_level", [8.0, 12.0], screening=16)
    low, rim = sorted(sweep["points"], key=lambda point: point["limit"])
    assert low["status"] == rim["status"] == "converged"
    assert rim["objective"] < 0.9 * low["objective"]


NOISY = [
    *("gouta2022/chadpc", "--dt", "0.05", "--set", "clock.duration=100", "--set"),
    *("sensor.noise=0.02", "--set", "actuator.delay=0.2"),
]


@pytest.mark.slow
def test_a_search_leaves_an_unstable_start_or_gives_the_reason_why_it_cannot(capsys):
    """At the paper's gains the loop with this noise and delay is unstable and its slopes exceed
    1e9, so no search can begin there.
    """
    words = ["--scenario", "none", "--starts", "1", "--screening", "8", "--validation", "0"]
    code, found, _ = told(capsys, "tune", *NOISY, *words, "--free", "controller.Tp=0.1:20")
    assert code == 0 and found["objective"]["after"] < 0.975 * found["objective"]["before"]
    code, found, _ = told(capsys, "tune", *NOISY, *words, "--free", "controller.Tp=0.1:0.2")
    assert code == 3 and found["status"] == "not_converged"
    assert "unstable or chaotic" in found["message"] and "--iterations" not in found["message"]


@pytest.mark.extended_for("settling_time=10-no setpoint has a step within its 40 s-command0")
@pytest.mark.parametrize(
    "command", [["tune", "--starts", "1"], ["uncertainty", "--vary", "plant.drain=uniform:5%"]]
)
@pytest.mark.parametrize(
    "limit, why",
    [
        ("settling_time=10", "no setpoint has a step within its 40 s"),
        ("overshoot_percent=5", "--limit overshoot_percent=none"),
    ],
)
def test_a_limit_that_no_run_can_be_measured_by_is_refused(capsys, tmp_path, command, limit, why):
    path = edited(tmp_path, changes="[]")
    assert main.main([command[0], path, *command[1:], "--limit", "none", "--limit", limit]) == 2
    out, err = capsys.readouterr()
    assert out == "" and err.count("\n") == 1
    assert err.startswith(f"jaxtank: limit {limit.replace('=', ' = ')} ")
    assert "undefined on this run" in err and why in err


@pytest.mark.extended
def test_an_output_without_a_step_is_not_limited_and_one_with_is(gouta):
    case = gouta("backstepping", {"clock.dt": 0.5})
    case = case.replace(
        loop=dataclasses.replace(
            case.loop, reference=ramps((3.0, 3.0), ((5.0, 0, 8.0),), ramp=40.0)
        )
    )
    assert [limit.index for limit in resolve_limits(case, {"settling_time": 50.0})] == [0]
    still = case.replace(clock=dataclasses.replace(case.clock, duration=4.0))
    with pytest.raises(
        jaxtank.InputError,
        match=r"settling_time = 50 s: undefined on this run: no setpoint has a step within its 4 s",
    ):
        resolve_limits(still, {"settling_time": 50.0})
    quiet = presets.find("gouta2022/chadpc")
    quiet = quiet.replace(clock=dataclasses.replace(quiet.clock, duration=400.0))
    with pytest.raises(
        jaxtank.InputError,
        match="recovery_time = 5 s: undefined on this run: no inflow disturbance begins within its"
        " 400 s",
    ):
        resolve_limits(quiet, {"recovery_time": 5.0})


@pytest.mark.slow
def test_what_becomes_undefined_in_the_search_breaks_its_limit(capsys, tmp_path):
    """With gains this small no run reaches 90 % of the step: no rise time is defined."""
    path = edited(tmp_path, Kc="0.15", Ti="95.0", overshoot_percent=None, settling_time=None)
    free = ["--free", "controller.Kc[0]=0.1:0.2", "--free", "controller.Ti[0]=90:100"]
    code, found, _ = told(capsys, "tune", path, *free, "--starts", "1", "--validation", "0")
    (row,) = found["constraints"]
    assert code in (3, 4) and row["value"] is None and row["margin"] < 0 and "90 %" in row["reason"]
    assert (
        "rise_time of output 1 is undefined (no change of the setpoint was followed to 90 %"
        in found["message"]
    )
    code, found, _ = told(
        capsys, "uncertainty", path, "--samples", "8", "--vary", "plant.drain=uniform:5%"
    )
    assert code == 0 and found["violations"][0]["count"] == 8


@pytest.mark.slow
def test_gains_that_no_run_exercises_are_kept(capsys):
    """The setpoint goes from 1 to 2 cm: knots at 5 and 8 cm have no effect, nor has the one at 1
    cm, where there is no error.
    """
    words = ["--schedule", "controller.Kc[0]=r1:1,2,5,8", "--starts", "2", "--validation", "0"]
    code, found, _ = told(capsys, "tune", WATERTANK, *words)
    assert code == 0
    idle = [n for n, p in found["parameters"].items() if not p["exercised"]]
    assert idle == ["controller.values[0,0]", "controller.values[0,2]", "controller.values[0,3]"]
    assert all(
        found["parameters"][n]["after"] == found["parameters"][n]["before"] == 1.6 for n in idle
    )
    assert found["parameters"]["controller.values[0,1]"]["after"] == pytest.approx(3.05, abs=0.02)
    assert "controller.values[0,0] 1.6 V/cm, controller.values[0,2]" in found["message"]
    assert "controller.values[0,3] 1.6 V/cm have no effect in any run" in found["message"]
    others = [
        words for words in found["message"].split("; ") if "no effect in any run" not in words
    ]
    assert not any(n in words for n in idle for words in others)


def test_every_code_of_a_message_is_listed():
    root = Path(tuning.__file__).parent
    listed = set(re.findall(r"^\| `([a-z-]+)` \|", (root / "README.md").read_text(), re.M))
    place, codes = {"Message": 0, "rule": 1}, set()
    for path in root.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            name = getattr(node.func, "id", "") if isinstance(node, ast.Call) else ""
            if name in place and len(node.args) > place[name]:
                texts = (getattr(n, "value", "") for n in ast.walk(node.args[place[name]]))
                codes |= {text for text in texts if isinstance(text, str) and "-" in text}
    assert len(codes) > 35 and codes <= listed
