"""Loops and branches of a traced function: `scan` and `while` stay loops, `cond` is a selection.

RULES holds the primitives of jax; `jaxtank.export.lowering` looks them up there.
"""

import numpy as np

from jaxtank.export.primitives import chosen, kind_of
from jaxtank.export.statements import REAL, WHOLE, Loop, Ref, Until


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
    closed, sequences = p["jaxpr"], operands[last:]
    if len(eqn.outvars) > p["num_carry"]:
        return _unrolled(writer, p, operands[:first], operands[first:last], sequences)
    starts, read = operands[first:last], lambda *counter: []
    if sequences:
        starts = [*starts, np.array(0, dtype=object)]
        read = _reader(writer, sequences, eqn.invars[last:], p["reverse"])

    def body(carried):
        own, counter = (carried[:-1], carried[-1:]) if sequences else (carried, [])
        out = writer.run(closed.jaxpr, closed.consts, [*operands[:first], *own, *read(*counter)])
        if sequences:
            after = np.empty((), dtype=object)
            after[()] = writer.define(WHOLE, "add", counter[0].item(), 1)
            out = [*out, after]
        return out

    kinds = [kind_of(v.aval.dtype) for v in eqn.outvars] + [WHOLE] * bool(sequences)
    return _loop(writer, kinds, starts, p["length"], body)[: len(eqn.outvars)]


def _unrolled(writer, p, consts, carry, sequences):
    """The results of a loop that writes sequences, pass by pass."""
    passes, rows = range(p["length"]), []
    for i in reversed(passes) if p["reverse"] else passes:
        inputs = [*consts, *carry, *(s[i] for s in sequences)]
        out = writer.run(p["jaxpr"].jaxpr, p["jaxpr"].consts, inputs)
        carry = out[: p["num_carry"]]
        rows.append(out[p["num_carry"] :])
    rows = rows[::-1] if p["reverse"] else rows
    return [*carry, *(np.stack(column) for column in zip(*rows))]


def _reader(writer, sequences, variables, backwards):
    """Return a function of the counter of a loop that gives what its pass reads of the sequences:
    each of their elements is an array of its own, indexed by the counter.
    """
    arrays = []
    for rows, v in zip(sequences, variables):
        rows, names = rows[::-1] if backwards else rows, np.empty(rows.shape[1:], dtype=object)
        for i in np.ndindex(names.shape):
            names[i] = writer.array(rows[(slice(None), *i)])
        arrays.append((kind_of(v.aval.dtype), names))

    def read(counter):
        found = []
        for kind, names in arrays:
            entries = np.empty(names.shape, dtype=object)
            for i in np.ndindex(names.shape):
                entry = Ref(names[i], counter.item())
                entries[i] = entry if kind == REAL else writer.define(kind, kind, entry)
            found.append(entries)
        return found

    return read


def _while(writer, eqn, operands):
    p = eqn.params
    test, body = p["cond_jaxpr"], p["body_jaxpr"]
    first, last = p["cond_nconsts"], p["cond_nconsts"] + p["body_nconsts"]

    def tested_body(carried):
        (on,) = writer.run(test.jaxpr, test.consts, [*operands[:first], *carried])
        writer.scopes[-1].append(Until(on.item()))
        return writer.run(body.jaxpr, body.consts, [*operands[first:last], *carried])

    kinds = [kind_of(v.aval.dtype) for v in eqn.outvars]
    return _loop(writer, kinds, operands[last:], None, tested_body)


def _loop(writer, kinds, starts, count, body):
    """The carried variables after a loop; body: function of them that returns the next ones."""
    carried, variables = [], []
    for kind, start in zip(kinds, starts):
        refs = np.empty(start.shape, dtype=object)
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
