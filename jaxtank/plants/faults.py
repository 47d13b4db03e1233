"""Faults: parameters of the plant that change for a while.

Imports core and the role Plant; may be imported by every folder above.
"""

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
    of time, unknown to the controller.

    A pump at 60 %: ("pump_gain[0]", 300, 400) with factor 0.6 (gouta2022). A leak: ("drain[0]",
    900, 1050) with extra = its area (calofir). Built by `faults`.

    Examples
    --------
    >>> from jaxtank.plants import state_coupled_four_tank
    >>> weak = faults(state_coupled_four_tank(15.0), [("pump_gain[0]", 1.0, 2.0, 0.6, 0.0)])
    >>> weak.sample(Clock(dt=1.0, duration=3.0))[0].tolist()
    [0.0, 1.0, 0.0, 0.0]
    """

    factor: np.ndarray = leaf(
        "-", "what each entry is multiplied by while its fault lasts", low=0.0, shape=("fault",)
    )
    extra: np.ndarray = leaf("-", "what is added to it, in its own unit", shape=("fault",))
    windows: tuple[Any, ...] = static(
        doc='(("drain[1]", start [s], end [s]), ...) entry of the plant and when, one per fault'
    )

    @pointwise
    def sample(self, clock: Clock) -> tuple[Any, ...]:
        """Return an array (samples,) per fault: 1 from its start until before its end, else 0."""
        t = sample_times(clock)
        half = 1e-7 * clock.dt
        return tuple(
            jnp.where((t >= start - half) & (t < end - half), 1.0, 0.0)
            for _, start, end in self.windows
        )

    arrays = True

    def apply_arrays(self, plant: Plant, active: Sequence) -> Plant:
        """Return `apply` with arrays as leaves of the plant."""
        changed: dict[str, Any] = {}
        for k, (name, _, _) in enumerate(self.windows):
            field, (index,) = split_index(name)
            entries = changed.get(field, jnp.asarray(getattr(plant, field)))
            faulty = (
                entries * (1.0 + (self.factor[k] - 1.0) * active[k]) + self.extra[k] * active[k]
            )
            changed[field] = jnp.where(np.arange(entries.shape[0]) == index, faulty, entries)
        return dataclasses.replace(cast(Any, plant), **changed)

    def apply(self, plant: Plant, active: Sequence) -> Plant:
        """Return the plant of a sample; active: one number per fault, 1 while it lasts."""
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
    """Return a `Faults` built from a list.

    Parameters
    ----------
    plant : Plant
    entries : (entry of the plant, start [s], end [s], factor [-], extra [unit of the entry]) each

    Raises
    ------
    InputError for an entry that the plant does not have, and for a window that ends before it
    starts.

    Examples
    --------
    >>> from jaxtank.plants import state_coupled_four_tank
    >>> faults(state_coupled_four_tank(15.0), [("drain[0]", 9.0, 10.0, 1.0, 0.2)]).extra
    array([0.2])
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
