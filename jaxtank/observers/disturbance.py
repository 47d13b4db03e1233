"""The nonlinear disturbance observer of gouta2022 (sec. 4, eqs. 22-25), for any rig."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from jaxtank.controllers.feedback_linearisation import check_own_pumps
from jaxtank.core.clock import Clock
from jaxtank.core.errors import InputError
from jaxtank.core.records import Estimate, Tick
from jaxtank.core.tree import POSITIVE, component, leaf, static
from jaxtank.observers.base import Observer
from jaxtank.observers.checks import check_model, check_tanks
from jaxtank.plants.base import Plant
from jaxtank.plants.elements import sections
from jaxtank.plants.runge_kutta import advance, euler

FED = ("applied", "command")


@component
class DisturbanceObserver(Observer):
    """Estimate of the rate of each measured level that the model does not explain [cm/s]:

        d^ = z + l h,   z' = -l z - l (l h + f(h) + g u)      (gouta2022 eqs. 23-24)

    with f + g u the model's level rates. A disturbance d, the inflow that the model lacks over the
    area of its tank, is estimated with d^' = l (d - d^): no rate of a level is measured. It is
    computed by forward Euler, carried as d^ and the level that the model expects next (the same
    numbers as with z, and good in float32),

        d^+ = (1 - l dt) d^ + l (h+ - h - dt (f + g u)),      l dt < 2

    so that a constant d is found without an error of discretisation. u is not what an offset dead
    zone leaves of it: d^ contains what the dead zones withhold, g times their width (gouta2022
    notes S2.3), in addition to the inflow.

    `measured`: tanks whose levels are read; left out, all. For these x_hat = y. The level of any
    other tank is predicted by the model from its level at t = 0, by a step of Runge-Kutta, and its
    d^ is 0: what the model misses there appears in the measured tanks that it feeds. (To estimate
    such a level too: `ExtendedKalman` with `disturbed`.) A rim that is physics in the model is so
    here: an overflow is no disturbance.

    u [V] is the command after the pumps' limits: with `fed` = "command", the unlimited command,
    the observer winds up while a pump is saturated (gouta2022 notes S4.2). `before_compensation`
    uses the input before eq. (28) subtracts the estimate again, u + d^/c2, as eq. (23) prints
    it (gouta2022 notes S4.3): the loop then behaves as with a single compensation with 2 l, and
    d^ is half the disturbance.

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
    >>> observer = DisturbanceObserver(model=rig, l=[2.0, 2.0])
    >>> tick = Tick(t=0.0, r=(8.0, 8.0), dr=(0.0, 0.0), ddr=(0.0, 0.0), dt=0.1)
    >>> estimate, _ = observer.step(observer.init((8.0, 8.0)), tick, (8.1, 8.0))
    >>> [round(float(d), 6) for d in estimate.d]  # l times the innovation
    [0.2, 0.0]
    """

    model: Plant
    l: np.ndarray = leaf(
        "1/s", "gain l of each tank; of unmeasured tanks not used", **POSITIVE, shape="tank"
    )
    fed: str = static("-", "input that the observer uses", choices=FED, default="applied")
    before_compensation: bool = static(
        "-", "as printed: use the input before eq. (28)", choices=(False, True), default=False
    )
    measured: tuple = static(
        doc="tanks whose levels are measured, counted from 0; left out: all", default=()
    )

    def __post_init__(self) -> None:
        if self.measured == ():
            # the tanks themselves, so that loops that mean the same have the same structure
            object.__setattr__(self, "measured", tuple(range(self.model.tanks)))

    def init(self, x0: tuple) -> Any:
        return tuple(0.0 * h for h in x0), x0

    def step(self, state: Any, tick: Tick, y: Sequence) -> tuple[Estimate, Any]:
        disturbance, expected = state
        is_measured = [i in self.measured for i in range(len(disturbance))]
        d = tuple(
            disturbance[i] + self.l[i] * (y[i] - expected[i]) if known else disturbance[i]
            for i, known in enumerate(is_measured)
        )
        x = tuple(y[i] if known else expected[i] for i, known in enumerate(is_measured))
        return Estimate(x=x, d=d), (d, x)

    def predict(self, state: Any, tick: Tick, command: Sequence, applied: Sequence) -> Any:
        d, x = state
        n = range(len(x))
        u = applied if self.fed == "applied" else command
        rate = level_rates(self.model, tick.t, x, u)
        if self.before_compensation:
            rate = tuple(rate[i] + d[i] for i in n)
        expected = euler(self.model, x, rate, tick.dt)
        if len(self.measured) < len(x):
            area = sections(self.model, x)
            inflow = None if area is None else tuple(area[i] * d[i] for i in n)
            moved = advance(self.model, "rk4", tick.t, x, u, inflow, tick.dt, 1).x
            expected = tuple(expected[i] if i in self.measured else moved[i] for i in n)
        d = tuple((1.0 - self.l[i] * tick.dt) * d[i] if i in self.measured else d[i] for i in n)
        return d, expected

    def check(self, plant: Plant) -> None:
        check_model(self, plant)
        check_tanks(self, "measured", plant)
        if self.before_compensation:
            check_own_pumps(self.model, holder="observer")

    def check_clock(self, clock: Clock) -> None:
        for i in self.measured:
            if not float(np.max(self.l[..., i])) * clock.dt < 2.0:
                raise InputError(
                    f"observer.l[{i}] = {np.max(self.l[..., i]):g} 1/s: must be below 2/clock.dt ="
                    f" {2.0 / clock.dt:g} 1/s, where the observer becomes unstable"
                )


def level_rates(model, t, x, u):
    """Return f(h) + g u of every tank: the level rates of the model at time t."""
    shares = getattr(model, "shares", None)
    if shares is None or not model.plain:
        return tuple(model.derivative(t, tuple(x), tuple(u), None))
    rate = list(model.derivative(t, tuple(x), (0.0,) * model.pumps, None))
    for j, tank, gain in shares():
        rate[tank] = rate[tank] + (gain / model.area[tank]) * u[j]
    return tuple(rate)
