"""Teacher-forced: Stone Soup's state in, one step on both sides, every intermediate compared."""

import jax
import numpy as np
import pytest

from jaxtrack import Params, tracker
from reference.pipeline import StoneSoupTracker
from reference.translate import slot_keys
from tests.parity.compare import TOLERANCE, estimate_error, expected_error
from tests.parity.scenes import AHEAD, BEHIND, UP, detections_near, padded, random_tracks

STEP = jax.jit(tracker.step)


def check_step(tracks, value, params, capacity=12, tolerance=TOLERANCE, exact_jacobian=True):
    """One step on both sides from the same track list; returns Stone Soup's record and ours."""
    oracle = StoneSoupTracker(params, exact_jacobian)
    oracle.load(tracks, 0)
    detections = padded(value, capacity)
    theirs = oracle.step(detections.value, detections.active)
    after, info = jax.device_get(STEP(tracks, detections, params.time_step, 1, params))

    before = slot_keys(tracks)
    for slot, key in enumerate(before):
        if key is None:
            continue
        assert expected_error(info, slot, theirs.expected[key]) <= tolerance, f"slot {slot}: expected"
        assert info.associated[slot] == theirs.associated.get(key, -1), f"slot {slot}: association"
        assert estimate_error(info.updated, slot, theirs.updated[key]) <= tolerance, f"slot {slot}: update"
        assert info.deleted[slot] == (key in theirs.deleted), f"slot {slot}: deletion"
    check_live(after, info, theirs, tolerance)
    return theirs, after, info


def check_live(after, info, theirs, tolerance):
    keys = slot_keys(after)
    assert {key for key in keys if key} == theirs.live.keys()
    assert {key for key, born in zip(keys, info.initiated, strict=True) if born} == theirs.initiated
    for slot, key in enumerate(keys):
        if key:
            assert estimate_error(after, slot, theirs.live[key]) <= tolerance, f"slot {slot}: live"


@pytest.mark.parametrize("towards", [AHEAD, BEHIND, UP], ids=["ahead", "behind", "up"])
@pytest.mark.parametrize("seed", range(8))
def test_one_step(seed, towards):
    rng = np.random.default_rng(seed)
    params = Params(time_step=rng.choice([0.005, 0.05, 1.0]), deletion_threshold=900.0)
    tracks = random_tracks(rng, 6, towards, max_tracks=20)
    value = detections_near(rng, tracks, params, count=8)
    check_step(tracks, value, params)
