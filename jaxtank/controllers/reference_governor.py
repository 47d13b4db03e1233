"""A PID behind a reference governor: setpoints move only as fast as the limits of levels allow."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from jaxtank.controllers.pid import PID
from jaxtank.core.checks import check_order
from jaxtank.core.clock import INTEGRATORS
from jaxtank.core.errors import InputError
from jaxtank.core.numerics import clip
from jaxtank.core.records import Estimate, Tick
from jaxtank.core.tree import POSITIVE, component, leaf, static
from jaxtank.core.vectors import each, take
from jaxtank.instruments.base import Actuator, Sensor
from jaxtank.instruments.sensors import check_unfiltered
from jaxtank.plants.runge_kutta import predicted

SHARES = np.arange(9) / 8
"""Shares of the way to the setpoint whose responses are predicted side by side [-]."""

ROUNDS = 2
"""Predictions in a sample: of shares of the whole way, then of the part where a limit is met."""


class Memory(NamedTuple):
    """State of the governor and of its PID."""

    main: Any
    setpoint: Any  # governed setpoints v, one per output [cm]
    slack: Any  # how far the least predicted response passes a limit [cm]


def largest_share(shares: Any, excess: Any) -> tuple[Any, Any, Any]:
    """Return (last share that keeps the limits, the next one, where the line between is 0)."""
    # where all or none of the shares keep them, the last, or that of the least excess, three times
    least, smallest = shares[0], excess[0]
    for j in range(1, len(SHARES)):
        least = jnp.where(excess[j] < smallest, shares[j], least)
        smallest = jnp.minimum(smallest, excess[j])
    rest = jnp.where(excess[0] > 0.0, least, shares[-1])
    low, high, share = rest, rest, rest
    for j in reversed(range(len(SHARES) - 1)):  # the first crossing counts
        crosses = (excess[0] <= 0.0) & (excess[j] <= 0.0) & (excess[j + 1] > 0.0)
        rise = jnp.where(crosses, excess[j + 1] - excess[j], 1.0)
        part = jnp.where(crosses, -excess[j], 0.0) / rise
        between = shares[j] + (shares[j + 1] - shares[j]) * part
        low, high = jnp.where(crosses, shares[j], low), jnp.where(crosses, shares[j + 1], high)
        share = jnp.where(crosses, between, share)
    return low, high, share


@component
class ReferenceGovernor(PID):
    """A PID per output whose setpoint v goes towards r by the largest share kappa of the way
    that keeps the predicted levels within their limits:

        v(k) = v(k-1) + kappa (r(k) - v(k-1)),    lowest_i <= h_i(t + j T) <= limit_i,  j = 1 .. N

    (Gilbert, Kolmanovsky and Tan 1995; Garone, Di Cairano and Kolmanovsky, Automatica 75, 2017).
    The prediction is the closed loop of model, PID and input range with the setpoint v held, over
    N samples of T = horizon/N, with the disturbance that the observer estimates. Nine shares are
    predicted, then nine between the last that keeps the limits and the next; kappa is where the
    line between two largest excesses is 0. Where no share keeps them, the one with the least excess
    is taken, and this excess is the measure `limit_slack`. The horizon must reach past the largest
    level of a response: what comes later is not seen. One sample costs 18 N steps of the model.

    At the start v is the level of each output.

    Examples
    --------
    A tank that may rise to 3 m lets a setpoint of 5 m through in part:

    >>> from jaxtank.plants import network
    >>> tank = network(area=1.0, drain=0.0, pump_gain=0.1, feeds=[(0, None)], rim=9.0)
    >>> governed = ReferenceGovernor(
    ...     model=tank, Kc=[2.0], bias=[0.0], low=[0.0], high=[1.0], horizon=120.0, limit=[3.0]
    ... )
    >>> tick = Tick(t=0.0, r=(5.0,), dr=(0.0,), ddr=(0.0,), dt=1.0)
    >>> _, after = governed.step(governed.init((1.0,), (0.0,)), tick, Estimate(x=(1.0,)))
    >>> print(f"{float(after.setpoint[0]):.3f} m")
    3.000 m
    """

    limits_levels = True
    horizon: float = leaf("s", "length of the prediction, N samples", **POSITIVE)
    limit: np.ndarray = leaf(
        "cm",
        "largest level of each tank; left out: its rim; inf: none",
        infinite=True,
        default=lambda values: values["model"].rim,
        shape="tank",
    )
    lowest: np.ndarray = leaf(
        "cm",
        "smallest level of each tank; left out or -inf: none",
        infinite=True,
        default=lambda values: np.full(values["model"].tanks, -np.inf),
        shape="tank",
    )
    low: np.ndarray = leaf("V", "lower limit of each input", shape="pump")
    high: np.ndarray = leaf("V", "upper limit of each input", shape="pump")
    samples: int = static("-", "number N of predicted samples", low=1, high=1000, default=50)
    integrator: str = static("-", "of the prediction", choices=INTEGRATORS, default="rk4")

    def init(self, x0: tuple, u0: tuple) -> Any:
        start = tuple(take(x0, self.model.outputs))
        return Memory(PID.init(self, x0, u0), start, 0.0 * start[0])

    def step(self, state: Any, tick: Tick, estimate: Estimate) -> tuple[Sequence, Any]:
        before, way = state.setpoint, tuple(r - v for r, v in zip(tick.r, state.setpoint))
        low = share = jnp.zeros_like(way[0])
        high, excess = low + 1.0, low
        for _ in range(ROUNDS):
            shares = low + SHARES * (high - low)
            lanes = tuple(v + shares * d for v, d in zip(before, way))
            excess = self._excess(state.main, tick._replace(r=lanes), estimate)
            low, high, share = largest_share(shares, excess)
        setpoint = tuple(v + share * d for v, d in zip(before, way))
        command, main = PID.step(self, state.main, tick._replace(r=setpoint), estimate)
        return command, Memory(main, setpoint, jnp.maximum(jnp.min(excess), 0.0))

    def _excess(self, main: Any, tick: Tick, estimate: Estimate) -> Any:
        """Largest excess over a limit in the predicted responses to setpoints tick.r [cm]."""
        period = self.horizon / self.samples
        tick, ones = tick._replace(dt=period), jnp.ones(len(SHARES))

        def onward(carry: Any, _: Any) -> Any:
            x, memory, most = carry
            command, memory = PID.step(self, memory, tick, Estimate(x, estimate.d))
            applied = each(clip, command, self.low, self.high)
            memory = PID.track(self, memory, tick, command, applied)._replace(error=())
            x = predicted(self.model, self.integrator, tick.t, x, applied, estimate.d, period)
            for i, h in enumerate(x):
                above, below = h - self.limit[i], self.lowest[i] - h
                most = jnp.maximum(most, jnp.maximum(above, below))
            return (tuple(x), memory, most), None

        start = tuple(estimate.x), main._replace(error=())  # an error is of its own sample
        x, main = jax.tree.map(lambda v: v * ones, start)
        last, _ = jax.lax.scan(onward, (x, main, -jnp.inf * ones), None, self.samples)
        return last[2]

    def track(self, state: Any, tick: Tick, command: Sequence, applied: Sequence) -> Any:
        return state._replace(main=PID.track(self, state.main, tick, command, applied))

    def transfer(self, state: Any, tick: Tick, command: Sequence, applied: Sequence) -> Any:
        return state._replace(main=PID.transfer(self, state.main, tick, command, applied))

    keeps_limits = True

    def level_limits(self) -> list[tuple[int, float, float]]:
        ends = zip(np.asarray(self.lowest), np.asarray(self.limit))
        return [(tank, float(least), float(most)) for tank, (least, most) in enumerate(ends)]

    def metadata_of(self, field: str) -> dict[str, Any]:
        """Return changes of a field's metadata: integral and tracking times are no shorter than a
        predicted sample.
        """
        if field not in ("Ti", "Tt") or isinstance(self.horizon, Tracer):
            return {}
        sample = float(self.horizon) / self.samples
        return {"low": sample, "strict": False, "why": "a predicted sample, horizon/samples"}

    def slack(self, state: Any) -> Any:
        return state.slack

    def check_sensor(self, sensor: Sensor) -> None:
        check_unfiltered(sensor, "a reference governor")

    def check_pumps(self, actuator: Actuator) -> None:
        bank: Any = actuator
        unseen = {"lag": bank.lag is not None, "rate": bank.rate is not None}
        unseen["delay"] = bool(bank.delay) or any(bank.delays)
        if names := [f"actuator.{name}" for name, given in unseen.items() if given]:
            raise InputError(
                f"{', '.join(names)}: a reference governor predicts pumps without dead time, lag"
                " and limit of change: leave this out, or choose another controller"
            )

    def check_gains(self) -> None:
        PID.check_gains(self)
        check_order("controller", self, "low", "high", self.model.units[1])
        limit, lowest = self.limit, self.lowest
        if not (isinstance(limit, np.ndarray) and isinstance(lowest, np.ndarray)):
            return  # traced
        unit = self.model.units[0]
        for i, (least, most) in enumerate(zip(lowest.tolist(), limit.tolist())):
            if not least < most:
                raise InputError(
                    f"controller.lowest[{i}] = {least:g} {unit}: must be below"
                    f" controller.limit[{i}] = {most:g} {unit}"
                )
        if not np.any(np.isfinite(np.concatenate([limit, lowest]))):
            raise InputError(
                "controller.limit: no tank has a limit; give the largest level of at least one"
            )
