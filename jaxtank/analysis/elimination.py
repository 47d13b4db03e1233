"""Elimination for small systems, without LAPACK.

In jaxlib 0.10 a batched LAPACK call divides its work among the threads on which it runs itself: as
many such calls at once as there are threads wait for each other for ever.
"""

import contextlib
import itertools
from collections.abc import Iterator

import jax
import jax.numpy as jnp
import numpy as np

UNROLLED = 40  # variables up to which the elimination is written out
ROWS = 64  # rows above which a product of three matrices is done row by row: a quarter of the time
STAGES = 4  # parts of a larger one: 1 takes twice the time of 4 at 100 variables, 8 as much as 4


@contextlib.contextmanager
def rolled() -> Iterator[None]:
    """Trace eliminations of any size as loops: unrolled, they would fill pages of exported code."""
    global UNROLLED
    before, UNROLLED = UNROLLED, STAGES - 1
    try:
        yield
    finally:
        UNROLLED = before


def solve(A, b):
    """Return x (n,) of A x = b, for a small matrix A (n, n): Gauss-Jordan with row pivots."""
    # Unrolled. Entries are not finite where a pivot is exactly 0.
    rows = jnp.concatenate([A, b[:, None]], axis=1)
    index = np.arange(A.shape[0])[:, None]
    for j in range(A.shape[0]):
        best = index == j + jnp.argmax(jnp.abs(rows[j:, j]))
        pivot = jnp.sum(jnp.where(best, rows, 0.0), axis=0)
        rows = jnp.where(best, rows[j], rows)  # exchange row j and the pivot row
        pivot = pivot / pivot[j]
        rows = jnp.where(index == j, pivot, rows - rows[:, j, None] * pivot)
    return rows[:, -1]


@jax.custom_jvp
@jax.jit
def inverse(A):
    """Return A^-1 (n, n), by Gauss-Jordan with row pivots; not finite where A is singular."""
    # `jaxtank.export.lowering` knows it by its name
    n, eye = A.shape[0], jnp.eye(A.shape[0], dtype=A.dtype)
    index = np.arange(n)

    def column(j, rows):
        size = jnp.where(index < j, -1.0, jnp.abs(entry(rows, j, axis=1)))
        best = index[:, None] == jnp.argmax(size)
        pivot = jnp.sum(jnp.where(best, rows, 0.0), axis=0)
        rows = jnp.where(best, entry(rows, j), rows)  # exchange row j and the pivot row
        pivot = pivot / entry(pivot, j)
        reduced = rows - entry(rows, j, axis=1)[:, None] * pivot
        return jnp.where(index[:, None] == j, pivot, reduced)

    return jax.lax.fori_loop(0, n, column, jnp.concatenate([A, eye], axis=1))[:, n:]


@inverse.defjvp
def _inverse_slope(primals, tangents):
    (A,), (dA,) = primals, tangents
    inverted = inverse(A)
    return inverted, -inverted @ dA @ inverted


@jax.custom_jvp
def solve_all(A, B):
    """Return A^-1 B, for A (n, n) and B (n,) or (n, columns); not finite where A is singular."""
    return _refined(inverse(A), A, B)


@solve_all.defjvp
def _slope_of_all(primals, tangents):
    (A, B), (dA, dB) = primals, tangents
    inverted = inverse(A)
    X = _refined(inverted, A, B)
    return X, inverted @ (dB - dA @ X)


def _refined(inverted, A, B):
    """A^-1 B from A^-1, with one step of refinement."""
    X = inverted @ B
    return X + inverted @ (B - A @ X)


def normal_matrix(H, G, weight):
    """Return H + G' diag(weight) G (n, n) for H (n, n), G (rows, n) and weight (rows,)."""
    many = H.shape[0] > UNROLLED or G.shape[0] > ROWS
    return H + (weighted_squares(G, weight) if many else (G.T * weight) @ G)


def times(A, x):
    """Return A x (rows,) without a product of matrices, as derivatives in many directions are."""
    return jnp.sum(A * x, axis=-1)


@jax.custom_jvp
@jax.jit
def weighted_squares(G, weight):
    """Return G' diag(weight) G (n, n) for G (rows, n) and weight (rows,), row by row."""
    # Inside a loop that is one compiled function, XLA vectorises the product of a vector and a
    # matrix, but writes the product of two matrices as three plain loops.
    product = jnp.zeros((G.shape[1], G.shape[1]), G.dtype)

    def row(j, product):
        new = (entry(G, j, axis=1) * weight) @ G
        return jax.lax.dynamic_update_index_in_dim(product, new, j, 0)

    return jax.lax.fori_loop(0, G.shape[1], row, product)


@weighted_squares.defjvp
def _weighted_squares_slope(primals, tangents):
    (G, weight), (dG, dweight) = primals, tangents
    moved = weight[:, None] * dG + (0.5 * dweight)[:, None] * G
    # a product of matrices as a sum of outer products, each of which is a loop over entries
    half = jax.lax.scan(
        lambda half, rows: (half + rows[0][:, None] * rows[1], None),
        jnp.zeros((G.shape[1], G.shape[1]), G.dtype),
        (moved, G),
    )[0]
    return weighted_squares(G, weight), half + half.T


def factor(A):
    """Return a factor of A (n, n) symmetric positive definite, for `_substitute`."""
    # Up to UNROLLED variables: [(column of L, pivot), ...] of A = L D L', written out column by
    # column. Above: `_cholesky`.
    if A.shape[0] > UNROLLED:
        return _cholesky(A)
    columns = []
    for j in range(A.shape[0]):
        columns.append((A[:, j] / A[j, j], A[j, j]))
        A = A - jnp.outer(columns[-1][0], A[j])
    return columns


def substitute(factor, b):
    """Return A^-1 b for the `_factor` of A; b: (n,)."""
    if not isinstance(factor, list):
        return _cholesky_solve(factor, b)
    index = np.arange(len(factor))
    for j, (column, _) in enumerate(factor):
        b = b - jnp.where(index > j, column, 0.0) * b[j]
    b = b / jnp.stack([pivot for _, pivot in factor])
    for j, (column, _) in reversed(list(enumerate(factor))):
        b = jnp.where(index == j, b - jnp.sum(jnp.where(index > j, column * b, 0.0)), b)
    return b


@jax.jit
def _cholesky(A):
    """Return U (n, n) upper triangular, A = U'U, of A positive definite (else NaN)."""
    # One row of U at a time, from a product of the rows before it. The rows are done in STAGES
    # parts of fixed shape, so that little of a product is spent on entries that are zero.
    # `jaxtank.export.lowering` writes this function, `_cholesky_solve` and `weighted_squares` as
    # loops of its own: it knows them by their names.
    n = A.shape[0]
    ends = [round(n * k / STAGES) for k in range(STAGES + 1)]
    U = jnp.zeros((0, n), A.dtype)
    for first, end in itertools.pairwise(ends):
        index, block = np.arange(n - first), A[first:, first:]

        def row(j, rows, first=first, index=index, block=block):
            column = entry(rows, j, axis=1)
            new = entry(block, j) - column @ rows
            new = jnp.where(index < j, 0.0, new * jax.lax.rsqrt(entry(new, j)))
            return jax.lax.dynamic_update_index_in_dim(rows, new, first + j, 0)

        rows = jnp.concatenate([U[:, first:], jnp.zeros((end - first, n - first), A.dtype)])
        rows = jax.lax.fori_loop(0, end - first, row, rows)
        U = jnp.concatenate([U, jnp.pad(rows[first:], ((0, 0), (first, 0)))])
    return U


@jax.jit
def _cholesky_solve(U, b):
    """Return x (n,) of U'U x = b; U (n, n) as `_cholesky` returns it; b: (n,)."""
    n = b.shape[0]
    index = np.arange(n)

    def forward(j, b):
        row = entry(U, j)
        y = entry(b, j) / entry(row, j)
        return jnp.where(index < j, b, jnp.where(index == j, y, b - row * y))

    def backward(k, x):
        j = n - 1 - k
        row = entry(U, j)
        y = (entry(x, j) - jnp.sum(jnp.where(index > j, row * x, 0.0))) / entry(row, j)
        return jax.lax.dynamic_update_index_in_dim(x, y, j, 0)

    return jax.lax.fori_loop(0, n, backward, jax.lax.fori_loop(0, n, forward, b))


def entry(array, j, axis=0):
    """Return entry j, a variable, of an array along an axis."""
    return jax.lax.dynamic_index_in_dim(array, j, axis, keepdims=False)
