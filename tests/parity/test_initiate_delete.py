"""`lifecycle` against SimpleMeasurementInitiator and CovarianceBasedDeleter."""

import jax
import numpy as np
import pytest
from stonesoup.types.state import GaussianState
from stonesoup.types.track import Track

from jaxtrack import Params, lifecycle
from reference.components import EPOCH, build_components
from reference.parity.compare import TOLERANCE, mean_error
from reference.parity.scenes import detections_near, random_tracks, track_list
from reference.pipeline import StoneSoupTracker, estimate
from reference.translate import detection_index, to_detections

from .stepping import check_step

INITIATE = jax.jit(jax.vmap(lifecycle.initial_estimate, in_axes=(0, None)))
DELETE = jax.jit(lifecycle.delete_uncertain_tracks)
# The stock Jacobian is a forward difference with steps of about 1e-8 of a coordinate. Measured up to
# 86 degrees of elevation: 6e-4 of the covariance's norm. At 89.95 degrees it is wrong by up to 14 %.
STOCK_MEAN_TOLERANCE = 1e-2  # m
STOCK_COVARIANCE_TOLERANCE = 1e-3


def stone_soup_estimates(value, params, exact_jacobian):
    parts = build_components(params, exact_jacobian)
    detections = to_detections(value, np.ones(len(value), bool), 0, EPOCH, parts.measurement_model)
    tracks = parts.initiator.initiate(set(detections), EPOCH)
    ordered = sorted(tracks, key=lambda track: detection_index(track.hypothesis.measurement))
    return [estimate(track) for track in ordered]


def everywhere(rng, count):
    """Detections in all directions, among them axes, the seam at pi, and nearly overhead."""
    value = np.stack(
        [rng.uniform(-1.5, 1.5, count), rng.uniform(-np.pi, np.pi, count), rng.uniform(100, 1e4, count)],
        axis=1,
    )
    value[:6, 1] = [0.0, np.pi / 2, np.pi - 1e-9, -np.pi + 1e-9, -np.pi / 2, 1e-6]
    value[6:9, 0] = [0.0, 1.57, -1.57]
    return value


def test_initial_estimate():
    params = Params(prior_velocity_sigma=25.0, range_sigma=7.0)
    value = everywhere(np.random.default_rng(1), 60)
    mean, covariance = INITIATE(value, params)
    for row, theirs in enumerate(stone_soup_estimates(value, params, exact_jacobian=True)):
        assert mean_error(mean[row], theirs.mean, theirs.covariance) <= TOLERANCE
        # Close to the zenith the position covariance is near singular: a norm, not sigmas.
        size = np.linalg.norm(theirs.covariance)
        assert np.linalg.norm(covariance[row] - theirs.covariance) <= TOLERANCE * size


def test_initial_estimate_with_the_stock_jacobian():
    params = Params()
    value = everywhere(np.random.default_rng(2), 60)
    value = value[np.abs(value[:, 0]) <= 1.5]
    mean, covariance = INITIATE(value, params)
    worst = 0.0
    for row, theirs in enumerate(stone_soup_estimates(value, params, exact_jacobian=False)):
        np.testing.assert_allclose(mean[row], theirs.mean, atol=STOCK_MEAN_TOLERANCE, rtol=0)
        difference = np.linalg.norm(covariance[row] - theirs.covariance)
        worst = max(worst, difference / np.linalg.norm(theirs.covariance))
    # Exact and stock really differ: were they equal, the tolerance above would be for nothing.
    assert 1e-9 < worst <= STOCK_COVARIANCE_TOLERANCE


@pytest.mark.parametrize("trace", [4999.0, 5000.0, np.nextafter(5000.0, np.inf), 5001.0, np.nan])
def test_deletion_threshold_is_strict(trace):
    params = Params(deletion_threshold=5000.0)
    covariance = np.diag([1000.0, 500.0, 1000.0, 500.0, 1000.0, 500.0])
    covariance[0, 0] += trace - 4500.0
    covariance[0, 1] = covariance[1, 0] = 300.0
    assert np.trace(covariance) == trace or np.isnan(trace)
    tracks = DELETE(track_list(np.ones((1, 6)), covariance[None]), params)
    track = Track([GaussianState(np.ones(6), covariance)])
    theirs = build_components(params).deleter.check_for_deletion(track)
    assert tracks.active[0] == (not theirs)
    assert theirs == (trace > 5000.0)


def test_newborns_live_until_the_next_step():
    """A prior above the threshold: born, gone and born again from the next detection."""
    rng = np.random.default_rng(3)
    params = Params(deletion_threshold=1000.0, missed_distance=1e-6)
    tracks = random_tracks(rng, 0, max_tracks=20)
    value = detections_near(rng, random_tracks(rng, 1), params, count=1)
    lives = []
    for index in range(4):
        theirs, tracks, _ = check_step(tracks, value, params, index=index)
        lives.append((len(theirs.deleted), len(theirs.initiated)))
    assert lives == [(0, 1), (1, 1), (1, 1), (1, 1)]


def test_detection_of_a_deleted_track_is_consumed():
    """It updated a track that was deleted at once, and starts no new one."""
    rng = np.random.default_rng(4)
    params = Params(deletion_threshold=10.0, gate_threshold=50.0, missed_distance=50.0)
    tracks = random_tracks(rng, 4, max_tracks=20)
    value = detections_near(rng, tracks, params, count=4, sigmas=0.1)
    theirs, _, _ = check_step(tracks, value, params)
    assert len(theirs.deleted) == 4
    assert len(theirs.associated) >= 2
    assert len(theirs.initiated) == 4 - len(theirs.associated)


def test_rebirth_in_the_slot_of_a_deleted_track():
    """The slot is free at once; the new track has its own key."""
    rng = np.random.default_rng(5)
    params = Params(deletion_threshold=10.0)
    tracks = random_tracks(rng, 20, max_tracks=20)
    value = detections_near(rng, random_tracks(rng, 3, towards=(-0.8, -0.4)), params, count=3)
    theirs, after, info = check_step(tracks, value, params)
    assert len(theirs.deleted) == 20
    assert len(theirs.initiated) == info.initiated.sum() == 3
    assert np.all(after.birth_step[info.initiated] == 1)


def test_free_running_with_the_stock_initiator():
    """A hundred steps from the stock initiator's tracks: same decisions, its own tolerance."""
    rng = np.random.default_rng(6)
    params = Params(time_step=0.05)
    targets = random_tracks(rng, 4)
    exact, stock = StoneSoupTracker(params), StoneSoupTracker(params, exact_jacobian=False)
    for _ in range(100):
        value = detections_near(rng, targets, params, count=rng.integers(0, 4), sigmas=0.3)
        ours, theirs = exact.step(value), stock.step(value)
        assert ours.associated == theirs.associated
        assert ours.live.keys() == theirs.live.keys()
        for key, estimate_ in ours.live.items():
            np.testing.assert_allclose(estimate_.mean, theirs.live[key].mean, atol=STOCK_MEAN_TOLERANCE)
            np.testing.assert_allclose(
                np.linalg.norm(estimate_.covariance - theirs.live[key].covariance),
                0.0,
                atol=STOCK_COVARIANCE_TOLERANCE * np.linalg.norm(estimate_.covariance),
            )
