"""The four files of CONTRIBUTING.md, saved outside the package, imported, and used."""

import importlib.util
import json
import math
import re
import sys
import tomllib
from pathlib import Path

import jax
import numpy as np
import pytest
from helpers import command, registries_kept

import jaxtank
import tuning
from jaxtank import presets, rig
from jaxtank.core.errors import InputError
from jaxtank.export import export, source
from jaxtank.measures import catalogue
from tuning.cli.main import main

PAGE = next(p for p in Path(__file__).resolve().parents if (p / ".github").is_dir()) / (
    ".github/CONTRIBUTING.md"
)


@pytest.fixture
def added(tmp_path):
    """Save the code below the heading "Add a ..." as a module in a folder, and import it."""

    def add(what):
        section = PAGE.read_text().split(f"## Add {what}\n")[1].split("\n## ")[0]
        (code,) = re.findall(r"```python\n(.*?)```", section, re.DOTALL)
        path = tmp_path / f"own_{what.split()[-1]}.py"
        path.write_text(code)
        spec = importlib.util.spec_from_file_location(path.stem, path)
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        return module

    with registries_kept():
        yield add


RIG = """
case = "cascaded/pi"
name = "own"
controller = { kind = "biased-proportional", Kc = 1.0, bias = 4.0 }
values = { "clock.duration" = 400.0 }
reference = { initial = [4.0], changes = [[40.0, 1, 5.0]], ramp = 0.0 }
free = { "controller.Kc" = [0.05, 5.0] }
"""


@pytest.mark.slow
def test_a_controller_from_outside_runs_and_is_tuned_by_the_commands(added, tmp_path, capsys):
    path = tmp_path / "rig.toml"
    path.write_text(RIG)
    assert main(["simulate", str(path)]) == 2  # not registered yet
    added("a controller")
    assert main(["simulate", str(path), "--json"]) == 0
    capsys.readouterr()
    quick = ["--starts", "1", "--screening", "2", "--iterations", "5", "--validation", "0"]
    assert main(["tune", str(path), "--json", "--quiet", "--nominal", *quick]) in (0, 3)
    found = json.loads(capsys.readouterr().out)
    gain = found["parameters"]["controller.Kc[0]"]
    assert gain["unit"] == "V/V" and gain["before"] == 1.0 and gain["after"] != 1.0
    assert found["objective"]["after"] < found["objective"]["before"]


PROJECT = """
[project]
name = "fake-control"
version = "1.0"
[project.entry-points."jaxtank.components"]
biased-proportional = "fake_control:BiasedProportional"
no-component = "fake_control:np"
not-there = "fake_absent:Anything"
"""


@pytest.fixture
def installed(tmp_path, monkeypatch):
    """A distribution with the controller of the page and the table of entry points of PROJECT."""
    section = PAGE.read_text().split("## Add a controller\n")[1].split("\n## ")[0]
    (code,) = re.findall(r"```python\n(.*?)```", section, re.DOTALL)
    (table,) = re.findall(r"```toml\n(.*?)```", section, re.DOTALL)
    points = tomllib.loads(PROJECT)["project"]["entry-points"]
    assert points.keys() == tomllib.loads(table)["project"]["entry-points"].keys()
    site = tmp_path / "site"
    (site / "fake_control-1.0.dist-info").mkdir(parents=True)
    (site / "fake_control.py").write_text(code.rsplit("\n\n\nrig.register", 1)[0] + "\n")
    (site / "fake_control-1.0.dist-info" / "METADATA").write_text(
        "Metadata-Version: 2.1\nName: fake-control\nVersion: 1.0\n"
    )
    lines = [f"[{g}]\n" + "\n".join(f"{k} = {v}" for k, v in p.items()) for g, p in points.items()]
    (site / "fake_control-1.0.dist-info" / "entry_points.txt").write_text("\n".join(lines))
    with registries_kept():
        yield lambda: monkeypatch.syspath_prepend(site)
    sys.modules.pop("fake_control", None)


def test_the_command_finds_a_controller_of_an_installed_package(installed, tmp_path):
    """Not before it is installed; other kinds of the package are offered, not imported."""
    path = tmp_path / "rig.toml"
    path.write_text(RIG)
    (tmp_path / "fake_control.py").write_text("raise SystemExit('imported from beside the rig')")
    found = command("simulate", str(path))
    assert found.code == 2 and "unknown controller kind 'biased-proportional'" in found.err
    installed()
    path.write_text(RIG.replace("biased-", "biassed-"))
    found = command("show", str(path))
    assert found.code == 2 and "nearest: biased-proportional" in found.err
    assert "fake_control" not in sys.modules
    path.write_text(RIG)
    found = command("simulate", str(path), "--json")
    assert found.code == 0, found.err
    assert found.json["parameters"]["controller.bias"] == [4.0]
    assert 'kind = "biased-proportional"' in rig.dump(rig.load(path))


@pytest.mark.parametrize(
    ("kind", "why"),
    [
        ("no-component", "no component"),
        ("not-there", "package fake-control cannot be imported (ModuleNotFoundError"),
    ],
)
def test_a_package_that_cannot_be_used_is_named_in_one_line(installed, tmp_path, kind, why):
    path = tmp_path / "rig.toml"
    path.write_text(RIG.replace("biased-proportional", kind))
    installed()
    found = command("simulate", str(path))
    assert found.code == 2 and found.err.count("\n") == 1 and not found.out
    assert why in found.err


@pytest.mark.slow
def test_a_measure_from_outside_is_evaluated_limited_and_minimised(added, capsys):
    case = presets.find("cascaded/pi").replace(clock=jaxtank.Clock(dt=4.0, duration=800.0))
    with pytest.raises(InputError, match="unknown measure"):
        jaxtank.evaluate(case.loop, case.clock, ["mean_absolute_error"])
    added("a measure")
    names = ["mean_absolute_error", "largest_total_input"]
    values = jaxtank.evaluate(case.loop, case.clock, names)
    run = jaxtank.simulate(case.loop, case.clock)
    np.testing.assert_allclose(values[names[0]], np.abs(run.e[:-1]).mean(axis=0), rtol=1e-12)
    assert float(values[names[1]]) == np.asarray(run.u).sum(axis=1).max()
    result = tuning.tune(
        case.replace(scenarios=()),
        tuning.SQP(starts=1, screening=2, validation=0),
        objective={"mean_absolute_error": 1.0},
        limits={"largest_total_input": 9.0},
    )
    row = next(r for r in result.constraints if r["name"].startswith("largest_total_input"))
    assert row["value"] <= 9.0 * (1 + 1e-6) and row["unit"] == "V"
    assert result.objective["after"] < result.objective["before"]
    assert main(["show", "cascaded/pi"]) == 0
    assert "mean_absolute_error" in capsys.readouterr().out


def test_a_paper_from_outside_is_found_listed_and_compared(added, tmp_path, capsys):
    with pytest.raises(InputError, match="unknown"):
        presets.find("doe2026/pi")
    module = added("a paper")
    case = presets.find("doe2026/pi")
    assert case.uncertain == {"plant.drain": 0.05} and "doe2026/pi" in presets.names()
    assert presets.load("doe2026").notes == tmp_path / "notes" / "doe2026.md"
    assert main(["list"]) == 0 and "doe2026/pi" in capsys.readouterr().out
    assert main(["show", "doe2026/pi"]) == 0 and "J. Doe" in capsys.readouterr().out
    assert main(["simulate", "doe2026/pi", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["measures"]["max_level"][0] > 9.99
    assert main(["compare", "doe2026"]) == 0
    assert "reproduced" in capsys.readouterr().out
    with pytest.raises(InputError, match="taken"):
        presets.register(module.preset())


@pytest.mark.slow_for("gouta2015/backstepping", "calofir/backstepping")
@pytest.mark.parametrize("name", ["gouta2015/backstepping", "calofir/backstepping"])
def test_a_language_from_outside_gives_the_voltages_of_the_simulation(added, name, capsys):
    with pytest.raises(InputError, match=r"must be one of c, m, js, st, fmu$"):
        export(presets.find(name), "py")
    added("an export language")
    assert main(["export", name, "--lang", "py", "--name", "own"]) == 0
    code = {"math": math}
    exec(capsys.readouterr().out, code)
    case = presets.find(name)
    case = rig.set_values(case, {"clock.duration": 60 * case.clock.dt})
    run = jax.tree.map(np.asarray, jaxtank.simulate(case.loop, case.clock))
    r, dr, ddr = (np.stack(part, axis=1) for part in case.loop.reference.sample(case.clock))
    s = code["own_begin"](run.x[0].tolist(), np.asarray(case.loop.actuator.initial).tolist())
    for k, t in enumerate(run.t):
        rows = [signal[k].tolist() for signal in (run.y, r, dr, ddr)]
        u, s = code["own_step"](s, float(t), *rows)
        np.testing.assert_allclose(u, run.applied[k], rtol=1e-12, atol=1e-12 * run.applied.max())


def test_a_name_that_is_taken_is_refused():
    with pytest.raises(InputError, match="'m' is taken"):
        source.register("m", source.Language(lambda program, name, precision: ""))
    with pytest.raises(InputError, match="must be named"):
        one = presets.load("cascaded")
        presets.register(type(one)(**{**vars(one), "paper": "other"}))
    with pytest.raises(InputError, match="max_level"):
        jaxtank.measures.register("max_level", catalogue.MEASURES["ise"])
    with pytest.raises(InputError, match="letters"):
        source.register("../c", source.LANGUAGES["c"])
