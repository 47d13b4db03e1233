"""Noise of readings and residuals of a fit: quality, autocorrelation, validation."""

import numpy as np

from jaxtank.core.errors import InputError

ENOUGH = 10  # fewest second differences from which the noise of a channel is estimated
OVERSTATED = 0.8  # share of the noise of readings below which that of residuals is taken
LAGS = 60
WHITE = 3.0  # largest autocorrelation of white residuals at lag 1, in 1/sqrt(n)
ROBUST_LIMIT = 3.0  # residual, in noise, from which a robust loss reduces its weight


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
    # median absolute second differences: a level is smooth, and steps do not affect the median
    span, least = _ranges(data)
    noise = np.full(least.shape, np.nan)
    for c in range(len(least)):
        # of consecutive readings only: across a gap a level is not smooth
        bends = np.abs(np.diff(data.y[..., c], 2, axis=1)) / np.sqrt(6.0)
        bends = bends[np.isfinite(bends)]
        if bends.size >= ENOUGH and span[..., c].max() > 0.0:
            noise[c] = max(1.4826 * np.median(bends), least[c], _rounding(data.y[..., c]))
    volts = np.array([in_volts for _, in_volts in data.channels])
    for c in np.flatnonzero(np.isnan(noise)):
        # too few readings, or none that move: the noise of like channels, or a share of the range
        alike = noise[(volts == volts[c]) & np.isfinite(noise)]
        largest = np.nanmax(np.abs(data.y[..., c]))
        noise[c] = max([*alike, least[c]] if alike.size else [10 * least[c], 1e-3 * largest])
    return noise


def _ranges(data):
    """Return ((logs, channels) ranges, (channels,) least noise, above round-off)."""
    present = np.isfinite(data.y)
    top = np.max(data.y, axis=1, where=present, initial=-np.inf)
    span = top - np.min(data.y, axis=1, where=present, initial=np.inf)
    return span, np.maximum(1e-3 * span.max(axis=0), 1e-12)


def fast_noise(estimation, fit):
    """Return (channels,) noise of residuals from sample to sample; NaN without neighbours."""
    steps = np.diff(residuals_of(estimation, fit), axis=1) / np.sqrt(2.0)
    known = np.isfinite(steps)
    squares = np.sum(steps**2, axis=(0, 1), where=known)
    return np.sqrt(squares / np.where(known.any((0, 1)), known.sum((0, 1)), np.nan))


def weighting_noise(estimation, fit):
    """Return (channels,) noise: that of the residuals where the readings' bends overstate it."""
    data, noise = estimation.data, estimation.noise
    count = np.isfinite(np.diff(data.y, axis=1)).sum(axis=(0, 1))
    freedom = 1.0 - estimation.size / max(int(estimation.mask.sum()), 1)
    rounding = [_rounding(y) for y in np.moveaxis(data.y, -1, 0)]
    least = np.maximum(_ranges(data)[1], rounding)
    fast = np.maximum(fast_noise(estimation, fit) / np.sqrt(freedom), least)
    return np.where((count >= ENOUGH) & (fast < OVERSTATED * noise), fast, noise)  # NaN: none


def _rounding(y):
    """Return the rounding error (sd) of a sensor; 0 where readings do not repeat on a grid."""
    y = y[np.isfinite(y)]
    values = np.unique(y)
    steps = np.diff(values)
    steps = steps[steps > 1e-9 * np.ptp(values)] if steps.size else steps
    if y.size - values.size < ENOUGH or not steps.size:
        return 0.0
    cells = steps / steps.min()
    step = float(steps.min()) if np.all(np.abs(cells - np.round(cells)) < 0.01) else 0.0
    return step / np.sqrt(12.0)


def at_samples(estimation, rows):
    """Return (logs, samples, channels) of one number for each reading; NaN where there is none."""
    full = np.full(estimation.mask.shape, np.nan)
    full[estimation.mask] = rows
    return full


def residuals_of(estimation, fit):
    """Return (logs, samples, channels) measured minus simulated, NaN where there is no reading."""
    y = estimation.predicted(estimation.unknowns(fit))
    return np.where(estimation.mask, estimation.data.y - y, np.nan)


def rms_of(estimation, fit):
    """Return (channels,) RMS of `residuals_of`."""
    return np.sqrt(np.nanmean(residuals_of(estimation, fit) ** 2, axis=(0, 1)))


def quality(y, residual):
    """Return {"rmse", "nrmse_percent", "residual_autocorrelation"} of each channel."""
    rho = [float(autocorrelation(r, 1)[1]) for r in np.moveaxis(residual, -1, 0)]
    return fit_of(y, residual) | {"residual_autocorrelation": rho}


def fit_of(y, residual):
    """Return {"rmse", "nrmse_percent"} of each channel, None where it has no residual."""
    fit = {"rmse": [], "nrmse_percent": []}
    for values, r in zip(np.moveaxis(y, -1, 0), np.moveaxis(residual, -1, 0)):
        present = np.isfinite(r).any()
        fit["rmse"].append(float(np.sqrt(np.nanmean(r**2))) if present else None)
        fit["nrmse_percent"].append(_percent(np.where(np.isnan(r), np.nan, values), r))
    return fit


def _percent(y, residual):
    """Return 100 (1 - |residual| / |y - mean y|), as MATLAB's `compare`; None for a constant y."""
    if not np.isfinite(y).any():
        return None
    spread = np.sqrt(np.nansum((y - np.nanmean(y)) ** 2))
    if spread <= 1e-9 * np.sqrt(np.nansum(y**2)):
        return None
    return float(100 * (1 - np.sqrt(np.nansum(residual**2)) / spread))


def autocorrelation(residual, lags=LAGS):
    """Return (lags + 1,) autocorrelation of residuals (logs, samples), NaN skipped."""
    lags = min(lags, residual.shape[-1] - 2)
    present = np.isfinite(residual)
    products = _lagged(np.where(present, residual, 0.0), lags)
    pairs = _lagged(present.astype(float), lags)
    total = products[0] / max(pairs[0], 1.0)
    usable = (np.round(pairs) > 0) & (total > 0)
    result = np.where(usable, products / np.maximum(np.round(pairs), 1.0) / (total or 1.0), 0.0)
    result[0] = 1.0
    return result


def is_white(residual):
    """Whether residuals (logs, samples) of a channel are not correlated from sample to sample."""
    limit = WHITE / np.sqrt(max(np.isfinite(residual).sum(), 1))
    return bool(abs(autocorrelation(residual, 1)[1]) < limit)


def _lagged(v, lags):
    """Return (lags + 1,) sums of v_k v_{k + lag} over v (logs, samples), by FFT."""
    n = v.shape[-1]
    power = np.sum(np.abs(np.fft.rfft(v, 2 * n, axis=-1)) ** 2, axis=tuple(range(v.ndim - 1)))
    return np.fft.irfft(power, 2 * n)[: lags + 1]


def pseudo(fit):
    """Return (rows,) pseudo-residuals psi(r) / mean psi'(r) (Huber, Robust Statistics, 7.6)."""
    r, limit = fit.residual, ROBUST_LIMIT
    if fit.loss == "huber":
        inside = np.abs(r) < limit
        return np.clip(r, -limit, limit) / max(float(inside.mean()), 1e-3)
    if fit.loss == "soft_l1":
        root = np.sqrt(1.0 + (r / limit) ** 2)
        return r / root / float(np.mean(root**-3))
    return r


def validate(estimation, partial, fit, counts):
    """Return how a fit of `partial` to the first samples of each log predicts the rest."""
    predicted = partial.predicted(partial.unknowns(fit), estimation.data)
    residual = np.where(estimation.mask, estimation.data.y - predicted, np.nan)
    first = (np.arange(residual.shape[1]) < np.array(counts)[:, None])[..., None]
    return {
        "samples": [int(n) for n in counts],
        "fitted": fit_of(estimation.data.y, np.where(first, residual, np.nan)),
        "held_back": fit_of(estimation.data.y, np.where(first, np.nan, residual)),
    }
