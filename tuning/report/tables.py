"""Numbers, tables and JSON of results, for people and for programs."""

import dataclasses
import itertools
import json
import math
import textwrap
from collections.abc import Sequence
from typing import Any

import numpy as np

from jaxtank import measures as ms
from jaxtank.core.jsonable import clean as clean
from jaxtank.core.labels import label_of, name_of
from jaxtank.core.units import DEFAULT

LONGEST = 100
"""Characters of the line under the head of a table."""

MANY = 16
"""Entries of a measure that are printed side by side; of more, the worst."""


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
    """Return the entries of a measure; "none", not a dash, for one that is undefined."""
    return Value(value, digits, missing="none")  # a dash reads as the sign of the next entry


def entries(measure, value, plant=None):
    """Return the entries of a measure; of more than 16, the four worst with their numbers."""
    values, spec = np.ravel(np.asarray(value, dtype=float)), ms.MEASURES[measure]
    if len(values) <= MANY:
        names = [name_of(plant, spec.per, i) for i in range(len(values)) if spec.per != "run"]
        if any(names):
            return "  ".join(f"{name} {numbers(v)}".strip() for name, v in zip(names, values))
        return numbers(values)
    if np.all(values == values[0]):
        return f"{numbers(values[0])} (each of {len(values)})"
    # undefined values first
    worse = spec.sense * np.where(np.isnan(values), spec.sense * np.inf, values)
    order = np.argsort(-worse, kind="stable")
    worst = ", ".join(f"{numbers(values[i])} ({label_of(plant, spec.per, i)})" for i in order[:4])
    return f"worst of {len(values)}: {worst}"


@dataclasses.dataclass(frozen=True)
class Table:
    """A table: cells are texts, numbers and Values; `gap`: after an empty line on a terminal."""

    rows: Sequence[Sequence[Any]]
    head: Sequence[str] = ()
    gap: bool = False
    heading: str = ""
    on: str = ""
    widths: Sequence[int] = ()  # of the columns but the last one, whose cells are then wrapped

    def lines(self, width=0):
        """Return the lines of the table as aligned columns."""
        body = [[str(cell) for cell in row] for row in self.rows]
        rows = [*([list(self.head)] if self.head else []), *body]
        widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]
        if self.widths:
            widths = [min(pair) for pair in zip(widths, self.widths)]
            widths.append(width - sum(widths) - 2 * len(widths))
        lines = []
        for row in rows:
            cells = [self._wrapped(c, w) for c, w in zip(row, widths)]
            for parts in itertools.zip_longest(*cells, fillvalue=""):
                lines.append("  ".join(c.ljust(w) for c, w in zip(parts, widths)).rstrip())
        if self.head:
            lines[1:1] = ["-" * (width if self.widths else min(LONGEST, len(max(lines, key=len))))]
        return lines

    def _wrapped(self, cell, width):
        return (textwrap.wrap(cell, width) or [""]) if self.widths else [cell]

    def __str__(self):
        return "\n".join(self.lines())


def table(rows, head=()):
    """Return rows as the text of aligned columns."""
    return str(Table(rows, head))


def measure_table(values, rig_units=DEFAULT, gap=False, plant=None):
    """Return the Table of {measure: value}: unit, entries and what the measure is."""
    rows = [
        [m, unit_text(m, rig_units, plant), entries(m, values[m], plant), spec.doc]
        for m, spec in ms.MEASURES.items()
        if m in values and m not in ms.times()
    ]
    return Table(rows, ["measure", "unit", "value", ""], gap)


def unit_text(measure, rig_units, plant=None):
    """The unit of a measure in a table; those of its entries, where they differ."""
    unit = ms.unit(measure, rig_units) if plant is None else ms.entry_units(measure, plant)
    return unit if isinstance(unit, str) else ", ".join(dict.fromkeys(unit))


def limit_table(rows, gap=False):
    """Return the Table of limits, rows as those of `ConstraintRow`."""
    timed = any(row["time_s"] is not None for row in rows)
    cells = [
        [
            row["name"],
            row["unit"],
            (">= " if ms.MEASURES[row["measure"]].sense < 0 else "<= ") + number(row["limit"], 7),
            Value(row["value"], 7),
            Value(row["margin"], 3) if row["reason"] is None else "undefined",
            *(["-" if row["time_s"] is None else f"{row['time_s']:.2f} s"] if timed else []),
        ]
        for row in rows
    ]
    heads = ["limit", "unit", "limit", "value", "margin", *(["reached at"] if timed else [])]
    return Table(cells, heads, gap)


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
    """Return {measure: why a case has no value}, without those that are computed on request."""
    named = ms.linear()
    return {m: s.unserved for m, s in ms.MEASURES.items() if s.unserved and m not in named}


def measures_json(measures):
    """Return measures as JSON; None for those undefined for the case (`reasons` has the cause)."""
    known = {m: v for m, v in measures.items() if m not in ms.times()}
    return {**dict.fromkeys(_unserved()), **clean(known)}


def fields(result, names):
    """Return {name: value of that attribute, as JSON takes it} of several names in one text."""
    return {name: clean(getattr(result, name)) for name in names.split()}


def dumps(table):
    """Return one JSON object as text; ValueError for NaN."""
    return json.dumps(table, indent=2, allow_nan=False)


def units(plant):
    """Return {measure: unit} of a plant; a list of units where those of entries differ."""
    return {m: ms.entry_units(m, plant) for m in ms.MEASURES}


def objective_unit(terms, rig_units=DEFAULT):
    """Return the unit of a weighted sum: the common unit of its measures, else "-"."""
    shared = {ms.unit(m, rig_units) for m in terms}
    return shared.pop() if len(shared) == 1 else "-"
