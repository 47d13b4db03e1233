"""Probabilities of rare failures against closed forms."""

import numpy as np
import pytest
from helpers import command
from scipy import stats

from jaxtank import Pump, Rig, Tank, presets
from jaxtank.limits import Limit
from tuning import Correlated, Discrete, ensemble
from tuning.uncertainty import promise as rare_events
from tuning.uncertainty.draws import Draws

SIDE = np.array([0.6, 0.8, 0.0])


def numbers_of(function, promise=1e-4, seed=0, dimensions=3):
    """The Failures of margins function(z) -> (n, K), with differences for slopes."""

    def slopes(z):
        moves = 1e-5 * np.eye(z.shape[1])
        rates = [(function(z + m) - function(z - m)) / 2e-5 for m in moves]
        return function(z), np.stack(rates, axis=-1)

    pilot = np.random.default_rng(seed + 50).standard_normal((500, dimensions))
    margins = rare_events.Margins(function, function, slopes)
    pair = pilot, function(pilot)
    return rare_events.probability(margins, pair, promise, 50_000, seed)


PROBLEMS = {
    "a plane": (lambda z: 4.0 - z[:, :1], stats.norm.sf(4.0)),
    "two planes in two directions": (
        lambda z: np.stack([4.0 - z @ SIDE, 4.2 + z[:, 2]], axis=1),
        1.0 - stats.norm.cdf(4.0) * stats.norm.cdf(4.2),
    ),
    "one limit, broken on either side": (lambda z: 16.0 - z[:, :1] ** 2, 2 * stats.norm.sf(4.0)),
    "a ball outside": (lambda z: 25.0 - np.sum(z**2, axis=1)[:, None], stats.chi2.sf(25.0, 3)),
    "a corner of a box": (lambda z: 2.9 - np.sum(stats.norm.cdf(z), axis=1)[:, None], 0.1**3 / 6),
    "a plane without a slope": (lambda z: np.where(z[:, :1] > 3.5, -1.0, 1.0), stats.norm.sf(3.5)),
}


@pytest.mark.slow_for(
    "a ball outside",
    "a corner of a box",
    "two planes in two directions",
    "one limit, broken on either side",
)
@pytest.mark.extended_for("a plane without a slope")
@pytest.mark.parametrize("name", PROBLEMS)
def test_probabilities_are_those_of_closed_forms(name):
    function, exact = PROBLEMS[name]
    results = [numbers_of(function, seed=seed) for seed in range(6)]
    ratios = np.array([r.estimate.probability for r in results]) / exact
    assert np.all(np.abs(ratios - 1.0) < 0.3) and abs(ratios.mean() - 1.0) < 0.1
    inside = [r.estimate.interval95[0] <= exact <= r.estimate.interval95[1] for r in results]
    assert sum(inside) >= 5
    assert max(r.runs + r.gradients for r in results) < 20_000


def test_the_most_likely_failure_is_the_foot_of_the_plane():
    result = numbers_of(lambda z: 2.0 * (3.5 - z @ SIDE)[:, None])
    np.testing.assert_allclose(result.centres[0], 3.5 * SIDE, atol=0.3)
    assert result.subset is None


def test_subset_simulation_needs_no_slopes():
    exact = (2 * stats.norm.sf(3.2)) ** 2

    def function(z):
        return np.floor(50.0 * (3.2 - np.min(np.abs(z), axis=1)))[:, None]

    margins = rare_events.Margins(function, function, None)
    estimates = []
    for seed in range(10):
        size, failing = rare_events.subset_simulation(margins, 2, np.random.default_rng(seed))
        assert np.all(function(failing) < 0)
        estimates.append(size)
    assert np.mean(estimates) == pytest.approx(exact, rel=0.5)


def test_a_weighted_count_has_the_interval_of_a_poisson_count_where_weights_are_equal():
    low, high = rare_events.interval(np.full(7, 1e-3), 1e-3)
    assert low == pytest.approx(1e-3 * stats.gamma.ppf(0.025, 7))
    assert high == pytest.approx(1e-3 * stats.gamma.ppf(0.975, 8))
    low, high = rare_events.interval(np.zeros(0), 1e-3)
    assert low == 0.0 and high == pytest.approx(1e-3 * stats.gamma.ppf(0.975, 1))


RIG = """
name = "two basins"
tank = [{ area = 10.0, rim = 14.7, level = 1.0 }, { area = 10.0, rim = 14.6, level = 1.0 }]
pump = [{ gain = 2.0, to = 1, high = 10.0 }, { gain = 2.0, to = 2, high = 10.0 }]
plant = { outputs = [1, 2], overflow = true }
controller = { kind = "open-loop", initial = [3.0, 3.0] }
reference = { initial = [5.0, 5.0] }
values = { "clock.dt" = 0.5, "clock.duration" = 20.0 }
limits = { max_level = "rim" }
"""


@pytest.mark.parametrize("promise, code, answer", [(8e-3, 0, "kept"), (1e-3, 4, "not kept")])
def test_two_tanks_that_fill_overflow_as_often_as_their_gains_are_large(
    tmp_path, promise, code, answer
):
    """Each level is 1 + 6 gain at the end: a closed form of the normal distribution, whose tail
    counts; below its rim a tank shows no overflow and no slope of it."""
    (tmp_path / "rig.toml").write_text(RIG)
    words = ["uncertainty", str(tmp_path / "rig.toml"), "--vary", "plant.pump_gain=normal:2:0.1"]
    words += ["--measure", "max_level", "--promise", str(promise), "--json", "--quiet"]
    done = command(*words)
    normal = stats.norm(loc=2.0, scale=0.1)
    each = normal.sf((14.7 - 1.0) / 6.0), normal.sf((14.6 - 1.0) / 6.0)
    exact = 1.0 - (1.0 - each[0]) * (1.0 - each[1])
    result = done.json["promise"]
    assert result["cut"] == 7.0
    assert done.code == code and result["answer"] == answer
    assert result["probability"] == pytest.approx(exact, rel=0.25)
    assert result["interval95"][0] < exact < result["interval95"][1]
    assert result["limits"]["overflow_volume of tank 2"] == pytest.approx(
        each[1] / sum(each), abs=0.1
    )
    likely = result["failures"][0]["values"]["plant.pump_gain[1]"]
    assert likely == pytest.approx(13.6 / 6.0, rel=0.01)


def promise_of_one_tank(distributions, limit=44.0):
    rig = Rig(
        name="one tank", tanks=[Tank("T", area=1.0, rim=100.0, drain_linear=20.0, level=40.0)],
        pumps=[Pump("P", to="T", gain=1.0, high=10.0, initial=2.0)],
        controller={"kind": "open-loop"}, inputs=[[0.0, 2.0]], reference=[[0, 20.0]],
        limits={"max_level": limit}, dt=5.0, duration=400.0,
    )  # fmt: skip
    return ensemble(rig, distributions, samples=300, key=0, fan=False, promise=4e-3)


@pytest.mark.parametrize("values, weights", [((1.0, 1.2), (999, 1)), ((1, 1.2, 1), (1, 0.002, 1))])
def test_a_rare_value_of_a_discrete_distribution_is_named_as_the_failure(values, weights):
    """48 at a gain of 1.2, 40 at a gain of 1."""
    result = promise_of_one_tank({"plant.pump_gain": Discrete(values=values, weights=weights)})
    assert result.promise.interval95[0] < 1e-3 < result.promise.interval95[1]
    assert result.promise.failures[0]["values"] == {"plant.pump_gain[0]": 1.2}
    assert "plant.pump_gain[0]" in str(result)


@pytest.mark.parametrize("limit, answer", [(44.0, "kept"), (30.0, "not kept")])
def test_plants_that_are_all_alike_keep_a_promise_or_none_does(limit, answer):
    result = promise_of_one_tank({"plant.pump_gain": Discrete(values=(1.0,))}, limit)
    assert result.promise.answer == answer and "Promise" in str(result)


def test_entries_that_cancel_each_other_are_seen_to_differ():
    pair = Correlated(names=("x0[0]", "x0[1]"), covariance=((1.0, -1.0), (-1.0, 2.0)), mean=(5, 5))
    space = Draws(presets.find("cascaded/pi").loop, {"pair": pair})
    study = rare_events.Study(None, space, (), (), None, 0, 1)
    np.testing.assert_array_equal(study.moving(), [0, 1])


class Runs:
    """Margins that count the runs: a plane at a distance from the origin."""

    def __init__(self, distance):
        self.distance, self.runs = distance, 0

    def judged(self, z):
        self.runs += len(z)
        return self.distance - z[:, :1]


def test_batches_run_until_the_estimate_is_accurate_or_its_runs_are_spent():
    rng, mixture = np.random.default_rng(2), rare_events.mixture_of(np.zeros((0, 2)))
    for most, accurate in ((100_000, True), (1000, False)):
        sample, runs = rare_events.Sample(mixture, 0), Runs(2.0)
        assert not sample.draw(runs, 1e-4, most, rng, np.inf, last=True, progress=None)
        estimate = sample.estimate()
        assert (estimate.variation <= rare_events.ACCURACY) == accurate and runs.runs <= most
        assert accurate or runs.runs + rare_events.BATCH > most
    assert abs(estimate.probability / stats.norm.sf(2.0) - 1.0) < 0.8


def test_failures_that_no_centre_explains_ask_for_a_better_mixture_but_for_the_last_time(
    monkeypatch,
):
    monkeypatch.setattr(rare_events.Mixture, "apart", lambda self, z, w: np.ones(len(w), bool))
    rng, mixture = np.random.default_rng(2), rare_events.mixture_of(np.zeros((0, 2)))
    for last in (False, True):
        sample = rare_events.Sample(mixture, 0)
        better = sample.draw(Runs(2.0), 1e-4, 4_000, rng, np.inf, last=last, progress=None)
        assert better == (not last) and len(sample.hits) >= rare_events.FEWEST_HITS


def test_a_margin_counts_as_a_share_of_its_limit():
    case = presets.find("cascaded/pi")
    limits = (Limit("max_level", 0, 5.0), Limit("max_level", 1, 8.0))
    study = rare_events.Study(case, None, limits, ("max_level",), None, 0, 1)
    margins = study.margins({"max_level": [[3.0, 9.0], [1.0, 1.0]]}, np.array([False, True]))
    np.testing.assert_allclose(margins[0], [2.0 / 5.0, -1.0 / 8.0], rtol=1e-12)
    np.testing.assert_array_equal(margins[1], -rare_events.UNDEFINED_MARGIN)
