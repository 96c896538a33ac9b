"""Linear algebra of many small matrices at once: `[m, n, ...]`, whatever follows is the batch.

The batch comes last, so that neighbouring numbers take the same operations, and everything is
written out: for matrices this small, calling a library costs more than the arithmetic.
"""

import functools

import jax
import jax.numpy as jnp

from jaxtrack.kernel import add_up


def cholesky(matrix: jax.Array) -> jax.Array:
    """Lower Cholesky factors of matrices `[n, n, ...]` from their lower triangles, column by column.

    NaN where a matrix is not positive definite.
    """
    columns: list[jax.Array] = []
    for j in range(matrix.shape[0]):
        # Column k of the factor is kept from its diagonal down.
        reduced = matrix[j:, j] - sum(column[j - k :] * column[j - k] for k, column in enumerate(columns))
        columns.append(reduced / jnp.sqrt(reduced[0]))
    above = [jnp.zeros_like(matrix[:k, 0]) for k in range(matrix.shape[0])]
    return jnp.stack([jnp.concatenate(pair) for pair in zip(above, columns, strict=True)], axis=1)


def triangular_factor(matrix: jax.Array) -> jax.Array:
    """Lower triangular L `[n, n, ...]` with ``L L^T = A A^T`` for matrices A `[n, m, ...]`, m >= n.

    By Householder reflections, without the product A A^T: small numbers beside large ones are kept where a
    Cholesky factor of the product would lose them. No diagonal of L is negative.
    """
    size = matrix.shape[0]
    # In a loop: written out, XLA takes minutes.
    reflected = jax.lax.fori_loop(0, size, _reflect, matrix)[:, :size]
    lower = jnp.tril(jnp.ones((size, size), bool)).reshape(size, size, *(1 for _ in matrix.shape[2:]))
    return jnp.where(lower, reflected, 0)


def _reflect(j: jax.Array, matrix: jax.Array) -> jax.Array:
    """Matrices A `[n, m, ...]` times a reflection after which row j is zero from column j + 1 on.

    Rows before j have had their turn, and are not changed.
    """
    column = jnp.arange(matrix.shape[1]).reshape(-1, *(1 for _ in matrix.shape[2:]))
    row = jnp.where(column >= j, jax.lax.dynamic_index_in_dim(matrix, j, keepdims=False), 0)
    # Scaled, so that no square is too large or too small.
    largest = functools.reduce(jnp.maximum, jnp.unstack(jnp.abs(row)))
    row = row / jnp.where(largest == 0, 1, largest)
    pivot = jax.lax.dynamic_index_in_dim(row, j)
    length = jnp.sqrt(add_up(row * row))
    mirror = jnp.where(column == j, pivot + jnp.copysign(length, pivot), row)
    half_square = length * (length + jnp.abs(pivot[0]))
    along = add_up(matrix * mirror, axis=1) / jnp.where(half_square == 0, 1, half_square)
    turned = matrix - along[:, None] * mirror
    return jnp.where(column == j, -jnp.copysign(1, pivot) * turned, turned)


def solve_lower(factor: jax.Array, vector: jax.Array) -> jax.Array:
    """``L^-1 b`` `[n, ...]` of lower triangular L `[n, n, ...]` and b `[n, ...]`, by substitution."""
    solved: list[jax.Array] = []
    for row, entry in zip(factor, vector, strict=True):
        rest = entry - sum(a * b for a, b in zip(row, solved, strict=False))
        solved.append(rest / row[len(solved)])
    return jnp.stack(solved)


def inverse_3x3(matrix: jax.Array) -> jax.Array:
    """Inverses of matrices `[3, 3, ...]` by cofactors, which is exact under scaling of units."""
    adjugate = _adjugate(matrix)
    return adjugate / add_up(matrix[0] * adjugate[:, 0])


def determinant_3x3(matrix: jax.Array) -> jax.Array:
    """Determinants `[...]` of matrices `[3, 3, ...]` by cofactors."""
    return add_up(matrix[0] * _adjugate(matrix)[:, 0])


def product(a: jax.Array, b: jax.Array) -> jax.Array:
    """Matrix products `[m, n, ...]` of `[m, k, ...]` and `[k, n, ...]`."""
    return add_up(a[:, :, None] * b[None], axis=1)


def batch_last(batch: jax.Array) -> jax.Array:
    """`[m, ..., B]` of `[B, m, ...]`."""
    return jnp.moveaxis(batch, 0, -1)


def batch_first(batch: jax.Array) -> jax.Array:
    """`[B, m, ...]` of `[m, ..., B]`."""
    return jnp.moveaxis(batch, -1, 0)


def _adjugate(matrix: jax.Array) -> jax.Array:
    a, b, c = matrix
    return jnp.stack([_cross(b, c), _cross(c, a), _cross(a, b)], axis=1)


def _cross(a: jax.Array, b: jax.Array) -> jax.Array:
    return jnp.stack([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])
