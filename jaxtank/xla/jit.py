"""`jax.jit` with the type of the function that it compiles kept."""

from collections.abc import Callable
from typing import Any, TypeVar, cast

import jax

from jaxtank.xla.executables import Kept

F = TypeVar("F", bound=Callable[..., Any])


def compiled(*static: str, keep: bool = False) -> Callable[[F], F]:
    """Return `jax.jit` as a decorator."""

    def decorate(function: F) -> F:
        jit: Any = jax.jit
        made = jit(function, static_argnames=static)
        return cast(F, Kept(function, made, static) if keep else made)

    return decorate
