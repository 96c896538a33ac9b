"""What the agent sees, by hand."""

import jax
import jax.numpy as jnp
import numpy as np

from jaxtrack import Params
from jaxtrack.observation import TRACK_FEATURES, covariance_norms, feature_scales, observe, track_features

# At range 13, to the left and up; the covariance of `tracks_at` is diag(100, 400, 100, ...).
MEAN = [3.0, 10.0, 4.0, -20.0, 12.0, 30.0]
NORM = np.sqrt(3 * 100.0**2 + 3 * 400.0**2)


def test_features_are_range_azimuth_elevation_velocity_and_norm(tracks_at):
    features = track_features(tracks_at(MEAN, 1))
    expected = [13, np.arctan(4 / 3), np.arctan(12 / 5), 10, -20, 30, NORM]
    np.testing.assert_allclose(features, [expected], rtol=1e-6)
    assert features.shape[1] == TRACK_FEATURES


def test_features_are_divided_by_the_numbers_of_the_scenario(tracks_at):
    params = Params(max_range=26.0, field_limit=0.5, prior_velocity_sigma=5.0, deletion_threshold=100.0)
    np.testing.assert_allclose(feature_scales(params), [26, 0.5, 0.5, 15, 15, 15, 100])
    observation = observe(tracks_at(MEAN, 1), jnp.zeros((2, 2)), params)
    expected = [0.5, 2 * np.arctan(4 / 3), 2 * np.arctan(12 / 5), 10 / 15, -20 / 15, 2, NORM / 100]
    np.testing.assert_allclose(observation["tracks"], [expected], rtol=1e-6)


def test_empty_slots_read_exactly_zero_whatever_they_hold(tracks_at, params):
    tracks = tracks_at([MEAN] * 3, 3).replace(active=jnp.array([False, True, False]))
    poisoned = tracks.replace(
        mean=tracks.mean.at[0].set(jnp.nan), covariance=tracks.covariance.at[2].set(jnp.inf)
    )
    observation = observe(poisoned, jnp.zeros((2, 2)), params)
    np.testing.assert_array_equal(observation["tracks"][jnp.array([0, 2])], np.zeros((2, 7)))
    np.testing.assert_array_equal(observation["mask"], [False, True, False])
    assert bool(jnp.all(observation["tracks"][1] != 0))


def test_variances_are_shown_where_they_are_asked_for(tracks_at):
    params = Params(deletion_threshold=100.0)
    tracks = tracks_at([MEAN] * 2, 2).replace(active=jnp.array([True, False]))
    observation = observe(tracks, jnp.zeros((2, 2)), params, with_variances=True)
    np.testing.assert_allclose(observation.pop("variances"), [[3.0, 12.0], [0.0, 0.0]], rtol=1e-6)
    plain = observe(tracks, jnp.zeros((2, 2)), params)
    jax.tree.map(np.testing.assert_array_equal, observation, plain)


def test_the_scan_map_is_shown_as_it_is(tracks_at, params):
    scan_map = jnp.array([[0.0, 0.25], [0.5, 1.0]])
    np.testing.assert_array_equal(observe(tracks_at(MEAN, 1), scan_map, params)["scan_map"], scan_map)


def test_the_covariance_norm_counts_every_entry(tracks_at):
    tracks = tracks_at(MEAN, 1).replace(covariance=jnp.arange(36.0).reshape(1, 6, 6))
    # 0^2 + 1^2 + ... + 35^2 = 35 * 36 * 71 / 6
    np.testing.assert_allclose(covariance_norms(tracks), [np.sqrt(14910)], rtol=1e-6)
