"""The result of `tune`, as typed data: words about it are made in `messages`."""

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from jaxtank import measures as ms
from jaxtank.case import Case
from jaxtank.core.errors import unknown
from jaxtank.limits import Limit
from jaxtank.loop.closed_loop import ClosedLoop
from tuning.problem.problem import Problem
from tuning.problem.slopes import SlopeCheck
from tuning.problem.status import Status
from tuning.views import Result

ACTIVE = 1e-3  # margin, as a share of its limit, below which a limit counts as active [-]


@dataclasses.dataclass(frozen=True)
class Message:
    """One finding about a result: a stable `code` for programs, a `text` for people.

    Parameters
    ----------
    code : kebab-case word that does not change between versions; tuning/README.md lists them all,
        for example "parameter-at-bound", "not-converged", "limit-active".
    text : the sentence that is printed.
    headline : a few words instead of the status, if the finding changes its meaning.

    Examples
    --------
    >>> print(Message("limit-active", "active limit: max_level of tank 3 (30 of 30 cm)"))
    active limit: max_level of tank 3 (30 of 30 cm)
    """

    code: str
    text: str
    headline: str = ""

    def __str__(self) -> str:
        return self.text


@dataclasses.dataclass(frozen=True, kw_only=True)
class ParameterChange:
    """A tuned parameter: its values and range, in `unit`.

    Parameters
    ----------
    before, after : value before and after tuning [unit].
    unit : unit of the values.
    lower, upper : range that was searched [unit].
    at_bound : "lower" or "upper" where the value ended at that end of its range, else None.
    sensitivity_percent : change of the objective for a change of the value by 10 % [%]; None where
        it was not computed.
    exercised : False if no run depends on the value, which then is that before.

    Examples
    --------
    >>> ParameterChange(before=2.0, after=10.0, unit="V/V", lower=0.1, upper=10.0,
    ...     at_bound="upper", sensitivity_percent=0.2, exercised=True).at_bound
    'upper'
    """

    before: float
    after: float
    unit: str
    lower: float
    upper: float
    at_bound: str | None
    sensitivity_percent: float | None
    exercised: bool


@dataclasses.dataclass(frozen=True, kw_only=True)
class ConstraintRow:
    """One limit in one scenario, and what tuning made of it. `row["margin"]` is `row.margin`.

    Parameters
    ----------
    name : the limit, with its tank, pump or output and its scenario; words : the same for people.
    measure, unit : name of the measure that is limited, and its unit.
    limit : the limit [unit].
    value, before : the measure after and before tuning [unit]; before is None where not asked.
    margin : how far the value is inside its limit [unit]; negative where the limit is violated.
    tank, pump : number of the tank or pump, from 1; None where it is of another kind.
    time_s : when the value was reached [s]; None for a measure of the whole run.
    scenario : its name; None for the case's own run.
    reason : why `value` is not a finite number; None where it is.
    active : True if the limit holds and determines the answer: the margin is below 1e-3 of the
        limit, or its multiplier is positive.
    multiplier : Lagrange multiplier of the scaled problem, >= 0 [-].

    Examples
    --------
    >>> row = ConstraintRow(name="max_level of tank 3", measure="max_level", unit="cm", limit=30.0,
    ...     value=29.5, margin=0.5, tank=3)
    >>> row.margin == row["margin"] == 0.5, row.active
    (True, False)
    """

    name: str
    measure: str
    unit: str
    limit: float
    value: float
    before: float | None = None
    margin: float
    tank: int | None = None
    pump: int | None = None
    time_s: float | None = None
    scenario: str | None = None
    reason: str | None = None
    active: bool = False
    multiplier: float = 0.0
    words: str = ""

    def __getitem__(self, name: str) -> Any:
        if name not in self.__dataclass_fields__:
            raise KeyError(name)
        return getattr(self, name)

    def amount(self) -> str:
        """Return the value with its unit, or why it has none."""
        known = self.reason is None
        return f"{self.value:.6g} {self.unit}" if known else f"undefined ({self.reason})"

    def to_json(self) -> dict[str, Any]:
        """Return the row as a dict, in the order of its fields."""
        return dataclasses.asdict(self)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Lost:
    """An output that follows its setpoint before tuning, and no longer afterwards."""

    output: int
    before: float
    after: float
    share: float
    unit: str


@dataclasses.dataclass(frozen=True, kw_only=True, repr=False)
class TuningResult(Result):
    """The result of `tune`: print it for tables, `.plot()` for pictures, `.save(dir)` for files.

    Parameters
    ----------
    case, tuned : the Case before and after tuning.
    method : the local search: "slsqp", "trf", "coarse-trf", "trf-slsqp", "lbfgs" or "adam".
    status : how the search ended (`tuning.Status`).
    messages : findings, most important first; `message` joins their texts.
    parameters : {name: the fields of ParameterChange}; `result[name]` is the ParameterChange.
    objective : {"before", "after": value, "terms": {measure: weight}}.
    measures : {"before", "after": {measure: value}} of the case's own run; those of a default
        answer that its text does not need are computed when one of them is asked for.
    tables : {"before", "after": [{measure: value}]} of every scenario in the objective.
    constraints : a ConstraintRow for each limit and scenario.
    evaluations : numbers of simulations, gradients, non-finite points and repeated screenings.
    wall_s : duration of the search [s].
    history : (start, cost, violation [share of the limit's scale], z) of every evaluation.
    starts : one dict for each local search: from, to, cost, violation, evaluations, converged,
        exhausted, slope_usable (None where it moved on).
    optimality : {"gradient_norm", "kkt_residual", "multipliers"} of the scaled cost.
    curvature : second derivative at the answer, see `diagnostics.curvature`; None if not computed.
    symmetry : the equivalent answer by a permutation of the gains, see `diagnostics.symmetric`.
    validation, cloud : the validation set, see `validation.summary_of`; None if not asked.
    provenance : versions, machine settings and seed.
    problem : the Problem that was solved.
    choices : one dict for each combination of discrete choices.
    bound : perfect-information open-loop optimum (`tuning.bound`), where asked.
    tradeoff : objective over one limit (`tuning.tradeoff`), where asked.
    lost : outputs that no longer follow their setpoints, as `Lost`.
    probe : {"runs", "searches", "lower"}: runs of differential evolution around the answer and
        over the ranges, searches from what it found, and how many of those ended lower; None where
        two searches agree and none was needed.
    certificate : violation probability on new plants (`tune_robust`), where asked.
    slopes : {"start", "answer": SlopeCheck} whether runs beside these points bear the exact slopes
        out; an answer whose slope they contradict is not converged.
    rules : of a PI or PID controller, what tuning rules give on the plants of the answer: one dict
        for each rule, {"rule", "parameters": {name: value}, "error" [unit of length], "holds",
        "setpoints_lost": on how many plants}.
    answer : the `tuning.Answer` of a default answer: its plants, noise and safety filter.

    Examples
    --------
    >>> import tuning
    >>> from jaxtank import presets
    >>> result = tuning.tune(presets.find("cascaded/pi"), starts=2)  # doctest: +SKIP
    >>> result["controller.Kc[0]"].after, result.status  # doctest: +SKIP
    """

    case: Case
    tuned: Case
    method: str
    status: Status
    messages: tuple[Message, ...] = ()
    parameters: dict[str, dict[str, Any]]
    objective: dict[str, Any]
    measures: dict[str, Mapping[str, Any]]
    tables: dict[str, list[Any]]
    constraints: list[ConstraintRow]
    evaluations: dict[str, int]
    wall_s: float
    history: list[tuple]
    starts: list[dict[str, Any]]
    optimality: dict[str, Any]
    curvature: dict[str, Any] | None
    symmetry: dict[str, Any] | None
    validation: dict[str, Any] | None
    provenance: dict[str, Any]
    problem: Problem
    choices: list[dict[str, Any]] = dataclasses.field(default_factory=list)
    bound: Any = None
    tradeoff: Any = None
    certificate: Any = None
    answer: Any = None
    rules: tuple[dict[str, Any], ...] = ()
    lost: tuple[Lost, ...] = ()
    probe: dict[str, int] | None = None
    slopes: Mapping[str, SlopeCheck] = dataclasses.field(default_factory=dict)
    cloud: dict[str, Any] | None = None

    @property
    def message(self) -> str:
        """The texts of `messages`, joined by semicolons."""
        return "; ".join(m.text for m in self.messages)

    @property
    def headline(self) -> str:
        """The status, with the findings that change its meaning."""
        return ", ".join([self.status, *(m.headline for m in self.messages if m.headline)])

    @property
    def success(self) -> bool:
        """True if the search converged and every limit holds at the case's own step."""
        return self.status == Status.CONVERGED

    def __getitem__(self, name: str) -> ParameterChange:
        """Return the ParameterChange of a free parameter. Raises InputError for another name."""
        if name not in self.parameters:
            raise unknown("tuned parameter", str(name), self.parameters)
        return ParameterChange(**self.parameters[name])

    def __iter__(self) -> Iterator[str]:
        return iter(self.parameters)

    def replace(self, **changes: Any) -> "TuningResult":
        """Return a copy with the named fields changed."""
        return dataclasses.replace(self, **changes)


def constraint_rows(
    problem: Problem,
    after: Sequence[Mapping[str, Any]],
    before: Sequence[Mapping[str, Any]] | None = None,
    multipliers: Mapping[str, float] | None = None,
) -> list[ConstraintRow]:
    """Return a ConstraintRow for each limit of the problem."""
    rows, multipliers = [], multipliers or {}
    for limit in problem.limits:
        entry = lambda table, name, x=limit: float(np.ravel(table[x.run][name])[x.index])
        reached, loop = ms.MEASURES[limit.measure].reached, problem.runs[limit.run].case.loop
        more: dict[str, Any] = {"scenario": limit.scenario or None}
        more["before"] = None if before is None else entry(before, limit.measure)
        more["time_s"] = entry(after, reached) if reached else None
        more["multiplier"] = multipliers.get(limit.label, 0.0)
        rows.append(row_of(limit, loop, entry(after, limit.measure), **more))
    return rows


def row_of(
    limit: Limit, loop: ClosedLoop, value: float, *, multiplier: float = 0.0, **more: Any
) -> ConstraintRow:
    """Return the ConstraintRow of a limit whose measure has this value; more : other fields."""
    measure, margin = ms.MEASURES[limit.measure], float(limit.margins(value))
    plant: Any = loop.plant
    tanks = {"tank": limit.index, "output": plant.outputs[limit.index % len(plant.outputs)]}
    return ConstraintRow(
        name=limit.label,
        words=limit.words,
        measure=limit.measure,
        unit=ms.unit(limit.measure, loop.units),
        limit=limit.value,
        value=value,
        margin=margin,
        tank=int(tanks[measure.per]) + 1 if measure.per in tanks else None,
        pump=limit.index + 1 if measure.per == "pump" else None,
        reason=None if np.isfinite(value) else measure.cause(value),
        active=margin >= 0 and (margin < ACTIVE * abs(limit.value) or multiplier > 0),
        multiplier=multiplier,
        **more,
    )
