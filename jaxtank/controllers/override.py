"""Override control: a level PI and a limit PI select one input by the lower or the higher."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from jaxtank.controllers.cascade import loop_on
from jaxtank.controllers.pid import PID
from jaxtank.core.errors import InputError
from jaxtank.core.records import Estimate, Tick
from jaxtank.core.tree import POSITIVE, component, leaf, static
from jaxtank.core.vectors import each


class Memory(NamedTuple):
    """State of the two loops, and what each asks for."""

    main: Any
    limiting: Any
    asked: Any  # inputs of the main loops
    override: Any  # inputs of the loops on the limits


@component
class Override(PID):
    """A PI(D) per output, which a second PI on the limit of a level takes over from:

        u = min(v, w),    w = bias + limit_Kc (limit - y2) + I2        (select = "low"; or max)

    (Smith and Corripio, Principles and Practice of Automatic Process Control, 2006, ch. 11.) The
    limit of output i is that of tank i of `limited`: a pump between two tanks fills one to its
    setpoint until the other is nearly empty. The gains of v are those of `PID`. Both loops have
    external reset: their integrals follow what is applied (with limit_Ti, and Tt or Ti of the main
    one), so that the loop that is not selected does not wind up.

    Examples
    --------
    >>> from jaxtank.plants import network
    >>> tanks = network(
    ...     area=1.0, drain=[0.0] * 2, pump_gain=1.0, feeds=[(1, None)], sources=[0], rim=9.0
    ... )
    >>> pump = Override(
    ...     model=tanks, Kc=[2.0], bias=[1.0], limited=(0,), limit=[0.5], limit_Kc=[-4.0]
    ... )
    >>> tick = Tick(t=0.0, r=(3.0,), dr=(0.0,), ddr=(0.0,), dt=0.1)
    >>> (u,), _ = pump.step(pump.init((0.6, 2.0), (0.0,)), tick, Estimate(x=(0.6, 2.0)))
    >>> round(float(u), 6)  # the lower of 1 + 2 (3 - 2) and 1 - 4 (0.5 - 0.6)
    1.4
    """

    limited: tuple = static("-", "the tank whose level is limited, of the input of each output")
    limit: np.ndarray = leaf("cm", "level that the second loop keeps", shape="output")
    limit_Kc: np.ndarray = leaf(
        "V/cm", "gain of the loop on the limit; below 0 where the input lowers it", shape="output"
    )
    limit_Ti: np.ndarray | None = leaf(
        "s",
        "integral time of the loop on the limit; left out: none",
        **POSITIVE,
        like="limit_Kc",
        default=None,
        shape="output",
    )
    select: str = static(
        "-", "which of the two inputs is applied", choices=("low", "high"), default="low"
    )

    @property
    def limiting_loop(self) -> PID:
        """The loops on the limits as a PI."""
        return loop_on(self.limited, Kc=self.limit_Kc, Ti=self.limit_Ti, bias=self.bias)

    def init(self, x0: tuple, u0: tuple) -> Any:
        zero = tuple(0.0 * u for u in u0)
        return Memory(PID.init(self, x0, u0), self.limiting_loop.init(x0, u0), zero, zero)

    def step(self, state: Any, tick: Tick, estimate: Estimate) -> tuple[Sequence, Any]:
        asked, main = PID.step(self, state.main, tick, estimate)
        limit = tuple(self.limit[i] for i in range(len(self.limited)))
        at_limit = tick._replace(r=limit, inflow=())
        override, limiting = self.limiting_loop.step(state.limiting, at_limit, estimate)
        selected = each(jnp.minimum if self.select == "low" else jnp.maximum, asked, override)
        return selected, Memory(main, limiting, asked, override)

    def track(self, state: Any, tick: Tick, command: Sequence, applied: Sequence) -> Any:
        main = PID.track(self, state.main, tick, state.asked, applied)
        limiting = self.limiting_loop.track(state.limiting, tick, state.override, applied)
        return state._replace(main=main, limiting=limiting)

    def transfer(self, state: Any, tick: Tick, command: Sequence, applied: Sequence) -> Any:
        main = PID.transfer(self, state.main, tick, state.asked, applied)
        limiting = self.limiting_loop.transfer(state.limiting, tick, state.override, applied)
        return state._replace(main=main, limiting=limiting)

    @property
    def bumpless(self) -> bool:
        return super().bumpless and self.limiting_loop.bumpless

    def level_limits(self) -> list[tuple[int, float, float]]:
        rows = zip(self.limited, np.asarray(self.limit), np.asarray(self.limit_Kc))
        is_upper = lambda gain: (gain > 0.0) == (self.select == "low")
        return [
            (i, -np.inf, float(v)) if is_upper(gain) else (i, float(v), np.inf)
            for i, v, gain in rows
        ]

    def check_gains(self) -> None:
        PID.check_gains(self)
        outputs = self.model.outputs
        if len(self.limited) != len(outputs):
            raise InputError(
                f"controller.limited: must have a tank for each of {len(outputs)} outputs, not"
                f" {len(self.limited)}"
            )
        if isinstance(self.limit_Kc, np.ndarray) and not np.all(self.limit_Kc):
            raise InputError(f"controller.limit_Kc = {self.limit_Kc}: must not be 0")
        if self.Ti is not None and self.anti_windup == "clamping":
            raise InputError(
                'controller.anti_windup = "clamping": does not see that the other loop is selected;'
                ' write "conditioned" or "back-calculation"'
            )
