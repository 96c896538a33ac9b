"""Detections converted to positions: a plain Kalman filter in numpy beside ours."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxtrack import NO_DETECTION, Detections, Params, StaticParams, converted, kalman, tracker
from jaxtrack.association import MEASURES
from jaxtrack.models import elevation_bearing_range

PARAMS = Params()
step = jax.jit(tracker.step, static_argnames="static")
convert, update = jax.jit(converted.convert), jax.jit(converted.update)
measured = jax.jit(lambda *given: converted.distances(*given[:2], MEASURES["mahalanobis"], given[2]))
MEANS = np.array([[3000.0, 5.0, 400.0, -3.0, 200.0, 1.0], [-2000.0, 0.0, 1e-3, 9.0, 500.0, 0.0]])
pytestmark = pytest.mark.usefixtures("quick_compilation")

H = np.zeros((3, 6))
H[[0, 1, 2], [0, 2, 4]] = 1


@pytest.fixture
def tracks(tracks_at):
    return tracks_at(MEANS, 3)


def seen(offset):
    return Detections.from_values(elevation_bearing_range(jnp.asarray(MEANS + offset)))


def test_noise_grows_across_the_line_of_sight(x64):
    ahead = Detections.from_values([[0.0, 0.0, 1000.0], [0.0, 0.0, 4000.0]])
    positions = convert(ahead, PARAMS)
    np.testing.assert_allclose(positions.value, [[1000, 0, 0], [4000, 0, 0]])
    sigmas = np.array([[5, 1000 * 2e-3, 1000 * 2e-3], [5, 4000 * 2e-3, 4000 * 2e-3]])
    np.testing.assert_allclose(positions.noise, [np.diag(row**2) for row in sigmas], atol=1e-12)


def test_distance_and_update_by_hand(x64, tracks):
    positions = convert(seen([4.0, 0, -3.0, 0, 2.0, 0]), PARAMS)
    expected = kalman.predict_positions(tracks, PARAMS)
    distances = measured(expected, positions, PARAMS)
    updated = update(tracks, expected, positions, jnp.array([0, 1, NO_DETECTION]))
    for slot in range(2):
        P, R, z = (np.asarray(leaf[slot]) for leaf in (tracks.covariance, positions.noise, positions.value))
        S, y = H @ P @ H.T + R, z - H @ MEANS[slot]
        K = P @ H.T @ np.linalg.inv(S)
        np.testing.assert_allclose(distances[slot, slot], np.sqrt(y @ np.linalg.solve(S, y)), rtol=1e-9)
        np.testing.assert_allclose(updated.mean[slot], MEANS[slot] + K @ y, rtol=1e-10)
        np.testing.assert_allclose(updated.covariance[slot], P - K @ S @ K.T, rtol=1e-9, atol=1e-9)
    np.testing.assert_array_equal(updated.mean[2], tracks.mean[2])


def test_metres_are_not_wrapped(tracks):
    """A residual of 10 m is no angle; nor is there a seam of bearings behind the radar."""
    static = StaticParams(filter="converted")
    after, info = step(tracks, seen([10.0, 0, 10.0, 0, 0, 0]), 1e-6, 1, PARAMS, static=static)
    np.testing.assert_array_equal(info.associated, [0, 1, NO_DETECTION])
    assert np.all(after.mean[:2, [0, 2]] - MEANS[:, [0, 2]] > 1.0)
