"""The last step of a default answer: robust gains in place of those whose linearised loop is
fragile.
"""

import itertools
from collections.abc import Mapping
from typing import Any

import jax
import numpy as np

from jaxtank import measures as ms
from tuning.problem.reported import margin_measures, run_measures
from tuning.problem.scenarios import noisy, runs_of
from tuning.search.diagnostics import lost_outputs
from tuning.search.setting import Setting
from tuning.search.small_changes import FINE, LINE, STRIDE, WORTH
from tuning.search.solve import Solution

PEAK = 2.0
"""Fragility that an answer may have [-]. Fragility is the sensitivity peak Ms, or DAMPING times the
complementary sensitivity peak Mt where this is larger: a poorly damped loop may have a small Ms (a
tank under a PI with damping 0.45: Ms 1.24, Mt 1.55). Textbooks recommend an Ms of 1.4 to 2 and an
Mt of 1.25 (Skogestad and Postlethwaite, Multivariable Feedback Control, sec. 2.4)."""

CALM, BISECTIONS, MOST_FREE = 1.4, 4, 12
"""Fragility towards which that of an answer is lowered while the cost rises by at most PRICE [-];
number of values that are tried; number of parameters above which none is tried, as each try
computes margins at some 100 points."""

DAMPING = CALM / 1.25  # an Mt of 1.25 is as fragile as an Ms of CALM [-]

FRAGILE = 2.5
"""Fragility above which first gains are no answer, and Ms above which a loop is reported as near
the edge of its stability [-]."""

PRICE = 0.05  # share of the cost that may be paid: half of it as a share of the error [-]

SLOWER = 4.0  # growth of a time above which a loop may no longer follow its setpoints [-]

STARTS = 6  # robust points from which that of least cost is searched

SPAN, ROUNDS = 0.01, 16
"""A step of the descent and of its differences, as a share of a range [-]; largest number of times
that STRIDE steps are taken along one direction."""

MARGIN = 0.005  # share by which a step aims below what is allowed, as it is not linear [-]


def move_back(setting: Setting, solution: Solution) -> None:
    """Lower the fragility of an answer to PEAK, and on towards CALM where that is cheap."""
    search, point = solution.search, solution.point
    if search is None or point is None:
        return
    problem, first = search.problem, search.problem.start()
    before = _fragility(setting, solution, problem, first)
    if np.array_equal(point.z, first) and not before > FRAGILE:
        return
    _limit_peak(setting, solution, before)
    _lower_peak(setting, solution)


def _limit_peak(setting, solution, before):
    """Lower the fragility of the answer to PEAK, or to that of the first gains (before) where this
    is between PEAK and FRAGILE.
    """
    search, least = solution.search, solution.point
    problem, first = search.problem, search.problem.start()
    fragility = lambda z: _fragility(setting, solution, problem, z)
    if not fragility(least.z) > PEAK:  # NaN: it has none
        return
    allowed = before if PEAK < before <= FRAGILE else PEAK
    _towards_first(setting, solution, before, allowed)
    point, robust = solution.point, fragility(solution.point.z) <= allowed
    if robust and point.cost <= least.cost + PRICE * abs(least.cost):
        return
    # other robust points may cost less
    free, violation = np.arange(len(first)), search.violation(least)
    highest = point.cost
    if not robust:
        highest = np.inf if before > allowed else _cost_of(search, first, violation)
    starts = [least.z, *_robust_starts(solution, fragility, highest, violation)]
    starts = starts if len(first) <= MOST_FREE else starts[:1]
    ends = [_cheapest(setting, solution, np.log(PEAK), violation, z, free) for z in starts]
    if np.isfinite(highest):
        highest -= WORTH * abs(highest)
    ends = [z for z in ends if z is not None and search.point(z).cost < highest]
    for z in sorted(ends, key=lambda z: search.point(z).cost):
        if _follows(setting, problem, z):
            _move(setting, solution, z, first)
            return


def _cost_of(search, z, violation):
    """The cost at z; infinite where limits are violated by more than `violation`."""
    point = search.point(z)
    return point.cost if search.violation(point) <= violation else np.inf


def _robust_starts(solution, fragility, price, violation):
    """The cheapest points, of those at which the search might have started, that are robust."""
    search = solution.search
    if not solution.screened:
        return ()
    zs, costs, margins = (np.concatenate(parts) for parts in zip(*solution.screened))
    fit = (costs < price) & (search.violations(margins) <= violation)
    order = [k for k in np.argsort(costs, kind="stable") if fit[k]]
    return itertools.islice((zs[k] for k in order if fragility(zs[k]) <= PEAK), STARTS)


def _towards_first(setting, solution, before, allowed):
    """Lower the fragility to `allowed` on the way to the first gains, where it is `before`."""
    search, point = solution.search, solution.point
    problem, z, first = search.problem, point.z, search.problem.start()
    highest = _fragility(setting, solution, problem, z)
    if before > PEAK:
        calmer, highest = _descended(setting, solution, highest)
        _move(setting, solution, calmer, first)
    if not highest > allowed or before > allowed:
        return
    line = z + np.arange(1, LINE + 1)[:, None] / LINE * (first - z)
    line[-1] = first
    calm = lambda each: _fragility(setting, solution, problem, each) <= allowed
    ceiling, violation = point.cost + PRICE * abs(point.cost), search.violation(point)
    each = _first_calm(search, line, calm, ceiling, violation)
    if each is None:  # at any price below that of the start: a fragile loop is no answer
        dearest = search.point(first).cost
        each = _first_calm(search, line, calm, dearest, violation)
        price = dearest if each is None else search.point(each).cost
        free = np.flatnonzero(~solution.kept)
        cheapest = _cheapest(setting, solution, np.log(allowed), violation, point.z, free)
        if cheapest is not None and search.point(cheapest).cost < price - WORTH * abs(price):
            each = cheapest
    if each is not None:
        _move(setting, solution, each, first)


def _lower_peak(setting, solution):
    """Lower fragility towards CALM, as far as PRICE allows, at the cheapest points."""
    search, point = solution.search, solution.point
    problem, z, first = search.problem, point.z, search.problem.start()
    least = search.best.cost + PRICE * abs(search.best.cost)
    violation = search.violation(point)
    # where fragility had to be lowered at a higher price than that: from the cost of the answer,
    # and not above that of the first gains
    dear = point.cost > least
    most = min(point.cost + PRICE * abs(point.cost), _cost_of(search, first, violation))
    ceiling = max(most, point.cost) if dear else least
    low, high = np.log(CALM), np.log(_fragility(setting, solution, problem, z))
    free = np.flatnonzero(~solution.kept)
    if not len(free) > 0 or len(z) > MOST_FREE or not high > low + 2.0 * MARGIN:  # NaN: it has none
        return
    for k in range(BISECTIONS):
        at = 0.5 * (low + high) if k else low
        there = _cheapest(setting, solution, at, violation, point.z, free)
        if there is None or search.point(there).cost > ceiling:
            low = at
            continue
        z, high = there, at
        if not k:
            break
    if _is_earlier(search, first, z, violation):
        calm = np.log(_fragility(setting, solution, problem, first)) <= high + 2.0 * MARGIN
        z = first.copy() if calm else z
    if _follows(setting, problem, z):
        _move(setting, solution, z, first)


def _follows(setting, problem, z):
    """Whether the outputs still follow their setpoints with a time, as Ti, that is much longer."""
    # slow integral action may cost less; nothing is run (and compiled) without such a time
    first, values = problem.own_values(), problem.values(z)
    if not any(b.unit == "s" and values[b.name] > SLOWER * first[b.name] for b in problem.bounds):
        return True
    sides = setting.tuned(first), setting.tuned(values)
    key = jax.random.key(0) if noisy(setting.case) else None
    of_run = [name for name in problem.needed if name not in ms.linear()]
    before, after = ([run_measures(c.loop, c.clock, key, of_run)] for c in sides)
    tables = {"before": before, "after": after}
    return not lost_outputs(runs_of(sides[0], (), 0), tables, values)


def _is_earlier(search, first, z, violation):
    """Whether the first values may be an earlier answer: they cost little more than those at z."""
    start, cost = search.point(first), search.point(z).cost
    dearest = cost + WORTH * abs(cost)
    return start.finite and start.cost <= dearest and search.violation(start) <= violation


def _move(setting, solution, z, first):
    """Make z the answer, which keeps the peaks of the gains that cost least."""
    if not np.array_equal(z, solution.point.z):
        if solution.least_cost_peaks is None:
            values = solution.search.problem.values(solution.search.best.z)
            least = margins_at(setting, solution, values)
            solution.least_cost_peaks = tuple(float(least[name]) for name in PEAKS)
        solution.z, solution.kept = z, z == first


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
    """Return (least fragile point within PRICE along the steepest descent, its fragility)."""
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
            peak = _fragility(setting, solution, problem, each)
            if peak < lowest:
                calmer, lowest = each, peak
            if lowest <= PEAK:
                return calmer, lowest
        z = line[-1]
    return calmer, lowest


def _cheapest(setting, solution, allowed, violation, z, free):
    """The point of least cost, from z, whose log fragility is at most `allowed`; or None."""
    # Newton steps on the cost under the linearised log fragility F; of STRIDE points along each the
    # one with the least cost + weight (F - allowed)+ is next, with twice the multiplier as weight
    search, problem, weight = solution.search, solution.search.problem, 0.0
    begin = np.log(_fragility(setting, solution, problem, z))
    robust = begin <= allowed and search.violation(search.point(z)) <= violation
    calmest = z if robust else None
    if problem.model is None or not np.isfinite(begin):
        return calmest
    for _ in range(ROUNDS):
        over = np.log(_fragility(setting, solution, problem, z)) - allowed
        slope = _slope(setting, solution, problem, z)
        step, multiplier = _newton_within(search, z, free, slope, over)
        size = np.max(np.abs(step), initial=0.0)
        if not 0.0 < size < np.inf:
            break
        weight = max(weight, 2.0 * multiplier)
        step *= min(1.0, STRIDE * SPAN / size)
        line = np.clip(z + np.arange(1, STRIDE + 1)[:, None] / STRIDE * step, 0.0, 1.0)
        costs, margins = search.evaluator.screen(line)
        overs = np.log([_fragility(setting, solution, problem, each) for each in line]) - allowed
        calm = (overs <= 0.0) & (search.violations(margins) <= violation) & np.isfinite(costs)
        if calm.any():
            k = int(np.argmin(np.where(calm, costs, np.inf)))
            gain = np.inf if calmest is None else search.point(calmest).cost - costs[k]
            calmest = line[k] if gain > 0.0 else calmest
            if gain < FINE * WORTH * abs(costs[k]):
                break
        excess = np.maximum(np.nan_to_num(overs, posinf=0.0), 0.0)
        merits = np.where(np.isfinite(overs) & np.isfinite(costs), costs + weight * excess, np.inf)
        k = int(np.argmin(merits))
        before = search.point(z).cost + weight * max(over, 0.0)
        if not merits[k] < before:
            break
        z = line[k]
    return calmest


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
    """(P,) the slope of the log fragility at z by central differences, 0 where it has none."""
    rate = np.zeros(len(z))
    for i, unit in enumerate(np.eye(len(z))):
        ends = [np.clip(z + sign * SPAN * unit, 0.0, 1.0) for sign in (1.0, -1.0)]
        up, down = (np.log(_fragility(setting, solution, problem, end)) for end in ends)
        if np.isfinite(up) and np.isfinite(down):
            rate[i] = (up - down) / (ends[0] - ends[1])[i]
    return rate


PEAKS = "sensitivity_peak", "complementary_peak"


def _fragility(setting, solution, problem, z):
    """Return the larger of Ms and DAMPING Mt at z (P,); NaN where the loop has no peaks."""
    measures = margins_at(setting, solution, problem.values(z))
    Ms, Mt = (float(measures.get(name, np.nan)) for name in PEAKS)
    return max(Ms, DAMPING * Mt)


def margins_at(setting: Setting, solution: Solution, values: Mapping[str, Any]) -> dict[str, Any]:
    """Return the margin measures of the tuned case, which a Solution remembers."""
    key = tuple((name, float(value)) for name, value in values.items())
    if key not in solution.margins:
        case = setting.tuned(values)
        solution.margins[key] = margin_measures(case.loop, case.clock)
    return solution.margins[key]
