"""Steps too long for a tank that runs empty: told, against runs that do it; refused where nothing
would be right.
"""

import dataclasses
import html
import json
import tomllib
import types
import warnings

import jax
import numpy as np
import pytest
import stiff_rigs

import jaxtank
import tuning
from jaxtank import presets, rig
from jaxtank.core.clock import Clock
from jaxtank.core.errors import InputError
from jaxtank.loop import step_size
from jaxtank.plants.faults import faults
from jaxtank.signals.inflows import inflow_pulses
from tuning.cli import main
from tuning.report import tuned as report, verdict

FEW = tuning.Options(starts=1, screening=2, iterations=2, validation=0)

ONE = """
tank = [{{ area = 20.0, rim = 20.0, drain = {drain}, level = 5.0 }}]
pump = [{{ gain = 8.0, to = 1, high = 12.0, initial = 0.0 }}]
controller = {{ kind = "open-loop" }}
"""


def levels(drain, integrator, samples=500):
    """Of a tank whose pump is off, sampled every second."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", step_size.StepWarning)
        case = rig.loads(ONE.format(drain=drain))
        clock = Clock(dt=1.0, duration=float(samples), integrator=integrator)
        return case, clock, np.asarray(jaxtank.simulate(case.loop, clock).x)[:, 0]


@pytest.mark.slow_for(*(f"{s}-{i}" for s in (1.05, 10.0) for i in step_size.LIMITS))
@pytest.mark.parametrize("integrator", step_size.LIMITS)
@pytest.mark.parametrize("share", [0.98, 1.05, 3.0, 10.0])
def test_what_is_reported_is_what_happens(integrator, share):
    """share: of the longest stable step of the film. Below it a tank empties and stays so; above,
    its level is thrown as high as is said: by a third of it (what is said holds of any start) to
    all of it (less what the product is rounded by).
    """
    drain = 0.1
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", step_size.StepWarning)
        for _ in range(3):  # a rate follows from the drain: the film's is proportional to it
            (rate,) = step_size.emptying_rates(rig.loads(ONE.format(drain=drain)).loop.plant)
            drain *= share * step_size.LIMITS[integrator] / rate
    case, clock, h = levels(drain, integrator)
    late = np.abs(h[-100:]).max()
    printed = (
        step_size.unstable_height(
            float(f"{step_size.emptying_rates(case.loop.plant)[0]:.3g}"), integrator
        )
        * 0.01
    )
    if share < 1.0:
        assert list(step_size.unstable_tanks(case.loop, clock)) == [] and late < 1e-6
    else:
        assert 0.3 * printed <= late <= 1.1 * printed


@pytest.mark.slow
def test_steps_as_the_papers_have_them_are_short_enough():
    for paper in presets.PAPERS:
        for case in presets.load(paper).cases.values():
            assert list(step_size.unstable_tanks(case.loop, case.clock)) == []


def test_the_remedy_is_one():
    case, clock, _ = levels(0.4, "rk4", samples=2)
    ((_, _, remedy),) = step_size.unstable_tanks(case.loop, clock)
    assert remedy.startswith("clock.substeps = 5 ")
    assert list(step_size.unstable_tanks(case.loop, dataclasses.replace(clock, substeps=5))) == []
    assert list(step_size.unstable_tanks(case.loop, dataclasses.replace(clock, substeps=4))) != []


def test_it_is_reported_and_where_a_full_tank_empties_in_a_step_refused(tmp_path, capsys):
    case = rig.loads(ONE.format(drain=0.1))
    fast = jaxtank.with_values(case.loop, {"plant.drain": 2.0})
    with pytest.warns(
        step_size.StepWarning, match="for an empty tank 1: .* rises to 2.9e.02 cm .*0.042 s"
    ):
        jaxtank.check(fast, case.clock)
    with pytest.raises(
        InputError, match=r"clock.dt = 30 s: tank 1 runs empty in 2 s, within one step"
    ):
        jaxtank.check(fast, Clock(dt=30.0, duration=300.0))
    file, out = tmp_path / "one.toml", tmp_path / "out"
    file.write_text(ONE.format(drain=2.0))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", step_size.StepWarning)
        words = ["simulate", str(file), "--set", "clock.duration=20", "--out", str(out)]
        assert main.main(words) == 2 and not out.exists()
    assert capsys.readouterr().err.count("note: steps too long for an empty tank 1") == 1


DEEP = """
tank = [{{ area = 1.0, rim = {rim}, drain = 0.5, level = 20.0 }}]
pump = [{{ gain = 1.0, to = 1, high = 10.0, initial = 1.0 }}]
controller = {{ kind = "open-loop" }}
reference = {{ initial = [{setpoint}] }}
values = {{ "clock.dt" = {dt}, "clock.duration" = 20.0 }}
"""


@pytest.mark.parametrize(("rim", "dt"), [(1e4, 0.1), (40.0, 0.06)])
def test_a_rim_far_above_all_levels_hides_nothing(rim, dt):
    """The tank empties from 20 cm and rises by centimetres in one unstable step, whether its rim is
    at 40 cm or, as a mere limit, at 100 m.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", step_size.StepWarning)
        case = rig.loads(DEEP.format(rim=rim, dt=dt, setpoint=1.0))
        run = jaxtank.simulate(case.loop, case.clock)
        assert np.diff(np.asarray(run.x)[:, 0]).max() > 3.0
        (sentence,) = step_size.step_warnings(case.loop, case.clock)
        assert "steps too long for an empty tank 1" in sentence
        with pytest.raises(InputError, match=r"rises by itself after t = 0\.3"):
            step_size.check_run(case.loop, case.clock, run)


@pytest.mark.extended
def test_what_shows_is_a_share_of_the_levels_that_a_run_is_about():
    """The setpoint counts where the tank starts empty; with neither, the rim alone is left. Traced
    levels tell nothing, and stop nothing.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", step_size.StepWarning)
        high, low = (rig.loads(DEEP.format(rim=1e4, dt=0.1, setpoint=r)) for r in (1e4, 1.0))
        empty = dataclasses.replace(low.loop, x0=np.zeros(1))
        nowhere = jaxtank.with_values(empty, {"reference.initial": 0.0})
        assert [
            bool(step_size.step_warnings(loop, low.clock))
            for loop in (high.loop, low.loop, empty, nowhere)
        ] == [False, True, True, False]
        error = lambda x0: jaxtank.evaluate(
            dataclasses.replace(low.loop, x0=x0), low.clock, ["rms_error_total"]
        )["rms_error_total"]
        slope = jax.jit(jax.grad(error))
        assert slope(low.loop.x0).shape == (1,)


@pytest.mark.extended_for("fault-20.0")
@pytest.mark.parametrize(
    "case, rim", [("fed", 1e4), ("empty", 20.0), ("fault", 20.0), ("pour", 1e4)]
)
def test_a_run_that_is_right_is_not_refused(case, rim):
    """The film is too fast for the steps, and yet no level rose: the tank is fed all the
    time, or starts empty and fills, or more comes in than its pump brings.
    """
    text = (
        ONE.format(drain=0.4)
        .replace("initial = 0.0", "initial = 6.0")
        .replace("rim = 20.0", f"rim = {rim}")
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", step_size.StepWarning)
        loop = rig.loads(text).loop
        if case == "empty":
            loop = dataclasses.replace(loop, x0=np.zeros(1))
        elif case == "fault":
            loop = dataclasses.replace(
                loop, faults=faults(loop.plant, [("pump_gain[0]", 3.0, 30.0, 1.5, 0.0)])
            )
        elif case == "pour":
            loop = dataclasses.replace(loop, disturbance=inflow_pulses(1, [(3.0, 1.0, 0, 150.0)]))
        clock = Clock(dt=1.0, duration=40.0)
        run = jaxtank.simulate(loop, clock)
    assert step_size.step_warnings(loop, clock)
    step_size.check_run(loop, clock, run)


COLANDER = """
tank = [{{ area = 2.0, rim = 20.0, drain = 1.0, level = 4.0 }}]
pump = [{{ gain = 60.0, to = 1, high = 12.0 }}]
controller = {{ kind = "pid", Kc = 0.5, Ti = 0.2, Tt = 30.0 }}
reference = {{ initial = [4.0], changes = [[2.0, 1, 12.0], [8.0, 1, {last}]] }}
values = {{ "clock.dt" = 0.05, "clock.duration" = 15.0, "clock.substeps" = {substeps} }}
free = {{ "controller.Kc" = [0.4, 0.6] }}
uncertain = {{ "plant.pump_gain" = 0.05 }}
"""
WRONG = (
    "this answer's run is wrong, and so are its numbers: clock.dt = 0.05 s: steps too long to"
    " follow tank 1"
)
DOUBT = "steps too long for an empty tank 1"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("last", "substeps", "words"),
    [(0.2, 1, WRONG), (10.0, 1, DOUBT), (0.2, 6, None)],
    ids=["long", "doubtful", "short"],
)
def test_an_answer_states_that_its_run_is_of_steps_too_long(last, substeps, words, tmp_path):
    """Tuned to follow setpoints down to the bottom, not so far down, and with steps short enough;
    the first throws its tank up.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", step_size.StepWarning)
        case = rig.loads(COLANDER.format(last=last, substeps=substeps))
        result = tuning.tune(case, FEW)
        reported = [repr(result), json.dumps(report.json_of(result), ensure_ascii=False)]
        if words == WRONG:  # the page as well: its pictures take longer than the search
            result.save(tmp_path)
            reported.append((tmp_path / "report.html").read_text())
    if words is None:
        assert not any("steps too long" in text or "runs empty" in text for text in reported)
    else:
        plain = [" ".join(html.unescape(text).split()) for text in reported]
        assert result.message.startswith(words) and f"- {words}" in plain[0]
        assert all(words in text for text in plain)
        # a run that is wrong is no answer, whatever its search says
        assert result.success == verdict.of_tuning(result).good == (words == DOUBT)
        assert ("its steps are too long" in plain[0]) == (words == WRONG)


@pytest.mark.slow
def test_an_answer_states_it_of_a_scenario_too():
    """The case's own setpoints stay above the bottom; those of its second scenario do not."""
    text = COLANDER.format(last=10.0, substeps=1)
    low = {"name": "low", "values": {"reference.targets": [12.0, 0.2]}}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", step_size.StepWarning)
        case = rig.from_table({**tomllib.loads(text), "scenario": [{"name": "high"}, low]})
        result = tuning.tune(case, FEW)
    assert result.message.startswith(f"scenario low: {WRONG}")


@pytest.mark.slow
@pytest.mark.parametrize("substeps", [1, 6])
def test_draws_of_steps_too_long_say_so(substeps, tmp_path):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", step_size.StepWarning)
        found = tuning.ensemble(rig.loads(COLANDER.format(last=0.2, substeps=substeps)), samples=8)
        found.save(tmp_path)
    reported = [
        repr(found),
        *((tmp_path / name).read_text() for name in ("result.json", "report.html")),
    ]
    assert [DOUBT in text for text in reported] == [substeps == 1] * 3


@pytest.mark.slow_for(*list(stiff_rigs.KINDS)[1:], "cascaded")
@pytest.mark.parametrize("kind", stiff_rigs.KINDS)
def test_a_random_stiff_rig_is_right_or_reported(kind):
    """No level is off by more than 5 % of its rim without a StepWarning (`python
    tests/audits/stiff_rigs.py` tries more).
    """
    found = stiff_rigs.tried(kind, range(8))
    assert len(found) == 8
    assert [error for error, reported in found if not reported and error > stiff_rigs.OFF] == []
    assert min(error for error, _ in found) < 0.01


def test_the_level_of_an_unresolved_laminar_zone_is_reported():
    """A stiff tank with `bottom`, fed a little: its level stands where one step's inflow is, and no
    higher than is reported.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", step_size.StepWarning)
        case = rig.loads(
            ONE.format(drain=0.4)
            .replace("high = 12.0", "high = 0.5")
            .replace("initial = 0.0", "initial = 0.5")
        )
        plant = dataclasses.replace(case.loop.plant, bottom=True)
        loop, clock = dataclasses.replace(case.loop, plant=plant), Clock(dt=2.0, duration=200.0)
        level = np.asarray(jaxtank.simulate(loop, clock).x)[-1, 0]
    (sentence,) = step_size.step_warnings(loop, clock)
    reported = float(sentence.split("up to ")[1].split(" cm")[0])
    exact = (0.5 * 8.0 / 0.4) ** 2 / (2 * 981.0)  # Torricelli
    np.testing.assert_allclose(level, 2.0 * 0.5 * 8.0 / 20.0, rtol=1e-9)
    assert exact < level < exact + reported


CHAIN = """
reachable = false
tank = [{ area = 7.232, rim = 30.0, level = 0.83, drain = 0.115 },
        { area = 20.134, rim = 30.0, level = 9.7, drain = 0.095 },
        { area = 4.939, rim = 30.0, level = 5.64, drain = 0.072 }]
orifice = [{ from = 1, to = 2, area = 0.139 }, { from = 2, to = 3, area = 0.234 }]
pump = [{ gain = 27.238, to = 1, high = 12.0, initial = 0.0 }]
plant = { outputs = [3] }
law = { kind = "pid", Kc = KC, Ti = 38.688, Tt = 30.0 }
reference = { initial = [5.0], changes = [[30.0, 1, 10.182]], ramp = 0.0 }
values = { "clock.dt" = 0.5, "clock.duration" = 120.0 }
"""


def finer(case, substeps):
    """The Trajectory of a case with these substeps."""
    return jaxtank.simulate(case.loop, dataclasses.replace(case.clock, substeps=substeps))


def test_a_run_that_its_steps_spoil_is_refused_with_its_error(tmp_path, capsys):
    """The level of tank 1 alone would rise to 0.67 cm; the controller makes 19 cm of it. No volume
    appears at any sample, so that the balance of a run does not see it.
    """
    (tmp_path / "chain.toml").write_text(CHAIN.replace("KC", "2.335"))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", step_size.StepWarning)
        case = rig.loads(CHAIN.replace("KC", "2.335"))
        step_size.check_run(case.loop, case.clock, finer(case, 1))
        apart = np.abs(np.asarray(finer(case, 1).x) - np.asarray(finer(case, 2).x))
        right = np.abs(np.asarray(finer(case, 1).x) - np.asarray(finer(case, 8).x)).max()
        assert main.main(["simulate", str(tmp_path / "chain.toml"), "--out", str(tmp_path)]) == 2
    tank, sample = np.unravel_index(np.argmax(apart.T), apart.T.shape)
    printed = capsys.readouterr().err
    assert f"the level of tank {tank + 1} differs by {apart.max():.3g} cm at" in printed
    assert f"at t = {0.5 * sample:g} s" in printed and "clock.substeps = 5 is short" in printed
    np.testing.assert_allclose(apart.max(), right, rtol=0.05)  # half the step tells the error
    assert list(tmp_path.iterdir()) == [tmp_path / "chain.toml"]


@pytest.mark.slow
def test_the_note_on_the_step_reports_measured_errors(tmp_path, capsys):
    """Levels, inputs and measures, against the same run with half the step."""
    text = CHAIN.replace("KC", "2.3").replace("27.238", "4.0")
    (tmp_path / "chain.toml").write_text(text)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", step_size.StepWarning)
        case = rig.loads(text)
        runs = [finer(case, substeps) for substeps in (1, 2)]
        assert main.main(["simulate", str(tmp_path / "chain.toml")]) == 0
    (note,) = [x for x in capsys.readouterr().err.splitlines() if "with half the step" in x]
    x, u = (
        np.abs(np.asarray(getattr(runs[0], name)) - np.asarray(getattr(runs[1], name)))
        for name in ("x", "u")
    )
    assert f"differs by {x[:, 0].max():.3g} cm" in note
    assert f"the input of pump 1 by {u.max():.3g} V" in note
    least = [np.asarray(run.x)[:, 0].min() for run in runs]
    words = f"min_level of tank 1 is {least[1]:.3g} cm in place of {least[0]:.3g} cm"
    assert words in note  # one of the measures that change most


TIP = """
units = ["m", "m^3/h"]
tank = [{ shape = "cone", diameter = 2.0, height = 2.0, level = 0.2 }]
pump = [{ to = 1, high = 15.0, initial = 3.72 }]
valve = [{ from = 1, area = "8.8 cm^2", initial = 0.7 }]
plant = { bottom = true }
controller = { kind = "open-loop" }
reference = { initial = [0.2] }
values = { "clock.dt" = 10.0, "clock.duration" = 600.0 }
"""
"""It settles where the valve passes what the pump brings: (q / a)^2 / 2 g = 0.1434 m."""


@pytest.mark.extended_for("10.0-False")
@pytest.mark.parametrize("dt, right", [(10.0, False), (5.0, True), (0.5, True)])
def test_a_level_near_the_tip_of_a_cone_is_right_or_refused(tmp_path, capsys, dt, right):
    """In 5 s 6.7 times as much flows as the cone holds; steps follow it, up to 6.7 s."""
    text = TIP.replace("= 10.0,", f"= {dt},")
    (tmp_path / "tip.toml").write_text(text)
    level = (3.72 / 3600 / (8.8e-4 * 0.7)) ** 2 / (2 * 9.81)
    last = float(finer(rig.loads(text), 1).x[-1, 0])
    assert (abs(last - level) < 1e-4) == right and (last > 1.15 * level) != right
    assert main.main(["simulate", str(tmp_path / "tip.toml")]) == (0 if right else 2)
    assert ("steps too long to follow tank 1" in capsys.readouterr().err) != right


def test_steps_past_the_tips_of_two_cones_are_one_note():
    second = '{ shape = "cone", diameter = 1.0, height = 1.0, level = 0.2, drain = "4 cm^2" }'
    text = TIP.replace("}]\npump", f"}}, {second}]\npump").replace("= 10.0,", "= 40.0,")
    with pytest.warns(step_size.StepWarning) as notes:
        case = rig.loads(text)
    narrow = step_size.narrow_tanks(case.loop, case.clock)
    (note,) = [str(x.message) for x in notes if "near the tip" in str(x.message)]
    assert "near the tip of tanks 1, 2: below" in note
    assert ", ".join(f"{narrow[k]:.2g}" for k in (0, 1)) in note


def test_a_cone_that_runs_empty_is_noted(tmp_path, capsys):
    """Without an inflow it is empty within a step; for some samples levels differ."""
    text = TIP.replace("initial = 3.72", "initial = 0.0").replace("level = 0.2", "level = 0.6")
    (tmp_path / "tip.toml").write_text(text)
    assert main.main(["simulate", str(tmp_path / "tip.toml")]) == 0
    assert "takes more liquid than there is" in capsys.readouterr().err


DRAWN = """
tank = [{ area = 20.0, rim = 20.0, level = 5.0 },
        { area = 900.0, rim = 20.0, level = 5.0, drain = 0.1 }]
pump = [{ gain = 1.0, to = 1, high = 12.0, initial = 5.0 },
        { gain = 1.0, from = 1, to = 2, high = 12.0, initial = 11.0 }]
controller = { kind = "open-loop" }
reference = { initial = [5.0, 5.0] }
values = { "clock.dt" = 4.0, "clock.duration" = 200.0 }
"""
"""Pump 2 takes more than pump 1 brings: tank 1 runs empty, and stays so."""


@pytest.mark.extended_for("4.0-True")
@pytest.mark.parametrize("dt, noted", [(4.0, True), (0.1, False)])
def test_a_tank_that_a_pump_empties_is_empty(tmp_path, capsys, dt, noted):
    """On the way there a level differs by what a step of 4 s takes."""
    text = DRAWN.replace("= 4.0,", f"= {dt},")
    (tmp_path / "drawn.toml").write_text(text)
    last = float(finer(rig.loads(text), 1).x[-1, 0])
    assert last == pytest.approx(0.0, abs=1e-12)
    assert main.main(["simulate", str(tmp_path / "drawn.toml")]) == 0
    said = capsys.readouterr().err
    assert ("near the bottom of tank 1, from which a pump draws, a step takes" in said) == noted


def test_a_fault_that_strengthens_a_pump_counts_in_the_largest_inflow():
    text = """
tank = [{ area = 20.0, rim = 20.0, level = 5.0, drain = 0.1 }]
pump = [{ gain = 8.0, to = 1, high = 12.0, initial = 6.0 }]
law = { kind = "open-loop", initial = [6.0] }
values = { "clock.dt" = 0.5, "clock.duration" = 20.0 }
fault = [{ of = "pump_gain[0]", start = 5.0, end = 10.0, factor = 2.5, extra = 1.0 }]
"""
    case = rig.loads(text)
    inflow = step_size._largest_inflow(case.loop, case.clock, np.array([[3.0], [0.0]]))
    np.testing.assert_allclose(inflow, [(2.5 * 8.0 + 1.0) * 3.0, 0.0], rtol=1e-12)


def test_a_plant_without_shapes_has_no_narrow_tank_and_the_others_are_counted(monkeypatch):
    plant = types.SimpleNamespace(rim=[1.0, 1.0, 1.0], tanks=3)
    loop = types.SimpleNamespace(plant=plant, units=("cm", "V"))
    assert step_size.narrow_tanks(loop, None) == {}
    items = [step_size.Unstable(k, 0.1 * (k + 1), "remedy") for k in range(3)]
    for count in (2, 3):
        monkeypatch.setattr(step_size, "_visible", lambda *_, count=count: items[:count])
        assert f" {count - 1} more" in step_size.step_warnings(loop, None)[0]
