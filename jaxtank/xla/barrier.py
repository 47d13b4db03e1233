"""A barrier to fusion: values that the compiler computes once, instead of again in every reader.

Necessary with the CPU compiler of jaxlib 0.10 and 0.11.

XLA fuses the work that leads to a value into every reader of that value. A step of a closed loop is
a chain of values that are read by several others each (a pump's voltage by every Runge-Kutta stage,
a stage's rates by the next stage and by the sum), so left alone each
fusion repeats most of the chain: for a batch of 256 runs of the four-tank 1028 operations where
312 suffice. Fusion does not cross a call that must not be inlined; such a call computes nothing and
costs nothing, for its result shares the memory of its operand.

An array must be read through the call alone: in a loop that is compiled to one function another
reader may write its own result over it, before the call's result is read (a wrong number, seen with
jaxlib 0.10 and 0.11). Scalars are safe. So must derivatives: the operand is best a product with a
coefficient, whose derivative does not read the product.
"""

from collections.abc import Callable
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
from jax.experimental.xla_metadata import set_xla_metadata

T = TypeVar("T")


def materialised(tree: T) -> T:
    """Return a pytree of the same values, each computed once."""
    if jax.default_backend() != "cpu":
        return tree
    with set_xla_metadata(inlineable="false"):
        return _as_it_is(tree)


def with_one_slope(function: Callable[[Any], Any]) -> Callable[[Any], Any]:
    """Return an elementwise function whose slope is computed once for all directions."""
    sloped: Any = jax.custom_jvp(function)

    @sloped.defjvp
    def rule(primals: Any, tangents: Any) -> Any:
        value, slope = jax.jvp(function, primals, (jnp.ones_like(primals[0]),))
        return value, materialised(slope) * tangents[0]

    return sloped


@jax.jit
def _as_it_is(tree):
    return tree
