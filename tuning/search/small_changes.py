"""After the search of a default answer: gains return to their start where the cost allows it, and
gains with too high a sensitivity peak of the linearised loop move back.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np

from tuning.problem.reported import margin_measures
from tuning.search.driver import Search
from tuning.search.methods import METHODS, automatic
from tuning.search.setting import Setting
from tuning.search.solve import Solution

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
    """A search over some of the parameters, the others fixed; every point is one of the owner's.
    ceiling: largest useful cost; `OutOfReach` is raised where the search will not get below it.
    """

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
    # One gain after the other is set back to its value in `first` and the rest searched again. It
    # stays there (kept) if the cost is within WORTH of the best found, and no limit that the best
    # point keeps is violated. A gain that cannot is moved back as far as it can.
    best = search.best
    fixed, z = np.zeros(len(first), dtype=bool), best.z
    ceiling = best.cost + WORTH * abs(best.cost)
    allowed = search.violation(best)

    def good(point):
        return point.finite and point.cost <= ceiling and search.violation(point) <= allowed

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


PEAK = 2.0
"""Sensitivity peak Ms that an answer may have, unless a lower one costs more than PRICE [-].
Textbooks recommend 1.4 to 2."""

CALM, BISECTIONS, MOST_FREE = 1.4, 4, 12
"""Ms towards which that of an answer is lowered while the cost rises by at most PRICE [-]; number
of values of Ms that are tried; number of parameters above which none is tried, as each try computes
margins at some 100 points."""

PRICE = 0.05  # share of the cost that a lower Ms may cost: half of it as a share of the error [-]

SPAN, ROUNDS = 0.01, 16
"""A step of the descent of Ms and of its differences, as a share of a range [-]; largest number of
times that STRIDE steps are taken along one direction."""

MARGIN = 0.005  # share by which a step aims below the Ms allowed, as log Ms is not linear [-]


def move_back(setting: Setting, solution: Solution) -> None:
    """Lower the Ms of an answer to PEAK, and on towards CALM where that is cheap."""
    search, point = solution.search, solution.point
    if search is None or point is None or np.array_equal(point.z, search.problem.start()):
        return
    _limit_peak(setting, solution)
    _lower_peak(setting, solution)


def _limit_peak(setting, solution):
    """Move the answer to a point whose Ms is at most PEAK."""
    search, point = solution.search, solution.point
    problem, z, first = search.problem, point.z, search.problem.start()
    highest = _peak(setting, solution, problem, z)
    if not highest > PEAK:  # NaN: it has none
        return
    before = _peak(setting, solution, problem, first)
    allowed, least = max(PEAK, before), highest
    if before > PEAK:
        calmer, highest = _descended(setting, solution, highest)
        _move(solution, calmer, first, least)
    if not highest > allowed:
        return
    line = z + np.arange(1, LINE + 1)[:, None] / LINE * (first - z)
    calm = lambda each: _peak(setting, solution, problem, each) <= allowed
    ceiling, violation = point.cost + PRICE * abs(point.cost), search.violation(point)
    each = _first_calm(search, line, calm, ceiling, violation)
    if each is None:  # at any price below that of the start: a fragile loop is no answer
        dearest = search.point(first).cost
        each = _first_calm(search, line, calm, dearest, violation)
        price = dearest if each is None else search.point(each).cost
        cheapest = _cheapest(setting, solution, np.log(allowed), violation)
        if cheapest is not None and search.point(cheapest).cost < price - WORTH * abs(price):
            each = cheapest
    if each is not None:
        _move(solution, each, first, least)


def _lower_peak(setting, solution):
    """Lower Ms towards CALM, as far as PRICE allows, by the cheapest points that have it."""
    search, point = solution.search, solution.point
    problem, z, first = search.problem, point.z, search.problem.start()
    ceiling, violation = search.best.cost + PRICE * abs(search.best.cost), search.violation(point)
    least = solution.least_cost_peak or _peak(setting, solution, problem, z)
    low, high = np.log(CALM), np.log(_peak(setting, solution, problem, z))
    if not high > low or point.cost > ceiling or solution.kept.all() or len(z) > MOST_FREE:
        return
    for k in range(BISECTIONS):
        at = 0.5 * (low + high) if k else low
        there = _cheapest(setting, solution, at, violation)
        if there is None or search.point(there).cost > ceiling:
            low = at
            continue
        z, high = there, at
        if not k:
            break
    if _is_earlier(search, first, z, violation):
        calm = np.log(_peak(setting, solution, problem, first)) <= high + 2.0 * MARGIN
        z = first.copy() if calm else z
    _move(solution, z, first, least)


def _is_earlier(search, first, z, violation):
    """Whether the first values may be an earlier answer: they cost little more than those at z."""
    start, cost = search.point(first), search.point(z).cost
    dearest = cost + WORTH * abs(cost)
    return start.finite and start.cost <= dearest and search.violation(start) <= violation


def _move(solution, z, first, peak):
    """Make z the answer; peak: Ms of the gains of least cost."""
    if not np.array_equal(z, solution.point.z):
        solution.z, solution.kept, solution.least_cost_peak = z, z == first, peak


def _first_calm(search, line, calm, ceiling, violation):
    """The first calm point of a line up to `ceiling`, or its end; None where there is none."""
    for some in np.split(line, LINE // STRIDE):
        low = np.array([calm(each) for each in some])
        if not low.any():
            continue
        costs, _ = search.evaluator.screen(some)
        for each in some[low & (costs <= ceiling)]:
            there = search.point(each)
            if search.violation(there) <= violation:
                dearest = min(ceiling, there.cost + WORTH * abs(there.cost))
                start = search.point(line[-1])
                near = start.cost <= dearest and search.violation(start) <= violation
                return line[-1].copy() if near else each
    return None


def _descended(setting, solution, highest):
    """Return (point of the lowest peak within PRICE along the steepest descent, that peak)."""
    search, point = solution.search, solution.point
    problem, z = search.problem, point.z
    ceiling, violation = point.cost + PRICE * abs(point.cost), search.violation(point)
    free, calmer, lowest = ~np.asarray(solution.kept), z, highest
    for _ in range(ROUNDS):
        slope = _slope(setting, solution, problem, z) * free
        norm = float(np.linalg.norm(slope))
        if not 0.0 < norm < np.inf:
            break
        line = np.clip(z - (np.arange(1, STRIDE + 1)[:, None] * SPAN) * slope / norm, 0.0, 1.0)
        costs, margins = search.evaluator.screen(line)
        fit = (costs <= ceiling) & (search.violations(margins) <= violation)
        for each, fits in zip(line, fit):
            if not fits:
                return calmer, lowest
            peak = _peak(setting, solution, problem, each)
            if peak < lowest:
                calmer, lowest = each, peak
            if lowest <= PEAK:
                return calmer, lowest
        z = line[-1]
    return calmer, lowest


def _cheapest(setting, solution, allowed, violation):
    """Return the point of least cost whose log Ms is at most `allowed`; None where none is met."""
    # Newton steps on the cost under the linearised log Ms; of STRIDE points along each the one with
    # the least cost + weight (log Ms - allowed)+ is next, with twice the multiplier as weight
    search, z, calmest = solution.search, solution.point.z, None
    problem, free, weight = search.problem, np.flatnonzero(~solution.kept), 0.0
    if problem.model is None:
        return None
    for _ in range(ROUNDS):
        over = np.log(_peak(setting, solution, problem, z)) - allowed
        step, multiplier = _newton(search, z, free, _slope(setting, solution, problem, z), over)
        size = np.max(np.abs(step), initial=0.0)
        if not 0.0 < size < np.inf:
            break
        weight = max(weight, 2.0 * multiplier)
        step *= min(1.0, STRIDE * SPAN / size)
        line = np.clip(z + np.arange(1, STRIDE + 1)[:, None] / STRIDE * step, 0.0, 1.0)
        costs, margins = search.evaluator.screen(line)
        overs = np.log([_peak(setting, solution, problem, each) for each in line]) - allowed
        calm = (overs <= 0.0) & (search.violations(margins) <= violation)
        if calm.any():
            k = int(np.argmin(np.where(calm, costs, np.inf)))
            gain = np.inf if calmest is None else search.point(calmest).cost - costs[k]
            calmest = line[k] if gain > 0.0 else calmest
            if gain < FINE * WORTH * costs[k]:
                break
        merits = np.nan_to_num(costs + weight * np.maximum(overs, 0.0), nan=np.inf)
        k = int(np.argmin(merits))
        before = search.point(z).cost + weight * max(over, 0.0)
        if not merits[k] < before:
            break
        z = line[k]
    return calmest


def _newton(search, z, free, slope, over):
    """Return (step (P,), multiplier) to the least of the cost where log Ms falls by `over`."""
    point, step = search.point(z), np.zeros(len(z))
    curvature, slope = point.gauss_newton[free][:, free], slope[free]
    if search.problem.model == "square":
        curvature = curvature / (2.0 * point.cost)
    sides = np.stack([point.gradient[free], slope], axis=1)
    if not np.all(np.isfinite(curvature)) or not np.all(np.isfinite(sides)):
        return step, 0.0
    to_least, to_calm = np.linalg.lstsq(curvature, sides, rcond=1e-9)[0].T
    fall = slope @ to_calm
    multiplier = max(0.0, (over + MARGIN - slope @ to_least) / fall) if fall > 0.0 else 0.0
    step[free] = -(to_least + multiplier * to_calm)
    return step, multiplier


def _slope(setting, solution, problem, z):
    """Return (P,) the slope of the log of Ms at z by central differences, 0 where it has none."""
    rate = np.zeros(len(z))
    for i, unit in enumerate(np.eye(len(z))):
        ends = [np.clip(z + sign * SPAN * unit, 0.0, 1.0) for sign in (1.0, -1.0)]
        up, down = (np.log(_peak(setting, solution, problem, end)) for end in ends)
        if np.isfinite(up) and np.isfinite(down):
            rate[i] = (up - down) / (ends[0] - ends[1])[i]
    return rate


def _peak(setting, solution, problem, z):
    """Return the sensitivity peak at z (P,); NaN where the loop has none."""
    measures = margins_at(setting, solution, problem.values(z))
    return float(measures.get("sensitivity_peak", np.nan))


def margins_at(setting: Setting, solution: Solution, values: Mapping[str, Any]) -> dict[str, Any]:
    """Return the margin measures of the tuned case, which a Solution remembers."""
    key = tuple((name, float(value)) for name, value in values.items())
    if key not in solution.margins:
        case = setting.tuned(values)
        solution.margins[key] = margin_measures(case.loop, case.clock)
    return solution.margins[key]
