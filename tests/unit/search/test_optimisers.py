"""How few evaluations the tuner's own local searches need, and what makes them few:
tests/benchmarks/optimisers.py has the rivals.
"""

import dataclasses

import numpy as np
import pytest

from jaxtank import presets
from jaxtank.signals.setpoints import ramps
from tuning.problem.evaluator import Evaluator
from tuning.problem.problem import Problem
from tuning.problem.scenarios import coarse_clock
from tuning.search.driver import Search
from tuning.search.methods import METHODS

SQUARES = {"ise": 1.0, "input_deviation": 3.0, "mean_square_travel": 100.0}


@pytest.fixture(scope="module")
def eight():
    """State feedback of mirakhorli: eight gains, seven noisy scenarios."""
    return Problem(presets.find("mirakhorli/sfc"), objective=SQUARES, limits={})


def searched(problem, method, iterations=60):
    """(Search after a local search from the case's values, passes at a tenth of the samples)."""
    rough, z = [], problem.start()
    report = lambda search: rough.append(len(search.history))
    search = Search(Evaluator(problem), problem.point(z), report)
    METHODS[method](search, z, iterations)
    return search, len(rough) - len(search.history)


@pytest.mark.slow  # two compilations of derivatives of seven runs
def test_few_evaluations(eight):
    # another algorithm, which uses no squares
    target = 1.001 * searched(eight, "slsqp")[0].best.cost
    arrived = lambda search: 1 + next(i for i, row in enumerate(search.history) if row[1] <= target)
    plain, none = searched(eight, "trf")
    refined, rough = searched(eight, "coarse-trf")
    assert none == 0
    # measured 6 to 16 passes from eight starts; the best derivative-free search needs 176
    # evaluations at least
    assert arrived(plain) <= 20
    # measured 1 to 4 of all samples, 7 to 17 of a tenth of them
    assert arrived(refined) <= 6 and rough <= 30
    assert refined.best.cost <= target / 1.001 * 1.00001


def quick(gouta, **changes):
    """Backstepping over a single pair of ramps, 100 s at 0.1 s."""
    case = gouta("backstepping")
    reference = ramps((3.0, 3.0), ((5.0, 0, 8.0), (5.0, 1, 6.0)), ramp=40.0)
    return case.replace(
        loop=dataclasses.replace(case.loop, reference=reference),
        clock=dataclasses.replace(case.clock, dt=0.1, duration=100.0),
        limits={},
        **changes,
    )


def test_a_short_run_has_no_rough_one(gouta):
    clock = quick(gouta).clock
    assert coarse_clock(clock) == clock
    longer = dataclasses.replace(clock, duration=400.0)
    assert coarse_clock(longer).dt == 10 * clock.dt and coarse_clock(longer).duration == 400.0


@pytest.mark.slow
def test_rough_search_starts_the_true_one(gouta):
    case = quick(gouta, objective={"mean_square_error": 1.0, "mean_square_travel": 100.0})
    case = case.replace(clock=dataclasses.replace(case.clock, duration=400.0))
    problem = Problem(case)
    both, rough = searched(problem, "coarse-trf")
    alone, _ = searched(problem, "trf")
    assert rough > 0
    # both end at 1e-10; the valley of k is flat
    assert both.best.cost == pytest.approx(alone.best.cost, rel=1e-6)
    # what the rough runs found stands in no history: every row there is a cost at the true step
    costs, _ = problem.screen(np.array([row[3] for row in both.history]))
    np.testing.assert_allclose(costs, [row[1] for row in both.history], rtol=1e-9)
