"""What a training carries from one update to the next."""

from typing import Any

import jax
from flax import struct

from jaxtrack.episode import EnvState
from jaxtrack.params import Params


class LearnerState(struct.PyTreeNode):
    """Everything that training carries from one update to the next, B environments.

    Attributes:
        weights: variables of the network.
        optimiser: state of Adam.
        env: states of the environments.
        inputs: network inputs of the current observations.
        episode_return: `[B]` reward summed since the episode began.
        episode_length: `[B]` steps since the episode began.
        scenario: numbers of the environment; traced, so that changing them recompiles nothing. What
            a curriculum moves is as in the last update.
        key: random key data.
        update: `[]` updates done.
    """

    weights: Any
    optimiser: Any
    env: EnvState
    inputs: Any
    episode_return: jax.Array
    episode_length: jax.Array
    scenario: Params
    key: jax.Array
    update: jax.Array

    def of_environments(self) -> "LearnerState":
        """The same tree with True for the arrays whose rows belong to environments, False for all others."""

        def marked(name: str, tree: Any) -> Any:
            own = name in ("env", "inputs", "episode_return", "episode_length")
            return jax.tree.map(lambda _: own, tree)

        return LearnerState(**{name: marked(name, tree) for name, tree in vars(self).items()})
