"""The problem of an identification: what is unknown, what was measured, and the residual between."""

import copy
import dataclasses
from collections.abc import Mapping
from typing import Any, cast

import numpy as np
from scipy.optimize import least_squares
from scipy.stats import qmc

from jaxtank.core.errors import DataError, InputError
from jaxtank.core.tree import split_index, with_values
from tuning.identification import simulation as pb
from tuning.identification.parametrisation import coordinates, nominal, usual
from tuning.problem.bounds import bounds

ESTIMATED = ("plant.", "sensor.", "actuator.", "disturbance.")
UNSEEN = (
    "sensor.noise",
    "sensor.full_scale",
    "actuator.low",
    "actuator.high",
    "actuator.initial",
    "actuator.stop",
    "actuator.pulse",
)
ENOUGH = 10
"""Second differences from which the noise of a channel is told."""

STARTS = ("free", "measured", "case")
FEWEST = 3
"""Samples of a log that can be fitted: residuals have a correlation from sample to sample from
three on.
"""

UNSOLVED = 0.05
"""Share of a channel's largest reading by which the last halving of the steps may move a reading."""

LARGEST = 1e60
"""Slope of a reading, in standard deviations per unit of a coordinate, above which the integration
has broken down.
"""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Fit:
    """Where a search ended."""

    p: np.ndarray  # (shared,) coordinates
    own: np.ndarray  # (logs, free levels) levels at the start of each log
    cost: float  # half the weighted sum of squares (of the loss) [-]
    residual: np.ndarray  # (rows,) weighted
    jacobian: np.ndarray  # (rows, unknowns) of the weighted residual
    evaluations: int
    status: int  # of scipy: above 0 where it has converged
    loss: str = "linear"

    @property
    def vector(self):
        """(unknowns,) p, then the levels of every log."""
        return np.concatenate([self.p, self.own.ravel()])


class Estimation:
    """What is unknown, what was measured, and the residual between: the problem that `identify`
    solves.

    case: the rig; logs: of one rig; free: {name: (low, high[, scale])} or None; start: "free"
    levels at the first sample of each log, "measured" (the readings there are exact) or "case"
    (they are those of the case); tanks that no log measures start from the case's levels unless
    they are free; noise: (channels,) standard deviation that weighs each channel, estimated from
    the record where None; samples: least length that records are padded to.
    """

    def __init__(self, case, logs, free=None, start="free", noise=None, substeps=None, samples=0):
        self.case, self.logs = case, logs
        loop = case.loop
        spec = (
            usual(loop)
            if free is None
            else {n: (*v, "log" if v[0] > 0 else "linear")[:3] for n, v in free.items()}
        )
        for name in spec:
            if not name.startswith(ESTIMATED):
                raise InputError(
                    f"free {name}: an identification estimates what begins with"
                    f" {', '.join(ESTIMATED)}; levels with --start"
                )
            if split_index(name)[0] in UNSEEN:
                raise InputError(
                    f"free {name}: no reading depends on it in a way that could be fitted"
                )
        self.bounds = _felt(loop, spec, bounds(loop, spec))
        self.coordinates = coordinates(self.bounds)
        self.rig, self.record = (
            pb.rig_of(loop),
            pb.record(logs, float(loop.actuator.delay), samples),
        )
        self.start = start
        if start not in STARTS:
            raise InputError(f"start = {start!r}: must be one of {', '.join(STARTS)}")
        self.first = self._first_levels()
        self.tanks = tuple(range(loop.plant.tanks)) if start == "free" else ()
        self.noise = (
            noise_of(logs, self.record)
            if noise is None
            else _given(noise, len(self.record.channels))
        )
        self.mask = np.isfinite(self.record.y)
        self.size = self.coordinates.size + self.first[:, list(self.tanks)].size
        if self.mask.sum() <= self.size:
            raise DataError(
                f"{self.mask.sum()} readings cannot tell {self.size} unknowns: give a longer log,"
                " or free fewer"
            )
        self.level_scale = np.tile(np.asarray(loop.plant.rim)[list(self.tanks)], len(logs))
        self.box = self._box()
        self.passes = 0
        middle = self.at(self.origin())
        self.substeps = self._substeps(middle) if substeps is None else int(substeps)

    def _substeps(self, middle):
        """Runge-Kutta steps per sample at the Rig `middle`; DataError where a step between samples
        is too long for any number of them.
        """
        found, moved = pb.substeps_for(
            middle, self.record, self.levels(self.origin()), 0.1 * self.noise
        )
        largest = np.nanmax(np.abs(self.record.y), axis=(0, 1), initial=0.0)
        if not np.all(moved <= np.maximum(UNSOLVED * largest, self.noise)):
            e = int(np.argmax([np.diff(one.t).max() for one in self.logs]))
            one, k = self.logs[e], int(np.argmax(np.diff(self.logs[e].t)))
            raise DataError(
                f"{one.where(k + 1, 0)}: {one.t[k + 1] - one.t[k]:g} s after the sample before: too"
                f" long for this rig to be simulated from one to the next in {found} Runge-Kutta"
                " steps; cut the log in two (give both with --data)"
            )
        return found

    @property
    def names(self) -> tuple[str, ...]:
        """(unknowns,) words for every unknown: parameters, then levels at the start."""
        logs = len(self.logs)
        where = [
            f"h{i + 1}(0)" + (f" of log {e + 1}" if logs > 1 else "")
            for e in range(logs)
            for i in self.tanks
        ]
        return (*self.coordinates.names, *where)

    def _box(self):
        """(low, high) of every unknown: coordinates, then levels as shares of their rims."""
        low, high = self.coordinates.box
        plant, tanks, count = self.case.loop.plant, list(self.tanks), len(self.logs)
        past = 1.0 if getattr(plant, "overflow", False) else 1.5
        top = np.maximum(
            np.asarray(plant.rim)[tanks] * past, self.first[:, tanks].max(axis=0, initial=0.0)
        )
        return (
            np.concatenate([low, np.zeros(self.level_scale.size)]),
            np.concatenate([high, np.tile(top, count) / self.level_scale]),
        )

    def plainly(self) -> "Estimation":
        """The same problem in coordinates of which each is that of one parameter: no branch gains."""
        other = copy.copy(self)
        other.coordinates = coordinates(self.bounds, branches=False)
        other.box = other._box()
        return other

    def _first_levels(self):
        x0 = np.tile(np.asarray(self.case.loop.x0, dtype=float), (len(self.logs), 1))
        if self.start == "case":
            return x0
        sensor = self.rig.sensor
        for e in range(len(self.logs)):
            for c, (tank, in_volts) in enumerate(self.record.channels):
                seen = self.record.y[e, :, c][np.isfinite(self.record.y[e, :, c])]
                if seen.size:
                    level = float(seen[0]) * (float(sensor.gain[tank]) if in_volts else 1.0)
                    x0[e, tank] = max(
                        level - (0.0 if sensor.offset is None else float(sensor.offset[tank])), 0.0
                    )
        return x0

    def origin(self) -> np.ndarray:
        """(unknowns,) the case's own values, levels as measured."""
        p = self.coordinates.point(nominal(self.case.loop, self.coordinates.names))
        return np.clip(
            np.concatenate([p, self.first[:, list(self.tanks)].ravel() / self.level_scale]),
            *self.box,
        )

    def parts(self, z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(p (shared,), own (logs, free levels) in the rig's unit) of an unknown vector z."""
        own = (z[self.coordinates.size :] * self.level_scale).reshape(
            len(self.logs), len(self.tanks)
        )
        return z[: self.coordinates.size], own

    def at(self, z: np.ndarray) -> Any:
        """The Rig at z."""
        return with_values(self.rig, self.coordinates.values(self.parts(z)[0]))

    def levels(self, z: np.ndarray) -> np.ndarray:
        """(logs, tanks) levels at the first sample of each log, at z."""
        own = self.first.copy()
        own[:, list(self.tanks)] = self.parts(z)[1]
        return own

    def predicted(self, z: np.ndarray) -> np.ndarray:
        """(logs, samples, channels) readings at z."""
        return np.asarray(
            pb.play(
                self.at(z),
                self.record.dt,
                self.record.u,
                self.levels(z),
                channels=self.record.channels,
                substeps=self.substeps,
            )
        )

    def pass_at(self, z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(residual (rows,), jacobian (rows, unknowns)), weighted by the noise; rows are the
        readings that there are.
        """
        p, own = self.parts(z)
        rig = self.rig
        if not self.tanks and np.any(self.first != self.first[0]):
            own, tanks, keep = self.first, tuple(range(self.first.shape[1])), 0
        else:
            tanks, keep = self.tanks, len(self.tanks)
            rig = rig if self.tanks else dataclasses.replace(rig, x0=self.first[0])
        y, slopes = pb.passes(
            rig,
            self.record.dt,
            self.record.u,
            p,
            own,
            coordinates=self.coordinates,
            tanks=tanks,
            channels=self.record.channels,
            substeps=self.substeps,
        )
        y, slopes = np.asarray(y), np.asarray(slopes)
        self.passes += 1
        shared, logs = self.coordinates.size, len(self.logs)
        jacobian = np.zeros((*y.shape, self.size))
        jacobian[..., :shared] = slopes[..., :shared]
        for e in range(logs):
            jacobian[e, ..., shared + e * keep : shared + (e + 1) * keep] = slopes[
                e, ..., shared : shared + keep
            ]
        with np.errstate(all="ignore"):
            jacobian[..., shared:] *= self.level_scale
        residual = (y - np.where(self.mask, self.record.y, 0.0)) / self.noise
        residual, jacobian = residual[self.mask], (jacobian / self.noise[:, None])[self.mask]
        # also where it is not a number: the search turns back from there
        if not np.all(np.abs(jacobian) < LARGEST):
            residual, jacobian = np.full_like(residual, np.nan), np.zeros_like(jacobian)
        return residual, jacobian

    def solve(
        self,
        z: np.ndarray,
        loss: str = "linear",
        iterations: int = 100,
        fixed: Mapping[int, float] | None = None,
        tolerance: float = 1e-14,
        pull: Any = None,
    ) -> Fit:
        """The Fit from the start z. fixed: {index: value} of unknowns that stay, in coordinates;
        tolerance: gain of an iteration, as a share of the cost, at which it ends; pull: (point
        (unknowns,), strength) to which every unknown is drawn, as readings of it with a standard
        deviation of 1 / strength would, a level's of a tenth of that.
        """
        moving = np.array([i for i in range(self.size) if i not in (fixed or {})])
        whole, kept = z.copy(), {}
        for i, value in (fixed or {}).items():
            whole[i] = value

        def both(v):
            if kept.get("v") is None or not np.array_equal(kept["v"], v):
                whole[moving] = v
                kept["v"], kept["at"] = v.copy(), self.pass_at(whole)
            return kept["at"]

        def slope(v):
            inner = both(v)[1][:, moving]
            return inner if pull is None else np.concatenate([inner, np.diag(drawn)])

        low, high = self.box[0][moving], self.box[1][moving]
        drawn: Any = (
            None if pull is None else pull[1] * np.where(moving < self.coordinates.size, 1.0, 10.0)
        )
        before = self.passes
        if not np.all(np.isfinite(both(np.clip(whole[moving], low, high))[0])):
            p, own = self.parts(whole)
            empty = np.zeros((0, self.size))
            return Fit(
                p=p.copy(),
                own=own,
                cost=np.inf,
                residual=empty[:, 0],
                jacobian=empty,
                evaluations=self.passes - before,
                status=-1,
            )
        # a wide range: scipy's step to its edge of trust
        with np.errstate(over="ignore", divide="ignore", invalid="ignore"):
            found = least_squares(
                lambda v: (
                    both(v)[0]
                    if pull is None
                    else np.concatenate([both(v)[0], drawn * (v - pull[0][moving])])
                ),
                np.clip(whole[moving], low, high),
                cast(Any, slope),
                bounds=(low - 1e-12, high + 1e-12),
                x_scale=1.0,
                loss=loss,
                f_scale=3.0,
                xtol=min(1e-8, 1e2 * tolerance),
                ftol=tolerance,
                gtol=min(1e-8, 1e2 * tolerance),
                max_nfev=iterations,
            )
        whole[moving] = np.clip(found.x, low, high)
        residual, jacobian = self.pass_at(whole)
        p, own = self.parts(whole)
        return Fit(
            p=p.copy(),
            own=own,
            cost=float(found.cost) if pull is None else 0.5 * float(residual @ residual),
            residual=residual,
            jacobian=jacobian,
            evaluations=self.passes - before,
            status=found.status,
            loss=loss,
        )

    def unknowns(self, fit: Fit) -> np.ndarray:
        """(unknowns,) the vector that `solve` and `pass_at` take, of a Fit."""
        return np.concatenate([fit.p, fit.own.ravel() / self.level_scale])

    def begin(self, count: int, seed: int) -> np.ndarray:
        """(count, unknowns) starts: the case's own values, then Sobol points of the box; measured
        levels stay as measured.
        """
        origin = self.origin()
        starts = np.tile(origin, (count, 1))
        measured = {tank for tank, _ in self.record.channels}
        vary = [i for i in range(self.coordinates.size)]
        vary += [
            self.coordinates.size + i
            for i in range(self.size - self.coordinates.size)
            if self.tanks[i % len(self.tanks)] not in measured
        ]
        if count > 1 and vary:
            points = qmc.Sobol(len(vary), rng=np.random.default_rng(seed)).random_base2(
                (count - 1).bit_length()
            )[: count - 1]
            low, high = self.box[0][vary], self.box[1][vary]
            starts[1:, vary] = low + points * (high - low)
        return starts


def _felt(loop, spec, found):
    """`found` Bounds less the splits of pumps that feed one tank, which nothing depends on: an
    array's are left out, one by name refused.
    """
    feeds = cast(Any, getattr(loop.plant, "feeds", ()))
    idle = {f"plant.split[{j}]" for j, (_, second) in enumerate(feeds) if second is None}
    for name in idle & set(spec):
        raise InputError(f"free {name}: this pump feeds one tank alone, its split changes nothing")
    kept = [b for b in found if b.name not in idle]
    if not kept:
        raise InputError(
            f"free {', '.join(spec)}: these pumps feed one tank each, their splits change nothing"
        )
    return kept


def _given(noise, channels):
    """(channels,) standard deviations that were given, one for all or one each."""
    noise = np.atleast_1d(np.asarray(noise, dtype=float))
    if noise.shape not in ((1,), (channels,)) or not np.all(np.isfinite(noise) & (noise > 0)):
        raise InputError(
            f"noise = {noise.tolist()}: must be one standard deviation above 0, or one for each of"
            f" the {channels} channels"
        )
    return np.broadcast_to(noise, (channels,))


def noise_of(logs, rec):
    """(channels,) standard deviation of the noise in a record, from its second differences, where a
    level is smooth: median deviation, so that steps do not count. At least a thousandth of what the
    channel ranges over: below that, weights would be those of round-off.
    """
    found, floors = [], []
    for c in range(len(rec.channels)):
        bends, spans = [], []
        for e in range(len(logs)):
            # readings next to each other: where some are missing a level is not smooth from one to
            # the next
            bend = np.abs(np.diff(rec.y[e, :, c], 2)) / np.sqrt(6.0)
            bends.append(bend[np.isfinite(bend)])
            seen = rec.y[e, :, c][np.isfinite(rec.y[e, :, c])]
            spans.append(np.ptp(seen) if seen.size else 0.0)
        bends = np.concatenate(bends)
        floors.append(max(1e-3 * max(spans), 1e-12))
        found.append(
            max(1.4826 * float(np.median(bends)), floors[-1]) if bends.size >= ENOUGH else np.nan
        )
    for c, (_, volts) in enumerate(rec.channels):
        # too sparse to tell: as the other channels of its kind, or a hundredth of what it ranges
        # over
        if np.isnan(found[c]):
            alike = [
                v for v, (_, other) in zip(found, rec.channels) if other == volts and np.isfinite(v)
            ]
            found[c] = (
                max([*alike, floors[c]])
                if alike
                else max(10 * floors[c], 1e-3 * np.nanmax(np.abs(rec.y[..., c])))
            )
    return np.array(found)


def check_length(logs):
    """Raise DataError for a log of too few samples."""
    for one in logs:
        if one.samples < FEWEST:
            raise DataError(
                f"{one.name}: has {one.samples} samples, an identification needs at least {FEWEST}"
            )
