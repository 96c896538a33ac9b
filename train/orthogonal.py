"""Orthogonal weights (Saxe et al. 2014) without a library's decomposition.

`jax.nn.initializers.orthogonal` calls LAPACK's QR. On a machine with two cores XLA (jaxlib 0.10.2)
starts several of them at once inside one program, and they can then wait for each other for ever:
a training that never begins. This gives the same weights, but for rounding.
"""

import math
from collections.abc import Sequence

import jax
import jax.numpy as jnp
from flax import linen as nn


def orthogonal(gain: float = 1.0) -> nn.initializers.Initializer:
    """Weights `[..., F]` whose F columns, or else their rows, are orthogonal and as long as `gain`."""

    def init(key: jax.Array, shape: Sequence[int], dtype: jnp.dtype = jnp.float32) -> jax.Array:
        rows, columns = math.prod(shape[:-1]), shape[-1]
        tall = jax.random.normal(key, (max(rows, columns), min(rows, columns)), dtype)
        basis = orthonormal_columns(tall)
        return gain * (basis if rows >= columns else basis.T).reshape(shape)

    return init


def orthonormal_columns(matrix: jax.Array) -> jax.Array:
    """Q of ``matrix = Q R`` `[M, N]`, M >= N, R with a positive diagonal: Gram-Schmidt, each column twice.

    Once is not enough in float32, twice is (Giraud et al. 2005).
    """

    def add_column(number: jax.Array, basis: jax.Array) -> jax.Array:
        column = matrix[:, number]
        for _ in range(2):
            column = column - basis @ (basis.T @ column)
        return basis.at[:, number].set(column / jnp.linalg.norm(column))

    return jax.lax.fori_loop(0, matrix.shape[1], add_column, jnp.zeros_like(matrix))
