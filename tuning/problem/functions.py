"""Objectives and constraints that are custom functions: each becomes a named measure."""

# functions of jax and of `measures` whose types are not complete
# pyright: reportUnknownMemberType=false

import dataclasses
import math
from collections.abc import Callable, Iterable, Mapping
from typing import Any, cast

import numpy as np

from jaxtank import measures as ms
from jaxtank.core.errors import InputError
from jaxtank.core.text import shortened
from jaxtank.loop.closed_loop import ClosedLoop
from jaxtank.loop.functions import program_of
from tuning.storage.fingerprint import digest

UNNAMED = "own_objective"  # name of an objective that is a function without one


@dataclasses.dataclass(frozen=True)
class Objective:
    """A custom objective: a function of the measures of a run, and of its trajectory.

    Parameters
    ----------
    name : name in reports, JSON and checkpoints.
    function : f(measures) or f(measures, trajectory) -> number, as in
        `jaxtank.measures.from_function`.
    unit : of its value.
    save_every : distance of the rows of the trajectory [samples].

    Examples
    --------
    >>> def squares(measures, trajectory):
    ...     return (trajectory.e**2).mean() + 0.1 * measures["input_travel"].sum()
    >>> Objective("squares", squares, unit="cm^2").unit
    'cm^2'
    """

    name: str
    function: Callable[..., Any]
    unit: str = dataclasses.field(default="-", kw_only=True)
    save_every: int = dataclasses.field(default=1, kw_only=True)

    @property
    def measure(self) -> ms.Measure:
        """The measure that it is."""
        return ms.from_function(self.function, self.unit, save_every=self.save_every)


@dataclasses.dataclass(frozen=True)
class Constraint:
    """A custom constraint: a function of a run whose value has an upper or a lower limit.

    Parameters
    ----------
    name : name in reports, JSON and checkpoints.
    function : f(measures) or f(measures, trajectory) -> number, as in
        `jaxtank.measures.from_function`.
    upper, lower : the limit [unit], one of them.
    unit : of its value.
    save_every : distance of the rows of the trajectory [samples].

    Raises
    ------
    InputError : for a limit that is no finite number, for none and for two.

    Examples
    --------
    >>> def last_error(measures, trajectory):
    ...     return abs(trajectory.e[-1, 0])
    >>> Constraint("last_error", last_error, upper=0.1, unit="cm").limit
    0.1
    """

    name: str
    function: Callable[..., Any]
    upper: float | None = dataclasses.field(default=None, kw_only=True)
    lower: float | None = dataclasses.field(default=None, kw_only=True)
    unit: str = dataclasses.field(default="-", kw_only=True)
    save_every: int = dataclasses.field(default=1, kw_only=True)

    def __post_init__(self) -> None:
        if (self.upper is None) == (self.lower is None):
            raise InputError(f"constraint {self.name}: must have either upper or lower")
        try:
            finite = np.asarray(self.limit).dtype.kind != "b" and math.isfinite(self.limit)
        except (TypeError, OverflowError):
            finite = False
        if not finite:
            raise InputError(
                f"constraint {self.name}: limit {shortened(self.limit)} must be a finite number"
                f" [{self.unit}]"
            )

    @property
    def limit(self) -> Any:
        """Its limit, upper or lower [unit]."""
        return self.lower if self.upper is None else self.upper

    @property
    def measure(self) -> ms.Measure:
        """The measure that it is."""
        return ms.from_function(
            self.function, self.unit, lower=self.upper is None, save_every=self.save_every
        )


def as_measures(objective: Any, limits: Any, taken: Iterable[str] = ()) -> tuple[Any, Any]:
    """Return ({measure: weight}, {measure: limit}) of an objective and limits, None where None."""
    functions: dict[str, ms.Measure] = {name: ms.MEASURES[name] for name in ms.functions(taken)}
    weights = None if objective is None else _weights(objective, functions)
    limited = None if limits is None else _limited(limits, functions)
    for name, measure in functions.items():
        ms.register(name, measure)
    return weights, limited


def _weights(objective: Any, functions: dict[str, ms.Measure]) -> dict[str, Any]:
    """Return {measure: weight} of an objective, its functions entered in `functions`."""
    table = isinstance(objective, Mapping)
    terms: Any = cast(Any, objective).items() if table else [(objective, 1.0)]
    weights: dict[str, Any] = {}
    for term, weight in terms:
        name = term
        if not (isinstance(term, str) and table):
            name = _enter(term if isinstance(term, Objective) else _of_function(term), functions)
        if name in weights:
            raise InputError(f"objective {name} is given twice")
        weights[name] = weight
    return weights


def _of_function(term: Any) -> Objective:
    if not callable(term):
        raise InputError(
            f"objective = {shortened(term)}: must be {{measure: weight}}, a tuning.Objective or a"
            " function of (measures) or (measures, trajectory)"
        )
    return Objective(ms.name_of(term, UNNAMED), term)


def _limited(limits: Any, functions: dict[str, ms.Measure]) -> dict[str, Any]:
    """Return {measure: limit} of limits, their functions entered in `functions`."""
    limited: dict[str, Any] = {}
    for entry in cast(Any, limits if isinstance(limits, list | tuple) else [limits]):
        table = {entry.name: entry.limit} if isinstance(entry, Constraint) else entry
        if not isinstance(table, Mapping):
            raise InputError(
                f"limits: {shortened(entry)} must be {{measure: value}}, a tuning.Constraint, or"
                " a list of both"
            )
        if isinstance(entry, Constraint):
            _enter(entry, functions)
        for name, value in cast(Any, table).items():
            if name in limited:
                raise InputError(f"limit {name} is given twice")
            limited[name] = value
    return limited


def _enter(custom: Objective | Constraint, functions: dict[str, ms.Measure]) -> str:
    """Return the name of a custom function after its measure was entered in `functions`."""
    name, measure = custom.name, custom.measure
    if functions.get(name, measure) != measure:
        if name == UNNAMED:
            raise InputError(
                "objective: two functions without a name, as lambdas; give each one:"
                ' tuning.Objective("name", function)'
            )
        raise InputError(
            f"{name} is the name of two functions (or of one with two units, limits or save_every):"
            " give each a different name"
        )
    functions[name] = measure
    return name


def digests(loop: ClosedLoop, clock: Any, names: Iterable[str]) -> dict[str, Any]:
    """Return {"functions": {name: digest of its program}} for a fingerprint, {} without any."""
    programs = {n: digest(program_of(loop, clock, n)) for n in ms.functions(names)}
    return {"functions": programs} if programs else {}
