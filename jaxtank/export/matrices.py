"""Products, factorisations and triangular solves of matrices: in scalars if small, else in loops.

RULES holds the primitives of jax, NAMED the functions of `jaxtank.analysis.qp` that are written as
matrix operations because their loops index arrays; `jaxtank.export.lowering` looks both up.
"""

import numpy as np

from jaxtank.export.primitives import each, no_code
from jaxtank.export.simplify import is_number
from jaxtank.export.statements import REAL

LARGE = 300
"""Number of multiplications in a matrix product above which it is a loop."""


def product(writer, a, b, dimensions):
    """Return the elements of a product of two arrays.

    Parameters
    ----------
    writer : Writer
    a, b : arrays of elements
    dimensions : ((axes of a, axes of b), (batch axes of a, of b)), as in `jax.lax.dot_general`
    """
    (left, right), batches = dimensions
    if any(batches):
        raise no_code("it multiplies stacks of matrices")
    rows = [i for i in range(a.ndim) if i not in left]
    columns = [i for i in range(b.ndim) if i not in right]
    A = a.transpose(*rows, *left).reshape(int(np.prod([a.shape[i] for i in rows])), -1)
    B = b.transpose(*right, *columns).reshape(A.shape[1], -1)
    shape = tuple(a.shape[i] for i in rows) + tuple(b.shape[i] for i in columns)
    if A.shape[0] * A.shape[1] * B.shape[1] > LARGE:
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
    """A solve with a right side of zero, of a term that carries derivatives alone."""
    if not all(is_number(e) and e == 0 for e in operands[-1].ravel()):
        raise no_code("it uses the operation custom_linear_solve")
    return [operands[-1]]


def _lu(writer, eqn, operands):
    """The factors of a matrix whose equations have a right side of zero: see `_linear_solve`."""
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
