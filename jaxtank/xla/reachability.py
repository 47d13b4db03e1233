"""Which results of a function depend on some of its arguments, read from its traced program."""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
from jax.extend.core import Literal

LOOPS = ("scan", "while")


class Use(NamedTuple):
    """Whether a result depends on arguments, entries of the largest matrix, any loop on the way."""

    reached: bool
    largest: int
    looped: bool


def use_of(function, watched, *others):
    """Return how function(watched, *others) uses its first argument."""
    jaxpr = jax.make_jaxpr(function)(watched, *others).jaxpr
    return _follow(jaxpr, set(jaxpr.invars[: len(jax.tree.leaves(watched))]))[0]


def reached(function: Callable[[Any], Any], watched: Any) -> list[bool]:
    """Return, for each leaf of function(watched), whether it depends on `watched`."""
    jaxpr = jax.make_jaxpr(function)(watched).jaxpr
    return _follow(jaxpr, set(jaxpr.invars))[1]


def _follow(jaxpr, reached):
    """(Use, [whether each result is reached]) from the variables in `reached`, added to."""
    largest, looped = 0, False
    for eqn in jaxpr.eqns:
        hit = [_in(v, reached) for v in eqn.invars]
        if not any(hit):
            continue
        # an operation that contains a program counts as a whole, unless it is a plain call
        results = [True] * len(eqn.outvars)
        inner = eqn.params.get("jaxpr") if eqn.primitive.name in ("jit", "pjit") else None
        if inner is not None:
            use, results = _follow(inner.jaxpr, {v for v, h in zip(inner.jaxpr.invars, hit) if h})
            largest, looped = max(largest, use.largest), looped or use.looped
        looped = looped or eqn.primitive.name in LOOPS
        for v, is_reached in zip(eqn.outvars, results):
            if is_reached:
                reached.add(v)
                largest = max(largest, math.prod(v.aval.shape) if len(v.aval.shape) > 1 else 0)
    results = [_in(v, reached) for v in jaxpr.outvars]
    return Use(any(results), largest, looped), results


def _in(v, reached):
    return not isinstance(v, Literal) and v in reached
