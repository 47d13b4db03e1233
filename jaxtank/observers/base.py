"""What every observer is to the loop, and the shortest one."""

import abc

from jaxtank.records import Estimate
from jaxtank.tree import component


class Observer(abc.ABC):
    """Turns measurements into an estimate. State is handed in and handed back."""

    def init(self):
        """State before the first sample."""
        return ()

    @abc.abstractmethod
    def step(self, state, tick, y):
        """(Estimate, new state) for measured levels y (n) [cm] at `tick`."""


@component
class Direct(Observer):
    """All levels are measured and taken as they are: x_hat = y (gouta2015, Fig. 3 and 4)."""

    def step(self, state, tick, y):
        return Estimate(x=y), state
