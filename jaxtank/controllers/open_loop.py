"""No feedback: a signal gives the inputs."""

from collections.abc import Sequence
from typing import Any

from jaxtank.controllers.base import Controller
from jaxtank.core.clock import Clock, pointwise
from jaxtank.core.records import Estimate, Tick
from jaxtank.core.tree import component
from jaxtank.signals.base import Signal


@component
class OpenLoop(Controller):
    """u(t_k) = s(t_k): a signal gives the inputs, independent of the levels (a recorded
    experiment, a constant flow).

    Nothing that an observer estimates is used.

    signal: one channel per pump, in the unit of the pumps' input (V), whatever the signal's unit.

    Examples
    --------
    >>> from jaxtank.signals.base import Constant
    >>> controller = OpenLoop(signal=Constant(level=[3.0, 2.5]))
    >>> inputs = controller.inputs(Clock(dt=1.0, duration=2.0))
    >>> [float(v[0]) for v in inputs]
    [3.0, 2.5]
    """

    signal: Signal

    @property
    def signal_units(self) -> dict[str, str]:
        """{signal: the unit of what it carries}."""
        return {"signal": "V"}

    @pointwise
    def inputs(self, clock: Clock) -> Any:
        return self.signal.sample(clock)[0]

    def step(self, state: Any, tick: Tick, estimate: Estimate) -> tuple[Sequence, Any]:
        return tick.own, state
