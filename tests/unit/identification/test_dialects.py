"""Logs as plants write them: one experiment in many dialects, each read to the same numbers without
an option, or refused once with the [log] table that reads it.
"""

import datetime as dt
import re
import tomllib

import numpy as np
import openpyxl
import pytest
from helpers import command

import tuning
from jaxtank import rig
from jaxtank.core.errors import DataError
from tuning.identification import signals
from tuning.identification.csv_log import LogError, read_log
from tuning.identification.data_checks import check_distinct
from tuning.identification.identified_case import bare

RIG = """
units = ["m", "%"]
tank = [
    { name = "LT101", area = 0.5, rim = 1.2, level = 0.4 },
    { name = "LT102", area = 0.25, rim = 1.0, level = 0.5, drain = 4.15e-4 },
]
orifice = [{ from = "LT101", to = "LT102", area = 3.2e-4 }]
pump = [{ name = "P101", gain = 2.5e-5, to = "LT101", high = 100.0, initial = 40.0 }]
plant = { gravity = 9.81 }
controller = { kind = "open-loop", initial = [40.0] }
"""
T0 = dt.datetime(2026, 11, 3, 23, 59, 40)
T = np.arange(0.0, 60.0, 5.0)
U = np.repeat([40.0, 55.0, 30.0], 4)
Y = np.stack([0.4 + 0.002 * T, 0.5 + 0.0005 * T], axis=1)
FLOW = U * 2.5e-5 * 60_000  # l/min
ROWS = range(len(T))
WHEN = [T0 + dt.timedelta(seconds=s) for s in T]


def comma(value):
    return f"{value:.9g}".replace(".", ",")


def wide(header, *columns, separator=",", above=""):
    rows = [separator.join(map(str, cells)) for cells in zip(*columns)]
    return above + "\n".join([separator.join(header), *rows]) + "\n"


def long(rows, header="timestamp,tag,value,quality"):
    return "\n".join([header, *(",".join(map(str, row)) for row in rows)]) + "\n"


STAMPS = [t.isoformat() for t in WHEN]
GERMAN = [t.strftime("%d.%m.%Y %H:%M:%S") for t in WHEN]
TAGS = [
    *((f"{t}Z", "Area1/LT101.PV", y, "Good") for t, y in zip(STAMPS, Y[:, 0])),
    *((f"{t}Z", "Area1/LT102.PV", y, "Good") for t, y in zip(STAMPS, Y[:, 1])),
    *((f"{t}Z", "Area1/P101.OUT", u, "Good") for t, u in zip(STAMPS, U)),
]
READ = {
    "rig's names without units": wide(["t [s]", "P101", "LT101", "LT102"], T, U, *Y.T),
    "decimal commas, day-first stamps, % of the rim, flow": wide(
        ["Zeitstempel", "P101 [L/min]", "LT101 [%]", "LT102 [%]"], GERMAN, map(comma, FLOW),
        map(comma, 100 * Y[:, 0] / 1.2), map(comma, 100 * Y[:, 1]), separator=";"),
    "long, with tags of the plant": long(TAGS),
    "long, sorted by tag, with another tag": long(
        [*reversed(TAGS), (f"{STAMPS[0]}Z", "TT101.PV", 20.5, "Good")]),
    "long, topics and payloads": long([row[:3] for row in TAGS], "time,topic,payload"),
    "long, fields of annotated CSV": long(
        [("", 0, *row[:3]) for row in TAGS], "#group,false\n,table,_time,_field,_value"),
    "zones, other order, other columns, capitals": wide(
        ["TT101 [°C]", "lt102 (MM)", "Time", "lt101 (MM)", "p-101 (PCT)"], T, 1000 * Y[:, 1],
        [f"{t}+01:00" for t in STAMPS], 1000 * Y[:, 0], U),
    "serials of Excel, tabs, a row of units": wide(
        ["Date", "P101", "LT101", "LT102"],
        ["", *(f"{(t - dt.datetime(1899, 12, 30)) / dt.timedelta(days=1):.10f}" for t in WHEN)],
        ["%", *U], ["cm", *(100 * Y[:, 0])], ["cm", *(100 * Y[:, 1])], separator="\t"),
    "rows of descriptions and units": wide(
        ["Tag", "P101.CV", "LT101.PV", "LT102.PV"], ["Description", "Units", *STAMPS],
        ['"Feed pump, command"', "%", *U], ["Level", "cm", *(100 * Y[:, 0])],
        ["Level", "cm", *(100 * Y[:, 1])]),
    "date and time apart, newest first": wide(
        ["Date", "Time", "P101 [%]", "LT101 [m]", "LT102 [m]"],
        [t.strftime("%d.%m.%Y") for t in WHEN][::-1], [t.strftime("%H:%M:%S") for t in WHEN][::-1],
        U[::-1], Y[::-1, 0], Y[::-1, 1]),
    "durations, volumes in litres, lines above": wide(
        ["elapsed", "P101 [%]", "LT101 [l]", "LT102 [L]"],
        [str(dt.timedelta(seconds=s)) for s in T], U, 500 * Y[:, 0], 250 * Y[:, 1],
        above="Trend export\n# by hand\n"),
    "durations with their unit, as of MATLAB": wide(
        ["Time", "P101", "LT101", "LT102"], [f"{s / 60:.9g} min" for s in T], U, *Y.T),
    "minutes, thin spaces, UTF-16": wide(
        ["t [min]", "P101 [%]", "LT101 [µm]".replace("µm", "mm"), "LT102 [mm]"], T / 60, U,
        [f"{1000 * y:.6f}" for y in Y[:, 0]], [f"{1000 * y:,.6f}".replace(",", "\u2009")
                                                for y in Y[:, 1]]).encode("utf-16"),
    "times of day over midnight, Latin-1": wide(
        ["Uhrzeit", "P101 [%]", "LT101 [m]", "LT102 [m]", "Ölstand"],
        [t.strftime("%H:%M:%S") for t in WHEN], U, *Y.T, T).encode("latin-1"),
    "English months, values named PV beside setpoints": wide(
        ["timestamp", "P101.OUT [%]", "LT101.SP [m]", "LT101.PV [m]", "LT102.PV [m]"],
        [t.strftime("%d-%b-%y %I:%M:%S %p") for t in WHEN], U, 9 * U, *Y.T),
    "inputs written on change": wide(
        ["t [s]", "P101 [%]", "LT101 [m]", "LT102 [m]"], T,
        [u if k % 4 == 0 else "" for k, u in enumerate(U)], *Y.T),
}  # fmt: skip
AMERICAN = [t.strftime("%m/%d/%Y %H:%M:%S") for t in WHEN]
REFUSED = {
    "month-first dates": wide(["time", "P101 [%]", "LT101 [m]", "LT102 [m]"], AMERICAN, U, *Y.T),
    "a time without a unit": wide(["time", "P101 [%]", "LT101 [m]", "LT102 [m]"], T, U, *Y.T),
    "a meter of another name": wide(["t [s]", "FT101 [m3/h]", "LT101", "LT102"], T,
                                    FLOW * 0.06, *Y.T),
    "units that are none": wide(["t [s]", "P101 [%]", "LT101 [metre above]", "LT102 [masl]"], T, U,
                                *Y.T),
    "an input in mA": wide(["t [s]", "P101 [mA]", "LT101", "LT102"], T, 4 + 0.16 * U, *Y.T),
    "setpoint, value and output of a controller": wide(
        ["t [s]", "LIC101.SP", "LIC101.PV", "LIC101.OUT", "LT102"], T, 9 * U, Y[:, 0], U, Y[:, 1]),
    "all at once": wide(["when", "FIC101 [%]", "Lvl 101 [m]", "LT102 [x]"], AMERICAN, U, *Y.T),
}  # fmt: skip


@pytest.fixture(scope="module")
def loop():
    return rig.loads(RIG).loop


def written(folder, content):
    path = folder / "log.csv"
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


def same(log):
    np.testing.assert_allclose(log.t - log.t[0], T, atol=2e-3)
    np.testing.assert_allclose(log.u[:, 0], U, rtol=1e-8)
    np.testing.assert_allclose(log.y, Y, rtol=1e-8)


@pytest.mark.parametrize("dialect", READ)
def test_a_log_is_read_without_an_option(tmp_path, loop, dialect):
    same(read_log(written(tmp_path, READ[dialect]), loop))


@pytest.mark.parametrize("dialect", REFUSED)
def test_a_log_in_doubt_is_refused_once_with_the_table_that_reads_it(tmp_path, loop, dialect):
    """The table of the answer, where it asks with the other answer, reads the file."""
    path = written(tmp_path, REFUSED[dialect])
    with pytest.raises(LogError) as refused:
        read_log(path, loop)
    table = refused.value.table
    assert ("day-first" in table) == (dialect in ("month-first dates", "all at once"))
    same(read_log(path, loop, rig.loads(RIG + table.replace("day-first", "month-first")).log))


def test_an_excel_file_is_read(tmp_path, loop):
    book = openpyxl.Workbook()
    book.active.append(["Zeit", "P101 [%]", "LT101 [m]", "LT102 [m]"])
    for cells in zip(WHEN, U, *Y.T):
        book.active.append([v.item() if hasattr(v, "item") else v for v in cells])
    book.save(tmp_path / "log.xlsx")
    same(read_log(tmp_path / "log.xlsx", loop))


def test_dates_and_times_apart_are_joined_in_excel_and_where_log_names_them(tmp_path, loop):
    book, head = openpyxl.Workbook(), ["Date", "Time", "P101 [%]", "LT101 [m]", "LT102 [m]"]
    book.active.append(head)
    for t, *cells in zip(WHEN, U, *Y.T):
        day = dt.datetime.combine(t.date(), dt.time())
        book.active.append([day, t.time(), *(v.item() for v in cells)])
    book.save(tmp_path / "log.xlsx")
    for columns in ({}, {"t": "Date"}, {"t": "Date Time"}):
        same(read_log(tmp_path / "log.xlsx", loop, columns))


@pytest.mark.parametrize(
    ("marks", "header"),
    [
        (marks, header)
        for marks in [("Good", "Bad"), ("192", "0"), ("OK", "Uncertain - stuck")]
        for header in ["LT101 quality", "LT101.Q", "Status"]
        if (marks[0], header) != ("192", "LT101.Q")  # a number called Q may be a flow
    ],
)
def test_readings_of_poor_quality_are_missing(tmp_path, loop, marks, header):
    quality = [marks[k in (3, 4)] for k in ROWS]
    head = ["t [s]", "P101 [%]", "LT102 [m]", "LT101 [m]", header, "LT102 quality"]
    log = read_log(
        written(tmp_path, wide(head, T, U, Y[:, 1], Y[:, 0], quality, ["Good"] * 12)), loop
    )
    assert np.flatnonzero(np.isnan(log.y[:, 0])).tolist() == [3, 4]
    assert np.isfinite(log.y[:, 1]).all() and "2" in "".join(log.notes)


@pytest.mark.parametrize("head", ["LT101 Status", "LT101 StatusCode"])
@pytest.mark.parametrize("codes", [("0", "2147483648"), ("0x00000000", "0x80350000")])
def test_the_status_of_opc_ua_is_0_where_it_is_good(tmp_path, loop, codes, head):
    quality = [codes[k in (3, 4)] for k in ROWS]
    head = ["t [s]", "P101 [%]", "LT102 [m]", "LT101 [m]", head]
    if codes[0] != "0":
        good = wide(head, T, U, Y[:, 1], Y[:, 0], [codes[0]] * len(T))
        same(read_log(written(tmp_path, good), loop))
    log = read_log(written(tmp_path, wide(head, T, U, Y[:, 1], Y[:, 0], quality)), loop)
    assert np.flatnonzero(np.isnan(log.y[:, 0])).tolist() == [3, 4]


def test_an_input_in_the_unit_of_the_rig_counts_before_the_flow_that_it_gives(tmp_path, loop):
    head = ["t [s]", "P101.PV [L/min]", "P101.OUT [%]", "LT101 [m]", "LT102 [m]"]
    same(read_log(written(tmp_path, wide(head, T, FLOW * 0.8, U, *Y.T)), loop))


@pytest.mark.parametrize(
    "other", ["P101 load [%]", "P101 temperature", "P101 starts", "P101 [bar]"]
)
def test_a_flow_counts_before_what_else_bears_the_name_of_its_pump(tmp_path, loop, other):
    head = ["t [s]", "P101 flow [L/min]", other, "LT101 [m]", "LT102 [m]"]
    if other == "P101 [bar]":
        head[1] = "P101 [L/min]"
        with pytest.raises(LogError, match="both look like pump1"):
            read_log(written(tmp_path, wide(head, T, FLOW, 0 * U + 17, *Y.T)), loop)
    else:
        head[1] = "P101.PV [L/min]"
        same(read_log(written(tmp_path, wide(head, T, FLOW, 0 * U + 17, *Y.T)), loop))


@pytest.mark.parametrize(
    ("header", "values"), [("Speed [%]", U), ("Speed [rpm]", 30 * U), ("Drive [%]", 0 * U + 40.0)]
)
def test_an_input_that_no_name_tells_is_asked_for(tmp_path, loop, header, values):
    """And is no drain test; a pump that is off throughout is one."""
    head = ["t [s]", header, "LT101 [m]", "LT102 [m]"]
    with pytest.raises(LogError, match="no column for pump1"):
        read_log(written(tmp_path, wide(head, T, values, *Y.T)), loop)
    assert not np.any(read_log(written(tmp_path, wide(head, T, 0 * U, *Y.T)), loop).u)


def test_a_level_in_volts_needs_a_sensor_that_states_them(tmp_path, loop):
    head, readings = ["t [s]", "P101 [%]", "LT101 [V]", "LT102 [m]"], (5 * Y[:, 0], Y[:, 1])
    path = written(tmp_path, wide(head, T, U, *readings))
    with pytest.raises(LogError, match=r"how many m of LT101 are 1 V: .*sensor\.gain\[0\]"):
        read_log(path, loop)
    stated = rig.loads(RIG + 'values = { "sensor.gain[0]" = 0.2 }\n').loop
    log = read_log(path, stated)
    assert log.in_volts == (True, False)
    np.testing.assert_allclose(stated.sensor.level_of(0, log.y[:, 0], True), Y[:, 0], rtol=1e-8)


def test_a_valve_without_a_column_stays_where_it_is(tmp_path):
    """Also where the rig has no pump, all of which would be off in a drain test."""
    text = RIG.replace("initial = [40.0]", "initial = [0.3]").replace(
        'pump = [{ name = "P101", gain = 2.5e-5, to = "LT101", high = 100.0, initial = 40.0 }]',
        'valve = [{ name = "FV101", from = "LT102", area = 1e-4, initial = 0.3 }]',
    )
    head = ["t [s]", "LT101 [m]", "LT102 [m]"]
    log = read_log(written(tmp_path, wide(head, T, *Y.T)), rig.loads(text).loop)
    assert log.u.tolist() == [[0.3]] * len(T) and "FV101: no column: it stays" in log.notes[0]


def test_a_clock_that_is_set_back_in_a_long_table_is_refused(tmp_path, loop):
    """Values are written in the order of events; with a zone, or shuffled, they are sorted."""
    clock = [dt.datetime(2026, 10, 25, 2, 30) + k * dt.timedelta(seconds=1201) for k in range(60)]
    clock = [t - dt.timedelta(hours=t >= dt.datetime(2026, 10, 25, 3)) for t in clock]
    rows = [(t.isoformat(), "LT101", 0.4 + k / 1e3) for k, t in enumerate(clock)]
    rows += [(clock[0].isoformat(), "P101", 40)]
    with pytest.raises(LogError, match=r"line 4: the times of 'LT101' go back by 2399 s"):
        read_log(written(tmp_path, long(rows, "timestamp,tag,value")), loop)
    zoned = [(f"{t}+0{1 + (k < 2)}:00", *row) for k, (t, *row) in enumerate(rows)]
    read_log(written(tmp_path, long(zoned, "timestamp,tag,value")), loop)
    late = [*rows[5:9], rows[4], *rows[9:60], rows[-1]]  # one value came late, rows were split
    read_log(written(tmp_path, long(late, "timestamp,tag,value")), loop)
    order = np.random.default_rng(0).permutation(len(rows))
    read_log(written(tmp_path, long([rows[k] for k in order], "timestamp,tag,value")), loop)


def test_sheets_that_are_not_read_are_named(tmp_path, loop):
    book = openpyxl.Workbook()
    for title in ("Run 1", "Run 2"):
        sheet = book.create_sheet(title)
        sheet.append(["t [s]", "P101 [%]", "LT101 [m]", "LT102 [m]"])
        for cells in zip(T, U, *Y.T):
            sheet.append([v.item() for v in cells])
    book.save(tmp_path / "log.xlsx")
    log = read_log(tmp_path / "log.xlsx", loop)
    same(log)
    assert "the first sheet alone is read, and not 'Run 2'" in log.notes[0]


def test_a_half_of_a_day_in_a_column_apart(tmp_path, loop):
    head = ["Date", "Time", "P101 [%]", "LT101 [m]", "LT102 [m]"]
    noon = [t + dt.timedelta(hours=12) for t in WHEN]  # from 11:59:40 to noon
    days, clocks = ([t.strftime(form) for t in noon] for form in ("%Y-%m-%d", "%I:%M:%S %p"))
    same(read_log(written(tmp_path, wide(head, days, clocks, U, *Y.T)), loop))


def test_the_same_log_twice_is_refused():
    data = tuning.log(t=T, u=U, y=Y)
    with pytest.raises(DataError, match="hold the same data"):
        check_distinct([data, data])
    check_distinct([data, tuning.log(t=T, u=U, y=Y + 0.1)])


@pytest.mark.parametrize("header", ["P101 Status", "LT101.status", "Status"])
def test_a_status_of_0_and_1_is_asked_about(tmp_path, loop, header):
    """It may be a quality, whose good value is not known, or whether a pump runs."""
    head = ["t [s]", "P101 [%]", "LT101 [m]", "LT102 [m]", header]
    with pytest.raises(LogError, match="holds 0 and 1"):
        read_log(written(tmp_path, wide(head, T, U, *Y.T, [1 - k % 2 for k in ROWS])), loop)
    same(read_log(written(tmp_path, wide(head, T, U, *Y.T, [1 for _ in ROWS])), loop))


def test_two_values_of_a_tag_at_one_time_are_refused(tmp_path, loop):
    """As where clocks were set back; a row that is repeated is not."""
    rows = [(t, "LT101", y) for t, y in zip(T, Y[:, 0])] + [(0, "P101", 40)]
    with pytest.raises(LogError, match=r"lines 4 and 15: two values of 'LT101' at one time"):
        read_log(written(tmp_path, long([*rows, (10.0, "LT101", 0.4)], "time [s],tag,value")), loop)
    log = read_log(written(tmp_path, long([*rows, rows[2]], "time [s],tag,value")), loop)
    assert log.y[:, 0].tolist() == Y[:, 0].tolist()


CROSSED = """
tank = [{ name = "T2", area = 1.0, rim = 5.0, level = 1.0 },
    { name = "T1", area = 1.0, drain = 0.1, rim = 5.0, level = 1.0 }]
orifice = [{ from = 1, to = 2, area = 0.1 }]
pump = [{ name = "Pump2", gain = 1.0, to = 1, high = 50.0 },
    { name = "Pump1", gain = 1.0, to = 2, high = 50.0 }]
plant = { outputs = [2, 1] }
controller = { kind = "open-loop" }
"""


def test_names_of_a_rig_count_before_numbers(tmp_path):
    """Its first tank is called T2: "Tank 1" may be either, and no column is read twice."""
    loop, read = rig.loads(CROSSED).loop, lambda *head: wide(["t [s]", *head], T, U, U / 2, *Y.T)
    head = ("Pump1 [V]", "Pump2 [V]", "T1 [cm]", "T2 [cm]")
    log = read_log(written(tmp_path, read(*head)), loop)
    np.testing.assert_array_equal(log.u, np.stack([U / 2, U], axis=1))
    assert log.tanks == (0, 1) and log.y[0].tolist() == [0.5, 0.4]
    with pytest.raises(LogError, match="no column for a level"):
        read_log(written(tmp_path, read(*head[:2], "Tank 1 [cm]", "x [kg]")), loop)


def test_a_long_table_has_inputs_at_their_own_times(tmp_path, loop):
    rows = [(t, "LT101", y) for t, y in zip(T, Y[:, 0])]
    rows += [(0, "P101", 40), (7.3, "P101", 55), (31.1, "P101", 20)]
    log = read_log(written(tmp_path, long(rows, "time [s],tag,value")), loop)
    assert log.t.tolist() == sorted([*T, 7.3, 31.1]) and log.hold == "zero-order"
    at = dict(zip(log.t.tolist(), log.u[:, 0].tolist()))
    assert (at[5.0], at[7.3], at[10.0], at[35.0]) == (40.0, 55.0, 55.0, 20.0)
    assert np.isnan(log.y[log.t == 7.3]).all() and log.tanks == (0,)


def test_without_a_pump_it_is_a_drain_test(tmp_path, loop):
    head = ["t [s]", "LT101 [m]", "LT102 [m]"]
    log = read_log(written(tmp_path, wide(head, T, *Y.T)), loop)
    assert not log.u.any() and any("drain" in note for note in log.notes)
    with pytest.raises(LogError):  # where another column may be the pump's, it is asked
        read_log(written(tmp_path, wide([*head, "speed"], T, *Y.T, U)), loop)
    read_log(written(tmp_path, wide([*head, "TT101 [°C]"], T, *Y.T, U)), loop)
    read_log(written(tmp_path, wide([*head, "LT101.SP"], T, *Y.T, U)), loop)


def test_the_log_table_of_a_rig_may_hold_columns_and_units_apart(tmp_path):
    content = wide(["when", "a", "LT101", "c"], GERMAN, U, 100 * Y[:, 0], Y[:, 1])
    table = '[log]\ncolumns = { t = "when", P101 = "a", h2 = "c" }\nunits = { LT101 = "cm" }\n'
    case = rig.loads(RIG + table)
    same(read_log(written(tmp_path, content), case.loop, case.log))
    assert rig.loads(rig.dump(case)).log == case.log


def test_a_rig_predicts_a_log_from_its_first_samples(tmp_path):
    """A falling tank in closed form, h = (sqrt(h0) - c t)^2: residuals are the noise, the bias of a
    sensor is reported, and a constant level says that its fit in % means nothing.
    """
    area, drain, g, noise = 0.25, 4.15e-4, 9.81, 1e-3
    text = """units = ["m", "%"]
    tank = [{ name = "LT1", area = 0.25, rim = 1.0, drain = 4.15e-4, level = 0.9 }]
    pump = [{ gain = 2e-5, to = "LT1", high = 100.0, initial = 0.0 }]
    plant = { gravity = 9.81 }
    controller = { kind = "open-loop", initial = [0.0] }
    """
    case, t = rig.loads(text), np.arange(0.0, 200.0, 2.0)
    h = (np.sqrt(0.8) - drain * np.sqrt(2 * g) / (2 * area) * t) ** 2
    rng = np.random.default_rng(0)
    y = h + noise * rng.standard_normal(len(t))
    result = tuning.predict(case, tuning.log(t=t, u=0 * t, y=y), start_samples=30)
    assert result.levels[0, 0] == pytest.approx(0.8, abs=3 * noise)
    assert result.quality["rmse"][0] == pytest.approx(noise, rel=0.25)
    assert result.quality["white"][0] > 0.01 and abs(result.quality["bias"][0]) < noise
    y[30:] += 0.02  # another sensor from then on
    moved = tuning.predict(case, tuning.log(t=t, u=0 * t, y=y), start_samples=30)
    assert moved.quality["bias"][0] == pytest.approx(0.02 * 70 / 100, abs=noise)
    assert moved.quality["white"][0] < 1e-6 and result.to_json()["fit"]["rmse"][0] < 2 * noise
    full = drain * np.sqrt(2 * g * 0.5) / 2e-5  # holds 0.5 m
    still = tuning.log(t=t, u=0 * t + full, y=0.5 + noise * rng.standard_normal(len(t)))
    assert "read the RMSE" in tuning.predict(case, still).to_json()["message"]


def test_the_command_answers_once_and_writes_nothing(tmp_path):
    (tmp_path / "rig.toml").write_text(RIG)
    path = written(tmp_path, REFUSED["all at once"])
    words = (str(tmp_path / "rig.toml"), "--data", str(path), "--out", str(tmp_path / "out"))
    code, out, err = command("identify", *words)
    assert code == 5 and out == "" and not (tmp_path / "out").exists()
    table = tomllib.loads(err[err.index("[log]") :])["log"]
    assert table == {
        "t": "when", "P101": "FIC101 [%]", "LT101": "Lvl 101 [m]", "LT102": ["LT102 [x]", "m"],
        "time": "day-first",
    }  # fmt: skip
    assert re.search(r"day 11 of month 3", err)


MIXED = ["m", "cm", "mm"] * 4
IN_M = {"m": 1.0, "cm": 100.0, "mm": 1000.0}


def in_cells(units, values):
    return [f"{v * IN_M[u]:.12g} {u}" for v, u in zip(values, units)]


@pytest.mark.parametrize("header", ["LT101", "LT101 [mm]"])
@pytest.mark.parametrize("comma", [False, True])
def test_a_unit_in_each_cell_is_the_unit_of_that_cell(tmp_path, loop, header, comma):
    cells = in_cells(MIXED, Y[:, 0])
    times = [f"{t:g} s" if t < 30 else f"{t / 60:.12g} min" for t in T]
    columns = [times, [f"{u:g} %" for u in U], cells, Y[:, 1]]
    if comma:
        columns = [[str(cell).replace(".", ",") for cell in column] for column in columns]
    content = wide(["time", "P101", header, "LT102"], *columns, separator=";" if comma else ",")
    same(read_log(written(tmp_path, content), loop))


def test_a_long_table_may_have_a_unit_for_each_value(tmp_path, loop):
    rows = [
        *((t, "LT101", f"{y * IN_M[u]:.12g}", u) for t, y, u in zip(STAMPS, Y[:, 0], MIXED)),
        *((t, "LT102", y, "m") for t, y in zip(STAMPS, Y[:, 1])),
        *((t, "P101", u, "%") for t, u in zip(STAMPS, U)),
    ]
    header = "timestamp,tag,value,unit"
    same(read_log(written(tmp_path, long(rows, header)), loop))
    rows[5] = (STAMPS[5], "LT101", 0.4, "V")
    with pytest.raises(LogError, match=r"line 7, column .LT101.: .0.4 V. .* does not convert"):
        read_log(written(tmp_path, long(rows, header)), loop)


@pytest.mark.parametrize("cell", ["12 %", "400"])
def test_a_cell_whose_unit_is_not_known_is_refused_with_its_row(tmp_path, loop, cell):
    cells = in_cells(MIXED, Y[:, 0])
    cells[3] = cell
    content = wide(["t [s]", "P101", "LT101", "LT102"], T, U, cells, Y[:, 1])
    line = 5 if "%" in cell else 2
    with pytest.raises(LogError, match=f"line {line}, column 'LT101': .* other cells have none"):
        read_log(written(tmp_path, content), loop)


@pytest.mark.parametrize(
    "pair", ["ON OFF", "TRUE FALSE", "True False", "Running Stopped", "open closed", "ein aus"]
)
@pytest.mark.parametrize("header", ["P101", "P101 [%]", "P101 running"])
def test_words_for_a_pump_are_the_ends_of_its_range(tmp_path, pair, header):
    on, off = pair.split()
    loop = rig.loads(RIG.replace("high = 100.0", "low = 5.0, high = 80.0")).loop
    cells = [on if k % 4 < 2 else off for k in ROWS]
    cells[5] = ""
    log = read_log(
        written(tmp_path, wide(["t [s]", header, "LT101", "LT102"], T, cells, *Y.T)), loop
    )
    np.testing.assert_array_equal(log.u[:, 0], [80.0 if k % 4 < 2 else 5.0 for k in ROWS])
    (note,) = [note for note in log.notes if on in note]
    assert "80 %" in note and "5 %" in note and off in note


def test_words_for_a_pump_without_a_range_are_refused_with_the_remedy(tmp_path, loop):
    cells = ["ON" if k % 4 < 2 else "OFF" for k in ROWS]
    path = written(tmp_path, wide(["t [s]", "P101", "LT101", "LT102"], T, cells, *Y.T))
    with pytest.raises(LogError, match=r"'P101': 'ON' and 'OFF' .* write low and high of P101"):
        read_log(path, bare(loop.plant).loop)
    cells[3] = "40"
    path = written(tmp_path, wide(["t [s]", "P101", "LT101", "LT102"], T, cells, *Y.T))
    with pytest.raises(LogError, match="'ON' is not a number"):
        read_log(path, loop)


@pytest.mark.parametrize("pair", ["TRUE FALSE", "Running Stopped"])
@pytest.mark.parametrize("header", ["P101 status", "feed pump"])
def test_the_state_of_a_pump_judges_no_reading_and_is_no_drain_test(tmp_path, loop, header, pair):
    """A column of another name is asked for; named, it is read, and no reading is missing."""
    on, off = pair.split()
    cells = [on if k % 4 < 2 else off for k in ROWS]
    path = written(tmp_path, wide(["t [s]", "LT101", "LT102", header], T, *Y.T, cells))
    with pytest.raises(LogError, match=f"no column for pump1 .* among .*'{header}'"):
        read_log(path, loop)
    log = read_log(path, loop, {"P101": header})
    assert np.isfinite(log.y).all() and set(log.u[:, 0]) == {0.0, 100.0}


def labview(segments=1, decimal=".", columns="One", unit="cm", again=False):
    """A measurement file of LabVIEW; each segment has a header, and the last cell is a comment."""

    def head(**facts):
        rows = ["\t".join([k, *np.atleast_1d(v)]) for k, v in facts.items()]
        return [*rows, "***End_of_Header***\t", "\t"]

    text = ["LabVIEW Measurement\t"]
    text += head(Writer_Version="2", Separator="Tab", Decimal_Separator=decimal,
                 Multi_Headings="Yes", X_Columns=columns, Time_Pref="Relative",
                 Date="2026/11/03", Time="23:59:40.0")  # fmt: skip
    for k in np.split(np.arange(len(T)), segments):
        text += head(Channels="3", Samples=["4"] * 3, Y_Unit_Label=["Volts", unit, unit],
                     X_Dimension=["Time"] * 3, Delta_X=["5.000000"] * 3)[:-1]  # fmt: skip
        text.append("X_Value\tP101\tLT101\tLT102\tComment")
        t = T[k] - T[k[0]] * again
        rows = zip(t, U[k], *(100 * Y[k]).T)
        text += ["\t".join(f"{v:.6f}" for v in row).replace(".", decimal) for row in rows]
    return "\r\n".join(text) + "\r\n"


@pytest.mark.parametrize("segments", [1, 3])
@pytest.mark.parametrize("decimal", [".", ","])
def test_a_measurement_file_of_labview_is_read(tmp_path, segments, decimal):
    loop = rig.loads(RIG.replace('["m", "%"]', '["m", "V"]')).loop
    same(read_log(written(tmp_path, labview(segments, decimal)), loop))


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (labview(columns="Multi"), "line 18: its X values .* 'One column only'"),
        (labview(segments=3, again=True), "begins again at X_Value 0.000000: .* all with --data"),
    ],
)
def test_one_of_several_x_columns_or_runs_is_refused_with_the_remedy(tmp_path, content, words):
    loop = rig.loads(RIG.replace('["m", "%"]', '["m", "V"]')).loop
    with pytest.raises(DataError, match=words):
        read_log(written(tmp_path, content), loop)


@pytest.mark.parametrize(
    ("text", "tank"),
    [
        ("Tank 1 level SP", 0),
        ("upper tank.level setpoint", 2),
        ("SP of tank 2", 1),
        ("area 3 tank 2 SP", 1),
        ("setpoint 3", 2),
        ("LIC102.SP", 1),
        ("FIC102.SP", None),
        ("tank 1 tank 2 SP", None),
        ("tank 1 level", None),
    ],
)
def test_a_setpoint_is_of_the_tank_that_any_part_of_its_name_means(text, tank):
    names = {0: ["tank1", "h1"], 1: ["tank2", "h2"], 2: ["uppertank"]}
    names[1].append("lt102")
    assert signals.setpoint_of(text, names) == tank


@pytest.mark.parametrize(
    ("levels", "first", "second"),
    [
        ((30.0, 40.0), "%", "cm"),
        ((0.3, 0.4), "cm", "%"),
        ((130.0, 150.0), "cm", "%"),
        ((*[30.0] * 20, -99.0), "%", "cm"),
    ],
)
def test_a_level_without_a_unit_of_a_sensor_in_per_cent_is_asked_about(
    tmp_path, levels, first, second
):
    """Beside the tank whose sensor reads the rig's unit, which is not asked about."""
    sensors = """sensor = [
    { name = "LIT1", tank = "LT101", unit = "%", span = [0.0, 200.0] },
    { name = "LIT2", tank = "LT102", unit = "cm", span = [0.0, 200.0] },
]
"""
    text = RIG.replace('["m", "%"]', '["cm", "%"]').replace("plant = {", sensors + "plant = {")
    loop = rig.loads(text.replace("rim = 1.2", "rim = 200").replace("rim = 1.0", "rim = 200")).loop
    content = wide(
        ["t [s]", "P101", "LIT1", "LIT2"], range(len(levels)), [40] * len(levels), levels, levels
    )
    path = written(tmp_path, content)
    with pytest.raises(LogError) as refused:
        read_log(path, loop)
    (problem,) = refused.value.problems
    assert f"'LIT1': has no unit: is it {first} or {second}?" in problem
    assert f'--column "LT101=LIT1;{first}"' in problem
    table = rig.loads(text + refused.value.table).log
    right = np.array(levels) * (2.0 if first == "%" else 1.0)
    right = np.where(right < -50.0, np.nan, right)  # a reading that failed
    np.testing.assert_allclose(read_log(path, loop, table).y[:, 0], right)


def test_inputs_up_to_1_of_a_range_in_per_cent_are_asked_about(tmp_path):
    """0.4 may be 0.4 % or 40 %; a column whose header says "-" is read."""
    case = rig.loads(RIG)
    rows = [f"{t},{u / 100},{a},{b}" for t, u, (a, b) in zip(T, U, Y)]
    for unit in ("", " [-]"):
        text = f"t [s],P101{unit},LT101 [m],LT102 [m]\n" + "\n".join(rows)
        (tmp_path / "log.csv").write_text(text)
        if unit:
            assert np.allclose(read_log(tmp_path / "log.csv", case).u[:, 0], U)
            continue
        with pytest.raises(LogError, match=r"is it - or %\? Its numbers are up to 0.55") as refused:
            read_log(tmp_path / "log.csv", case)
        assert 'P101 = ["P101", "-"]  # or %' in refused.value.table
