"""Logs as files: what is read of them, and one line with the place for each that cannot be used."""

import dataclasses
import json
import re
import tomllib

import numpy as np
import pytest
from helpers import command

import tuning
from jaxtank import presets, rig
from jaxtank.core.errors import DataError, InputError
from jaxtank.core.tables import split_header
from tuning.identification.coordinates import default_free
from tuning.identification.csv_log import LogError, read_log, unknown_inputs
from tuning.identification.data_checks import checked, findings
from tuning.identification.inspection import inspect
from tuning.identification.sanity import oddities
from tuning.report.inspection import json_of, report

HEADER = "t [s],pump1 [V],pump2 [V],h1 [cm],h2 [cm],h3 [cm],h4 [cm]"


def rows(count=8):
    """Cells of `count` samples of a rise of the four levels of the quadruple tank, pumps at 3 and
    2.8 V.
    """
    return [
        [str(k), "3", "2.8", f"{0.9 + 0.1 * k:.2f}", f"{0.8 + 0.2 * k:.2f}", "1", "2"]
        for k in range(count)
    ]


def text(header=HEADER, cells=None, separator=",", eol="\n"):
    """A file of these cells."""
    cells = rows() if cells is None else cells
    return eol.join([header, *(separator.join(row) for row in cells)]) + eol


def changed(row, column, cell):
    """The rows with one cell changed."""
    cells = rows()
    cells[row][column] = cell
    return cells


@pytest.fixture(scope="module")
def case():
    return presets.load("mirakhorli").cases["sfc"]


@pytest.fixture
def read(tmp_path, case):
    """read(text or bytes, **options) -> Log of a file with it."""

    def reader(content, loop=None, **options):
        path = tmp_path / "log.csv"
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
        return read_log(path, case.loop if loop is None else loop, **options)

    return reader


def same(log, reference):
    """Whether two logs hold the same numbers."""
    for name in ("t", "u", "y"):
        np.testing.assert_allclose(getattr(log, name), getattr(reference, name), rtol=1e-12, atol=0)
    return log.tanks == reference.tanks and log.in_volts == reference.in_volts


def test_a_plain_file(read):
    log = read(text())
    assert log.samples == 8 and log.tanks == (0, 1, 2, 3) and log.in_volts == (False,) * 4
    np.testing.assert_array_equal(log.t, np.arange(8.0))
    np.testing.assert_array_equal(log.u, np.tile([3.0, 2.8], (8, 1)))
    np.testing.assert_allclose(log.y[:, 0], 0.9 + 0.1 * np.arange(8), rtol=1e-12)
    assert list(log.lines) == list(range(2, 10)) and log.headers == tuple(HEADER.split(","))


@pytest.mark.parametrize(
    "content",
    [
        "\ufeff" + text(),
        text(eol="\r\n"),
        text(eol="\r"),
        text(HEADER.replace(",", "\t"), separator="\t"),
        text(HEADER.replace(",", ";"), separator=";"),
        "# rig 3, autumn\n\n" + text().replace("\n3,", "\n\n# a note, with commas, in it\n3,"),
        "\n".join(line + "," for line in text().splitlines()),
        text().replace("\n", ",,\n").replace(",,\n", "\n", 1),
        text(
            ",".join(f'"{h}"' for h in HEADER.split(",")),
            [[f'"{c}"' for c in row] for row in rows()],
        ),
        text(HEADER.replace(",", ", "), separator=" , "),
        text(HEADER + ",remark,remark", [[*row, "valve open", "?"] for row in rows()]),
        text().rstrip("\n"),
        text(HEADER.replace(" [cm]", "_cm").replace(" [V]", "_V").replace("t [s]", "time_s")),
        text(
            HEADER.replace("[", "(")
            .replace("]", ")")
            .replace("pump", "u")
            .replace("h", "Level ")
            .replace("t (s)", "Time (s)")
        ),
        text(cells=[[f"{float(c):.6e}" for c in row] for row in rows()]),
    ],
)
def test_the_same_data_in_other_columns_and_units(read, content):
    assert same(read(content), read(text()))


def test_columns_in_any_order_and_levels_that_are_not_there(read):
    order = [4, 0, 2, 1, 3]
    log = read(
        text(
            ",".join(HEADER.split(",")[i] for i in order),
            [[row[i] for i in order] for row in rows()],
        )
    )
    whole = read(text())
    assert log.tanks == (0, 1)
    np.testing.assert_array_equal(log.y, whole.y[:, :2])
    np.testing.assert_array_equal(log.u, whole.u)


def test_units_of_the_header(read):
    cells = [
        [
            f"{float(r[0]) / 60:.12f}",
            str(1000 * float(r[1])),
            r[2],
            *(str(float(c) * 10) for c in r[3:]),
        ]
        for r in rows()
    ]
    log = read(text("t [min],pump1 [mV],pump2 [V],h1 [mm],h2 [mm],h3_mm,h4 (mm)", cells))
    whole = read(text())
    np.testing.assert_allclose(log.t, whole.t, atol=1e-9)
    np.testing.assert_allclose(log.u, whole.u, rtol=1e-12)
    np.testing.assert_allclose(log.y, whole.y, rtol=1e-12)


def test_units_of_a_rig_in_metres_and_flows(read):
    loop = presets.load("calofir").cases["backstepping"].loop
    log = read("t [ms],pump1 [l/min],h1 [cm],h2 [mm]\n0,3,5,13\n1000,3,6,14\n2000,0,7,15\n", loop)
    np.testing.assert_allclose(log.t, [0, 1, 2])
    np.testing.assert_allclose(log.u[:, 0], [5e-5, 5e-5, 0])  # 3 l/min = 3e-3 m^3 / 60 s
    np.testing.assert_allclose(log.y, [[0.05, 0.013], [0.06, 0.014], [0.07, 0.015]])


def test_the_gain_is_not_estimated_from_flows_that_it_made_inputs(read, case):
    flows = read(text("t [s],pump1 [l/h],pump2 [V],h1 [cm],h2 [cm],h3 [cm],h4 [cm]"))
    gains = [f"plant.pump_gain[{j}]" for j in (0, 1)]
    assert [name in default_free(case.loop, [flows]) for name in gains] == [False, True]
    assert all(name in default_free(case.loop, [read(text())]) for name in gains)


@pytest.mark.parametrize(
    ("header", "name", "other"),
    [
        (HEADER.replace("pump1 [V]", "pump1 [l/h]"), "plant.pump_gain", "plant.pump_gain[1]"),
        (HEADER.replace("h1 [cm]", "h1 [ml]"), "plant.area[0]", "plant.area[1]"),
    ],
)
def test_a_parameter_that_made_a_column_is_not_estimated_from_it(read, case, header, name, other):
    log = read(text(header, [[*r[:3], str(30 * float(r[3])), *r[4:]] for r in rows()]))
    column = next(head for head in header.split(",") if head not in HEADER)
    with pytest.raises(
        InputError, match=rf"free {re.escape(name)}.*'{re.escape(column)}' has .* leave it out"
    ):
        tuning.Estimation(case, [log], {name: (0.1, 100.0)})
    assert tuning.Estimation(case, [log], {other: (0.1, 100.0)}, substeps=1).bounds


def test_a_level_in_volts_is_the_sensors(read):
    log = read("t [s],pump1 [V],pump2 [V],h2 [cm],h1 [mV]\n0,3,3,1,200\n1,3,3,2,300\n")
    assert log.tanks == (0, 1) and log.in_volts == (True, False)
    np.testing.assert_allclose(log.y, [[0.2, 1], [0.3, 2]])


def test_decimal_commas(read):
    comma = text(
        HEADER.replace(",", ";"), [[c.replace(".", ",") for c in row] for row in rows()], ";"
    )
    assert same(read(comma, decimal=","), read(text()))
    # of several files one may have points: a stated sign decides where numbers do not
    assert same(read(text(HEADER.replace(",", ";"), separator=";"), decimal=","), read(text()))
    with pytest.raises(InputError, match="decimal"):
        read(text(), decimal="x")


def test_missing_readings(read):
    cells = changed(3, 4, "")
    for row, word in ((4, "NaN"), (5, "na"), (6, "-"), (7, "null")):
        cells[row][4] = word
    log = read(text(cells=cells))
    assert list(np.isnan(log.y[:, 1])) == [False] * 3 + [True] * 5
    assert np.isfinite(np.delete(log.y, 1, axis=1)).all()


def test_columns_named_by_option_or_rig(read, case):
    content = text(
        "when,left,right [mV],a,b,c,h4 [cm]",
        [[r[0], r[1], str(1000 * float(r[2])), *r[3:]] for r in rows()],
    )
    columns = {
        "t": ("when", "s"),
        "pump1": ("left", "V"),
        "pump2": "right [mV]",
        "h1": ("a", "cm"),
        "h2": ("b", "cm"),
        "h3": ("c", "cm"),
    }
    assert same(read(content, columns=columns), read(text()))
    with pytest.raises(InputError, match="unknown column 'h9'"):
        read(content, columns={"h9": "a"})
    with pytest.raises(DataError, match="no column 'lft' for pump1; nearest: left"):
        read(content, columns={**columns, "pump1": "lft"})
    # a column named for one slot is not taken for another by its own name
    log = read(
        text("t [s],pump1 [V],pump2 [V],h2 [cm],h1 [cm],h3 [cm],h4 [cm]"),
        columns={"h1": "h2 [cm]", "h2": "h1 [cm]"},
    )
    assert same(log, read(text()))


def test_a_level_is_left_out_by_none(read, case):
    """Whether its header names it, or the [log] table of a rig; a pump, or the time, is needed."""
    assert read(text(), columns={"h3": "none", "h1": "none"}).tanks == (1, 3)
    table = {"h1": "h3 [cm]", "h3": "h1 [cm]"}
    assert read(text(), columns=table | {"h3": "none"}).tanks == (0, 1, 3)
    assert rig.loads(rig.dump(case.replace(log={"h3": "none", "h4": "none"}))).log == {
        "h3": "none",
        "h4": "none",
    }
    with pytest.raises(InputError, match="column t = none: only a level may be left out"):
        read(text(), columns={"t": "none"})
    np.testing.assert_array_equal(read(text(), columns={"pump2": "none"}).u[:, 1], 0.0)
    with pytest.raises(DataError, match="no column for a level"):
        read(text(), columns=dict.fromkeys(("h1", "h2", "h3", "h4"), "none"))


def test_the_log_table_of_a_rig_file(tmp_path, read, case):
    table = {"t": ("when", "s"), "pump1": "left [V]", "pump2": ("right", "mV"), "h2": ("b", "mm")}
    path = tmp_path / "rig.toml"
    path.write_text(rig.dump(case.replace(log=table)))
    again = rig.load(path)
    assert again.log == table
    log = read("when,left [V],right,b\n0,3,2800,10\n1,3,2800,20\n", columns=again.log)
    assert log.tanks == (1,)
    np.testing.assert_allclose(log.y[:, 0], [1, 2])
    np.testing.assert_allclose(log.u, [[3, 2.8]] * 2)


def test_init_shows_a_log_table_that_works(tmp_path, read):
    """With its comment signs taken away the example is a table for a file of such columns."""
    code, out, _ = command("init", "mirakhorli/sfc")
    assert code == 0
    whole, example = out.split("# Columns of the experiment data", 1)
    table = "\n".join(line.removeprefix("#") for line in example.splitlines()[1:])
    (tmp_path / "rig.toml").write_text(whole + table + "\n")
    columns = rig.load(tmp_path / "rig.toml").log
    assert set(columns) == {"t", "pump1", "pump2", "h1", "h2", "h3", "h4"}
    header = ",".join(name for name, _ in columns.values())
    assert same(read(text(header), columns=columns), read(text()))


@pytest.mark.parametrize(
    ("header", "expected"),
    [
        ("h1 [cm]", ("h1", "cm")),
        ("h1(cm)", ("h1", "cm")),
        ("pump1_V", ("pump1", "V")),
        ("pump_1", ("pump_1", None)),
        ("flow_l/min", ("flow", "l/min")),
        ("h1", ("h1", None)),
        ("upper_tank", ("upper_tank", None)),
        ("Time_ms", ("Time", "ms")),
        ("millis", ("millis", "ms")),
        ("millis()", ("millis", "ms")),
        ("ms", ("ms", "ms")),
        ("micros", ("micros", "us")),
        ("Time [\u00b5s]", ("Time", "\u00b5s")),
    ],
)
def test_a_header_in_parts(header, expected):
    assert split_header(header) == expected


@pytest.mark.parametrize(
    "time", ["millis", "ms", "Time_ms", "millis()", "clock", "micros", "t [\u00b5s]"]
)
def test_parts_of_a_second_by_the_name_of_their_column_or_by_log(tmp_path, case, time):
    path, columns = tmp_path / "log.csv", {"t": ("clock", "ms")} if time == "clock" else {}
    second = 1_000_000 if time in ("micros", "t [\u00b5s]") else 1000
    cells = [[f"{1234 + second // 2 * k}", *row[1:]] for k, row in enumerate(rows())]
    path.write_text(text(HEADER.replace("t [s]", time), cells), "utf-8")
    result = inspect(path, case.loop, columns)
    np.testing.assert_allclose(np.diff(result.t), 0.5)
    assert not result.problems
    log = tomllib.loads(result.table)["log"]
    assert log["t"] == (["clock", "ms"] if columns else time)
    if not columns:
        assert inspect(path).t[1] == result.t[1]


@pytest.mark.parametrize("stamp", ["?{}", "0{}/03/2026 10:00"])  # no time; of two meanings
def test_no_step_of_times_that_cannot_be_read(tmp_path, case, stamp):
    path = tmp_path / "log.csv"
    cells = [[stamp.format(k), *row[1:]] for k, row in enumerate(rows(), 1)]
    path.write_text(text(HEADER.replace("t [s]", "t"), cells))
    for result in (inspect(path, case.loop), inspect(path)):
        written = json.loads(json.dumps(json_of(result)))
        times = {name: written["time"][name] for name in ("length", "step", "longest_step")}
        assert result.problems and set(times.values()) == {None}
        assert {column["step"] for column in written["columns"]} == {None}
        assert report(result).verdict is not None  # and no length is written


def headed(old, new):
    """A file whose header has another word in a place."""
    return text(HEADER.replace(old, new))


def scaled(factor, columns, digits=".4f"):
    """A file with cells multiplied."""
    return text(cells=[
        [f"{float(c) * factor:{digits}}" if i in columns else c for i, c in enumerate(row)]
        for row in rows()
    ])  # fmt: skip


@pytest.mark.parametrize(
    "sensor", ["offset = 385.0, scale = 1.1", "curve = [[0.0, 385.0], [20.0, 407.0]]"]
)
def test_readings_of_a_sensor_with_an_offset_or_a_curve_are_in_range(sensor):
    """Readings above sea level: 412.5 m where the rim is 36 m; a thousand metres more are not."""
    text = """
        units = ["m", "m^3/s"]
        tank = [{ area = 1e5, rim = 36.0, level = 27.5 }]
        pump = [{ from = 1, high = 60.0 }]
        sensor = [{ tank = 1, SENSOR }]
        controller = { kind = "open-loop", initial = [0.0] }
    """
    case = rig.loads(text.replace("SENSOR", sensor))
    level = 27.5 + np.arange(20.0)[:, None]
    for more, codes in ((0.0, []), (1000.0, ["range"])):
        y = 1.1 * level + 385.0 + more
        log = tuning.log(t=60.0 * np.arange(20.0), u=np.ones((20, 1)), y=y, tanks=[0])
        assert [code for code, _ in findings(log, case.loop, np.inf)] == codes


COMMA = [[c.replace(".", ",") for c in row] for row in rows()]
CALLED = "another unit"
# fmt: off
BAD = {  # a file, and what the message must hold
    "empty": ("", "is empty"),
    "comments only": ("# nothing\n\n", "is empty"),
    "header only": (HEADER + "\n", "has a header, but no samples"),
    "no header": (text().split("\n", 1)[1], "line 1: has numbers"),
    "single sample": (text(cells=rows(1)), "number of samples is 1:", "at least 3"),
    "two samples": (text(cells=rows(2)), "number of samples is 2:"),
    "duplicated time": (text(cells=changed(3, 0, "2")), "line 5, column 't [s]': time 2 s is that",
                        "delete one of the two rows"),
    "backward time": (text(cells=changed(3, 0, "0.5")), "line 5,", "time 0.5 s is 1.5 s before",
                      "sort the rows"),
    "time missing": (text(cells=changed(3, 0, "")), "line 5, column 't [s]': is empty"),
    "time as a date": (text(cells=changed(0, 0, "2024-01-01 00:00")), "line 3,", "time stamp"),
    "gap": (text(cells=[*rows(5), ["60", *rows(1)[0][1:]]]), "line 7, column 't [s]'",
            "a gap of 56 s after 4 s", "--gap 56"),
    "step too long": (text(cells=[*rows(30), ["1e9", *rows(1)[0][1:]]]), "line 32,",
                      "1e+09 s after the sample before: too long"),
    "time without a unit": (headed("t [s]", "t"), "line 1, column 't': has no unit"),
    "unit of another kind": (headed("h1 [cm]", "h1 [s]"), "column 'h1 [s]': 's'"),
    "unknown unit": (headed("h2 [cm]", "h2 [furlong]"), "'furlong' is no unit"),
    "pump in Hz of nothing": (headed("pump1 [V]", "pump1 [Hz of 0 Hz]"), "is no unit"),
    "pump in a share of a length": (headed("pump1 [V]", "pump1 [m of 50 m]"), "is no unit"),
    "per cents of another kind": (headed("pump1 [V]", "pump1 [% of 50 Hz]"), "is no unit"),
    "pump in Hz": (headed("pump1 [V]", "pump1 [Hz]"), "'Hz' is no unit", "Hz of 50 Hz"),
    "pump in percent": (headed("pump1 [V]", "pump1 [%]"), "'%' is no unit", "V, mV, % of 5 V"),
    "number of a failed input": (text(cells=changed(3, 3, "-9999")), "h1 = -9999 cm",
                                 "Leave the cell empty"),
    "mm called cm": (text(cells=changed(4, 3, "85")), "line 6, column 'h1 [cm]': h1 = 85 cm",
                     "rim is 30 cm", CALLED, "'h1 [mm]'"),
    "mV called V": (scaled(1000, (1,)), "line 2, column 'pump1 [V]'", "3000 V", "'pump1 [mV]'"),
    "V called mV": (headed("pump2 [V]", "pump2 [mV]"), "0.0028 V", "5 V", "'pump2 [V]'"),
    "m called cm": (scaled(0.01, (3, 4, 5, 6)), "no level reads more than", "'h2 [m]'"),
    "both in other units": (scaled(1000, (1, 3)), "'pump1 [mV]'", "h1 = 900 cm"),
    "volts of another sensor": (text(HEADER.replace("h1 [cm]", "h1 [V]"), changed(2, 3, "9")),
                                "line 4", "h1 = 9 V", "range is 5 V"),
    "decimal commas and points": (text(HEADER.replace(",", ";"), [*COMMA, *rows()], ";"),
                                  "column 'pump2 [V]'", "'2.8' is not a number"),
    "decimal comma between commas": (text(cells=COMMA), "10 cells under 7 "),
    "two for one": (headed("h2 [cm]", "y1 [cm]"), "'h1 [cm]' and 'y1 [cm]' both look like h1"),
    "two for time": (text(HEADER + ",t [s]", [[*r, "1"] for r in rows()]),
                     "line 1: two columns are called 't [s]'"),
    "no pump": (headed("pump2 [V]", "valve [V]"), "no column for pump2", "--column pump2=HEADER"),
    "no time": (headed("t [s]", "n"), "line 1: no column for t"),
    "no level": ("t [s],pump1 [V],pump2 [V],a\n0,3,3,1\n1,3,3,1\n", "no column for a level"),
    "tank of many digits": (text(f"t [s],pump1 [V],pump2 [V],h{'9' * 450} [cm]",
                                 [row[:4] for row in rows()]), "no column for a level"),
    "letters": (text(cells=changed(3, 3, "abc")), "column 'h1 [cm]': 'abc' is not a number"),
    "infinite": (text(cells=changed(3, 3, "1e400")), "line 5,", "'1e400' is not finite"),
    "underscore": (text(cells=changed(3, 3, "1_0")), "'1_0' is not a number"),
    "digits of another script": (text(cells=changed(3, 3, "٣")), "line 5, column 'h1 [cm]'"),
    "no input": (text(cells=[[r[0], "", *r[2:]] for r in rows()]), "pump1 has no value"),
    "short row": (text() + "9,3\n", "line 10: 2 cells under 7 column names",
                  "delete the line"),
    "long row": (text(cells=[*rows(3), [*rows(1)[0], "1"]]), "line 5: 8 cells under 7"),
    "no reading": (text(cells=[[*r[:4], "", *r[5:]] for r in rows()]), "h2 has no reading"),
    "few readings": (text(cells=[[*r[:3], *(c if i == k else "" for i, c in enumerate(r[3:]))]
                                 for k, r in enumerate(rows())]), "readings cannot determine"),
    "open quote": (text().replace("1.20", '"1.20'), "line 4: a quotation mark opens"),
    "long cell": (text(cells=changed(3, 3, "1" * 300)), "a cell of 300 characters"),
    "longer cell": (text(cells=changed(3, 3, "1" * 200_000)), "line 5: field larger"),
    "zero byte": (text() + "\0", "not text"),
    "latin 1": (text().encode().replace(b"2.8", b"2\xb78"), "'2·8' is not a number"),
    "another file": (b"\x89PNG\r\n\x1a\n" + bytes(range(256)), "is not text"),
    "negative level": (text(cells=changed(3, 3, "-12")), "line 5, column 'h1 [cm]': h1 = -12 cm"),
    "negative input": (text(cells=changed(3, 2, "-2.8")), "pump2 = -2.8 V"),
}
# fmt: on


def refused(tmp_path, content, *options):
    """The one line of the command for a file, or for none."""
    path, out = tmp_path / "log.csv", tmp_path / "out"
    if content is not None:
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
    words = ("--data", str(path), "--out", str(out), "--hold-back", "0", *options, "--quiet")
    code, printed, reported = command("identify", "mirakhorli/sfc", *words)
    first, *table = reported.splitlines()
    assert (code, printed) == (5, "") and (not table or "[log]" in table), reported
    assert not out.exists() and reported.startswith(("jaxtank: log.csv", "jaxtank: file"))
    return first


@pytest.mark.extended_for("step too long")
@pytest.mark.parametrize("name", BAD)
def test_a_bad_log_is_refused_in_one_line_and_nothing_is_written(name, tmp_path):
    content, *parts = BAD[name]
    options = ("--gap", "1e12") if name == "step too long" else ()
    reported = refused(tmp_path, content, *options)
    assert "log.csv" in reported and all(part in reported for part in parts), reported


@pytest.mark.parametrize(
    ("header", "column", "words"),
    [
        (
            HEADER.replace("h1 [cm],h2 [cm]", "level, level "),
            ("h1=level;cm",),
            "line 1: two columns are called 'level'",
        ),
        (
            HEADER.replace("h1 [cm]", "level"),
            ("h1=level;cm", "h2=level;cm"),
            "line 1: column 'level' is given for h1 and for h2",
        ),
    ],
)
def test_a_log_with_a_column_twice_is_refused(header, column, words, tmp_path):
    options = [word for pair in column for word in ("--column", pair)]
    assert words in refused(tmp_path, text(header), *options)


def test_no_file_a_folder_and_a_name_that_is_too_long(tmp_path):
    assert "does not exist" in refused(tmp_path, None)
    (tmp_path / "log.csv").mkdir()
    assert "is not a file" in refused(tmp_path, None)
    code, _, reported = command("identify", "mirakhorli/sfc", "--data", "a" * 5000)
    assert code == 5 and "cannot be read: File name too long" in reported


def test_one_bad_log_among_several(tmp_path, case):
    (tmp_path / "good.csv").write_text(text())
    more = ("--data", str(tmp_path / "good.csv"))
    assert "log.csv, line 5" in refused(tmp_path, text(cells=changed(3, 0, "2")), *more)
    logs = [tuning.log(t=np.arange(n), u=np.ones((n, 2)), y=np.ones((n, 4))) for n in (20, 2)]
    with pytest.raises(DataError, match="number of samples is 2"):
        tuning.identify_many(case, logs, start="case", noise=0.1)


@pytest.mark.slow
def test_a_step_that_is_long_and_can_be_simulated_is_taken(case):
    """Three minutes without a sample, among the samples held back: as many steps as it needs are
    taken over it.
    """
    t = np.arange(40.0)
    y = [2.0, 2, 1, 1] + (1 - np.exp(-t / 20))[:, None] * [5.0, 6, 2, 3]
    t[-1] += 180.0
    log, free = tuning.log(t=t, u=np.tile([3.0, 2.8], (40, 1)), y=y), {"plant.pump_gain": (5, 60.0)}
    data = tuning.identify(case, log, free, starts=1, gap=1e3)
    assert np.all(np.isfinite(data.quality["rmse"])) and data.estimation.substeps > 2


def test_a_pump_without_a_true_limit_may_be_faint():
    """khalid's input is a dimensionless one with limits of +-1000 in name only."""
    loop = presets.load("khalid").cases["gpc"].loop
    log = tuning.log(t=np.arange(5.0), u=np.full(5, 2.0), y=np.full((5, 2), 0.2))
    assert not findings(log, loop)


def test_a_pump_that_stands_still_is_no_mistake(case):
    u = np.stack([np.full(5, 3.0), np.zeros(5)], axis=1)
    assert not findings(tuning.log(t=np.arange(5.0), u=u, y=np.ones((5, 4))), case.loop)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"t": np.arange(4.0)}, "shapes"),
        ({"u": np.full((5, 2), np.nan)}, r"sample 1: pump1 = nan"),
        ({"y": np.full((5, 4), np.inf)}, r"sample 1: h1 = inf"),
        ({"tanks": (0, 0, 1, 2)}, "two columns"),
        ({"tanks": (0, 1)}, "4 channels of levels"),
        ({"t": [0, 1, 2, 3, "x"]}, "must be arrays of numbers"),
        ({"t": [0.0, 1, 1, 2, 3]}, "sample 3: time 1 s is that"),
    ],
)
def test_arrays_that_are_no_log(change, words):
    whole = {"t": np.arange(5.0), "u": np.ones((5, 2)), "y": np.ones((5, 4))}
    with pytest.raises(DataError, match=words):
        tuning.log(**(whole | change))


def test_a_log_of_another_rig(case):
    whole = {"t": np.arange(5.0), "u": np.ones((5, 2)), "y": np.ones((5, 4))}
    codes = lambda log: [code for code, _ in findings(log, case.loop)]
    assert codes(tuning.log(**(whole | {"u": np.ones(5)}))) == ["pumps"]
    assert codes(tuning.log(**whole, tanks=(0, 1, 2, 7))) == ["tanks"]


def test_gaps_are_counted_in_usual_steps(case):
    def of(t, gap=1.5):
        log = tuning.log(t=t, u=np.ones((len(t), 2)), y=np.ones((len(t), 4)))
        return findings(log, case.loop, gap)

    ((code, message),) = of([0.0, 1, 2, 3, 5, 6, 7])
    assert code == "gap" and "sample 5: a gap of 2 s after 3 s" in message
    assert message.endswith("--gap 2")
    assert not of([0.0, 1, 2, 3, 5, 6, 7], 2.0) and not of([0.0, 1, 2.4, 3, 4.4, 5])


def test_every_column_in_another_unit_is_reported_at_once(case):
    log = tuning.log(t=np.arange(5.0), u=np.full((5, 2), 3000.0), y=np.full((5, 4), 60.0))
    assert [code for code, _ in findings(log, case.loop)] == ["range"] * 6


@pytest.mark.parametrize(
    ("past", "count", "code"),
    [(0.004, 200, ""), (0.5, 1, ""), (0.5, 2, "input-limit"), (0.05, 200, ""), (6.0, 1, "range")],
)
def test_inputs_beyond_a_limit_are_noted_and_refused_where_they_are_many(case, past, count, code):
    """The upper limit of the pumps is 5 V: more than 2 % beyond it, in 1 % of 200 samples."""
    u = np.full((200, 2), 5.0)
    u[200 - count :, 1] += past
    log = tuning.log(t=np.arange(200.0), u=u, y=np.ones((200, 4)))
    assert [known for known, _ in findings(log, case.loop)] == [code] * bool(code)
    if code == "input-limit":
        ((_, message),) = findings(log, case.loop)
        assert "pump2 = 5.5 V, and 2 samples" in message and "actuator.high[1]" in message
    elif not code:
        (data,) = checked(log, case.loop, 1.5)
        noted = f"pump 2 goes to {5 + past:g} V, beyond its limit, 5 V, in {count} of 200 samples"
        assert (noted in "".join(data.notes)) == (past > 0.005)


@pytest.mark.parametrize(
    ("value", "count", "most", "codes"),
    [
        (400.0, 4, 9.0, []),
        (-999.0, 1, 9.0, []),
        (400.0, 5, 9.0, ["range"]),
        (50.0, 4, 40.0, ["range"]),  # a level that rises, in another unit
        (400.0, 4, 0.09, ["level-faint"]),
    ],
)
def test_few_readings_far_beyond_the_range_are_noted(case, value, count, most, codes):
    """The rims are at 30 cm."""
    y = np.linspace(0.5 * most, most, 100)
    y[40 : 40 + count] = value
    log = tuning.log(t=np.arange(100.0), u=np.ones((100, 2)), y=y)
    assert [code for code, _ in findings(log, case.loop)] == codes
    if not codes:
        (data,) = checked(log, case.loop, 1.5)
        (note,) = data.notes
        assert f"h1: {count} of 100 readings beyond its range, the first {value:g} cm" in note
        assert "sample 41" in note and np.isnan(data.y[40 : 40 + count]).all()
        assert np.isfinite(data.y).sum() == 100 - count
        kinds = {odd.kind for odd in oddities(log)} - {odd.kind for odd in oddities(log, case.loop)}
        assert kinds == {"spike"}  # named once
        assert checked(data, case.loop, 1.5)[0].notes == (note,)


def test_inputs_below_the_lower_limit_are_refused(case):
    high = np.full(2, 5.0)
    bank = dataclasses.replace(case.loop.actuator, low=np.array([1.0, 1.0]), high=high)
    loop = dataclasses.replace(case.loop, actuator=bank)
    log = tuning.log(t=np.arange(9.0), u=np.tile([0.0, 2.0], (9, 1)), y=np.ones((9, 4)))
    ((code, message),) = findings(log, loop)
    assert code == "input-limit" and "actuator.low[0]" in message


def test_a_bare_input_in_per_cent_is_told_its_unit(read, case):
    """60 on a scale of 0 to 5 V may be per cents; 6 may be, too."""
    for value, code in ((60.0, "range"), (6.0, "input-limit")):
        cells = [[r[0], str(value), *r[2:]] for r in rows()]
        ((known, message),) = findings(read(text(HEADER.replace("p1 [V]", "p1"), cells)), case.loop)
        assert known == code and "'pump1 [% of 5 V]'" in message


@pytest.mark.parametrize(("unit", "scale"), [("hz of 50", 10.0), ("RPM of 3 000 1/min", 600.0)])
def test_a_speed_of_a_pump_is_a_share_of_its_upper_limit(read, unit, scale):
    """Upper limit 5 V = 50 Hz = 3000 rpm: 3 V are 30 Hz."""
    cells = [[r[0], f"{scale * float(r[1]):g}", *r[2:]] for r in rows()]
    data = read(text(HEADER.replace("pump1 [V]", f"pump1 [{unit}]"), cells))
    np.testing.assert_allclose(data.u[:, 0], [float(r[1]) for r in rows()], rtol=1e-12)


@pytest.mark.parametrize(("low", "inputs"), [(4.0, [4.0, 12.0, 20.0]), (0.0, [0.0, 10.0, 20.0])])
def test_a_speed_of_a_drive_in_ma_begins_at_its_lower_limit(read, low, inputs):
    tank = "[{ area = 50.0, rim = 30.0, drain = 0.5, level = 5.0 }]"
    pump = f"[{{ to = 1, gain = 4.0, low = {low}, high = 20.0, initial = 12.0 }}]"
    rest = 'controller = { kind = "pi", Kc = 1.0, Ti = 50.0 }\nreachable = false'
    case = rig.loads(f'units = ["cm", "mA"]\ntank = {tank}\npump = {pump}\n{rest}')
    cells = "t [s],pump1 [Hz of 50 Hz],h1 [cm]\n0,0,5\n1,25,5.1\n2,50,5.2\n"
    np.testing.assert_allclose(read(cells, case.loop).u[:, 0], inputs, rtol=1e-12)


@pytest.mark.parametrize(
    ("known", "t", "first", "duration"),
    [
        (np.delete(np.arange(100), range(40, 60)), np.arange(100.0), 40, 20.0),
        (np.delete(np.arange(100), range(40, 41)), np.arange(100.0), 40, 1.0),
        (np.arange(0, 100, 3), np.arange(100.0), None, 0.0),  # written on change
    ],
)
@pytest.mark.parametrize("absent", [False, True])
def test_inputs_that_are_missing_are_a_gap_but_not_between_changes(
    known, t, first, duration, absent
):
    """The rows without an input are empty, or, of a long table, absent."""
    values = np.full(100, np.nan)
    values[known] = 3.0
    rows = known if absent else slice(None)
    unknown = unknown_inputs(t[rows], values[rows], t, 100)
    assert unknown.any() == (first is not None and not (absent and duration < 2))
    if unknown.any():
        assert np.flatnonzero(unknown)[[0, -1]].tolist() == [first + absent, first + duration - 1]


@pytest.mark.parametrize("changes", [False, True])
def test_a_gap_in_an_input_of_half_the_rate_is_one_unless_its_values_are_changes(changes):
    t, at = np.arange(100.0), np.delete(np.arange(0, 100, 2), range(20, 30))
    values = np.arange(len(at)) if changes else np.repeat([3.0, 4.0], len(at) // 2)
    unknown = unknown_inputs(at.astype(float), values.astype(float), t, 100)
    assert unknown.any() != changes
    if unknown.any():
        assert 38 < np.flatnonzero(unknown)[0] < np.flatnonzero(unknown)[-1] == 59


def test_an_opening_beyond_its_limit_is_noted_without_the_unit_of_the_pumps():
    case = rig.loads("""
        tank = [{ area = 10.0, rim = 9.0, level = 2.0, drain = 0.1 }]
        pump = [{ gain = 5.0, to = 1, high = 9.0 }]
        valve = [{ name = "V", from = 1, area = 0.2 }]
        controller = { kind = "open-loop" }
    """)
    u = np.tile([1.0, 1.01], (50, 1))
    (log,) = checked(tuning.log(t=np.arange(50.0), u=u, y=np.ones((50, 1))), case.loop, 1.5)
    assert "V goes to 1.01, beyond its limit, 1, in 50 of 50" in "".join(log.notes)


def test_a_gap_in_an_input_is_refused_as_one_of_all_columns(read, case):
    cells = rows(20)
    for row, cell in ((5, ""), (10, "Bad"), (11, ""), (12, "Bad")):
        cells[row][1] = cell
    log = read(text(cells=cells))
    ((code, message),) = findings(log, case.loop)
    assert code == "input-gap" and "pump1 has no value for 3 s from 10 s on" in message
    assert message.endswith("--gap 3") and not findings(log, case.loop, 3.0)
    assert not findings(log.part(0, 10), case.loop)


def test_zeros_and_ones_of_a_pump_without_a_unit_are_asked_about(read):
    loop = presets.load("cascaded").cases["open-loop"].loop  # up to 10 V
    content = "t [s],pump1,h1 [V],h2 [V]\n0,1,5,5\n1,0,5,6\n2,1,6,6\n"
    with pytest.raises(LogError, match=r"is it on/off or V\?.* state --column") as refused:
        read(content, loop)
    assert 'pump1 = ["pump1", "on/off"]  # or V' in refused.value.table
    log = read(content, loop, columns={"pump1": ("pump1", "on/off")})
    assert log.u[:, 0].tolist() == [10.0, 0.0, 10.0] and "1 is read as 10 V" in log.notes[0]
    assert read(content, loop, columns={"pump1": ("pump1", "V")}).u[:, 0].tolist() == [1, 0, 1]
    assert read(content.replace("1,0,5", "1,2,5"), loop).u[1, 0] == 2.0
    with pytest.raises(DataError, match=r"0\.5: must be 0 or 1"):
        read(content.replace("1,0,5", "1,0.5,5"), loop, columns={"pump1": ("pump1", "on/off")})


def test_a_part_keeps_its_lines(read):
    log = read(text()).part(2, 5)
    assert log.samples == 3
    assert list(log.lines) == [4, 5, 6] and log.where(0, 0) == "log.csv, line 4, column 't [s]'"


@pytest.mark.extended
def test_a_long_log_is_read(read):
    """The numbers of the last row, and its line."""
    n = 20_000
    body = "\n".join(f"{k / 10:.1f},3,2.8,{k % 7}.5,2,1,{k % 3}" for k in range(n))
    log = read(f"{HEADER}\n{body}\n")
    assert log.samples == n and log.y[-1, 0] == (n - 1) % 7 + 0.5 and log.lines[-1] == n + 1


def test_arrays_with_masks_dates_and_tanks():
    t, u, y = np.arange(4.0), np.ones(4), np.array([1.0, 7.0, 1.2, 1.3])
    hidden = tuning.log(t=t, u=u, y=np.ma.array(y, mask=[0, 1, 0, 0])).y[:, 0]
    np.testing.assert_array_equal(hidden, [1.0, np.nan, 1.2, 1.3])
    with pytest.raises(DataError, match="pump1 = nan"):
        tuning.log(t=t, u=np.ma.array(u, mask=[0, 0, 1, 0]), y=y)
    begin = np.datetime64("2026-03-01T12:00:00")
    for unit in ("s", "ms", "us", "ns"):
        dates = (begin + np.arange(0, 120, 30).astype("timedelta64[s]")).astype(f"M8[{unit}]")
        for times in (dates, dates - dates[0]):
            assert tuning.log(t=times, u=u, y=y).t.tolist() == [0.0, 30.0, 60.0, 90.0]
    assert tuning.log(t=t, u=u, y=y, tanks=1, in_volts=True).tanks == (1,)
    for tanks in (["LT101"], [0.9], [-1], [True]):
        with pytest.raises(DataError, match="must be the number of a tank"):
            tuning.log(t=t, u=u, y=y, tanks=tanks)
    with pytest.raises(DataError, match="has no sample"):
        tuning.log(t=[], u=[], y=[])
