"""A scan whose body may be written plainly: work that does not belong in the loop is moved in front
of it.

Laws and plants compute their coefficients from their leaves where they use them, as their papers
write them. XLA leaves such work inside a compiled loop (measured on the four-tank: a fifth of a
run). Here the body is traced once, and what depends on constants alone is computed once; equal
coefficients (each Runge-Kutta stage makes its own) become one, so that XLA can see they are.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax.extend.core import Literal


def scan(body: Callable[[Any, Any], Any], carry: Any, xs: Any, length: int) -> Any:
    """jax.lax.scan(body, carry, xs, length), less what need not be in the loop. Values and
    derivatives are the same.
    """
    closed, shape = jax.make_jaxpr(body, return_shape=True)(
        _like(carry), jax.tree.map(lambda a: jax.ShapeDtypeStruct(a.shape[1:], a.dtype), xs)
    )
    jaxpr, structure = closed.jaxpr, jax.tree.structure(shape)
    once, inside, same = _split(jaxpr)
    constants = dict(zip(jaxpr.constvars, closed.consts))
    _run(once, constants, same)

    def lean(state, x):
        values = {**constants, **dict(zip(jaxpr.invars, jax.tree.leaves((state, x))))}
        _run(inside, values, same)
        return jax.tree.unflatten(structure, [_read(v, values, same) for v in jaxpr.outvars])

    return jax.lax.scan(lean, carry, xs, length=length)


def _split(jaxpr):
    """(operations to do once, operations of the loop, {variable: the one it equals})."""
    once, inside, same, seen, fixed = [], [], {}, {}, set(jaxpr.constvars)
    for eqn in jaxpr.eqns:
        operands = [v if isinstance(v, Literal) else same.get(v, v) for v in eqn.invars]
        if eqn.effects or not all(isinstance(v, Literal) or v in fixed for v in operands):
            inside.append(eqn)
            continue
        twin = seen.setdefault(_key(eqn, operands), eqn)
        if twin is eqn:
            once.append(eqn)
            fixed.update(eqn.outvars)
        else:
            same.update(zip(eqn.outvars, twin.outvars))
    # a number spread over lanes is cheaper to spread again than to fetch
    wanted = {same.get(v, v) for eqn in inside for v in eqn.invars if not isinstance(v, Literal)}
    spread = [
        eqn for eqn in once if eqn.primitive.name == "broadcast_in_dim" and eqn.outvars[0] in wanted
    ]
    return once, spread + inside, same


def _key(eqn, operands):
    """Equal for two operations that give the same result. Operations that carry a program are told
    apart by identity.
    """
    if any(hasattr(p, "eqns") or hasattr(p, "jaxpr") or callable(p) for p in eqn.params.values()):
        return id(eqn)
    told = tuple((str(v.aval), repr(v.val)) if isinstance(v, Literal) else id(v) for v in operands)
    return eqn.primitive, told, tuple(sorted((name, str(p)) for name, p in eqn.params.items()))


def _run(eqns, values, same):
    """Do the operations in order, reading and writing {variable: value}."""
    for eqn in eqns:
        bound = eqn.primitive.get_bind_params(eqn.params)
        # a pair in older releases of jax
        functions, params = bound if isinstance(bound, tuple) else ((), bound)
        with eqn.ctx.manager:  # what `materialised` says of a call
            out = eqn.primitive.bind(
                *functions, *(_read(v, values, same) for v in eqn.invars), **params
            )
        values.update(zip(eqn.outvars, out if eqn.primitive.multiple_results else [out]))


def _read(v, values, same):
    return v.val if isinstance(v, Literal) else values[same.get(v, v)]


def _like(tree):
    return jax.tree.map(lambda a: jax.ShapeDtypeStruct(jnp.shape(a), jnp.result_type(a)), tree)
