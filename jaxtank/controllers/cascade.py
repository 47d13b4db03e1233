"""Cascade control: a level PI(D) gives the setpoint of an inner loop, a level or a flow."""

import functools
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from jaxtank.controllers.pid import PID, option
from jaxtank.core.errors import InputError
from jaxtank.core.numerics import clip
from jaxtank.core.records import Estimate, Tick
from jaxtank.core.tree import POSITIVE, component, leaf, static
from jaxtank.core.vectors import each
from jaxtank.plants.base import Plant
from jaxtank.plants.tank_network import TankNetwork

inner_option = functools.partial(leaf, like="inner_Kc", default=None, shape="output")
"""A leaf of the inner loops that may be left out."""


class Outputs(NamedTuple):
    """The entries that an inner loop reads, as the model of its PI."""

    outputs: tuple[int, ...]


def loop_on(entries: Sequence[int], **gains: Any) -> PID:
    """Return a PI on given entries of the levels (or flows), conditioned by what is applied."""
    model: Any = Outputs(tuple(entries))
    return PID(model=model, anti_windup="conditioned", **gains)


class Memory(NamedTuple):
    """State of a cascade."""

    outer: Any
    inner: Any
    asked: Any  # the setpoints that the outer loops ask for
    setpoint: Any  # these setpoints within their limits


@component
class Cascade(PID):
    """A level PI(D) per output whose output is the setpoint s of the level y2 of another tank,
    which a PI moves by the input:

        s = bias + Kc (r - y) + I,    u = inner_bias + inner_Kc (s - y2) + I2

    (Seborg et al., Process Dynamics and Control, 2016, ch. 16; the outer gains and options are
    those of `PID`). Output i has tank i of `inner` and input i. Both loops have integral action
    where Ti and inner_Ti are given. The inner loop is conditioned by what its input applies (Hanus
    1987), and the anti-windup of the outer one acts on the setpoint that would have given this
    input,

        s + (u applied - u)/inner_Kc,

    within `inner_low` and `inner_high`, so that neither winds up while the input is at a limit.

    Examples
    --------
    >>> from jaxtank.plants.rigs import coupled_tanks
    >>> rig = coupled_tanks(
    ...     area=225.0, drain=0.8, pipe=0.9, pump_gain=35.0, rim=30.0, outputs=(1,), feeds=(0,)
    ... )
    >>> controller = Cascade(
    ...     model=rig, Kc=[2.0], bias=[9.0], inner=(0,), inner_Kc=[3.0], inner_bias=[5.0]
    ... )
    >>> tick = Tick(t=0.0, r=(8.0,), dr=(0.0,), ddr=(0.0,), dt=0.1)
    >>> (u,), _ = controller.step(controller.init((9.5, 7.5), (5.0,)), tick, Estimate(x=(9.5, 7.5)))
    >>> float(u)  # 5 V + 3 V/cm (s - 9.5 cm), with s = 9 cm + 2 (8 cm - 7.5 cm)
    6.5
    """

    model: Plant
    Kc: np.ndarray = leaf("-", "gain of the outer loop, not 0: setpoint by level", shape="output")
    bias: np.ndarray = leaf("cm", "setpoint of the inner level at zero error", shape="output")
    inflow_gain: np.ndarray | None = option(
        "s/cm^2",
        "setpoint added for a unit of the measured inflow; left out: no inflow is measured",
    )
    inner: tuple = static("-", "the tank whose level is the inner one, of each output")
    inner_Kc: np.ndarray = leaf(
        "V/cm", "gain of the inner loop, not 0; below 0 where the input lowers it", shape="output"
    )
    inner_bias: np.ndarray = leaf("V", "input at zero error of the inner loop", shape="output")
    inner_Ti: np.ndarray | None = inner_option(
        "s", "integral time of the inner loop; left out: none", **POSITIVE
    )
    inner_low: np.ndarray | None = inner_option("cm", "least inner setpoint")
    inner_high: np.ndarray | None = inner_option("cm", "largest inner setpoint")

    def inner_entries(self) -> tuple[int, ...]:
        """The places of the inner loops' readings."""
        return self.inner

    def inner_readings(self, tick: Tick, estimate: Estimate) -> Estimate:
        """What the inner loops read from."""
        return estimate

    @property
    def inner_loop(self) -> PID:
        """The inner loops as a PI."""
        gains = {"Kc": self.inner_Kc, "Ti": self.inner_Ti, "bias": self.inner_bias}
        return loop_on(self.inner_entries(), **gains)

    def init(self, x0: tuple, u0: tuple) -> Any:
        zero = tuple(0.0 * u for u in u0)
        return Memory(PID.init(self, x0, u0), self.inner_loop.init(x0, u0), zero, zero)

    def step(self, state: Any, tick: Tick, estimate: Estimate) -> tuple[Sequence, Any]:
        asked, outer = PID.step(self, state.outer, tick, estimate)
        setpoint = self._within(asked)
        readings = self.inner_readings(tick, estimate)
        at_inner = tick._replace(r=setpoint, inflow=())
        command, inner = self.inner_loop.step(state.inner, at_inner, readings)
        return command, Memory(outer, inner, asked, setpoint)

    def track(self, state: Any, tick: Tick, command: Sequence, applied: Sequence) -> Any:
        inner = self.inner_loop.track(state.inner, tick, command, applied)
        moved = lambda s, v, u, k: s + (u - v) / k
        reached = self._within(each(moved, state.setpoint, command, applied, self.inner_Kc))
        outer = PID.track(self, state.outer, tick, state.asked, reached)
        return state._replace(outer=outer, inner=inner)

    def transfer(self, state: Any, tick: Tick, command: Sequence, applied: Sequence) -> Any:
        # the outer loop follows the inner level, so that the inner loop begins without an error
        follows: Any = lambda s, e, v, u, k: s - e
        if self.inner_Ti is None:
            follows = lambda s, e, v, u, k: s + (u - v) / k
        s, k = state.setpoint, self.inner_Kc
        if self.Ti is not None:
            s = self._within(each(follows, s, state.inner.error, command, applied, k))
        moved = each(lambda v, a, b, k: v + k * (a - b), command, s, state.setpoint, k)
        inner = self.inner_loop.transfer(state.inner, tick, moved, applied)
        outer = PID.transfer(self, state.outer, tick, state.asked, s)
        return state._replace(outer=outer, inner=inner)

    @property
    def bumpless(self) -> bool:
        return self.inner_loop.bumpless or super().bumpless

    def _inner_ends(self) -> tuple[Any, Any]:
        """(least, largest) inner setpoints of all outputs."""
        none = np.full(len(self.model.outputs), np.inf)
        low, high = self.inner_low, self.inner_high
        return -none if low is None else low, none if high is None else high

    def _within(self, setpoint: Any) -> Any:
        """Setpoints within their limits."""
        if self.inner_low is None and self.inner_high is None:
            return setpoint
        return each(clip, setpoint, *self._inner_ends())

    def level_limits(self) -> list[tuple[int, float, float]]:
        ends = zip(self.inner, *map(np.asarray, self._inner_ends()))
        return [(tank, float(least), float(most)) for tank, least, most in ends]

    def check_gains(self) -> None:
        PID.check_gains(self)
        if isinstance(self.inner_Kc, np.ndarray) and not np.all(self.inner_Kc):
            raise InputError(f"controller.inner_Kc = {self.inner_Kc}: must not be 0")
        if self.feed_forward:
            raise InputError("controller.feed_forward: is of PID alone; leave it out of a cascade")
        low, high = self.inner_low, self.inner_high
        if low is not None and high is not None and np.any(np.asarray(low) >= np.asarray(high)):
            raise InputError("controller.inner_high: must be above controller.inner_low")
        self._check_inner()

    def _check_inner(self) -> None:
        outputs = self.model.outputs
        if len(self.inner) != len(outputs) or set(self.inner) & set(outputs):
            raise InputError(
                f"controller.inner: must have a tank for each of {len(outputs)} outputs, whose"
                " level is not controlled itself; without such a tank write kind ="
                ' "flow-cascade" or "pi"'
            )


@component
class FlowCascade(Cascade):
    """A level PI(D) per output whose output is the setpoint of the flow q that its input moves:

        s = bias + Kc (r - y) + I,    u = inner_bias + inner_Kc (s - q) + I2

    with q [cm^3/s] the flow of the pump or valve of the output as a flow meter without noise shows
    it, after dead time and lag of the actuator. As `Cascade` otherwise; levels alone tell the
    controller nothing of q, so that `export`, whose code reads levels, refuses it.

    Examples
    --------
    >>> from jaxtank.plants import network
    >>> tank = network(area=100.0, drain=0.0, pump_gain=20.0, feeds=[(0, None)], rim=9.0)
    >>> controller = FlowCascade(
    ...     model=tank, Kc=[5.0], bias=[40.0], inner_Kc=[0.02], inner_Ti=[2.0], inner_bias=[2.0]
    ... )
    >>> tick = Tick(t=0.0, r=(8.0,), dr=(0.0,), ddr=(0.0,), dt=0.1, flow=(40.0,))
    >>> (u,), _ = controller.step(controller.init((6.0,), (2.0,)), tick, Estimate(x=(6.0,)))
    >>> round(float(u), 9)  # 2 V + 0.02 V s/cm^3 (s - q), with s = q + 5 cm^2/s (8 cm - 6 cm)
    2.2
    """

    reads_flow = True
    Kc: np.ndarray = leaf("cm^2/s", "gain of the outer loop, not 0: flow by level", shape="output")
    bias: np.ndarray = leaf("cm^3/s", "setpoint of the flow at zero error", shape="output")
    inflow_gain: np.ndarray | None = option(
        "-", "share of the measured inflow added to the setpoint; left out: no inflow is measured"
    )
    inner: tuple = static("-", "not in use: the flow is that of the output's input", default=())
    inner_Kc: np.ndarray = leaf("V s/cm^3", "gain of the flow loop, not 0", shape="output")
    inner_low: np.ndarray | None = inner_option("cm^3/s", "least setpoint of the flow")
    inner_high: np.ndarray | None = inner_option("cm^3/s", "largest setpoint of the flow")

    def flow_limits(self) -> list[tuple[float, float]]:
        """Return [(least, largest flow [cm^3/s])] that the outer loop asks of each input."""
        low, high = map(np.asarray, self._inner_ends())
        return [(float(least), float(most)) for least, most in zip(low, high)]

    def inner_entries(self) -> tuple[int, ...]:
        return tuple(range(len(self.model.outputs)))

    def inner_readings(self, tick: Tick, estimate: Estimate) -> Estimate:
        return Estimate(x=tick.flow)

    def _check_inner(self) -> None:
        if self.inner:
            raise InputError('controller.inner: is of kind = "cascade"; leave it out')
        if not isinstance(self.model, TankNetwork):
            raise InputError(
                f"controller: flow-cascade needs the pumps and valves of a TankNetwork, and not a"
                f" {type(self.model).__name__}"
            )
