"""Logs as CSV files: a header that names columns and units, or a rig's [log] table that does."""

import csv
import io
import math
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from jaxtank.core.errors import DataError, InputError, nearest
from jaxtank.core.files import refusal
from jaxtank.core.text import printable
from jaxtank.loop.closed_loop import ClosedLoop
from tuning.identification.experiment import FLOWS, LENGTHS, VOLTS, Log, log

LARGEST = 512 * 1024 * 1024  # bytes
MOST_ROWS = 20_000_000
LONGEST_CELL = 200  # characters
TIMES = {"s": 1.0, "sec": 1.0, "ms": 1e-3, "min": 60.0, "h": 3600.0}
SHARES = {"-": 1.0, "1": 1.0, "%": 0.01}
KNOWN = {**TIMES, **LENGTHS, **VOLTS, **FLOWS, **SHARES}
NAMES = {
    "time": ("t", "time", "zeit"),
    "pump": ("pump", "u", "voltage", "input"),
    "level": ("h", "level", "y", "tank", "x"),
}


def read_log(
    path: str | Path, loop: ClosedLoop, columns: Mapping[str, Any] | None = None, decimal: str = "."
) -> Log:
    """The Log of a CSV file, for the rig of `loop` (a ClosedLoop).

    columns: {"t", "pump1", .., "h1", ..: a column's header, or (header, unit)}, where the header
    does not say it in its own words ("h1 [cm]", "pump1_V", "time [s]"); "none" leaves a level out;
    decimal: "." or ",". Comma or semicolon or tab between cells, "#" for lines to pass over, an
    empty cell or "nan" for a reading that is missing. Raises DataError, naming line and column, for
    anything else.
    """
    path = Path(path)
    if decimal not in (".", ","):
        raise InputError(f"--decimal {decimal!r}: must be '.' or ','")
    text, called = _text(path), printable(path.name)
    rows = _rows(text, called)
    first, header = next(rows, (0, None))
    if header is None:
        raise DataError(f"{called}: is empty: a header line and samples are needed")
    header = [cell.strip() for cell in header]
    wanted = _columns(header, called, first, loop, columns or {})
    lines, table = [], []
    for line, cells in rows:
        # a separator at the end of the line
        while len(cells) > len(header) and not cells[-1].strip():
            cells.pop()
        if len(cells) != len(header):
            hint = (
                ": a comma within a number? Cells need another separator then, as ';' with"
                " --decimal ,"
                if len(cells) > len(header)
                else ""
            )
            raise DataError(
                f"{called}, line {line}: {len(cells)} cells under {len(header)} column names{hint}"
            )
        if len(table) >= MOST_ROWS:
            raise DataError(f"{called}: more than {MOST_ROWS} samples")
        table.append([_number(cells[w.index], decimal, called, line, w) for w in wanted])
        lines.append(line)
    if not table:
        raise DataError(f"{called}: has a header, but no samples")
    data = np.array(table) * [w.factor for w in wanted]
    inputs = [i for i, w in enumerate(wanted) if w.kind == "pump"]
    levels = [i for i, w in enumerate(wanted) if w.kind == "level"]
    return log(
        t=data[:, 0],
        u=data[:, inputs],
        y=data[:, levels],
        tanks=[wanted[i].number for i in levels],
        in_volts=[wanted[i].in_volts for i in levels],
        name=called,
        lines=lines,
        headers=tuple(w.header for w in wanted),
        units=tuple(w.unit for w in wanted),
    )


class _Column:
    """A column of the file: where it stands, what it is, what to multiply it with."""

    def __init__(self, index, kind, number, header, unit, factor, in_volts=False):
        self.index, self.kind, self.number, self.header, self.unit = (
            index,
            kind,
            number,
            header,
            unit,
        )
        self.factor, self.in_volts = factor, in_volts


def _text(path):
    try:
        if why := refusal(path, LARGEST):
            raise DataError(f"log {str(path)!r} {why}")
        data = path.read_bytes()
    except FileNotFoundError:
        raise DataError(f"log {str(path)!r} does not exist") from None
    except OSError as error:  # a name that is too long for the disk, too
        raise DataError(f"log {str(path)!r} cannot be read: {error.strerror}") from None
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise DataError(f"log {path.name!r} is not UTF-8 text (byte {error.start})") from None
    if "\0" in text:
        raise DataError(f"log {path.name!r} is not text: it has zero bytes")
    return text.replace("\r\n", "\n").replace("\r", "\n")


def _rows(text, name):
    """(line number, cells) of every line that is not empty and not a comment."""
    first = next(
        (line for line in text.splitlines() if line.strip() and not line.lstrip().startswith("#")),
        "",
    )
    delimiter = max((";", "\t", ","), key=lambda d: (first.count(d), d == ","))
    reader = csv.reader(io.StringIO(text), delimiter=delimiter)
    try:
        end = 0
        for cells in reader:
            start, end = end + 1, reader.line_num
            if end > start:
                raise DataError(
                    f"{name}, line {start}: a quotation mark opens and does not close on that line"
                )
            if cells and any(c.strip() for c in cells) and not cells[0].lstrip().startswith("#"):
                yield reader.line_num, cells
    except csv.Error as error:
        raise DataError(f"{name}, line {reader.line_num}: {error}") from None


def _number(cell, decimal, name, line, column):
    text = cell.strip()
    where = f"{name}, line {line}, column {column.header!r}"
    if len(text) > LONGEST_CELL:
        raise DataError(f"{where}: a cell of {len(text)} characters is no number")
    if text.lower() in ("", "nan", "na", "null", "-"):
        if column.kind == "level":
            return math.nan
        raise DataError(
            f"{where}: is empty: every sample needs its time and the input of every pump"
        )
    if decimal == "," and "." in text:
        raise DataError(f"{where}: {text!r} has a point, where the decimal sign is a comma")
    try:
        if "_" in text or not text.isascii():
            raise ValueError(text)
        value = float(text.replace(",", ".") if decimal == "," else text)
    except ValueError:
        hint = (
            ": a decimal comma? read it with --decimal ,"
            if decimal == "." and re.fullmatch(r"[-+]?\d+,\d+([eE][-+]?\d+)?", text)
            else ""
        )
        raise DataError(f"{where}: {text!r} is not a number{hint}") from None
    if not math.isfinite(value):
        raise DataError(f"{where}: {text!r} is not finite; leave a missing reading empty")
    return value


def _is_number(cell):
    return re.fullmatch(r"[-+]?[\d.,]+([eE][-+]?\d+)?", cell) is not None


def split_header(header):
    """(name, unit or None) of a column's header: "h1 [cm]", "h1 (cm)", "pump1_V", "h1"."""
    found = re.fullmatch(r"(.*?)\s*[\[(]\s*(.*?)\s*[\])]", header)
    if found:
        return found.group(1).strip(), found.group(2)
    stem, line, tail = header.rpartition("_")
    return (
        (stem.strip(), tail)
        if line and tail in KNOWN and not tail.isdigit()
        else (header.strip(), None)
    )


def _columns(header, name, line, loop, given):
    """The columns in use, time first, then pumps, then levels."""
    plant, (length, drive) = loop.plant, loop.units
    slots = {"t": ("time", 0), **{f"pump{j + 1}": ("pump", j) for j in range(plant.pumps)}}
    slots |= {f"h{i + 1}": ("level", i) for i in range(plant.tanks)}
    if all(_is_number(cell) for cell in header):
        raise DataError(
            f"{name}, line {line}: has numbers where the columns' names should be: begin with a"
            f" header, as 't [s],pump1 [{drive}],h1 [{length}]'"
        )
    found, taken = [], {}
    for slot, spec in given.items():
        if slot not in slots:
            raise InputError(f"unknown log column {slot!r}{nearest(slot, slots)}")
        wanted, unit = (spec, None) if isinstance(spec, str) else spec
        if wanted.strip() == "none" and wanted not in header:
            if slots[slot][0] != "level":
                raise InputError(
                    f"log column {slot} = none: only a level may be left out, as h1=none"
                )
            continue
        if wanted not in header:
            raise DataError(
                f"{name}, line {line}: there is no column {wanted!r} for"
                f" {slot}{nearest(wanted, header)}"
            )
        index = header.index(wanted)
        if other := next((known for known, (column, _) in taken.items() if column == index), None):
            raise DataError(
                f"{name}, line {line}: column {wanted!r} is given for {other} and for {slot}: name"
                " one column for each"
            )
        taken[slot] = (index, unit or split_header(wanted)[1])
    used = {index for index, _ in taken.values()}
    for index, cell in enumerate(header):
        stem, unit = split_header(cell)
        slot = _slot(stem, plant)
        if index in used or slot is None or slot in given:
            continue
        if slot in taken:
            raise DataError(
                f"{name}, line {line}: columns {header[taken[slot][0]]!r} and {cell!r} both look"
                f" like {slot}; say which with --column"
            )
        taken[slot] = (index, unit)
    for slot, (kind, number) in slots.items():
        if slot not in taken:
            if kind != "level":
                raise DataError(
                    f"{name}, line {line}: no column for {slot}"
                    f" ({'time' if kind == 'time' else f'pump {number + 1}'}) among"
                    f" {_listed(header)}; name it with --column {slot}=HEADER"
                )
            continue
        index, unit = taken[slot]
        if header.count(header[index]) > 1:
            raise DataError(f"{name}, line {line}: two columns are called {header[index]!r}")
        factor, in_volts = _factor(
            kind, unit, length, drive, f"{name}, line {line}, column {header[index]!r}"
        )
        found.append(_Column(index, kind, number, header[index], unit, factor, in_volts))
    if not any(c.kind == "level" for c in found):
        raise DataError(
            f"{name}, line {line}: no column for a level among {_listed(header)}; name it with"
            " --column h1=HEADER"
        )
    return found


def _listed(header, most=20):
    """The names of the columns, the first of them where there are many."""
    more = f" and {len(header) - most} more" if len(header) > most else ""
    return ", ".join(map(repr, header[:most])) + more


def _slot(stem, plant):
    """The slot ("t", "pump1", "h2") that a column's name says, or None."""
    # no rig has a tank of seven digits
    word = re.fullmatch(r"([a-z]+)[ _]?(\d{0,6})", stem.strip().lower())
    if word is None:
        return None
    for kind, names in NAMES.items():
        if word.group(1) in names:
            if kind == "time":
                return None if word.group(2) else "t"
            count = plant.pumps if kind == "pump" else plant.tanks
            number = int(word.group(2)) if word.group(2) else 1 if count == 1 else 0
            return f"{'pump' if kind == 'pump' else 'h'}{number}" if 1 <= number <= count else None
    return None


def _factor(kind, unit, length, drive, where):
    """(what a cell is multiplied with, whether it is a sensor's volts)."""
    if unit is None:
        own = {"time": "s", "pump": drive, "level": length}[kind]
        word = {"time": "t", "pump": "pump1", "level": "h1"}[kind]
        raise DataError(
            f"{where}: has no unit: write it in the header, as '{word} [{own}]', or with --column"
        )
    if kind == "time":
        table, own = TIMES, "s"
    elif kind == "pump":
        own = drive
        table = next((t for t in (VOLTS, FLOWS, SHARES) if drive in t), {drive: 1.0})
    else:
        own, table = (
            length,
            (LENGTHS if length in LENGTHS else VOLTS if length in VOLTS else {length: 1.0}),
        )
        if unit in VOLTS and length not in VOLTS:
            return VOLTS[unit], True
    if unit not in table:
        raise DataError(
            f"{where}: unit {unit!r} cannot be that of a {'time' if kind == 'time' else kind}: must"
            f" be one of {', '.join(table)}"
        )
    return table[unit] / table[own], False
