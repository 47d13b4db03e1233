"""Every controller that fits a rig, at its first gains and tuned, judged on the same plants."""

import contextlib
import dataclasses
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from jaxtank import presets, rig
from jaxtank.bounds import free_of
from jaxtank.case import Case, check_case
from jaxtank.controllers import OpenLoop
from jaxtank.core.errors import InputError, unknown
from jaxtank.core.tree import get_value
from jaxtank.export.timing import step_time
from jaxtank.loop.margins import stability_margins
from jaxtank.rig.components import kind_of
from tuning.problem.controllers import START, equal, same_rig, with_kind
from tuning.search.judged import FRESH, Judged, judge
from tuning.search.options import check_numbers, check_precision
from tuning.search.setting import setting_of
from tuning.search.tuner import tune
from tuning.views import Result

TRAVEL = "input_travel"
MISPRINTS = "-printed"  # end of the name of a case with a misprint, which is left out


class Rival(NamedTuple):
    """A controller with one set of gains on the plants of a comparison."""

    name: str
    kind: str
    gains: str  # "published", "first" or "own", or "tuned"
    case: Case
    judged: Judged
    peak: float | None  # largest sensitivity peak Ms of all plateaus; None where not known
    step_us: float | None  # time of a step of the controller alone in C; None if unknown
    why: str = ""  # why there is no peak

    @property
    def tuned(self) -> bool:
        return self.gains == "tuned"

    @property
    def filtered(self) -> bool:
        return self.case.loop.safety_filter is not None

    @property
    def followers(self) -> np.ndarray:
        """(N,) True for the plants on which some controller can hold every setpoint."""
        infeasible = self.judged.infeasible
        return np.ones(self.judged.samples, bool) if infeasible is None else ~infeasible

    @property
    def error(self) -> float | None:
        """Mean total rms error of the plants where every setpoint is reachable [unit of length]."""
        return self._mean(self.judged.error)

    @property
    def travel(self) -> float | None:
        """Mean over the same plants of the total variation of all inputs [unit of the inputs]."""
        values = self.judged.measures.get(TRAVEL)
        return None if values is None else self._mean(values.reshape(len(values), -1).sum(axis=1))

    def _mean(self, values: np.ndarray) -> float | None:
        good = self.followers & ~self.judged.failed
        return float(np.mean(values[good])) if good.any() else None

    @property
    def parameters(self) -> dict[str, Any]:
        """Return {dotted name: value} of the tunable parameters."""
        return {n: np.asarray(get_value(self.case.loop, n)).tolist() for n in free_of(self.case)}

    @property
    def violations(self) -> int:
        return int((~self.judged.held).sum())

    @property
    def holds(self) -> bool:
        return bool(self.judged.held.all())

    def words(self) -> str:
        """Return the controller, its gains and its filter."""
        gains = {"first": "first gains", "own": "gains as given"}.get(self.gains, self.gains)
        return f"{self.name}, {gains}{', with the safety filter' * self.filtered}"


@dataclasses.dataclass(frozen=True, kw_only=True, repr=False)
class ControllerComparison(Result):
    """Every controller that fits a rig on the same plants; made by `tuning.compare_controllers`.

    Parameters
    ----------
    case : the Case whose rig, reference and limits all of them share.
    rivals : the Rivals, those that hold every limit first, by their error.
    refused : {name: why it does not fit the rig}.
    samples, seed : of the plants.

    Examples
    --------
    >>> import tuning
    >>> from jaxtank import presets
    >>> case = presets.find("mirakhorli/hybrid")
    >>> result = tuning.compare_controllers(case)  # doctest: +SKIP
    >>> result.best.name, result.own.error  # doctest: +SKIP
    """

    case: Case
    rivals: tuple[Rival, ...]
    refused: dict[str, str]
    samples: int
    seed: int

    @property
    def best(self) -> Rival:
        """The Rival of the least error among those that hold most limits."""
        return self.rivals[0]

    @property
    def own(self) -> Rival | None:
        """The best Rival with the controller of the case itself; None where it is left out."""
        return next((r for r in self.rivals if r.name == self.case_name), None)

    @property
    def unit(self) -> str:
        """Unit of the errors."""
        return str(self.case.loop.units[0])

    @property
    def claims(self) -> dict[str, str] | None:
        """{controller that the paper of the case calls best: section}; None without a paper."""
        paper, _, _ = self.case.name.partition("/")
        return dict(presets.load(paper).best) if paper in presets.PAPERS else None

    @property
    def case_name(self) -> str:
        """Name of the case's own controller."""
        return _name(self.case)


def _name(case: Case) -> str:
    """The name of a controller: that of its case in a paper, else its kind."""
    paper, _, name = case.name.partition("/")
    return name if paper in presets.PAPERS else str(kind_of("controller", case.loop.controller))


def _candidates(case: Case, refused: dict[str, str]) -> Iterator[tuple[str, str, Case]]:
    """Yield (name, origin of its gains, Case) of every controller that fits the rig of a case."""
    others = _of_paper(case)
    yield _name(case), "published" if others is not None else "own", case
    kinds = {kind_of("controller", case.loop.controller)}
    for other in others or ():
        kinds.add(kind_of("controller", other.loop.controller))
        yield _name(other), "published", other
    if kinds & {"pid", "pi", "p"}:
        kinds |= {"pid", "pi"}
    for kind in START:
        if kind in kinds:
            continue
        try:
            yield kind, "first", with_kind(case, kind)
        except InputError as error:
            refused[kind] = str(error)


def _of_paper(case: Case) -> list[Case] | None:
    """Other controllers of the paper of a case under the same conditions; None without a paper."""
    paper, _, _ = case.name.partition("/")
    if paper not in presets.PAPERS:
        return None
    parts = ("reference", "x0", "disturbance", "faults")
    return [
        other
        for other in presets.load(paper).cases.values()
        if other.name != case.name
        and not other.name.endswith(MISPRINTS)
        and not isinstance(other.loop.controller, OpenLoop)
        and other.clock == case.clock
        and same_rig(other, case)
        and all(equal(getattr(other.loop, p), getattr(case.loop, p)) for p in parts)
    ]


def _peak(case: Case) -> tuple[float | None, str]:
    """(largest sensitivity peak of all plateaus, why there is none)."""
    try:
        plateaus = stability_margins(case.loop, case.clock)
    except InputError as error:
        return None, str(error)
    if any(not p.stable and not p.why for p in plateaus):
        return None, "the linearised loop is unstable at a plateau"
    peaks = [float(p.margins.sensitivity_peak) for p in plateaus if p.stable]
    return (max(peaks), "") if peaks else (None, "no plateau has margins")


def order(rival: Rival) -> tuple[bool, int, float]:
    """Sort key of a Rival: limits held, then how many plants break one, then the error."""
    error = rival.error
    return not rival.holds, rival.violations, np.inf if error is None else error


def compare_controllers(
    case: Case,
    *,
    kinds: Sequence[str] | None = None,
    samples: int = FRESH,
    seed: int = 0,
    progress: Callable[[str], None] | None = None,
) -> ControllerComparison:
    """Return how every controller that fits a rig does on the same uncertain plants.

    Each is judged at its published gains (or first gains by a rule, as `with_kind` computes them)
    and at those of the default answer of `tuning.tune`, each with and without the safety filter,
    on `samples` plants with sensor noise. The controllers of the paper are taken with the observer
    of their case.

    Parameters
    ----------
    case : the Case whose rig, reference, start and limits all of them share.
    kinds : names of controllers to compare, as the result prints them; every one where None.
    samples : number of plants.
    seed : of the plants, the noise and the searches.
    progress : called with the name of each controller before it is tuned.

    Returns
    -------
    ControllerComparison

    Raises
    ------
    InputError : for a case that cannot be run, and for a kind that is not known.

    Examples
    --------
    >>> import jax, tuning
    >>> from jaxtank import presets
    >>> jax.config.update("jax_enable_x64", True)
    >>> case = presets.find("cascaded/pi")
    >>> result = tuning.compare_controllers(case, kinds=["pi"])  # doctest: +SKIP
    >>> result.best.name  # doctest: +SKIP
    'pi'
    """
    check_case(case, seed)
    check_precision()
    check_numbers(samples=samples)
    refused: dict[str, str] = {}
    fitting = list(_candidates(case.without_safety_filter(), refused))
    names = [name for name, _, _ in fitting]
    for kind in kinds or ():
        if kind not in (*names, *refused):
            raise unknown("controller", kind, names)
    rivals: list[Rival] = []
    for name, gains, other in fitting:
        if kinds is not None and name not in kinds:
            continue
        if progress is not None:
            progress(name)
        try:
            rivals += list(_judged(name, gains, rig.check(other), samples, seed))
        except InputError as error:  # a law that this rig's plateaus do not admit
            refused[name] = str(error)
    if not rivals:
        reasons = "; ".join(f"{name}: {why}" for name, why in refused.items())
        raise InputError(f"{case.name}: no controller fits this rig: {reasons}")
    rivals.sort(key=order)
    return ControllerComparison(
        case=case, rivals=tuple(rivals), refused=refused, samples=samples, seed=seed
    )


def _judged(name: str, gains: str, case: Case, samples: int, seed: int) -> Iterator[Rival]:
    """Yield the Rivals of one controller: as it is and tuned, each without and with the filter."""
    kind = str(kind_of("controller", case.loop.controller))
    tuned, (step, _) = case, step_time(case.without_safety_filter())
    if free_of(case):
        tuned = tune(case, seed=seed).tuned.replace(objective=case.objective)
    for origin, judged in ((gains, case), ("tuned", tuned))[: 1 + bool(free_of(case))]:
        plain = judged.without_safety_filter()
        sides = [plain]
        with contextlib.suppress(InputError):  # no limit on a level, or a rig it does not serve
            sides.append(judged if judged.loop.safety_filter else plain.with_safety_filter())
        for side in sides:
            peak, why = _peak(side)
            runs = judge(setting_of(side), samples, seed, more=(TRAVEL,))
            yield Rival(name, kind, origin, side, runs, peak, step, why)
