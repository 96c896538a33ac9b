"""Spaces that gymnax 1.0.1 lacks: index arrays, boxes without bounds, dictionaries of observations."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from gymnax.environments import spaces

__all__ = ["Box", "Dict", "Indices"]


class Box(spaces.Box):
    """gymnax's `Box` draws NaN where it has no bounds, and only True where it is boolean."""

    def sample(self, key: jax.Array) -> jax.Array:
        """Standard normal without bounds, a fair coin for booleans, else uniform."""
        if np.isinf(self.low) or np.isinf(self.high):
            return jax.random.normal(key, self.shape, self.dtype)
        if self.dtype == jnp.bool_:
            return jax.random.bernoulli(key, shape=self.shape)
        return super().sample(key)


class Indices(spaces.Space):
    """Integer arrays of a shape, each entry in [0, count): Gymnasium's `MultiDiscrete`."""

    def __init__(self, count: int, shape: tuple[int, ...]) -> None:
        self.count = count
        self.shape = shape
        self.low, self.high = 0, count - 1
        self.dtype = jnp.int32

    def sample(self, key: jax.Array) -> jax.Array:
        """Uniform over all indices, the last included."""
        return jax.random.randint(key, self.shape, 0, self.count, self.dtype)

    def contains(self, x: jax.Array) -> jax.Array:
        """Whether `x` has this shape and every entry is an index."""
        whole = jnp.issubdtype(jnp.asarray(x).dtype, jnp.integer) and jnp.shape(x) == self.shape
        return jnp.all((x >= 0) & (x < self.count)) & whole


class Dict(spaces.Dict):
    """gymnax's `Dict` looks for attributes; observations here are plain dictionaries."""

    def contains(self, x: Any) -> jax.Array:
        """Whether `x` has exactly these keys, shapes, and values in range."""
        if set(x) != set(self.spaces):
            return jnp.asarray(False)
        inside = [
            jnp.shape(x[key]) == space.shape and space.contains(x[key]) for key, space in self.spaces.items()
        ]
        return jnp.all(jnp.array(inside))
