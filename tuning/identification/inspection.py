"""A file of experiment data before any fit: its columns, its times, and what is odd."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxtank import rig as rigs
from jaxtank.core.errors import DataError
from jaxtank.core.quantities import factor
from jaxtank.core.stamps import seconds
from jaxtank.core.tables import numbers, read_table, unit_name
from jaxtank.loop.closed_loop import ClosedLoop
from tuning.identification.csv_log import LogFile
from tuning.identification.data_checks import findings
from tuning.identification.sanity import Oddity, oddities
from tuning.identification.signals import Signal, poor, signals_of, states_of, time_columns


class ColumnOf(NamedTuple):
    """A column of numbers, or a tag of a long table."""

    header: str
    slot: str  # pump1, h2; "" where it is of no tank and no pump
    unit: str
    t: np.ndarray  # [s]
    values: np.ndarray  # NaN where missing, as the file has them
    why: str = ""  # it has no numbers

    @property
    def count(self) -> int:
        return int(np.isfinite(self.values).sum())


class Inspection(NamedTuple):
    """What a file of experiment data holds; `table`: of [log] in a rig file."""

    name: str
    time: str  # header
    t: np.ndarray  # (rows,) [s]; numbers of the rows where the times could not be read
    columns: list[ColumnOf]
    table: str
    oddities: list[Oddity]
    notes: list[str]
    problems: list[str]
    timed: bool = True  # whether the times could be read


def inspect(
    path: str | Path,
    loop: ClosedLoop | None = None,
    columns: Mapping[str, Any] | None = None,
    decimal: str = "",
    hold: str = "",
    time: str = "",
    gap: float = 1.5,
) -> Inspection:
    """Return the Inspection of a file, for a rig where its loop is given; as `read_log` reads."""
    if loop is None:
        return _without_rig(path, decimal, time)
    file = LogFile(path, loop, columns, decimal, hold, time)
    problems: list[str] = file.problems
    try:
        data = file.log()
    except DataError as error:  # of samples, beyond the columns
        data, problems = None, [*problems, str(error)]
    odd = [] if data is None else oddities(data, loop)
    problems = problems + ([] if data is None else [why for _, why in findings(data, loop, gap)])
    slots = {signal.described.header: slot for slot, signal in file.taken.items()}
    rows = [_column(signal, slots.get(signal.described.header, "")) for signal in file.signals]
    t = np.unique(np.concatenate([signal.t for signal in file.signals])) if rows else np.zeros(0)
    header = file.time.header if file.time else ""
    notes = [] if data is None else list(data.notes)
    text = file.table_text()
    return Inspection(file.name, header, t, rows, text, odd, notes, problems, file.timed)


def _column(signal: Signal, slot: str = "") -> ColumnOf:
    column, values, why = signal.described, np.full(len(signal.t), np.nan), ""
    try:
        states = states_of(column)
        values = numbers(signal.table, signal.column)[0] if states is None else states
        values = np.where(poor(signal), np.nan, values)
    except DataError as error:
        why = str(error)
    return ColumnOf(column.header, slot, column.unit or "", signal.t, values, why)


def _without_rig(path, decimal, order):
    """Return the Inspection of a file without its rig: lengths are levels, others inputs."""
    table = read_table(path, decimal)
    used, problems, t = time_columns(table), [], np.arange(len(table.lines), dtype=float)
    header, timed = table.columns[used[-1]].header if used else "", bool(used)
    try:
        t = seconds(table, used[-1], order) if used else t
    except DataError as error:
        timed = False
        problems.append(str(error))
    if not used:
        problems.append(f"{table.name}: no column of times: name it, as t [s]")
    rows, lines, of = [], [f"t = {rigs.toml(header)}"] if used else [], {}
    for signal in signals_of(table, used, t):
        column = _column(signal)
        moves = column.count and np.nanmax(column.values) > np.nanmin(column.values)
        kind = "h" if factor(unit_name(column.unit), "m") else "pump"
        if moves or (column.count and kind == "pump" and column.unit):
            of[kind] = of.get(kind, 0) + 1
            lines.append(f"{kind}{of[kind]} = {rigs.toml(column.header)}  # a guess: check it")
        rows.append(column)
    text = "\n".join(["[log]", *lines])
    return Inspection(table.name, header, t, rows, text, [], [], problems, timed)
