"""Teacher-forced steps: Stone Soup's state in, one step on both sides, all intermediates compared."""

import jax
import numpy as np
import pytest

from jaxtrack import Params
from reference.parity.scenes import AHEAD, BEHIND, UP, detections_near, random_tracks
from reference.pipeline import StoneSoupTracker

from .stepping import check_step

pytestmark = pytest.mark.usefixtures("quick_compilation")

# Measured: 2.7e-4 standard deviations at most over the scenes below.
FLOAT32_TOLERANCE = 1e-3
# Measured: 1.4e-7 at most here, away from the axes; see test_initiate_delete for elsewhere.
STOCK_JACOBIAN_TOLERANCE = 1e-5


@pytest.mark.parametrize("towards", [AHEAD, BEHIND, UP], ids=["ahead", "behind", "up"])
@pytest.mark.parametrize("seed", range(6))
def test_one_step(seed, towards):
    rng = np.random.default_rng(seed)
    params = Params(time_step=float(rng.choice([0.005, 0.05, 1.0])), deletion_threshold=900.0)
    tracks = random_tracks(rng, 6, towards, max_tracks=20)
    near = detections_near(rng, tracks, params, count=6)
    # Clutter in the opposite hemisphere: differences of elevations beyond a right angle are folded.
    far = np.array([[-1.4 * np.sign(towards[1]), 2.0, 800.0], [-0.9, rng.uniform(-3, 3), 5000.0]])
    check_step(tracks, np.concatenate([near, far]), params)


@pytest.mark.parametrize("towards", [AHEAD, BEHIND, UP], ids=["ahead", "behind", "up"])
def test_competition(towards):
    """Tracks so close that most detections are contested."""
    rng = np.random.default_rng(7)
    params = Params()
    contested = 0
    for _ in range(6):
        tracks = random_tracks(rng, 8, towards, max_tracks=20, spread=0.002, distance=(3000.0, 3030.0))
        theirs, _, _ = check_step(tracks, detections_near(rng, tracks, params, count=5), params)
        for key, expected in theirs.expected.items():
            nearest = np.nanargmin(expected.distances)
            contested += expected.admissible[nearest] and theirs.associated.get(key) != nearest
    assert contested >= 10


def test_empty_scan():
    rng = np.random.default_rng(8)
    theirs, _, _ = check_step(random_tracks(rng, 6, max_tracks=20), np.zeros((0, 3)), Params())
    assert not theirs.associated
    assert not theirs.initiated


def test_no_tracks():
    rng = np.random.default_rng(9)
    params = Params()
    value = detections_near(rng, random_tracks(rng, 6), params, count=8)
    nobody = random_tracks(rng, 0, max_tracks=20)
    theirs, _, _ = check_step(nobody, value, params)
    assert len(theirs.initiated) == 8


@pytest.mark.parametrize("count", [1, 100])
def test_number_of_tracks(count):
    rng = np.random.default_rng(count)
    params = Params()
    tracks = random_tracks(rng, count, max_tracks=104, spread=0.02)
    theirs, _, _ = check_step(tracks, detections_near(rng, tracks, params, count=10), params)
    assert theirs.associated


@pytest.mark.parametrize("free", [0, 1, 3])
def test_full_track_list(free):
    """Stone Soup has no capacity: ours drops the last of the new tracks, and counts them."""
    rng = np.random.default_rng(11)
    params = Params()
    tracks = random_tracks(rng, 20 - free, max_tracks=20)
    elsewhere = random_tracks(rng, 4, towards=(-0.5, -0.3))
    value = np.concatenate(
        [detections_near(rng, tracks, params, 3, sigmas=0.5), detections_near(rng, elsewhere, params, 4)]
    )
    theirs, _, info = check_step(tracks, value, params)
    assert theirs.associated
    assert info.num_dropped == len(theirs.initiated) - free > 0


def test_chain_from_the_oracles_own_states():
    """Sixty steps, each from the state that Stone Soup reached, with misses and clutter."""
    rng = np.random.default_rng(12)
    params = Params(time_step=0.2, deletion_threshold=4000.0)
    targets = random_tracks(rng, 5, max_tracks=20)
    oracle = StoneSoupTracker(params, intermediates=False)
    tracks = oracle.export(max_tracks=20)
    deleted = 0
    for _ in range(60):
        value = detections_near(rng, targets, params, count=rng.integers(0, 6), sigmas=0.3)
        clutter = detections_near(rng, random_tracks(rng, 1, spread=0.3), params, rng.integers(0, 2))
        value = np.concatenate([value, clutter])
        check_step(tracks, value, params, index=oracle.index)
        record = oracle.step(value)
        deleted += len(record.deleted)
        tracks = oracle.export(max_tracks=20, record=record)
    assert deleted > 5


@pytest.mark.parametrize("seed", range(4))
def test_stock_finite_difference_jacobian(seed):
    rng = np.random.default_rng(seed)
    params = Params()
    tracks = random_tracks(rng, 6, max_tracks=20)
    value = detections_near(rng, random_tracks(rng, 8), params, count=8)
    theirs, _, _ = check_step(tracks, value, params, exact_jacobian=False, tolerance=STOCK_JACOBIAN_TOLERANCE)
    assert theirs.initiated


@pytest.mark.parametrize("seed", range(6))
def test_float32(seed):
    """Single precision, as used for training, from the same numbers as double precision."""
    rng = np.random.default_rng(seed)
    params = Params(time_step=0.05)
    with jax.enable_x64(False):
        tracks = random_tracks(rng, 6, max_tracks=20)
        value = detections_near(rng, tracks, params, count=8).astype(np.float32)
        _, after, _ = check_step(tracks, value, params, tolerance=FLOAT32_TOLERANCE)
    assert after.mean.dtype == np.float32
