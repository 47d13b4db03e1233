"""Physical relations and constants of tanks: scalars or arrays, lengths in the rig's unit."""

import math

from jaxtank.core.errors import InputError
from jaxtank.core.numerics import LAMINAR_THRESHOLD
from jaxtank.core.quantities import LENGTHS

GRAVITY = 981.0  # standard acceleration in the units of gouta2015, Table 1 [cm/s^2]

PER_CENTIMETRE = {unit: 1 / (100 * size) for unit, size in LENGTHS.items()}
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
