"""`jaxtank replay`: exports in several languages against logs."""

import json
import shutil
import types

import numpy as np
import pytest

import jaxtank
from jaxtank import presets, rig
from jaxtank.core.errors import DataError
from jaxtank.export.replay import Export, _rates, _refuse_twice, read
from jaxtank.loop.trajectory import csv
from tuning.cli import main

WORDS = {"c": "gcc", "js": "node", "fmu": "gcc"}


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    """A run of 100 samples of cascaded/pi, as `simulate --out` saves it."""
    case = rig.set_values(presets.find("cascaded/pi"), {"clock.duration": 396.0})
    path = tmp_path_factory.mktemp("log") / "trajectory.csv"
    path.write_text(csv(jaxtank.simulate(case.loop, case.clock), case.loop.units))
    return path


def export(folder, *words):
    assert main.main(["export", "cascaded/pi", "--name", "law", "--out", str(folder), *words]) == 0


@pytest.mark.parametrize("lang", ["c", "js", "fmu"])
def test_an_export_gives_the_inputs_of_a_log_of_its_simulation(tmp_path, capsys, log, lang):
    """And the difference is one of the gain where that was changed: Kc times the error."""
    if shutil.which(WORDS[lang]) is None:
        pytest.skip(f"no {WORDS[lang]} on this machine")
    differences = []
    for i, words in enumerate([(), ("--set", "controller.bias=2.6")]):
        export(tmp_path / str(i), "--lang", lang, *words)
        capsys.readouterr()
        file = tmp_path / str(i) / f"law.{lang}"
        assert main.main(["replay", str(file), "--data", str(log), "--json"]) == 0
        (row,) = json.loads(capsys.readouterr().out)["inputs"]
        differences.append(row["largest_difference"])
    assert row["name"] == "u1"
    assert differences[0] < 1e-8  # the log has ten digits
    assert differences[1] == pytest.approx(2.6 - 2.50030361456214, rel=1e-3)


SLOW_PUMP = """
tank = [{area = 100.0, rim = 60.0, drain = 0.5, level = 20.0}]
pump = [
    {name = "P", to = 1, gain = 10.0, high = 12.0, initial = 9.0, lag = 3.0, delay = 2.0},
]
controller = {kind = "pi", Kc = 1.0, Ti = 20.0}
reference = {initial = [20.0], changes = [[5.0, 1, 25.0]]}
values = {"clock.dt" = 1.0, "clock.duration" = 60.0}
"""


VALVE = """
tank = [{area = 100.0, rim = 60.0, level = 20.0}, {area = 100.0, rim = 60.0, level = 10.0}]
pump = [{to = 1, gain = 10.0, high = 12.0, initial = 6.0}]
valve = [
    {from = 1, to = 2, area = 0.4, initial = 0.5},
]
orifice = [{from = 2, area = 0.3}]
plant = { gravity = 981.0, outputs = [1, 2] }
controller = {kind = "pi", Kc = [1.0, 0.05], Ti = 20.0}
reference = {initial = [20.0, 10.0], changes = [[5.0, 1, 22.0]]}
values = {"clock.dt" = 1.0, "clock.duration" = 60.0}
"""


def test_an_export_gives_the_inputs_ahead_of_dead_time_and_lag(tmp_path, capsys):
    """Those behind them, which the log holds besides, are others."""
    if shutil.which("gcc") is None:
        pytest.skip("no gcc on this machine")
    (tmp_path / "rig.toml").write_text(SLOW_PUMP)
    case = rig.load(tmp_path / "rig.toml")
    run = jaxtank.simulate(case.loop, case.clock)
    (tmp_path / "log.csv").write_text(csv(run, case.loop.units))
    words = ["export", str(tmp_path / "rig.toml"), "--name", "law", "--out", str(tmp_path)]
    assert main.main([*words, "--lang", "c"]) == 0
    capsys.readouterr()
    log = str(tmp_path / "log.csv")
    assert main.main(["replay", str(tmp_path / "law.c"), "--data", log, "--json"]) == 0
    (row,) = json.loads(capsys.readouterr().out)["inputs"]
    assert row["name"] == "applied_P" and row["largest_difference"] < 1e-8
    assert np.max(np.abs(run.applied - run.u)) > 1.0


def test_a_log_that_does_not_suit_and_an_export_that_is_none_are_reported(tmp_path, capsys, log):
    """Exit codes 5 and 2."""
    if shutil.which("gcc") is None:
        pytest.skip("no gcc on this machine")
    export(tmp_path, "--lang", "c")
    export(tmp_path, "--lang", "st")
    capsys.readouterr()
    rows = log.read_text().splitlines()
    sparse, short = tmp_path / "sparse.csv", tmp_path / "short.csv"
    sparse.write_text("\n".join([rows[0], *rows[1::2]]))
    short.write_text("\n".join(line.rsplit(",", 4)[0].rsplit(",", 1)[0] for line in rows))
    law = str(tmp_path / "law.c")
    for data, words in ((sparse, "every 4 s"), (short, "1 of applied1, .. or u1, .. or pump1")):
        assert main.main(["replay", law, "--data", str(data)]) == 5
        assert words in capsys.readouterr().err
    (tmp_path / "other.c").write_text("int other;\n")
    (tmp_path / "other.h").write_text("int other;\n")
    for file, words in (
        ("other.c", "does not compile"),
        ("law.st", "interpreter of Structured Text"),
        ("none.c", "no such file"),
    ):
        assert main.main(["replay", str(tmp_path / file), "--data", str(log)]) == 2
        error = capsys.readouterr().err
        assert words in error and error.count("\n") == 1
    assert main.main(["replay", law]) == 2


def test_levels_are_those_of_their_numbers_wherever_their_columns_stand(tmp_path, log):
    rows = [line.split(",")[::-1] for line in log.read_text().splitlines()]
    (tmp_path / "back.csv").write_text("\n".join(map(",".join, rows)))
    levels = [
        read(path, Export(4.0, (2, 1, 1), None))[0].y for path in (log, tmp_path / "back.csv")
    ]
    np.testing.assert_array_equal(*levels)


def test_dates_and_times_of_day_in_two_columns_are_joined(tmp_path, log):
    head, *rows = log.read_text().splitlines()
    times = [f"2026-05-04,06:{4 * k // 60:02}:{4 * k % 60:02}" for k in range(len(rows))]
    lines = [f"{time},{row.partition(',')[2]}" for time, row in zip(times, rows)]
    data = tmp_path / "dated.csv"
    data.write_text("\n".join([f"Date,Time,{head.partition(',')[2]}", *lines]))
    export = Export(4.0, (2, 1, 1), None)
    np.testing.assert_array_equal(read(data, export)[0].t, read(log, export)[0].t)


def test_rates_of_ramps_are_their_slopes_and_those_of_jumps_are_zero():
    r = np.array([[1.0], [1.0], [1.5], [2.0], [2.5], [2.5], [4.0], [4.0]])
    np.testing.assert_allclose(_rates(r, 0.5)[:, 0], [0, 1, 1, 1, 0, 0, 0, 0])


def in_other_units(log, units, row_of_units):
    """The log in other units (levels, setpoints and inputs are in V), stated in heads or in a row
    below them.
    """
    heads, *rows = [line.split(",") for line in log.read_text().splitlines()]
    names = [head.split(" [")[0] for head in heads]
    scale = {"mV": 1e3, "kV": 1e-3, "V": 1.0, "s": 1.0, "min": 1 / 60}
    chosen = ["min", *([units] * (len(names) - 1))]
    cells = [[f"{float(c) * scale[u]:.17g}" for c, u in zip(row, chosen)] for row in rows]
    if row_of_units:
        return "\n".join(map(",".join, [names, chosen, *cells]))
    return "\n".join(map(",".join, [[f"{n} [{u}]" for n, u in zip(names, chosen)], *cells]))


@pytest.mark.parametrize("lang", ["c", "js", "fmu", "fmu2"])
@pytest.mark.parametrize("row_of_units", [False, True])
def test_a_log_in_other_units_is_converted_to_those_of_the_export(
    tmp_path, capsys, log, lang, row_of_units
):
    if shutil.which(WORDS[lang.rstrip("2")]) is None:
        pytest.skip(f"no {WORDS[lang.rstrip('2')]} on this machine")
    more = ("--fmi", "2") if lang == "fmu2" else ()
    export(tmp_path, "--lang", lang.rstrip("2"), *more)
    data = tmp_path / "log.csv"
    data.write_text(in_other_units(log, "mV", row_of_units))
    capsys.readouterr()
    words = ["replay", str(tmp_path / f"law.{lang.rstrip('2')}"), "--data", str(data), "--json"]
    assert main.main(words) == 0
    (row,) = json.loads(capsys.readouterr().out)["inputs"]
    assert row["largest_difference"] < 1e-8


def test_a_unit_that_does_not_convert_and_a_column_twice_are_refused_by_name(log, tmp_path):
    for name, unit in (("y2", "cm"), ("u1", "%"), ("r1", "m3/h")):
        (tmp_path / "log.csv").write_text(
            log.read_text().replace(f"{name} [V]", f"{name} [{unit}]")
        )
        with pytest.raises(
            DataError, match=rf"column '{name} \[{unit}\]': '{unit}' is no unit .* V"
        ):
            read(tmp_path / "log.csv", Export(4.0, (2, 1, 1), None, ("V", "V")))
    for other in ("y2 [mV]", "u1 [V]", "t [s]"):
        lines = log.read_text().splitlines()
        lines = [f"{lines[0]},{other}", *(f"{line},1" for line in lines[1:])]
        (tmp_path / "log.csv").write_text("\n".join(lines))
        with pytest.raises(DataError, match=f"two columns are called '{other.split()[0]}'"):
            read(tmp_path / "log.csv", Export(4.0, (2, 1, 1), None))


@pytest.mark.extended
def test_the_opening_of_a_valve_has_a_unit_of_its_own(tmp_path, capsys):
    """In a rig whose pumps are in V, the opening of a valve is a share."""
    if shutil.which("gcc") is None:
        pytest.skip("no gcc on this machine")
    (tmp_path / "rig.toml").write_text(VALVE)
    case = rig.load(tmp_path / "rig.toml")
    run = jaxtank.simulate(case.loop, case.clock)
    text = csv(run, case.loop.units)
    assert "u2 [-]" in text
    (tmp_path / "log.csv").write_text(text)
    for lang in ("c", "fmu"):
        words = ["export", str(tmp_path / "rig.toml"), "--name", "law", "--out", str(tmp_path)]
        assert main.main([*words, "--lang", lang]) == 0
        capsys.readouterr()
        file = str(tmp_path / f"law.{lang}")
        assert main.main(["replay", file, "--data", str(tmp_path / "log.csv"), "--json"]) == 0
        rows = json.loads(capsys.readouterr().out)["inputs"]
        assert max(row["largest_difference"] for row in rows) < 1e-8


def test_columns_of_one_name_are_refused_whatever_their_case():
    table = lambda *names: types.SimpleNamespace(
        name="log.csv", head=1, columns=[types.SimpleNamespace(name=name) for name in names]
    )
    _refuse_twice(table("u1", "u2", "U1"), [0, 1])
    with pytest.raises(DataError):
        _refuse_twice(table("u1", "u2", "U1"), [0, 1, 2])


def test_the_time_of_the_largest_difference_is_that_of_its_row(tmp_path, capsys, log):
    if shutil.which("gcc") is None:
        pytest.skip("no gcc on this machine")
    export(tmp_path, "--lang", "c")
    head, *rows = log.read_text().splitlines()
    cells, column = (
        rows[7].split(","),
        head.split(",").index(next(c for c in head.split(",") if c.startswith("u1"))),
    )
    cells[column] = str(float(cells[column]) + 0.5)
    (tmp_path / "log.csv").write_text("\n".join([head, *rows[:7], ",".join(cells), *rows[8:]]))
    capsys.readouterr()
    main.main(["replay", str(tmp_path / "law.c"), "--data", str(tmp_path / "log.csv"), "--json"])
    (row,) = json.loads(capsys.readouterr().out)["inputs"]
    assert row["time_s"] == 7 * 4.0 and row["largest_difference"] == pytest.approx(0.5, abs=1e-6)
