"""Tables in files, CSV or Excel, as plants and people write them: encodings, separators, decimal
signs, rows of units, time stamps.
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
from collections.abc import Callable, Iterable, Iterator
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
PREAMBLE = 20
"""Lines among which the names of the columns are looked for."""
MISSING = {
    *("", "nan", "na", "n/a", "#n/a", "null", "none", "-", "--", "---", "bad", "no data", "error"),
    *("bad input", "i/o timeout", "comm fail", "scan off", "pt created", "shutdown", "invalid"),
    *("configure", "over range", "under range", "over-range", "under-range", "out of serv", "err"),
    *("bad total", "no result", "not connect", "timeout", "#value!", "#div/0!", "#ref!", "#num!"),
    *("****", "1.#qnan", "-1.#ind", "[-11059] no good data for calculation"),
}
"""Words in place of a number, in lower case."""
EMPTY = "leave a missing reading empty"
ORDERS = ("day-first", "month-first", "h:m", "m:s")
"""How dates such as 03/11/2026, and times such as 14:05, are read where they can be read twice."""

UNIT_WORDS = {
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
"""Units in words; in lower case."""


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
    widths = Counter(len(cells) for _, cells in rows[: 10 * PREAMBLE])
    width = widths.most_common(1)[0][0]
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
NUMBERS = {
    sign: re.compile(
        rf"[-+]?(?=[{sign}]?\d)(?:[1-9]\d{{0,2}}(?:[{group}]\d{{3}})+|\d*)(?:[{sign}]\d*)?{POWER}",
        re.ASCII,
    )
    for sign, group in ((".", ","), (",", "."))
}
"""{decimal sign: a number}; the other sign may separate thousands."""


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
ZONES = {
    **{"z": 0.0, "utc": 0.0, "gmt": 0.0, "wet": 0.0, "west": 1.0, "bst": 1.0, "cet": 1.0},
    **{"mez": 1.0, "cest": 2.0, "mesz": 2.0, "eet": 2.0, "eest": 3.0},
}
"""Hours east of Greenwich."""
EPOCH = dt.datetime(1970, 1, 1)
DAY = 86400.0
SERIALS = (20_000.0, 80_000.0)
"""Days of Excel, of the years 1954 to 2119."""
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
    date = (EPOCH + dt.timedelta(seconds=stamp.value)).isoformat(" ")
    return date + "Z" * (stamp.kind == ZONED)


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
