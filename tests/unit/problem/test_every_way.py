"""Problems of the nominal optimum, of many plants and of the default answer: one interface."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxtank import presets
from tuning.problem import scenarios
from tuning.problem.evaluator import Evaluator
from tuning.problem.problem import Problem
from tuning.search.default import Checks, problem_of
from tuning.search.setting import scenarios_of, setting_of

FREE = {"controller.Kc": (0.2, 4.0)}
LIMITS = {"max_level": 9.0}


@pytest.fixture(scope="module")
def case():
    """Its clock leaves a coarse step."""
    case = presets.find("cascaded/pi")
    return case.replace(clock=dataclasses.replace(case.clock, dt=0.4, duration=4000.0, substeps=1))


def nominal(case):
    return Problem(case, FREE, limits=LIMITS)


def robust(case):
    return Problem(case, FREE, limits=LIMITS, scenarios=scenarios_of(case, samples=4), risk="cvar")


def default(case, checks=None):
    setting = setting_of(case, limits=LIMITS)
    return problem_of(setting, setting.searched, FREE, 0, checks)


def default_with_checks(case):
    setting = setting_of(case, limits=LIMITS)
    checks = Checks(setting, setting.searched, FREE, setting.limits, {})
    checks.look(checks.problem.start())
    return default(case, checks)


EVERY = [nominal, robust, default, default_with_checks]


@pytest.mark.extended
@pytest.mark.slow_for("default_with_checks", "robust", "nominal")
@pytest.mark.parametrize("make", EVERY)
def test_every_problem_is_run_at_every_step(case, make):
    """The noise of the default answer is drawn beforehand, and not for the coarse step."""
    problem = make(case)
    z = problem.start()
    (cost,), margins = problem.screen(z[None])
    (rough,), _ = problem.screen(z[None], coarse=True)
    assert rough != cost and rough == pytest.approx(cost, rel=0.5)
    assert margins.shape == (1, len(problem.limits))


@pytest.mark.slow
@pytest.mark.parametrize("make", EVERY)
def test_every_problem_has_derivatives_at_every_step(case, make):
    problem = make(case)
    z = problem.start()
    point, coarse = problem.point(z), problem.coarse_point(z)
    assert problem.screen(z[None])[0][0] == pytest.approx(point.cost, rel=1e-9)
    assert problem.screen(z[None], coarse=True)[0][0] == pytest.approx(coarse.cost, rel=1e-9)
    assert problem.total(point.measures) == pytest.approx(point.cost, rel=1e-9)
    batch = problem.batch_point(z, problem.batch(3, np.random.default_rng(0)))
    for one in (point, coarse, batch):
        assert one.finite and one.gradient.shape == (1,)


def test_a_problem_is_frozen_and_its_evaluator_counts(case, monkeypatch):
    problem = Problem(case.replace(clock=dataclasses.replace(case.clock, dt=8.0)), FREE, limits={})
    with pytest.raises(dataclasses.FrozenInstanceError):
        problem.limits = []
    calls = []
    monkeypatch.setattr(Problem, "_screen", lambda *a: calls.append(a) or (np.ones(2), a[1][:, :0]))
    evaluator, zs = Evaluator(problem), np.array([[0.2], [0.4]])
    first, again = evaluator.screen(zs), evaluator.screen(zs)
    assert first[0].tolist() == again[0].tolist() and len(calls) == 1  # known the second time
    assert evaluator.simulations == 4 and evaluator.gradients == 0


def test_noise_that_is_drawn_beforehand_changes_no_coarse_run(case):
    """As the same group without: the coarse clock draws its own numbers from the same keys."""
    drawn = default(case)
    assert all(group.noise is not None for group in drawn.groups)
    plain = drawn.replace(groups=[group._replace(noise=None) for group in drawn.groups])
    z = drawn.start()[None]
    assert drawn.screen(z, coarse=True)[0] == plain.screen(z, coarse=True)[0]


def test_processors_share_the_runs_of_many_plants(case, monkeypatch):
    """64 plants, 32 in a program: the same bits on one processor and on two."""
    short = case.replace(clock=dataclasses.replace(case.clock, dt=4.0, duration=800.0))
    problem = Problem(short, FREE, limits=LIMITS, scenarios=scenarios_of(short, samples=64))
    z, results = problem.start(), []
    for count in (1, 2):
        monkeypatch.setattr(scenarios, "processors", lambda count=count: count)
        shares = scenarios._shares(problem.groups[0])
        assert [len(share.runs) for share in shares] == [32, 32]
        results.append((*problem.screen(z[None]), *problem.point(z)[1:5]))
    for alone, shared in zip(*results, strict=True):
        np.testing.assert_array_equal(shared, alone)


@pytest.mark.parametrize("double", [False, True])
def test_threads_have_the_precision_of_their_caller(double):
    with jax.enable_x64(double):
        results = scenarios.at_once(lambda size: jnp.zeros(size), [1, 2, 3], most=2)
    assert {v.dtype.itemsize for v in results} == {8 if double else 4}
