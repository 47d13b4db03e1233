"""Nonlinear generalised predictive control (gouta2015, sec. 3)."""

from collections.abc import Sequence
from typing import Any

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
from jaxtank.core.tree import POSITIVE, component, leaf
from jaxtank.plants.base import Plant
from jaxtank.signals.base import Signal


@component
class NGPC(Controller):
    """Closed-form predictive controller of gouta2015, eq. (28), for the state-coupled four-tank.

        v_i = r''_i - K1 e_i - K2 e'_i + c_i z'_i / (2 sqrt(h_i)),   e = h - r,  K1 = 10/(3 Tp^2),
        K2 = 5/(2 Tp)

    with h, r [cm], K1 [1/s^2], K2 [1/s], v [cm/s^2], followed by the inversion of
    `feedback_linearisation.decouple`. z'_i is the level rate the model predicts
    (no differentiation). Without saturation the loop is exactly e'' + K2 e' + K1 e = 0: damping
    0.685, natural frequency 1.826/Tp.

    With an observer that estimates disturbances d of the level rates [cm/s], the model is f + d:
    z'_i has d_i in it, and the disturbances of the upper tanks, which enter where the pumps do, are
    subtracted from the demanded voltages, u1 - d_3/c8 (the composite control of gouta2022, sec. 4,
    for this rig; d' is taken as 0). At a steady state z'_i is then the plant's own rate, 0, and so
    is e_i.

    Examples
    --------
    At the steady state the voltages are those that hold the levels:

    >>> from jaxtank.plants.rigs import state_coupled_four_tank
    >>> controller = NGPC(model=state_coupled_four_tank(21.213), Tp=11.0, level_floor=0.01)
    >>> tick = Tick(t=0.0, r=(9.0, 9.0), dr=(0.0, 0.0), ddr=(0.0, 0.0))
    >>> upper = 9.0 * (0.48**2 / (0.38**2 + 0.31**2)) ** 2
    >>> (u1, u2), _ = controller.step((), tick, Estimate(x=(9.0, 9.0, upper, upper)))
    >>> round(float(u1), 2), round(float(u2), 2)
    (3.13, 3.13)
    """

    model: Plant
    Tp: float = leaf("s", "prediction horizon Tp", **POSITIVE)
    level_floor: float = leaf("cm", "lower clip of the levels in the roots", **POSITIVE)

    def step(self, state: Any, tick: Tick, estimate: Estimate) -> tuple[Sequence, Any]:
        c = coefficients(self.model)
        (h1, h2, _, _), (r1, r2) = estimate.x, tick.r
        s1, s2, s3, s4 = clipped_roots(estimate.x, self.level_floor)
        k1, k2 = (10.0 / 3.0) / (self.Tp * self.Tp), 2.5 / self.Tp  # K1 [1/s^2], K2 [1/s]
        z1 = c.c2 * s3 + c.c3 * s4 - c.c1 * s1  # modelled h1' [cm/s]
        z2 = c.c5 * s3 + c.c6 * s4 - c.c4 * s2  # modelled h2'
        if estimate.d:
            z1, z2 = z1 + estimate.d[0], z2 + estimate.d[1]
        v1 = tick.ddr[0] - k1 * (h1 - r1) - k2 * (z1 - tick.dr[0]) + 0.5 * c.c1 * z1 / s1
        v2 = tick.ddr[1] - k1 * (h2 - r2) - k2 * (z2 - tick.dr[1]) + 0.5 * c.c4 * z2 / s2
        u = decouple(c, s3, s4, v1, v2)
        return (less_upper(c, u, estimate.d) if estimate.d else u), state

    def input_metric(self, estimate: Estimate) -> tuple | None:
        _, _, s3, s4 = clipped_roots(estimate.x, self.level_floor)
        return input_metric(coefficients(self.model), s3, s4)

    def check(self, reference: Signal) -> None:
        check_state_coupled(self.model, reference)
