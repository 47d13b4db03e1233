"""Units of a rig. Metadata is written for centimetres and volts; a rig in other units says so, and every printed unit follows.

`plant.units` is (length, pump input): ("cm", "V") unless its paper counts otherwise, as in ("m", "m^3/s").
"""

import re

DEFAULT = ("cm", "V")


def local(unit, units=DEFAULT):
    """`unit`, written with "cm" for the length, "V" for the pump input and "volt" for a sensor's volt, in the units of a rig."""
    length, drive = units
    if tuple(units) != DEFAULT:
        if drive == f"{length}^3/s" and unit == "cm^3/(s V)":  # the input is the flow itself
            return "-"
        unit = re.sub(r"\bV\b", drive, unit)
        unit = re.sub(r"\bcm\b", length, unit)
    return unit.replace("volt", "V")
