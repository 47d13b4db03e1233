"""The problem of an identification: the unknowns, the experiment data, and the residual."""

import copy
import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any, cast

import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike
from scipy.stats import qmc

from jaxtank.case import Case
from jaxtank.core.errors import DataError, InputError
from jaxtank.core.tree import get_value, split_index, with_values
from jaxtank.signals.base import Constant
from tuning.identification import simulation
from tuning.identification.experiment import Log
from tuning.identification.residuals import given_noise, noise_of
from tuning.problem.bounds import bounds

ESTIMATED = ("plant.", "sensor.", "actuator.", "disturbance.")
WITHOUT_EFFECT = (
    "sensor.noise",
    "sensor.full_scale",
    "actuator.low",
    "actuator.high",
    "actuator.initial",
    "actuator.stop",
    "actuator.pulse",
)
STARTS = ("free", "measured", "case")

LARGEST_ERROR = 0.05
"""Share of a channel's largest reading by which halving the steps may still move a reading."""

LARGEST_SLOPE = 1e60
"""Sensitivity, in standard deviations per unit of a coordinate, above which a run diverged."""


class Estimation:
    """Unknowns, experiment data and weighted residual: the problem that `identify` solves.

        residual = (y(t_k; theta, h(0)) - y_k) / sigma

    The vector of unknowns is the coordinates of the parameters (`Coordinates`), then the free
    levels at the first sample of each log as shares of their rims.

    Parameters
    ----------
    case : Case
        The rig.
    logs : sequence of Log
        Experiment data of this rig.
    free : mapping, optional
        {name: (low, high)} or {name: (low, high, "log" or "linear")}; `default_free` if omitted.
    start : {"free", "measured", "case"}
        Levels at the first sample: estimated, as measured, or those of the case. Tanks that are not
        measured start from the case's levels unless they are free.
    noise : (channels,) array, optional
        Standard deviation that weights each channel; estimated from the data if omitted.
    substeps : int, optional
        Runge-Kutta steps per sample; found by halving if omitted.
    samples : int
        Least length that the data are padded to.

    Raises
    ------
    InputError
        For what cannot be estimated.
    DataError
        For fewer readings than unknowns, or a step too long to be simulated.

    Examples
    --------
    >>> import jax, numpy as np, tuning
    >>> from jaxtank import presets
    >>> jax.config.update("jax_enable_x64", True)
    >>> case = presets.load("cascaded").cases["open-loop"]
    >>> t = np.arange(20.0)
    >>> data = tuning.log(t=t, u=0 * t + 3, y=4 + 0.01 * t, tanks=[1])
    >>> free = {"plant.pump_gain": (0.01, 0.2)}
    >>> problem = tuning.Estimation(case, [data], free, "case", noise=0.1, substeps=1)
    >>> problem.names, problem.size
    (('plant.pump_gain[0]',), 1)
    >>> residual, jacobian = problem.residual_and_jacobian(problem.nominal())
    >>> residual.shape, jacobian.shape
    ((20,), (20, 1))
    """

    def __init__(
        self,
        case: Case,
        logs: Sequence[Log],
        free: Mapping[str, Any] | None = None,
        start: str = "free",
        noise: ArrayLike | None = None,
        substeps: int | None = None,
        samples: int = 0,
    ):
        self.case, self.logs = case, logs
        loop = case.loop
        if start not in STARTS:
            raise InputError(f"start = {start!r}: must be one of {', '.join(STARTS)}")
        self.bounds = _bounds(loop, specification(loop, free))
        self.coordinates = coordinates(self.bounds)
        self.rig = simulation.rig_of(loop)
        self.data = simulation.padded(logs, float(loop.actuator.delay), samples)
        self.start = start
        self.initial = self._initial_levels()  # (logs, tanks), before any is estimated
        self.tanks = tuple(range(loop.plant.tanks)) if start == "free" else ()
        self.noise = (
            noise_of(self.data) if noise is None else given_noise(noise, len(self.data.channels))
        )
        self.mask = np.isfinite(self.data.y)
        self.size = self.coordinates.size + self.initial[:, list(self.tanks)].size
        if self.mask.sum() <= self.size:
            raise DataError(
                f"{self.mask.sum()} readings cannot determine {self.size} unknowns: give longer"
                " data, or free fewer"
            )
        self.level_scale = np.tile(np.asarray(loop.plant.rim)[list(self.tanks)], len(logs))
        self.box = self._box()
        self.evaluations = 0  # of residual and Jacobian
        self.substeps = self._substeps() if substeps is None else int(substeps)

    def _substeps(self):
        """Return Runge-Kutta steps per sample at the case's own values."""
        z = self.nominal()
        found, moved = simulation.substeps_for(
            self.rig_at(z), self.data, self.first_levels(z), 0.1 * self.noise
        )
        largest = np.nanmax(np.abs(self.data.y), axis=(0, 1), initial=0.0)
        if not np.all(moved <= np.maximum(LARGEST_ERROR * largest, self.noise)):
            e = int(np.argmax([np.diff(one.t).max() for one in self.logs]))
            one, k = self.logs[e], int(np.argmax(np.diff(self.logs[e].t)))
            raise DataError(
                f"{one.where(k + 1, 0)}: {one.t[k + 1] - one.t[k]:g} s after the sample before: too"
                f" long for this rig to be simulated from one to the next in {found} Runge-Kutta"
                " steps; cut the file in two (give both with --data)"
            )
        return found

    @property
    def names(self) -> tuple[str, ...]:
        """(unknowns,) name of every unknown: parameters, then levels at the first sample."""
        logs = len(self.logs)
        levels = [
            f"h{i + 1}(0)" + (f" of log {e + 1}" if logs > 1 else "")
            for e in range(logs)
            for i in self.tanks
        ]
        return (*self.coordinates.names, *levels)

    def _box(self):
        """Return (low, high) of every unknown: coordinates, then levels as shares of their rims."""
        low, high = self.coordinates.box
        plant, tanks, count = self.case.loop.plant, list(self.tanks), len(self.logs)
        past = 1.0 if getattr(plant, "overflow", False) else 1.5
        top = np.maximum(
            np.asarray(plant.rim)[tanks] * past, self.initial[:, tanks].max(axis=0, initial=0.0)
        )
        return (
            np.concatenate([low, np.zeros(self.level_scale.size)]),
            np.concatenate([high, np.tile(top, count) / self.level_scale]),
        )

    def without_branch_gains(self) -> "Estimation":
        """Return the same problem with one coordinate for each parameter: no branch gains."""
        other = copy.copy(self)
        other.coordinates = coordinates(self.bounds, branches=False)
        other.box = other._box()
        return other

    def _initial_levels(self):
        """Return (logs, tanks) levels of the case or, where measured, of the first reading."""
        x0 = np.tile(np.asarray(self.case.loop.x0, dtype=float), (len(self.logs), 1))
        if self.start == "case":
            return x0
        sensor = self.rig.sensor
        for e in range(len(self.logs)):
            for c, (tank, in_volts) in enumerate(self.data.channels):
                y = self.data.y[e, :, c][np.isfinite(self.data.y[e, :, c])]
                if y.size:
                    level = float(y[0]) * (float(sensor.gain[tank]) if in_volts else 1.0)
                    offset = 0.0 if sensor.offset is None else float(sensor.offset[tank])
                    x0[e, tank] = max(level - offset, 0.0)
        return x0

    def nominal(self) -> np.ndarray:
        """Return (unknowns,) the case's own values, levels as measured."""
        p = self.coordinates.point(nominal(self.case.loop, self.coordinates.names))
        return np.clip(
            np.concatenate([p, self.initial[:, list(self.tanks)].ravel() / self.level_scale]),
            *self.box,
        )

    def split(self, z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return (coordinates (shared,), levels (logs, free levels) in the rig's unit) of z."""
        levels = (z[self.coordinates.size :] * self.level_scale).reshape(
            len(self.logs), len(self.tanks)
        )
        return z[: self.coordinates.size], levels

    def unknowns(self, fit: Any) -> np.ndarray:
        """Return (unknowns,) of a Fit, the inverse of `split`."""
        return np.concatenate([fit.p, fit.levels.ravel() / self.level_scale])

    def rig_at(self, z: np.ndarray) -> Any:
        """Return the Rig at the unknowns z."""
        return with_values(self.rig, self.coordinates.values(self.split(z)[0]))

    def first_levels(self, z: np.ndarray) -> np.ndarray:
        """Return (logs, tanks) levels at the first sample of each log, at the unknowns z."""
        levels = self.initial.copy()
        levels[:, list(self.tanks)] = self.split(z)[1]
        return levels

    def predicted(self, z: np.ndarray) -> np.ndarray:
        """Return (logs, samples, channels) simulated readings at the unknowns z."""
        return np.asarray(
            simulation.play(
                self.rig_at(z),
                self.data.dt,
                self.data.u,
                self.first_levels(z),
                channels=self.data.channels,
                substeps=self.substeps,
            )
        )

    def residual_and_jacobian(self, z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return (residual (rows,), Jacobian (rows, unknowns)), weighted, a row for each reading.

        NaN and 0 where the simulation diverges, from which a search turns back.
        """
        p, levels = self.split(z)
        rig = self.rig
        if not self.tanks and np.any(self.initial != self.initial[0]):
            levels, tanks, keep = self.initial, tuple(range(self.initial.shape[1])), 0
        else:
            tanks, keep = self.tanks, len(self.tanks)
            rig = rig if self.tanks else dataclasses.replace(rig, x0=self.initial[0])
        y, slopes = simulation.sensitivities(
            rig,
            self.data.dt,
            self.data.u,
            p,
            levels,
            coordinates=self.coordinates,
            tanks=tanks,
            channels=self.data.channels,
            substeps=self.substeps,
        )
        y, slopes = np.asarray(y), np.asarray(slopes)
        self.evaluations += 1
        shared = self.coordinates.size
        jacobian = np.zeros((*y.shape, self.size))
        jacobian[..., :shared] = slopes[..., :shared]
        for e in range(len(self.logs)):
            columns = slice(shared + e * keep, shared + (e + 1) * keep)
            jacobian[e, ..., columns] = slopes[e, ..., shared : shared + keep]
        with np.errstate(all="ignore"):
            jacobian[..., shared:] *= self.level_scale
        residual = (y - np.where(self.mask, self.data.y, 0.0)) / self.noise
        residual, jacobian = residual[self.mask], (jacobian / self.noise[:, None])[self.mask]
        if not np.all(np.abs(jacobian) < LARGEST_SLOPE):  # also where it is NaN
            residual, jacobian = np.full_like(residual, np.nan), np.zeros_like(jacobian)
        return residual, jacobian

    def starts(self, count: int, seed: int) -> np.ndarray:
        """Return (count, unknowns) starts: the case's own values, then Sobol points of the box.

        Levels that are measured stay as measured.
        """
        starts = np.tile(self.nominal(), (count, 1))
        measured, shared = {tank for tank, _ in self.data.channels}, self.coordinates.size
        vary = list(range(shared))
        vary += [
            shared + i
            for i in range(self.size - shared)
            if self.tanks[i % len(self.tanks)] not in measured
        ]
        if count > 1 and vary:
            points = qmc.Sobol(len(vary), rng=np.random.default_rng(seed)).random_base2(
                (count - 1).bit_length()
            )[: count - 1]
            low, high = self.box[0][vary], self.box[1][vary]
            starts[1:, vary] = low + points * (high - low)
        return starts


def _bounds(loop, spec):
    """Return the Bounds of {name: (low, high, scale)}; raise InputError for what has no effect."""
    for name in spec:
        if not name.startswith(ESTIMATED):
            raise InputError(
                f"free {name}: an identification estimates what begins with"
                f" {', '.join(ESTIMATED)}; levels with --start"
            )
        if split_index(name)[0] in WITHOUT_EFFECT:
            raise InputError(f"free {name}: no reading depends on it in a way that could be fitted")
    found = bounds(loop, spec)
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


@dataclasses.dataclass(frozen=True)
class Coordinates:
    """The coordinates p of the scalars to be estimated, as a hashable description."""

    # items: ("log", name, low, high) with value exp(p); ("linear", name, low, high) with value low
    # + p (high - low); ("branch", gain, split, (low, high) of both branches): p = (log c1, log c2),
    # c1 = k s and c2 = k (1 - s) the gains of a pump's two branches, in which the inflows are
    # linear (mirakhorli notes S11), gain k = c1 + c2, split s = c1 / (c1 + c2).

    items: tuple

    @property
    def names(self):
        """(size,) dotted name of the value of each coordinate; of a branch, gain then split."""
        return tuple(
            n for kind, *rest in self.items for n in (rest[:2] if kind == "branch" else rest[:1])
        )

    @property
    def pairs(self):
        """((i, i + 1), ...): coordinates that are the two branches of one pump."""
        found, i = [], 0
        for kind, *_ in self.items:
            if kind == "branch":
                found.append((i, i + 1))
                i += 1
            i += 1
        return tuple(found)

    @property
    def size(self):
        """Number of coordinates [-]."""
        return len(self.names)

    @property
    def box(self):
        """(low (size,), high (size,)) of the coordinates."""
        pairs = []
        for kind, *rest in self.items:
            if kind == "branch":
                pairs += [tuple(np.log(b)) for b in rest[2]]
            else:
                pairs.append((0.0, 1.0) if kind == "linear" else (np.log(rest[1]), np.log(rest[2])))
        return (
            tuple(np.array(side, dtype=float) for side in zip(*pairs))
            if pairs
            else (np.zeros(0), np.zeros(0))
        )

    def values(self, p):
        """Return {name: value} at coordinates p (size,), of numpy or jax."""
        exp = np.exp if isinstance(p, np.ndarray) else jnp.exp
        found, i = {}, 0
        for kind, *rest in self.items:
            if kind == "log":
                found[rest[0]] = exp(p[i])
            elif kind == "linear":
                found[rest[0]] = rest[1] + p[i] * (rest[2] - rest[1])
            else:
                first, second = exp(p[i]), exp(p[i + 1])
                found[rest[0]], found[rest[1]] = first + second, first / (first + second)
                i += 1
            i += 1
        return found

    def point(self, values):
        """Return (size,) coordinates of {name: value}, projected onto the bounds."""
        p = []
        for kind, *rest in self.items:
            if kind == "log":
                p.append(np.log(max(values[rest[0]], 1e-300)))
            elif kind == "linear":
                p.append((values[rest[0]] - rest[1]) / (rest[2] - rest[1]))
            else:
                gain, split = values[rest[0]], np.clip(values[rest[1]], 1e-9, 1 - 1e-9)
                p += [np.log(gain * split), np.log(gain * (1 - split))]
        return np.clip(np.array(p, dtype=float), *self.box)

    def slopes(self, p):
        """Return (size, size) derivatives of the values, ordered as `names`, by the coordinates."""
        out, i = np.zeros((self.size, self.size)), 0
        for kind, *rest in self.items:
            if kind == "log":
                out[i, i] = np.exp(p[i])
            elif kind == "linear":
                out[i, i] = rest[2] - rest[1]
            else:
                first, second = np.exp(p[i]), np.exp(p[i + 1])
                share = first / (first + second)
                out[i, i : i + 2] = first, second
                out[i + 1, i : i + 2] = share * (1 - share), -share * (1 - share)
                i += 1
            i += 1
        return out


def coordinates(bounds, branches=True):
    """Return the Coordinates of a list of tuning.problem.bounds.Bound."""
    by_name = {b.name: b for b in bounds} if branches else {}
    items, done = [], set()
    for b in bounds:
        if b.name in done:
            continue
        base, index = split_index(b.name)
        split = f"plant.split[{index[0]}]" if base == "plant.pump_gain" and index else None
        if split in by_name:
            s = by_name[split]
            low, high = max(s.low, 1e-6), min(s.high, 1 - 1e-6)
            items.append(
                (
                    "branch",
                    b.name,
                    split,
                    ((b.low * low, b.high * high), (b.low * (1 - high), b.high * (1 - low))),
                )
            )
            done |= {b.name, split}
        elif base == "plant.split" and f"plant.pump_gain[{index[0]}]" in by_name:
            continue  # comes with its gain
        else:
            items.append((b.scale, b.name, b.low, b.high))
            done.add(b.name)
    return Coordinates(tuple(items))


def default_free(loop):
    """Return {name: (low, high, scale)}: the default unknowns of an identification."""
    # Pump gains, splits between two tanks, open orifices, pipes, the captured share of an overflow
    # and a constant disturbance; not areas, which are measured with a ruler.
    plant, found = loop.plant, {}
    for name in ("pump_gain", "drain", "orifice", "pipe"):
        values = np.asarray(getattr(plant, name, ()))
        for i, value in enumerate(np.ravel(values)):
            if value > 0:
                found[f"plant.{name}[{i}]"] = (float(value) / 10, float(value) * 10, "log")
    feeds = cast(Any, getattr(plant, "feeds", ()))
    for j, (_, second) in enumerate(feeds):
        if second is not None:
            found[f"plant.split[{j}]"] = (0.02, 0.98, "linear")
    if getattr(plant, "overflow", False):
        found |= {f"plant.caught[{k}]": (0.0, 1.0, "linear") for k in range(len(plant.spills))}
    if isinstance(loop.disturbance, Constant):
        for i, value in enumerate(np.asarray(loop.disturbance.level)):
            if value != 0:
                found[f"disturbance.level[{i}]"] = (
                    -10 * abs(float(value)),
                    10 * abs(float(value)),
                    "linear",
                )
    return found


def nominal(loop, names):
    """Return {name: value} of a loop as floats."""
    return {name: float(np.asarray(get_value(loop, name))) for name in names}


def specification(loop, free):
    """Return {name: (low, high, scale)} of `free`: logarithmic by default above 0."""
    if free is None:
        return default_free(loop)
    return {n: (*v, "log" if v[0] > 0 else "linear")[:3] for n, v in free.items()}
