"""The search of a fit, by SciPy's bounded trust region, and the profile likelihood."""

import contextlib
import dataclasses
import math
from collections.abc import Mapping
from typing import Any, cast

import numpy as np
from scipy import optimize

from jaxtank.core.errors import DataError
from tuning.identification.residuals import ROBUST_LIMIT, weighting_noise

CHI_SQUARED_95 = 3.841458820694124  # one degree of freedom


@dataclasses.dataclass(frozen=True)
class Fit:
    """Where a search ended."""

    p: np.ndarray  # (shared,) coordinates
    levels: np.ndarray  # (logs, free levels) levels at the first sample of each log
    cost: float  # half the weighted sum of squares (of the loss) [-]
    residual: np.ndarray  # (rows,) weighted
    jacobian: np.ndarray  # (rows, unknowns) of the weighted residual
    evaluations: int
    status: int  # of scipy: above 0 where it has converged
    loss: str = "linear"
    z: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(0))  # (unknowns,)


class _Residual:
    """Residual and Jacobian by the unknowns that are free, evaluated once per point."""

    # prior: (point, strength): readings of every unknown with sd 1/strength, levels 0.1 of it

    def __init__(self, estimation, start, fixed, prior):
        self.estimation, self.point, self.last = estimation, start.copy(), None
        self.free = np.array([i for i in range(estimation.size) if i not in fixed])
        self.point[list(fixed)] = list(fixed.values())
        self.prior, self.weight = np.zeros(0), np.zeros(0)
        if prior is not None:
            self.prior = prior[0][self.free]
            self.weight = prior[1] * np.where(self.free < estimation.coordinates.size, 1.0, 10.0)

    def at(self, v):
        """Return (residual, jacobian) of the readings at the free unknowns v."""
        if self.last is None or not np.array_equal(self.last[0], v):
            self.point[self.free] = v
            self.last = v.copy(), self.estimation.residual_and_jacobian(self.point)
        return self.last[1]

    def value(self, v):
        """Return the residual with the rows of the prior."""
        rows = self.weight * (v - self.prior) if self.prior.size else self.prior
        readings = self.at(v)[0]
        return np.concatenate([readings, rows, self._earlier()[0]])

    def slope(self, v):
        """Return the Jacobian by the free unknowns with the rows of the prior."""
        slopes = self.at(v)[1][:, self.free]
        if self.prior.size:
            slopes = np.concatenate([slopes, np.diag(self.weight)])
        if self.estimation.prior is not None:
            slopes = np.concatenate([slopes, self._earlier()[1][:, self.free]])
        return slopes

    def _earlier(self):
        """Return (residual, Jacobian) of an earlier identification, at the last point."""
        return self.estimation.prior_rows(self.point[: self.estimation.coordinates.size])


def solve(
    estimation: Any,
    start: np.ndarray,
    loss: str = "linear",
    iterations: int = 100,
    fixed: Mapping[int, float] | None = None,
    tolerance: float = 1e-14,
    prior: Any = None,
) -> Fit:
    """Return the Fit of a search from `start` (unknowns,) of an Estimation or a Likelihood."""
    before, residual = estimation.evaluations, _Residual(estimation, start, fixed or {}, prior)
    low, high = (side[residual.free] for side in estimation.box)
    begin = np.clip(residual.point[residual.free], low, high)
    cost, status, end = np.inf, -1, residual.point
    rows, jacobian = np.zeros(0), np.zeros((0, estimation.size))
    if np.all(np.isfinite(residual.at(begin)[0])):
        # with a wide range scipy's step to the edge of its trust region overflows
        ends = dict.fromkeys(("xtol", "gtol"), min(1e-8, 1e2 * tolerance)) | {"ftol": tolerance}
        options: Any = {"loss": loss, "f_scale": ROBUST_LIMIT, "max_nfev": iterations, **ends}
        box = (low - 1e-12, high + 1e-12)
        with np.errstate(over="ignore", divide="ignore", invalid="ignore"):
            solution = optimize.least_squares(
                residual.value, begin, cast(Any, residual.slope), bounds=box, **options
            )
        end[residual.free] = np.clip(solution.x, low, high)
        rows, jacobian = estimation.residual_and_jacobian(end)
        cost = float(solution.cost) if prior is None else 0.5 * float(rows @ rows)
        status = solution.status
    p, levels = estimation.split(end)
    count = estimation.evaluations - before
    return Fit(p.copy(), levels, cost, rows, jacobian, count, status, loss=loss, z=end)


def refine_noise_and_steps(
    estimation: Any, fit: Fit, noise: Any, substeps: Any, **settings: Any
) -> Fit:
    """Return the Fit with the noise of its residuals and enough substeps, which it sets."""
    while np.isfinite(fit.cost):
        needed = weighting_noise(estimation, fit) if noise is None else estimation.noise
        same, estimation.noise, finer = np.all(needed == estimation.noise), needed, 0
        with contextlib.suppress(DataError):  # no number is enough: the report says so
            finer = estimation.substeps_for(estimation.unknowns(fit)) if substeps is None else 0
        if same and finer <= estimation.substeps:
            break
        estimation.substeps = max(finer, estimation.substeps)
        fit = solve(estimation, estimation.unknowns(fit), **settings)
    return fit


def profile_likelihood(estimation, fit, spread, loss):
    """Return the profile likelihood of the least certain parameter."""
    # at 11 values within 3 sd, the rest fitted again; "rise": 2 log likelihood ratio
    name, sd = spread.worst()
    levels = estimation.unknowns(fit)[estimation.coordinates.size :]
    at_fit = estimation.coordinates.values(fit.p)
    estimation = estimation.without_branch_gains()
    i = estimation.coordinates.names.index(name)
    z = np.concatenate([estimation.coordinates.point(at_fit), levels])
    grid = np.linspace(-3.0, 3.0, 11) * (sd or 1 / 3.0)
    # a bound may truncate it
    grid = np.unique(np.clip(z[i] + grid, estimation.box[0][i], estimation.box[1][i]))
    inflate = max(spread.widened, 1.0) ** 2 * max(spread.scale, 1e-300)
    middle = int(np.argmin(np.abs(grid - z[i])))
    upward, downward = list(range(middle, len(grid))), list(range(middle, -1, -1))
    rise, values = np.zeros(len(grid)), np.zeros(len(grid))
    for side in (upward, downward):
        start = z.copy()
        for j in side:
            near = solve(estimation, start, loss, fixed={i: grid[j]})
            start = estimation.unknowns(near)
            rise[j] = max(2 * (near.cost - fit.cost) / inflate, 0.0)
            values[j] = float(estimation.coordinates.values(near.p)[name])
    ends: list[Any] = [_crossing(values[side], rise[side]) for side in (downward, upward)]
    return {
        "name": name,
        "unit": next(b.unit for b in estimation.bounds if b.name == name),
        "values": values.tolist(),
        "rise": rise.tolist(),
        "interval95": ends if None in ends else sorted(ends),
    }


def _crossing(values, rise):
    """Return the value at which `rise` passes the 95 % threshold, None where it does not."""
    for k in range(len(rise) - 1):
        if rise[k + 1] >= CHI_SQUARED_95:
            low, high, at = (math.sqrt(v) for v in (rise[k], rise[k + 1], CHI_SQUARED_95))
            return float(values[k] + (at - low) / (high - low) * (values[k + 1] - values[k]))
    return None
