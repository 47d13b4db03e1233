"""Tables in files beside a rig file: setpoints, inputs and inflows as columns over time."""

import contextlib
import functools
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxtank.core import stamps, tables
from jaxtank.core.errors import DataError, InputError, nearest
from jaxtank.core.labels import index_of, label_of, name_of
from jaxtank.core.quantities import converted, factor
from jaxtank.rig.entry import Problems, is_numeric, refusal
from jaxtank.rig.sensors import check_current, in_span

KEYS = ("csv", "column", "time", "time_order", "decimal")
"""Keys of a table of a rig file that name a file in place of `changes`."""
MOST = 100_000  # rows of a table, so that a rig file that holds them can be read again
TIMES = ("t", "time", "zeit", "timestamp", "date", "datetime")
"""Names of the column of times where none is given; else it is the first one."""


def resolved(table: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    """Return a rig file's table with Columns for files, from its `begins` or the earliest time."""
    read: list[Columns] = []

    def of_file(label: str, value: Any) -> Any:
        if not isinstance(value, dict) or not isinstance(value.get("csv"), str):
            return value
        value = {**value, "csv": str(folder / value["csv"])}
        with contextlib.suppress(InputError):  # which is raised again where the table is read
            read.append(Columns(label, value))
            value["csv"] = read[-1]
        return value

    out = {name: of_file(name, value) for name, value in table.items()}
    if isinstance(out.get("inflow"), list):
        out["inflow"] = [of_file(f"inflow {i}", row) for i, row in enumerate(out["inflow"], 1)]
    first = _start_together(read, _moment(out["begins"]) if "begins" in out else None)
    return out | ({"begins": first} if first else {})


class Repeat(NamedTuple):
    """`repeat` of a table: its rows begin again after each period, until the run ends."""

    period: float  # [s]
    until: float  # duration of the run [s]

    def tiled(self, label: str, times: Any, rows: Any) -> tuple[np.ndarray, np.ndarray]:
        """Return rows at (times [s], rows), those of the period before t = 0 too."""
        times, rows = np.asarray(times, dtype=float), np.asarray(rows)
        ends = times - times[0] == self.period  # 24:00, which is 0:00 of the next day
        begun = rows[times == times[0]].tolist()
        if ends.any() and all(row in begun for row in rows[ends].tolist()):
            times, rows = times[~ends], rows[~ends]
        if times[-1] - times[0] >= self.period:
            raise InputError(
                f"{label}: repeat = {self.period:g} s, and its rows go from {times[0]:g} s to"
                f" {times[-1]:g} s: must be longer than they are (a last row at the end of the"
                " period is that of its begin: give it the same value, or leave it out)"
            )
        first = -math.ceil(times[0] / self.period)
        periods = np.arange(first, math.floor((self.until - times[0]) / self.period) + 2)
        if len(periods) * len(times) > MOST:
            raise InputError(
                f"{label}: repeat makes {len(periods) * len(times)} rows of {len(times)}: must be"
                f" at most {MOST}; shorten the run"
            )
        tiled = (times + self.period * periods[:, None]).ravel()
        return tiled, np.concatenate([rows] * len(periods))

    def changes(self, label: str, changes: Sequence[tuple]) -> list[tuple]:
        """Return changes (time [s], channel, value) and those of later periods."""
        if not changes:
            return []
        times, rows = self.tiled(label, [t for t, *_ in changes], [row for _, *row in changes])
        every = zip(times.tolist(), rows.tolist())
        return [(t, int(i), v) for t, (i, v) in every if 0.0 <= t <= self.until]


def course(
    label: str, times: Any, values: Any, repeat: Repeat | None = None, between: str = "hold"
) -> tuple[np.ndarray, np.ndarray]:
    """Return (times, values) of rows from t = 0 on, of a Repeat to the end of the run."""
    ends = [0.0]
    if repeat is not None:
        times, values = repeat.tiled(label, times, values)
        ends.append(repeat.until)
    elif times[0] >= 0.0:
        return times, values
    known = np.interp(ends, times, values)
    if between == "hold":
        known = values[np.searchsorted(times, ends, "right") - 1]
    inside = (times > 0.0) & (times < (np.inf if repeat is None else repeat.until))
    joined = lambda ends, rows: np.concatenate([ends[:1], rows[inside], ends[1:]])
    return joined(np.array(ends), times), joined(known, values)


def with_repeats(table: Mapping[str, Any], duration: Any) -> dict[str, Any]:
    """Return a rig file's table with a Repeat for each `repeat`; duration: that of the run."""

    def of_entry(label: str, entry: Any) -> Any:
        if not isinstance(entry, dict) or "repeat" not in entry:
            return entry
        label = f"{label}.repeat"
        if not is_numeric(until := converted("duration", duration, "s")):
            raise InputError(f"{label}: needs the duration of the run: write duration = ... too")
        if not 0.0 < until < math.inf:
            raise InputError(f"clock.duration = {until:g} s: must be a finite number above 0 s")
        until = float(until)
        period = converted(label, entry["repeat"], "s")
        if not (is_numeric(period) and 0.0 < period < math.inf):
            raise refusal(label, entry["repeat"], "be a time above 0 s")
        return {**entry, "repeat": Repeat(float(period), until)}

    out = {
        name: of_entry(name, table[name]) for name in ("reference", "controller") if name in table
    }
    if isinstance(table.get("inflow"), list):
        out["inflow"] = [of_entry(f"inflow {i}", row) for i, row in enumerate(table["inflow"], 1)]
    return {**table, **out}


def _moment(value: Any) -> stamps.Stamp:
    """Return the Stamp of a date and time of a rig file, TOML's own or a text."""
    stamp = stamps.moment(str(value))
    if stamp is None:
        raise refusal("begins", value, 'be a date and time, such as "2026-11-30 07:00"')
    return stamp


def _start_together(read: list["Columns"], begins: stamps.Stamp | None) -> str:
    """Set the start time of each table; return the date of t = 0."""
    starts, daily, begins = _apart(_stamps_of(read), begins)
    origin = set() if begins is None else {begins.kind}
    if len({stamp.kind for stamp in starts.values()} | origin) > 1:
        # durations from 0 on need no date, nor do times of a day where t = 0 is a midnight
        zero = stamps.Stamp(stamps.OF_DAY, 0.0)
        dated = {columns: stamp for columns, stamp in starts.items() if stamp != zero}
        if _first(dated, begins).value % stamps.DAY == 0.0:
            starts = dated
    _check_comparable(starts, begins)
    if not starts and begins is None:
        return ""
    first = _first(starts, begins)
    for columns, stamp in starts.items():
        columns.begins = round(stamp.value - first.value, 6)  # without rounding noise
    if daily and first.kind == stamps.ZONED:
        (columns, *_) = daily
        raise InputError(
            f"{columns.table.name} has {stamps.OF_DAY} and others have {stamps.ZONED}: of which"
            " zone these are is not known; give the others dates without a time zone"
        )
    for columns, stamp in daily.items():
        columns.begins = round((stamp.value - first.value) % stamps.DAY, 6)
    return stamps.written_moment(first)


def _apart(
    starts: dict["Columns", stamps.Stamp], begins: stamps.Stamp | None
) -> tuple[dict["Columns", stamps.Stamp], dict["Columns", stamps.Stamp], stamps.Stamp | None]:
    """Return (Stamps of tables, those of rows of every day, when t = 0 is)."""
    daily = {c: stamp for c, stamp in starts.items() if c.daily and stamp.kind == stamps.OF_DAY}
    if daily and begins is None and len(daily) == len(starts):
        begins = stamps.Stamp(stamps.OF_DAY, 0.0)  # 0:00, where no other table says it
    return {c: stamp for c, stamp in starts.items() if c not in daily}, daily, begins


def _first(starts: dict["Columns", stamps.Stamp], begins: stamps.Stamp | None) -> stamps.Stamp:
    return begins or min(starts.values(), key=lambda stamp: stamp.value)


def _stamps_of(read: list["Columns"]) -> dict["Columns", stamps.Stamp]:
    starts = {}
    for columns in read:
        with contextlib.suppress(InputError):
            if stamp := columns.stamped[1]:
                starts[columns] = stamp
    return starts


def _check_comparable(starts: dict["Columns", stamps.Stamp], begins: stamps.Stamp | None) -> None:
    """Raise InputError where the times of tables cannot be compared."""
    files = {stamp.kind: columns.table.name for columns, stamp in starts.items()}
    if begins is not None:
        files.setdefault(begins.kind, "begins")
    if len(files) > 1:
        both = " and ".join(f"{file} has {kind}" for kind, file in files.items())
        remedy = "give all tables dates with, or all without, a time zone"
        if stamps.OF_DAY in files:
            remedy = f"give the times in {files[stamps.OF_DAY]} dates, or the time since the start"
            remedy += " of the run, in s, min or h"
        raise InputError(f"{both}: their times cannot be compared; {remedy}")
    values = [stamp.value for stamp in starts.values()]
    if stamps.OF_DAY in files and np.ptp(values or [0.0]) > 0.5 * stamps.DAY:
        raise InputError(
            f"{files[stamps.OF_DAY]}: the tables begin more than 12 h apart, or at either side of"
            " midnight: give their times dates"
        )


class Columns:
    """The columns of a file that the keys of KEYS name; `label` begins each message."""

    daily = False  # its rows are those of every day

    def __init__(self, label: str, keys: Mapping[str, Any]):
        self.label = f"{label}: "
        for name in ("csv", "time"):
            if not isinstance(keys.get(name, ""), str):
                what = "a file" if name == "csv" else "a column"
                raise refusal(f"{self.label}{name}", keys[name], f"be the name of {what}")
        for name, choices in (("decimal", (".", ",")), ("time_order", tables.ORDERS)):
            if name in keys and keys[name] not in choices:
                raise refusal(f"{self.label}{name}", keys[name], f"be one of {', '.join(choices)}")
        try:
            self.table: tables.Table = tables.read_table(keys["csv"], keys.get("decimal") or "")
        except tables.Ambiguous as error:
            raise self._ambiguous(error, "decimal") from None
        except DataError as error:
            raise InputError(f"{self.label}{error}") from None
        if len(self.table.lines) > MOST:
            raise InputError(
                f"{self.label}{self.table.name}: {len(self.table.lines)} rows: must be at most"
                f" {MOST}; keep those at which a value changes"
            )
        with contextlib.suppress(InputError):  # which is raised again where it is read
            self.daily = converted("repeat", keys.get("repeat"), "s") == stamps.DAY
        self.repeats = "repeat" in keys
        self.begins = 0.0  # when the first row of a table with dates is [s]
        self.order: str = keys.get("time_order") or ""
        self.times = self._time_columns(keys.get("time"))
        self.time = self.times[-1]

    def _ambiguous(self, error: tables.Ambiguous, key: str) -> InputError:
        answers = " or ".join(f'"{answer}"' for answer in error.answers)
        return InputError(f"{self.label}{error} Write {key} = {answers} beside csv")

    def _time_columns(self, name: str | None) -> list[int]:
        """Indices of the columns of the times, the last the one to read."""
        if joined := stamps.join_times(self.table, name or ""):
            return joined
        names = [column.name.lower() for column in self.table.columns]
        usual = (names.index(known) for known in TIMES if known in names)
        return [next(usual, 0) if name is None else self.index_of(name)]

    def unit(self, text: Any) -> str | None:
        """The unit that a header of the file has, or this text; None of neither."""
        return self.table.columns[self.index_of(text)].unit or tables.split_header(text)[1]

    def index_of(self, text: Any) -> int:
        """Index of the column of a header, with or without its unit."""
        if not isinstance(text, str):
            raise refusal(f"{self.label}column", text, "be the name of a column")
        columns, stem = self.table.columns, tables.split_header(text)[0]
        names = [c.name for c in columns]
        lists = [c.header for c in columns], names, names, [name.lower() for name in names]
        for each, spelling in zip(lists, (text, text, stem, stem.lower())):
            places = [i for i, name in enumerate(each) if name == spelling]
            if len(places) > 1:
                raise InputError(
                    f"{self.label}{self.table.name}, line {self.table.head}: {len(places)} columns"
                    f" are called {text!r}: give each its own name"
                )
            if places:
                return places[0]
        headers = [column.header for column in columns]
        raise InputError(
            f"{self.label}{self.table.name}, line {self.table.head}: has no column"
            f" {text!r}{nearest(text, headers)}"
        )

    def chosen(self, column: Any, kind: str, plant: Any, count: int) -> dict[int, str]:
        """Return {channel: header} of what `column` says, else of the channels' own names."""
        if isinstance(column, dict):
            where = f"{self.label}column"
            return {index_of(where, plant, kind, key): text for key, text in column.items()}
        if column is None:
            return self._usual(kind, plant, count)
        texts = column if isinstance(column, list) else [column]
        if len(texts) != count:
            names = [name_of(plant, kind, i) or i + 1 for i in range(min(count, 2))]
            example = ", ".join(f'{name} = "..."' for name in names)
            must = f"be a column for each of {count} {kind}s, or {{ {example} }} for some of them"
            raise refusal(f"{self.label}column", column, must)
        return dict(enumerate(texts))

    def _usual(self, kind: str, plant: Any, count: int) -> dict[int, str]:
        others = [c.header for i, c in enumerate(self.table.columns) if i not in self.times]
        names = {c.name: c.header for c in self.table.columns}
        by_name = {i: name_of(plant, kind, i) for i in range(count)}
        by_name = {i: names[name] for i, name in by_name.items() if name in names}
        if by_name:
            return by_name
        if count == 1 and len(others) == 1:
            return {0: others[0]}
        twice = next((text for text in others if others.count(text) > 1), None)
        more = f"; two columns are called {twice!r}: rename one in the file" if twice else ""
        raise InputError(
            f"{self.label}column: must name a column of {self.table.name}: {', '.join(others)}"
            + more
        )

    def read(self, columns, units, spans=None) -> tuple[Any, Any]:
        """Return (times [s], {channel: values in its unit}); spans: at 0 and 100 %, of levels."""
        problems, times, values = Problems(), np.zeros(0), {}
        with problems.collect():
            times = self._times()
        for channel, text in columns.items():
            with problems.collect():
                span = spans[channel] if spans else None
                values[channel] = self._values(text, units[channel], span)
        problems.check()
        return times, values

    @functools.cached_property
    def stamped(self) -> tuple[np.ndarray, stamps.Stamp | None]:
        """(rows,) times [s], from the first row on where it has a Stamp, and this."""
        table, column = self.table, self.table.columns[self.time]
        try:
            return stamps.stamped(table, self.time, self.order)
        except tables.Ambiguous as error:
            raise self._ambiguous(error, "time_order") from None
        except DataError as error:
            refused: Exception = error
        if column.unit is None:  # numbers that are no days and no seconds since 1970
            columns = list(table.columns)
            columns[self.time] = column._replace(unit="s")
            with contextlib.suppress(DataError):
                return stamps.stamped(table._replace(columns=columns), self.time, self.order)
        raise InputError(f"{self.label}{refused}")

    def _times(self) -> np.ndarray:
        table, column = self.table, self.table.columns[self.time]
        t = self.stamped[0] + self.begins
        where = lambda k: f"{self.label}{table.where(self.time, k)}: {column.cells[k]!r}"
        end = 0 if self.stamped[1] is None else len(t) - 1
        if t[end] < 0.0 and not self.repeats:
            raise InputError(f"{where(end)}: must be at or after 0 s, where a run begins")
        late = np.flatnonzero(np.diff(t) <= 0.0) + 1
        if late.size:
            more = f", and {late.size - 1} rows below" if late.size > 1 else ""
            raise InputError(
                f"{where(late[0])}{more}: does not come after {column.cells[late[0] - 1]!r} of the"
                " row before: times must increase; sort the rows, and keep one of two at one time"
            )
        return t

    def _values(self, text: Any, base: str, span: Any = None) -> np.ndarray:
        place = self.index_of(text)
        try:
            values, _ = tables.numbers(self.table, place)
        except DataError as error:
            raise InputError(f"{self.label}{error}") from None
        missing = np.flatnonzero(np.isnan(values))
        if missing.size:
            lines = [str(self.table.lines[k]) for k in missing[:3]]
            more = f" and {missing.size - 3} more" if missing.size > 3 else ""
            raise InputError(
                f"{self.label}{self.table.where(place)}: no number in line {', '.join(lines)}{more}"
                ": every row needs one; fill it in, or delete the row"
            )
        unit = self.unit(text)
        if span and unit in ("%", "mA"):
            check_current(values, unit, span)
            return in_span(values, unit, span)
        size = 1.0 if unit is None else factor(tables.unit_name(unit), base)
        if size is None:
            needed = "have no unit" if base == "-" else f"be in {base}, or a unit of its dimension"
            raise InputError(f"{self.label}{self.table.where(place)}: {unit!r}: must {needed}")
        return values * size


def columns_of(label: str, keys: Mapping[str, Any]) -> Columns:
    """Return the Columns of a table with csv, which `resolved` may have read."""
    csv = keys["csv"]
    return csv if isinstance(csv, Columns) else Columns(label, keys)


def check_setpoints(reference: Any, units: Sequence[str | None], plant: Any, length: str) -> None:
    """Raise InputError for setpoints without a unit, of outputs that read in % or mA (`units`)."""
    if not isinstance(reference, dict) or "csv" not in reference:
        return
    columns = columns_of("reference", reference)
    for i, text in columns.chosen(reference.get("column"), "output", plant, len(units)).items():
        if units[i] in ("%", "mA") and columns.unit(text) is None:
            raise InputError(
                f"reference: {columns.table.where(columns.index_of(text))}: has no unit, and the"
                f" sensor of {label_of(plant, 'output', i)} reads in {units[i]}: write it in the"
                f" header or in column, '{text} [{units[i]}]' or '{text} [{length}]'"
            )


def changes_of(times: Any, values: Mapping[int, Any], initial: Any) -> list[tuple]:
    """Return [(time [s], channel from 0, value)] of the rows at which a channel changes."""
    changes = []
    for channel, column in values.items():
        moves = np.flatnonzero(column != np.concatenate([[initial[channel]], column[:-1]]))
        changes += [(float(times[k]), channel, float(column[k])) for k in moves]
    return sorted(changes)
