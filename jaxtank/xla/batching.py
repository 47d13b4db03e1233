"""Functions of which `jax.vmap` runs a limited number of elements at a time. Imports jax only."""
# jax leaves the types of custom_vmap and custom_jvp partly open.
# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false
# pyright: reportUnknownArgumentType=false, reportUntypedFunctionDecorator=false
# pyright: reportUnknownParameterType=false, reportUnknownLambdaType=false

from collections.abc import Callable
from typing import Any

import jax
from jax.custom_derivatives import SymbolicZero


def in_batches(function: Callable[..., Any], batch: int) -> Callable[..., Any]:
    """Return `function` of arrays; on a CPU `jax.vmap` of it runs at most `batch` elements at once.

    What is computed side by side then fits the cache. On a GPU, and wherever derivatives are taken,
    all elements run at once. Both modes of differentiation work; arguments with a tangent of zero
    are not differentiated.

    Examples
    --------
    >>> import jax.numpy as jnp
    >>> square = in_batches(lambda x: x * x, 4)
    >>> jax.vmap(square)(jnp.arange(6.0)).tolist()
    [0.0, 1.0, 4.0, 9.0, 16.0, 25.0]
    >>> jax.vmap(jax.grad(square))(jnp.arange(3.0)).tolist()
    [0.0, 2.0, 4.0]
    """
    alone = jax.custom_batching.custom_vmap(function)

    @alone.def_vmap
    def several(size: int, mapped: Any, *arguments: Any) -> Any:
        axes = tuple(0 if here else None for here in mapped)
        if size <= batch or jax.default_backend() != "cpu":
            found = jax.vmap(function, in_axes=axes)(*arguments)
        else:
            own = [v for v, here in zip(arguments, mapped) if here]

            def one(row: Any) -> Any:
                moving = iter(row)
                return function(*(next(moving) if h else v for v, h in zip(arguments, mapped)))

            found = jax.lax.map(one, own, batch_size=batch)
        return found, jax.tree.map(lambda _: True, found)

    whole = jax.custom_jvp(alone)

    def derivative(primals: Any, tangents: Any) -> Any:
        moving = [i for i, v in enumerate(tangents) if not isinstance(v, SymbolicZero)]

        def of(*own: Any) -> Any:
            here = dict(zip(moving, own))
            return function(*(here.get(i, v) for i, v in enumerate(primals)))

        return jax.jvp(of, [primals[i] for i in moving], [tangents[i] for i in moving])

    whole.defjvp(derivative, symbolic_zeros=True)
    return whole
