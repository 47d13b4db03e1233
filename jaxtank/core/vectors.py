"""Vectors of the time loop: tuples of scalars in small rigs, arrays in large ones.

A tuple of scalars compiles to straight-line code, which is fastest for a few tanks; its program
grows with the number of tanks, and so does the time to compile it. An array keeps the program the
same for any number. Formulas that are written with `each`, `take` and `total` serve both forms.
"""
# pyright: reportUnknownMemberType=false, reportUnknownArgumentType=false

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

FROM = 10  # number of tanks from which on the vectors of a loop are arrays


def serves_arrays(part: Any) -> bool:
    """Whether a component's own class, not a base of it, takes vectors as arrays."""
    return "arrays" in vars(type(part)) and bool(part.arrays)


def keeping_nan(before: Any, after: Any) -> jax.Array:
    """Return `after`, and NaN where `before` is: a comparison with NaN would make it a number."""
    return jnp.where(before == before, after, before)


def is_array(vector: Any) -> bool:
    """Return whether a vector is an array of jax, and not a tuple of scalars."""
    return isinstance(vector, jax.Array)


def each(function: Callable[..., Any], vector: Any, *others: Any) -> Any:
    """Return `function` of the entries of vectors, or of the whole arrays."""
    if is_array(vector):
        return function(vector, *others)
    return tuple(function(v, *(o[i] for o in others)) for i, v in enumerate(vector))


def unzipped(vector: Any, results: Any) -> tuple[Any, ...]:
    """Return the vectors of the results of `each` for a function with several results."""
    return results if is_array(vector) else tuple(zip(*results))


def take(vector: Any, indices: Any) -> Any:
    """Return the entries of a vector at fixed places: numbers, or an array of whole numbers."""
    if not is_array(vector):
        return tuple(vector[i] for i in indices)
    places = np.asarray(indices, dtype=np.int32)
    first, count = (int(places[0]), len(places)) if len(places) else (0, 0)
    if np.array_equal(places, np.arange(first, first + count)):
        return vector if count == vector.shape[0] else vector[first : first + count]
    along = jax.lax.GatherDimensionNumbers((), (0,), (0,))
    inside = jax.lax.GatherScatterMode.PROMISE_IN_BOUNDS
    return jax.lax.gather(vector, places[:, None], along, (1,), mode=inside)


def total(vector: Any) -> Any:
    """Return the sum of the entries."""
    return jnp.sum(vector) if is_array(vector) else sum(vector)


def zeros(vector: Any) -> Any:
    """Return zeros in the form of a vector."""
    return jnp.zeros_like(vector) if is_array(vector) else (0.0,) * len(vector)


def scalars(vector: Any) -> Any:
    """Return the tuple of the entries of an array; anything else unchanged."""
    return tuple(vector[i] for i in range(vector.shape[0])) if is_array(vector) else vector


def like(vector: Any, other: Any) -> Any:
    """Return a vector in the form of another one; an empty one, of an unused part, unchanged."""
    if is_array(other) and len(vector):
        return vector if is_array(vector) else jnp.stack([jnp.asarray(v) for v in vector])
    return scalars(vector)


def form_for(part: Any, vector: Any) -> Any:
    """Return a vector in the form that a component takes: scalars, unless it `serves_arrays`."""
    return vector if serves_arrays(part) else scalars(vector)


def columns(signals: Any) -> jax.Array:
    """Return an array (samples, n) of n arrays (samples,)."""
    return signals if is_array(signals) else jnp.stack(list(signals), axis=1)
