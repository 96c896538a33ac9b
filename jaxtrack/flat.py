"""`SearchTrack-v0` with a vector as observation, one number as action, and gymnax's old step.

PureJaxRL and rejax are written for gymnax before 1.0: for them

    env, params = jaxtrack.flat.make_legacy(reward="information")

stands in the place of `gymnax.make`.
"""

import math
from typing import Any

import jax
import jax.numpy as jnp
from gymnax.environments import spaces
from gymnax.wrappers import LegacyStepAPIWrapper

from jaxtrack.env import SearchTrack, make
from jaxtrack.episode import EnvState
from jaxtrack.params import Params
from jaxtrack.policies import to_action
from jaxtrack.spaces import Box


class FlatSearchTrack(SearchTrack):
    """`SearchTrack` with one vector as observation and, unless actions are continuous, one number as action.

    The observation `[F]` is, row by row, the mask, the scan map, the tracks, and the variances if
    there are any; the action is the number of a look, azimuth index x `num_looks` + elevation index.
    """

    def step_env(
        self, key: jax.Array, state: EnvState, action: jax.Array, params: Params
    ) -> tuple[Any, EnvState, jax.Array, jax.Array, dict[str, jax.Array]]:
        """One step: observation, state, reward, terminated, info."""
        look = action if self.static.continuous_actions else to_action(action, self.static, params)
        return super().step_env(key, state, look, params)

    def observe(self, key: jax.Array, state: EnvState, action: jax.Array | None, params: Params) -> Any:
        """The parts of the observation in the order of their names, one after the other."""
        parts = jax.tree.leaves(super().observe(key, state, action, params))
        return jnp.concatenate([part.astype(float).ravel() for part in parts])

    def action_space(self, params: Params) -> Any:
        """An integer in [0, num_looks^2), or two angles in rad."""
        if self.static.continuous_actions:
            return super().action_space(params)
        return spaces.Discrete(self.num_actions)

    def observation_space(self, params: Params) -> Any:
        """A vector of numbers without bounds."""
        parts = super().observation_space(params).spaces.values()
        return Box(-jnp.inf, jnp.inf, (sum(math.prod(part.shape) for part in parts),), jnp.float32)


class LegacyStep(LegacyStepAPIWrapper):
    """gymnax's wrapper for the step of five values, which rejax can also copy."""

    def __deepcopy__(self, memo: dict[int, Any]) -> "LegacyStep":
        """Itself, as it never changes: without this, copying gymnax 1.0.1's wrapper never ends."""
        return self


def make_legacy(**fields: Any) -> tuple[LegacyStep, Params]:
    """The environment as learners for gymnax before 1.0 want it, and its parameters.

    Args:
        **fields: any field of `Params` or `StaticParams`, or whole ones as `params` and `static`.

    Raises:
        ValueError: naming the wrong field and its range, or a field that does not exist.
    """
    env, params = make(**fields)
    return LegacyStep(FlatSearchTrack(env.static)), params
