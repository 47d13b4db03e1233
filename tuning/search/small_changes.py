"""After the search of a default answer: gains return to their start where the cost allows it."""

from typing import Any

import numpy as np

from tuning.search.driver import Search
from tuning.search.methods import METHODS, automatic

WORTH = 0.01  # a gain is changed only where that lowers the cost by this share [-]

AGAIN = 1.25
"""All gains stay at their first values if that costs less than this many times WORTH [-]. The first
values may be an earlier answer, which may cost WORTH already, with slightly different plants."""

FINE = 0.1  # share of WORTH to which the cost with some gains at their first values is searched [-]

REACH = 4.0
"""A search with some gains at their first values ends where the cost stays too high even after this
many times the decrease that the Gauss-Newton model predicts, at two points in a row [-]."""

LINE, STRIDE = 32, 8  # values between best and first gain; how many run at once


class OutOfReach(Exception):
    """The ceiling of the cost is out of reach of a search."""


class Subspace(Search):
    """A search over some parameters; raises `OutOfReach` where the cost stays above `ceiling`."""

    def __init__(self, owner: Search, z: np.ndarray, free: np.ndarray, ceiling: float = np.inf):
        # its owner reports every evaluation already
        tolerance = max(owner.tolerance, FINE * WORTH)
        super().__init__(owner.evaluator, owner.last_finite, tolerance=tolerance)
        self.scale, self.owner, self.fixed = owner.scale, owner, z
        self.free: np.ndarray = np.asarray(free)
        self.ceiling, self.too_high = ceiling, 0
        # what a point that is not finite falls back on has the derivatives of all parameters
        self.last_finite = self.within(owner.last_finite)

    def full(self, z: Any) -> np.ndarray:
        """Return (P,) the point of the owner at z, values of the free parameters."""
        z_all = self.fixed.copy()
        z_all[self.free] = np.clip(z, 0.0, 1.0)
        return z_all

    def point(self, z: Any) -> Any:
        """Return the Point at z, derivatives by the free parameters alone; cached."""
        z = np.clip(z, 0.0, 1.0)
        if z.tobytes() not in self.memory:
            point = self.within(self.owner.point(self.full(z)))._replace(z=z)
            self.take(point)
            self.too_high = self.too_high + 1 if self._out_of_reach(point) else 0
            if self.too_high == 2:
                raise OutOfReach
        return self.memory[z.tobytes()]

    def _out_of_reach(self, point: Any) -> bool:
        """Whether REACH times the decrease of the Gauss-Newton model leaves the cost too high."""
        if not point.finite or self.problem.model != "cost" or not np.isfinite(self.ceiling):
            return False
        step, *_ = np.linalg.lstsq(point.gauss_newton, point.gradient, rcond=1e-9)
        fall = 0.5 * float(point.gradient @ step)
        return fall >= 0.0 and point.cost - REACH * fall > self.ceiling

    def within(self, point: Any) -> Any:
        """Return a Point of the owner with derivatives by the free parameters alone."""
        free, slopes = self.free, point.run_slopes
        return point._replace(
            z=point.z[free],
            gradient=point.gradient[free],
            gauss_newton=point.gauss_newton[free][:, free],
            margin_slopes=point.margin_slopes[:, free],
            run_slopes=slopes[:, free] if slopes.size else np.zeros(0),
        )


def stay_put(
    search: Search, first: np.ndarray, iterations: int, slack: Any = None
) -> tuple[np.ndarray, np.ndarray]:
    """Return (z (P,), kept (P,)): the point nearest to the first values that costs little more."""
    # One gain after the other returns to `first` (kept), or as far as WORTH and the limits allow.
    best = search.best
    fixed, z = np.zeros(len(first), dtype=bool), best.z
    ceiling = best.cost + WORTH * abs(best.cost)
    allowed = search.violation(best)
    good = lambda p: p.finite and p.cost <= ceiling and search.violation(p) <= allowed
    start = search.point(first)
    loose = start if slack is None else start._replace(margins=start.margins + slack)
    dearest = best.cost + AGAIN * WORTH * abs(best.cost)
    if start.finite and start.cost <= dearest and search.violation(loose) <= allowed:
        return first.copy(), ~fixed
    # first those whose value costs least by the curvature at the best point
    order = np.argsort(np.diag(best.gauss_newton) * (best.z - first) ** 2, kind="stable")
    for i in order:
        trial = fixed.copy()
        trial[i] = True
        reached = _without(search, trial, first, z, iterations, ceiling)
        if reached is not None and good(search.point(reached)):
            fixed, z = trial, reached
        else:
            z = _towards(search, i, first, z, ceiling, allowed, good)
    return z, fixed


def _without(search, trial, first, z, iterations, ceiling):
    """The best point with the gains of `trial` at their first values; None if above `ceiling`."""
    begin = np.where(trial, first, z)
    if trial.all():
        return begin
    free = np.flatnonzero(~trial)
    inner = Subspace(search, begin, free, ceiling)
    try:
        METHODS[automatic(search.problem)](inner, begin[free], iterations)
    except OutOfReach:
        return None
    return None if inner.best is None else inner.full(inner.best.z)


def _towards(search, i, first, z, ceiling, allowed, good):
    """Return z with gain i moved towards its first value while the cost is below `ceiling`."""
    # LINE values, STRIDE at once, up to the first that does not fit; without derivatives.
    shares = np.arange(1, LINE + 1) / (LINE + 1)
    line = np.repeat(z[None], LINE, axis=0)
    line[:, i] = z[i] + shares * (first[i] - z[i])
    count = 0
    for some in np.split(line, LINE // STRIDE):
        costs, margins = search.evaluator.screen(some)
        shortfall = search.violations(margins)
        fits = np.isfinite(costs) & (costs <= ceiling) & (shortfall <= allowed)
        count += STRIDE if fits.all() else int(np.argmin(fits))
        if not fits.all():
            break
    for k in range(count - 1, -1, -1):
        if good(search.point(line[k])):
            return line[k]
    return z
