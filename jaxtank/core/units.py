"""Units of a rig. Metadata is written for centimetres and volts; a rig in other units declares
them, and every printed unit follows.

`plant.units` is (length, pump input): ("cm", "V") unless its paper counts otherwise, as in ("m",
"m^3/s").
"""

import functools
import re

from jaxtank.core.errors import InputError

DEFAULT = ("cm", "V")

LENGTHS = {"m": 1.0, "dm": 0.1, "cm": 0.01, "mm": 1e-3, "in": 0.0254, "inch": 0.0254, "ft": 0.3048}
VOLTS = {"V": 1.0, "mV": 1e-3}
TIMES = {"s": 1.0, "sec": 1.0, "ms": 1e-3, "min": 60.0, "h": 3600.0}
FLOWS = {
    **{f"{name}^3/s": size**3 for name, size in LENGTHS.items()},
    **{
        f"{volume}/{time}": size / TIMES[time]
        for volume, size in (("m^3", 1.0), ("cm^3", 1e-6), ("l", 1e-3), ("ml", 1e-6))
        for time in ("s", "min", "h")
    },
    "gpm": 231 * 0.0254**3 / 60,
}
SHARES = {"-": 1.0, "1": 1.0, "%": 0.01}
DRIVES = ({"A": 1.0, "mA": 1e-3}, {"W": 1.0, "kW": 1e3}, {"Hz": 1.0, "rpm": 1 / 60}, {"U0": 1.0})
"""Current, power, speed, and the input at rest (khalid2015)."""

LEVELS = (LENGTHS, VOLTS, SHARES)
INPUTS = (VOLTS, FLOWS, SHARES, *DRIVES)
"""Tables {unit: size} of one dimension each: what levels and pump inputs may be counted in. A flow
is in m^3/s, a length in m."""


def canonical(unit: str) -> str:
    """Return a unit as the tables spell it."""
    text = re.sub(
        r"(?<=[a-z])\^?([23]|[²³])", lambda m: "^" + m[1].translate(_RAISED), unit.strip()
    )
    text = re.sub(r"\s*/\s*", "/", text).replace("L/", "l/")
    return re.sub(r"^cc/", "cm^3/", text)


_RAISED = str.maketrans("²³", "23")


def check_units(where: str, units: tuple[str, str]) -> tuple[str, str]:
    """Return the units of a rig, (length, pump input), powers written with ^."""
    checked: list[str] = []
    for what, text, tables in zip(("level", "pump input"), units, (LEVELS, INPUTS)):
        check_unit(f"{where}: entry", text)
        unit = canonical(text)
        known = [name for table in tables for name in table]
        if unit not in known:
            alien = next((t for t in (LENGTHS, TIMES, FLOWS, *DRIVES) if unit in t), None)
            why = "is unknown" if alien is None else f"is no unit of a {what}"
            raise InputError(f"{where}: {text!r} {why}: must be one of {', '.join(known)}")
        checked.append(
            text if canonical(text.replace("L", "l")) == text.replace("L", "l") else unit
        )
    return checked[0], checked[1]


def flow_per_input(units: tuple[str, str]) -> float | None:
    """Flow [length^3/s] of one unit of the pump's input; None where it is no flow."""
    length, drive = map(canonical, units)
    if drive not in FLOWS or length not in LENGTHS:
        return None
    return FLOWS[drive] / LENGTHS[length] ** 3


LONGEST = 40
"""Characters of a unit at most."""


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
