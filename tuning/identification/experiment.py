"""Experiment data: sample times, pump inputs, readings of the level sensors."""

import dataclasses
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from jaxtank.core import stamps
from jaxtank.core.errors import DataError, InputError

HOLDS = ("", "zero-order", "first-order")  # "": unknown, zero-order where samples are regular
IRREGULAR = 1.25  # ratio of steps (90th, 10th percentile) above which samples follow no clock


ASSUMED = {  # sentences on the assumptions of `Log.assumed`
    ("inputs", "lines"): "rows are irregular, and inputs change from row to row: they follow a"
    " line from row to row (--hold first-order); --hold zero-order for a step at each row",
    ("inputs", "steps"): "rows are irregular: inputs step at each row (--hold zero-order), which"
    " fits better than a line from row to row (--hold first-order)",
    (
        "inputs",
        "moments",
    ): "inputs change between rows, at moments within their steps that are estimated"
    " (--hold zero-order for changes at the rows)",
    (
        "inputs",
        "rows",
    ): "inputs are taken to change at the rows; the controller of the rig acts more often, and what"
    " it did between the rows is not told: intervals do not allow for it (log more often;"
    " --hold zero-order where the log has every change)",
    ("parts", "own levels"): "more rows than are fitted at once: it is taken in parts, each with"
    " levels of its own at its first row",
    (
        "parts",
        "gaps",
    ): "inputs change where rows or values are missing, at times that are not told: it is cut"
    " there, each part with levels of its own at its first row",
    ("gaps", "at rows"): "inputs change where rows are missing, and are taken to change at the row"
    " after: intervals do not allow for it; give the data before and after as files of their own",
    (
        "loop",
        "fast",
    ): "inputs jump and return from row to row: if that is no noise, the loop is faster than the"
    " rows, and intervals do not allow for what its inputs did between them; log more often",
    ("inflow", "acts"): "the varying inflow of the rig is applied, with t = 0 at the first row:"
    " the data fit better with it",
    ("inflow", "acts by date"): "the varying inflow of the rig is applied at its dates: the data"
    " fit better with it",
    ("inflow", "left out"): "the varying inflow of the rig is not applied: the data do not fit"
    " clearly better with it; if it did flow, give its column as a pump with gain = 1 that fills"
    " the tank",
}


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
    notes : tuple of str
        What was taken for granted when a file was read.
    setpoints : dict
        {tank: (header, (samples,) setpoints in the rig's unit of length)} of a file that has them.
    unknown : (samples, pumps) array or None
        Whether an input is held over missing values of a file that has one in every row.
    assumed : dict
        {"inputs": "lines", "steps", "moments" or "rows"; "parts": "own levels"; "loop":
        "fast"; "inflow": "acts", "acts by date" or "left out"}: assumptions of an identification,
        where these are open.
    begins : Stamp or None
        When t = 0 is; None where times have no date.
    early : (samples, pumps) array or None
        Time by which an input changed before the row that shows it [s]; None where no moment of
        a change is estimated.

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
    notes: tuple = ()
    setpoints: dict = dataclasses.field(default_factory=dict)
    unknown: np.ndarray | None = None
    assumed: dict[str, str] = dataclasses.field(default_factory=dict)
    early: np.ndarray | None = None
    begins: stamps.Stamp | None = None

    @property
    def remarks(self) -> tuple[str, ...]:
        """The notes, followed by a sentence on each assumption."""
        return tuple(remarks_on([self]))

    @property
    def samples(self) -> int:
        """Number of samples [-]."""
        return len(self.t)

    def part(self, start: int, stop: int | None) -> "Log":
        """Return the samples start .. stop - 1 as a Log."""
        cut = slice(start, stop)
        arrays = {n: getattr(self, n) for n in ("t", "u", "y", "lines", "unknown", "early")}
        parts = {n: None if v is None else v[cut] for n, v in arrays.items()}
        setpoints = {tank: (head, r[cut]) for tank, (head, r) in self.setpoints.items()}
        return dataclasses.replace(self, setpoints=setpoints, **parts)

    def where(self, k: int | None = None, column: int | None = None) -> str:
        """Return the place of sample k for a message; column: index over the columns t, u, y."""
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


NAMED = 3  # logs that a message names; of more it names the first and counts the others


def names_of(logs: Sequence[Log]) -> str:
    """Return the names of Logs for a message."""
    names = [log.name for log in logs]
    return ", ".join(names) if len(names) <= NAMED else f"{names[0]} and {len(names) - 1} more"


def remarks_on(logs: Sequence[Log]) -> list[str]:
    """Return the notes of Logs, each once, and a sentence on each assumption."""
    notes = dict.fromkeys(note for log in logs for note in log.notes)
    shared: dict[tuple[str, str], list[Log]] = {}
    for log in logs:
        for assumption in log.assumed.items():
            shared.setdefault(assumption, []).append(log)
    return [*notes, *(f"{names_of(alike)}: {ASSUMED[what]}" for what, alike in shared.items())]


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
    notes: tuple = (),
) -> Log:
    """Return experiment data from arrays, for `tuning.identify`.

    Parameters
    ----------
    t : (samples,) array
        Sample times [s], increasing; or datetime64, the first of which is 0 s, or timedelta64.
    u : (samples,) or (samples, pumps) array
        Pump inputs in the rig's unit, one for each sample.
    y : (samples,) or (samples, channels) array
        Readings, NaN or masked where one is missing. A sample without a reading gives the time at
        which an input changed between two readings.
    tanks : sequence of int, optional
        Tank of each channel, counted from 0; 0, 1, ... by default.
    in_volts : sequence of bool, optional
        Whether each channel is the sensor's voltage; False by default: a level in the rig's unit.
    name, lines, headers, units, notes
        As in `Log`, for messages.
    hold : {"", "zero-order", "first-order"}
        Inputs between samples: "zero-order", each held until the next sample; "first-order", a
        straight line from sample to sample. "": zero-order, or where samples are irregular and
        inputs change from one to the next a straight line, unless zero-order fits clearly better.

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
    t, u, y = _arrays(t, u, y, name)
    numbers = range(y.shape[1]) if tanks is None else np.ravel(np.asarray(tanks, dtype=object))
    tanks = tuple(_tank(name, tank) for tank in numbers)
    volts = np.zeros(len(tanks), bool) if in_volts is None else np.ravel(in_volts)
    in_volts = tuple(bool(v) for v in volts)
    if not len(tanks) == len(in_volts) == y.shape[1]:
        raise DataError(
            f"{name}: {y.shape[1]} channels of levels, but {len(tanks)} tanks and {len(in_volts)}"
            " units named"
        )
    if len(set(tanks)) < len(tanks):
        raise DataError(f"{name}: a tank is measured by two columns")
    lines = None if lines is None else np.asarray(lines)
    data = Log(
        t=t, u=u, y=y, tanks=tanks, in_volts=in_volts, name=name, lines=lines, headers=headers,
        units=units, hold=hold, notes=notes,
    )  # fmt: skip
    _check_samples(data)
    return data


def _arrays(t, u, y, name):
    """((samples,), (samples, pumps), (samples, channels)) arrays of the data."""
    try:
        t, u, y = _seconds(t), _floats(u), _floats(y)
    except (TypeError, ValueError):
        raise DataError(f"{name}: t, u and y must be arrays of numbers") from None
    u, y = (v[:, None] if v.ndim == 1 else v for v in (u, y))
    if t.size == 0:
        raise DataError(f"{name}: has no sample")
    if t.ndim != 1 or u.ndim != 2 or y.ndim != 2 or not len(t) == len(u) == len(y):
        raise DataError(
            f"{name}: t, u and y have shapes {t.shape}, {u.shape}, {y.shape}: must share their"
            " first dimension, the number of samples"
        )
    return t, u, y


def _seconds(t):
    """Times [s]: numbers, or dates and durations of numpy or pandas, the first date at 0 s."""
    kind = getattr(getattr(t, "dtype", None) or np.asarray(t).dtype, "kind", "")
    if kind == "M":
        t = np.asarray(t, dtype="datetime64[ns]")  # in UTC where pandas has a zone
        return (t - t[:1]) / np.timedelta64(1, "s")
    return np.asarray(t) / np.timedelta64(1, "s") if kind == "m" else _floats(t)


def _floats(values):
    """An array of floats, NaN where a masked array hides an entry."""
    if np.ma.isMaskedArray(values):
        return np.ma.filled(values.astype(float), np.nan)
    return np.asarray(values, dtype=float)


def _tank(name, tank):
    """The number of a tank, counted from 0."""
    if isinstance(tank, int | np.integer) and not isinstance(tank, bool) and tank >= 0:
        return int(tank)
    raise DataError(f"{name}: tanks: {tank!r} must be the number of a tank, counted from 0")


def _check_samples(data):
    """Raise DataError at the first number that is not finite, or time that does not increase."""
    t, u, y = data.t, data.u, data.y
    table = np.concatenate([t[:, None], u, y], axis=1)
    wrong = ~np.isfinite(table)
    wrong[:, 1 + u.shape[1] :] = np.isinf(y)  # a reading may be missing
    for k, column in np.argwhere(wrong)[:1]:
        raise DataError(
            f"{data.where(k, column)}: {data.slot(column)} = {table[k, column]}: must be a finite"
            " number"
        )
    for k in 1 + np.flatnonzero(np.diff(t) <= 0)[:1]:
        back = t[k - 1] - t[k]
        before = f"{back:g} s before that of" if back else "that of"
        remedy = "delete one of the two rows, or write times with their seconds"
        if back:
            remedy = "sort the rows; of a clock that was set back, write the zone in each stamp"
        raise DataError(
            f"{data.where(k, 0)}: time {t[k]:.10g} s is {before} the sample before: times must"
            f" increase from sample to sample: {remedy}"
        )


def is_irregular(t: np.ndarray) -> bool:
    """Whether samples at times t follow no clock."""
    low, high = np.quantile(np.diff(t), [0.1, 0.9], method="lower")
    return bool(high > IRREGULAR * low)


def check_hold(hold: str) -> None:
    if hold not in HOLDS:
        raise InputError(f"hold = {hold!r}: must be one of {', '.join(HOLDS[1:])}")
