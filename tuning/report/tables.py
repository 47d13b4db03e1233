"""Numbers, tables and JSON of results, for people and for programs."""

import dataclasses
import itertools
import json
import math
import shutil
import textwrap
from collections.abc import Sequence
from typing import Any

import numpy as np

from jaxtank import measures as ms
from jaxtank.core.jsonable import clean as clean, fields as fields
from jaxtank.core.labels import label_of, place_of
from jaxtank.core.text import csv_line

NARROW, WIDE = 60, 100  # least and most characters of a line on a terminal
WORD = 50  # characters of a word in a cell, above which it is broken
JOINED = "\u00a0"  # a space at which no line is broken
MANY = 16  # entries of a measure that are printed side by side; of more, the worst


def number(value, digits=5):
    """Return a number of at most `digits` significant digits, a dash where there is none."""
    value = float(value)
    if not math.isfinite(value):
        return "-"
    if value == 0:
        return "0"
    text = f"{value:.{digits}g}"
    return text if "e" not in text else f"{value:.{digits - 1}e}"


@dataclasses.dataclass(frozen=True)
class Value:
    """A number, or several side by side, with its significant digits and its unit."""

    value: Any
    digits: int = 5
    unit: str = ""
    between: str = "  "
    missing: str = "-"

    def __str__(self):
        values = np.ravel(np.asarray(self.value, dtype=float))
        texts = [number(v, self.digits) if math.isfinite(v) else self.missing for v in values]
        text = self.between.join(texts)
        return f"{text} {self.unit}" if self.unit and np.isfinite(values).any() else text


def numbers(value, digits=5):
    """Return the entries of a measure; an undefined one is "none", not a dash."""
    return Value(value, digits, missing="none")  # a dash reads as the sign of the next entry


def entries(measure, value, plant=None):
    """Return the entries of a measure; of more than 16, the four worst with their numbers."""
    values, spec = np.ravel(np.asarray(value, dtype=float)), ms.MEASURES[measure]
    if spec.per == "run" or (plant is None and len(values) <= MANY):
        return numbers(values)
    if len(values) <= MANY:
        places = [place_of(plant, spec.per, i) for i in range(len(values))]
        return "  ".join(f"{place} {numbers(v)}" for place, v in zip(places, values))
    if np.all(values == values[0]):
        return f"{numbers(values[0])} (each of {len(values)})"
    # undefined values first
    worse = spec.sense * np.where(np.isnan(values), spec.sense * np.inf, values)
    order = np.argsort(-worse, kind="stable")
    worst = ", ".join(f"{numbers(values[i])} ({label_of(plant, spec.per, i)})" for i in order[:4])
    return f"worst of {len(values)}: {worst}"


def columns():
    return min(max(shutil.get_terminal_size((80, 24)).columns, NARROW), WIDE)


def _joined(cell):
    """The text of a cell: a Value, or entries with two spaces between them, are not broken."""
    text = str(cell)
    if not isinstance(cell, Value) and "  " not in text:
        return text
    return "  ".join(entry.replace(" ", JOINED) for entry in text.split("  "))


@dataclasses.dataclass(frozen=True)
class Table:
    """A table of texts, numbers and Values; gap: after an empty line; top: not folded on a page."""

    rows: Sequence[Sequence[Any]]
    head: Sequence[str] = ()
    gap: bool = False
    heading: str = ""
    on: str = ""
    top: bool = False

    def lines(self):
        """Return aligned, wrapped columns; those that do not fit stand below."""
        body = [[_joined(cell) for cell in row] for row in self.rows]
        rows, width = [*([list(self.head)] if self.head else []), *body], columns()
        words = lambda i: (word for row in rows for word in row[i].split(" "))
        least = [min(max(map(len, words(i)), default=0), WORD) for i in range(len(rows[0]))]
        least[0] = min(max(len(row[0]) for row in rows), WORD)
        blocks, used = [[0]], least[0]
        for i in range(1, len(least)):
            if used + 2 + least[i] > width and len(blocks[-1]) > 1:
                blocks.append([0])
                used = least[0]
            blocks[-1].append(i)
            used += 2 + least[i]
        lines: list[str] = []
        for block in blocks:
            part = [[row[i] for i in block] for row in rows]
            lines += [""] * bool(lines) + self._aligned(part, [least[i] for i in block], width)
        return lines

    def _aligned(self, rows, least, width):
        """The lines of columns that fit, the widest ones wrapped; `least` : longest words."""
        widths = [max(len(row[i]) for row in rows) for i in range(len(least))]
        while sum(widths) + 2 * (len(widths) - 1) > width:
            spare = [w - m for w, m in zip(widths, least)]
            wide = [w if s > 0 else 0 for w, s in zip(widths, spare)]
            if not any(wide):
                break
            widths[wide.index(max(wide))] -= 1
        lines = []
        for row in rows:
            wrap = lambda cell, w: textwrap.wrap(cell, max(w, 1), break_on_hyphens=False) or [""]
            for parts in itertools.zip_longest(*map(wrap, row, widths), fillvalue=""):
                line = "  ".join(c.ljust(w) for c, w in zip(parts, widths))
                lines.append(line.replace(JOINED, " ").rstrip())
            if self.head and row is rows[0]:
                lines.append("-" * min(width, sum(widths) + 2 * (len(widths) - 1)))
        return lines

    def __str__(self):
        return "\n".join(self.lines())


def table(rows, head=()):
    return str(Table(rows, head))


def measure_table(values, plant, names=None, on=""):
    """Return the Table of {measure: value}, of `names` alone: entries with their places, units."""
    rows = [
        [f"{ms.label(m)} [{unit_text(m, plant)}]", entries(m, values[m], plant), m]
        for m in (ms.MEASURES if names is None else names)
        if m in values and m not in ms.times()
    ]
    return Table(rows, ["measure", "", "name"], gap=True, on=on)


def unit_text(measure, plant):
    """The unit of a measure in a table, or the units of its entries where they differ."""
    unit = ms.entry_units(measure, plant)
    return unit if isinstance(unit, str) else ", ".join(dict.fromkeys(unit))


def limit_table(rows):
    timed = any(row["time_s"] is not None for row in rows)
    cells = []
    for row in rows:
        side = ">= " if ms.MEASURES[row["measure"]].sense < 0 else "<= "
        margin = Value(row["margin"], 3) if row["reason"] is None else "undefined"
        time = "-" if row["time_s"] is None else f"{row['time_s']:.2f} s"
        values = [Value(row["value"], 7), margin, *([time] if timed else [])]
        cells.append([row["name"], row["unit"], side + number(row["limit"], 7), *values])
    heads = ["limit", "unit", "limit", "value", "margin", *(["reached at"] if timed else [])]
    return Table(cells, heads, gap=True)


def undefined(measures, plant=None):
    """Return sentences: why entries of {measure: value} are printed as "none"."""
    return [
        f"{m}: none, because {why}"
        for m, v in measures.items()
        if (why := _why(m, v, plant)) and not np.isfinite(np.asarray(v, dtype=float)).all()
    ]


def reasons(measures):
    """Return {measure: why} of every measure that is absent or has an entry that is not finite."""
    causes = {m: why for m, values in measures.items() if (why := _why(m, values))}
    return {**causes, **{m: why for m, why in _unserved().items() if m not in measures}}


def _why(measure, values, plant=None):
    """Why entries of a measure are not finite, each cause once; "" where all are finite."""
    spec, values = ms.MEASURES[measure], np.ravel(np.asarray(values, dtype=float))
    causes = {i: spec.cause(float(v)) for i, v in enumerate(values) if not np.isfinite(v)}
    if len(set(causes.values())) < 2:
        return next(iter(causes.values()), "")
    return ", ".join(f"{label_of(plant, spec.per, i)}: {why}" for i, why in causes.items())


def _unserved():
    named = ms.linear()
    return {m: s.unserved for m, s in ms.MEASURES.items() if s.unserved and m not in named}


def measures_json(measures):
    """Return measures as JSON; None for those undefined for the case (`reasons` has the cause)."""
    untimed = {m: v for m, v in measures.items() if m not in ms.times()}
    return {**dict.fromkeys(_unserved()), **clean(untimed)}


def csv_text(rows):
    """Return rows of texts and numbers as CSV text; NaN is empty."""
    cell = lambda v: v if isinstance(v, (str, int)) else "" if np.isnan(v) else f"{v:.10g}"
    return "".join(csv_line(map(cell, row)) for row in rows)


def dumps(table):
    return json.dumps(table, indent=2, allow_nan=False)


def units(plant):
    """Return {measure: unit} of a plant; a list of units where entries have different ones."""
    return {m: ms.entry_units(m, plant) for m in ms.MEASURES}


def objective_unit(terms, rig_units):
    """Return the unit of a weighted sum: the common unit of its measures, else "-"."""
    shared = {ms.unit(m, rig_units) for m in terms}
    return shared.pop() if len(shared) == 1 else "-"
