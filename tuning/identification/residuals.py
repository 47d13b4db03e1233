"""Noise of the readings and residuals of a fit: quality, autocorrelation, prediction of a
validation set.
"""

from typing import Any

import numpy as np

from jaxtank.core.errors import InputError
from tuning.identification import simulation

ENOUGH = 10
"""Fewest second differences from which the noise of a channel is estimated."""
LAGS = 60
ROBUST_LIMIT = 3.0
"""Residual, in standard deviations, beyond which a robust loss reduces its weight."""


def given_noise(noise, channels):
    """Return (channels,) standard deviations that were given, one for all or one each."""
    noise = np.atleast_1d(np.asarray(noise, dtype=float))
    if noise.shape not in ((1,), (channels,)) or not np.all(np.isfinite(noise) & (noise > 0)):
        raise InputError(
            f"noise = {noise.tolist()}: must be one standard deviation above 0, or one for each of"
            f" the {channels} channels"
        )
    return np.broadcast_to(noise, (channels,))


def noise_of(data):
    """Return (channels,) standard deviation of the noise in PaddedData."""
    # Estimated from second differences, for a level is smooth, by their median absolute deviation,
    # which steps do not affect. At least a thousandth of the range of the channel: with less,
    # weights would be those of round-off.
    found, least = [], []
    for c in range(len(data.channels)):
        bends, spans = [], []
        for y in data.y[..., c]:
            # consecutive readings only: across a gap a level is not smooth
            bend = np.abs(np.diff(y, 2)) / np.sqrt(6.0)
            bends.append(bend[np.isfinite(bend)])
            present = y[np.isfinite(y)]
            spans.append(np.ptp(present) if present.size else 0.0)
        bends = np.concatenate(bends)
        least.append(max(1e-3 * max(spans), 1e-12))
        found.append(
            max(1.4826 * float(np.median(bends)), least[-1]) if bends.size >= ENOUGH else np.nan
        )
    for c, (_, volts) in enumerate(data.channels):
        # too few readings: the noise of other channels of this kind, or a hundredth of the range
        if np.isnan(found[c]):
            alike = [
                v
                for v, (_, other) in zip(found, data.channels)
                if other == volts and np.isfinite(v)
            ]
            found[c] = (
                max([*alike, least[c]])
                if alike
                else max(10 * least[c], 1e-3 * np.nanmax(np.abs(data.y[..., c])))
            )
    return np.array(found)


def residuals_of(estimation, fit):
    """Return (logs, samples, channels) measured minus simulated, NaN where there is no reading."""
    y = estimation.predicted(estimation.unknowns(fit))
    return np.where(estimation.mask, estimation.data.y - y, np.nan)


def quality(estimation, fit):
    """Return {"rmse", "nrmse_percent", "residual_autocorrelation"}, one entry per channel."""
    residuals = residuals_of(estimation, fit)
    found = {"rmse": [], "nrmse_percent": [], "residual_autocorrelation": []}
    for c in range(residuals.shape[-1]):
        r = residuals[..., c]
        y = np.where(estimation.mask[..., c], estimation.data.y[..., c], np.nan)
        found["rmse"].append(float(np.sqrt(np.nanmean(r**2))))
        found["nrmse_percent"].append(percent(r, y))
        found["residual_autocorrelation"].append(float(autocorrelation(r, 1)[1]))
    return found


def percent(residual, y):
    """Return 100 (1 - |residual| / |y - mean y|), as MATLAB's `compare`; None for a constant y."""
    spread = np.sqrt(np.nansum((y - np.nanmean(y)) ** 2))
    return (
        float(100 * (1 - np.sqrt(np.nansum(residual**2)) / spread))
        if spread > 1e-9 * np.sqrt(np.nansum(y**2))
        else None
    )


def autocorrelation(residual, lags=LAGS):
    """Return (lags + 1,) autocorrelation of residuals (logs, samples), NaN skipped."""
    lags = min(lags, residual.shape[-1] - 2)
    present = np.isfinite(residual)
    products, pairs = (
        _lagged(v, lags) for v in (np.where(present, residual, 0.0), present.astype(float))
    )
    total = products[0] / max(pairs[0], 1.0)
    usable = (np.round(pairs) > 0) & (total > 0)
    found = np.where(usable, products / np.maximum(np.round(pairs), 1.0) / (total or 1.0), 0.0)
    found[0] = 1.0
    return found


def _lagged(v, lags):
    """Return (lags + 1,) sums of v_k v_{k + lag} over v (logs, samples), by FFT."""
    n = v.shape[-1]
    spectrum = np.fft.rfft(v, 2 * n, axis=-1)
    return np.fft.irfft(np.sum(np.abs(spectrum) ** 2, axis=tuple(range(v.ndim - 1))), 2 * n)[
        : lags + 1
    ]


def pseudo(fit):
    """Return (rows,) pseudo-residuals psi(r) / mean psi'(r) (Huber, Robust Statistics,
    1981, 7.6).
    """
    r, limit = fit.residual, ROBUST_LIMIT
    if fit.loss == "huber":
        inside = np.abs(r) < limit
        return np.clip(r, -limit, limit) / max(float(inside.mean()), 1e-3)
    if fit.loss == "soft_l1":
        root = np.sqrt(1.0 + (r / limit) ** 2)
        return r / root / float(np.mean(root**-3))
    return r


def validate(estimation, partial, fit, kept):
    """Return how a fit to the first `kept` samples of each log predicts the rest."""
    z = partial.unknowns(fit)
    predicted = np.asarray(
        simulation.play(
            partial.rig_at(z),
            estimation.data.dt,
            estimation.data.u,
            partial.first_levels(z),
            channels=estimation.data.channels,
            substeps=partial.substeps,
        )
    )
    y = np.where(estimation.mask, estimation.data.y, np.nan)
    residual, sample = y - predicted, np.arange(y.shape[1])
    fitted = sample < np.array(kept)[:, None]  # (logs, samples)
    found: dict[str, Any] = {"samples": [int(n) for n in kept]}
    for side, rows in (("fitted", fitted), ("held_back", ~fitted)):
        found[side] = {"rmse": [], "nrmse_percent": []}
        for c in range(y.shape[-1]):
            r, measured = (np.where(rows, v[..., c], np.nan) for v in (residual, y))
            present = np.isfinite(r).any()
            found[side]["rmse"].append(float(np.sqrt(np.nanmean(r**2))) if present else None)
            found[side]["nrmse_percent"].append(percent(r, measured) if present else None)
    return found
