"""The values and measures that a search starts from."""

import numpy as np

from jaxtank import measures as ms
from jaxtank.core.tree import get_value
from jaxtank.loop import run as lp


def own_values(problem):
    """{name: value} of the case itself."""
    return {b.name: float(get_value(problem.loop, b.name)) for b in problem.bounds}


def run_measures(loop, clock, key):
    """{measure: value} of everything that is reported of a run, and when the highest and lowest
    levels were reached.
    """
    names = tuple(m for m in ms.reported() if ms.serves(m, loop))
    values = lp.evaluate(loop, clock, (*names, *ms.times()), key)
    return {m: np.asarray(v) for m, v in values.items()}
