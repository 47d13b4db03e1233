"""The role Signal, and signals for any purpose: constant, table, sum."""

import abc
import math
import operator
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np

from jaxtank.core.clock import Clock, pointwise, sample_times
from jaxtank.core.tree import POSITIVE, Role, component, leaf, static
from jaxtank.core.vectors import columns, serves_arrays

BETWEEN = ("hold", "linear")  # what a table of rows does between them


CARRIED = ("level", "values", "initial", "targets", "amplitude", "offset")
"""Leaves of signals that have the unit of what a signal stands for: a level, a flow, an input."""


class Signal(Role):
    """A signal of one or more channels: a reference, a disturbance or an input.

    A custom signal is a `component` with its own `channels` and `sample`. One whose setpoints
    change also gives `changes`, `windows` and `plateaus`; one that disturbs from time to time gives
    `onset` and `since`. All of them are None where a signal has no such thing.
    """

    changes: Any = None
    """((time [s], channel), ...) of its setpoint changes in order of time, or None."""

    onset: Any = None
    """(time [s], ...) at which a disturbance begins, in order of time, or None."""

    is_table: bool = False
    """Whether samples are looked up in a table, which code of a single sample does not hold."""

    known: Any = None
    """{"jumps", "moves"} of `loop.change_windows` where one sample of the signal is known, else
    None."""

    def metadata_of(self, field: str) -> dict[str, Any]:
        """Return what of a field's metadata depends on the signal's place (`walk`)."""
        return {"carried": field in CARRIED}

    @property
    @abc.abstractmethod
    def channels(self) -> int:
        """Number of channels [-]."""

    @abc.abstractmethod
    def sample(self, clock: Clock) -> tuple[tuple[Any, ...], tuple[Any, ...], tuple[Any, ...]]:
        """Return the samples of a run, evaluated before the time loop.

        A method whose every sample follows from `sample_times(clock)` alone may be marked
        `jaxtank.core.clock.pointwise`: a long run then calls it chunk by chunk.

        Parameters
        ----------
        clock : Clock, or a Chunk of one

        Returns
        -------
        (value, rate [1/s], second derivative [1/s^2]): tuples of arrays (samples,), one per channel
        """

    @pointwise
    def windows(self, clock: Clock) -> tuple[Any, ...] | None:
        """Return the windows for overshoot and settling, or None without `changes`.

        Returns
        -------
        Per channel (target [cm], step [cm], time since the change ended [s], settling band [cm]),
        arrays (samples,) each
        """
        return None

    @pointwise
    def since(self, clock: Clock) -> jax.Array | None:
        """Return (samples,) time since the last `onset` [s], -1 where there was none; or None."""
        return None

    def plateaus(self, until: float = math.inf) -> np.ndarray | None:
        """Return (plateaus, channels) values held between `changes` before `until` [s], or None."""
        return None

    def held(self, until: float = math.inf) -> tuple[tuple[Any, ...], ...] | None:
        """Return the values of the channels at the start and after the changes of each time before
        `until` [s], also of changes that end after the next ones begin; None where nothing is held.
        Derivatives pass through.
        """
        return None

    def steady(self) -> Any:
        """Return the (channels,) values that last, or None: of pulses, which end."""
        return None

    def at_start(self) -> Any:
        """Return the (channels,) values at t = 0 as if they lasted, or None: of pulses."""
        return self.steady()


def sampled(signal: Signal, clock: Clock, arrays: bool = False) -> tuple[Any, Any, Any]:
    """Return `signal.sample(clock)`, whose vectors are arrays (samples, channels) if `arrays`."""
    if arrays and serves_arrays(signal):
        return cast(Any, signal).sample_arrays(clock)
    value, rate, second = map(columns, signal.sample(clock)) if arrays else signal.sample(clock)
    return value, rate, second


@component
class Constant(Signal):
    """A signal that does not change.

    Examples
    --------
    >>> value, rate, _ = Constant(level=[4.0]).sample(Clock(dt=1.0, duration=2.0))
    >>> value[0].tolist(), rate[0].tolist()
    ([4.0, 4.0, 4.0], [0.0, 0.0, 0.0])
    """

    level: np.ndarray = leaf(
        "-",
        "value, in the unit of what it stands for: a level of a setpoint, a flow of a disturbance",
        shape="channel",
    )

    @property
    def channels(self) -> int:
        return np.shape(self.level)[0]

    @pointwise
    def sample(self, clock: Clock) -> tuple[tuple[Any, ...], tuple[Any, ...], tuple[Any, ...]]:
        zero = jnp.zeros(clock.samples)
        flat = (zero,) * self.channels
        return tuple(self.level[i] + zero for i in range(self.channels)), flat, flat

    arrays = True

    def sample_arrays(self, clock: Clock) -> tuple[Any, Any, Any]:
        """Return `sample` as three arrays (samples, channels)."""
        flat = jnp.zeros((clock.samples, self.channels))
        return self.level + flat, flat, flat

    def steady(self) -> Any:
        return self.level

    def held(self, until: float = math.inf) -> tuple[tuple[Any, ...], ...]:
        return (tuple(self.level[i] for i in range(self.channels)),)


@component
class Table(Signal):
    """Recorded samples, one every `period` from t = 0 on: a measured input or inflow.

    Between samples the last one is held ("hold"; its rate is 0) or a straight line joins them
    ("linear"); after the last sample, it is held.

    Examples
    --------
    >>> table = Table(values=[[1.0, 3.0]], period=2.0, between="linear")
    >>> table.sample(Clock(dt=1.0, duration=3.0))[0][0].tolist()
    [1.0, 2.0, 3.0, 3.0]
    """

    values: np.ndarray = leaf(
        "-", "recorded values, in the unit of what they stand for", shape=("channel", "sample")
    )
    period: float = static("s", "time between samples", **POSITIVE)
    between: str = static(doc="what is between samples", choices=BETWEEN, default="hold")

    @property
    def channels(self) -> int:
        return np.shape(self.values)[0]

    def sample(self, clock: Clock) -> tuple[tuple[Any, ...], tuple[Any, ...], tuple[Any, ...]]:
        last = np.shape(self.values)[1] - 1
        # which sample, and how far past it, is known to the host; the tolerance makes 3 * 0.1 s
        # sample 3
        at = np.arange(clock.samples) * (clock.dt / self.period)
        index = np.minimum(np.floor(at + 5e-7), last).astype(int)
        after, past = np.minimum(index + 1, last), np.clip(at - index, 0.0, 1.0)
        table, still = jnp.asarray(self.values), jnp.zeros(clock.samples)
        values = table[:, index]
        if self.between == "hold":
            return tuple(values), (still,) * self.channels, (still,) * self.channels
        slope = table[:, after] - values
        return tuple(values + slope * past), tuple(slope / self.period), (still,) * self.channels


@component
class Sum(Signal):
    """Two signals added, channel by channel.

    Examples
    --------
    >>> total = Sum(first=Constant(level=[4.0]), second=Constant(level=[1.0]))
    >>> total.sample(Clock(dt=1.0, duration=1.0))[0][0].tolist()
    [5.0, 5.0]
    """

    first: Signal
    second: Signal

    @property
    def channels(self) -> int:
        return self.first.channels

    @property
    def changes(self) -> Any:
        return self.first.changes

    @property
    def onset(self) -> Any:
        return self.first.onset

    @property
    def is_table(self) -> bool:
        return self.first.is_table or self.second.is_table

    @pointwise
    def sample(self, clock: Clock) -> tuple[tuple[Any, ...], tuple[Any, ...], tuple[Any, ...]]:
        add = lambda a, b: tuple(map(operator.add, a, b))
        value, rate, second = map(add, self.first.sample(clock), self.second.sample(clock))
        return value, rate, second

    @pointwise
    def windows(self, clock: Clock) -> tuple[Any, ...] | None:
        """Return the windows of the first signal (`Ramps`).

        A channel has no step after the second signal (`Sine`) has started to move it.
        """
        t = sample_times(clock)
        sine, windows = cast(Any, self.second), self.first.windows(clock)
        if windows is None:
            return None
        channels = list(windows)
        still = t < sine.start - 1e-7 * clock.dt
        channels[sine.channel] = tuple(jnp.where(still, a, 0.0) for a in channels[sine.channel])
        return tuple(channels)

    @pointwise
    def since(self, clock: Clock) -> jax.Array | None:
        return self.first.since(clock)

    def held(self, until: float = math.inf) -> tuple[tuple[Any, ...], ...] | None:
        """Return the plateaus of the first signal; the second one oscillates about them."""
        return self.first.held(until)

    def steady(self) -> Any:
        return _added(self.first.steady(), self.second.steady())

    def at_start(self) -> Any:
        return _added(self.first.at_start(), self.second.at_start())


def _added(*parts):
    """The sum of those that are not None; None without any."""
    known = [part for part in parts if part is not None]
    return sum(known) if known else None
