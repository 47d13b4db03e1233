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
from jaxtank.core.labels import name_of
from jaxtank.core.quantities import INPUT_UNITS, LEVEL_UNITS, TIMES, VOLTS, factor
from jaxtank.core.text import printable
from jaxtank.core.units import canonical
from jaxtank.loop.closed_loop import ClosedLoop
from tuning.identification.experiment import Log, check_hold, log

LARGEST = 512 * 1024 * 1024  # bytes
MOST_ROWS = 20_000_000
LONGEST_CELL = 200  # characters
MISSING = {"", "nan", "na", "null", "-"}
KNOWN = {*TIMES, *LEVEL_UNITS, *INPUT_UNITS}
WORDS = {
    **dict.fromkeys(("t", "time", "zeit"), "t"),
    **dict.fromkeys(("pump", "u", "voltage", "input"), "pump"),
    **dict.fromkeys(("h", "level", "y", "tank", "x"), "h"),
}
"""Names of time, pump input and level in the header of a column."""
KINDS = {"t": "time", "pump": "pump", "h": "level"}


class _Column(NamedTuple):
    """A column of the file: its index, its quantity, and the factor to the rig's unit."""

    index: int
    kind: str  # "t", "pump" or "h"
    number: int  # of the pump or the tank, counted from 0
    header: str
    unit: str
    factor: float
    in_volts: bool  # a level as the sensor's voltage


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
    line, header = next(rows, (0, ()))
    if not header:
        raise DataError(f"{name}: is empty: a header line and samples are needed")
    header = [cell.strip() for cell in header]
    used = _columns(header, f"{name}, line {line}", loop, columns or {})
    table, lines = _samples(rows, header, used, decimal, name)
    data = np.array(table) * [c.factor for c in used]
    kinds = np.array([c.kind for c in used])
    levels = [c for c in used if c.kind == "h"]
    return log(
        t=data[:, 0],
        u=data[:, kinds == "pump"],
        y=data[:, kinds == "h"],
        tanks=[c.number for c in levels],
        in_volts=[c.in_volts for c in levels],
        name=name,
        lines=lines,
        headers=tuple(c.header for c in used),
        units=tuple(c.unit for c in used),
        hold=hold,
    )


def _samples(rows, header, used, decimal, name):
    """(Numbers of each sample, its line in the file)."""
    table, lines = [], []
    for line, cells in rows:
        table.append(_numbers(cells, header, used, decimal, f"{name}, line {line}"))
        lines.append(line)
        if len(table) > MOST_ROWS:
            raise DataError(f"{name}: more than {MOST_ROWS} samples")
    if not table:
        raise DataError(f"{name}: has a header, but no samples")
    return table, lines


def _text(path):
    """Return the text of a file; raise DataError where it cannot be read."""
    try:
        if why := refusal(path, LARGEST):
            raise DataError(f"file {str(path)!r} {why}")
        text = path.read_bytes().decode("utf-8-sig")
    except FileNotFoundError:
        raise DataError(f"file {str(path)!r} does not exist") from None
    except OSError as error:  # a name that is too long for the disk, too
        raise DataError(f"file {str(path)!r} cannot be read: {error.strerror}") from None
    except UnicodeDecodeError as error:
        raise DataError(f"file {path.name!r} is not UTF-8 text (byte {error.start})") from None
    if "\0" in text:
        raise DataError(f"file {path.name!r} is not text: it has zero bytes")
    return text.replace("\r\n", "\n").replace("\r", "\n")


def _rows(text, name):
    """Yield (line number, cells) of every line that is not empty and not a comment."""
    lines = (line for line in text.splitlines() if not line.lstrip().startswith(("#", "\n")))
    first = next(filter(str.strip, lines), "")
    delimiter = max((";", "\t", ","), key=lambda d: (first.count(d), d == ","))
    reader, end = csv.reader(io.StringIO(text), delimiter=delimiter), 0
    try:
        for cells in reader:
            start, end = end + 1, reader.line_num
            if end > start:
                raise DataError(
                    f"{name}, line {start}: a quotation mark opens and does not close on that line"
                )
            if any(c.strip() for c in cells) and not cells[0].lstrip().startswith("#"):
                yield end, cells
    except csv.Error as error:
        raise DataError(f"{name}, line {reader.line_num}: {error}") from None


def _numbers(cells, header, used, decimal, where):
    """Return the numbers of the used columns of a row."""
    while len(cells) > len(header) and not cells[-1].strip():  # a separator at the end of the line
        cells.pop()
    if len(cells) != len(header):
        comma = ": a comma within a number? Cells need another separator then, as ';' with"
        raise DataError(
            f"{where}: {len(cells)} cells under {len(header)} column names"
            + (f"{comma} --decimal ," if len(cells) > len(header) else "")
        )
    numbers = []
    for column in used:
        try:
            numbers.append(_number(cells[column.index].strip(), decimal, column.kind))
        except ValueError as error:
            raise DataError(f"{where}, column {column.header!r}: {error}") from None
    return numbers


def _number(text, decimal, kind):
    """Return the number in a cell, NaN for a missing reading."""
    if len(text) > LONGEST_CELL:
        raise ValueError(f"a cell of {len(text)} characters is no number")
    if text.lower() in MISSING:
        if kind == "h":
            return math.nan
        raise ValueError("is empty: every sample needs its time and the input of every pump")
    if decimal == "," and "." in text:
        raise ValueError(f"{text!r} has a point, where the decimal sign is a comma")
    try:
        if "_" in text or not text.isascii():
            raise ValueError
        value = float(text.replace(",", ".") if decimal == "," else text)
    except ValueError:
        comma = decimal == "." and re.fullmatch(r"[-+]?\d+,\d+([eE][-+]?\d+)?", text)
        hint = ": a decimal comma? read it with --decimal ," if comma else ""
        raise ValueError(f"{text!r} is not a number{hint}") from None
    if not math.isfinite(value):
        raise ValueError(f"{text!r} is not finite; leave a missing reading empty")
    return value


def split_header(header):
    """Return (name, unit or None) of a column's header: "h1 [cm]", "h1 (cm)", "pump1_V", "h1"."""
    if brackets := re.fullmatch(r"(.*?)\s*[\[(]\s*(.*?)\s*[\])]", header):
        return brackets[1].strip(), brackets[2]
    stem, line, tail = header.rpartition("_")
    if line and canonical(tail) in KNOWN and not tail.isdigit():
        return stem.strip(), tail
    return header.strip(), None


def _columns(header, where, loop, named):
    """Return the columns in use: time, then pumps, then levels."""
    plant, (length, drive) = loop.plant, loop.units
    if all(re.fullmatch(r"[-+]?[\d.,]+([eE][-+]?\d+)?", cell) for cell in header):
        raise DataError(
            f"{where}: has numbers where the columns' names should be: begin with a header, as"
            f" 't [s],pump1 [{drive}],h1 [{length}]'"
        )
    slots = {"t": ("t", 0), **{f"pump{j + 1}": ("pump", j) for j in range(plant.pumps)}}
    slots |= {f"h{i + 1}": ("h", i) for i in range(plant.tanks)}
    taken = _named_columns(header, where, slots, named)
    taken |= _recognised_columns(header, where, slots, taken, named, _own(plant, slots))
    columns, names = [], ", ".join(map(repr, header[:20]))
    names += f" and {len(header) - 20} more" if len(header) > 20 else ""
    for slot, (kind, number) in slots.items():
        if slot not in taken:
            if kind != "h":
                what = "time" if kind == "t" else f"pump {number + 1}"
                raise DataError(
                    f"{where}: no column for {slot} ({what}) among {names}; name it with --column"
                    f" {slot}=HEADER"
                )
            continue
        index, unit = taken[slot]
        if header.count(header[index]) > 1:
            raise DataError(f"{where}: two columns are called {header[index]!r}")
        factor, in_volts = _factor(
            kind, slot, unit, loop.units, f"{where}, column {header[index]!r}"
        )
        columns.append(_Column(index, kind, number, header[index], unit, factor, in_volts))
    if columns[-1].kind != "h":
        raise DataError(
            f"{where}: no column for a level among {names}; name it with --column h1=HEADER"
        )
    return columns


def _named_columns(header, where, slots, named):
    """Return {slot: (index, unit)} of the columns that --column or the rig file names."""
    taken = {}
    for slot, spec in named.items():
        if slot not in slots:
            raise InputError(f"unknown column {slot!r}{nearest(slot, slots)}")
        name, unit = (spec, None) if isinstance(spec, str) else spec
        if name.strip() == "none" and name not in header:
            if slots[slot][0] != "h":
                raise InputError(f"column {slot} = none: only a level may be left out, as h1=none")
            continue
        if name not in header:
            raise DataError(
                f"{where}: there is no column {name!r} for {slot}{nearest(name, header)}"
            )
        index = header.index(name)
        if other := next((known for known, (column, _) in taken.items() if column == index), None):
            raise DataError(
                f"{where}: column {name!r} is given for {other} and for {slot}: name one column"
                " for each"
            )
        taken[slot] = (index, unit or split_header(name)[1])
    return taken


def _recognised_columns(header, where, slots, taken, named, by_name):
    """Return {slot: (index, unit)} of the other columns whose headers name a slot themselves."""
    used, columns = {index for index, _ in taken.values()}, {}
    for index, cell in enumerate(header):
        stem, unit = split_header(cell)
        slot = by_name.get(stem) or _slot(stem, slots)
        if index in used or slot is None or slot in named:
            continue
        if slot in columns:
            raise DataError(
                f"{where}: columns {header[columns[slot][0]]!r} and {cell!r} both look like {slot};"
                " name one with --column"
            )
        columns[slot] = (index, unit)
    return columns


def _own(plant, slots):
    """{"LT101", "h_LT101", "u_P101", ..: slot} of what a rig's own names call its columns."""
    by_name = {}
    for slot, (kind, number) in slots.items():
        name = "" if kind == "t" else name_of(plant, "tank" if kind == "h" else kind, number)
        letter = "h" if kind == "h" else "u"
        by_name |= {name: slot, f"{letter}_{name}": slot} if name else {}
    return by_name


def _slot(stem, slots):
    """Return the slot ("t", "pump1", "h2") that a column's name means, or None."""
    # no rig has a tank of seven digits
    word = re.fullmatch(r"([a-z]+)[ _]?(\d{0,6})", stem.strip().lower())
    if not word or word[1] not in WORDS:
        return None
    kind, number = WORDS[word[1]], word[2] and str(int(word[2]))
    alone = kind != "t" and not number and f"{kind}2" not in slots  # "level" of a single tank
    slot = f"{kind}1" if alone else f"{kind}{number}"
    return slot if slot in slots else None


def _factor(kind, slot, unit, units, where):
    """Return (factor of a cell to the rig's unit, whether it is the sensor's voltage)."""
    length, drive = units
    base = {"t": "s", "pump": drive, "h": length}[kind]
    if unit is None:
        raise DataError(
            f"{where}: has no unit: write it in the header, as '{slot} [{base}]', or with --column"
        )
    name, base = canonical(unit), canonical(base)
    if kind == "h" and name in VOLTS and length not in VOLTS:
        return VOLTS[name], True
    size = factor(name, base)
    if size is None:
        usual = {"t": tuple(TIMES), "pump": INPUT_UNITS, "h": LEVEL_UNITS}[kind]
        names = [other for other in usual if factor(other, base)] or [base]
        raise DataError(
            f"{where}: {unit!r} is no unit of a {KINDS[kind]}: must be one of {', '.join(names)}"
        )
    return size, False
