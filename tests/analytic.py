"""Problems with a closed form, instead of a Problem and its Evaluator."""

from types import SimpleNamespace

import numpy as np

from jaxtank.bounds import Bound
from jaxtank.core.clock import Clock
from jaxtank.limits import Limit
from tuning.problem.problem import Point


class Analytic:
    """cost(z) is (value, gradient) or (value, gradient, second derivative); margins(z) is
    (margins (limits,), slopes (limits, P)).
    """

    loop = case = SimpleNamespace(symmetry=None)
    clock, seed, risk, runs, scenarios = Clock(dt=1.0, duration=10.0), 0, "mean", (None,), ()
    objective = {"mean_square_error": 1.0}

    def __init__(self, cost, margins=None, *, names=("a", "b"), model=None, start=None):
        self.problem, self.of_cost, self.of_margins = self, cost, margins
        self.names, self.model, self.first = list(names), model, start
        self.bounds = [Bound(name, 0.0, 1.0, "linear", "-") for name in names]
        count = 0 if margins is None else len(np.atleast_1d(margins(np.full(len(names), 0.5))[0]))
        self.limits = [Limit("min_level", i, 1.0) for i in range(count)]
        self.limit_scales = np.ones(count)
        self.simulations = self.gradients = self.non_finite = 0

    def start(self):
        return np.array(self.first)

    def own_values(self):
        return self.values(self.first)

    def values(self, z):
        return dict(zip(self.names, map(float, z)))

    def point(self, z):
        z = np.array(z, dtype=float)
        cost, gradient, *matrix = self.of_cost(z)
        margins, slopes = ((), ()) if self.of_margins is None else self.of_margins(z)
        slopes, gradient = np.array(slopes).reshape(-1, len(z)), np.array(gradient)
        return Point(
            z, cost, gradient, matrix[0] if matrix else np.eye(len(z)),
            np.atleast_1d(np.array(margins, dtype=float)), slopes, (), np.array([cost]),
            gradient[None],
        )  # fmt: skip

    coarse_point = point

    def screen(self, zs, coarse=False):
        self.simulations += len(zs)
        points = [self.point(z) for z in zs]
        margins = np.array([p.margins for p in points]).reshape(len(zs), -1)
        return np.array([p.cost for p in points]), margins


def bowl(z, centre, value=0.0):
    """(value, gradient) of `value` and the squared distance from a centre."""
    apart = np.asarray(z) - centre
    return value + float(apart @ apart), 2.0 * apart
