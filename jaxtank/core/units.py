"""Units of a rig. Metadata is written for centimetres and volts; a rig in other units declares
them, and every printed unit follows. Imports core only; may be imported by every folder.

`plant.units` is (length, pump input): ("cm", "V") unless its paper counts otherwise, as in ("m",
"m^3/s").
"""

import functools
import re

from jaxtank.core.errors import InputError

DEFAULT = ("cm", "V")

LONGEST = 40
"""Characters of a unit at most."""


def check_unit(where: str, text: str) -> str:
    """Return `text` if it is a unit, such as "cm", "L/min", "m^3/s" or "cm^3/(s V)".

    A unit is names joined by *, / or a space, each with ^ and a number where it has an exponent; a
    product may stand in brackets. A name is letters, digits and _, and begins with a letter; "%",
    "1" and "-" are units too.

    Parameters
    ----------
    where : what messages call it
    text : the unit

    Raises
    ------
    InputError for any other text.

    Examples
    --------
    >>> check_unit("column h1", "L/min")
    'L/min'
    """
    name = r"(?:[^\W\d_]\w*|°[CF]|%|1)"
    factor = rf"{name}(?:\^-?\d+(?:\.\d+)?)?"
    joint = r"(?: ?[*/·] ?| )"
    product = rf"{factor}(?:{joint}{factor})*"
    term = rf"(?:{factor}|\({product}\)(?:\^-?\d+)?)"
    if len(text) > LONGEST or not re.fullmatch(rf"-|{term}(?:{joint}{term})*", text):
        shown = text if len(text) <= LONGEST else text[:LONGEST] + "..."
        raise InputError(
            f"{where} = {shown!r}: must be a unit of at most {LONGEST} characters, such as cm,"
            " L/min, m^3/s or cm^3/(s V): names joined by *, / or a space, ^ before an exponent"
        )
    return text


@functools.cache
def local(unit: str, units: tuple[str, str] = DEFAULT) -> str:
    """Return a unit in the units of a rig.

    A unit of several factors is put in brackets where it is one of several itself.

    Parameters
    ----------
    unit : written with "cm" for the length, "V" for the pump input and "volt" for a sensor's volt
    units : (length, pump input) of the rig

    Examples
    --------
    >>> local("cm/V", ("m", "m^3/s"))
    'm/(m^3/s)'
    """
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
