"""Plant parameters from a log: output error, Gauss-Newton with exact sensitivities, and how far the
answer is to be believed.
"""

import dataclasses
import functools
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
from numpy.typing import ArrayLike
from scipy.stats import chi2

import jaxtank
from jaxtank.case import Case
from jaxtank.core.errors import DataError, InputError
from jaxtank.plants.base import Plant
from tuning.identification import confidence as idf
from tuning.identification import experiment as lg
from tuning.identification.confidence import stopped
from tuning.identification.identified_case import bare, proposed
from tuning.identification.problem import Estimation, Fit, check_length
from tuning.identification.proposal import check_law
from tuning.problem.result import Result
from tuning.problem.status import Status
from tuning.storage.batch_store import digest
from tuning.storage.evaluation_log import Log, Memo, folder_of

LOSSES = ("linear", "soft_l1", "huber")
AGREE = 1.001
"""Two searches whose sums of squares differ by less than this factor have ended in the same place."""


@dataclasses.dataclass(frozen=True, kw_only=True, repr=False)
class Identification(Result):
    """What `identify` found. See `jaxtank identify --json` for the same as a table; `save(folder)`,
    `plot()`.
    """

    REPORT = "tuning.report.identification"

    case: Any  # the case that was given
    estimation: Estimation
    fit: Fit
    status: Status  # CONVERGED, NOT_CONVERGED, NOT_IDENTIFIABLE or INTERRUPTED
    # {name: {"before", "value", "unit", "lower", "upper", "sd", "interval95", "identifiable",
    # "at_bound"}}
    parameters: dict
    levels: list  # of each log, of each tank: {"value", "interval95"}
    covariance: tuple  # (names, (n, n)) of the parameters that have an interval, in their units
    # {"rmse", "nrmse_percent", "residual_autocorrelation"}: per channel; and {"widened", "noise"}
    quality: dict
    # what the data cannot tell apart: {"words", "parameters" {name: factor}, "sd"}
    directions: list
    remedies: list  # words: what experiment would tell it
    starts: list  # {"cost", "evaluations", "agrees"}
    validation: dict | None
    profile: dict | None
    wall_s: float
    seed: int
    law: str | None = None  # controller that is proposed for the rig

    @functools.cached_property
    def proposed(self) -> tuple[Case, str | None]:
        """(`identified`, why): why no controller of the kind `law` could be proposed, None where it
        was, or none was asked for.
        """
        return proposed(self)

    @property
    def identified(self) -> Case:
        """The case with the estimated plant in it, in the law's and the observer's models too, with
        covariance and noise.
        """
        return self.proposed[0]

    @property
    def message(self) -> str:
        """In words: how it ended."""
        return self._report().message(self)


def identify(
    case: Case | Plant,
    log: lg.Log | Sequence[lg.Log],
    free: Mapping[str, Any] | None = None,
    *,
    start: str = "free",
    starts: int = 8,
    seed: int = 0,
    hold_back: float = 0.25,
    noise: ArrayLike | None = None,
    loss: str = "linear",
    substeps: int | None = None,
    profile: bool = False,
    iterations: int = 100,
    gap: float = 1.5,
    folder: str | Path | None = None,
    checkpoint: str | Path | None = None,
    resume: bool = False,
    progress: Callable | None = None,
    ready: Callable | None = None,
    law: str | None = None,
) -> Identification:
    """Estimate parameters of a rig from one log or several, by least squares on the simulated
    readings (output error).

        min over theta, h(0)   sum over readings ((y_k - y(t_k; theta, h(0))) / sigma)^2

    case: a Case, or a plant for one with ideal pumps and sensors; log: a `tuning.Log` (see
    tuning.log, tuning.read_log), or a list of them, each with its own start; free: {name: (low,
    high)} or (low, high, "log" or "linear"), of plant, sensor, actuator or a constant disturbance;
    None: pump gains, splits, orifices and pipes; start: levels at the first sample of each log:
    "free" (estimated, too), "measured" or "case"; starts: searches, the first from the case's own
    values, the others from Sobol points of the ranges; hold_back: share of each log (below 1), or
    number of samples, at its end on which a fit to the rest is judged before all is fitted; noise:
    standard deviation of each channel in its unit, from the record where None; loss: "linear",
    "soft_l1" or "huber" (beyond 3 standard deviations);
    substeps: of Runge-Kutta per sample, found where None; profile: whether to trace the profile
        likelihood of the worst parameter;
    gap: longest step between samples, in median steps; checkpoint (or folder): where a log
    of the searches is kept, with which resume=True goes on after a
    kill, to the same bits; progress: called with the Fit of each search that has ended; if it
    raises KeyboardInterrupt, the best of them is gone on with; ready: called with nothing once all
    has been checked, before the first search;
    law: "pi" for the identified rig under a PI controller with gains from its model
        (`proposal.py`), None for the case's own.

    Returns an Identification. Raises InputError for what cannot be estimated, DataError for a log
    that cannot be used.
    """
    began, folder = time.perf_counter(), folder_of(checkpoint, folder=folder)
    if not jax.config.read("jax_enable_x64"):
        raise InputError(
            "identification needs float64: call jax.config.update('jax_enable_x64', True) first"
        )
    case = bare(case) if isinstance(case, Plant) else case
    check_law(law, case)
    logs = [log] if isinstance(log, lg.Log) else list(log)
    if not logs:
        raise InputError("no log is given")
    if loss not in LOSSES:
        raise InputError(f"loss = {loss!r}: must be one of {', '.join(LOSSES)}")
    for name, count in (("starts", starts), ("iterations", iterations)):
        if not isinstance(count, int) or isinstance(count, bool) or count < 1:
            raise InputError(f"{name} = {count!r}: must be a whole number above 0")
    for one in logs:
        lg.check_gaps(one, gap)
        lg.check_fits(one, case.loop)
    kept = [_kept(one, hold_back) for one in logs]
    options = {
        "free": free,
        "start": start,
        "noise": noise,
        "substeps": substeps,
        "samples": max(one.samples for one in logs),
    }
    begin = [one.part(0, n) for one, n in zip(logs, kept)]
    longest, first = (max(np.diff(one.t).max() for one in side) for side in (logs, begin))
    if substeps is None and longest > 1.01 * first:  # the longest step is in what is held back
        options["substeps"] = Estimation(case, logs, **options).substeps
    partial = Estimation(case, begin, **options)
    check_length(logs)
    memo = Memo()
    if folder is not None:
        memo = Log(
            folder,
            _problem(
                case, logs, partial, {**options, "loss": loss, "iterations": iterations, "gap": gap}
            ),
            resume,
        )
    if ready is not None:
        ready()
    fits, interrupted = [], False
    try:
        for z in partial.begin(starts, seed):
            fits.append(_search(memo, partial, z, loss, iterations))
            if progress is not None:
                progress(fits[-1])
    except KeyboardInterrupt:
        if not fits:
            raise
        interrupted = True
    ranked = sorted((f for f in fits if np.isfinite(f.cost)), key=lambda f: f.cost)
    if not ranked:
        raise DataError(f"{logs[0].name}: no search ended with finite readings")
    best, estimation, validation = (
        partial.solve(partial.unknowns(ranked[0]), loss, iterations),
        partial,
        None,
    )
    if any(n < one.samples for n, one in zip(kept, logs)):
        estimation = Estimation(
            case, logs, **(options | {"substeps": partial.substeps, "noise": partial.noise})
        )
        validation = idf.held_back(estimation, partial, best, kept)
        best = estimation.solve(partial.unknowns(best), loss, iterations)
    # branch gains may leave the ranges of gain and split: the same search in these themselves
    if not _within(estimation, best):
        plain = estimation.plainly()
        values = estimation.coordinates.values(best.p)
        start_at = np.concatenate(
            [plain.coordinates.point(values), best.own.ravel() / plain.level_scale]
        )
        estimation, best = plain, plain.solve(np.clip(start_at, *plain.box), loss, iterations)
    if not np.isfinite(best.cost):
        raise DataError(
            f"{logs[0].name}: what fits the first {kept[0]} samples cannot be simulated over all of"
            " them"
        )
    quality = idf.quality(estimation, best)
    spread = idf.Spread(estimation, best, quality)
    if spread.open.any():
        best = _nearest(estimation, best, spread.scale, loss, iterations)
        quality = idf.quality(estimation, best)
        spread = idf.Spread(estimation, best, quality)
    parameters, levels = spread.parameters(), spread.levels()
    directions = spread.directions()
    status = (
        "converged" if best.status > 0 and not stopped(case.loop, parameters) else "not_converged"
    )
    if not all(
        p["identifiable"] for p in parameters.values()
    ):  # a level at the start that is not told costs nothing but its interval
        status = "not_identifiable"
    if interrupted:
        status = "interrupted"
    return Identification(
        case=case,
        estimation=estimation,
        fit=best,
        status=Status(status),
        parameters=parameters,
        levels=levels,
        covariance=spread.covariance_of_values(),
        quality=quality
        | {"widened": spread.widened, "noise": [float(v) for v in estimation.noise]},
        directions=directions,
        remedies=idf.remedies(estimation, best, spread) if status == "not_identifiable" else [],
        starts=[
            {
                "cost": f.cost,
                "evaluations": f.evaluations,
                "agrees": bool(f.cost <= ranked[0].cost * AGREE + 1e-12),
            }
            for f in fits
        ],
        validation=validation,
        profile=(
            idf.profile(estimation, best, spread, loss) if profile and not interrupted else None
        ),
        wall_s=time.perf_counter() - began,
        seed=seed,
        law=law,
    )


def _search(memo, estimation, z, loss, iterations):
    """The Fit of a first search from z. One that a memo knows is where it ended, without its
    residual and jacobian.
    """
    made = []

    def compute():
        made.append(estimation.solve(z, loss, iterations, tolerance=1e-8))
        return (
            made[0].p,
            made[0].own,
            made[0].cost,
            float(made[0].evaluations),
            float(made[0].status),
        )

    p, own, cost, evaluations, status = memo.recall("search", [z], compute)
    if made:
        return made[0]
    none = np.zeros((0, estimation.size))
    return Fit(
        p=p,
        own=own,
        cost=cost,
        residual=none[:, 0],
        jacobian=none,
        evaluations=int(evaluations),
        status=int(status),
        loss=loss,
    )


def _problem(case, logs, partial, options):
    """What two runs must share for one to go on where the other ended: {what: text}."""
    return {
        "command": "identify",
        "case": digest([np.asarray(leaf) for leaf in jax.tree.leaves(case.loop)]),
        "logs": digest([np.asarray(v) for one in logs for v in (one.t, one.u, one.y)]),
        "free": repr([tuple(b) for b in partial.bounds]),
        "held back": repr([one.samples for one in partial.logs]),
        "noise": repr(partial.noise.tolist()),
        "substeps": repr(partial.substeps),
        **{n: repr(options[n]) for n in ("start", "loss", "iterations", "gap")},
        "jaxtank": jaxtank.__version__,
        "jax": jax.__version__,
    }


def _within(estimation, fit):
    """Whether every value lies in its range."""
    values = estimation.coordinates.values(fit.p)
    return all(
        b.low - 1e-9 * abs(b.high) <= values[b.name] <= b.high + 1e-9 * abs(b.high)
        for b in estimation.bounds
    )


def _nearest(estimation, best, scale, loss, iterations):
    """Of the points in the 95 % region about `best` one near to the case's own values: a search
    that slides along a valley ends in a corner that says nothing.
    """
    origin, most = (
        estimation.origin(),
        best.residual @ best.residual + chi2.ppf(0.95, estimation.size) * scale,
    )
    for strength in (100.0, 30.0, 10.0, 3.0, 1.0):
        near = estimation.solve(origin, loss, iterations, tolerance=1e-8, pull=(origin, strength))
        if near.residual.size and near.residual @ near.residual <= most:
            return near
    return best


def _kept(one, hold_back):
    """Number of samples of a Log that the first fit sees."""
    if not (
        isinstance(hold_back, (int, float))
        and not isinstance(hold_back, bool)
        and 0 <= hold_back < one.samples
    ):
        raise InputError(
            f"hold_back = {hold_back!r}: must be a share from 0 to below 1, or a number of samples"
            f" below {one.samples}"
        )
    kept = one.samples - (round(hold_back * one.samples) if hold_back < 1 else int(hold_back))
    return max(kept, 2)
