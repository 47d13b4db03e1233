"""A search as a solver uses it: scaled cost and margins, cached points, the best point so far."""

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np
import scipy

from jaxtank import measures as ms
from tuning.problem.problem import DIVERGED, Point, Problem
from tuning.problem.slopes import SlopeCheck, check_slope

TIGHTENING = 1e-6
"""Share of its limit by which a search keeps a measure inside it, so that the reported value is not
above by round-off [-].
"""

SETTLED = 0.02
"""KKT residual, of the scaled cost per unit of z, below which a first-order method counts as
converged.
"""


class Search:
    """A problem as a solver uses it."""

    def __init__(
        self,
        problem: Problem,
        reference: Point,
        report: Callable[["Search"], Any],
        tolerance: float = 1e-8,
    ):
        self.problem, self.report, self.tolerance = problem, report, tolerance
        self.reference = reference
        # a cost can be a scale where its slopes are not to be used
        self.scale = reference.cost if 0 < reference.cost < DIVERGED else 1.0
        self.limit_scale = problem.limit_scales
        # a limit of exactly zero is often the least a measure can be, and cannot be tightened; a
        # search ends within its tolerance of a limit, on either side
        self.tightening = max(TIGHTENING, tolerance) * np.array(
            [limit.value != 0 for limit in problem.limits], dtype=float
        )
        self.start = 0  # number of the local search
        self.exhausted = False  # whether the last local search used up its iterations
        self.best: Any = None
        self.best_start: Any = None
        self.history: list[tuple] = []
        self.memory: dict[bytes, Point] = {}
        self.slopes: dict[bytes, SlopeCheck] = {}
        self.last_finite = reference

    def point(self, z: Any) -> Point:
        """Return the Point at z, clipped into the unit cube; cached."""
        z = np.clip(z, 0.0, 1.0)
        key = z.tobytes()
        if key not in self.memory:
            self.take(self.problem.point(z))
        return self.memory[key]

    def take(self, point: Point) -> None:
        """Enter a Point into the cache and the history; it may become the best."""
        self.memory[point.z.tobytes()] = point
        violation = self.violation(point) if point.finite else np.inf
        self.history.append((self.start, float(point.cost), violation, tuple(point.z)))
        if point.finite:
            self.last_finite = point
            if self.best is None or self.better(point, self.best):
                self.best, self.best_start = point, self.start
        self.report(self)

    def slope(self, point: Point) -> SlopeCheck:
        """Return whether runs beside a Point bear its slopes out; cached."""
        key = point.z.tobytes()
        if key not in self.slopes:
            self.slopes[key] = check_slope(self.problem, point)
        return self.slopes[key]

    def violation(self, point: Point) -> float:
        """Return the largest violation as a share of its `limit_scale` [-]; 0 where all hold."""
        return float(max(0.0, *(-point.margins / self.limit_scale))) if len(point.margins) else 0.0

    def return_to_start(self) -> bool:
        """Return True if the best point is now the start, whose derivatives are not finite."""
        start = self.reference
        if start.finite or not start.valued:
            return False
        if self.best is not None and not self.better(start, self.best):
            return False
        self.best, self.best_start = start, None
        return True

    def better(self, a: Point, b: Point) -> bool:
        """Return True if a is to be preferred: smaller violation first, then lower cost."""
        va, vb = self.violation(a), self.violation(b)
        return va < vb if max(va, vb) > 0 and va != vb else a.cost < b.cost

    def cost(self, z: Any) -> tuple[float, np.ndarray]:
        """Return (scaled cost, gradient (P,))."""
        # A point that is not finite costs ten times the start, and its gradient points back to the
        # last finite one.
        point = self.point(z)
        if point.finite:
            return point.cost / self.scale, point.gradient / self.scale
        return 10.0, (point.z - self.last_finite.z) * 10.0

    def margins(self, z: Any) -> tuple[np.ndarray, np.ndarray]:
        """Return (limits,) scaled margins less the tightening, and their (limits, P) slopes."""
        point = self.point(z)
        good = point if point.finite else self.last_finite
        slopes = good.margin_slopes / self.limit_scale[:, None]
        return good.margins / self.limit_scale - self.tightening, slopes


def event_of(search: Search, starts: int, **more: Any) -> dict[str, Any]:
    """Return what `progress` is called with after an evaluation, and `more`."""
    best, last = search.best, search.history[-1]
    return {
        "start": search.start,
        "starts": starts,
        "evaluations": len(search.history),
        "cost": last[1],
        "violation": last[2],
        "best": None if best is None else best.cost,
        "best_violation": None if best is None else search.violation(best),
        "values": None if best is None else search.problem.values(best.z),
        "details": lambda: details_of(search.problem, best),
        **more,
    }


def details_of(problem: Problem, best: Point | None) -> dict[str, Any]:
    """Return the parameters and the limits of a problem at a point, as JSON objects."""
    now: dict[str, float] = {} if best is None else problem.values(best.z)
    parameters = [
        {
            "name": b.name,
            "unit": b.unit,
            "low": b.low,
            "high": b.high,
            "before": before,
            "now": now.get(b.name),
        }
        for b, before in zip(problem.bounds, problem.own_values().values())
    ]
    limits: dict[Any, dict[str, Any]] = {}
    for limit, margin in zip(problem.limits, () if best is None else best.margins):
        key = limit.measure, limit.index, limit.value
        unit = ms.unit(limit.measure, problem.loop.units)
        one = limits.setdefault(
            key,
            {
                "name": dataclasses.replace(limit, scenario="").label,
                "unit": unit,
                "value": limit.value,
                "sense": limit.sign,
                "margin": float(margin),
            },
        )
        one["margin"] = min(one["margin"], float(margin))
    return {"parameters": parameters, "limits": list(limits.values())}


class CoarseSearch(Search):
    """The same problem at a tenth of the samples, on the same scale."""

    def __init__(self, search: Search):
        super().__init__(search.problem, search.last_finite, search.report)
        self.scale, self.owner = search.scale, search

    def point(self, z: Any) -> Point:
        """Return the coarse Point at z, clipped into the unit cube; cached."""
        z = np.clip(z, 0.0, 1.0)
        if z.tobytes() not in self.memory:
            found = self.memory[z.tobytes()] = self.problem.coarse_point(z)
            if found.finite and (self.best is None or found.cost < self.best.cost):
                self.best = found
            self.owner.report(self.owner)
        return self.memory[z.tobytes()]


SLOPING = 0.05
"""KKT residual, of the scaled cost per unit of z, above which `downhill` looks for a lower
point.
"""

STRIDES = (3e-2, 1e-2, 3e-3, 1e-3, 1e-4)
"""Steps along the gradient that is left, in the unit cube, at which `downhill` looks for a lower
point.
"""

UNSTABLE = 1.0 / STRIDES[-1]
"""KKT residual, of the scaled cost per unit of z, by which the cost would fall below 0 within the
least of STRIDES: the derivative of an unstable or chaotic run, exact, and of no use for a step.
"""

LOWER_BY = 1e-4
"""Share by which the cost must fall for a point to count as lower than one at a kink [-]."""


def optimality(search, point):
    """Return (gradient norm, KKT residual, multipliers of the limits) at a point."""
    # All of the scaled cost per unit of z. The residual is what is left of the gradient after the
    # best non-negative combination of the slopes of active limits and bounds. Infinite where a
    # derivative is not finite.
    if not point.finite:
        return np.inf, np.inf, np.zeros(len(point.margins))
    residual, multipliers = _residual(search, point)
    return (
        float(np.linalg.norm(point.gradient / search.scale)),
        float(np.linalg.norm(residual)),
        multipliers,
    )


def named_optimality(search, point):
    """Return {"gradient_norm", "kkt_residual", "multipliers": {limit: value}} of a point."""
    if search is None or point is None or not search.slope(point).usable:
        return {"gradient_norm": None, "kkt_residual": None, "multipliers": {}}
    norm, residual, multipliers = optimality(search, point)
    named = {limit.label: float(m) for limit, m in zip(search.problem.limits, multipliers) if m > 0}
    return {"gradient_norm": norm, "kkt_residual": residual, "multipliers": named}


def _residual(search, point):
    """Return (what is left of the gradient (P,), multipliers (limits,)); see `optimality`."""
    g = point.gradient / search.scale
    columns, owners = [], []
    margins = point.margins / search.limit_scale - search.tightening
    slopes = point.margin_slopes / search.limit_scale[:, None]
    for i, (margin, slope) in enumerate(zip(margins, slopes)):
        if margin < 1e-4:
            columns.append(slope)
            owners.append(i)
    for p, z in enumerate(point.z):
        if z < 1e-6 or z > 1 - 1e-6:
            columns.append(np.eye(len(g))[p] * (1.0 if z < 0.5 else -1.0))
            owners.append(None)
    multipliers = np.zeros(len(point.margins))
    residual = g
    if columns:
        matrix = np.array(columns).T
        found, _ = scipy.optimize.nnls(matrix, g)
        residual = g - matrix @ found
        for owner, value in zip(owners, found):
            if owner is not None:
                multipliers[owner] = value
    return residual, multipliers


def downhill(search, point):
    """Return a feasible Point that is lower than `point`, found along the gradient that is left."""
    if not point.finite:
        return None
    residual, _ = _residual(search, point)
    if np.linalg.norm(residual) <= SLOPING:
        return None
    for stride in STRIDES:
        other = search.point(point.z - stride * residual / np.linalg.norm(residual))
        if (
            other.finite
            and search.violation(other) == 0.0
            and other.cost < point.cost - LOWER_BY * abs(point.cost)
        ):
            return other
    return None
