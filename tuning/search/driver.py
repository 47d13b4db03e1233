"""A search: its problem, counted evaluations, cached points, and the same on a coarse model."""

import numpy as np

from tuning.problem.problem import EXPLODED

BACKOFF = 1e-6
"""Share of its limit by which a search keeps a measure inside it, so that the reported value is not
above by round-off [-].
"""

SETTLED = 0.02
"""KKT residual, of the scaled cost per unit of z, below which a first-order method counts as
converged.
"""


class Search:
    """A problem as a solver sees it: scaled cost, margins, memory of the last points, the best one
    so far.
    """

    def __init__(self, problem, reference, report, tolerance=1e-8):
        self.problem, self.report, self.tolerance = problem, report, tolerance
        # a cost can be a scale where its slopes are not to be used
        self.scale = reference.cost if 0 < reference.cost < EXPLODED else 1.0
        self.room = problem.rooms
        # a limit of exactly zero is often the least a measure can be: there is no room to keep off
        # it
        # a search ends within its tolerance of a limit, on either side
        self.backoff = max(BACKOFF, tolerance) * np.array(
            [limit.value != 0 for limit in problem.limits], dtype=float
        )
        self.best_start = None
        self.exhausted = False  # whether the last local search used up its iterations
        self.best, self.history, self.memory, self.last_finite, self.start = (
            None,
            [],
            {},
            reference,
            0,
        )

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
        """Largest amount by which a limit is broken, as a share of its `objective.room_of` [-]; 0
        where all hold.
        """
        return float(max(0.0, *(-point.margins / self.room))) if len(point.margins) else 0.0

    def better(self, a, b):
        """True if a is to be preferred: fewer violations first, then lower cost."""
        va, vb = self.violation(a), self.violation(b)
        return va < vb if max(va, vb) > 0 and va != vb else a.cost < b.cost

    def cost(self, z):
        """(scaled cost, gradient). A point that is not finite costs ten times the start and points
        back to the last good one.
        """
        point = self.point(z)
        if point.finite:
            return point.cost / self.scale, point.gradient / self.scale
        return 10.0, (point.z - self.last_finite.z) * 10.0

    def margins(self, z):
        """((limits,) margins as shares of their limits, less the back-off, (limits, P) slopes)."""
        point = self.point(z)
        good = point if point.finite else self.last_finite
        return good.margins / self.room - self.backoff, good.margin_slopes / self.room[:, None]


class Rough(Search):
    """The same problem at a tenth of the samples, on the same scale: what it finds is a start, and
    enters no race.
    """

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
