"""The last step of a default answer: robust gains in place of fragile ones."""

import itertools
from collections.abc import Iterator, Mapping
from typing import Any

import jax
import numpy as np

from jaxtank import measures as ms
from jaxtank.core.tree import with_values
from tuning.problem.reported import margin_measures, run_measures
from tuning.problem.scenarios import noisy, runs_of
from tuning.search.diagnostics import lost_outputs
from tuning.search.setting import Setting
from tuning.search.small_changes import FINE, LINE, STRIDE, WORTH
from tuning.search.solve import Solution

FRAGILITY_LIMIT = 2.0
"""Largest fragility of an answer [-]. Fragility is the sensitivity peak Ms, or MT_WEIGHT times the
complementary sensitivity peak Mt where this is larger: a poorly damped loop may have a small Ms (a
tank under a PI with damping 0.45: Ms 1.24, Mt 1.55). Textbooks recommend an Ms of 1.4 to 2 and an
Mt of 1.25 (Skogestad and Postlethwaite, Multivariable Feedback Control, sec. 2.4)."""

FRAGILITY_GOAL, BISECTIONS = 1.4, 4
"""Fragility towards which that of an answer is lowered while the cost rises by at most PRICE [-];
number of values that are tried."""

MT_WEIGHT = FRAGILITY_GOAL / 1.25  # an Mt of 1.25 is as fragile as an Ms of 1.4 [-]

FRAGILE = 2.5
"""Fragility above which the first gains are no answer, and Ms above which a loop is reported as
near the edge of its stability [-]."""

LESS_FRAGILE = FRAGILE, 3.5, 5.0  # limits that are tried in turn where no robust point is known [-]

PRICE = 0.05  # increase of the cost for robustness, as a share of it; of the error it is half [-]

TIME_GROWTH = 1.5  # of a time, as Ti, above which a loop may no longer follow its setpoints [-]

VISIBLE = 1e-3  # share of a rim below which a steady-state error does not count [-]

ERROR_GROWTH = 1.5  # of a steady-state error, above which integral times are shortened [-]

LOOKED = 100  # points of least violation among which a robust one is looked for

STARTS = 6  # robust points from which that of least cost is searched

MOST_FREE = 12
"""Number of parameters up to which more than one search for robust gains is made: each computes
margins at some 100 points or more."""

SPAN, ROUNDS = 0.01, 16
"""Step of the differences of the fragility, as a share of a range [-]; Newton steps of a search, of
at most STRIDE such shares."""

MARGIN = 0.005  # share by which a Newton step aims below the limit, as fragility is not linear [-]

ROUNDING = 1e-9  # relative difference of costs of one point in batches of other sizes [-]

PEAKS = "sensitivity_peak", "complementary_peak"


def make_robust(setting: Setting, solution: Solution) -> None:
    """Lower the fragility of an answer to the limit, and on towards the goal if that is cheap."""
    search, point = solution.search, solution.point
    if search is None or point is None:
        return
    gains = _RobustGains(setting, solution)
    before = gains.fragility(gains.first)
    if np.array_equal(point.z, gains.first) and not before > FRAGILE:
        return
    gains.allow_violation()
    gains.reach_limit(before)
    gains.approach_goal()
    gains.shorten_times()


def prefer_robust(setting: Setting, solution: Solution) -> None:
    """Replace a fragile answer of an interrupted search by the best robust point it has seen."""
    search, point = solution.search, solution.point
    if search is None or point is None:
        return
    gains = _RobustGains(setting, solution)
    fragility = gains.fragility(point.z)
    seen = [p for p in search.memory.values() if p.finite]
    seen.sort(key=lambda p: (search.violation(p), p.cost))
    for limit in FRAGILITY_LIMIT, *LESS_FRAGILE:
        if not fragility > limit:  # NaN: it has none
            return
        if better := next((p for p in seen[:LOOKED] if gains.fragility(p.z) <= limit), None):
            gains.choose(better.z)
            return


class _RobustGains:
    """Points z (P,) of a search: their fragility, and those of least cost that are robust."""

    def __init__(self, setting: Setting, solution: Solution):
        self.setting, self.solution = setting, solution
        self.search: Any = solution.search
        self.problem: Any = self.search.problem
        self.first: np.ndarray = self.problem.start()
        self.violation = self.search.violation(solution.point)

    def fragility(self, z: np.ndarray) -> float:
        """The larger of Ms and MT_WEIGHT Mt; NaN where the loop has no peaks."""
        Ms, Mt = self._peaks(z)
        return max(Ms, MT_WEIGHT * Mt)

    def _peaks(self, z) -> tuple[float, float]:
        """(Ms, Mt)."""
        measures = margins_at(self.setting, self.solution, self.problem.values(z))
        Ms, Mt = (float(measures.get(name, np.nan)) for name in PEAKS)
        return Ms, Mt

    def cost(self, z: np.ndarray) -> float:
        """The cost; infinite where limits are violated by more than at the answer."""
        point = self.search.point(z)
        return point.cost if self.search.violation(point) <= self.violation else np.inf

    def allow_violation(self) -> None:
        """Allow the smallest violation of a robust point beside a fragile answer."""
        fragile = self.fragility(self.solution.point.z) > FRAGILE
        if not (fragile and self.violation > 0.0 and self.solution.screened):
            return
        zs, _, margins = self._screened()
        violations = self.search.violations(margins)
        for k in np.argsort(violations, kind="stable")[:LOOKED]:
            if self.fragility(zs[k]) <= FRAGILITY_LIMIT:
                self.violation = max(self.violation, float(violations[k]))
                return

    def reach_limit(self, before: float) -> None:
        """Lower the fragility to its limit, or to `before` where that is up to FRAGILE."""
        least, first = self.solution.point, self.first
        if not self.fragility(least.z) > FRAGILITY_LIMIT:  # NaN: it has none
            return
        limit = before if FRAGILITY_LIMIT < before <= FRAGILE else FRAGILITY_LIMIT
        # beside first gains that are no answer, the cost of robust ones is not limited
        most = np.inf if before > limit else self.cost(first)
        z = None if before > limit else self._towards_first(limit, most)
        if z is not None and self.cost(z) <= least.cost + PRICE * abs(least.cost):
            self.choose(z)
            return
        if z is not None:  # on the way to the first gains, unless another costs less
            most = self.cost(z) - WORTH * abs(self.cost(z))
        ends = [end for end in self._cheapest_of_starts(FRAGILITY_LIMIT) if self.cost(end) < most]
        if z is None and not ends:
            ends = self._less_fragile(self.fragility(least.z))
        ends = sorted(ends, key=self.cost)
        astray = list(itertools.takewhile(lambda end: not self._follows(end), ends))
        z = ends[len(astray)] if len(astray) < len(ends) else z
        if z is not None:
            self.choose(self._nearest_that_follows(astray, z, limit))

    def _less_fragile(self, fragility: float) -> list[np.ndarray]:
        """The cheapest points up to the lowest of LESS_FRAGILE for which any are known."""
        limits = (limit for limit in LESS_FRAGILE if limit < fragility)
        return next(filter(None, map(self._cheapest_of_starts, limits)), [])

    def _screened(self) -> Any:
        """(points, costs, margins) at which the search might have started."""
        return (np.concatenate(parts) for parts in zip(*self.solution.screened))

    def _nearest_that_follows(self, astray, z, limit):
        """The first point on the way from cheap robust points to z that is robust and follows."""
        for end in astray:
            for share in np.arange(1, LINE) / LINE:
                point = end + share * (z - end)
                saves = self.cost(point) < self.cost(z) - WORTH * abs(self.cost(z))
                if saves and self.fragility(point) <= limit and self._keeps_setpoints(point):
                    z = point
                    break
        return z

    def _cheapest_of_starts(self, fragility: float) -> list[np.ndarray]:
        """Points of least cost up to a fragility, from the answer and from other such points."""
        limit, at_first = np.log(fragility), self.solution.kept
        every = np.arange(len(at_first))
        free = every if at_first.all() else np.flatnonzero(~at_first)
        ends = [self.cheapest(limit, self.solution.point.z, free)]
        if len(every) <= MOST_FREE:
            ends += [self.cheapest(limit, z, every) for z in self._robust_starts(fragility)]
        return [end for end in ends if end is not None]

    def approach_goal(self) -> None:
        """Lower the fragility towards its goal, as far as PRICE allows, at the cheapest points."""
        search, z = self.search, self.solution.point.z
        if self.problem.model is None:  # the price of robustness is one of a squared error
            return
        cost, ceiling = self.cost(z), search.best.cost + PRICE * abs(search.best.cost)
        if cost > ceiling:  # the limit was dear: from there, but not above the first gains
            ceiling = max(cost, min(cost + PRICE * abs(cost), self.cost(self.first)))
        low, high = np.log(FRAGILITY_GOAL), np.log(self.fragility(z))
        free = np.flatnonzero(~self.solution.kept)
        if not 0 < len(free) <= len(z) <= MOST_FREE or not high > low + 2.0 * MARGIN:
            return  # NaN: it has none
        start = z
        for k in range(BISECTIONS):
            limit = 0.5 * (low + high) if k else low
            end = self.cheapest(limit, start, free)
            if end is None or self.cost(end) > ceiling:
                low = limit
                continue
            z, high = end, limit
            if not k:
                break
        cost, robust = self.cost(z), np.log(self.fragility(self.first)) <= high + 2.0 * MARGIN
        if robust and self.cost(self.first) <= cost + WORTH * abs(cost):  # an earlier answer
            z = self.first.copy()
        if self._follows(z):
            self.choose(z)

    def shorten_times(self) -> None:
        """Shorten grown integral times where steady-state errors grew, within WORTH of the cost."""
        end, low, high = self.solution.point.z, 0.0, 1.0
        names = [b.name for b in self.problem.bounds]
        grown = [i for i in self._grown_times(end) if names[i].split("[")[0].endswith("Ti")]
        if not grown or len(end) > MOST_FREE or not self._error_has_grown(end):
            return
        limit = np.log(self.fragility(end))  # NaN: it has none, and nothing is found
        ceiling = self.cost(end) + WORTH * abs(self.cost(end))
        free = np.setdiff1d(np.flatnonzero(~self.solution.kept), grown)
        best = end
        for _ in range(BISECTIONS):
            share, z = 0.5 * (low + high), best.copy()
            z[grown] = end[grown] + share * (self.first - end)[grown]
            shorter = self.cheapest(limit, z, free)
            if shorter is None or self.cost(shorter) > ceiling:
                high = share
            else:
                low, best = share, shorter
        if best is not end:
            self.solution.z, self.solution.kept = best, best == self.first

    def cheapest(self, limit: float, z: np.ndarray, free: np.ndarray) -> np.ndarray | None:
        """The point of least cost, from z, whose log fragility is at most `limit`; or None."""
        # Newton steps under the linearised log fragility F, each cut to the point of least
        # cost + weight (F - limit)+ on it, with twice the multiplier as weight
        search, weight, log = self.search, 0.0, lambda z: np.log(self.fragility(z))
        with np.errstate(invalid="ignore"):  # both infinite
            over = log(z) - limit
        best = z if over <= 0.0 and self.cost(z) < np.inf else None
        if not np.isfinite(over):
            return best
        for _ in range(ROUNDS):
            step, multiplier = _newton_within(search, z, free, self._slope(z), over)
            size = np.max(np.abs(step), initial=0.0)
            if not 0.0 < size < np.inf:
                break
            weight = max(weight, 2.0 * multiplier)
            step *= min(1.0, STRIDE * SPAN / size)
            line = np.clip(z + np.arange(1, STRIDE + 1)[:, None] / STRIDE * step, 0.0, 1.0)
            costs, margins = search.evaluator.screen(line)
            allowed = np.isfinite(costs) & (search.violations(margins) <= self.violation)
            overs = self._overs(line, costs, allowed, limit, weight)
            fit = allowed & (overs <= 0.0)
            if fit.any():
                k = int(np.argmin(np.where(fit, costs, np.inf)))
                fall = np.inf if best is None else search.point(best).cost - costs[k]
                best = line[k] if fall > 0.0 else best
                if fall < FINE * WORTH * abs(costs[k]):
                    break
            known = np.isfinite(costs) & np.isfinite(overs)
            penalties = weight * np.maximum(np.where(known, overs, 0.0), 0.0)
            merits = np.where(known, costs + penalties, np.inf)
            k = int(np.argmin(merits))
            if not merits[k] < search.point(z).cost + weight * max(over, 0.0):
                break
            z, over = line[k], overs[k]
        return best

    def _overs(self, line, costs, allowed, limit, weight):
        """(points,) log fragility above `limit`; inf of points too dear to matter."""
        overs, merit, fits = np.full(len(line), np.inf), np.inf, False
        for k in np.argsort(costs, kind="stable"):
            if not np.isfinite(costs[k]) or (fits and costs[k] >= merit):
                break
            over = np.log(self.fragility(line[k])) - limit
            if np.isfinite(over):
                overs[k], merit = over, min(merit, costs[k] + weight * max(over, 0.0))
                fits |= allowed[k] and over <= 0.0
        return overs

    def _slope(self, z):
        """(P,) the slope of the log fragility by central differences, 0 where it has none."""
        rate = np.zeros(len(z))
        for i, unit in enumerate(np.eye(len(z))):
            ends = [np.clip(z + sign * SPAN * unit, 0.0, 1.0) for sign in (1.0, -1.0)]
            up, down = (np.log(self.fragility(end)) for end in ends)
            if np.isfinite(up) and np.isfinite(down):
                rate[i] = (up - down) / (ends[0] - ends[1])[i]
        return rate

    def _towards_first(self, limit, most):
        """The first robust point on the way to the first gains, or these if they cost no more."""
        z, first = self.solution.point.z, self.first
        line = z + np.arange(1, LINE + 1)[:, None] / LINE * (first - z)
        line[-1] = first
        for points in np.split(line, LINE // STRIDE):
            robust = np.array([self.fragility(point) <= limit for point in points])
            if not robust.any():
                continue
            costs, _ = self.search.evaluator.screen(points)
            for point in points[robust & (costs <= most + ROUNDING * abs(most))]:
                cost = self.cost(point)
                if cost < np.inf:
                    near = self.cost(first) <= min(most, cost + WORTH * abs(cost))
                    return first.copy() if near else point
        return None

    def _robust_starts(self, limit: float) -> Iterator[np.ndarray]:
        """The cheapest points up to a fragility of those at which the search might have started."""
        if not self.solution.screened:
            return iter(())
        zs, costs, margins = self._screened()
        fit = np.isfinite(costs) & (self.search.violations(margins) <= self.violation)
        cheap = (zs[k] for k in np.argsort(costs, kind="stable") if fit[k])
        return itertools.islice((z for z in cheap if self.fragility(z) <= limit), STARTS)

    def _grown_times(self, z):
        """Parameters that are times, as Ti, and have grown at z."""
        first, values = self.problem.own_values(), self.problem.values(z)
        times = [(i, b.name) for i, b in enumerate(self.problem.bounds) if b.unit == "s"]
        return [i for i, name in times if values[name] > TIME_GROWTH * first[name]]

    def _follows(self, z):
        """Whether outputs still follow their setpoints, where a time, as Ti, has grown."""
        # slow integral action may cost less; nothing is run (and compiled) without such a time
        return not self._grown_times(z) or self._keeps_setpoints(z)

    def _keeps_setpoints(self, z):
        """Whether no output that follows its setpoints with the first gains has lost them at z."""
        case, tables = self._runs(z)
        objective = self.problem.objective
        return not lost_outputs(runs_of(case, (), 0), tables, self.problem.values(z), objective)

    def _error_has_grown(self, z):
        """Whether a steady-state error is visibly larger at z than with the first gains."""
        case, rows = self._runs(z)
        before, after = (np.asarray(rows[k][0]["steady_state_error"]) for k in ("before", "after"))
        rims = np.asarray(case.loop.plant.rim)[list(case.loop.plant.outputs)]
        return bool(np.any((after > ERROR_GROWTH * before) & (after > VISIBLE * rims)))

    def _runs(self, z):
        """(Case, {"before": [measures]}) with the first gains, and "after" with those of z."""
        first, values, case = self.problem.own_values(), self.problem.values(z), self.setting.case
        sides = self.setting.tuned(first), self.setting.tuned(values)
        key = jax.random.key(0) if noisy(case) else None
        needed = dict.fromkeys([*self.problem.needed, "steady_state_error"])
        of_run = [name for name in needed if name not in ms.linear()]
        before, after = ([run_measures(c.loop, c.clock, key, of_run)] for c in sides)
        return sides[0], {"before": before, "after": after}

    def choose(self, z):
        """Make z the answer, which keeps the peaks of the gains that cost least."""
        solution = self.solution
        if not np.array_equal(z, solution.point.z):
            if solution.least_cost_peaks is None:
                solution.least_cost_peaks = self._peaks(self.search.best.z)
            solution.z, solution.kept = z, z == self.first


def _newton_within(search, z, free, slope, over):
    """The step of `_newton` up to the ends of the ranges, without gains that it holds at an end."""
    while True:
        step, multiplier = _newton(search, z, free, slope, over)
        within = np.clip(z + step, 0.0, 1.0) - z
        moving = (within != 0.0) | (step == 0.0)
        if moving[free].all():
            return within, multiplier
        free = free[moving[free]]


def _newton(search, z, free, slope, over):
    """(step (P,), multiplier) to the least of the cost where the log fragility falls by `over`."""
    point, step = search.point(z), np.zeros(len(z))
    slope = slope[free]
    if search.problem.model is None:  # along the gradient, as far as a line of points reaches
        size = np.max(np.abs(point.gradient[free]), initial=1e-300)
        curvature = size / (STRIDE * SPAN) * np.eye(len(slope))
    else:
        curvature = point.gauss_newton[free][:, free]
    if search.problem.model == "square":
        curvature = curvature / (2.0 * point.cost)
    sides = np.stack([point.gradient[free], slope], axis=1)
    if not np.all(np.isfinite(curvature)) or not np.all(np.isfinite(sides)):
        return step, 0.0
    to_least, to_robust = np.linalg.lstsq(curvature, sides, rcond=1e-9)[0].T
    fall = slope @ to_robust
    multiplier = max(0.0, (over + MARGIN - slope @ to_least) / fall) if fall > 0.0 else 0.0
    step[free] = -(to_least + multiplier * to_robust)
    return step, multiplier


def margins_at(setting: Setting, solution: Solution, values: Mapping[str, Any]) -> dict[str, Any]:
    """Return the margin measures of the tuned case, which a Solution remembers."""
    key = tuple((name, float(value)) for name, value in values.items())
    if key not in solution.margins:
        # of the loop without its safety filter, which `setting.tuned` would design again
        loop = with_values(setting.case.loop, values)
        solution.margins[key] = margin_measures(loop, setting.case.clock)
    return solution.margins[key]
