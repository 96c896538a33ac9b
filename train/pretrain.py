"""Auto-encoder pre-training of a track-list encoder, as in the companion paper (arXiv 2502.13584).

Before the training the encoder learns to keep what a track list holds: a decoder, which is thrown away
afterwards, must reproduce the list from the latent.
"""

from typing import Any

import jax
import jax.numpy as jnp
import optax
from flax import linen as nn

from jaxtrack.env import SearchTrack
from jaxtrack.episode import EnvState
from jaxtrack.observation import Observation
from jaxtrack.params import Params
from jaxtrack.policies import POLICIES
from train.config import TrainConfig
from train.encoders import zero_padding
from train.networks import ENCODERS
from train.orthogonal import orthogonal
from train.vision import GAIN

LEARNING_RATE = 1e-3
WIDTH = 128
"""Of the decoder's hidden layer."""


class Decoder(nn.Module):
    """A latent back to a track list."""

    slots: int
    features: int

    @nn.compact
    def __call__(self, latent: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Maps latents `[B, Z]` to tracks `[B, T, F]` and to logits `[B, T]` that a slot holds one."""
        hidden = nn.relu(nn.Dense(WIDTH, kernel_init=orthogonal(GAIN))(latent))
        rows = nn.Dense(self.slots * (self.features + 1), kernel_init=orthogonal(1.0))(hidden)
        rows = rows.reshape(-1, self.slots, self.features + 1)
        return rows[..., 1:], rows[..., 0]


def reconstruction_loss(tracks: jax.Array, holds: jax.Array, observation: Observation) -> jax.Array:
    """Error `[]` of decoded track lists.

    The mean over live tracks of the squared error of their features, plus the mean over slots of the
    cross-entropy of whether there is a track.

    Args:
        tracks: `[B, T, F]` decoded.
        holds: `[B, T]` logits that there is a track.
        observation: the lists, `tracks` and `mask`.
    """
    mask = observation["mask"]
    squared = jnp.square(tracks - zero_padding(observation["tracks"], mask)).mean(axis=-1)
    of_tracks = jnp.sum(jnp.where(mask, squared, 0.0)) / jnp.maximum(mask.sum(), 1)
    return of_tracks + optax.sigmoid_binary_cross_entropy(holds, mask.astype(float)).mean()


def pretrain(
    key: jax.Array,
    weights: Any,
    observation: Observation,
    states: EnvState,
    scenario: Params,
    env: SearchTrack,
    config: TrainConfig,
) -> tuple[Any, jax.Array]:
    """Teaches the encoder in `weights` to keep track lists, on those that random looks lead to.

    Every environment takes `pretrain_steps / num_envs` steps, the optimiser one for each of them.

    Args:
        key: is consumed.
        weights: variables of one of the paper's networks.
        observation: of the B environments, `[B, ...]`.
        states: of the environments; they are left as they are.
        scenario: numbers of the environment.
        env: the environment.
        config: encoder and number of steps.

    Returns:
        The variables, of which the encoder's have changed, and the loss `[steps]`.
    """
    encoder = ENCODERS[config.encoder]()
    decoder = Decoder(env.static.max_tracks, observation["tracks"].shape[-1])
    look, optimiser = POLICIES["random"](env.static, scenario), optax.adam(LEARNING_RATE)
    key_decoder, key_looks, key = jax.random.split(key, 3)
    own = weights["params"]["track_list"]
    latent = encoder.apply({"params": own}, observation["tracks"], observation["mask"])
    both = (own, decoder.init(key_decoder, latent)["params"])
    looks = jax.random.split(key_looks, config.num_envs)

    def decode(own: Any, latent: Any) -> tuple[jax.Array, jax.Array]:
        result: Any = decoder.apply({"params": own}, latent)
        return result

    def loss(both: Any, observation: Observation) -> jax.Array:
        latent = encoder.apply({"params": both[0]}, observation["tracks"], observation["mask"])
        tracks, holds = decode(both[1], latent)
        return reconstruction_loss(tracks, holds, observation)

    def one_step(carry: Any, key: jax.Array) -> tuple[Any, jax.Array]:
        both, moments, observation, states = carry
        error, gradient = jax.value_and_grad(loss)(both, observation)
        change, moments = optimiser.update(gradient, moments)
        action = jax.vmap(look)(looks, states)
        keys = jax.random.split(key, config.num_envs)
        observation, states, *_ = jax.vmap(env.step, in_axes=(0, 0, 0, None))(keys, states, action, scenario)
        return (optax.apply_updates(both, change), moments, observation, states), error

    keys = jax.random.split(key, config.pretrain_steps // config.num_envs)
    carry: Any = (both, optimiser.init(both), observation, states)
    (both, *_), losses = jax.lax.scan(one_step, carry, keys)
    return {"params": {**weights["params"], "track_list": both[0]}}, losses
