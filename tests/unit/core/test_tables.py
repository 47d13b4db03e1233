"""Tables in files, in the dialects of plants: cells, numbers and times against Python's own."""

import datetime as dt

import numpy as np
import openpyxl
import pytest

from jaxtank.core.errors import DataError
from jaxtank.core.stamps import seconds
from jaxtank.core.tables import Ambiguous, numbers, read_table, split_header

T0 = dt.datetime(2026, 11, 3, 23, 59, 50)
STEPS = np.array([0.0, 5.0, 10.0, 17.25, 3600.0, 90000.0])
TIMES = [T0 + dt.timedelta(seconds=s) for s in STEPS]


@pytest.fixture
def table(tmp_path):
    """table(text or bytes, decimal) -> Table of a file with it."""

    def read(content, decimal="", name="log.csv"):
        path = tmp_path / name
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
        return read_table(path, decimal)

    return read


def column(*cells, head="x"):
    return "\n".join([f"{head};y", *(f"{cell};1" for cell in cells)]) + "\n"


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "utf-16-le", "cp1252"])
def test_encodings(table, encoding):
    read = table("Füllstand [m];y\n1,5;2\n".encode(encoding))
    assert read.columns[0].name == "Füllstand" and read.columns[0].unit == "m"
    assert numbers(read, 0)[0].tolist() == [1.5]


@pytest.mark.parametrize("separator", [",", ";", "\t", "|"])
def test_separators_a_row_of_units_and_lines_above_the_names(table, separator):
    rows = [["t", "LT101", "P101"], ["s", "%", "l/min"], ["0", "1.5", "2"], ["1", "2.5", "3"]]
    text = "Export of the plant\n# a comment\n" + "\n".join(map(separator.join, rows))
    read = table(text)
    assert [(c.name, c.unit) for c in read.columns] == [
        ("t", "s"),
        ("LT101", "%"),
        ("P101", "l/min"),
    ]
    assert read.head == 3 and read.lines == [5, 6]
    assert numbers(read, 1)[0].tolist() == [1.5, 2.5]


@pytest.mark.parametrize(
    ("cells", "values"),
    [
        (["1,5", "2"], [1.5, 2.0]),
        (["1.5", "2e-3"], [1.5, 2e-3]),
        (["1.234,5", "1.234"], [1234.5, 1234.0]),
        (["1,234.5", "1,234"], [1234.5, 1234.0]),
        (["0,512", "1,512"], [0.512, 1.512]),
        (["1\u2009234,5", "1\u00a0234", "−2"], [1234.5, 1234.0, -2.0]),
        (["1'234.5", ".5", "5."], [1234.5, 0.5, 5.0]),
    ],
)
def test_decimal_signs_and_thousands(table, cells, values):
    assert numbers(table(column(*cells)), 0)[0].tolist() == values


def test_what_can_be_read_two_ways_is_asked(table):
    with pytest.raises(Ambiguous, match="decimal comma, or one in thousands"):
        table(column("1,234", "2,345"))
    assert numbers(table(column("1,234"), ","), 0)[0].tolist() == [1.234]
    assert numbers(table(column("1,234"), "."), 0)[0].tolist() == [1234.0]
    with pytest.raises(Ambiguous, match="day 3 of month 11, or day 11 of month 3"):
        seconds(table(column("03/11/2026 14:05")), 0)
    with pytest.raises(Ambiguous, match="does the month come first"):
        seconds(table(column("11/03/2026 14:05", "11/13/2026 14:05")), 0)
    with pytest.raises(Ambiguous, match="hours and minutes"):
        seconds(table(column("14:05", "14:06")), 0)
    read = table(column("03/11/2026 14:05", "03/12/2026 14:05"))
    assert seconds(read, 0, "day-first").tolist() == [0.0, 30 * 86400.0]
    assert seconds(read, 0, "month-first").tolist() == [0.0, 86400.0]


@pytest.mark.parametrize(
    "write",
    [
        lambda t: t.isoformat(),
        lambda t: t.isoformat(" ") + "Z",
        lambda t: (t + dt.timedelta(hours=5.5)).isoformat() + "+05:30",
        lambda t: (t + dt.timedelta(hours=1)).strftime("%d.%m.%Y %H:%M:%S,%f CET"),
        lambda t: t.strftime("%d.%m.%y %H:%M:%S.%f"),
        lambda t: t.strftime("%d-%b-%Y %H:%M:%S.%f"),
        lambda t: t.strftime("%a %b %d, %Y %I:%M:%S.%f %p"),
        lambda t: t.strftime("%Y%m%dT%H:%M:%S.%f"),
        lambda t: f"{(t - dt.datetime(1899, 12, 30)) / dt.timedelta(days=1):.10f}",
        lambda t: f"{(t - dt.datetime(1970, 1, 1)).total_seconds():.3f}",
        lambda t: f"{(t - dt.datetime(1970, 1, 1)).total_seconds() * 1000:.0f}",
    ],
)
def test_time_stamps(table, write):
    read = table(column(*map(write, TIMES)))
    np.testing.assert_allclose(seconds(read, 0), STEPS, atol=2e-3)


def test_slashes_with_a_day_above_12_are_day_first(table):
    read = table(column("12/11/2026 23:00", "13/11/2026 00:00"))
    assert seconds(read, 0).tolist() == [0.0, 3600.0]


@pytest.mark.parametrize(
    ("head", "cells", "values"),
    [
        ("t [min]", ["0", "0.5"], [0.0, 30.0]),
        ("elapsed minutes", ["0", "2"], [0.0, 120.0]),
        ("t", ["0:00:00", "0:00:05.5", "1:00:00"], [0.0, 5.5, 3600.0]),
        ("t", ["23:59:58", "00:00:03"], [0.0, 5.0]),
        ("t [mm:ss]", ["0:30", "75:15"], [0.0, 74 * 60 + 45.0]),
        ("t", ["202611300759", "202611300800"], [0.0, 60.0]),
        ("t", ["20261130075959", "20261130080000"], [0.0, 1.0]),
        ("t [mm:ss]", ["0:30", "1:15"], [0.0, 45.0]),
        ("t", ["1.00:00:00", "1.00:00:05"], [0.0, 5.0]),
        ("t", ["0 days 00:00:00", "1 days 00:00:01"], [0.0, 86401.0]),
        ("t", ["PT0S", "PT1M0.5S", "P1DT1H"], [0.0, 60.5, 90000.0]),
    ],
)
def test_durations(table, head, cells, values):
    assert seconds(table(column(*cells, head=head)), 0).tolist() == values


@pytest.mark.parametrize("last", ["23:15", "75:15"])
def test_hours_or_minutes_are_asked_for(table, last):
    """Elapsed hours have no end at 24."""
    with pytest.raises(Ambiguous, match=f"'{'75' if last > '3' else '0'}:.*hours and minutes"):
        seconds(table(column("0:30", last, head="t")), 0)


def test_ten_digits_that_are_a_date_and_seconds_since_1970_are_asked_about(table):
    with pytest.raises(DataError, match="2026-11-30 07:00:00, or 2052-09-30 09:18:20"):
        seconds(table(column("2611300700", "2611300701", head="t")), 0)
    read = table(column("1764486000", "1764486060", head="t"))
    assert seconds(read, 0).tolist() == [0.0, 60.0]


def test_missing_words_are_counted_and_all_other_texts_refused_at_once(table):
    values, words = numbers(table(column("1", "Bad", "", "NaN", "Bad")), 0)
    assert np.isnan(values).tolist() == [False, True, True, True, True]
    assert words == {"Bad": 2, "NaN": 1}
    with pytest.raises(DataError, match=r"line 2.*'abc' is not a number \(2 times\); nor is 'x'"):
        numbers(table(column("abc", "abc", "x", "1")), 0)


@pytest.mark.parametrize("cell", ["2026-13-01 00:00", "31.02.2026 00:00", "2026-01-01 25:00", "x"])
def test_times_that_are_none(table, cell):
    with pytest.raises(DataError, match=r"line 3, column 'x'"):
        seconds(table(column("2026-01-01 00:00", cell)), 0)


@pytest.mark.parametrize(
    ("content", "words"),
    [("", "is empty"), ("a;b\n", "no samples"), ("a;b\n1;2;3\n", "3 cells under 2"),
     (b"\x89PNG\r\n\x1a\n" + bytes(range(256)), "is not text"), (b"PK\x03\x04zip", "Excel")],
)  # fmt: skip
def test_files_that_are_no_table(table, content, words):
    with pytest.raises(DataError, match=words):
        table(content)


def test_an_excel_file(table, tmp_path):
    book = openpyxl.Workbook()
    book.active.append(["when", "LT101 [m]", "after"])
    for time, value in zip(TIMES, STEPS):
        book.active.append([time, value / 7, dt.timedelta(seconds=value)])
    book.save(tmp_path / "log.xlsx")
    read = read_table(tmp_path / "log.xlsx")
    np.testing.assert_allclose(seconds(read, 0), STEPS, atol=1e-3)
    np.testing.assert_allclose(seconds(read, 2), STEPS, atol=1e-3)
    np.testing.assert_allclose(numbers(read, 1)[0], STEPS / 7, rtol=1e-15)


def test_names_and_units_of_headers():
    pairs = {"h1 [cm]": ("h1", "cm"), "pump1_V": ("pump1", "V"), "flow_l/min": ("flow", "l/min"),
             "Level in cm": ("Level", "cm"), "LT101 %": ("LT101", "%"), "tank A": ("tank A", None),
             "upper_tank": ("upper_tank", None), "pump_1": ("pump_1", None)}  # fmt: skip
    assert {header: split_header(header) for header in pairs} == pairs
