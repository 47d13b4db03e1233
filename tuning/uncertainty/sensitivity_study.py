"""Which parameter moves which measure: exact derivatives, Morris' elementary effects, Sobol's
shares of the variance.
"""

import dataclasses
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax
import numpy as np

from jaxtank import measures as ms
from jaxtank.case import Case
from jaxtank.core.errors import InputError, unknown
from jaxtank.core.tree import get_value
from jaxtank.loop import run as lp
from tuning.problem import scenarios as sc
from tuning.uncertainty import indices
from tuning.uncertainty.distributions import Correlated, Draws, stated
from tuning.uncertainty.local import Column, entries_of, local_columns
from tuning.uncertainty.sampling import spread_of
from tuning.uncertainty.study import check_devices

METHODS = ("local", "morris", "sobol")

SAMPLES = {"local": None, "morris": 32, "sobol": 512}
"""Trajectories of Morris and base points of Sobol unless told otherwise."""

LEAST, MOST = {"morris": 4, "sobol": 16}, 1 << 20
"""Fewest samples that an interval can be drawn from, and most that are taken."""

LANES, NUMBERS = 64, 1 << 22
"""Runs in a batch, and the samples that all of them may have together: what is prepared before the
loop is held for each.
"""

RANKED_BY = {"local": "effect", "morris": "mu_star", "sobol": "total"}


@dataclasses.dataclass(frozen=True, kw_only=True)
class SensitivityResult:
    """What `sensitivity` found. `.text()` for tables, `.to_json()`, `.figures()` for pictures,
    `.save(dir)` for files.

    parameters: (D,) dotted names of what varies; values: {name: its own value (list of them where
    entries are tied)}; half_width: {name: (D,) of the local method, in the parameter's unit};
    columns: one Column for each entry of each measure; runs: simulations; failed: how many of them
    stopped being finite; samples: trajectories or base points, None for the local method.
    """

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
        """The parameters' indices, the one that moves the column most first; those without an index
        last.
        """
        size = np.abs(column.felt[RANKED_BY[self.method]])
        return np.argsort(np.where(np.isfinite(size), -size, np.inf), kind="stable")

    def to_json(self):
        """The JSON object of `jaxtank sensitivity --json`."""
        from tuning.report.sensitivity_tables import json_of

        return json_of(self)

    def text(self):
        """The result as a page of text."""
        from tuning.report.sensitivity_tables import text

        return text(self)

    def figures(self):
        """Matplotlib figures {"tornado" or "sobol": figure}."""
        from tuning.report.sensitivity_tables import figures

        return figures(self)

    plot = figures

    def save(self, folder, command=None):
        """Write result.json, sensitivity.csv, the picture and report.html, which says the line
        `command`, to a folder; returns their paths.
        """
        from tuning.report.sensitivity_tables import save

        return save(self, folder, command)

    def __repr__(self):
        return self.text()


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
    progress: Callable | None = None,
) -> SensitivityResult:
    """Which uncertain parameter moves which measure of a case.

    distributions: {dotted name: distribution}; what the case calls uncertain, uniform within its
    own share, where None; spread: one share for all that the case calls uncertain [-], instead of
    `distributions`. method: "local": derivative at the case's own values times half-width of the
    distribution; "morris": elementary effects over `samples` (32) trajectories, samples (D + 1)
    runs;
    "sobol": first and total order from `samples` (512) base points, rounded up to a power of 2,
    samples (D + 2) runs. measures: names, those of the case's objective, rms_error_total and
    max_level where None; seed: of the points and of the sensor noise, which is the same in every
    run; batch: runs at once; devices: of this process, each of which takes batches of its own, to
    the same bits; progress: called with (runs done, runs in all). Returns a SensitivityResult.
    Raises InputError before anything is run, and NonFiniteError if the local method meets a run
    that is not finite.
    """
    began = time.perf_counter()
    if method not in METHODS:
        raise unknown("method", method, METHODS)
    given = what_varies(case, distributions, spread)
    draws = Draws(case.loop, given)
    if not draws.dimensions:
        raise InputError(
            "nothing moves: a relative spread leaves zeros alone, and all values are zero"
        )
    names = check_measures(case, measures, method)
    notes = []
    if method == "local":
        if samples is not None:
            notes.append("the local method takes one run and its derivatives: samples are not used")
        samples = None
    else:
        samples = check_samples(samples, method, notes)
        for name, d in given.items():
            if isinstance(d, Correlated):
                raise InputError(
                    f"{name}: parameters that vary together have no effects of their own; take the"
                    " local method"
                )
    if isinstance(seed, bool) or not isinstance(seed, int) or not 0 <= seed < 2**31:
        raise InputError(f"seed = {seed!r}: must be a whole number from 0 to {2**31 - 1}")
    if batch is not None and (isinstance(batch, bool) or not isinstance(batch, int) or batch < 1):
        raise InputError(f"batch = {batch!r}: must be a whole number of at least 1")
    check_devices(devices)
    random = sc.noisy(case) or any(n.startswith("sensor.noise") for n in draws.labels)
    # one key for all runs: differences are the parameters' alone
    key = jax.random.key(seed) if random else None
    lp.check(case.loop, case.clock, key)
    half_width = {}
    if method == "local":
        columns, half_width = local_columns(case, draws, names, key, progress)
        runs, failed = 1, 0
    else:
        points = (indices.morris_points if method == "morris" else indices.sobol_points)(
            draws.dimensions, samples, seed
        )
        run = Runs(case, draws, names, key, batch, progress, devices)
        found = run(points.reshape(-1, draws.dimensions)).reshape(*points.shape[:2], -1)
        columns = [
            _column(
                case,
                names,
                k,
                run.nominal[k],
                found[..., k],
                _indices(method, points, found[..., k], seed),
            )
            for k in range(found.shape[-1])
        ]
        runs, failed = found.shape[0] * found.shape[1], run.failed
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


def what_varies(case, distributions=None, spread=None):
    """{name: distribution} of a study: `distributions`, or what the case calls uncertain, within
    one `spread` or its own.
    """
    if spread is not None and (
        isinstance(spread, bool) or not isinstance(spread, (int, float)) or not 0 < spread < 1
    ):
        raise InputError(f"spread = {spread!r}: must be a share above 0 and below 1, as 0.05")
    if distributions is not None and spread is not None:
        raise InputError(
            "distributions say what varies, spread how much of the case's own: give one of them"
        )
    return spread_of(case, spread) if distributions is None else stated(distributions)


def check_measures(case, measures, method):
    """The names of the measures of a study, if the case has them all and the method can say
    something of each.
    """
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
                    f"measure {m} means nothing for {case.name}: it has no changes of setpoint, or"
                    " nothing is poured"
                )
            if method == "local" and ms.MEASURES[m].counts:
                raise InputError(
                    f"measure {m} counts whole samples and has no derivative: take the method"
                    " morris or sobol"
                )
    return tuple(dict.fromkeys(names))


def check_samples(samples, method, notes):
    """The number of samples, for Sobol a power of 2; says in `notes` if that is not what was asked."""
    samples = SAMPLES[method] if samples is None else samples
    if (
        isinstance(samples, bool)
        or not isinstance(samples, int)
        or not LEAST[method] <= samples <= MOST
    ):
        raise InputError(
            f"samples = {samples!r}: the method {method} takes a whole number from {LEAST[method]}"
            f" to {MOST}"
        )
    if method == "sobol" and samples & (samples - 1):
        notes.append(
            f"samples: {samples} rounded up to {1 << samples.bit_length()}, Sobol points are even"
            " in powers of 2"
        )
        samples = 1 << samples.bit_length()
    return samples


class Runs:
    """A case as a function of the unit cube: (n, D) probabilities in, (n, K) entries of measures
    out, NaN where a run is not finite.

    Batches have one size, so that one compiled program serves; the case's own run goes first. After
    a call `nominal` (K,) holds its values and `failed` the number of other runs that stopped being
    finite.
    """

    def __init__(self, case, draws, names, key, batch=None, progress=None, devices=1):
        (self.group,) = sc.groups_of([sc.ScenarioRun("", case, key, 1.0)])
        self.own = {
            name: np.asarray(get_value(case.loop, name))[None]
            for name in draws.values(np.zeros((0, draws.dimensions)))
        }
        self.draws, self.names, self.progress = draws, names, progress
        self.batch = batch or max(
            8, min(LANES, 1 << (max(1, NUMBERS // case.clock.samples).bit_length() - 1))
        )
        self.nominal: Any = None
        self.failed = 0
        self.devices, self.pool = jax.local_devices()[:devices], ThreadPoolExecutor(devices)

    def _batch(self, device, values):
        measures, broken = sc.values_of(self.group, self.names, jax.device_put(values, device))
        flat = np.concatenate(
            [np.asarray(measures[m])[:, 0].reshape(len(broken), -1) for m in self.names], axis=1
        )
        return np.where(np.asarray(broken), np.nan, flat), np.asarray(broken)[:, 0]

    def __call__(self, p):
        values = {
            name: np.concatenate([self.own[name], v]) for name, v in self.draws.values(p).items()
        }
        total, found = len(p) + 1, []
        size = min(self.batch, total)
        starts = range(0, total, size)
        for group in (
            starts[i : i + len(self.devices)] for i in range(0, len(starts), len(self.devices))
        ):
            rows = [
                np.minimum(np.arange(start, start + size), total - 1) for start in group
            ]  # the last run repeated to fill the batch
            done = self.pool.map(
                self._batch,
                self.devices,
                [{name: v[r] for name, v in values.items()} for r in rows],
            )
            for start, (flat, lost) in zip(group, done):
                found.append(flat[: total - start])
                self.failed += int(lost[: total - start].sum()) - int(start == 0 and lost[0])
            if self.progress is not None:
                self.progress(min(group[-1] + size, total) - 1, len(p))
        found = np.concatenate(found)
        self.nominal = found[0]
        return found[1:]


def _column(case, names, k, nominal, y, felt):
    measure, label, unit = entries_of(case, names)[k]
    bad = int(np.sum(~np.isfinite(y)))
    known, reason = np.isfinite(felt["total" if "total" in felt else "mu_star"]), ""
    if not known.all():
        reason = (
            "fewer than 2 samples in which it is finite"
            if np.min(felt["kept"]) < 2
            else "it does not vary"
        )
    return Column(measure, label, unit, float(nominal), bad, felt, reason, not known.any())


def _indices(method, points, y, seed):
    if method == "sobol":
        return indices.sobol_indices(y, seed)
    return indices.morris_indices(indices.morris_effects(points, y))
