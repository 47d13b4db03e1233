"""From a rig file to a Case."""

import dataclasses
import re
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from jaxtank import presets
from jaxtank.case import Case
from jaxtank.core.errors import InputError, unknown
from jaxtank.core.files import read_text
from jaxtank.core.text import shortened
from jaxtank.rig import components, experiment_tables, network, signals, validate
from jaxtank.rig.schema import name_of
from jaxtank.rig.values import by_dotted_name, has, set_and_schedule, with_models

MOST = 100
"""Parts of a dotted key; the names of a rig have four."""

MOST_WORDS = 100_000
"""Keys (each part of one), numbers (those with a point twice), texts, lists and tables of a file:
it is parsed and checked in seconds.
"""

_PART = r"""(?:[A-Za-z0-9_-]++|"(?:[^"\\\n]|\\[^\n])*+"|'[^'\n]*+')"""
# Every alternative is possessive: nothing is read twice, whatever is left open. A value has two
# such parts at most, those of a float.
_TOKEN = re.compile(
    r'''(?P<text>"""(?:[^"\\]|\\.|"{1,2}(?!"))*+"{3,5}|\'\'\'(?:[^']|'{1,2}(?!'))*+'{3,5})'''
    rf"""|(?P<open>\"\"\"|''')|(?P<key>{_PART}(?:[ \t]*+\.[ \t]*+{_PART})*+)|(?P<quote>["'])|[\[{{]|(?:\#[^\n]*+\s*+)++""",
    re.DOTALL,
)
_ONE = re.compile(_PART)


def check_keys(text):
    """Raise InputError for a key of more than `MOST` dotted parts, and for a file of more than
    `MOST_WORDS` words. Dots of numbers, texts and comments are none of a key's.
    """
    words = 0
    for token in _TOKEN.finditer(text):
        if token.lastgroup in ("open", "quote"):
            return  # a text without an end: the parser gets no further either
        parts = (
            sum(1 for _ in _ONE.finditer(token.group()))
            if token.lastgroup == "key" and "." in token.group()
            else 1
        )
        if parts > MOST:
            line = text.count("\n", 0, token.start()) + 1
            raise InputError(
                f"line {line}: a key of {parts} parts joined by dots: must be at most {MOST}"
            )
        words += parts
        if words > MOST_WORDS:
            raise InputError(f"has more than {MOST_WORDS} keys and values")


TABLES = (
    "case",
    "name",
    "reachable",
    *network.TABLES,
    "law",
    "observer",
    "sensor",
    "actuator",
    "schedule",
    "values",
    "reference",
    "disturbance",
    "pour",
    "fault",
    "limits",
    "free",
    "objective",
    "uncertain",
    "covariance",
    "log",
    "scenario",
)
LISTS = ("scenario", "tank", "orifice", "pipe", "spill", "pump", "pour", "fault")
KINDS = {
    "case": (str, "a text"),
    "name": (str, "a text"),
    "reachable": (bool, "true or false"),
    "units": (list, "a list"),
    **{k: (list, f"a list of tables, [[{k}]]") for k in LISTS},
}


def open_case(name: str) -> Case:
    """The Case of "paper/case", or of a rig file where `name` ends in .toml, checked."""
    return load(name) if name.endswith(".toml") else presets.find(name)


def load(path: str | Path) -> Case:
    """The Case of a rig file. Raises InputError, naming the file, for anything in it that is
    unknown, misshapen or out of range.
    """
    return loads(read_text(path, "rig file"), f"rig file {str(path)!r}")


def loads(text: str, words: str = "rig file") -> Case:
    """The Case of the text of a rig file, called `words` in errors."""
    try:
        check_keys(text)
    except InputError as error:
        raise InputError(f"{words}: {error}") from None
    try:
        # a byte-order mark, as some editors write
        table = tomllib.loads(text.removeprefix("\ufeff"))
    except tomllib.TOMLDecodeError as error:
        raise InputError(f"{words} is not TOML: {' '.join(str(error).split())}") from None
    except ValueError:  # of Python, which reads no whole number of thousands of digits
        raise InputError(
            f"{words}: a whole number in it has more digits than can be read: write it with an"
            " exponent, as 1e30"
        ) from None
    except RecursionError:
        raise InputError(f"{words} is not TOML that can be read: it is nested too deeply") from None
    try:
        return from_table(table)
    except InputError as error:
        raise type(error)(f"{words}: {error}") from None
    except RecursionError:
        raise InputError(f"{words}: a value is nested too deeply") from None


def from_table(table: Mapping[str, Any]) -> Case:
    """The Case described by a table of the form of a rig file."""
    case = start_of(table)
    table = {
        **table,
        **{
            key: by_dotted_name(table[key], key)
            for key in ("values", "free", "uncertain")
            if key in table
        },
    }
    values = with_models(case.loop, table.get("values", {}))
    case = set_and_schedule(case, values, table.get("schedule", {}))
    if "limits" in table:
        case = case.replace(limits=validate.check_limits(case.loop, table["limits"]))
    if "objective" in table:
        case = case.replace(objective=validate.check_objective(table["objective"]))
    if "free" in table:
        case = case.replace(free=validate.free_of(case.loop, table["free"]))
    if "uncertain" in table:
        case = case.replace(uncertain=validate.check_uncertain(case.loop, table["uncertain"]))
    if "covariance" in table:
        case = case.replace(
            covariance=experiment_tables.check_covariance(case.loop, table["covariance"])
        )
    if "log" in table:
        case = case.replace(log=experiment_tables.check_log(case.loop.plant, table["log"]))
    if "scenario" in table:
        case = case.replace(
            scenarios=tuple(
                validate.scenario(case, entry, i) for i, entry in enumerate(table["scenario"])
            )
        )
    return validate.check(case)


def start_of(table):
    """The Case of the tables that build: case or tanks, law, observer, reference, what disturbs;
    before any value is set.
    """
    for key, value in table.items():
        if key not in TABLES:
            raise unknown("key", key, TABLES)
        wanted, words = KINDS.get(key, (dict, "a table"))
        if not isinstance(value, wanted):
            raise InputError(f"{key} = {shortened(value)}: must be {words}")
    name_of("name", table.get("name", ""))
    if "case" in table and (given := [k for k in network.TABLES if k in table]):
        raise InputError(
            f"{given[0]}: a rig file is either a case or a rig described tank by tank: leave out"
            f" case, or [{given[0]}]"
        )
    if "case" not in table and "tank" not in table:
        raise InputError(
            'a rig file needs case = "paper/case" to start from (`jaxtank list` prints them), or'
            " [[tank]] to describe a rig"
        )
    case = (
        _with_parts(presets.find(table["case"]), table) if "case" in table else network.build(table)
    )
    loop, changed = case.loop, {}
    for word in components.INSTRUMENTS:
        if word in table:
            changed[word] = components.instrument_of(word, table[word], loop)
    if "reference" in table:
        changed["reference"] = signals.reference_of(table["reference"], loop.reference)
    if "disturbance" in table or "pour" in table:
        named = network.names_in(table)
        changed["disturbance"] = signals.disturbance_of(
            table,
            loop,
            lambda value, where: network.tank_index(value, where, named, loop.plant.tanks),
        )
    if "fault" in table:
        changed["faults"] = signals.faults_of(table["fault"], loop.plant)
    if changed:
        case = case.replace(loop=dataclasses.replace(loop, **changed))
    return case.replace(
        name=table.get("name", case.name), reachable=table.get("reachable", case.reachable)
    )


def _with_parts(case, table):
    """A case with the law or observer of a table in the place of its own. What its own could be
    tuned by goes with a law.
    """
    loop, changed = case.loop, {}
    levels, initial = np.asarray(loop.x0), loop.actuator.initial
    if "law" in table:
        start = [float(levels[i]) for i in loop.plant.outputs]
        changed["controller"] = components.law_of(table["law"], loop.plant, start, initial)
        if type(changed["controller"]) is not type(loop.controller):
            case = case.replace(symmetry=None)
    if "observer" in table:
        changed["observer"] = components.observer_of(table["observer"], loop.plant, levels, initial)
    if not changed:
        return case
    prefix = tuple(f"{name}." for name in changed)
    free = {
        n: f
        for n, f in case.free.items()
        if not n.startswith(prefix) or has(dataclasses.replace(loop, **changed), n)
    }
    return case.replace(loop=dataclasses.replace(loop, **changed), free=free)
