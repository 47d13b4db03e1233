"""References and disturbances as functions of time, sampled before the time loop starts.

A signal answers `sample(clock)` with three tuples (value, rate, second derivative), one array (samples,) per channel. The
samples are inputs of the loop: interpolating inside it would cost more than the plant does.
"""

import abc
import math

import jax.numpy as jnp
import numpy as np

from jaxtank.core.clock import Piece, indices, pointwise, sample_times
from jaxtank.core.errors import InputError
from jaxtank.core.tree import component, leaf, number, static

SHAPES = ("linear", "quintic")


class Signal(abc.ABC):
    """A signal of one or more channels."""

    @property
    @abc.abstractmethod
    def channels(self):
        """Number of channels [-]."""

    @abc.abstractmethod
    def sample(self, clock):
        """(value, rate, second derivative): each a tuple of arrays (samples,), one per channel, for a Clock. A signal whose every sample
        follows from `sample_times(clock)` alone may be marked `pieces.pointwise`: a long run then asks for it piece by piece."""


@component
class Constant(Signal):
    """A signal that does not change."""

    level: np.ndarray = leaf(
        "-", "(channels,) value, in the unit of what it stands for: a level of a setpoint, a flow of a disturbance"
    )

    @property
    def channels(self):
        return np.shape(self.level)[0]

    @pointwise
    def sample(self, clock):
        zero = jnp.zeros(clock.samples)
        flat = (zero,) * self.channels
        return tuple(self.level[i] + zero for i in range(self.channels)), flat, flat


@component
class Ramps(Signal):
    """Plateaus joined by ramps or S-curves: the trapezoidal benchmark of gouta2015 (sec. 5, Fig. 5).

        r(t) = initial + sum_j (target_j - value before) S((t - t_j) / D)

    S(x) is x (shape "linear"; rate Delta/D on [t_j, t_j + D), second derivative 0, the impulses at the corners left out) or
    10 x^3 - 15 x^4 + 6 x^5 ("quintic": two continuous derivatives), held at 0 before and 1 after. D = 0 gives steps. A change that
    begins before the last one of its channel has ended starts from where that one has got to.
    """

    initial: np.ndarray = leaf("cm", "(channels,) value before the first change")
    targets: np.ndarray = leaf("cm", "(changes,) value after each change")
    changes: tuple = static(doc="((time [s], channel), ...) in order of time")
    ramp: float = static("s", "duration D of every change", low=0.0, default=60.0)
    shape: str = static(doc="course of a change", choices=SHAPES, default="linear")
    band: float = static(
        "-", "half width of the settling band, as a share of the step", low=0.0, high=1.0, strict=True, default=0.05
    )

    @property
    def channels(self):
        return np.shape(self.initial)[0]

    @pointwise
    def sample(self, clock):
        pieces = [[(0, _flat(self.initial[i]))] for i in range(self.channels)]  # of each channel: (first sample, function of time)
        for j, (start, i) in enumerate(self.changes):
            level = pieces[i][-1][1](start)[0]  # the last target, or how far a change that is not over has come
            if pieces[i][-1][0] > _index(start, clock):
                pieces[i].pop()
                level = pieces[i][-1][1](start)[0]
            pieces[i].append((_index(start, clock), _course(level, self.targets[j] - level, start, self.ramp, self.shape)))
            pieces[i].append((_index(start + self.ramp, clock), _flat(self.targets[j])))
        value, rate, second = zip(*(_join(channel, clock) for channel in pieces))
        return value, rate, second

    @pointwise
    def windows(self, clock):
        """Per channel (target, step, time since the change ended, settling band), each (samples,): what overshoot and settling refer to.

        Before a channel's first change the step is 0. Times in s, levels in cm.
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

    def plateaus(self, until=math.inf):
        """(plateaus, channels) the values held between changes, as host numbers: those whose changes end before the next and `until` [s]."""
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

    One channel of several moves, the others stay at 0. Its rate is that of the sine; jumps at the two ends have no impulse.
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
    def channels(self):
        return self.width

    @pointwise
    def sample(self, clock):
        t, omega = sample_times(clock), 2.0 * math.pi / self.period
        inside, angle = (t >= self.start - 1e-7 * clock.dt) & (t < self.end - 1e-7 * clock.dt), omega * (t - self.zero)
        sine, cosine = self.amplitude * jnp.sin(angle), self.amplitude * jnp.cos(angle)
        moving = [jnp.where(inside, v, 0.0) for v in (self.offset + sine, omega * cosine, -omega * omega * sine)]
        still = jnp.zeros_like(t)
        return tuple(tuple(v if i == self.channel else still for i in range(self.width)) for v in moving)


@component
class Table(Signal):
    """Recorded samples, one every `period` from t = 0 on: an input or an inflow that was logged.

    Between samples the last one is held ("hold"; its rate is 0) or a straight line joins them ("linear"); after the last, the last.
    """

    values: np.ndarray = leaf("-", "(channels, samples) the record, in the unit of what it stands for")
    period: float = static("s", "time between samples", low=0.0, strict=True)
    between: str = static(doc="what is between samples", choices=("hold", "linear"), default="hold")

    @property
    def channels(self):
        return np.shape(self.values)[0]

    def sample(self, clock):
        last = np.shape(self.values)[1] - 1
        # which sample, and how far past it, is known to the host: a little forgiveness makes 3 * 0.1 s sample 3
        at = np.arange(clock.samples) * (clock.dt / self.period)
        index = np.minimum(np.floor(at + 5e-7), last).astype(int)
        after, past = np.minimum(index + 1, last), np.clip(at - index, 0.0, 1.0)
        table, still = jnp.asarray(self.values), jnp.zeros(clock.samples)
        here = table[:, index]
        if self.between == "hold":
            return tuple(here), (still,) * self.channels, (still,) * self.channels
        slope = table[:, after] - here
        return tuple(here + slope * past), tuple(slope / self.period), (still,) * self.channels


@component
class Sum(Signal):
    """Two signals added, channel by channel."""

    first: Signal
    second: Signal

    @property
    def channels(self):
        return self.first.channels

    @pointwise
    def sample(self, clock):
        return tuple(
            tuple(a + b for a, b in zip(one, two)) for one, two in zip(self.first.sample(clock), self.second.sample(clock))
        )

    @pointwise
    def windows(self, clock):
        """Those of the first signal (`Ramps`); a channel that the second (`Sine`) moves has no step from its start on."""
        t = sample_times(clock)
        found = list(self.first.windows(clock))
        still = t < self.second.start - 1e-7 * clock.dt
        found[self.second.channel] = tuple(jnp.where(still, a, 0.0) for a in found[self.second.channel])
        return tuple(found)


@component
class Pours(Signal):
    """Volumes poured into tanks at a steady rate: 500 cm^3 over 1.1 s in gouta2022 (sec. 5.2; gouta2022 notes S3.2). An inflow per tank [cm^3/s].

    What a sample is given is the mean over that sample, so that the whole volume arrives whatever the sampling period.
    """

    volume: np.ndarray = leaf("cm^3", "(pours,) volume of each pour; negative: taken out")
    events: tuple = static(doc="((time [s], duration [s], tank), ...) one per pour")
    width: int = static("-", "number of tanks", low=1, high=100)
    window: float = static("s", "how long after a pour a tank is watched for its recovery", low=0.0, strict=True, default=60.0)

    @property
    def channels(self):
        return self.width

    @pointwise
    def sample(self, clock):
        t = sample_times(clock)
        flow = [jnp.zeros_like(t) for _ in range(self.width)]
        for j, (start, duration, tank) in enumerate(self.events):
            share = (jnp.minimum(t + clock.dt, start + duration) - jnp.maximum(t, start)) / (duration * clock.dt)
            flow[tank] = flow[tank] + self.volume[j] * jnp.maximum(share, 0.0)
        still = (jnp.zeros_like(t),) * self.width
        return tuple(flow), still, still

    @pointwise
    def since(self, clock):
        """(samples,) time since the last pour began [s]; -1 where there was none within `window`."""
        t = sample_times(clock)
        since = -jnp.ones_like(t)
        for start, _, _ in sorted(self.events):
            after = t - start
            since = jnp.where(after >= -1e-7 * clock.dt, jnp.where(after <= self.window, after, -1.0), since)
        return since


def pours(tanks, entries):
    """A `Pours` for `tanks` tanks from a list of (time [s], duration [s], tank counted from 0, volume [cm^3]). InputError for a bad one."""
    for time, duration, tank, _ in entries:
        if not (time >= 0 and duration > 0 and 0 <= tank < tanks):
            raise InputError(
                f"pour at {time} s over {duration} s into tank {tank}: needs a time at or after 0 s, a duration above 0 s and a tank "
                f"from 0 to {tanks - 1}, counted from 0"
            )
    return Pours(
        volume=number([volume for *_, volume in entries]),
        events=tuple((float(time), float(duration), int(tank)) for time, duration, tank, _ in entries),
        width=tanks,
    )


def ramps(initial, changes, ramp=60.0, shape="linear", band=0.05):
    """A `Ramps` from a list of (time [s], channel, target [cm]); band: share of each step.

    Raises InputError for a bad time, channel or shape.
    """
    changes = sorted(changes, key=lambda change: change[0])
    for time, channel, _ in changes:
        if not 0 <= channel < len(initial):
            raise InputError(f"reference change at {time:g} s names channel {channel}: there are {len(initial)}, counted from 0")
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
    """First sample at or after `time`; half a part in a million of a sample is forgiven, so that 20 s is sample 2000 at 0.01 s."""
    return max(0, math.ceil(min(time / clock.dt, 2.0**53) - 5e-7))


def _flat(level):
    return lambda t: (level + jnp.zeros_like(t), jnp.zeros_like(t), jnp.zeros_like(t))


def _course(level, delta, start, duration, shape):
    """Value, rate and second derivative of a change of `delta` from `level`, as a function of time inside the change."""
    if shape == "linear":
        return lambda t: (level + delta * ((t - start) / duration), delta / duration + jnp.zeros_like(t), jnp.zeros_like(t))

    def quintic(t):
        x = (t - start) / duration
        s = x * x * x * (10.0 + x * (6.0 * x - 15.0))
        ds = 30.0 * x * x * (1.0 - x) * (1.0 - x) / duration
        dds = 60.0 * x * (1.0 - x) * (1.0 - 2.0 * x) / duration**2
        return level + delta * s, delta * ds, delta * dds

    return quintic


def _join(pieces, clock):
    """The pieces of one channel, each evaluated on its own samples only, end to end; of a `Piece`, which may lie anywhere, on all."""
    if isinstance(clock, Piece):
        k, t = indices(clock), sample_times(clock)
        found = pieces[0][1](t)
        for (first, f), (after, _) in zip(pieces[1:], [*pieces[2:], (math.inf, None)]):
            if after > first:
                found = tuple(jnp.where(k >= first, new, old) for new, old in zip(f(t), found))
        return found
    starts = [min(first, clock.samples) for first, _ in pieces] + [clock.samples]
    parts = [f((a + jnp.arange(b - a)) * clock.dt) for (_, f), a, b in zip(pieces, starts, starts[1:]) if b > a]
    return tuple(jnp.concatenate(column) for column in zip(*parts))
