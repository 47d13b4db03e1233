"""Backstepping of two coupled tanks (calofir), in physical units."""

from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np

from jaxtank.controllers.base import Controller
from jaxtank.core.clock import pointwise
from jaxtank.core.errors import InputError
from jaxtank.core.numerics import clipped_sqrt
from jaxtank.core.records import Estimate, Tick
from jaxtank.core.tree import POSITIVE, component, leaf
from jaxtank.plants.network import TankNetwork
from jaxtank.plants.rigs import COUPLED_PIPES, check_topology
from jaxtank.signals.base import Signal


@component
class TwoTankBackstepping(Controller):
    """Backstepping of calofir, eqs. (16)-(21) with the errata of calofir notes S5, for a pumped
    tank that drains through a second one.

    With h1, h3 the levels of tanks 0 and 1, s = sqrt(h3), Z = sqrt(h1 - h3), e = h3 - h3r and h3r =
    kappa h1r (calofir notes S4.2, where the paper's z0 and Q0 cancel):

        Phi = (b s - K_phi e)/a,   Y = Z - Phi,   a = c1/A, b = c2/A
        Q = 2 A Z [ a - b s/(2 Z) + ((b/(2 s) - K_phi)/a) (a Z - b s) - a e - K_y Y ]

    Without limits the loop is e' = -K_phi e + a Y, Y' = -a e - K_y Y. It is a feedback
    linearisation of h3, of which only K_phi + K_y and K_phi K_y + a^2 matter: the two gains may be
    exchanged. a^2 carries a length, so the same gains are another controller where levels have
    other units. The output h1 follows h3; there is no integral action, and disturbances that an
    observer estimates are not used. Units in this class are the rig's (m, m^3/s).

    Examples
    --------
    >>> from jaxtank import presets
    >>> controller = presets.find("calofir/backstepping").loop.controller
    >>> float(controller.K_phi), float(controller.K_y)
    (0.02, 0.1)
    >>> tick = Tick(t=0.0, r=(0.4,), dr=(0.0,), ddr=(0.0,), plan=controller.prepare((0.4,), (), ()))
    >>> (flow,), _ = controller.step((), tick, Estimate(x=(0.4, tick.plan[0])))
    >>> bool(abs(float(flow) - float(tick.plan[1])) < 1e-8)  # the steady-state flow
    True
    """

    model: TankNetwork
    K_phi: float = leaf("1/s", "gain K_phi of the first step", **POSITIVE)
    K_y: float = leaf("1/s", "gain K_y of the second step", **POSITIVE)
    level_floor: float = leaf("cm", "lower clip of the level h3 in the control law", **POSITIVE)
    difference_floor: float = leaf("cm", "lower clip of h1 - h3 in the control law", **POSITIVE)

    def coefficients(self) -> tuple:
        """Return (a1, a3, b): c1/A of the first and of the second tank, c2/A [cm^0.5/s]; a1 = a3
        = a in the paper, whose tanks are equal.
        """
        w = jnp.sqrt(2.0 * self.model.gravity)
        A1, A3, pipe = self.model.area[0], self.model.area[1], self.model.pipe[0]
        return pipe * w / A1, pipe * w / A3, self.model.drain[1] * w / A3

    @pointwise
    def prepare(self, r: tuple, dr: tuple, ddr: tuple) -> Any:
        """Return (h3r, Q_s) of every sample: the level of the second tank and the flow at the
        steady state h1 = r (calofir notes S2.2) [cm, cm^3/s].
        """
        c1, c2 = self.model.pipe[0], self.model.drain[1]
        h3r = c1**2 / (c1**2 + c2**2) * r[0]  # kappa h1r
        return h3r, c1 * jnp.sqrt(2.0 * self.model.gravity) * jnp.sqrt(r[0] - h3r)

    def step(self, state: Any, tick: Tick, estimate: Estimate) -> tuple[Sequence, Any]:
        a1, a, b = self.coefficients()
        h1, h3 = estimate.x
        e = h3 - tick.plan[0]
        s, Z = clipped_sqrt(h3, self.level_floor), clipped_sqrt(h1 - h3, self.difference_floor)
        Y = Z - (b * s - self.K_phi * e) / a
        inner = ((b / (2.0 * s) - self.K_phi) / a) * (a * Z - b * s) - a * e - self.K_y * Y
        flow = self.model.area[0] * (2.0 * Z * (0.5 * (a1 + a) + inner) - b * s)
        return (flow / self.model.pump_gain[0],), state

    def check(self, reference: Signal) -> None:
        check_topology(
            self.model,
            "two coupled tanks",
            pipes=COUPLED_PIPES,
            feeds=((0, None),),
            links=(),
            outputs=(0,),
        )
        if float(self.model.drain[0]) != 0.0:
            raise InputError(
                f"controller.model.drain[0] = {float(self.model.drain[0]):g}: this controller needs"
                " a first tank that drains only into the second"
            )
        for field in ("initial", "targets", "level"):
            if np.any(np.asarray(getattr(reference, field, 1.0), dtype=float) <= 0.0):
                raise InputError(
                    f"reference.{field}: must be above 0 (the controller computes its square root)"
                )
