"""How far a fit is to be believed: residuals, intervals, what the data cannot tell apart, and what
experiment would.
"""

import math
from typing import Any, cast

import numpy as np
from scipy.linalg import qr
from scipy.signal import lfilter
from scipy.stats import t as student

from jaxtank.core.tree import describe, get_value
from tuning.identification import simulation as pb

VAGUE = 0.5
"""Standard deviation of a direction, in units of its coordinates (logarithms, shares of a range),
at which nothing is known of it.
"""
ROUND_OFF = 1e-9
"""Singular value, as a share of the largest, below which a direction is one of round-off."""
PART = 0.1
"""Share of a direction at which a parameter is named as part of it."""
LAGS = 60


def quality(estimation, fit):
    """{"rmse", "nrmse_percent", "residual_autocorrelation"}, lists with one entry per channel; rmse
    in the channel's unit, percent as MATLAB's
    `compare`: 100 (1 - |y - y^| / |y - mean y|), autocorrelation at one sample.
    """
    residuals = residuals_of(estimation, fit)
    told = {"rmse": [], "nrmse_percent": [], "residual_autocorrelation": []}
    for c in range(residuals.shape[-1]):
        r, y = (
            residuals[..., c],
            np.where(estimation.mask[..., c], estimation.record.y[..., c], np.nan),
        )
        told["rmse"].append(float(np.sqrt(np.nanmean(r**2))))
        told["nrmse_percent"].append(percent(r, y))
        told["residual_autocorrelation"].append(float(autocorrelation(r, 1)[1]))
    return told


def percent(residual, y):
    """100 (1 - |residual| / |y - its mean|); None for a reading that never changes. Arrays with NaN
    where there is no reading.
    """
    spread = np.sqrt(np.nansum((y - np.nanmean(y)) ** 2))
    return (
        float(100 * (1 - np.sqrt(np.nansum(residual**2)) / spread))
        if spread > 1e-9 * np.sqrt(np.nansum(y**2))
        else None
    )


def residuals_of(estimation, fit):
    """(logs, samples, channels) measured less simulated, NaN where there is no reading."""
    y = estimation.predicted(estimation.unknowns(fit))
    return np.where(estimation.mask, estimation.record.y - y, np.nan)


def autocorrelation(residual, lags=LAGS):
    """(lags + 1,) of residuals (logs, samples), NaN passed over; 0 where nothing is left to
    correlate.
    """
    lags = min(lags, residual.shape[-1] - 2)
    seen = np.isfinite(residual)
    products, pairs = (
        _lagged(v, lags) for v in (np.where(seen, residual, 0.0), seen.astype(float))
    )
    total = products[0] / max(pairs[0], 1.0)
    usable = (np.round(pairs) > 0) & (total > 0)
    found = np.where(usable, products / np.maximum(np.round(pairs), 1.0) / (total or 1.0), 0.0)
    found[0] = 1.0
    return found


def _lagged(v, lags):
    """(lags + 1,) sums over logs and samples of v_k v_{k + lag}, v (logs, samples), by way of its
    spectrum: a log may be long.
    """
    n = v.shape[-1]
    spectrum = np.fft.rfft(v, 2 * n, axis=-1)
    return np.fft.irfft(np.sum(np.abs(spectrum) ** 2, axis=tuple(range(v.ndim - 1))), 2 * n)[
        : lags + 1
    ]


def pseudo(fit):
    """(rows,) residuals as a robust loss counts them, psi(r) / mean psi'(r) (Huber, Robust
    Statistics, 1981, sec. 7.6): the residuals themselves for the linear one. An outlier then widens
    an interval by what it weighs in the fit, and no more.
    """
    r, limit = fit.residual, 3.0
    if fit.loss == "huber":
        inside = np.abs(r) < limit
        return np.clip(r, -limit, limit) / max(float(inside.mean()), 1e-3)
    if fit.loss == "soft_l1":
        root = np.sqrt(1.0 + (r / limit) ** 2)
        return r / root / float(np.mean(root**-3))
    return r


class Spread:
    """Standard deviations of a Fit from J'J; directions that the data leave open are taken out
    first.

    Where residuals are correlated from sample to sample, as those of a model that is not quite the
    rig's, the covariance is the sandwich (J'J)^-1 S (J'J)^-1, with S of Newey and West
    (Econometrica 55, 1987, 703) or S = J' C J with C that of first-order noise with the residuals'
    correlation, whichever is wider: the first is too narrow for slow noise, the second for slow
    noise under a fast one. `widened` says how much it widens the intervals.
    """

    def __init__(self, estimation, fit, told):
        self.estimation, self.fit, self.residual = estimation, fit, pseudo(fit)
        z = estimation.unknowns(fit)
        low, high = estimation.box
        edge = 1e-6 * (high - low)
        self.at_bound = (z < low + edge) | (z > high - edge)
        # a tank that starts empty is at the end of its range for a good reason
        self._decompose(np.flatnonzero(~self.at_bound))
        # a search that slid along a valley until a bound stopped it is not held there by the data
        if self.open.any():
            here, count = self.moving, self.open.sum()
            self._decompose(np.arange(z.size))
            if self.open.sum() == count:
                self._decompose(here)
        s, vt, n = self.singular, self.axes, fit.residual.size
        kept = ~self.open
        inverse = (vt[kept].T / s[kept] ** 2) @ vt[kept]
        self.white = inverse * self.scale
        self.widened = 1.0
        self.covariance = self.white
        if max(map(abs, told["residual_autocorrelation"]), default=0.0) > 3 / math.sqrt(
            n / len(estimation.record.channels)
        ):
            for middle in (self._scores() * n / self.freedom, self._first_order()):
                sandwich = inverse @ middle @ inverse
                ratio = np.sqrt(
                    np.maximum(np.diag(sandwich), 0) / np.maximum(np.diag(self.white), 1e-300)
                )
                if ratio.size and np.median(ratio) > self.widened:
                    self.covariance, self.widened = sandwich, float(np.median(ratio))
        # an unknown is vague if an open direction carries it further than the rest of the data
        # would let it go
        own = np.sqrt(np.maximum(np.diag(self.covariance), 0))
        self.vague = np.zeros(estimation.size, dtype=bool)
        for axis, reach in zip(self.axes[self.open], np.minimum(self.sd_of_axes[self.open], 1.0)):
            self.vague[self.moving[np.abs(axis) * reach > np.maximum(0.5 * own, 1e-6)]] = True
        self.at_bound &= ~self.vague

    def _decompose(self, moving):
        """Singular values and axes of the slopes by the unknowns `moving`, and which axes the data
        leave open.
        """
        self.moving, residual = moving, self.residual
        self.freedom = max(residual.size - moving.size, 1)
        self.scale = float(residual @ residual) / self.freedom
        _, self.singular, self.axes = np.linalg.svd(
            self.fit.jacobian[:, moving], full_matrices=False
        )
        with np.errstate(divide="ignore", invalid="ignore"):
            self.sd_of_axes = np.where(
                self.singular > 0, np.sqrt(self.scale) / self.singular, np.inf
            )
        self.open = (self.sd_of_axes > VAGUE) | (
            self.singular < ROUND_OFF * self.singular.max(initial=0.0)
        )

    def _scores(self):
        """Newey and West's S of the weighted residuals: products of scores up to the lag at which
        the residuals have forgotten.
        """
        estimation, shape = self.estimation, self.estimation.mask.shape
        residual = np.full(shape, np.nan)
        residual[estimation.mask] = self.residual
        longest = shape[1] // 5
        acf = np.mean(
            [np.abs(autocorrelation(residual[..., c], longest)) for c in range(shape[-1])], axis=0
        )
        forgotten = np.flatnonzero(acf < 0.1)
        lags = int(min(2 * forgotten[0] if forgotten.size else longest, longest))
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
        """J' C J, C the covariance of weighted residuals that follow each other as rho^(time /
        usual step), anew in each log and channel.

        rho is that of the residuals from sample to sample, less what fitting has taken from it
        (Marriott and Pope, Biometrika 41, 1954, 390).
        """
        estimation, size = self.estimation, self.moving.size
        shape, dt = estimation.mask.shape, estimation.record.dt
        residual, slopes = np.full(shape, np.nan), np.zeros((*shape, size))
        residual[estimation.mask], slopes[estimation.mask] = (
            self.residual,
            self.fit.jacobian[:, self.moving],
        )
        samples = np.mean([one.samples for one in estimation.logs])
        steps, total = dt / np.median(dt[dt > 0]), np.zeros((size, size))
        for c in range(shape[-1]):
            rho = autocorrelation(residual[..., c], 1)[1]
            rho = float(np.clip(rho + (1 + 4 * rho) / samples, 0.0, 0.999))
            variance = np.nanmean(residual[..., c] ** 2) * self.fit.residual.size / self.freedom
            one = slopes[:, :, c]
            # the sum of rho^(time since) J of all earlier samples
            if np.ptp(steps[dt > 0]) < 1e-6:
                before = lfilter([0.0, rho], [1.0, -rho], one, axis=1)
            else:
                before = np.zeros_like(one)
                for k in range(1, shape[1]):
                    before[:, k] = (before[:, k - 1] + one[:, k - 1]) * rho ** steps[:, k - 1, None]
            product = np.einsum("eki,ekj->ij", one, before)
            total += variance * (np.einsum("eki,ekj->ij", one, one) + product + product.T)
        return total

    def _values(self):
        """(covariance of the values of the shared parameters, of the levels), full size, zero where
        something is fixed.
        """
        size = self.estimation.size
        full = np.zeros((size, size))
        full[np.ix_(self.moving, self.moving)] = self.covariance
        shared = self.estimation.coordinates.size
        turn = np.eye(size)
        turn[:shared, :shared] = self.estimation.coordinates.slopes(self.fit.p)
        turn[range(shared, size), range(shared, size)] = self.estimation.level_scale
        return turn @ full @ turn.T

    @property
    def quantile(self):
        """Two-sided 95 % point of Student's distribution."""
        return float(student.ppf(0.975, self.freedom))

    def _hidden(self):
        """(unknowns,) whose values have no interval: part of an open direction, or at a bound; of a
        branch pair, both.
        """
        hidden = self.vague | self.at_bound
        for pair in self.estimation.coordinates.pairs:
            hidden[list(pair)] = hidden[list(pair)].any()
        return hidden

    def parameters(self):
        """{name: {"before", "value", "unit", "lower", "upper", "sd", "interval95", "identifiable",
        "at_bound"}}.
        """
        est = self.estimation
        values, sd, hidden = (
            est.coordinates.values(self.fit.p),
            np.sqrt(np.diag(self._values())),
            self._hidden(),
        )
        found = {}
        for i, name in enumerate(est.coordinates.names):
            b = next(b for b in est.bounds if b.name == name)
            value, half = float(values[name]), self.quantile * float(sd[i])
            found[name] = {
                "before": float(np.asarray(get_value(est.case.loop, name))),
                "value": value,
                "unit": b.unit,
                "lower": b.low,
                "upper": b.high,
                "sd": None if hidden[i] else float(sd[i]),
                "interval95": (
                    None
                    if hidden[i]
                    else within(describe(est.case.loop, name), value - half, value + half)
                ),
                "identifiable": (
                    (not self.vague[i] and not hidden[i])
                    or bool(self.at_bound[i] and not self.vague[i])
                ),
                "at_bound": bool(self.at_bound[i]),
            }
        return {b.name: found[b.name] for b in est.bounds}

    def levels(self):
        """Of each log, of each tank: {"value", "interval95"}; None for an interval of what was not
        estimated.
        """
        est = self.estimation
        levels = est.levels(est.unknowns(self.fit))
        sd, hidden, shared = np.sqrt(np.diag(self._values())), self._hidden(), est.coordinates.size
        rows = []
        for e in range(len(est.logs)):
            row = []
            for tank in range(levels.shape[1]):
                half = None
                if tank in est.tanks:
                    i = shared + e * len(est.tanks) + est.tanks.index(tank)
                    half = None if hidden[i] else self.quantile * float(sd[i])
                value = float(levels[e, tank])
                row.append(
                    {
                        "value": value,
                        "interval95": (
                            None if half is None else [max(value - half, 0.0), value + half]
                        ),
                    }
                )
            rows.append(row)
        return rows

    def covariance_of_values(self):
        """(names, (n, n)) of the parameters that have an interval, in their own units."""
        shared = self.estimation.coordinates.size
        seen = np.flatnonzero(~self._hidden()[:shared])
        block = cast(Any, np.ix_)(seen, seen)  # numpy's stubs know lists only
        return tuple(self.estimation.coordinates.names[i] for i in seen), self._values()[block]

    def correlation(self):
        """(names, (n, n)) correlation of the same."""
        names, matrix = self.covariance_of_values()
        sd = np.sqrt(np.maximum(np.diag(matrix), 1e-300))
        return names, matrix / np.outer(sd, sd)

    def directions(self):
        """What the data leave open: [{"words", "parameters" {name: factor or change}, "sd"}], the
        vaguest first.
        """
        est, told = self.estimation, []
        z = est.unknowns(self.fit)
        for axis, sd in zip(*self._plainly()):
            whole = np.zeros(est.size)
            whole[self.moving] = axis
            step = math.log(1.1) / max(np.abs(whole).max(), 1e-300)
            if whole[np.argmax(np.abs(whole))] < 0:
                step = -step
            here, there = (
                est.coordinates.values(v[: est.coordinates.size]) for v in (z, z + step * whole)
            )
            touched, moved, said = self._touched(np.abs(whole) > PART * np.abs(whole).max()), {}, []
            for i, name in enumerate(est.names):
                if not touched[i]:
                    continue
                if here.get(name):
                    moved[name] = float(there[name] / here[name])
                    said.append(f"{name} x {moved[name]:.3g}")
                else:  # a level, or what is 0 now: by how much it changes
                    change = (
                        step * whole[i] * est.level_scale[i - len(here)]
                        if name not in here
                        else there[name] - here[name]
                    )
                    moved[name] = float(change)
                    said.append(
                        f"{name} {change:+.2g}"
                        f" {est.case.loop.units[0] if name not in here else self._unit(name)}".rstrip(
                            " -"
                        )
                    )
            words = " with ".join(said)
            told.append(
                {"words": words, "parameters": moved, "sd": float(sd) if np.isfinite(sd) else None}
            )
        return told

    def _unit(self, name):
        return next(b.unit for b in self.estimation.bounds if b.name == name)

    def _plainly(self):
        """(axes, standard deviations) of the open directions, the vaguest first; of several the
        combinations of fewest unknowns.
        """
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

    def _touched(self, part):
        touched = part.copy()
        for pair in self.estimation.coordinates.pairs:
            touched[list(pair)] = part[list(pair)].any()
        return touched

    def worst(self):
        """(name, standard deviation of its own coordinate: a logarithm, or a share of its range) of
        the parameter that is known worst; None for a standard deviation where the data leave it
        open.
        """
        est, shared = self.estimation, self.estimation.coordinates.size
        if self.vague[:shared].any():
            part = np.zeros(est.size)
            part[self.moving] = np.abs(self._plainly()[0][0])
            return (
                est.coordinates.names[
                    int(np.argmax(np.where(self.vague[:shared], part[:shared], -1.0)))
                ],
                None,
            )
        plain = est.plainly().coordinates
        values = est.coordinates.values(self.fit.p)
        slopes = np.diag(plain.slopes(plain.point(values)))
        own = dict(zip(est.coordinates.names, np.sqrt(np.diag(self._values()))))
        sd = {n: own[n] / abs(slopes[i]) for i, n in enumerate(plain.names)}
        name = max(sd, key=sd.__getitem__)
        return name, float(sd[name])


def within(meta, low, high):
    """[low, high] less what the parameter's own range rules out."""
    floor, top = meta["low"], meta["high"]
    return [low if floor is None else max(low, floor), high if top is None else min(high, top)]


def held_back(estimation, partial, fit, kept):
    """How a fit to the first `kept` samples of each log does on the rest: {"samples", "fitted"
    quality, "held_back" quality}, both simulated in one run from the first sample on.
    """
    y = partial.at(partial.unknowns(fit)), partial.levels(partial.unknowns(fit))
    told = np.asarray(
        pb.play(
            y[0],
            estimation.record.dt,
            estimation.record.u,
            y[1],
            channels=estimation.record.channels,
            substeps=partial.substeps,
        )
    )
    residual = np.where(estimation.mask, estimation.record.y - told, np.nan)
    found = {"samples": [int(n) for n in kept], "fitted": {}, "held_back": {}}
    for side in ("fitted", "held_back"):
        rows = {"rmse": [], "nrmse_percent": []}
        for c in range(residual.shape[-1]):
            r, measured = (
                residual[..., c].copy(),
                np.where(estimation.mask[..., c], estimation.record.y[..., c], np.nan),
            )
            for e, n in enumerate(kept):
                hidden = slice(n, None) if side == "fitted" else slice(0, n)
                r[e, hidden], measured[e, hidden] = np.nan, np.nan
            rows["rmse"].append(float(np.sqrt(np.nanmean(r**2))) if np.isfinite(r).any() else None)
            rows["nrmse_percent"].append(percent(r, measured) if np.isfinite(r).any() else None)
        found[side] = rows
    return found


def remedies(estimation, fit, spread):
    """Words: which experiment would tell what these data leave open, found by asking the model for
    its sensitivities there.
    """
    from tuning.identification import design as ex

    z = estimation.unknowns(fit)
    found = []
    for words, logs in ex.alternatives(estimation, z):
        sd = ex.open_directions(estimation, z, logs, np.sqrt(max(spread.scale, 1e-12)))
        if sd is not None and sd < VAGUE:
            found.append(f"{words} (largest standard deviation of a direction {100 * sd:.2g} %)")
    names = [
        n for n in estimation.coordinates.names for d in spread.directions() if n in d["parameters"]
    ]
    if names:
        which = names[0] if len(set(names)) == 1 else f"one of them by itself, as {names[0]},"
        found.append(f"measure {which} and leave it out of --free")
    return found


def profile(estimation, fit, spread, loss="linear", points=11, reach=3.0):
    """Profile likelihood of the parameter that is known worst: it is set, all others are fitted
    again.

    Returns {"name", "unit", "values", "rise" (points,): 2 log of the likelihood ratio,
    "interval95": where it passes 3.84, interpolated, None at a side where it does not}.
    """
    name, sd = spread.worst()
    levels, values = (
        estimation.unknowns(fit)[estimation.coordinates.size :],
        estimation.coordinates.values(fit.p),
    )
    estimation = estimation.plainly()
    i, z = (
        estimation.coordinates.names.index(name),
        np.concatenate([estimation.coordinates.point(values), levels]),
    )
    grid = np.linspace(-reach, reach, points) * (sd if sd else 1 / reach)
    grid = np.clip(z[i] + grid, estimation.box[0][i], estimation.box[1][i])
    inflate = max(spread.widened, 1.0) ** 2 * max(spread.scale, 1e-300)
    grid = np.unique(grid)  # a bound cuts it short
    points, middle = len(grid), int(np.argmin(np.abs(grid - z[i])))
    rise, values = np.zeros(points), np.zeros(points)
    for side in (range(middle, points), range(middle, -1, -1)):
        here = z.copy()
        for j in side:
            one = estimation.solve(here, loss, fixed={i: grid[j]})
            here = estimation.unknowns(one)
            rise[j] = max(2 * (one.cost - fit.cost) / inflate, 0.0)
            values[j] = float(estimation.coordinates.values(one.p)[name])
    threshold = 3.841458820694124
    ends = []
    for side in (range(middle, -1, -1), range(middle, points)):
        order = list(side)
        crossing = next(((a, b) for a, b in zip(order, order[1:]) if rise[b] >= threshold), None)
        if crossing is None:
            ends.append(None)
            continue
        a, b = crossing
        share = (math.sqrt(threshold) - math.sqrt(rise[a])) / (
            math.sqrt(rise[b]) - math.sqrt(rise[a])
        )
        ends.append(float(values[a] + share * (values[b] - values[a])))
    unit = next(b.unit for b in estimation.bounds if b.name == name)
    if ends[0] is not None and ends[1] is not None:
        ends = sorted(ends)
    return {
        "name": name,
        "unit": unit,
        "values": values.tolist(),
        "rise": rise.tolist(),
        "interval95": ends,
    }


def stopped(loop, parameters):
    """Names of the parameters that ended at a bound of their search which is not one of nature, as
    0 or 1 for a share.
    """
    names = []
    for name, p in parameters.items():
        meta = describe(loop, name)
        ends = [v for v in (meta["low"], meta["high"]) if v is not None]
        reach = 1e-5 * (p["upper"] - p["lower"])
        if p["at_bound"] and not any(abs(p["value"] - end) <= reach for end in ends):
            names.append(name)
    return names
