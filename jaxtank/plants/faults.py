"""Faults: parameters of the plant that change for a while."""

import dataclasses
from collections.abc import Sequence
from typing import Any, cast

import jax.numpy as jnp
import numpy as np

from jaxtank.core.clock import Clock, pointwise, sample_times
from jaxtank.core.errors import InputError
from jaxtank.core.labels import label_of
from jaxtank.core.tree import component, describe, get_value, leaf, number, split_index, static
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
        "-", "what each entry is multiplied by while its fault lasts", low=0.0, shape="fault"
    )
    extra: np.ndarray = leaf("-", "what is added to it, in its own unit", shape="fault")
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

    def unseen(self, clock: Clock) -> list[int]:
        """Return the faults that no sample lies in which lasts for dt: they do nothing."""
        times, half = clock.dt * np.arange(clock.samples - 1), 1e-7 * clock.dt
        first, after = (
            np.searchsorted(times, [float(window[i]) - half for window in self.windows])
            for i in (1, 2)
        )
        return np.flatnonzero(first == after).tolist()

    def problems(self, plant: Plant, clock: Clock) -> list[str]:
        """Return a sentence for each fault that leaves an entry's range or creates volume."""
        texts = []
        for k, (name, start, end) in enumerate(self.windows):
            field, (index,) = split_index(name)
            what = f"fault {k + 1} of {name} from {start:g} s to {end:g} s"
            meta = describe(plant, field)
            if outside := self._out_of_range(plant, k, meta):
                texts.append(f"{what}: {outside}")
            elif field in ("area", "extent") and not self._lasts(k, clock):
                texts.append(
                    f"{what}: volume would come from nowhere as the {field} changes: must last for"
                    f" the whole run, from 0 s to {clock.duration:g} s or later"
                )
            elif field == "caught":
                texts += self._caught_twice(what, plant, index, start)
        return texts

    def _out_of_range(self, plant, k, meta):
        """The range of an entry that fault k leaves, in words; None where it stays inside."""
        name, start, end = self.windows[k]
        unit = "" if meta["unit"] == "-" else f" {meta['unit']}"
        ends = [e for other, _, e in self.windows if other == name and start < e < end]
        values = [self._value(plant, name, time) for time in (start, *ends)]
        value, largest, low, high = min(values), max(values), meta["low"], meta["high"]
        # a pump may stand still
        strict = split_index(name)[0] in ("area", "rim", "extent", "rangeability")
        if low is not None and (value <= low if strict else value < low):
            words = "above" if strict else "at least"
            return f"makes it {value:g}{unit}: must be {words} {low:g}{unit}"
        if high is not None and largest > high:
            return f"makes it {largest:g}{unit}: must be at most {high:g}{unit}"
        return None

    def _value(self, plant, name, time):
        """The value of an entry of the plant at a time."""
        value = float(get_value(plant, name))
        for k, (other, start, end) in enumerate(self.windows):
            if other == name and start <= time < end:
                value = value * float(self.factor[k]) + float(self.extra[k])
        return value

    def _lasts(self, k, clock):
        """Whether fault k lasts from the first sample to the last one that lasts for dt."""
        _, start, end = self.windows[k]
        half = 1e-7 * clock.dt
        return start <= half and end - half > (clock.samples - 2) * clock.dt

    def _caught_twice(self, what, plant, index, time):
        """A sentence where more than all that passes a rim is caught."""
        network: Any = plant
        spills = network.spills
        source = spills[index][0]
        siblings = [i for i, spill in enumerate(spills) if spill[0] == source]
        total = sum(self._value(plant, f"caught[{i}]", time) for i in siblings)
        if total <= 1.0 + 1e-9:
            return []
        return [
            f"{what}: {total:g} of what passes the rim of {label_of(plant, 'tank', source)} is then"
            " caught: must be at most 1"
        ]

    arrays = True

    def apply_arrays(self, plant: Plant, active: Sequence) -> Plant:
        """Return `apply` with arrays as leaves of the plant."""
        changed: dict[str, Any] = {}
        for k, (name, _, _) in enumerate(self.windows):
            field, (index,) = split_index(name)
            entries = changed.get(field, jnp.asarray(getattr(plant, field)))
            faulty = self._faulty(k, entries, active)
            changed[field] = jnp.where(np.arange(entries.shape[0]) == index, faulty, entries)
        return dataclasses.replace(cast(Any, plant), **changed)

    def apply(self, plant: Plant, active: Sequence) -> Plant:
        """Return the plant of a sample; active: one number per fault, 1 while it lasts."""
        changed = {}
        for k, (name, _, _) in enumerate(self.windows):
            field, (index,) = split_index(name)
            whole = getattr(plant, field)
            entries = changed.setdefault(field, [whole[i] for i in range(np.shape(whole)[0])])
            entries[index] = self._faulty(k, entries[index], active)
        return dataclasses.replace(
            cast(Any, plant), **{field: tuple(entries) for field, entries in changed.items()}
        )

    def _faulty(self, k, value, active):
        """`value` of an entry under fault k."""
        share = 1.0 + (self.factor[k] - 1.0) * active[k]
        return value * share + self.extra[k] * active[k]


def faults(plant, entries):
    """Return a `Faults` built from a list."""
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
