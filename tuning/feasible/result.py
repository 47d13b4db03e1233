"""The result of a feasibility study: levels needed at each plateau, and the smallest mends."""

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np

from tuning.uncertainty.sampling import clopper_pearson
from tuning.views import Result


@dataclasses.dataclass(frozen=True, kw_only=True)
class PlateauNeed:
    """A level or an input that a plateau needs and that some plants cannot have."""

    time_s: float
    setpoints: tuple[float, ...]
    tank: int | None
    pump: int | None
    needed: float
    needed_p95: float
    limit: float
    share: float
    unit: str
    upper: bool  # whether `limit` is the largest value that is possible, not the least


@dataclasses.dataclass(frozen=True, kw_only=True)
class Mend:
    """The smallest change of one kind that makes the plateaus of 95 % of the plants feasible (of
    "ramps": that makes the nominal run keep its limits).

    Attributes
    ----------
    what : str
        One of `tuning.feasible.study.KINDS`.
    set : dict
        {dotted name: number or list} as for `--set`; {} where nothing needs to change.
    share : float or None
        Plants that it makes feasible, of the draws it was found with [-]; None for ramps.
    words : str
        The change for people.

    Examples
    --------
    >>> Mend(what="rims", set={"plant.rim[2]": 40.5}, share=0.96, words="rim of tank 3").options
    ['--set plant.rim[2]=40.5']
    """

    what: str
    set: Mapping[str, Any]
    share: float | None
    words: str

    @property
    def options(self) -> list[str]:
        """The options of the command that make this change."""
        return [f"--set {name}={str(value).replace(' ', '')}" for name, value in self.set.items()]


@dataclasses.dataclass(frozen=True, kw_only=True, repr=False)
class Feasibility(Result):
    """Which plants can hold the setpoints of a case under some controller; by `tuning.feasibility`.

    Attributes
    ----------
    case : Case
    distributions : dict
        {dotted name: distribution} of the uncertain parameters.
    infeasible : (samples,) array of bool
        True where the steady state of some plateau needs a level or an input outside its limits.
    plateaus : tuple of PlateauNeed
        What some of the plants cannot have, in order of time.
    mends : tuple of Mend
    seed : int
    wall_s : float
        Run time, of the share and the plateaus [s]; of the mends in `mends_s`.
    mends_s : float
    """

    case: Any
    distributions: Mapping[str, Any]
    infeasible: np.ndarray
    plateaus: tuple[PlateauNeed, ...]
    mends: tuple[Mend, ...]
    seed: int
    wall_s: float
    mends_s: float

    @property
    def samples(self) -> int:
        """Number of plants."""
        return len(self.infeasible)

    @property
    def infeasible_for_any_controller(self) -> float:
        """Share of the plants that no controller can hold at every plateau [-]."""
        return float(np.mean(self.infeasible))

    @property
    def interval95(self) -> list[float]:
        """Exact 95 % interval of that share."""
        return clopper_pearson(int(np.sum(self.infeasible)), self.samples)
