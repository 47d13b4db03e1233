"""Stages of a search on costs and limits with a closed form."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest

from jaxtank.bounds import Bound
from tuning.problem.problem import Point
from tuning.problem.slopes import SlopeCheck
from tuning.search import diagnostics, methods, small_changes, solve
from tuning.search.driver import Search, optimality
from tuning.search.screening import Population, best_screened

CENTRE = np.array([0.3, 0.6])
PLAN = solve.Plan(method="slsqp", starts=1, screening=8, iterations=1, seed=0)


class Bowl:
    """An Evaluator of 1 + sum of `weights` (z - CENTRE)^2, and of `margins` (z), with `slopes` or
    without any.
    """

    def __init__(self, margins=lambda z: [], scales=(), weights=(1.0, 1.0), slopes=None):
        self.slopes = np.zeros((len(scales), 2)) if slopes is None else np.array(slopes)
        self.margins, self.weights, self.simulations = margins, np.array(weights), 0
        self.problem = SimpleNamespace(
            bounds=[Bound(name, 0.0, 1.0, "linear", "") for name in "ab"], names=["a", "b"],
            limits=[SimpleNamespace(label=f"limit {i}", value=1.0) for i in range(len(scales))],
            limit_scales=np.array(scales), runs=[0], clock=SimpleNamespace(samples=10),
            objective={}, model="", risk="mean",
            values=lambda z: dict(zip("ab", np.asarray(z).tolist())),
        )  # fmt: skip

    def point(self, z):
        away, margins = z - CENTRE, np.array(self.margins(z), dtype=float)
        cost, gradient = 1.0 + float(self.weights @ away**2), 2 * self.weights * away
        runs = np.array([cost]), gradient[None]
        return Point(z, cost, gradient, np.eye(2), margins, self.slopes, (), *runs)

    def screen(self, zs, coarse=False):
        points = [self.point(z) for z in np.asarray(zs)]
        return np.array([p.cost for p in points]), np.array([p.margins for p in points])


def search_of(evaluator, z=(0.5, 0.5)):
    search = Search(evaluator, evaluator.point(np.array(z)))
    search.take(search.reference)
    return search


def test_starts_are_ranked_by_cost_and_violation_as_shares(monkeypatch):
    """The second limit is violated by 20 of its scale of 100: 2 costs of the start are added."""
    arguments = []

    def rank(zs, merits, count, first):
        arguments.extend([zs, merits])
        raise KeyboardInterrupt

    monkeypatch.setattr(solve, "distinct_starts", rank)
    bowl = Bowl(lambda z: [0.5, -20.0], [1.0, 100.0])
    solution = solve.solve(bowl, np.array([0.5, 0.5]), PLAN, None)
    zs, merits = arguments
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


@pytest.mark.parametrize("weight", [1.0, -1.0])
@pytest.mark.parametrize("a", [0.0, 1.0])
def test_a_slope_towards_a_bound_is_no_reason_to_search_on(a, weight):
    """The cost falls into the range from both ends of a, or towards both."""
    evaluator = Bowl(weights=[weight, 1.0])
    search = search_of(evaluator, (0.5, 0.6))
    point = evaluator.point(np.array([a, 0.6]))
    gradient = 2 * abs(a - 0.3) / (1.0 + 0.04 * weight)
    norm, residual, multipliers = optimality(search, point)
    assert norm == pytest.approx(gradient) and not len(multipliers)
    assert residual == pytest.approx(gradient if weight > 0 else 0.0)
    inner = evaluator.point(np.array([0.4, 0.6]))
    assert optimality(search, inner)[1] == pytest.approx(0.2 / (1.0 + 0.04 * weight))


@pytest.mark.parametrize(("a", "begins"), [(0.29, True), (0.31, False)])
def test_a_better_screened_point_is_searched_from_where_limits_hold(a, begins):
    """Limits a <= 0.3 and b <= 0.7; the best so far is (0.2, 0.6)."""
    evaluator = Bowl(lambda z: [0.3 - z[0], 0.7 - z[1]], [1.0, 1.0])
    search = search_of(evaluator, (0.2, 0.6))
    zs = np.array([[0.1, 0.6], [a, 0.6]])
    start = best_screened(search, Population(zs, *evaluator.screen(zs)))
    assert (start is not None) == begins and (not begins or start.tolist() == [a, 0.6])


def test_a_screened_point_that_is_known_or_breaks_a_limit_is_not_run():
    """The coarse step of the screening has the best point cheaper than it is."""
    evaluator = Bowl(lambda z: [0.3 - z[0]], [1.0])
    search = search_of(evaluator, (0.2, 0.6))
    zs = np.array([[0.2, 0.6], [0.31, 0.6]])
    costs, margins = evaluator.screen(zs)
    assert best_screened(search, Population(zs, costs - 0.1, margins)) is None
    assert len(search.history) == 1


def test_an_active_limit_that_blocks_the_slope_has_a_multiplier():
    """Cost (a - 0.3)^2 + ... at (0.5, 0.6), a >= 0.5 and a >= 0.1; the cost there is 1.04."""
    evaluator = Bowl(lambda z: [z[0] - 0.5, z[0] - 0.1], [1.0, 1.0])
    search = search_of(evaluator, (0.5, 0.6))
    at_limit = search.best._replace(margin_slopes=np.array([[1.0, 0.0], [1.0, 0.0]]))
    norm, residual, multipliers = optimality(search, at_limit)
    assert norm == pytest.approx(0.4 / 1.04) and residual == pytest.approx(0.0, abs=1e-9)
    np.testing.assert_allclose(multipliers, [0.4 / 1.04, 0.0])
    outward = at_limit._replace(margin_slopes=np.array([[-1.0, 0.0], [1.0, 0.0]]))
    assert optimality(search, outward)[1] == pytest.approx(0.4 / 1.04)


@pytest.mark.parametrize(
    ("ceiling", "gap", "count"),
    [
        (1.01, (2.0, 2.0), 5),  # 0.1 away: between 5 and 6 of 33 parts of 0.6
        (9.0, (2.0, 2.0), 32),
        (9.0, (0.5, 0.6), 10),  # 11 of 33 parts are 0.2
        (9.0, (0.301, 0.85), 0),
    ],
)
def test_a_gain_moves_back_up_to_the_first_value_that_costs_too_much_or_breaks_a_limit(
    ceiling, gap, count
):
    """From a = 0.3, the best, towards 0.9, with 32 values between; a limit is violated in a gap."""
    low, high = gap
    evaluator = Bowl(lambda z: [-1.0 if low - 1e-9 <= z[0] <= high else 1.0], [1.0])
    search = search_of(evaluator, CENTRE)
    good = lambda point: point.cost <= ceiling and search.violation(point) == 0.0
    towards = small_changes._towards
    z = towards(search, 0, np.array([0.9, 0.1]), CENTRE, ceiling, 0.0, good)
    np.testing.assert_allclose(z, [0.3 + 0.6 * count / 33, 0.6])
    assert len(search.history) == 1 + (count > 0)


def test_gains_that_all_stay_are_not_searched():
    evaluator = Bowl()
    search, first = search_of(evaluator), np.array([0.1, 0.2])
    z = small_changes._without(search, np.array([True, True]), first, CENTRE, 10, 9.0)
    assert z.tolist() == first.tolist() and len(search.history) == 1
    z = small_changes._without(search, np.array([True, False]), first, first, 10, 9.0)
    np.testing.assert_allclose(z, [0.1, 0.6], atol=1e-3)


@pytest.mark.parametrize("ceiling, ends", [(1.03, True), (1.05, False)])
def test_a_search_of_some_gains_ends_where_it_cannot_come_down_to_its_cost(ceiling, ends):
    """With a = 0.1, 0.2 off, the cost is 1.04 at least; the model is that of the bowl."""
    evaluator = Bowl()
    evaluator.problem.model = "cost"
    search, first = search_of(evaluator), np.array([0.1, 0.61])
    z = small_changes._without(search, np.array([True, False]), first, first, 40, ceiling)
    if ends:
        assert z is None and len(search.history) == 3  # two points with that gain
    else:
        assert z[0] == 0.1 and search.point(z).cost <= 1.0402


@pytest.mark.parametrize("limit", [1.0, 0.1, -0.5])
def test_a_search_from_screening_to_curvature(limit, monkeypatch):
    """The limit a <= 1, 0.1 (active) or -0.5 (which no point keeps): the answer is known."""
    evaluator = Bowl(lambda z: [limit - z[0]], [1.0], slopes=[[-1.0, 0.0]])
    cost = lambda values: evaluator.point(np.array([*values.values()])).cost
    table = lambda problem, values: [{"rms_error_total": np.array(cost(values))}]
    monkeypatch.setattr(diagnostics, "table_of", table)
    plan = dataclasses.replace(PLAN, starts=2, iterations=40)
    solution = solve.solve(evaluator, np.array([0.05, 0.5]), plan, None)
    answer = [max(0.0, min(0.3, limit)), 0.6]
    np.testing.assert_allclose(solution.best.z, answer, atol=1e-4 if limit > 0 else 1)
    assert solution.best.z[0] == pytest.approx(answer[0], abs=1e-4)
    feasible = limit > 0.0
    assert solution.status(feasible) == ("converged" if feasible else "infeasible")
    assert solution.least == (not feasible) and (solution.curvature is not None) == feasible
    if feasible:  # an active limit leaves the direction of b
        values = solution.curvature["eigenvalues"]
        scale = 1.0 + 0.25**2 + 0.1**2
        np.testing.assert_allclose(values, [2.0 / scale] * (1 + (limit > 0.3)), rtol=1e-6)


@pytest.mark.parametrize("a", [1.0, 1.0 + 2.0**-52])
def test_a_start_at_the_end_of_a_range_is_there_whatever_the_rounding(a):
    """The best of a is its upper end, and runs beside it contradict the slope."""
    evaluator = Bowl(weights=[-1.0, 1.0])
    stages = solve.Stages(evaluator, PLAN, lambda search: None)
    search = stages.search = search_of(evaluator, (0.5, 0.6))
    end = search.point(np.array([1.0, 0.6])).z
    search.slopes[end.tobytes()] = SlopeCheck(False, (0.0,), 3.0)
    stages.local_search(np.array([a, 0.6]))
    (start,) = stages.solution.starts
    assert start["to"] == {"a": 1.0, "b": 0.6}
    assert start["slope_usable"] is False and start["converged"] is False


@pytest.mark.parametrize(
    ("ratio", "runs", "steps"),
    [(1.05, 1, [True]), (1.2, 1, [True, False]), (0.8, 1, [True, False]), (1.2, 2, [True])],
)
@pytest.mark.parametrize("lower", [0.0, 0.01])
def test_an_evolution_on_coarse_runs_is_done_again_where_they_mislead(
    ratio, runs, steps, lower, monkeypatch
):
    """By more than a tenth of the cost; a point that it has `lower` by this share is returned."""
    evaluator = Bowl()
    evaluator.problem.runs = [0] * runs
    stages = solve.Stages(evaluator, PLAN, lambda search: None)
    search = stages.search = search_of(evaluator, CENTRE)
    stages.screened = Population(CENTRE[None], *evaluator.screen(CENTRE[None]))
    calls = []

    def evolve(search, zs, generations, seed, coarse=True):
        calls.append(coarse)
        first = Population(zs, *evaluator.screen(zs))
        first = first._replace(costs=first.costs * (ratio if coarse else 1.0))
        costs = np.where(np.arange(len(zs)) == 1, first.costs[0] * (1.0 - lower), 99.0)
        return first._replace(costs=costs), first

    monkeypatch.setattr(solve, "evolve", evolve)
    z = stages.evolved(0)
    assert calls == steps and np.array_equal(search.history[0][3], CENTRE)
    assert (z is not None) == (lower > 0.0) == bool(stages.solution.probe["searches"])


@pytest.mark.parametrize(
    ("method", "tolerance", "a", "expected"),
    [
        ("adam", None, 0.3001, []),
        ("slsqp", None, 0.3001, [solve.POLISHED]),
        ("slsqp", 1e-4, 0.3001, []),
        ("slsqp", 1e-4, 0.5, [None] * solve.RENEWED),
    ],
)
@pytest.mark.parametrize("done", [True, False])
def test_a_last_search_goes_on_to_rounding_unless_a_tolerance_is_stated(
    method, tolerance, a, expected, done, monkeypatch
):
    """With a tolerance an optimum is one, and is sought again where there is a slope."""
    tolerances = []
    record = lambda search, z, iterations, tolerance=None: tolerances.append(tolerance) or done
    monkeypatch.setattr(solve, "slsqp", record)
    plan = dataclasses.replace(PLAN, method=method, tolerance=tolerance)
    stages = solve.Stages(Bowl(), plan, lambda search: None)
    stages.search = search_of(stages.evaluator, (a, 0.6))
    stages.solution.starts = [{"converged": True}]
    ended = stages.last_search()
    assert tolerances == expected
    polished, optimal = solve.POLISHED in expected, tolerance is not None and a < 0.5
    assert ended == (done if polished else optimal)
