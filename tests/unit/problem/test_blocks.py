"""Points are run in blocks of one size, and every point has its own numbers."""

import numpy as np
import pytest

from jaxtank import presets, rig
from tuning.problem.evaluator import IDLE, Blocks, Evaluator
from tuning.problem.problem import LANES, Problem


@pytest.mark.parametrize("runs", [1, 3, 32, 1024])
def test_a_block_fills_the_lanes_and_is_kept(runs):
    blocks, most = Blocks(runs), max(1, LANES // runs)
    assert blocks.size(64, False, 100) == min(64, most)
    for points in (1, 5, 64, 200):
        assert blocks.size(points, False, 100) in (min(64, most), min(points, most))
    assert blocks.size(3, True, 100) == min(3, most)  # the coarse clock has programs of its own


def test_a_program_of_its_own_serves_where_filling_up_would_cost_more():
    blocks = Blocks(1)
    assert blocks.size(64, False, IDLE // 10) == 64
    assert blocks.size(60, False, IDLE // 10) == 64
    assert blocks.size(2, False, IDLE // 10) == 2


@pytest.mark.extended
def test_each_point_has_the_cost_that_it_has_alone(monkeypatch):
    case = rig.set_values(presets.find("cascaded/pi"), {"clock.dt": 8.0})
    problem = Evaluator(Problem(case, limits={"max_level": 9.0}))
    zs = np.random.default_rng(0).uniform(0.2, 0.8, (7, len(problem.problem.bounds)))
    costs, margins = problem.screen(zs)
    sizes, screen = [], Problem._screen
    record = lambda self, some, coarse: sizes.append(len(some)) or screen(self, some, coarse)
    monkeypatch.setattr(Problem, "_screen", record)
    for i in (0, 3, 6):
        alone = problem.screen(zs[i : i + 1])
        np.testing.assert_allclose(alone[0], costs[i : i + 1], rtol=1e-12)
        np.testing.assert_allclose(alone[1], margins[i : i + 1], rtol=1e-9)
    assert sizes == [7, 7, 7]  # the compiled program again
