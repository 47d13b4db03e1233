"""The problem of an identification: the unknowns, the experiment data, and the residual."""

import copy
import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from jaxtank.bounds import Bound
from jaxtank.case import Case
from jaxtank.core.checks import check_choice, check_whole
from jaxtank.core.errors import DataError
from jaxtank.core.tree import with_values
from tuning.identification import coordinates, simulation
from tuning.identification.experiment import Log
from tuning.identification.residuals import given_noise, noise_of
from tuning.uncertainty.sobol import Sobol

STARTS = ("free", "measured", "case")

LARGEST_ERROR = 0.05  # share of a channel's largest reading that shorter steps may change

DIFFERENCE = 1e-6  # change of a coordinate of an input by which slopes are computed

LARGEST_SLOPE = 1e60  # sensitivity, in noise per unit, above which a run diverged


class Estimation:
    """Unknowns, experiment data and weighted residual: the problem that `identify` solves.

        residual = (y(t_k; theta, h(0)) - y_k) / sigma

    The vector of unknowns is the coordinates of the parameters (`Coordinates`), then the free
    levels at the first sample of each log as shares of their rims.

    Parameters
    ----------
    case, free, start, noise, substeps, prior
        As in `identify`; tanks without readings start from the case's levels unless free.
    logs : sequence of Log
        Experiment data of this rig.
    samples : int
        Least length that the data are padded to.
    inputs : sequence
        (Bound, (field of Inputs, pump, value that the rig has)) of dead times, lags, dead zones and
        curves to estimate.
    begin : mapping, optional
        {name: value} from which a search begins; the case's own by default.
    inflow : bool or sequence of bool
        Whether the pulses and tables of the rig's inflow act from the first sample of each log on,
        for all logs or each; a steady inflow always acts.

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
        prior: bool = False,
        inputs: Sequence[tuple[Bound, tuple]] = (),
        begin: Mapping[str, float] | None = None,
        inflow: bool | Sequence[bool] = False,
    ):
        self.case, self.logs, loop, self.begin = case, logs, case.loop, dict(begin or {})
        check_whole("substeps", substeps, 1, optional=True)
        check_choice("start", start, STARTS)
        free = coordinates.default_free(loop, logs) if free is None else free
        self.bounds = coordinates.free_bounds(loop, free)
        coordinates.refuse_used(loop, logs, {bound.name for bound in self.bounds})
        self.bounds = [*self.bounds, *(bound for bound, _ in inputs)]
        ways = tuple(way for _, way in inputs)
        self.coordinates = coordinates.coordinates_of(self.bounds, inputs=ways)
        self.prior = self._prior() if prior else None
        self.prior_weight = 1.0  # the standard deviation of the residual, once it is known
        self.alone: Any = None  # the Spread of the estimates of these data without the prior
        self.rig = simulation.rig_of(loop)
        courses = simulation.courses_of(logs, loop.actuator, case.clock.dt)
        self.data = simulation.padded(logs, simulation.delays_of(loop.actuator), samples, courses)
        if np.any(inflow):
            flows = simulation.flows_of(logs, samples, case)
            acts = np.broadcast_to(inflow, len(logs))[:, None, None]
            self.data = self.data._replace(flows=None if flows is None else acts * flows)
        self.initial = self._initial_levels(start)  # (logs, tanks), before any is estimated
        self.tanks = tuple(range(loop.plant.tanks)) if start == "free" else ()
        channels = len(self.data.channels)
        self.noise = noise_of(self.data) if noise is None else given_noise(noise, channels)
        self.mask = np.isfinite(self.data.y)
        if self.mask.sum() <= self.size:
            names = ", ".join(log.name for log in logs)
            raise DataError(
                f"{names}: {self.mask.sum()} readings cannot determine {self.size} unknowns: give"
                " longer data, or free fewer"
            )
        self.moments: Any = None  # of changes between rows, `moments.Moments`
        self.evaluations = 0  # of residual and Jacobian
        self.substeps = self.substeps_for(self.nominal()) if substeps is None else int(substeps)

    def _prior(self):
        """Return (names, values (n,), root (n, n) of the information) of the prior, or None."""
        names, matrix = self.case.covariance or ((), ())
        chosen = [i for i, name in enumerate(names) if name in self.coordinates.names]
        if not chosen:
            return None
        names = tuple(names[i] for i in chosen)
        root = np.linalg.inv(np.linalg.cholesky(np.array(matrix)[np.ix_(chosen, chosen)]))
        return names, np.array(list(coordinates.nominal(self.case.loop, names).values())), root

    def prior_rows(self, p: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return (residual (n,), Jacobian (n, unknowns)) of the prior at coordinates p."""
        if self.prior is None:
            return np.zeros(0), np.zeros((0, self.size))
        (names, mean, root), of = self.prior, self.coordinates
        values, slopes = of.values(p), np.zeros((len(names), self.size))
        slopes[:, : of.size] = of.slopes(p)[[of.names.index(name) for name in names]]
        change = np.array([values[name] for name in names]) - mean
        return self.prior_weight * root @ change, self.prior_weight * root @ slopes

    def _initial_levels(self, start):
        """Return (logs, tanks) levels of the case or, where measured, of the first reading."""
        x0 = np.tile(np.asarray(self.case.loop.x0, dtype=float), (len(self.logs), 1))
        if start == "case":
            return x0
        for c, (tank, in_volts) in enumerate(self.data.channels):
            for e, readings in enumerate(self.data.y[..., c]):
                for y in readings[np.isfinite(readings)][:1]:
                    x0[e, tank] = max(float(self.rig.sensor.level_of(tank, y, in_volts)), 0.0)
        return x0

    def substeps_for(self, z):
        """Return Runge-Kutta steps per sample at unknowns z, for an error below the noise."""
        at = (self.rig_at(z), self.data, self.first_levels(z))
        count, change = simulation.substeps_for(*at, 0.1 * self.noise)
        largest = np.nanmax(np.abs(self.data.y), axis=(0, 1), initial=0.0)
        if not np.all(change <= np.maximum(LARGEST_ERROR * largest, self.noise)):
            log = max(self.logs, key=lambda log: np.diff(log.t).max())
            k = int(np.argmax(np.diff(log.t)))
            raise DataError(
                f"{log.where(k + 1, 0)}: {log.t[k + 1] - log.t[k]:g} s after the sample before: too"
                f" long for this rig to be simulated from one to the next in {count} Runge-Kutta"
                " steps; cut the file in two (give both with --data)"
            )
        return count

    @property
    def size(self) -> int:
        """Number of unknowns [-]."""
        return self.coordinates.size + len(self.logs) * len(self.tanks)

    @property
    def level_scale(self) -> np.ndarray:
        """(free levels of all logs,) rims, of which these levels are shares."""
        return np.tile(np.asarray(self.case.loop.plant.rim)[list(self.tanks)], len(self.logs))

    @property
    def names(self) -> tuple[str, ...]:
        """(unknowns,) name of every unknown: parameters, then levels at the first sample."""
        of_log = [f" of log {e + 1}" for e in range(len(self.logs))] if len(self.logs) > 1 else [""]
        levels = [f"h{i + 1}(0){which}" for which in of_log for i in self.tanks]
        return (*self.coordinates.names, *levels)

    @property
    def box(self) -> tuple[np.ndarray, np.ndarray]:
        """(low, high) of every unknown: coordinates, then levels as shares of their rims."""
        low, high = self.coordinates.box
        plant, tanks, scale = self.case.loop.plant, list(self.tanks), self.level_scale
        top = np.asarray(plant.rim)[tanks] * (1.0 if getattr(plant, "overflow", False) else 1.5)
        top = np.maximum(top, self.initial[:, tanks].max(axis=0, initial=0.0))
        highest = np.tile(top, len(self.logs)) / scale
        return np.concatenate([low, np.zeros(scale.size)]), np.concatenate([high, highest])

    @property
    def of_inputs(self) -> dict[str, float]:
        """{name: value that the rig has} of what is estimated of inputs."""
        of = self.coordinates
        return dict(zip(of.names[of.leaves.size :], (null for *_, null in of.inputs)))

    def without_branch_gains(self) -> "Estimation":
        """Return the same problem with one coordinate for each parameter: no branch gains."""
        other, ways = copy.copy(self), self.coordinates.inputs
        other.coordinates = coordinates.coordinates_of(self.bounds, branches=False, inputs=ways)
        return other

    def of_log(self, e: int) -> "Estimation":
        """Return the problem of one of the logs alone."""
        other, only = copy.copy(self), slice(e, e + 1)
        data = self.data._asdict()
        arrays = {n: v[only] for n, v in data.items() if n != "channels" and v is not None}
        other.logs, other.data = self.logs[only], self.data._replace(**arrays)
        other.initial, other.mask = self.initial[only], self.mask[only]
        other.moments = None
        return other

    def nominal(self) -> np.ndarray:
        """Return (unknowns,) the case's own values, levels as measured."""
        values = coordinates.nominal(self.case.loop, self.coordinates.leaves.names) | self.of_inputs
        p = self.coordinates.point(values | self.begin)
        levels = self.initial[:, list(self.tanks)].ravel() / self.level_scale
        return np.clip(np.concatenate([p, levels]), *self.box)

    def split(self, z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return (coordinates (shared,), levels (logs, free levels) in the rig's unit) of z."""
        shared = self.coordinates.size
        return z[:shared], (z[shared:] * self.level_scale).reshape(len(self.logs), len(self.tanks))

    def unknowns(self, fit: Any) -> np.ndarray:
        """Return (unknowns,) of a Fit, the inverse of `split`."""
        return np.concatenate([fit.p, fit.levels.ravel() / self.level_scale])

    def rig_at(self, z: np.ndarray) -> Any:
        """Return the Rig at the unknowns z."""
        leaves = self.coordinates.leaves
        return with_values(self.rig, leaves.values(z[: leaves.size]))

    def first_levels(self, z: np.ndarray) -> np.ndarray:
        """Return (logs, tanks) levels at the first sample of each log, at the unknowns z."""
        levels = self.initial.copy()
        levels[:, list(self.tanks)] = self.split(z)[1]
        return levels

    def predicted(self, z: np.ndarray, data: Any = None) -> np.ndarray:
        """Return (logs, samples, channels) simulated readings at z, for the inputs of `data`."""
        data = self.data if data is None else data
        static = {"channels": data.channels, "substeps": self.substeps}
        u, first = self.inputs_at(self.split(z)[0], data), self.first_levels(z)
        return np.asarray(simulation.play(self.rig_at(z), data.dt, u, first, **static))

    def inputs_at(self, p: np.ndarray, data: Any) -> np.ndarray:
        """Return (logs, samples, .., pumps) inputs of PaddedData at coordinates p."""
        of = self.coordinates
        return simulation.played(data, of.inputs, list(of.values(p).values())[of.leaves.size :])

    def by_log(self, p: np.ndarray, levels: np.ndarray, logs: Any = slice(None)) -> tuple:
        """Return weighted (residual (logs, samples, channels), Jacobian) at p and free levels."""
        rig, tanks, free = self.rig, self.tanks, len(self.tanks)
        if not tanks and np.any(self.initial != self.initial[0]):
            levels, tanks = self.initial[logs], tuple(range(self.initial.shape[1]))
        elif not tanks:
            rig = dataclasses.replace(rig, x0=self.initial[0])
        of = self.coordinates.leaves
        u = self.inputs_at(p, self.data)
        run = (rig, self.data.dt[logs], u[logs], p[..., : of.size], levels)
        static = {"tanks": tanks, "channels": self.data.channels, "substeps": self.substeps}
        y, slopes = simulation.sensitivities(*run, coordinates=of, **static)
        shared, slopes = self.coordinates.size, np.array(slopes)[..., : of.size + free]
        if shared > of.size:
            z = np.concatenate([p, levels.ravel() / self.level_scale])
            steps = DIFFERENCE * np.eye(z.size)[of.size : shared]  # of inputs, by differences
            more = [(self.predicted(z + step) - y) / DIFFERENCE for step in steps]
            slopes = np.insert(slopes, [of.size], np.stack(more, axis=-1), axis=-1)
        measured = np.where(self.mask[logs], self.data.y[logs], 0.0)
        with np.errstate(all="ignore"):
            slopes[..., shared:] *= self.level_scale[:free]
            return (np.asarray(y) - measured) / self.noise, slopes / self.noise[:, None]

    def jacobian_of(self, slopes: np.ndarray) -> np.ndarray:
        """Return (logs, .., unknowns) of slopes (logs, .., coordinates and levels of a log)."""
        shared, free = self.coordinates.size, len(self.tanks)
        jacobian = np.zeros((*slopes.shape[:-1], self.size))
        jacobian[..., :shared] = slopes[..., :shared]
        for e in range(len(self.logs)):
            begin = shared + e * free
            jacobian[e, ..., begin : begin + free] = slopes[e, ..., shared:]
        return jacobian

    def residual_and_jacobian(self, z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return weighted (residual (rows,), Jacobian); NaN and 0 where the simulation diverges."""
        residual, slopes = self.by_log(*self.split(z))
        self.evaluations += 1
        residual, jacobian = residual[self.mask], self.jacobian_of(slopes)[self.mask]
        if not np.all(np.abs(jacobian) < LARGEST_SLOPE):  # also where it is NaN
            return np.full_like(residual, np.nan), np.zeros_like(jacobian)
        return self.whitened(residual - self.shift), self.whitened(jacobian)

    def whitened(self, rows: np.ndarray) -> np.ndarray:
        """Return weighted rows (rows, ...) without what unknown moments of the inputs do."""
        return rows if self.moments is None else self.moments.whitened(rows, self.noise)

    @property
    def shift(self) -> Any:
        """(rows,) change of the weighted readings from mean moments to the present ones."""
        return 0.0 if self.moments is None else self.moments.shift(self.noise)

    def starts(self, count: int, seed: int) -> np.ndarray:
        """Return (count, unknowns) starts: the case's values, then Sobol points of what varies."""
        starts = np.tile(self.nominal(), (count, 1))
        measured = {tank for tank, _ in self.data.channels}
        vary = [True] * self.coordinates.size
        vary += [tank not in measured for _ in self.logs for tank in self.tanks]
        vary = np.flatnonzero(vary)
        if count > 1 and vary.size:
            points = Sobol(vary.size, seed).rows(0, count - 1)
            low, high = (side[vary] for side in self.box)
            starts[1:, vary] = low + points * (high - low)
        return starts
