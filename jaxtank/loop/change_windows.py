"""Changes of setpoints, for measures: windows of overshoot, rise and settling, and jumps."""
# pyright: reportUnknownMemberType=false

from typing import Any, cast

import jax.numpy as jnp
import numpy as np

from jaxtank.core.clock import Chunk, Clock, indices, sample_times
from jaxtank.core.vectors import columns, is_array, serves_arrays, take
from jaxtank.signals.base import sampled
from jaxtank.signals.setpoints import differs

AWAY = 0.01
"""Distance of the first level from a constant setpoint above which it counts as a change, as a
share of the setpoint [-]."""


def windows(loop: Any, times: Any, arrays: bool = False) -> Any:
    """Return the windows that overshoot, rise and settling refer to; or (samples, n) arrays."""
    # If the setpoint of an output does not change, a start away from it counts as a change at
    # t = 0: the step is setpoint minus level in `loop.x0`, if it is more than AWAY of the setpoint.
    reference: Any = loop.reference
    if arrays and serves_arrays(reference):
        return _array_windows(loop, times)
    channels = reference.windows(times)
    band = getattr(reference, "band", None)
    if channels is not None and band is not None:
        moving, t = moves(reference), sample_times(times)
        channels = tuple(
            tuple(
                jnp.where(moving[i], a, b)
                for a, b in zip(window, _from_start(window, t, loop.x0[output], band))
            )
            for i, (output, window) in enumerate(zip(loop.plant.outputs, channels))
        )
    return channels if channels is None or not arrays else tuple(columns(v) for v in zip(*channels))


def moves(reference: Any) -> Any:
    """Whether a target of each channel is not its first value: one that repeats it is no change."""
    if reference.known is not None:
        return reference.known["moves"]
    moving: list[Any] = [np.array(False)] * reference.channels
    for i in {channel for _, channel in reference.changes}:
        places = np.array([j for j, (_, channel) in enumerate(reference.changes) if channel == i])
        targets: Any = jnp.asarray(reference.targets)[places]
        moving[i] = jnp.any(differs(targets, reference.initial[i]))
    return moving


def _array_windows(loop: Any, times: Any) -> Any:
    """`windows` of a reference that serves arrays."""
    reference: Any = loop.reference
    if reference.changes is None:
        return None
    channels = reference.window_arrays(times)
    level = take(jnp.asarray(loop.x0), loop.plant.outputs)
    first = _from_start(channels, sample_times(times)[:, None], level, reference.band)
    moving = jnp.stack(moves(reference))
    return tuple(jnp.where(moving, b, a) for a, b in zip(first, channels))


def _from_start(window: Any, t: Any, level: Any, band: float) -> Any:
    """Return the window at times t of an output with a constant setpoint that starts at `level`."""
    target, none, _, _ = window
    step = jnp.where(jnp.abs(target - level) > AWAY * jnp.abs(target), target - level, none)
    return target, step, t, band * jnp.abs(step)


def jumps(loop: Any, times: Clock | Chunk, r: Any) -> Any:
    """Return whether a constant setpoint jumps, later by each delay: m vectors of booleans."""
    if loop.reference.known is not None:
        return loop.reference.known["jumps"]
    actuator = loop.actuator
    delays = getattr(actuator, "delays", ()) or (0.0,) * loop.plant.pumps
    later = [round((getattr(actuator, "delay", 0.0) + more) / times.dt) for more in delays]
    lead = 2 + max(later)
    series = columns(r)
    if isinstance(times, Chunk):  # the samples before it; before the first of a run as this one
        before = Chunk(first=times.first - lead, samples=lead, dt=times.dt)
        earlier = columns(sampled(loop.reference, cast(Any, before), is_array(r))[0])
        earlier = jnp.where(indices(before)[:, None] < 0, series[0], earlier)
    else:
        earlier = jnp.broadcast_to(series[0], (lead, series.shape[1]))
    series = jnp.concatenate([earlier, series])
    moves = jnp.any(series[1:] != series[:-1], axis=1)
    starts = moves[1:] & ~moves[:-1]
    delayed = {n: starts[lead - 2 - n :][: times.samples] for n in set(later)}
    series_of_pumps = tuple(delayed[n] for n in later)
    return columns(series_of_pumps) if is_array(r) else series_of_pumps
