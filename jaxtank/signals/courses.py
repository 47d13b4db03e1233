"""The course of one setpoint channel: changes joined end to end, and a first-order filter behind.

Times of changes are part of the compiled program; levels, the duration of a change and the time
constant of the filter may be traced, and derivatives by them are exact.
"""

import functools
import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxtank.core.clock import Chunk, indices, sample_times
from jaxtank.xla.barrier import materialised

TOLERANCE = 5e-7
"""Part of a sample that is forgiven: 20 s is sample 2000 at 0.01 s."""


def index(time, clock):
    """Return the first sample at or after `time` [s]; of an array of times, an array."""
    if np.ndim(time):
        samples = np.ceil(np.minimum(time / clock.dt, 2.0**53) - TOLERANCE)
        return np.maximum(samples, 0.0).astype(np.int64)
    return max(0, math.ceil(min(time / clock.dt, 2.0**53) - TOLERANCE))


def channel(clock, initial, changes, duration, shape, lag=None):
    """Return (value, rate, second derivative) of one channel at the samples of a clock."""
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


def _change(level, target, start, duration, shape, dt, k, t):
    """Value, rate and second derivative of a change from `level` at samples k, times t >= start."""
    # The rate of a linear change at its last sample is its mean over that sample, so that rates add
    # up to the step for any duration, and depend on it continuously. Where the change ends on a
    # sample, the derivatives by the duration are those from below.
    left = (start + duration) / dt - k  # samples until the end
    tolerance = TOLERANCE + 4.0 * jnp.finfo(jnp.result_type(left)).eps * jnp.abs(left + k)
    moving = left > tolerance
    course = _linear if shape == "linear" else _quintic
    delta, whole = target - level, jnp.where(duration > 0, duration, 1.0)  # steps: never moving
    value, rate, second = course(level, delta, t - start, whole)
    if shape == "linear":
        # 1 at the last whole sample, with the slope of `left`
        edge = 1.0 + (left - jax.lax.stop_gradient(left))
        share = jnp.where(
            left > 1.0 + tolerance, 1.0, jnp.where(left > 1.0 - tolerance, edge, left)
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
    """(r, f, f', f'') at times t of lag f' = r - f, where r changes from `level` from `start` on,
    and f = `state` there.
    """
    slope = jnp.where(duration > 0, (target - level) / jnp.where(duration > 0, duration, 1.0), 0.0)
    s = jnp.maximum(t - start, 0.0)
    ramp = _decay(level, state, slope, jnp.minimum(s, duration), lag)
    after = _decay(target, ramp[1], 0.0, jnp.maximum(s - duration, 0.0), lag)
    return tuple(jnp.where(s < duration, a, b) for a, b in zip(ramp, after))


def _decay(level, state, slope, s, lag):
    """(r, f, f', f'') a time s after f = `state`, with r = level + slope s."""
    kept, gone = jnp.exp(-s / lag), jnp.expm1(-s / lag)
    left = (state - level) * kept
    value = level + left + slope * (s + lag * gone)
    second = left / lag**2 + slope / lag * kept
    return level + slope * s, value, -left / lag - slope * gone, second


def _flat(level, k, t):
    still = jnp.zeros_like(t)
    return level + still, still, still


def _join(pieces, clock):
    """The pieces of one channel, each evaluated on its own samples only, end to end; of a `Chunk`,
    which may lie anywhere, and of several channels, which change at other times each, on all.
    """
    k, t = indices(clock), sample_times(clock)
    if any(np.ndim(first) for first, _ in pieces):
        k, t = k[:, None], t[:, None]
        found = pieces[0][1](k, t)
        for first, f in pieces[1:]:
            found = tuple(jnp.where(k >= first, new, old) for new, old in zip(f(k, t), found))
        return found
    if isinstance(clock, Chunk):
        found = pieces[0][1](k, t)
        for (first, f), (after, _) in zip(pieces[1:], [*pieces[2:], (math.inf, None)]):
            if after > first:
                found = tuple(jnp.where(k >= first, new, old) for new, old in zip(f(k, t), found))
        return found
    starts = [min(first, clock.samples) for first, _ in pieces] + [clock.samples]
    parts = []
    for (_, f), a, b in zip(pieces, starts, starts[1:]):
        if b > a:
            k = a + jnp.arange(b - a)
            parts.append(f(k, k * clock.dt))
    return tuple(jnp.concatenate(column) for column in zip(*parts))
