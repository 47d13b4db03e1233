"""Inflow disturbances: volumes added to a tank for a while."""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxtank.core.clock import Clock, pointwise, sample_times
from jaxtank.core.errors import InputError
from jaxtank.core.tree import component, leaf, number, static
from jaxtank.signals.base import Signal
from jaxtank.xla.gather import gathered


@component
class InflowPulses(Signal):
    """Inflow pulses: volumes added to tanks at a constant rate, as an inflow per tank [cm^3/s].

    500 cm^3 over 1.1 s in gouta2022 (sec. 5.2; gouta2022 notes S3.2). The value of a sample is the
    mean over that sample, so that the whole volume arrives whatever the sampling period.

    Examples
    --------
    >>> pulse = InflowPulses(volume=[50.0], events=((1.0, 2.0, 0),), width=1)
    >>> pulse.sample(Clock(dt=1.0, duration=4.0))[0][0].tolist()
    [0.0, 25.0, 25.0, 0.0, 0.0]
    """

    volume: np.ndarray = leaf(
        "cm^3", "volume of each inflow pulse; negative: taken out", shape="pulse"
    )
    events: tuple = static(doc="((time [s], duration [s], tank), ...) one per inflow pulse")
    width: int = static("-", "number of tanks", low=1, high=5000)
    window: float = static(
        "s",
        "time after an inflow pulse in which the recovery of its tank is measured",
        low=0.0,
        strict=True,
        default=60.0,
    )

    @property
    def channels(self) -> int:
        return self.width

    @property
    def onset(self) -> tuple:
        return tuple(sorted(start for start, *_ in self.events))

    @pointwise
    def sample(self, clock: Clock) -> tuple[tuple, tuple, tuple]:
        t = sample_times(clock)
        flow = [jnp.zeros_like(t) for _ in range(self.width)]
        for j, (start, duration, tank) in enumerate(self.events):
            share = (jnp.minimum(t + clock.dt, start + duration) - jnp.maximum(t, start)) / (
                duration * clock.dt
            )
            flow[tank] = flow[tank] + self.volume[j] * jnp.maximum(share, 0.0)
        still = (jnp.zeros_like(t),) * self.width
        return tuple(flow), still, still

    arrays = True

    def sample_arrays(self, clock: Clock) -> tuple[Any, Any, Any]:
        """Return `sample` as three arrays (samples, tanks)."""
        t = sample_times(clock)[:, None]
        still = jnp.zeros((clock.samples, self.width))
        if not self.events:
            return still, still, still
        start, duration = (np.array([event[i] for event in self.events]) for i in (0, 1))
        end = start + duration
        share = (jnp.minimum(t + clock.dt, end) - jnp.maximum(t, start)) / (duration * clock.dt)
        tanks = tuple(tank for *_, tank in self.events)
        weights = jnp.asarray(self.volume)
        sums = jax.vmap(lambda row: gathered(weights, row, tanks, self.width))
        return sums(jnp.maximum(share, 0.0)), still, still

    @pointwise
    def since(self, clock: Clock) -> jax.Array:
        """Return (samples,) time since the last pulse began [s]; -1 for none within `window`."""
        t = sample_times(clock)
        since = -jnp.ones_like(t)
        for start in self.onset:
            after = t - start
            since = jnp.where(
                after >= -1e-7 * clock.dt, jnp.where(after <= self.window, after, -1.0), since
            )
        return since


def inflow_pulses(tanks: int, entries: Sequence[tuple[float, float, int, float]]) -> InflowPulses:
    """Return an `InflowPulses` built from a list.

    Parameters
    ----------
    tanks : number of tanks
    entries : (time [s], duration [s], tank counted from 0, volume [cm^3]) of each pulse

    Raises
    ------
    InputError for a time before 0, a duration of 0 and a tank that does not exist.

    Examples
    --------
    >>> inflow_pulses(2, [(500.0, 1.1, 1, 500.0)]).onset
    (500.0,)
    """
    for time, duration, tank, _ in entries:
        if not (time >= 0 and duration > 0 and 0 <= tank < tanks):
            raise InputError(
                f"inflow pulse at {time} s over {duration} s into tank {tank}: needs a time at or"
                f" after 0 s, a duration above 0 s and a tank from 0 to {tanks - 1}, counted from 0"
            )
    return InflowPulses(
        volume=number([volume for *_, volume in entries]),
        events=tuple(
            (float(time), float(duration), int(tank)) for time, duration, tank, _ in entries
        ),
        width=tanks,
    )
