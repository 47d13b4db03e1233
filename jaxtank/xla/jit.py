"""`jax.jit` with the type of the function that it compiles kept. May import nothing of ours."""

from collections.abc import Callable
from typing import Any, TypeVar, cast

import jax

F = TypeVar("F", bound=Callable[..., Any])


def compiled(*static: str) -> Callable[[F], F]:
    """Return `jax.jit` as a decorator; static: names of the arguments that are part of the program.

    Examples
    --------
    >>> @compiled("n")
    ... def power(x: float, n: int) -> float:
    ...     return x**n
    >>> float(power(2.0, n=3))
    8.0
    """

    def decorate(function: F) -> F:
        jit: Any = jax.jit
        return cast(F, jit(function, static_argnames=static))

    return decorate
