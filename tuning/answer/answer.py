"""What the default answer of `tune` gives besides the gains, as data."""

import dataclasses
import importlib
from collections.abc import Mapping
from typing import Any

from jaxtank.core.jsonable import clean
from tuning.answer.judged import Judged, drawn
from tuning.answer.setting import Setting
from tuning.problem.result import Shown


@dataclasses.dataclass(frozen=True, kw_only=True, repr=False)
class Answer(Shown):
    """How the default answer was found and judged: `TuningResult.answer`.

    Parameters
    ----------
    setting : what was searched: noise, plants, cost, safety filter.
    before, after : the case as given and the tuned case on the same validation plants.
    nominal : {"before", "after": total rms error of the case's own run, without noise}.
    kept : {parameter: True where it stays at its start}.
    agreed : True if two searches ended within 1 % of each other, or differential evolution found
        nothing better.
    lost : outputs that no longer follow their setpoints, as `tuning.search.result.Lost`.
    idle : numbers of the tanks, from 1, whose limit no plant comes near.
    tightened : largest share by which a limit was tightened for the search [-].
    coarse_dt : step of the search [s]; integrator : its integrator.
    measures : {"before", "after": {measure: value} of the case's own run}.
    feasibility : a `tuning.Feasibility`, None where it is not known; mended : the Mend that was
        applied first, None where none was asked for.

    Examples
    --------
    >>> import tuning
    >>> from jaxtank import presets
    >>> result = tuning.tune(presets.find("gouta2015/backstepping"))  # doctest: +SKIP
    >>> result.answer.after.share_held()["share"]  # doctest: +SKIP
    1.0
    """

    setting: Setting
    before: Judged
    after: Judged | None
    nominal: Mapping[str, float]
    kept: Mapping[str, bool]
    agreed: bool
    lost: tuple
    idle: tuple[int, ...]
    tightened: float
    coarse_dt: float
    integrator: str = "rk4"
    measures: Mapping[str, Mapping[str, Any]] = dataclasses.field(default_factory=dict)
    feasibility: Any = None
    mended: Any = None

    @property
    def held(self) -> bool:
        """True if every limit holds on every plant that judged the answer."""
        return self.after is not None and bool(self.after.held.all())

    def _report(self) -> Any:
        return importlib.import_module("tuning.report.tuned")

    def _sections(self) -> list[Any]:
        return self._report().of_answer(self)

    def __str__(self) -> str:
        return self._report().answer_text(self)

    def plot(self) -> dict[str, Any]:
        """Return matplotlib figures {"plants": errors and highest levels before and after}."""
        sides = {"before": self.before, "after": self.after}
        return drawn({name: one for name, one in sides.items() if one is not None})

    def holds(self) -> dict[str, Any]:
        """Return the object `holds` of the JSON: share of plants, interval, certificates."""
        known = self.after is not None and bool(self.after.limits)
        found = self.after.share_held() if self.after is not None and known else None
        return {
            "limits_on_validation": found["share"] if found else None,
            "interval95": found["interval95"] if found else None,
            "samples": found["samples"] if found else 0,
            "certified": [
                {"tank": row.tank + 1, "certified": bool(row.certified), "why": row.reason}
                | {"starts": row.starts or None}
                for row in self.setting.certificates
            ],
        }

    def to_json(self) -> dict[str, Any]:
        """Return what the JSON of a result says of its plants, its noise and its safety filter."""
        sides = {"before": self.before, "after": self.after}
        return clean(
            {
                "noise": self.setting.noise,
                "noise_assumed": self.setting.assumed,
                "plants_stated": self.setting.stated,
                "objective": dict(self.setting.objective),
                "safety_filter": self.setting.filter,
                "nominal_error": {  # of the run whose measures the JSON has, to the last digit
                    side: float(dict(m)["rms_error_total"]) for side, m in self.measures.items()
                },
                "plants": {name: j.to_json() for name, j in sides.items() if j is not None},
                "kept": [name for name, stays in self.kept.items() if stays],
                "idle_limits_of_tanks": list(self.idle),
                "limits_tightened": self.tightened,
                "search_dt_s": self.coarse_dt,
                "search_integrator": self.integrator,
                "mended": None if self.mended is None else dict(self.mended.set),
            }
        )
