"""Inversion that controllers share: from demanded output accelerations to voltages."""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from jaxtank.core.errors import InputError
from jaxtank.core.numerics import clipped_sqrt
from jaxtank.plants.elements import check_plain
from jaxtank.plants.rigs import STATE_COUPLED_FEEDS, STATE_COUPLED_LINKS
from jaxtank.signals.base import Constant
from jaxtank.signals.setpoints import Ramps


def drift(model, x):
    """Return f(h): level rates of the model with its pumps off."""
    rate = model.derivative(0.0, tuple(x), (0.0,) * model.pumps, None)
    return tuple(rate[i] for i in model.outputs)


def authority(model):
    """Return c2 = Kp/A: level rate per volt of each pump in its own tank (gouta2022 eq. 3)."""
    return tuple(model.pump_gain[j] / model.area[first] for j, (first, _) in enumerate(model.feeds))


def check_inverted(model, holder="controller"):
    """Raise InputError for a model with elements that the formulas of a controller have not."""
    others = 'kind = "pid", "lqi", "gpc" or "laguerre" serves such a rig'
    others = "the Kalman filters serve such a rig" if holder == "observer" else others
    check_plain(model, f"{holder}.model", f"this {holder} inverts a plain network: {others}")


def check_own_pumps(model, holder="controller"):
    """Check that pump j fills the j-th controlled tank alone."""
    check_inverted(model, holder)
    if model.feeds != tuple((tank, None) for tank in model.outputs):
        raise InputError(
            f"{holder}.model must have one pump per controlled tank, in the same order: this"
            f" {holder} inverts it tank by tank"
        )
    if model.outputs != tuple(range(model.tanks)):
        raise InputError(
            f"{holder}.model has tanks whose levels are not controlled: this {holder} needs the"
            " setpoint of every tank"
        )


class Coefficients(NamedTuple):
    """c1 .. c10 of gouta2015 eq."""

    # (7), with the receiving tank's area (gouta2015 notes E1) [cm^0.5/s]; c8, c10 [cm/(V s)].

    c1: Any
    c2: Any
    c3: Any
    c4: Any
    c5: Any
    c6: Any
    c7: Any
    c8: Any
    c9: Any
    c10: Any

    @property
    def alpha(self):
        """(c2 c6 - c3 c5) / 2 [cm/s^2]: determinant of the decoupling matrix without its roots."""
        return 0.5 * (self.c2 * self.c6 - self.c3 * self.c5)


def coefficients(model):
    """Return c1 .. c10 of gouta2015 eq. (7) for a state-coupled `TankNetwork`."""
    s31, s32, s41, s42 = (model.orifice[i] for i in range(4))
    a1, a2, a3, a4 = (model.area[i] for i in range(4))
    w = jnp.sqrt(2.0 * model.gravity)
    return Coefficients(
        c1=model.drain[0] * w / a1,
        c2=s31 * w / a1,
        c3=s41 * w / a1,
        c4=model.drain[1] * w / a2,
        c5=s32 * w / a2,
        c6=s42 * w / a2,
        c7=(s31 + s32) * w / a3,
        c8=model.pump_gain[0] / a3,
        c9=(s41 + s42) * w / a4,
        c10=model.pump_gain[1] / a4,
    )


def clipped_roots(levels, lower):
    """Return sqrt(max(h, lower)) of each level."""
    # The command is proportional to the roots of the upper levels: with a dry tank it would stay 0;
    # with a clip of about 1 cm the loop restarts (gouta2015 notes H3).
    return tuple(clipped_sqrt(h, lower) for h in levels)


def decouple(c, s3, s4, v1, v2, scale=1.0):
    """Return b^-1 (v - g) for accelerations scale * v, division-free (gouta2015 eqs. 28, 48)."""
    # u1 = [sqrt(h3) (c6 v1 - c3 v2)/alpha + c7 sqrt(h3)] / c8, u2 likewise
    # b is not formed: its entries grow as 1/sqrt(h) while its inverse stays finite.
    a8, a10 = c.alpha * c.c8, c.alpha * c.c10
    u1 = s3 * ((c.c7 / c.c8 + (scale * c.c6 / a8) * v1) - (scale * c.c3 / a8) * v2)
    u2 = s4 * ((c.c9 / c.c10 - (scale * c.c5 / a10) * v1) + (scale * c.c2 / a10) * v2)
    return u1, u2


def less_upper(c, u, d):
    """Return the voltages (u1, u2) less the effect of the upper tanks' disturbances."""
    # h3' = -c7 sqrt(h3) + c8 u1 + d3, so that u1 - d3/c8 has the effect that u1 was meant to have;
    # u2 likewise
    return u[0] - d[2] / c.c8, u[1] - d[3] / c.c10


def input_metric(c, s3, s4):
    """Return (g11, g12, g22) of G = b'b (gouta2015 eq. 26; gouta2015 notes S4.5)."""
    # b = B/2 diag(1/sqrt(h3), 1/sqrt(h4)) diag(c8, c10)
    p, q = 0.5 * c.c8 / s3, 0.5 * c.c10 / s4
    g11 = p * p * (c.c2**2 + c.c5**2)
    return g11, p * q * (c.c2 * c.c3 + c.c5 * c.c6), q * q * (c.c3**2 + c.c6**2)


def check_state_coupled(model, reference):
    """Check the model and the reference of a controller of gouta2015."""
    check_inverted(model)
    shape = model.links, model.feeds, model.outputs
    if shape != (STATE_COUPLED_LINKS, STATE_COUPLED_FEEDS, (0, 1)):
        raise InputError(
            "controller.model must be a state-coupled four-tank (plants.state_coupled_four_tank):"
            " this controller inverts it"
        )
    s31, s32, s41, s42 = (float(s) for s in model.orifice)
    if not abs(s31 * s42 - s41 * s32) > 1e-9 * (s31 * s42 + s41 * s32):  # alpha without the areas
        raise InputError(
            f"controller.model.orifice = {np.asarray(model.orifice)} cm^2: both upper tanks"
            " feed the lower ones in the same proportion, so the outputs cannot be decoupled"
        )
    for field in {Ramps: ("initial", "targets"), Constant: ("level",)}.get(type(reference), ()):
        for i, level in enumerate(np.asarray(getattr(reference, field), dtype=float)):
            if not level > 0:
                raise InputError(
                    f"reference.{field}[{i}] = {level:g} cm: must be above 0 cm (the controller"
                    " computes its square root)"
                )
