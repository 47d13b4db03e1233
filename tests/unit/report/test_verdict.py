"""The verdict: the live page and the commands judge one run alike; a level that ends far from its
setpoint, a broken limit and an unstable loop are not good.
"""

import dataclasses
import functools
import json
import re
from pathlib import Path

import numpy as np
import pytest
from helpers import NODE, ONE_TANK, node

import jaxtank
import tuning
from jaxtank import presets, rig
from jaxtank.export import export
from jaxtank.live.engine import engine
from jaxtank.live.page import _script
from jaxtank.safety import TankCertificate
from tuning.cli import main
from tuning.cli.parser import COMMANDS, parser
from tuning.feasible import study
from tuning.problem.reported import run_measures
from tuning.report import advice, simulated, verdict as verdicts
from tuning.report.document import terminal
from tuning.search.judged import run_plants
from tuning.uncertainty.validation import SEED_OFFSET

PAGE = """
const e = makeEngine(), leaf = (name) => e.info.leaves.find((one) => one.name === name)?.value;
console.log(JSON.stringify(GIVEN.map(({ values, filter }) => {
  const inForce = (name, otherwise) => values[name] ?? leaf(name) ?? otherwise;
  return verdictOf(e.info, inForce, e.run(values, { filter, every: 100 }));
})));
"""
FOUR, TWO, ONE, BARE = "gouta2015/backstepping", "cascaded/pi", "one tank", "no limit on levels"
TRANSFER = """
dt = 5.0
duration = 3600.0
units = ["m", "%"]
tank = [
    { name = "T1", area = 0.5, rim = 1.2, drain = "4 cm^2", level = 0.4 },
    { name = "S", area = 0.5, rim = 8.0, level = 7.0, inflow = 1e-9 },
]
pump = [
    { name = "P1", to = "T1", gain = 3e-5, high = 100.0 },
    { name = "P2", from = "S", gain = 1e-6, high = 100.0, initial = 50.0 },
]
plant = { outputs = ["T1"] }
controller = { kind = "pi", Kc = 200.0, Ti = "5 min", lead = ["P1"] }
reference = { initial = [0.4], changes = [[60.0, 1, 1.0]] }
limits = { overshoot_percent = 80.0 }
"""
CLOCKS = {FOUR: {"clock.dt": 0.5, "clock.duration": 400.0}}
RELAY = "relay"
SWINGING = """
name = "relay"
units = ["m", "-"]
tank = [{ area = 1.0, rim = 2.0, level = 1.0 }]
pump = [{ gain = 0.02, to = 1, low = 0.0, high = 1.0, initial = 0.5 }]
plant = { gravity = 9.81 }
law = { kind = "pid", Kc = 1e6, Ti = 1e12, Tt = 1e12, bias = 0.5 }
reference = { initial = [1.0], changes = [[1.0, 1, 1.02]], ramp = 0.0 }
disturbance = { inflow = [-0.01] }
values = { "clock.dt" = 0.05, "clock.duration" = 79.0, "actuator.delay" = 5.0 }
"""
"""A P controller that switches a pump with dead time, above a constant outflow: the level swings by
0.05 m (Tsypkin) and ends near its setpoint.
"""

RUNS = {  # values and filter of a run, and whether it is good
    FOUR: [
        ({}, False, False),
        ({f"plant.rim[{i}]": 36.0 for i in range(4)}, False, True),
        ({"plant.rim[2]": 15.0, "plant.rim[3]": 15.0}, False, False),
        ({"controller.k1": 0.2}, True, True),
        ({"plant.drain[0]": 0.6}, True, False),
        ({"actuator.high[0]": 2.0}, False, False),
    ],
    ONE: [
        ({}, False, True),
        ({"plant.rim[0]": 2.9}, False, False),
        ({"plant.rim[0]": 2.5, "controller.Kc[0]": 10.0}, False, False),
        ({"controller.Kc[0]": 0.05, "controller.Ti[0]": 100.0}, False, False),
        ({"plant.pump_gain[0]": 1.0}, False, False),
    ],
    BARE: [
        ({}, False, True),
        ({"reference.targets[0]": 1.3}, False, False),
        ({"plant.pump_gain[1]": 1e-4}, False, False),
        # what flows in keeps 3 mm in S, which one step would take
        ({"plant.pump_gain[1]": 1e-4, "x0[1]": 0.1, "disturbance.level[1]": 3e-4}, False, False),
        ({"actuator.high[0]": 38.0, "reference.ramp": 6000.0}, False, False),
        (
            {"plant.rim[0]": 4.0, "x0[0]": 2.0, "reference.initial[0]": 2.0}
            | {"reference.targets[0]": 2.19, "actuator.high[0]": 84.0},
            False,
            False,
        ),
    ],
    RELAY: [({}, False, False), ({"controller.Kc[0]": 1.0}, False, True)],
}


def case_of(name):
    """A case whose limits are its rims."""
    if name == RELAY:
        return rig.loads(SWINGING)
    if name == BARE:
        return rig.loads(TRANSFER)
    if name == ONE:
        return rig.loads(ONE_TANK).replace(limits={"max_level": "rim"})
    return rig.set_values(presets.find(name), CLOCKS[name])


def measured(name, values, filtered):
    """(case, its measures) of a run."""
    case = case_of(name)
    case = case.with_safety_filter() if filtered else case
    case = rig.set_values(case, values) if values else case
    return case, run_measures(case.loop, case.clock, None)


ALL_FOUR = pytest.param(FOUR, marks=pytest.mark.slow)
EVERY = pytest.mark.parametrize("name", [ONE, BARE, RELAY, ALL_FOUR])
EACH = pytest.mark.parametrize("name", [ONE, ALL_FOUR])


@pytest.fixture(scope="module")
def judged():
    """Function of a case's name that returns [(case, measures)] of RUNS."""
    return functools.cache(lambda name: [measured(name, *run[:2]) for run in RUNS[name]])


@pytest.mark.extended_for("no limit on levels")
@pytest.mark.skipif(NODE is None, reason="no node on this machine")
@EVERY
def test_page_and_command_have_the_same_verdict_on_a_run(judged, name):
    case = case_of(name)
    text = engine(case, case.with_safety_filter() if name == FOUR else None) + _script("core")
    given = [{"values": values, "filter": filtered} for values, filtered, _ in RUNS[name]]
    page = node(text + PAGE, given)
    ours = [verdicts.of_run(*of) for of in judged(name)]
    assert page == [{"good": v.good, "sentence": v.sentence} for v in ours]
    assert len({v.sentence for v in ours}) > len(ours) - 2


@EACH
def test_a_run_is_good_where_levels_settle_and_limits_hold(judged, name):
    for (case, measures), (values, _, good) in zip(judged(name), RUNS[name], strict=True):
        verdict = verdicts.of_run(case, measures)
        run = jaxtank.simulate(case.loop, case.clock)
        levels, setpoints = np.asarray(run.x), np.asarray(run.r)
        ends = [*np.flatnonzero(np.diff(setpoints[:, 0])), len(setpoints) - 1]
        ends = [k for k in ends if setpoints[k, 0] == setpoints[k - 1, 0]]
        tank = case.loop.plant.outputs[0]
        errors = np.abs(levels[ends, tank] - setpoints[ends, 0])
        worst = np.ravel(measures["steady_state_error"])[0]
        assert worst == pytest.approx(errors.max(), abs=1e-12), values
        when = np.ravel(measures["time_of_steady_state_error"])[0]
        assert when == pytest.approx(np.asarray(run.t)[ends[np.argmax(errors)]])
        assert verdict.good == good == (verdict.tracking.good and verdict.limits.good), values
        if verdict.limits.good and len(case.loop.plant.outputs) == 1:
            assert verdict.tracking.good == (worst <= 0.05 * np.ravel(case.loop.plant.rim)[tank])


def swing(errors):
    """Smaller of the largest errors to either side over the last two parts of one plateau; a part
    begins where the plateau is a fifth longer than at the begin of the part before.
    """
    begins, count = [1, 4], 4
    while (count := int(np.ceil(1.2 * count - 1e-9))) <= len(errors):
        begins.append(count)
    end = errors[begins[-2] - 1 :] if len(errors) >= 4 else errors
    return max(0.0, min(end.max(), -end.min()))


@pytest.mark.extended_for("relay")
@pytest.mark.parametrize("name", [ONE, RELAY])
def test_a_level_that_swings_is_judged_by_its_swing(judged, name):
    runs = [*zip(judged(name), RUNS[name], strict=True)]
    if name == ONE:  # one that rings
        ringing = {"controller.Ti[0]": 1.0}
        runs.append((measured(name, ringing, False), (ringing, False, False)))
    for (case, measures), (values, _, good) in runs:
        run = jaxtank.simulate(case.loop, case.clock)
        errors = np.asarray(run.x[:, 0] - run.r[:, 0])
        begin = np.flatnonzero(np.abs(np.diff(run.r[:, 0])) > 1e-9)[-1] + 1
        before = swing(errors[:begin]) if begin > 1 else 0.0
        expected = max(before, swing(errors[begin:]))
        assert measures["steady_state_swing"][0] == pytest.approx(expected, abs=1e-12), values
        if name == RELAY:
            words = verdicts.tracking(case.loop, measures)
            assert words.good == good and ("swings 0.05 m" in words.words) != good
    assert expected > 0.01 or name == RELAY
    if name == RELAY:  # of a relay: flow times dead time over area, 0.01 * 5 / 1 (Tsypkin)
        worst = [float(np.ravel(measures["steady_state_swing"])[0]) for _, measures in judged(name)]
        assert worst[0] == pytest.approx(0.05, rel=2e-3) and worst[1] == 0.0
        assert judged(name)[0][1]["steady_state_error"][0] < 0.01  # at the end of the run: good


def test_what_no_limit_names_is_judged_all_the_same(judged):
    """A rim without a limit, an empty tank under a pump, a pump at its limit, a step not taken."""
    found = [verdicts.of_run(*of) for of in judged(BARE)]
    assert [v.good for v in found] == [good for *_, good in RUNS[BARE]]
    parts = [(v.tracking.good, v.limits.good) for v in found]
    dry = [(True, False)] * 2
    assert parts == [(True, True), (True, False), *dry, (False, True), (False, True)]
    rises, dry = (v.limits.words for v in found[1:3])
    told = [advice.of_run(*of).gives for of in judged(BARE)]
    assert all(v.limits.good or v.limits.words in told[i] for i, v in enumerate(found))
    measures = judged(BARE)[1][1]
    assert f"T1 rises to {verdicts.shown(measures['max_level'][0])} m" in rises
    assert "S" in dry and "P2" in dry and judged(BARE)[2][1]["min_level"][1] < 1e-3


def test_one_bad_part_makes_a_verdict_bad():
    part = verdicts.Part
    unstable = verdicts.robustness({"sensitivity_peak": np.inf})
    assert not unstable.good and verdicts.robustness({"sensitivity_peak": 1.3}).good
    both = verdicts.robustness({"sensitivity_peak": 1.3, "complementary_peak": 1.25})
    assert both.words == "Ms 1.3, Mt 1.25"
    assert verdicts.robustness({}) is verdicts.robustness({"sensitivity_peak": np.nan}) is None
    assert verdicts.Verdict(tracking=part("a"), limits=part("b")).good
    assert not verdicts.Verdict(tracking=part("a"), robustness=unstable).good
    some = verdicts.plants(3, 4, interval=(0.2, 0.9))
    assert not some.good and "20 to 90 %" in some.words
    whole = verdicts.Verdict(limits=part("limits"), plants=verdicts.plants(4, 4))
    assert whole.good and "limits;" not in whole.sentence and whole.to_json()["limits"] == "limits"


def test_a_setpoint_above_a_rim_is_beyond_any_gain():
    """Setpoints of 7 V in tank 2; tank 1 then stands at (drain 2 / orifice 1)^2 of that."""
    case = presets.find(TWO)
    assert advice.of_nominal_plant(case).startswith(advice.REACHABLE)
    (need,) = study.of_nominal_plant(rig.set_values(case, {"plant.rim[1]": 6.0}))
    assert (need.tank, need.needed, need.limit, need.unit) == (2, pytest.approx(7.0), 6.0, "V")
    low = rig.set_values(case, {"plant.rim[0]": 7.5})
    (need,) = study.of_nominal_plant(low)
    plant = case.loop.plant
    ratio = float(plant.drain[1] / plant.orifice[0])
    assert need.tank == 1 and need.needed == pytest.approx(7.0 * ratio**2)
    assert verdicts.shown(need.needed) in advice.of_nominal_plant(low)


@pytest.mark.extended
def test_an_open_loop_has_no_gains_no_errors_and_no_setpoint_out_of_reach():
    case = presets.find("cascaded/open-loop")
    values = run_measures(case.loop, case.clock, None)
    said, page = advice.of_run(case, values), terminal(simulated.report(case, values))
    assert "rms_error" in values and "error" not in said.gives + page and "max_level" in page
    assert said.to_set == "Nothing to set: an open loop has no gains."
    assert "gain" not in said.beyond and "steady state" not in said.beyond
    assert advice.of_nominal_plant(presets.find(TWO)) != said.beyond


def test_an_error_that_stays_is_said_to_stay():
    assert advice.error_of(0.35401, 0.35379, "ft") == "0.354 ft, as before"
    assert advice.error_of(0.667, 0.47, "cm") == "0.667 -> 0.47 cm"


@pytest.mark.skipif(NODE is None, reason="no node on this machine")
def test_numbers_are_written_as_the_page_writes_them():
    rng = np.random.default_rng(0)
    values = [0.0, 2.125, 12.25, 0.0625, 1e-3, 9.996e-4, 999999.0, 1e6, 99.95, -3.5, 123456.5]
    values += (rng.normal(size=300) * 10.0 ** rng.uniform(-8, 8, 300)).tolist()
    for digits in (3, 5):
        texts = f"JSON.stringify(GIVEN.map((v) => shown(v, {digits})))"
        page = node(f"{_script('core')}\nconsole.log({texts})", values)
        assert page == [verdicts.shown(value, digits) for value in values]


JUDGED = {  # commands that judge nothing, or one short run, with the shortest words
    **{"list": [], "show": [TWO], "init": [TWO], "export": [TWO], "figure": [], "cache": []},
    **{"simulate": ["one.toml"], "explore": [TWO, "--out", "page.html"], "bench": []},
    "identify": ["--inspect", "log.csv"],
    "predict": [TWO, "--data", "log.csv"],
    "replay": ["law.js", "--data", "run.csv"],
}
RESULTS = {"tune", "uncertainty", "sensitivity", "compare", "attack", "learn"}
"""Commands that print a result whose `to_json` has the verdict (test_page.py, below)."""


@pytest.mark.parametrize("command", [None, *COMMANDS])
def test_the_help_of_every_command_is_in_groups_with_two_examples(command, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    top = parser()
    text = (top.commands[command] if command else top).format_help()
    assert all(len(line) <= 80 for line in text.splitlines())
    assert command is None or text.count(f"  jaxtank {command}") >= 2


def test_every_command_with_json_is_judged_here():
    known = parser()
    with_json = {name for name in COMMANDS if "--json" in known.options(name)}
    assert with_json == {*JUDGED, *RESULTS}


SLOW = ("explore", "identify", "predict")  # of which other tests read the JSON too


@pytest.mark.slow_for("show")
@pytest.mark.parametrize(
    "command", [pytest.param(c, marks=pytest.mark.slow) if c in SLOW else c for c in JUDGED]
)
def test_the_json_of_every_command_has_a_verdict(command, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    rows = "\n".join(f"{4 * k},3.0,{4 + k / 20}" for k in range(40))
    (tmp_path / "one.toml").write_text(ONE_TANK)
    (tmp_path / "log.csv").write_text(f"t_s,pump_V,lower_tank_V\n{rows}\n")
    monkeypatch.setenv("COLUMNS", "80")
    monkeypatch.setattr("tuning.bench.bench.measure", lambda rounds: {})
    if command == "replay":
        if NODE is None:
            pytest.skip("no node on this machine")
        (tmp_path / "law.js").write_text(export(presets.find(TWO), "js", name="law"))
        (tmp_path / "run.csv").write_text("t [s],y1,y2,r1,u1\n0,4,4,4,2.5\n4,4,4,4,2.5\n")
    monkeypatch.setattr("tuning.bench.bench.text", lambda rows: "")
    assert main.main([command, *JUDGED[command], "--json", "--quiet"]) == 0
    verdict = json.loads(capsys.readouterr().out)["verdict"]
    assert set(verdict) == {"good", "sentence", "tracking", "limits", "plants", "robustness"}
    assert isinstance(verdict["good"], bool) and verdict["sentence"]
    if command not in ("init", "export"):  # files
        main.main([command, *JUDGED[command], "--quiet"])
        lines = capsys.readouterr().out.splitlines()
        paths = [x for x in lines if any(Path(word).is_absolute() for word in x.split())]
        assert [x for x in lines if len(x) > 80 and x not in paths] == []  # a path has any length
    if command == "simulate":
        checked = [command, *JUDGED[command], "--quiet", "--check"]
        assert main.main(checked) == (0 if verdict["good"] else 4)
        printed = capsys.readouterr().out
        assert verdict["sentence"] in " ".join(printed.split())
        wide = [command, "one.toml", "--set", "plant.pump_gain=1", "--quiet"]
        assert main.main(wide) == 0 and main.main([*wide, "--check"]) == 4
        for most, code in ((10.0, 0), (1.01, 4)):  # of the linearised loop, without --margins
            for name in ("a", "b"):
                limited = ONE_TANK.replace("max_level = 2.7", f"sensitivity_peak = {most}")
                (tmp_path / f"{name}.toml").write_text(limited.replace("one tank", name))
            for cases in (["a.toml"], ["a.toml", "b.toml"]):
                assert main.main([command, *cases, "--quiet", "--check"]) == code


def test_a_limit_is_proved_where_the_certificate_is_at_least_as_strict():
    proved = TankCertificate(0, 10.0, True, "theorem 1", 0.1, 0.2, 0.5, 9.9, low=1.0)
    failed = dataclasses.replace(proved, certified=False, reason="not covered: leak")
    low = dataclasses.replace(proved, low_certified=True)
    assert proved.unproved("max_level", 10.0) is proved.unproved("overflow_volume", 10.0) is None
    assert proved.unproved("max_level", 9.0) == "the safety filter keeps another limit, 10"
    assert failed.unproved("overflow_volume", 10.0) == "not covered: leak"
    assert proved.unproved("min_level", 0.5) and low.unproved("min_level", 0.5) is None
    assert low.unproved("min_level", 1.5)


LATE = """
tank = [{ area = 30.0, rim = 30.0, drain = 0.4, level = 20.0 }]
pump = [{ to = 1, gain = 20.0, high = 8.0, initial = 3.96 }]
controller = { kind = "pi", Kc = 0.15, Ti = 15.0 }
reference = { initial = [20.0], changes = [[20.0, 1, 12.0]], ramp = 0.0 }
values = { "clock.dt" = 0.5, "clock.duration" = 100.0, "actuator.delay" = 4.0 }
sensor = { noise = 0.03 }
limits = { max_level = [29.0] }
uncertain = { "plant.drain" = 0.1, "plant.pump_gain" = 0.1 }
safety_filter = {}
"""


@pytest.mark.extended
def test_a_tank_is_proved_where_both_its_limits_are():
    """With dead time the upper limit alone is proved."""
    options = tuning.Options(validation=16)
    both = LATE.replace("[29.0]", "[29.0], min_level = [6.0]")
    for text, proved in ((LATE, True), (both, False)):
        result = tuning.tune(rig.loads(text), options)
        verdict, text = result.to_json()["verdict"]["sentence"], str(result.answer)
        assert ("proved for" in verdict) == proved == ("proved: on any plant" in text)
        (row,) = result.to_json()["holds"]["certified"]
        assert row["certified"] == proved and ("dead time" in row["why"]) == (not proved)
        assert len({str(m) for m in result.messages}) == len(result.messages)
        codes = [message.code for message in result.messages if hasattr(message, "code")]
        assert ("limit-not-certified" in codes) == (not proved)


@pytest.mark.extended
def test_tune_says_on_how_many_plants_setpoints_are_not_kept():
    """A pump that is too small for the setpoint of 2.6 cm on plants whose pump at its limit fills
    the tank to less, (gain high / drain)^2 / (2 g).
    """
    weak = ONE_TANK.replace("high = 2.0", "high = 0.66").replace("= 40.0", "= 400.0")
    result = tuning.tune(rig.loads(weak), tuning.Options(validation=64))
    setting, after = result.answer.setting, result.answer.after
    drawn = run_plants(setting.searched, setting.distributions, 64, SEED_OFFSET, ("max_level",))
    (group,) = drawn.groups
    gain, drain = (np.ravel(group.values[f"plant.{n}"]) for n in ("pump_gain", "drain"))
    low = (gain * 0.66 / drain) ** 2 / (2.0 * 0.5) < 2.6
    verdict = verdicts.of_tuning(result)
    assert 10 < low.sum() < 54 and result.success and not verdict.good
    assert f"but {low.sum()} of 64 validation plants do not keep" in verdict.tracking.words
    assert "no steady state" in verdict.tracking.words
    np.testing.assert_array_equal(
        verdicts.not_tracking(setting.case.loop, after.measures, after.failed), low
    )
    share = f"{100 * low.mean():.3g} %"
    table = str(result.answer)
    assert re.search(rf"do not keep to their setpoints +[.0-9]+ % +{share}", table)
    lost = [row["setpoints_lost"] for row in result.rules if row["parameters"]]
    assert lost and min(lost) >= low.sum() and "missed" in str(result)


@pytest.mark.parametrize("robust", [False, True])
def test_other_answers_say_on_how_many_runs_setpoints_are_not_kept(robust):
    """The pump of the test above, by the nominal optimum and by that of a few plants."""
    weak = ONE_TANK.replace("high = 2.0", "high = 0.66").replace("= 40.0", "= 400.0")
    case = rig.loads(weak).replace(uncertain={"plant.drain": 0.05}, safety=None)
    if robust:
        result = tuning.tune_robust(case, samples=4, fresh=64, method=tuning.Options(starts=1))
    else:
        result = tuning.tune(tuning.Problem(case), tuning.Options(starts=1, validation=64))
    kept, finite = result.validation["setpoints_kept"]["after"], 64 - result.validation["failed"]
    verdict = verdicts.of_tuning(result)
    assert 0.1 < kept < 0.9 and not verdict.tracking.good and not verdict.good
    assert f"{round((1 - kept) * finite)} of {finite} validation runs" in verdict.tracking.words
    none = result.validation | {"setpoints_kept": {"before": 1.0, "after": 0.0}}
    words = verdicts.of_tuning(result.replace(validation=none)).tracking.words
    assert f"{finite} of {finite} validation runs" in words
