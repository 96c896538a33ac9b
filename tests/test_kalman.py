"""The filter against the textbook, written out in numpy, and its linear algebra against numpy's."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from jaxtrack import Detections, Params, kalman
from jaxtrack import params as params_module
from jaxtrack.models import constant_velocity

MEANS = np.array([[3000.0, 10, 900, -5, 1200, 3], [-2000, 0, 5, 40, -600, 9], [1500, -7, -1500, 1, 20, 4]])
predict = jax.jit(kalman.predict)
predict_detections = jax.jit(kalman.predict_detections)


@jax.jit
def filter_once(tracks, detections, associated, params):
    expected = kalman.predict_detections(tracks, params)
    return expected, kalman.update(tracks, expected, detections, associated)


def spd(seed, size, sigmas=1.0):
    root = np.random.default_rng(seed).normal(size=(size, size))
    return (root @ root.T + 0.1 * np.eye(size)) * sigmas * np.reshape(sigmas, (-1, 1))


def textbook_measure(states):
    x, y, z = np.moveaxis(np.asarray(states)[..., 0::2], -1, 0)
    return np.stack([np.arctan2(z, np.hypot(x, y)), np.arctan2(y, x), np.sqrt(x**2 + y**2 + z**2)], -1)


def textbook_unscented(mean, P, params):
    """Unscented transform as in Wan and van der Merwe (2000), angles averaged on the circle."""
    n = 6
    lam = params.alpha**2 * (n + params.kappa) - n
    root = np.linalg.cholesky((n + lam) * P)
    points = np.vstack([mean, mean + root.T, mean - root.T])
    w_mean = np.full(13, 1 / (2 * (n + lam)))
    w_mean[0] = lam / (n + lam)
    w_cov = w_mean.copy()
    w_cov[0] += 1 - params.alpha**2 + params.beta
    Z = textbook_measure(points)
    z = np.append(np.angle(w_mean @ np.exp(1j * Z[:, :2])), w_mean @ Z[:, 2])
    D = Z - z
    D[:, :2] = np.angle(np.exp(1j * D[:, :2]))
    R = np.diag([params.elevation_sigma, params.bearing_sigma, params.range_sigma]) ** 2
    return z, (w_cov * D.T) @ D + R, (w_cov * (points - mean).T) @ D


def test_prediction_is_the_textbooks(tracks_at, x64):
    params = Params(process_noise=2.0)
    tracks = tracks_at(MEANS, 4, age=jnp.array([0, 4, 7, 0]), updated_by=jnp.array([1, -1, 0, -1]))
    tracks = tracks.replace(covariance=tracks.covariance.at[0].set(spd(1, 6, 30.0)))
    predicted = predict(tracks, 0.4, params)
    F, Q = (np.asarray(matrix) for matrix in constant_velocity(0.4, 2.0))
    for row in range(3):
        np.testing.assert_allclose(predicted.mean[row], F @ MEANS[row], rtol=1e-14)
        expected = F @ np.asarray(tracks.covariance[row]) @ F.T + Q
        np.testing.assert_allclose(predicted.covariance[row], expected, rtol=1e-13)
    np.testing.assert_array_equal(predicted.updated_by, [-1] * 4)
    np.testing.assert_array_equal(predicted.age[:3], [1, 5, 8])
    np.testing.assert_array_equal(predicted.active, tracks.active)


@pytest.mark.parametrize("numbers", [{}, {"alpha": 1.0, "beta": 0.5, "kappa": 1.0}])
def test_expected_detections_are_the_textbooks_unscented_transform(numbers, tracks_at, x64):
    params = Params(**numbers)
    # Far enough from Gaussian that every weight matters.
    tracks = tracks_at(MEANS, 3, position_sigma=150.0)
    expected = predict_detections(tracks, params)
    for row in range(3):
        z, S, C = textbook_unscented(MEANS[row], np.asarray(tracks.covariance[row]), params)
        np.testing.assert_allclose(expected.mean[row], z, rtol=1e-10)
        np.testing.assert_allclose(expected.covariance[row], S, rtol=1e-8, atol=1e-10)
        np.testing.assert_allclose(expected.cross_covariance[row], C, rtol=1e-8, atol=1e-8)


def textbook_jacobian(state):
    """Derivative `[3, 6]` of elevation, bearing and range by the state."""
    x, y, z = state[0::2]
    ground, distance = np.hypot(x, y), np.sqrt(x**2 + y**2 + z**2)
    H = np.zeros((3, 6))
    H[0, 0::2] = np.array([-x * z / ground, -y * z / ground, ground]) / distance**2
    H[1, 0::2] = np.array([-y, x, 0]) / ground**2
    H[2, 0::2] = state[0::2] / distance
    return H


def test_where_the_measurement_is_linear_the_filter_is_the_textbooks_kalman_filter(tracks_at, x64):
    # Within a centimetre at kilometres the measurement is linear to about 1e-5 of the spread,
    # and the noise is as small, so that the gain is neither 0 nor 1.
    params = Params(elevation_sigma=3e-6, bearing_sigma=5e-6, range_sigma=0.01)
    R = np.diag([3e-6, 5e-6, 0.01]) ** 2
    P = spd(3, 6, 0.01)
    tracks = tracks_at(MEANS, 3).replace(covariance=jnp.asarray(np.stack([P, 2 * P, 3 * P])))
    innovation = np.array([4e-6, -3e-6, 0.02])
    detections = Detections.from_values(textbook_measure(MEANS) + innovation)
    expected, updated = filter_once(tracks, detections, jnp.array([0, 1, 2]), params)
    for row in range(3):
        H, prior = textbook_jacobian(MEANS[row]), (row + 1) * P
        S = H @ prior @ H.T + R
        K = prior @ H.T @ np.linalg.inv(S)
        scale = np.sqrt(np.diag(S))
        relative = np.asarray(expected.covariance[row]) / np.outer(scale, scale)
        np.testing.assert_allclose(relative, S / np.outer(scale, scale), atol=1e-5)
        np.testing.assert_allclose(expected.mean[row], textbook_measure(MEANS[row]), rtol=1e-8)
        np.testing.assert_allclose(updated.mean[row] - MEANS[row], K @ innovation, rtol=1e-3, atol=1e-6)
        posterior = (np.eye(6) - K @ H) @ prior
        np.testing.assert_allclose(updated.covariance[row], posterior, atol=1e-5 * np.trace(P))


def test_tracks_without_a_detection_keep_their_prediction(tracks_at, params, x64):
    tracks = tracks_at(MEANS, 3)
    detections = Detections.from_values(textbook_measure(MEANS[:2]))
    _, updated = filter_once(tracks, detections, jnp.array([-1, 1, -1]), params)
    np.testing.assert_array_equal(updated.updated_by, [-1, 1, -1])
    for row in (0, 2):
        np.testing.assert_array_equal(updated.mean[row], tracks.mean[row])
        np.testing.assert_array_equal(updated.covariance[row], tracks.covariance[row])
    assert float(jnp.trace(updated.covariance[1])) < float(jnp.trace(tracks.covariance[1]))


def test_an_innovation_across_the_rear_is_small(tracks_at, params, x64):
    # The track lies at bearing pi - 0.001, the detection at -pi + 0.001: 0.002 further left.
    behind = [3000 * np.cos(np.pi - 0.001), 0, 3000 * np.sin(np.pi - 0.001), 0, 0, 0]
    detections = Detections.from_values([[0.0, -np.pi + 0.001, 3000.0]] * 3)
    expected, updated = filter_once(tracks_at([behind] * 3, 3), detections, jnp.arange(3), params)
    np.testing.assert_allclose(expected.mean[0, 1], np.pi - 0.001, atol=1e-6)
    # Both variances are (10 m / 3000 m)^2 and (2 mrad)^2: the gain is 0.735, the way 6 m.
    gain = (1 / 300) ** 2 / ((1 / 300) ** 2 + 0.002**2)
    np.testing.assert_allclose(updated.mean[0, 2], 3 - gain * 6, atol=1e-2)


@given(seed=st.integers(0, 10_000), scale=st.sampled_from([1.0, 30.0, 300.0]))
def test_updates_keep_covariances_symmetric_positive_and_smaller(tracks_at, params, x64, seed, scale):
    tracks = tracks_at(MEANS, 3)
    covariances = np.stack([spd(seed + row, 6, scale * np.ones(6)) for row in range(3)])
    tracks = tracks.replace(covariance=jnp.asarray(covariances))
    detections = Detections.from_values(textbook_measure(MEANS))
    _, updated = filter_once(tracks, detections, jnp.arange(3), params)
    P = np.asarray(updated.covariance)
    np.testing.assert_allclose(P, P.swapaxes(-1, -2), atol=1e-10 * scale**2)
    for row in range(3):
        assert np.linalg.eigvalsh(P[row]).min() >= -1e-9 * np.trace(P[row])
        shrinkage = covariances[row] - P[row]
        assert np.linalg.eigvalsh(shrinkage).min() >= -1e-9 * np.trace(covariances[row])


def test_single_precision_agrees_with_double(tracks_at, params, x64):
    tracks = tracks_at(MEANS, 3, position_sigma=5.0)
    detections = Detections.from_values(textbook_measure(MEANS) + np.array([1e-3, -1e-3, 4.0]))
    single = jax.tree.map(
        lambda leaf: leaf.astype(jnp.float32) if leaf.dtype == jnp.float64 else leaf, (tracks, detections)
    )
    _, double_result = filter_once(tracks, detections, jnp.arange(3), params)
    _, single_result = filter_once(*single, jnp.arange(3), params)
    np.testing.assert_allclose(single_result.mean, double_result.mean, atol=2e-2)
    np.testing.assert_allclose(single_result.covariance, double_result.covariance, rtol=2e-2, atol=0.05)


def test_the_extended_filter_is_the_textbooks(tracks_at, x64):
    tracks = tracks_at(MEANS, 3)
    tracks = tracks.replace(covariance=jnp.asarray(np.stack([spd(seed, 6, 15.0) for seed in range(3)])))
    expected = jax.jit(kalman.predict_detections_extended)(tracks, Params())
    R = np.diag([2e-3, 2e-3, 5.0]) ** 2
    for row in range(3):
        H, P = textbook_jacobian(MEANS[row]), np.asarray(tracks.covariance[row])
        np.testing.assert_allclose(expected.mean[row], textbook_measure(MEANS[row]), rtol=1e-12)
        np.testing.assert_allclose(expected.covariance[row], H @ P @ H.T + R, rtol=1e-9, atol=1e-15)
        np.testing.assert_allclose(expected.cross_covariance[row], P @ H.T, rtol=1e-9, atol=1e-12)


def textbook_cubature(mean, P):
    """Cubature transform as in Arasaratnam and Haykin (2009), angles averaged on the circle, without R."""
    root = np.sqrt(6) * np.linalg.cholesky(P)
    points = np.vstack([mean + root.T, mean - root.T])
    Z = textbook_measure(points)
    z = np.append(np.angle(np.exp(1j * Z[:, :2]).mean(axis=0)), Z[:, 2].mean())
    D = Z - z
    D[:, :2] = np.angle(np.exp(1j * D[:, :2]))
    return z, D.T @ D / 12, (points - mean).T @ D / 12


def test_expected_detections_are_the_textbooks_cubature_transform(tracks_at, x64):
    """But for what circular means leave, a thousandth of a sigma at these widths."""
    tracks = tracks_at(MEANS, 3, position_sigma=60.0)
    expected = jax.jit(kalman.predict_detections_cubature)(tracks, Params())
    R = np.diag([2e-3, 2e-3, 5.0]) ** 2
    for row in (0, 2):  # the other lies on the seam of bearings
        z, S, C = textbook_cubature(MEANS[row], np.asarray(tracks.covariance[row]))
        np.testing.assert_allclose(expected.mean[row], z, rtol=1e-10)
        sigma = np.sqrt(np.diag(S + R))
        np.testing.assert_allclose((expected.covariance[row] - R - S) / np.outer(sigma, sigma), 0, atol=2e-3)
        scale = np.outer(np.sqrt(np.diag(tracks.covariance[row])), sigma)
        np.testing.assert_allclose((expected.cross_covariance[row] - C) / scale, 0, atol=2e-3)


@pytest.mark.usefixtures("quick_compilation")
@pytest.mark.parametrize("name", ["extended", "cubature", "converted"])
def test_every_filter_in_single_precision(name, tracks_at):
    predict_as = jax.jit(kalman.FILTERS[name])
    single = jax.device_get(predict_as(tracks_at(MEANS, 3), Params()))
    assert single.covariance.dtype == np.float32
    with jax.enable_x64(True):
        double = jax.device_get(predict_as(tracks_at(MEANS, 3), Params()))
    sigma = np.sqrt(np.diagonal(double.covariance, axis1=1, axis2=2))
    np.testing.assert_allclose((single.mean - double.mean) / sigma, 0, atol=2e-3)
    scale = sigma[:, :, None] * sigma[:, None]
    np.testing.assert_allclose((single.covariance - double.covariance) / scale, 0, atol=2e-3)


def test_every_filter_can_be_asked_for_by_name():
    assert tuple(kalman.FILTERS) == params_module.FILTERS
