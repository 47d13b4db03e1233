"""The units that are known, and numbers with a unit, such as "2500 cm^2", "5 min" or "36 m3/h",
converted to a rig's unit.
"""

import difflib
import functools
import re
from collections.abc import Iterable
from typing import Any, cast

from jaxtank.core.errors import InputError
from jaxtank.core.text import shortened

WATER = 9806.65
"""Specific weight of water at 4 C [N/m^3]: a pressure stands for the height of such a column."""

PSI = 6894.757293168 / WATER
GALLON = 231 * 0.0254**3  # gallon of the United States [m^3]

LENGTHS = {"m": 1.0, "dm": 0.1, "cm": 0.01, "mm": 1e-3, "in": 0.0254, "inch": 0.0254, "ft": 0.3048}
TIMES = {"s": 1.0, "sec": 1.0, "ms": 1e-3, "us": 1e-6, "min": 60.0, "h": 3600.0}
WORDS = {"second": 1.0, "minute": 60.0, "hour": 3600.0, "day": 86400.0, "week": 604800.0}
VOLTS = {"V": 1.0, "mV": 1e-3}
SHARES = {"-": 1.0, "1": 1.0, "%": 0.01}
DRIVES = ({"A": 1.0, "mA": 1e-3}, {"W": 1.0, "kW": 1e3}, {"Hz": 1.0}, {"rpm": 1.0}, {"U0": 1.0})
"""Current, power, frequency of a drive and speed of its shaft, of which the one does not give the
other, and the input at rest (khalid2015)."""

TABLES: tuple[tuple[str, dict[str, float]], ...] = (
    ("m", {**LENGTHS, "km": 1000.0, "yd": 0.9144}),
    ("m", {"bar": 1e5 / WATER, "mbar": 1e2 / WATER, "Pa": 1 / WATER, "kPa": 1e3 / WATER}),
    ("m", {**dict.fromkeys(("psi", "psig"), PSI), "barg": 1e5 / WATER, "atm": 101325.0 / WATER}),
    ("m", {f"{length}WC": size for length, size in LENGTHS.items()}),  # water column
    ("m^3", {"l": 1e-3, "L": 1e-3, "ml": 1e-6, "mL": 1e-6, "cc": 1e-6}),
    ("m^3", {"hl": 0.1, "kl": 1.0, "kL": 1.0, "Ml": 1000.0, "ML": 1000.0}),
    ("m^3", {"bbl": 42 * GALLON, "gal": GALLON, "gallon": GALLON, "gallons": GALLON}),
    (
        "m^3/s",
        {
            **dict.fromkeys(("gpm", "GPM"), GALLON / 60),
            **dict.fromkeys(("gph", "GPH"), GALLON / 3600),
        },
    ),
    ("m^3/s", {**dict.fromkeys(("lpm", "LPM"), 1e-3 / 60), "lps": 1e-3, "LPS": 1e-3}),
    ("m^3/s", dict.fromkeys(("lph", "LPH"), 1e-3 / 3600)),
    ("m^3/s", {"cfm": 0.3048**3 / 60, "cfs": 0.3048**3}),
    (
        "m^3/s",
        {
            "gpd": GALLON / 86400,
            **dict.fromkeys(("MGD", "mgd"), 1e6 * GALLON / 86400),
            "MLD": 1000.0 / 86400,
        },
    ),
    ("s", {**TIMES, "hr": 3600.0, "hrs": 3600.0, "d": 86400.0, "mins": 60.0, "secs": 1.0}),
    ("s", {f"{name}{s}": size for name, size in WORDS.items() for s in ("", "s")}),
    ("V", VOLTS),
    ("", {**SHARES, "ppm": 1e-6}),
    *((next(iter(table)), table) for table in DRIVES),
)
"""(dimension, {unit: size}): sizes in the dimension's own unit."""

LEVEL_UNITS = (*LENGTHS, *VOLTS, *SHARES)
FLOW_UNITS = (
    *(f"{length}^3/s" for length in LENGTHS),
    *(f"{v}/{t}" for v in ("m^3", "cm^3", "l", "ml") for t in ("s", "min", "h")),
    "gpm",
)
INPUT_UNITS = (*VOLTS, *dict.fromkeys(FLOW_UNITS), *SHARES, *(n for t in DRIVES for n in t))
"""Usual units of levels, flows and pump inputs, for hints; others of the same dimension are
read too.
"""

RAISED = str.maketrans("²³⁻¹", "23-1")
NUMBER = re.compile(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?")
TOKEN = re.compile(
    r"\s*(?:(?P<name>[^\W\d_]+|%|1(?![\d.]))(?:(?:\^|\*\*)?(?P<power>-?\d+))?|(?P<sign>[*/·()]))"
)
NO_UNIT = re.compile(r"(?<![^\s/(])-(?![\w^])")
"""A factor without a unit, as in "m^3/(s -)", the gain of a pump whose input has none."""

Size = tuple[float, dict[str, int]]  # size of a unit, and the exponents of its dimensions


def _product(a: Size, b: Size, power: int) -> Size:
    """Return a times b to a power."""
    exponents = {k: a[1].get(k, 0) + power * b[1].get(k, 0) for k in {**a[1], **b[1]}}
    size = a[0] * b[0] ** power if power > 0 else a[0] / b[0] ** -power  # exact for 1e-3/60
    return size, {k: v for k, v in exponents.items() if v}


@functools.cache
def _sizes() -> dict[str, Size]:
    """Return {unit: its size} of TABLES."""
    powers = {"m": {"m": 1}, "m^3": {"m": 3}, "m^3/s": {"m": 3, "s": -1}, "": {}}
    return {
        name: (size, powers.get(dimension, {dimension: 1}))
        for dimension, table in TABLES
        for name, size in table.items()
    }


@functools.cache
def size_of(unit: str) -> Size:
    """Return the size of a unit such as "cm^3/(s V)"; KeyError with the name that is unknown."""
    text, end = unit.strip().translate(RAISED).replace("H2O", "WC"), 0
    text = NO_UNIT.sub("1", text)
    if not text:
        return 1.0, {}
    # one level of the stack for each open bracket: (product so far, the power that comes next)
    stack: list[tuple[Size, int]] = [((1.0, {}), 1)]
    while end < len(text):
        token = TOKEN.match(text, end)
        if token is None:
            raise KeyError(text[end:].strip())
        end = token.end()
        (product, power), sign = stack[-1], token["sign"]
        if token["name"]:
            factor = _sizes()[token["name"]]
            stack[-1] = _product(product, factor, power * int(token["power"] or 1)), 1
        elif sign == "(":
            stack.append(((1.0, {}), 1))
        elif sign == ")" and len(stack) > 1:
            inside = stack.pop()[0]
            product, power = stack[-1]
            stack[-1] = _product(product, inside, power), 1
        elif sign in "*·/":
            stack[-1] = product, -1 if sign == "/" else 1
        else:
            raise KeyError(sign)
    if len(stack) > 1:
        raise KeyError("(")
    return stack[0][0]


def factor(unit: str, base: str) -> float | None:
    """Return the number of `base` that one `unit` is; None where one is unknown, and of units of
    different dimensions.
    """
    if unit == base:  # also a unit that is a mere label, such as U0
        return 1.0
    try:
        (size, dimension), (base_size, base_dimension) = size_of(unit), size_of(base)
    except KeyError:
        return None
    return size / base_size if dimension == base_dimension else None


def quantity(where: str, text: str, unit: str) -> float:
    """Return the number of `unit` that a text such as "36 m3/h" stands for.

    Raises InputError for a text that is not a number with a unit, a unit that is unknown, and a
    unit of another dimension.
    """
    bracketed = "" if unit == "-" else f" [{unit}]"
    number = NUMBER.match(text.strip())
    name = text.strip()[number.end() :] if number else ""
    if number is None or not name.strip() or re.match(r"[.,_\d]", name):
        example = f'"2.5 {unit}"' if unit != "-" else '"80 %"'
        raise InputError(
            f"{where} = {shortened(text)}: must be a number{bracketed}, or one with a unit such as"
            f" {example}, with a point as the decimal sign"
        )
    value, name = float(number[0]), name.strip()
    size = factor(name, unit)
    if size is not None and "%" in unit.partition("/")[2] and "%" not in name:  # a hundredth of it?
        top, _, bottom = name.partition("/")
        each = f"{top}/({bottom} %)" if bottom else f"{top}/%"
        raise InputError(
            f'{where} = {shortened(text)}: for each %, or for 100 %? Write "{value:g} {each}" or'
            f' "{value / 100:.10g} {each}"'
        )
    if size is not None:
        return value * size
    needed = "%, or have no unit" if unit == "-" else f"{unit}, or in a unit that converts to it"
    try:
        size_of(name)
    except KeyError as error:
        nearest = difflib.get_close_matches(str(error.args[0]), list(_sizes()), 3, 0.5)
        hint = f"; nearest: {', '.join(nearest)}" if nearest else ""
        raise InputError(
            f"{where} = {shortened(text)}: the unit {name} is unknown{hint}; must be in {needed}"
        ) from None
    raise InputError(f"{where} = {shortened(text)}: must be in {needed}")


def converted(where: str, value: Any, unit: str) -> Any:
    """Return `value` with each text in it that begins with a number as a number of `unit`."""
    if isinstance(value, str):
        return quantity(where, value, unit) if NUMBER.match(value.strip()) else value
    if isinstance(value, (list, tuple)):
        return [converted(where, each, unit) for each in cast(Iterable[Any], value)]
    return value
