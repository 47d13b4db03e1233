"""Draws of a posterior: against a closed form, calibrated, and as a distribution of plants."""

import sys

import numpy as np
import pytest
from calibration import one_tank, probabilities, shares
from helpers import command

import tuning
from jaxtank import rig
from jaxtank.core.errors import InputError
from tuning.uncertainty.distributions import parse
from tuning.uncertainty.draws import Draws

NAMES = ("plant.pump_gain[0]", "plant.drain[0]")
ROWS = np.array([[2.9, 0.05], [3.0, 0.051], [3.1, 0.052], [3.05, 0.049]])


@pytest.fixture
def tank(tmp_path):
    return one_tank(tmp_path)[0]


def test_plants_are_the_rows_of_a_file_of_draws(tank, tmp_path):
    heads = ",".join(f'"{name}"' for name in NAMES)
    np.savetxt(tmp_path / "draws.csv", ROWS, delimiter=",", header=heads, comments="")
    draws = parse("posterior", f"draws:{tmp_path / 'draws.csv'}")
    np.testing.assert_allclose(draws.covariance, np.cov(ROWS.T), rtol=1e-9)
    space = Draws(tank.loop, {"posterior": draws})
    p = np.random.default_rng(0).random((4000, space.dimensions))
    values = np.stack([space.values(p)[name] for name in NAMES], axis=1)
    rows, counts = np.unique(values, axis=0, return_counts=True)
    np.testing.assert_allclose(rows, ROWS[np.lexsort(ROWS.T[::-1])])
    assert np.all(np.abs(counts / 4000 - 0.25) < 0.03)


@pytest.mark.parametrize(
    "text", ["", '"x0[0]"\n1\n2\n', '"x0[0]","x0[1]"\n1\n2\n3\n', '"x0[0]"\na\nb\nc\n']
)
def test_files_without_draws_are_refused(tmp_path, text):
    (tmp_path / "draws.csv").write_text(text)
    with pytest.raises(InputError):
        parse("posterior", f"draws:{tmp_path / 'draws.csv'}")


def test_draws_have_no_tail_to_promise_anything_of(tank):
    draws = tuning.empirical(NAMES, ROWS)
    with pytest.raises(InputError, match="no tail"):
        limits = {"max_level": 18.0}
        tuning.ensemble(tank, {"all": draws}, samples=8, limits=limits, promise=1e-3, fan=False)


def test_hmc_without_blackjax_is_refused_before_the_search(tmp_path, monkeypatch, tank):
    monkeypatch.setitem(sys.modules, "blackjax", None)
    (tmp_path / "log.csv").write_text("t [s],pump1 [V],h1 [cm]\n0,1,5\n1,1,5\n2,1,5\n")
    words = [str(tmp_path / "one.toml"), "--data", str(tmp_path / "log.csv")]
    done = command("identify", *words, "--posterior", "hmc", "--out", str(tmp_path / "out"))
    assert done.code == 2 and "pip install blackjax" in done.err
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_draws_of_a_linear_model_are_those_of_its_normal_posterior(tank):
    """A tank without a drain: the level is linear in the gain."""
    from tuning.identification.posterior import with_draws

    closed = rig.set_values(tank, {"plant.drain": [0.0], "x0": [1.0]})
    t, u = np.arange(40.0), 1.0 + (np.arange(40) % 7)
    inflow = np.append(0.0, np.cumsum(u)[:-1]) / 10.0  # level = 1 + gain * inflow
    y = 1.0 + 0.6 * inflow + 0.05 * np.random.default_rng(3).standard_normal(40)
    log = tuning.log(t=t, u=u, y=y)
    free = {"plant.pump_gain": (0.1, 2.0, "linear")}
    fit = tuning.identify(closed, log, free, start="case", starts=1, hold_back=0)
    posterior = with_draws(fit).posterior
    gain = inflow @ (y - 1.0) / (inflow @ inflow)
    sd = np.sqrt(np.sum((y - 1.0 - gain * inflow) ** 2) / 39 / (inflow @ inflow))
    assert posterior.mixed and min(posterior.effective.values()) > 400
    assert posterior.values.mean() == pytest.approx(gain, abs=0.2 * sd)
    assert posterior.values.std() == pytest.approx(sd, rel=0.1)


@pytest.mark.slow
def test_laplace_posteriors_are_calibrated(tank):
    assert np.all(probabilities(shares(tank, NAMES, 40, seed=1)) > 0.01)
