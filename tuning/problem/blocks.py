"""Points run in blocks of one size, so that the fewest programs are compiled. Used by `problem`."""

from collections.abc import Callable

import numpy as np

from tuning.problem.point import Floats

LANES = 256
"""Runs without derivatives that one program makes side by side: enough to fill the vector units."""

IDLE = 2**23
"""Samples of runs that are made in vain, at most, so as to use a program that is compiled."""

Screened = tuple[Floats, Floats]
"""(costs (points,), margins (points, limits))."""


class Blocks:
    """How many points a program runs: as many as in an earlier call where that serves."""

    # The sizes follow from the calls alone, not from what is known already: a search that is
    # continued gives the same bits.

    def __init__(self, runs: int):
        self.runs = runs
        self.sizes: dict[bool, int] = {}

    def size(self, points: int, coarse: bool, samples: int) -> int:
        """Return the points of a block, for a call with so many points of runs of `samples`."""
        size, wanted = self.sizes.get(coarse, 0), max(1, min(points, LANES // self.runs))
        if size < wanted:
            self.sizes[coarse] = wanted
            return wanted
        return size if -points % size * self.runs * samples <= IDLE else wanted


def in_blocks(screen: Callable[[Floats], Screened], zs: Floats, size: int) -> Screened:
    """Return screen(zs), called with `size` points at a time, the last one repeated to fill up."""
    filled = np.concatenate([zs, np.repeat(zs[-1:], -len(zs) % size, axis=0)])
    found = [screen(filled[i : i + size]) for i in range(0, len(filled), size)]
    costs, margins = (np.concatenate(parts)[: len(zs)] for parts in zip(*found))
    return costs, margins
