"""The Cramer-Rao bound by hand: a truth on the x axis, where the axes do not mix."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxtrack import Params, Truths, pcrb
from jaxtrack.lifecycle import initial_estimate

pytestmark = pytest.mark.usefixtures("quick_compilation")

# Range sigma 5 m; at 1000 m the angles' sigmas of 2 and 3 mrad are 2 m up and 3 m across.
PARAMS = Params(range_sigma=5.0, elevation_sigma=2e-3, bearing_sigma=3e-3, process_noise=0.0)
AHEAD = np.array([1000.0, 0, 0, 0, 0, 0])
path_bound = jax.jit(pcrb.path_bound)
bounds = jax.jit(pcrb.bounds)


def bound_of(times, position_variance=100.0, velocity_variance=0.0, alive=None, state=AHEAD, **kwargs):
    times = np.asarray(times, np.float32)
    alive = np.ones(len(times), dtype=bool) if alive is None else np.asarray(alive)
    prior = np.diag(np.array([position_variance, velocity_variance] * 3, np.float32))
    params = kwargs.pop("params", PARAMS)
    return path_bound(np.tile(state, (len(times), 1)), alive, times, prior, params, kwargs.pop("irf", 1.0))


def test_a_standing_truth_of_known_velocity_averages_its_measurements():
    bound = bound_of([0.0, 0.1, 0.3, 0.4])
    for step in range(4):
        variances = [1 / (1 / 100 + step / sigma**2) for sigma in (5, 3, 2)]
        np.testing.assert_allclose(np.diagonal(bound.covariance[step])[0::2], variances, rtol=1e-5)
        np.testing.assert_allclose(bound.position[step], np.sqrt(sum(variances)), rtol=1e-5)
    np.testing.assert_allclose(bound.velocity, 0.0, atol=1e-6)


def test_the_information_reduction_factor_weakens_every_measurement():
    half = bound_of([0.0, 0.1, 0.3], irf=0.5)
    full = bound_of([0.0, 0.1])
    np.testing.assert_allclose(half.covariance[2], full.covariance[1], rtol=1e-5, atol=1e-5)


def test_without_measurements_only_the_motion_counts():
    # P = F P F^T + Q over 2 s with q = 0.3: 100 + 2^2 * 4 + 0.3 * 8 / 3, and 4 + 0.3 * 2.
    params = PARAMS.replace(process_noise=0.3)
    bound = bound_of([0.0, 2.0], 100.0, 4.0, irf=0.0, params=params)
    np.testing.assert_allclose(bound.position[1], np.sqrt(3 * (100 + 16 + 0.8)), rtol=1e-6)
    np.testing.assert_allclose(bound.velocity, np.sqrt([3 * 4.0, 3 * 4.6]), rtol=1e-6)


def test_positions_over_time_bound_the_velocity():
    # x axis: prior 100 and 4, one measurement of variance 25 after 2 s.
    predicted = np.array([[100 + 16, 8], [8, 4]])
    expected = np.linalg.inv(np.linalg.inv(predicted) + np.diag([1 / 25, 0]))
    bound = bound_of([0.0, 2.0], 100.0, 4.0)
    np.testing.assert_allclose(bound.covariance[1, :2, :2], expected, rtol=1e-5)


def test_it_is_the_true_place_at_which_the_radar_measures():
    # On the y axis the range lies along y.
    bound = bound_of([0.0, 0.1], state=np.array([0, 0, 1000.0, 0, 0, 0]))
    variances = [1 / (1 / 100 + 1 / sigma**2) for sigma in (3, 5, 2)]
    np.testing.assert_allclose(np.diagonal(bound.covariance[1])[0::2], variances, rtol=1e-4)


def test_absent_steps_are_passed_over_in_one_prediction():
    times = [0.0, 0.1, 0.4, 0.5]
    gap = bound_of(times, 100.0, 900.0, alive=[True, False, True, True])
    without = bound_of([0.0, 0.4, 0.5], 100.0, 900.0)
    np.testing.assert_allclose(gap.covariance[np.array([0, 2, 3])], without.covariance, rtol=1e-6)
    late = bound_of(times, 100.0, 900.0, alive=[False, True, True, False])
    np.testing.assert_allclose(late.position[1], np.sqrt(300.0), rtol=1e-6)
    for absent in (gap.covariance[1], late.covariance[0], late.covariance[3], late.position[3]):
        assert not np.any(absent)


def test_a_record_is_bounded_truth_by_truth():
    alive = np.array([[1, 0, 0], [1, 1, 0], [1, 1, 0]], dtype=bool)
    states = np.tile(np.array([[3000.0, 0, 100, 0, 50, 0], [0, 9, 4000, 0, 900, 0], [np.nan] * 6]), (3, 1, 1))
    states[~alive] = np.nan
    times = np.array([0.0, 0.1, 0.2], np.float32)
    result = bounds(Truths(jnp.asarray(states), jnp.asarray(alive)), times, PARAMS)
    for row in range(2):
        first = int(alive[:, row].argmax())
        x, y, z = states[first, row, 0::2]
        detection = [np.arctan2(z, np.hypot(x, y)), np.arctan2(y, x), np.sqrt(x**2 + y**2 + z**2)]
        prior = jax.jit(initial_estimate)(jnp.array(detection), PARAMS)[1]
        np.testing.assert_allclose(result.covariance[first, row], prior, rtol=1e-4, atol=1e-3)
        alone = path_bound(states[:, row], alive[:, row], times, prior, PARAMS)
        np.testing.assert_allclose(result.position[:, row], alone.position, rtol=1e-5)
        np.testing.assert_allclose(result.velocity[:, row], alone.velocity, rtol=1e-5)
    # A truth that never lives has no bound, and no NaN either.
    assert not np.any(result.covariance[:, 2])
    assert np.all(np.isfinite(result.covariance))


def test_a_given_prior_is_used():
    truths = Truths(jnp.tile(AHEAD, (2, 1, 1)), jnp.ones((2, 1), dtype=bool))
    prior = jnp.diag(jnp.array([100.0, 0.0] * 3))[None]
    result = bounds(truths, jnp.array([0.0, 0.1]), PARAMS, prior, 1.0)
    np.testing.assert_allclose(result.position[:, 0], bound_of([0.0, 0.1]).position, rtol=1e-6)


def test_rounding_does_not_grow_over_a_long_path():
    steps = 400
    states = np.tile(np.array([700.0, -30, 430, -6, 940, -5]), (steps, 1))
    times = 0.005 * np.arange(steps)
    states[:, 0::2] += times[:, None] * states[:, 1::2]
    truths = Truths(states.astype(np.float32)[:, None], np.ones((steps, 1), dtype=bool))
    params = PARAMS.replace(process_noise=1.0)
    covariance = np.asarray(bounds(truths, times.astype(np.float32), params).covariance[-1, 0])
    sigma = np.sqrt(np.diagonal(covariance))
    np.testing.assert_allclose((covariance - covariance.T) / np.outer(sigma, sigma), 0.0, atol=1e-5)
