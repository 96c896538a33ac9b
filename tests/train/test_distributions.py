"""Factored and joint distributions over looks: frequencies, arithmetic and shapes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from train.distributions import FACTORED, JOINT

L = 3
each = pytest.mark.parametrize(
    ("distribution", "shape"), [(FACTORED, (2, L)), (JOINT, (L * L,))], ids=["factored", "joint"]
)
PAIRS = jnp.stack(jnp.meshgrid(jnp.arange(L), jnp.arange(L), indexing="ij"), axis=-1).reshape(-1, 2)


def probabilities(distribution, logits):
    """Probability `[L * L]` of every pair, in the order of `PAIRS`."""
    repeated = jnp.broadcast_to(logits, (L * L, *logits.shape))
    return np.exp(np.asarray(distribution.log_prob(repeated, PAIRS), np.float64))


@each
def test_samples_follow_the_log_probabilities(distribution, shape):
    logits = jax.random.normal(jax.random.key(0), shape)
    expected = probabilities(distribution, logits)
    assert np.isclose(expected.sum(), 1, atol=1e-5)
    n = 20_000
    actions = distribution.sample(jax.random.key(1), jnp.broadcast_to(logits, (n, *shape)))
    assert actions.shape == (n, 2)
    assert actions.dtype == jnp.int32
    counts = np.bincount(np.asarray(actions) @ [L, 1], minlength=L * L)
    assert stats.chisquare(counts, n * expected / expected.sum()).pvalue > 1e-3


@each
def test_entropy_and_mode_agree_with_the_log_probabilities(distribution, shape):
    logits = 2 * jax.random.normal(jax.random.key(2), (5, *shape))
    for row, entropy, mode in zip(
        logits, distribution.entropy(logits), distribution.mode(logits), strict=True
    ):
        p = probabilities(distribution, row)
        np.testing.assert_allclose(entropy, stats.entropy(p), rtol=1e-5)
        np.testing.assert_array_equal(mode, PAIRS[np.argmax(p)])
    assert distribution.mode(logits).dtype == jnp.int32


def test_joint_index_is_azimuth_times_looks_plus_elevation():
    logits = jnp.full(L * L, -20.0).at[2 * L + 1].set(20.0)
    np.testing.assert_array_equal(JOINT.mode(logits), [2, 1])
    np.testing.assert_array_equal(JOINT.sample(jax.random.key(0), logits), [2, 1])
    np.testing.assert_allclose(JOINT.log_prob(logits, jnp.array([2, 1])), 0, atol=1e-6)


def test_factored_heads_are_azimuth_then_elevation():
    logits = jnp.log(jnp.array([[0.2, 0.3, 0.5], [0.7, 0.2, 0.1]]))
    np.testing.assert_array_equal(FACTORED.mode(logits), [2, 0])
    np.testing.assert_allclose(FACTORED.log_prob(logits, jnp.array([1, 2])), np.log(0.3 * 0.1), rtol=1e-6)


@each
def test_uniform_entropy(distribution, shape):
    np.testing.assert_allclose(distribution.entropy(jnp.full(shape, 7.0)), 2 * np.log(L), rtol=1e-6)


@each
def test_gradients_survive_impossible_looks(distribution, shape):
    logits = jnp.zeros(shape).at[..., 0].set(-jnp.inf)
    entropy, gradient = jax.value_and_grad(distribution.entropy)(logits)
    possible = (L - 1) ** 2 if shape == (2, L) else L * L - 1
    np.testing.assert_allclose(entropy, np.log(possible), rtol=1e-6)
    assert np.all(np.isfinite(gradient))


@each
def test_policy_gradient_of_log_prob(distribution, shape):
    """d log p(a) / d logits sums to zero over each softmax and is positive at a."""
    logits = jax.random.normal(jax.random.key(3), shape)
    gradient = jax.grad(distribution.log_prob)(logits, jnp.array([2, 1]))
    np.testing.assert_allclose(gradient.sum(axis=-1), np.zeros(shape[:-1]), atol=1e-6)
    chosen = gradient[jnp.arange(2), jnp.array([2, 1])] if shape == (2, L) else gradient[2 * L + 1]
    assert np.all(chosen > 0)
    assert np.sum(np.asarray(gradient) > 0) == np.size(chosen)


def test_joint_refuses_a_number_of_looks_that_is_not_square():
    with pytest.raises(ValueError, match="square number"):
        JOINT.mode(jnp.zeros(10))
