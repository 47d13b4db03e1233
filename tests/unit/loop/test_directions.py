"""Derivatives of runs side by side are those of each run alone, whatever the number of gains."""

import dataclasses

import jax
import numpy as np
import pytest

from jaxtank import presets
from jaxtank.core.tree import with_values
from jaxtank.loop.derivatives import SMALL, sensitivities_compiled
from tuning.problem.problem import Problem

NAMES = ("rms_error_total", "max_level", "input_travel")
SQUARES = (("mean_square_error", 1.0), ("mean_square_jitter", 0.5))
LARGE = "mirakhorli/lqi"  # the gain of its LQI is an array that depends on the parameters


@pytest.mark.extended
@pytest.mark.slow_for("cascaded/pi-1", "mirakhorli/smc-3", "mirakhorli/lqi-4")
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
        for expected, batch in zip(jax.tree.leaves(alone), jax.tree.leaves(together)):
            largest = np.abs(expected).max(initial=1e-12)
            np.testing.assert_allclose(batch[i], expected, rtol=1e-9, atol=1e-11 * largest)
    matrix = np.asarray(together[2])
    assert matrix.shape == (3, count, count) and np.all(matrix[:, 0, 0] > 0.0)
    np.testing.assert_allclose(matrix, np.swapaxes(matrix, 1, 2), rtol=1e-12)


def _equations(jaxpr):
    """All equations of a jaxpr and of those in it."""
    for equation in jaxpr.eqns:
        yield equation
        for inner in jax.tree.leaves(list(equation.params.values()), is_leaf=_is_jaxpr):
            if _is_jaxpr(inner):
                yield from _equations(getattr(inner, "jaxpr", inner))


def _without(plants, shape):
    """A shape without its axis of plants."""
    return shape[1:] if shape[:1] == (plants,) else shape


def _is_jaxpr(value):
    return hasattr(value, "eqns") or hasattr(value, "jaxpr")


@pytest.mark.parametrize("name, separate", [("cascaded/pi", True), (LARGE, False)])
def test_tangents_are_scalars_of_each_plant_and_no_matrix_is_copied(name, separate):
    """What makes the pass fast: no carried array ends in the axis of directions, and the barrier,
    a call that is not inlined, takes no large array.
    """
    case = presets.find(name)
    problem = Problem(case)
    values = problem.values(problem.start())
    free, start = tuple(values), tuple(values.values())
    plants = 5
    area = np.tile(np.asarray(case.loop.plant.area), (plants, 1))

    def slopes(area):
        loop = with_values(case.loop, {"plant.area": area})
        return sensitivities_compiled(loop, case.clock, NAMES, free, start, None, SQUARES, True)

    equations = list(_equations(jax.make_jaxpr(jax.vmap(slopes))(area).jaxpr))
    scans = [e for e in equations if e.primitive.name == "scan"]
    longest = max(scans, key=lambda e: e.params["length"])
    first, count = longest.params["num_consts"], longest.params["num_carry"]
    carried = [v.aval.shape for v in longest.invars[first : first + count]]
    tangents = [shape for shape in carried if len(shape) == 2 and shape[-1] == len(free)]
    assert (not tangents) == separate
    barriers = [e for e in equations if e.params.get("name") == "_as_it_is"]
    sizes = [np.prod(_without(plants, v.aval.shape)) for e in barriers for v in e.invars]
    assert barriers and max(sizes) <= SMALL
