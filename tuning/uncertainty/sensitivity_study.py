"""Which parameter changes which measure: derivatives, Morris' elementary effects, Sobol indices."""

import dataclasses
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple, cast

import jax
import numpy as np
from scipy import special

from jaxtank import measures as ms
from jaxtank.case import Case, check_case
from jaxtank.core.checks import check_whole
from jaxtank.core.errors import InputError, NonFiniteError, unknown
from jaxtank.core.labels import entry_label
from jaxtank.core.tree import get_value, with_values
from jaxtank.loop import run as lp
from tuning.cluster.engine import check_cluster
from tuning.problem.slopes import contradicted
from tuning.uncertainty.batches import batch_runner, check_devices, seed_of
from tuning.uncertainty.distributions import Correlated, Discrete, Normal
from tuning.uncertainty.draws import entry_names
from tuning.uncertainty.sampling import varied
from tuning.uncertainty.sobol import Sobol
from tuning.views import Result

LEVELS = 4  # of Morris' grid; with a step of 2/3 all levels are equally likely

RESAMPLES = 1000  # bootstrap resamples of an interval
BLOCK = 1 << 22  # bootstrap weights held at once
FLAT = 1e-10  # standard deviation of an output, as a share of its size, that is rounding alone [-]


def sobol_points(dimensions, samples, seed):
    """Return the points that `sobol_indices` needs."""
    base = Sobol(2 * dimensions, seed).rows(0, samples)
    a, b = base[:, :dimensions], base[:, dimensions:]
    points = np.repeat(a[:, None], dimensions + 2, axis=1)
    points[:, -1] = b
    for j in range(dimensions):
        points[:, j + 1, j] = b[:, j]
    return points


def sobol_indices(y, seed=0):
    """Return the shares of the variance of y that each input has: alone and in all."""
    # Saltelli et al. 2010, table 2 (b) and (f); a row with an output not finite is left out.
    y = np.asarray(y, dtype=float)
    dimensions, rows = y.shape[1] - 2, y[np.isfinite(y).all(axis=1)]
    unknown = {"": np.full(dimensions, np.nan), "_interval95": np.full((dimensions, 2), np.nan)}
    indices: dict = {f"{n}{part}": v for n in ("first", "total") for part, v in unknown.items()}
    indices["kept"] = len(rows)
    if len(rows) < 2:
        return {**indices, "sd": np.nan}
    size = np.abs(rows).max() or 1.0
    rows = rows / size  # what is squared must not overflow
    rows = rows - rows.mean()  # an output far from 0 would spoil the first-order products
    a, mixed, b = rows[:, :1], rows[:, 1:-1], rows[:, -1:]
    terms = np.hstack(
        [b * (mixed - a), 0.5 * (a - mixed) ** 2, 0.5 * (a + b), 0.5 * (a * a + b * b)]
    )

    def shares(means):
        variance = means[..., -1:] - means[..., -2:-1] ** 2
        return means[..., :-2] / np.where(variance > 0, variance, np.nan), variance

    point, variance = shares(terms.mean(axis=0))
    if not variance[0] > FLAT**2:
        return {**indices, "sd": 0.0}
    ends = np.nanquantile(shares(bootstrap_means(terms, seed))[0], (0.025, 0.975), axis=0).T
    for name, entries in (("first", slice(dimensions)), ("total", slice(dimensions, None))):
        indices |= {name: point[entries], f"{name}_interval95": ends[entries]}
    return {**indices, "sd": float(size * np.sqrt(variance[0]))}


def bootstrap_means(terms, seed):
    """(RESAMPLES, ...) means of `terms` (n, ...) over n rows drawn with replacement."""
    n, rng, means = len(terms), np.random.default_rng(seed), []
    rows = max(1, BLOCK // n)
    for start in range(0, RESAMPLES, rows):
        count = min(rows, RESAMPLES - start)
        picks = rng.integers(n, size=(count, n)) + n * np.arange(count)[:, None]
        weights = np.bincount(picks.ravel(), minlength=count * n).reshape(count, n)
        means.append(weights @ terms / n)
    return np.concatenate(means)


def morris_points(dimensions, trajectories, seed):
    """Return the points that `morris_effects` needs."""
    rng, step = np.random.default_rng(seed), LEVELS / (2.0 * (LEVELS - 1))
    base = rng.integers(LEVELS, size=(trajectories, dimensions)) / (LEVELS - 1)
    moved = np.clip(np.where(base < 0.5, base + step, base - step), 0.0, 1.0)
    # when each coordinate moves
    turn = rng.permuted(np.tile(np.arange(dimensions), (trajectories, 1)), axis=1)
    return np.where(
        np.arange(dimensions + 1)[:, None] > turn[:, None, :], moved[:, None, :], base[:, None, :]
    )


# outputs near the largest number come out as not finite
@np.errstate(over="ignore", invalid="ignore")
def morris_effects(points, y):
    """Return the elementary effects: change of y over the step, per unit of the cube."""
    y = np.where(np.isfinite(y), y, np.nan)
    change = np.diff(points, axis=1)
    mover = np.abs(change).argmax(axis=2)
    step = np.take_along_axis(change, mover[..., None], axis=2)[..., 0]
    effects = np.empty(mover.shape)
    np.put_along_axis(effects, mover, np.diff(y, axis=1) / step, axis=1)
    return effects


@np.errstate(over="ignore", invalid="ignore")
def morris_indices(effects):
    """Return mean, mean size and standard deviation of the elementary effects of each input."""
    dimensions = effects.shape[1]
    names = ("mu", "mu_star", "sigma")
    indices = {k: np.full(dimensions, np.nan) for k in names}
    indices |= {f"{k}_interval95": np.full((dimensions, 2), np.nan) for k in names[:2]}
    indices["kept"] = np.isfinite(effects).sum(axis=0)
    for j, column in enumerate(effects.T):
        finite = column[np.isfinite(column)]
        if len(finite) < 2:
            continue
        half = special.stdtrit(len(finite) - 1, 0.975) / np.sqrt(len(finite))
        indices["sigma"][j] = finite.std(ddof=1)
        for name, values in (("mu", finite), ("mu_star", np.abs(finite))):
            mean, sd = values.mean(), values.std(ddof=1)
            indices[name][j] = mean
            indices[f"{name}_interval95"][j] = mean - half * sd, mean + half * sd
    indices["mu_star_interval95"] = np.maximum(indices["mu_star_interval95"], 0.0)
    return indices


METHODS = ("local", "morris", "sobol")

SAMPLES = {"local": None, "morris": 32, "sobol": 512}  # trajectories, base points
LEAST, MOST = {"morris": 4, "sobol": 16}, 1 << 20  # fewest and most samples

RANKED_BY = {"local": "effect", "morris": "mu_star", "sobol": "total"}


@dataclasses.dataclass(frozen=True, kw_only=True, repr=False)
class SensitivityResult(Result):
    """How sensitive measures of a case are to its parameters; made by `tuning.sensitivity`."""

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
    2010, 259 (see `sobol_indices`).

    Parameters
    ----------
    case : Case
    distributions : dict or None
        {dotted name: distribution}; by default the uncertain parameters of the case.
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
    batch, devices, cluster
        As in `ensemble`, to the same bits; workers run the batches of morris and sobol.
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
    check_case(case, seed)
    began, notes = time.perf_counter(), []
    if method not in METHODS:
        raise unknown("method", method, METHODS)
    distributions, draws = what_varies(case, distributions, spread)
    names = check_measures(case, measures, method)
    samples = check_samples(samples, method, notes)
    for name, d in distributions.items():
        if isinstance(d, Correlated) and method != "local":
            raise InputError(
                f"{name}: the effects of parameters that vary together cannot be separated; use"
                " the local method"
            )
    if batch is not None:
        check_whole("batch", batch, 1)
    check_devices(devices)
    check_cluster(cluster, devices)
    noise = seed_of(case, draws.labels, seed)
    half_width, runs, failed = {}, 1, 0
    if method == "local":
        # one key for all runs: differences are the parameters' alone
        key = None if noise is None else jax.random.key(seed)
        columns, half_width = local_columns(case, draws, names, key, progress)
        if cluster is not None:
            notes.append("the local method takes one run: the cluster is not used")
    else:
        make = morris_points if method == "morris" else sobol_points
        points = make(draws.dimensions, samples, seed)
        runs = points.shape[0] * points.shape[1]
        with batch_runner(case, names, noise, devices, cluster) as run:
            nominal, values, failed = _entries(case, draws, names, points, run, batch, progress)
        columns = _columns(case, names, method, points, nominal, values, seed)
    return SensitivityResult(
        case=case,
        method=method,
        samples=samples,
        runs=runs,
        failed=failed,
        seed=seed,
        distributions=distributions,
        parameters=draws.labels,
        half_width=half_width,
        columns=columns,
        notes=notes,
        wall_s=time.perf_counter() - began,
    )


def what_varies(case, distributions=None, spread=None):
    """Return ({name: distribution}, Draws) of a study."""
    if spread is not None and not (type(spread) in (int, float) and 0 < spread < 1):
        raise InputError(f"spread = {spread!r}: must be a share above 0 and below 1, as 0.05")
    if distributions is not None and spread is not None:
        raise InputError(
            "distributions name what varies, spread how much all that the case calls uncertain"
            " varies: give one of them"
        )
    return varied(case, distributions, spread)


def check_measures(case, measures, method):
    """Return the names of the measures of a study."""
    # Raises InputError where the case lacks one or the method cannot treat it.
    counted = lambda m: method == "local" and ms.MEASURES[m].counts
    if measures is None:
        usual = (*case.objective, "rms_error_total", "max_level")
        names = [m for m in usual if ms.serves(m, case.loop) and not counted(m)]
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
            if counted(m):
                raise InputError(
                    f"measure {m} counts whole samples and has no derivative: take the method"
                    " morris or sobol"
                )
    return tuple(dict.fromkeys(names))


def check_samples(samples, method, notes):
    """Return the number of samples, for Sobol a power of 2, None for the local method."""
    if method == "local":
        if samples is not None:
            notes.append("the local method takes one run and its derivatives: samples are not used")
        return None
    samples = SAMPLES[method] if samples is None else samples
    check_whole(f"method {method}: samples", samples, LEAST[method], MOST)
    if method == "sobol" and samples & (samples - 1):
        power = 1 << samples.bit_length()
        notes.append(
            f"samples: {samples} rounded up to {power}; Sobol points are evenly spread in powers"
            " of 2"
        )
        return power
    return samples


def _entries(case, draws, names, points, run, batch, progress):
    """Return measures of the own run (K,) and of `points` (samples, runs, K), and failures."""
    # batches have one size, so that one compiled program serves; the case's own run goes first
    values = {
        name: np.concatenate([np.asarray(get_value(case.loop, name))[None], v])
        for name, v in draws.values(points.reshape(-1, points.shape[-1])).items()
    }
    total = points.shape[0] * points.shape[1] + 1
    most = 1 << (max(1, SAMPLES_AT_ONCE // case.clock.samples).bit_length() - 1)
    size = min(batch or max(8, min(RUNS_AT_ONCE, most)), total)
    sizes = [ms.entries(m, case.loop.plant) for m in names]
    entries, broken = np.empty((total, sum(sizes))), np.zeros(total, dtype=bool)

    def inputs(start):
        index = np.minimum(np.arange(start, start + size), total - 1)
        return {name: v[index] for name, v in values.items()}, None

    for done, (start, measures) in enumerate(run(range(0, total, size), inputs, size), 1):
        rows = slice(start, min(start + size, total))
        flat = np.concatenate([measures[m].reshape(size, -1) for m in names], axis=1)
        entries[rows] = flat[: total - start]
        broken[rows] = measures["failed"][: total - start] > 0
        if progress is not None:
            progress(min(size * done, total) - 1, total - 1)
    entries[broken] = np.nan
    return entries[0], entries[1:].reshape(*points.shape[:2], -1), int(broken[1:].sum())


def _columns(case, names, method, points, nominal, values, seed):
    """The Columns of a study by runs at `points`."""
    columns = []
    for k, entry in enumerate(entries_of(case, names)):
        y, reason = values[..., k], ""
        sobol = method == "sobol"
        effects = sobol_indices(y, seed) if sobol else morris_indices(morris_effects(points, y))
        known = np.isfinite(effects[RANKED_BY[method]])
        if not known.all():
            few = np.min(effects["kept"]) < 2
            reason = "fewer than 2 samples in which it is finite" if few else "it does not vary"
        bad, empty = int(np.sum(~np.isfinite(y))), not known.any()
        columns.append(Column(*entry, float(nominal[k]), bad, effects, reason, empty))
    return columns


CHUNK = 16  # parameters whose derivatives are computed at once
NORMAL_WIDTH = 2.0  # half-width of a normal distribution, in standard deviations [-]

RUNS_AT_ONCE, SAMPLES_AT_ONCE = 64, 1 << 22  # of a batch

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
    plant, units = case.loop.plant, case.loop.units
    return [
        (m, entry_label(plant, m, ms.MEASURES[m].per, i), ms.unit(m, units))
        for m in names
        for i in range(ms.entries(m, plant))
    ]


def local_columns(case, draws, names, key, progress=None):
    """Return the Columns by derivatives at the case's own values, and {parameter: half-width}."""
    widths = half_widths(draws)
    steps = {name: width for group in widths for name, width in group.items()}
    scalars = list(steps)
    nominal, derivatives = _derivatives(case, scalars, names, key, progress)
    _drop_contradicted(case, steps, names, key, nominal, derivatives)
    by_name = dict(zip(scalars, derivatives.T))
    absent = np.full(len(nominal), np.nan)
    effect, single, values, half_width = [], [], [], {}
    for label, group in zip(draws.labels, widths):
        name, *others = group
        effect.append(sum(by_name[n] * width for n, width in group.items()))
        single.append(absent if others else by_name[name])
        values.append(np.nan if others else float(get_value(case.loop, name)))
        half_width[label] = list(group.values()) if others else group[name]
    single = np.stack(single, axis=1)
    elasticity = single * np.array(values) / np.where(nominal == 0, np.nan, nominal)[:, None]
    effects = {"effect": np.stack(effect, axis=1), "derivative": single, "elasticity": elasticity}
    columns = []
    for k, entry in enumerate(entries_of(case, names)):
        row = {quantity: column[k] for quantity, column in effects.items()}
        good = bool(np.isfinite(row["effect"]).all())
        reason = "" if good else UNUSABLE
        columns.append(Column(*entry, float(nominal[k]), int(not good), row, reason))
    return columns, half_width


def _derivatives(case, scalars, names, key, progress):
    """(K,) entries of the measures and (K, scalars) their derivatives, CHUNK scalars at once."""
    columns, measures = [], {}
    for start in range(0, len(scalars), CHUNK):
        chunk = scalars[start : start + CHUNK]
        values = {name: float(get_value(case.loop, name)) for name in chunk}
        measures, rates, _, diverged = lp.sensitivities(case.loop, case.clock, names, values, key)
        if diverged:
            raise NonFiniteError(
                f"{case.name}: a level stops being finite at the case's own values, so there are no"
                " derivatives"
            )
        columns.append(np.concatenate([np.reshape(rates[m], (-1, len(chunk))) for m in names]))
        if progress is not None:
            progress(start + len(chunk), len(scalars))
    return _flat(measures, names), np.concatenate(columns, axis=1)


def _flat(measures, names):
    return np.concatenate([np.ravel(measures[m]) for m in names])


def _drop_contradicted(case, steps, names, key, nominal, derivatives):
    """Set derivatives (K, scalars) to NaN where runs contradict them."""
    # by runs one step to either side, for scalars that would change an entry by more than itself
    sizes = np.abs(nominal)
    for j, (name, step) in enumerate(steps.items()):
        if np.all(np.abs(derivatives[:, j] * step) <= sizes):
            continue
        moves, rows = np.array([1.0, -1.0]) * step, []
        for value in float(get_value(case.loop, name)) + moves:
            loop = with_values(case.loop, {name: value})
            measures, broken = lp.evaluate_and_flag(loop, case.clock, names, key)
            rows.append(_flat(measures, names) * (np.nan if broken else 1.0))
        wrong = contradicted(moves[:, None] * derivatives[:, j], np.array(rows) - nominal, sizes)
        derivatives[wrong, j] = np.nan


def half_widths(draws):
    """Return for each dimension {name of a scalar that it moves: half-width}."""
    widths = []
    for name, d, nominal, _ in draws.parts:
        if isinstance(d, Correlated):
            sd = np.sqrt(np.diag(np.asarray(d.covariance, dtype=float)))
            widths += [{n: float(NORMAL_WIDTH * s)} for n, s in zip(d.names, sd)]
            continue
        width = np.broadcast_to(_half_width(d, nominal), nominal.shape)
        entries = {label: float(width[i]) for i, label in entry_names(name, nominal.shape)}
        if nominal.ndim and d.tied:
            widths.append(entries)
        else:
            widths += [{n: abs(w)} for n, w in entries.items() if n in draws.labels]
    return widths


def _half_width(d, nominal):
    if isinstance(d, Normal):
        sd = d.sd if d.relative is None else d.relative * np.abs(nominal)
        return min(NORMAL_WIDTH, d.cut) * cast(Any, sd)
    if isinstance(d, Discrete):
        return 0.5 * (max(d.values) - min(d.values))
    ends = (d.quantile(np.full(nominal.shape, p), nominal) for p in (1.0, 0.0))
    return 0.5 * np.subtract(*ends)
