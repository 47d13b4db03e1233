"""The last step of the default answer: gains whose loop is fragile are moved back."""

import numpy as np
import pytest

from jaxtank import presets, rig
from tuning.problem.evaluator import Evaluator
from tuning.problem.problem import Problem
from tuning.search import small_changes as robustness
from tuning.search.driver import Search
from tuning.search.setting import setting_of
from tuning.search.small_changes import LINE
from tuning.search.solve import Solution


@pytest.fixture(scope="module")
def answered():
    """(setting, problem, search) of the public two-tank rig on its nominal plant, two plateaus."""
    case = rig.set_values(presets.find("cascaded/pi"), {"clock.duration": 800.0})
    setting = setting_of(case)
    problem = Problem(setting.searched, None, setting.objective, {}, None, 0)
    evaluator = Evaluator(problem)
    reference = evaluator.point(problem.start())
    search = Search(evaluator, reference, tolerance=1e-4)
    search.take(reference)
    return setting, problem, search


def found_at(problem, search, Kc):
    """The outcome of a search that ended at a gain Kc."""
    low, high = problem.case.free["controller.Kc"][:2]
    z = np.array([np.log(Kc / low) / np.log(high / low), problem.start()[1]])
    search.take(search.point(z))
    return Solution(search=search, z=z, kept=np.array([False, True]))


def peak(setting, problem, z):
    case = setting.tuned(problem.values(z))
    found = robustness.margin_measures(case.loop, case.clock)
    return float(found["sensitivity_peak"])


@pytest.mark.slow
def test_a_fragile_answer_moves_back_as_far_as_its_sensitivity_peak_asks(answered, monkeypatch):
    setting, problem, search = answered
    first = problem.start()
    found = found_at(problem, search, 1.6)
    before = found.z
    monkeypatch.setattr(robustness, "PRICE", 1.0)
    allowed = max(robustness.PEAK, peak(setting, problem, first))
    assert peak(setting, problem, before) > allowed == 2.5
    robustness.move_back(setting, found)
    assert peak(setting, problem, found.z) <= allowed
    assert peak(setting, problem, found.z - (first - before) / LINE) > allowed
    assert found.kept.tolist() == [False, True]


@pytest.mark.slow
def test_tuned_again_the_answer_stays(answered, monkeypatch):
    """The first values are an earlier answer, a little below the peak that is allowed."""
    setting, problem, search = answered
    monkeypatch.setattr(robustness, "PRICE", 1.0)
    earlier = problem.values(found_at(problem, search, 1.2).z)["controller.Kc[0]"]
    case = rig.set_values(setting.case, {"controller.Kc": [earlier]})
    again = setting_of(case)
    problem = Problem(again.searched, None, again.objective, {}, None, 0)
    search = Search(Evaluator(problem), problem.point(problem.start()), tolerance=1e-4)
    found = found_at(problem, search, 1.6)
    robustness.move_back(again, found)
    assert np.array_equal(found.z, problem.start()) and found.kept.all()


@pytest.mark.slow_for("1.04-0.05")
@pytest.mark.parametrize(("Kc", "price"), [(1.04, 0.05), (1.25, 0.0)])
def test_an_answer_stays_that_is_robust_enough_or_for_which_it_costs_too_much(
    answered, monkeypatch, Kc, price
):
    setting, problem, search = answered
    found = found_at(problem, search, Kc)
    before = found.z
    monkeypatch.setattr(robustness, "PRICE", price)
    robustness.move_back(setting, found)
    assert found.z is before
