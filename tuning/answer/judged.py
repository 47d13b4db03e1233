"""How a set of gains does on plants that no search has used, at the case's own step."""

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np

from jaxtank import measures as ms
from jaxtank.case import Case
from tuning.answer.plants import run_plants
from tuning.answer.setting import Setting, limited_levels, measured, setting_of
from tuning.feasible.study import can_follow, can_judge
from tuning.problem.functions import as_measures
from tuning.problem.limits import resolve_limits
from tuning.problem.result import Shown
from tuning.problem.scenarios import noisy
from tuning.search.options import check_options, check_precision
from tuning.uncertainty.sampling import clopper_pearson
from tuning.uncertainty.validation import SEED_OFFSET

FRESH = 256
"""Plants on which an answer is judged."""

NOMINAL = ("rms_error_total", "rms_error", "settling_time", "recovery_time")
"""Measures of the nominal plant, which runs beside them, besides those of every plant."""


@dataclasses.dataclass(frozen=True, kw_only=True, repr=False)
class Judged(Shown):
    """A case on N plants that are not exactly known, with sensor noise; made by `tuning.validate`.

    Parameters
    ----------
    cost, error : (N,) objective; total rms error [unit of length].
    level : (N, tanks) highest levels.
    travel : (N,) rms change of the inputs per sample, as a share of their range [-].
    held : (N,) True where every limit holds; failed : (N,) True where the run diverged.
    infeasible : (N,) True where no controller can hold a setpoint; None where that is not known.
    limits : the Limits; measures : {name: (N, ...)}.  unit : of length.
    nominal : {name: value} of the nominal plant without noise: the measures above and NOMINAL; None
        where the case states noise, or that run diverged.
    runs : what the N runs are, in words: plants, or one plant with new noise.
    """

    cost: np.ndarray
    error: np.ndarray
    level: np.ndarray
    travel: np.ndarray
    held: np.ndarray
    failed: np.ndarray
    infeasible: np.ndarray | None
    limits: list[Any]
    measures: dict[str, np.ndarray]
    unit: str
    nominal: dict[str, np.ndarray] | None = None
    runs: str = "plants"

    @property
    def samples(self) -> int:
        """Number of plants N."""
        return len(self.cost)

    def share_held(self) -> dict[str, Any]:
        """Return {"share", "interval95", "samples"} of the plants on which every limit holds."""
        held, n = int(self.held.sum()), self.samples
        return {"share": held / n, "interval95": clopper_pearson(held, n), "samples": n}

    def to_json(self) -> dict[str, Any]:
        """Return means over the plants whose run is finite, as plain numbers."""
        good = ~self.failed
        mean = lambda values: float(np.mean(values[good])) if good.any() else None
        held = self.share_held()
        return {
            "samples": self.samples,
            "failed": int(self.failed.sum()),
            "objective": mean(self.cost),
            "error": mean(self.error),
            "highest_level": self.level[good].max(axis=0).tolist() if good.any() else None,
            "travel_percent": mean(100.0 * self.travel),
            "limits_held": held["share"],
            "interval95": held["interval95"],
        }

    def _rows(self) -> dict[str, str]:
        found = self.to_json()
        low, high = (100.0 * end for end in found["interval95"])
        numbers = {
            "limits held": f"{100 * found['limits_held']:.3g} % of {self.samples} {self.runs}"
            f" (95 % interval {low:.3g} to {high:.3g} %)"
        }
        if found["error"] is not None:
            levels = ", ".join(f"{v:.4g}" for v in found["highest_level"])
            numbers |= {
                "mean total rms error": f"{found['error']:.4g} {self.unit}",
                "highest levels": f"{levels} {self.unit}",
                "rms change of input per sample": f"{found['travel_percent']:.3g} % of their range",
            }
        if found["failed"]:
            numbers["diverged"] = f"{found['failed']} plants"
        return numbers

    def plot(self) -> dict[str, Any]:
        """Return matplotlib figures {"plants": errors and highest levels}; {} where every run
        diverged.
        """
        return drawn({"plants": self})

    def worst(self) -> list[dict[str, Any]]:
        """Return a dict for each limit: the Limit, its worst value, and on how many plants it is
        violated."""
        rows = []
        for limit in self.limits:
            values = self.measures[limit.measure].reshape(self.samples, -1)[:, limit.index]
            margins = limit.margins(values)
            i = int(np.argmin(margins))
            rows.append(
                {
                    "limit": limit,
                    "value": float(values[i]),
                    "margin": float(margins[i]),
                    "plant": i,
                    "broken": int((margins < 0).sum()),
                }
            )
        return rows


def drawn(sides: Mapping[str, Judged]) -> dict[str, Any]:
    """Return {"plants": figure} of {name: Judged}, one or before and after; {} where every run of
    one diverged.
    """
    if any(one.failed.all() for one in sides.values()):
        return {}
    from jaxtank.plots.uncertainty import plants

    found = {name: (one.error[~one.failed], one.level[~one.failed]) for name, one in sides.items()}
    last = list(sides.values())[-1]
    limits = np.full(last.level.shape[1], np.inf)
    for limit in last.limits:
        if limit.measure == "max_level":
            limits[limit.index] = limit.value
    return {"plants": plants(found, limits, last.unit)}


def validate(
    case: Case,
    samples: int = FRESH,
    seed: int = 0,
    *,
    distributions: Mapping[str, Any] | None = None,
    objective: Any = None,
    limits: Any = None,
) -> Judged:
    """Return how a case does on plants that are not exactly known, with noise in the readings.

    The noise is that of the case or its scenarios, else 0.1 % of the height of its tanks. The same
    plants and noise for the same seed, and the plants of `tune` for its seed.

    Parameters
    ----------
    case : the Case, with the gains and the safety filter that it has.
    samples : number of plants.
    seed : of plants and noise.
    distributions : {name: distribution or share}; what the case calls uncertain where None, 5 % of
        every flow where that is nothing.
    objective : {measure: weight} or a function of one's own; as in `tuning.tune`.
    limits : {measure: value}, and `Constraint`s, as in `tuning.tune`; those of the case where None.

    Returns
    -------
    Judged

    Raises
    ------
    InputError : for a name or a value that cannot be used.

    Examples
    --------
    >>> import jax, tuning
    >>> from jaxtank import presets
    >>> jax.config.update("jax_enable_x64", True)
    >>> found = tuning.validate(presets.find("cascaded/pi"), samples=8)
    >>> found.share_held()["share"]
    0.0
    """
    check_precision()
    check_options(samples=samples)
    objective, limits = as_measures(objective, limits)
    return judge(setting_of(case, objective, limits, distributions), samples, seed)


def judge(setting: Setting, samples: int, seed: int, round_: int = 0) -> Judged:
    """Return how the searched case of a setting does on `samples` plants."""
    case, names = setting.searched, measured(setting)
    limits = resolve_limits(case, setting.case.limits)
    wanted = (*names, *(limit.measure for limit in limits))
    own = tuple(m for m in NOMINAL if ms.serves(m, case.loop)) if not noisy(setting.case) else ()
    found = run_plants(
        case,
        setting.distributions,
        samples,
        (SEED_OFFSET + seed + 104_729 * round_) % 2**31,
        tuple(dict.fromkeys((*wanted, *own))),
        bool(own),
    )
    by = {m: found.measures[m] for m in dict.fromkeys(wanted)}
    rows = {m: v.reshape(samples, -1) for m, v in by.items()}
    cost = sum(w * rows[m].sum(axis=1) for m, w in setting.objective.items())
    past = [limit.margins(rows[limit.measure][:, limit.index]) < 0 for limit in limits]
    changes = np.sqrt(rows["mean_square_travel"]) / setting.span
    return Judged(
        cost=np.asarray(cost),
        error=rows["rms_error_total"][:, 0],
        level=rows["max_level"],
        travel=np.sqrt(np.mean(changes**2, axis=1)),
        held=~(found.failed | np.any(past, axis=0)) if past else ~found.failed,
        failed=found.failed,
        infeasible=_unreachable(setting.case, found.values),
        limits=limits,
        measures=by,
        nominal=found.nominal,
        unit=unit_of(setting),
        runs="plants" if setting.plants_vary else setting.runs,
    )


def _unreachable(case, values):
    """Return (N,) True where no controller can hold a setpoint; None where that is not known."""
    return ~can_follow(case, values, case.limits) if can_judge(case) else None


def matters(setting: Setting, judged: Judged, near: float) -> np.ndarray:
    """Return (tanks,) True where some plant comes within `near` of the limit on its level."""
    limit = limited_levels(setting.case)
    with np.errstate(invalid="ignore"):
        highest = np.where(judged.failed[:, None], np.inf, judged.level).max(axis=0)
        return np.isfinite(limit) & (highest >= near * limit)


def unit_of(setting: Setting) -> str:
    """Return the unit of length of the rig."""
    return ms.unit("max_level", setting.case.loop.units)
