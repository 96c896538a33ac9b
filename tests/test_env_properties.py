"""What must hold for a step of the environment in any state that an episode reaches, drawn by Hypothesis."""

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import jaxtrack
from jaxtrack.episode import EnvState, StepNoise

pytestmark = pytest.mark.usefixtures("quick_compilation")

LOOKS, STEPS = 5, 8
few = settings(max_examples=max(3, settings.default.max_examples // 8))
seeds = st.integers(0, 2**32 - 1)


class Shared:
    """One small environment, all of whose functions are compiled once."""

    def __init__(self):
        # Two of three truths in the beam, on average, and false detections: tracks compete.
        shapes = {"num_truths": 4, "max_tracks": 8, "max_detections": 7, "max_clutter": 2, "map_size": 10}
        self.env, self.params = jaxtrack.make(
            **shapes, num_looks=LOOKS, clutter_rate=0.7, beam_azimuth=1.5, beam_elevation=1.5, time_step=0.5
        )
        self.advance = jax.jit(self.env.advance)
        self.played = jax.jit(self.play)

    def play(self, key) -> tuple[EnvState, StepNoise]:
        """A state after some random looks, and the noise of the step that follows."""
        key, key_reset = jax.random.split(key)
        _, state = self.env.reset_env(key_reset, self.params)

        def one(state, key):
            action = jax.random.randint(key, (2,), 0, LOOKS)
            return self.env.advance(state, action, self.env.sample_noise(key), self.params)[0], None

        state, _ = jax.lax.scan(one, state, jax.random.split(key, STEPS))
        return state, self.env.sample_noise(jax.random.fold_in(key, STEPS))


@pytest.fixture(scope="module")
def shared():
    return Shared()


actions = st.tuples(st.integers(0, LOOKS - 1), st.integers(0, LOOKS - 1)).map(jnp.array)


def by_place(tracks):
    """Means and covariances of the live tracks in an order that no slot decides."""
    table = np.concatenate([tracks.mean, np.reshape(tracks.covariance, (-1, 36))], axis=1)[tracks.active]
    return table[np.lexsort(np.round(table[:, :6:2], 2).T)]


@given(seeds, actions, st.permutations(range(4)))
def test_the_order_of_the_truths_does_not_matter(x64, shared, seed, action, order):
    state, noise = shared.played(jax.random.key(seed))
    rows = np.asarray(order)
    other = state.replace(truths=jax.tree.map(lambda leaf: leaf[rows], state.truths))
    other_noise = noise.replace(
        truths=noise.truths.replace(motion=noise.truths.motion[rows], death=noise.truths.death[rows]),
        sensor=noise.sensor.replace(
            detection=noise.sensor.detection[rows], detected=noise.sensor.detected[rows]
        ),
    )
    after, record = shared.advance(state, action, noise, shared.params)
    after_other, record_other = shared.advance(other, action, other_noise, shared.params)
    np.testing.assert_allclose(after_other.truths.state, after.truths.state[rows], rtol=1e-12)
    assert int(record.num_dropped_detections) == int(record_other.num_dropped_detections)
    if not (record.num_dropped_detections or record.num_dropped_tracks):
        np.testing.assert_allclose(by_place(after_other.tracks), by_place(after.tracks), rtol=1e-7, atol=1e-6)


@given(seeds, actions)
def test_a_world_seen_in_a_mirror_is_the_mirrored_world(x64, shared, seed, action):
    state, noise = shared.played(jax.random.key(seed))
    # Left and right: y of truths and tracks, the bearing's noise, the columns of the map, the look.
    signs = jnp.array([1.0, 1, -1, -1, 1, 1])

    def mirror(state):
        return state.replace(
            truths=state.truths.replace(state=state.truths.state * signs),
            tracks=state.tracks.replace(
                mean=state.tracks.mean * signs, covariance=state.tracks.covariance * signs[:, None] * signs
            ),
            scan_map=state.scan_map[:, ::-1],
        )

    draws = noise.sensor
    mirrored_noise = noise.replace(
        truths=noise.truths.replace(motion=noise.truths.motion * signs[::2, None]),
        sensor=draws.replace(
            detection=draws.detection * jnp.array([1, -1, 1]),
            clutter=draws.clutter.at[:, 0].set(1 - draws.clutter[:, 0]),
        ),
    )
    after, _ = shared.advance(state, action, noise, shared.params)
    there, _ = shared.advance(
        mirror(state), action.at[0].set(LOOKS - 1 - action[0]), mirrored_noise, shared.params
    )
    back = mirror(there)
    np.testing.assert_array_equal(back.tracks.active, after.tracks.active)
    live = np.asarray(after.tracks.active)
    np.testing.assert_allclose(back.truths.state, after.truths.state, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(back.tracks.mean[live], after.tracks.mean[live], rtol=1e-7, atol=1e-6)
    np.testing.assert_allclose(
        back.tracks.covariance[live], after.tracks.covariance[live], rtol=1e-6, atol=1e-4
    )
    np.testing.assert_array_equal(back.scan_map, after.scan_map)


@given(seeds, actions)
def test_what_is_not_there_can_hold_anything(x64, shared, seed, action):
    state, noise = shared.played(jax.random.key(seed))
    gone = state.replace(truths=state.truths.replace(alive=jnp.array([True, False, True, False])))
    dead = ~gone.truths.alive[:, None]
    truths = gone.truths.replace(state=jnp.where(dead, jnp.nan, gone.truths.state))
    empty = ~gone.tracks.active
    tracks = gone.tracks.replace(
        mean=jnp.where(empty[:, None], jnp.inf, gone.tracks.mean),
        covariance=jnp.where(empty[:, None, None], jnp.nan, gone.tracks.covariance),
    )
    clean, _ = shared.advance(gone, action, noise, shared.params)
    filled, _ = shared.advance(gone.replace(truths=truths, tracks=tracks), action, noise, shared.params)
    seen = [shared.env.observe(jax.random.key(0), each, action, shared.params) for each in (filled, clean)]
    chex.assert_trees_all_equal(*seen)


@few
@given(seeds, actions)
def test_compiled_equals_eager(x64, shared, seed, action):
    state, noise = shared.played(jax.random.key(seed))
    compiled, _ = shared.advance(state, action, noise, shared.params)
    eager, _ = shared.env.advance(state, action, noise, shared.params)
    np.testing.assert_array_equal(compiled.tracks.active, eager.tracks.active)
    np.testing.assert_allclose(compiled.scan_map, eager.scan_map, rtol=1e-9)
    np.testing.assert_allclose(by_place(compiled.tracks), by_place(eager.tracks), rtol=1e-7, atol=1e-6)
