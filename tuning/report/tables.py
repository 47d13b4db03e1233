"""How results are written: numbers, tables and JSON, for people and for programs."""

import json
import math

import numpy as np

from jaxtank import measures as ms
from jaxtank.core.jsonable import clean as clean
from jaxtank.core.units import DEFAULT


def number(value, digits=5):
    """A number for people: at most `digits` significant digits, a dash where there is none."""
    value = float(value)
    if not math.isfinite(value):
        return "-"
    if value == 0:
        return "0"
    text = f"{value:.{digits}g}"
    return text if "e" not in text else f"{value:.{digits - 1}e}"


def numbers(value, digits=5):
    """The entries of a measure, side by side."""
    return "  ".join(number(v, digits) for v in np.ravel(value))


def reasons(measures):
    """{measure: why} for every measure that is absent or has an entry that is not a number."""
    absent = (m for m, v in measures.items() if not np.all(np.isfinite(np.asarray(v, dtype=float))))
    found = {m: ms.MEASURES[m].undefined for m in absent}
    return {**found, **{m: why for m, why in _unserved().items() if m not in measures}}


def _unserved():
    """{measure: why a case has none} of those that are reported where they are not computed."""
    return {m: spec.unserved for m, spec in ms.MEASURES.items() if spec.unserved}


def measures_json(measures):
    """Measures as JSON; null for those that mean nothing for the case (`reasons` says why)."""
    return {
        **dict.fromkeys(_unserved()),
        **clean({m: v for m, v in measures.items() if m not in ms.times()}),
    }


def dumps(table):
    """One JSON object as text; refuses NaN."""
    return json.dumps(table, indent=2, allow_nan=False)


def units(rig_units):
    """{measure: unit} of everything that is reported, on a rig with these (length, pump input)
    units.
    """
    return {m: ms.unit(m, rig_units) for m in ms.MEASURES}


class Table(str):
    """Aligned columns as text, which still knows its `head` and `rows`, so that a page may set them
    in its own way.
    """

    head: list
    rows: list


def table(rows, head=None):
    """Rows of text as aligned columns, the first to the left: a Table."""
    body = [[str(c) for c in row] for row in rows]
    rows = ([head] if head else []) + body
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]
    lines = ["  ".join(c.ljust(w) for c, w in zip(row, widths)).rstrip() for row in rows]
    found = Table(
        "\n".join(
            lines[:1] + ["-" * min(100, len(max(lines, key=len)))] + lines[1:] if head else lines
        )
    )
    found.head, found.rows = head or [], body
    return found


def measure_table(values, rig_units=DEFAULT):
    """Return the Table of {measure: value}: unit, entries and what the measure is."""
    rows = [
        [m, ms.unit(m, rig_units), numbers(values[m]), spec.doc]
        for m, spec in ms.MEASURES.items()
        if m in values and m not in ms.times()
    ]
    return table(rows, ["measure", "unit", "value", ""])


def wrap(message):
    return "\n".join(f"- {part}" for part in message.split("; "))


def objective_unit(terms, rig_units=DEFAULT):
    """Unit of a weighted sum: that of its only measure, or a plain number."""
    found = {ms.unit(m, rig_units) for m in terms}
    return found.pop() if len(found) == 1 else "-"
