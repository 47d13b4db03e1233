"""Times in tables as people write them: dates, clocks, time spans, seconds, numbers of days."""

import datetime as dt
import re
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from jaxtank.core.errors import DataError
from jaxtank.core.quantities import size_of
from jaxtank.core.tables import (
    MISSING,
    NUMBERS,
    ORDERS,
    Ambiguous,
    Column,
    Table,
    is_known,
    numbers,
    unit_name,
)
from jaxtank.core.text import shortened

CLOCK = (
    r"(?P<H>\d{1,2}):(?P<M>\d{2})(?::(?P<S>\d{2})(?:[.,](?P<f>\d+))?)?"
    r"(?:\s*(?P<half>[AaPp])\.?[Mm]\.?)?\s*(?P<zone>Z|[A-Za-z]{2,5}|[-+]\d{2}(?::?\d{2})?)?"
)
MONTHS = {
    **{"jan": 1, "feb": 2, "mar": 3, "apr": 4, "may": 5, "jun": 6, "jul": 7, "aug": 8, "sep": 9},
    **{"oct": 10, "nov": 11, "dec": 12, "mrz": 3, "mai": 5, "okt": 10, "dez": 12},
}
MONTH, YEAR = rf"(?P<month>(?i:{'|'.join(MONTHS)}))[a-z]*\.?", r"(?P<y>\d{4}|\d{2})"
DATES = (
    r"(?P<y>\d{4})[-/.](?P<m>\d{1,2})[-/.](?P<d>\d{1,2})",
    r"(?P<y>\d{4})(?P<m>\d{2})(?P<d>\d{2})(?=[T ])",
    rf"(?P<a>\d{{1,2}})(?P<joint>[./-])(?P<b>\d{{1,2}})(?P=joint){YEAR}",
    rf"(?P<d>\d{{1,2}})[-. /]*{MONTH}[-, /]*{YEAR}",
    rf"{MONTH}[- ](?P<d>\d{{1,2}}),?[- ]{YEAR}",
)
STAMPS = [
    re.compile(rf"(?:[^\W\d]{{2,9}}\.?,? )?{date}(?:(?:[T_, :]\s*)+{CLOCK})?", re.ASCII)
    for date in DATES
]
SPAN = re.compile(
    r"(?:(?P<d>\d+)(?:\s*d(?:ays?)?,?\s*|[. ]))?(?P<a>\d+):(?P<b>\d{2})(?::(?P<c>\d{2})"
    r"(?:[.,](?P<f>\d+))?)?",
    re.ASCII,
)
ISO_SPAN = re.compile(
    r"P(?:(?P<d>[\d.]+)D)?T?(?:(?P<a>[\d.]+)H)?(?:(?P<b>[\d.]+)M)?(?:(?P<c>[\d.]+)S)?", re.ASCII
)
SPREADSHEET_DAY = re.compile(r"([-\d.]+) d", re.ASCII)
ZONES = {  # hours east of Greenwich
    **{"z": 0.0, "utc": 0.0, "gmt": 0.0, "wet": 0.0, "west": 1.0, "bst": 1.0, "cet": 1.0},
    **{"mez": 1.0, "cest": 2.0, "mesz": 2.0, "eet": 2.0, "eest": 3.0},
}
EPOCH = dt.datetime(1970, 1, 1)
DAY = 86400.0
SERIALS = (20_000.0, 80_000.0)  # days of Excel, of the years 1954 to 2119
SERIAL_OF_1970 = 25_569.0  # [d]
EPOCHS = ((1e9, 1.0), (1e12, 1e-3), (1e15, 1e-6), (1e18, 1e-9))
"""Least number of s, ms, us and ns since 1970 that is read as such (2001), and their size [s]."""


def is_time(cell: str) -> bool:
    """Whether a text is a time stamp or a duration."""
    return any(stamp.fullmatch(cell) for stamp in (*STAMPS, SPAN))


def _is_time_or_half(cell: str) -> bool:
    """Whether a text is a time, also one of AM or PM alone."""
    clock = re.fullmatch(CLOCK, cell, re.ASCII)
    return is_time(cell) or bool(clock and clock["half"])


def _dates_and_clocks(columns: list[Column]) -> tuple[list[int], list[int]]:
    """Indices of the columns of dates alone, and of those of times of day."""
    times = [i for i, column in enumerate(columns) if _is_time_or_half(column.cells[0])]
    of_a_day = re.compile(r"([01]?\d|2[0-3]):")  # and no time that has passed, of more hours
    days = [i for i in times if not any(":" in cell for cell in columns[i].cells)]
    texts = {i: filter(None, columns[i].cells) for i in times}
    return days, [i for i in times if all(map(of_a_day.match, texts[i]))]


def join_times(table: Table, name: str = "") -> list[int]:
    """Add a column of dates and times of day joined; return the indices of the three. [] without
    both, where `name` is another column, or without it one is called t or time.
    """
    columns = table.columns
    days, clocks = _dates_and_clocks(columns)
    if not (days and clocks):
        return []
    day, clock = columns[days[0]], columns[clocks[0]]
    header = f"{day.header} {clock.header}"
    names = day.header, day.name, clock.header, clock.name, header
    others = (c for i, c in enumerate(columns) if i not in (days[0], clocks[0]))
    if name and name.lower() not in map(str.lower, names):
        return []
    if not name and any(c.name.lower() in ("t", "time") for c in others):
        return []
    cells = [f"{a} {b}" for a, b in zip(day.cells, clock.cells)]
    columns.append(Column(header, header, None, cells))
    return [days[0], clocks[0], len(columns) - 1]


class Stamp(NamedTuple):
    """When the first row of a table is: `kind` of its stamps, and their value [s]."""

    kind: str
    value: float


LOCAL, ZONED, OF_DAY = "dates without a time zone", "dates with a time zone", "times without a date"


def moment(text: str) -> Stamp | None:
    """Return the Stamp of a date and time that begins with the year; None of another text."""
    match = next((m for m in (stamp.fullmatch(text) for stamp in STAMPS) if m), None)
    value = _stamp(text, "")
    if match is None or value is None or not re.match(r"\d{4}", text):
        return None
    return Stamp(ZONED if match.groupdict().get("zone") else LOCAL, value)


def written_moment(stamp: Stamp) -> str:
    """Return the text of a `moment`; "" of a time without a date."""
    if stamp.kind == OF_DAY:
        return ""
    return (EPOCH + dt.timedelta(seconds=stamp.value)).isoformat(" ") + "Z" * (stamp.kind == ZONED)


def seconds(table: Table, column: int, order: str = "") -> np.ndarray:
    """Return the times of `stamped`."""
    return stamped(table, column, order)[0]


def stamped(table: Table, column: int, order: str = "") -> tuple[np.ndarray, Stamp | None]:
    """Return (rows,) times [s] of a column: numbers in its unit; ISO or day-first time stamps,
    times of a day, durations, days of Excel and seconds since 1970, from the first row; and the
    Stamp of that row, None of numbers in a unit.

    order: one of ORDERS, for times that can be read twice; without it they raise Ambiguous.
    """
    (_, _, unit, cells) = table.columns[column]

    def place(k: int) -> str:
        return table.where(column, k)

    for k, cell in enumerate(cells):
        if cell.lower() in MISSING:
            raise DataError(f"{place(k)}: is empty: every sample needs its time")
    if unit is None and (dates := _compact_dates(cells)):
        cells = dates
    elif all(NUMBERS[table.decimal].fullmatch(cell) for cell in cells[:50]):
        return _numbers_as_times(table, column, unit)
    first = next((m for m in (stamp.fullmatch(cells[0]) for stamp in STAMPS) if m), None)
    dated = first is not None
    order = order or (_date_order if dated else _clock_order)(cells, unit, place)
    t = _read_all(cells, order, dated, place)
    kind = OF_DAY if first is None else ZONED if first.groupdict().get("zone") else LOCAL
    return t - t[0], Stamp(kind, float(t[0]))


def _read_all(cells: list[str], order: str, dated: bool, place: Callable[[int], str]) -> np.ndarray:
    """Return (rows,) seconds of time stamps, or of times of a day and durations."""
    read, t = (_stamp if dated else _span), np.empty(len(cells))
    for k, cell in enumerate(cells):
        value = read(cell, order)
        if value is None:
            kind = "a time stamp" if dated else "a number or a time"
            raise DataError(f"{place(k)}: {shortened(cell)} is not {kind}")
        t[k] = value
    if not dated and t.max() < DAY:  # times of a day go on over midnight
        t += DAY * np.cumsum(np.diff(t, prepend=t[0]) < -DAY / 2)
    return t


def _numbers_as_times(
    table: Table, column: int, unit: str | None
) -> tuple[np.ndarray, Stamp | None]:
    """Return `stamped` of a column of numbers."""
    t: Any = numbers(table, column)[0]
    if unit is not None:
        size = is_known(unit_name(unit)) and size_of(unit_name(unit))
        if not size or size[1] != {"s": 1}:
            raise DataError(
                f"{table.where(column)}: {unit!r} is no unit of time: must be one of s, ms, min, h,"
                " d"
            )
        scale: float = size[0]
        return np.asarray(t * scale), None
    step = float(np.median(np.abs(np.diff(t)))) if len(t) > 1 else 0.0
    if t.min() > SERIALS[0] and t.max() < SERIALS[1] and step < 0.5:
        days: Any = (t - t[0]) * DAY
        first = (t[0] - SERIAL_OF_1970) * DAY
        return np.asarray(days).round(3), Stamp(LOCAL, first)  # a serial has that many digits
    sizes = [size for least, size in EPOCHS if t.min() >= least and t.max() < 4 * least]
    if sizes:
        _check_seconds(table, column, float(t[0]))
        return np.asarray((t - t[0]) * sizes[0]), Stamp(ZONED, float(t[0] * sizes[0]))
    raise DataError(
        f"{table.where(column)}: has no unit: write it in the header, such as"
        f" '{table.columns[column].name} [s]'"
    )


def _check_seconds(table: Table, column: int, first: float) -> None:
    """Raise DataError where seconds since 1970 are dates of ten digits as well."""
    cells = table.columns[column].cells
    if dates := _compact_dates([f"20{cell}" for cell in cells]):
        since = (EPOCH + dt.timedelta(seconds=first)).isoformat(" ")
        raise DataError(
            f"{table.where(column, 0)}: {cells[0]!r} is {dates[0]}, or {since} as seconds since"
            " 1970: write the stamps as dates, such as 2026-11-30 07:00, or [s] in the header"
        )


def _compact_dates(cells: list[str]) -> list[str]:
    """Return time stamps of 12 or 14 digits, from the year to minutes or seconds, as ISO dates; []
    where one is none.
    """
    dates: list[str] = []
    for cell in cells:
        parts = re.fullmatch(r"((?:19|20)\d\d)(\d\d)(\d\d)(\d\d)(\d\d)(\d\d)?", cell, re.ASCII)
        if parts is None:
            return []
        year, month, day, hour, minute, second = (int(part or 0) for part in parts.groups())
        try:
            dates.append(dt.datetime(year, month, day, hour, minute, second).isoformat(" "))
        except ValueError:
            return []
    return dates


def _date_order(cells: list[str], unit: str | None, place: Callable[[int], str]) -> str:
    """Return how dates such as 03/11/2026 are read."""
    match = STAMPS[2].fullmatch(cells[0])
    if match is None or match["joint"] == ".":  # with points the day comes first everywhere
        return "day-first"
    for k, cell in enumerate(cells):
        pair = STAMPS[2].fullmatch(cell)
        if pair and int(pair["a"]) > 12:
            return "day-first"
        if pair and int(pair["b"]) > 12:
            question = f"{place(k)}: does the month come first in {cell!r}?"
            raise Ambiguous(question, "time", ("month-first", "day-first"))
    day, month = int(match["a"]), int(match["b"])
    raise Ambiguous(
        f"{place(0)}: is {cells[0]!r} day {day} of month {month}, or day {month} of month {day}?",
        "time",
        ("day-first", "month-first"),
    )


def _stamp(cell: str, order: str) -> float | None:
    """Return seconds since 1970 of a time stamp, None of another text."""
    match = next((m for m in (stamp.fullmatch(cell) for stamp in STAMPS) if m), None)
    if match is None:
        return None
    part: dict[str, Any] = match.groupdict()
    if "a" in part:
        day, month = (part["a"], part["b"]) if order != "month-first" else (part["b"], part["a"])
    else:
        day, month = part["d"], part.get("m") or MONTHS[part["month"].lower()]
    year = int(part["y"]) + (2000 if len(part["y"]) == 2 else 0)
    try:
        date = dt.datetime(year, int(month), int(day))
    except ValueError:
        return None
    clock = _clock(part)
    return None if clock is None else (date - EPOCH).total_seconds() + clock


def _clock(part: dict[str, Any]) -> float | None:
    """Return seconds of a day, in UTC, of the parts of a time."""
    if part["H"] is None:
        return 0.0
    hour, minute, second = int(part["H"]), int(part["M"]), int(part["S"] or 0)
    if part["half"]:
        hour = hour % 12 + 12 * (part["half"] in "pP")
    if hour > 24 or minute > 59 or second > 60:
        return None
    zone, offset = (part["zone"] or "").lower(), 0.0
    if zone[:1] in ("+", "-"):
        digits = zone[1:].replace(":", "").ljust(4, "0")
        offset = (int(digits[:2]) + int(digits[2:]) / 60) * (-1 if zone[0] == "-" else 1)
    elif zone:
        if zone not in ZONES:
            return None
        offset = ZONES[zone]
    return 3600.0 * (hour - offset) + 60 * minute + second + float(f"0.{part['f'] or 0}")


def _clock_order(cells: list[str], unit: str | None, place: Callable[[int], str]) -> str:
    """Return whether times such as 14:05 are "h:m" or "m:s"."""
    pairs = [match for match in map(SPAN.fullmatch, cells) if match and match["c"] is None]
    header = re.sub(r"([hms])\1", r"\1", (unit or "").lower())
    if not pairs or header in ORDERS:
        return header
    last = cells[-1] if max(int(pair["a"]) for pair in pairs) > 23 else cells[0]
    question = f"{place(cells.index(last))}: is {last!r} in hours and minutes, or minutes and"
    raise Ambiguous(f"{question} seconds?", "time", ("h:m", "m:s"))


def _span(cell: str, order: str) -> float | None:
    """Return seconds of a duration or a time of day, None of another text."""
    if days := SPREADSHEET_DAY.fullmatch(cell):
        return float(days[1]) * DAY
    match = SPAN.fullmatch(cell)
    if match is None:
        match = ISO_SPAN.fullmatch(cell)
        if match is None or len(cell) < 3:
            return None
        parts = [float(match[name] or 0) for name in "dabc"]
        return float(np.dot(parts, [DAY, 3600.0, 60.0, 1.0]))
    first, second, third = int(match["a"]), int(match["b"]), int(match["c"] or 0)
    if match["c"] is None and order == "m:s":
        first, second, third = 0, first, second
    total = 3600.0 * first + 60 * second + third + float(f"0.{match['f'] or 0}")
    return total + DAY * int(match["d"] or 0)
