"""A record of an experiment: when, what the pumps were given, what the level sensors said."""

import dataclasses

import numpy as np

from jaxtank.errors import DataError
from jaxtank.units import DEFAULT

RIM_MARGIN = 1.5
"""How many times its rim a level may read before the log is taken to be in another unit."""
DRIVE_MARGIN = 2.0
"""The same of a pump's upper limit."""


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Log:
    """One experiment, as arrays on the host.

    t: (samples,) times [s], increasing; u: (samples, pumps) what each pump was given, held until the next sample, in the rig's unit;
    y: (samples, channels) readings, NaN where one is missing; tanks: the tank that each channel measures, counted from 0; in_volts: for
    each channel whether it is the sensor's volts (True) or a level in the rig's unit of length; name: for messages; lines: (samples,) line
    of the file each sample stood in, or None.
    """

    t: np.ndarray
    u: np.ndarray
    y: np.ndarray
    tanks: tuple
    in_volts: tuple
    name: str = "log"
    lines: np.ndarray | None = None

    @property
    def samples(self):
        """Number of samples [-]."""
        return len(self.t)

    def part(self, start, stop):
        """The samples start .. stop - 1 as a Log."""
        cut = slice(start, stop)
        lines = None if self.lines is None else self.lines[cut]
        return dataclasses.replace(self, t=self.t[cut], u=self.u[cut], y=self.y[cut], lines=lines)

    def where(self, k):
        """Words for sample k: its line in the file, or its number."""
        return f"{self.name}, {f'sample {k + 1}' if self.lines is None else f'line {self.lines[k]}'}"


def log(*, t, u, y, tanks=None, in_volts=None, name="log", lines=None):
    """A Log from arrays. t: (samples,) [s]; u: (samples,) or (samples, pumps); y: (samples,) or (samples, channels), NaN where missing; tanks:
    the tank of each channel (0, 1, ... where None); in_volts: per channel, False where None. Raises DataError for shapes that do not
    agree, inputs that are not finite, and times that do not increase.
    """
    t, u, y = (np.asarray(v, dtype=float) for v in (t, u, y))
    u, y = (v[:, None] if v.ndim == 1 else v for v in (u, y))
    if t.ndim != 1 or u.ndim != 2 or y.ndim != 2 or not len(t) == len(u) == len(y):
        raise DataError(f"{name}: t, u and y have shapes {t.shape}, {u.shape}, {y.shape}: must share their first dimension")
    tanks = tuple(range(y.shape[1])) if tanks is None else tuple(int(i) for i in tanks)
    in_volts = (False,) * len(tanks) if in_volts is None else tuple(bool(v) for v in in_volts)
    if not len(tanks) == len(in_volts) == y.shape[1]:
        raise DataError(f"{name}: {y.shape[1]} channels of levels, but {len(tanks)} tanks and {len(in_volts)} units named")
    if len(set(tanks)) < len(tanks):
        raise DataError(f"{name}: a tank is measured by two columns")
    found = Log(t=t, u=u, y=y, tanks=tanks, in_volts=in_volts, name=name, lines=None if lines is None else np.asarray(lines))
    if len(t) < 2:
        raise DataError(f"{name}: has {len(t)} samples, at least 2 are needed")
    for what, column in (("time", t[:, None]), ("input", u)):
        bad = np.argwhere(~np.isfinite(column))
        if len(bad):
            raise DataError(f"{found.where(bad[0, 0])}: {what} {bad[0, 1] + 1} is not a finite number: every sample needs one")
    bad = np.argwhere(np.isinf(y))
    if len(bad):
        raise DataError(f"{found.where(bad[0, 0])}: level h{tanks[bad[0, 1]] + 1} is infinite")
    _check_times(found)
    return found


def _check_times(found):
    steps = np.diff(found.t)
    wrong = np.flatnonzero(steps <= 0)
    if len(wrong):
        k = wrong[0] + 1
        words = "that of the sample before" if steps[k - 1] == 0 else f"{-steps[k - 1]:g} s before that of the sample before"
        raise DataError(f"{found.where(k)}: time {found.t[k]:.10g} s is {words}: times must increase from sample to sample")


def check_gaps(found, most=1.5):
    """Raise DataError where two samples lie further apart than `most` times the median step: what the pumps did between is not known."""
    steps = np.diff(found.t)
    usual = float(np.median(steps))
    k = int(np.argmax(steps))
    if steps[k] > most * usual * (1 + 1e-9):
        enough = np.ceil(10 * steps[k] / usual) / 10
        raise DataError(
            f"{found.where(k + 1)}: a gap of {steps[k]:g} s after {found.t[k]:g} s, where samples come every {usual:g} s: what the pumps did "
            f"there is not known; cut the log in two (give both with --data), or hold the input over it with --gap {enough:g}"
        )


def check_fits(found, loop):
    """Raise DataError where the log cannot be of this rig: another number of pumps, a tank it does not have, readings out of all range."""
    plant, (length, drive) = loop.plant, getattr(loop, "units", DEFAULT)
    if found.u.shape[1] != plant.pumps:
        raise DataError(f"{found.name}: has {found.u.shape[1]} pump columns, the rig {plant.pumps} pumps")
    high, rim = np.asarray(loop.actuator.high), np.asarray(plant.rim)
    for c, tank in enumerate(found.tanks):
        if not 0 <= tank < plant.tanks:
            raise DataError(f"{found.name}: measures tank {tank + 1}, the rig has {plant.tanks}")
        top, unit = float(rim[tank]), length
        if found.in_volts[c]:
            top, unit = float(loop.sensor.full_scale), "V"
        _check_range(
            found,
            found.y[:, c],
            f"h{tank + 1}",
            unit,
            -0.25 * top,
            RIM_MARGIN * top,
            "rim" if unit == length else "sensor's range",
            top,
        )
        if not np.isfinite(found.y[:, c]).any():
            raise DataError(f"{found.name}: column h{tank + 1} has no reading")
    for j in range(plant.pumps):
        top = float(high[j])
        low = min(float(np.asarray(loop.actuator.low)[j]), 0.0)
        _check_range(found, found.u[:, j], f"pump{j + 1}", drive, low - 0.1 * top, DRIVE_MARGIN * top, "upper limit", top)


def _check_range(found, column, name, unit, low, high, what, top):
    bad = np.flatnonzero((column > high) | (column < low))
    if len(bad):
        raise DataError(
            f"{found.where(bad[0])}: {name} = {column[bad[0]]:g} {unit}, where the {what} is {top:g} {unit}: is the column in another unit? "
            f"Write it in the header, as '{name} [mm]' or '{name} [mV]'"
        )
