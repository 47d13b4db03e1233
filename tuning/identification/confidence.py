"""Confidence in a fit: standard deviations, 95 % intervals, and what is not identifiable."""

import math
from collections.abc import Sequence
from typing import Any, cast

import numpy as np
from scipy.linalg import block_diag, qr
from scipy.signal import lfilter
from scipy.stats import t as student

from jaxtank.core.tree import describe, get_value
from tuning.identification.least_squares import Fit
from tuning.identification.problem import Estimation
from tuning.identification.residuals import autocorrelation, pseudo

VAGUE = 0.5
"""Standard deviation of a direction, in units of its coordinates (logarithms, shares of a range),
above which it is not identifiable.
"""
ROUND_OFF = 1e-9
"""Singular value, as a share of the largest, below which a direction is one of round-off."""
SHARE = 0.1
"""Share of a direction's largest entry above which a parameter is named as part of it."""


class Spread:
    """Covariance of the estimates from J'J, without the directions that are not identifiable."""

    # Where residuals are correlated from sample to sample, as those of a model that differs from
    # the rig, the covariance is the sandwich (J'J)^-1 S (J'J)^-1, with S of Newey and West
    # (Econometrica 55, 1987, 703) or S = J' C J with C that of first-order noise with the
    # residuals' autocorrelation, whichever is wider: the first is too narrow for slow noise, the
    # second for slow noise under fast noise. `widened` is the factor by which this widens the
    # intervals.

    def __init__(self, estimation: Estimation, fit: Fit, correlation: Sequence[float] = ()):
        self.estimation, self.fit, self.residual = estimation, fit, pseudo(fit)
        z = estimation.unknowns(fit)
        low, high = estimation.box
        edge = 1e-6 * (high - low)
        self.at_bound = (z < low + edge) | (z > high - edge)
        inside = np.flatnonzero(~self.at_bound)
        self._decompose(inside)
        # a search along an insensitive direction may end at a bound that the data do not determine
        if self.open.any():
            count = self.open.sum()
            self._decompose(np.arange(z.size))
            if self.open.sum() == count:
                self._decompose(inside)
        self._set_covariance(correlation)
        # an unknown is vague if an open direction moves it further than its own deviation
        sd = np.sqrt(np.maximum(np.diag(self.covariance), 0))
        self.vague = np.zeros(estimation.size, dtype=bool)
        for axis, reach in zip(self.axes[self.open], np.minimum(self.sd_of_axes[self.open], 1.0)):
            self.vague[self.moving[np.abs(axis) * reach > np.maximum(0.5 * sd, 1e-6)]] = True
        self.at_bound &= ~self.vague
        self.hidden = self._with_branches(self.vague | self.at_bound)  # without an interval
        self.quantile = float(student.ppf(0.975, self.freedom))  # 95 %, two-sided
        self.values_covariance = self._covariance_of_values()
        self.sd = np.sqrt(np.diag(self.values_covariance))

    def _decompose(self, moving):
        """Set singular values and axes of the Jacobian by the unknowns `moving`."""
        # `open`: which axes are not identifiable.
        self.moving, residual = moving, self.residual
        self.freedom = max(residual.size - moving.size, 1)
        self.scale = float(residual @ residual) / self.freedom
        slopes = self.fit.jacobian[:, moving]
        _, self.singular, self.axes = np.linalg.svd(slopes, full_matrices=False)
        with np.errstate(divide="ignore", invalid="ignore"):
            sd = np.where(self.singular > 0, np.sqrt(self.scale) / self.singular, np.inf)
        self.sd_of_axes = sd
        self.open = (sd > VAGUE) | (self.singular < ROUND_OFF * self.singular.max(initial=0.0))

    def _set_covariance(self, correlation):
        """Set `covariance` of the unknowns `moving` and `widened`, for residuals with this
        correlation from sample to sample in each channel.
        """
        n = self.fit.residual.size
        s, vt = self.singular[~self.open], self.axes[~self.open]
        inverse = (vt.T / s**2) @ vt
        white = inverse * self.scale
        self.covariance, self.widened = white, 1.0
        white_noise = 3 / math.sqrt(n / len(self.estimation.data.channels))
        if max(map(abs, correlation), default=0.0) <= white_noise:
            return
        for middle in (self._newey_west() * n / self.freedom, self._first_order()):
            sandwich = inverse @ middle @ inverse
            ratio = np.sqrt(np.maximum(np.diag(sandwich), 0) / np.maximum(np.diag(white), 1e-300))
            if ratio.size and np.median(ratio) > self.widened:
                self.covariance, self.widened = sandwich, float(np.median(ratio))

    def _newey_west(self):
        """Return S of Newey and West: products of scores up to the lag of the autocorrelation."""
        estimation, shape = self.estimation, self.estimation.mask.shape
        residual = np.full(shape, np.nan)
        residual[estimation.mask] = self.residual
        longest = shape[1] // 5
        acf = np.mean(
            [np.abs(autocorrelation(residual[..., c], longest)) for c in range(shape[-1])], axis=0
        )
        lags = int(min([longest, *2 * np.flatnonzero(acf < 0.1)[:1]]))
        score = np.zeros((*shape, self.moving.size))
        score[estimation.mask] = self.fit.jacobian[:, self.moving] * self.residual[:, None]
        # Bartlett's weights 1 - lag / (lags + 1) are those of sums over windows of lags + 1 samples
        score = np.concatenate(
            [score.sum(axis=2), np.zeros((shape[0], lags, self.moving.size))], axis=1
        )
        window = np.cumsum(score, axis=1)
        window[:, lags + 1 :] -= window[:, : -lags - 1].copy()
        return np.einsum("eki,ekj->ij", window, window) / (lags + 1)

    def _first_order(self):
        """Return J' C J with C of noise correlated as rho^(time / median step) in a channel."""
        estimation, size = self.estimation, self.moving.size
        shape, dt = estimation.mask.shape, estimation.data.steps
        residual, slopes = np.full(shape, np.nan), np.zeros((*shape, size))
        residual[estimation.mask] = self.residual
        slopes[estimation.mask] = self.fit.jacobian[:, self.moving]
        samples = np.mean([log.samples for log in estimation.logs])
        steps, total = dt / np.median(dt[dt > 0]), np.zeros((size, size))
        for c in range(shape[-1]):
            rho = autocorrelation(residual[..., c], 1)[1]
            rho = float(np.clip(rho + (1 + 4 * rho) / samples, 0.0, 0.999))
            variance = np.nanmean(residual[..., c] ** 2) * self.fit.residual.size / self.freedom
            J = slopes[:, :, c]
            # the sum of rho^(time since) J of all earlier samples
            if np.ptp(steps[dt > 0]) < 1e-6:
                before = lfilter([0.0, rho], [1.0, -rho], J, axis=1)
            else:
                before = np.zeros_like(J)
                for k in range(1, shape[1]):
                    before[:, k] = (before[:, k - 1] + J[:, k - 1]) * rho ** steps[:, k - 1, None]
            product = np.einsum("eki,ekj->ij", J, before)
            total += variance * (np.einsum("eki,ekj->ij", J, J) + product + product.T)
        return total

    def _covariance_of_values(self):
        """Return (unknowns, unknowns) covariance in the rig's units, zero where one is fixed."""
        est = self.estimation
        full = np.zeros((est.size, est.size))
        full[np.ix_(self.moving, self.moving)] = self.covariance
        slopes: Any = block_diag(est.coordinates.slopes(self.fit.p), np.diag(est.level_scale))
        return slopes @ full @ slopes.T

    def _with_branches(self, chosen):
        """Return (unknowns,) bool: `chosen`, of a branch pair both."""
        chosen = chosen.copy()
        for pair in self.estimation.coordinates.pairs:
            chosen[pair] = chosen[pair].any()
        return chosen

    def parameters(self):
        """Return {name: {"before", "value", "unit", "lower", "upper", "sd", "interval95", ...}}."""
        est, rows = self.estimation, {}
        values = est.coordinates.values(self.fit.p)
        for b in est.bounds:
            i = est.coordinates.names.index(b.name)
            value, half = float(values[b.name]), self.quantile * float(self.sd[i])
            interval = _within(describe(est.case.loop, b.name), value - half, value + half)
            rows[b.name] = {
                "before": float(np.asarray(get_value(est.case.loop, b.name))),
                "value": value,
                "unit": b.unit,
                "lower": b.low,
                "upper": b.high,
                "sd": None if self.hidden[i] else float(self.sd[i]),
                "interval95": None if self.hidden[i] else interval,
                "identifiable": bool(
                    not self.vague[i] and (self.at_bound[i] or not self.hidden[i])
                ),
                "at_bound": bool(self.at_bound[i]),
            }
        return rows

    def levels(self):
        """Return {"value", "interval95"} of each tank of each log."""
        # The interval is None where the level is not estimated or not identifiable.
        est = self.estimation
        levels = est.first_levels(est.unknowns(self.fit))
        rows = [[{"value": float(v), "interval95": None} for v in row] for row in levels]
        free = [(e, tank) for e in range(len(est.logs)) for tank in est.tanks]
        for i, (e, tank) in enumerate(free, est.coordinates.size):
            value, half = float(levels[e, tank]), self.quantile * float(self.sd[i])
            if not self.hidden[i]:
                rows[e][tank]["interval95"] = [max(value - half, 0.0), value + half]
        return rows

    def covariance_of_parameters(self):
        """Return (names, (n, n)) of the parameters that have an interval, in their own units."""
        names = self.estimation.coordinates.names
        present = np.flatnonzero(~self.hidden[: len(names)])
        return tuple(names[i] for i in present), self.values_covariance[np.ix_(present, present)]

    def directions(self):
        """Return what is not identifiable, the least certain direction first."""
        est, rows = self.estimation, []
        z, shared, units = est.unknowns(self.fit), est.coordinates.size, self._units()
        for axis, sd in zip(*self._open_directions()):
            step = np.zeros(est.size)
            step[self.moving] = axis
            size = np.abs(step)
            largest = np.argmax(size)
            step *= math.log(1.1) / max(size[largest], 1e-300) * (-1 if step[largest] < 0 else 1)
            now, then = (est.coordinates.values(v[:shared]) for v in (z, z + step))
            factors, words = {}, []
            for i in np.flatnonzero(self._with_branches(size > SHARE * size.max())):
                name = est.names[i]
                if now.get(name):
                    factors[name] = float(then[name] / now[name])
                    words.append(f"{name} x {factors[name]:.3g}")
                    continue
                # of a level, or of a value that is 0: by how much it changes
                change = then[name] - now[name] if name in now else step[i] * units[name][0]
                factors[name] = float(change)
                words.append(f"{name} {factors[name]:+.2g} {units[name][1]}".rstrip(" -"))
            deviation = float(sd) if np.isfinite(sd) else None
            rows.append({"words": " with ".join(words), "parameters": factors, "sd": deviation})
        return rows

    def _units(self):
        """Return {name of an unknown: (scale, unit)}."""
        est = self.estimation
        length = est.case.loop.units[0]
        levels = zip(est.names[est.coordinates.size :], est.level_scale)
        return {b.name: (1.0, b.unit) for b in est.bounds} | {n: (s, length) for n, s in levels}

    def _open_directions(self):
        """Return (axes, standard deviations) of the open directions, the least certain first."""
        axes, sd = self.axes[self.open][::-1], self.sd_of_axes[self.open][::-1]
        if len(axes) < 2:
            return axes, sd
        _, order = cast(Any, qr(axes, pivoting=True, mode="r"))
        lead = order[: len(axes)]
        plain = np.linalg.solve(axes[:, lead], axes)
        # of the unknown that leads each combination
        reach = np.sqrt(np.square(np.minimum(sd, 1e150)) @ np.square(axes[:, lead]))
        order = np.argsort(-reach, kind="stable")
        return plain[order], np.where(reach < 1e100, reach, np.inf)[order]

    def worst(self):
        """Return (name, standard deviation of its coordinate) of the least certain parameter."""
        # None for the standard deviation of one that is not identifiable.
        coordinates, shared = self.estimation.coordinates, self.estimation.coordinates.size
        if self.vague[:shared].any():
            part = np.zeros(self.estimation.size)
            part[self.moving] = np.abs(self._open_directions()[0][0])
            largest = np.argmax(np.where(self.vague[:shared], part[:shared], -1.0))
            return coordinates.names[int(largest)], None
        plain = self.estimation.without_branch_gains().coordinates
        slopes = np.diag(plain.slopes(plain.point(coordinates.values(self.fit.p))))
        sd = dict(zip(coordinates.names, self.sd))
        relative = {n: sd[n] / abs(slope) for n, slope in zip(plain.names, slopes)}
        name = max(relative, key=relative.__getitem__)
        return name, float(relative[name])


def _within(meta, low, high):
    """Return [low, high] within the parameter's own range."""
    least, most = meta["low"], meta["high"]
    return [low if least is None else max(low, least), high if most is None else min(high, most)]


def at_search_bounds(loop, parameters):
    """Return names of the parameters at a bound of their search that is not one of their range."""
    names = []
    for name, p in parameters.items():
        meta = describe(loop, name)
        ends = [v for v in (meta["low"], meta["high"]) if v is not None]
        reach = 1e-5 * (p["upper"] - p["lower"])
        if p["at_bound"] and not any(abs(p["value"] - end) <= reach for end in ends):
            names.append(name)
    return names
