"""Linear algebra of small matrices against numpy's, one matrix and many at once."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from jaxtrack import matrices

cholesky = jax.jit(matrices.cholesky)
triangular_factor = jax.jit(matrices.triangular_factor)
solve_lower = jax.jit(matrices.solve_lower)
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


@given(st.integers(0, 10_000), st.sampled_from([(3, 5), (4, 4), (1, 1)]))
def test_triangular_factors_have_the_same_product(x64, seed, shape):
    matrix = np.random.default_rng(seed).normal(size=shape) * 10.0 ** np.arange(shape[0])[:, None]
    factor = np.asarray(triangular_factor(jnp.asarray(matrix)))
    np.testing.assert_array_equal(factor, np.tril(factor))
    assert np.all(np.diagonal(factor) >= 0)
    scale = np.linalg.norm(matrix, axis=1)
    np.testing.assert_allclose(
        factor @ factor.T / np.outer(scale, scale),
        (matrix / scale[:, None]) @ (matrix / scale[:, None]).T,
        atol=1e-13,
    )


def test_a_triangular_factor_keeps_in_float32_what_a_product_loses():
    """Variances that differ by a factor of 1e16: beside the larger one the smaller is less than rounding."""
    matrix = np.array([[1e6, 0, 1e-2], [1e6, 1e-2, 0]], np.float32)
    factor = np.asarray(triangular_factor(matrix), float)
    assert factor[1, 1] == pytest.approx(np.sqrt(2) * 1e-2, rel=1e-5)
    assert not np.linalg.det(matrix @ matrix.T) > 0


def test_triangular_factors_of_rows_of_zeros_and_of_extreme_numbers():
    for scale in (0.0, 1e-30, 1e30):
        factor = np.asarray(triangular_factor(np.full((2, 3), scale, np.float32)))
        expected = np.sqrt(3) * scale * np.array([[1, 0], [1, 0]])
        np.testing.assert_allclose(factor, expected, atol=3e-7 * scale)


@given(st.integers(0, 10_000))
def test_solving_by_substitution(x64, seed):
    factor = np.tril(np.random.default_rng(seed).normal(size=(3, 3))) + 3 * np.eye(3)
    np.testing.assert_allclose(solve_lower(factor, factor @ np.arange(3)), np.arange(3), atol=1e-12)


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
