"""The loss, its gradient in pieces, the optimiser and the summaries, by hand arithmetic."""

import dataclasses
import math
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxtrack import Params
from train import learner, rollout
from train.agents import Agent
from train.beams import BeamInputs, BeamNetwork
from train.config import TrainConfig
from train.distributions import JOINT
from train.loss import Sample, explained_variance, ppo_loss
from train.pieces import minibatch_gradient

BASE = TrainConfig(
    num_envs=8, rollout_steps=8, num_minibatches=2, microbatch=16, learning_rate=0.03, anneal=False
)

# An agent whose weights are its outputs: the loss can be done by hand.
BARE = Agent(
    lambda observation: observation,
    SimpleNamespace(
        apply=lambda weights, inputs: (
            jnp.broadcast_to(weights["logits"], (len(inputs), 4)),
            jnp.broadcast_to(weights["value"], (len(inputs),)),
        )
    ),
    JOINT,
)
# Look (0, 0) has probability 1/2, the others 1/6.
WEIGHTS = {"logits": jnp.log(jnp.array([3.0, 1.0, 1.0, 1.0])), "value": jnp.array(2.0)}


def loss_of(old_probability, advantage, config, taught=False):
    """Loss, parts and gradient for one sample of look (0, 0) whose target is 5."""
    sample = Sample(
        inputs=jnp.zeros((1, 1)),
        action=jnp.zeros((1, 2), dtype=int),
        taught=jnp.array([taught]),
        log_prob=jnp.log(jnp.array([old_probability])),
        value=jnp.zeros(1),
        advantage=jnp.zeros(1),
    )
    loss = jax.value_and_grad(ppo_loss, has_aux=True)
    return loss(WEIGHTS, sample, jnp.array([advantage]), jnp.array([5.0]), BARE, config)


@pytest.mark.parametrize(
    ("old_probability", "advantage", "policy_loss", "clipped"),
    [
        # Ratio 1/2 / 1/4 = 2 is clipped to 1.2 where that is the smaller gain.
        (0.25, 1.0, -1.2, True),
        (0.25, -1.0, 2.0, False),
        # Ratio 1/2 / 1 = 0.5, clipped to 0.8.
        (1.0, -1.0, 0.8, True),
        (1.0, 1.0, -0.5, False),
        (0.5, 3.0, -3.0, False),
    ],
)
def test_the_surrogate_is_clipped_on_the_side_that_gains(old_probability, advantage, policy_loss, clipped):
    config = dataclasses.replace(BASE, value_coefficient=0.0, entropy_coefficient=0.0)
    (loss, parts), gradient = loss_of(old_probability, advantage, config)
    np.testing.assert_allclose([loss, parts["policy_loss"]], policy_loss, rtol=1e-5)
    assert parts["clip_fraction"] == (old_probability != 0.5)
    assert (np.abs(gradient["logits"]).max() < 1e-6) == clipped


@pytest.mark.parametrize("advantage", [-1.0, 1.0])
def test_a_taught_action_is_imitated_whatever_it_earned(advantage):
    config = dataclasses.replace(BASE, value_coefficient=0.0, entropy_coefficient=0.0)
    (loss, parts), gradient = loss_of(0.25, advantage, config, taught=True)
    # Cross-entropy of probability 1/2, and its gradient: probabilities less one where it was taught.
    np.testing.assert_allclose([loss, parts["policy_loss"]], math.log(2), rtol=1e-5)
    np.testing.assert_allclose(gradient["logits"], [-1 / 2, 1 / 6, 1 / 6, 1 / 6], rtol=1e-5)


def test_value_error_entropy_and_divergence_by_hand():
    config = dataclasses.replace(BASE, value_coefficient=0.5, entropy_coefficient=0.1)
    (loss, parts), gradient = loss_of(0.25, 1.0, config)
    # Half the squared error of 2 against 5; entropy (1/2) ln 2 + 3 (1/6) ln 6; ratio 2.
    entropy = 0.5 * math.log(2) + 0.5 * math.log(6)
    np.testing.assert_allclose(parts["value_loss"], 4.5, rtol=1e-6)
    np.testing.assert_allclose(parts["entropy"], entropy, rtol=1e-6)
    np.testing.assert_allclose(parts["approximate_kl"], 1 - math.log(2), rtol=1e-5)
    np.testing.assert_allclose(loss, -1.2 + 0.5 * 4.5 - 0.1 * entropy, rtol=1e-5)
    np.testing.assert_allclose(gradient["value"], 0.5 * (2 - 5), rtol=1e-6)


def random_samples(count):
    """Samples as a rollout on four looks gives them."""
    rng = np.random.default_rng(0)
    return Sample(
        inputs=BeamInputs(
            search=jnp.asarray(rng.uniform(size=(count, 6, 4)) / 50, dtype=float),
            inside=jnp.asarray(rng.uniform(size=(count, 2, 4)) < 0.4),
            tracks=jnp.asarray(rng.uniform(size=(count, 2, 9)) / 50, dtype=float),
            mask=jnp.asarray(rng.uniform(size=(count, 2)) < 0.8),
            context=jnp.asarray(rng.uniform(size=(count, 6)), dtype=float),
        ),
        action=jnp.asarray(rng.integers(0, 2, (count, 2))),
        taught=jnp.asarray(rng.uniform(size=count) < 0.3),
        log_prob=jnp.asarray(rng.normal(-1.4, 0.2, count), dtype=float),
        value=jnp.asarray(rng.normal(size=count), dtype=float),
        advantage=jnp.asarray(rng.normal(3, 2, count), dtype=float),
    )


def test_the_microbatch_changes_nothing(draw_variables):
    samples = random_samples(16)
    network = BeamNetwork(width=4)
    weights = draw_variables(network, samples.inputs)
    agent = Agent(lambda observation: observation, network, JOINT)
    config = dataclasses.replace(BASE, rollout_steps=4, num_minibatches=2, entropy_coefficient=0.1)
    assert config.minibatch_size == 16

    @jax.jit
    def gradients(weights):
        in_pieces = [
            minibatch_gradient(
                weights, samples, jnp.arange(16), agent, dataclasses.replace(config, microbatch=size)
            )
            for size in (16, 4)
        ]
        # The loss over the whole minibatch, its advantages normalised.
        advantage = samples.advantage
        normalised = (advantage - advantage.mean()) / advantage.std()
        whole = jax.grad(ppo_loss, has_aux=True)(
            weights, samples, normalised, samples.value + advantage, agent, config
        )
        return [*in_pieces, whole]

    one_piece, four_pieces, whole = gradients(weights)
    for result in (one_piece, four_pieces):
        jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y, rtol=1e-4, atol=1e-6), result, whole)


def rates(steps, **options):
    """Adam's step on a constant gradient, which is its learning rate, over that many steps."""
    optimiser = learner.make_optimiser(dataclasses.replace(BASE, max_grad_norm=1e9, **options))
    state, sizes = optimiser.init(jnp.zeros(())), []
    for _ in range(steps):
        step, state = optimiser.update(jnp.ones(()), state, jnp.zeros(()))
        sizes.append(-float(step))
    return sizes


def test_the_learning_rate_falls_to_zero_over_all_updates():
    # Two updates of four epochs of two minibatches.
    found = rates(17, anneal=True, warm_start="none", total_steps=2 * BASE.batch_size)
    np.testing.assert_allclose(found, 0.03 * (1 - np.arange(17) / 16), atol=1e-5)


def test_the_warm_start_has_a_learning_rate_of_its_own():
    # One update of imitation, then two from rewards.
    options = {"warm_start_steps": BASE.batch_size, "total_steps": 3 * BASE.batch_size}
    found = rates(24, anneal=True, warm_start_learning_rate=0.5, **options)
    np.testing.assert_allclose(found[:8], 0.5, atol=1e-5)
    np.testing.assert_allclose(found[8:], 0.03 * (1 - np.arange(16) / 16), atol=1e-5)
    np.testing.assert_allclose(rates(24, warm_start_learning_rate=0.5, **options)[8:], 0.03, atol=1e-5)


def test_gradients_are_scaled_down_to_the_largest_norm():
    config = dataclasses.replace(BASE, max_grad_norm=0.5)
    optimiser = learner.make_optimiser(config)
    gradient = jnp.array([3.0, 4.0])
    _, state = optimiser.update(gradient, optimiser.init(gradient), gradient)
    # Adam's first moment is a tenth of the gradient it got: (3, 4) at norm 0.5.
    moment = jax.tree.leaves(state)[1]
    np.testing.assert_allclose(moment, [0.03, 0.04], rtol=1e-5)


def test_explained_variance():
    value, advantage = jnp.array([1.0, 2.0, 3.0]), jnp.zeros(3)
    assert explained_variance(value, advantage) == 1
    # Values that say nothing explain nothing.
    np.testing.assert_allclose(explained_variance(jnp.zeros(3), value), 0.0, atol=1e-6)


def test_without_a_whole_episode_the_return_is_nan():
    finished = {"done": jnp.array([[True]]), "episode_length": jnp.array([[3]])}
    finished |= {"episode_return": jnp.ones((1, 1)), "terminated": jnp.array([[False]])}
    summary = rollout.summarise(finished, {"reward": jnp.ones((1, 1))}, Params(max_steps_in_episode=4))
    assert summary["episodes"] == 0
    assert np.isnan(summary["episode_return"])
    ended = finished | {"terminated": jnp.array([[True]])}
    assert rollout.summarise(ended, {}, Params(max_steps_in_episode=4))["episodes"] == 1


def test_only_whole_episodes_count_for_the_return_and_all_steps_for_the_rest():
    """Two steps of three environments: cut short, whole or stopped, and going on."""
    finished = {
        "done": jnp.array([[True, False, False], [True, True, False]]),
        "terminated": jnp.array([[False, False, False], [True, False, False]]),
        "episode_length": jnp.array([[3, 3, 1], [1, 4, 2]]),
        "episode_return": jnp.array([[100.0, 200.0, 300.0], [2.0, 5.0, 400.0]]),
    }
    reward = jnp.array([[1.0, 2.0, 3.0], [4.0, 5.0, 9.0]])
    summary = rollout.summarise(finished, {"reward": reward}, Params(max_steps_in_episode=4))
    assert (int(summary["episodes"]), float(summary["episode_return"])) == (2, 3.5)
    assert summary["reward"] == 4
