"""Units of a rig. Metadata is written for centimetres and volts; a rig in other units declares
them, and every printed unit follows.

`plant.units` is (length, pump input): ("cm", "V") unless its paper counts otherwise, as in ("m",
"m^3/s").
"""

import functools
import re

from jaxtank.core.errors import InputError
from jaxtank.core.quantities import INPUT_UNITS, LEVEL_UNITS, RAISED, factor, size_of

DEFAULT = ("cm", "V")


def canonical(unit: str) -> str:
    """Return a unit as the tables spell it."""
    text = re.sub(r"(?<=[a-z])\^?([23]|[²³])", lambda m: "^" + m[1].translate(RAISED), unit.strip())
    text = re.sub(r"\s*/\s*", "/", text).replace("L/", "l/")
    return re.sub(r"^cc/", "cm^3/", text)


def check_units(where: str, units: tuple[str, str]) -> tuple[str, str]:
    """Return the units of a rig, (length, pump input), powers written with ^."""
    checked: list[str] = []
    for what, text, usual in zip(("level", "pump input"), units, (LEVEL_UNITS, INPUT_UNITS)):
        check_unit(f"{where}: entry", text)
        unit = canonical(text)
        like = what == "pump input" and any(factor(unit, name) for name in usual)
        if unit not in usual and not like:
            try:
                size_of(unit)
                why = f"is no unit of a {what}"
            except KeyError:
                why = "is unknown"
            raise InputError(f"{where}: {text!r} {why}: must be one of {', '.join(usual)}")
        checked.append(
            text if canonical(text.replace("L", "l")) == text.replace("L", "l") else unit
        )
    return checked[0], checked[1]


def flow_per_input(units: tuple[str, str]) -> float | None:
    """Flow [length^3/s] of one unit of the pump's input; None where it is no flow."""
    length, drive = map(canonical, units)
    return factor(drive, f"{length}^3/s") if factor(length, "m") else None


LONGEST = 40  # largest number of characters of a unit


def check_unit(where: str, text: str) -> str:
    """Return `text` if it is a unit, such as "cm", "L/min", "m^3/s" or "cm^3/(s V)"."""
    name = r"(?:[^\W\d_]\w*|°[CF]|%|1)"
    factor = rf"{name}(?:\^-?\d+(?:\.\d+)?)?"
    joint = r"(?: ?[*/·] ?| )"
    product = rf"{factor}(?:{joint}{factor})*"
    term = rf"(?:{factor}|\({product}\)(?:\^-?\d+)?)"
    if len(text) > LONGEST or not re.fullmatch(rf"-|{term}(?:{joint}{term})*", text):
        start = text if len(text) <= LONGEST else text[:LONGEST] + "..."
        raise InputError(
            f"{where} = {start!r}: must be a unit of at most {LONGEST} characters, such as cm,"
            " L/min, m^3/s or cm^3/(s V): names joined by *, / or a space, ^ before an exponent"
        )
    return text


@functools.cache
def local(unit: str, units: tuple[str, str] = DEFAULT) -> str:
    """Return a unit in the units of a rig."""
    length, drive = units
    if drive == f"{length}^3/s" and unit == "cm^3/(s V)":  # the input is the flow itself
        return "-"
    meant = {"cm": length, "V": drive, "volt": "V"}
    # all in one pass: what stands for one of them may hold another
    return re.sub(
        r"\b(cm|V|volt)\b", lambda found: _factor(meant[found[0]], alone=found[0] == unit), unit
    )


def _factor(unit: str, alone: bool) -> str:
    """`unit` as one factor of another."""
    return unit if alone or not re.search(r"[\s/*^]", unit) else f"({unit})"
