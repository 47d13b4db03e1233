"""The command line as its callers see it: exit codes, JSON keys, files, and one line for whatever
cannot be used.
"""

import contextlib
import io
import json
import math
import os
import shlex
import subprocess
import sys

import helpers
import jax
import matplotlib.image
import numpy as np
import pytest
from helpers import ONE_TANK, assert_same_tree, command as say, no_live_page

import jaxtank
import tuning
from jaxtank import measures, presets, rig
from jaxtank.core.clock import Clock
from jaxtank.core.tree import parameters
from tuning.cli import main, values
from tuning.cli.commands import tuning as tune_command

CASE = "gouta2015/backstepping"
SHORT = ("--set", "clock.duration=200", "--dt", "0.1")
OVERRIDES = {"clock.duration": 200, "clock.dt": 0.1}
SEARCH = ("--nominal", "--starts", "2", "--screening", "8")
ONE = ("--starts", "1", "--screening", "8")
QUICK = ("--starts", "1", "--screening", "1", "--iterations", "1", "--validation", "0")
RUN_KEYS = {"case", "measures", "units", "clock", "parameters", "provenance"}
TUNE_KEYS = {
    *("case", "method", "success", "status", "message", "parameters", "objective", "measures"),
    *("constraints", "evaluations", "wall_s", "bound", "validation", "provenance"),
}
MEASURES = {
    *("rms_error", "rms_error_total", "ise", "iae", "rms_input", "input_travel"),
    *("saturated_fraction", "max_level", "min_level", "overflow_volume", "overshoot_percent"),
    *("rise_time", "settling_time", "recovery_time", "estimation_rms"),
}


def done(*args):
    printed = say(*args)
    assert printed.code == 0, printed.err
    return printed


def shell(*args, **options):
    """Run the command in a process of its own."""
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True, "timeout": 120}
    return subprocess.run([sys.executable, *args], check=False, **pipes | options)


def setting(*assignments):
    return [part for value in assignments for part in ("--set", value)]


def read_csv(path):
    head, *rows = path.read_text(encoding="utf-8").splitlines()
    return head.split(","), np.array([[float(v) for v in row.split(",")] for row in rows])


def assert_picture(path):
    image = matplotlib.image.imread(path)
    assert min(image.shape[:2]) > 100 and image[..., :3].std() > 0.01  # not a blank sheet


def assert_close(printed, expected, rtol=1e-12):
    """Measures as JSON beside measures as arrays; the same program compiled for other outputs may
    round differently.
    """
    for name, value in expected.items():
        value = np.where(np.isfinite(value), value, np.nan)  # JSON has null for no number
        number = np.array(printed[name], dtype=float)
        np.testing.assert_allclose(number, value, rtol=rtol, atol=1e-14, err_msg=name)


def measured(case):
    names = [
        m for m in measures.MEASURES if m in measures.reported() and measures.serves(m, case.loop)
    ]
    return jaxtank.evaluate(case.loop, case.clock, names)


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """An empty folder to be in."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


# what there is


def test_list_prints_every_case():
    named = [line.split()[0] for line in done("list", "--all").out.splitlines()[:-1]]
    assert named == presets.names()
    *rows, last = done("list").out.splitlines()
    firsts, counts = [row.split()[0] for row in rows], [row.split()[1] for row in rows]
    assert set(firsts) < set(named) and len(rows) < 25 and last.startswith(f"{len(named)} cases")
    assert len(rows) + sum(int(n) for n in counts if n.isdigit()) == len(named)
    titles = {name: presets.find(name).title for name in presets.names()}
    printed = done("list", "--json").json
    assert {name: printed[name] for name in titles} == titles


@pytest.mark.slow
def test_show_prints_every_parameter_with_its_unit_and_range():
    printed = done("show", CASE)
    rows = {}  # two tables, each with the names in front
    for line in printed.out.partition("Every parameter\n")[2].splitlines():
        name, *words = line.split() or [""]
        if "." in name and line[:1].strip():
            rows[name] = " ".join([*rows.get(name, "").split(), *words])
    assert rows["controller.k1"].startswith("0.088 1/s 0.001 : 5 gain k1")
    assert rows["plant.rim"].startswith("30 30 30 30 cm")
    static = {"reference.shape*", "plant.overflow*", "clock.dt*", "clock.substeps*"}
    assert static | {"reference.ramp"} <= set(rows)
    assert "not in use" in rows["actuator.dead_zone"] and printed.err == ""


def test_show_json_follows_set():
    page = done(
        "show",
        CASE,
        "--json",
        *setting("controller.k1=0.1", "actuator.lag=0.5", "reference.ramp=30"),
    ).json
    assert page["case"] == CASE and page["plant"] == "TankNetwork" and page["law"] == "Backstepping"
    row = lambda n: [page["parameters"][n][k] for k in ("value", "unit", "low", "high", "static")]
    assert row("controller.k1") == [0.1, "1/s", 0.001, 5.0, False]
    assert row("reference.ramp") == [30.0, "s", None, None, False]
    assert row("actuator.lag")[0] == [0.5, 0.5] and row("actuator.dead_zone")[0] is None
    # what the paper prints stays what it prints
    assert page["published"]["controller.k1"][0] == 0.088
    assert page["limits"] == {"max_level": "rim"} and page["departures"]


def test_init_prints_a_rig_file_that_is_the_case(folder):
    more = setting("plant.overflow=true", "plant.area[1]=20")
    printed = done("init", CASE, *SHORT, *more)
    (folder / "mine.toml").write_text(printed.out, encoding="utf-8")
    changes = {**OVERRIDES, "plant.overflow": True, "plant.area[1]": 20.0}
    case, again = rig.set_values(presets.find(CASE), changes), rig.load(folder / "mine.toml")
    assert_same_tree(again.loop, case.loop)
    assert again.clock == case.clock
    assert done("init", "mine.toml").out == printed.out  # a rig file stands wherever a case may


def test_version_and_help():
    assert done("--version").out.strip() == jaxtank.__version__
    for args in (["--help"], ["tune", "--help"]):
        with pytest.raises(SystemExit) as caught, contextlib.redirect_stdout(io.StringIO()) as out:
            main.main(args)
        assert caught.value.code == 0 and "usage: jaxtank" in out.getvalue()


# simulate


@pytest.fixture(scope="module")
def simulated():
    """JSON of the short run."""
    return done("simulate", CASE, *SHORT, "--json").json


def test_simulate_json_has_the_keys_of_the_contract_and_the_values_of_the_library(simulated, gouta):
    assert set(simulated) >= RUN_KEYS and simulated["case"] == CASE
    assert MEASURES <= simulated["measures"].keys() <= simulated["units"].keys()
    assert simulated["clock"] == {"dt": 0.1, "duration": 200.0, "substeps": 1, "integrator": "rk4"}
    case = gouta("backstepping", OVERRIDES)
    assert_close(simulated["measures"], measured(case))
    assert simulated["parameters"].keys() == parameters(case.loop).keys()
    assert_close(simulated["parameters"], parameters(case.loop), rtol=0)
    assert simulated["provenance"]["dtype"] == "float64" and simulated["provenance"]["seed"] == 0


def test_what_is_not_a_number_is_null_with_a_reason(tank_file):
    # nothing changes in 0.8 s
    result = done("simulate", tank_file, *setting("clock.duration=0.8"), "--json").json
    printed, result = result, result["measures"]
    assert result["settling_time"] == [None] and result["recovery_time"] is None
    nothing = {m for m, v in result.items() if v is None or (isinstance(v, list) and None in v)}
    assert nothing == set(printed["reasons"]) and all(printed["reasons"].values())


def test_simulate_prints_a_table_of_the_same_numbers(simulated):
    words = " ".join(done("simulate", CASE, *SHORT, "--all").out.split())
    assert MEASURES - {"recovery_time"} <= set(words.split())
    brief = " ".join(done("simulate", CASE, *SHORT).out.split())
    assert len(MEASURES & set(brief.split())) == 5 and "--all" in brief
    total = simulated["measures"]["rms_error_total"]
    levels = simulated["measures"]["max_level"]
    for text in (words, brief):  # five digits are printed
        assert f"total RMS error [cm] {total:.5g}" in text
        assert all(f"tank {i + 1} {level:.5g}" in text for i, level in enumerate(levels))


@pytest.mark.slow
def test_simulate_writes_the_run(folder, gouta):
    printed = done("simulate", CASE, *SHORT, "--out", "deep/out", "--json")
    out = folder / "deep" / "out"
    names = {"result.json", "trajectory.csv", "responses.png", "report.html"}
    assert {p.name for p in out.iterdir()} == names and all(n in printed.err for n in names)
    assert json.loads((out / "result.json").read_text(encoding="utf-8")) == printed.json
    # writing again is no error
    assert done("simulate", CASE, *SHORT, "--out", "deep/out", "--quiet").err == ""
    assert_picture(out / "responses.png")
    head, rows = read_csv(out / "trajectory.csv")
    case = gouta("backstepping", OVERRIDES)
    run = jaxtank.simulate(case.loop, case.clock)
    columns = [run.t[:, None], run.x, run.y, run.r, run.u, run.command, run.spilled]
    signals = zip(
        ["h", "y", "r", "u", "command", "spilled"],
        ["cm", "cm", "cm", "V", "V", "cm^3"],
        (4, 4, 2, 2, 2, 4),
    )
    heads = (f"{name}{i + 1} [{unit}]" for name, unit, count in signals for i in range(count))
    assert head == ["t [s]", *heads]
    # ten digits are written
    np.testing.assert_allclose(rows, np.hstack(columns), rtol=1e-9, atol=1e-12)


@pytest.mark.slow
def test_a_long_run_is_thinned_in_the_file_alone(folder, gouta):
    result = done("simulate", CASE, "--dt", "0.1", "--out", "out", "--json").json
    _, rows = read_csv(folder / "out" / "trajectory.csv")
    case = gouta("backstepping", {"clock.dt": 0.1})
    assert 1000 < len(rows) < 4000 < case.clock.samples
    x = jaxtank.simulate(case.loop, case.clock).x[:: round(rows[1, 0] / 0.1)]
    np.testing.assert_allclose(rows[:, 1:5], x, rtol=1e-9)
    assert_close(result["measures"], measured(case))


@pytest.mark.slow_for(
    "actuator.saturation", "clock.substeps", "plant.drain[2]", "plant.overflow", "reference.ramp"
)
@pytest.mark.parametrize(
    "changes",
    [
        {"controller.k1": 0.2},
        {"plant.drain[2]": 0.01, "plant.area": [20.0, 21.0, 22.0, 23.0], "actuator.lag": 0.5},
        {"reference.ramp": 30.0, "reference.shape": "quintic"},
        {"actuator.saturation": "boxqp", "actuator.high": 3.0},
        {"plant.overflow": True, "plant.rim": 7.0},
        {"clock.substeps": 2, "clock.integrator": "midpoint"},
    ],
    ids=lambda changes: next(iter(changes)),
)
def test_set_reaches_leaves_entries_and_static_fields(simulated, gouta, changes):
    word = lambda v: str(v).lower() if isinstance(v, bool) else str(v).replace(" ", "")
    words = setting(*(f"{n}={word(v)}" for n, v in changes.items()))
    result = done("simulate", CASE, *SHORT, *words, "--json").json["measures"]
    assert_close(result, measured(gouta("backstepping", {**OVERRIDES, **changes})))
    assert result["rms_error_total"] != simulated["measures"]["rms_error_total"]


def test_dt_is_short_for_the_clock_and_order_does_not_matter():
    init = lambda *words: done("init", CASE, *words).out
    # the duration alone is shorter than the preset's own dt
    for pair in (("clock.duration=0.005", "clock.dt=0.001"), ("clock.duration=200", "clock.dt=1")):
        text = init(*setting(*pair))
        assert text == init(*setting(*pair[::-1]))
        assert all('"{}" = {}'.format(*word.split("=")) in text for word in pair)
    assert text == init("--set", "clock.duration=200", "--dt", "1")


@pytest.mark.slow
def test_the_seed_decides_the_noise_and_nothing_else():
    short = ("cascaded/pi", "--dt", "4", "--json")
    noisy = ("simulate", *short, "--set", "sensor.noise=0.05", "--seed")
    first, same, other = (done(*noisy, seed) for seed in "112")
    assert first.out == same.out and first.json["measures"] != other.json["measures"]
    # 1025 deviates: one sigma is 2.2 %
    assert math.isclose(first.json["measures"]["estimation_rms"][0], 0.05, rel_tol=0.12)
    quiet = [done("simulate", *short, "--seed", seed).json["measures"] for seed in "07"]
    assert quiet[0] == quiet[1]


def test_a_run_that_leaves_the_numbers_is_reported_and_nothing_is_written(folder):
    printed = say("simulate", CASE, *SHORT, "--set", "controller.k=1e308", "--out", "out")
    assert printed.code == 2 and printed.out == "" and printed.errors.count("\n") == 1
    assert all(word in printed.err for word in ("tanks 1 to 4", "t = 0.1 s", "controller.k1"))
    assert list(folder.iterdir()) == []


# tune


@pytest.fixture(scope="module")
def tank_file(tmp_path_factory):
    """A rig file of one tank, whose programs are small."""
    path = tmp_path_factory.mktemp("one") / "one.toml"
    path.write_text(ONE_TANK, encoding="utf-8")
    return str(path)


TUNE = (*SEARCH, "--validation", "8", "--free", "controller.Kc=0.05:50", "--limit", "max_level=3")


@pytest.fixture(scope="module")
def tuned(tank_file, tmp_path_factory):
    """One search, with its files: (output, folder)."""
    folder = tmp_path_factory.mktemp("tuned") / "out"
    with no_live_page():
        return say("tune", tank_file, *TUNE, "--json", "--out", str(folder)), folder


def test_tune_json_has_the_keys_of_the_contract(tuned):
    printed, _ = tuned
    assert printed.code == 0, printed.err
    result = printed.json
    assert set(result) >= TUNE_KEYS
    ended = (result["case"], result["success"], result["status"])
    assert ended == ("one tank", True, "converged")
    assert set(result["parameters"]) == {"controller.Kc[0]"}
    p = result["parameters"]["controller.Kc[0]"]
    assert set(p) >= {"before", "after", "unit", "lower", "upper", "at_bound", "interval"}
    assert (p["before"], p["unit"], p["lower"], p["upper"]) == (1.0, "V/cm", 0.05, 50.0)
    assert p["lower"] <= p["after"] <= p["upper"]
    assert all(result["measures"][when].keys() >= MEASURES for when in ("before", "after"))
    (c,) = result["constraints"]
    (level,) = result["measures"]["after"]["max_level"]
    assert (c["name"], c["tank"]) == ("max_level of tank 1", 1)
    assert (c["limit"], c["value"], c["margin"]) == (3.0, level, c["limit"] - level)
    assert c["margin"] >= 0 and 0 <= c["time_s"] <= 40
    assert result["evaluations"]["simulations"] >= result["evaluations"]["gradients"] > 0
    assert result["bound"] is None and result["wall_s"] > 0 and result["validation"]["samples"] == 8
    assert set(result["validation"]["objective"]["after"]) == {"mean", "p05", "p50", "p95"}
    assert result["scenarios"] == [] and result["choices"] == [] and result["tradeoff"] is None


@pytest.mark.slow
def test_tune_is_no_worse_than_its_start_and_its_numbers_are_of_its_runs(tuned, tank_file):
    result = tuned[0].json
    assert result["objective"]["after"] < result["objective"]["before"]
    for when in ("before", "after"):
        gain = {n: p[when] for n, p in result["parameters"].items()}
        assert_close(result["measures"][when], measured(rig.set_values(rig.load(tank_file), gain)))
        assert result["objective"][when] == result["measures"][when]["rms_error_total"]


def test_tune_reports_its_progress_on_stderr_and_quiet_does_not(tuned, tank_file):
    assert all(words in tuned[0].err for words in ("start 1/2", "best ", "written to"))
    printed = done("tune", tank_file, *TUNE, "--quiet")
    assert printed.err == ""
    assert all(w in printed.out for w in ("one tank: converged", "controller.Kc", "tank 1"))


def test_tune_writes_result_rig_trajectory_and_pictures(tuned):
    printed, folder = tuned
    names = {p.name for p in folder.iterdir()}
    pictures = {"responses", "rig", "margins", "convergence", "landscape", "saturation"}
    pictures |= {"clouds"}
    files = {"result.json", "rig.toml", "trajectory.csv", "before.csv", "report.html"}
    assert names == files | {f"{picture}.png" for picture in pictures}
    assert json.loads((folder / "result.json").read_text(encoding="utf-8")) == printed.json
    for picture in folder.glob("*.png"):
        assert_picture(picture)


def test_the_tuned_rig_runs_to_the_measures_of_the_result(tuned):
    printed, folder = tuned
    result = done("simulate", str(folder / "rig.toml"), "--json").json
    assert result["case"] == "one tank"
    margins = ("sensitivity_peak", "gain_margin", "phase_margin", "delay_margin")  # of `--margins`
    undefined = ("recovery_time", *margins)
    after = {m: v for m, v in printed.json["measures"]["after"].items() if m not in undefined}
    assert_close(result["measures"], {m: np.array(v, dtype=float) for m, v in after.items()})
    case = rig.load(folder / "rig.toml")
    head, rows = read_csv(folder / "trajectory.csv")
    assert head[:2] == ["t [s]", "h1 [cm]"]
    np.testing.assert_allclose(rows[:, 1:2], jaxtank.simulate(case.loop, case.clock).x, rtol=1e-9)


def test_the_same_seed_finds_the_same(tuned, tank_file):
    again = done("tune", tank_file, *TUNE, "--json", "--quiet").json
    assert again | {"wall_s": 0} == tuned[0].json | {"wall_s": 0}


@pytest.mark.slow
def test_tune_takes_what_is_free_limited_and_minimised_from_its_options():
    limits = ("--limit", "none", "--limit", "max_level=29.5", "--limit", "min_level=0.5")
    objective = ("--objective", "iae=1", "--objective", "input_travel=0.5")
    words = ("--free", "controller.k1=0.02:1", *limits, *objective)
    result = done("tune", CASE, *SHORT, *SEARCH, "--json", *words).json
    ((name, p),) = result["parameters"].items()
    assert (name, p["lower"], p["upper"]) == ("controller.k1", 0.02, 1.0)
    expected = [
        (f"{m} of tank {i}", v)
        for m, v in (("max_level", 29.5), ("min_level", 0.5))
        for i in (1, 2, 3, 4)
    ]
    assert [(c["name"], c["limit"]) for c in result["constraints"]] == expected
    assert all(c["margin"] >= 0 for c in result["constraints"])
    after = result["measures"]["after"]
    cost = sum(after["iae"]) + 0.5 * sum(after["input_travel"])
    assert math.isclose(result["objective"]["after"], cost, rel_tol=1e-12)


@pytest.mark.slow
def test_scenarios_choices_trade_off_and_bound_from_the_command_line(folder):
    words = shlex.split(
        "--scenario 'name=noise;sensor.noise=0.02;weight=2' --scenario 'reference.ramp=40;seed=5'"
        " --choose controller.reference_rates=false,true --tradeoff max_level=24:28:2 --bound"
        " --validation 4 --json --quiet --out out"
    )
    result = done("tune", CASE, *SHORT, *ONE, *words).json
    weights = [(s["name"], round(s["weight"], 6)) for s in result["scenarios"]]
    assert weights == [("noise", 0.666667), ("reference.ramp=40;seed=5", 0.333333)]
    rates = [row["values"]["controller.reference_rates"] for row in result["choices"]]
    assert rates == [False, True]
    assert [p["limit"] for p in result["tradeoff"]["points"]] == [28.0, 24.0]
    assert result["validation"]["samples"] == 4
    assert 0 < result["bound"]["cost"] < result["objective"]["after"]
    assert json.loads((folder / "out" / "result.json").read_text(encoding="utf-8")) == result


NOISY = ("tune", "calofir/backstepping", "--free", "controller.K_phi=0.001:1", "--limit", "none")
NOISY += (*QUICK, "--nominal", *setting("clock.duration=60", "sensor.noise=0.005"))


@pytest.mark.slow
def test_what_is_set_holds_in_the_scenarios_of_the_case():
    printed = say(*NOISY, "--json")
    changes = {"clock.duration": 60.0, "sensor.noise": 0.005}
    case = rig.set_values(presets.find("calofir/backstepping"), changes)
    key = jax.random.fold_in(jax.random.key(0), 1)
    result = jaxtank.evaluate(case.loop, case.clock, list(case.objective), key)
    cost = sum(w * float(np.sum(result[m])) for m, w in case.objective.items())
    assert printed.json["scenarios"][0]["objective"]["before"] == pytest.approx(cost, rel=1e-9)
    assert "also replaces the value of sensor.noise in 1 scenario ('noise')" in printed.err


def test_numbers_of_a_file_are_kept_and_what_is_set_takes_their_place(folder):
    """Numbers of a [[scenario]] are its author's, --set is of whoever runs it: an entry after its
    array, a factor on what is set."""
    text = f'case = "{CASE}"\n[[scenario]]\nname = "a"\n'
    text += 'values = { "sensor.noise" = 0.1, "x0" = [1, 2, 3, 4], "plant.drain" = "x1.1" }\n'
    (folder / "rig.toml").write_text(text, encoding="utf-8")
    assert rig.load("rig.toml").scenarios[0].values["sensor.noise"] == 0.1
    changes = setting("sensor.noise=0.3", "x0[1]=5", "plant.drain=0.4")
    printed = done("init", "rig.toml", *changes, "--quiet")
    (folder / "set.toml").write_text(printed.out, encoding="utf-8")
    again = rig.load("set.toml")
    loop = rig.set_scenario(again, again.scenarios[0].values).loop
    assert loop.sensor.noise.tolist() == [0.3] * 4 and loop.x0.tolist() == [1.0, 5.0, 3.0, 4.0]
    assert loop.plant.drain.tolist() == [1.1 * 0.4] * 4


APART = "controller.model.pump_gain = [27.43, 19.55] cm^3/(s V), and plant.pump_gain = [35, 25]"


def test_a_plant_that_is_set_leaves_the_model_with_a_note():
    err = lambda gain, *more: (
        say("show", "mirakhorli/sfc", "--json", *setting(f"plant.pump_gain={gain}"), *more).err
    )
    assert err("[35,25]").count(APART) == 1
    assert "controller.model" not in err("[28,20]")  # within 5 %
    assert err("[35,25]", "--quiet") == ""


@pytest.mark.slow
def test_a_limit_that_cannot_be_met_ends_with_4_and_the_best_of_it(folder):
    # the whole run asks for 8 cm and more from 20 s on; the short one starts above 2 cm
    for clock, limit in ((("--dt", "0.1"), 5.0), ((*SHORT, "--out", "out"), 2.0)):
        words = (*clock, *SEARCH, "--limit", f"max_level={limit}", "--json", "--quiet")
        printed = say("tune", CASE, *words)
        assert printed.code == 4, printed.err
        result = printed.json
        assert (result["success"], result["status"]) == (False, "infeasible")
        broken = min(result["constraints"], key=lambda c: c["margin"])
        assert broken["margin"] < 0 and broken["limit"] == limit < broken["value"]
    assert json.loads((folder / "out" / "result.json").read_text(encoding="utf-8")) == result
    assert rig.load(folder / "out" / "rig.toml").clock == Clock(dt=0.1, duration=200.0)


@pytest.mark.slow
def test_too_few_iterations_end_with_3():
    printed = say("tune", CASE, *SHORT, *QUICK, "--nominal", "--json", "--quiet")
    assert printed.code == 3 and "--iterations" in printed.json["message"]
    assert (printed.json["success"], printed.json["status"]) == (False, "not_converged")


@pytest.mark.slow
def test_an_interrupted_search_ends_with_130_and_its_best_point_is_written(folder, monkeypatch):
    class Impatient(tune_command.Progress):
        def __call__(self, event):
            if event["evaluations"] == 3:
                raise KeyboardInterrupt

    monkeypatch.setattr(tune_command, "Progress", Impatient)
    printed = say("tune", "gouta2015/ngpc", *SHORT, *SEARCH, "--json", "--out", "out")
    assert printed.code == 130 and printed.json["status"] == "interrupted"
    result = printed.json
    assert result["objective"]["after"] <= result["objective"]["before"]
    Tp = rig.load(folder / "out" / "rig.toml").loop.controller.Tp
    assert Tp == result["parameters"]["controller.Tp"]["after"]


@pytest.mark.slow
def test_a_trade_off_that_is_interrupted_costs_itself_and_not_the_answer(folder, monkeypatch):
    class Late(tune_command.Progress):
        def __call__(self, event):
            pass

        def check(self, *_):  # called by what follows the search
            self.stop = True
            raise KeyboardInterrupt

    monkeypatch.setattr(tune_command, "Progress", Late)
    more = ("--tradeoff", "max_level=24:26:2", "--json", "--out", "out")
    printed = say("tune", "gouta2015/ngpc", *SHORT, *SEARCH, *more)
    assert printed.code == 130 and printed.json["status"] != "interrupted"
    assert (folder / "out" / "rig.toml").exists() and printed.json.get("tradeoff") is None


@pytest.mark.slow
def test_an_objective_that_no_run_can_give_is_reported():
    # before 20 s nothing changes, so nothing settles: the objective is not a number anywhere
    clock = (*setting("clock.duration=10"), "--dt", "0.1", "--quiet", "--nominal")
    printed = say("tune", CASE, *clock, *QUICK, "--objective", "settling_time=1")
    assert printed.code in (2, 3) and "settling_time" in printed.out + printed.err


# bench


@pytest.mark.slow
def test_bench_reports_what_a_step_costs():
    result = done("bench", "--rounds", "1", "--json").json
    assert result["steps"] == 120_001 and CASE in result["rows"]
    assert all(row["ns_per_step"] > 0 for row in result["rows"].values())
    # the same arithmetic in another language
    assert result.get("difference_to_c_cm", 0.0) < 1e-9


# bad input

RIGS = {
    "broken.toml": "case = = 3",
    "text.txt": "x",
    "far.toml": f'case = "{CASE}"\n[reference]\nchanges = [[20.0, 1, 16.0]]\n',
    "zero.toml": f'case = "{CASE}"\n[reference]\nchanges = [[20.0, 1, 0.0]]\n',
    "limit.toml": f'case = "{CASE}"\n[limits]\nmax_levl = 3\n',
    "bare.toml": 'case = "cascaded/pi"\nuncertain = {}\n',
    "still.toml": 'case = "cascaded/pi"\n[reference]\ninitial = [4.0]\nchanges = []\n',
}
# a line of the shell, C the case and S "simulate C --set", and what the message must hold
BAD = {
    "simulat C": "unknown command 'simulat'; nearest: simulate",
    "simulate": "CASE",
    "simulate C --bogus": "unknown option '--bogus'",
    "simulate C --sed 3": "unknown option '--sed'; nearest: --se",
    "simulate C extra": "'extra'",
    "show C --starts 3": "--starts",
    "simulate C --set": "--set",
    "simulate gouta2015/backsteping": "nearest: gouta2015/backstepping",
    "init ''": "unknown case ''",
    "simulate missing.toml": "'missing.toml' does not exist",
    "simulate broken.toml": "'broken.toml' is not TOML",
    "tune far.toml": "outputs (16, 3) cm have no steady state: the outflow of tank 4",
    "simulate zero.toml": "'zero.toml': reference.targets[0] = 0 cm: must be above 0 cm",
    "tune limit.toml": "unknown measure 'max_levl'; nearest: max_level",
    "tune C --objective isee=1 --limit overshot=1": "measure 'isee'; unknown measure 'overshot'",
    "S controller.kk=1": "unknown parameter 'controller.kk'; nearest: controller.k",
    "S plant=1": "unknown parameter 'plant'",
    "S plant.area[7]=1": "plant.area[7]",
    "S plant.area": "--set 'plant.area': must be NAME=VALUE",
    "S =3": "--set '=3': must be NAME=VALUE",
    "S plant.area[0][0]=90": "or, of a matrix, component.field[i,j]",
    "S plant.area=1,2,3": "plant.area has shape (3,): must be a number or shape (4,)",
    "S plant.area=": "plant.area",
    "S controller.k=1_000": "controller.k = '1_000': must be a number",
    "S reference.initial[0]=16": "outputs (16, 3) cm have no steady state: the outflow of tank 4",
    "S plant.overflow=yes": "plant.overflow = 'yes': must be one of false, true",
    "S sensor.noise=0,05": "write 0.05, with a point, for a number, or [0, 5] for a list",
    "S controller.k=-1,5e-2": "write -1.5e-2, with a point",
    "S plant.rim=1.000,5": "write 1000.5, with a point",
    "S sensor.noise=[1,]": "--set 'sensor.noise=[1,]': an entry of the list is empty",
    "S sensor.noise=,": "an entry of the list is empty",
    "S sensor.noise=0,05,0,05": "entry 05 begins with a zero",
    "simulate C --dt 0": "clock.dt = 0",
    "simulate C --dt soon": "--dt = 'soon': must be a number",
    "simulate C --dt 1e-9": "samples",
    "simulate C --seed x": "--seed 'x'",
    "simulate C --seed -1": "--seed '-1': must be a whole number from 0 to 2147483647",
    "simulate C --out text.txt": "'text.txt' is a file",
    "simulate C --schedule controller.k=r1:3,,6": "an entry of the list is empty",
    "tune C --out text.txt/in": "text.txt",
    "tune C --free controller.k=5:1": "controller.k = 5:1: must be LOW:HIGH",
    "tune C --free controller.k=a:b": "must be NAME=LOW:HIGH",
    "tune C --free controller.k=0.01:1:cubic": "cubic",
    "tune C --free controller.k": "controller.k",
    "tune C --free controller.k=1:5": "controller.k = 0.03 1/s: starts outside its range 1:5 1/s",
    "tune C --free clock.dt=0.01:0.1": "clock.dt: cannot be tuned",
    "tune C --free actuator.lag=0.1:2": "actuator.lag",
    "tune C --free plant.area=10:30 --free plant.area[0]=10:30": "plant.area[0] is given twice",
    "tune C --limit max_levl=30": "unknown measure 'max_levl'; nearest: max_level",
    "tune C --limit max_level": "--limit 'max_level'",
    "tune C --limit max_level=high": "limit max_level = 'high': must be a finite number [cm]",
    "tune C --limit phase_margin=500": "phase_margin = 500 deg: must be at most 180 deg",
    "tune C --limit gain_margin=-2": "gain_margin = -2: must be at least 1;",
    "tune C --limit iae=-1": "limit iae = -1 cm s: must be at least 0 cm s",
    "tune C --limit max_level=[1,2]": "or 4 of them",
    "tune C --limit max_level=30,5": "the comma may be a decimal one: write 30.5",
    "tune C --scenario sensor.noise": "--scenario 'sensor.noise': must be NAME=VALUE",
    "tune C --scenario sensor.noise=0,02": "the comma may be a decimal one",
    "tune C --scenario sensor.nois=0.1": "nearest: sensor.noise",
    "tune C --scenario controller.k=1": "sets controller.k, which is free",
    "tune C --scenario seed=1.5": "seed = 1.5: must be a whole number",
    "tune C --scenario weight=0": "weight = 0 must be a finite number above 0",
    "tune C --set sensor.noise=0.1 --scenario sensor.noise=0.1": "which --set or --dt sets too",
    "tune C --choose clock.substeps=1,,2": "must be values with commas",
    "tune C --choose controller.k=0,05": "must be values with commas",
    "tune C --choose controller.reference_rate=true": "'controller.reference_rate'",
    "tune C --choose controller.reference_rates=3": "must be one of false, true",
    "tune C --method newton": "--method 'newton': must be one of auto, trf",
    "tune C --method trf": "trf cannot hold limits",
    "tune C --objective rms=1": "unknown measure 'rms'; nearest: rms_",
    "tune C --starts 0": "--starts '0': must be a whole number from 1",
    "tune C --screening many": "--screening 'many'",
    "tune C --iterations 0": "--iterations '0'",
    "tune C --tradeoff max_level=30:20": "--tradeoff 'max_level=30:20'",
    "tune still.toml --tradeoff rise_time=10:20:2": "no setpoint has a step within its 200 s",
    "tune C --tradeoff max_levl=20:30": "unknown measure 'max_levl'; nearest: max_level",
    "tune C --batch 2 --method slsqp": "only method adam",
    "tune C --resume ''": "--resume",
    "tune C --resume out/deep": "'out/deep': cannot be read as a run",
    "tune C --resume . --out b": "different folders",
    "tune C --samples 8": "belong to --robust",
    "tune C --robust mean --back-off 2": "from 0 to below 1",
    "tune C --robust best": "--robust 'best': must be one of mean, cvar, worst",
    "tune C --robust mean --scenario sensor.noise=0.1": "omit --choose",
    "tune C --starts 0 --seed x --limit max_levl=3": "--starts '0'; --seed 'x'; unknown measure",
    "uncertainty C --samples 0": "--samples '0'",
    "uncertainty C --vary plant.drian=uniform:5%": "plant.drain",
    "uncertainty C --vary plant.drain=beta:1": "must be uniform:LOW:HIGH",
    "uncertainty C --vary plant.drain=uniform:200%": "at least 0 cm^2",
    "uncertainty C --vary plant.drain=uniform:5% --spread 0.1": "give one of them",
    "uncertainty C --spread 2": "--spread '2': must be a share between 0 and 1",
    "uncertainty C --draws halton": "must be one of random, latin, sobol",
    "uncertainty C --measure rms": "unknown measure 'rms'",
    "uncertainty C --devices 0": "--devices '0'",
    "bench --rounds 0": "--rounds '0'",
    "simulate C --time m:s": "--time needs --data",
    "simulate C --column t=clock": "--column needs --data",
    "compare calofir --samples 10": "--samples: is of --controllers",
    "compare calofir --kind pid": "--kind: is of --controllers",
    "figure gouta2015/1": "shows no result that a run could redraw",
    "figure gouta2015/18": "unknown figure 'gouta2015/18'; nearest: gouta2015/",
    "figure gouta2015/6 --out a.bmp": "must end in .svg, .png, .pdf",
    "figure gouta2015/6 --out svg": "must end in .svg, .png, .pdf",
    "figure --out a.svg": "--out needs a figure",
    "simulate gouta2022/pi cascaded/pi": "control of tank 2 and gouta2022/pi has",
    "simulate gouta2022/pi gouta2015/ngpc": "has 4 tanks and gouta2022/pi has 2 tanks",
    "simulate gouta2022/pi gouta2022/pi": "give each case once",
    "simulate gouta2022/pi gouta2022/pdi": "'gouta2022/pdi'",
    "simulate gouta2022/pi gouta2022/pid --gif --out x": "--gif: of one case alone",
    "simulate gouta2022/pi gouta2022/pid --margins": "--margins: of one case alone",
    "simulate C --against cascaded/pi": "--against needs --gif",
    "simulate cascaded/pi --gif --out film --against cascaded/p": "nearest: cascaded/pi",
    "attack C --pumps ful --out out": "--pumps 'ful': must be one of own, full, random",
    "attack C --starts 0 --out out": "--starts '0'",
    "attack C --spread 2 --out out": "--spread '2'",
    "attack C --vary plant.drian=uniform:5% --out out": "plant.drain",
    "sensitivity cascaded/pid --out out": "unknown case 'cascaded/pid'",
    "sensitivity C --method sobel --out out": "--method 'sobel'",
    "sensitivity C --samples many --out out": "--samples 'many'",
    "sensitivity C --spread 5% --out out": "--spread '5%'",
    "sensitivity C --vary plant.drain=gauss:5% --out out": "plant.drain=gauss:5%",
    "sensitivity C --seed x --out out": "--seed 'x'",
    "uncertainty bare.toml --samples 2": "--vary NAME=; [uncertain]",
    "uncertainty bare.toml --spread 0.1": "--vary NAME=; [uncertain]",
    "sensitivity bare.toml": "--vary NAME=; [uncertain]",
    "S safety_filter.rate=0.1": "--safety-filter turns it on",
    "simulate C --safety-filter --set safety_filter.rat=0.1": "nearest: rate",
    # said twice, or beside what it contradicts
    "S controller.k=1 --set controller.k=9": "--set controller.k is given twice: give it once",
    "S plant.area[0]=1 --set ' plant.area[0] =1'": "--set plant.area[0] is given twice",
    "simulate C --schedule controller.k=r1:1,2 --schedule controller.k=r1:1,2": "k is given twice",
    "tune C --free controller.k=1:2 --free controller.k=1:3": "--free controller.k is given twice",
    "tune C --limit max_level=9 --limit max_level=8": "--limit max_level is given twice",
    "tune C --objective ise=1 --objective ise=2": "--objective ise is given twice: give it once",
    "tune C --choose clock.substeps=1,2 --choose clock.substeps=4": "substeps is given twice",
    "tune C --scenario 'sensor.noise=0.1;sensor.noise=0.2'": "--scenario sensor.noise is given",
    "identify C --free plant.area=1:2 --free plant.area=1:3": "--free plant.area is given twice",
    "uncertainty C --vary plant.area=uniform:5% --vary plant.area=uniform:9%": "is given twice",
    "bench --rounds 3 --rounds 4": "--rounds is given twice: give it once",
    "simulate C --dt 1 --set clock.dt=2": "--dt 1 beside --set clock.dt=2: give one of them",
    "identify C --plan --data a.csv --out b": "to fit --data 'a.csv'; --plan writes no files",
    "identify C --data a.csv --duration 300": "--duration ; belongs to a planned experiment",
    "identify C --data a.csv --voltage 3,3": "--voltage ; belongs to a planned experiment",
    "identify C --data a.csv --measure h1": "--measure ; belongs to a planned experiment",
}


@pytest.mark.parametrize("line", BAD)
def test_bad_input_is_reported_in_one_line_and_leaves_nothing(line, folder):
    for name, text in RIGS.items():
        (folder / name).write_text(text, encoding="utf-8")
    words = shlex.split(line.replace("S ", "simulate C --set ", 1) if line[:2] == "S " else line)
    words = [CASE if word == "C" else word for word in words]
    if words[2:] and words[0] in ("simulate", "tune"):
        # where a file could be left; quick, should it be taken for good
        usual = {"--set": "clock.duration=200", "--dt": "0.1", "--out": "out/deep"}
        usual |= dict.fromkeys(QUICK[:6:2] if words[0] == "tune" else (), "1")
        used = [word.partition("=")[0] for word in words]
        more = [w for pair in usual.items() if pair[0] not in words for w in pair]
        if "clock.duration" not in used and "--set" in words:
            more += setting("clock.duration=200")
        if "clock.dt" in used or "--resume" in words:
            more = [w for w in more if w not in ("--dt", "0.1", "--out", "out/deep")]
        words += [*more, "--json"]
    printed = say(*words)
    assert (printed.code, printed.out, printed.errors.count("\n")) == (2, "", 1), printed.err
    assert printed.err.startswith("jaxtank: ")
    # several problems: each of them, in the order of the line
    assert all(part in printed.err for part in BAD[line].split("; "))
    assert {p.name: p.read_text(encoding="utf-8") for p in folder.iterdir()} == RIGS


def test_a_matrix_is_read_by_its_rows():
    for text in ("[[0.1,0,-2e-3],[1,2 V/cm,3]]", "[ [0.1, 0, -2e-3], [1, 2 V/cm, 3] ]"):
        assert values.value_or_matrix(text) == [[0.1, 0, -0.002], [1, "2 V/cm", 3]]
    assert values.value_or_matrix("[[90]]") == [[90]]


def test_a_list_whose_comma_cannot_be_a_decimal_one_is_read():
    for text in ("[11, 12]", "[11,12]", "11.0,12.0", "11, 12"):
        assert values.value(text) == [11, 12]


@pytest.mark.parametrize(
    ("args", "other"),
    [
        (["simulate", CASE, "--bogus"], "--rounds"),
        (["show", CASE, "--seed", "3"], "--seed"),
        (["list", "--seed", "3"], "--seed"),
    ],
    ids=["simulate", "show", "list"],
)
def test_an_unknown_option_is_answered_with_options_of_its_own_command_once_each(args, other):
    near = say(*args).err.strip().partition("nearest: ")[2].split(", ")
    assert len(near) == len(set(near)) and other not in near


# a process of its own


def test_an_error_is_one_line_and_code_2_in_the_shell_too(tmp_path):
    words = ("simulate", CASE, "--set", "plant.area=-1", "--out", "out")
    ran = shell("-m", "jaxtank", *words, cwd=tmp_path)
    assert (ran.returncode, ran.stdout) == (2, "")
    assert ran.stderr == "jaxtank: plant.area[0] = -1 cm^2: must be above 0 cm^2\n"
    assert list(tmp_path.iterdir()) == []


def test_a_reader_that_has_left_is_no_error_and_changes_no_code():
    tank = str(helpers.RIGS / "watertank.toml")  # whose limits do not hold before tuning
    check = ("simulate", tank, "--check", "--quiet", "--all")
    for words, code in ((("completion", "bash"), 0), (check, 4)):
        reader, writer = os.pipe()
        os.close(reader)
        ran = shell("-m", "jaxtank", *words, stdout=writer)
        os.close(writer)
        assert (ran.returncode, ran.stderr) == (code, "")


# uncertainty

DRAWS = ("--vary", "plant.drain=uniform:5%", "--vary", "controller.k1=normal:0.1:0.01")


def test_uncertainty_json_has_the_keys_of_the_contract_and_the_numbers_of_the_library(tank_file):
    vary = {
        "plant.drain": tuning.Uniform(relative=0.05),
        "plant.rim": tuning.Normal(mean=3.0, sd=0.1),
    }
    words = ("--vary", "plant.drain=uniform:5%", "--vary", "plant.rim=normal:3:0.1")
    more = ("--samples", "24", "--seed", "2", "--json", "--quiet")
    result = done("uncertainty", tank_file, *words, *more).json
    assert set(result) >= {"case", "samples", "failed", "measures", "violations", "provenance"}
    assert result["samples"] == 24
    keys = {"mean", "sd", "p05", "p50", "p95", "cvar95", "max"}
    assert all(set(summary) >= keys for summary in result["measures"].values())
    keys = {"name", "limit", "count", "probability", "interval95"}
    assert all(set(v) >= keys for v in result["violations"])
    summary = tuning.ensemble(rig.load(tank_file), vary, samples=24, key=2).summary()
    assert result["measures"]["rms_error_total"]["p95"] == summary["rms_error_total"]["p95"]
    assert result["measures"]["max_level"]["max"] == summary["max_level"]["max"].tolist()


@pytest.mark.slow
def test_uncertainty_writes_its_result_and_no_batches(folder):
    done("uncertainty", CASE, *SHORT, *DRAWS, "--samples", "24", "--quiet", "--out", "one")
    names = {"result.json", "draws.csv", "report.html", "fan.png", "violations.png", "rig.png"}
    assert {p.name for p in (folder / "one").iterdir()} == names
    for picture in (folder / "one").glob("*.png"):
        assert_picture(picture)
    rows = (folder / "one" / "draws.csv").read_text().splitlines()
    assert len(rows) == 25 and rows[0].startswith("draw,failed,plant.drain[0],")


@pytest.mark.slow
def test_robust_tuning_from_the_command_line():
    words = shlex.split(
        "--robust worst --samples 4 --spread 0.02 --limit max_level=33"
        " --free controller.k1=0.01:1 --validation 0 --json --quiet"
    )
    result = done("tune", CASE, *SHORT, *words, *ONE).json
    assert result["certificate"]["scenarios"] == 4 == len(result["scenarios"])
    assert result["certificate"]["fresh"] == 1024
    assert all(c["margin"] >= 0 for c in result["constraints"]) and len(result["constraints"]) == 16


ROW = """
tank = [
    { area = 150.0, rim = 40.0, level = 12.0 },
    { area = 120.0, rim = 30.0, drain = 0.7, level = 9.0 },
    { area = 100.0, rim = 30.0, drain = 0.6, level = 8.0 },
]
orifice = [{ from = 1, to = 2, area = 0.7 }]
pump = [
    { gain = 15.0, to = 1, high = 10.0, initial = 6.0 },
    { gain = 10.0, to = 3, high = 12.0, initial = 7.0 },
]
plant = { outputs = [2, 3] }
controller = { kind = "pi", Kc = [0.6, 1.0], Ti = [100.0, 60.0] }
reference = { initial = [9.0, 8.0], changes = [[50.0, 1, 12.0], [200.0, 2, 10.0]], ramp = 0.0 }
values = { "clock.dt" = 1.0, "clock.duration" = 400.0, "clock.substeps" = 3 }
limits = { max_level = [30.0, 13.0, 11.0] }
"""


@pytest.mark.extended
@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="processors cannot be chosen")
def test_an_answer_does_not_depend_on_the_number_of_processors(tmp_path):
    """As many BLAS threads as processors gave another count of evaluations."""
    (tmp_path / "rig.toml").write_text(ROW)
    words = ["-m", "tuning.cli.main", "tune", "rig.toml", "--nominal", "--json", "--quiet"]
    first = {min(os.sched_getaffinity(0))}
    answers = []
    for chosen in (first, os.sched_getaffinity(0)):
        run = subprocess.run(
            [sys.executable, *words],
            cwd=tmp_path,
            stdout=subprocess.PIPE,
            preexec_fn=lambda chosen=chosen: os.sched_setaffinity(0, chosen),
        )
        answer = json.loads(run.stdout)
        answers.append({k: v for k, v in answer.items() if k != "wall_s"})
    assert answers[0] == answers[1]
