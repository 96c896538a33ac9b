"""Distributions over looks: factored (two heads of L logits) and joint (one of L * L).

All are used the same way, so that the learner does not care which one a policy has. An
action is int32 `[..., 2]`: the azimuth index and the elevation index, each in [0, L).

Where actions are continuous it is float `[..., 2]`: azimuth and elevation (rad). `OnGrid` makes a
distribution of the angles of discrete looks out of one of those above; `Gaussian` has all of the field.
"""

import dataclasses
import math
from typing import Protocol

import jax
import jax.numpy as jnp
from jax.scipy.stats import norm

from jaxtrack.params import Params, StaticParams
from jaxtrack.sensor import look_angles, look_indices

SMALLEST_SIGMA, LARGEST_SIGMA = 1e-3, 2.0
"""Between these, per limit of the field, lies the standard deviation of a Gaussian."""


class Distribution(Protocol):
    """What the learner asks of a distribution; logits are whatever numbers it takes from a network."""

    def sample(self, key: jax.Array, logits: jax.Array) -> jax.Array:
        """Draws actions `[..., 2]`."""

    def log_prob(self, logits: jax.Array, action: jax.Array) -> jax.Array:
        """Log-probability, or its density per rad^2, `[...]` of actions `[..., 2]`."""

    def entropy(self, logits: jax.Array) -> jax.Array:
        """Entropy `[...]` in nats."""

    def mode(self, logits: jax.Array) -> jax.Array:
        """Most probable actions `[..., 2]`."""


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


class OnGrid:
    """Continuous actions, of which only the angles of the discrete looks are ever taken.

    An action elsewhere counts as the look nearest to it. Looks beside the grid would leave slivers of the
    field unseen: docs/training.md tells what they cost.

    Args:
        indices: over indices of looks.
        static: shapes.
        params: numbers.
    """

    def __init__(self, indices: Distribution, static: StaticParams, params: Params) -> None:
        self.indices, self.static, self.params = indices, static, params

    def sample(self, key: jax.Array, logits: jax.Array) -> jax.Array:
        """Draws actions `[..., 2]` (rad)."""
        return self._angles(self.indices.sample(key, logits))

    def log_prob(self, logits: jax.Array, action: jax.Array) -> jax.Array:
        """Log-probability `[...]` of the looks nearest to actions `[..., 2]`; no density."""
        return self.indices.log_prob(logits, look_indices(action, self.static, self.params))

    def entropy(self, logits: jax.Array) -> jax.Array:
        """Entropy `[...]` in nats."""
        return self.indices.entropy(logits)

    def mode(self, logits: jax.Array) -> jax.Array:
        """Most probable actions `[..., 2]` (rad)."""
        return self._angles(self.indices.mode(logits))

    def _angles(self, pairs: jax.Array) -> jax.Array:
        return look_angles(pairs, dataclasses.replace(self.static, continuous_actions=False), self.params)


class Gaussian:
    """Independent azimuth and elevation, each normal and cut off at the edges of the field.

    Logits `[..., 2, 2]`: for each of the two angles its mean before a tanh, which keeps it in the field, and
    its standard deviation before a logistic function. All zero they give the field's middle and its limit.

    Args:
        limit: of the field (rad).
    """

    def __init__(self, limit: jax.Array | float) -> None:
        self.limit = limit

    def sample(self, key: jax.Array, logits: jax.Array) -> jax.Array:
        """Draws actions `[..., 2]` (rad)."""
        mean, sigma = self._moments(logits)
        low, high = self._edges(mean, sigma)
        drawn = mean + sigma * jax.random.truncated_normal(key, low, high)
        return jnp.clip(drawn, -self.limit, self.limit)  # rounding

    def log_prob(self, logits: jax.Array, action: jax.Array) -> jax.Array:
        """Log-density `[...]` per rad^2 of actions `[..., 2]` in the field."""
        mean, sigma = self._moments(logits)
        return (norm.logpdf(action, mean, sigma) - jnp.log(self._inside(mean, sigma))).sum(axis=-1)

    def entropy(self, logits: jax.Array) -> jax.Array:
        """Differential entropy `[...]` in nats."""
        mean, sigma = self._moments(logits)
        low, high = self._edges(mean, sigma)
        inside = self._inside(mean, sigma)
        whole = jnp.log(sigma * inside) + (1 + math.log(2 * math.pi)) / 2
        cut = (low * norm.pdf(low) - high * norm.pdf(high)) / (2 * inside)
        return (whole + cut).sum(axis=-1)

    def mode(self, logits: jax.Array) -> jax.Array:
        """Most probable actions `[..., 2]` (rad)."""
        return self._moments(logits)[0]

    def _moments(self, logits: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Mean and standard deviation `[..., 2]` (rad) before what lies outside the field is cut off."""
        mean, spread = jnp.moveaxis(logits, -1, 0)
        share = SMALLEST_SIGMA + (LARGEST_SIGMA - SMALLEST_SIGMA) * jax.nn.sigmoid(spread)
        return self.limit * jnp.tanh(mean), self.limit * share

    def _edges(self, mean: jax.Array, sigma: jax.Array) -> tuple[jax.Array, jax.Array]:
        """The field's edges in standard deviations from the mean."""
        return (-self.limit - mean) / sigma, (self.limit - mean) / sigma

    def _inside(self, mean: jax.Array, sigma: jax.Array) -> jax.Array:
        """The part that lies in the field: at least a third, as the mean does and sigma is bounded."""
        low, high = self._edges(mean, sigma)
        return norm.cdf(high) - norm.cdf(low)


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
