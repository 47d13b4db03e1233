"""A scan that hoists loop-invariant work in front of the loop.

Controllers and plants compute their coefficients from their leaves where they use them, as their
papers write them. XLA (jaxlib 0.10 and 0.11) leaves such work inside a compiled loop, a fifth of a
run of the four-tank. Here the body is traced once, and what depends on constants alone is computed
once; equal coefficients (each Runge-Kutta stage makes its own) become one.
"""

import math
from collections.abc import Callable
from typing import Any, cast

import jax
import jax.numpy as jnp
from jax.extend.core import Literal


def scan(body: Callable[[Any, Any], Any], carry: Any, xs: Any, length: int) -> Any:
    """Return jax.lax.scan(body, carry, xs, length) with invariant work done before the loop."""
    closed, shape = jax.make_jaxpr(body, return_shape=True)(
        _like(carry), jax.tree.map(lambda a: jax.ShapeDtypeStruct(a.shape[1:], a.dtype), xs)
    )
    jaxpr, structure = closed.jaxpr, jax.tree.structure(shape)
    once, inside, same = _split(jaxpr)
    constants = dict(zip(jaxpr.constvars, closed.consts))
    run(once, constants, same)

    def lean(state, x):
        values = {**constants, **dict(zip(jaxpr.invars, jax.tree.leaves((state, x))))}
        run(inside, values, same)
        return jax.tree.unflatten(structure, [read(v, values, same) for v in jaxpr.outvars])

    return jax.lax.scan(lean, carry, xs, length=length)


def checkpointed_scan(body: Callable[[Any, Any], Any], carry: Any, xs: Any, length: int) -> Any:
    """Return the carry of a scan over sqrt(length) chunks, recomputed in reverse."""

    def chunk(carry: Any, now: Any) -> Any:
        return scan(body, carry, now, length=inner)[0], None

    def first(a: Any) -> Any:
        return a[: outer * inner].reshape(outer, inner, *a.shape[1:])

    def last(a: Any) -> Any:
        return a[outer * inner :]

    inner = math.isqrt(length)
    outer = length // inner
    checkpoint = cast(Any, jax.checkpoint)
    carry = scan(checkpoint(chunk), carry, jax.tree.map(first, xs), length=outer)[0]
    return scan(body, carry, jax.tree.map(last, xs), length=length - outer * inner)[0]


def _split(jaxpr):
    """(operations to do once, operations of the loop, {variable: the one it equals})."""
    once, inside, same, first_of, fixed = [], [], {}, {}, set(jaxpr.constvars)
    for eqn in jaxpr.eqns:
        operands = [v if isinstance(v, Literal) else same.get(v, v) for v in eqn.invars]
        if eqn.effects or not all(isinstance(v, Literal) or v in fixed for v in operands):
            inside.append(eqn)
            continue
        twin = first_of.setdefault(_key(eqn, operands), eqn)
        if twin is eqn:
            once.append(eqn)
            fixed.update(eqn.outvars)
        else:
            same.update(zip(eqn.outvars, twin.outvars))
    # a number broadcast over a batch is cheaper to broadcast again than to load
    reads = {same.get(v, v) for eqn in inside for v in eqn.invars if not isinstance(v, Literal)}
    broadcast = [
        eqn for eqn in once if eqn.primitive.name == "broadcast_in_dim" and eqn.outvars[0] in reads
    ]
    return once, broadcast + inside, same


def _key(eqn, operands):
    """Equal for operations with the same result; operations with a program stay apart."""
    if any(hasattr(p, "eqns") or hasattr(p, "jaxpr") or callable(p) for p in eqn.params.values()):
        return id(eqn)
    read = tuple((str(v.aval), repr(v.val)) if isinstance(v, Literal) else id(v) for v in operands)
    return eqn.primitive, read, tuple(sorted((name, str(p)) for name, p in eqn.params.items()))


def run(eqns, values, same):
    """Do the operations in order, reading and writing {variable: value}; same: {variable: twin}."""
    for eqn in eqns:
        with eqn.ctx.manager:  # the metadata that `materialised` gives a call
            out = bind(eqn, (read(v, values, same) for v in eqn.invars))
        values.update(zip(eqn.outvars, out))


def bind(eqn, operands):
    """Return the list of results of an operation on values."""
    bound = eqn.primitive.get_bind_params(eqn.params)
    # a pair in older releases of jax
    functions, params = bound if isinstance(bound, tuple) else ((), bound)
    out = eqn.primitive.bind(*functions, *operands, **params)
    return out if eqn.primitive.multiple_results else [out]


def read(v, values, same):
    """Return the value of a variable, or of a literal."""
    return v.val if isinstance(v, Literal) else values[same.get(v, v)]


def _like(tree):
    return jax.tree.map(lambda a: jax.ShapeDtypeStruct(jnp.shape(a), jnp.result_type(a)), tree)
