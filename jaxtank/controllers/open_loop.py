"""No feedback: inputs played back."""

from collections.abc import Sequence
from typing import Any

from jaxtank.controllers.base import Controller
from jaxtank.core.clock import Clock, pointwise
from jaxtank.core.records import Estimate, Tick
from jaxtank.core.tree import component
from jaxtank.signals.base import Signal


@component
class OpenLoop(Controller):
    """u(t_k) = s(t_k): the inputs are those of a signal, whatever the levels do (a recorded
    experiment, a constant flow).

    signal: one channel per pump, in the unit of the pumps' input; the signal's units are read as
        the input's.
    """

    signal: Signal

    @pointwise
    def inputs(self, clock: Clock) -> Any:
        return self.signal.sample(clock)[0]

    def step(self, state: Any, tick: Tick, estimate: Estimate) -> tuple[Sequence, Any]:
        return tick.own, state
