"""Tables in files, CSV or Excel, as plants and people write them: encodings, separators, decimal
signs, rows of units. Times: `stamps`.
"""

import codecs
import csv
import datetime as dt
import functools
import io
import math
import re
import zipfile
from collections import Counter
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxtank.core.errors import DataError
from jaxtank.core.files import refusal
from jaxtank.core.quantities import factor, size_of
from jaxtank.core.text import count, printable, shortened
from jaxtank.core.units import canonical

LARGEST = 512 * 1024 * 1024  # bytes
MOST_ROWS = 20_000_000
LONGEST_CELL = 200  # characters
LABVIEW = "LabVIEW Measurement"
PREAMBLE = 20  # lines among which the names of the columns are looked for
MISSING = {  # words in place of a number, in lower case
    *("", "nan", "na", "n/a", "#n/a", "null", "none", "-", "--", "---", "bad", "no data", "error"),
    *("bad input", "i/o timeout", "comm fail", "scan off", "pt created", "shutdown", "invalid"),
    *("configure", "over range", "under range", "over-range", "under-range", "out of serv", "err"),
    *("bad total", "no result", "not connect", "timeout", "#value!", "#div/0!", "#ref!", "#num!"),
    *("****", "1.#qnan", "-1.#ind", "[-11059] no good data for calculation"),
}
EMPTY = "leave a missing reading empty"
ORDERS = ("day-first", "month-first", "h:m", "m:s")
"""How dates such as 03/11/2026, and times such as 14:05, are read where they can be read twice."""

UNIT_WORDS = {  # units in words; in lower case
    **dict.fromkeys(("percent", "pct", "prozent", "% span", "%span", "% open", "%fs"), "%"),
    **dict.fromkeys(("ms", "msec", "millis", "millisecond", "milliseconds"), "ms"),
    **dict.fromkeys(("us", "usec", "micros", "microsecond", "microseconds"), "us"),
    **dict.fromkeys(("\u00b5s", "\u03bcs"), "us"),  # the sign of micro, and the Greek letter
    **dict.fromkeys(("second", "seconds", "secs", "sek", "sekunden"), "s"),
    **dict.fromkeys(("minute", "minutes", "mins", "minuten"), "min"),
    **dict.fromkeys(("hour", "hours", "hrs", "stunden"), "h"),
    **dict.fromkeys(("day", "days", "tage"), "d"),
    **dict.fromkeys(("metre", "metres", "meter", "meters"), "m"),
    **dict.fromkeys(("volt", "volts"), "V"),
    **dict.fromkeys(("litre", "litres", "liter", "liters"), "l"),
    **dict.fromkeys(("lpm", "slpm"), "l/min"),
    **dict.fromkeys(("cbm", "qm"), "m^3"),
}


class Column(NamedTuple):
    """A column: its header, the name and unit in it (or in a row of units), and its cells."""

    header: str
    name: str
    unit: str | None
    cells: list[str]


class Table(NamedTuple):
    """Columns of a file; `lines`: that of each row, `decimal`: the sign in its numbers."""

    name: str
    columns: list[Column]
    lines: list[int]
    head: int  # line of the names
    decimal: str
    sheets: tuple[str, ...] = ()  # of an Excel file, that are not read

    def where(self, column: int, row: int | None = None) -> str:
        """Return the place of a column, or of a cell, for a message."""
        line = self.head if row is None else self.lines[row]
        return f"{self.name}, line {line}, column {self.columns[column].header!r}"


class Ambiguous(DataError):
    """Numbers or times that can be read in two ways; the message asks which.

    setting: "decimal" of `read_table`, "time" of `seconds`; answers: what it may be.
    """

    def __init__(self, question: str, setting: str, answers: tuple[str, str]):
        super().__init__(question)
        self.setting, self.answers = setting, answers


def read_table(path: str | Path, decimal: str = "") -> Table:
    """Return the Table in a file: cells separated by comma, semicolon, tab or "|", an Excel file
    (.xlsx) or a LabVIEW measurement file (.lvm). Lines that begin with "#" are comments. decimal:
    its sign, from the numbers if "", and where all that tell have the other one.

    Raises DataError, in one line with file and line, for one that cannot be read.
    """
    path = Path(path)
    name, data = printable(path.name), _bytes(path)
    sheets: tuple[str, ...] = ()
    if data.startswith(b"PK\x03\x04"):
        rows, sheets = _sheet(data, name)
    elif (text := _text(data, name)).startswith(LABVIEW):
        rows, sign = _labview(text, name)
        decimal = decimal or sign
    else:
        rows = list(_rows(text, name))
    head, header, body = _head_and_body(rows, name)
    units, body = _units_and_samples(body, len(header))
    if not body:
        raise DataError(f"{name}: has a header, but no samples")
    cells = [_widened(row, len(header), f"{name}, line {line}") for line, row in body]
    columns: list[Column] = []
    for text, unit, values in zip(header, units, zip(*cells)):
        stem, stated = split_header(text)
        columns.append(Column(text, stem, stated or unit or None, list(values)))
    sign = _decimal(columns, name, decimal)
    columns = [in_one_unit(column, sign) for column in columns]
    return Table(name, columns, [line for line, _ in body], head, sign, sheets)


def _units_and_samples(
    body: list[tuple[int, list[str]]], width: int
) -> tuple[list[str], list[tuple[int, list[str]]]]:
    """Return (units, "" where none are stated; the rows below) of the rows below the names."""
    if len(body) > 1 and _is_units(body[1][1], width):
        above = [cell.strip() for cell in body[0][1] if cell.strip()]
        body = body if any(map(_like_value, above)) else body[1:]  # without descriptions
    if body and _is_units(body[0][1], width):
        return [unit.strip().strip("[]()") for unit in body[0][1]], body[1:]
    return [""] * width, body


def _head_and_body(
    rows: list[tuple[int, list[str]]], name: str
) -> tuple[int, list[str], list[tuple[int, list[str]]]]:
    """Return (line of the names, the names, the rows below)."""
    if not rows:
        raise DataError(f"{name}: is empty: a header line and samples are needed")
    start = _header(rows)
    line, cells = rows[start]
    header = [" ".join(cell.split()) for cell in cells]
    if all(map(_like_value, header)):
        raise DataError(
            f"{name}, line {line}: has numbers where the columns' names should be: begin with a"
            " header, such as 't [s],pump1 [V],h1 [cm]'"
        )
    return line, header, rows[start + 1 :]


def _bytes(path: Path) -> bytes:
    try:
        if why := refusal(path, LARGEST):
            raise DataError(f"file {str(path)!r} {why}")
        return path.read_bytes()
    except FileNotFoundError:
        raise DataError(f"file {str(path)!r} does not exist") from None
    except (OSError, ValueError) as error:  # a name that is too long for the disk, or with a NUL
        why = getattr(error, "strerror", None) or str(error)
        raise DataError(f"file {str(path)!r} cannot be read: {why}") from None


def _text(data: bytes, name: str) -> str:
    """Return text in UTF-8, UTF-16 or Windows' Latin-1."""
    start = data[:4096]
    if data.startswith(codecs.BOM_UTF8):
        encodings = ("utf-8-sig",)
    elif data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        encodings = ("utf-16",)
    elif start[1::2].count(0) > 0.3 * len(start) or start[::2].count(0) > 0.3 * len(start):
        encodings = ("utf-16-le" if start[1::2].count(0) else "utf-16-be",)
    else:
        encodings = ("utf-8", "cp1252", "latin-1")
    for encoding in encodings:
        try:
            text = data.decode(encoding)
        except UnicodeDecodeError:
            continue
        if re.search(r"[\x00-\x08\x0e-\x1f]", text):
            break
        return text.replace("\r\n", "\n").replace("\r", "\n")
    raise DataError(f"file {name!r} is not text, and no Excel file (.xlsx)")


def _rows(text: str, name: str) -> Iterator[tuple[int, list[str]]]:
    """Yield (line, cells) of every line that is not empty and not a comment."""
    reader, end = csv.reader(io.StringIO(text), delimiter=_delimiter(text)), 0
    try:
        for cells in reader:
            start, end = end + 1, reader.line_num
            if end > start:
                raise DataError(
                    f"{name}, line {start}: a quotation mark opens and does not close on that line"
                )
            if end > MOST_ROWS:
                raise DataError(f"{name}: more than {MOST_ROWS} samples")
            written = any(c.strip() for c in cells) and not cells[0].lstrip().startswith("#")
            if written and not (end == 1 and cells[0].startswith("sep=")):  # Excel's first line
                yield end, cells
    except csv.Error as error:
        raise DataError(f"{name}, line {reader.line_num}: {error}") from None


def _labview(text: str, name: str) -> tuple[list[tuple[int, list[str]]], str]:
    """Return ([(line, cells)], the decimal sign or "") of a LabVIEW measurement file: names, units
    and the samples of all segments.
    """
    facts: dict[str, list[str]] = {}  # of the file and of the latest segment
    names: list[str] = []
    rows: list[tuple[int, list[str]]] = []
    begins = 0  # row of the first sample
    separator, in_header = "," if re.search(r"^Separator,", text, re.MULTILINE) else "\t", True
    for line, written in enumerate(text.split("\n"), 1):
        first, *rest = cells = [cell.strip() for cell in written.split(separator)]
        if first in ("Channels", "***End_of_Header***"):  # the first begins the header of a segment
            in_header = first == "Channels"
        elif in_header:
            facts[first] = rest
        elif first == "X_Value":
            heads = _labview_heads(line, cells, facts, name)
            if names not in ([], heads[0][1]):
                raise DataError(_another_segment(name, line, "has other channels"))
            if not names:
                rows, begins, names = heads, len(heads), heads[0][1]
        elif names and any(cells):
            if len(rows) > begins and first == rows[begins][1][0]:
                raise DataError(_another_segment(name, line, f"begins again at X_Value {first}"))
            rows.append((line, (cells + [""] * len(names))[: len(names)]))
    return rows, "".join(facts.get("Decimal_Separator", [])[:1])


def _labview_heads(
    line: int, cells: list[str], facts: dict[str, list[str]], name: str
) -> list[tuple[int, list[str]]]:
    """Return the rows of names and, where any is known, of units of a LabVIEW measurement file."""
    names = cells[: cells.index("Comment")] if "Comment" in cells else cells
    if names.count("X_Value") > 1 or facts.get("X_Columns", ["One"])[:1] != ["One"]:
        raise DataError(
            f"{name}, line {line}: its X values are not in one column for all channels: write the"
            " file with 'One column only' for X values, or as CSV with a column 't [s]'"
        )
    units = ["s" if facts.get("X_Dimension", ["Time"])[:1] == ["Time"] else ""]
    units += facts.get("Y_Unit_Label", [])
    units = [unit if is_known(unit_name(unit)) else "" for unit in units][: len(names)]
    return [(line, names), *([(line, units)] if any(units) else [])]


def _another_segment(name: str, line: int, what: str) -> str:
    """Return a message on a segment of a LabVIEW measurement file that does not go on."""
    return (
        f"{name}, line {line}: a segment that {what}: give each segment as a file of its own, all"
        " with --data"
    )


def _delimiter(text: str) -> str:
    """Return what separates cells: the first that most lines have as often."""
    lines = [line for line in text[:65536].splitlines() if line.strip() and line[0] != "#"][:50]
    for delimiter in (";", "\t", "|", ","):
        counts = Counter(line.count(delimiter) for line in lines)
        if counts and counts.most_common(1)[0][0]:
            return delimiter
    return ","


def _sheet(data: bytes, name: str) -> tuple[list[tuple[int, list[str]]], tuple[str, ...]]:
    """Return ([(row, cells as text)] of the first sheet of an Excel file that is not empty, names
    of the others).
    """
    try:
        import openpyxl
    except ImportError:
        raise DataError(
            f"{name}: an Excel file needs openpyxl: pip install 'jaxtank[excel]', or save it as CSV"
        ) from None
    try:
        size = sum(item.file_size for item in zipfile.ZipFile(io.BytesIO(data)).infolist())
        if size > LARGEST:
            raise DataError(f"{name}: has {size} bytes unpacked: at most {LARGEST} are read")
        book: Any = openpyxl.load_workbook(io.BytesIO(data), read_only=True, data_only=True)
        first: list[tuple[int, list[str]]] = []
        others: list[str] = []
        for sheet in book.worksheets:
            rows = enumerate(sheet.iter_rows(values_only=True), 1)
            written = ((line, [_cell(v) for v in row]) for line, row in rows)
            texts = [(line, cells) for line, cells in written if any(cells)]
            if texts and first:
                others.append(printable(sheet.title))
            first = first or texts
        return first, tuple(others)
    except DataError:
        raise
    except Exception as error:  # of a damaged file: zipfile, XML, openpyxl's own
        why = f"{type(error).__name__}: {error}"
        raise DataError(f"{name}: no Excel file that can be read ({why})") from None


def _cell(value: Any) -> str:
    """Return a cell of a spreadsheet as text; a number with a point."""
    if value is None:
        return ""
    if isinstance(value, dt.timedelta):
        return f"{value.total_seconds() / 86400:.10f} d"
    if isinstance(value, dt.datetime) and value.time() == dt.time():
        return str(value.date())
    return repr(value) if isinstance(value, float) else str(value)


def _header(rows: list[tuple[int, list[str]]]) -> int:
    """Return the row of the names: the first as wide as most rows, and without a number."""
    width = Counter(len(cells) for _, cells in rows[: 10 * PREAMBLE]).most_common(1)[0][0]
    for k, (_, cells) in enumerate(rows[:PREAMBLE]):
        texts = [cell.strip() for cell in cells if cell.strip()]
        if len(cells) == width > 1 and texts and not any(map(_like_value, texts)):
            return k
    return 0


def _like_value(text: str) -> bool:
    """Whether a cell is a number, a time or a missing one."""
    return bool(re.match(r"[-+−]?[.,]?\d", text)) or text.lower() in MISSING


def _is_units(cells: list[str], width: int) -> bool:
    """Whether a row holds units."""
    texts = [cell.strip().strip("[]()") for cell in cells if cell.strip()]
    if len(cells) > width or not texts or any(_like_value(t) for t in texts if t != "-"):
        return False
    return 2 * sum(map(is_unit, texts)) >= len(texts)


def _widened(cells: list[str], width: int, where: str) -> list[str]:
    """Return the cells of a row, as many as there are names."""
    while len(cells) > width and not cells[-1].strip():  # a separator at the end of the line
        cells = cells[:-1]
    if len(cells) != width:
        remedy = "a comma within a number? Cells need another separator then, such as ';'"
        if len(cells) < width:
            remedy = "delete the line, or give it a cell for each column"
        written = count(len(cells), "cell")
        raise DataError(f"{where}: {written} under {width} column names: {remedy}")
    return [cell.strip() for cell in cells]


def unit_name(text: str) -> str:
    """Return a unit as `quantities` spells it: "%" of "percent", "m^3/h" of "M3/H"."""
    unit = canonical(text)
    if is_known(unit):
        return unit
    word = text.strip().lower()
    if "ML" in text:  # megalitres a day, as no capital says in ML/MIN
        return canonical(word.replace("ml", "ML")) if word.endswith(("/d", "/day")) else unit
    return next((u for u in (UNIT_WORDS.get(word), canonical(word)) if u and is_known(u)), unit)


def is_known(unit: str) -> bool:
    """Whether a unit has a size."""
    try:
        size_of(unit)
    except KeyError:
        return False
    return bool(unit)


def is_unit(text: str) -> bool:
    """Whether a text is a unit, also one without a size, such as °C."""
    return is_known(unit_name(text)) or bool(re.fullmatch(r"°[CF]|pH|[a-zA-Zµ]+/[a-zA-Z]+", text))


def split_header(header: str) -> tuple[str, str | None]:
    """Return (name, unit or None) of a header: "h1 [cm]", "h1 (cm)", "pump1_V", "level in cm"."""
    if brackets := re.fullmatch(r"(.*?)\s*[\[(]\s*(.*?)\s*[\])]\s*", header):
        if not is_known(unit_name(brackets[2])):  # a name may have brackets, and so may a unit
            last = re.fullmatch(r"(.*)\s*[\[(]\s*([^\[(]*?)\s*[\])]\s*", header)
            brackets = last if last and is_known(unit_name(last[2])) else brackets
        return brackets[1].strip(), brackets[2] or UNIT_WORDS.get(brackets[1].lower())
    for joint in ("_", " in ", ", ", " "):
        stem, line, tail = header.rpartition(joint)
        # one letter behind a mere space may be a name: "tank A"
        short = joint == " " and len(tail) == 1 and tail != "%"
        unit = UNIT_WORDS.get(tail.strip().lower()) or canonical(tail)
        if line and stem.strip() and not tail.isdigit() and not short and is_known(unit):
            return stem.strip(), tail.strip()
    return header.strip(), UNIT_WORDS.get(header.strip().lower())


SPACES = dict.fromkeys(map(ord, " \u00a0\u2007\u2009\u202f'’"), None) | {ord("−"): "-"}
POWER = r"(?:[eE][-+]?\d+)?"
NUMBERS = {  # {decimal sign: a number}; the other sign may separate thousands
    sign: re.compile(
        rf"[-+]?(?=[{sign}]?\d)(?:[1-9]\d{{0,2}}(?:[{group}]\d{{3}})+|\d*)(?:[{sign}]\d*)?{POWER}",
        re.ASCII,
    )
    for sign, group in ((".", ","), (",", "."))
}


def _sign_of(cell: str) -> str:
    """Return the decimal sign that a number tells, "?" of a comma that may be either, else ""."""
    text, _ = _number_and_unit(cell)
    point, comma = (bool(NUMBERS[sign].fullmatch(text)) for sign in ".,")
    if point != comma:
        return "." if point else ","
    return "?" if comma and "," in text else ""


def _decimal(columns: Iterable[Column], name: str, stated: str = "") -> str:
    """Return the decimal sign of the numbers in a file."""
    first: dict[str, str] = {}  # {what a cell tells: the first one that does}
    for column in columns:
        for cell in column.cells:
            first.setdefault(_sign_of(cell), cell)
            if (first.keys() & {".", ","}) if not stated else stated in first:
                break
    told = [sign for sign in first if sign in (".", ",")]
    if told or stated:
        return stated if stated in told or not told else told[0]
    if (doubtful := first.get("?")) is None:
        return "."
    raise Ambiguous(
        f"{name}: is {doubtful!r} a number with a decimal comma, or one in thousands? Every number"
        " of the file can be read both ways.",
        "decimal",
        (",", "."),
    )


def _number_and_unit(cell: str) -> tuple[str, str]:
    """Return (number, unit) of a cell such as "12.3 cm"; (the cell, "") of another."""
    text = cell.translate(SPACES)
    parts = re.fullmatch(r"([-+]?[\d.,]*\d[.,]?(?:[eE][-+]?\d+)?)((?:[^\W\d_]|%).*)", text)
    return (parts[1], parts[2]) if parts and _stands_for_unit(parts[2]) else (text, "")


@functools.lru_cache(maxsize=4096)
def _stands_for_unit(text: str) -> bool:
    """Whether a text behind a number is its unit."""
    return is_known(unit_name(text.translate(SPACES)))


def in_one_unit(column: Column, sign: str) -> Column:
    """Return a column whose cells have units with numbers in that of its head, or of its first
    cell; a cell that does not convert stays, for `numbers` to refuse. sign: the decimal one.
    """
    tails = re.findall(
        r"\d[.,]?[^\S\n]*((?:[^\W\d_]|%)[^\n:]{0,20})$", "\n".join(column.cells), re.MULTILINE
    )
    if not any(map(_stands_for_unit, {*tails})):
        return column
    parts = [_number_and_unit(cell) for cell in column.cells]
    base = column.unit or next((unit for _, unit in parts if unit), "")
    bare = (not unit and NUMBERS[sign].fullmatch(text) for text, unit in parts)
    if not base or (not column.unit and any(bare)):
        return column
    rows = zip(column.cells, parts)
    cells = [_in_unit(text, unit, base, sign) if unit else cell for cell, (text, unit) in rows]
    changed = [new or cell for new, cell in zip(cells, column.cells)]
    return column._replace(unit=base, cells=changed)


def _in_unit(text: str, unit: str, base: str, sign: str) -> str:
    """Return a number with a unit as a number in another, "" where it does not convert."""
    size, group = factor(unit_name(unit), unit_name(base)), "," if sign == "." else "."
    if size is None or not NUMBERS[sign].fullmatch(text):
        return ""
    value = float(text.replace(group, "").replace(sign, "."))
    return text if size == 1.0 else repr(value * size).replace(".", sign)


def numbers(table: Table, column: int) -> tuple[np.ndarray, dict[str, int]]:
    """Return ((rows,) numbers of a column, NaN where one is missing; {word in place of a number:
    how often}). Raises DataError with every text that is no number.
    """
    cells, sign = table.columns[column].cells, table.decimal
    group = "," if sign == "." else "."
    values, words, wrong = np.full(len(cells), math.nan), Counter[str](), Counter[str]()
    first: dict[str, int] = {}
    for k, cell in enumerate(cells):
        text = cell.translate(SPACES)
        if len(text) <= LONGEST_CELL and NUMBERS[sign].fullmatch(text):
            value = float(text.replace(group, "").replace(sign, "."))
            if math.isfinite(value):
                values[k] = value
                continue
        elif cell.lower() in MISSING:
            words[cell] += bool(cell)
            continue
        wrong[cell] += 1
        first.setdefault(cell, k)
    if wrong:
        raise DataError(_refused(table, column, wrong, first))
    return values, {word: count for word, count in words.items() if count}


def _refused(table: Table, column: int, wrong: Counter[str], first: dict[str, int]) -> str:
    """Return a message on texts that are no numbers."""
    cell, *others = wrong
    if len(cell) > LONGEST_CELL:
        what = f"a cell of {len(cell)} characters is no number"
    elif NUMBERS["."].fullmatch(cell) and re.search(r"[eE]", cell):
        what = f"{cell!r} is not finite"
    else:
        often = f" ({wrong[cell]} times)" if wrong[cell] > 1 else ""
        sign = "" if table.decimal == "." else ", where the decimal sign is a comma"
        if _number_and_unit(cell)[1]:
            sign = ": its unit does not convert to that of the column, or other cells have none"
        what = f"{shortened(cell)} is not a number{often}{sign}"
    more = ", ".join(shortened(other) for other in others[:3])
    more = f"; nor is {more}" + f" and {len(others) - 3} more" * (len(others) > 3) if more else ""
    few = 2 * wrong.total() < len(table.columns[column].cells)
    return f"{table.where(column, first[cell])}: {what}{more}" + f"; {EMPTY}" * few
