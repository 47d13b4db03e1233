"""Interface between an observer and the loop, and the direct observer."""

import abc
from collections.abc import Sequence
from typing import Any

from jaxtank.core.clock import Clock
from jaxtank.core.records import Estimate, Tick
from jaxtank.core.tree import Role, component
from jaxtank.plants.base import Plant


class Observer(Role):
    """Estimator of the levels: corrected by measurements, predicted with the applied inputs.

    Examples
    --------
    >>> Direct().init((9.0, 9.0))  # no state
    ()
    """

    coefficients: tuple[str, ...] = ()
    """Entries of its model that it estimates, such as "drain[0]"."""

    sequential = False  # many runs take less time in sequence than as one batch

    def init(self, x0: tuple[Any, ...]) -> Any:
        """Return the state before the first sample, for levels x0 (n) [cm] at t = 0."""
        return ()

    @abc.abstractmethod
    def step(self, state: Any, tick: Tick, y: Sequence[Any]) -> tuple[Estimate, Any]:
        """Return (Estimate, new state) for measured levels y (n) [cm] at `tick`."""

    def predict(
        self, state: Any, tick: Tick, command: Sequence[Any], applied: Sequence[Any]
    ) -> Any:
        """Return the state at the next sample, for the controller's `command` (m) and that command
        after the pumps' limits, `applied` (m) [V].

        `applied` is known to the computer; dead zone, lag and delay of the pumps are not in it.
        """
        return state

    def settled(self, state: Any, dt: Any, u: Sequence[Any]) -> Any:
        """Return `state` after many samples of dt [s] at its levels with inputs u (m) [V], from
        where a steady state of the loop is searched; unchanged where that does not help.
        """
        return state

    def mode_names(self, plant: Plant) -> tuple[tuple[str, str], ...]:
        """Return (name, unit of its size) of each mode of its estimate; () without."""
        return ()

    def check(self, plant: Plant) -> None:
        """Raise InputError if the observer does not fit this plant."""

    def check_clock(self, clock: Clock) -> None:
        """Raise InputError if the observer cannot work at the sampling period of this clock."""


@component
class Direct(Observer):
    """All levels are measured and taken as they are: x_hat = y [cm] (gouta2015, Fig. 3 and 4).

    Examples
    --------
    >>> tick = Tick(t=0.0, r=(9.0,), dr=(0.0,), ddr=(0.0,))
    >>> Direct().step((), tick, (8.9,))[0].x
    (8.9,)
    """

    arrays = True

    def step(self, state: Any, tick: Tick, y: Sequence[Any]) -> tuple[Estimate, Any]:
        return Estimate(x=y), state
