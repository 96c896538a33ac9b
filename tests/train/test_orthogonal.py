"""Orthogonal weights are those of JAX's own initialiser."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxtrack import make
from train.agents import AGENTS
from train.config import TrainConfig
from train.learner import init_learner
from train.orthogonal import orthogonal, orthonormal_columns

SHAPES = [(5, 3), (3, 5), (4, 4), (1, 3), (3, 1), (3, 3, 2, 4), (1024, 128)]


@pytest.mark.parametrize("shape", SHAPES, ids=str)
def test_the_weights_are_those_of_jax(shape):
    key = jax.random.key(0)
    expected = jax.nn.initializers.orthogonal(1.5)(key, shape)
    found = jax.jit(orthogonal(1.5), static_argnums=1)(key, shape)
    assert found.dtype == expected.dtype
    np.testing.assert_allclose(found, expected, atol=5e-5)


def test_columns_that_are_almost_the_same_are_still_orthogonal():
    rng = np.random.default_rng(0)
    alike = rng.normal(size=(60, 1)) + 1e-3 * rng.normal(size=(60, 20))
    basis = orthonormal_columns(jnp.asarray(alike, dtype=jnp.float32))
    np.testing.assert_allclose(basis.T @ basis, np.eye(20), atol=1e-5)


@pytest.mark.parametrize("encoder", AGENTS)
def test_no_network_calls_a_decomposition(encoder):
    """Several at once can wait for each other for ever."""
    config = TrainConfig(encoder=encoder, num_envs=1)
    env, params = make(config.params, config.static)
    lowered = jax.jit(lambda key: init_learner(key, params, env, config)).lower(jax.random.key(0))
    assert "lapack" not in lowered.as_text()
