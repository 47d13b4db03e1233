"""What every law is to the loop."""

import abc
from collections.abc import Sequence
from typing import Any

from jaxtank.core.clock import Clock, pointwise
from jaxtank.core.records import Estimate, Tick
from jaxtank.instruments.base import Actuator
from jaxtank.signals.base import Signal


class Controller(abc.ABC):
    """A sampled law. It holds its own model of the plant: what it believes and what is true are
    different leaves.
    """

    @pointwise
    def prepare(self, r: tuple[Any, ...], dr: tuple[Any, ...], ddr: tuple[Any, ...]) -> Any:
        """What the law can compute of the reference before the loop starts: any tree of arrays
        (samples,), given back at each sample
        as `tick.plan`. r, dr, ddr: tuples of arrays (samples,), one per output [cm, cm/s, cm/s^2].
        """
        return ()

    @pointwise
    def inputs(self, clock: Clock) -> Any:
        """Signals of the law's own, sampled on `clock` before the loop starts: any tree of arrays
        (samples,), given back at each sample as `tick.own`. For a law that plays something back
        (`OpenLoop`).
        """
        return ()

    def init(self, x0: tuple[Any, ...], u0: tuple[Any, ...]) -> Any:
        """State before the first sample, for levels x0 (n) [cm] and pumps that ran at u0 (m) [V]
        until t = 0.
        """
        return ()

    @abc.abstractmethod
    def step(self, state: Any, tick: Tick, estimate: Estimate) -> tuple[Sequence[Any], Any]:
        """((m) commanded voltages [V], new state) at `tick` for `estimate`; the command is not
        limited here.

        Coefficients and gains may be computed here from leaves, with jnp.linalg too: what does not
        depend on state or estimate is moved in front of the loop.
        """

    def track(self, state: Any, tick: Tick, command: Sequence[Any], applied: Sequence[Any]) -> Any:
        """State after the pumps' limits have made `applied` (m) [V] of `command` (m) [V]:
        anti-windup of laws with memory.
        """
        return state

    def input_metric(self, estimate: Estimate) -> tuple[Any, ...] | None:
        """(g11, g12, g22): how the law's cost weighs a change of its two inputs, for allocation by
        box QP; None if it has none.
        """
        return None

    @property
    def allocates(self) -> bool:
        """True if the law has an `input_metric`, so that its inputs can be allocated by box QP."""
        return type(self).input_metric is not Controller.input_metric

    @property
    def reads_model(self) -> bool:
        """True if the inputs depend on the coefficients of the law's own model."""
        return True

    def check_pumps(self, actuator: Actuator) -> None:  # noqa: B027
        """Raise InputError for pumps whose limits, or whose input before t = 0, the law cannot work
        with.
        """

    def check(self, reference: Signal) -> None:  # noqa: B027  (there may be nothing to check)
        """Raise InputError if the law cannot serve this reference, or its model is not of the kind
        it inverts.
        """
