"""Experiment data from files: columns by the rig's names, their units, qualities and times."""

import dataclasses
import re
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

from jaxtank import rig as rigs
from jaxtank.case import Case
from jaxtank.core import stamps, tables
from jaxtank.core.errors import DataError, InputError, nearest
from jaxtank.core.labels import input_unit, label_of, name_of
from jaxtank.core.quantities import INPUT_UNITS, LEVEL_UNITS, VOLTS, factor, quantity
from jaxtank.core.text import count, printable
from jaxtank.core.units import canonical
from jaxtank.loop.closed_loop import ClosedLoop
from jaxtank.plants.vessels import level_of
from jaxtank.rig.sensors import in_span, spans_of
from jaxtank.rig.validation import LOG_SETTINGS, log_keys, log_slots
from tuning.identification import signals
from tuning.identification.data_checks import with_clips
from tuning.identification.experiment import IRREGULAR, Log, check_hold, is_irregular, log

KINDS = {"pump": "pump", "h": "level"}
SHARE = r"(%|mA)(?: of (.+))?"  # units of a reading in a span, which may be stated
RATED = r"(\S+) of (\d+(?: \d{3})*(?:[.,]\d+)?) *(\S*)"  # a speed and the largest: Hz of 50 Hz
SPEEDS = {"hz": 60.0, **dict.fromkeys(("rpm", "1/min", "min-1", "min^-1", "u/min", "r/min"), 1.0)}
"""{unit of a speed in lower case: revolutions per minute}."""
ON_OFF = "on/off"  # unit of an input that is 0 or 1, the ends of its range
USUAL = {"%": (2.0, 125.0), "mA": (4.1, 23.0)}  # between which the largest readings are
SWITCHED = 5.0  # upper limit of an input of 0 and 1 above which they may be off and on


class LogError(DataError):
    """Experiment data that cannot be read as they are: all that is wrong, and a [log] table."""

    def __init__(self, problems: list[str], table: str):
        super().__init__("; ".join(problems))
        self.problems, self.table = problems, table


def read_log(
    path: str | Path,
    loop: ClosedLoop | Case,
    columns: Mapping[str, Any] | None = None,
    decimal: str = "",
    hold: str = "",
    time: str = "",
) -> Log:
    """Read experiment data from a CSV or Excel file.

    Columns are found by the rig's own names ("LT101 [%]", "LT101.PV") or by "t", "pump1", "h1";
    values are converted to the rig's units. Read are also long tables (time, tag, value, quality),
    columns of quality, time stamps, decimal commas, levels in per cent of the rim or as volumes,
    and pumps in flows. What is taken for granted is in `notes` of the result.

    Parameters
    ----------
    path : str or Path
        The file: text in UTF-8, UTF-16 or Latin-1, .xlsx, or .lvm of LabVIEW.
    loop : ClosedLoop or Case
        The rig that was measured.
    columns : mapping, optional
        As the [log] table of a rig file: column of each of "t", "pump1", .., "h1", .. or of the
        rig's names: a header, or (header, unit), where the header is in other words; "none" leaves
        a level out and switches a pump off; "decimal", "time" and "hold" as below.
    decimal : str
        Decimal sign, "." or ","; by default from the numbers.
    hold : {"", "zero-order", "first-order"}
        What inputs do between samples, as in `tuning.log`.
    time : {"", "day-first", "month-first", "h:m", "m:s"}
        How dates such as 03/11/2026, and times such as 14:05, are read.

    Returns
    -------
    Log

    Raises
    ------
    DataError
        For a file that cannot be read so; where columns are in doubt, with a [log] table to
        complete.
    InputError
        For `columns`, `decimal`, `hold` or `time` that do not exist.

    Examples
    --------
    >>> import pathlib, tempfile, tuning
    >>> from jaxtank import presets
    >>> loop = presets.load("cascaded").cases["open-loop"].loop
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = pathlib.Path(folder) / "run.csv"
    ...     _ = path.write_text("t [s],pump1 [mV],h2 [V]\\n0,3000,1\\n4,3000,1.5\\n8,3500,\\n")
    ...     data = tuning.read_log(path, loop)
    >>> print(data.u[:, 0], data.y[:, 0], data.tanks)
    [3.  3.  3.5] [1.  1.5 nan] (1,)
    """
    loop = loop.loop if isinstance(loop, Case) else loop
    file = LogFile(path, loop, columns, decimal, hold, time)
    data = file.log()
    if file.problems or data is None:
        raise LogError(file.problems, file.table_text() if file.in_doubt else "")
    return data


class LogFile:
    """A file of experiment data: its signals, those of the rig, and all that is wrong."""

    def __init__(self, path, loop, columns=None, decimal="", hold="", time=""):
        self.loop, self.slots, self.keys = loop, log_slots(loop.plant), log_keys(loop.plant)
        self.plant: Any = loop.plant
        self.problems: list[str] = []
        self.in_doubt = False  # a column, a unit or a setting, so that a [log] table helps
        self.suggested: dict[str, tuple[str, ...]] = {}  # setting: answers to a question
        self.asked: dict[str, tuple[str, str]] = {}  # slot: the units that it may have
        self.time: tables.Column | None = None
        self.timed = False  # whether the times could be read
        self.stamp: stamps.Stamp | None = None  # of the first row
        self.notes: dict[str, list[str]] = {}  # what was taken for granted: of which signals
        settings, named = _settings_and_columns(self.plant, columns or {})
        self.named = {slot: spec for slot, spec in named.items() if spec[0]}
        self.units = {slot: unit for slot, (_, unit) in named.items() if unit}
        self.hold, order = hold or settings.get("hold", ""), time or settings.get("time", "")
        check_hold(self.hold)
        decimal = decimal or settings.get("decimal", "")
        for key, value in {"decimal": decimal, "time": order}.items():
            if value and value not in LOG_SETTINGS[key]:
                must = " ".join(LOG_SETTINGS[key])
                raise InputError(f"--{key} {value!r}: must be one of {must}")
        try:
            self.table = tables.read_table(path, decimal)
        except tables.Ambiguous as question:
            self._ask(question)
            self.table = tables.read_table(path, ",")
        self.name, self.place = self.table.name, f"{self.table.name}, line {self.table.head}"
        if others := ", ".join(map(repr, self.table.sheets[:8])):
            self._note(f"the first sheet alone is read, and not {others}")
        t, used = self._times(order)
        self.signals = signals.signals_of(self.table, used, t)
        self.long = any(signal.t is not t for signal in self.signals)
        self._check_run_states()
        self._check_times_of_tags()
        self._check_clock_of_tags()
        self.taken = self._named_signals()
        self.taken |= self._recognised_signals()
        self.setpoints = self._signals_of_setpoints()

    def _check_run_states(self) -> None:
        """Add to the problems what may be a quality, or tell that a pump is off."""
        for signal in () if self.long else self.signals:
            column = signal.described
            both = {"0", "1"} <= {cell.strip() for cell in column.cells}
            if both and signals.is_run_state(column):
                self.problems.append(
                    f"{self.place}: column {column.header!r} holds 0 and 1: whether something runs,"
                    " or a quality? Write 0 in the column of a pump while it is off, and leave this"
                    " column out; or call it a quality in its header, where 1 is good"
                )

    def _check_times_of_tags(self) -> None:
        """Add to the problems two values of one tag at one time."""
        for signal in self.signals if self.long else ():
            cells = signal.described.cells
            same = np.flatnonzero(np.diff(signal.t) == 0.0)
            twice = [k for k in same if cells[k].strip() != cells[k + 1].strip()]
            if twice:
                a, b = (signal.table.lines[k] for k in (twice[0], twice[0] + 1))
                more = f", and {len(twice) - 1} more" * (len(twice) > 1)
                self.problems.append(
                    f"{self.name}: lines {a} and {b}: two values of {signal.described.header!r} at"
                    f" one time{more}: where clocks were set back, write times with their zone, or"
                    " leave one of the rows out"
                )

    def _check_clock_of_tags(self) -> None:
        """Add to the problems that a clock without a zone is set back among the rows of a tag."""
        local = self.long and self.stamp is not None and self.stamp.kind == stamps.LOCAL
        for signal in self.signals if local else ():
            if back := signals.set_back(signal):
                self.problems.append(
                    f"{self.name}: line {back[0]}: the times of {signal.described.header!r} go back"
                    f" by {back[1]:g} s: where a clock was set back, write times with their zone,"
                    " or leave the repeated hour out"
                )
                return

    def _doubt(self, problem: str) -> None:
        """Add a problem that a line of [log] solves."""
        self.problems.append(problem)
        self.in_doubt = True

    def _ask(self, question: tables.Ambiguous) -> None:
        """Add a question to the problems, and its answers to the suggested table."""
        answers = " or ".join(f"--{question.setting} {answer}" for answer in question.answers)
        self._doubt(f"{question} State {answers}")
        self.suggested[question.setting] = question.answers

    def _times(self, order: str) -> tuple[np.ndarray, list[int]]:
        """Return (times [s] of the rows, columns they are in), the newest row last."""
        columns, t = self.table.columns, np.arange(len(self.table.lines), dtype=float)
        if "t" in self.named:
            header = self.named["t"][0]
            used = stamps.join_times(self.table, header) or self._found(header, "t", columns)
        elif not (used := signals.time_columns(self.table)):
            self._no_column("t", "time", [c.header for c in columns])
        if not used:
            return t, used
        self.time = columns[used[-1]]
        if "t" not in self.named:
            self._found(self.time.header, "t", columns)  # not twice
        columns[used[-1]] = self.time._replace(unit=self.units.get("t", self.time.unit))
        try:
            t, self.stamp = stamps.stamped(self.table, used[-1], order)
            self.timed = True
        except tables.Ambiguous as question:
            self._ask(question)
        except DataError as error:
            self.in_doubt |= not (self.time.unit or stamps.is_time(self.time.cells[0]))
            self.problems.append(str(error))
        if len(t) > 1 and np.all(np.diff(t) < 0):
            for column in columns:
                column.cells.reverse()
            self.table.lines.reverse()
            self._note("rows come newest first, and are turned round")
            if self.stamp is not None:
                self.stamp = self.stamp._replace(value=self.stamp.value + float(t[-1]))
            t = t[::-1] - t[-1]
        return t, used

    def _found(self, header: str, slot: str, columns: list[tables.Column]) -> list[int]:
        """Return [index] of the column with a header that was given for a slot; [] without."""
        headers = [column.header for column in columns]
        if header not in headers:
            other = nearest(header, headers)
            self._doubt(f"{self.place}: there is no column {header!r} for {slot}{other}")
            return []
        if headers.count(header) > 1:
            self._doubt(f"{self.place}: two columns are called {header!r}")
        return [headers.index(header)]

    def _named_signals(self) -> dict[str, signals.Signal]:
        """Return {slot: its signal} by the headers that were given."""
        taken: dict[str, signals.Signal] = {}
        known = [signal.described for signal in self.signals]
        named = {s: header for s, (header, _) in self.named.items() if header != "none"}
        named.pop("t", None)
        for slot, header in named.items():
            other = next((s for s in taken if named[s] == header), None)
            if other:
                self._doubt(
                    f"{self.place}: column {header!r} is given for {other} and for {slot}: name one"
                    " column for each"
                )
            for i in self._found(header, slot, known):
                taken[slot] = self.signals[i]
        return taken

    def _recognised_signals(self) -> dict[str, signals.Signal]:
        """Return {slot: its signal} by the names of the other columns."""
        taken: dict[str, signals.Signal] = {}
        for slot, (kind, _) in self.slots.items():
            if slot in self.named or kind == "t":
                continue
            alike = self._alike(slot)
            if len(alike) > 1:
                a, b = (signal.described.header for signal in alike[:2])
                alone = f"two columns are called {a!r}"
                both = f"columns {a!r} and {b!r} both look like {slot}; name one with --column"
                self._doubt(f"{self.place}: {alone if a == b else both}")
            other = [of for of, signal in taken.items() if alike and signal is alike[0]]
            if other:
                self._doubt(
                    f"{self.place}: column {alike[0].described.header!r} looks like {other[0]} and"
                    f" like {slot}: name one column for each with --column"
                )
            elif alike:
                taken[slot] = alike[0]
        return taken

    def _alike(self, slot: str) -> list[signals.Signal]:
        """Return the unused signals whose names mean a slot best."""
        known = [key for key, its in self.keys.items() if its == slot]
        ranks = [
            max(signals.rank(s.described.name, slot, name, self.slots, self.keys) for name in known)
            for s in self.unused
        ]
        most = max(ranks, default=0)
        best = [s for rank, s in zip(ranks, self.unused) if 0 < rank == most]
        if self.slots[slot][0] == "pump" and len(best) == 1 and self._is_flow(best[0], slot):
            base = canonical(self._base(slot))
            drives = [s for rank, s in zip(ranks, self.unused) if rank > 0 and _drives(s, base)]
            return drives or best  # its input rather than the flow that it gives
        return best

    def _is_flow(self, signal: signals.Signal, slot: str) -> bool:
        """Whether a signal is a flow, where the input of a pump is none."""
        unit, base = tables.unit_name(signal.described.unit or ""), canonical(self._base(slot))
        return bool(factor(unit, "m^3/s")) and not factor(base, "m^3/s")

    def _signals_of_setpoints(self) -> dict[int, signals.Signal]:
        """Return {tank of an output: signal of its setpoint}."""
        slots = {tank: f"h{tank + 1}" for tank in self.plant.outputs}
        names = {tank: [k for k, its in self.keys.items() if its == s] for tank, s in slots.items()}
        setpoints: dict[int, signals.Signal] = {}
        for signal in self.unused:
            tank = signals.setpoint_of(signal.described.name, names)
            if tank is not None:
                setpoints.setdefault(tank, signal)
        return setpoints

    @property
    def unused(self) -> list[signals.Signal]:
        """The signals that are of no tank and no pump."""
        used = {signal.described.header for signal in self.taken.values()}
        return [signal for signal in self.signals if signal.described.header not in used]

    def log(self) -> Log | None:
        """Return the experiment data, None where something is wrong."""
        pumps = self._of_kind("pump")
        levels = [slot for slot in self._of_kind("h") if slot in self.taken]
        constant = self._without_column([slot for slot in pumps if slot not in self.taken])
        if not levels:
            self._no_column("h1", "a level")
        values = {slot: self._values(slot) for slot in self.taken}
        if self.problems:
            return None
        most = max(int(np.isfinite(values[slot][0]).sum()) for slot in levels)
        t, u, y, lines, unknown = self._samples(pumps, levels, values, constant, most)
        heads, units = zip(*(self._head(slot) for slot in (*pumps, *levels)))
        setpoints = self._setpoints(t)
        self._note_unused({header for header, _ in setpoints.values()})
        tanks, in_volts = zip(*((self.slots[slot][1], values[slot][1]) for slot in levels))
        data = log(
            t=t,
            u=u,
            y=y,
            tanks=tanks,
            in_volts=in_volts,
            name=self.name,
            lines=lines,
            headers=(self.time.header if self.time else "", *heads),
            units=("s", *units),
            hold=self.hold or "zero-order" * self._own_rows(pumps, levels, values, most),
            notes=tuple(f"{', '.join(of)}: {what}" for what, of in self.notes.items()),
        )
        data = dataclasses.replace(data, setpoints=setpoints, unknown=unknown, begins=self.stamp)
        return with_clips(data, self.loop)

    def _setpoints(self, t: np.ndarray) -> dict[int, tuple[str, np.ndarray]]:
        """Return {tank: (header, setpoints at the times t in the rig's unit)}."""
        notes, rows = {what: [*of] for what, of in self.notes.items()}, {}
        for tank, signal in self.setpoints.items():
            column, slot = signal.described, f"h{tank + 1}"
            unit = column.unit or (self._unit(slot) if slot in self.taken else None)
            try:
                values, _ = tables.numbers(signal.table, signal.column)
                values, volts = self._converted(slot, values, unit)
            except DataError:
                continue  # listed as not used
            levels = np.asarray(self.loop.sensor.level_of(tank, values, True)) if volts else values
            known = np.isfinite(levels)
            at = np.searchsorted(signal.t[known], t, side="right") - 1
            setpoints = np.append(levels[known], np.nan)[at]  # at -1: before the first
            rows |= {tank: (column.header, setpoints)} if known.any() else {}
        self.notes = notes  # only of what every command uses
        return rows

    def _of_kind(self, kind: str) -> list[str]:
        return [slot for slot, (its, _) in self.slots.items() if its == kind]

    def _note_unused(self, setpoints: set[str]) -> None:
        names = [repr(h) for s in self.unused if (h := s.described.header) not in setpoints]
        if names:
            self._note(f"not used: {', '.join(names[:12])}{', ..' * (len(names) > 12)}")

    def _head(self, slot: str) -> tuple[str, str]:
        """Return (header, unit) of a slot's column, "" without one."""
        if slot not in self.taken:
            return "", ""
        return self.taken[slot].described.header, self._unit(slot) or ""

    def _own_rows(self, pumps: list[str], levels: list[str], values: dict, most: int) -> bool:
        """Whether inputs are at other times than readings, or only in the rows of their changes."""
        inputs = [slot for slot in pumps if slot in values]
        if self.long:
            readings = np.concatenate([self.taken[slot].t for slot in levels])
            if not all(np.isin(self.taken[slot].t, readings).all() for slot in inputs):
                return True
        known = [v[np.isfinite(v)] for v in (values[slot][0] for slot in inputs)]
        changes = (2 * np.count_nonzero(np.diff(v)) >= len(v) - 1 for v in known)
        return bool(known) and all(2 * len(v) < most for v in known) and all(changes)

    def _samples(self, pumps, levels, values, constant, most):
        """Return t, u (samples, pumps), y (samples, levels), lines of the file or None, unknown."""
        t, lines = self.signals[0].t, np.array(self.table.lines)
        if self.long:
            t, lines = np.unique(np.concatenate([self.taken[s].t for s in values])), None
        u, unknown = np.zeros((len(t), len(pumps))), np.zeros((len(t), len(pumps)), dtype=bool)
        for j, slot in enumerate(pumps):
            u[:, j] = self._held(slot, t, values[slot][0]) if slot in values else constant[slot]
            if slot in values:
                unknown[:, j] = unknown_inputs(self.taken[slot].t, values[slot][0], t, most)
        y = np.full((len(t), len(levels)), np.nan)
        for c, slot in enumerate(levels):
            y[np.minimum(np.searchsorted(t, self.taken[slot].t), len(t) - 1), c] = values[slot][0]
        keep = np.isfinite(u).all(axis=1)
        if not keep.all():
            self._note(f"{count(int((~keep).sum()), 'row')} before the first input left out")
        if self.long:  # a row that tells neither a reading nor a change
            keep &= np.isfinite(y).any(axis=1) | np.any(np.diff(u, axis=0, prepend=np.nan), axis=1)
        lines = None if lines is None else lines[keep]
        return t[keep], u[keep], y[keep], lines, unknown[keep]

    def _note(self, what: str, of: str = "") -> None:
        """Note what is taken for granted of a signal, or of the whole file."""
        self.notes.setdefault(what, []).append(of or self.name)

    def _label(self, slot: str) -> str:
        kind, number = self.slots.get(slot, ("t", 0))
        name = name_of(self.plant, "tank" if kind == "h" else kind, number) if kind != "t" else ""
        return name or slot

    def _unit(self, slot: str) -> str | None:
        return self.units.get(slot, self.taken[slot].described.unit)

    def _base(self, slot: str) -> str:
        (kind, number), (length, drive) = self.slots[slot], self.loop.units
        return length if kind == "h" else input_unit(self.plant, number, drive)

    def _no_column(self, slot: str, what: str, headers: list[str] | None = None) -> None:
        """Add to the problems that a slot has no column among some headers, the signals'."""
        headers = headers or [signal.described.header for signal in self.signals]
        headers = list(map(repr, headers))
        more = f" and {len(headers) - 20} more" if len(headers) > 20 else ""
        for_slot = f"for {what}" if slot == "h1" else f"for {slot} ({what})"
        self._doubt(
            f"{self.place}: no column {for_slot} among {', '.join(headers[:20])}{more}; name it"
            f" with --column {slot}=HEADER"
            + f", or {slot}=none where it is off"
            * (self.slots.get(slot, ("t",))[0] == "pump")
        )

    def _without_column(self, missing: list[str]) -> dict[str, float]:
        """Return {slot: input} of pumps without a column: off in a drain test."""
        inputs, feeds = {}, len(getattr(self.plant, "feeds", range(self.plant.pumps)))
        valves = [slot for slot in missing if self.slots[slot][1] >= feeds]
        drained = len(missing) - len(valves) == feeds
        drained = drained and not any(map(self._like_input, self.unused))
        for slot in missing:
            number = self.slots[slot][1]
            if slot in valves:
                inputs[slot] = float(np.asarray(self.loop.actuator.initial)[number])
                what = label_of(self.plant, "pump", number)
                self._note(f"no column: it stays at {inputs[slot]:g}", what)
            elif slot in self.named or drained:
                inputs[slot] = 0.0
                self._note("no column: off throughout, a drain test", self._label(slot))
            else:
                self._no_column(slot, label_of(self.plant, "pump", number))
        return inputs

    def _like_input(self, signal: signals.Signal) -> bool:
        """Whether a signal without a name of the rig may be the input of a pump."""
        if any(signal is setpoint for setpoint in self.setpoints.values()):
            return False
        if (states := signals.states_of(signal.described)) is not None:
            return len(np.unique(states[np.isfinite(states)])) > 1
        unit = tables.unit_name(signal.described.unit or self.loop.units[1])
        driving = unit in ("%", "mA") or unit.lower() in SPEEDS
        share = unit in ("%", "mA") and unit != self.loop.units[1]  # else of anything
        if not driving and not any(factor(unit, name) for name in (self.loop.units[1], "m^3/s")):
            return False
        try:
            values, _ = tables.numbers(signal.table, signal.column)
        except DataError:
            return False
        values = values[np.isfinite(values)]
        return bool(np.any(values != (values[:1] if share else 0.0)))

    def _values(self, slot: str) -> tuple[np.ndarray, bool]:
        """Return (values of a slot in the rig's unit, whether they are a sensor's volts)."""
        signal, label = self.taken[slot], self._label(slot)
        values, in_volts, words = np.full(len(signal.t), np.nan), False, Counter[str]()
        states = signals.states_of(signal.described) if self.slots[slot][0] == "pump" else None
        try:
            if states is not None:
                values, missing = self._switched(slot, states), {}
            else:
                values, missing = tables.numbers(signal.table, signal.column)
                values, in_volts = self._converted(slot, values, self._unit(slot))
            words.update(missing)
            bad = signals.poor(signal)
            words.update(signal.quality[k] for k in np.flatnonzero(bad & np.isfinite(values)))
            values = np.where(bad, np.nan, values)
        except DataError as error:
            self.problems.append(str(error))
        if words:
            each = ", ".join(f"{n} {printable(word)}" for word, n in words.most_common(5))
            self._note(f"{count(words.total(), 'value')} taken as missing ({each})", label)
        return values, in_volts

    def _switched(self, slot: str, states: np.ndarray) -> np.ndarray:
        """Return inputs of the states of a pump, the ends of its range."""
        number, signal, label = self.slots[slot][1], self.taken[slot], self._label(slot)
        bank = self.loop.actuator
        low, high = float(bank.low[number]), float(bank.high[number])
        base = canonical(self._base(slot))
        for k in np.flatnonzero(np.isfinite(states) & ~np.isin(states, (0.0, 1.0)))[:1]:
            place = signal.table.where(signal.column, int(k))
            raise DataError(f"{place}: {states[k]:g}: must be 0 or 1, off and on")
        cells = signal.described.cells
        words = {share: cells[list(states).index(share)] for share in (1.0, 0.0) if share in states}
        if not (np.isfinite(low) and np.isfinite(high)):
            raise DataError(
                f"{signal.table.where(signal.column)}: {' and '.join(map(repr, words.values()))}"
                f" stand for no number, for the rig gives {label} no range: write low and high of"
                f" {label} [{base}] in the rig file, or numbers in {base} in the log"
            )
        ends = {1.0: high, 0.0: low}
        read = [f"{printable(word)} is read as {ends[v]:g} {base}" for v, word in words.items()]
        end = "ends" if len(read) > 1 else "end"
        self._note(f"{', '.join(read)}, the {end} of its range", label)
        return low + states * (high - low)

    def _held(self, slot: str, t: np.ndarray, values: np.ndarray) -> np.ndarray:
        """Return an input at the times t, each value held until the next."""
        known = np.isfinite(values)
        if not known.any():
            raise DataError(f"{self.place}: {slot} has no value")
        if not known.all():
            missing = count(int((~known).sum()), "value")
            self._note(f"{missing} missing: held from the row before", self._label(slot))
        at = np.searchsorted(self.taken[slot].t[known], t, side="right") - 1
        return np.where(at < 0, np.nan, values[known][at])

    def _converted(self, slot, values, written) -> tuple[np.ndarray, bool]:
        """Return (values in the rig's unit, whether they stay a sensor's volts)."""
        (kind, number), base = self.slots[slot], canonical(self._base(slot))
        if written is None:
            self._check_bare(slot, values, base)
            self._note(f"no unit in the header: taken in {base}, the rig's", self._label(slot))
            return values, False
        unit = tables.unit_name(written)
        if kind == "h" and unit in VOLTS and base not in VOLTS:
            self._check_volts(slot, base)
            return values * VOLTS[unit], True
        if (size := factor(unit, base)) is not None:
            return values * size, False
        if kind == "pump" and written.strip().lower() == ON_OFF:
            return self._switched(slot, values), False
        other = self._as_level if kind == "h" else self._as_input
        result = other(number, values, written, base, self._label(slot))
        if result is None:
            self._refuse_unit(slot, base, written)
        return result, False

    def _check_volts(self, slot: str, base: str) -> None:
        """Raise DataError where the rig does not say which level a voltage means."""
        tank, sensor, label = self.slots[slot][1], self.loop.sensor, self._label(slot)
        stated = getattr(sensor, "curve_level", None) is not None
        gain = np.broadcast_to(np.asarray(sensor.gain, dtype=float), (self.plant.tanks,))[tank]
        if not stated and gain == 1.0:
            place = self.taken[slot].table.where(self.taken[slot].column)
            raise DataError(
                f"{place}: is in V, and the rig does not say how many {base} of {label} are 1 V:"
                f" write it into the rig file, as the gain of its sensor [{base}/V], values ="
                f' {{ "sensor.gain[{tank}]" = 4.0 }}, or as its curve; where 1 V is 1 {base}, write'
                f" [{base}] in the header"
            )

    def _check_bare(self, slot: str, values: np.ndarray, base: str) -> None:
        """Raise DataError where the numbers of a column without a unit can be read in two ways."""
        (kind, number), known = self.slots[slot], values[np.isfinite(values)]
        if kind == "pump":
            high = float(self.loop.actuator.high[number])
            if SWITCHED < high < np.inf and known.any() and np.isin(known, (0.0, 1.0)).all():
                why = f"Its only numbers are 0 and 1, and its upper limit is {high:g} {base}"
                self._ask_unit(slot, (ON_OFF, base), why)
            if (
                base == "%"
                and high > SWITCHED
                and known.any()
                and np.all(known == known.clip(0, 1))
            ):
                why = f"Its numbers are up to {known.max():.4g}, and its upper limit is {high:g} %"
                self._ask_unit(slot, ("-", "%"), why)
            return
        display = getattr(self.loop.sensor, "display", ())
        if (reads := display[number] if display else "") and known.size:
            least, most = USUAL[reads]
            high = float(np.quantile(known, 0.9))  # above may be failed readings
            rim = float(np.broadcast_to(self.plant.rim, (self.plant.tanks,))[number])
            why = f"The sensor reads in {reads}, the rim of the tank is {rim:g} {base}"
            units = (reads, base) if least < high <= most else (base, reads)
            self._ask_unit(slot, units, f"{why}, and 90 % of the numbers are up to {high:.4g}")

    def _ask_unit(self, slot: str, units: tuple[str, str], why: str) -> NoReturn:
        """Raise DataError that asks which of two units a column without one has."""
        signal, label = self.taken[slot], self._label(slot)
        header, (first, second) = signal.described.header, units
        self.in_doubt, self.asked[slot] = True, units
        raise DataError(
            f"{signal.table.where(signal.column)}: has no unit: is it {first} or {second}? {why}."
            f" Write it in the header, as '{header} [{first}]' or '{header} [{second}]', or state"
            f' --column "{label}={header};{first}"'
        )

    def _refuse_unit(self, slot: str, base: str, written: str) -> NoReturn:
        """Raise DataError with the units that the column of a slot may have."""
        kind = self.slots[slot][0]
        usual = INPUT_UNITS if kind == "pump" else LEVEL_UNITS
        names = [name for name in usual if factor(name, base)] or [base]
        names += ["%", f"{base}^3"] * (kind == "h" and factor(base, "m") is not None)
        shares = [share for share in ("%", "mA") if factor(share, base) is None]
        if kind == "pump":
            names += [*(f"{share} of {self._top(slot)}" for share in shares), ON_OFF]
            if self.slots[slot][1] < len(getattr(self.plant, "feeds", ())):
                names.insert(-1, "Hz of 50 Hz")
        where = self.taken[slot].table.where(self.taken[slot].column)
        self.in_doubt = True
        raise DataError(
            f"{where}: {written!r} is no unit of a {KINDS[kind]}: must be one of {', '.join(names)}"
        )

    def _as_level(self, tank, values, unit, base, label) -> np.ndarray | None:
        """Return levels of per cents of a span, or of volumes; None of another unit."""
        if share := re.fullmatch(SHARE, tables.unit_name(unit)):
            low, high = spans_of(self.loop)[tank]
            if share[2]:
                low, high = 0.0, quantity(f"{label}, {share[1]} of", share[2], base)
            self._note(f"in {share[1]} of {low:g} to {high:g} {base}", label)
            return np.asarray(in_span(values, share[1], (low, high)))
        size, plant = factor(tables.unit_name(unit), f"{base}^3"), self.plant
        if size is None or getattr(plant, "area", None) is None:
            return None
        self._note("a volume: read as the level that holds it", label)
        shape = plant.shapes[tank] if getattr(plant, "shapes", ()) else "prism"
        extent = getattr(plant, "extent", None)
        top = 1.0 if extent is None else float(np.asarray(extent)[tank])
        volumes = np.where(np.isfinite(values), values * size, 0.0)
        levels = np.asarray(level_of(shape, float(np.asarray(plant.area)[tank]), top, volumes))
        return np.where(np.isfinite(values), levels, np.nan)

    def _as_input(self, pump, values, unit, base, label) -> np.ndarray | None:
        """Return inputs of shares of a range, or of flows by the pump's gain; None of others."""
        length, plant = self.loop.units[0], self.plant
        if share := re.fullmatch(SHARE, tables.unit_name(unit)):
            if not share[2]:
                return None  # its range is not known
            try:
                high = quantity(f"{label}, {share[1]} of", share[2], base)
            except InputError:
                return None
            self._note(f"in {share[1]} of 0 to {high:g} {base}", label)
            return np.asarray(in_span(values, share[1], (0.0, high)))
        most = float(self.loop.actuator.high[pump])
        feeds = getattr(plant, "feeds", ())
        if pump < len(feeds) and np.isfinite(most) and (full := _full_speed(unit)):
            least = float(self.loop.actuator.low[pump]) if base == "mA" else 0.0  # 4 to 20 mA
            ends = f"{unit.partition(' of ')[2]} is read as {most:g} {base}, 0 as {least:g}"
            self._note(f"a speed: {ends}", label)
            return least + values * ((most - least) / full)
        size = factor(tables.unit_name(unit), f"{length}^3/s") if factor(length, "m") else None
        curves = getattr(plant, "curves", ())
        plain = pump < len(feeds) and not (curves and curves[pump])
        if size is None or not plain:
            return None
        gain = float(np.asarray(plant.pump_gain)[pump])
        by = f"the input that gives it by the gain, {gain:.6g}, which this log cannot tell"
        self._note(f"a flow: read as {by}", label)
        return values * size / gain

    def _top(self, slot: str) -> str:
        """Return the upper limit of an input with its unit, as a span."""
        base, number = canonical(self._base(slot)), self.slots[slot][1]
        high = float(self.loop.actuator.high[number])
        high = high if np.isfinite(high) and high else 10.0  # an example
        return f"{100 * high:g} %" if base == "-" else f"{high:g} {base}"

    def table_text(self) -> str:
        """Return the [log] table of a rig file that reads the file, or that is to be completed."""
        guesses = self._guesses()
        lines = {"t": self._line_of_time()}
        for slot in self.slots.keys() - lines.keys():
            lines[slot] = "none", "no column"
            if slot in self.taken:
                lines[slot] = self._line_of(slot)
            elif slot in guesses:
                lines[slot] = guesses[slot].described.header, "a guess: check it"
        lines |= {
            s: (first, f"or {rigs.toml(other)}") for s, (first, other) in self.suggested.items()
        }
        texts = ["[log]"]
        for slot in [*self.slots, *self.suggested]:
            (value, remark), label = lines[slot], self._label(slot)
            key = label if re.fullmatch(r"[\w-]+", label, re.ASCII) else rigs.toml(label)
            texts.append(f"{key} = {rigs.toml(value)}" + f"  # {remark}" * bool(remark))
        return "\n".join(texts)

    def _line_of_time(self) -> tuple[Any, str]:
        """Return (value, remark) of the line of the times."""
        if self.time is None:
            used = [signal.described.header for signal in self.taken.values()]
            free = [c.header for c in self.table.columns if c.header not in used]
            return (free or ["TIME"])[0], "a guess: which column is the time?"
        if unit := self.units.get("t"):
            return [self.time.header, unit], ""
        if self.timed or self.time.unit or stamps.is_time(self.time.cells[0]):
            return self.time.header, ""
        return [self.time.header, "s"], "or ms, min, h, d"

    def _line_of(self, slot: str) -> tuple[Any, str]:
        """Return (value, remark) of the line of a slot that has a signal."""
        column = self.taken[slot].described
        if slot in self.asked:
            first, second = self.asked[slot]
            return [column.header, first], f"or {second}"
        kind, base = self.slots[slot][0], self._base(slot)
        try:
            self._converted(slot, np.zeros(1), self._unit(slot))
        except DataError:
            unit = printable(self._unit(slot))
            if kind == "pump" and tables.unit_name(unit) in ("%", "mA"):
                return [column.header, f"{unit} of {self._top(slot)}"], "a guess: of which range?"
            if kind == "pump" and (speed := SPEEDS.get(unit.lower())):
                full = f"{unit} of {3000.0 / speed:g} {unit}"
                return [column.header, full], "a guess: which is full speed?"
            return [column.header, base], f"if its numbers are in {base}: {unit} is not read"
        stated, unit = tables.split_header(column.header)[1], self._unit(slot) or base
        return (column.header if stated == unit else [column.header, unit]), ""

    def _guesses(self) -> dict[str, signals.Signal]:
        """Return {slot: signal} that may be meant, of the same number or of a unit that suits."""
        guesses: dict[str, signals.Signal] = {}
        for slot, (kind, _) in self.slots.items():
            if slot in self.taken or kind == "t":
                continue
            digits = re.findall(r"\d+", self._label(slot))[-1:]
            for signal in self.unused:
                same = re.findall(r"\d+", signal.described.name)[-1:] == digits
                words = set(re.split(r"[\W_]+", signal.described.name.lower()))
                measured = words & signals.MEASURED
                drives = words & signals.DRIVEN or (not measured and self._like_input(signal))
                suits = bool(drives) == (kind == "pump") and not words & signals.OTHER
                if same and suits and not any(signal is other for other in guesses.values()):
                    guesses.setdefault(slot, signal)
        return guesses


def _drives(signal: signals.Signal, base: str) -> bool:
    """Whether a signal is called an output of a controller and is in the unit of an input."""
    words, unit = re.split(r"[\W_]+", signal.described.name.lower()), signal.described.unit
    return bool(signals.DRIVEN & {*words} and factor(tables.unit_name(unit or base), base))


def _full_speed(unit: str) -> float | None:
    """Return 50.0 of "Hz of 50 Hz", or of "Hz of 3000 rpm"; None of a unit of another form."""
    rated = re.fullmatch(RATED, unit.strip().lower())
    if rated is None:
        return None
    speed, full = (SPEEDS.get(name) for name in (rated[1], rated[3] or rated[1]))
    number = float(rated[2].replace(" ", "").replace(",", "."))
    return number * full / speed if speed and full else None


def unknown_inputs(
    rows: np.ndarray, values: np.ndarray, t: np.ndarray, readings: int
) -> np.ndarray:
    """Return whether an input with values at the times `rows` is unknown at each of times t."""
    # none of an input that is written on change only: few values, or empty rows between most
    known = np.flatnonzero(np.isfinite(values))
    changing = 2 * np.count_nonzero(np.diff(values[known])) >= len(known) - 1
    few = len(known) < 3 or (2 * len(known) < readings and changing)
    if few or np.quantile(np.diff(known), 0.75) > 1:
        return np.zeros(len(t), dtype=bool)
    at = np.searchsorted(rows, t, side="right") - 1
    unknown = ~np.isfinite(values[at])
    if not is_irregular(rows):  # by a clock: rows are absent, and not only without a change
        unknown |= t - rows[at] > IRREGULAR * np.quantile(np.diff(rows), 0.9)
    return unknown & (at >= 0)


def _settings_and_columns(plant, columns):
    """Return ({setting: value}, {slot: (header, unit or None)}) of a [log] table."""
    keys, settings, named = log_keys(plant), {}, {}
    for key, spec in columns.items():
        if key in LOG_SETTINGS:
            settings[key] = spec
        elif key not in keys:
            raise InputError(f"unknown column {key!r}{nearest(key, [*keys, *LOG_SETTINGS])}")
        else:
            header, unit = (spec, None) if isinstance(spec, str) else spec
            named[keys[key]] = (header.strip(), unit)  # "": found by its name
    if named.get("t", ("", None))[0] == "none":
        raise InputError("column t = none: only a level may be left out, or a pump that is off")
    return settings, named
