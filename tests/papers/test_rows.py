"""The rows of `jaxtank compare`: a verdict follows from what was measured, and could be another."""

import dataclasses
import warnings

import jax
import numpy as np
import pytest

from jaxtank import presets, rig
from jaxtank.core.errors import InputError
from jaxtank.core.tree import parameters, with_values
from jaxtank.observers import Direct
from jaxtank.presets import gouta2022, mirakhorli
from jaxtank.presets.paper import Claim, Published, Sample
from jaxtank.presets.rows import robustness
from jaxtank.presets.rows.operations import operations, sample_operations
from tuning.problem.problem import Problem
from tuning.report import papers


@pytest.mark.parametrize("stated", ["reproduced", None, 1.0, ()])
def test_a_claim_holds_or_not_and_states_no_verdict(stated):
    with pytest.raises(TypeError, match="holds or not"):
        Claim(stated, "0 s")


def test_a_number_that_equals_the_printed_one_is_an_input():
    """Sums of inputs agree to rounding; no measurement agrees with a rounded number to 1e-9."""
    printed = Published(0.76, "-", "sec. 3", 0.005)
    assert papers.verdict(printed, 0.42 + 0.34)[0] == "input"
    assert papers.verdict(printed, 0.7601)[0] == "reproduced"
    chosen = printed._replace(fitted="chosen for it")
    assert papers.verdict(chosen, 0.42 + 0.34)[0] == "input"
    exact = Published(1.4, "-", "sec. III", 0.01, closed_form="0.7 x 0.6 / 0.3")
    assert papers.verdict(exact, 1.4)[0] == "reproduced"


def test_several_seeds_give_a_mean_and_a_deviation():
    sample = Sample([(1.0, 10.0), (3.0, 10.0), (5.0, 10.0)])
    assert sample.mean == (3.0, 10.0) and sample.deviation == (2.0, 0.0)
    printed = Published((3.1, 10.5), "s", "Table 3", 0.1, fitted="chosen for it")
    word, value, reason = papers.verdict(printed, sample)
    assert word == "fitted" and value == (3.0, 10.0)
    assert "largest difference 4.8 %" in reason and "3 seeds" in reason


# ------------------------------------------------------------------- every claim can be refuted


ARRAYS = ("x", "e", "u", "applied", "command", "d_hat")  # all but time and setpoints


def changed(case, trajectory, change, names=ARRAYS):
    """A run whose arrays are changed."""
    arrays = {name: change(np.asarray(getattr(trajectory, name))) for name in names}
    return case, dataclasses.replace(trajectory, **arrays)


def noise(array):
    return np.random.default_rng(3).normal(0.0, 20.0, array.shape)


def at_rest(array):
    return np.repeat(array[-1:], len(array), axis=0)


def fading(array):
    return array * np.linspace(1.0, 0.0, len(array))[:, None]


def other_rig(case, trajectory):
    """The same run, said to be of a rig and a controller with other numbers."""
    rng = np.random.default_rng(7)
    numbers = {
        name: np.asarray(value) * rng.uniform(0.4, 2.5, np.shape(value))
        for name, value in parameters(case.loop).items()
        if name in ("plant.drain", "plant.orifice", "plant.pipe", "plant.pump_gain")
        or name in ("controller.K", "controller.k1", "controller.Tp", "controller.surface")
    }
    if "controller.K" in numbers:
        numbers["controller.K"] *= -1.0
    splits = {"plant.split": 1.0 - np.asarray(case.loop.plant.split)}
    numbers |= splits if np.any(np.asarray(case.loop.plant.split) < 1.0) else {}
    loop = with_values(case.loop, numbers)
    if hasattr(loop.controller, "N"):  # Laguerre functions, more than increments of GPC
        loop = dataclasses.replace(loop, controller=dataclasses.replace(loop.controller, N=30))
    return dataclasses.replace(case, loop=loop), trajectory


def exchanged(run, pairs):
    """`run` with the trajectories of each pair of cases exchanged, where they take the values."""
    partner = dict(pairs) | {b: a for a, b in pairs}

    def other(name, values=None, save_every=1, seed=0):
        case, trajectory = run(name, values, save_every, seed)
        try:
            return case, run(partner.get(name, name), values, save_every, seed)[1]
        except InputError:
            return case, trajectory

    return other


PAIRS = {
    "gouta2015": [("ngpc", "backstepping")],
    "gouta2022": [("enmpc", "chadpc"), ("pi", "fopi-ff")],
    "mirakhorli": [("sfc", "hybrid"), ("smc-printed", "lqi"), ("sfc-fitted", "hybrid-fitted")],
    "khalid": [("gpc-nc2", "gpc-nc30"), ("gpc", "laguerre"), ("gpc-mimo", "laguerre-mimo")],
    "calofir": [("backstepping", "backstepping-perturbed")],
}


def other_runs(run, paper):
    """Runs that differ from those of `run` in one way each: a function of the same arguments."""
    through = lambda change: lambda *args: changed(*run(*args), change)
    pairs = PAIRS.get(paper, [])
    seconds = {name for _, name in pairs}

    def of_seconds(change, sense=True):
        one = lambda name: change if (name in seconds) is sense else lambda a: a
        return lambda name, *args: changed(*run(name, *args), one(name))

    yield exchanged(run, pairs)
    yield from map(through, (noise, fading, lambda a: a[::-1]))
    yield from (through(lambda a, scale=scale: a * scale) for scale in (1e-9, 1e3))
    yield from (through(lambda a, shift=shift: a + shift) for shift in (-5.0, 5.0))
    yield from (of_seconds(lambda a, scale=scale: a * scale) for scale in (1e-3, 0.1, 10.0, 1e3))
    yield from (of_seconds(at_rest, sense) for sense in (True, False))
    yield lambda *args: changed(*run(*args), fading, ("d_hat",))
    wide = lambda values: 0.5 if values and "actuator.high" in values else 1.0
    yield lambda name, values=None, *args: changed(
        *run(name, values, *args), lambda a: a * wide(values)
    )
    yield lambda *args: other_rig(*run(*args))


def uncertain_plants(run, seed=None):
    """Made-up results of robustness.everything: the study itself has tests of its own."""
    rng = np.random.default_rng(seed)
    found, nominal = {}, {"ngpc": 0.1, "backstepping": 0.4}
    for key in [(c, s) for c in robustness.CONTROLLERS for s in robustness.SPREADS]:
        size = rng.uniform(0.0, 100.0 if seed else 1.0, robustness.N)
        each = {n: size[:, None] * [1.0, 1.0] for n in robustness.MEASURES}
        each |= {"rms_error_total": size, "max_level": size[:, None] * np.ones(4)}
        errors = np.zeros((robustness.N, 2401, 2)) + size[:, None, None]
        failed = np.full(robustness.N, seed is not None and seed % 2 == 0)
        found[key] = robustness.Study(each, errors, failed)
    return found, nominal


def parts(claim):
    """Which parts of a claim hold."""
    return tuple(np.ravel(claim.holds).tolist())


FAST = ("dts200",)


@pytest.mark.slow_for("dts200")
@pytest.mark.parametrize(
    "paper", [pytest.param(p, marks=() if p in FAST else pytest.mark.slow) for p in presets.PAPERS]
)
def test_a_claim_that_no_run_refutes_is_no_measurement(paper, monkeypatch):
    """Whatever is measured changes with the runs, and so does what holds of each claim."""
    jax.config.update("jax_enable_x64", True)
    preset, run = presets.load(paper), papers.runner(paper)
    monkeypatch.setattr(robustness, "everything", uncertain_plants)
    first = preset.measured(run)
    words = {name: {parts(v)} for name, v in first.items() if isinstance(v, Claim)}
    moved = set()
    for number, other in enumerate(other_runs(run, paper)):
        monkeypatch.setattr(robustness, "everything", lambda r, n=number: uncertain_plants(r, n))
        costs = np.random.default_rng(number)
        other.cost = lambda *_, costs=costs: float(costs.uniform(1.0, 2.0))
        with np.errstate(all="ignore"), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            measured = preset.measured(other)
        for name, value in measured.items():
            if isinstance(value, Claim):
                words.setdefault(name, set()).add(parts(value))
            elif repr(value) != repr(first[name]):
                moved.add(name)
    rows = {name: papers.verdict(preset.published[name], value)[0] for name, value in first.items()}
    stuck = {name for name in words if name in rows and len(words[name]) < 2}
    stuck = {name for name in stuck if not name.startswith("uncertain plants")}  # made up here
    assert {name for name in stuck if isinstance(first[name], Claim)} - COUNTED == set()
    numbers = {n for n, word in rows.items() if not isinstance(first[n], Claim) and word != "input"}
    assert numbers - moved - QUOTED == set()


# a count of operations, which no trajectory changes: its own test is below
COUNTED = {"computation of CHADPC"}
# numbers of a case of ours that are not the printed ones, and a count that no number changes
QUOTED = {"pulses of H2, one pump", "pulses of H1 and H2, two pumps", "relative degree"}


def test_the_operations_of_the_observer_are_counted():
    """ENMPC computes as much as CHADPC without its observer, but for the compensation."""
    enmpc, chadpc = (presets.find(f"gouta2022/{name}") for name in ("enmpc", "chadpc"))
    bare = dataclasses.replace(enmpc, loop=dataclasses.replace(enmpc.loop, observer=Direct()))
    assert gouta2022._operations(enmpc, chadpc).holds
    assert not gouta2022._operations(enmpc, bare).holds
    # k e, f and the voltage of two tanks, and limits: some dozens, not thousands
    assert 20 < sample_operations(bare.loop, bare.clock) < 100


def test_operations_are_those_of_the_formulas():
    """A product of a matrix and a vector, a loop of known length, a root and a sum."""
    A, b = np.ones((3, 4)), np.ones(4)
    count = lambda f, *args: operations(jax.make_jaxpr(f)(*args).jaxpr)
    assert count(lambda A, b: A @ b, A, b) == 2 * 3 * 4
    grow = lambda b: jax.lax.scan(lambda x, _: (x * x + b, None), b, None, length=10)[0]
    assert count(grow, b) == 10 * (4 + 4)
    assert count(lambda b: jax.jit(jax.numpy.sqrt)(b).sum(), b) == 4 + 4


@pytest.mark.slow
def test_the_tuned_gains_are_the_optima_that_tune_ends_at():
    """Slopes of J there are below a thousandth of what they are at the given gains."""
    jax.config.update("jax_enable_x64", True)
    case = presets.find("mirakhorli/sfc")
    problem = Problem(case, limits={})
    tuned = Problem(rig.set_values(case, mirakhorli.TUNED["sfc"]), limits={})
    first, last = (np.abs(p.point(p.start()).gradient).max() for p in (problem, tuned))
    assert last < 1e-3 * first
    assert papers.cost(case) == pytest.approx(problem.point(problem.start()).cost, rel=1e-9)
