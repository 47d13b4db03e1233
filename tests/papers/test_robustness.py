"""gouta2015 sec. 5.3: what the laws make of coefficients that are off (gouta2015 notes S11), with
intervals.
"""

import numpy as np
import observers
import pytest
from scipy.stats import beta

import jaxtank
from jaxtank import presets, rig
from jaxtank.core.tree import with_values
from jaxtank.presets.rows import robustness
from jaxtank.presets.rows.robustness import CONTROLLERS, N, above_zero, interval
from tuning.report.papers import runner

# law, spread, mean, sd, p5, p50, p95 of the total RMS error [cm], mean largest error at the
# plateaus' ends [cm]
ROWS = [
    ("ngpc", 0.05, 0.467, 0.210, 0.226, 0.418, 0.875, 0.375),
    ("backstepping", 0.05, 0.877, 0.174, 0.697, 0.834, 1.244, 0.445),
    ("ngpc", 0.10, 0.837, 0.458, 0.268, 0.769, 1.669, 0.754),
    ("backstepping", 0.10, 1.224, 0.464, 0.707, 1.120, 2.195, 0.892),
]


@pytest.fixture(scope="module")
def everything():
    return robustness.everything(runner("gouta2015"))


@pytest.fixture(scope="module")
def errors(everything):
    """{(law, spread): (N,) total RMS errors [cm]}, and of the nominal plant {law: number}."""
    found, nominal = everything
    return {key: f.measures["rms_error_total"] for key, f in found.items()}, nominal


@pytest.mark.slow
@pytest.mark.parametrize("controller, spread, mean, sd, p05, p50, p95, rest", ROWS)
def test_rows_of_the_study(everything, errors, controller, spread, mean, sd, p05, p50, p95, rest):
    """Within three standard errors of two samples of 200 (the study's draws are in another order);
    of a quantile by the binomial law.
    """
    values = errors[0][controller, spread]
    assert values.mean() == pytest.approx(mean, abs=3 * sd * np.sqrt(2 / N))
    kurtosis = np.mean((values - values.mean()) ** 4) / values.var() ** 2
    assert values.std(ddof=1) == pytest.approx(
        sd, abs=3 * sd * np.sqrt(2 * (kurtosis - 1) / (4 * N))
    )
    for p, expected in ((0.05, p05), (0.5, p50), (0.95, p95)):
        half = 3 * np.sqrt(2 * p * (1 - p) / N)
        low, high = np.quantile(values, (max(0.0, p - half), min(1.0, p + half)))
        assert low <= expected <= high
    found = everything[0][controller, spread]
    ends = [round(t / robustness.EVERY) for t in robustness.CHANGES]
    worst = np.abs(found.errors[:, ends]).max(axis=(1, 2))
    assert worst.mean() == pytest.approx(rest, abs=3 * worst.std() * np.sqrt(2 / N))


@pytest.mark.slow
def test_runs_of_the_table_are_those_of_the_library(everything):
    case = rig.set_values(presets.find("gouta2015/ngpc"), robustness.SETTING)
    values = robustness.coefficients(case.loop.plant, 0.10)
    i = int(np.argmax((values["plant.drain"] >= 0).all(axis=1)))  # a plant that the door lets in
    t = jaxtank.simulate(with_values(case.loop, {n: v[i] for n, v in values.items()}), case.clock)
    found = everything[0]["ngpc", 0.10]
    e, x, u = (np.asarray(v) for v in (t.e, t.x, t.u))
    np.testing.assert_allclose(
        found.measures["rms_error_total"][i], np.sqrt((e**2).mean(axis=0).sum()), rtol=1e-9
    )
    np.testing.assert_allclose(found.measures["max_level"][i], x.max(axis=0), rtol=1e-9)
    np.testing.assert_allclose(
        found.measures["input_travel"][i], np.abs(np.diff(u, axis=0)).sum(axis=0), rtol=1e-8
    )
    np.testing.assert_allclose(found.errors[i], e[::25], atol=1e-9)
    row = robustness.window(found, 0, 270.0, 470.0)[i]
    assert row == np.abs(found.errors[i, 540:940, 0]).max()
    assert np.asarray(t.r)[::25][540, 1] < np.asarray(t.r)[::25][620, 1]


@pytest.mark.slow
@pytest.mark.parametrize("name, largest", [("ngpc", 1e-4), ("backstepping", 1e-3)])
def test_offsets_vanish_with_the_disturbance_observer(name, largest):
    """Of the plants that can follow, 10 % off: a share of 1e-4 of the error without it is left."""
    row = observers.row(f"gouta2015/{name}", 0.10)
    assert row.follow > 80 and row.without[1] > 0.6
    assert row.share < 1e-4 and row.observed[2] < largest


def test_intervals_and_verdicts():
    rng = np.random.default_rng(5)
    estimate, low, high = interval(rng.normal(1.0, 2.0, 400))
    assert (high - low) / 2 == pytest.approx(1.96 * 2.0 / 20, rel=0.12) and low < estimate < high
    assert above_zero([(1, 0.5, 2), (1, 0.1, 2)]) == [True, True]
    assert above_zero([(-1, -2, -0.5)]) == [False]
    assert above_zero([(1, 0.5, 2), (1, -0.1, 2)]) == [True, False]
    for count, n in ((0, 50), (13, 50), (50, 50)):  # quantiles of the beta distribution
        low = beta.ppf(0.025, count, n - count + 1) if count else 0.0
        high = beta.ppf(0.975, count + 1, n - count) if count < n else 1.0
        np.testing.assert_allclose(robustness.exact(count, n), (low, high), rtol=1e-9)


def test_each_claim_follows_from_its_numbers():
    """On made-up runs: errors of backstepping four times those of NGPC, as on the nominal plant."""
    rng = np.random.default_rng(1)
    found, nominal = {}, {"ngpc": 0.1, "backstepping": 0.4}
    for spread in robustness.SPREADS:
        share = rng.uniform(1.0, 1.1, N)
        for controller in CONTROLLERS:
            size = nominal[controller] * share
            measures = {"rms_error_total": size, "max_level": np.full((N, 4), 29.0)}
            for name in ("rms_input", "input_travel", "overshoot_percent", "saturated_fraction"):
                measures[name] = size[:, None] * [1.0, 1.0]
            errors = np.zeros((N, 2401, 2)) + size[:, None, None]
            found[controller, spread] = robustness.Study(measures, errors, np.zeros(N, dtype=bool))
    verdicts = {
        n.partition(": ")[2]: c.verdict for n, c in robustness.claims(found, nominal).items()
    }
    assert verdicts["stable loops"] == verdicts["feasible trajectories"] == "reproduced"
    assert verdicts["precision"] == "reproduced" and verdicts["steady error"] == "not reproduced"
    for name in ("size of the error", "growth of the error"):  # NGPC is better, growth is equal
        assert verdicts[name] != "reproduced"
    for name in ("overshoot", "voltage", "changes of the voltage", "time at the limits"):
        assert verdicts[name] == "not reproduced"
