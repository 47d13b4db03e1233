"""Which parameter changes which measure: derivatives, Morris' elementary effects, Sobol indices."""

import dataclasses
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple, cast

import jax
import numpy as np

from jaxtank import measures as ms
from jaxtank.case import Case
from jaxtank.core.errors import InputError, NonFiniteError, unknown
from jaxtank.core.tree import get_value, with_values
from jaxtank.loop import run as lp
from tuning.cluster.engine import check_cluster, connect
from tuning.problem import scenarios as sc
from tuning.problem.result import Result
from tuning.problem.slopes import contradicted
from tuning.uncertainty import indices
from tuning.uncertainty.batches import Runs, check_devices, on_workers
from tuning.uncertainty.distributions import Correlated, Discrete, Normal, stated
from tuning.uncertainty.draws import Draws
from tuning.uncertainty.sampling import check_whole, spread_of

METHODS = ("local", "morris", "sobol")

SAMPLES = {"local": None, "morris": 32, "sobol": 512}
"""Default number of trajectories of Morris and of base points of Sobol."""

LEAST, MOST = {"morris": 4, "sobol": 16}, 1 << 20
"""Fewest samples that an interval can be computed from, and most that are taken."""

RANKED_BY = {"local": "effect", "morris": "mu_star", "sobol": "total"}


@dataclasses.dataclass(frozen=True, kw_only=True, repr=False)
class SensitivityResult(Result):
    """How sensitive measures of a case are to its parameters; made by `tuning.sensitivity`."""

    REPORT = "tuning.report.effects"

    case: Any
    method: str
    samples: int | None
    runs: int
    failed: int
    seed: int
    distributions: dict
    parameters: list
    half_width: dict
    columns: list
    notes: list
    wall_s: float

    def order(self, column):
        """Return the indices of the parameters, the most influential one first."""
        size = np.abs(column.effects[RANKED_BY[self.method]])
        return np.argsort(np.where(np.isfinite(size), -size, np.inf), kind="stable")


def sensitivity(
    case: Case,
    distributions: Mapping[str, Any] | None = None,
    *,
    method: str = "local",
    measures: Sequence[str] | None = None,
    samples: int | None = None,
    spread: float | None = None,
    seed: int = 0,
    batch: int | None = None,
    devices: int = 1,
    cluster: Any = None,
    progress: Callable | None = None,
) -> SensitivityResult:
    """Return how sensitive measures of a case are to its uncertain parameters.

    Sources: Morris, Technometrics 33(2) 1991, 161; Saltelli et al., Comput. Phys. Commun. 181(2)
    2010, 259 (see `tuning.uncertainty.indices`).

    Parameters
    ----------
    case : Case
    distributions : dict or None
        {dotted name: distribution}; what the case calls uncertain where None.
    method : {"local", "morris", "sobol"}
        "local": derivative at the case's own values times half-width of the distribution;
        "morris": elementary effects over `samples` (32) trajectories, samples (D + 1) runs;
        "sobol": first and total order from `samples` (512) base points, rounded up to a power of
        2, samples (D + 2) runs.
    measures : sequence of str or None
        Those of the case's objective, rms_error_total and max_level where None.
    samples : int or None
    spread : float or None
        One relative half-width for all that the case calls uncertain, in place of
        `distributions` [-].
    seed : int
        Of the points and of the sensor noise, which is the same in every run.
    batch : int or None
        Runs at once.
    devices : int
        Of this process; each takes batches of its own, to the same bits.
    cluster : str, distributed.Client or None
        Run the batches of morris and sobol on a Dask cluster, to the same bits: "HOST:PORT" of its
        scheduler, "local:N" for N workers on this machine, or a Client.
    progress : callable or None
        Called with (runs done, runs in all).

    Returns
    -------
    SensitivityResult

    Raises
    ------
    InputError
        Before anything is run.
    NonFiniteError
        The run of the local method diverges.

    Examples
    --------
    >>> import tuning
    >>> from jaxtank import presets, rig
    >>> case = rig.set_values(presets.find("cascaded/pi"), {"clock.duration": 8.0})
    >>> found = tuning.sensitivity(case, {"plant.pump_gain": 0.1}, measures=["max_level"])
    >>> found.parameters, [c.label for c in found.columns]
    (['plant.pump_gain[0]'], ['max_level of tank 1', 'max_level of tank 2'])
    """
    began, notes = time.perf_counter(), []
    if method not in METHODS:
        raise unknown("method", method, METHODS)
    given = what_varies(case, distributions, spread)
    draws = Draws(case.loop, given)
    if not draws.dimensions:
        raise InputError(
            "nothing varies: a relative spread leaves zeros alone, and all values are zero"
        )
    names = check_measures(case, measures, method)
    samples = check_samples(samples, method, notes)
    _check_arguments(given, method, seed, batch)
    check_devices(devices)
    check_cluster(cluster, devices)
    random = sc.noisy(case) or any(n.startswith("sensor.noise") for n in draws.labels)
    # one key for all runs: differences are the parameters' alone
    key = jax.random.key(seed) if random else None
    lp.check(case.loop, case.clock, key)
    half_width, runs, failed = {}, 1, 0
    if method == "local":
        columns, half_width = local_columns(case, draws, names, key, progress)
        if cluster is not None:
            notes.append("the local method takes one run: the cluster is not used")
    else:
        make = indices.morris_points if method == "morris" else indices.sobol_points
        points = make(draws.dimensions, samples, seed)
        with connect(cluster) as engine:
            noise = seed if random else None
            each = engine and on_workers(engine, "points", case, names, noise)
            run = Runs(case, draws, names, key, batch, progress, devices, each)
            columns = _columns(case, names, method, points, run, seed)
        runs, failed = points.shape[0] * points.shape[1], run.failed
    return SensitivityResult(
        case=case,
        method=method,
        samples=samples,
        runs=runs,
        failed=failed,
        seed=seed,
        distributions=given,
        parameters=draws.labels,
        half_width=half_width,
        columns=columns,
        notes=notes,
        wall_s=time.perf_counter() - began,
    )


def _check_arguments(given, method, seed, batch):
    """Raise InputError for parameters that vary together, a seed or a batch that is none."""
    for name, d in given.items():
        if isinstance(d, Correlated) and method != "local":
            raise InputError(
                f"{name}: parameters that vary together have no effects of their own; take the"
                " local method"
            )
    check_whole("seed", seed, 0, 2**31 - 1)
    if batch is not None:
        check_whole("batch", batch, 1)


def what_varies(case, distributions=None, spread=None):
    """Return {name: distribution} of a study."""
    if spread is not None and (
        isinstance(spread, bool) or not isinstance(spread, (int, float)) or not 0 < spread < 1
    ):
        raise InputError(f"spread = {spread!r}: must be a share above 0 and below 1, as 0.05")
    if distributions is not None and spread is not None:
        raise InputError(
            "distributions name what varies, spread how much all that the case calls uncertain"
            " varies: give one of them"
        )
    return spread_of(case, spread) if distributions is None else stated(distributions)


def check_measures(case, measures, method):
    """Return the names of the measures of a study."""
    # Raises InputError where the case lacks one or the method cannot treat it.
    if measures is None:
        names = [
            m for m in (*case.objective, "rms_error_total", "max_level") if ms.serves(m, case.loop)
        ]
        names = [m for m in names if method != "local" or not ms.MEASURES[m].counts]
    else:
        names = [measures] if isinstance(measures, str) else list(measures)
        if not names:
            raise InputError("measures: name at least one")
        ms.check_names(names)
        for m in names:
            if not ms.serves(m, case.loop):
                raise InputError(
                    f"measure {m} is undefined for {case.name}: it has no changes of setpoint, or"
                    " no inflow disturbance"
                )
            if method == "local" and ms.MEASURES[m].counts:
                raise InputError(
                    f"measure {m} counts whole samples and has no derivative: take the method"
                    " morris or sobol"
                )
    return tuple(dict.fromkeys(names))


def check_samples(samples, method, notes):
    """Return the number of samples, for Sobol a power of 2, None for the local method."""
    # A note is added to `notes` where it is not what was asked for.
    if method == "local":
        if samples is not None:
            notes.append("the local method takes one run and its derivatives: samples are not used")
        return None
    samples = SAMPLES[method] if samples is None else samples
    whole = isinstance(samples, int) and not isinstance(samples, bool)
    if not whole or not LEAST[method] <= samples <= MOST:
        raise InputError(
            f"samples = {samples!r}: the method {method} takes a whole number from {LEAST[method]}"
            f" to {MOST}"
        )
    if method == "sobol" and samples & (samples - 1):
        rounded = 1 << samples.bit_length()
        notes.append(
            f"samples: {samples} rounded up to {rounded}; Sobol points are evenly spread in powers"
            " of 2"
        )
        return rounded
    return samples


def _columns(case, names, method, points, run, seed):
    """The Columns of a study by runs at `points` (samples, runs of each, D)."""
    found = run(points.reshape(-1, points.shape[-1])).reshape(*points.shape[:2], -1)
    columns = []
    for k, (measure, label, unit) in enumerate(entries_of(case, names)):
        y, nominal = found[..., k], float(run.nominal[k])
        if method == "sobol":
            effects, ranking = indices.sobol_indices(y, seed), "total"
        else:
            effects = indices.morris_indices(indices.morris_effects(points, y))
            ranking = "mu_star"
        known, reason = np.isfinite(effects[ranking]), ""
        if not known.all():
            few = np.min(effects["kept"]) < 2
            reason = "fewer than 2 samples in which it is finite" if few else "it does not vary"
        bad = int(np.sum(~np.isfinite(y)))
        columns.append(Column(measure, label, unit, nominal, bad, effects, reason, not known.any()))
    return columns


CHUNK = 16
"""Parameters whose derivatives are computed at once."""

NORMAL_WIDTH = 2.0
"""Half-width of a normal distribution, in standard deviations [-]."""


UNUSABLE = (
    "a derivative is not finite, or runs contradict it by orders of magnitude, as in a chaotic or"
    " exploding loop"
)


class Column(NamedTuple):
    """The sensitivity of one entry of one measure to every parameter."""

    measure: str
    label: str
    unit: str
    nominal: float  # value of the case's own run, NaN where it has none
    not_finite: int  # runs of the study in which it is no finite number
    effects: dict
    reason: str  # why some or all indices are absent, "" where none is
    empty: bool = False  # no parameter has an index


def entries_of(case, names):
    """Return [(measure, label, unit)] of every entry of the measures, counted from 1."""
    found = []
    for m in names:
        per = ms.MEASURES[m].per
        for i in range(ms.entries(m, case.loop.plant)):
            found.append(
                (m, m if per == "run" else f"{m} of {per} {i + 1}", ms.unit(m, case.loop.units))
            )
    return found


def local_columns(case, draws, names, key, progress=None):
    """Return the Columns by derivatives at the case's own values, and {parameter: half-width}."""
    widths = half_widths(draws)
    scalars = list(dict.fromkeys(name for width in widths for name in width))
    nominal, derivatives = _derivatives(case, scalars, names, key, progress)
    width = {name: w for width in widths for name, w in width.items()}
    steps = np.array([width[name] for name in scalars])
    derivatives = _borne_out(case, scalars, steps, names, key, nominal, derivatives)
    where = {name: i for i, name in enumerate(scalars)}
    effect = [sum(derivatives[:, where[n]] * w for n, w in width.items()) for width in widths]
    effect = np.stack(effect, axis=1)
    alone = [next(iter(width)) if len(width) == 1 else None for width in widths]
    absent = np.full(len(nominal), np.nan)
    single = np.stack([derivatives[:, where[n]] if n else absent for n in alone], axis=1)
    own = np.array([float(get_value(case.loop, n)) if n else np.nan for n in alone])
    elasticity = single * own / np.where(nominal == 0, np.nan, nominal)[:, None]
    effects = {"effect": effect, "derivative": single, "elasticity": elasticity}
    half = [next(iter(w.values())) if len(w) == 1 else list(w.values()) for w in widths]
    return _local_columns(case, names, nominal, effects), dict(zip(draws.labels, half))


def _local_columns(case, names, nominal, effects):
    """The Columns of (K,) nominal entries and {quantity: (K, D)}."""
    columns = []
    for k, (measure, label, unit) in enumerate(entries_of(case, names)):
        row = {quantity: values[k] for quantity, values in effects.items()}
        good = bool(np.isfinite(row["effect"]).all())
        reason = "" if good else UNUSABLE
        columns.append(Column(measure, label, unit, float(nominal[k]), int(not good), row, reason))
    return columns


def _derivatives(case, scalars, names, key, progress):
    """(K,) entries of the measures and (K, scalars) their derivatives, CHUNK scalars at once."""
    found, measures = [], {}
    for start in range(0, len(scalars), CHUNK):
        chunk = scalars[start : start + CHUNK]
        values = {name: float(get_value(case.loop, name)) for name in chunk}
        measures, rates, _, diverged = lp.sensitivities(case.loop, case.clock, names, values, key)
        if diverged:
            raise NonFiniteError(
                f"{case.name}: a level stops being finite at the case's own values, so there are no"
                " derivatives"
            )
        rows = [np.asarray(rates[m]).reshape(-1, len(values)) for m in names]
        found.append(np.concatenate(rows))
        if progress is not None:
            progress(min(start + CHUNK, len(scalars)), len(scalars))
    nominal = np.concatenate([np.ravel(measures[m]) for m in names])
    return nominal, np.concatenate(found, axis=1)


def _borne_out(case, scalars, steps, names, key, nominal, derivatives):
    """Return derivatives (K, scalars), NaN where runs contradict them."""
    # Runs are made by a step to either side for each scalar by which some entry would change by
    # more than itself.
    sizes = np.abs(nominal)
    large = ~(np.abs(derivatives * steps) <= sizes[:, None])
    found = derivatives.copy()
    for j in np.flatnonzero(large.any(axis=0)):
        moves, value = np.array([1.0, -1.0]) * steps[j], float(get_value(case.loop, scalars[j]))
        rows = []
        for to in value + moves:
            loop = with_values(case.loop, {scalars[j]: to})
            measures, broken = lp.evaluate_and_flag(loop, case.clock, names, key)
            run = np.concatenate([np.ravel(measures[m]) for m in names])
            rows.append(run * np.nan if broken else run)
        wrong = contradicted(moves[:, None] * derivatives[:, j], np.array(rows) - nominal, sizes)
        found[wrong, j] = np.nan
    return found


def half_widths(draws):
    """Return for each dimension {name of a scalar that it moves: half-width}."""
    found = []
    for name, d, nominal, _ in draws.parts:
        if isinstance(d, Correlated):
            found += [
                {one: NORMAL_WIDTH * float(np.sqrt(d.covariance[i][i]))}
                for i, one in enumerate(d.names)
            ]
            continue
        width = _half_width(d, nominal) + np.zeros(nominal.shape)
        if nominal.ndim == 0:
            found.append({name: abs(float(width))})
            continue
        entries = {
            f"{name}[{','.join(map(str, i))}]": float(width[i]) for i in np.ndindex(nominal.shape)
        }
        found += (
            [entries]
            if d.tied
            else [{one: abs(w)} for one, w in entries.items() if one in draws.labels]
        )
    return found


def _half_width(d, nominal):
    if isinstance(d, Normal):
        return min(NORMAL_WIDTH, d.cut) * (
            cast(float, d.sd) if d.relative is None else d.relative * np.abs(nominal)
        )
    if isinstance(d, Discrete):
        return 0.5 * (max(d.values) - min(d.values))
    return 0.5 * (
        d.quantile(np.ones(nominal.shape), nominal) - d.quantile(np.zeros(nominal.shape), nominal)
    )
