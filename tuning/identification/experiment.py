"""Experiment data: sample times, the inputs of the pumps, the readings of the level sensors."""

import dataclasses
from collections.abc import Sequence

import jax
import numpy as np
from numpy.typing import ArrayLike

from jaxtank.core.errors import DataError, InputError
from jaxtank.core.units import DEFAULT, FLOWS, LENGTHS, VOLTS, canonical

HOLDS = ("", "zero-order", "first-order")
"""What inputs do between samples; "": not known, zero-order where samples are regular."""


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Log:
    """Experiment data of one run, as arrays on the host; made by `tuning.log` or `read_log`.

    Attributes
    ----------
    t : (samples,) array
        Sample times [s], increasing.
    u : (samples, pumps) array
        Pump inputs in the rig's unit; between samples as `hold` says.
    y : (samples, channels) array
        Readings, NaN where one is missing.
    tanks : tuple of int
        Tank that each channel measures, counted from 0.
    in_volts : tuple of bool
        For each channel whether it is the sensor's voltage (True) or a level in the rig's unit of
        length.
    name : str
        Name in messages.
    lines : (samples,) array or None
        Line of the file that holds each sample.
    headers, units : tuple or None
        Column names in the file, and the units they were in: of t, of u and of y.
    hold : {"", "zero-order", "first-order"}
        As in `tuning.log`.

    Examples
    --------
    >>> import numpy as np, tuning
    >>> data = tuning.log(t=[0.0, 1.0, 2.0], u=[3.0, 3.0, 3.5], y=[1.0, np.nan, 1.2])
    >>> data.samples, data.u.shape, data.tanks
    (3, (3, 1), (0,))
    >>> print(data.part(1, 3).t)
    [1. 2.]
    """

    t: np.ndarray
    u: np.ndarray
    y: np.ndarray
    tanks: tuple
    in_volts: tuple
    name: str = "log"
    lines: np.ndarray | None = None
    headers: tuple | None = None
    units: tuple | None = None
    hold: str = ""

    @property
    def samples(self) -> int:
        """Number of samples [-]."""
        return len(self.t)

    def part(self, start: int, stop: int | None) -> "Log":
        """Return the samples start .. stop - 1 as a Log."""
        cut = slice(start, stop)
        lines = None if self.lines is None else self.lines[cut]
        return dataclasses.replace(self, t=self.t[cut], u=self.u[cut], y=self.y[cut], lines=lines)

    def where(self, k: int | None = None, column: int | None = None) -> str:
        """Return the place of sample k for a message: its line in the file, or its number.

        column: index over the columns t, u, y.
        """
        place = self.name
        if k is not None:
            place += f", sample {k + 1}" if self.lines is None else f", line {self.lines[k]}"
        if column is None or self.headers is None:
            return place
        return f"{place}, column {self.headers[column]!r}"

    def slot(self, column: int) -> str:
        """Return the rig's name of a column: t, pump1, .., h1, .."""
        pumps = self.u.shape[1]
        if column == 0:
            return "t"
        return f"pump{column}" if column <= pumps else f"h{self.tanks[column - 1 - pumps] + 1}"


def log(
    *,
    t: ArrayLike,
    u: ArrayLike,
    y: ArrayLike,
    tanks: Sequence[int] | None = None,
    in_volts: Sequence[bool] | None = None,
    name: str = "log",
    lines: ArrayLike | None = None,
    headers: tuple | None = None,
    units: tuple | None = None,
    hold: str = "",
) -> Log:
    """Return experiment data from arrays, for `tuning.identify`.

    Parameters
    ----------
    t : (samples,) array
        Sample times [s], increasing; at least two.
    u : (samples,) or (samples, pumps) array
        Pump inputs in the rig's unit, one for each sample.
    y : (samples,) or (samples, channels) array
        Readings, NaN where one is missing. A sample without a reading gives the time at which an
        input changed between two readings.
    tanks : sequence of int, optional
        Tank of each channel, counted from 0; 0, 1, ... by default.
    in_volts : sequence of bool, optional
        Whether each channel is the sensor's voltage; False by default: a level in the rig's unit.
    name, lines, headers, units
        As in `Log`, for messages.
    hold : {"", "zero-order", "first-order"}
        Inputs between samples: "zero-order", each held until the next sample; "first-order", a
        straight line from sample to sample. "": zero-order; `identify` refuses it where readings
        come at irregular times and inputs change from one to the next.

    Returns
    -------
    Log

    Raises
    ------
    DataError
        For shapes that do not agree, inputs that are not finite, and times that do not increase.
    InputError
        For an unknown `hold`.

    Examples
    --------
    >>> import tuning
    >>> data = tuning.log(t=[0.0, 1.0], u=[[3.0, 2.8], [3.0, 2.8]], y=[[1.0], [1.2]], tanks=[1])
    >>> data.samples, data.tanks
    (2, (1,))
    >>> tuning.log(t=[0.0, 0.0], u=[3.0, 3.0], y=[1.0, 1.2])  # doctest: +ELLIPSIS
    Traceback (most recent call last):
    ...
    jaxtank.core.errors.DataError: log, sample 2: time 0 s is that of the sample before: times ...
    """
    check_hold(hold)
    t, u, y = _arrays(name, t, u, y)
    tanks = tuple(range(y.shape[1])) if tanks is None else tuple(int(i) for i in tanks)
    in_volts = (False,) * len(tanks) if in_volts is None else tuple(bool(v) for v in in_volts)
    if not len(tanks) == len(in_volts) == y.shape[1]:
        raise DataError(
            f"{name}: {y.shape[1]} channels of levels, but {len(tanks)} tanks and {len(in_volts)}"
            " units named"
        )
    if len(set(tanks)) < len(tanks):
        raise DataError(f"{name}: a tank is measured by two columns")
    found = Log(
        t=t,
        u=u,
        y=y,
        tanks=tanks,
        in_volts=in_volts,
        name=name,
        lines=None if lines is None else np.asarray(lines),
        headers=headers,
        units=units,
        hold=hold,
    )
    if len(t) < 2:
        raise DataError(
            f"{name}: has {len(t)} sample{'s' if len(t) != 1 else ''}, at least 2 are needed"
        )
    _check_finite(found)
    _check_times(found)
    return found


def check_hold(hold: str) -> None:
    """Raise InputError for what inputs cannot do between samples."""
    if hold not in HOLDS:
        raise InputError(f"hold = {hold!r}: must be one of {', '.join(HOLDS[1:])}")


def _arrays(name, t, u, y):
    """Return (samples,), (samples, pumps) and (samples, channels) arrays; raise DataError."""
    try:
        t, u, y = (np.asarray(v, dtype=float) for v in (t, u, y))
    except (TypeError, ValueError):
        raise DataError(f"{name}: t, u and y must be arrays of numbers") from None
    u, y = (v[:, None] if v.ndim == 1 else v for v in (u, y))
    if t.ndim != 1 or u.ndim != 2 or y.ndim != 2 or not len(t) == len(u) == len(y):
        raise DataError(
            f"{name}: t, u and y have shapes {t.shape}, {u.shape}, {y.shape}: must share their"
            " first dimension"
        )
    return t, u, y


def _check_finite(found):
    """Raise DataError for a time or an input that is not finite, or a reading that is infinite."""
    table = np.concatenate([found.t[:, None], found.u, found.y], axis=1)
    wrong = ~np.isfinite(table)
    wrong[:, 1 + found.u.shape[1] :] = np.isinf(found.y)  # a reading may be missing
    for k, column in np.argwhere(wrong)[:1]:
        raise DataError(
            f"{found.where(k, column)}: {found.slot(column)} = {table[k, column]}: must be a finite"
            " number"
        )


def _check_times(found):
    """Raise DataError where time does not increase from one sample to the next."""
    steps = np.diff(found.t)
    wrong = np.flatnonzero(steps <= 0)
    if len(wrong):
        k = wrong[0] + 1
        words = (
            "that of the sample before"
            if steps[k - 1] == 0
            else f"{-steps[k - 1]:g} s before that of the sample before"
        )
        raise DataError(
            f"{found.where(k, 0)}: time {found.t[k]:.10g} s is {words}: times must increase from"
            " sample to sample"
        )


RIM_MARGIN = 1.5
"""Reading, in rims of its tank, above which the column is taken to be in another unit."""
DRIVE_MARGIN = 2.0
"""The same of a pump's input, in its upper limits."""
FAINT = 0.015
"""Share of its range below which a pump's input, or every level, is taken to be in another unit."""
IRREGULAR = 1.25
"""Ratio of a long to a short step between samples (90th and 10th percentile) above which they are
no longer those of a controller's own clock, at which its outputs change."""
FEWEST = 3
"""Fewest samples of a run that can be fitted: residuals have an autocorrelation from three on."""


def check_float64():
    """Raise InputError unless JAX computes in float64."""
    if not jax.config.read("jax_enable_x64"):
        raise InputError(
            "identification needs float64: call jax.config.update('jax_enable_x64', True) first"
        )


def check_data(logs, loop, gap):
    """Raise InputError without experiment data, DataError for data that are not of this rig."""
    if not logs:
        raise InputError("no log is given: identification needs experiment data")
    for one in logs:
        check_gaps(one, gap)
        check_changes(one)
        check_fits(one, loop)


def first_samples(one, hold_back):
    """Return the number of samples of a Log before its validation set."""
    if not (
        isinstance(hold_back, (int, float))
        and not isinstance(hold_back, bool)
        and 0 <= hold_back < one.samples
    ):
        raise InputError(
            f"hold_back = {hold_back!r}: must be a share from 0 to below 1, or a number of samples"
            f" below {one.samples}"
        )
    first = one.samples - (round(hold_back * one.samples) if hold_back < 1 else int(hold_back))
    return max(first, 2)


def check_length(logs):
    """Raise DataError for experiment data of too few samples."""
    for one in logs:
        if one.samples < FEWEST:
            raise DataError(
                f"{one.name}: has {one.samples} samples, an identification needs at least {FEWEST}"
            )


def check_gaps(found, most=1.5):
    """Raise DataError where two samples lie further apart than `most` times the median step."""
    # What the pumps did in between is not known.
    steps = np.diff(found.t)
    usual = float(np.median(steps))
    k = int(np.argmax(steps))
    if steps[k] > most * usual * (1 + 1e-9):
        enough = np.ceil(10 * steps[k] / usual) / 10
        raise DataError(
            f"{found.where(k + 1, 0)}: a gap of {steps[k]:g} s after {found.t[k]:g} s, where"
            f" samples come every {usual:g} s: what the pumps did there is not known; cut the file"
            f" in two (give both with --data), or hold the input over it with --gap {enough:g}"
        )


def check_changes(found):
    """Raise DataError where nothing says when inputs changed between readings at
    irregular times.
    """
    low, high = np.quantile(np.diff(found.t), [0.1, 0.9])
    changed = 1 + np.flatnonzero(np.any(np.diff(found.u, axis=0) != 0.0, axis=1))
    unsure = changed[np.isfinite(found.y[changed]).any(axis=1)]
    if found.hold or high <= IRREGULAR * low or 2 * len(unsure) <= len(changed):
        return
    k = unsure[0]
    raise DataError(
        f"{found.where(k)}: an input changed in the {found.t[k] - found.t[k - 1]:g} s before"
        f" {found.t[k]:g} s, and samples come irregularly, every {low:g} to {high:g} s: when it"
        " changed is not known, and intervals would exclude the truth. Add a row at the time of"
        " each change, with its inputs and no readings; or state that inputs change at the times of"
        " their rows, --hold zero-order, or along a line from row to row, --hold first-order"
    )


def check_fits(found, loop):
    """Raise DataError where the data cannot be of this rig."""
    # That is another number of pumps, a tank it does not have, readings or inputs far out of range.
    plant, (length, drive) = loop.plant, getattr(loop, "units", DEFAULT)
    if found.u.shape[1] != plant.pumps:
        raise DataError(
            f"{found.name}: has {found.u.shape[1]} pump columns, the rig {plant.pumps} pumps"
        )
    _check_readings(found, loop, length)
    for j in range(plant.pumps):
        _check_input(found, loop, j, drive)
    _check_levels_move(found, loop, length)


def _check_readings(found, loop, length):
    """Raise DataError for a channel of an unknown tank, without a reading, or out of range."""
    plant = loop.plant
    rim = np.asarray(plant.rim)
    for c, tank in enumerate(found.tanks):
        column = 1 + plant.pumps + c
        if not 0 <= tank < plant.tanks:
            raise DataError(
                f"{found.where(column=column)}: measures tank {tank + 1}, the rig has {plant.tanks}"
            )
        if not np.isfinite(found.y[:, c]).any():
            raise DataError(f"{found.where(column=column)}: h{tank + 1} has no reading")
        volts = found.in_volts[c]
        top = float(loop.sensor.full_scale) if volts else float(rim[tank])
        unit, what = ("V", "sensor's range") if volts else (length, "rim")
        ends = (-0.25 * top, RIM_MARGIN * top)
        _check_range(found, column, found.y[:, c], unit, ends, f"{what} is {top:g}")


def _check_input(found, loop, j, drive):
    """Raise DataError where the input of pump j is far above its limit, or far below."""
    u, top = found.u[:, j], float(np.asarray(loop.actuator.high)[j])
    low = min(float(np.asarray(loop.actuator.low)[j]), 0.0)
    ends = (low - 0.1 * top, DRIVE_MARGIN * top)
    _check_range(found, 1 + j, u, drive, ends, f"pump's upper limit is {top:g}")
    most = float(np.max(np.abs(u)))
    # limits in other units are often nominal
    if np.isfinite(top) and 0 < most < FAINT * top and canonical(drive) in {**VOLTS, **FLOWS}:
        ends = (2 * FAINT * top, DRIVE_MARGIN * top)
        raise DataError(
            f"{found.where(column=1 + j)}: pump{j + 1} is never above {most:g} {drive}, where its"
            f" upper limit is {top:g} {drive}: is the column in another"
            f" unit?{_other_units(found, 1 + j, np.array([most]), drive, ends)}"
        )


def _check_levels_move(found, loop, length):
    """Raise DataError where all readings together use almost none of their ranges."""
    rim, first = np.asarray(loop.plant.rim), 1 + found.u.shape[1]
    tops = np.array(
        [
            float(loop.sensor.full_scale) if v else float(rim[i])
            for i, v in zip(found.tanks, found.in_volts)
        ]
    )
    most = np.nanmax(np.abs(found.y), axis=0)
    if not np.any(most > 0):
        raise DataError(
            f"{found.where(column=first)}: every level reads 0 throughout: nothing moves that could"
            " be fitted"
        )
    if np.all(most < FAINT * tops):
        c = int(np.argmax(most / tops))
        column, unit, top = first + c, "V" if found.in_volts[c] else length, tops[c]
        ends = (2 * FAINT * top, RIM_MARGIN * top)
        raise DataError(
            f"{found.where(column=column)}: no level reads more than {100 * FAINT:g} % of its"
            f" range, {found.slot(column)} at most {most[c]:g} {unit} of {top:g} {unit}: is the"
            " column in another"
            f" unit?{_other_units(found, column, most[c : c + 1], unit, ends)}"
        )


def _check_range(found, index, column, unit, ends, limit):
    """Raise DataError for a value outside `ends`, naming the limit it was derived from."""
    low, high = ends
    bad = np.flatnonzero((column > high) | (column < low))
    if len(bad):
        raise DataError(
            f"{found.where(bad[0], index)}: {found.slot(index)} = {column[bad[0]]:g} {unit}, where"
            f" the {limit} {unit}: is the column in another"
            f" unit?{_other_units(found, index, column, unit, ends)}"
        )


def _other_units(found, index, column, unit, ends):
    """Return a hint: the units in which a column, held in `unit`, would lie within `ends`."""
    unit = canonical(unit)
    table = next((t for t in (LENGTHS, VOLTS, FLOWS) if unit in t), {unit: 1.0})
    named = unit if found.units is None else canonical(found.units[index])
    written, slot = column * (table[unit] / table.get(named, table[unit])), found.slot(index)
    fits = [
        f"'{slot} [{u}]'"
        for u, size in table.items()
        if u != named
        and np.nanmin(written) * size >= ends[0] * table[unit]
        and np.nanmax(written) * size <= ends[1] * table[unit]
    ]
    return f" Write it in the header, as {' or '.join(fits[:2])}" if fits else ""
