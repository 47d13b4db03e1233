"""Numbers with a unit, such as "2500 cm^2", "5 min" or "36 m3/h", converted to a rig's unit."""

import difflib
import functools
import re

from jaxtank.core.errors import InputError
from jaxtank.core.units import DRIVES, LENGTHS, SHARES, TIMES, VOLTS

WATER = 9806.65
"""Specific weight of water at 4 C [N/m^3]: a pressure stands for the height of such a column."""

GALLON = 231 * 0.0254**3
"""Gallon of the United States [m^3]."""

TABLES: tuple[tuple[str, dict[str, float]], ...] = (
    ("m", {**LENGTHS, "km": 1000.0, "yd": 0.9144}),
    ("m", {"bar": 1e5 / WATER, "mbar": 1e2 / WATER, "Pa": 1 / WATER, "kPa": 1e3 / WATER}),
    ("m", {"psi": 6894.757293168 / WATER}),
    ("m^3", {"l": 1e-3, "L": 1e-3, "ml": 1e-6, "mL": 1e-6, "hl": 0.1, "gal": GALLON}),
    ("m^3/s", {"gpm": GALLON / 60, "cfm": 0.3048**3 / 60}),
    ("s", {**TIMES, "hr": 3600.0, "d": 86400.0}),
    ("V", VOLTS),
    ("", {**SHARES, "ppm": 1e-6}),
    *((next(iter(table)), table) for table in DRIVES),
)
"""(dimension, {unit: size}): sizes in the dimension's own unit."""

RAISED = str.maketrans("²³⁻¹", "23-1")
NUMBER = re.compile(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?")
TOKEN = re.compile(
    r"\s*(?:(?P<name>[^\W\d_]+|%|1(?![\d.]))(?:(?:\^|\*\*)?(?P<power>-?\d+))?|(?P<sign>[*/·()]))"
)

Size = tuple[float, dict[str, int]]
"""Size of a unit, and the exponents of its dimensions."""


def _product(a: Size, b: Size, power: int) -> Size:
    """Return a times b to a power."""
    exponents = {k: a[1].get(k, 0) + power * b[1].get(k, 0) for k in {**a[1], **b[1]}}
    return a[0] * b[0] ** power, {k: v for k, v in exponents.items() if v}


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
    text, end = unit.strip().translate(RAISED), 0
    if text in ("-", ""):
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


def quantity(where: str, text: str, unit: str) -> float:
    """Return the number of `unit` that a text such as "36 m3/h" stands for.

    Raises InputError for a text that is not a number with a unit, a unit that is unknown, and a
    unit of another dimension.
    """
    number = NUMBER.match(text.strip())
    name = text.strip()[number.end() :] if number else ""
    if number is None or not name.strip() or re.match(r"[.,\d]", name):
        raise InputError(
            f'{where} = "{text}": must be a number [{unit}], or a number with a unit such as'
            f' "2.5 {unit}", with a point as the decimal sign'
        )
    value, name = float(number[0]), name.strip()
    if name == unit:  # also a unit that is a mere label, such as U0
        return value
    try:
        size, dimension = size_of(name)
    except KeyError as error:
        nearest = difflib.get_close_matches(str(error.args[0]), list(_sizes()), 3, 0.5)
        hint = f"; nearest: {', '.join(nearest)}" if nearest else ""
        raise InputError(
            f'{where} = "{text}": the unit {name} is unknown{hint}; [{unit}] is needed'
        ) from None
    try:
        unit_size, unit_dimension = size_of(unit)
    except KeyError:
        unit_size, unit_dimension = 1.0, {unit: 1}
    if dimension != unit_dimension:
        raise InputError(f'{where} = "{text}": must be in {unit}, or in a unit that converts to it')
    return value * (size / unit_size)
