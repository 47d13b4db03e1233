"""Inflow disturbances: volumes added to a tank for a while, and measured inflows."""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxtank.core.checks import check_choice
from jaxtank.core.clock import Clock, pointwise, sample_times
from jaxtank.core.errors import InputError
from jaxtank.core.tree import POSITIVE, component, leaf, number, static
from jaxtank.signals.base import BETWEEN, Signal
from jaxtank.xla.gather import gathered

SHORTEST, WATCHED = 60.0, 5.0
"""How long recovery from an inflow pulse is watched: s, and in durations of the longest pulse."""


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
        **POSITIVE,
        default=SHORTEST,
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
            share = jnp.minimum(t + clock.dt, start + duration) - jnp.maximum(t, start)
            share = share / (duration * clock.dt)
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
        for after in (t - start for start in self.onset):
            begun, recent = after >= -1e-7 * clock.dt, after <= self.window
            since = jnp.where(begun, jnp.where(recent, after, -1.0), since)
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
    longest = max((duration for _, duration, *_ in entries), default=0.0)
    volume = number([volume for *_, volume in entries])
    events = tuple((float(time), float(span), int(tank)) for time, span, tank, _ in entries)
    window = max(SHORTEST, WATCHED * longest)
    return InflowPulses(volume=volume, events=events, width=tanks, window=window)


@component
class InflowTable(Signal):
    """Measured inflows: rows of time and flow, as an inflow per tank [cm^3/s].

    Between rows the last one is held ("hold") or a straight line joins them ("linear"); the first
    row also holds before its time, and the last one after it. The value of a sample is the mean
    over that sample, so that the whole volume arrives whatever the sampling period. Several tables
    of one tank add up. Built by `inflow_table`.

    Examples
    --------
    >>> table = inflow_table(1, [(0, [0.0, 1.5, 3.0], [2.0, 4.0, 0.0])])
    >>> table.sample(Clock(dt=1.0, duration=3.0))[0][0].tolist()
    [2.0, 3.0, 4.0, 0.0]
    """

    flow: np.ndarray = leaf("cm^3/s", "inflow from each row on, table after table", shape="row")
    rows: tuple = static(
        doc="((tank, what is between its rows, times [s] of its rows), ...), one per table"
    )
    width: int = static("-", "number of tanks", low=1, high=5000)
    records: tuple = static(doc="numbers of the tables that are rows of a file", default=())

    is_table = True

    @property
    def channels(self) -> int:
        return self.width

    def tables(self) -> list[tuple[int, str, Any, Any]]:
        """Return (tank, what is between rows, times [s], flows [cm^3/s]) of each table; the first
        row may be later than 0 s.
        """
        ends = np.cumsum([0, *(len(times) for *_, times in self.rows)])
        return [
            (tank, between, np.array(times), self.flow[a:b])
            for (tank, between, times), a, b in zip(self.rows, ends, ends[1:])
        ]

    def from_start(self) -> list[tuple[int, str, Any, Any]]:
        """`tables` with the first row at 0 s too, as it also holds before its time."""
        join = (np if isinstance(self.flow, np.ndarray) else jnp).concatenate
        return [
            (tank, between, np.insert(times, 0, 0.0), join([rows[:1], rows]))
            if times[0] > 0.0
            else (tank, between, times, rows)
            for tank, between, times, rows in self.tables()
        ]

    @pointwise
    def sample(self, clock: Clock) -> tuple[tuple, tuple, tuple]:
        still = jnp.zeros_like(sample_times(clock))
        flow = [still] * self.width
        for tank, between, times, rows in self.from_start():
            flow[tank] = flow[tank] + _means(clock, times, rows, between == "linear")
        return tuple(flow), (still,) * self.width, (still,) * self.width

    def steady(self, duration: float | None = None) -> Any:
        """Return the (tanks,) mean flow of a run [cm^3/s]; None: up to the last row."""
        mean = [0.0 * self.flow[0]] * self.width
        for tank, between, times, rows in self.from_start():
            if len(times) == 1:
                mean[tank] = mean[tank] + rows[0]
                continue
            end = times[-1] if duration is None else duration
            shares = _shares_of_mean(times, end, between == "linear")
            mean[tank] = mean[tank] + (rows * shares).sum()
        return self._stacked(mean)

    def at_start(self) -> Any:
        """Return the (tanks,) flow at t = 0 [cm^3/s]."""
        flow = [0.0 * self.flow[0]] * self.width
        for tank, between, times, rows in self.tables():
            k = max(int(np.searchsorted(times, 0.0, side="right")) - 1, 0)
            first = rows[k]
            if between == "linear" and times[k] < 0.0 and k + 1 < len(times):
                first = first - (rows[k + 1] - rows[k]) * times[k] / (times[k + 1] - times[k])
            flow[tank] = flow[tank] + first
        return self._stacked(flow)

    def _stacked(self, flows):
        return (np if isinstance(self.flow, np.ndarray) else jnp).stack(flows)


def _shares_of_mean(times, end, linear):
    """(rows,) share of each row in the mean flow from the first row to `end`."""
    begun = int(np.searchsorted(times, end))
    spans = np.diff([*times[:begun], end])
    following = np.zeros(begun)  # share of the next row in each span
    if linear:
        between = min(begun, len(times) - 1)
        following[:between] = 0.5 * spans[:between] / np.diff(times)[:between]
    shares = np.zeros(len(times) + 1)
    shares[:begun] = spans * (1.0 - following)
    shares[1 : begun + 1] += spans * following
    return shares[:-1] / spans.sum()


def _means(clock, times, rows, linear):
    """(samples,) means over each sample of the course through rows of flow."""
    # Within a row the mean is that of its ends. Over more rows volumes add up: the rest of the
    # first, those between from a running sum, and the begun part of the last.
    rows, spans = jnp.asarray(rows), np.diff(times)
    slopes = jnp.diff(rows) / spans if linear else jnp.zeros(len(spans))
    slopes = jnp.append(slopes, 0.0)
    volumes = spans * (rows[:-1] + 0.5 * slopes[:-1] * spans)
    volumes = jnp.concatenate([jnp.zeros(1), jnp.cumsum(volumes)])
    t, near = sample_times(clock), 1e-7 * clock.dt
    end = t + clock.dt
    # a row within the tolerance of a sample begins with it
    end_row = len(times) - 1
    place = lambda at: jnp.clip(jnp.searchsorted(times, at, side="right") - 1, 0, end_row)
    first, last = place(t + near), place(end - near)
    past = lambda row, moment: moment - jnp.asarray(times)[row]
    flow = lambda row, moment: rows[row] + slopes[row] * past(row, moment)
    within = 0.5 * (flow(first, t) + flow(first, end))
    following = jnp.minimum(first + 1, end_row)
    until = jnp.asarray(times)[following]
    rest = (until - t) * 0.5 * (flow(first, t) + flow(first, until))
    begun = past(last, end) * 0.5 * (rows[last] + flow(last, end))
    across = (rest + (volumes[last] - volumes[following]) + begun) / clock.dt
    return jnp.where(first == last, within, across)


def inflow_table(
    tanks: int, tables: Sequence[tuple[int, Any, Any]], between: str | Sequence[str] = "hold"
) -> InflowTable:
    """Return an `InflowTable` built from arrays.

    Parameters
    ----------
    tanks : number of tanks
    tables : (tank counted from 0, (rows,) times [s], (rows,) flows [cm^3/s]) of each table, a
        negative flow taken out
    between : "hold" or "linear", of all tables or one per table

    Raises
    ------
    InputError for times before 0 or that do not increase, arrays of different lengths and a tank
    that does not exist.

    Examples
    --------
    >>> float(inflow_table(2, [(1, [0.0, 60.0], [5.0, 7.0])]).flow[1])
    7.0
    """
    rows, flows = [], []
    kinds = [between] * len(tables) if isinstance(between, str) else between
    for kind, (tank, times, flow) in zip(kinds, tables, strict=True):
        times, flow = number(times), number(flow)
        good = times.ndim == 1 and times.shape == flow.shape and times.size > 0
        if not (good and times[0] >= 0.0 and np.all(np.diff(times) > 0.0) and 0 <= tank < tanks):
            raise InputError(
                f"inflow table of tank {tank}: needs a tank from 0 to {tanks - 1}, counted from 0,"
                " and as many flows as times, which increase from 0 s or later"
            )
        check_choice("between", kind, BETWEEN)
        rows.append((int(tank), kind, tuple(times.tolist())))
        flows.append(flow)
    return InflowTable(flow=np.concatenate(flows), rows=tuple(rows), width=int(tanks))
