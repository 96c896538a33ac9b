"""Whose rounding it is: updates of far tracks against the same in 80-bit arithmetic.

Between scans 20 s apart the variance of a new aircraft's track grows a hundredfold and shrinks
again in the update, and S holds radians beside metres. Stone Soup inverts it as it stands.
"""

import jax
import numpy as np
import pytest

from jaxtrack import Params, kalman, tracker
from jaxtrack.models import constant_velocity
from reference.components import noise_covariance
from reference.opensky import Options, tracker_params
from reference.parity.compare import covariance_error, cross_covariance_error, mean_error
from reference.parity.scenes import (
    AHEAD,
    padded,
    random_covariances,
    random_means,
    spherical,
    track_list,
    unit_vectors,
)
from reference.pipeline import StoneSoupTracker

LONG = np.longdouble
CENTRE_MEAN, CENTRE_COVARIANCE, OTHER = LONG(-7), LONG(-4.25), LONG(2) / 3
"""Weights of the sigma points for alpha = 0.5, beta = 2, kappa = -3; their spread is sqrt(0.75)."""


def long_cholesky(matrix):
    factor = np.zeros_like(matrix)
    for j in range(len(matrix)):
        factor[j, j] = np.sqrt(matrix[j, j] - np.sum(factor[j, :j] ** 2))
        for i in range(j + 1, len(matrix)):
            factor[i, j] = (matrix[i, j] - np.sum(factor[i, :j] * factor[j, :j])) / factor[j, j]
    return factor


def long_inverse(matrix):
    """Inverse of `[3, 3]` by cofactors, scaled to ones on the diagonal."""
    scale = 1 / np.sqrt(np.diag(matrix))
    a = matrix * np.outer(scale, scale)
    cofactors = np.stack([np.cross(a[1], a[2]), np.cross(a[2], a[0]), np.cross(a[0], a[1])], axis=-1)
    return cofactors / (a[0] @ cofactors[:, 0]) * np.outer(scale, scale)


def long_update(mean, covariance, detection, params):
    """Prediction and unscented update of one track, far from where angles wrap."""
    F, Q = (np.asarray(a).astype(LONG) for a in constant_velocity(params.time_step, params.process_noise))
    mean, covariance = F @ mean.astype(LONG), F @ covariance.astype(LONG) @ F.T + Q
    columns = np.sqrt(LONG(0.75)) * long_cholesky(covariance).T
    offsets = np.concatenate([np.zeros((1, 6), LONG), columns, -columns])
    x, y, z = (mean + offsets)[:, 0::2].T
    ground = np.hypot(x, y)
    Z = np.stack([np.arctan2(z, ground), np.arctan2(y, x), np.hypot(ground, z)], axis=-1)
    weights = np.array([CENTRE_MEAN] + [OTHER] * 12)
    angles = np.arctan2(weights @ np.sin(Z[:, :2]), weights @ np.cos(Z[:, :2]))
    expected = np.append(angles, weights @ Z[:, 2])
    D = Z - expected
    weights[0] = CENTRE_COVARIANCE
    S = (weights[:, None] * D).T @ D + noise_covariance(params).astype(LONG)
    K = (weights[:, None] * offsets).T @ D @ long_inverse(S)
    return mean + K @ (detection.astype(LONG) - expected), covariance - K @ S @ K.T


NEEDS_LONG = pytest.mark.skipif(
    np.finfo(LONG).eps > 1e-18, reason="long double is no longer than double here"
)


@NEEDS_LONG
def test_stone_soup_rounds_more_than_we_do():
    rng = np.random.default_rng(0)
    params = tracker_params(Options(path=None), 20.0)
    places = unit_vectors(rng.uniform(-2.5, 2.5, 12), rng.uniform(0, 0.2, 12))
    places *= rng.uniform(50e3, 300e3, (12, 1))
    mean = np.zeros((12, 6))
    mean[:, 0::2] = places
    covariance = np.broadcast_to(np.diag([150.0**2, 200.0**2] * 3), (12, 6, 6)).copy()
    detections = spherical(places) + rng.normal(0, [0.003, 0.003, 500.0], (12, 3))

    largest = {"ours": 0.0, "theirs": 0.0}
    step = jax.jit(tracker.step)
    for n in range(12):
        tracks = track_list(mean[n : n + 1], covariance[n : n + 1])
        detection = padded(detections[n : n + 1], 1)
        ours, info = step(tracks, detection, params.time_step, 1, params)
        oracle = StoneSoupTracker(params, intermediates=False)
        oracle.load(tracks, 0)
        theirs = oracle.step(detection.value, detection.active)
        assert info.associated[0] == theirs.associated[0, 0] == 0
        true_mean, true_covariance = long_update(mean[n], covariance[n], detections[n], params)
        for side, got in (
            ("ours", (ours.mean[0], ours.covariance[0])),
            ("theirs", (theirs.live[0, 0].mean, theirs.live[0, 0].covariance)),
        ):
            off = (
                mean_error(np.asarray(got[0]), true_mean, true_covariance),
                covariance_error(np.asarray(got[1]), true_covariance),
            )
            largest[side] = max(largest[side], *off)
    assert largest["ours"] < 1e-11
    assert 10 * largest["ours"] < largest["theirs"] < 1e-8


def long_cubature(mean, covariance, params):
    """Cubature transform of one track: S, and the covariance `[6, 3]` between state and detection."""
    columns = np.sqrt(LONG(6)) * long_cholesky(covariance.astype(LONG)).T
    offsets = np.concatenate([columns, -columns])
    x, y, z = (mean.astype(LONG) + offsets)[:, 0::2].T
    Z = np.stack([np.arctan2(z, np.hypot(x, y)), np.arctan2(y, x), np.sqrt(x**2 + y**2 + z**2)], axis=-1)
    angles = np.arctan2(np.sin(Z[:, :2]).mean(axis=0), np.cos(Z[:, :2]).mean(axis=0))
    expected = np.append(angles, Z[:, 2].mean())
    D = Z - expected
    left = D.mean(axis=0)
    of_means = np.outer(expected, left)
    S = D.T @ D / 12 + of_means + of_means.T + noise_covariance(params).astype(LONG)
    return S, offsets.T @ D / 12 + np.outer(mean, left)


@NEEDS_LONG
def test_cubature_keeps_its_digits_far_away(x64):
    """What circular means leave is next to nothing, but is multiplied by the position."""
    rng, count = np.random.default_rng(0), 30
    params = Params(elevation_sigma=2e-4, bearing_sigma=2e-4)
    mean = random_means(rng, count, AHEAD, distance=(10e3, 20e3))
    covariance = random_covariances(rng, count)
    ours = jax.jit(kalman.predict_detections_cubature)(track_list(mean, covariance), params)
    largest = 0.0
    for n in range(count):
        S, C = long_cubature(mean[n], covariance[n], params)
        sigma, sigma_detection = np.sqrt(np.diag(covariance[n])), np.sqrt(np.diag(S))
        largest = max(
            largest,
            covariance_error(ours.covariance[n], S),
            cross_covariance_error(ours.cross_covariance[n], C, sigma, sigma_detection),
        )
    assert largest < 1e-11  # 80 bits are good to 2e-12 themselves, as they take the mean of the differences
