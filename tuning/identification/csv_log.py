"""CSV files of experiment data: columns and units from the header, or from a rig's [log] table."""

import csv
import io
import math
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxtank.core.errors import DataError, InputError, nearest
from jaxtank.core.files import refusal
from jaxtank.core.text import printable
from jaxtank.core.units import INPUTS, LEVELS, TIMES, VOLTS, canonical
from jaxtank.loop.closed_loop import ClosedLoop
from tuning.identification.experiment import Log, check_hold, log

LARGEST = 512 * 1024 * 1024  # bytes
MOST_ROWS = 20_000_000
LONGEST_CELL = 200  # characters
KNOWN = {unit for table in (TIMES, *LEVELS, *INPUTS) for unit in table}
NAMES = {
    "time": ("t", "time", "zeit"),
    "pump": ("pump", "u", "voltage", "input"),
    "level": ("h", "level", "y", "tank", "x"),
}


class _Column(NamedTuple):
    """A column of the file: its index, what it holds, and the factor to the rig's unit."""

    index: int
    kind: str  # "time", "pump" or "level"
    number: int  # of the pump or the tank, counted from 0
    header: str
    unit: str
    factor: float
    in_volts: bool = False  # a level as the sensor's voltage


def read_log(
    path: str | Path,
    loop: ClosedLoop,
    columns: Mapping[str, Any] | None = None,
    decimal: str = ".",
    hold: str = "",
) -> Log:
    """Read experiment data from a CSV file.

    Cells are separated by comma, semicolon or tab; lines that begin with "#" are comments; an empty
    cell or "nan" is a missing reading. A header such as "t [s]", "pump1_V" or "h1 (mm)" names
    column and unit; values are converted to the rig's units.

    Parameters
    ----------
    path : str or Path
        The file, UTF-8.
    loop : ClosedLoop
        The rig that was measured.
    columns : mapping, optional
        Column of each of "t", "pump1", .., "h1", ..: a header, or (header, unit), where the header
        is in other words; "none" leaves a level out.
    decimal : str
        Decimal sign, "." or ",".
    hold : {"", "zero-order", "first-order"}
        What inputs do between samples, as in `tuning.log`.

    Returns
    -------
    Log

    Raises
    ------
    DataError
        For a file that cannot be read so, naming line and column.
    InputError
        For `columns`, `decimal` or `hold` that do not exist.

    Examples
    --------
    >>> import pathlib, tempfile, tuning
    >>> from jaxtank import presets
    >>> loop = presets.load("cascaded").cases["open-loop"].loop
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = pathlib.Path(folder) / "run.csv"
    ...     _ = path.write_text("t [s],pump1 [mV],h2 [V]\\n0,3000,1\\n4,3000,1.5\\n8,3500,\\n")
    ...     data = tuning.read_log(path, loop)
    >>> print(data.u[:, 0], data.y[:, 0], data.tanks)
    [3.  3.  3.5] [1.  1.5 nan] (1,)
    """
    path = Path(path)
    check_hold(hold)
    if decimal not in (".", ","):
        raise InputError(f"--decimal {decimal!r}: must be '.' or ','")
    text, name = _text(path), printable(path.name)
    rows = _rows(text, name)
    first, header = next(rows, (0, None))
    if header is None:
        raise DataError(f"{name}: is empty: a header line and samples are needed")
    header = [cell.strip() for cell in header]
    used = _columns(header, f"{name}, line {first}", loop, columns or {})
    table, lines = _table(rows, header, used, decimal, name)
    data = np.array(table) * [c.factor for c in used]
    inputs = [i for i, c in enumerate(used) if c.kind == "pump"]
    levels = [i for i, c in enumerate(used) if c.kind == "level"]
    return log(
        t=data[:, 0],
        u=data[:, inputs],
        y=data[:, levels],
        tanks=[used[i].number for i in levels],
        in_volts=[used[i].in_volts for i in levels],
        name=name,
        lines=lines,
        headers=tuple(c.header for c in used),
        units=tuple(c.unit for c in used),
        hold=hold,
    )


def _text(path):
    """Return the text of a file; raise DataError where it cannot be read."""
    try:
        if why := refusal(path, LARGEST):
            raise DataError(f"file {str(path)!r} {why}")
        data = path.read_bytes()
    except FileNotFoundError:
        raise DataError(f"file {str(path)!r} does not exist") from None
    except OSError as error:  # a name that is too long for the disk, too
        raise DataError(f"file {str(path)!r} cannot be read: {error.strerror}") from None
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise DataError(f"file {path.name!r} is not UTF-8 text (byte {error.start})") from None
    if "\0" in text:
        raise DataError(f"file {path.name!r} is not text: it has zero bytes")
    return text.replace("\r\n", "\n").replace("\r", "\n")


def _rows(text, name):
    """Yield (line number, cells) of every line that is not empty and not a comment."""
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


def _table(rows, header, used, decimal, name):
    """Return (numbers of the used columns, line of each sample)."""
    table, lines = [], []
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
                f"{name}, line {line}: {len(cells)} cells under {len(header)} column names{hint}"
            )
        if len(table) >= MOST_ROWS:
            raise DataError(f"{name}: more than {MOST_ROWS} samples")
        table.append([_number(cells[c.index], decimal, name, line, c) for c in used])
        lines.append(line)
    if not table:
        raise DataError(f"{name}: has a header, but no samples")
    return table, lines


def _number(cell, decimal, name, line, column):
    """Return the number in a cell, NaN for a missing reading."""
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
    """Return whether a cell of the header is a number."""
    return re.fullmatch(r"[-+]?[\d.,]+([eE][-+]?\d+)?", cell) is not None


def split_header(header):
    """Return (name, unit or None) of a column's header: "h1 [cm]", "h1 (cm)", "pump1_V", "h1"."""
    found = re.fullmatch(r"(.*?)\s*[\[(]\s*(.*?)\s*[\])]", header)
    if found:
        return found.group(1).strip(), found.group(2)
    stem, line, tail = header.rpartition("_")
    if line and canonical(tail) in KNOWN and not tail.isdigit():
        return stem.strip(), tail
    return header.strip(), None


def _columns(header, where, loop, named):
    """Return the columns in use: time, then pumps, then levels."""
    plant, (length, drive) = loop.plant, loop.units
    if all(_is_number(cell) for cell in header):
        raise DataError(
            f"{where}: has numbers where the columns' names should be: begin with a header, as"
            f" 't [s],pump1 [{drive}],h1 [{length}]'"
        )
    slots = {"t": ("time", 0), **{f"pump{j + 1}": ("pump", j) for j in range(plant.pumps)}}
    slots |= {f"h{i + 1}": ("level", i) for i in range(plant.tanks)}
    taken = _named_columns(header, where, slots, named)
    taken |= _recognised_columns(header, where, plant, taken, named)
    found = []
    for slot, (kind, number) in slots.items():
        if slot in taken:
            index, unit = taken[slot]
            if header.count(header[index]) > 1:
                raise DataError(f"{where}: two columns are called {header[index]!r}")
            place = f"{where}, column {header[index]!r}"
            factor, in_volts = _factor(kind, unit, length, drive, place)
            found.append(_Column(index, kind, number, header[index], unit, factor, in_volts))
        elif kind != "level":
            raise DataError(
                f"{where}: no column for {slot}"
                f" ({'time' if kind == 'time' else f'pump {number + 1}'}) among"
                f" {_listed(header)}; name it with --column {slot}=HEADER"
            )
    if not any(c.kind == "level" for c in found):
        raise DataError(
            f"{where}: no column for a level among {_listed(header)}; name it with"
            " --column h1=HEADER"
        )
    return found


def _named_columns(header, where, slots, named):
    """Return {slot: (index, unit)} of the columns that --column or the rig file names."""
    taken = {}
    for slot, spec in named.items():
        if slot not in slots:
            raise InputError(f"unknown column {slot!r}{nearest(slot, slots)}")
        wanted, unit = (spec, None) if isinstance(spec, str) else spec
        if wanted.strip() == "none" and wanted not in header:
            if slots[slot][0] != "level":
                raise InputError(f"column {slot} = none: only a level may be left out, as h1=none")
            continue
        if wanted not in header:
            raise DataError(
                f"{where}: there is no column {wanted!r} for {slot}{nearest(wanted, header)}"
            )
        index = header.index(wanted)
        if other := next((known for known, (column, _) in taken.items() if column == index), None):
            raise DataError(
                f"{where}: column {wanted!r} is given for {other} and for {slot}: name one column"
                " for each"
            )
        taken[slot] = (index, unit or split_header(wanted)[1])
    return taken


def _recognised_columns(header, where, plant, taken, named):
    """Return {slot: (index, unit)} of the other columns whose headers name a slot themselves."""
    used, found = {index for index, _ in taken.values()}, {}
    for index, cell in enumerate(header):
        stem, unit = split_header(cell)
        slot = _slot(stem, plant)
        if index in used or slot is None or slot in named:
            continue
        if slot in found:
            raise DataError(
                f"{where}: columns {header[found[slot][0]]!r} and {cell!r} both look like {slot};"
                " name one with --column"
            )
        found[slot] = (index, unit)
    return found


def _listed(header, most=20):
    """Return the names of the columns, the first of them where there are many."""
    more = f" and {len(header) - most} more" if len(header) > most else ""
    return ", ".join(map(repr, header[:most])) + more


def _slot(stem, plant):
    """Return the slot ("t", "pump1", "h2") that a column's name means, or None."""
    # no rig has a tank of seven digits
    word = re.fullmatch(r"([a-z]+)[ _]?(\d{0,6})", stem.strip().lower())
    kind = word and next((k for k, names in NAMES.items() if word.group(1) in names), None)
    if not word or kind is None:
        return None
    if kind == "time":
        return None if word.group(2) else "t"
    count = plant.pumps if kind == "pump" else plant.tanks
    number = int(word.group(2)) if word.group(2) else 1 if count == 1 else 0
    return f"{'pump' if kind == 'pump' else 'h'}{number}" if 1 <= number <= count else None


def _factor(kind, unit, length, drive, where):
    """Return (factor of a cell to the rig's unit, whether it is the sensor's voltage)."""
    base = {"time": "s", "pump": drive, "level": length}[kind]
    if unit is None:
        slot = {"time": "t", "pump": "pump1", "level": "h1"}[kind]
        raise DataError(
            f"{where}: has no unit: write it in the header, as '{slot} [{base}]', or with --column"
        )
    written, unit, base = unit, canonical(unit), canonical(base)
    if kind == "level" and unit in VOLTS and length not in VOLTS:
        return VOLTS[unit], True
    choices = {"time": (TIMES,), "pump": INPUTS, "level": LEVELS}[kind]
    table = next((t for t in choices if base in t), {base: 1.0})
    if unit not in table:
        raise DataError(
            f"{where}: unit {written!r} cannot be that of a {kind}: must be one of"
            f" {', '.join(table)}"
        )
    return table[unit] / table[base], False
