"""A record of an experiment: when, what the pumps were given, what the level sensors said."""

import dataclasses
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from jaxtank.core.errors import DataError
from jaxtank.core.units import DEFAULT

RIM_MARGIN = 1.5
"""How many times its rim a level may read before the log is taken to be in another unit."""
DRIVE_MARGIN = 2.0
"""The same of a pump's upper limit."""
FAINT = 0.015
"""Share of its range that a pump's input, or every level, must pass for the log not to be taken to
be in another unit.
"""
LENGTHS = {"m": 1.0, "dm": 0.1, "cm": 0.01, "mm": 1e-3, "in": 0.0254, "inch": 0.0254}
VOLTS = {"V": 1.0, "mV": 1e-3}
FLOWS = {
    "m^3/s": 1.0,
    "cm^3/s": 1e-6,
    "l/min": 1e-3 / 60,
    "l/s": 1e-3,
    "ml/s": 1e-6,
    "l/h": 1e-3 / 3600,
}


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Log:
    """One experiment, as arrays on the host.

    t: (samples,) times [s], increasing; u: (samples, pumps) what each pump was given, held until
        the next sample, in the rig's unit;
    y: (samples, channels) readings, NaN where one is missing; tanks: the tank that each channel
    measures, counted from 0; in_volts: for each channel whether it is the sensor's volts (True) or
    a level in the rig's unit of length; name: for messages; lines: (samples,) line of the file each
    sample stood in, or None; headers, units: what the columns of t, of u and of y were called in
    the file, and the units that they were in, or None.
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

    @property
    def samples(self) -> int:
        """Number of samples [-]."""
        return len(self.t)

    def part(self, start: int, stop: int | None) -> "Log":
        """The samples start .. stop - 1 as a Log."""
        cut = slice(start, stop)
        lines = None if self.lines is None else self.lines[cut]
        return dataclasses.replace(self, t=self.t[cut], u=self.u[cut], y=self.y[cut], lines=lines)

    def where(self, k: int | None = None, column: int | None = None) -> str:
        """Words for sample k: its line in the file, or its number; column: counted over t, u and y."""
        words = self.name
        if k is not None:
            words += f", sample {k + 1}" if self.lines is None else f", line {self.lines[k]}"
        return (
            words
            if column is None or self.headers is None
            else f"{words}, column {self.headers[column]!r}"
        )

    def word(self, column: int) -> str:
        """What a column is, in the words of a rig: t, pump1, .., h1, .."""
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
) -> Log:
    """A Log from arrays. t: (samples,) [s]; u: (samples,) or (samples, pumps); y: (samples,) or
    (samples, channels), NaN where missing; tanks: the tank of each channel (0, 1, ... where None);
    in_volts: per channel, False where None; name, lines, headers, units: of a Log, for messages.
    Raises DataError for shapes that do not agree, inputs that are not finite, and times that do not
    increase.
    """
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
    tanks = tuple(range(y.shape[1])) if tanks is None else tuple(int(i) for i in tanks)
    in_volts = (False,) * len(tanks) if in_volts is None else tuple(bool(v) for v in in_volts)
    if not len(tanks) == len(in_volts) == y.shape[1]:
        raise DataError(
            f"{name}: {y.shape[1]} channels of levels, but {len(tanks)} tanks and {len(in_volts)}"
            " units named"
        )
    if len(set(tanks)) < len(tanks):
        raise DataError(f"{name}: a tank is measured by two columns")
    lines = None if lines is None else np.asarray(lines)
    found = Log(
        t=t,
        u=u,
        y=y,
        tanks=tanks,
        in_volts=in_volts,
        name=name,
        lines=lines,
        headers=headers,
        units=units,
    )
    if len(t) < 2:
        raise DataError(
            f"{name}: has {len(t)} sample{'s' if len(t) != 1 else ''}, at least 2 are needed"
        )
    table = np.concatenate([t[:, None], u, y], axis=1)
    wrong = ~np.isfinite(table)
    wrong[:, 1 + u.shape[1] :] = np.isinf(y)  # a reading may be missing
    for k, column in np.argwhere(wrong)[:1]:
        raise DataError(
            f"{found.where(k, column)}: {found.word(column)} = {table[k, column]}: must be a finite"
            " number"
        )
    _check_times(found)
    return found


def _check_times(found):
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


def check_gaps(found, most=1.5):
    """Raise DataError where two samples lie further apart than `most` times the median step: what
    the pumps did between is not known.
    """
    steps = np.diff(found.t)
    usual = float(np.median(steps))
    k = int(np.argmax(steps))
    if steps[k] > most * usual * (1 + 1e-9):
        enough = np.ceil(10 * steps[k] / usual) / 10
        raise DataError(
            f"{found.where(k + 1, 0)}: a gap of {steps[k]:g} s after {found.t[k]:g} s, where"
            f" samples come every {usual:g} s: what the pumps did there is not known; cut the log"
            f" in two (give both with --data), or hold the input over it with --gap {enough:g}"
        )


def check_fits(found, loop):
    """Raise DataError where the log cannot be of this rig: another number of pumps, a tank it does
    not have, readings out of all range.
    """
    plant, (length, drive) = loop.plant, getattr(loop, "units", DEFAULT)
    if found.u.shape[1] != plant.pumps:
        raise DataError(
            f"{found.name}: has {found.u.shape[1]} pump columns, the rig {plant.pumps} pumps"
        )
    high, rim = np.asarray(loop.actuator.high), np.asarray(plant.rim)
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
        what = "sensor's range" if volts else "rim"
        _check_range(
            found,
            column,
            found.y[:, c],
            "V" if volts else length,
            -0.25 * top,
            RIM_MARGIN * top,
            what,
            top,
        )
    for j in range(plant.pumps):
        top, low = float(high[j]), min(float(np.asarray(loop.actuator.low)[j]), 0.0)
        what = "pump's upper limit"
        _check_range(
            found, 1 + j, found.u[:, j], drive, low - 0.1 * top, DRIVE_MARGIN * top, what, top
        )
        most = float(np.max(np.abs(found.u[:, j])))
        # others have limits in name only
        if np.isfinite(top) and 0 < most < FAINT * top and (drive in VOLTS or drive in FLOWS):
            hint = _instead(
                found, 1 + j, np.array([most]), drive, 2 * FAINT * top, DRIVE_MARGIN * top
            )
            raise DataError(
                f"{found.where(column=1 + j)}: pump{j + 1} is never given more than {most:g}"
                f" {drive}, where its upper limit is {top:g} {drive}: is the column in another"
                f" unit?{hint}"
            )
    _check_levels_move(found, loop, length)


def _check_levels_move(found, loop, length):
    """Raise DataError where all readings together use next to nothing of their ranges: metres
    called centimetres.
    """
    rim = np.asarray(loop.plant.rim)
    tops = np.array(
        [
            float(loop.sensor.full_scale) if v else float(rim[i])
            for i, v in zip(found.tanks, found.in_volts)
        ]
    )
    most = np.nanmax(np.abs(found.y), axis=0)
    if not np.any(most > 0):
        raise DataError(
            f"{found.where(column=1 + found.u.shape[1])}: every level reads 0 throughout: nothing"
            " moves that could be fitted"
        )
    if np.all(most < FAINT * tops):
        c = int(np.argmax(most / tops))
        column, unit, top = 1 + found.u.shape[1] + c, "V" if found.in_volts[c] else length, tops[c]
        hint = _instead(found, column, most[c : c + 1], unit, 2 * FAINT * top, RIM_MARGIN * top)
        raise DataError(
            f"{found.where(column=column)}: no level reads more than {100 * FAINT:g} % of its"
            f" range, {found.word(column)} at most {most[c]:g} {unit} of {top:g} {unit}: is the"
            f" column in another unit?{hint}"
        )


def _check_range(found, index, column, unit, low, high, what, top):
    bad = np.flatnonzero((column > high) | (column < low))
    if len(bad):
        raise DataError(
            f"{found.where(bad[0], index)}: {found.word(index)} = {column[bad[0]]:g} {unit}, where"
            f" the {what} is {top:g} {unit}: is the column in another"
            f" unit?{_instead(found, index, column, unit, low, high)}"
        )


def _instead(found, index, column, unit, low, high):
    """Words for the units in which a column, held in `unit`, would lie within [low, high] had its
    header named them.
    """
    table = next((t for t in (LENGTHS, VOLTS, FLOWS) if unit in t), {unit: 1.0})
    said = unit if found.units is None else found.units[index]
    written, word = column * (table[unit] / table.get(said, table[unit])), found.word(index)
    fits = [
        f"'{word} [{u}]'"
        for u, size in table.items()
        if u != said
        and np.nanmin(written) * size >= low * table[unit]
        and np.nanmax(written) * size <= high * table[unit]
    ]
    return f" Write it in the header, as {' or '.join(fits[:2])}" if fits else ""
