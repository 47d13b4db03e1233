"""Checks of experiment data against a rig: conditions and messages."""

import dataclasses
import itertools

import jax
import numpy as np

from jaxtank.core.errors import DataError, InputError
from jaxtank.core.labels import input_unit, label_of, signal_units
from jaxtank.core.quantities import FLOW_UNITS, LENGTHS, VOLTS, factor
from jaxtank.core.units import canonical
from jaxtank.loop.closed_loop import ClosedLoop
from tuning.identification.experiment import Log, is_irregular
from tuning.identification.simulation import changes_of, check_sensor

RIM_MARGIN = 1.5  # reading, in rims, above which it failed or its column has another unit
MOST_FAILED = 0.05  # share of readings beyond the range, below which they failed
NEAR = 1.1  # reading, in rims, below which all others are then
RIM_BELOW = 0.25  # the same below the bottom
DRIVE_MARGIN = 2.0  # the same of a pump's input, in its upper limits
FAINT = 0.015  # share of the range below which an input, or every level, has another unit
ROUNDED = 1e-3  # share of the range beyond a limit that rounding explains
CLIPPED = 0.02  # share of the range beyond a limit above which a sample counts
MOST_CLIPPED = 0.01  # share of samples that count, from which inputs are of another pump
FEWEST = 3  # samples of a run that can be fitted: residuals need an autocorrelation


def checked(log, loop, gap: float) -> list[Log]:
    """Return the Logs of one Log or several; raise an error for data that cannot be of this rig."""
    if not jax.config.read("jax_enable_x64"):
        raise InputError(
            "identification needs float64: call jax.config.update('jax_enable_x64', True) first"
        )
    check_sensor(loop)
    logs = [log] if isinstance(log, Log) else log
    logs = list(logs) if isinstance(logs, list | tuple) else [logs]
    if wrong := [data for data in logs if not isinstance(data, Log)]:
        raise InputError(
            f"log is a {type(wrong[0]).__name__}: must be a Log or a list of them: tuning.log(t=,"
            " u=, y=) makes one of arrays, tuning.read_log(FILE, case) of a file"
        )
    logs = [with_hold(with_even_times(data)) for data in logs]
    if not logs:
        raise InputError("no log is given: identification needs experiment data")
    messages = [message for log in logs for _, message in findings(log, loop, gap)]
    if messages:
        raise DataError("; ".join(messages))
    return [with_clips(log, loop) for log in logs]


def check_distinct(logs: list[Log]) -> None:
    """Raise DataError where two Logs are one experiment, which would count twice."""
    for log, before in itertools.combinations(logs, 2):
        arrays = zip((log.t, log.u, log.y), (before.t, before.u, before.y))
        if all(np.array_equal(a, b, equal_nan=True) for a, b in arrays):
            raise DataError(f"{before.name} and {log.name} hold the same data: give them once")


def findings(log: Log, loop, gap: float = 1.5) -> list[tuple[str, str]]:
    """Return (code, message) of all that is wrong with experiment data of a rig."""
    rows = []
    for code, check, ends in CHECKS:
        for sample, column, message in check(log, loop, gap):
            rows.append((code, f"{log.where(sample, column)}: {message}"))
        if rows and ends:
            return rows
    return rows


def first_samples(log, hold_back):
    """Return the number of samples of a Log before its validation set."""
    number = isinstance(hold_back, int | float) and not isinstance(hold_back, bool)
    if not (number and 0 <= hold_back < log.samples):
        raise InputError(
            f"hold_back = {hold_back!r}: must be a share from 0 to below 1, or a number of samples"
            f" below {log.samples}"
        )
    last = round(hold_back * log.samples) if hold_back < 1 else int(hold_back)
    return max(log.samples - last, 2)


def _few_samples(log, loop, gap):
    if (count := log.samples) < FEWEST:
        yield None, None, f"number of samples is {count}: at least {FEWEST} are needed"


def _pump_count(log, loop, gap):
    if log.u.shape[1] != loop.plant.pumps:
        yield None, None, f"has {log.u.shape[1]} pump columns, the rig {loop.plant.pumps} pumps"


def _unknown_tanks(log, loop, gap):
    for column, tank in enumerate(log.tanks, 1 + loop.plant.pumps):
        if not 0 <= tank < loop.plant.tanks:
            yield None, column, f"measures tank {tank + 1}, the rig has {loop.plant.tanks}"


def _gaps(log, loop, gap):
    starts = np.arange(log.samples - 1)
    for k, step, rest in _long_steps(log, starts, starts + 1, gap, "pumps"):
        yield k + 1, 0, f"a gap of {step:g} s after {log.t[k]:g} s, {rest}"


def _input_gaps(log, loop, gap):
    for column, unknown in enumerate([] if log.unknown is None else log.unknown.T, 1):
        edges = np.flatnonzero(np.diff(unknown, prepend=False, append=False))
        ends = edges[::2], np.minimum(edges[1::2], log.samples - 1)
        for k, step, rest in _long_steps(log, *ends, gap, "pump") if edges.size else ():
            what = f"{log.slot(column)} has no value for {step:g} s from {log.t[k]:g} s on"
            yield k, column, f"{what}, {rest}"


def _long_steps(log, starts, stops, gap, what):
    """Yield (first sample, length [s], end of the message) of the longest step if it is a gap."""
    steps, share = log.t[stops] - log.t[starts], 0.9 if is_irregular(log.t) else 0.5
    longest, usual = steps.max(), float(np.quantile(np.diff(log.t), share, method="lower"))
    if longest > gap * usual * (1 + 1e-9):
        rest = (
            f"where samples come every {usual:g} s: what the {what} did there is not known; cut"
            " the file in two (give both with --data), or accept it (an input is held over it; the"
            " log is cut there where it has changed) with --gap"
            f" {np.ceil(10 * longest / usual) / 10:g}"
        )
        yield starts[np.argmax(steps)], longest, rest


def with_even_times(log):
    """A Log whose days were written with few decimals, at the even times that they round."""
    if log.samples < 20:  # uneven times of a few samples are those of somebody's hand
        return log
    steps, k = np.diff(log.t), np.arange(log.samples)
    for raster in 86400.0 / 10.0 ** np.arange(2, 8):  # s, of a day with so many decimals
        whole = steps / raster
        if raster > 1e-3 * np.median(steps) and np.allclose(whole, np.round(whole), atol=1e-3):
            break
    else:
        return log
    step = float(np.polyfit(k, log.t, 1)[0])
    short = float(f"{step:.3g}")
    step = short if abs(short - step) * log.samples < raster else step
    if np.ptp(whole) < 0.5 or np.ptp(log.t - step * k) > raster * (1.0 + 1e-3):
        return log
    note = (
        f"{log.name}: its days are rounded to {raster:.4g} s: samples are taken as evenly spaced, "
        f"{step:.6g} s apart"
    )
    return dataclasses.replace(log, t=log.t[0] + step * k, notes=(*log.notes, note))


def with_hold(log: Log) -> Log:
    """Return a Log that states what its inputs do between samples: lines if irregular."""
    # A step at its row would act late, by half a step on average, as a dead time does.
    move = np.diff(log.u, axis=0)
    alike = (move[:-1] != 0.0) & (np.abs(np.diff(move, axis=0)) <= 0.05 * np.abs(move[:-1]))
    along_lines = np.count_nonzero(alike) > 0.5 * np.count_nonzero(move) > 10
    if not log.hold and log.samples >= FEWEST and along_lines:
        note = (
            f"{log.name}: inputs move along lines: each is held until the next row (--hold"
            " first-order: a line from row to row)"
        )
        log = log if is_irregular(log.t) else dataclasses.replace(log, notes=(*log.notes, note))
    if log.hold or log.samples < FEWEST or not is_irregular(log.t):
        return log
    changed = changes_of(log.u)
    if 2 * len(changed[np.isfinite(log.y[changed]).any(axis=1)]) <= len(changed):
        return log
    return dataclasses.replace(assuming(log, "inputs", "lines"), hold="first-order")


def with_steps(log: Log) -> Log:
    """A Log whose inputs step at each row in place of the lines that are assumed."""
    return dataclasses.replace(assuming(log, "inputs", "steps"), hold="zero-order")


def assuming(log: Log, topic: str, value: str) -> Log:
    """A Log with an assumption of `experiment.ASSUMED`."""
    return dataclasses.replace(log, assumed={**log.assumed, topic: value})


def with_clips(log: Log, loop) -> Log:
    """Return a Log without failed readings, noting these and each input limit that is passed."""
    notes = list(_notes_on_failed(log, loop))
    log = dataclasses.replace(log, y=valid(log, loop)) if notes else log
    for column, end, limit, beyond in _clips(log, loop):
        if count := int(np.sum(beyond > ROUNDED)):
            most, unit = log.u[int(np.argmax(beyond)), column - 1], _unit(loop, column)
            name = label_of(loop.plant, "pump", column - 1)
            of = lambda value, unit=unit: f"{value:g} {unit}".strip()
            notes.append(
                f"{log.name}: {name} goes to {of(most)}, beyond its limit, {of(limit)}, in {count}"
                f" of {log.samples} samples: simulated at the limit; set"
                f" actuator.{end}[{column - 1}] to what it can do, or check the unit"
            )
    notes = [note for note in notes if note not in log.notes]  # of a file that was read
    return dataclasses.replace(log, notes=(*log.notes, *notes)) if notes else log


def _notes_on_failed(log, loop):
    """Yield a note on each channel with few readings beyond its range."""
    failed = np.isfinite(log.y) & ~np.isfinite(valid(log, loop))
    for c in np.flatnonzero(failed.any(axis=0)):
        rows, (top, unit, what) = np.flatnonzero(failed[:, c]), _channels(log, loop)[c]
        column = 1 + loop.plant.pumps + c
        numbers = rows + 1 if log.lines is None else log.lines[rows]
        more = f" and {len(rows) - 5} more" if len(rows) > 5 else ""
        yield (
            f"{log.where(None, column)}: {log.slot(column)}: {len(rows)} of"
            f" {np.isfinite(log.y[:, c]).sum()} readings beyond its range, the first"
            f" {log.y[rows[0], c]:g} {unit}, where the {what} is {top:g} {unit}"
            f" ({'sample' if log.lines is None else 'line'} {', '.join(map(str, numbers[:5]))}"
            f"{more}): taken as missing"
        )


def valid(log: Log, loop: ClosedLoop) -> np.ndarray:
    """Return (samples, channels) readings without those that failed, few and far beyond a range."""
    tops = np.array([top for top, *_ in _channels(log, loop)])
    h, readable = _levels(log, loop, log.y), np.isfinite(log.y)
    beyond = (h < -RIM_BELOW * tops) | (h > RIM_MARGIN * tops)
    few = beyond.sum(axis=0) < MOST_FAILED * readable.sum(axis=0)
    near = np.max(h, axis=0, where=readable & ~beyond, initial=0.0) <= NEAR * tops
    return np.where(beyond & few & near, np.nan, log.y)


def _levels(log, loop, y):
    """Return the levels of readings y (samples, channels), without offset, scale and curve of their
    sensors; those in volts as they are.
    """
    of = lambda i, volts, v: v if volts else np.asarray(loop.sensor.level_of(i, v))
    return np.stack([of(*c) for c in zip(log.tanks, log.in_volts, y.T)], axis=-1)


def _readings(log, loop, levels):
    """Return what the sensors of the channels (c,) read of levels; in volts the levels."""
    of = lambda i, volts, v: v if volts else float(loop.sensor.reading_of(i, v))
    return [of(*c) for c in zip(log.tanks, log.in_volts, levels)]


def _clips(log, loop):
    """Yield (column, "low" or "high", limit, (samples,) shares of the range beyond it)."""
    for j, (u, low, high) in enumerate(_pumps(log, loop)):
        size = high - low if np.isfinite(high - low) else np.nanmax(np.abs(u))
        for end, limit, beyond in (("low", low, low - u), ("high", high, u - high)):
            if np.isfinite(limit):
                yield 1 + j, end, limit, beyond / (size or 1.0)


def _clipped(log, loop, gap):
    for column, end, limit, beyond in _clips(log, loop):
        count, k = int(np.sum(beyond > CLIPPED)), int(np.argmax(beyond))
        u, low, high = _pumps(log, loop)[column - 1]
        inside = _first_outside(u, *_margins(low, high)).size == 0  # else another check refuses it
        if inside and count >= MOST_CLIPPED * log.samples:
            unit = _unit(loop, column)
            fits = _fitting_units(log, loop, column, u, unit, (low, high))
            hint = f", as {' or '.join(fits[:2])}" if fits and _is_bare(log, column) else ""
            message = (
                f"{log.slot(column)} = {u[k]:g} {unit}, and {count} samples in all are beyond its"
                f" limit, {limit:g} {unit}, at which the simulated one stops: set"
                f" actuator.{end}[{column - 1}] to what it can do (or {end} of it in the rig file),"
                f" or write the unit of the column in its header{hint}"
            )
            yield k, column, message


def _empty_channels(log, loop, gap):
    for column in np.flatnonzero(~np.isfinite(log.y).any(axis=0)):
        column += 1 + loop.plant.pumps
        yield None, column, f"{log.slot(column)} has no reading"


def _out_of_range(log, loop, gap):
    units, tops = signal_units(loop.plant, loop.units)[1:], _channels(log, loop)
    pumps = [(u, unit, *_margins(low, top), f"pump's upper limit is {top:g}")
             for unit, (u, low, top) in zip(units, _pumps(log, loop))]  # fmt: skip
    ends = [_readings(log, loop, [k * top for top, *_ in tops]) for k in (-RIM_BELOW, RIM_MARGIN)]
    levels = [(y, unit, low, high, f"{what} is {top:g}")
              for y, (top, unit, what), low, high
              in zip(valid(log, loop).T, tops, *ends)]  # fmt: skip
    for column, (values, unit, low, high, limit) in enumerate([*pumps, *levels], 1):
        for k in _first_outside(values, low, high):
            hint = _other_units(log, loop, column, values, unit, (low, high))
            value = f"{log.slot(column)} = {values[k]:g} {unit}"
            yield k, column, f"{value}, where the {limit} {unit}: {UNIT}{hint}"


def _margins(low, top):
    """Return the ends beyond which an input between low and top has another unit."""
    return min(low, 0.0) - 0.1 * top, DRIVE_MARGIN * top


def _first_outside(values, low, high):
    return np.flatnonzero((values < low) | (values > high))[:1]


def _faint_inputs(log, loop, gap):
    drive = loop.units[1]
    if canonical(drive) not in (*VOLTS, *FLOW_UNITS):  # limits in other units are often nominal
        return
    for column, (u, _, top) in enumerate(_pumps(log, loop), 1):
        most, unit = np.max(np.abs(u)), f" {_unit(loop, column)}".rstrip()
        if np.isfinite(top) and 0 < most < FAINT * top:
            ends = (2 * FAINT * top, DRIVE_MARGIN * top)
            hint = " Write it in the header, as [-] of openings from 0 to 1"
            hint = _other_units(log, loop, column, most, drive, ends) if unit else hint
            message = (
                f"{log.slot(column)} is never above {most:g}{unit}, where its upper limit is"
                f" {top:g}{unit}: {UNIT}{hint}"
            )
            yield None, column, message


def _faint_levels(log, loop, gap):
    tops, units, _ = zip(*_channels(log, loop))
    y = _levels(log, loop, valid(log, loop))
    most = np.max(np.abs(y), axis=0, initial=0.0, where=np.isfinite(y))
    c = int(np.argmax(most / tops))
    most, top, unit, column = most[c], tops[c], units[c], 1 + loop.plant.pumps + c
    if 0 < most < FAINT * top:
        hint = _other_units(log, loop, column, most, unit, (2 * FAINT * top, RIM_MARGIN * top))
        message = (
            f"no level reads more than {100 * FAINT:g} % of its range, {log.slot(column)} at most"
            f" {most:g} {unit} of {top:g} {unit}: {UNIT}{hint}"
        )
        yield None, column, message


def _nothing_moves(log, loop, gap):
    if not np.any(np.abs(log.y) > 0):
        zero = "every level reads 0 throughout: nothing moves that could be fitted"
        yield None, 1 + loop.plant.pumps, zero


def _channels(log, loop):
    """Return (top of the range, its unit, its name) of each channel of readings."""
    sensor = (float(loop.sensor.full_scale), "V", "sensor's range")
    rim = [(float(top), loop.units[0], "rim") for top in np.asarray(loop.plant.rim)]
    return [sensor if volts else rim[tank] for tank, volts in zip(log.tanks, log.in_volts)]


def _pumps(log, loop):
    """Return (inputs (samples,), lower limit, upper limit) of each pump."""
    limits = np.asarray(loop.actuator.low), np.asarray(loop.actuator.high)
    return [(u, float(low), float(high)) for u, low, high in zip(log.u.T, *limits)]


def _other_units(log, loop, column, values, unit, ends):
    """Return a hint: the units in which values, held in `unit`, would lie within `ends`."""
    fits = _fitting_units(log, loop, column, values, unit, ends)
    if not fits:
        return " Leave the cell empty where it stands for a failed reading"
    return f" Write it in the header, as {' or '.join(fits[:2])}"


def _fitting_units(log, loop, column, values, unit, ends):
    """Return the headers with the units in which values, held in `unit`, lie within `ends`."""
    unit = canonical(unit)
    header = unit if log.units is None else canonical(log.units[column])
    cells, slot = values / (factor(header, unit) or 1.0), log.slot(column)
    sizes = {name: factor(name, unit) for name in (*LENGTHS, *VOLTS, *dict.fromkeys(FLOW_UNITS))}
    least, most = np.nanmin(cells), np.nanmax(cells)
    inside = lambda size: size and least * size >= ends[0] and most * size <= ends[1]
    names = [name for name, size in sizes.items() if name != header and inside(size)]
    if _is_bare(log, column) and least >= -10.0 and 2.0 < most <= 110.0 and unit != "%":
        names = [_per_cent(loop, column), *names]
    return [f"'{slot} [{name}]'" for name in names]


def _is_bare(log, column):
    return log.units is not None and not log.units[column]


def _per_cent(loop, column):
    """Return the unit of per cents of the range of a column."""
    if column > loop.plant.pumps:
        return "%"
    unit = canonical(_unit(loop, column))
    return f"% of {float(loop.actuator.high[column - 1]):g} {unit}" if unit else "%"


def _unit(loop, column):
    """Return the unit of the input of a column, "" of the opening of a valve."""
    return input_unit(loop.plant, column - 1, loop.units[1]).strip("-")


UNIT = "is the column in another unit?"
CHECKS = (  # in this order; True: the checks after it need what it checks
    ("samples", _few_samples, True),
    ("pumps", _pump_count, True),
    ("tanks", _unknown_tanks, True),
    ("gap", _gaps, False),
    ("input-gap", _input_gaps, False),
    ("no-reading", _empty_channels, True),
    ("range", _out_of_range, False),
    ("input-limit", _clipped, False),
    ("input-faint", _faint_inputs, False),
    ("level-faint", _faint_levels, False),
    ("level-zero", _nothing_moves, False),
)
