"""The gradient of a minibatch, summed over pieces small enough for the cache.

Encoders that take track lists of any length get each piece without the slots that are empty in
all of it. So that pieces hold lists of like length, a minibatch is sorted by them first.
"""

from typing import Any

import jax
import jax.numpy as jnp

from train.agents import Agent
from train.config import TrainConfig
from train.loss import Sample, ppo_loss


def shortest_first(rows: jax.Array, inputs: Any, agent: Agent) -> jax.Array:
    """The rows `[M]` of a minibatch in order of their lists' lengths, where that is of use.

    Args:
        rows: which of the samples.
        inputs: network inputs of all samples.
        agent: its `lists` tell how long lists are.
    """
    if agent.lists is None:
        return rows
    return rows[jnp.argsort(agent.lists.used(inputs)[rows])]


def minibatch_gradient(
    weights: Any, minibatch: Sample, agent: Agent, config: TrainConfig
) -> tuple[Any, dict[str, jax.Array]]:
    """Gradient of the loss over a minibatch, and what the loss reports, as means over its pieces."""
    spread = minibatch.advantage.std() + 1e-8
    normalised = (minibatch.advantage - minibatch.advantage.mean()) / spread
    target = minibatch.value + minibatch.advantage
    pieces = config.minibatch_size // config.piece_size
    split = jax.tree.map(
        lambda leaf: leaf.reshape(pieces, config.piece_size, *leaf.shape[1:]),
        (minibatch, normalised, target),
    )

    def gradient(piece: tuple[Sample, jax.Array, jax.Array]) -> Any:
        return piece_gradient(weights, *piece, agent, config)

    def add_piece(total: Any, piece: Any) -> tuple[Any, None]:
        return jax.tree.map(jnp.add, total, gradient(piece)), None

    shapes = jax.eval_shape(gradient, jax.tree.map(lambda leaf: leaf[0], split))
    zeros = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes)
    total, _ = jax.lax.scan(add_piece, zeros, split)
    return jax.tree.map(lambda leaf: leaf / pieces, total)


def piece_gradient(
    weights: Any, samples: Sample, advantage: jax.Array, target: jax.Array, agent: Agent, config: TrainConfig
) -> tuple[Any, dict[str, jax.Array]]:
    """Gradient of the loss over a piece, with its track lists as short as they may be cut."""

    def gradient(inputs: Any) -> Any:
        short = samples.replace(inputs=inputs)
        return jax.grad(ppo_loss, has_aux=True)(weights, short, advantage, target, agent, config)

    # Outside the gradient: inside, every branch would fill in what the others keep for the way back.
    result: Any = agent.on_short_lists(gradient, samples.inputs)
    return result
