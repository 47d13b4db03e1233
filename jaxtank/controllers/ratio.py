"""Ratio control: inputs that follow another input or a measured inflow, or stand still."""

from typing import Any

import numpy as np

from jaxtank.controllers.pid import PID, SharedPID
from jaxtank.core.errors import InputError
from jaxtank.core.labels import name_of
from jaxtank.core.numerics import clip
from jaxtank.core.tree import component, leaf, static


@component
class Ratio(SharedPID):
    """A PID per output on its input `lead`, and inputs that follow in a ratio:

        u_j = ratio_j u_i    of the input i = follow_j, within its limits,
        u_j = inflow_ratio_j q_k    of the measured inflow q of the tank k = follow_inflow_j

    (Seborg et al., Process Dynamics and Control, 2016, ch. 15), so that streams are blended. The
    inputs that do not lead follow in their order: first those of `follow`, then those of
    `follow_inflow`. Where none follows, those that do not lead keep their inputs `held`: a manual
    valve, a pump that runs all day.

    Examples
    --------
    >>> from jaxtank.core.records import Estimate, Tick
    >>> from jaxtank.plants import network
    >>> tank = network(
    ...     area=1.0, drain=0.0, pump_gain=[1.0, 1.0], feeds=[(0, None)] * 2, outputs=(0,), rim=9.0
    ... )
    >>> blend = Ratio(
    ...     model=tank, Kc=[2.0], bias=[1.0], low=[0, 0], high=[5, 5], follow=(0,), ratio=[0.25]
    ... )
    >>> tick = Tick(t=0.0, r=(3.0,), dr=(0.0,), ddr=(0.0,), dt=0.1)
    >>> u, _ = blend.step(blend.init((2.5,), (0.0, 0.0)), tick, Estimate(x=(2.5,)))
    >>> [float(v) for v in u]
    [2.0, 0.5]
    """

    low: np.ndarray = leaf("V", "lower limit of each input", shape="pump")
    high: np.ndarray = leaf("V", "upper limit of each input", shape="pump")
    lead: tuple = static("-", "the input of each output; left out: the first ones", default=())
    held: np.ndarray | None = leaf(
        "V",
        "inputs of those that neither lead nor follow; left out: their `initial`",
        like="low",
        default=None,
        shape="pump",
    )
    follow: tuple = static("-", "the input that each of the next inputs follows", default=())
    ratio: np.ndarray | None = leaf(
        "-", "ratio to the input that is followed", default=None, shape="follower", like="Kc"
    )
    follow_inflow: tuple = static(
        "-", "the tank whose inflow each of the last inputs follows", default=()
    )
    inflow_ratio: np.ndarray | None = leaf(
        "V s/cm^3",
        "ratio to the inflow that is followed",
        default=None,
        shape="inflow follower",
        like="Kc",
    )

    def __post_init__(self) -> None:
        PID.__post_init__(self)
        if not self.lead:
            object.__setattr__(self, "lead", tuple(range(len(self.model.outputs))))

    @property
    def reads_inflow(self) -> bool:
        return bool(self.follow_inflow) or self.inflow_gain is not None

    def inputs_of(self, output: int) -> tuple[int, ...]:
        lead = self.lead[output]
        return (lead, *(j for j, i in zip(self._followers(), self.follow) if i == lead))

    def _followers(self) -> list[int]:
        return [j for j in range(self.model.pumps) if j not in self.lead]

    @property
    def by_hand(self) -> list[int]:
        """Inputs that stay as `held` has them."""
        followers = self._followers()
        return followers[len(self.follow) + len(self.follow_inflow) :]

    def shared(self, v: Any, inflow: Any = ()) -> tuple[Any, ...]:
        held: Any = self.held
        inputs: list[Any] = [0.0 if held is None else held[j] for j in range(self.model.pumps)]
        for i, command in zip(self.lead, v):
            inputs[i] = command
        ratio: Any = self.ratio
        for k, (j, i) in enumerate(zip(self._followers(), self.follow)):
            inputs[j] = ratio[k] * clip(inputs[i], self.low[i], self.high[i])
        ratio, last = self.inflow_ratio, self._followers()[len(self.follow) :]
        for k, (j, tank) in enumerate(zip(last, self.follow_inflow)):
            inputs[j] = ratio[k] * inflow[tank] if len(inflow) else 0.0 * v[0]
        return tuple(inputs)

    def total(self, u: Any) -> tuple[Any, ...]:
        return tuple(u[i] for i in self.lead)

    def check_inputs(self) -> None:
        outputs, pumps = len(self.model.outputs), self.model.pumps
        if len(self.lead) != outputs or len(set(self.lead)) < outputs:
            raise InputError(
                f"controller.lead: must be {outputs} different inputs, one for each output"
            )
        following = len(self.follow) + len(self.follow_inflow)
        if following not in (0, pumps - outputs):
            raise InputError(
                f"controller.follow, controller.follow_inflow: must have an entry for each of the"
                f" {pumps - outputs} inputs that do not lead, or for none of them, not {following}"
            )
        if not set(self.follow) <= set(self.lead):
            label = lambda j: f'"{of}"' if (of := name_of(self.model, "pump", j)) else f"{j + 1}"
            followers = ", ".join(label(j) for j in self._followers()[: len(self.follow)])
            example = ", ".join([label(self.lead[0])] * len(self.follow))
            raise InputError(
                f"controller.follow = [{', '.join(map(label, self.follow))}]: must name, for each"
                f" input that does not lead ({followers}), the one of controller.lead"
                f" ({', '.join(map(label, self.lead))}) that it follows, as follow = [{example}]"
            )
        for name, entries in (("ratio", self.follow), ("inflow_ratio", self.follow_inflow)):
            value = getattr(self, name)
            if (len(entries),) != (np.shape(value) if value is not None else (0,)):
                raise InputError(
                    f"controller.{name}: must have {len(entries)} numbers, one for each input that"
                    " follows"
                )
        if self.feed_forward:
            raise InputError("controller.feed_forward: is of PID alone; leave it out of a ratio")
