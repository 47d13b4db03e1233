"""Loops and branches of a traced function: `scan` and `while` stay loops, `cond` is a selection.

RULES holds the primitives of jax; `jaxtank.export.lowering` looks them up there.
"""

import numpy as np

from jaxtank.export.primitives import chosen, kind_of, no_code
from jaxtank.export.statements import Loop, Ref, Until


def _cond(writer, eqn, operands):
    """All branches are computed, because none has an effect, and one is chosen."""
    branches = [writer.run(b.jaxpr, b.consts, operands[1:]) for b in eqn.params["branches"]]
    out = []
    for variable, *values in zip(eqn.outvars, *branches):
        index = np.broadcast_to(operands[0], values[0].shape)
        out.append(chosen(writer, index, values, kind_of(variable.aval.dtype)))
    return out


def _scan(writer, eqn, operands):
    p = eqn.params
    first, last = p["num_consts"], p["num_consts"] + p["num_carry"]
    if operands[last:] or len(eqn.outvars) > p["num_carry"]:
        raise no_code("a loop in it reads or writes a sequence")
    closed = p["jaxpr"]

    def body(carried):
        return writer.run(closed.jaxpr, closed.consts, [*operands[:first], *carried])

    return _loop(writer, eqn, operands[first:], p["length"], body)


def _while(writer, eqn, operands):
    p = eqn.params
    test, body = p["cond_jaxpr"], p["body_jaxpr"]
    first, last = p["cond_nconsts"], p["cond_nconsts"] + p["body_nconsts"]

    def tested_body(carried):
        (on,) = writer.run(test.jaxpr, test.consts, [*operands[:first], *carried])
        writer.scopes[-1].append(Until(on.item()))
        return writer.run(body.jaxpr, body.consts, [*operands[first:last], *carried])

    return _loop(writer, eqn, operands[last:], None, tested_body)


def _loop(writer, eqn, starts, count, body):
    """The carried variables after a loop; body: function of them that returns the next ones."""
    carried, variables = [], []
    for v, start in zip(eqn.outvars, starts):
        kind, refs = kind_of(v.aval.dtype), np.empty(start.shape, dtype=object)
        for i in np.ndindex(start.shape):
            ref = refs[i] = Ref(writer.fresh("c"))
            carried.append((kind, ref.name, start[i]))
        variables.append(refs)
    writer.scopes.append([])
    writer.known.append({})
    out = body(variables)
    statements = writer.scopes.pop()
    writer.known.pop()
    new = tuple(e for o in out for e in o.ravel())
    writer.scopes[-1].append(Loop(count, tuple(carried), statements, new))
    return variables


RULES = {"cond": _cond, "scan": _scan, "while": _while}
"""{primitive of jax: function (writer, equation, operands) -> list of arrays of elements}."""
