"""How often a track was detected, and how long ago: what deleters by time and initiators of several hits ask.

The default tracker asks neither and keeps none of it.
"""

import jax
import jax.numpy as jnp
from flax import struct

MICROSECONDS = 1_000_000
LONGEST = 2**30
"""Longest duration of a step that is told apart (microseconds), 18 minutes: two of them are an int32."""


class Counts(struct.PyTreeNode):
    """Counts of each of T tracks.

    Attributes:
        hits: `[T]` detections so far, the one at birth included.
        missed_steps: `[T]` steps since the last detection; steps of no duration do not count.
        missed_time: `[T]` time since the last detection (microseconds), less than `LONGEST`. Whole
            microseconds, as in Stone Soup, so that sums of time steps are exact.
    """

    hits: jax.Array  # [T] int
    missed_steps: jax.Array  # [T] int
    missed_time: jax.Array  # [T] int

    @classmethod
    def zero(cls, max_tracks: int) -> "Counts":
        """Counts of tracks that do not exist."""
        nothing = jnp.zeros(max_tracks, dtype=int)
        return cls(hits=nothing, missed_steps=nothing, missed_time=nothing)

    def predicted(self, time_step: jax.Array) -> "Counts":
        """After `time_step` `[]` (s), before it is known what was detected."""
        duration = to_microseconds(time_step)
        return self.replace(
            missed_steps=self.missed_steps + (duration > 0),
            missed_time=jnp.minimum(self.missed_time + duration, LONGEST - 1),
        )

    def updated(self, is_updated: jax.Array) -> "Counts":
        """After an update of the tracks `[T]`."""
        return Counts(
            hits=self.hits + is_updated,
            missed_steps=jnp.where(is_updated, 0, self.missed_steps),
            missed_time=jnp.where(is_updated, 0, self.missed_time),
        )

    def initiated(self, born: jax.Array) -> "Counts":
        """After the birth of tracks `[T]`."""
        return Counts(
            hits=jnp.where(born, 1, self.hits),
            missed_steps=jnp.where(born, 0, self.missed_steps),
            missed_time=jnp.where(born, 0, self.missed_time),
        )


def to_microseconds(seconds: jax.Array | float) -> jax.Array:
    """Whole microseconds of a time (s), at most `LONGEST`; halves go to the even number."""
    return jnp.minimum(jnp.round(jnp.asarray(seconds, dtype=float) * MICROSECONDS), LONGEST).astype(int)
