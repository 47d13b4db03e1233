"""Local searches from one start: each takes a Search, may stop early, and must not raise."""

from typing import NamedTuple

import numpy as np
import scipy  # its parts are imported when they are first used

from tuning.cluster.ahead import recorded
from tuning.problem.problem import DIVERGED, ROOT
from tuning.search.driver import LOWER_BY, SETTLED, CoarseSearch, Search, optimality
from tuning.search.screening import MEMBERS, distinct_starts, evolution_size, evolve, sobol

STEEPEST = 10.0  # largest gradient for a first-order method: a step must not go far away


def lbfgs(search, z, iterations):
    """Return True if optax's L-BFGS converged: halving steps, projected onto the bounds."""
    import optax

    return _augmented(search, z, iterations, optax.scale_by_lbfgs(memory_size=8), descend=True)


def adam(search, z, iterations):
    """Return True if optax's Adam converged: five steps an iteration, projected onto the bounds."""
    import optax

    steps = 5 * iterations
    schedule = optax.cosine_decay_schedule(0.05, max(steps // _rounds(search), 1), 0.002)
    return _augmented(search, z, steps, optax.adam(schedule), descend=False)


def _rounds(search):
    """Return how often the multipliers of the limits are updated."""
    return 4 if search.problem.limits else 1


def _augmented(search, z, iterations, optimiser, descend):
    """Return True if an optax optimiser converged on the augmented Lagrangian of the limits."""
    weights, stiffness, rounds = np.zeros(len(search.problem.limits)), 100.0, _rounds(search)

    def value(z):
        f, g = search.cost(z)
        if not len(weights):
            return f, g
        m, slopes = search.margins(z)
        penalty = np.maximum(0.0, weights - stiffness * m)
        return f + float(penalty @ penalty) / (2 * stiffness), g - penalty @ slopes

    for _ in range(rounds):
        state = optimiser.init(z)
        for _ in range(max(1, iterations // rounds)):
            f, g = value(z)
            g = g * min(1.0, STEEPEST / max(float(np.linalg.norm(g)), 1e-300))
            update, state = optimiser.update(g, state, z)
            step = np.asarray(update) if not descend else -np.asarray(update)
            new = np.clip(z + step, 0.0, 1.0)
            halvings = 0
            while descend and value(new)[0] > f - 1e-4 * abs(g @ (new - z)) and halvings < 12:
                step, halvings = 0.5 * step, halvings + 1
                new = np.clip(z + step, 0.0, 1.0)
            moved, z = float(np.linalg.norm(new - z)), new
            search.exhausted = moved >= 1e-6
            if not search.exhausted:
                break
        if len(weights):
            weights = np.maximum(0.0, weights - stiffness * search.margins(z)[0])
            stiffness *= 4
    return search.best is not None and optimality(search, search.best)[1] < SETTLED


PROGRESS, PATIENCE = 1e-9, 25
"""Share by which the best cost must fall within PATIENCE evaluations for a search to go on: at a
kink a line search does not end by itself [-].
"""

ITERATION_LIMIT = 9  # status of scipy's SLSQP that has used up its iterations

COARSE_TOLERANCE = 1e-4  # at a tenth of the samples, whose own error is larger [-]
EXACT = 1e-8  # up to it Gauss-Newton goes on to rounding: it takes few steps there
RESTORED = 5  # points from which the least violation is sought, where none holds
NEAR, HALVINGS = 0.1, 10  # largest violation that `approach` starts from [-], halvings

MANY = 4  # number of parameters from which "auto" tries Gauss-Newton before it considers limits
UNCONSTRAINED = ("trf", "coarse-trf")  # those that ignore limits


def slsqp(search, z, iterations, tolerance=None):
    """Return True if sequential quadratic programming converged, on the exact maxima."""
    tolerance = search.tolerance if tolerance is None else tolerance
    if search.problem.risk == "worst" and len(search.problem.runs) > 1:
        # min t subject to cost_i <= t, which is smooth where the largest cost is not.

        def known(z):
            point = search.point(z)
            return point if point.finite else search.last_finite

        def holds(y):
            point = known(y[:-1])
            return np.append(y[-1] - point.run_costs / search.scale, search.margins(y[:-1])[0])

        def slopes(y):
            point = known(y[:-1])
            costs = np.hstack(
                [-point.run_slopes / search.scale, np.ones((len(point.run_costs), 1))]
            )
            rows = search.margins(y[:-1])[1].reshape(-1, len(y) - 1)
            return np.vstack([costs, np.hstack([rows, np.zeros((len(rows), 1))])])

        y = np.append(z, known(z).run_costs.max() / search.scale)
        rows = [{"type": "ineq", "fun": holds, "jac": slopes}]
        return _minimise(search, _last, y, [(None, None)], rows, iterations, tolerance)
    rows = {
        "type": "ineq",
        "fun": lambda z: search.margins(z)[0],
        "jac": lambda z: search.margins(z)[1],
    }
    constraints = [rows] if search.problem.limits else []
    try:
        return _minimise(search, _Watch(search), z, [], constraints, iterations, tolerance)
    except _NoProgress:
        return True


def _minimise(search, function, y, more, constraints, iterations, tolerance):
    """Return True if SLSQP converged from y in [0, 1], the last ones in the ranges `more`."""
    box = [(0.0, 1.0)] * (len(y) - len(more)) + more
    rules = {"bounds": box, "constraints": constraints, "jac": True, "method": "SLSQP"}
    options = {"maxiter": iterations, "ftol": tolerance}
    done = scipy.optimize.minimize(function, y, options=options, **rules)
    search.exhausted = done.status == ITERATION_LIMIT
    # 8: no descent along the search direction, the end at the precision of a kinked cost
    return bool(done.success) or done.status == 8


def _last(y):
    return y[-1], np.eye(len(y))[-1]


class _NoProgress(Exception):
    """The best point is as good as the precision of the cost allows."""


class _Watch:
    """`Search.cost`, until feasible points have not become better for PATIENCE evaluations."""

    def __init__(self, search):
        self.search, self.least, self.since = search, np.inf, 0

    def __call__(self, z):
        cost, gradient = self.search.cost(z)
        point = self.search.point(z)
        if point.finite:
            feasible, begun = self.search.violation(point) == 0, np.isfinite(self.least)
            better = feasible and (not begun or cost < self.least - PROGRESS * abs(self.least))
            self.since = 0 if better or not begun else self.since + 1
            self.least = min(self.least, cost) if feasible else self.least
        if self.since > PATIENCE:
            raise _NoProgress
        return cost, gradient


def trf(search, z, iterations, tolerance=1e-10):
    """Return True if a bounded Gauss-Newton trust region converged, without the limits."""
    tolerance = max(tolerance, search.tolerance) if search.tolerance > EXACT else tolerance
    squared = search.problem.model == "square"
    weight = search.problem.objective[ROOT] if squared else 1.0

    def model(z):
        point = search.point(z)
        if not point.finite or not np.all(np.abs(point.gauss_newton) < DIVERGED**2):
            return np.full(len(z) + 1, 1e3), np.eye(len(z) + 1, len(z))
        cost = point.cost / search.scale
        if squared:
            value, slope = cost**2, cost * point.gradient / search.scale
            normal = 0.5 * weight**2 * point.gauss_newton / search.scale**2
        else:  # the squares sum to the cost and 1, so that a steep cost near 0 fits too
            value, slope = cost + 1.0, 0.5 * point.gradient / search.scale
            normal = 0.5 * point.gauss_newton / search.scale
        root = np.linalg.cholesky(normal + 1e-12 * (np.trace(normal) + 1e-12) * np.eye(len(z)))
        head = np.linalg.solve(root, slope)
        # terms without squares may slope more than the model's curvature allows
        excess = max(1.0, float(head @ head) / max(value, 1e-300))
        rest = max(value - head @ head / excess, 0.0) ** 0.5
        return np.append(head / excess**0.5, rest), np.vstack([root.T * excess**0.5, 0 * z])

    value, slopes = (lambda z: model(z)[0]), (lambda z: model(z)[1])
    options = dict.fromkeys(("ftol", "xtol", "gtol"), tolerance) | {"max_nfev": iterations}
    inside = np.clip(z, 1e-9, 1 - 1e-9)
    done = scipy.optimize.least_squares(value, inside, jac=slopes, bounds=(0.0, 1.0), **options)
    search.exhausted = done.status == 0
    return bool(done.success)


def coarse_first(search, z, iterations):
    """Return True if `trf` at a tenth of the samples, then at all of them, converged."""
    coarse = CoarseSearch(search)
    began = coarse.point(z)
    trf(coarse, z, iterations, tolerance=COARSE_TOLERANCE)
    if coarse.best is not None and began.finite:
        near = search.point(coarse.best.z)
        z = near.z if near.finite and near.cost < began.cost else z
    return trf(search, z, iterations)


def gauss_newton_first(search, z, iterations):
    """Return True if `trf` converged to a feasible point, else if `slsqp` from z did."""
    mark = len(search.history)
    converged = trf(search, z, iterations, tolerance=1e-6)
    mine = [h for h in search.history[mark:] if np.isfinite(h[1])]
    if mine and min(mine, key=lambda h: h[1])[2] == 0.0:
        return converged
    return slsqp(search, z, iterations)


def restore(search, z, iterations):
    """Return True if a search for the least violation of the limits converged."""
    # min t subject to scaled margin_i >= -t, t >= 0, by SLSQP on (z, t).
    if not search.problem.limits:
        return True

    holds = lambda y: search.margins(y[:-1])[0] + y[-1]

    def slopes(y):
        rows = search.margins(y[:-1])[1]
        return np.hstack([rows, np.ones((len(rows), 1))])

    y = np.append(z, max(0.0, float(-search.margins(z)[0].min())))
    rows = [{"type": "ineq", "fun": holds, "jac": slopes}]
    return _minimise(search, _last, y, [(0.0, None)], rows, iterations, 1e-10)


def approach(search):
    """Move the best feasible point towards a lower infeasible one, by halving the distance."""
    best = search.best
    if best is None or search.violation(best) > 0:
        return
    blind = ~np.any(best.margin_slopes, axis=1)
    outside = [
        p
        for p in search.memory.values()
        if p.finite
        and p.cost < best.cost - LOWER_BY * abs(best.cost)
        and search.violation(p) < NEAR
        and np.all(p.margins[~blind] >= 0)
    ]
    if not outside:
        return
    out, inside = min(outside, key=lambda p: p.cost).z, best.z
    for _ in range(HALVINGS):
        middle = search.point(0.5 * (out + inside))
        if middle.finite and search.violation(middle) == 0:
            inside = middle.z
        else:
            out = middle.z


def find_feasible(search, screened, iterations, seed, coarse=True):
    """Return True if the searches for the least violation of the limits came to their end."""
    short = np.maximum(0.0, -screened.margins / search.limit_scale).max(axis=1, initial=0.0)
    starts = distinct_starts(screened.zs, short, RESTORED, search.best.z)
    ended = []
    for z in starts:
        ended.append(restore(search, z, iterations))
        if search.violation(search.best) == 0:
            slsqp(search, search.best.z, iterations)
            return True
    count, generations = evolution_size(search, screened)
    more = sobol(MEMBERS, len(search.best.z), seed + 1)
    order = np.argsort(np.where(np.isfinite(short), short, np.inf), kind="stable")
    members = np.concatenate([search.best.z[None], screened.zs[order[: count // 2]], more])[:count]
    now, _ = evolve(search, members, generations, seed, coarse)
    z = now.zs[np.argmin(now.merits(search))]
    ended.append(restore(search, z, iterations))
    if search.violation(search.best) == 0:
        slsqp(search, search.best.z, iterations)
    return any(ended)


def automatic(problem):
    """Return the method "auto": Gauss-Newton without limits or for many parameters, else SLSQP."""
    if problem.model and not problem.limits:
        return "trf"
    return "trf-slsqp" if problem.model and len(problem.bounds) >= MANY else "slsqp"


METHODS = {
    "slsqp": slsqp,
    "trf": trf,
    "lbfgs": lbfgs,
    "adam": adam,
    "trf-slsqp": gauss_newton_first,
    "coarse-trf": coarse_first,
}


class Local(NamedTuple):
    """How local searches run."""

    method: str
    iterations: int
    tolerance: float | None = None  # None: the tolerance of the Search
    batch: int | None = None  # scenarios drawn for each step of adam
    seed: int = 0  # of these


def run_local(search, z, how):
    """Return True if the local search from z (P,) converged."""
    if how.batch is None:
        return METHODS[how.method](search, z, how.iterations)
    rng = np.random.default_rng([how.seed, search.start])
    import optax

    steps = 5 * how.iterations
    optimiser = optax.adam(optax.cosine_decay_schedule(0.05, steps, 0.002))
    state, every = optimiser.init(z), max(1, steps // 10)
    for k in range(steps):
        point = search.evaluator.batch_point(z, how.batch, rng)
        search.report(search)
        if not point.finite:
            z = 0.5 * (z + search.last_finite.z)
            continue
        scale = search.limit_scale[list(point.rows)]
        penalty = 100.0 * np.maximum(0.0, -point.margins / scale)
        g = point.gradient / search.scale - penalty @ (point.margin_slopes / scale[:, None])
        g = g * min(1.0, STEEPEST / max(float(np.linalg.norm(g)), 1e-300))
        update, state = optimiser.update(g, state, z)
        z = np.clip(z + np.asarray(update), 0.0, 1.0)
        if (k + 1) % every == 0:
            search.point(z)
    search.exhausted = True
    return search.best is not None and optimality(search, search.best)[1] < SETTLED


def search_alone(evaluator, z, number, how):
    """Run the local search of this number from z (P,) as the first search of a problem."""
    how, reference = Local(*how), evaluator.point(evaluator.problem.start())
    search = Search(evaluator, reference, tolerance=how.tolerance)
    search.take(reference)
    search.start = number
    run_local(search, z, how)


def search_task(text, arrays, arguments, known):
    """Return the new evaluations of `search_alone`; a task, see `tuning.cluster.ahead`."""
    return recorded(text, arrays, search_alone, arguments, known)
