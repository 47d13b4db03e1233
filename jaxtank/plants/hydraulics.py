"""Physical relations and constants of tanks: scalars or arrays, lengths in the rig's unit."""

import math

from jaxtank.core.errors import InputError
from jaxtank.core.numerics import LAMINAR_THRESHOLD

GRAVITY = 981.0
"""Standard acceleration in the units of gouta2015, Table 1 [cm/s^2]."""

PER_CENTIMETRE = {
    "mm": 10.0,
    "cm": 1.0,
    "dm": 0.1,
    "m": 0.01,
    "in": 1 / 2.54,
    "inch": 1 / 2.54,
    "ft": 1 / 30.48,
}
"""Units of length: how many are one centimetre."""


def in_unit(centimetres, length):
    """Return a length [cm], or acceleration [cm/s^2], in the unit `length` of a rig."""
    return centimetres * PER_CENTIMETRE.get(length, 1.0)


def default_gravity(length):
    """Return the acceleration g [length/s^2], 981 cm/s^2 in a rig's unit of length."""
    if length not in PER_CENTIMETRE:
        raise InputError(
            f'plant.gravity: must be given for a rig whose length is "{length}" '
            f"(known without it: {', '.join(PER_CENTIMETRE)}; 981 for cm, 9.81 for m)"
        )
    return in_unit(GRAVITY, length)


def default_threshold(length):
    """Return the default laminar threshold, 0.01 cm, in the unit `length` of a rig."""
    return in_unit(LAMINAR_THRESHOLD, length)


def disc(diameter):
    """Return the area of a disc [cm^2] of `diameter` [cm]: s = pi d^2 / 4."""
    return math.pi * diameter**2 / 4
