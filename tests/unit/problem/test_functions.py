"""Objectives and constraints that are custom functions, against built-in measures, NumPy on a
trajectory, differences, and a grid."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import RIGS

import jaxtank
import tuning
from jaxtank import measures as ms, rig
from jaxtank.core.errors import InputError
from jaxtank.loop.run import evaluate_for_reverse
from jaxtank.measures import from_function, register, registry
from tuning.problem.problem import FORWARD_LIMIT, Problem
from tuning.search.setting import scenarios_of

GAINS = {"controller.Kc[0]": 3.0, "controller.Ti[0]": 20.0}


@pytest.fixture(autouse=True)
def _forget():
    """Forget the measures of a test."""
    known = set(ms.MEASURES)
    yield
    for name in set(ms.MEASURES) - known:
        del ms.MEASURES[name]


@pytest.fixture(scope="module")
def watertank():
    case = rig.load(RIGS / "watertank.toml")
    case = rig.set_values(case, {"clock.dt": 0.1, "clock.duration": 20.0})
    return case.replace(limits={}, objective={"rms_error_total": 1.0})


def root_mean_square(measures, trajectory):
    """Root of the mean squared errors, summed over outputs."""
    return jnp.sqrt(jnp.sum(jnp.mean(trajectory.e**2, axis=0)))


def fastest_change(measures, trajectory):
    """Fastest change of an input."""
    change = jnp.diff(trajectory.u, axis=0) / jnp.diff(trajectory.t)[:, None]
    return jnp.max(jnp.abs(change))


def total_variation_and_level(measures):
    """A function of measures alone."""
    return jnp.sum(measures["input_travel"]) + measures["max_level"][0] ** 2


def at(case, values):
    return jaxtank.with_values(case.loop, values)


@pytest.mark.extended
def test_a_function_has_the_value_that_numpy_gives_on_the_trajectory(watertank):
    """With sensor noise, of a trajectory that is thinned, and of measures alone."""
    noisy, key = at(watertank, {"sensor.noise": 0.02}), jax.random.key(3)
    register("fastest", from_function(fastest_change, "V/s", save_every=7))
    register("both", from_function(total_variation_and_level))
    names = ["fastest", "both", "input_travel", "max_level"]
    values = jaxtank.evaluate(noisy, watertank.clock, names, key)
    run = jaxtank.simulate(noisy, watertank.clock, key, save_every=7)
    u, t = np.asarray(run.u), np.asarray(run.t)
    np.testing.assert_allclose(
        values["fastest"], np.abs(np.diff(u, axis=0) / np.diff(t)[:, None]).max(), rtol=1e-12
    )
    expected = values["input_travel"].sum() + values["max_level"][0] ** 2
    np.testing.assert_allclose(values["both"], expected, rtol=1e-14)
    assert not {"fastest", "both"} & set(ms.reported())


def test_its_derivatives_are_those_of_the_measure_that_it_repeats(watertank):
    """In forward mode with the run, in reverse mode through checkpoints, by differences."""
    register("own_root", from_function(root_mean_square, "cm"))
    names = ("own_root", "rms_error_total")
    values, slopes, _, broken = jaxtank.sensitivities(watertank.loop, watertank.clock, names, GAINS)
    assert not broken and jnp.isclose(values["own_root"], values["rms_error_total"], rtol=1e-12)
    np.testing.assert_allclose(slopes["own_root"], slopes["rms_error_total"], rtol=1e-9)

    def cost(theta):
        here = at(watertank, dict(zip(GAINS, theta)))
        return evaluate_for_reverse(here, watertank.clock, ["own_root"])["own_root"]

    point = jnp.array(list(GAINS.values()))
    reverse = jax.jit(jax.grad(cost))(point)
    np.testing.assert_allclose(reverse, slopes["rms_error_total"], rtol=1e-9)
    compiled = jax.jit(cost)
    for i in range(2):
        step = 1e-6 * point * jnp.eye(2)[i]
        change = (compiled(point + step) - compiled(point - step)) / (2 * step[i])
        np.testing.assert_allclose(change, reverse[i], rtol=1e-5)


@pytest.mark.slow
def test_a_problem_has_the_point_of_the_measure_that_its_function_repeats(watertank):
    """Cost, margins and slopes over several plants, forward and (many parameters) in reverse."""
    plants = scenarios_of(watertank, {"plant.pump_gain": 0.05}, samples=2, seed=1)
    make = functools.partial(Problem, watertank, scenarios=plants)
    own = make(
        objective={root_mean_square: 2.0},
        limits=tuning.Constraint("root_again", root_mean_square, upper=0.5, unit="cm"),
    )
    same = make(objective={"rms_error_total": 2.0}, limits={"rms_error_total": 0.5})
    z = np.array([0.4, 0.6])
    mine, theirs = own.point(z), same.point(z)
    for field in ("cost", "gradient", "margins", "margin_slopes"):
        np.testing.assert_allclose(getattr(mine, field), getattr(theirs, field), rtol=1e-8)
    np.testing.assert_allclose(own.screen(z[None])[0], theirs.cost, rtol=1e-10)
    assert own.model is None, "a general function has no Gauss-Newton matrix"
    assert own.limits[0].label == "root_again in plant 1"


def test_many_parameters_are_differentiated_in_reverse(watertank, monkeypatch):
    monkeypatch.setattr("tuning.problem.problem.FORWARD_LIMIT", 0)
    assert FORWARD_LIMIT > 0
    own = Problem(watertank, objective=root_mean_square).point(np.array([0.5, 0.5]))
    monkeypatch.setattr("tuning.problem.problem.FORWARD_LIMIT", FORWARD_LIMIT)
    forward = Problem(watertank).point(np.array([0.5, 0.5]))
    np.testing.assert_allclose(own.gradient, forward.gradient, rtol=1e-8)


QUICK = tuning.Options(starts=1, screening=8, validation=0, iterations=40)


@pytest.mark.slow
def test_an_own_constraint_is_active_at_the_least_cost_of_a_grid_that_keeps_it(watertank):
    """One gain: 400 values of it, run one beside the other, without the tuner."""
    limit, low, high = 60.0, 0.5, 20.0
    free = {"controller.Kc": (low, high)}
    constraint = tuning.Constraint("fastest", fastest_change, upper=limit, unit="V/s")
    result = tuning.tune(watertank, QUICK, free=free, limits=[constraint])
    row = result.constraints[0]

    @jax.jit
    @jax.vmap
    def run(gain):
        found = jaxtank.simulate(at(watertank, {"controller.Kc": gain}), watertank.clock)
        return found.e, found.u

    gains = np.linspace(low, high, 400)
    errors, inputs = (np.asarray(v)[:, :, 0] for v in run(gains[:, None]))
    fastest = np.abs(np.diff(inputs, axis=1)).max(axis=1) / watertank.clock.dt
    cost = np.where(fastest <= limit, np.sqrt((errors**2).mean(axis=1)), np.inf)
    best = int(np.argmin(cost))
    assert np.argmin(np.sqrt((errors**2).mean(axis=1))) != best, "the limit matters"
    assert row.active and row.name == "fastest" and row.unit == "V/s"
    assert result["controller.Kc[0]"].after == pytest.approx(gains[best], abs=0.05)
    assert result.objective["after"] <= cost[best]
    assert row.value <= limit


@pytest.mark.slow
def test_results_name_it_with_its_unit(watertank):
    objective = tuning.Objective("own_root", root_mean_square, unit="cm")
    constraint = tuning.Constraint("fastest", fastest_change, lower=1.0, unit="V/s")
    limits = [{"max_level": "rim"}, constraint]
    result = tuning.tune(watertank, QUICK, objective=objective, limits=limits)
    text, table = str(result), result.to_json()
    assert "objective: own_root" in text and "own_root            cm" in text
    assert "fastest              V/s   >= 1" in text
    assert table["units"]["own_root"] == "cm" and table["objective"]["terms"] == {"own_root": 1.0}
    assert table["measures"]["after"]["own_root"] == pytest.approx(result.objective["after"])
    assert table["constraints"][-1]["unit"] == "V/s"
    tuned = result.tuned.replace(objective={"own_root": 1.0}, limits={"fastest": 1.0})
    assert "own_root" not in rig.dump(tuned), "a file names no function"
    read = rig.loads(rig.dump(tuned))
    assert read.objective == {"rms_error_total": 1.0} and not read.limits


@pytest.mark.slow
def test_robust_tuning_and_the_tradeoff_take_functions(watertank):
    own = tuning.Objective("own_root", root_mean_square, unit="cm")
    limits = [tuning.Constraint("fastest", fastest_change, upper=60.0, unit="V/s")]
    free, spread = {"controller.Kc": (0.5, 20.0)}, {"plant.pump_gain": 0.05}
    stated = dict(free=free, objective=own, limits=limits)
    quick = tuning.Options(starts=1, screening=4, iterations=10)
    robust = tuning.tune_robust(watertank, spread, samples=2, fresh=4, method=quick, **stated)
    assert {c.name for c in robust.constraints} == {"fastest in plant 1", "fastest in plant 2"}
    assert robust.certificate.fresh == 4
    found = tuning.tradeoff(
        watertank, "fastest", [80.0, 40.0], free=free, objective=own, screening=4, iterations=10
    )
    first, second = found["points"]
    assert first["objective"] < second["objective"]


@pytest.mark.slow
def test_new_plants_are_judged_by_functions(watertank):
    own = tuning.Objective("own_root", root_mean_square, unit="cm")
    limits = [tuning.Constraint("fastest", fastest_change, upper=60.0, unit="V/s")]
    spread = {"plant.pump_gain": 0.05}
    judged = tuning.validate(watertank, 4, distributions=spread, objective=own, limits=limits)
    errors = np.asarray(judged.measures["rms_error_total"])
    np.testing.assert_allclose(judged.cost, errors, rtol=1e-10)
    assert judged.limits[0].measure == "fastest" and judged.held.shape == (4,)


@pytest.mark.slow
def test_the_default_answer_takes_functions(watertank):
    own = tuning.Objective("own_root", root_mean_square, unit="cm")
    limits = [tuning.Constraint("fastest", fastest_change, upper=60.0, unit="V/s")]
    few = tuning.Options(validation=16, starts=2)
    result = tuning.tune(watertank, few, objective=own, limits=limits)
    assert result.answer.setting.objective == {"own_root": 1.0}
    assert result.objective["after"] < result.objective["before"]
    assert result.answer.held and result.constraints[0].name == "fastest"
    assert "objective own_root, mean of 16 plants [cm]" in str(result)
    same = tuning.tune(watertank, few, objective={"rms_error_total": 1.0}, limits=limits)
    assert result.objective["after"] == pytest.approx(same.objective["after"], rel=0.01)


@pytest.mark.slow
def test_two_functions_share_no_checkpoint(watertank, tmp_path):
    """The same name, and code that differs by a number that it closes over alone."""

    def objective(weight):
        def own(measures, trajectory):
            return jnp.mean(trajectory.e**2) + weight * jnp.sum(measures["input_travel"])

        return own

    def search(weight, resume):
        return tuning.tune(
            watertank, QUICK, objective=objective(weight), checkpoint=tmp_path, resume=resume
        )

    first = search(0.01, False)
    again = search(0.01, True)
    assert again.objective == first.objective and again.parameters == first.parameters
    with pytest.raises(InputError, match="another problem; what differs: functions"):
        search(0.02, True)


def takes_three(measures, trajectory, weight):
    return measures["ise"]


def takes_the_number(measures):
    return float(measures["rms_error_total"])


def asks_whether(measures, trajectory):
    return trajectory.e[0, 0] if trajectory.e[-1, 0] > 0 else trajectory.e[1, 0]


def gives_a_list(measures, trajectory):
    return trajectory.e[:, 0]


def gives_two(measures):
    return measures["rms_error_total"], 1.0


def gives_a_text(measures):
    return "small"


def misspells(measures):
    return measures["rms_eror_total"]


def fails(measures, trajectory):
    return trajectory.levels[0]


def is_not_finite(measures):
    return jnp.log(measures["rms_error_total"] - 1e3)


def has_no_slope(measures):
    return jnp.sqrt(measures["rms_error_total"] * 0.0)


@pytest.mark.parametrize(
    ("objective", "words"),
    [
        (takes_three, r"takes_three\(.*\): must take \(measures\) or \(measures, trajectory\)"),
        (takes_the_number, "function takes_the_number: jax cannot trace it.*instead of float"),
        (asks_whether, "function asks_whether: jax cannot trace it"),
        (gives_a_list, r"gives_a_list: returns an array of shape \(201,\): must return one number"),
        (gives_two, "gives_two: returns a tuple: must return one number"),
        (gives_a_text, "function gives_a_text: must return one number"),
        (misspells, "misspells: unknown measure 'rms_eror_total'; nearest: rms_error_total"),
        (fails, "function fails: AttributeError: .*levels"),
        (is_not_finite, "objective is_not_finite is not a number at the starting values"),
        (has_no_slope, r"function has_no_slope: its derivative by controller.Kc\[0\]"),
        (3.0, "objective = 3.0: must be {measure: weight}, a tuning.Objective or a function"),
        ({lambda m: 0.0: 1.0, lambda m: 1.0: 1.0}, "two functions without a name, as lambdas"),
        (tuning.Objective("ise", is_not_finite), "measure 'ise' is built in"),
        (tuning.Objective("a b", is_not_finite), "measure 'a b': a name must be a text of letters"),
    ],
)
def test_a_function_that_cannot_be_used_is_named_in_one_line(watertank, objective, words, tmp_path):
    with pytest.raises(InputError, match=words) as error:
        tuning.tune(watertank, QUICK, objective=objective, checkpoint=tmp_path / "log")
    assert "\n" not in str(error.value)
    assert not (tmp_path / "log").exists()


def test_a_constraint_has_one_finite_limit_and_a_name_of_its_own(watertank):
    for limits in ({}, {"upper": 1.0, "lower": 0.0}):
        with pytest.raises(InputError, match="fastest: must have either upper or lower"):
            tuning.Constraint("fastest", fastest_change, **limits)
    with pytest.raises(InputError, match=r"fastest: limit nan must be a finite number \[V/s\]"):
        tuning.Constraint("fastest", fastest_change, upper=np.nan, unit="V/s")
    with pytest.raises(InputError, match=r"fastest: limit .*True.* must be a finite number"):
        tuning.Constraint("fastest", fastest_change, upper=np.bool_(True))
    two = [
        tuning.Constraint("same", fastest_change, upper=1.0),
        tuning.Constraint("same", root_mean_square, upper=1.0),
    ]
    with pytest.raises(InputError, match="same is the name of two functions"):
        Problem(watertank, limits=two)
    with pytest.raises(InputError, match=r"limits: 3.0 must be \{measure: value\}"):
        Problem(watertank, limits=[3.0])


def test_a_measure_of_an_installed_package_is_known_by_its_name(watertank, monkeypatch):
    """As an entry point of the group "jaxtank.measures", a function of a module."""
    from importlib.metadata import EntryPoint

    value = f"{__name__}:total_variation_and_level"
    point = EntryPoint(name="theirs", value=value, group=registry.GROUP)
    monkeypatch.setattr(EntryPoint, "load", lambda point: total_variation_and_level)
    monkeypatch.setattr(registry, "installed", lambda group: {"theirs": point})
    assert rig.check_objective({"theirs": 1.0}) == {"theirs": 1.0}
    values = jaxtank.evaluate(watertank.loop, watertank.clock, ["theirs", "input_travel"])
    assert values["theirs"] > values["input_travel"].sum()
    assert ms.unreadable(["theirs"]) == ()


@pytest.mark.extended
def test_a_number_that_a_function_reads_may_change_between_calls(watertank):
    """jax keeps a compiled program by the identity of the function, not by what it closes over."""
    price = [1.0]

    def cost(measures, trajectory):
        return price[0] * jnp.mean(jnp.abs(trajectory.e))

    def before():
        problem = tuning.Problem(watertank, objective=cost, limits={})
        return problem.screen(problem.start()[None])[0]

    first = before()
    price[0] = 10.0
    assert before() == pytest.approx(10.0 * first, rel=1e-12)
