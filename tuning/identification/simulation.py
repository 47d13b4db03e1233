"""A rig played by a log: what its sensors would have read, had the pumps been given what the log
says.
"""

import dataclasses
import functools
from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np

from jaxtank.core.clock import Clock
from jaxtank.core.errors import InputError
from jaxtank.core.numerics import clip
from jaxtank.core.tree import component, leaf, with_values
from jaxtank.instruments.base import Actuator
from jaxtank.instruments.sensors import LevelSensor
from jaxtank.plants.base import Plant
from jaxtank.plants.runge_kutta import advance
from jaxtank.signals.base import Constant
from jaxtank.xla.hoist import scan


@component
class Rig:
    """What of a closed loop a log plays: everything but the law and its observer. Names are those
    of the loop.
    """

    plant: Plant
    sensor: LevelSensor
    actuator: Actuator
    disturbance: Constant | None = None
    x0: np.ndarray = leaf("cm", "(n,) levels at the first sample", low=0.0)

    @property
    def units(self):
        """(length, pump input) of the rig."""
        return self.plant.units


def rig_of(loop):
    """The Rig of a loop. A constant disturbance belongs to it; one that comes and goes belonged to
    another run and does not. A transport delay is taken up by `shifted`.
    """
    disturbance = loop.disturbance if isinstance(loop.disturbance, Constant) else None
    if not isinstance(loop.sensor, LevelSensor):
        raise InputError(
            f"the sensor of this loop is a {type(loop.sensor).__name__}: experiment data are"
            " compared with the readings of a LevelSensor"
        )
    actuator = loop.actuator
    if actuator.delay:
        actuator = dataclasses.replace(cast(Any, actuator), delay=0.0)
    return Rig(
        plant=loop.plant, sensor=loop.sensor, actuator=actuator, disturbance=disturbance, x0=loop.x0
    )


class Record(NamedTuple):
    """Logs side by side, as arrays padded to the longest; the padding takes no time and counts for
    nothing.
    """

    dt: np.ndarray  # (logs, samples) time to the next sample [s], 0 at the last one and after
    u: np.ndarray  # (logs, samples, pumps)
    y: np.ndarray  # (logs, samples, channels), NaN where there is no reading
    channels: tuple  # ((tank, in volts), ...)


def record(logs, delay=0.0, samples=0):
    """The Record of Logs. delay: transport delay of the pumps [s]: an input reaches its tank at the
    first sample that is at least as late;
    samples: least length to pad to, so that logs cut short run through the program of the whole
        ones.
    """
    channels = tuple(sorted({pair for one in logs for pair in zip(one.tanks, one.in_volts)}))
    n = max(samples, *(one.samples for one in logs))
    dt, u = np.zeros((len(logs), n)), np.zeros((len(logs), n, logs[0].u.shape[1]))
    y = np.full((len(logs), n, len(channels)), np.nan)
    for e, one in enumerate(logs):
        dt[e, : one.samples - 1] = np.diff(one.t)
        u[e, : one.samples] = shifted(one, delay)
        for c, pair in enumerate(zip(one.tanks, one.in_volts)):
            y[e, : one.samples, channels.index(pair)] = one.y[:, c]
    return Record(dt, u, y, channels)


def shifted(one, delay):
    """(samples, pumps) inputs of a Log as they reach the tanks `delay` [s] later."""
    k = np.searchsorted(one.t, one.t - delay + 1e-9 * max(1.0, delay), side="right") - 1
    return one.u[np.maximum(k, 0)]


def readings(rig, dt, u, channels, substeps):
    """(samples, channels) what the sensors read, free of noise, in the channels' units.

    dt: (samples,) [s]; u: (samples, pumps) held until the next sample; each step is `substeps`
        steps of fourth-order Runge-Kutta.
    """
    x, d = tuple(rig.x0[i] + 0.0 * dt[0] for i in range(rig.plant.tanks)), None
    if rig.disturbance is not None:
        d = tuple(rig.disturbance.level[i] for i in range(rig.plant.tanks))
    state = jax.tree.map(
        lambda v: v + 0.0 * x[0] if jnp.issubdtype(jnp.result_type(v), jnp.floating) else v,
        rig.actuator.init(Clock(dt=1.0, duration=1.0)),
    )

    def body(carry, now):
        x, state = carry
        step, inputs = now
        out = tuple(_reading(rig, x, channel) for channel in channels)
        # a command past its limits is what a saturated pump was asked for
        inputs = tuple(
            clip(v, rig.actuator.low[j], rig.actuator.high[j]) for j, v in enumerate(inputs)
        )
        held = jnp.where(step > 0, step, 1.0)  # the padding at the end must not divide by nothing
        driven, state = rig.actuator.step(state, inputs, held)
        driven = rig.actuator.driving(driven)
        found = advance(rig.plant, "rk4", 0.0, x, driven, d, step, substeps, rolled=True)
        return (found.x, state), out

    xs = (dt, tuple(u[:, j] for j in range(rig.plant.pumps)))
    return jnp.stack(scan(body, (x, state), xs, length=dt.shape[0])[1], axis=-1)


def _reading(rig, x, channel):
    tank, in_volts = channel
    y = x[tank] if rig.sensor.offset is None else x[tank] + rig.sensor.offset[tank]
    return y / rig.sensor.gain[tank] if in_volts else y


@functools.partial(jax.jit, static_argnames=("coordinates", "tanks", "channels", "substeps"))
def passes(rig, dt, u, p, own, *, coordinates, tanks, channels, substeps):
    """(readings (logs, samples, channels), their derivatives (logs, samples, channels, shared +
    own)) of every log at once.

    p: (shared,) coordinates of what all logs have in common; own: (logs, len(tanks)) levels of
        `tanks` at the start of each log.
    """
    shared = coordinates.size

    def one(dt, u, own):
        def predicted(q):
            r = with_values(rig, coordinates.values(q[:shared]))
            r = with_values(r, {f"x0[{tank}]": q[shared + i] for i, tank in enumerate(tanks)})
            return readings(r, dt, u, channels, substeps)

        q = jnp.concatenate([p, own])

        def both(tangent):
            return jax.jvp(predicted, (q,), (tangent,))

        y, slopes = jax.vmap(both, out_axes=(None, -1))(jnp.eye(q.size, dtype=q.dtype))
        return y, slopes

    return jax.vmap(one)(dt, u, own)


@functools.partial(jax.jit, static_argnames=("channels", "substeps"))
def play(rig, dt, u, own, *, channels, substeps):
    """(logs, samples, channels) readings of a Rig whose levels start at own (logs, tanks)."""
    return jax.vmap(
        lambda dt, u, x0: readings(dataclasses.replace(rig, x0=x0), dt, u, channels, substeps)
    )(dt, u, own)


MOST_SUBSTEPS = 64


@functools.partial(jax.jit, static_argnames=("channels",))
def _tried(rig, dt, u, own, substeps, *, channels):
    """`play` with any number of steps: one program for all."""
    return jax.vmap(
        lambda dt, u, x0: readings(dataclasses.replace(rig, x0=x0), dt, u, channels, substeps)
    )(dt, u, own)


def substeps_for(rig, rec, own, error):
    """(how many steps each sample needs: twice as many move no reading by more than `error`
    (channels,), in the channels' units, at most 64; (channels,) by how much they do: NaN or
    infinite where the levels leave the numbers).
    """
    own, before, count = np.asarray(own), None, 1
    while count <= MOST_SUBSTEPS:
        y = np.asarray(_tried(rig, rec.dt, rec.u, own, count, channels=rec.channels))
        if before is not None:
            with np.errstate(invalid="ignore", over="ignore"):
                moved = np.max(np.abs(y - before), axis=(0, 1))
            if np.all(moved <= error):
                return count // 2, moved
        before, count = y, 2 * count
    return MOST_SUBSTEPS, moved
