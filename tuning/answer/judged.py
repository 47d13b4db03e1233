"""How a set of gains does on plants that no search has used, at the case's own step.

Imported by `recommend` and by the report.
"""

import dataclasses
from typing import Any, cast

import numpy as np

from jaxtank import measures as ms
from tuning.answer.setting import Setting, limited_levels, measured
from tuning.uncertainty.result import Ensemble
from tuning.uncertainty.sampling import clopper_pearson
from tuning.uncertainty.study import ensemble
from tuning.uncertainty.validation import SEED_OFFSET

FRESH = 256
"""Plants on which an answer is judged."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Judged:
    """One set of gains on N plants with noise, none of them used by the search.

    Parameters
    ----------
    cost, error : (N,) objective; total rms error [unit of length].
    level : (N, tanks) highest levels.
    travel : (N,) rms change of the inputs from sample to sample, as a share of their range [-].
    held : (N,) True where every limit holds; failed : (N,) True where the run diverged.
    infeasible : (N,) True where no controller can hold a setpoint; None where that is not known.
    limits : the Limits; measures : {name: (N, ...)}.
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

    @property
    def samples(self) -> int:
        """Number of plants N."""
        return len(self.cost)

    def share_held(self) -> dict[str, Any]:
        """Return {"share", "interval95", "samples"} of the plants on which every limit holds."""
        held, n = int(self.held.sum()), self.samples
        return {"share": held / n, "interval95": clopper_pearson(held, n), "samples": n}

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


def judge(setting: Setting, samples: int, seed: int, round_: int = 0) -> Judged:
    """Return how the searched case of a setting does on `samples` plants.

    The same plants and noise for the same seed and round; other ones than any search draws.
    """
    case, limits = setting.searched, dict(setting.case.limits)
    found = cast(
        Ensemble,
        ensemble(
            case.replace(limits=limits),
            setting.distributions,
            samples=samples,
            key=(SEED_OFFSET + seed + 104_729 * round_) % 2**31,
            measures=measured(setting),
            limits=limits,
            fan=False,
        ),
    )
    by = {m: np.asarray(v) for m, v in found.measures.items()}
    rows = {m: v.reshape(samples, -1) for m, v in by.items()}
    cost = sum(w * rows[m].sum(axis=1) for m, w in setting.objective.items())
    past = [limit.margins(rows[limit.measure][:, limit.index]) < 0 for limit in found.limits]
    changes = np.sqrt(rows["mean_square_travel"]) / setting.span
    return Judged(
        cost=np.asarray(cost),
        error=rows["rms_error_total"][:, 0],
        level=rows["max_level"],
        travel=np.sqrt(np.mean(changes**2, axis=1)),
        held=~(found.failed | np.any(past, axis=0)) if past else ~found.failed,
        failed=found.failed,
        infeasible=found.infeasible,
        limits=found.limits,
        measures=by,
    )


def matters(setting: Setting, judged: Judged, near: float) -> np.ndarray:
    """Return (tanks,) True where some plant comes within `near` of the limit on its level."""
    limit = limited_levels(setting.case)
    with np.errstate(invalid="ignore"):
        highest = np.where(judged.failed[:, None], np.inf, judged.level).max(axis=0)
        return np.isfinite(limit) & (highest >= near * limit)


def unit_of(setting: Setting) -> str:
    """Return the unit of length of the rig."""
    return ms.unit("max_level", setting.case.loop.units)
