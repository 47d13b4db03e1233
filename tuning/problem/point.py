"""A problem at one point: cost, margins and their derivatives."""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

DIVERGED = 1e9
"""Size at which a cost, a margin or a slope is no longer a number to search with."""

NO_VECTOR: Floats = np.zeros(0)
NO_MATRIX: Floats = np.zeros((0, 0))


class Point(NamedTuple):
    """The problem at one point z of the unit cube, derivatives with respect to z."""

    z: Floats  # (P,)
    cost: float  # weighted sum of measures, over the scenarios by `risk`
    gradient: Floats  # (P,)
    # (P, P) second derivative of what `Problem.model` names, without the residuals' own curvature
    gauss_newton: Floats
    margins: Floats  # (limits,) in each measure's unit
    margin_slopes: Floats  # (limits, P)
    measures: tuple[Mapping[str, Any], ...]  # of each scenario, {name: value}
    run_costs: Floats = NO_VECTOR  # (scenarios,)
    run_slopes: Floats = NO_MATRIX  # (scenarios, P)
    rows: tuple[int, ...] = ()  # which of the problem's limits the margins are of, where not all

    @property
    def finite(self) -> bool:
        """True if cost, margins and derivatives are numbers that one can search with."""
        return all(
            bool(np.all(np.abs(v) < DIVERGED))
            for v in (self.cost, self.gradient, self.margins, self.margin_slopes)
        )

    @property
    def valued(self) -> bool:
        """True if cost and margins are numbers that one can compare, whatever the derivatives."""
        return all(bool(np.all(np.abs(v) < DIVERGED)) for v in (self.cost, self.margins))
