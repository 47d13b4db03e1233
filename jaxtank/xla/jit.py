"""`jax.jit` with the type of the function that it compiles kept. Imports `xla` only."""

from collections.abc import Callable
from typing import Any, TypeVar, cast

import jax

from jaxtank.xla.executables import Kept

F = TypeVar("F", bound=Callable[..., Any])


def compiled(*static: str, keep: bool = False) -> Callable[[F], F]:
    """Return `jax.jit` as a decorator.

    Parameters
    ----------
    static : names of the arguments that are part of the program.
    keep : whether programs are kept between processes, where the user keeps any (`jaxtank.cache`):
        for those that take long to trace.

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
        made = jit(function, static_argnames=static)
        return cast(F, Kept(function, made, static) if keep else made)

    return decorate
