"""Setpoints as functions of time: ramps and a sine.

Their samples are inputs of the loop: interpolating inside it would cost more than the plant does.
"""

import functools
import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxtank.core.checks import check_choice
from jaxtank.core.clock import Chunk, Clock, indices, pointwise, sample_times
from jaxtank.core.errors import InputError
from jaxtank.core.tree import POSITIVE, component, leaf, number, static
from jaxtank.core.vectors import columns
from jaxtank.signals.base import Signal
from jaxtank.xla.barrier import materialised

TOLERANCE = 5e-7  # part of a sample that is forgiven: 20 s is sample 2000 at 0.01 s


MANY = 60
"""Number of changes of one channel above which an array is searched, so that the program does not
grow with it; with fewer changes each one is a separate term, which is faster."""


class Many(NamedTuple):
    """The changes of a channel that has more than MANY."""

    starts: np.ndarray  # [s]
    targets: Any


REPEATED = 1e-9
"""Share of a setpoint by which another one differs that repeats it, in another unit, say [-]."""


def differs(target: Any, last: Any) -> Any:
    """Whether a target is another one than the last."""
    return jnp.abs(target - last) > REPEATED * jnp.maximum(jnp.abs(target), jnp.abs(last))


def index(time, clock):
    """Return the first sample at or after `time` [s]; of an array of times, an array."""
    if np.ndim(time):
        samples = np.ceil(np.minimum(time / clock.dt, 2.0**53) - TOLERANCE)
        return np.maximum(samples, 0.0).astype(np.int64)
    return max(0, math.ceil(min(time / clock.dt, 2.0**53) - TOLERANCE))


def channel(clock, initial, changes, duration, shape, lag=None):
    """Return (value, rate, second derivative) of one channel at the samples of a clock."""
    if isinstance(changes, Many):
        return _many(clock, initial, changes, duration, shape, lag)
    pieces: list[Any] = [(0, functools.partial(_flat, initial))]
    for start, target in changes:
        first = index(start, clock)
        level = pieces[-1][1](first, start)[0]
        course = functools.partial(_change, level, target, start, duration, shape, clock.dt)
        pieces.append((first, course))
    plain = _join(pieces, clock)
    if lag is None:
        return plain
    plain = materialised(plain)  # its bits are those without a filter
    filtered = _join(_filtered(initial, changes, duration, lag, clock), clock)
    return tuple(jnp.where(lag > 0, new, old) for new, old in zip(filtered, plain))


def _many(clock, initial, changes, duration, shape, lag):
    """`channel` with many changes: a scan gives the value before each, then one lookup."""
    starts, targets = changes
    first: Any = index(starts, clock)

    def look_up(begin, course):
        def follow(before, change):
            start, target, k, t = change
            return (after := course(before, start, target, k, t)[0]), after

        between = (starts[:-1], targets[:-1], first[1:], starts[1:])
        _, reached = jax.lax.scan(follow, begin, between)
        before = jax.tree.map(lambda a, b: jnp.concatenate([a[None], b]), begin, reached)
        k, t = indices(clock), sample_times(clock)
        which = jnp.searchsorted(first, k, side="right") - 1
        place = jnp.maximum(which, 0)
        at = jax.tree.map(lambda v: v[place], (before, jnp.asarray(starts), targets))
        courses = course(*at, k, t)[1]
        return tuple(jnp.where(which < 0, a, b) for a, b in zip(_flat(initial, k, t), courses))

    def plain(level, start, target, k, t):
        course = _change(level, target, start, duration, shape, clock.dt, k, t)
        return course[0], course

    start = jnp.asarray(initial, jnp.result_type(targets))
    value = look_up(start, plain)
    if lag is None:
        return value

    def filtered(before, start, target, k, t):
        level, state = before
        course = _lagged(level, state, target, start, duration, jnp.where(lag > 0, lag, 1.0), t)
        return course[:2], course[1:]

    behind = look_up((start, start), filtered)
    return tuple(jnp.where(lag > 0, new, old) for new, old in zip(behind, value))


def _change(level, target, start, duration, shape, dt, k, t):
    """Value, rate and second derivative of a change from `level` at samples k, times t >= start."""
    # The rate of a linear change at its last sample is its mean over that sample, so that rates add
    # up to the step for any duration, and depend on it continuously. Where the change ends on a
    # sample, the derivatives by the duration are those from below.
    to_go = (start + duration) / dt - k  # samples until the end
    tolerance = TOLERANCE + 4.0 * jnp.finfo(jnp.result_type(to_go)).eps * jnp.abs(to_go + k)
    moving = to_go > tolerance
    course = _linear if shape == "linear" else _quintic
    delta, whole = target - level, jnp.where(duration > 0, duration, 1.0)  # steps: never moving
    value, rate, second = course(level, delta, t - start, whole)
    if shape == "linear":
        # 1 at the last whole sample, with the slope of `left`
        edge = 1.0 + (to_go - jax.lax.stop_gradient(to_go))
        share = jnp.where(
            to_go > 1.0 + tolerance, 1.0, jnp.where(to_go > 1.0 - tolerance, edge, to_go)
        )
        rate = rate * share
    ended = _flat(target, k, t)
    return tuple(jnp.where(moving, a, b) for a, b in zip((value, rate, second), ended))


def _linear(level, delta, s, duration):
    # in this order: the bits of a run do not depend on whether the duration is traced
    slope, still = delta * (1.0 / duration), jnp.zeros_like(s)
    return level + s * slope, slope + still, still


def _quintic(level, delta, s, duration):
    x = s / duration
    value = x * x * x * (10.0 + x * (6.0 * x - 15.0))
    rate = 30.0 * x * x * (1.0 - x) * (1.0 - x) / duration
    second = 60.0 * x * (1.0 - x) * (1.0 - 2.0 * x) / duration**2
    return level + delta * value, delta * rate, delta * second


def _filtered(initial, changes, duration, lag, clock):
    """The pieces of a linear channel behind lag f' = r - f, f(0) = initial, solved exactly."""
    lag = jnp.where(lag > 0, lag, 1.0)
    pieces: list[Any] = [(0, functools.partial(_flat, initial))]
    at: Any = lambda t: (initial, initial)
    for start, target in changes:
        level, state = at(start)[:2]
        at = functools.partial(_lagged, level, state, target, start, duration, lag)
        pieces.append((index(start, clock), lambda k, t, at=at: at(t)[1:]))
    return pieces


def _lagged(level, state, target, start, duration, lag, t):
    """(r, f, f', f'') at times t of lag f' = r - f; r leaves `level` and f = `state` at `start`."""
    slope = jnp.where(duration > 0, (target - level) / jnp.where(duration > 0, duration, 1.0), 0.0)
    s = jnp.maximum(t - start, 0.0)
    ramp = _decay(level, state, slope, jnp.minimum(s, duration), lag)
    after = _decay(target, ramp[1], 0.0, jnp.maximum(s - duration, 0.0), lag)
    return tuple(jnp.where(s < duration, a, b) for a, b in zip(ramp, after))


def _decay(level, state, slope, s, lag):
    """(r, f, f', f'') a time s after f = `state`, with r = level + slope s."""
    decay, decayed = jnp.exp(-s / lag), jnp.expm1(-s / lag)
    distance = (state - level) * decay
    value = level + distance + slope * (s + lag * decayed)
    second = distance / lag**2 + slope / lag * decay
    return level + slope * s, value, -distance / lag - slope * decayed, second


def _flat(level, k, t):
    still = jnp.zeros_like(t)
    return level + still, still, still


def _join(pieces, clock):
    """The pieces of a channel, end to end; of a `Chunk` or of several channels, on all samples."""
    k, t = indices(clock), sample_times(clock)
    several = any(np.ndim(first) for first, _ in pieces)
    if several or isinstance(clock, Chunk):
        k, t = (k[:, None], t[:, None]) if several else (k, t)
        signal = pieces[0][1](k, t)
        for (first, f), (after, _) in zip(pieces[1:], [*pieces[2:], (math.inf, None)]):
            if several or after > first:
                signal = tuple(jnp.where(k >= first, new, old) for new, old in zip(f(k, t), signal))
        return signal
    starts = [min(first, clock.samples) for first, _ in pieces] + [clock.samples]
    parts = []
    for (_, f), a, b in zip(pieces, starts, starts[1:]):
        if b > a:
            k = a + jnp.arange(b - a)
            parts.append(f(k, k * clock.dt))
    return tuple(jnp.concatenate(column) for column in zip(*parts))


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

    With `filter` (linear changes only) the controller follows f instead, T f' = r - f, f(0) = r(0),
    solved exactly, and errors are those from f; overshoot, rise and settling refer to the targets.
    A time constant T of 0 changes no bit. Levels, D and T are leaves: derivatives by them are exact
    (where a change ends on a sample, those from below D).

    Examples
    --------
    >>> steps = ramps([3.0], [(1.0, 0, 8.0)], ramp=2.0)
    >>> steps.sample(Clock(dt=1.0, duration=4.0))[0][0].tolist()
    [3.0, 3.0, 5.5, 8.0, 8.0]
    """

    initial: np.ndarray = leaf("cm", "value before the first change", shape="channel")
    targets: np.ndarray = leaf("cm", "value after each change", shape="change")
    changes: tuple = static(doc="((time [s], channel), ...) in order of time")
    ramp: np.ndarray = leaf("s", "duration D of every change", low=0.0, default=lambda values: 60.0)
    filter: Any = leaf(
        "s",
        "time constant of a first-order filter behind the ramps; 0: none",
        low=0.0,
        like="initial",
        default=None,
        shape="channel",
    )
    shape: str = static(doc="course of a change", choices=SHAPES, default="linear")
    band: float = static(
        "-",
        "half width of the settling band, as a share of the step",
        low=0.0,
        high=1.0,
        strict=True,
        default=0.05,
    )
    begins: tuple = static("s", "(time of the first row,) of its table in a file", default=())

    @property
    def channels(self) -> int:
        return np.shape(self.initial)[0]

    @pointwise
    def sample(self, clock: Clock) -> tuple[tuple, tuple, tuple]:
        self._check_filter()
        courses = []
        for i in range(self.channels):
            lag = None if self.filter is None else self.filter[i]
            changes = self._changes_of(i)
            courses.append(channel(clock, self.initial[i], changes, self.ramp, self.shape, lag))
        value, rate, second = zip(*courses)
        return value, rate, second

    @pointwise
    def windows(self, clock: Clock) -> tuple:
        """Return the windows for overshoot and settling; the step is 0 before the first change.

        Returns
        -------
        Per channel (target [cm], step [cm], time since the change ended [s], settling band [cm]),
        arrays (samples,) each
        """
        t = sample_times(clock)
        return tuple(
            self._window(clock, t, self.initial[i], self._changes_of(i))
            for i in range(self.channels)
        )

    def _changes_of(self, i):
        """The changes of a channel: [(time, target)], or Many."""
        places = [j for j, (_, channel) in enumerate(self.changes) if channel == i]
        if len(places) > MANY:
            starts = np.array([self.changes[j][0] for j in places])
            return Many(starts, jnp.asarray(self.targets)[np.array(places)])
        return [(self.changes[j][0], self.targets[j]) for j in places]

    def _window(self, clock, t, last, changes):
        """(target, step, time since, band) at times t of one channel, or of several: arrays."""
        still = jnp.zeros_like(t)
        target, step, since = last + still, still, still
        if isinstance(changes, Many):
            starts = changes.starts
            levels = jnp.concatenate([jnp.asarray(last)[None], changes.targets])
            after = jnp.searchsorted(starts - 1e-7 * clock.dt, t, side="right")
            moves = jnp.where(differs(levels[1:], levels[:-1]), np.arange(len(starts)), -1)
            latest = jax.lax.cummax(moves)[jnp.maximum(after - 1, 0)]
            moved, latest = (after > 0) & (latest >= 0), jnp.maximum(latest, 0)
            step = jnp.where(moved, levels[latest + 1] - levels[latest], 0.0)
            since = jnp.where(moved, t - (jnp.asarray(starts)[latest] + self.ramp), 0.0)
            target = jnp.where(moved, levels[latest + 1], last)
            return target, step, since, self.band * jnp.abs(step)
        end = -jnp.inf
        for start, level in changes:
            after, moves = t >= start - 1e-7 * clock.dt, differs(level, last)
            counts = moves | (start < end)  # a target repeated in its own ramp begins that anew
            target = jnp.where(after & moves, level, target)
            step = jnp.where(after & moves, level - last, step)
            since = jnp.where(after & counts, t - (start + self.ramp), since)
            last, end = level, jnp.where(counts, start + self.ramp, end)
        return target, step, since, self.band * jnp.abs(step)

    arrays = True

    def sample_arrays(self, clock: Clock) -> tuple[Any, Any, Any]:
        """Return `sample` as three arrays (samples, channels)."""
        self._check_filter()
        if self.is_table:
            value, rate, second = map(columns, self.sample(clock))
            return value, rate, second

        def course(which, initial, changes):
            if not changes:
                still = jnp.zeros((clock.samples, 1))
                return initial + still, still, still
            lag = None if self.filter is None else jnp.asarray(self.filter)[which]
            return channel(clock, initial, changes, self.ramp, self.shape, lag)

        return self._by_count(clock, course)

    def window_arrays(self, clock: Clock) -> tuple[Any, Any, Any, Any]:
        """Return `windows` as four arrays (samples, channels)."""
        if self.is_table:
            target, step, since, band = map(columns, zip(*self.windows(clock)))
            return target, step, since, band
        t = sample_times(clock)[:, None]
        return self._by_count(clock, lambda which, *own: self._window(clock, t, *own))

    @property
    def is_table(self) -> bool:
        """Whether a channel has more changes than the program has pieces for."""
        counts = np.bincount([i for _, i in self.changes], minlength=1)
        return bool(counts.max() > MANY)

    def _by_count(self, clock, course) -> Any:
        """Arrays (samples, channels) of course(which, initial, changes), by number of changes."""
        by_channel = [[] for _ in range(self.channels)]
        for j, (_, i) in enumerate(self.changes):
            by_channel[i].append(j)
        initial, targets = jnp.asarray(self.initial), jnp.asarray(self.targets)
        order, parts = [], []
        for count in sorted({len(mine) for mine in by_channel}):
            which = np.array([i for i, mine in enumerate(by_channel) if len(mine) == count])
            places = np.array([by_channel[i] for i in which], dtype=int).reshape(len(which), count)
            changes = [
                (np.array([self.changes[j][0] for j in column]), targets[column])
                for column in places.T
            ]
            values = course(which, initial[which], changes)
            parts.append(tuple(jnp.broadcast_to(v, (clock.samples, len(which))) for v in values))
            order += list(which)
        back = np.argsort(order)
        return tuple(jnp.concatenate(part, axis=1)[:, back] for part in zip(*parts))

    def _check_filter(self):
        if self.filter is not None and self.shape != "linear":
            raise InputError(
                f"reference.filter: is for ramps, and reference.shape = {self.shape!r}: set the"
                " shape to 'linear', or leave the filter out"
            )

    def plateaus(self, until: float = math.inf) -> np.ndarray:
        """Return (plateaus, channels) values held between changes [cm], as host numbers.

        Those whose changes end before the next one and `until` [s].
        """
        now = np.array(self.initial, dtype=float)
        values = [now.copy()]
        by_time = {}
        for j, (start, i) in enumerate(self.changes):
            by_time.setdefault(start, []).append((i, float(self.targets[j])))
        starts = sorted(by_time)
        for start, following in zip(starts, [*starts[1:], math.inf]):
            for i, target in by_time[start]:
                now[i] = target
            if start + float(self.ramp) <= min(following, until):
                values.append(now.copy())
        return np.array(values)

    def held(self, until: float = math.inf) -> tuple[tuple[Any, ...], ...]:
        now = [self.initial[i] for i in range(self.channels)]
        values = {-1.0: tuple(now)}
        for j, (start, i) in enumerate(self.changes):
            if start < until:
                now[i] = self.targets[j]
                values[start] = tuple(now)
        return tuple(values.values())


@component
class Sine(Signal):
    """A raised sine that lasts a while: the moving part of benchmark 1 of gouta2022 (sec. 5.1).

        s(t) = offset + amplitude sin(2 pi (t - zero) / period)   for start <= t < end, else 0

    One channel of several moves, the others stay at 0. The rate is the derivative of the
    sine; jumps at the two ends have no impulse.

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
    period: float = static("s", "period", **POSITIVE)
    zero: float = static("s", "a time at which the sine rises through its mean")
    start: float = static("s", "when it begins", low=0.0)
    end: float = static("s", "when it ends", low=0.0)
    channel: int = static("-", "the channel that moves", low=0, high=5000)
    width: int = static("-", "number of channels", low=1, high=5000)

    @property
    def channels(self) -> int:
        return self.width

    @pointwise
    def sample(self, clock: Clock) -> tuple[tuple, tuple, tuple]:
        t, omega = sample_times(clock), 2.0 * math.pi / self.period
        inside = (t >= self.start - 1e-7 * clock.dt) & (t < self.end - 1e-7 * clock.dt)
        angle = omega * (t - self.zero)
        sine, cosine = self.amplitude * jnp.sin(angle), self.amplitude * jnp.cos(angle)
        course = (self.offset + sine, omega * cosine, -omega * omega * sine)
        moving = [jnp.where(inside, v, 0.0) for v in course]
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
    filter: Any = None,
) -> Ramps:
    """Return a `Ramps` built from a list.

    Parameters
    ----------
    initial : (channels,) values before the first change [cm]
    changes : (time [s], channel counted from 0, target [cm]) of each change
    ramp : duration of every change [s]; 0 gives steps
    shape : "linear" or "quintic"
    band : half width of the settling band, as a share of each step [-]
    filter : (channels,) time constants of a first-order filter behind the ramps [s]; None: none

    Raises
    ------
    InputError for a time before 0, a channel that does not exist and an unknown shape.

    Examples
    --------
    >>> ramps([3.0, 3.0], [(20.0, 0, 8.0)]).plateaus().tolist()
    [[3.0, 3.0], [8.0, 3.0]]
    """
    changes = sorted(changes, key=lambda change: change[0])
    for time, which, _ in changes:
        if not 0 <= which < len(initial):
            raise InputError(
                f"reference change at {time:g} s names channel {which}: there are {len(initial)},"
                " counted from 0"
            )
        if not time >= 0:
            raise InputError(f"reference change at {time} s: must be at or after 0 s")
    check_choice("reference.shape", shape, SHAPES)
    return Ramps(
        initial=number(initial),
        targets=number([target for _, _, target in changes]),
        changes=tuple((float(time), int(which)) for time, which, _ in changes),
        ramp=number(ramp),
        shape=shape,
        band=float(band),
        filter=None if filter is None else number(filter),
    )
