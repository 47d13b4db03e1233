"""More free gains than derivatives are carried of: reverse mode on a rig of arrays."""

import numpy as np
import pytest
from tanks_in_a_row import rig_text

from jaxtank import rig
from tuning.problem.problem import FORWARD_LIMIT, Problem

TANKS = 40


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    path = tmp_path_factory.mktemp("rig") / "forty.toml"
    path.write_text(rig_text(TANKS))
    return path


@pytest.mark.slow
def test_the_gradient_of_reverse_mode_is_that_of_differences(file):
    problem = Problem(rig.load(file))
    assert len(problem.names) == 2 * TANKS > FORWARD_LIMIT
    z, rng = problem.start(), np.random.default_rng(0)
    gradient, step = problem.point(z).gradient, 1e-5
    one = [np.eye(len(z))[i] for i in (0, 7, 39, 40, 79)]
    moves = np.array([*one, *rng.choice([-1.0, 1.0], (3, len(z)))]) * step
    costs = problem.screen(np.concatenate([z + moves, z - moves]))[0]
    differences = (costs[: len(moves)] - costs[len(moves) :]) / 2.0
    np.testing.assert_allclose(moves @ gradient, differences, rtol=1e-6)
