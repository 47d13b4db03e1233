"""Confidence in a fit: standard deviations, 95 % intervals, unidentifiable directions."""

import math
from collections.abc import Sequence
from typing import Any, cast

import numpy as np
from scipy.linalg import block_diag, qr
from scipy.signal import lfilter
from scipy.stats import t as student

from jaxtank.core.jsonable import fields
from jaxtank.core.tree import describe
from tuning.identification.coordinates import nominal
from tuning.identification.least_squares import Fit
from tuning.identification.problem import Estimation
from tuning.identification.residuals import WHITE, at_samples, autocorrelation, pseudo
from tuning.identification.simulation import STATIC

LARGEST_DEVIATION = 0.5  # largest standard deviation of an identifiable direction
ROUND_OFF = 1e-9  # share of the largest singular value that is round-off
SHARE = 0.1  # share of a direction's largest entry above which a parameter is named as part of it


class Spread:
    """Covariance of the estimates from J'J, without the directions that are not identifiable."""

    # Correlated residuals: sandwich (J'J)^-1 S (J'J)^-1 with the wider of two S, Newey and West
    # (Econometrica 55, 1987, 703) and J' C J of first-order noise; `widened`: ratio to white noise.

    def __init__(self, estimation: Estimation, fit: Fit, correlation: Sequence[float] = ()):
        self.estimation, self.fit, self.residual = estimation, fit, pseudo(fit)
        z = estimation.unknowns(fit)
        low, high = estimation.box
        edge = 1e-6 * (high - low)
        self.at_bound = (z < low + edge) | (z > high - edge)
        inside = np.flatnonzero(~self.at_bound)
        self._decompose(inside)
        # a search along an insensitive direction may end at a bound that the data do not determine
        if self.open_axes.any():
            count = self.open_axes.sum()
            self._decompose(np.arange(z.size))
            if self.open_axes.sum() == count:
                self._decompose(inside)
        self._set_covariance(correlation)
        # an open direction that changes an unknown by more than half of the unknown's deviation
        sd = np.sqrt(np.maximum(np.diag(self.covariance), 0))
        self.unidentifiable = np.zeros(estimation.size, dtype=bool)
        reaches = np.minimum(self.sd_of_axes[self.open_axes], 1.0)
        for axis, reach in zip(self.axes[self.open_axes], reaches):
            exceeded = np.abs(axis) * reach > np.maximum(0.5 * sd, 1e-6)
            self.unidentifiable[self.estimated[exceeded]] = True
        self.at_bound &= ~self.unidentifiable
        self.without_interval = self._with_partners(self.unidentifiable | self.at_bound)
        self.quantile = float(student.ppf(0.975, self.freedom))  # 95 %, two-sided
        full = np.zeros((estimation.size, estimation.size))
        full[np.ix_(self.estimated, self.estimated)] = self.covariance
        est = estimation
        slopes: Any = block_diag(est.coordinates.slopes(self.fit.p), np.diag(est.level_scale))
        self.values_covariance = slopes @ full @ slopes.T
        self.sd = np.sqrt(np.diag(self.values_covariance))

    def _decompose(self, estimated):
        """Set the singular values and axes of the Jacobian with respect to `estimated` unknowns."""
        # `open_axes`: True for an axis that is not identifiable.
        self.estimated, residual = estimated, self.residual
        self.freedom = max(residual.size - estimated.size, 1)
        self.scale = float(residual @ residual) / self.freedom
        self.earlier = self.estimation.prior_rows(self.fit.p)[1][:, estimated]
        slopes = np.concatenate([self.fit.jacobian[:, estimated], self.earlier])
        _, self.singular, self.axes = np.linalg.svd(slopes, full_matrices=False)
        with np.errstate(divide="ignore", invalid="ignore"):
            sd = np.where(self.singular > 0, np.sqrt(self.scale) / self.singular, np.inf)
        self.sd_of_axes = sd
        round_off = self.singular < ROUND_OFF * self.singular.max(initial=0.0)
        self.open_axes = (sd > LARGEST_DEVIATION) | round_off

    def _set_covariance(self, correlation):
        """Set `covariance` and `widened`; correlation: of each channel's residuals at lag 1."""
        n = self.fit.residual.size
        s, vt = self.singular[~self.open_axes], self.axes[~self.open_axes]
        inverse = (vt.T / s**2) @ vt
        white = inverse * self.scale
        self.covariance, self.widened = white, 1.0
        white_noise = WHITE / math.sqrt(n / len(self.estimation.data.channels))
        if max(map(abs, correlation), default=0.0) <= white_noise:
            return
        earlier = self.scale * self.earlier.T @ self.earlier
        estimation, size = self.estimation, self.estimated.size
        shape, dt = estimation.mask.shape, estimation.data.steps
        residual, slopes = at_samples(estimation, self.residual), np.zeros((*shape, size))
        slopes[estimation.mask] = self.fit.jacobian[:, self.estimated]
        samples = np.mean([log.samples for log in estimation.logs])
        steps, total = dt / np.median(dt[dt > 0]), np.zeros((size, size))
        for c in range(shape[-1]):
            rho = autocorrelation(residual[..., c], 1)[1]
            rho = float(np.clip(rho + (1 + 4 * rho) / samples, 0.0, 0.999))
            variance = np.nanmean(residual[..., c] ** 2) * self.fit.residual.size / self.freedom
            J = slopes[:, :, c]
            # sum over all earlier samples of rho^(time difference / median step) J
            if np.ptp(steps[dt > 0]) < 1e-6:
                before = lfilter([0.0, rho], [1.0, -rho], J, axis=1)
            else:
                before = np.zeros_like(J)
                for k in range(1, shape[1]):
                    before[:, k] = (before[:, k - 1] + J[:, k - 1]) * rho ** steps[:, k - 1, None]
            product = np.einsum("eki,ekj->ij", J, before)
            total += variance * (np.einsum("eki,ekj->ij", J, J) + product + product.T)
        for middle in (self._newey_west() * n / self.freedom, total):
            sandwich = inverse @ (middle + earlier) @ inverse
            ratio = np.sqrt(np.maximum(np.diag(sandwich), 0) / np.maximum(np.diag(white), 1e-300))
            if ratio.size and np.median(ratio) > self.widened:
                self.covariance, self.widened = sandwich, float(np.median(ratio))

    def _newey_west(self):
        """Return S of Newey and West: products of scores up to the lag of the autocorrelation."""
        estimation, shape = self.estimation, self.estimation.mask.shape
        residual = at_samples(estimation, self.residual)
        longest = shape[1] // 5
        each = [np.abs(autocorrelation(residual[..., c], longest)) for c in range(shape[-1])]
        lags = int(min([longest, *2 * np.flatnonzero(np.mean(each, axis=0) < 0.1)[:1]]))
        score = np.zeros((*shape, self.estimated.size))
        score[estimation.mask] = self.fit.jacobian[:, self.estimated] * self.residual[:, None]
        # sums over windows of lags + 1 samples have Bartlett's weights 1 - lag / (lags + 1)
        padding = np.zeros((shape[0], lags, self.estimated.size))
        score = np.concatenate([score.sum(axis=2), padding], axis=1)
        window = np.cumsum(score, axis=1)
        window[:, lags + 1 :] -= window[:, : -lags - 1].copy()
        return np.einsum("eki,ekj->ij", window, window) / (lags + 1)

    def _with_partners(self, flags):
        """Return `flags` (unknowns,); if one gain of a branch pair has the flag, both have it."""
        flags = flags.copy()
        for pair in self.estimation.coordinates.pairs:
            flags[pair] = flags[pair].any()
        return flags

    def parameters(self):
        """Return {name: {"before", "value", "unit", "lower", "upper", "sd", "interval95", ...}}."""
        est, rows = self.estimation, {}
        values = est.coordinates.values(self.fit.p)
        before = nominal(est.case.loop, est.coordinates.leaves.names) | est.of_inputs
        for b in est.bounds:
            i = est.coordinates.names.index(b.name)
            value, half = float(values[b.name]), self.quantile * float(self.sd[i])
            meta, low, high = describe(est.case.loop, b.name), value - half, value + half
            low = low if meta["low"] is None else max(low, meta["low"])  # to its physical range
            high = high if meta["high"] is None else min(high, meta["high"])
            at_bound, known = bool(self.at_bound[i]), not self.without_interval[i]
            rows[b.name] = {
                "before": before[b.name],
                "value": value,
                **fields(b, "unit lower=low upper=high"),
                "sd": None if self.without_interval[i] else float(self.sd[i]),
                "interval95": None if self.without_interval[i] else [low, high],
                "identifiable": not self.unidentifiable[i] and (at_bound or known),
                "at_bound": at_bound,
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
            if not self.without_interval[i]:
                rows[e][tank]["interval95"] = [max(value - half, 0.0), value + half]
        return rows

    def covariance_of_parameters(self):
        """Return (names, (n, n) covariance) of the parameters with an interval, in their units."""
        names = self.estimation.coordinates.names
        leaf = [name.split("[")[0] not in STATIC for name in names]  # which a rig file can draw
        present = np.flatnonzero(~self.without_interval[: len(names)] & leaf)
        return tuple(names[i] for i in present), self.values_covariance[np.ix_(present, present)]

    def directions(self):
        """Return the directions that are not identifiable, the least certain first."""
        est, rows = self.estimation, []
        z, shared = est.unknowns(self.fit), est.coordinates.size
        levels = zip(est.names[shared:], est.level_scale)
        units = {name: (scale, est.case.loop.units[0]) for name, scale in levels}
        units |= {b.name: (1.0, b.unit) for b in est.bounds}
        for axis, sd in zip(*self._open_directions()):
            step = np.zeros(est.size)
            step[self.estimated] = axis
            size = np.abs(step)
            largest = np.argmax(size)
            step *= math.log(1.1) / max(size[largest], 1e-300) * (-1 if step[largest] < 0 else 1)
            start, end = (est.coordinates.values(v[:shared]) for v in (z, z + step))
            factors, words = {}, []
            for i in np.flatnonzero(self._with_partners(size > SHARE * size.max())):
                name = est.names[i]
                if start.get(name):
                    factors[name] = float(end[name] / start[name])
                    words.append(f"{name} x {factors[name]:.3g}")
                    continue
                # a level, or a parameter with value 0: the change, not a factor
                change = end[name] - start[name] if name in start else step[i] * units[name][0]
                factors[name] = float(change)
                words.append(f"{name} {factors[name]:+.2g} {units[name][1]}".rstrip(" -"))
            deviation = float(sd) if np.isfinite(sd) else None
            rows.append({"words": " with ".join(words), "parameters": factors, "sd": deviation})
        return rows

    def _open_directions(self):
        """Return (axes, standard deviations) of the open directions, the least certain first."""
        axes, sd = self.axes[self.open_axes][::-1], self.sd_of_axes[self.open_axes][::-1]
        if len(axes) < 2:
            return axes, sd
        _, order = cast(Any, qr(axes, pivoting=True, mode="r"))
        pivots = order[: len(axes)]
        combinations = np.linalg.solve(axes[:, pivots], axes)
        # standard deviation of the pivot unknown of each combination
        pivot_sd = np.sqrt(np.square(np.minimum(sd, 1e150)) @ np.square(axes[:, pivots]))
        order = np.argsort(-pivot_sd, kind="stable")
        return combinations[order], np.where(pivot_sd < 1e100, pivot_sd, np.inf)[order]

    def worst(self):
        """Return (name, standard deviation of its coordinate) of the least certain parameter."""
        # The standard deviation is None if the parameter is not identifiable.
        coordinates, shared = self.estimation.coordinates, self.estimation.coordinates.size
        if self.unidentifiable[:shared].any():
            part = np.zeros(self.estimation.size)
            part[self.estimated] = np.abs(self._open_directions()[0][0])
            largest = np.argmax(np.where(self.unidentifiable[:shared], part[:shared], -1.0))
            return coordinates.names[int(largest)], None
        separate = self.estimation.without_branch_gains().coordinates
        slopes = np.diag(separate.slopes(separate.point(coordinates.values(self.fit.p))))
        sd = dict(zip(coordinates.names, self.sd))
        relative = {n: sd[n] / abs(slope) for n, slope in zip(separate.names, slopes)}
        name = max(relative, key=relative.__getitem__)
        return name, float(relative[name])


def at_search_bounds(loop, parameters):
    """Return the parameters at a bound of the search that is no bound of their physical range."""
    names = []
    for name, p in parameters.items():
        meta = describe(loop, name)
        ends = [v for v in (meta["low"], meta["high"]) if v is not None]
        reach = 1e-5 * (p["upper"] - p["lower"])
        if p["at_bound"] and not any(abs(p["value"] - end) <= reach for end in ends):
            names.append(name)
    return names
