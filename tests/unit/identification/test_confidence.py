"""Covariance of estimates whose residuals are correlated, against sums over all pairs."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.signal import lfilter

from tuning.identification.confidence import Spread
from tuning.identification.residuals import autocorrelation


@pytest.mark.parametrize("uneven", [False, True])
def test_a_covariance_with_correlated_residuals_is_a_sum_over_pairs_of_samples(uneven):
    """S = J' C J, with C of first-order noise: rho^|t_i - t_j|, in median steps."""
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
    spread.earlier, spread.freedom = np.zeros((0, size)), samples - size
    spread.scale = float(residual[0] @ residual[0]) / spread.freedom
    _, spread.singular, spread.axes = np.linalg.svd(jacobian, full_matrices=False)
    spread.open_axes = np.zeros(size, dtype=bool)
    spread._newey_west = lambda: np.zeros((size, size))
    spread._set_covariance([0.8])

    rho = autocorrelation(residual, 1)[1]
    rho += (1 + 4 * rho) / samples  # the bias of an estimate from so many samples
    t = np.concatenate([[0.0], np.cumsum(steps[0])])[:samples]
    correlation = rho ** (np.abs(t[:, None] - t) / np.median(steps))
    inverse = np.linalg.inv(jacobian.T @ jacobian)
    middle = spread.scale * jacobian.T @ correlation @ jacobian
    np.testing.assert_allclose(spread.covariance, inverse @ middle @ inverse, rtol=1e-9)
    ratio = np.sqrt(np.diag(spread.covariance) / np.diag(inverse * spread.scale))
    assert spread.widened == pytest.approx(np.median(ratio)) and spread.widened > 2
