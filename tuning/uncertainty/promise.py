"""Whether any limit of a case is broken in fewer plants than promised: its runs as margins."""

import contextlib
import dataclasses
from typing import Any, NamedTuple

import jax
import numpy as np
import scipy  # its parts are imported when they are first used

from jaxtank.case import Case
from jaxtank.core.errors import InputError
from jaxtank.core.tree import is_real
from jaxtank.limits import UNDEFINED_MARGIN, Limit, limit_scale, without_overflow
from jaxtank.loop.derivatives import sensitivities_compiled
from jaxtank.xla.jit import compiled
from tuning.uncertainty import rare_events
from tuning.uncertainty.batches import batch_runner
from tuning.uncertainty.distributions import Empirical
from tuning.uncertainty.draws import Draws

PILOT = 4096  # most draws of the study that the search for failures begins from
FURTHER = 100  # most runs after the draws of the study, in numbers of them [-]
CLIPPED = 1e-12  # least and, below 1, largest probability at which a distribution is read [-]
STEP = 1e-4  # step of the differences of drawn values in the standard normal space [sd]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Promise:
    """The estimated probability that any limit is broken, and the promised upper bound.

    Attributes
    ----------
    promise : float
    answer : {"kept", "not kept", "undecided"}
        Which side of the promise the 95 % interval lies on; "undecided" if it contains it.
    probability : float
    interval95 : (low, high)
    coefficient_of_variation : float or None
        Of the probability; None where no run broke a limit.
    limits : dict
        {limit: share of the failures in which it is the one broken most}, the largest first.
    failures : list of dict
        The most likely failures, the nearest first: {"distance" [standard deviations], "values":
        {name: value}}.
    runs, gradients : int
        Runs, the draws of the study among them, and runs with derivatives.
    unseen : float
        95 % upper bound on the probability of a kind of failure that is not among the plain draws.
    subset_simulation : float or None
        Estimate by subset simulation, if the search by gradients found no failure.
    """

    promise: float
    answer: str
    probability: float
    interval95: tuple[float, float]
    coefficient_of_variation: float | None
    limits: dict[str, float]
    failures: list[dict[str, Any]]
    runs: int
    gradients: int
    unseen: float
    subset_simulation: float | None


def check_promise(case: Case, promise: Any, limits: Any, distributions: Any) -> None:
    """Raise InputError unless `promise` is None, or a probability of breaking one of `limits`."""
    if promise is None:
        return
    if not (is_real(promise) and np.ndim(promise) == 0 and 0 < promise < 1):
        raise InputError(f"promise = {promise!r}: must be a probability above 0 and below 1")
    for name, d in distributions.items():
        if isinstance(d, Empirical):
            raise InputError(
                f"promise = {promise:g}: {name} has {len(d.draws)} draws and no tail: give a"
                " distribution, or leave it out for the [covariance] of the rig"
            )
    if not limits:
        raise InputError(
            f"promise = {promise:g}: {case.name} has no limit that could be broken; state one, as"
            " --limit max_level=rim"
        )


class Study(NamedTuple):
    """Runs of a case at points of the standard normal space."""

    case: Case
    space: Draws
    limits: tuple[Limit, ...]
    measures: tuple[str, ...]
    noise: int | None  # seed of the sensor noise
    seed: int
    batch: int

    def explored(self) -> "Study":
        """Return the study in which a level can be seen to pass a rim."""
        loop = without_overflow(self.case.loop)
        if loop is self.case.loop:
            return self
        rim = np.asarray(loop.plant.rim, dtype=float)
        limits = tuple(
            Limit("max_level", v.index, float(rim[v.index]), name=v.name)
            if v.measure == "overflow_volume"
            else v
            for v in self.limits
        )
        measures = tuple(dict.fromkeys(limit.measure for limit in limits))
        return self._replace(case=self.case.replace(loop=loop), limits=limits, measures=measures)

    def values(self, z: Any) -> dict[str, Any]:
        """Return {name: (n, ...)} at points z (n, D)."""
        return self.space.values(np.clip(scipy.special.ndtr(z), CLIPPED, 1.0 - CLIPPED))

    def margins(self, measures: Any, failed: Any) -> Any:
        """Return (n, K) margins, each divided by its scale, of measures {name: (n, ...)}."""
        columns = [
            limit.margins(np.reshape(measures[limit.measure], (len(failed), -1))[:, limit.index])
            / limit_scale(limit, self.case.loop)
            for limit in self.limits
        ]
        return np.where(failed[:, None], -UNDEFINED_MARGIN, np.stack(columns, axis=1))

    def at(self, run: Any, z: Any, first: int) -> Any:
        """Return (n, K) margins of runs at z (n, D), with the noise of draws `first` and on."""
        size = self.batch

        def inputs(k):
            rows = np.minimum(np.arange(k * size, (k + 1) * size), len(z) - 1)
            return self.values(z[rows]), first + np.arange(k * size, (k + 1) * size)

        batches = dict(run(range(-(-len(z) // size)), inputs, size))
        joined = {
            n: np.concatenate([batches[k][n] for k in sorted(batches)])[: len(z)]
            for n in batches[0]
        }
        return self.margins(joined, joined.pop("failed") > 0)

    def slopes(self, z: Any) -> Any:
        """Return ((n, K) margins, (n, K, D) their slopes) at z (n, D), LANES points at once."""
        values = self.values(z)
        columns = []
        for move in STEP * np.eye(z.shape[1]):
            ends = (_flat(self.values(z + sign * move)) for sign in (1.0, -1.0))
            columns.append(np.subtract(*ends) / (2.0 * STEP))
        moving, jacobian = self.moving(), np.stack(columns, axis=-1)
        order = tuple(_entries(values)[i] for i in moving)
        flat = _flat(values)[:, moving]
        size = rare_events.LANES
        parts = []
        for k in range(0, len(z), size):
            rows = flat[np.minimum(np.arange(k, k + size), len(z) - 1)]
            parts.append(
                _sensitivities(
                    self.case.loop, tuple(rows.T), self.noise, self.case.clock, self.measures, order
                )
            )
        measures, rates, failed = jax.tree.map(
            lambda *v: np.concatenate([np.asarray(part) for part in v])[: len(z)], *parts
        )
        slopes = [
            -limit.sign
            / limit_scale(limit, self.case.loop)
            * rates[limit.measure].reshape(len(z), -1, len(order))[:, limit.index]
            for limit in self.limits
        ]
        slopes = np.einsum("nkp,npd->nkd", np.stack(slopes, axis=1), jacobian[:, moving])
        return self.margins(measures, failed), slopes

    def moving(self) -> Any:
        """Return which entries of the drawn values differ from plant to plant."""
        ends = _flat(self.values(np.array([[-3.0], [3.0]]) * np.ones(self.space.dimensions)))
        return np.flatnonzero(ends[0] != ends[1])


def _flat(values):
    """(n, entries) of {name: (n, ...)}."""
    return np.concatenate([np.reshape(v, (len(v), -1)) for v in values.values()], axis=1)


def _entries(values):
    """Dotted name of each column of `_flat`."""
    return [
        f"{name}[{','.join(map(str, i))}]" if i else name
        for name, v in values.items()
        for i in np.ndindex(np.shape(v)[1:])
    ]


@compiled("clock", "names", "order", "seed", keep=True)
def _sensitivities(loop, rows, seed, clock, names, order):
    """(measures, their slopes by `order`, whether diverged) of runs at `rows`, same noise."""
    key = None if seed is None else jax.random.key(seed)

    def run(values):
        return sensitivities_compiled(loop, clock, names, order, values, key, (), True)

    measures, slopes, _, diverged = jax.vmap(run)(rows)
    return measures, slopes, diverged


def promise_of(
    study: Study,
    promise: float | None,
    points: Any,
    table: Any,
    failed: Any,
    devices: int,
    cluster: Any,
    progress: Any,
) -> Promise | None:
    """Return the Promise of a study, after the draws at `points` with the measures `table`."""
    if promise is None:
        return None
    explored, drawn = study.explored(), min(len(failed), PILOT)
    z = scipy.special.ndtri(points.rows(0, drawn))
    pilot = z, study.margins({m: table[m][:drawn] for m in study.measures}, failed[:drawn])
    used = len(failed)

    def runs(of, run):
        def margins(z):
            nonlocal used
            used += len(z)
            return of.at(run, z, used - len(z))

        return margins

    def runner(of):
        return batch_runner(of.case, of.measures, study.noise, devices, cluster)

    with runner(study) as run, contextlib.ExitStack() as stack:
        other = run if explored is study else stack.enter_context(runner(explored))
        margins = rare_events.Margins(runs(study, run), runs(explored, other), explored.slopes)
        result = rare_events.probability(
            margins,
            pilot,
            promise,
            FURTHER * len(failed),
            study.seed,
            progress and (lambda done: progress(done + len(failed))),
        )
    estimate, (low, high) = result.estimate, result.estimate.interval95
    shares = sorted(zip(estimate.shares, study.limits), key=lambda pair: -pair[0])
    return Promise(
        promise=promise,
        answer="kept" if high < promise else "not kept" if low > promise else "undecided",
        probability=estimate.probability,
        interval95=(low, high),
        coefficient_of_variation=estimate.variation if np.isfinite(estimate.variation) else None,
        limits={limit.label: float(share) for share, limit in shares if share > 0},
        failures=_failures(study, result.centres),
        runs=len(failed) + result.runs + result.gradients,
        gradients=result.gradients,
        unseen=float(-np.expm1(np.log(0.05) / estimate.plain)),
        subset_simulation=result.subset,
    )


def _failures(study, centres):
    """{"distance", "values"} of centres (k, D)."""
    if not len(centres):
        return []
    values, moving = study.values(centres), study.moving()
    names, flat = _entries(values), _flat(values)
    return [
        {"distance": float(np.linalg.norm(z)), "values": {names[j]: float(row[j]) for j in moving}}
        for z, row in zip(centres, flat)
    ]
