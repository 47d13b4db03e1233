"""PumpBank: limits or allocation, rate, dead zone, lag and delay of pumps and valves, in order."""

import dataclasses
import functools
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxtank.core.clock import Clock
from jaxtank.core.numerics import clip, decay, lower_clip
from jaxtank.core.tree import POSITIVE, component, leaf, static
from jaxtank.core.vectors import each, is_array, keeping_nan, like, scalars, unzipped
from jaxtank.instruments.base import Actuator

SATURATIONS = ("clip", "boxqp")
DEAD_ZONES = ("plain", "offset", "hysteresis", "pulse")

option = functools.partial(leaf, like="low", default=None, shape="pump")
"""A leaf of the pumps that may be left out."""


class ActuatorState(NamedTuple):
    """Memory of the pumps: vectors with one entry per pump, () where a feature is not in use."""

    running: Any  # 1.0 while a pump with hysteresis turns
    owed: Any  # volt-seconds the pulse compensation still owes [V s]
    lagged: Any  # voltage behind the lag [V]
    line: Any  # (delay samples,) ring buffer of each pump [V]; one (delay samples, m) of arrays
    head: Any  # where the ring buffers are read and written
    own: Any = ()  # (line, head) of each pump with a further delay, () of the others


def _largest(high):
    """(m,) pulses [V] as high as the pumps' upper limits [V], 1 V where those are no pulse."""
    xp = jnp if isinstance(high, jax.Array) else np
    return xp.where((high > 0.0) & xp.isfinite(high), high, 1.0)


@component
class PumpBank(Actuator):
    """m pumps, such as `PumpBank(low=[0.0], high=[12.0])`: from a command u to the plant's input.

    1. Saturation (gouta2015 eq. 9): "clip" holds each voltage in [low, high]; "boxqp" takes the
       voltages in the box that are best by the controller's own cost (see `allocate`), which
       removes the wrong-way latch-up of clipping a decoupling controller.
    2. Rate, if given: the voltage moves by at most `rate` [V/s] from that of the sample before.
       Controller and observer are given the result, so that anti-windup acts on it.
    3. Dead zone, if given: no flow at or below `dead_zone` (gouta2015, Remark 4: 3 V). "offset":
       the flow is proportional to u - dead_zone above the dead zone (gouta2022 notes S2.3).
       "hysteresis": a pump that turns stops below `stop`, and starts again above `dead_zone`.
       "pulse": voltages that would not turn the pump are saved up as volt-seconds and paid out in
       samples at `pulse` volts, so that the mean flow is the one asked for (sigma-delta).
    4. Lag, if given: first order with time constant `lag` [s], lag v' = u - v, solved exactly. The
       plant receives the mean of v over each sample, so that the delivered volume is exact for any
       sampling period.
    5. Transport delay: `delay` [s] of all and `delays` [s] of each besides, whole samples.

    At the edge of a dead zone the derivative is one-sided; through "pulse" it is the
    derivative of the mean flow, 1.

    Examples
    --------
    >>> pumps = PumpBank(low=[0.0], high=[12.0], dead_zone=[3.0])
    >>> start = pumps.init(Clock(dt=1.0, duration=10.0))
    >>> [float(pumps.step(start, pumps.limit((v,)), 1.0)[0][0]) for v in (2.0, 5.0, 20.0)]
    [0.0, 5.0, 12.0]
    """

    low: np.ndarray = leaf("V", "lower limit of each pump", shape="pump")
    high: np.ndarray = leaf("V", "upper limit of each pump", shape="pump")
    dead_zone: Any = option("V", "input at or below which a pump stands still", low=0.0)
    stop: np.ndarray = leaf(
        "V",
        "input below which a turning pump stops (hysteresis)",
        low=0.0,
        default=lambda own: np.zeros(np.shape(own["low"])),
        shape="pump",
    )
    pulse: np.ndarray = leaf(
        "V",
        "input of the pulses that replace a dead zone (pulse)",
        **POSITIVE,
        default=lambda own: _largest(own["high"]),
        shape="pump",
    )
    lag: Any = option("s", "time constant of each pump", low=0.0)
    rate: Any = option(
        "V/s",
        "largest change of the input of each pump per second; inf: none",
        **POSITIVE,
        infinite=True,
    )
    initial: np.ndarray = leaf(
        "V",
        "input at which the pumps ran before t = 0",
        default=lambda own: np.zeros(np.shape(own["low"])),
        shape="pump",
    )
    delay: float = static(
        "s", "transport delay from pump to tank", low=0.0, high=1000.0, default=0.0
    )
    delays: tuple = static(
        doc="transport delay [s] of each pump beyond `delay`, (): none", default=()
    )
    saturation: str = static(
        "-", "what saturation does to a command", choices=SATURATIONS, default="clip"
    )
    dead_zone_kind: str = static(
        "-", "what the dead zone does", choices=DEAD_ZONES, default="plain"
    )

    def __post_init__(self) -> None:
        rate: Any = self.rate
        if isinstance(rate, np.ndarray) and np.all(np.isinf(rate)):
            object.__setattr__(self, "rate", None)  # no memory that never acts

    @property
    def allocates(self) -> bool:
        return self.saturation == "boxqp"

    @property
    def offset(self) -> Any:
        return self.dead_zone if self._has_dead_zone("offset") else 0.0

    def orders(self) -> list[tuple[str, str, bool]]:
        orders = [("low", "high", False)]
        if self._has_dead_zone("hysteresis"):
            orders += [("stop", "dead_zone", True)]
        if self._has_dead_zone("pulse"):
            orders += [("dead_zone", "pulse", False), ("pulse", "high", True)]
        return orders

    def _has_dead_zone(self, *kinds):
        """Whether there is a dead zone of one of these kinds."""
        return self.dead_zone is not None and self.dead_zone_kind in kinds

    arrays = True

    def init(self, clock: Clock) -> ActuatorState:
        """Return the state before the first sample: pumps turning steadily at `initial`."""
        return self._begin(tuple(self.initial[i] for i in range(self.pumps)), clock)

    def init_arrays(self, clock: Clock) -> ActuatorState:
        """Return that state for vectors that are arrays."""
        return self._begin(jnp.asarray(self.initial), clock)

    def _begin(self, start, clock):
        zero = each(lambda s: 0.0 * s, start)
        delay = round(self.delay / clock.dt)
        line = ()
        if delay and is_array(start):
            line = jnp.broadcast_to(start, (delay, self.pumps))
        elif delay:
            line = tuple(jnp.broadcast_to(s, (delay,)) for s in start)
        return ActuatorState(
            running=each(lambda z: z + 1.0, zero) if self._has_dead_zone("hysteresis") else (),
            owed=zero if self._has_dead_zone("pulse") else (),
            lagged=self._turning(start) if self.lag is not None else (),
            line=line,
            head=jnp.int32(0),
            own=self._own_lines(scalars(start), clock),
        )

    def _own_lines(self, start, clock):
        """(line, head) of each pump with a delay beyond that of all, () of the others."""
        counts = [round(delay / clock.dt) for delay in self.delays]
        return tuple(
            (jnp.broadcast_to(s, (n,)), jnp.int32(0)) if n else () for s, n in zip(start, counts)
        )

    def limit(self, command: Sequence, metric: tuple | None = None) -> tuple:
        if self.allocates:
            return allocate(command, metric, self.low, self.high)
        return super().limit(command, metric)

    def step(self, state: ActuatorState, applied: tuple, dt: Any) -> tuple[tuple, ActuatorState]:
        u = applied
        if self._has_dead_zone("plain", "hysteresis", "pulse"):
            turned, state = self._dead_zone(state, u, dt)
            u = each(keeping_nan, u, turned)
        if self.lag is not None:
            u, state = self._lagged(state, self._turning(u), dt)
        u, state = _delayed(state, u) if len(state.line) else (u, state)
        return _delayed_each(state, u) if state.own else (u, state)

    def reachable(self, before: Any, dt: Any) -> "PumpBank":
        """Return these pumps with the limits that they reach a sample after inputs `before`."""

        def end(sign):
            move = lambda u, rate, low, high: clip(u + sign * (rate * dt), low, high)
            return each(move, before, self.rate, self.low, self.high)

        return dataclasses.replace(self, low=end(-1.0), high=end(1.0), rate=None)

    def driving(self, u: tuple) -> tuple:
        """Return the part of inputs `u` (m,) [V] that moves liquid: less an "offset" dead zone."""
        if not self._has_dead_zone("offset"):
            return u
        return each(lambda v, least: lower_clip(v - least, 0.0), u, self.dead_zone)

    def _turning(self, u):
        """Input of the lag: an "offset" dead zone rectifies noise before the lag, not after."""
        if not self._has_dead_zone("offset"):
            return u
        return each(lower_clip, u, self.dead_zone)

    def _lagged(self, state, u, dt):
        """(means of the lagged inputs over a sample, new state) for inputs u held over it."""

        def follow(v, lag, lagged):
            keep = decay(dt, lag)
            short = lagged - v  # from its target at the start of the sample
            return v + keep * short, v + lag / dt * (1.0 - keep) * short

        lagged, mean = unzipped(u, each(follow, u, self.lag, state.lagged))
        return mean, state._replace(lagged=lagged)

    def _dead_zone(self, state, u, dt):
        """(inputs behind a "plain", "hysteresis" or "pulse" dead zone, new state)."""
        if self.dead_zone_kind == "hysteresis":
            running = each(
                lambda v, r, stop, start: jnp.where(
                    jnp.where(r > 0.5, v >= stop, v > start), 1.0, 0.0
                ),
                u,
                state.running,
                self.stop,
                self.dead_zone,
            )
            turned = each(lambda v, r: jnp.where(r > 0.5, v, 0.0), u, running)
            return turned, state._replace(running=running)
        if self.dead_zone_kind == "pulse":

            def pay(v, owed, least, pulse):
                due = v + owed / dt
                turning = v > least
                paid = jnp.where(turning, v, jnp.where(due >= pulse, pulse, 0.0))
                remainder = jax.lax.stop_gradient(jnp.where(turning, owed, (due - paid) * dt))
                return v + jax.lax.stop_gradient(paid - v), remainder

            paid, owed = unzipped(u, each(pay, u, state.owed, self.dead_zone, self.pulse))
            return paid, state._replace(owed=owed)
        return each(lambda v, least: jnp.where(v > least, v, 0.0), u, self.dead_zone), state


def _delayed(state, u):
    """(inputs that entered the ring buffers a delay ago, new state)."""
    head = state.head
    if is_array(state.line):
        out = jax.lax.dynamic_index_in_dim(state.line, head, keepdims=False)
        line = jax.lax.dynamic_update_index_in_dim(state.line, u, head, 0)
        return out, state._replace(line=line, head=_next(head, line))
    out = tuple(jax.lax.dynamic_index_in_dim(line, head, keepdims=False) for line in state.line)
    line = tuple(
        jax.lax.dynamic_update_index_in_dim(line, v, head, 0) for line, v in zip(state.line, u)
    )
    return out, state._replace(line=line, head=_next(head, line[0]))


def _delayed_each(state, u):
    """(inputs behind the further delay of each pump, new state)."""
    out, own = [], []
    for v, memory in zip(scalars(u), state.own):
        if memory:
            line, head = memory
            v, now = jax.lax.dynamic_index_in_dim(line, head, keepdims=False), v
            line = jax.lax.dynamic_update_index_in_dim(line, now, head, 0)
            memory = line, _next(head, line)
        out.append(v)
        own.append(memory)
    return like(tuple(out), u), state._replace(own=tuple(own))


def _next(head, line):
    """The place after `head` in a ring buffer."""
    return jnp.where(head + 1 == line.shape[0], 0, head + 1)


def allocate(command, metric, low, high):
    """Return the inputs in the box that are best by a controller's cost."""
    # For the predictive controller of gouta2015 G = b'b makes this the exact constrained minimiser
    # of its cost (eq. 21; gouta2015 notes S4.5). The four faces of the box are tried and the
    # cheapest is kept; a command inside the box is unchanged.
    if len(command) != 2:
        raise ValueError(f"allocation by box QP is for two pumps, not {len(command)}")
    (a, b), (g11, g12, g22) = command, metric
    best_x, best_y, best = clip(a, low[0], high[0]), clip(b, low[1], high[1]), jnp.inf
    inside = (a >= low[0]) & (a <= high[0]) & (b >= low[1]) & (b <= high[1])
    faces = [(x, clip(b - g12 / g22 * (x - a), low[1], high[1])) for x in (low[0], high[0])]
    faces += [(clip(a - g12 / g11 * (y - b), low[0], high[0]), y) for y in (low[1], high[1])]
    for x, y in faces:
        p, q = x - a, y - b
        cost = g11 * p * p + 2.0 * g12 * p * q + g22 * q * q
        better = cost < best
        best_x, best_y, best = (
            jnp.where(better, x, best_x),
            jnp.where(better, y, best_y),
            jnp.where(better, cost, best),
        )
    return jnp.where(inside, a, best_x), jnp.where(inside, b, best_y)
