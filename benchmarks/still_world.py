"""An environment that costs nothing, to time a learner alone."""

from typing import Any

import jax
import jax.numpy as jnp
from flax import struct

from jaxtrack.observation import TRACK_FEATURES, Observation
from jaxtrack.params import Params, StaticParams
from train.rollout import LOGGED

Step = tuple[Observation, "StillState", jax.Array, jax.Array, jax.Array, dict[str, Any]]


class StillState(struct.PyTreeNode):
    """Steps since the start, and the observation that every step shows again."""

    time: jax.Array
    observation: Observation


class StillWorld:
    """Observations of the environment's shapes that never change; no episode ends.

    The reward is the azimuth index of the look, so that the gradients are not zero.

    Args:
        static: shapes.
        live_tracks: fewest and most live tracks in an observation; they are in its first slots.
    """

    def __init__(self, static: StaticParams, live_tracks: tuple[int, int]) -> None:
        self.static, self.live_tracks = static, live_tracks

    def reset_env(self, key: jax.Array, params: Params) -> tuple[Observation, StillState]:
        """A random observation."""
        del params
        observation = random_observation(key, self.static, self.live_tracks)
        return observation, StillState(jnp.asarray(0), observation)

    def step(self, key: jax.Array, state: StillState, action: jax.Array, params: Params) -> Step:
        """The same observation again."""
        del key, params
        reward = action[0] / self.static.num_looks
        never = jnp.asarray(False)
        info = {"final_observation": state.observation, **{name: reward for name in LOGGED}}
        return state.observation, state.replace(time=state.time + 1), reward, never, never, info


def random_observation(key: jax.Array, static: StaticParams, live_tracks: tuple[int, int]) -> Observation:
    """Random numbers in the shapes of the environment's observation, padded as there.

    Returns:
        `tracks` `[T, 7]`, `mask` `[T]` and `scan_map` `[M, M]`.
    """
    key_number, key_tracks, key_map = jax.random.split(key, 3)
    number = jax.random.randint(key_number, (), live_tracks[0], live_tracks[1] + 1)
    mask = jnp.arange(static.max_tracks) < number
    tracks = jax.random.uniform(key_tracks, (static.max_tracks, TRACK_FEATURES), minval=-1.0)
    scan_map = jax.random.uniform(key_map, (static.map_size, static.map_size))
    return {"tracks": jnp.where(mask[:, None], tracks, 0.0), "mask": mask, "scan_map": scan_map}
