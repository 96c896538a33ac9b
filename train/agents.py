"""An agent: fixed features, a network, and the distribution its logits belong to."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
from flax import linen as nn

from jaxtrack.observation import Observation, observe
from jaxtrack.params import Params, StaticParams
from jaxtrack.policies import Policy
from train.cells import CellGeometry, CellNetwork
from train.distributions import FACTORED, JOINT, Distribution
from train.networks import ENCODERS, PaperNetwork

AGENTS = ("cells", *ENCODERS)
"""Names of the policies that can be trained: the per-cell one, then the paper's three."""


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


def build_agent(name: str, static: StaticParams, params: Params) -> Agent:
    """The agent of that name for a scenario.

    Raises:
        ValueError: if the name is none of `AGENTS`.
    """
    if name not in AGENTS:
        raise ValueError(f"encoder = {name!r}: expected one of {', '.join(AGENTS)}")
    if name == "cells":
        return Agent(CellGeometry(static, params), CellNetwork(), JOINT)
    network = PaperNetwork(encoder=name, num_looks=static.num_looks)
    return Agent(lambda observation: observation, network, FACTORED)


def as_policy(agent: Agent, weights: Any, params: Params, greedy: bool = False) -> Policy:
    """The trained agent behind the signature of the baselines; it samples unless `greedy`."""

    def policy(key: jax.Array, state: Any) -> jax.Array:
        observation = observe(state.tracks, state.scan_map, params)
        inputs = jax.tree.map(lambda leaf: leaf[None], agent.features(observation))
        logits, _ = agent.network.apply(weights, inputs)
        if greedy:
            return agent.distribution.mode(logits)[0]
        return agent.distribution.sample(jax.random.fold_in(key, state.time), logits)[0]

    return policy
