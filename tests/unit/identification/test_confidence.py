"""Covariance of estimates whose residuals are correlated, and the noise from sample to sample,
against sums over all pairs.
"""

from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.signal import lfilter

from tuning.identification.confidence import Spread
from tuning.identification.diagnosis import noise_of_tests
from tuning.identification.residuals import autocorrelation


@pytest.mark.parametrize("uneven", [False, True])
@pytest.mark.parametrize("earlier", [np.zeros((0, 2)), np.array([[3.0, 1.0], [0.0, 2.0]])])
def test_a_covariance_with_correlated_residuals_is_a_sum_over_pairs_of_samples(uneven, earlier):
    """S = J' C J, with C of first-order noise: rho^|t_i - t_j|, in median steps. Rows of an
    earlier fit count as white noise.
    """
    rng = np.random.default_rng(3)
    samples, size = 400, 2
    steps = rng.choice([1.0, 2.0, 4.0], (1, samples)) if uneven else np.full((1, samples), 2.0)
    residual = lfilter([1.0], [1.0, -0.8], rng.standard_normal((1, samples)))
    jacobian = rng.standard_normal((samples, size)).cumsum(axis=0) / 20
    spread = Spread.__new__(Spread)
    spread.estimation = SimpleNamespace(
        mask=np.ones((1, samples, 1), dtype=bool),
        data=SimpleNamespace(steps=steps, channels=[0]),
        logs=[SimpleNamespace(samples=samples)],
    )
    spread.fit = SimpleNamespace(jacobian=jacobian, residual=residual[0])
    spread.residual, spread.estimated = residual[0], np.arange(size)
    spread.earlier, spread.freedom = earlier, samples - size
    spread.scale = float(residual[0] @ residual[0]) / spread.freedom
    rows = np.concatenate([jacobian, earlier])
    _, spread.singular, spread.axes = np.linalg.svd(rows, full_matrices=False)
    spread.open_axes = np.zeros(size, dtype=bool)
    spread._newey_west = lambda: np.zeros((size, size))
    spread._set_covariance([0.8])

    rho = autocorrelation(residual, 1)[1]
    rho += (1 + 4 * rho) / samples  # the bias of an estimate from so many samples
    t = np.concatenate([[0.0], np.cumsum(steps[0])])[:samples]
    correlation = rho ** (np.abs(t[:, None] - t) / np.median(steps))
    inverse = np.linalg.inv(rows.T @ rows)
    middle = spread.scale * (jacobian.T @ correlation @ jacobian + earlier.T @ earlier)
    np.testing.assert_allclose(spread.covariance, inverse @ middle @ inverse, rtol=1e-9)
    ratio = np.sqrt(np.diag(spread.covariance) / np.diag(inverse * spread.scale))
    assert spread.widened == pytest.approx(np.median(ratio)) and spread.widened > 2


def test_the_noise_of_a_channel_is_that_of_its_steps_between_two_readings():
    """A slow misfit of 0.5 over 300 samples is no noise; every third reading is missing in one
    channel, every second, so all steps, in another, and one has hardly any noise.
    """
    rng = np.random.default_rng(5)
    residual = 0.3 * rng.standard_normal((1, 300, 4)) + np.linspace(0.0, 0.5, 300)[:, None]
    residual[0, ::3, 1] = residual[0, ::2, 2] = np.nan
    residual[..., 3] *= 1e-3
    estimation = SimpleNamespace(
        mask=np.isfinite(residual),
        data=SimpleNamespace(y=residual),
        noise=np.array([0.7, 0.7, 0.9, 0.5]),
        unknowns=lambda fit: None,
        predicted=lambda z: 0.0,
    )
    noise = noise_of_tests(estimation, None)
    for c in (0, 1):
        steps = [b - a for a, b in pairwise(residual[0, :, c]) if np.isfinite(b - a)]
        assert len(steps) == (299, 100)[c]
        assert noise[c] == pytest.approx(np.sqrt(np.mean(np.square(steps)) / 2))
    assert noise[2:].tolist() == [0.9, 0.05]
