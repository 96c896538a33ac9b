"""The loss of PPO, and of imitating a rule."""

from typing import Any

import jax
import jax.numpy as jnp
from flax import struct

from train.agents import Agent
from train.config import TrainConfig


class Sample(struct.PyTreeNode):
    """What the loss reads of one step; leading dimensions are whatever the batch has.

    `taught` tells where the action was that of a rule to imitate.
    """

    inputs: Any
    action: jax.Array
    taught: jax.Array
    log_prob: jax.Array
    value: jax.Array
    advantage: jax.Array


def ppo_loss(
    weights: Any,
    samples: Sample,
    advantage: jax.Array,
    target: jax.Array,
    agent: Agent,
    config: TrainConfig,
) -> tuple[jax.Array, dict[str, jax.Array]]:
    """Clipped surrogate, value error and entropy (Schulman et al. 2017, eq. 9).

    Where the action was taught, cross-entropy takes the surrogate's place.
    """
    logits, value = agent.evaluate(weights, samples.inputs)
    log_prob = agent.distribution.log_prob(logits, samples.action)
    log_ratio = log_prob - samples.log_prob
    ratio = jnp.exp(log_ratio)
    clipped = jnp.clip(ratio, 1 - config.clip, 1 + config.clip)
    surrogate = jnp.minimum(ratio * advantage, clipped * advantage)
    policy_loss = -jnp.where(samples.taught, log_prob, surrogate).mean()
    value_loss = 0.5 * jnp.square(value - target).mean()
    entropy = agent.distribution.entropy(logits).mean()
    loss = policy_loss + config.value_coefficient * value_loss - config.entropy_coefficient * entropy
    return loss, {
        "policy_loss": policy_loss,
        "value_loss": value_loss,
        "entropy": entropy,
        "approximate_kl": ((ratio - 1) - log_ratio).mean(),
        "clip_fraction": (jnp.abs(ratio - 1) > config.clip).mean(),
    }


def explained_variance(value: jax.Array, advantage: jax.Array) -> jax.Array:
    """Share of the returns' variance that the values explain; 1 is perfect."""
    target = value + advantage
    return 1 - advantage.var() / jnp.maximum(target.var(), 1e-12)
