"""Distributions over looks, as indices and as angles: frequencies, arithmetic and shapes."""

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from scipy import stats

from jaxtrack import Params, StaticParams
from jaxtrack.policies import to_action
from train.distributions import FACTORED, JOINT, Gaussian, OnGrid

pytestmark = pytest.mark.usefixtures("quick_compilation")

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


GRID = StaticParams(num_looks=L, continuous_actions=True)
PARAMS = Params(field_limit=0.8)
GAUSSIAN = Gaussian(PARAMS.field_limit)
MOMENTS = jnp.array([[[0.3, -1.5], [-2.0, 0.5]], [[0.0, 0.0], [4.0, -9.0]]])
"""Two times azimuth and elevation: inside the field, at its edge, as at the start, sharp at the edge."""


def moments(logits):
    """Mean and standard deviation `[..., 2]` of the normal distributions, in double precision."""
    mean, spread = np.moveaxis(np.asarray(logits, float), -1, 0)
    return 0.8 * np.tanh(mean), 0.8 * (1e-3 + 1.999 / (1 + np.exp(-spread)))


def cumulated(angles, logits):
    """Probability `[..., 2]` of smaller angles in the field."""
    normal = stats.norm(*moments(logits))
    return (normal.cdf(angles) - normal.cdf(-0.8)) / (normal.cdf(0.8) - normal.cdf(-0.8))


def log_density(angles, logits):
    """Logarithm of the density `[..., 2]` of angles in the field."""
    normal = stats.norm(*moments(logits))
    return normal.logpdf(angles) - np.log(normal.cdf(0.8) - normal.cdf(-0.8))


def test_gaussian_densities_are_those_of_scipy():
    drawn = GAUSSIAN.sample(jax.random.key(0), jnp.broadcast_to(MOMENTS, (50, 2, 2, 2)))
    expected = log_density(np.asarray(drawn, float), MOMENTS).sum(axis=-1)
    np.testing.assert_allclose(GAUSSIAN.log_prob(MOMENTS, drawn), expected, rtol=1e-3, atol=1e-3)


def test_gaussian_entropies_are_their_integrals():
    # The sharpest has a thousandth of the field for its standard deviation.
    angles = np.linspace(-0.8, 0.8, 40_001)[:, None, None]
    density = log_density(angles, MOMENTS)
    expected = -np.trapezoid(np.exp(density) * density, angles, axis=0).sum(axis=-1)
    np.testing.assert_allclose(GAUSSIAN.entropy(MOMENTS), expected, rtol=2e-3)
    widest = GAUSSIAN.entropy(jnp.array([[0.0, 50.0]] * 2))
    np.testing.assert_allclose(widest, 2 * np.log(1.6), atol=0.05)


def test_gaussian_density_is_one_over_the_field():
    axis = jnp.linspace(-0.8, 0.8, 801)
    looks = jnp.stack(jnp.meshgrid(axis, axis), axis=-1)
    density = np.exp(GAUSSIAN.log_prob(MOMENTS[0], looks))
    np.testing.assert_allclose(np.trapezoid(np.trapezoid(density, axis), axis), 1, atol=1e-3)


def test_gaussian_samples_lie_in_the_field_and_follow_the_density():
    drawn = np.asarray(GAUSSIAN.sample(jax.random.key(1), jnp.broadcast_to(MOMENTS, (5000, 2, 2, 2))))
    assert np.abs(drawn).max() <= np.float32(0.8)
    share = cumulated(drawn, MOMENTS)
    for place in np.ndindex(2, 2):
        assert stats.kstest(share[:, *place], "uniform").pvalue > 1e-3
    np.testing.assert_allclose(GAUSSIAN.mode(MOMENTS), 0.8 * np.tanh(MOMENTS[..., 0]), rtol=1e-6)


def test_gaussian_is_fitted_to_looks_by_their_likelihood():
    """Imitation: the mean and the spread of azimuths 0.3 +- 0.05 and elevations -0.4 +- 0.1."""
    looks = jnp.array([0.3, -0.4]) + jnp.array([0.05, 0.1]) * jax.random.normal(jax.random.key(2), (500, 2))
    adam = optax.adam(0.05)

    def step(carry, _):
        logits, state = carry
        gradient = jax.grad(lambda logits: -GAUSSIAN.log_prob(logits, looks).mean())(logits)
        change, state = adam.update(gradient, state)
        return (optax.apply_updates(logits, change), state), None

    start = jnp.zeros((2, 2))
    (logits, _), _ = jax.jit(lambda carry: jax.lax.scan(step, carry, length=300))((start, adam.init(start)))
    np.testing.assert_allclose(GAUSSIAN.mode(logits), [0.3, -0.4], atol=0.02)
    np.testing.assert_allclose(moments(logits)[1], [0.05, 0.1], atol=0.01)


def test_gaussian_gradients_are_finite_wherever_the_action_is():
    for logits in (*MOMENTS, jnp.array([[9.0, -30.0], [-9.0, 30.0]])):
        for angle in (-0.8, 0.0, 0.8):
            action = jnp.array([angle, -angle])
            gradients = jax.grad(lambda at: GAUSSIAN.log_prob(at, action) + GAUSSIAN.entropy(at))(logits)  # noqa: B023
            assert np.all(np.isfinite(gradients))


@each
def test_on_the_grid_actions_are_the_angles_of_the_same_looks(distribution, shape):
    on_grid, angle = OnGrid(distribution, GRID, PARAMS), np.array([-0.8, 0.0, 0.8], np.float32)
    logits = 2 * jax.random.normal(jax.random.key(4), (40, *shape))
    key = jax.random.key(5)
    pairs, actions = distribution.sample(key, logits), on_grid.sample(key, logits)
    assert actions.dtype == jnp.float32
    np.testing.assert_allclose(actions, angle[np.asarray(pairs)], atol=1e-7)
    np.testing.assert_array_equal(on_grid.log_prob(logits, actions), distribution.log_prob(logits, pairs))
    np.testing.assert_array_equal(on_grid.entropy(logits), distribution.entropy(logits))
    np.testing.assert_allclose(on_grid.mode(logits), angle[np.asarray(distribution.mode(logits))], atol=1e-7)


def test_what_a_rule_does_is_an_action_on_the_grid():
    """Imitation: the log-probability of a rule's angles is that of its look, azimuth first."""
    logits = jnp.log(jnp.arange(1.0, 1 + L * L) / 45)
    actions = jax.vmap(to_action, in_axes=(0, None, None))(jnp.arange(L * L), GRID, PARAMS)
    found = OnGrid(JOINT, GRID, PARAMS).log_prob(jnp.broadcast_to(logits, (L * L, L * L)), actions)
    np.testing.assert_allclose(found, logits, atol=1e-6)
