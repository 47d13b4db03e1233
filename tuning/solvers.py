"""Local searches from one start. Each takes a Search, which counts, remembers and shields; each may stop early, none may fail."""

import numpy as np
import scipy  # its parts are imported when they are first used

from tuning.problem.problem import EXPLODED, ROOT

BACKOFF = 1e-6
"""Share of its limit by which a search keeps a measure inside it, so that the reported value is not above by round-off [-]."""

SETTLED = 0.02
"""KKT residual, of the scaled cost per unit of z, below which a first-order method counts as converged."""

SLOPING = 0.05
"""KKT residual, of the scaled cost per unit of z, above which an answer is looked at once more: see `downhill`."""

STEEPEST = 10.0
"""Longest gradient, of the scaled cost per unit of z, that a first-order method is shown: a cliff should turn it back, not throw it."""


STILL, LONG = 1e-9, 25
"""Share by which the best cost must fall within LONG evaluations for a search to go on: at a kink a line search never ends by itself [-]."""

ITERATION_LIMIT = 9
"""Status of scipy's SLSQP that has used up its iterations."""

ROUGHLY = 1e-4
"""Tolerance of the search at a tenth of the samples, whose own error is larger [-]."""


class Search:
    """A problem as a solver sees it: scaled cost, margins, memory of the last points, the best one so far."""

    def __init__(self, problem, reference, report, tolerance=1e-8):
        self.problem, self.report, self.tolerance = problem, report, tolerance
        # a cost can be a scale where its slopes are not to be used
        self.scale = reference.cost if 0 < reference.cost < EXPLODED else 1.0
        self.room = problem.rooms
        # a limit of exactly zero is often the least a measure can be: there is no room to keep off it
        # a search ends within its tolerance of a limit, on either side
        self.backoff = max(BACKOFF, tolerance) * np.array([limit.value != 0 for limit in problem.limits], dtype=float)
        self.best_start = None
        self.exhausted = False  # whether the last local search used up its iterations
        self.best, self.history, self.memory, self.last_finite, self.start = None, [], {}, reference, 0

    def point(self, z):
        """The Point at z, clipped into the box; remembered."""
        z = np.clip(z, 0.0, 1.0)
        key = z.tobytes()
        if key not in self.memory:
            self.take(self.problem.point(z))
        return self.memory[key]

    def take(self, point):
        """Enter a Point into the memory, the history and the race for the best."""
        self.memory[point.z.tobytes()] = point
        broken = self.violation(point) if point.finite else np.inf
        self.history.append((self.start, float(point.cost), broken, tuple(point.z)))
        if point.finite:
            self.last_finite = point
            if self.best is None or self.better(point, self.best):
                self.best, self.best_start = point, self.start
        self.report(self)

    def passed(self):
        """Tell the reporter that something was evaluated that is not a Point of its own."""
        self.report(self)

    def violation(self, point):
        """Largest amount by which a limit is broken, as a share of its `objective.room_of` [-]; 0 where all hold."""
        return float(max(0.0, *(-point.margins / self.room))) if len(point.margins) else 0.0

    def better(self, a, b):
        """True if a is to be preferred: fewer violations first, then lower cost."""
        va, vb = self.violation(a), self.violation(b)
        return va < vb if max(va, vb) > 0 and va != vb else a.cost < b.cost

    def cost(self, z):
        """(scaled cost, gradient). A point that is not finite costs ten times the start and points back to the last good one."""
        point = self.point(z)
        if point.finite:
            return point.cost / self.scale, point.gradient / self.scale
        return 10.0, (point.z - self.last_finite.z) * 10.0

    def margins(self, z):
        """((limits,) margins as shares of their limits, less the back-off, (limits, P) slopes)."""
        point = self.point(z)
        good = point if point.finite else self.last_finite
        return good.margins / self.room - self.backoff, good.margin_slopes / self.room[:, None]


def slsqp(search, z, iterations, tolerance=None):
    """Sequential quadratic programming on the exact maxima. Returns True if it converged."""
    tolerance = search.tolerance if tolerance is None else tolerance
    if getattr(search.problem, "risk", "mean") == "worst" and len(search.problem.lanes) > 1:
        return _epigraph(search, z, iterations, tolerance)
    constraints = []
    if search.problem.limits:
        constraints = [{"type": "ineq", "fun": lambda z: search.margins(z)[0], "jac": lambda z: search.margins(z)[1]}]
    try:
        done = scipy.optimize.minimize(
            _Watch(search),
            z,
            jac=True,
            method="SLSQP",
            bounds=[(0.0, 1.0)] * len(z),
            constraints=constraints,
            options={"maxiter": iterations, "ftol": tolerance},
        )
    except _Settled:
        return True
    search.exhausted = done.status == ITERATION_LIMIT
    # 8: no further descent along the search direction, which is how a solver ends at the precision of a kinked cost
    return bool(done.success) or done.status == 8


class _Settled(Exception):
    """The best point is as good as the cost can tell."""


class _Watch:
    """`Search.cost`, until points within the limits have not become better for long."""

    def __init__(self, search):
        self.search, self.least, self.since = search, np.inf, 0

    def __call__(self, z):
        found = self.search.cost(z)
        point = self.search.point(z)
        if point.finite:
            held = self.search.violation(point) == 0
            better = held and found[0] < self.least - STILL * abs(self.least if np.isfinite(self.least) else 0.0)
            self.since = 0 if better or not np.isfinite(self.least) else self.since + 1
            self.least = min(self.least, found[0]) if held else self.least
        if self.since > LONG:
            raise _Settled
        return found


def _epigraph(search, z, iterations, tolerance):
    """`slsqp` of the worst scenario: t made small under cost_i <= t, which is smooth where the largest cost is not."""

    def known(z):
        point = search.point(z)
        return point if point.finite else search.last_finite

    def holds(y):
        point = known(y[:-1])
        return np.append(y[-1] - point.lane_costs / search.scale, search.margins(y[:-1])[0])

    def slopes(y):
        point = known(y[:-1])
        costs = np.hstack([-point.lane_slopes / search.scale, np.ones((len(point.lane_costs), 1))])
        rows = search.margins(y[:-1])[1].reshape(-1, len(y) - 1)
        return np.vstack([costs, np.hstack([rows, np.zeros((len(rows), 1))])])

    done = scipy.optimize.minimize(
        lambda y: (y[-1], np.eye(len(y))[-1]),
        np.append(z, known(z).lane_costs.max() / search.scale),
        jac=True,
        method="SLSQP",
        bounds=[(0.0, 1.0)] * len(z) + [(None, None)],
        constraints=[{"type": "ineq", "fun": holds, "jac": slopes}],
        options={"maxiter": iterations, "ftol": tolerance},
    )
    search.exhausted = done.status == ITERATION_LIMIT
    return bool(done.success) or done.status == 8


def trf(search, z, iterations, tolerance=1e-10):
    """Bounded Gauss-Newton trust region on P + 1 residuals that have the cost's value, slope and second derivative (the latter without
    the residuals' own curvature). Limits are not looked at. Returns True if it converged."""
    squared = search.problem.model == "square"
    weight = search.problem.objective[ROOT] if squared else 1.0

    def model(z):
        point = search.point(z)
        if not point.finite or not np.all(np.abs(point.gauss_newton) < EXPLODED**2):
            return np.full(len(z) + 1, 1e3), np.eye(len(z) + 1, len(z))
        cost = point.cost / search.scale
        if squared:
            value, slope = cost**2, cost * point.gradient / search.scale
            normal = 0.5 * weight**2 * point.gauss_newton / search.scale**2
        else:  # the residuals' squares sum to the cost and one more, so that a steep cost near 0 fits too
            value, slope, normal = cost + 1.0, 0.5 * point.gradient / search.scale, 0.5 * point.gauss_newton / search.scale
        root = np.linalg.cholesky(normal + 1e-12 * (np.trace(normal) + 1e-12) * np.eye(len(z)))
        head = np.linalg.solve(root, slope)
        excess = max(1.0, float(head @ head) / value)  # terms without squares may slope more than the model's curvature allows
        return np.append(head / excess**0.5, max(value - head @ head / excess, 0.0) ** 0.5), np.vstack(
            [root.T * excess**0.5, 0 * z]
        )

    done = scipy.optimize.least_squares(
        lambda z: model(z)[0],
        np.clip(z, 1e-9, 1 - 1e-9),
        jac=lambda z: model(z)[1],
        bounds=(0.0, 1.0),
        method="trf",
        ftol=tolerance,
        xtol=tolerance,
        gtol=tolerance,
        max_nfev=iterations,
    )
    search.exhausted = done.status == 0
    return bool(done.success)


class Rough(Search):
    """The same problem at a tenth of the samples, on the same scale: what it finds is a start, and enters no race."""

    def __init__(self, search):
        super().__init__(search.problem, search.last_finite, search.report)
        self.scale, self.owner = search.scale, search

    def point(self, z):
        """The rough Point at z, clipped into the box; remembered."""
        z = np.clip(z, 0.0, 1.0)
        if z.tobytes() not in self.memory:
            found = self.memory[z.tobytes()] = self.problem.rough(z)
            if found.finite and (self.best is None or found.cost < self.best.cost):
                self.best = found
            self.owner.passed()
        return self.memory[z.tobytes()]


def coarse_first(search, z, iterations):
    """`trf` at a tenth of the samples, then at all of them from where that ended: most of the way is gone where a step is cheap. Where
    the rough runs mislead (at ten times the step a loop may chatter), the second part begins at z. Limits are not looked at."""
    rough = Rough(search)
    began = rough.point(z)
    trf(rough, z, iterations, tolerance=ROUGHLY)
    if rough.best is not None and began.finite:
        near = search.point(rough.best.z)
        z = near.z if near.finite and near.cost < began.cost else z
    return trf(search, z, iterations)


def gauss_newton_first(search, z, iterations):
    """`trf` as if there were no limits; where it ends outside one, `slsqp` from where it began. The cheapest way where limits are slack."""
    mark = len(search.history)
    converged = trf(search, z, iterations, tolerance=1e-6)
    mine = [h for h in search.history[mark:] if np.isfinite(h[1])]
    if mine and min(mine, key=lambda h: h[1])[2] == 0.0:
        return converged
    return slsqp(search, z, iterations)


def restore(search, z, iterations):
    """The least largest violation, as a share of each limit: slsqp on (z, t), t made small, with every margin at least -t. True if it came to
    its end."""
    if not search.problem.limits:
        return True

    def holds(y):
        return search.margins(y[:-1])[0] + y[-1]

    def slopes(y):
        rows = search.margins(y[:-1])[1]
        return np.hstack([rows, np.ones((len(rows), 1))])

    worst = max(0.0, float(-search.margins(z)[0].min()))
    done = scipy.optimize.minimize(
        lambda y: (y[-1], np.eye(len(y))[-1]),
        np.append(z, worst),
        jac=True,
        method="SLSQP",
        bounds=[(0.0, 1.0)] * len(z) + [(0.0, None)],
        constraints=[{"type": "ineq", "fun": holds, "jac": slopes}],
        options={"maxiter": iterations, "ftol": 1e-10},
    )
    return bool(done.success) or done.status == 8


def approach(search):
    """Move the best feasible point towards a lower infeasible one, by halving the distance.

    Only where each limit that is broken there has no slope at the feasible point: a measure that changes
    in steps, or is 0 in all of the feasible set (overshoot), gives SLSQP no direction along its boundary.
    """
    best = search.best
    if best is None or search.violation(best) > 0:
        return
    blind = ~np.any(best.margin_slopes, axis=1)
    outside = [
        p
        for p in search.memory.values()
        if p.finite and p.cost < best.cost * (1 - LOWER_BY) and search.violation(p) < NEAR and np.all(p.margins[~blind] >= 0)
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


def lbfgs(search, z, iterations):
    """optax's L-BFGS direction with halving steps, limits by augmented Lagrangian, projected into the box."""
    import optax

    return _augmented(search, z, iterations, optax.scale_by_lbfgs(memory_size=8), descend=True)


def adam(search, z, iterations):
    """optax's Adam, limits by augmented Lagrangian, projected into the box. Its steps are small: five to an iteration."""
    import optax

    steps = 5 * iterations
    schedule = optax.cosine_decay_schedule(0.05, max(steps // _rounds(search), 1), 0.002)
    return _augmented(search, z, steps, optax.adam(schedule), descend=False)


def minibatches(search, z, iterations, batch, rng):
    """optax's Adam on the mean of `batch` scenarios drawn afresh for every step, limits of those by a quadratic penalty. All scenarios
    are looked at ten times on the way, and they decide what is best."""
    import optax

    steps = 5 * iterations
    optimiser = optax.adam(optax.cosine_decay_schedule(0.05, steps, 0.002))
    state, every = optimiser.init(z), max(1, steps // 10)
    for k in range(steps):
        point = search.problem.part(z, batch, rng)
        search.passed()
        if not point.finite:
            z = 0.5 * (z + search.last_finite.z)
            continue
        room = search.room[list(point.rows)]
        push = 100.0 * np.maximum(0.0, -point.margins / room)
        g = point.gradient / search.scale - push @ (point.margin_slopes / room[:, None])
        g = g * min(1.0, STEEPEST / max(float(np.linalg.norm(g)), 1e-300))
        update, state = optimiser.update(g, state, z)
        z = np.clip(z + np.asarray(update), 0.0, 1.0)
        if (k + 1) % every == 0:
            search.point(z)
    search.exhausted = True
    return search.best is not None and optimality(search, search.best)[1] < SETTLED


def _rounds(search):
    return 4 if search.problem.limits else 1


def _augmented(search, z, iterations, optimiser, descend):
    weights, stiffness, rounds = np.zeros(len(search.problem.limits)), 100.0, _rounds(search)

    def value(z):
        f, g = search.cost(z)
        if not len(weights):
            return f, g
        m, slopes = search.margins(z)
        push = np.maximum(0.0, weights - stiffness * m)
        return f + float(push @ push) / (2 * stiffness), g - push @ slopes

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


def optimality(search, point):
    """(gradient norm, KKT residual, multipliers of the limits) at a point, all of the scaled cost per unit of z.

    The residual is what is left of the gradient after the best non-negative combination of the slopes of active limits and bounds.
    """
    residual, multipliers = _left(search, point)
    return float(np.linalg.norm(point.gradient / search.scale)), float(np.linalg.norm(residual)), multipliers


def _left(search, point):
    """(what is left of the gradient (P,), multipliers (limits,)); see `optimality`."""
    g = point.gradient / search.scale
    columns, owners = [], []
    room = point.margins / search.room - search.backoff
    for i, (m, slope) in enumerate(zip(room, point.margin_slopes / search.room[:, None])):
        if m < 1e-4:
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


NEAR, HALVINGS = 0.1, 10
"""Largest violation of a point that `approach` moves towards [-], and number of halvings."""

STRIDES = (3e-2, 1e-2, 3e-3, 1e-3, 1e-4)
"""Steps along the slope that is left at an answer, in the unit cube, at which something better is looked for."""

UNSTABLE = 1.0 / STRIDES[-1]
"""KKT residual, of the scaled cost per unit of z, by which the cost would fall below 0 within the least
of STRIDES: the derivative of an unstable or chaotic run, exact, and of no use for a step."""

LOWER_BY = 1e-4
"""Share by which the cost must fall for a point to count as better than an answer at a kink [-]."""


def downhill(search, point):
    """A Point within the limits that is lower than `point` by more than the cost can be trusted to, found along the slope that is left of it;
    None where there is none: the point is an optimum, or at a kink."""
    residual, _ = _left(search, point)
    if np.linalg.norm(residual) <= SLOPING:
        return None
    for stride in STRIDES:
        other = search.point(point.z - stride * residual / np.linalg.norm(residual))
        if other.finite and search.violation(other) == 0.0 and other.cost < point.cost - LOWER_BY * abs(point.cost):
            return other
    return None


METHODS = {"slsqp": slsqp, "trf": trf, "lbfgs": lbfgs, "adam": adam, "trf-slsqp": gauss_newton_first, "coarse-trf": coarse_first}
