"""An agent: fixed features, a network, and the distribution its logits belong to."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
from flax import linen as nn

from jaxtrack.episode import EnvState
from jaxtrack.observation import Observation, observe
from jaxtrack.params import Params, StaticParams
from jaxtrack.policies import Policy, PolicyBuilder
from train.beams import BeamGeometry, BeamNetwork
from train.distributions import FACTORED, JOINT, Distribution
from train.networks import ENCODERS, PaperNetwork

AGENTS = ("beams", *ENCODERS)
"""Names of the policies that can be trained: the beam policy, then the paper's three."""


class Agent(NamedTuple):
    """What the learner needs of a policy.

    Attributes:
        features: one observation to network inputs; nothing in it is learned.
        network: batched inputs to (logits, value).
        distribution: of actions, given logits.
    """

    features: Callable[[Observation], Any]
    network: nn.Module
    distribution: Distribution

    def evaluate(self, weights: Any, inputs: Any) -> tuple[jax.Array, jax.Array]:
        """Logits and value of batched inputs."""
        result: Any = self.network.apply(weights, inputs)
        return result


def build_agent(name: str, static: StaticParams, params: Params) -> Agent:
    """The agent of that name for a scenario.

    Call it inside the jitted program, where `params` are traced: what the geometry fixes is
    then computed there once, instead of being compiled in as a large constant.

    Raises:
        ValueError: if the name is none of `AGENTS`.
    """
    if name not in AGENTS:
        raise ValueError(f"encoder = {name!r}: expected one of {', '.join(AGENTS)}")
    if name == "beams":
        return Agent(BeamGeometry(static, params), BeamNetwork(), JOINT)
    network = PaperNetwork(encoder=name, num_looks=static.num_looks)
    return Agent(lambda observation: observation, network, FACTORED)


def agent_policy(name: str, weights: Any, greedy: bool = False) -> PolicyBuilder:
    """A trained agent in the form of the baselines; it samples its looks unless `greedy`."""

    def build(static: StaticParams, params: Params) -> Policy:
        agent = build_agent(name, static, params)

        def policy(key: jax.Array, state: EnvState) -> jax.Array:
            observation = observe(state.tracks, state.scan_map, params, static.observe_variances)
            inputs = jax.tree.map(lambda leaf: leaf[None], agent.features(observation))
            logits, _ = agent.evaluate(weights, inputs)
            if greedy:
                return agent.distribution.mode(logits)[0]
            return agent.distribution.sample(jax.random.fold_in(key, state.time), logits)[0]

        return policy

    return build
