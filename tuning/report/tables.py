"""Numbers, tables and JSON of results, for people and for programs; imported by the reports."""

import json
import math

import numpy as np

from jaxtank import measures as ms
from jaxtank.core.jsonable import clean as clean
from jaxtank.core.units import DEFAULT


def number(value, digits=5):
    """Return a number for people: at most `digits` significant digits, a dash where there
    is none.
    """
    value = float(value)
    if not math.isfinite(value):
        return "-"
    if value == 0:
        return "0"
    text = f"{value:.{digits}g}"
    return text if "e" not in text else f"{value:.{digits - 1}e}"


def numbers(value, digits=5):
    """Return the entries of a measure, side by side; "none" for one that is undefined."""
    # A dash would read as the sign of the entry after it.
    values = np.ravel(np.asarray(value, dtype=float))
    return "  ".join(number(v, digits) if math.isfinite(v) else "none" for v in values)


MANY = 16
"""Entries of a measure that are printed side by side; of more, the worst."""


def entries(measure, value):
    """Return the entries of a measure; of more than 16, the four worst with their numbers."""
    values, spec = np.ravel(np.asarray(value, dtype=float)), ms.MEASURES[measure]
    if len(values) <= MANY:
        return numbers(values)
    if np.all(values == values[0]):
        return f"{numbers(values[0])} (each of {len(values)})"
    # what is undefined first
    worse = spec.sense * np.where(np.isnan(values), spec.sense * np.inf, values)
    order = np.argsort(-worse, kind="stable")
    found = ", ".join(f"{numbers(values[i])} ({spec.per} {i + 1})" for i in order[:4])
    return f"worst of {len(values)}: {found}"


def undefined(measures):
    """Return sentences: why entries of {measure: value} are printed as "none"."""
    return [
        f"{m}: none, because {why}"
        for m, v in measures.items()
        if (why := _why(m, v)) and not np.isfinite(np.asarray(v, dtype=float)).all()
    ]


def reasons(measures):
    """Return {measure: why} of every measure that is absent or has an entry that is not finite."""
    found = {m: why for m, values in measures.items() if (why := _why(m, values))}
    return {**found, **{m: why for m, why in _unserved().items() if m not in measures}}


def _why(measure, values):
    """Why entries of a measure are not finite, each cause once; "" where all are finite."""
    spec, values = ms.MEASURES[measure], np.ravel(np.asarray(values, dtype=float))
    causes = {i: spec.cause(float(v)) for i, v in enumerate(values) if not np.isfinite(v)}
    if len(set(causes.values())) < 2:
        return next(iter(causes.values()), "")
    return ", ".join(f"{spec.per} {i + 1}: {why}" for i, why in causes.items())


def _unserved():
    """{measure: why a case has none} of those that are reported where they are not computed; not
    those of the linearised loop, which are computed only where they are named.
    """
    named = ms.linear()
    return {m: s.unserved for m, s in ms.MEASURES.items() if s.unserved and m not in named}


def measures_json(measures):
    """Return measures as JSON; None for those undefined for the case (`reasons` has the cause)."""
    return {
        **dict.fromkeys(_unserved()),
        **clean({m: v for m, v in measures.items() if m not in ms.times()}),
    }


def dumps(table):
    """Return one JSON object as text; ValueError for NaN."""
    return json.dumps(table, indent=2, allow_nan=False)


def units(rig_units):
    """Return {measure: unit} on a rig with these (length, pump input) units."""
    return {m: ms.unit(m, rig_units) for m in ms.MEASURES}


class Table(str):
    """Aligned columns as text, with its `head` and `rows` for other ways of display."""

    head: list
    rows: list


def table(rows, head=None):
    """Return rows of text as aligned columns: a Table."""
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
        [m, ms.unit(m, rig_units), entries(m, values[m]), spec.doc]
        for m, spec in ms.MEASURES.items()
        if m in values and m not in ms.times()
    ]
    return table(rows, ["measure", "unit", "value", ""])


def wrap(message):
    """Return the parts of a message as lines that begin with a dash."""
    return "\n".join(f"- {part}" for part in message.split("; "))


def objective_unit(terms, rig_units=DEFAULT):
    """Return the unit of a weighted sum: that of its measures where they share one, else "-"."""
    found = {ms.unit(m, rig_units) for m in terms}
    return found.pop() if len(found) == 1 else "-"


def cost_unit(result):
    """Return the unit of the objective of a TuningResult; a default answer knows that of its own,
    whose price on changes of the inputs is in the unit of the squared error.
    """
    own = result.answer and result.answer.setting.cost_unit
    return own or objective_unit(result.objective["terms"], result.tuned.loop.units)
