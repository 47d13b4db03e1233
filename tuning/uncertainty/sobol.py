"""Scrambled Sobol points, those of `scipy.stats.qmc.Sobol` without its slow import.

Joe and Kuo 2008 (direction numbers), Matousek 1998 (scrambling by matrices and a shift).
"""

import functools
import importlib.util
from pathlib import Path
from typing import Any

import numpy as np

BITS = 30  # of a point
NUMBERS = Path("stats", "_sobol_direction_numbers.npz")  # in the folder of scipy


class Sobol:
    """The sequence of a seed in a cube."""

    def __init__(self, dimensions: int, seed: Any):
        self.dimensions, self.seed = dimensions, seed
        if _directions(dimensions) is None:
            return
        rng, size = np.random.default_rng(seed).spawn(1)[0], (dimensions, BITS)
        powers = 2 ** np.arange(BITS, dtype=np.uint32)
        self.shift = np.dot(rng.integers(2, size=size, dtype=np.uint32), powers)
        matrices = np.tril(rng.integers(2, size=(*size, BITS), dtype=np.uint32))
        matrices[:, np.arange(BITS), np.arange(BITS)] = 1
        rows, columns = matrices @ powers[::-1], _directions(dimensions)
        # bit p of a scrambled column, from the highest: the parity of row p and the column
        parity = np.bitwise_count(rows[:, :, None] & columns[:, None, :]).astype(np.uint32) & 1
        self.columns: Any = np.sum(parity * powers[::-1][:, None], axis=1, dtype=np.uint32)

    def rows(self, start: int, stop: int) -> np.ndarray:
        """Return (stop - start, dimensions) points of the sequence."""
        if _directions(self.dimensions) is None:
            from scipy.stats import qmc

            engine = qmc.Sobol(self.dimensions, rng=np.random.default_rng(self.seed))
            return engine.random_base2(stop.bit_length())[start:stop]
        place = np.arange(start, stop, dtype=np.uint32)
        gray = np.bitwise_xor(place, place >> 1)[:, None]  # of which each place changes one bit
        points = np.broadcast_to(self.shift, (len(place), len(self.shift)))
        for bit in range(stop.bit_length()):
            points = points ^ np.where(gray >> bit & 1, self.columns[:, bit], 0)
        return points / 2.0**BITS


@functools.cache
def _directions(dimensions: int) -> Any:
    """(dimensions, BITS) direction numbers by Joe and Kuo's recurrence; None without table."""
    package = importlib.util.find_spec("scipy")
    folder = Path(next(iter(package.submodule_search_locations or ()))) if package else Path()
    try:
        with np.load(folder / NUMBERS, allow_pickle=False) as tables:
            polynomials = tables["poly"][:dimensions].tolist()
            starts = tables["vinit"][:dimensions].tolist()
    except (OSError, KeyError):
        return None
    if len(starts) < dimensions:
        return None
    numbers = [[1] * BITS]
    for polynomial, begin in zip(polynomials[1:], starts[1:]):
        degree = polynomial.bit_length() - 1
        row = begin[:degree]
        for j in range(degree, BITS):
            value = row[j - degree]
            for k in range(degree):
                if polynomial >> (degree - 1 - k) & 1:
                    value ^= row[j - k - 1] << (k + 1)
            row.append(value)
        numbers.append(row[:BITS])
    powers = 2 ** np.arange(BITS - 1, -1, -1, dtype=np.uint64)
    return (np.array(numbers[:dimensions], dtype=np.uint64) * powers).astype(np.uint32)
