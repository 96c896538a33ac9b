"""Auto-encoder pre-training: the loss by hand, and an encoder that learns to keep track lists."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxtrack import Params, StaticParams
from jaxtrack.env import SearchTrack
from train.agents import build_agent
from train.config import TrainConfig
from train.learner import init_learner
from train.pretrain import pretrain, reconstruction_loss

pytestmark = pytest.mark.usefixtures("quick_compilation")

STATIC = StaticParams(num_truths=3, max_tracks=4, max_detections=3, map_size=36, num_looks=3)
# Beams so wide that random looks find tracks at once.
PARAMS = Params(beam_azimuth=1.5, beam_elevation=1.5)
CONFIG = TrainConfig(
    encoder="flatten", head="factored", num_envs=8, pretrain_steps=8 * 250, static=STATIC, params=PARAMS
)


def test_loss_by_hand():
    observation = {
        "tracks": jnp.array([[[1.0, 2.0], [jnp.nan, 9.0]], [[0.0, 0.0], [3.0, 0.0]]]),
        "mask": jnp.array([[True, False], [False, True]]),
    }
    tracks = jnp.array([[[1.0, 4.0], [5.0, 5.0]], [[7.0, 7.0], [0.0, 0.0]]])
    holds = jnp.array([[np.log(3.0), 0.0], [0.0, np.log(3.0)]])
    # Two live tracks, with mean squared errors 4 / 2 and 9 / 2; probabilities 3/4, 1/2, 1/2, 3/4.
    expected = (2 + 4.5) / 2 - (2 * np.log(3 / 4) + 2 * np.log(1 / 2)) / 4
    np.testing.assert_allclose(reconstruction_loss(tracks, holds, observation), expected, rtol=1e-6)
    nothing = {**observation, "mask": jnp.zeros((2, 2), bool)}
    assert np.isfinite(reconstruction_loss(tracks, holds, nothing))


def test_the_encoder_learns_to_keep_lists_and_nothing_else_changes():
    env = SearchTrack(STATIC)
    agent = build_agent("flatten", STATIC, PARAMS, "factored")

    @jax.jit
    def learn(key):
        key_env, key_net, key = jax.random.split(key, 3)
        observation, states = jax.vmap(env.reset_env, in_axes=(0, None))(jax.random.split(key_env, 8), PARAMS)
        weights = agent.network.init(key_net, observation)
        return weights, *pretrain(key, weights, observation, states, PARAMS, env, CONFIG)

    before, after, losses = learn(jax.random.key(0))
    assert losses.shape == (250,)
    # Once lists are full: the first steps have few tracks, which are easy to tell.
    assert losses[-50:].mean() < 0.5 * losses[10:60].mean()
    assert set(before["params"]) == set(after["params"])
    for part in before["params"]:
        same = jax.tree.map(np.array_equal, before["params"][part], after["params"][part])
        assert all(jax.tree.leaves(same)) == (part != "track_list")


@pytest.mark.medium
def test_a_training_begins_with_it():
    env = SearchTrack(STATIC)

    def first_weights(steps):
        config = dataclasses.replace(CONFIG, pretrain_steps=steps)
        state = jax.jit(lambda key: init_learner(key, PARAMS, env, config))(jax.random.key(0))
        return state.weights["params"]

    without, with_it = first_weights(0), first_weights(16)
    for part in without:
        same = jax.tree.map(np.array_equal, without[part], with_it[part])
        assert all(jax.tree.leaves(same)) == (part != "track_list")
