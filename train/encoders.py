"""Track-list encoders of the paper: flatten, BiGRU, and self-attention before a BiGRU.

Each maps a padded track list `[B, T, F]` and its mask `[B, T]` to a latent z_TL `[B, 64]`
(paper, section Network Design). Rows outside the mask may hold anything, NaN included: they
become zeros before any arithmetic, so that neither values nor gradients depend on them.
"""

import jax
import jax.numpy as jnp
from flax import linen as nn

from train.gru import Weights, gru
from train.orthogonal import orthogonal
from train.vision import GAIN

Dtype = jnp.dtype


class FlattenEncoder(nn.Module):
    """The zero-padded track list as one vector through one dense layer."""

    features: int = 64

    @nn.compact
    def __call__(self, tracks: jax.Array, mask: jax.Array) -> jax.Array:
        """Maps tracks `[B, T, F]` and mask `[B, T]` to a latent `[B, features]`."""
        flat = zero_padding(tracks, mask).reshape(tracks.shape[0], -1)
        return nn.relu(_dense(self.features)(flat))


class BiGRUEncoder(nn.Module):
    """Bidirectional GRU over the track list; its two final states through one dense layer."""

    hidden: int = 64
    features: int = 64

    @nn.compact
    def __call__(self, tracks: jax.Array, mask: jax.Array) -> jax.Array:
        """Maps tracks `[B, T, F]` and mask `[B, T]` to a latent `[B, features]`."""
        tracks = zero_padding(tracks, mask)
        forward = GRU(self.hidden, name="forward")(tracks, mask)
        # One direction after the other: on a machine with two cores XLA (jaxlib 0.10.2) starts both
        # loops at once, and inside another loop the two then wait for each other for ever.
        forward, tracks = jax.lax.optimization_barrier((forward, tracks))
        backward = GRU(self.hidden, reverse=True, name="backward")(tracks, mask)
        return nn.relu(_dense(self.features)(jnp.concatenate([forward, backward], axis=-1)))


class AttentionEncoder(nn.Module):
    """Multi-head self-attention over the tracks, then a BiGRU of half the stand-alone size."""

    embedding: int = 64
    heads: int = 4
    hidden: int = 32
    features: int = 64

    @nn.compact
    def __call__(self, tracks: jax.Array, mask: jax.Array) -> jax.Array:
        """Maps tracks `[B, T, F]` and mask `[B, T]` to a latent `[B, features]`."""
        x = _dense(self.embedding)(zero_padding(tracks, mask))
        x = nn.LayerNorm()(x + SelfAttention(self.heads)(x, mask))
        return BiGRUEncoder(self.hidden, self.features)(x, mask)


class SelfAttention(nn.Module):
    """Scaled dot-product attention of rows to the rows inside the mask (Vaswani et al. 2017)."""

    heads: int

    @nn.compact
    def __call__(self, x: jax.Array, mask: jax.Array) -> jax.Array:
        """Maps rows `[B, T, E]` and mask `[B, T]` to `[B, T, E]`; `heads` must divide E."""
        batch, length, embedding = x.shape
        qkv = nn.Dense(3 * embedding, kernel_init=nn.initializers.xavier_uniform(), name="qkv")(x)
        query, key, value = jnp.moveaxis(qkv.reshape(batch, length, 3, self.heads, -1), 2, 0)
        scores = jnp.einsum("bqhd,bkhd->bhqk", query, key) / query.shape[-1] ** 0.5
        # A finite floor, not -inf: an empty track list would make the whole row NaN.
        scores = jnp.where(mask[:, None, None, :], scores, jnp.finfo(scores.dtype).min)
        mixed = jnp.einsum("bhqk,bkhd->bqhd", nn.softmax(scores), value)
        return _dense(embedding, gain=1.0, name="out")(mixed.reshape(batch, length, embedding))


class GRU(nn.Module):
    """Final state of a gated recurrent unit that passes over rows outside the mask (`train.gru`)."""

    hidden: int
    reverse: bool = False
    """Reads the list from its last row to its first."""

    @nn.compact
    def __call__(self, x: jax.Array, mask: jax.Array) -> jax.Array:
        """Maps rows `[B, T, F]` and mask `[B, T]` to the final state `[B, hidden]`; 0 if empty."""
        wide, glorot = 3 * self.hidden, nn.initializers.xavier_uniform()
        weights = Weights(
            kernel=self.param("kernel", _per_gate(glorot), (x.shape[-1], wide)),
            bias=self.param("bias", nn.initializers.zeros, (wide,)),
            recurrent_kernel=self.param("recurrent_kernel", _per_gate(orthogonal()), (self.hidden, wide)),
            recurrent_bias=self.param("recurrent_bias", nn.initializers.zeros, (self.hidden,)),
        )
        return gru(weights, jnp.swapaxes(x, 0, 1), mask.T, self.reverse)


def zero_padding(tracks: jax.Array, mask: jax.Array) -> jax.Array:
    """Track list `[B, T, F]` with exact zeros in the rows outside the mask `[B, T]`."""
    return jnp.where(mask[..., None], tracks, 0.0)


def _dense(features: int, gain: float = GAIN, name: str | None = None) -> nn.Dense:
    return nn.Dense(features, kernel_init=orthogonal(gain), name=name)


def _per_gate(initialise: nn.initializers.Initializer) -> nn.initializers.Initializer:
    """Draws the three gates' kernels one by one, as fan-out and orthogonality are per gate."""

    def init(key: jax.Array, shape: tuple[int, int], dtype: Dtype = jnp.float32) -> jax.Array:
        fan_in, fan_out = shape[0], shape[1] // 3
        gates = jax.vmap(lambda key: initialise(key, (fan_in, fan_out), dtype))(jax.random.split(key, 3))
        return jnp.concatenate(list(gates), axis=-1)

    return init
