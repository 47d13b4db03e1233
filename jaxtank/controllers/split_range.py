"""Split range: several inputs in sequence for each controlled level."""

from typing import Any

import numpy as np

from jaxtank.controllers.pid import PID, SharedPID
from jaxtank.core.errors import InputError
from jaxtank.core.numerics import lower_clip
from jaxtank.core.tree import POSITIVE, component, leaf, static
from jaxtank.core.vectors import total


@component
class SplitRange(SharedPID):
    """A PID per output whose output v is shared by several inputs, one after the other:

        u_j = low_j + (high_j - low_j) clip((v - start_j)/span_j, 0, 1)

    with start_j the sum of the spans before j. An input in `reverse` runs from high to low. Staged
    pumps are the first over its whole range, then the second; a valve in the outlet, reversed, and
    then a pump in the inlet open one after the other. Anti-windup acts on v, by what the inputs
    within their limits add up to. A `span` that is left out is the range of its input: v is then
    the sum of the inputs above their lower limits.

    Examples
    --------
    >>> from jaxtank.plants import network
    >>> tank = network(
    ...     area=1.0, drain=0.0, pump_gain=[1.0, 1.0], feeds=[(0, None)] * 2, outputs=(0,), rim=9.0
    ... )
    >>> pumps = SplitRange(model=tank, Kc=[1.0], bias=[0.0], low=[0.0, 0.0], high=[5.0, 5.0])
    >>> [float(u) for u in pumps.shared((7.0,))]
    [5.0, 2.0]
    """

    low: np.ndarray = leaf("V", "lower end of each input's range", shape="pump")
    high: np.ndarray = leaf("V", "upper end of each input's range", shape="pump")
    span: np.ndarray | None = leaf(
        "V",
        "what each input takes of the output of its PID; left out: its range",
        **POSITIVE,
        like="low",
        default=None,
        shape="pump",
    )
    sequence: tuple = static(
        "-", "the inputs of each output in their sequence; left out: all, of one output", default=()
    )
    reverse: tuple = static("-", "the inputs that run from high to low", default=())

    def __post_init__(self) -> None:
        PID.__post_init__(self)
        if not self.sequence and len(self.model.outputs) == 1:
            object.__setattr__(self, "sequence", (tuple(range(self.model.pumps)),))

    def inputs_of(self, output: int) -> tuple[int, ...]:
        return self.sequence[output]

    @property
    def reversed_inputs(self) -> tuple[int, ...]:
        return self.reverse

    def _spans(self) -> Any:
        ranges = tuple(high - low for low, high in zip(self.low, self.high))
        return ranges if self.span is None else self.span

    def shared(self, v: Any, inflow: Any = ()) -> tuple[Any, ...]:
        """Return the inputs (m,) of PID outputs v (outputs,): the first and the last of a sequence
        go on beyond their ranges, so that `total` is v. Inflows are not used.
        """
        spans, inputs = self._spans(), [0.0] * self.model.pumps
        for i, members in enumerate(self.sequence):
            rest = v[i]
            for k, j in enumerate(members):
                part = rest if k == 0 else lower_clip(rest, 0.0)
                if k < len(members) - 1:
                    part = part - lower_clip(part - spans[j], 0.0)
                rest = rest - spans[j]
                if self.span is not None:
                    part = part * ((self.high[j] - self.low[j]) / spans[j])
                inputs[j] = self.high[j] - part if j in self.reverse else self.low[j] + part
        return tuple(inputs)

    def total(self, u: Any) -> tuple[Any, ...]:
        spans = self._spans()

        def part(j: int) -> Any:
            above = self.high[j] - u[j] if j in self.reverse else u[j] - self.low[j]
            return above if self.span is None else above * (spans[j] / (self.high[j] - self.low[j]))

        return tuple(total(tuple(part(j) for j in members)) for members in self.sequence)

    def check_inputs(self) -> None:
        outputs, pumps = len(self.model.outputs), self.model.pumps
        entries = [j for members in self.sequence for j in members]
        if len(self.sequence) != outputs or sorted(entries) != list(range(pumps)):
            raise InputError(
                f"controller.sequence: must have a list for each of {outputs} outputs, and in them"
                f" each of the {pumps} inputs once, as [[1, 2], [3]]"
            )
        if not set(self.reverse) <= set(entries):
            raise InputError(f"controller.reverse: must be inputs, counted from 1 to {pumps}")
        if self.feed_forward:
            raise InputError(
                "controller.feed_forward: its model has one pump per output; leave it out of"
                " split-range"
            )
        if not np.all(np.asarray(self.high) > np.asarray(self.low)):
            raise InputError("controller.high: must be above controller.low")
