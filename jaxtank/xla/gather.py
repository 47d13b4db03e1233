"""Which orifices, pipes, spills and pumps end at which tank, as index arrays of a fixed width.

What meets at a tank is summed by gathers: each row reads at most `width` values, padded with ones
of weight 0. A scatter would break the time loop's compilation to one function (five times slower
with 100 tanks); so would a sparse matrix.
"""

import functools
import operator
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from jaxtank.core.vectors import take
from jaxtank.xla.barrier import materialised

WIDEST = 8
"""Values that a row reads at most: a tank that more of them meet has several rows."""


class Round(NamedTuple):
    """Rows of partial sums: row r reads values[index[r, j]], those with present[r, j] = 1."""

    index: np.ndarray[Any, Any]  # (rows, width)
    present: np.ndarray[Any, Any]  # (rows, width) 1 or 0


@functools.lru_cache(maxsize=256)
def rounds(ends: tuple[int, ...], tanks: int) -> tuple[Round, ...]:
    """Return the Rounds that add up the values of each tank; value i belongs to tank ends[i]."""
    if not ends:
        return ()
    groups: list[list[int]] = [[] for _ in range(tanks)]
    for value, tank in enumerate(ends):
        groups[tank].append(value)
    sizes = np.bincount(ends, minlength=tanks)
    most = min(WIDEST, int(sizes.max()))
    # as few reads as possible in all: rows times width
    width = min(
        range(1 if sizes.max() == 1 else 2, most + 1),
        key=lambda w: w * int(np.maximum(1, -(-sizes // w)).sum()),
    )
    rows = [
        (tank, group[start : start + width])
        for tank, group in enumerate(groups)
        for start in range(0, max(1, len(group)), width)
    ]
    index, present = np.zeros((len(rows), width), np.int32), np.zeros((len(rows), width))
    for r, (_, row) in enumerate(rows):
        index[r, : len(row)], present[r, : len(row)] = row, 1.0
    first = Round(index, present)
    if len(rows) == tanks:
        return (first,)
    return first, *rounds(tuple(tank for tank, _ in rows), tanks)


def gathered(weights: Any, values: Any, ends: tuple[int, ...], tanks: int, of: Any = None) -> Any:
    """Return (n,) sums over what ends at each tank of weight times value; None without any."""
    sums: Any = None
    for level, (index, present) in enumerate(rounds(ends, tanks)):
        terms: list[Any] = []
        sums = materialised(sums) if level else None
        for column, there in zip(index.T, present.T):
            if level:
                terms.append(_kept(there, take(sums, column)))
                continue
            known = isinstance(weights, np.ndarray)
            weight = _kept(there, weights[column] if known else take(weights, column))
            read = column if of is None else np.asarray(of)[column]
            terms.append(weight if values is None else weight * take(values, read))
        sums = functools.reduce(operator.add, terms)
    return sums


def _kept(present: np.ndarray[Any, Any], values: Any) -> Any:
    """`values` (rows,), 0 where they only pad a row."""
    if isinstance(values, np.ndarray):
        return values * present
    return values if present.all() else jnp.where(present > 0.0, values, 0.0)
