"""The nonlinear disturbance observer of gouta2022 (sec. 4, eqs. 22-25)."""

from collections.abc import Sequence
from typing import Any

from jaxtank.controllers.feedback_linearisation import authority, check_own_pumps, drift
from jaxtank.core.errors import InputError
from jaxtank.core.records import Estimate, Tick
from jaxtank.core.tree import component, leaf, static
from jaxtank.observers.base import Observer
from jaxtank.plants.base import Plant

FED = ("applied", "command")


@component
class DisturbanceObserver(Observer):
    """Estimate of the rate of each level that the model does not explain, one per tank [cm/s]:

        d^ = z + l h,   z' = -l z - l (l h + f(h) + c2 u)      (gouta2022 eqs. 23-24), so that d^' =
        l (d - d^)

    by forward Euler, carried as d^ and the level that the model expects next (the same numbers as
    with z, and good in float32): d^+ = (1 - l dt) d^ + l (h+ - h - dt (f + c2 u)). All levels are
    measured; x_hat = y.

    u [V] is the command after the pumps' limits: with `fed` = "command", the unlimited command,
    the observer winds up while a pump is saturated (gouta2022 notes S4.2). `before_compensation`
    uses the input before eq. (28) subtracts the estimate again, u + d^/c2, as eq. (23) prints
    it (gouta2022 notes S4.3): the loop is then that of a single compensation with 2 l, and d^ is
    half the disturbance.

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
    l: Any = leaf("1/s", "(n,) gain l of each tank", low=0.0, strict=True)
    fed: str = static("-", "input that the observer uses", choices=FED, default="applied")
    before_compensation: bool = static(
        "-", "as printed: use the input before eq. (28)", choices=(False, True), default=False
    )

    def init(self, x0: tuple) -> Any:
        return tuple(0.0 * h for h in x0), x0

    def step(self, state: Any, tick: Tick, y: Sequence) -> tuple[Estimate, Any]:
        held, expected = state
        d = tuple(held[i] + self.l[i] * (y[i] - expected[i]) for i in range(len(y)))
        return Estimate(x=y, d=d), (d, y)

    def predict(self, state: Any, tick: Tick, command: Sequence, applied: Sequence) -> Any:
        d, y = state
        f, c2 = drift(self.model, y), authority(self.model)
        u = applied if self.fed == "applied" else command
        rate = tuple(
            f[i] + c2[i] * u[i] + (d[i] if self.before_compensation else 0.0) for i in range(len(y))
        )
        held = tuple((1.0 - self.l[i] * tick.dt) * d[i] for i in range(len(y)))
        return held, tuple(y[i] + tick.dt * rate[i] for i in range(len(y)))

    def check(self, plant: Plant) -> None:
        check_own_pumps(self.model)
        if self.model.tanks != plant.tanks:
            raise InputError(
                f"observer.model has {self.model.tanks} tanks, the plant {plant.tanks}"
            )
