"""Truths: where they are born, how they move, and how recordings are replayed."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxtrack import Params, StaticParams, Truths
from jaxtrack.models import constant_velocity, spherical
from jaxtrack.truth import initiate_truths, process_noise_factor, propagate_truths
from jaxtrack.types import position, velocity

MANY = StaticParams(num_truths=4000)
initiate = jax.jit(initiate_truths, static_argnums=1)
propagate = jax.jit(propagate_truths)


@pytest.fixture(scope="module")
def born(params):
    return initiate(jax.random.key(0), MANY, params)


def test_all_truths_are_born_alive_within_the_field(born, params):
    elevation, azimuth, distance = np.moveaxis(np.asarray(spherical(position(born.state))), -1, 0)
    assert bool(jnp.all(born.alive))
    for angle in (azimuth, elevation):
        assert np.all(np.abs(angle) <= params.field_limit * (1 + 1e-6))
        # Uniform on (-limit, limit): mean 0, standard deviation limit/sqrt(3); 5 standard errors.
        assert abs(angle.mean()) < 5 * params.field_limit / np.sqrt(3 * MANY.num_truths)
        np.testing.assert_allclose(angle.std(), params.field_limit / np.sqrt(3), rtol=0.05)
    assert np.all((distance > params.min_range * 0.999) & (distance < params.max_range * 1.001))
    np.testing.assert_allclose(distance.mean(), (params.min_range + params.max_range) / 2, rtol=0.05)
    assert abs(np.corrcoef(azimuth, elevation)[0, 1]) < 5 / np.sqrt(MANY.num_truths)


def test_initial_velocities_are_normal_on_each_axis(born, params):
    covariance = np.cov(np.asarray(velocity(born.state)).T)
    np.testing.assert_allclose(covariance / params.truth_velocity_sigma**2, np.eye(3), atol=0.12)


def test_equal_keys_give_equal_truths_and_others_do_not(static, params):
    first, again, other = (initiate(jax.random.key(seed), static, params) for seed in (1, 1, 2))
    np.testing.assert_array_equal(first.state, again.state)
    assert not np.any(np.asarray(first.state) == np.asarray(other.state))


def test_the_noise_factor_is_the_root_of_one_axis_of_Q(x64):
    _, Q = constant_velocity(0.3, 2.0)
    factor = process_noise_factor(0.3, 2.0)
    np.testing.assert_allclose(factor @ factor.T, Q[:2, :2], rtol=1e-13)


def test_the_spread_of_moving_truths_is_Q():
    count, params = MANY.num_truths, Params(time_step=0.5, truth_process_noise=3.0)
    truths = Truths(state=jnp.zeros((count, 6)), alive=jnp.ones(count, dtype=bool))
    noise = jax.random.normal(jax.random.key(3), (count, 3, 2))
    moved = propagate(truths, noise, 1, params)
    _, Q = constant_velocity(0.5, 3.0)
    scale = np.sqrt(np.outer(np.diag(Q), np.diag(Q)))
    # A sample correlation of n draws has a standard error of at most sqrt(2/n) = 0.022.
    np.testing.assert_allclose(np.cov(np.asarray(moved.state).T) / scale, Q / scale, atol=0.11)


def test_without_process_noise_truths_fly_exactly_straight():
    params = Params(time_step=0.5, truth_process_noise=0.0)
    truths = Truths(state=jnp.array([[1000.0, 8, -200, -4, 50, 2]]), alive=jnp.ones(1, dtype=bool))
    for step in range(1, 5):
        truths = propagate(truths, jnp.ones((1, 3, 2)), step, params)
    # Four steps of half a second.
    np.testing.assert_array_equal(truths.state, [[1016.0, 8, -208, -4, 54, 2]])


def test_motion_is_linear_in_the_noise_of_its_own_truth_and_axis(static):
    params = Params(time_step=0.5, truth_process_noise=3.0)
    truths = Truths(state=jnp.zeros((3, 6)), alive=jnp.ones(3, dtype=bool))
    noise = jnp.zeros((3, 3, 2)).at[1, 2].set(jnp.array([1.0, -2.0]))
    moved = np.asarray(propagate(truths, noise, 1, params).state)
    expected = np.linalg.cholesky(np.asarray(constant_velocity(0.5, 3.0)[1][:2, :2])) @ [1.0, -2.0]
    np.testing.assert_allclose(moved[1, 4:6], expected, rtol=1e-5)
    assert np.count_nonzero(moved) == 2


@pytest.fixture(scope="module")
def recording():
    recorded = np.arange(36, dtype=float).reshape(2, 3, 6)
    recorded[0, 1, 4] = np.nan
    recorded[1, 2] = np.nan
    return recorded


def test_recordings_replace_birth_and_motion(recording, static):
    params = Params(trajectories=jnp.asarray(recording))
    truths = initiate(jax.random.key(0), static, params)
    np.testing.assert_array_equal(truths.alive, [True, False, True])
    np.testing.assert_array_equal(truths.state[0], recording[0, 0])
    np.testing.assert_array_equal(truths.state[1], np.zeros(6))
    truths = propagate(truths, jnp.ones((3, 3, 2)), 1, params)
    np.testing.assert_array_equal(truths.alive, [True, True, False])
    np.testing.assert_array_equal(truths.state[:2], recording[1, :2])


def test_the_last_row_stays_after_the_end_of_a_recording(recording, static):
    params = Params(trajectories=jnp.asarray(recording))
    truths = initiate(jax.random.key(0), static, params)
    after = propagate(truths, jnp.zeros((3, 3, 2)), 7, params)
    np.testing.assert_array_equal(after.state[:2], recording[1, :2])
    np.testing.assert_array_equal(after.alive, [True, True, False])
