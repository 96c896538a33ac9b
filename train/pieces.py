"""The gradient of a minibatch, summed over pieces small enough for the cache.

Encoders that take track lists of any length get each piece without the slots that are empty in
all of it. So that pieces hold lists of like length, a minibatch is sorted by them first.
"""

from typing import Any

import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree

from jaxtrack.kernel import stage
from train.agents import Agent
from train.config import TrainConfig
from train.devices import ALONE, Share
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
    weights: Any, samples: Sample, rows: jax.Array, agent: Agent, config: TrainConfig, share: Share = ALONE
) -> tuple[Any, dict[str, jax.Array]]:
    """Gradient of the loss over a minibatch, and what the loss reports, as means over its pieces.

    Args:
        weights: of the network.
        samples: all of this device.
        rows: `[M]` those of them that are in the minibatch.
        agent: the agent.
        config: of the whole training.
        share: what this device does of it.
    """
    advantages = share.all(samples.advantage[rows])
    mean, spread = advantages.mean(), advantages.std() + 1e-8
    pieces = rows.reshape(-1, config.piece_size)

    def of_piece(weights: Any, samples: Sample, advantage: jax.Array, target: jax.Array) -> Any:
        return piece_gradient(weights, samples, advantage, target, agent, config)

    def gradient(rows: jax.Array) -> Any:
        piece = jax.tree.map(lambda leaf: leaf[rows], samples)
        target = piece.value + piece.advantage
        # A stage: where samples are taken must not merge with what lays out patches of their maps.
        return stage(of_piece)(weights, piece, (piece.advantage - mean) / spread, target)

    def add_piece(total: Any, rows: jax.Array) -> tuple[Any, None]:
        return jax.tree.map(jnp.add, total, gradient(rows)), None

    shapes = jax.eval_shape(gradient, pieces[0])
    zeros = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes)
    total, _ = jax.lax.scan(add_piece, zeros, pieces)
    # As one row: the devices wait for each other once for every array that is added up.
    row, unravel = ravel_pytree(total)
    result: Any = unravel(share.add(row) / (len(pieces) * share.number))
    return result


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
