"""Problems of the nominal optimum, of many plants and of the default answer: one interface."""

import dataclasses
import inspect

import numpy as np
import pytest

from jaxtank import presets
from tuning.problem.problem import Problem
from tuning.search.attempts import Checks, Task
from tuning.search.setting import scenarios_of, setting_of
from tuning.search.stages import Plan

FREE = {"controller.Kc": (0.2, 4.0), "controller.Ti": (20.0, 400.0)}
LIMITS = {"max_level": 9.0}


def nominal(case):
    return Problem(case, FREE, limits=LIMITS)


def robust(case):
    return Problem(case, FREE, limits=LIMITS, scenarios=scenarios_of(case, samples=4), risk="cvar")


def default(case, checked=False):
    setting = setting_of(case, limits=LIMITS)
    plan = Plan(method="slsqp", starts=1, screening=1, iterations=1, seed=0)
    task = Task(FREE, plan, 4, None)
    checks = Checks(setting, setting.searched, FREE, setting.limits, {}) if checked else None
    if checks:
        checks.look(checks.problem.start())
    return task.problem(setting, setting.searched, checks)


def default_with_checks(case):
    return default(case, checked=True)


def points(problem):
    """What each public name of a Problem gives at one point; the names are checked to be all."""
    limits, z = problem.with_limits(LIMITS), problem.start()
    point = problem.point(z)
    coarse = problem.coarse_point(z)
    batch = problem.batch_point(z, 3, np.random.default_rng(0))
    return {
        "with_limits": limits,
        "names": problem.names,
        "model": problem.model,
        "start": z,
        "own_values": problem.own_values(),
        "values": problem.values(z),
        "loop_at": problem.loop_at(z),
        "cost": [problem.cost(row) for row in point.measures],
        "total": problem.total(point.measures),
        "shares": problem.shares(point.run_costs, range(len(problem.runs))),
        "margins": problem.margins(point.measures),
        "screen": [problem.screen(z[None], coarse=way) for way in (False, True)],
        "point": point,
        "coarse_point": coarse,
        "batch_point": batch,
    }


@pytest.mark.parametrize("make", [nominal, robust, default, default_with_checks])
def test_every_public_method_serves_every_problem(make):
    """The clock leaves a coarse step, and the noise of the default answer is drawn beforehand."""
    case = presets.find("cascaded/pi")
    case = case.replace(clock=dataclasses.replace(case.clock, dt=0.4, duration=4000.0, substeps=1))
    problem = make(case)
    found = points(problem)
    assert set(found) == {n for n, _ in inspect.getmembers(Problem) if not n.startswith("_")}
    (true, margins), (coarse, _) = found["screen"]
    assert true[0] == pytest.approx(found["point"].cost, rel=1e-9)
    assert coarse[0] == pytest.approx(found["coarse_point"].cost, rel=1e-9)
    assert coarse[0] != true[0] and coarse[0] == pytest.approx(true[0], rel=0.5)
    assert found["total"] == pytest.approx(found["point"].cost, rel=1e-9)
    assert margins.shape == (1, len(problem.limits))
    for point in (found["point"], found["coarse_point"], found["batch_point"]):
        assert point.finite and point.gradient.shape == (2,)


def test_noise_that_is_drawn_beforehand_changes_no_coarse_run():
    """As the same group without: the coarse clock draws its own numbers from the same keys."""
    case = presets.find("cascaded/pi")
    drawn = default(
        case.replace(clock=dataclasses.replace(case.clock, dt=0.4, duration=4000.0, substeps=1))
    )
    z = drawn.start()
    assert all(group.noise is not None for group in drawn.groups)
    costs = drawn.screen(z[None], coarse=True)[0], drawn.coarse_point(z).cost
    drawn.groups = [group._replace(noise=None) for group in drawn.groups]
    drawn.cache = type(drawn.cache)()
    assert (drawn.screen(z[None], coarse=True)[0], drawn.coarse_point(z).cost) == costs
