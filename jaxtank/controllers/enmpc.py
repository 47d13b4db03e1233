"""Explicit nonlinear predictive control, a pump for each tank (gouta2022, sec. 3 and 4)."""

from collections.abc import Sequence
from typing import Any

from jaxtank.controllers.base import Controller
from jaxtank.controllers.feedback_linearisation import authority, check_own_pumps, drift
from jaxtank.core.records import Estimate, Tick
from jaxtank.core.tree import POSITIVE, component, leaf, static
from jaxtank.plants.base import Plant
from jaxtank.signals.base import Signal

COMPENSATIONS = ("none", "single", "double")
DRIFTS = ("derived", "printed")


@component
class ENMPC(Controller):
    """The minimiser of J = 1/2 int_0^Tp |y - r|^2 with a first-order Taylor prediction (gouta2022
    eqs. 9-12; gouta2022 notes S4.1):

        u_i = -(1/c2) (k e_i + f_i(h) - r'_i + d_i),   e = h - r,  k = 3/(2 Tp)

    with h, r [cm], k [1/s], c2 [cm/(s V)], f and d [cm/s]. Unsaturated and with an exact model the
    loop is e' = -k e. `compensation`: "none" omits d (ENMPC); "single" subtracts the observer's
    estimate once (CHADPC as it must be read, gouta2022 notes S4.3); "double" subtracts it twice, as
    eqs. (27) and (28) do together. An observer that estimates no disturbance leaves all three the
    same. `drift`: "printed" has f with the sign of eqs. (12) and (27),
    which is not the minimiser and leaves an offset 2 f/k (gouta2022 notes E2).

    Examples
    --------
    >>> from jaxtank.plants.rigs import coupled_tanks
    >>> rig = coupled_tanks(
    ...     area=225.0,
    ...     drain=0.0,
    ...     pipe=0.0,
    ...     pump_gain=45.0,
    ...     rim=30.0,
    ...     outputs=(0, 1),
    ...     feeds=(0, 1),
    ... )
    >>> tick = Tick(t=0.0, r=(8.0, 10.0), dr=(0.0, 0.0), ddr=(0.0, 0.0))
    >>> u, _ = ENMPC(model=rig, Tp=1.5).step((), tick, Estimate(x=(7.0, 10.0)))
    >>> [abs(round(float(v), 6)) for v in u]  # k e A/Kp = 1 1/s * 1 cm * 225/45 V s/cm
    [5.0, 0.0]
    """

    model: Plant
    Tp: float = leaf("s", "prediction horizon Tp", **POSITIVE)
    compensation: str = static(
        "-",
        "how often the disturbance estimate is subtracted",
        choices=COMPENSATIONS,
        default="none",
    )
    drift: str = static(
        "-",
        "sign of f in the control law: derived, or as printed",
        choices=DRIFTS,
        default="derived",
    )

    def step(self, state: Any, tick: Tick, estimate: Estimate) -> tuple[Sequence, Any]:
        c2, k = authority(self.model), 1.5 / self.Tp
        f = drift(self.model, estimate.x)
        sign = 1.0 if self.drift == "derived" else -1.0
        times = COMPENSATIONS.index(self.compensation)
        d = estimate.d if times and estimate.d else (0.0,) * len(f)
        e = tuple(estimate.x[i] - r for i, r in zip(self.model.outputs, tick.r))
        asked = lambda i: k * e[i] + sign * f[i] - tick.dr[i] + times * d[i]
        return tuple(-asked(i) / c2[i] for i in range(len(f))), state

    @property
    def ignores_disturbance(self) -> bool:
        return self.compensation == "none"

    def check(self, reference: Signal) -> None:
        check_own_pumps(self.model)
