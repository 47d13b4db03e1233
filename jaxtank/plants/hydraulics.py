"""One physical law each. Scalars or arrays; lengths in the rig's unit (cm unless its paper is in m)."""

import math

import jax.numpy as jnp

from jaxtank.numerics import root

GRAVITY = 981.0
"""Standard acceleration in the units of gouta2015, Table 1 [cm/s^2]."""


def disc(diameter):
    """Area of a disc [cm^2] of `diameter` [cm]: s = pi d^2 / 4."""
    return math.pi * diameter**2 / 4


def efflux(level, gravity, knee):
    """Torricelli's speed of efflux v = sqrt(2 g h) [cm/s] under `level` h [cm]; C1 through zero (see numerics.root)."""
    return jnp.sqrt(2.0 * gravity) * root(level, knee)
