"""The search on problems with a closed form: solvers, stages, what "converged" needs, curvature."""

import numpy as np
import pytest
from analytic import Analytic, bowl

import tuning
from tuning.problem.problem import ROOT
from tuning.problem.slopes import check_slope
from tuning.search import diagnostics, methods
from tuning.search.driver import Search, downhill, optimality
from tuning.search.methods import METHODS, slsqp
from tuning.search.screening import Population, best_screened, distinct_starts, evolve, sobol
from tuning.search.small_changes import WORTH, Subspace, stay_put
from tuning.search.solve import Plan, Stages, solve


@pytest.fixture(autouse=True)
def tables_of_closed_forms(monkeypatch):
    """The only measure of a closed form is its cost."""
    table = lambda problem, values: [{ROOT: problem.point(list(values.values())).cost}]
    monkeypatch.setattr(diagnostics, "table_of", table)


def searched(problem, z):
    return Search(problem, problem.point(np.array(z)))


def plan(**changes):
    usual = dict(method="slsqp", starts=1, screening=1, iterations=60, seed=0)
    return Plan(**{**usual, **changes})


# solvers


def limited_bowl(z):
    """(z1 - 0.7)^2 + 4 (z2 - 0.2)^2 + 0.1; NaN in a corner."""
    g = np.array([2 * (z[0] - 0.7), 8 * (z[1] - 0.2)])
    cost = (z[0] - 0.7) ** 2 + 4 * (z[1] - 0.2) ** 2 + 0.1
    return (np.nan, g * np.nan) if min(z) > 0.8 else (cost, g, np.diag([2.0, 8.0]))


BOWL = Analytic(limited_bowl, lambda z: (0.5 - z[0], [-1.0, 0.0]))
"""Under z1 <= 0.5: optimum (0.5, 0.2), multiplier 0.4."""


@pytest.mark.slow_for("start1-lbfgs", "start1-adam", "start0-lbfgs")
@pytest.mark.parametrize("method", ["slsqp", "lbfgs", "adam"])
@pytest.mark.parametrize("start", [(0.1, 0.9), (0.9, 0.1)])
def test_methods_on_a_bowl_with_a_known_answer(method, start):
    search = searched(BOWL, start)
    METHODS[method](search, np.array(start), 200)
    np.testing.assert_allclose(search.best.z, (0.5, 0.2), atol=5e-3)
    assert search.violation(search.best) == 0.0


def test_multipliers_of_a_bowl():
    search = searched(BOWL, (0.5, 0.2))
    norm, residual, multipliers = optimality(search, search.reference)
    exact = (0.4 / search.scale, 0.0, 0.4 / search.scale)
    np.testing.assert_allclose((norm, residual, multipliers[0]), exact, atol=1e-12)


def test_points_that_are_not_finite_are_shrunk_away_from():
    search = searched(BOWL, (0.79, 0.79))
    assert not BOWL.point(np.array([0.95, 0.95])).finite
    METHODS["slsqp"](search, np.array([0.95, 0.95]), 100)
    np.testing.assert_allclose(search.best.z, (0.5, 0.2), atol=1e-3)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("model", ["square", "cost"])
@pytest.mark.parametrize("start", [(0.9, 0.1), (0.5, 0.5)])
def test_trf_ends_at_an_objective_of_exactly_zero(model, start):
    """Sum of squares of two residuals, or its root, whose slope does not exist at the answer."""
    jacobian = np.array([[1.0, 0.0], [2.0, 3.0]])

    def cost(z):
        residual = jacobian @ (z - 0.5)
        square, slope = residual @ residual, 2 * jacobian.T @ residual
        if model == "square":
            slope = slope / (2 * np.sqrt(square)) if square > 0 else np.zeros(2)
            square = np.sqrt(square)
        return square, slope, 2 * jacobian.T @ jacobian

    problem = Analytic(cost, model=model)
    problem.objective = {ROOT: 1.0}
    search = searched(problem, (0.9, 0.1))
    assert METHODS["trf"](search, np.array(start), 60)
    assert search.best.cost <= 1e-12 * search.reference.cost
    np.testing.assert_allclose(search.best.z, (0.5, 0.5), atol=1e-6)
    # the point itself, where value, slope and every residual of the model are 0
    assert any(point.cost == 0.0 for point in search.memory.values()) == (start == (0.5, 0.5))


def quadratic(H, c, a=(), b=(), names=("k", "l")):
    """1 + (z - c)' H (z - c) / 2 under a z <= b, of parameters on a logarithmic scale."""
    H, c, b = np.array(H), np.array(c), np.array(b)
    a = np.array(a).reshape(-1, len(c))
    cost = lambda z: (1 + 0.5 * (z - c) @ H @ (z - c), H @ (z - c), H)
    margins = (lambda z: (b - a @ z, -a)) if len(b) else None
    problem = Analytic(cost, margins, names=names, model="cost")
    problem.bounds = [tuning.Bound(n, 0.01, 100.0, "log", "1/s") for n in names]
    return problem


@pytest.mark.parametrize("method", ["trf", "coarse-trf", "trf-slsqp"])
def test_trf_on_a_quadratic_is_one_step_from_its_answer(method):
    search = searched(quadratic([[4.0, -1.9], [-1.9, 1.0]], [0.4, 0.7]), (0.2, 0.2))
    assert METHODS[method](search, np.array([0.2, 0.2]), 20)
    np.testing.assert_allclose(search.best.z, (0.4, 0.7), atol=1e-5)
    assert len(search.history) < 12


def test_the_least_violation_of_limits_that_exclude_each_other():
    """z1 <= 0.3 and z1 >= 0.7 (and z2 free): no point does better than to miss both by 0.2."""
    problem = quadratic(np.eye(2), [0.1, 0.2], a=[[1.0, 0.0], [-1.0, 0.0]], b=[0.3, -0.7])
    search = searched(problem, (0.1, 0.2))
    search.take(search.reference)
    methods.restore(search, np.array([0.1, 0.2]), 50)
    assert search.violation(search.best) == pytest.approx(0.2, abs=1e-5)


def valley(lowest=0.0):
    """|z1 - 0.6| + (z2 - 0.3)^2 under z2 >= lowest: a kink along z1 = 0.6."""

    def cost(z):
        side = 1.0 if z[0] >= 0.6 else -1.0
        return abs(z[0] - 0.6) + (z[1] - 0.3) ** 2 + 1.0, [side, 2 * (z[1] - 0.3)]

    return Analytic(cost, lambda z: (z[1] - lowest, [0.0, 1.0]))


def test_a_kink_is_told_from_a_slope_that_goes_on():
    def lower(problem, z):
        search = searched(problem, (0.1, 0.9))
        return downhill(search, search.point(np.array(z)))

    assert lower(valley(), (0.6, 0.3)) is None  # its slope is 1, and nothing is lower
    assert lower(valley(), (0.8, 0.3)).cost < 1.2 * (1 - 1e-4)
    assert lower(valley(0.5), (0.6, 0.5)) is None  # held up by the limit and the kink together
    assert lower(valley(0.5), (0.4, 0.5)).margins[0] >= 0.0


def test_slsqp_on_the_kink_is_no_false_success():
    search = searched(valley(), (0.1, 0.9))
    slsqp(search, np.array([0.1, 0.9]), 60)
    assert search.best.cost < 1.0 + 1e-3


# screening


def test_starts_are_distinct_and_the_first_is_the_given_one():
    zs = sobol(64, 2, 1)
    assert np.array_equal(zs, sobol(64, 2, 1)) and not np.array_equal(zs, sobol(64, 2, 2))
    merits = np.sum((zs - 0.3) ** 2, axis=1)
    merits[5] = np.nan
    taken = distinct_starts(zs, merits, 8, np.array([0.3, 0.3]))
    assert len(taken) == 8 and np.array_equal(taken[0], (0.3, 0.3))
    assert not any(np.array_equal(t, zs[5]) for t in taken)
    gaps = [np.linalg.norm(a - b) for i, a in enumerate(taken) for b in taken[:i]]
    assert min(gaps) > 0.05


def test_every_point_that_the_coarse_step_rates_better_is_run_at_the_true_one():
    """Five are rated too low, and the sixth is the one that is better."""
    true = np.array([1.5, 1.4, 1.3, 1.2, 1.1, 0.4, 2.0])
    zs = np.stack([np.linspace(0.1, 0.7, 7), np.full(7, 0.5)], axis=1)
    cost = lambda z: (float(np.interp(z[0], zs[:, 0], true)), np.ones(2))
    search = searched(Analytic(cost), (0.72, 0.5))
    search.point(np.array([0.3, 0.9]))  # 1.3
    search.point(np.array([0.54, 0.5]))  # 0.82
    coarse = Population(zs, np.array([0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.9]), np.zeros((7, 0)))
    assert best_screened(search, coarse)[0] == pytest.approx(0.6)
    assert search.best.cost == pytest.approx(0.4)
    assert best_screened(search, coarse) is None


def test_differential_evolution_finds_the_lowest_of_many_minima():
    """Rastrigin's function: 0 at (0.3, 0.6), and a minimum in each square of 0.1 of the rest."""

    def rastrigin(z):
        apart = np.asarray(z) - (0.3, 0.6)
        wave = 1.0 - np.cos(20 * np.pi * apart)
        return float(100 * apart @ apart + wave.sum()), np.zeros(2)

    search = searched(Analytic(rastrigin), (1.0, 1.0))
    now, first = evolve(search, sobol(64, 2, seed=1), 60, seed=1)
    assert first.costs.min() > 0.1 and now.costs.min() < 1e-3
    np.testing.assert_allclose(now.zs[np.argmin(now.costs)], (0.3, 0.6), atol=2e-3)


# all stages


def two_bowls(z):
    """A wide bowl of least value 1, and a narrow one, of 2 % of the square, of 0.5."""
    wide, narrow = bowl(z, (0.3, 0.3), 1.0), bowl(z, (0.85, 0.8), 0.0)
    deep = (0.5 + 60.0 * narrow[0], 60.0 * narrow[1])
    return deep if deep[0] < wide[0] else wide


@pytest.mark.parametrize("seed", range(3))
def test_one_start_leaves_a_local_minimum_that_no_screened_point_is_better_than(seed):
    solution = solve(Analytic(two_bowls), np.array([0.2, 0.4]), plan(seed=seed), None)
    assert solution.starts[0]["cost"] == pytest.approx(1.0)  # where the only start leads
    assert solution.best.cost == pytest.approx(0.5, abs=1e-9)
    np.testing.assert_allclose(solution.best.z, (0.85, 0.8), atol=1e-5)
    assert solution.confirmed and solution.probe["lower"] == 1 and solution.probe["searches"] >= 1


def test_an_interrupt_gives_the_best_point_so_far():
    events = []

    def stop(event):
        events.append(event)
        if len(events) == 3:
            raise KeyboardInterrupt

    problem = Analytic(lambda z: bowl(z, (0.3, 0.3), 1.0))
    solution = solve(problem, np.array([0.2, 0.9]), plan(), stop)
    history = solution.search.history
    assert solution.interrupted and solution.status(feasible=True) == "interrupted"
    assert len(history) == 3 and solution.best.cost == min(cost for _, cost, *_ in history)
    assert events[-1]["best"] == solution.best.cost and events[-1]["evaluations"] == 3


def test_starts_that_agree_need_no_differential_evolution():
    first = np.array([0.2, 0.4])
    one = solve(Analytic(lambda z: bowl(z, (0.3, 0.3))), first, plan(), None)
    more = plan(starts=3, screening=8)
    two = solve(Analytic(lambda z: bowl(z, (0.3, 0.3), 1.0)), first, more, None)
    assert one.probe["searches"] <= 1 and two.probe is None
    assert one.status(feasible=True) == two.status(feasible=True) == "converged"
    assert one.confirmed and two.confirmed and len(two.starts) == 2


def test_the_answer_leaves_a_neighbour_that_is_lower_behind_a_step(monkeypatch):
    """The slope is zero on either side of the step, 6 % of the range away; without evolution."""
    monkeypatch.setattr(Stages, "evolved", lambda *_: None)

    def step(z):
        return (1.0 if z[0] < 0.56 else 0.9) + bowl(z[1:], 0.5)[0], np.append(0.0, 2 * (z[1] - 0.5))

    solution = solve(Analytic(step), np.array([0.5, 0.5]), plan(), None)
    assert solution.best.cost == pytest.approx(0.9)
    feasible = [cost for _, cost, violation, _ in solution.search.history if violation == 0]
    assert min(feasible) == solution.best.cost


def test_a_small_feasible_set_that_no_slope_leads_to_is_found():
    """A margin without a slope, negative but in a disc of 1 % of the square."""
    hidden = lambda z: (0.06 - float(np.hypot(z[0] - 0.7, z[1] - 0.8)), np.zeros(2))
    problem = Analytic(lambda z: bowl(z, (0.7, 0.8), 1.0), hidden)
    solution = solve(problem, np.array([0.1, 0.1]), plan(screening=4), None)
    assert solution.search.violation(solution.best) == 0.0 and solution.best.cost < 1.0 + 0.06**2


def test_infeasible_is_said_of_the_least_violation_after_several_searches():
    """x + y >= 2.5 cannot hold in the square: the least violation is 0.5, at (1, 1)."""
    limit = lambda z: (float(z.sum()) - 2.5, np.ones(2))
    problem = Analytic(lambda z: bowl(z, (0.2, 0.2), 1.0), limit)
    solution = solve(problem, np.array([0.1, 0.1]), plan(screening=4), None)
    assert solution.status(feasible=False) == "infeasible"
    assert solution.search.violation(solution.best) == pytest.approx(0.5, abs=1e-6)
    assert problem.simulations > 16 * 16  # the derivative-free search


def test_a_start_without_usable_derivatives_is_the_answer_where_nothing_is_better():
    def steep(z):
        at_start = abs(z[0] - 0.1) + abs(z[1] - 0.1) < 1e-9
        return (0.5, np.full(2, 1e12)) if at_start else bowl(z, (0.6, 0.6), 1.0)

    solution = solve(Analytic(steep), np.array([0.1, 0.1]), plan(screening=8), None)
    assert solution.best.cost == 0.5 and solution.status(feasible=True) == "not_converged"


@pytest.mark.parametrize("worth, stays", [(0.02, True), (0.5, False)])
def test_a_gain_stays_where_a_change_is_worth_less_than_one_percent(worth, stays):
    """(z0 - 0.8)^2 + worth (z1 - 0.2)^2 + 1, start at (0.3, 0.7)."""
    w, centre = np.array([1.0, worth]), np.array([0.8, 0.2])
    cost = lambda z: (1.0 + np.sum(w * (z - centre) ** 2), 2 * w * (z - centre), 2 * np.diag(w))
    problem = Analytic(cost, model="cost", start=(0.3, 0.7))
    few = plan(method="trf", starts=4, screening=32, iterations=40, tolerance=1e-4, agree=0.01)
    stages = Stages(problem, Plan(**{**vars(few), "polish": False}), lambda search: None)
    stages.run(problem.start())
    found = stages.solution
    found.z, found.kept = stay_put(found.search, problem.start(), 40)
    assert found.confirmed and found.kept.tolist() == [False, stays]
    assert found.point.cost <= 1.0 + WORTH + 1e-12
    if stays:  # 0.02 x 0.5^2 = 0.5 %; what is left of 1 % takes the other gain towards its start
        assert found.z[1] == 0.7 and 0.7 < found.z[0] < 0.8
    else:  # as far back as 1 % in all allows
        assert found.z[0] < 0.8 and found.z[1] > 0.2 and found.point.cost > 1.005


def test_a_search_of_some_gains_has_their_slopes_alone_where_no_point_is_finite():
    outer = searched(BOWL, (0.1, 0.9))
    inner = Subspace(outer, np.array([0.1, 0.9]), np.array([0]))
    cost, gradient = inner.cost(np.array([1.0]))
    margins, slopes = inner.margins(np.array([1.0]))  # NaN: those of the last finite point
    assert cost == 10.0 and gradient.shape == (1,)
    expected, all_slopes = outer.margins(np.array([0.1, 0.9]))
    assert margins == pytest.approx(expected, abs=0.01)  # less the tightening
    assert slopes.tolist() == all_slopes[:, :1].tolist()


# curvature, and slopes that runs contradict


def curvature_of(problem, z=(0.5, 0.5)):
    search = searched(problem, z)
    return diagnostics.curvature(search, search.reference)


def test_curvature_and_the_flattest_direction():
    H = np.array([[4.0, -1.9], [-1.9, 1.0]])
    found = curvature_of(quadratic(H, [0.5, 0.5]))
    values, vectors = np.linalg.eigh(H)
    np.testing.assert_allclose(found["eigenvalues"], values, rtol=1e-6)
    first = np.array([found["directions"][0][n] for n in ("k", "l")])
    assert abs(first @ vectors[:, 0]) == pytest.approx(1.0, abs=1e-6)
    step = np.log(1.1) / np.log(1e4) / vectors[1, 0] * vectors[:, 0]
    # rounded, and run as they are said; rounding may cost 5 %
    least = found["least_sensitive"]
    printed = np.log([least["factors"][n] for n in ("k", "l")]) / np.log(1e4)
    assert least["changes_percent"] == pytest.approx(50 * printed @ H @ printed, rel=1e-9)
    assert printed @ H @ printed == pytest.approx(step @ H @ step, rel=0.05)
    assert least["factors"]["l"] == 1.1


def test_the_least_sensitive_direction_is_that_of_the_numbers():
    """Beside a steep valley, a thousandth of the other parameter is what keeps the objective where
    it is.
    """
    turn = np.array([[0.0178, 0.9998], [0.9998, -0.0178]])
    problem = quadratic(turn.T @ np.diag([2000.0, 0.01]) @ turn, [0.5, 0.5])
    problem.bounds = [
        tuning.Bound("k", 0.001, 50.0, "log", "1/s"),
        tuning.Bound("l", 0.0, 5.0, "linear", "-"),
    ]
    found = curvature_of(problem)["least_sensitive"]
    ratio, change = found["factors"].values()
    values = np.sqrt(0.001 * 50.0) * ratio, 2.5 + change
    z = np.array([b.to_unit(v) for b, v in zip(problem.bounds, values)])
    change = lambda z: 100 * (problem.point(z).cost - 1.0)
    assert change(z) == pytest.approx(found["changes_percent"], rel=1e-6)
    assert change([z[0], 0.5]) > 10 * change(z)


def test_directions_that_limits_hold_are_left_out():
    problem = quadratic([[2.0, 0.0], [0.0, 6.0]], [0.9, 0.5], a=[[1.0, 0.0]], b=[0.5])
    cost = problem.point([0.5, 0.5]).cost
    np.testing.assert_allclose(curvature_of(problem)["eigenvalues"], [6.0 / cost], rtol=1e-6)


def falsified(factor, kink=False):
    """1 + |z - 0.4|^2 (or the sum of distances) with a gradient that is `factor` times its own."""

    def cost(z):
        if kink:
            return 1.0 + np.abs(z - 0.4).sum(), factor * np.where(z >= 0.4, 1.0, -1.0)
        return 1.0 + ((z - 0.4) ** 2).sum(), factor * 2.0 * (z - 0.4)

    return Analytic(cost)


@pytest.mark.parametrize("kink", [False, True])
@pytest.mark.parametrize("z", [(0.7, 0.2), (1.0, 1.0), (0.0, 1.0), (0.4, 0.4)])
def test_a_true_slope_is_borne_out_wherever_it_is(z, kink):
    problem = falsified(1.0, kink)
    assert check_slope(problem, problem.point(z)).usable


@pytest.mark.parametrize("factor", [1e4, -1e7, np.inf, np.nan])
@pytest.mark.parametrize("z", [(0.7, 0.2), (1.0, 1.0)])
def test_a_slope_that_exceeds_every_secant_by_orders_is_of_no_use(factor, z):
    problem = falsified(factor)
    point = problem.point(z)
    check = check_slope(problem, point)
    assert not check.usable
    if np.isfinite(factor):
        along = np.sign(factor) * (point.z - 0.4) / np.linalg.norm(point.z - 0.4)
        slope = 2.0 * (point.z - 0.4) @ along
        assert check.secants == pytest.approx([slope, slope], rel=2e-3)
        assert check.orders == pytest.approx(np.log10(abs(factor)), abs=0.06)
