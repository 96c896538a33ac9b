"""Linear algebra of small matrices against numpy's, one matrix and many at once."""

import jax
import jax.numpy as jnp
import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from jaxtrack import matrices

cholesky = jax.jit(matrices.cholesky)
inverse_3x3 = jax.jit(matrices.inverse_3x3)


def spd(seed, size, sigmas=1.0):
    root = np.random.default_rng(seed).normal(size=(size, size))
    return (root @ root.T + 0.1 * np.eye(size)) * sigmas * np.reshape(sigmas, (-1, 1))


@given(st.integers(0, 10_000), st.sampled_from([1, 2, 3, 6]))
def test_cholesky_equals_numpys(x64, seed, size):
    matrix = spd(seed, size, 10.0 ** np.arange(size))
    np.testing.assert_allclose(cholesky(matrix), np.linalg.cholesky(matrix), rtol=1e-9)


def test_cholesky_reads_the_lower_triangle_only():
    matrix = spd(0, 6)
    lower_only = np.tril(matrix) + np.triu(np.full((6, 6), 7.0), 1)
    np.testing.assert_array_equal(cholesky(lower_only), cholesky(matrix))


def test_cholesky_of_an_indefinite_matrix_is_nan():
    assert bool(jnp.any(jnp.isnan(cholesky(jnp.diag(jnp.array([1.0, -1.0, 1.0]))))))


@given(st.integers(0, 10_000))
def test_inverse_3x3_equals_numpys_in_any_units(x64, seed):
    matrix = spd(seed, 3, np.array([1e-3, 1e-3, 10.0]))
    np.testing.assert_allclose(inverse_3x3(matrix), np.linalg.inv(matrix), rtol=1e-8)


def test_inverse_3x3_needs_no_symmetry(x64):
    matrix = np.array([[1.0, 2, 3], [0, 1, 4], [5, 6, 0]])
    np.testing.assert_allclose(inverse_3x3(matrix), [[-24, 18, 5], [20, -15, -4], [-5, 4, 1]], rtol=1e-12)


@given(st.integers(0, 10_000))
def test_determinant_3x3_equals_numpys(x64, seed):
    matrix = np.random.default_rng(seed).normal(size=(3, 3))
    np.testing.assert_allclose(matrices.determinant_3x3(matrix), np.linalg.det(matrix), atol=1e-12)


def test_many_matrices_at_once_equal_each_alone(x64):
    batch = jnp.asarray([spd(seed, 3) for seed in range(4)])
    last = matrices.batch_last(batch)
    for function, numpys in (
        (matrices.cholesky, np.linalg.cholesky),
        (matrices.inverse_3x3, np.linalg.inv),
        (matrices.determinant_3x3, np.linalg.det),
        (lambda a: matrices.product(a, a), lambda a: a @ a),
    ):
        np.testing.assert_allclose(matrices.batch_first(function(last)), numpys(batch), rtol=1e-9)
    np.testing.assert_array_equal(matrices.batch_first(last), batch)
