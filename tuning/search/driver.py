"""A search as a solver uses it: scaled cost and margins, cached points, the best point so far."""

from collections.abc import Callable
from typing import Any

import numpy as np
import scipy

from tuning.problem.evaluator import Evaluator
from tuning.problem.problem import DIVERGED, Point
from tuning.problem.slopes import SlopeCheck, check_slope

TIGHTENING = 1e-6  # share of a limit by which a search stays inside it: round-off [-]
SETTLED = 0.02  # KKT residual (scaled cost per unit of z) of a converged first-order method
SLOPING = 0.05  # KKT residual above which `downhill` looks for a lower point

STRIDES = (3e-2, 1e-2, 3e-3, 1e-3, 1e-4)
"""Steps along the gradient that is left, in the unit cube, at which `downhill` looks for a lower
point.
"""

UNSTABLE = 1.0 / STRIDES[-1]
"""KKT residual, of the scaled cost per unit of z, by which the cost would fall below 0 within the
least of STRIDES: the derivative of an unstable or chaotic run, exact, and of no use for a step.
"""

LOWER_BY = 1e-4  # share by which a cost must fall to count as lower at a kink [-]


class Search:
    """A problem as a solver uses it."""

    def __init__(
        self,
        evaluator: Evaluator,
        reference: Point,
        report: Callable[["Search"], Any] = lambda search: None,
        tolerance: float | None = None,
    ):
        self.evaluator, self.problem = evaluator, evaluator.problem
        self.report, self.tolerance = report, 1e-8 if tolerance is None else tolerance
        self.reference = reference
        # a cost can be a scale where its slopes are not to be used
        self.scale = reference.cost if 0 < reference.cost < DIVERGED else 1.0
        self.limit_scale = self.problem.limit_scales
        # zero is often the least a measure can be: such a limit cannot be tightened
        self.tightening = max(TIGHTENING, self.tolerance) * np.array(
            [limit.value != 0 for limit in self.problem.limits], dtype=float
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
            self.take(self.evaluator.point(z))
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
            self.slopes[key] = check_slope(self.evaluator, point)
        return self.slopes[key]

    def violation(self, point: Point) -> float:
        """Return the largest violation as a share of its `limit_scale` [-]; 0 where all hold."""
        return float(self.violations(point.margins))

    def violations(self, margins: Any) -> Any:
        return np.max(-margins / self.limit_scale, axis=-1, initial=0.0)

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
        # where not finite: ten times the start, with a gradient back to the last finite point
        point = self.point(z)
        if point.finite:
            return point.cost / self.scale, point.gradient / self.scale
        return 10.0, (point.z - self.last_finite.z) * 10.0

    def margins(self, z: Any) -> tuple[np.ndarray, np.ndarray]:
        """Return (limits,) scaled margins less the tightening, and their (limits, P) slopes."""
        point = self.point(z)
        return self.scaled_margins(point if point.finite else self.last_finite)

    def scaled_margins(self, point: Point) -> tuple[np.ndarray, np.ndarray]:
        """Return `margins` of a finite Point."""
        slopes = point.margin_slopes / self.limit_scale[:, None]
        return point.margins / self.limit_scale - self.tightening, slopes


class CoarseSearch(Search):
    """The same problem at a tenth of the samples, on the same scale."""

    def __init__(self, search: Search):
        super().__init__(search.evaluator, search.last_finite, search.report)
        self.scale, self.owner = search.scale, search

    def point(self, z: Any) -> Point:
        """Return the coarse Point at z, clipped into the unit cube; cached."""
        z = np.clip(z, 0.0, 1.0)
        if z.tobytes() not in self.memory:
            point = self.memory[z.tobytes()] = self.evaluator.coarse_point(z)
            if point.finite and (self.best is None or point.cost < self.best.cost):
                self.best = point
            self.owner.report(self.owner)
        return self.memory[z.tobytes()]


def reporter(progress: Callable | None, starts: int, unit: str | None = None) -> Callable:
    """Return the callback of a Search after each evaluation: `progress` with a dict."""

    def report(search: Search) -> None:
        if progress is None or not search.history:
            return
        best, (_, cost, violation, _) = search.best, search.history[-1]
        event: dict[str, Any] = dict.fromkeys(("best", "best_violation", "values"))
        if best is not None:
            event = {"best": best.cost, "best_violation": search.violation(best)}
            event["values"] = search.problem.values(best.z)
        event |= {"start": search.start, "starts": starts, "evaluations": len(search.history)}
        # unit: of the cost, None: the usual one of the case
        progress(event | {"cost": cost, "violation": violation, "unit": unit})

    return report


def optimality(search, point):
    """Return (gradient norm, KKT residual, multipliers of the limits) at a point."""
    # Residual: the gradient less its best non-negative combination of active limits and bounds.
    if not point.finite:
        return np.inf, np.inf, np.zeros(len(point.margins))
    residual, multipliers = _residual(search, point)
    gradient = float(np.linalg.norm(point.gradient / search.scale))
    return gradient, float(np.linalg.norm(residual)), multipliers


def named_optimality(search, point):
    """Return {"gradient_norm", "kkt_residual", "multipliers": {limit: value}} of a point."""
    if search is None or point is None or not search.slope(point).usable:
        return {"gradient_norm": None, "kkt_residual": None, "multipliers": {}}
    norm, residual, multipliers = optimality(search, point)
    named = {limit.label: float(m) for limit, m in zip(search.problem.limits, multipliers) if m > 0}
    return {"gradient_norm": norm, "kkt_residual": residual, "multipliers": named}


def _residual(search, point):
    """Return (what is left of the gradient (P,), multipliers (limits,)); see `optimality`."""
    gradient, multipliers = point.gradient / search.scale, np.zeros(len(point.margins))
    margins, slopes = search.scaled_margins(point)
    active = np.flatnonzero(margins < 1e-4)
    ends = np.flatnonzero((point.z < 1e-6) | (point.z > 1 - 1e-6))
    inward = np.where(point.z[ends] < 0.5, 1.0, -1.0)
    columns = np.vstack([slopes[active], inward[:, None] * np.eye(len(gradient))[ends]])
    if not len(columns):
        return gradient, multipliers
    weights, _ = scipy.optimize.nnls(columns.T, gradient)
    multipliers[active] = weights[: len(active)]
    return gradient - columns.T @ weights, multipliers


def downhill(search, point):
    """Return a feasible Point that is lower than `point`, found along the gradient that is left."""
    if not point.finite:
        return None
    residual, _ = _residual(search, point)
    size = np.linalg.norm(residual)
    if size <= SLOPING:
        return None
    for stride in STRIDES:
        other = search.point(point.z - stride * residual / size)
        lower = other.cost < point.cost - LOWER_BY * abs(point.cost)
        if other.finite and search.violation(other) == 0.0 and lower:
            return other
    return None
