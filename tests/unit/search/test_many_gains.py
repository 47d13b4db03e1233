"""More free gains than derivatives are carried of: reverse mode on a rig of arrays."""

import numpy as np
import pytest

from jaxtank import rig
from tuning.problem.problem import FORWARD_LIMIT, Problem

TANKS = 40


def forty_tanks():
    """A row of tanks joined by orifices, each with a pump under a PI of its own."""
    numbers = range(TANKS)
    changes = [[3.0 + i // 6, i + 1, 5.4 + 0.2 * (i % 2)] for i in numbers]
    tank = "[[tank]]\narea = {}\nlevel = 5.0\nrim = 20.0\ndrain = 0.1"
    orifice = "[[orifice]]\nfrom = {}\nto = {}\narea = 0.02"
    pump = "[[pump]]\nto = {}\ngain = 5.0\nhigh = 12.0\ninitial = 1.98"
    return "\n".join(
        [
            'name = "forty tanks"',
            *(tank.format(20 + i % 3) for i in numbers),
            *(orifice.format(i, i + 1) for i in numbers[1:]),
            *(pump.format(i + 1) for i in numbers),
            f"[plant]\noutputs = {[i + 1 for i in numbers]}",
            f'[controller]\nkind = "pid"\nKc = {[1 + 0.01 * i for i in numbers]}',
            f"Ti = {[20 + 0.1 * i for i in numbers]}",
            f"[reference]\ninitial = {[5.0] * TANKS}\nramp = 3.0\nchanges = {changes}",
            '[values]\n"clock.dt" = 1.0\n"clock.duration" = 40.0',
            '[free]\n"controller.Kc" = [0.2, 8.0]\n"controller.Ti" = [5.0, 200.0]',
        ]
    )


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    path = tmp_path_factory.mktemp("rig") / "forty.toml"
    path.write_text(forty_tanks())
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
