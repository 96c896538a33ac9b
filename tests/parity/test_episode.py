"""Free-running: whole episodes, the same detections fed to both trackers, nothing reset between.

Both must take the same decision on every step: births, associations, deletions.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxtrack import Detections, Params, SearchTrack, StaticParams, models
from reference.parity.compare import TOLERANCE
from reference.parity.environment import pointing_or_random
from reference.parity.episodes import compare_episode
from reference.parity.ours import track_detections
from reference.pipeline import StoneSoupTracker

STEPS = 1000
SHAPES = StaticParams(num_truths=7, max_tracks=40, max_detections=20)


def environment_episode(params, seed):
    """Truths, detections, track lists and tracker records of one episode, each `[K, ...]`."""
    env = SearchTrack(SHAPES)

    def one_step(state, key):
        key_action, key_noise = jax.random.split(key)
        action = pointing_or_random(key_action, state, env, params)
        state, record = env.advance(state, action, env.sample_noise(key_noise), params)
        return state, (state.truths.state, record.detections, state.tracks, record.tracker)

    key_reset, key_steps = jax.random.split(jax.random.key(seed))
    _, state = env.reset_env(key_reset, params)
    return jax.lax.scan(one_step, state, jax.random.split(key_steps, STEPS))[1]


RECORD = jax.jit(environment_episode)


def check_episode(detections, tracks, info, params, steps):
    """Runs Stone Soup on the first detections; every step must agree. Returns what happened."""
    assert not info.num_dropped[:steps].any(), "capacity is a limit that Stone Soup does not have"
    oracle = StoneSoupTracker(params, intermediates=False)
    records = [oracle.step(detections.value[k], detections.active[k]) for k in range(steps)]
    found = compare_episode(records, tracks, info, detections.active, params, TOLERANCE)
    assert found.divergence is None, str(found.divergence)
    assert found.steps == steps
    return found


# Long enough steps that tracks which are not looked at die within the episode.
QUICK = {"time_step": 0.02, "deletion_threshold": 3500.0}
HARD = {**QUICK, "detection_probability": 0.8, "clutter_rate": 0.5, "process_noise": 20.0}
CROWDED = {**HARD, "field_limit": 0.15, "min_range": 2000.0, "max_range": 2200.0}


@pytest.mark.parametrize(
    ("numbers", "seed", "steps"),
    [({}, 0, 1000), (QUICK, 1, 400), (HARD, 2, 300), (CROWDED, 3, 150)],
    ids=["paper", "quick", "clutter-and-misses", "crowded"],
)
def test_environment_episode(numbers, seed, steps):
    params = Params(**numbers)
    _, detections, tracks, info = jax.device_get(RECORD(params, seed))
    happened = check_episode(detections, tracks, info, params, steps)
    assert happened.updates > 0.2 * steps
    assert happened.births > happened.deletions >= 2


def test_truths_move_before_the_radar_looks():
    """As in Stone Soup's loop: with a perfect radar the detections are the present truths."""
    params = Params(elevation_sigma=1e-9, bearing_sigma=1e-9, range_sigma=1e-6)
    truths, detections, _, _ = jax.device_get(RECORD(params, 5))
    step, row = np.nonzero(detections.active)
    seen = truths[step, detections.truth[step, row]]
    offsets = np.asarray(detections.value[step, row] - models.elevation_bearing_range(seen))
    assert len(step) > 300
    assert np.abs(offsets / [1e-9, 1e-9, 1e-6]).max() < 6.0


def test_behind_the_radar():
    """The same field turned by half a turn: bearings jump between -pi and pi all the time."""
    params, steps = Params(**QUICK), 250
    recorded = RECORD(params, 4)[1]
    turned = recorded.value.at[..., 1].set(models.wrap_bearing(recorded.value[..., 1] + jnp.pi))
    detections = Detections(turned, recorded.active, recorded.truth)
    tracks, info = jax.device_get(track_detections(detections, params, 40))
    happened = check_episode(jax.device_get(detections), tracks, info, params, steps)
    assert happened.updates > 0.2 * steps
    assert happened.births > happened.deletions >= 2
