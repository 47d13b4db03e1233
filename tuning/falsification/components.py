"""Parts of an attacked loop: readings with given errors, pumps that follow a plan, coefficients
that change in time.
"""

import dataclasses
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxtank.controllers.base import Controller
from jaxtank.core.clock import CHUNK, Clock, pointwise, sample_times
from jaxtank.core.numerics import clip
from jaxtank.core.records import Estimate, Tick
from jaxtank.core.tree import component, leaf, split_index, static
from jaxtank.instruments.base import Sensor
from jaxtank.plants.faults import Faults


@component
class GivenErrors(Sensor):
    """Readings y = h + error, a given error of each sample; an ADC reads no more than `top`."""

    error: Any = leaf("cm", "error of each tank's reading at each sample", shape=("sample", "tank"))
    top: tuple = static("cm", "highest level that can be read, None without an ADC")

    def draw(
        self, key: jax.Array | None, samples: int, piece: Any | None = None
    ) -> tuple[Any, ...]:
        """Return the (n) errors (samples,) [cm] of a run, or of the chunk `piece` of it."""
        error = jnp.asarray(self.error)
        if piece is not None:
            error = jax.lax.dynamic_slice_in_dim(error, piece * CHUNK, samples, 1)
        return tuple(error[i, :samples] for i in range(error.shape[0]))

    def step(
        self, state: Any, x: Sequence[Any], xi: Sequence[Any] | None, dt: Any
    ) -> tuple[Sequence[Any], Any]:
        assert xi is not None  # `draw`
        y = tuple(h + e for h, e in zip(x, xi))
        return tuple(v if t is None else clip(v, 0.0, t) for v, t in zip(y, self.top)), state


@component
class PumpPlan(Controller):
    """Commands that are constant over windows of equal length, whatever the levels."""

    command: Any = leaf("V", "command of each window and pump", shape=("window", "pump"))
    length: Any = leaf("s", "length of a window", low=0.0, strict=True)

    @pointwise
    def inputs(self, clock: Clock) -> Any:
        """Return the (m) commands (samples,) [V]."""
        command = jnp.asarray(self.command)
        window = _window(clock, self.length, command.shape[0])
        return tuple(command[window, j] for j in range(command.shape[1]))

    def step(self, state: Any, tick: Tick, estimate: Estimate) -> tuple[Sequence[Any], Any]:
        return tick.own, state

    @property
    def reads_model(self) -> bool:
        return False


@component
class Course:
    """Entries of the plant whose values are constant over windows of equal length, unknown to
    controller and filter; takes the place of a loop's `Faults`, which follow in `then`.
    """

    value: Any = leaf(
        "-", "value of each entry in each window, in its own unit", shape=("window", "entry")
    )
    length: Any = leaf("s", "length of a window", low=0.0, strict=True)
    names: tuple[str, ...] = static(doc="entries of the plant, as drain[1]")
    then: Faults | None = None

    @pointwise
    def sample(self, clock: Clock) -> tuple[Any, Any]:
        """Return (values (samples,) of each entry, samples of the faults that follow)."""
        value = jnp.asarray(self.value)
        window = _window(clock, self.length, value.shape[1])
        own = tuple(value[i, window] for i in range(value.shape[0]))
        return own, () if self.then is None else self.then.sample(clock)

    def apply(self, plant: Any, active: Sequence[Any]) -> Any:
        """Return the plant of a sample; active: a sample of `sample`."""
        own, then = active
        changed = {}
        for name, v in zip(self.names, own):
            field, (index,) = split_index(name)
            value = getattr(plant, field)
            entries = changed.setdefault(field, [value[i] for i in range(np.shape(value)[0])])
            entries[index] = v
        plant = dataclasses.replace(plant, **{f: tuple(e) for f, e in changed.items()})
        return plant if self.then is None else self.then.apply(plant, then)


def _window(clock, length, count):
    """(samples,) index of the window of `length` [s] in which each sample lies."""
    window = jnp.floor((sample_times(clock) + 1e-7 * clock.dt) / length).astype(int)
    return jnp.clip(window, 0, count - 1)
