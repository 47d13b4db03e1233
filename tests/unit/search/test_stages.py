"""Stages of a search on costs and limits with a closed form."""

from types import SimpleNamespace

import numpy as np
import pytest

from jaxtank.bounds import Bound
from tuning.problem.problem import Point
from tuning.search import default, diagnostics, methods, solve
from tuning.search.driver import Search

CENTRE = np.array([0.3, 0.6])
PLAN = solve.Plan(method="slsqp", starts=1, screening=8, iterations=1, seed=0)


class Bowl:
    """An Evaluator of 1 + sum of `weights` (z - CENTRE)^2, and of `margins` (z) without slopes."""

    def __init__(self, margins=lambda z: [], scales=(), weights=(1.0, 1.0)):
        self.margins, self.weights, self.simulations = margins, np.array(weights), 0
        self.problem = SimpleNamespace(
            bounds=[Bound(name, 0.0, 1.0, "linear", "") for name in "ab"],
            names=["a", "b"],
            limits=[SimpleNamespace(label=f"limit {i}", value=1.0) for i in range(len(scales))],
            limit_scales=np.array(scales),
            runs=[0],
            clock=SimpleNamespace(samples=10),
            objective={},
            values=lambda z: dict(zip("ab", np.asarray(z).tolist())),
        )

    def point(self, z):
        away, margins = z - CENTRE, np.array(self.margins(z), dtype=float)
        cost, gradient = 1.0 + float(self.weights @ away**2), 2 * self.weights * away
        slopes, run = np.zeros((len(margins), 2)), (np.array([cost]), gradient[None])
        return Point(z, cost, gradient, np.eye(2), margins, slopes, (), *run)

    def screen(self, zs, coarse=False):
        points = [self.point(z) for z in np.asarray(zs)]
        return np.array([p.cost for p in points]), np.array([p.margins for p in points])


def search_of(evaluator, z=(0.5, 0.5)):
    search = Search(evaluator, evaluator.point(np.array(z)))
    search.take(search.reference)
    return search


def test_starts_are_ranked_by_cost_and_violation_as_shares(monkeypatch):
    """The second limit is violated by 20 of its scale of 100: 2 costs of the start are added."""
    asked = []

    def rank(zs, merits, count, first):
        asked.extend([zs, merits])
        raise KeyboardInterrupt

    monkeypatch.setattr(solve, "distinct_starts", rank)
    bowl = Bowl(lambda z: [0.5, -20.0], [1.0, 100.0])
    solution = solve.solve(bowl, np.array([0.5, 0.5]), PLAN, None)
    zs, merits = asked
    costs = 1.0 + ((zs - CENTRE) ** 2).sum(axis=1)
    np.testing.assert_allclose(merits, costs / (1.0 + 0.04 + 0.01) + 2.0)
    assert solution.status(feasible=True) == "interrupted"


@pytest.mark.parametrize(("at_start", "stays"), [(0.15, False), (0.1, True), (0.05, True)])
def test_a_gain_without_effect_keeps_its_first_value_unless_limits_are_violated_more(
    at_start, stays, monkeypatch
):
    monkeypatch.setattr(diagnostics, "table_of", lambda problem, values: [{}])
    margins = lambda z: [-0.1 if z[0] > 0.5 else -at_start]
    evaluator = Bowl(margins, [1.0], weights=[0.0, 1.0])
    first = np.array([0.2, 0.4])
    search = Search(evaluator, evaluator.point(first))
    search.best = evaluator.point(np.array([0.8, 0.5]))
    assert diagnostics.unexercised(search, first).tolist() == [stays, False]
    np.testing.assert_allclose(search.best.z, [0.2 if stays else 0.8, 0.5])


@pytest.mark.parametrize(("best", "first"), [(0.8, 0.9), (0.3, 0.2)])
def test_a_gain_that_has_an_effect_elsewhere_in_its_range_has_one(best, first, monkeypatch):
    """Runs differ on the other side of the middle only, 0.4 of the range away."""
    side = lambda values: [{"rms_error_total": np.array(float(values["a"] > 0.5))}]
    monkeypatch.setattr(diagnostics, "table_of", lambda problem, values: side(values))
    evaluator = Bowl(weights=[0.0, 1.0])
    first = np.array([first, 0.4])
    search = Search(evaluator, evaluator.point(first))
    search.best = evaluator.point(np.array([best, 0.5]))
    assert diagnostics.unexercised(search, first).tolist() == [False, False]


@pytest.mark.parametrize(("limit", "answer"), [(0.25, 0.2), (0.15, 0.1)])
def test_a_lower_point_along_the_least_sensitive_direction_is_the_answer_within_limits(
    limit, answer
):
    """Costs of z = (0.1, 0.6), where the search ended, and 0.1 nearer to the centre; a <= limit."""
    evaluator = Bowl(lambda z: [limit - z[0]], [1.0], weights=[1.0, 4.0])
    search = search_of(evaluator, (0.1, 0.6))
    curvature = diagnostics.curvature(search, search.best)
    np.testing.assert_allclose(curvature["eigenvalues"], [2 / 1.04, 8 / 1.04])
    least = curvature["least_sensitive"]
    assert least["factors"] == {"a": 0.1, "b": 0.0}
    assert least["changes_percent"] == pytest.approx(100 * (1 - 1.01 / 1.04))
    np.testing.assert_allclose(search.best.z, [answer, 0.6], atol=2 * diagnostics.STEP)


def test_gains_of_a_rival_are_taken_within_the_ranges():
    """No positive number is none on a logarithmic range; on a linear one it is one like others."""
    bounds = [Bound("k", 0.1, 10.0, "log", ""), *(Bound(n, -1.0, 1.0, "linear", "") for n in "abc")]
    problem, first = SimpleNamespace(bounds=bounds), np.full(4, 0.7)
    gains = {"k": 0.0, "a": -0.5, "b": 3.0}
    np.testing.assert_allclose(default._at(problem, first, gains), [0.7, 0.25, 1.0, 0.7])
    np.testing.assert_allclose(default._at(problem, first, {"k": 1.0})[0], 0.5)


@pytest.mark.parametrize(
    ("feasible", "least", "confirmed", "steps", "lost", "status"),
    [
        (True, False, True, False, (), "converged"),
        (True, True, False, False, (), "not_converged"),
        (True, False, True, True, (), "not_converged"),
        (True, False, True, False, ("output 1",), "not_converged"),
        (False, True, True, False, (), "infeasible"),
        (False, False, True, False, (), "not_converged"),
    ],
)
def test_a_search_has_converged_only_with_limits_slopes_and_setpoints(
    feasible, least, confirmed, steps, lost, status
):
    """Limits hold; nothing better was found; the cost has no steps; every setpoint is followed."""
    search = search_of(Bowl(weights=[0.0, 0.0] if steps else [1.0, 1.0]))
    solution = solve.Solution(search=search, least=least, confirmed=confirmed)
    assert solution.status(feasible, lost) == status
    solution.interrupted = True
    assert solution.status(feasible, lost) == "interrupted"
    assert solve.Solution(confirmed=True).status(feasible) == "not_converged"


@pytest.mark.parametrize("cost", [2.0, -2.0])
@pytest.mark.parametrize(
    ("above", "violation", "converged", "agree"),
    [
        ([0.0, 0.0009], 0.0, True, True),
        ([0.0, 0.0011], 0.0, True, False),
        ([0.0, 0.0009], 0.1, True, False),
        ([0.0, 0.0009], 0.0, False, False),
        ([0.0011, 0.0, 0.0009], 0.0, True, True),
    ],
)
def test_searches_agree_where_two_end_within_a_share_of_the_best_cost(
    cost, above, violation, converged, agree
):
    search = search_of(Bowl())
    search.best = search.best._replace(cost=cost)
    stages = solve.Stages(search.evaluator, PLAN, lambda search: None)
    stages.search = search
    ends = [{"cost": cost + share * abs(cost), "violation": 0.0} for share in above]
    ends[-1]["violation"] = violation
    stages.solution.starts = [end | {"converged": False} for end in ends]
    assert not stages.agreed
    stages.solution.starts[-1]["converged"] = converged
    assert stages.agreed == agree


@pytest.mark.parametrize(
    ("costs", "violations", "lower"),
    [
        ((1.0, 1.00005), (0.0, 0.0), False),
        ((1.0, 1.0002), (0.0, 0.0), True),
        ((-1.0002, -1.0), (0.0, 0.0), True),
        ((-1.00005, -1.0), (0.0, 0.0), False),
        ((1.0, 2.0), (0.1, 0.0), False),
        ((2.0, 1.0), (0.1, 0.2), True),
        ((1.0, 1.00005), (0.1, 0.1), True),
    ],
)
def test_a_point_is_lower_by_more_than_the_cost_is_known_to(costs, violations, lower):
    """Violations decide first; where limits hold, a cost must be lower by a share of 1e-4."""
    evaluator = Bowl(lambda z: [0.0], [1.0])
    stages = solve.Stages(evaluator, PLAN, lambda search: None)
    stages.search = search_of(evaluator)
    point, other = (
        stages.search.best._replace(cost=cost, margins=np.array([-violation]))
        for cost, violation in zip(costs, violations)
    )
    assert stages.is_lower(point, other) == lower


@pytest.mark.parametrize(
    ("outside", "slope", "moves"),
    [(0.34, 0.0, True), (0.36, 0.0, False), (0.34, -1.0, False), (0.2003, 0.0, False)],
)
def test_a_search_approaches_a_limit_without_slopes_by_halving(outside, slope, moves):
    """From a = 0.2 to a <= 0.25, towards a cheaper point that violates it by less than 0.1; a cost
    that is lower by less than a share of 1e-4 is not sought.
    """
    evaluator = Bowl(lambda z: [0.25 - z[0] if abs(z[0] - 0.2003) > 1e-6 else -0.05], [1.0])
    search = search_of(evaluator, (0.2, 0.6))
    search.best = search.best._replace(margin_slopes=np.array([[slope, 0.0]]))
    search.point(np.array([outside, 0.6]))
    methods.approach(search)
    nearest = 0.25 - (outside - 0.2) / 2**methods.HALVINGS if moves else 0.2
    assert nearest <= search.best.z[0] <= (0.25 if moves else 0.2)
