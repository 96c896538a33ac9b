"""A radar on a platform that flies ahead, against Stone Soup's tracker in the world's frame.

Stone Soup tracks in the frame of the world, in which the platform of every detection has its place;
ours in the platform's. Their tracks differ by the platform's own state, and by nothing else.
"""

import jax
import numpy as np
import pytest

from jaxtrack import Detections, Params, Tracks, models, tracker
from reference.components import build_components, measurement_model, time_of
from reference.translate import to_detections, to_tracks
from reference.truths import initial_states

SPEED, STEPS, TRUTHS = 250.0, 12, 4
NUMBERS = {"time_step": 0.5, "deletion_threshold": 1e6, "field_limit": 0.5}
SIGMAS = np.sqrt(np.diag(models.measurement_noise(Params())))


@pytest.fixture
def scans(x64):
    """Detections `[STEPS, TRUTHS, 3]` of truths that fly straight, from the place of the platform."""
    rng = np.random.default_rng(2)
    start = initial_states(rng, TRUTHS, Params(**NUMBERS))
    times = NUMBERS["time_step"] * np.arange(STEPS)
    seen = start[None, :, 0::2] + times[:, None, None] * start[:, 1::2]
    seen[..., 0] -= SPEED * times[:, None]
    exact = np.asarray(models.spherical(seen))
    return exact + SIGMAS * rng.standard_normal(exact.shape)


def test_tracks_in_the_frames_of_world_and_platform_are_the_same(scans):
    world, ours = Params(**NUMBERS), Params(**NUMBERS, platform_speed=SPEED)
    theirs = build_components(world).tracker()
    tracks, step = Tracks.empty(TRUTHS), jax.jit(tracker.step)
    for k, values in enumerate(scans):
        tracks, _ = step(tracks, Detections.from_values(values), ours.time_step, k, ours)
        model = measurement_model(world)
        model.translation_offset = np.array([[SPEED * k * ours.time_step], [0.0], [0.0]])
        detections = to_detections(values, np.ones(TRUTHS, dtype=bool), k, time_of(k, world), model)
        theirs.update_tracker(time_of(k, world), set(detections))
    found = to_tracks(theirs.tracks, STEPS - 1, TRUTHS, {})
    assert np.asarray(tracks.active).all()
    np.testing.assert_array_equal(found.birth_detection, tracks.birth_detection)
    platform = np.array([SPEED * (STEPS - 1) * ours.time_step, SPEED, 0, 0, 0, 0])
    np.testing.assert_allclose(tracks.mean, found.mean - platform, rtol=1e-7, atol=1e-5)
    np.testing.assert_allclose(tracks.covariance, found.covariance, rtol=1e-6, atol=1e-6)
