"""What breaks while a rig runs: parameters of the plant that change for a while."""

import dataclasses
from collections.abc import Sequence
from typing import Any, cast

import jax.numpy as jnp
import numpy as np

from jaxtank.core.clock import Clock, pointwise, sample_times
from jaxtank.core.errors import InputError
from jaxtank.core.tree import component, get_value, leaf, number, split_index, static
from jaxtank.plants.base import Plant


@component
class Faults:
    """Entries of the plant's leaves that are `factor` times themselves plus `extra` within a window
    of time; the law is not told.

    A pump at 60 %: ("pump_gain[0]", 300, 400) with factor 0.6 (gouta2022). A leak: ("drain[0]",
    900, 1050) with extra = its area (calofir).
    """

    factor: np.ndarray = leaf(
        "-", "(faults,) what each entry is multiplied by while its fault lasts", low=0.0
    )
    extra: np.ndarray = leaf("-", "(faults,) what is added to it, in its own unit")
    windows: tuple[Any, ...] = static(
        doc='(("drain[1]", start [s], end [s]), ...) entry of the plant and when, one per fault'
    )

    @pointwise
    def sample(self, clock: Clock) -> tuple:
        """Tuple of arrays (samples,), one per fault: 1 from its start until before its end, else 0."""
        t = sample_times(clock)
        half = 1e-7 * clock.dt
        return tuple(
            jnp.where((t >= start - half) & (t < end - half), 1.0, 0.0)
            for _, start, end in self.windows
        )

    def apply(self, plant: Plant, active: Sequence) -> Plant:
        """The plant of a sample; active: one number per fault, 1 while it lasts."""
        changed = {}
        for k, (name, _, _) in enumerate(self.windows):
            field, (index,) = split_index(name)
            entries = changed.setdefault(
                field, [getattr(plant, field)[i] for i in range(np.shape(getattr(plant, field))[0])]
            )
            entries[index] = (
                entries[index] * (1.0 + (self.factor[k] - 1.0) * active[k])
                + self.extra[k] * active[k]
            )
        return dataclasses.replace(
            cast(Any, plant), **{field: tuple(entries) for field, entries in changed.items()}
        )


def faults(plant, entries):
    """A `Faults` from a list of (entry of `plant`, start [s], end [s], factor [-], extra [unit of
    the entry]).

    Raises InputError for an entry that the plant does not have, and for a window that ends before
    it starts.
    """
    for name, start, end, _, _ in entries:
        if np.ndim(get_value(plant, name)) != 0 or not split_index(name)[1]:
            raise InputError(f"fault of {name}: name one entry, as in {name}[0]")
        if not 0 <= start < end:
            raise InputError(
                f"fault of {name} from {start} s to {end} s: must start at or after 0 s and end"
                " later"
            )
    return Faults(
        factor=number([factor for *_, factor, _ in entries]),
        extra=number([extra for *_, extra in entries]),
        windows=tuple((name, float(start), float(end)) for name, start, end, _, _ in entries),
    )
