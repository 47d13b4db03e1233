"""No point that a search evaluated is better than its answer; what "converged" needs."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest
from helpers import RIGS

import jaxtank
import tuning
from jaxtank import rig
from jaxtank.bounds import Bound
from jaxtank.core.clock import Clock
from jaxtank.limits import Limit, resolve_limits, undefined
from jaxtank.signals.setpoints import ramps
from tuning.problem.problem import Point
from tuning.problem.reported import table_of
from tuning.search import diagnostics
from tuning.search.diagnostics import lost_outputs
from tuning.search.driver import Search
from tuning.search.screening import Population, best_screened, evolve, sobol
from tuning.search.stages import Plan, solve, status_of

CLOCK = Clock(dt=1.0, duration=10.0)


class Landscape:
    """A problem with a closed form: cost(z) and margin(z) return (value, gradient)."""

    loop = case = SimpleNamespace(symmetry=None)
    clock, model, risk, seed, runs = CLOCK, None, "mean", 0, (None,)
    names = ["a", "b"]
    bounds = tuple(Bound(name, 0.0, 1.0, "linear", "-") for name in names)
    simulations = gradients = 0

    def __init__(self, cost, margin=None):
        self.of_cost, self.of_margin = cost, margin
        self.limits = () if margin is None else (Limit("min_level", 0, 1.0),)
        self.limit_scales = np.ones(len(self.limits))

    def values(self, z):
        return dict(zip(self.names, map(float, z)))

    def point(self, z):
        z, pairs = np.array(z), [] if self.of_margin is None else [self.of_margin(z)]
        margins, slopes = np.array([m for m, _ in pairs]), np.array([s for _, s in pairs])
        cost, gradient = self.of_cost(z)
        slopes = slopes.reshape(-1, 2)
        return Point(
            z, cost, gradient, np.eye(2), margins, slopes, (), np.array([cost]), gradient[None]
        )

    def screen(self, zs, coarse=False):
        self.simulations += len(zs)
        points = [self.point(z) for z in zs]
        margins = np.array([p.margins for p in points]).reshape(len(zs), -1)
        return np.array([p.cost for p in points]), margins


@pytest.fixture(autouse=True)
def tables_of_landscapes(monkeypatch):
    """The only measure of a landscape is its cost."""

    def table(problem, values):
        if not isinstance(problem, Landscape):
            return table_of(problem, values)
        return [{"rms_error_total": problem.point(list(values.values())).cost}]

    monkeypatch.setattr(diagnostics, "table_of", table)


def bowl(z, centre, value=0.0):
    apart = np.asarray(z) - centre
    return value + float(apart @ apart), 2.0 * apart


def two_bowls(z):
    """A wide bowl of least value 1, and a narrow one, of 2 % of the square, of 0.5."""
    wide, narrow = bowl(z, (0.3, 0.3), 1.0), bowl(z, (0.85, 0.8), 0.0)
    deep = (0.5 + 60.0 * narrow[0], 60.0 * narrow[1])
    return deep if deep[0] < wide[0] else wide


def plan(**changes):
    usual = dict(method="slsqp", starts=1, screening=1, iterations=60, seed=0)
    return Plan(**{**usual, "batch": None, "tolerance": None, **changes})


@pytest.mark.parametrize("seed", range(3))
def test_one_start_leaves_a_local_minimum_that_no_screened_point_is_better_than(seed):
    found = solve(Landscape(two_bowls), np.array([0.2, 0.4]), plan(seed=seed), None)
    assert found.starts[0]["cost"] == pytest.approx(1.0)  # where the only start leads
    assert found.best.cost == pytest.approx(0.5, abs=1e-9)
    np.testing.assert_allclose(found.best.z, (0.85, 0.8), atol=1e-5)
    assert found.confirmed and found.probe["lower"] == 1 and found.probe["searches"] >= 1


def test_starts_that_agree_need_no_differential_evolution():
    first = np.array([0.2, 0.4])
    one = solve(Landscape(lambda z: bowl(z, (0.3, 0.3))), first, plan(), None)
    two = solve(
        Landscape(lambda z: bowl(z, (0.3, 0.3), 1.0)), first, plan(starts=3, screening=8), None
    )
    assert one.probe["searches"] <= 1 and two.probe is None
    assert status_of(one, feasible=True) == status_of(two, feasible=True) == "converged"
    assert one.confirmed and two.confirmed and len(two.starts) == 2


def test_the_answer_leaves_a_neighbour_that_is_lower_behind_a_step():
    """The slope is zero on either side of the step, 6 % of the range away."""

    def step(z):
        return (1.0 if z[0] < 0.56 else 0.9) + bowl(z[1:], 0.5)[0], np.append(0.0, 2 * (z[1] - 0.5))

    found = solve(Landscape(step), np.array([0.5, 0.5]), plan(starts=1), None)
    assert found.best.cost == pytest.approx(0.9)
    assert min(cost for _, cost, violation, _ in found.search.history if violation == 0) == (
        found.best.cost
    )


def test_every_point_that_the_coarse_step_rates_better_is_run_at_the_true_one():
    """Five are rated too low, and the sixth is the one that is better."""
    true = np.array([1.5, 1.4, 1.3, 1.2, 1.1, 0.4, 2.0])
    zs = np.stack([np.linspace(0.1, 0.7, 7), np.full(7, 0.5)], axis=1)

    def cost(z):
        return float(np.interp(z[0], zs[:, 0], true)), np.ones(2)

    problem = Landscape(cost)
    search = Search(problem, problem.point(np.array([0.72, 0.5])), lambda s: None)
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

    problem = Landscape(rastrigin)
    search = Search(problem, problem.point(np.ones(2)), lambda s: None)
    now, first = evolve(search, sobol(64, 2, seed=1), 60, seed=1)
    assert first.costs.min() > 0.1 and now.costs.min() < 1e-3
    np.testing.assert_allclose(now.zs[np.argmin(now.costs)], (0.3, 0.6), atol=2e-3)


def hidden(z):
    """A margin without a slope, negative but in a disc of 1 % of the square."""
    return 0.06 - float(np.hypot(z[0] - 0.7, z[1] - 0.8)), np.zeros(2)


def test_a_small_feasible_set_that_no_slope_leads_to_is_found():
    problem = Landscape(lambda z: bowl(z, (0.7, 0.8), 1.0), hidden)
    found = solve(problem, np.array([0.1, 0.1]), plan(screening=4), None)
    assert found.search.violation(found.best) == 0.0 and found.best.cost < 1.0 + 0.06**2


def test_infeasible_is_said_of_the_least_violation_after_several_searches():
    """x + y >= 2.5 cannot hold in the square: the least violation is 0.5, at (1, 1)."""
    problem = Landscape(
        lambda z: bowl(z, (0.2, 0.2), 1.0), lambda z: (float(z.sum()) - 2.5, np.ones(2))
    )
    found = solve(problem, np.array([0.1, 0.1]), plan(screening=4), None)
    assert status_of(found, feasible=False) == "infeasible"
    assert found.search.violation(found.best) == pytest.approx(0.5, abs=1e-6)
    assert problem.simulations > 16 * 16  # the derivative-free search


def test_a_start_without_usable_derivatives_is_the_answer_where_nothing_is_better():
    def steep(z):
        at_start = abs(z[0] - 0.1) + abs(z[1] - 0.1) < 1e-9
        return (0.5, np.full(2, 1e12)) if at_start else bowl(z, (0.6, 0.6), 1.0)

    found = solve(Landscape(steep), np.array([0.1, 0.1]), plan(screening=8), None)
    assert found.best.cost == 0.5 and status_of(found, feasible=True) == "not_converged"


# on rigs


@pytest.fixture(scope="module")
def watertank():
    return rig.load(RIGS / "watertank.toml")


def held(result):
    """Costs of the points of a search that keep every limit."""
    return [cost for _, cost, violation, _ in result.history if violation == 0.0]


def test_no_screened_point_is_better_at_the_true_step_where_the_coarse_one_differs(watertank):
    case = rig.set_values(watertank, {"clock.dt": 0.004})
    result = tuning.tune(case, nominal=True, starts=1, screening=16, validation=0, seed=5)
    assert result.provenance["coarse_dt_s"] == 0.04
    zs = sobol(16, 2, seed=5)
    costs, margins = result.problem.screen(zs)
    feasible = costs[np.all(margins >= 0, axis=1)]
    assert result.objective["after"] <= min(feasible, default=np.inf) + 1e-9
    assert result.objective["after"] <= min(held(result)) * (1 + 1e-9)


def test_robust_tuning_with_one_start_ends_at_or_below_all_that_it_saw(watertank):
    result = tuning.tune_robust(
        watertank,
        {"plant.pump_gain": tuning.Uniform(relative=0.05)},
        samples=4,
        fresh=4,
        starts=1,
        screening=16,
        limits={"overshoot_percent": 20.0},
    )
    assert all(c.margin >= 0 for c in result.constraints)
    assert result.objective["after"] <= min(held(result)) * (1 + 1e-9)
    assert result.objective["after"] <= result.objective["before"]
    values = {n: p["after"] for n, p in result.parameters.items()}
    z = [float(b.to_unit(values[b.name])) for b in result.problem.bounds]
    costs, margins = result.problem.screen(diagnostics.neighbours(result.problem, np.array(z)))
    feasible = costs[np.all(margins >= 0, axis=1)]
    assert result.objective["after"] <= feasible.min() * (1 + 1e-6)


def test_a_controller_that_no_longer_follows_is_not_converged(watertank):
    """The least total variation of the input is that of gains at their lower ends."""
    result = tuning.tune(
        watertank,
        nominal=True,
        objective={"input_travel": 1.0},
        limits={},
        starts=2,
        screening=4,
        validation=0,
    )
    codes = [m.code for m in result.messages]
    assert result.status == "not_converged" and "no-longer-follows" in codes
    assert "not-converged" not in codes
    (lost,) = result.lost
    case = result.tuned
    error = np.asarray(jaxtank.simulate(case.loop, case.clock).e)[:, 0]
    late = abs(error[-78:].mean())  # a tenth of the samples after the step at 1 s
    assert lost.output == 1 and lost.after == pytest.approx(late, rel=0.02) and late > 0.1
    assert lost.share == pytest.approx(lost.after) and lost.before < 0.01  # a step of 1 cm


def test_a_controller_that_follows_less_well_has_not_lost_its_setpoint(watertank):
    problem = tuning.Problem(watertank, limits={})
    own = problem.own_values()
    slow = {**own, "controller.Kc[0]": 0.8}  # settles, later
    tables = {"before": table_of(problem, own), "after": table_of(problem, slow)}
    assert lost_outputs(problem, tables, slow) == ()
    off = {**own, "controller.Kc[0]": 0.1, "controller.Ti[0]": 100.0}
    tables["after"] = table_of(problem, off)
    assert [x.output for x in lost_outputs(problem, tables, off)] == [1]
    assert lost_outputs(problem, {"before": tables["after"], "after": tables["after"]}, off) == ()


def constant(case, setpoint, start):
    loop = dataclasses.replace(
        case.loop, reference=ramps([setpoint], [], ramp=0.0), x0=np.array([start])
    )
    return case.replace(loop=loop)


@pytest.mark.parametrize("start", [1.0, 3.0])
def test_a_start_away_from_a_constant_setpoint_counts_as_a_change(watertank, start):
    """Rise, settling and overshoot against the trajectory."""
    case = constant(watertank, 2.0, start)
    names = ["rise_time", "settling_time", "overshoot_percent"]
    rise, settled, past = (jaxtank.evaluate(case.loop, case.clock, names)[n][0] for n in names)
    run = jaxtank.simulate(case.loop, case.clock)
    t, done = np.asarray(run.t), (np.asarray(run.x)[:, 0] - start) / (2.0 - start)
    assert rise == pytest.approx(t[done >= 0.9][0] - t[done >= 0.1][0])
    assert settled == pytest.approx(t[np.abs(done - 1.0) > 0.05][-1])
    assert past == pytest.approx(100 * max(done.max() - 1.0, 0.0))
    assert [x.measure for x in resolve_limits(case, {"rise_time": 5.0})] == ["rise_time"]


def test_a_start_at_a_constant_setpoint_is_no_change(watertank):
    case = constant(watertank, 2.0, 2.01)
    why, missing = undefined("rise_time", case)
    assert missing == [True] and "x0" in why
    with pytest.raises(jaxtank.InputError, match="rise_time = 5 s: undefined on this run"):
        tuning.tune(case, nominal=True, limits={"rise_time": 5.0}, starts=1)


@pytest.mark.slow
def test_an_infeasible_value_of_a_trade_off_is_the_least_violation_of_a_grid(watertank):
    """A rise time is a count of samples: no slope leads to the least violation."""
    limits = {"overshoot_percent": 5.0}
    found = tuning.tradeoff(watertank, "rise_time", [2.0, 0.05], limits=limits, screening=32)
    kept, missed = found["points"]
    assert kept["status"] == "converged" and kept["violation"] == 0.0
    problem = tuning.Problem(watertank, limits={**limits, "rise_time": 0.05})
    axis = np.linspace(0.0, 1.0, 31)
    _, margins = problem.screen(np.stack([v.ravel() for v in np.meshgrid(axis, axis)], axis=1))
    least = np.maximum(0.0, -margins / problem.limit_scales).max(axis=1).min()
    assert missed["status"] == "infeasible" and 0.0 < missed["violation"] <= least
