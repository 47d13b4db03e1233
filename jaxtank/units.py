"""Units of a rig. Metadata is written for centimetres and volts; a rig in other units says so, and every printed unit follows.

`plant.units` is (length, pump input): ("cm", "V") unless its paper counts otherwise, as in ("m", "m^3/s").
"""

import re

DEFAULT = ("cm", "V")


def local(unit, units=DEFAULT):
    """`unit`, written with "cm" for the length, "V" for the pump input and "volt" for a sensor's volt, in the units of a rig.

    A unit of several factors is put in brackets where it is one of several itself: V^2 of ("m", "m^3/s") is (m^3/s)^2.
    """
    length, drive = units
    if drive == f"{length}^3/s" and unit == "cm^3/(s V)":  # the input is the flow itself
        return "-"
    meant = {"cm": length, "V": drive, "volt": "V"}
    # all in one pass: what stands for one of them may hold another
    return re.sub(r"\b(cm|V|volt)\b", lambda found: _factor(meant[found[0]], alone=found[0] == unit), unit)


def _factor(unit, alone):
    """`unit` as one factor of another."""
    return unit if alone or not re.search(r"[\s/*^]", unit) else f"({unit})"
