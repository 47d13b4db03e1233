"""Compensated sums for float32 runs (Kahan, Comm. ACM 8(1), 1965).

A level of 10 cm changes by 1e-4 cm in a step of 0.01 s, of which float32 keeps two digits; a mean
over 120,000 samples loses as much. In float64 a plain sum is good to 1e-12, and these functions are
plain sums.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxtank.core.numerics import Real


class Sum(NamedTuple):
    """A running sum in float32: its value, and what rounding has added to it too much."""

    total: Any
    excess: Any


def nothing(zero: Real) -> Any:
    """Return an empty sum of the type of `zero`: `zero` itself, or a Sum in float32."""
    return Sum(zero, zero) if jnp.result_type(zero) == jnp.float32 else zero


def plus(sum: Any, term: Real) -> Any:
    """Return `sum` with `term` added."""
    return Sum(*added(sum.total, sum.excess, term)) if isinstance(sum, Sum) else sum + term


def added(value: Any, excess: Any, term: Any) -> tuple[Any, Any]:
    """Return (value + term - excess, rounding error of that sum)."""
    owed = term - excess
    new = value + owed
    return new, (new - value) - owed


def totals(tree: Any) -> Any:
    """Return a pytree with the value of every Sum in its place."""

    def is_sum(node: Any) -> bool:
        return isinstance(node, Sum)

    def total(node: Any) -> Any:
        return node.total if is_sum(node) else node

    return jax.tree.map(total, tree, is_leaf=is_sum)
