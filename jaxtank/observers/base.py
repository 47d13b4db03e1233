"""What every observer is to the loop, and the shortest one."""

import abc
from collections.abc import Sequence
from typing import Any

from jaxtank.core.records import Estimate, Tick
from jaxtank.core.tree import component
from jaxtank.plants.base import Plant


class Observer(abc.ABC):
    """Turns measurements into an estimate: corrected by what is measured, carried on by what is
    applied. State is handed in and out.
    """

    def init(self, x0: tuple[Any, ...]) -> Any:
        """State before the first sample, for levels x0 (n) [cm] at t = 0."""
        return ()

    @abc.abstractmethod
    def step(self, state: Any, tick: Tick, y: Sequence[Any]) -> tuple[Estimate, Any]:
        """(Estimate, new state) for measured levels y (n) [cm] at `tick`."""

    def predict(
        self, state: Any, tick: Tick, command: Sequence[Any], applied: Sequence[Any]
    ) -> Any:
        """State at the next sample, for the law's command (m) and what the pumps were told after
        their limits, `applied` (m) [V].

        `applied` is known to the computer; dead zone, lag and delay of the pumps are not in it.
        """
        return state

    def check(self, plant: Plant) -> None:  # noqa: B027  (there may be nothing to check)
        """Raise InputError if the observer does not fit this plant."""


@component
class Direct(Observer):
    """All levels are measured and taken as they are: x_hat = y (gouta2015, Fig. 3 and 4)."""

    def step(self, state: Any, tick: Tick, y: Sequence[Any]) -> tuple[Estimate, Any]:
        return Estimate(x=y), state
