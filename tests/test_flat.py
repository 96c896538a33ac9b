"""The environment for PureJaxRL and rejax: a vector, one number, five values."""

import copy

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnax.environments import spaces
from gymnax.wrappers import FlattenObservationWrapper, LogWrapper

from jaxtrack import make
from jaxtrack.flat import FlatSearchTrack, LegacyStep, make_legacy

pytestmark = pytest.mark.usefixtures("quick_compilation")

SHAPES = {"num_truths": 3, "max_tracks": 4, "map_size": 10, "num_looks": 5, "observe_variances": True}
NUMBERS = {"max_steps_in_episode": 6, "beam_azimuth": 2.0, "beam_elevation": 1.0}
LENGTH = 4 + 10 * 10 + 4 * 7 + 4 * 2


def test_the_vector_and_the_number_say_what_the_parts_say():
    plain, params = make(**SHAPES, **NUMBERS)
    flat = FlatSearchTrack(plain.static)
    key = jax.random.key(3)
    observation, state = plain.reset(key, params)
    vector, flat_state = flat.reset(key, params)
    for look, action in [([2, 2], 12), ([0, 3], 3)]:
        key, key_step = jax.random.split(key)
        observation, state, *_ = plain.step(key_step, state, jnp.array(look), params)
        vector, flat_state, _, _, _, info = flat.step(key_step, flat_state, jnp.array(action), params)
        mask, scan_map, tracks, variances = np.split(np.asarray(vector), [4, 104, 132])
        np.testing.assert_allclose(mask, observation["mask"])
        np.testing.assert_allclose(scan_map, observation["scan_map"].ravel(), rtol=1e-6)
        np.testing.assert_allclose(tracks, observation["tracks"].ravel(), rtol=1e-4, atol=1e-6)
        np.testing.assert_allclose(variances, observation["variances"].ravel(), rtol=1e-4, atol=1e-6)
        np.testing.assert_array_equal(info["final_observation"], vector)
    assert mask.any()


def test_spaces_are_those_that_learners_ask_for():
    env, params = make_legacy(**SHAPES, **NUMBERS)
    assert env.observation_space(params).shape == (LENGTH,)
    assert isinstance(env.observation_space(params), spaces.Box)
    assert isinstance(env.action_space(params), spaces.Discrete)
    assert env.action_space(params).n == 25
    angles, params = make_legacy(continuous_actions=True)
    assert angles.action_space(params).shape == (2,)


def test_continuous_looks_stay_two_angles():
    env, params = make_legacy(continuous_actions=True, **SHAPES, **NUMBERS)
    key = jax.random.key(0)
    _, state = jax.eval_shape(env.reset, key, params)
    observation, *_ = jax.eval_shape(env.step, key, state, jnp.zeros(2), params)
    assert observation.shape == (LENGTH,)


def test_five_values_over_the_end_of_an_episode_with_the_wrappers_of_gymnax():
    flat, params = make_legacy(**SHAPES, **NUMBERS)
    env = LegacyStep(LogWrapper(FlattenObservationWrapper(flat._env)))
    start = jax.vmap(env.reset, in_axes=(0, None))(jax.random.split(jax.random.key(0), 2), params)

    def one_step(carry, key):
        _, state = carry
        keys = jax.random.split(key, 2)
        observation, state, reward, done, info = jax.vmap(env.step, in_axes=(0, 0, 0, None))(
            keys, state, jnp.array([12, 3]), params
        )
        return (observation, state), (observation, reward, done, info)

    keys = jax.random.split(jax.random.key(1), 7)
    _, (observation, reward, done, info) = jax.lax.scan(one_step, start, keys)
    assert done.tolist() == [[step == 5] * 2 for step in range(7)]
    assert observation.shape == (7, 2, LENGTH)
    np.testing.assert_allclose(info["returned_episode_returns"][5], reward[:6].sum(axis=0), rtol=1e-5)
    # The first observation of the next episode holds no track; the last of the old one does.
    assert not bool(observation[5, :, :4].any())
    assert bool(info["final_observation"][5, :, :4].any())


def test_it_can_be_copied_as_rejax_does():
    env, params = make_legacy(**SHAPES)
    copied, _ = copy.deepcopy((env, params))
    assert copied.static.num_looks == 5


def test_a_wrong_field_is_named():
    with pytest.raises(ValueError, match="nonsense: no such field"):
        make_legacy(nonsense=1)
