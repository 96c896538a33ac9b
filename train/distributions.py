"""Distributions over looks: factored (two heads of L logits) and joint (one of L * L).

Both are used the same way, so that the learner does not care which one a policy has. An
action is int32 `[..., 2]`: the azimuth index and the elevation index, each in [0, L).
"""

import math
from typing import Protocol

import jax
import jax.numpy as jnp


class Distribution(Protocol):
    """What the learner asks of a distribution; logits need not be normalised."""

    def sample(self, key: jax.Array, logits: jax.Array) -> jax.Array:
        """Draws actions, int32 `[..., 2]`."""

    def log_prob(self, logits: jax.Array, action: jax.Array) -> jax.Array:
        """Log-probability `[...]` of actions `[..., 2]`."""

    def entropy(self, logits: jax.Array) -> jax.Array:
        """Entropy `[...]` in nats."""

    def mode(self, logits: jax.Array) -> jax.Array:
        """Most probable actions, int32 `[..., 2]`."""


class Factored:
    """Independent azimuth and elevation: logits `[..., 2, L]` (the paper's MultiDiscrete)."""

    def sample(self, key: jax.Array, logits: jax.Array) -> jax.Array:
        """Draws actions, int32 `[..., 2]`."""
        return jax.random.categorical(key, logits).astype(jnp.int32)

    def log_prob(self, logits: jax.Array, action: jax.Array) -> jax.Array:
        """Joint log-probability `[...]` of actions `[..., 2]`, the sum over both heads."""
        return _log_prob(logits, action).sum(axis=-1)

    def entropy(self, logits: jax.Array) -> jax.Array:
        """Joint entropy `[...]` in nats, the sum over both heads."""
        return _entropy(logits).sum(axis=-1)

    def mode(self, logits: jax.Array) -> jax.Array:
        """Most probable actions, int32 `[..., 2]`."""
        return jnp.argmax(logits, axis=-1).astype(jnp.int32)


class Joint:
    """One softmax over all looks: logits `[..., L * L]`, look (i, j) at index ``i L + j``."""

    def sample(self, key: jax.Array, logits: jax.Array) -> jax.Array:
        """Draws actions, int32 `[..., 2]`."""
        return _to_pair(jax.random.categorical(key, logits), logits)

    def log_prob(self, logits: jax.Array, action: jax.Array) -> jax.Array:
        """Log-probability `[...]` of actions `[..., 2]`."""
        return _log_prob(logits, action[..., 0] * _looks(logits) + action[..., 1])

    def entropy(self, logits: jax.Array) -> jax.Array:
        """Entropy `[...]` in nats."""
        return _entropy(logits)

    def mode(self, logits: jax.Array) -> jax.Array:
        """Most probable actions, int32 `[..., 2]`."""
        return _to_pair(jnp.argmax(logits, axis=-1), logits)


FACTORED: Distribution = Factored()
JOINT: Distribution = Joint()


def _looks(logits: jax.Array) -> int:
    looks = math.isqrt(logits.shape[-1])
    if looks * looks != logits.shape[-1]:
        raise ValueError(f"logits of shape {logits.shape}: expected a square number of looks, L * L")
    return looks


def _to_pair(index: jax.Array, logits: jax.Array) -> jax.Array:
    return jnp.stack(jnp.divmod(index, _looks(logits)), axis=-1).astype(jnp.int32)


def _log_prob(logits: jax.Array, index: jax.Array) -> jax.Array:
    return jnp.take_along_axis(jax.nn.log_softmax(logits), index[..., None], axis=-1)[..., 0]


def _entropy(logits: jax.Array) -> jax.Array:
    log_p = jax.nn.log_softmax(logits)
    # Where a look is impossible (logit -inf) p log p is 0, not NaN; also in the gradient.
    finite = jnp.isfinite(log_p)
    return -jnp.sum(jnp.where(finite, jnp.exp(log_p) * jnp.where(finite, log_p, 0.0), 0.0), axis=-1)
