"""Recorded episodes: play one with a policy and keep everything, for pictures and analysis."""

import dataclasses
from typing import TYPE_CHECKING, Any

import jax
import numpy as np

from jaxtrack import metrics
from jaxtrack.params import Params, StaticParams
from jaxtrack.policies import Policy

if TYPE_CHECKING:  # at run time it would bring gymnax, and that matplotlib, along
    from jaxtrack.env import SearchTrack
    from jaxtrack.episode import EnvState, StepRecord


@dataclasses.dataclass(frozen=True)
class Episode:
    """A recorded episode of S steps; every array has a leading axis S and lies on the host.

    Attributes:
        static: shapes of the scenario.
        params: numbers of the scenario.
        states: the states after each step.
        records: what happened in each step.
        completeness: `[S]` share of the truths that have a track.
        gospa: `[S]` GOSPA distance (m).
    """

    static: StaticParams
    params: Params
    states: "EnvState"
    records: "StepRecord"
    completeness: np.ndarray  # [S]
    gospa: np.ndarray  # [S]

    def __len__(self) -> int:
        """Number of steps."""
        return len(self.completeness)


def record_episode(
    env: "SearchTrack", params: Params, policy: Policy, key: jax.Array, num_steps: int | None = None
) -> Episode:
    """Plays one episode and keeps everything.

    Args:
        env: the environment.
        params: numbers of the scenario.
        policy: the look for a state; gets the same key on every step of the episode.
        key: consumed.
        num_steps: length; the scenario's own where not given.

    Raises:
        ValueError: if the length is below 1.
    """
    steps = int(params.max_steps_in_episode) if num_steps is None else num_steps
    if steps < 1:
        raise ValueError(f"num_steps = {steps}: expected an integer >= 1")

    @jax.jit
    def play(key: jax.Array) -> Any:
        key_reset, key_policy, key_steps = jax.random.split(key, 3)

        def step(state: "EnvState", key: jax.Array) -> tuple["EnvState", Any]:
            action = policy(key_policy, state)
            state, record = env.advance(state, action, env.sample_noise(key), params)
            completeness = metrics.completeness(state.truths, state.tracks, params)
            distance = metrics.gospa(state.truths, state.tracks, params).distance
            return state, (state, record, completeness, distance)

        _, state = env.reset_env(key_reset, params)
        return jax.lax.scan(step, state, jax.random.split(key_steps, steps))[1]

    return Episode(env.static, params, *jax.tree.map(np.asarray, play(key)))
