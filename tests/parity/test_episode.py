"""Free-running: whole episodes, the same detections fed to both trackers, nothing reset between.

Both must take the same decision on every step: births, associations, deletions.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxtrack import NO_DETECTION, Detections, Params, SearchTrack, StaticParams, Tracks, models, tracker
from reference.parity.compare import TOLERANCE, estimate_error
from reference.pipeline import StoneSoupTracker
from reference.translate import slot_keys

STEPS = 1000
SHAPES = StaticParams(num_truths=7, max_tracks=40, max_detections=20)


def pointing_or_random(key, state, env, params):
    """Half of the looks at one of three truths, half anywhere: updates, births and deletions."""
    elevation, azimuth, _ = models.elevation_bearing_range(state.truths.state[(state.time // 10) % 3])
    last = env.static.num_looks - 1
    there = jnp.round((jnp.stack([azimuth, elevation]) / params.field_limit + 1) / 2 * last).astype(int)
    anywhere = jax.random.randint(key, (2,), 0, env.static.num_looks)
    return jnp.where(state.time % 2 == 0, anywhere, there)


def environment_episode(params, seed):
    """Truths, detections, track lists and tracker records of one episode, each `[K, ...]`."""
    env = SearchTrack(SHAPES)

    def one_step(state, key):
        key_action, key_noise = jax.random.split(key)
        action = pointing_or_random(key_action, state, env, params)
        state, record = env.advance(state, action, env.sample_noise(key_noise), params)
        return state, (state.truths.state, record.detections, state.tracks, decisions(record.tracker))

    key_reset, key_steps = jax.random.split(jax.random.key(seed))
    _, state = env.reset_env(key_reset, params)
    return jax.lax.scan(one_step, state, jax.random.split(key_steps, STEPS))[1]


def tracker_episode(detections, params, max_tracks):
    """Track lists and records of the bare tracker on recorded detections `[K, D]`."""

    def one_step(carry, detections):
        tracks, index = carry
        tracks, info = tracker.step(tracks, detections, params.time_step, index, params)
        return (tracks, index + 1), (tracks, decisions(info))

    return jax.lax.scan(one_step, (Tracks.empty(max_tracks), jnp.asarray(1)), detections)[1]


RECORD = jax.jit(environment_episode)
REPLAY = jax.jit(tracker_episode, static_argnums=2)


def decisions(info):
    return info.associated, info.deleted, info.initiated, info.num_dropped


def check_episode(detections, tracks, made, params, steps):
    """Runs Stone Soup on the first detections and compares every step; returns how much happened."""
    oracle = StoneSoupTracker(params, intermediates=False)
    before = [None] * tracks.active.shape[1]
    happened = {"updates": 0, "deletions": 0, "births": 0, "error": 0.0}
    assert not made[3][:steps].any(), "capacity is a limit that Stone Soup does not have"
    for k in range(steps):
        theirs = oracle.step(detections.value[k], detections.active[k])
        now = jax.tree.map(lambda leaf, k=k: leaf[k], tracks)
        after = slot_keys(now)
        associated, deleted, initiated = (decision[k] for decision in made[:3])
        pairs = {key: row for key, row in zip(before, associated, strict=True) if row != NO_DETECTION}
        assert pairs == theirs.associated, f"step {k + 1}: associations"
        gone = {key for key, is_gone in zip(before, deleted, strict=True) if is_gone}
        assert gone == theirs.deleted, f"step {k + 1}: deletions"
        born = {key for key, is_born in zip(after, initiated, strict=True) if is_born}
        assert born == theirs.initiated, f"step {k + 1}: births"
        assert {key for key in after if key} == theirs.live.keys(), f"step {k + 1}: live"
        for slot, key in enumerate(after):
            if key:
                error = estimate_error(now, slot, theirs.live[key])
                assert error <= TOLERANCE, f"step {k + 1}, track {key}: off by {error:.1e} sigma"
                happened["error"] = max(happened["error"], error)
        happened["updates"] += len(pairs)
        happened["deletions"] += len(gone)
        happened["births"] += len(born)
        before = after
    return happened


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
    _, detections, tracks, made = jax.device_get(RECORD(params, seed))
    happened = check_episode(detections, tracks, made, params, steps)
    assert happened["updates"] > 0.2 * steps
    assert happened["births"] > happened["deletions"] >= 2


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
    tracks, made = jax.device_get(REPLAY(detections, params, 40))
    happened = check_episode(jax.device_get(detections), tracks, made, params, steps)
    assert happened["updates"] > 0.2 * steps
    assert happened["births"] > happened["deletions"] >= 2


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(20))
def test_ten_thousand_random_scenario_steps(seed):
    """Twenty episodes of 500 steps, every number of the tracker drawn at random."""
    rng = np.random.default_rng(seed)
    params = Params(
        time_step=int(rng.integers(5, 40)) / 1000,
        truth_process_noise=rng.uniform(0, 20),
        process_noise=rng.uniform(0.1, 20),
        elevation_sigma=rng.uniform(0.5e-3, 5e-3),
        bearing_sigma=rng.uniform(0.5e-3, 5e-3),
        range_sigma=rng.uniform(1, 20),
        gate_threshold=rng.uniform(2, 6),
        missed_distance=rng.uniform(2, 6),
        prior_velocity_sigma=rng.uniform(15, 35),
        deletion_threshold=rng.uniform(4000, 6000),
        detection_probability=rng.uniform(0.6, 1),
        clutter_rate=rng.uniform(0, 0.2),
    )
    _, detections, tracks, made = jax.device_get(RECORD(params, seed))
    assert check_episode(detections, tracks, made, params, 500)["updates"] > 50
