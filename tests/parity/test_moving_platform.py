"""A radar on a platform that flies ahead or in a turn, against Stone Soup's tracker in the world's frame.

Stone Soup tracks in the frame of the world, in which the platform of every detection has its place;
ours in the platform's. Their tracks differ by the platform's own state, and by nothing else.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from stonesoup.models.transition.linear import (
    CombinedLinearGaussianTransitionModel,
    ConstantVelocity,
    KnownTurnRate,
)
from stonesoup.platform import MovingPlatform
from stonesoup.types.state import State

from jaxtrack import Detections, Params, Tracks, Truths, models, tracker
from jaxtrack.truth import TruthNoise, propagate_truths
from jaxtrack.types import velocity
from reference.components import build_components, measurement_model, time_of
from reference.translate import to_detections, to_tracks
from reference.truths import initial_states

SPEED, STEPS, TRUTHS = 250.0, 12, 4
LATE = 5
"""From this step on the last truth is seen, so that a track begins on the way."""
NUMBERS = {"time_step": 0.5, "deletion_threshold": 1e6, "field_limit": 0.5}
SIGMAS = np.sqrt(np.diag(models.measurement_noise(Params())))


def path(turn_rate):
    """States `[STEPS, 6]` of Stone Soup's platform, at a step each."""
    plane = [ConstantVelocity(0), ConstantVelocity(0)]
    if turn_rate is not None:
        plane = [KnownTurnRate(turn_noise_diff_coeffs=[0, 0], turn_rate=turn_rate)]
    platform = MovingPlatform(
        states=State([0, SPEED, 0, 0, 0, 0], timestamp=time_of(0, Params(**NUMBERS))),
        position_mapping=(0, 2, 4),
        velocity_mapping=(1, 3, 5),
        transition_model=CombinedLinearGaussianTransitionModel([*plane, ConstantVelocity(0)]),
    )
    states = []
    for step in range(STEPS):
        platform.move(time_of(step, Params(**NUMBERS)))
        states.append(np.asarray(platform.state_vector, float).ravel())
    return np.stack(states)


@pytest.fixture(params=[None, 0.3], ids=["straight", "turning"])
def flight(request):
    """Turn rate and path of a platform."""
    return request.param, path(request.param)


@pytest.fixture
def scans(x64, flight):
    """Detections `[STEPS, TRUTHS, 3]` of truths that fly straight, from the place of the platform."""
    rng = np.random.default_rng(2)
    start = initial_states(rng, TRUTHS, Params(**NUMBERS))
    times = NUMBERS["time_step"] * np.arange(STEPS)
    seen = start[None, :, 0::2] + times[:, None, None] * start[:, 1::2]
    seen -= flight[1][:, None, 0::2]
    exact = np.asarray(models.spherical(seen))
    return exact + SIGMAS * rng.standard_normal(exact.shape)


def test_tracks_in_the_frames_of_world_and_platform_are_the_same(scans, flight):
    turn_rate, platform = flight
    world = Params(**NUMBERS)
    ours = Params(**NUMBERS, platform_speed=SPEED, platform_turn_rate=turn_rate)
    theirs = build_components(world).tracker()
    tracks, step = Tracks.empty(TRUTHS), jax.jit(tracker.step)
    for k, values in enumerate(scans):
        seen = np.arange(TRUTHS) < (TRUTHS if k >= LATE else TRUTHS - 1)
        tracks, _ = step(tracks, Detections.from_values(values, seen), ours.time_step, k, ours)
        model = measurement_model(world)
        model.translation_offset = platform[k, 0::2, None]
        detections = to_detections(values, seen, k, time_of(k, world), model)
        theirs.update_tracker(time_of(k, world), set(detections))
    found = to_tracks(theirs.tracks, STEPS - 1, TRUTHS, {})
    assert np.asarray(tracks.active).all()
    np.testing.assert_array_equal(found.birth_detection, tracks.birth_detection)
    np.testing.assert_array_equal(tracks.birth_step, [0, 0, 0, LATE])
    np.testing.assert_allclose(tracks.mean, found.mean - platform[-1], rtol=1e-7, atol=1e-5)
    np.testing.assert_allclose(tracks.covariance, found.covariance, rtol=1e-6, atol=1e-6)


def test_truths_are_seen_from_where_the_platform_is(x64, flight):
    """What flies straight in the world, born before the first step or at the last."""
    turn_rate, platform = flight
    params = Params(
        **NUMBERS, platform_speed=SPEED, platform_turn_rate=turn_rate, truth_process_noise=0.0, birth_rate=9.0
    )
    start = initial_states(np.random.default_rng(3), TRUTHS, Params(**NUMBERS))
    truths = Truths(state=jnp.asarray(start - platform[0]), alive=jnp.ones(TRUTHS, dtype=bool))
    move = jax.jit(propagate_truths)
    noise = TruthNoise(jnp.zeros((TRUTHS, 3, 2)), jnp.full(TRUTHS, 0.5), jnp.asarray(0.5))
    for step in range(1, STEPS):
        truths, _, _ = move(truths, jnp.asarray(TRUTHS), noise, jnp.asarray(step), params)
    start[:, 0::2] += (STEPS - 1) * params.time_step * start[:, 1::2]
    np.testing.assert_allclose(truths.state, start - platform[-1], rtol=1e-9, atol=1e-6)
    nobody = truths.replace(alive=jnp.zeros(TRUTHS, dtype=bool))
    born, _, _ = move(nobody, jnp.asarray(0), noise, jnp.asarray(STEPS - 1), params)
    assert born.alive.all()
    np.testing.assert_allclose(velocity(born.state), np.tile(-platform[-1, 1::2], (TRUTHS, 1)), atol=1e-6)
