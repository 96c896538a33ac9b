"""One step on both sides from one track list, every intermediate compared."""

import jax
import numpy as np

from jaxtrack import NO_DETECTION, tracker
from reference.parity.compare import TOLERANCE, estimate_error, expected_error
from reference.parity.scenes import padded
from reference.pipeline import StoneSoupTracker
from reference.translate import slot_keys

STEP = jax.jit(tracker.step)


def check_step(tracks, value, params, capacity=12, tolerance=TOLERANCE, exact_jacobian=True, index=0):
    """Teacher-forced step from `tracks` as they were after step `index`, with detections `[D, 3]`.

    Returns Stone Soup's record, our track list, and our intermediates.
    """
    oracle = StoneSoupTracker(params, exact_jacobian)
    oracle.load(tracks, index)
    detections = padded(value, capacity)
    theirs = oracle.step(detections.value, detections.active)
    after, info = jax.device_get(
        STEP(jax.device_get(tracks), detections, params.time_step, index + 1, params)
    )
    for slot, key in enumerate(slot_keys(tracks)):
        if key:
            check_track(info, slot, key, theirs, tolerance)
    check_live(after, info, theirs, tolerance)
    return theirs, after, info


def check_track(info, slot, key, theirs, tolerance):
    assert expected_error(info, slot, theirs.expected[key]) <= tolerance, f"{key}: expected"
    assert info.associated[slot] == theirs.associated.get(key, NO_DETECTION), f"{key}: association"
    assert estimate_error(info.updated, slot, theirs.updated[key]) <= tolerance, f"{key}: update"
    assert info.deleted[slot] == (key in theirs.deleted), f"{key}: deletion"


def check_live(after, info, theirs, tolerance):
    """Live tracks after the step; what found no slot is dropped, lowest detections first served."""
    keys = slot_keys(after)
    born = [key for key, initiated in zip(keys, info.initiated, strict=True) if initiated]
    kept = sorted(theirs.initiated)[: len(born)]
    assert sorted(born) == kept
    assert len(theirs.initiated) - len(kept) == info.num_dropped
    if info.num_dropped:
        assert np.all(after.active), "dropped although a slot was free"
    assert {key for key in keys if key} == theirs.live.keys() - (theirs.initiated - set(kept))
    for slot, key in enumerate(keys):
        if key:
            assert estimate_error(after, slot, theirs.live[key]) <= tolerance, f"{key}: live"
            assert after.updated_by[slot] == theirs.source(key), f"{key}: source"
            assert after.age[slot] == theirs.step - key[0], f"{key}: age"
