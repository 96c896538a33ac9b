"""Measurement prediction, Mahalanobis distance and update against UnscentedKalmanUpdater."""

import datetime
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from stonesoup.types.angle import Bearing, Elevation
from stonesoup.types.hypothesis import SingleHypothesis
from stonesoup.types.prediction import GaussianStatePrediction
from stonesoup.types.state import State

from jaxtrack import Detections, Params, association, kalman, models
from reference.components import build_components, measurement_model
from reference.parity.compare import (
    TOLERANCE,
    covariance_error,
    cross_covariance_error,
    distance_error,
    estimate_error,
    mean_error,
)
from reference.parity.scenes import AHEAD, BEHIND, UP, random_covariances, random_means, track_list
from reference.pipeline import estimate
from reference.translate import as_vector, to_detections

NOW = datetime.datetime(2000, 1, 1)
EXPECT = jax.jit(kalman.predict_detections)
UPDATE = jax.jit(kalman.update)
MEASURE = jax.jit(association.mahalanobis)
DIRECTIONS = pytest.mark.parametrize("towards", [AHEAD, BEHIND, UP], ids=["ahead", "behind", "up"])


def test_angles_wrap_and_fold_as_typed_angles():
    angles = np.concatenate([np.linspace(-12.0, 12.0, 2001), np.pi / 2 * np.arange(-7, 8)])
    np.testing.assert_allclose(
        models.wrap_bearing(angles), [float(Bearing(angle)) for angle in angles], atol=1e-14
    )
    np.testing.assert_allclose(
        models.fold_elevation(angles), [float(Elevation(angle)) for angle in angles], atol=1e-14
    )


@DIRECTIONS
def test_measurement_function_and_its_inverse(towards):
    mean = random_means(np.random.default_rng(2), 30, towards)
    theirs = measurement_model(Params())
    values = np.stack([as_vector(theirs.function(State(state))) for state in mean])
    np.testing.assert_allclose(models.elevation_bearing_range(mean), values, rtol=1e-12, atol=1e-12)
    detections = to_detections(values, np.ones(30, bool), 1, NOW, theirs)
    positions = [as_vector(theirs.inverse_function(detection))[0::2] for detection in detections]
    np.testing.assert_allclose(models.inverse_elevation_bearing_range(values), positions, atol=1e-8)


@DIRECTIONS
@pytest.mark.parametrize("scaling", [{}, {"alpha": 1.0, "beta": 1.0, "kappa": 0.0}], ids=["default", "other"])
def test_expected_detection(towards, scaling):
    rng = np.random.default_rng(3)
    params = Params(**scaling)
    parts = build_components(params)
    mean, covariance = random_means(rng, 30, towards), random_covariances(rng, 30)
    ours = EXPECT(track_list(mean, covariance), params)
    for slot in range(30):
        check_expected(ours, slot, parts, GaussianStatePrediction(mean[slot], covariance[slot], NOW))


def check_expected(ours, slot, parts, prediction):
    theirs = parts.updater.predict_measurement(prediction, parts.measurement_model)
    S, z = np.asarray(theirs.covar, float), as_vector(theirs.state_vector)
    assert mean_error(ours.mean[slot], z, S) <= TOLERANCE
    assert covariance_error(ours.covariance[slot], S) <= TOLERANCE
    sigma_state, sigma_detection = np.sqrt(np.diag(prediction.covar)), np.sqrt(np.diag(S))
    cross = np.asarray(theirs.cross_covar, float)
    assert (
        cross_covariance_error(ours.cross_covariance[slot], cross, sigma_state, sigma_detection) <= TOLERANCE
    )


@pytest.mark.parametrize("sigma", [60.0, 100.0, 200.0, 400.0])
def test_wide_prediction_close_to_the_radar(sigma):
    """The negative centre weight turns the circular mean by pi when sigma exceeds the range."""
    params = Params()
    mean = np.array([[100.0, 1.0, 3.0, 2.0, 20.0, -1.0]])
    covariance = np.diag([sigma**2, 4.0, sigma**2 / 9, 4.0, sigma**2 / 16, 4.0])[None]
    ours = EXPECT(track_list(mean, covariance), params)
    check_expected(ours, 0, build_components(params), GaussianStatePrediction(mean[0], covariance[0], NOW))
    assert (abs(ours.mean[0, 1]) > 3.0) == (sigma >= 200.0)


def test_predictions_all_around_the_radar():
    """Sigma points in all directions at once: residuals wrap and fold, S is often indefinite."""
    rng = np.random.default_rng(6)
    params = Params()
    parts = build_components(params)
    mean, covariance = 100.0 * rng.standard_normal((200, 6)), random_covariances(rng, 200)
    covariance *= rng.uniform(5, 30, (200, 1, 1)) ** 2
    ours = EXPECT(track_list(mean, covariance), params)
    size = np.array([1.0, 1.0, 100.0])  # rad, rad, m: an indefinite S has no sigmas
    for slot in range(200):
        prediction = GaussianStatePrediction(mean[slot], covariance[slot], NOW)
        theirs = parts.updater.predict_measurement(prediction, parts.measurement_model)
        z, S = as_vector(theirs.state_vector), np.asarray(theirs.covar, float)
        assert mean_error(ours.mean[slot], z, np.diag(size**2)) <= TOLERANCE
        assert cross_covariance_error(ours.covariance[slot], S, size, size) <= TOLERANCE
        cross, sigma = np.asarray(theirs.cross_covar, float), np.sqrt(np.diag(covariance[slot]))
        assert cross_covariance_error(ours.cross_covariance[slot], cross, sigma, size) <= TOLERANCE


def test_only_the_lower_triangle_is_read():
    """A covariance that rounding made asymmetric gives the same sigma points on both sides."""
    rng = np.random.default_rng(4)
    params = Params()
    mean, covariance = random_means(rng, 1, AHEAD), random_covariances(rng, 1)
    covariance = covariance * (1 + 1e-3 * np.triu(np.ones((6, 6)), 1))
    ours = EXPECT(track_list(mean, covariance), params)
    check_expected(ours, 0, build_components(params), GaussianStatePrediction(mean[0], covariance[0], NOW))


@DIRECTIONS
def test_distance_and_posterior(towards):
    """Also for detections far outside the gate, where angles wrap and fold."""
    rng = np.random.default_rng(5)
    params = Params()
    parts = build_components(params)
    mean, covariance = random_means(rng, 10, towards), random_covariances(rng, 10)
    value = np.stack(
        [rng.uniform(-1.55, 1.55, 10), rng.uniform(-np.pi, np.pi, 10), rng.uniform(10.0, 9000.0, 10)], axis=1
    )
    predicted = track_list(mean, covariance)
    expected = EXPECT(predicted, params)
    detections = Detections.from_values(value)
    distances = MEASURE(expected, detections, params)
    stone_soup = to_detections(value, np.ones(10, bool), 1, NOW, parts.measurement_model)
    for row in range(10):
        updated = UPDATE(predicted, expected, detections, jnp.full(10, row))
        for slot in range(10):
            theirs = GaussianStatePrediction(mean[slot], covariance[slot], NOW)
            check_posterior(updated, slot, parts, theirs, stone_soup[row])
            measured = parts.updater.predict_measurement(theirs, parts.measurement_model)
            distance = parts.measure(measured, stone_soup[row])
            assert distance_error(distances[slot, row], distance) <= TOLERANCE


def check_posterior(updated, slot, parts, prediction, detection):
    posterior = parts.updater.update(SingleHypothesis(prediction, detection))
    theirs = estimate(SimpleNamespace(state_vector=posterior.state_vector, covar=posterior.covar))
    # A detection thousands of sigmas away moves the mean by thousands of sigmas.
    moved = mean_error(theirs.mean, as_vector(prediction.state_vector), theirs.covariance)
    assert estimate_error(updated, slot, theirs) <= TOLERANCE * max(1.0, moved)
