"""Backstepping (gouta2015, sec. 4), as printed and with the reference's rates."""

from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp

from jaxtank.controllers.base import Controller
from jaxtank.controllers.feedback_linearisation import (
    check_state_coupled,
    clipped_roots,
    coefficients,
    decouple,
    input_metric,
    less_upper,
)
from jaxtank.core.records import Estimate, Tick
from jaxtank.core.tree import POSITIVE, component, leaf, static
from jaxtank.plants.base import Plant
from jaxtank.signals.base import Signal


@component
class Backstepping(Controller):
    """Backstepping of gouta2015, eqs. (46)-(48), for the state-coupled four-tank.

        v_i = -(k + k1) (z_i - c_i sqrt(r_i) + k1 (h_i - r_i)),     z = inflow of the lower tanks,
        c_i sqrt(r_i): their outflow at r

    followed by the inversion of `feedback_linearisation.decouple`; h, r [cm], v [cm/s^2]. The
    printed control law has no derivatives of the reference and lags behind ramps; with
    `reference_rates` it has the missing terms (gouta2015 notes S4.4; not in the paper):

        v_i = r''_i + c_i r'_i / (2 sqrt(r_i)) - (k + k1) (z_i - c_i sqrt(r_i) - r'_i + k1 (h_i -
        r_i))

    k and k1 enter through k1 and k + k1 only: the loop is insensitive to k where k1 is much larger.

    With an observer that estimates disturbances d of the level rates [cm/s], the plant is taken as

        h_i' = z_i - c_i sqrt(h_i) + d_i,    h_3' = -c7 sqrt(h3) + c8 u1 + d_3,    i = 1, 2

    (not in the paper). First step: with the error e_i = h_i - r_i, r constant, the virtual control
    z_i = c_i sqrt(r_i) - k1 e_i - d_i makes e_i' = c_i (sqrt(r_i) - sqrt(h_i)) - k1 e_i, whatever
    d_i; the second error is therefore Z_i = z_i - c_i sqrt(r_i) + k1 e_i + d_i. Second step: v_i =
    z_i' = -(k + k1) Z_i with this Z_i, as in eq. (46) for d = 0 (d_i' is taken as 0; where d moves,
    it enters as a disturbance of Z_i). d_3 and d_4 act where the pumps do and are subtracted from
    the demanded voltages, u1 - d_3/c8. At a steady state v = 0 and the plant's own h_i' = 0, so
    that c_i (sqrt(h_i) - sqrt(r_i)) + k1 e_i = 0: e = 0 whatever the error of the model, if d^
    accounts for it. With `reference_rates`, h_i' is z_i - c_i sqrt(h_i) + d_i in the same way.

    Examples
    --------
    At the steady state the voltages are those that hold the levels:

    >>> from jaxtank.plants.rigs import state_coupled_four_tank
    >>> controller = Backstepping(
    ...     model=state_coupled_four_tank(21.213), k=0.03, k1=0.088, level_floor=0.01
    ... )
    >>> tick = Tick(t=0.0, r=(9.0, 9.0), dr=(0.0, 0.0), ddr=(0.0, 0.0))
    >>> upper = 9.0 * (0.48**2 / (0.38**2 + 0.31**2)) ** 2
    >>> (u1, u2), _ = controller.step((), tick, Estimate(x=(9.0, 9.0, upper, upper)))
    >>> round(float(u1), 2), round(float(u2), 2)
    (3.13, 3.13)
    """

    model: Plant
    k: float = leaf("1/s", "gain k of the second step", **POSITIVE)
    k1: float = leaf("1/s", "gain k1 of the first step", **POSITIVE)
    level_floor: float = leaf("cm", "lower clip of the levels in the roots", **POSITIVE)
    reference_rates: bool = static(
        "-", "use r' and r'' (backstepping-ff)", choices=(False, True), default=False
    )

    def step(self, state: Any, tick: Tick, estimate: Estimate) -> tuple[Sequence, Any]:
        c = coefficients(self.model)
        (h1, h2, _, _), (r1, r2) = estimate.x, tick.r
        _, _, s3, s4 = clipped_roots(estimate.x, self.level_floor)
        q1, q2 = jnp.sqrt(r1), jnp.sqrt(r2)
        gain = self.k + self.k1
        # residual of the first step [cm/s]; the roots come last, they are the last to be ready
        w1 = (self.k1 * (h1 - r1) - c.c1 * q1) + c.c2 * s3 + c.c3 * s4
        w2 = (self.k1 * (h2 - r2) - c.c4 * q2) + c.c5 * s3 + c.c6 * s4
        if estimate.d:
            w1, w2 = w1 + estimate.d[0], w2 + estimate.d[1]
        if not self.reference_rates:
            u = decouple(c, s3, s4, w1, w2, scale=-gain)
            return (less_upper(c, u, estimate.d) if estimate.d else u), state
        v1 = tick.ddr[0] + 0.5 * c.c1 * tick.dr[0] / q1 - gain * (w1 - tick.dr[0])
        v2 = tick.ddr[1] + 0.5 * c.c4 * tick.dr[1] / q2 - gain * (w2 - tick.dr[1])
        u = decouple(c, s3, s4, v1, v2)
        return (less_upper(c, u, estimate.d) if estimate.d else u), state

    def input_metric(self, estimate: Estimate) -> tuple | None:
        _, _, s3, s4 = clipped_roots(estimate.x, self.level_floor)
        return input_metric(coefficients(self.model), s3, s4)

    def check(self, reference: Signal) -> None:
        check_state_coupled(self.model, reference)
