"""Arrays of the state that are read and written at an index: the lines of transport delays.

Such an array stays an array: "item" reads an element, `Store` writes one in its place. RULES holds
the primitives of jax; `jaxtank.export.lowering` looks them up there.
"""

import numpy as np
from jax.extend.core import Literal

from jaxtank.export import primitives
from jaxtank.export.primitives import no_code
from jaxtank.export.simplify import is_number
from jaxtank.export.statements import REAL, Ref, Store

SMALL = 64
"""Number of entries up to which an array that is read at a computed index is a choice of values."""


def written(jaxpr):
    """Return the inputs of a jaxpr that it writes to at an index that it computes."""
    inputs, found = set(jaxpr.invars), set()
    for eqn in jaxpr.eqns:
        operands = [None if isinstance(v, Literal) else v for v in eqn.invars]
        if eqn.primitive.name == "dynamic_update_slice" and len(eqn.invars[0].aval.shape) == 1:
            found.add(operands[0])
        elif eqn.primitive.name in ("jit", "pjit"):
            inner = eqn.params["jaxpr"].jaxpr
            inside = written(inner)
            found |= {v for v, own in zip(operands, inner.invars) if own in inside}
    return found & inputs


def elements_of(name, size):
    """Return the elements of the line `name`."""
    out = np.empty(size, dtype=object)
    out[:] = [Ref(name, i) for i in range(size)]
    return out


def line_of(array):
    """Return the name of the line whose elements are those of an array; None of another array."""
    whole = array.ndim == 1 and all(
        isinstance(e, Ref) and e.index == i for i, e in enumerate(array)
    )
    same = {e.name for e in array.ravel()} if whole else set()
    return same.pop() if len(same) == 1 else None


def _read(writer, eqn, operands):
    array, *index = operands
    if all(is_number(i.item()) for i in index):
        return primitives.RULES["slice"](writer, eqn, operands)
    name = line_of(array)
    if name is None or eqn.params["slice_sizes"] != (1,):
        return [_chosen_slice(writer, eqn, array, [i.item() for i in index])]
    out = np.empty(1, dtype=object)
    out[0] = writer.define(REAL, "item", Ref(name), index[0].item())
    return [out]


def _chosen_slice(writer, eqn, array, index):
    """A slice of a small array whose place along one axis is computed: one of all there are."""
    sizes = eqn.params["slice_sizes"]
    moving = [d for d, i in enumerate(index) if not is_number(i) and array.shape[d] > sizes[d]]
    if len(moving) > 1 or array.size > SMALL:
        raise no_code("it reads an array at an index that it computes")
    starts = [
        0 if not is_number(i) else min(max(i, 0), n - m)
        for i, n, m in zip(index, array.shape, sizes)
    ]
    ranges = [slice(i, i + m) for i, m in zip(starts, sizes)]
    if not moving:
        return array[tuple(ranges)]
    (d,) = moving
    choices = []
    for i in range(array.shape[d] - sizes[d] + 1):
        ranges[d] = slice(i, i + sizes[d])
        choices.append(array[tuple(ranges)])
    at = np.empty(choices[0].shape, dtype=object)
    for i in np.ndindex(at.shape):
        at[i] = index[d]
    kind = primitives.kind_of(eqn.outvars[0].aval.dtype)
    return primitives.chosen(writer, at, choices, kind)


def _write(writer, eqn, operands):
    array, update, index = operands
    name = line_of(array)
    if name is None or update.shape != (1,):
        raise no_code("it writes to an array at an index")
    new = writer.fresh("l")
    writer.scopes[-1].append(Store(new, name, index.item(), update[0]))
    return [elements_of(new, array.size)]


RULES = {"dynamic_slice": _read, "dynamic_update_slice": _write}
"""{primitive of jax: function (writer, equation, operands) -> list of arrays of elements}."""
