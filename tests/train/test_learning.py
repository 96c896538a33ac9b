"""The beam policy learns on a small scenario what its reward says, and nothing else."""

import dataclasses

import jax
import pytest

from jaxtrack import Params, StaticParams
from jaxtrack.env import SearchTrack
from train import learner
from train.config import TrainConfig

pytestmark = pytest.mark.usefixtures("quick_compilation")


def test_the_beam_policy_learns_what_the_reward_says():
    static = StaticParams(3, 4, 3, 0, map_size=10, num_looks=5, reward="information")
    params = Params(max_steps_in_episode=40, time_step=0.05, beam_azimuth=0.6, beam_elevation=0.6)
    config = TrainConfig(
        num_envs=16,
        rollout_steps=40,
        num_minibatches=4,
        microbatch=160,
        total_steps=20 * 640,
        anneal=False,
        warm_start="none",
    )
    env = SearchTrack(static)

    @jax.jit
    def rewards(params, rate):
        changed = dataclasses.replace(config, learning_rate=rate)
        state = learner.init_learner(jax.random.key(0), params, env, changed)
        step = lambda state, _: learner.train_step(state, env, changed)  # noqa: E731
        return jax.lax.scan(step, state, length=config.num_updates)[1]["reward"]

    trained = rewards(params, 3e-3)[-5:].mean()
    untrained = rewards(params, 0.0)[-5:].mean()
    flipped = params.replace(track_weight=-params.track_weight, search_weight=-params.search_weight)
    misled = -rewards(flipped, 3e-3)[-5:].mean()
    # Measured over seeds: about 0.28, 0.05 and -0.45.
    assert trained > untrained + 0.1
    assert misled < untrained - 0.1
