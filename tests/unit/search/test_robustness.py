"""The last step of the default answer: gains whose loop is fragile are moved back."""

from types import SimpleNamespace

import numpy as np
import pytest
from helpers import ONE_TANK

from jaxtank import rig
from tuning.problem.evaluator import Evaluator
from tuning.problem.problem import Problem
from tuning.search import messages, robustness
from tuning.search.driver import Search
from tuning.search.methods import METHODS, automatic
from tuning.search.setting import setting_of
from tuning.search.small_changes import LINE
from tuning.search.solve import Solution


def stated(values):
    """(setting, problem, search) of one tank with a slow pump, on its nominal plant."""
    case = rig.set_values(rig.loads(ONE_TANK), {"actuator.delay": 0.5, **values})
    setting = setting_of(case, {"rms_error_total": 1.0})
    problem = Problem(setting.searched, None, setting.objective, {}, None, 0)
    reference = problem.point(problem.start())
    search = Search(Evaluator(problem), reference, tolerance=1e-4)
    search.take(reference)
    return setting, problem, search


@pytest.fixture(scope="module")
def answered():
    return stated({})


def solution_at(problem, search, Kc):
    """The outcome of a search that ended at a gain Kc."""
    low, high = problem.case.free["controller.Kc"][:2]
    z = np.array([np.log(Kc / low) / np.log(high / low), problem.start()[1]])
    search.take(search.point(z))
    return Solution(search=search, z=z, kept=np.array([False, True]))


def fragility_of(Ms, Mt):
    return max(Ms, 1.4 / 1.25 * Mt)


def peak(setting, problem, z):
    """The fragility as its definition has it."""
    case = setting.tuned(problem.values(z))
    margins = robustness.margin_measures(case.loop, case.clock)
    return float(fragility_of(margins["sensitivity_peak"], margins["complementary_peak"]))


@pytest.mark.extended
def test_a_fragile_answer_moves_back_as_far_as_its_sensitivity_peak_asks(answered, monkeypatch):
    setting, problem, search = answered
    first = problem.start()
    solution = solution_at(problem, search, 8.0)
    before = solution.z
    monkeypatch.setattr(robustness, "PRICE", 1.0)
    monkeypatch.setattr(robustness, "FRAGILITY_GOAL", np.inf)
    allowed = max(robustness.FRAGILITY_LIMIT, peak(setting, problem, first))
    assert peak(setting, problem, before) > allowed == 2.0
    robustness.make_robust(setting, solution)
    assert peak(setting, problem, solution.z) <= allowed
    assert peak(setting, problem, solution.z - (first - before) / LINE) > allowed
    assert solution.kept.tolist() == [False, True]


def test_an_interrupted_search_gives_the_best_robust_gains_it_has_seen():
    setting, problem, search = stated({})
    for Kc in 1.0, 2.5, 3.0, 8.0:
        solution = solution_at(problem, search, Kc)
    seen = list(search.memory.values())
    robust = [p for p in seen if peak(setting, problem, p.z) <= 2.0]
    assert peak(setting, problem, solution.z) > 2.0 and 1 < len(robust) < len(seen)
    robustness.prefer_robust(setting, solution)
    assert solution.point.cost == min(p.cost for p in robust)


def test_tuned_again_the_answer_stays(answered, monkeypatch):
    """The first values are an earlier answer, a little below the peak that is allowed."""
    _, problem, search = answered
    monkeypatch.setattr(robustness, "PRICE", 1.0)
    earlier = problem.values(solution_at(problem, search, 4.6).z)["controller.Kc[0]"]
    again, problem, search = stated({"controller.Kc": [earlier]})
    solution = solution_at(problem, search, 8.0)
    robustness.make_robust(again, solution)
    assert np.array_equal(solution.z, problem.start()) and solution.kept.all()


def test_a_fragile_answer_moves_back_where_that_costs_least(monkeypatch):
    """The straight line to slow gains, on a ramp, gives up much of what the search has gained."""
    slow = {"reference.ramp": 10.0, "controller.Kc": [0.2], "controller.Ti": [50.0]}
    setting, problem, search = stated(slow)
    METHODS[automatic(problem)](search, problem.start(), 40)
    best = search.best.z

    def moved():
        solution = Solution(search=search, z=best.copy(), kept=np.zeros(2, dtype=bool))
        robustness.make_robust(setting, solution)
        assert (
            peak(setting, problem, solution.z)
            <= robustness.FRAGILITY_LIMIT
            < peak(setting, problem, best)
        )
        return search.point(solution.z)

    answer = moved()
    monkeypatch.setattr(robustness._RobustGains, "cheapest", lambda *_: None)
    straight = moved()
    assert answer.cost < 0.9 * straight.cost
    again = problem.values(answer.z)
    setting, problem, search = stated(slow | {n: [again[f"{n}[0]"]] for n in list(slow)[1:]})
    solution = Solution(search=search, z=best.copy(), kept=np.zeros(2, dtype=bool))
    robustness.make_robust(setting, solution)
    assert np.array_equal(solution.z, problem.start())
    # no point of a grid around it with as low a peak costs less
    near = [np.array(z) for z in np.ndindex(5, 5)]
    near = [np.clip(answer.z + 0.02 * (z - 2.0), 0.0, 1.0) for z in near]
    calm = [z for z in near if peak(setting, problem, z) <= robustness.FRAGILITY_LIMIT]
    assert all(search.point(z).cost > 0.99 * answer.cost for z in calm)


def test_an_answer_that_is_robust_enough_stays(answered, monkeypatch):
    setting, problem, search = answered
    monkeypatch.setattr(robustness, "FRAGILITY_GOAL", 2.0)
    solution = solution_at(problem, search, 4.0)
    before = solution.z
    robustness.make_robust(setting, solution)
    assert solution.z is before


def test_a_fragile_answer_moves_back_at_any_cost_below_that_of_the_first_gains(
    answered, monkeypatch
):
    setting, problem, search = answered
    solution = solution_at(problem, search, 8.0)
    before, first = solution.z, problem.start()
    monkeypatch.setattr(robustness, "PRICE", 0.0)
    robustness.make_robust(setting, solution)
    assert (
        peak(setting, problem, solution.z)
        <= robustness.FRAGILITY_LIMIT
        < peak(setting, problem, before)
    )
    assert search.point(solution.z).cost <= search.point(first).cost


@pytest.mark.parametrize(
    "before, after, noted", [(0.0007, 0.0078, False), (0.002, 0.03, True), (0.01, 0.05, False)]
)
def test_a_growth_of_the_changes_of_inputs_is_noted_where_it_is_felt(before, after, noted):
    of = lambda travel: SimpleNamespace(travel=np.array([travel]), failed=np.array([False]))
    result = SimpleNamespace(answer=SimpleNamespace(before=of(before), after=of(after)))
    codes = [message.code for message in messages._busier(result)]
    assert codes == ["input-total-variation"] * noted


def test_a_move_back_is_noted_with_the_peak_that_it_left():
    after = {"sensitivity_peak": 1.9, "complementary_peak": 1.2}
    of = lambda peaks: SimpleNamespace(
        answer=SimpleNamespace(least_cost_peaks=peaks), measures={"after": after}
    )
    texts = lambda peaks: list(messages._moved_back(of(peaks)))
    assert texts(None) == texts((1.901, 1.2)) == []  # other gains, as robust
    (text,) = texts((2.934, 1.851))
    assert "Ms 2.93 and Mt 1.85" in text
    (text,) = texts((np.inf, np.inf))  # of an unstable loop
    assert " inf" not in text


def test_moving_back_says_what_peak_the_cheapest_gains_have(answered, monkeypatch):
    setting, problem, search = answered
    monkeypatch.setattr(robustness, "PRICE", 1.0)
    monkeypatch.setattr(robustness, "FRAGILITY_GOAL", robustness.FRAGILITY_LIMIT)
    solution = solution_at(problem, search, 8.0)
    least = peak(setting, problem, search.best.z)
    robustness.make_robust(setting, solution)
    assert fragility_of(*solution.least_cost_peaks) == pytest.approx(least)
    calm = solution_at(problem, search, 4.0)
    robustness.make_robust(setting, calm)
    assert calm.least_cost_peaks is None


def test_an_answer_that_is_robust_enough_is_calmed_while_that_is_cheap(answered, monkeypatch):
    setting, problem, search = answered
    first = problem.start()
    monkeypatch.setattr(robustness, "FRAGILITY_GOAL", 1.1)
    before = solution_at(problem, search, 4.0)
    start = peak(setting, problem, before.z)
    assert 1.4 < start < robustness.FRAGILITY_LIMIT
    ceiling = search.best.cost * (1.0 + robustness.PRICE)
    assert search.point(before.z).cost <= ceiling
    robustness.make_robust(setting, before)
    lower = peak(setting, problem, before.z)
    assert lower < start - 0.02 and search.point(before.z).cost <= ceiling
    least = peak(setting, problem, search.best.z)
    assert fragility_of(*before.least_cost_peaks) == pytest.approx(least)
    assert before.kept.tolist() == (before.z == first).tolist()
    # tuned again from there, it stays
    earlier = problem.values(before.z)["controller.Kc[0]"]
    again, problem, search = stated({"controller.Kc": [earlier]})
    solution = solution_at(problem, search, 4.0)
    robustness.make_robust(again, solution)
    assert abs(peak(again, problem, solution.z) / lower - 1.0) < 0.02


def test_a_grown_integral_time_is_taken_back_where_the_output_stays_farther(answered, monkeypatch):
    setting, problem, search = answered
    solution = solution_at(problem, search, 4.0)
    solution.z = np.array([solution.z[0], 0.9])
    solution.kept[:] = False
    search.take(search.point(solution.z))
    slow, cost = problem.values(solution.z), search.point(solution.z).cost
    gains = robustness._RobustGains(setting, solution)
    fragility = peak(setting, problem, solution.z)
    monkeypatch.setattr(robustness, "ERROR_GROWTH", np.inf)
    gains.shorten_times()
    assert problem.values(solution.z) == slow
    monkeypatch.setattr(robustness, "ERROR_GROWTH", 1.5)
    gains.shorten_times()
    values = problem.values(solution.z)
    assert values["controller.Ti[0]"] < 0.1 * slow["controller.Ti[0]"]
    assert search.point(solution.z).cost <= 1.01 * cost
    assert peak(setting, problem, solution.z) <= fragility * (1.0 + 1e-9)
    assert not gains._error_has_grown(solution.z)
