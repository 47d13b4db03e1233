"""Derivatives of runs side by side are those of each run alone, whatever the number of gains."""

import dataclasses

import jax
import numpy as np
import pytest

from jaxtank import presets
from jaxtank.core.tree import with_values
from jaxtank.loop.derivatives import FEW, SMALL, sensitivities_compiled
from tuning.problem.problem import Problem

NAMES = ("rms_error_total", "max_level", "input_travel")
SQUARES = (("mean_square_error", 1.0), ("mean_square_jitter", 0.5))
LARGE = "mirakhorli/lqi"  # the gain of its LQI is an array that depends on the parameters


@pytest.mark.parametrize(
    "name, count", [("cascaded/pi", 1), ("cascaded/pi", 2), ("mirakhorli/smc", 3), (LARGE, 4)]
)
def test_runs_side_by_side_have_the_derivatives_of_each_alone(name, count):
    case = presets.find(name)
    clock = dataclasses.replace(case.clock, duration=1000.0 * case.clock.dt)
    problem = Problem(case)
    values = problem.values(problem.start())
    free, start = tuple(values)[:count], tuple(values.values())[:count]
    start_level = 0.9 * np.asarray(case.loop.x0) + 0.02 * np.asarray(case.loop.plant.rim)
    areas = np.outer([0.97, 1.0, 1.04], np.asarray(case.loop.plant.area))

    def of(area, batched):
        loop = with_values(case.loop, {"plant.area": area, "x0": start_level})
        return sensitivities_compiled(loop, clock, NAMES, free, start, None, SQUARES, batched)

    together = jax.vmap(lambda area: of(area, True))(areas)
    for i, area in enumerate(areas):
        alone = of(area, False)
        for one, all_of_them in zip(jax.tree.leaves(alone), jax.tree.leaves(together)):
            largest = np.abs(one).max(initial=1e-12)
            np.testing.assert_allclose(all_of_them[i], one, rtol=1e-9, atol=1e-11 * largest)
    matrix = np.asarray(together[2])
    assert matrix.shape == (3, count, count) and np.all(matrix[:, 0, 0] > 0.0)
    np.testing.assert_allclose(matrix, np.swapaxes(matrix, 1, 2), rtol=1e-12)


def test_the_cases_are_on_both_sides_of_what_the_code_tells_apart():
    gain = np.size(presets.find(LARGE).loop.controller.Q)
    assert FEW == 3 and gain * gain > SMALL
