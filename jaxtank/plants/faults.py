"""Faults: parameters of the plant that change for a while, and readings that are wrong."""

import dataclasses
import functools
from collections.abc import Sequence
from typing import Any, NamedTuple, Self, cast

import jax.numpy as jnp
import numpy as np

from jaxtank.core.clock import Clock, pointwise, sample_times
from jaxtank.core.errors import InputError
from jaxtank.core.labels import label_of
from jaxtank.core.tree import (
    component,
    describe,
    get_value,
    leaf,
    number,
    split_index,
    static,
    with_entries,
)
from jaxtank.core.vectors import is_array
from jaxtank.plants.base import Plant

KINDS = ("offset", "drift", "freeze", "spikes", "noise")  # faults of sensors


class SensorFault(NamedTuple):
    """A fault of the sensor of a tank from `start` until before `end` [s], spikes `every` [s]."""

    tank: int
    kind: str
    start: float
    end: float
    every: float = 0.0


@component
class Faults:
    """Entries of the plant's leaves that are `factor` times themselves plus `extra` within a window
    of time, and readings that are wrong within one, unknown to the controller.

    A pump at 60 %: ("pump_gain[0]", 300, 400) with factor 0.6 (gouta2022). A leak: ("drain[0]",
    900, 1050) with extra = its area (calofir). Built by `faults`.

    A sensor with an offset, a drift, spikes of one sample or more noise sees its level plus
    `size` times 1, the time since its start, 1, or the deviate of its noise; then come its span and
    ADC. A frozen sensor repeats its last reading before its start, or its first one.

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
    size: Any = leaf(
        "cm",
        "size of each fault of a sensor; of a drift per second, of noise its standard deviation",
        like="factor",
        default=None,
        shape="sensor fault",
    )
    sensors: tuple[SensorFault, ...] = static(doc="faults of sensors", default=())

    @pointwise
    def sample(self, clock: Clock) -> tuple[Any, ...]:
        """Return an array (samples,) per fault: 1 from its start until before its end, else 0; of
        sensors what their size is multiplied by.
        """
        t = sample_times(clock)
        half = 1e-7 * clock.dt
        lasts = [
            jnp.where((t >= start - half) & (t < end - half), 1.0, 0.0)
            for _, start, end in self.events
        ]
        for k, fault in enumerate(self.sensors, len(self.windows)):
            since = t - fault.start
            if fault.kind == "drift":
                lasts[k] = lasts[k] * since
            elif fault.kind == "freeze":  # there is no reading before the first one
                lasts[k] = jnp.where(t > half, lasts[k], 0.0)
            elif fault.kind == "spikes":
                phase = since + half - fault.every * jnp.floor((since + half) / fault.every)
                lasts[k] = jnp.where(phase < clock.dt, lasts[k], 0.0)
        return tuple(lasts)

    @property
    def events(self) -> list[tuple[Any, float, float]]:
        """[(entry of the plant or "sensor n", start [s], end [s])] of all faults."""
        sensors = ((f"sensor {f.tank + 1}", f.start, f.end) for f in self.sensors)
        return [*self.windows, *sensors]

    @property
    def holds(self) -> bool:
        """Whether a sensor freezes, so that readings are carried from sample to sample."""
        return any(fault.kind == "freeze" for fault in self.sensors)

    @property
    def noisy(self) -> bool:
        """Whether a sensor has more noise for a while, so that a run needs a key."""
        return any(fault.kind == "noise" for fault in self.sensors)

    def without_noise(self) -> Self:
        """Return the faults without those that are noise."""
        quiet = [k for k, fault in enumerate(self.sensors) if fault.kind != "noise"]
        size = None if self.size is None else self.size[np.array(quiet, dtype=int)]
        sensors = tuple(self.sensors[k] for k in quiet)
        return dataclasses.replace(cast(Any, self), size=size, sensors=sensors)

    def unseen(self, clock: Clock) -> list[int]:
        """Return the `events` that no sample lies in which lasts for dt: they do nothing."""
        times, half = clock.dt * np.arange(clock.samples - 1), 1e-7 * clock.dt
        first, after = (
            np.searchsorted(times, [float(event[i]) - half for event in self.events])
            for i in (1, 2)
        )
        return np.flatnonzero(first == after).tolist()

    def problems(self, plant: Plant, clock: Clock) -> list[str]:
        """Return a sentence for each fault that leaves an entry's range or creates volume."""
        texts = []
        if np.shape(self.size if self.sensors else ()) != (len(self.sensors),):
            counts = f"{np.size(self.size)} sizes for {len(self.sensors)} faults of sensors"
            return [f"faults.size: {counts}: must be one for each"]
        for fault, size in zip(self.sensors, () if self.size is None else self.size):
            if fault.kind == "noise" and size < 0.0:
                texts.append(
                    f"noise of sensor {fault.tank + 1} from {fault.start:g} s to {fault.end:g} s:"
                    f" size = {float(size):g} {plant.units[0]}: must be at least 0"
                    f" {plant.units[0]}"
                )
        for k, (name, start, end) in enumerate(self.windows):
            field, (index,) = split_index(name)
            what = f"fault {k + 1} of {name} from {start:g} s to {end:g} s"
            if outside := self._out_of_range(plant, k, describe(plant, field)):
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
            faulty = self._faulty(k, active, entries)
            changed[field] = jnp.where(np.arange(entries.shape[0]) == index, faulty, entries)
        return dataclasses.replace(cast(Any, plant), **changed)

    def apply(self, plant: Plant, active: Sequence) -> Plant:
        """Return the plant of a sample; active: one number per fault, 1 while it lasts."""
        faulty = [functools.partial(self._faulty, k, active) for k in range(len(self.windows))]
        return with_entries(plant, zip((name for name, _, _ in self.windows), faulty))

    def seen(self, x: Any, xi: Any, active: Sequence) -> Any:
        """Return the levels that faulty sensors see; xi: deviates of their noise, None without."""
        quiet = ("freeze",) if xi is not None else ("freeze", "noise")
        for k, fault in enumerate(self.sensors):
            if fault.kind in quiet:
                continue
            error = cast(Any, self.size)[k] * active[len(self.windows) + k]
            error = error * cast(Any, xi)[fault.tank] if fault.kind == "noise" else error
            x = _with_entry(x, fault.tank, x[fault.tank] + error)
        return x

    def frozen(self, y: Any, last: Any, active: Sequence) -> Any:
        """Return readings with those of frozen sensors as they were a sample before, `last`."""
        for k, fault in enumerate(self.sensors, len(self.windows)):
            if fault.kind == "freeze":
                entry = jnp.where(active[k] > 0.0, last[fault.tank], y[fault.tank])
                y = _with_entry(y, fault.tank, entry)
        return y

    def _faulty(self, k, active, value):
        """`value` of an entry under fault k."""
        share = 1.0 + (self.factor[k] - 1.0) * active[k]
        return value * share + self.extra[k] * active[k]


def _with_entry(vector, index, value):
    """A vector of the loop with one entry replaced."""
    if is_array(vector):
        return jnp.where(np.arange(vector.shape[0]) == index, value, vector)
    return (*vector[:index], value, *vector[index + 1 :])


def faults(plant, entries, sensors=()):
    """Return a `Faults` built from lists.

    entries : (entry of the plant, start [s], end [s], factor, extra)
    sensors : (`SensorFault`, size)
    """
    for name, start, end, _, _ in entries:
        if np.ndim(get_value(plant, name)) != 0 or not split_index(name)[1]:
            raise InputError(f"fault of {name}: name one entry, as in {name}[0]")
        _check_window(name, start, end)
    for fault, _ in sensors:
        _check_window(f"sensor {fault.tank + 1}", fault.start, fault.end)
        if fault.kind == "spikes" and not fault.every > 0.0:
            raise InputError(f"spikes of sensor {fault.tank + 1}: every must be above 0 s")
    return Faults(
        factor=number([factor for *_, factor, _ in entries]),
        extra=number([extra for *_, extra in entries]),
        windows=tuple((name, float(start), float(end)) for name, start, end, _, _ in entries),
        size=number([size for _, size in sensors]) if sensors else None,
        sensors=tuple(fault for fault, _ in sensors),
    )


def _check_window(name, start, end):
    if not 0 <= start < end:
        raise InputError(
            f"fault of {name} from {start} s to {end} s: must start at or after 0 s and end later"
        )
