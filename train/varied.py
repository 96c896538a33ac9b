"""Scenarios that change during a training: by a curriculum, or from episode to episode."""

import dataclasses
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct

from jaxtrack.env import SearchTrack
from jaxtrack.episode import EnvState
from jaxtrack.observation import Observation
from jaxtrack.params import Params
from jaxtrack.types import Scalar
from train.config import TrainConfig
from train.ranges import COUNTS


def scenario_at(update: Scalar, scenario: Params, config: TrainConfig) -> Params:
    """The scenario after so many updates: with the curriculum's numbers, if there is one."""
    way = jnp.minimum(update / (config.curriculum_share * config.num_updates), 1.0)
    numbers: dict[str, Any] = {}
    for name, (start, end) in config.curriculum.items():
        number = (1 - way) * start + way * end  # both ends are met exactly
        numbers[name] = jnp.round(number).astype(int) if name in COUNTS else number
    return dataclasses.replace(scenario, **numbers)


@struct.dataclass
class DrawnState(EnvState):
    """State of one scenario of which numbers were drawn.

    Attributes:
        drawn: `[]` each, the numbers of this episode by name.
    """

    drawn: dict[str, Any]


class RandomisedSearchTrack(SearchTrack):
    """Search and track with numbers that are drawn anew, uniformly, at the begin of every episode.

    Truths, radar, tracker and reward have the drawn numbers. An agent is not told them: what it
    sees is scaled by those of the scenario.
    """

    def __init__(self, env: SearchTrack, ranges: Mapping[str, tuple[float, float]]) -> None:
        super().__init__(env.static)
        self.ranges = {name: sorted(ends) for name, ends in sorted(ranges.items())}

    def _begin(self, key: jax.Array, params: Params) -> DrawnState:
        key_truths, *keys = jax.random.split(key, 1 + len(self.ranges))
        drawn: dict[str, Any] = {
            name: draw_between(each, name in COUNTS, *ends)
            for each, (name, ends) in zip(keys, self.ranges.items(), strict=True)
        }
        state = super()._begin(key_truths, dataclasses.replace(params, **drawn))
        return DrawnState(**vars(state), drawn=drawn)

    def step_env(
        self, key: jax.Array, state: EnvState, action: jax.Array, params: Params
    ) -> tuple[Observation, EnvState, jax.Array, jax.Array, dict[str, Any]]:
        """One step with the episode's own numbers."""
        assert isinstance(state, DrawnState)
        own = dataclasses.replace(params, **state.drawn)
        _, moved, reward, terminated, info = super().step_env(key, state, action, own)
        moved = DrawnState(**vars(moved), drawn=state.drawn)
        return self.observe(key, moved, action, params), moved, reward, terminated, info


def draw_between(key: jax.Array, whole: bool, low: float, high: float) -> jax.Array:
    """A number `[]` drawn uniformly between two, or of all whole ones with both ends; the key is consumed."""
    if whole:
        return jax.random.randint(key, (), low, high + 1)
    return jax.random.uniform(key, minval=low, maxval=high)


def randomised(env: SearchTrack, config: TrainConfig) -> SearchTrack:
    """The environment in which the training takes place; the given one where nothing is drawn."""
    return RandomisedSearchTrack(env, config.randomise) if config.randomise else env
