"""Setpoints as functions of time: ramps and a sine.

Their samples are inputs of the loop: interpolating inside it would cost more than the plant does.
Imports core; may be imported by every folder above.
"""

import math
from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np

from jaxtank.core.clock import Chunk, Clock, indices, pointwise, sample_times
from jaxtank.core.errors import InputError
from jaxtank.core.tree import component, leaf, number, static
from jaxtank.signals.base import Signal

SHAPES = ("linear", "quintic")


@component
class Ramps(Signal):
    """Plateaus joined by ramps or S-curves: the trapezoidal benchmark of gouta2015 (sec. 5, Fig.
    5).

        r(t) = initial + sum_j (target_j - value before) S((t - t_j) / D)

    S(x) is x (shape "linear"; rate Delta/D on [t_j, t_j + D), second derivative 0, the impulses at
    the corners left out) or 10 x^3 - 15 x^4 + 6 x^5 ("quintic": two continuous derivatives), held
    at 0 before and 1 after. D = 0 gives steps. A change that begins before the last one of its
    channel has ended starts from the value reached by then. Built by `ramps`.

    Examples
    --------
    >>> steps = ramps([3.0], [(1.0, 0, 8.0)], ramp=2.0)
    >>> steps.sample(Clock(dt=1.0, duration=4.0))[0][0].tolist()
    [3.0, 3.0, 5.5, 8.0, 8.0]
    """

    initial: np.ndarray = leaf("cm", "(channels,) value before the first change")
    targets: np.ndarray = leaf("cm", "(changes,) value after each change")
    changes: tuple = static(doc="((time [s], channel), ...) in order of time")
    ramp: float = static("s", "duration D of every change", low=0.0, default=60.0)
    shape: str = static(doc="course of a change", choices=SHAPES, default="linear")
    band: float = static(
        "-",
        "half width of the settling band, as a share of the step",
        low=0.0,
        high=1.0,
        strict=True,
        default=0.05,
    )

    @property
    def channels(self) -> int:
        return np.shape(self.initial)[0]

    @pointwise
    def sample(self, clock: Clock) -> tuple[tuple, tuple, tuple]:
        # of each channel: (first sample, function of time)
        pieces = [[(0, _flat(self.initial[i]))] for i in range(self.channels)]
        for j, (start, i) in enumerate(self.changes):
            # the last target, or the value reached by a change that has not ended
            level = pieces[i][-1][1](start)[0]
            if pieces[i][-1][0] > _index(start, clock):
                pieces[i].pop()
                level = pieces[i][-1][1](start)[0]
            pieces[i].append(
                (
                    _index(start, clock),
                    _course(level, self.targets[j] - level, start, self.ramp, self.shape),
                )
            )
            pieces[i].append((_index(start + self.ramp, clock), _flat(self.targets[j])))
        value, rate, second = zip(*(_join(channel, clock) for channel in pieces))
        return value, rate, second

    @pointwise
    def windows(self, clock: Clock) -> tuple:
        """Return what overshoot and settling refer to; the step is 0 before the first change.

        Returns
        -------
        Per channel (target [cm], step [cm], time since the change ended [s], settling band [cm]),
        arrays (samples,) each
        """
        t = sample_times(clock)
        last = [self.initial[i] for i in range(self.channels)]
        target = [level + jnp.zeros_like(t) for level in last]
        step = [jnp.zeros_like(t) for _ in last]
        since = [jnp.zeros_like(t) for _ in last]
        for j, (start, i) in enumerate(self.changes):
            after = t >= start - 1e-7 * clock.dt
            target[i] = jnp.where(after, self.targets[j], target[i])
            step[i] = jnp.where(after, self.targets[j] - last[i], step[i])
            since[i] = jnp.where(after, t - (start + self.ramp), since[i])
            last[i] = self.targets[j]
        return tuple((a, b, c, self.band * jnp.abs(b)) for a, b, c in zip(target, step, since))

    def plateaus(self, until: float = math.inf) -> np.ndarray:
        """Return (plateaus, channels) values held between changes [cm], as host numbers.

        Those whose changes end before the next one and `until` [s].
        """
        values, now = [], np.array(self.initial, dtype=float)
        values.append(now.copy())
        by_time = {}
        for j, (start, i) in enumerate(self.changes):
            by_time.setdefault(start, []).append((i, float(self.targets[j])))
        starts = sorted(by_time)
        for start, following in zip(starts, [*starts[1:], math.inf]):
            for i, target in by_time[start]:
                now[i] = target
            if start + self.ramp <= min(following, until):
                values.append(now.copy())
        return np.array(values)


@component
class Sine(Signal):
    """A raised sine that lasts a while: the moving part of benchmark 1 of gouta2022 (sec. 5.1).

        s(t) = offset + amplitude sin(2 pi (t - zero) / period)   for start <= t < end, else 0

    One channel of several moves, the others stay at 0. Its rate is that of the sine; jumps at the
    two ends have no impulse.

    Examples
    --------
    >>> sine = Sine(
    ...     amplitude=1.0, offset=2.0, period=4.0, zero=0.0, start=0.0, end=9.0, channel=0, width=1
    ... )
    >>> [round(float(v), 3) for v in sine.sample(Clock(dt=1.0, duration=3.0))[0][0]]
    [2.0, 3.0, 2.0, 1.0]
    """

    amplitude: np.ndarray = leaf("cm", "amplitude of the sine")
    offset: np.ndarray = leaf("cm", "mean of the sine")
    period: float = static("s", "period", low=0.0, strict=True)
    zero: float = static("s", "a time at which the sine rises through its mean")
    start: float = static("s", "when it begins", low=0.0)
    end: float = static("s", "when it ends", low=0.0)
    channel: int = static("-", "the channel that moves", low=0, high=100)
    width: int = static("-", "number of channels", low=1, high=100)

    @property
    def channels(self) -> int:
        return self.width

    @pointwise
    def sample(self, clock: Clock) -> tuple[tuple, tuple, tuple]:
        t, omega = sample_times(clock), 2.0 * math.pi / self.period
        inside, angle = (
            (t >= self.start - 1e-7 * clock.dt) & (t < self.end - 1e-7 * clock.dt),
            omega * (t - self.zero),
        )
        sine, cosine = self.amplitude * jnp.sin(angle), self.amplitude * jnp.cos(angle)
        moving = [
            jnp.where(inside, v, 0.0)
            for v in (self.offset + sine, omega * cosine, -omega * omega * sine)
        ]
        still = jnp.zeros_like(t)
        value, rate, second = (
            tuple(v if i == self.channel else still for i in range(self.width)) for v in moving
        )
        return value, rate, second


def ramps(
    initial: Sequence[float],
    changes: Sequence[tuple[float, int, float]],
    ramp: float = 60.0,
    shape: str = "linear",
    band: float = 0.05,
) -> Ramps:
    """Return a `Ramps` built from a list.

    Parameters
    ----------
    initial : (channels,) values before the first change [cm]
    changes : (time [s], channel counted from 0, target [cm]) of each change
    ramp : duration of every change [s]; 0 gives steps
    shape : "linear" or "quintic"
    band : half width of the settling band, as a share of each step [-]

    Raises
    ------
    InputError for a time before 0, a channel that does not exist and an unknown shape.

    Examples
    --------
    >>> ramps([3.0, 3.0], [(20.0, 0, 8.0)]).plateaus().tolist()
    [[3.0, 3.0], [8.0, 3.0]]
    """
    changes = sorted(changes, key=lambda change: change[0])
    for time, channel, _ in changes:
        if not 0 <= channel < len(initial):
            raise InputError(
                f"reference change at {time:g} s names channel {channel}: there are {len(initial)},"
                " counted from 0"
            )
        if not time >= 0:
            raise InputError(f"reference change at {time} s: must be at or after 0 s")
    if shape not in SHAPES:
        raise InputError(f"reference.shape = {shape!r}: must be one of {', '.join(SHAPES)}")
    return Ramps(
        initial=number(initial),
        targets=number([target for _, _, target in changes]),
        changes=tuple((float(time), int(channel)) for time, channel, _ in changes),
        ramp=float(ramp),
        shape=shape,
        band=float(band),
    )


def _index(time, clock):
    """First sample at or after `time`; half a part in a million of a sample is forgiven, so that 20
    s is sample 2000 at 0.01 s.
    """
    return max(0, math.ceil(min(time / clock.dt, 2.0**53) - 5e-7))


def _flat(level):
    return lambda t: (level + jnp.zeros_like(t), jnp.zeros_like(t), jnp.zeros_like(t))


def _course(level, delta, start, duration, shape):
    """Value, rate and second derivative of a change of `delta` from `level`, as a function of time
    inside the change.
    """
    if shape == "linear":
        return lambda t: (
            level + delta * ((t - start) / duration),
            delta / duration + jnp.zeros_like(t),
            jnp.zeros_like(t),
        )

    def quintic(t):
        x = (t - start) / duration
        s = x * x * x * (10.0 + x * (6.0 * x - 15.0))
        ds = 30.0 * x * x * (1.0 - x) * (1.0 - x) / duration
        dds = 60.0 * x * (1.0 - x) * (1.0 - 2.0 * x) / duration**2
        return level + delta * s, delta * ds, delta * dds

    return quintic


def _join(pieces, clock):
    """The pieces of one channel, each evaluated on its own samples only, end to end; of a `Chunk`,
    which may lie anywhere, on all.
    """
    if isinstance(clock, Chunk):
        k, t = indices(clock), sample_times(clock)
        found = pieces[0][1](t)
        for (first, f), (after, _) in zip(pieces[1:], [*pieces[2:], (math.inf, None)]):
            if after > first:
                found = tuple(jnp.where(k >= first, new, old) for new, old in zip(f(t), found))
        return found
    starts = [min(first, clock.samples) for first, _ in pieces] + [clock.samples]
    parts = [
        f((a + jnp.arange(b - a)) * clock.dt)
        for (_, f), a, b in zip(pieces, starts, starts[1:])
        if b > a
    ]
    return tuple(jnp.concatenate(column) for column in zip(*parts))
