"""Functions of a loop and a clock that take a case instead of both."""

import functools
from collections.abc import Callable, Mapping
from typing import Any, Concatenate, ParamSpec, Protocol, TypeVar, overload

from jaxtank.core.clock import Clock, check_is_clock
from jaxtank.core.errors import InputError
from jaxtank.loop.closed_loop import ClosedLoop

P = ParamSpec("P")
R = TypeVar("R")
R_co = TypeVar("R_co", covariant=True)


class CaseLike(Protocol):
    """A case: a loop and its clock."""

    @property
    def loop(self) -> ClosedLoop: ...
    @property
    def clock(self) -> Clock: ...


class OfCase(Protocol[P, R_co]):
    """A function of (loop, clock, ...) or of (case, ...)."""

    @overload
    def __call__(self, case: CaseLike, /, *args: P.args, **options: P.kwargs) -> R_co: ...
    @overload
    def __call__(
        self, loop: ClosedLoop | CaseLike, clock: Clock, /, *args: P.args, **options: P.kwargs
    ) -> R_co: ...


def takes_case(function: Callable[Concatenate[ClosedLoop, Clock, P], R]) -> OfCase[P, R]:
    """Let a function of (loop, clock, ...) take (case, ...), or (case, clock, ...), too."""

    @functools.wraps(function)
    def run(*args: Any, **options: Any) -> R:
        if args and hasattr(args[0], "loop") and hasattr(args[0], "clock"):
            clocks = () if args[1:] and isinstance(args[1], Clock) else (args[0].clock,)
            args = (args[0].loop, *clocks, *args[1:])
        for check, part in zip((check_is_loop, check_is_clock), args):
            check(part)
        return function(*args, **options)

    return run


def check_is_values(values: Any) -> None:
    """Raise InputError for what is no {parameter: value}."""
    if not isinstance(values, Mapping):
        raise InputError(
            f"values is a {type(values).__name__}: must be {{parameter: value}} (the arguments are"
            " loop, clock, measures, values, in this order)"
        )


def check_is_loop(loop: Any) -> None:
    """Raise InputError for what is no ClosedLoop."""
    if not hasattr(loop, "plant"):
        raise InputError(
            f"loop is a {type(loop).__name__}: must be a ClosedLoop, such as case.loop (the"
            " arguments are loop, clock, in this order), or a Case, without a clock"
        )
