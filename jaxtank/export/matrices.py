"""Products, factorisations and triangular solves of matrices: in scalars if small, else in loops.

RULES holds the primitives of jax, NAMED the functions of `jaxtank.analysis.qp` that are written as
matrix operations because their loops index arrays; `jaxtank.export.lowering` looks both up.
"""

import numpy as np

from jaxtank.export.primitives import each, no_code
from jaxtank.export.simplify import is_number
from jaxtank.export.statements import REAL


def product(writer, a, b, dimensions):
    """Return the elements of a product of two arrays."""
    (left, right), batches = dimensions
    if any(batches):
        raise no_code("it multiplies stacks of matrices")
    rows = [i for i in range(a.ndim) if i not in left]
    columns = [i for i in range(b.ndim) if i not in right]
    A = a.transpose(*rows, *left).reshape(int(np.prod([a.shape[i] for i in rows])), -1)
    B = b.transpose(*right, *columns).reshape(A.shape[1], -1)
    shape = tuple(a.shape[i] for i in rows) + tuple(b.shape[i] for i in columns)
    if A.shape[0] * A.shape[1] * B.shape[1] > writer.large:
        return writer.matrix("product", (A, B), (*A.shape, B.shape[1]), shape)
    out = np.empty((A.shape[0], B.shape[1]), dtype=object)
    for i, j in np.ndindex(out.shape):
        out[i, j] = _inner_product(writer, A[i], B[:, j])
    return out.reshape(shape)


def _inner_product(writer, row, column):
    total = writer.define(REAL, "mul", row[0], column[0])
    for a, b in zip(row[1:], column[1:]):
        total = writer.define(REAL, "add", total, writer.define(REAL, "mul", a, b))
    return total


def _product(writer, eqn, operands):
    return [product(writer, *operands, dimensions=eqn.params["dimension_numbers"])]


def _factorise(writer, eqn, operands):
    n = operands[0].shape[-1]
    return [writer.matrix("cholesky", operands, (n,), (n, n))]


def _triangular(writer, eqn, operands):
    (a, b), params = operands, eqn.params
    if params["unit_diagonal"] or params["conjugate_a"]:
        raise no_code("a triangular solve of an unusual kind")
    transposed = params["transpose_a"]
    if not params["left_side"]:  # x A = b is A' x' = b'
        b, transposed = b.T, not transposed
    operation = "forward" if params["lower"] != transposed else "backward"
    x = writer.matrix(operation, (a if params["lower"] else a.T, b), b.shape, b.shape)
    return [x if params["left_side"] else x.T]


def _linear_solve(writer, eqn, operands):
    """Solves with the matrix of a linear function, found by applying it to unit vectors."""
    # Numbers that do not meet in it (several right sides) are solved for apart.
    lengths, jaxprs = eqn.params["const_lengths"], eqn.params["jaxprs"]
    right = operands[sum(lengths) :]
    if len(right) != 1:
        raise no_code("it solves for several arrays at once")
    b, shape = right[0].ravel(), right[0].shape
    if all(is_number(e) and e == 0 for e in b):
        return right
    closed, consts = jaxprs.matvec, operands[: lengths.matvec]
    columns = []
    for i in range(b.size):
        unit = np.zeros(b.size, dtype=object)
        unit[:] = [float(i == j) for j in range(b.size)]
        (column,) = writer.run(closed.jaxpr, closed.consts, [*consts, unit.reshape(shape)])
        columns.append(column.ravel())
    a, x = np.stack(columns, axis=1), np.empty(b.size, dtype=object)
    for matrix, places in _blocks(a):
        n, k = places.shape
        x[places] = writer.matrix("solve", (matrix, b[places]), (n, k), (n, k))
    return [x.reshape(shape)]


def _blocks(a):
    """Yield (matrix (n, n), places (n, k) in the vector) of each group of equal diagonal blocks."""
    size = len(a)
    meet = np.array([[not (is_number(e) and e == 0) for e in row] for row in a]) | np.eye(
        size, dtype=bool
    )
    meet = meet | meet.T
    for _ in range(size.bit_length()):
        meet = meet @ meet
    groups = {}
    for first in range(size):
        own = np.flatnonzero(meet[first])
        if own[0] == first:
            block = a[np.ix_(own, own)]
            groups.setdefault(tuple(block.ravel()), (block, []))[1].append(own)
    for block, places in groups.values():
        yield block, np.stack(places, axis=1)


def _lu(writer, eqn, operands):
    """The factors of a matrix, which `_linear_solve` does not read."""
    return [operands[0], *(np.zeros(v.aval.shape, dtype=object) for v in eqn.outvars[1:])]


RULES = {
    "dot_general": _product,
    "cholesky": _factorise,
    "triangular_solve": _triangular,
    "custom_linear_solve": _linear_solve,
    "lu": _lu,
}
"""{primitive of jax: function (writer, equation, operands) -> list of arrays of elements}."""


def _cholesky(writer, a):
    n = a.shape[0]
    return writer.matrix("cholesky", (a,), (n,), (n, n)).T


def _cholesky_solve(writer, upper, b):
    n = len(b)
    y = writer.matrix("forward", (upper.T, b), (n, 1), (n,))
    return writer.matrix("backward", (upper.T, y), (n, 1), (n,))


def _weighted(writer, g, weight):
    scaled = each(lambda a, w: writer.define(REAL, "mul", a, w), g, weight[:, None])
    return product(writer, scaled.T, g, (((1,), (0,)), ((), ())))


NAMED = {f.__name__: f for f in (_cholesky, _cholesky_solve, _weighted)}
"""{function of `jaxtank.analysis.qp`: function (writer, *operands) -> array of elements}."""
