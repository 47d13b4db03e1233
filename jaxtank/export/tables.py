"""Signals that are tables or recorded samples, as data beside the code of a loop."""

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxtank.case import Case
from jaxtank.core.clock import Chunk, Clock, is_pointwise, pointwise
from jaxtank.core.errors import InputError
from jaxtank.loop.change_windows import jumps, moves
from jaxtank.signals.base import Signal, Sum

LARGEST = 100_000  # line segments of a page's tables
STRAIGHT = 1e-12  # deviation from a straight line, as a share of a column's largest number


class Columns(NamedTuple):
    """What table signals return at each sample of a run."""

    signals: dict[str, Signal]  # {dotted name of a signal: itself}
    structure: Any  # of all that they return, for `jax.tree.unflatten`
    values: list[Any]  # in this order: a number that lasts, else (samples,)

    @property
    def varying(self) -> list[np.ndarray]:
        """Those that change."""
        return [v for v in self.values if np.ndim(v)]


@jax.tree_util.register_static
class LookedUp:
    """A table signal with its values at the current sample."""

    def __init__(self, signal: Signal, now: Any):
        self.signal, self.now = signal, now

    def __getattr__(self, name: str) -> Any:
        return getattr(self.signal, name)

    @pointwise
    def sample(self, times: Clock | Chunk) -> Any:
        """Return `Signal.sample` of the current sample."""
        assert times.samples == 1, "one sample is known"
        return self.now["sample"]

    @pointwise
    def windows(self, times: Clock | Chunk) -> Any:
        """Return `Signal.windows` of the current sample."""
        return self.now["windows"]

    @pointwise
    def since(self, times: Clock | Chunk) -> Any:
        """Return `Signal.since` of the current sample."""
        return self.now["since"]

    @property
    def known(self) -> dict[str, Any]:
        """What `change_windows` would ask of other samples: whether each input's setpoint jumps
        now, and whether each target ever moves.
        """
        return {name: tuple(v != 0.0 for v in self.now[name]) for name in ("jumps", "moves")}


def columns_of(case: Case) -> Columns:
    """Return the Columns of a case."""
    loop, clock = case.loop, case.clock
    signals, results = tables_of(loop), dict[str, Any]()
    for name, signal in signals.items():
        now: dict[str, Any] = {"sample": signal.sample(clock), "windows": signal.windows(clock)}
        now |= {"since": signal.since(clock), "jumps": (), "moves": ()}
        if name == "reference":
            now["jumps"] = jumps(loop, clock, now["sample"][0])
            now["moves"] = moves(signal) if signal.changes else ()
        results[name] = now
    flat, structure = jax.tree.flatten(results)
    values = [np.asarray(v, dtype=float) for v in flat]
    values = [v.flat[0] if np.all(v == v.flat[0]) else v for v in values]
    return Columns(signals, structure, values)


def tables_of(loop: Any) -> dict[str, Signal]:
    """Return {dotted name: signal} of the signals that code of single samples does not hold."""
    signals = {
        "reference": loop.reference,
        "controller.signal": getattr(loop.controller, "signal", None),
        **dict(_parts("disturbance", loop.disturbance)),
    }
    table = lambda s: s is not None and (s.is_table or not is_pointwise(s))
    return {name: signal for name, signal in signals.items() if table(signal)}


def _parts(name: str, signal: Any) -> Any:
    """Yield (dotted name, signal) of what a Sum adds."""
    if isinstance(signal, Sum):
        yield from _parts(f"{name}.first", signal.first)
        yield from _parts(f"{name}.second", signal.second)
    else:
        yield name, signal


def runs_by_samples(loop: Any) -> bool:
    """Return whether all but the tables of a loop follows from the time of a sample alone."""
    return is_pointwise(_with(loop, {name: LookedUp(s, {}) for name, s in tables_of(loop).items()}))


def looked_up(loop: Any, columns: Columns, now: tuple[Any, ...]) -> Any:
    """Return a loop whose table signals have the values `now` of the varying columns."""
    varying = iter(now)
    values = [next(varying)[None] if np.ndim(v) else jnp.full(1, v) for v in columns.values]
    results = jax.tree.unflatten(columns.structure, values)
    return _with(loop, {n: LookedUp(s, results[n]) for n, s in columns.signals.items()})


def _with(part: Any, values: dict[str, Any]) -> Any:
    """`part` with other values of fields with dotted names."""
    for name, value in values.items():
        first, _, rest = name.partition(".")
        value = _with(getattr(part, first), {rest: value}) if rest else value
        part = dataclasses.replace(part, **{first: value})
    return part


def packed(case: Case) -> list[list[list[float]]]:
    """Return [starts, ends, numbers of samples] of the line segments of each varying column."""
    # Raises InputError for more than a page holds.
    rows = [line_segments(v) for v in columns_of(case).varying]
    count = sum(len(starts) for starts, *_ in rows)
    if count > LARGEST:
        raise InputError(
            f"{case.name}: its tables have {count:,} line segments, and a page holds"
            f" {LARGEST:,}: run a part of the time (--set clock.duration=S), or take longer samples"
            " (--dt)"
        )
    return rows


def line_segments(v: np.ndarray) -> list[list[float]]:
    """Return [starts, ends, numbers of samples] of line segments, straight to STRAIGHT."""
    near = STRAIGHT * np.max(np.abs(v))
    bends = 2 + np.flatnonzero(np.abs(np.diff(v, n=2)) > near)
    starts = [0]
    for k in bends.tolist():
        if k - 1 > starts[-1]:  # else this is the second sample of a piece, which gives its slope
            starts.append(k)
    first = np.array(starts)
    last = np.append(first[1:], len(v)) - 1
    # bends that are each too small to be seen may add up
    ends = np.ravel([first, last], "F")
    line = np.interp(np.arange(len(v)), ends, v[ends])
    not_straight = np.maximum.reduceat(np.abs(line - v), first) > near
    samples = np.repeat(not_straight, last - first + 1)
    first = np.union1d(first, np.flatnonzero(samples))
    last = np.append(first[1:], len(v)) - 1
    counts: Any = last - first + 1
    return [v[first].tolist(), v[last].tolist(), counts.tolist()]
