"""Stock PPO on Stone Soup, as the benchmark times it; `make sb3` runs this."""

import dataclasses
from types import SimpleNamespace

import jax
import numpy as np
import pytest

from benchmarks.ppo import OurLearner, Seconds, UpdateOptions, configure
from jaxtrack.env import make
from train.agents import build_agent
from train.networks import ENCODERS

pytestmark = [pytest.mark.sb3, pytest.mark.usefixtures("quick_compilation")]

OPTIONS = UpdateOptions(num_envs=8, rollout_steps=4, minibatch_size=16, epochs=2)


@pytest.fixture(scope="module")
def stone_soup_ppo():
    """A small learner on Stone Soup after its warm-up."""
    from benchmarks.stone_soup_ppo import StoneSoupPPO

    config = dataclasses.replace(configure("flatten", OPTIONS), num_envs=2, rollout_steps=16)
    learner = StoneSoupPPO(config, piece=4)
    learner.warm_up(6)
    return learner


def test_stone_soup_steps_in_pieces_and_learns_from_a_full_batch(stone_soup_ppo, monkeypatch):
    model = stone_soup_ppo.model
    assert model.num_timesteps == 2 * 8  # six steps are two pieces of four
    scenarios = [env.unwrapped.scenario for env in model.env.envs]
    assert [scenario.step_index for scenario in scenarios] == [8, 8]
    seconds = stone_soup_ppo.collect()
    assert seconds.wall > 0
    assert [scenario.step_index for scenario in scenarios] == [12, 12]
    counts = [len(scenario.tracks) for scenario in scenarios]
    assert 0 <= stone_soup_ppo.tracks.mean <= max(counts) + 1

    optimiser_steps, weights = [], {name: value.clone() for name, value in model.policy.named_parameters()}
    step = model.policy.optimizer.step
    monkeypatch.setattr(model.policy.optimizer, "step", lambda: (optimiser_steps.append(1), step()))
    stone_soup_ppo.update()
    assert len(optimiser_steps) == OPTIONS.epochs * OPTIONS.samples // OPTIONS.minibatch_size
    assert any((value != weights[name]).any() for name, value in model.policy.named_parameters())


def test_the_full_batch_is_the_last_piece_again_and_again(stone_soup_ppo):
    stone_soup_ppo.collect()
    batch, rollout = stone_soup_ppo._full_batch(), stone_soup_ppo._rollout
    assert (batch.full, batch.buffer_size, batch.n_envs) == (True, 16, 2)
    assert stone_soup_ppo.pieces == 4
    for step in range(16):
        for name in ("actions", "log_probs", "advantages", "returns", "values", "rewards"):
            np.testing.assert_array_equal(getattr(batch, name)[step], getattr(rollout, name)[step % 4])
        for name, values in batch.observations.items():
            np.testing.assert_array_equal(values[step], rollout.observations[name][step % 4])
    assert np.abs(rollout.advantages).max() > 0
    assert rollout.observations["scan_map"].shape == (4, 2, 1, 48, 48)


def test_live_tracks_come_first_in_their_order():
    from benchmarks.stone_soup_ppo import for_the_network

    mask = np.array([0, 1, 0, 1, 1], np.int8)
    tracks = mask[:, None] * np.arange(5.0)[:, None]
    shown = for_the_network({"tracks": tracks, "mask": mask, "scan_map": np.ones((3, 3))})
    assert shown["mask"].tolist() == [1, 1, 1, 0, 0]
    assert shown["tracks"][:, 0].tolist() == [1, 3, 4, 0, 0]
    assert shown["scan_map"].shape == (1, 3, 3)


@pytest.mark.parametrize("encoder", ENCODERS)
def test_both_networks_have_the_same_number_of_parameters(encoder):
    """But for PyTorch's second bias of the gates r and z, which a GRU adds to the first."""
    from benchmarks.stone_soup_ppo import StoneSoupPPO

    config = configure(encoder, OPTIONS)
    network = build_agent(encoder, config.static, config.params, config.head).network
    env, _ = make(config.params, config.static)
    observation = jax.eval_shape(env.reset_env, jax.random.key(0), config.params)[0]
    one = jax.tree.map(lambda leaf: jax.ShapeDtypeStruct((1, *leaf.shape), leaf.dtype), observation)
    weights = jax.eval_shape(network.init, jax.random.key(0), one)
    ours = OurLearner(SimpleNamespace(weights=weights), None, Seconds(0.0, 0.0)).parameters
    second_biases = 2 * 2 * {"flatten": 0, "bigru": 64, "mhsa": 32}[encoder]
    assert StoneSoupPPO(config, piece=4).parameters == ours + second_biases
    assert ours > 100_000
