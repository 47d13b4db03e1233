"""Signals in a table: which columns are times, values and their qualities, and whose they are."""

import re
from typing import NamedTuple

import numpy as np

from jaxtank.core import stamps, tables
from jaxtank.core.errors import DataError
from jaxtank.core.quantities import factor

# fmt: off
TIME = {  # names of a column of times, letters and digits only
    "t", "time", "timestamp", "datetime", "date", "elapsed", "elapsedtime", "sampletime", "ts",
    "localtime", "utctime", "timeutc", "seconds", "minutes", "hours", "zeit", "zeitstempel",
    "datum", "datumzeit", "uhrzeit", "horodatage",
}
WORDS = {  # names of a pump's input and a level, before their number
    **dict.fromkeys(("pump", "u", "voltage", "input"), "pump"),
    **dict.fromkeys(("h", "level", "y", "tank", "x"), "h"),
}
TAG = {
    "tag", "tagname", "tagid", "name", "point", "pointname", "variable", "signal", "item",
    "itemid", "sensor", "channel", "bezeichnung", "kanal", "topic", "field", "metric", "series",
}
VALUE = {"value", "val", "wert", "reading", "average", "valeur", "valor", "messwert", "payload"}
UNIT = {"unit", "units", "uom", "eu", "einheit"}
QUALITY = {"quality", "qual", "status", "statuscode", "q", "qly", "qualitat", "qualität"}
"""Names of the columns of a long table, a row for each value of a tag."""
SETPOINT = {"r", "w", "sp", "setpoint", "sollwert", "soll", "consigne"}
"""Words that mean the setpoint of a level."""
OTHER = {*SETPOINT, "e", "mode", "alarm", "alm", "hh", "ll", "hi", "lo", "limit", "lim"}
"""Words beside the name of a tank or a pump that mean another signal of it."""
MEASURED = {"pv", "val", "value", "actual", "ist", "istwert", "avg", "mean", "measured", "act"}
"""Words beside it that mean its value."""
DRIVEN = {"op", "out", "output", "cv", "mv", "co", "cmd", "command"}
"""Words of a controller that mean its output, the input of a pump."""
GOOD = {"good", "ok", "g", "valid", "gut", "true", "normal"}
POOR = {  # first words of a quality, in lower case
    "bad", "uncertain", "questionable", "substituted", "b", "u", "poor", "invalid", "false",
    "schlecht", "unsicher",
}
SWITCH = {  # {word for the state of a pump or a valve, in lower case: share of its range}
    **dict.fromkeys(("on", "true", "running", "run", "open", "opened", "started", "start"), 1.0),
    **dict.fromkeys(("ein", "an", "wahr", "auf", "offen", "läuft", "yes", "enabled"), 1.0),
    **dict.fromkeys(("off", "false", "stopped", "stop", "closed", "close", "idle", "shut"), 0.0),
    **dict.fromkeys(("aus", "falsch", "zu", "geschlossen", "steht", "no", "disabled"), 0.0),
}
# fmt: on
GOOD_CODE = 192  # least code of OPC for a good quality
MOST_BACK = 3  # steps back of the times of a tag that are settings of a clock
HOUR = 3600.0  # time by which a clock is set back [s]
UNCERTAIN = 2**30  # least status of OPC UA (or of a Windows HRESULT) that is not good


class Signal(NamedTuple):
    """Readings of one column, or of one tag of a long table."""

    table: tables.Table
    column: int
    t: np.ndarray  # times of its cells [s]
    quality: list[str]  # a word or number for each cell, [] without

    @property
    def described(self) -> tables.Column:
        return self.table.columns[self.column]


def time_columns(table: tables.Table) -> list[int]:
    """Return the columns of the times, the last the one to read: dates and times of day joined."""
    if joined := stamps.join_times(table):
        return joined
    where = lambda holds: [i for i, column in enumerate(table.columns) if holds(column)]
    times = where(lambda c: stamps.is_time(c.cells[0]))
    words = where(lambda c: compact(c.name) in TIME)
    units = where(lambda c: factor(tables.unit_name(c.unit or ""), "s"))
    return [*(i for i in words if i in times), *words, *times, *units][:1]


def signals_of(table: tables.Table, used: list[int], t: np.ndarray) -> list[Signal]:
    """Return the signals of a table whose rows are at the times t; used: the columns of these."""
    names = [compact(column.name) for column in table.columns]
    of = lambda words: next((i for i, name in enumerate(names) if name in words), None)
    tag, value = of(TAG), of(VALUE)
    if tag is None or value is None:
        return _wide(table, used, t)
    return _long(table, t, tag, value, of(UNIT), of(QUALITY))


def _long(table, t, tag, value, unit, quality):
    """Return the signals of a table with a row for each value of a tag."""
    columns, rows = table.columns, {}
    for k, text in enumerate(columns[tag].cells):
        rows.setdefault(text, []).append(k)
    signals = []
    for text, of_tag in rows.items():
        of_tag.sort(key=t.__getitem__)
        cells = lambda i, of_tag=of_tag: [columns[i].cells[k] for k in of_tag]
        name, stated = tables.split_header(text)
        values, units = cells(value), [] if unit is None else cells(unit)
        if len({*units} - {""}) > 1:  # each value has its own
            values = [f"{v} {u}".strip() if v[-1:].isdigit() else v for v, u in zip(values, units)]
        else:
            stated = stated or columns[value].unit or next(filter(None, units), None)
        column = tables.in_one_unit(tables.Column(text, name, stated, values), table.decimal)
        part = table._replace(columns=[column], lines=[table.lines[k] for k in of_tag])
        signals.append(Signal(part, 0, t[of_tag], [] if quality is None else cells(quality)))
    return signals


def _wide(table, used, t):
    """Return the signals of a table with a column for each."""
    rest = sorted({*range(len(table.columns))} - {*used})
    qualities = _qualities(table.columns, rest)
    plain, marks = [i for i in rest if i not in qualities], {}
    for i, name in qualities.items():
        of = [j for j in plain if compact(table.columns[j].name) == name != ""]
        if not of:  # the only one is of all columns, others of the one to their left
            alone = [name] == [*qualities.values()] == [""]
            of = plain if alone else [j for j in plain if j < i][-1:]
        marks |= dict.fromkeys(of, table.columns[i].cells)
    return [Signal(table, i, t, marks.get(i, [])) for i in plain]


def _qualities(columns, rest):
    """Return {column of qualities: what it judges}; TRUE and FALSE alone are states."""
    qualities = {i: name for i in rest if (name := _judged(columns[i])) is not None}
    values = [compact(columns[i].name) for i in rest if i not in qualities]
    states = [i for i in qualities if states_of(columns[i]) is not None]
    alone = [i for i in states if not any(qualities[i] in value for value in values)]
    return {i: name for i, name in qualities.items() if i not in alone}


def compact(text):
    return re.sub(r"[\W_]+", "", text.lower())


def rank(text, slot, name, slots, keys):
    """Return how well a column's name means a slot: 4 as what a run gave a pump, before lag and
    dead time, 3 exactly, 2 as a value, 1 in part, 0 not."""
    if slots[slot][0] != "h" and (applied := text.removeprefix("applied")) != text:
        return 4 if _rank(f"u{applied}", slot, name, slots, keys) == 3 else 0
    return _rank(text, slot, name, slots, keys)


def _rank(text, slot, name, slots, keys):
    letter = "h" if slots[slot][0] == "h" else "u"
    if text != slot and _is_name_of_another(text, slot, slots, keys):
        return 0
    ambiguous = _has_number_of_another(text, slot, slots, keys)
    by_number = _generic(text, slots) == slot and not ambiguous
    if by_number or text in (name, f"{letter}_{name}"):
        return 3 if text else 0
    if compact(text) == compact(name) != "":
        return 3
    parts = re.findall(r"[^\W\d_]+|\d+", name.lower())
    if not any(map(str.isalpha, parts)):
        return 0
    pattern = r"(?<![^\W_])" + r"[\W_]*".join(parts) + r"(?![^\W_])"
    if not re.search(pattern, text.lower()):
        return 0
    rest = set(re.split(r"[\W_]+", re.sub(pattern, " ", text.lower())))
    return 0 if rest & (OTHER | QUALITY) else 2 if rest & MEASURED else 1


def _is_name_of_another(text, slot, slots, keys):
    """Whether a text is the name that the rig gives another slot."""
    return any(
        of != slot and key not in slots and compact(key) == compact(text)
        for key, of in keys.items()
    )


def _has_number_of_another(text, slot, slots, keys):
    """Whether a number, as of "Tank 1", ends the name of another tank or pump, not of this one."""
    names = {key: of for key, of in keys.items() if key not in slots and text != slot}
    last = lambda word: int((re.findall(r"\d+", word) or ["-1"])[-1])
    alike = {of for name, of in names.items() if last(name) == last(text) and last(name) > -1}
    return slot not in alike and slots[slot][0] in {slots[of][0] for of in alike}


def states_of(column):
    """Return (cells,) shares of a range of words such as ON and OFF, NaN if missing, or None."""
    words = [cell.lower() for cell in column.cells]
    if not {*words} & SWITCH.keys() or not {*words} <= SWITCH.keys() | tables.MISSING:
        return None
    return np.array([SWITCH.get(word, np.nan) for word in words])


def setpoint_of(text, names):
    """Return the tank whose setpoint a column means, or None; names: {tank: its names}."""
    # "SP1" is of output 1, also where that is another tank; "LIC101.SP" of the tank with number 101
    parts = re.findall(r"[^\W\d_]+|\d+", re.sub(r"set[\W_]?points?", "sp", text.lower()))
    rest, tanks = [part for part in parts if part not in SETPOINT], [*names]
    if len(rest) == len(parts):
        return None
    meant = [i for i, of in names.items() if any(_within(compact(n), rest) for n in of)]
    meant = meant or (_of_number(rest, names) if rest else tanks)
    return meant[0] if len(meant) == 1 else None


def _of_number(parts, names):
    """Return the tanks whose number ends the parts of a name: of an output where it is alone."""
    number, beside = parts[-1], "".join(parts[-2:-1])
    if not number.isdigit() or not (beside[:1] in ("", "l") or WORDS.get(beside) == "h"):
        return []  # FIC101: of a flow
    if not beside and 0 < int(number) <= len(names):
        return [[*names][int(number) - 1]]
    digits = lambda name: (re.findall(r"\d+", name) or [""])[-1]
    return [i for i, of in names.items() if any(number == digits(n) for n in of)]


def _within(name, parts):
    """Whether parts of a text in a row make up a name."""
    ends = range(len(parts) + 1)
    return any("".join(parts[a:b]) == name for a in ends for b in ends[a + 1 :])


def _generic(stem, slots):
    """Return the slot ("t", "pump1", "h2") that a column's name means, or None."""
    # no rig has a tank of seven digits
    word = re.fullmatch(r"([a-z]+)[ _]?(\d{0,6})", stem.strip().lower())
    if not word or word[1] not in WORDS:
        return None
    kind, number = WORDS[word[1]], word[2] and str(int(word[2]))
    alone = not number and f"{kind}2" not in slots  # "level" of a single tank
    return f"{kind}1" if alone else f"{kind}{number}"


def _judged(column):
    """Return the compact name of what a column of qualities judges, "" for all; None of another."""
    *stem, last = re.split(r"[\W_]+", column.name.lower())
    marks = {_word(cell) for cell in column.cells}
    text = bool(marks & (GOOD | POOR))
    number = last != "q" and all(mark == "" or _code(mark) is not None for mark in marks)
    if last not in QUALITY or not (text or number) or is_run_state(column):
        return None
    return compact("".join(stem))


def is_run_state(column):
    """Whether a column called status holds 0 and 1 alone: whether a pump runs, or a quality."""
    last = re.split(r"[\W_]+", column.name.lower())[-1]
    marks = {cell.strip().lower() for cell in column.cells} - tables.MISSING
    return last == "status" and marks <= {"0", "1"}


def _word(mark):
    return re.split(r"[\s,;(\[]+", mark.strip().lower())[0]


def _code(word):
    """The number of a quality, also in hexadecimal digits; None of a word."""
    if re.fullmatch(r"0x[0-9a-f]{1,16}", word):
        return int(word, 16)
    return int(word) if re.fullmatch(r"-?\d{1,18}", word) else None


def _unknown(code):
    return False


def _good_codes(codes):
    """The function that tells a good code, from all codes of a column; `_unknown` of odd ones."""
    if any(abs(code) >= UNCERTAIN for code in codes):  # OPC UA, also as signed numbers
        return lambda code: code is not None and 0 <= code < UNCERTAIN
    if max(codes, default=0) >= GOOD_CODE:
        return lambda code: code is not None and code >= GOOD_CODE
    return (lambda code: code == 1) if codes <= {0, 1} else _unknown


def poor(signal):
    """Return (cells,) whether the quality of a signal is not good."""
    words = [_word(mark) for mark in signal.quality]
    if not words:
        return np.zeros(len(signal.t), dtype=bool)
    is_good = _good_codes({code for word in words if (code := _code(word)) is not None})
    if any(word.startswith("0x") for word in words):
        is_good = _good_codes({UNCERTAIN})  # only a status is written so
    good = [word in GOOD or word == "" or is_good(_code(word)) for word in words]
    if not any(good) or is_good is _unknown:
        known = ", ".join(map(repr, sorted(set(signal.quality))[:8]))
        raise DataError(
            f"{signal.table.where(signal.column)}: its quality is never known to be good: {known};"
            " write Good, Bad or Uncertain, or codes of OPC (192 is good) or of OPC UA (0 is good),"
            " or leave the column out"
        )
    return ~np.array(good)


def set_back(signal: Signal) -> tuple[int, float] | None:
    """Return (line, time [s]) at which a clock is set back by an hour at most; else None."""
    lines = np.array(signal.table.lines)
    order = np.argsort(lines)
    t = signal.t[order]
    steps = np.diff(t)
    steps = -steps if np.sum(steps) < 0.0 else steps  # newest first
    back = np.flatnonzero(steps < 0.0)
    if not 0 < back.size <= MOST_BACK or np.any(steps[back] <= -HOUR):
        return None
    # rows in front of the step and behind it alternate once they are sorted
    behind = np.arange(t.size)[np.argsort(t, kind="stable")] > back[0]
    if np.count_nonzero(np.diff(behind)) <= 2 * back.size + 1:
        return None
    return int(lines[order][back[0] + 1]), float(-steps[back[0]])
