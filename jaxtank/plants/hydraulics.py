"""One physical law each. Scalars or arrays; lengths in the rig's unit (cm unless its paper is in
m).
"""

import math

import jax.numpy as jnp

from jaxtank.core.errors import InputError
from jaxtank.core.numerics import LAMINAR_THRESHOLD, smooth_sqrt

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
    """A number of `centimetres` [cm], or of one of them per s^2, in the unit `length` of a rig; as
    it is where that is no length: levels in the volts of a sensor have no other scale.
    """
    return centimetres * PER_CENTIMETRE.get(length, 1.0)


def default_gravity(length):
    """Return the acceleration g [length/s^2] of a rig whose unit of length is `length`: 981 cm/s^2.

    Raises InputError where `length` is no unit of length, as the volts of a sensor.
    """
    if length not in PER_CENTIMETRE:
        raise InputError(
            f'plant.gravity: must be given for a rig whose length is "{length}" '
            f"(known without it: {', '.join(PER_CENTIMETRE)}; 981 for cm, 9.81 for m)"
        )
    return in_unit(GRAVITY, length)


def default_threshold(length):
    """Level below which flow turns laminar unless a rig says otherwise: 0.01 cm, in the unit
    `length` of the rig.
    """
    return in_unit(LAMINAR_THRESHOLD, length)


def disc(diameter):
    """Area of a disc [cm^2] of `diameter` [cm]: s = pi d^2 / 4."""
    return math.pi * diameter**2 / 4


def efflux(level, gravity, knee):
    """Torricelli's speed of efflux v = sqrt(2 g h) [cm/s] under `level` h [cm]; C1 through zero
    (see numerics.smooth_sqrt).
    """
    return jnp.sqrt(2.0 * gravity) * smooth_sqrt(level, knee)
