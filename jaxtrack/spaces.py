"""Spaces that gymnax 1.0.1 lacks: arrays of indices, and dictionaries that are dictionaries."""

from typing import Any

import jax
import jax.numpy as jnp
from gymnax.environments import spaces
from gymnax.environments.spaces import Box

__all__ = ["Box", "Dict", "Indices"]


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
        """Whether every entry of `x` is an index."""
        return jnp.all((x >= 0) & (x < self.count))


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
