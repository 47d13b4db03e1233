"""A scan whose body may be written plainly: work that does not belong in the loop is moved in front of it.

Laws and plants compute their coefficients from their leaves where they use them, as their papers write them. XLA leaves such work
inside a compiled loop (measured on the four-tank: a fifth of a run). Here the body is traced once, and what depends on constants
alone is computed once; equal coefficients (each Runge-Kutta stage makes its own) become one, so that XLA can see they are.
"""

import jax
import jax.numpy as jnp
from jax.core import eval_jaxpr
from jax.extend.core import Literal


def scan(body, carry, xs, length):
    """jax.lax.scan(body, carry, xs, length), less what need not be in the loop. Values and derivatives are the same."""
    closed, shape = jax.make_jaxpr(body, return_shape=True)(_like(carry), jax.tree.map(lambda a: _like(a[0]), xs))
    jaxpr, structure = closed.jaxpr, jax.tree.structure(shape)

    same, seen, fixed, once, inside = {}, {}, set(jaxpr.constvars), [], []
    for eqn in jaxpr.eqns:
        eqn = eqn.replace(invars=[v if isinstance(v, Literal) else same.get(v, v) for v in eqn.invars])
        if eqn.effects or not all(isinstance(v, Literal) or v in fixed for v in eqn.invars):
            inside.append(eqn)
            continue
        twin = seen.setdefault(_key(eqn), eqn)
        if twin is eqn:
            once.append(eqn)
            fixed.update(eqn.outvars)
        else:
            same.update(zip(eqn.outvars, twin.outvars))
    out = [v if isinstance(v, Literal) else same.get(v, v) for v in jaxpr.outvars]

    # a number spread over lanes is cheaper to spread again than to fetch
    wanted = {v for eqn in inside for v in eqn.invars if not isinstance(v, Literal)}
    inside = [eqn for eqn in once if eqn.primitive.name == "broadcast_in_dim" and eqn.outvars[0] in wanted] + inside
    made = {v for eqn in inside for v in eqn.outvars}
    used = {v for v in [*out, *(v for eqn in inside for v in eqn.invars)] if not isinstance(v, Literal)}
    kept = [v for v in [*jaxpr.constvars, *(v for eqn in once for v in eqn.outvars)] if v in used and v not in made]
    before = jaxpr.replace(invars=[], outvars=kept, eqns=once, debug_info=None)
    loop = jaxpr.replace(constvars=kept, outvars=out, eqns=inside, debug_info=None)
    constants = eval_jaxpr(before, closed.consts)

    def lean(state, x):
        return jax.tree.unflatten(structure, eval_jaxpr(loop, constants, *jax.tree.leaves((state, x))))

    return jax.lax.scan(lean, carry, xs, length=length)


def _like(tree):
    return jax.tree.map(lambda a: jax.ShapeDtypeStruct(jnp.shape(a), jnp.result_type(a)), tree)


def _key(eqn):
    """Equal for two operations that give the same result. Operations that carry a program are told apart by identity."""
    operands = tuple(("literal", str(v.aval), repr(v.val)) if isinstance(v, Literal) else id(v) for v in eqn.invars)
    plain = all(not hasattr(p, "eqns") and not hasattr(p, "jaxpr") and not callable(p) for p in eqn.params.values())
    return (eqn.primitive, operands, tuple(sorted((k, str(v)) for k, v in eqn.params.items()))) if plain else id(eqn)
