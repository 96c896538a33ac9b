"""An agent: fixed features, a network, and the distribution its logits belong to."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from flax import linen as nn

from jaxtrack.episode import EnvState
from jaxtrack.observation import Observation, observe
from jaxtrack.params import Params, StaticParams
from jaxtrack.policies import Policy, PolicyBuilder
from train.beams import BeamGeometry, BeamNetwork
from train.distributions import FACTORED, JOINT, Distribution, Gaussian, OnGrid
from train.networks import ANY_LENGTH, ENCODERS, PaperNetwork

AGENTS = ("beams", *ENCODERS)
"""Names of the policies that can be trained: the beam policy, then the paper's three."""


SHARES = (2, 1)
"""Track lists of T slots are cut to T / share. What is done with them is compiled for each length, and in
the paper's scenario a half is enough for whatever a policy tracks."""


class TrackLists(NamedTuple):
    """How to leave out the empty slots at the end of track lists, which change no result.

    Attributes:
        slots: number T of slots of a list.
        used: batched inputs to the numbers `[B]` of slots up to the last track.
        cut: batched inputs and a length to the same inputs with so many slots.
    """

    slots: int
    used: Callable[[Any], jax.Array]
    cut: Callable[[Any, int], Any]

    def apply(self, function: Callable[[Any], Any], inputs: Any) -> Any:
        """`function` of batched inputs, their lists cut to the first length into which all fit."""
        lengths = sorted({-(-self.slots // share) for share in SHARES})
        fits = jnp.searchsorted(jnp.asarray(lengths), jnp.max(self.used(inputs)))
        branches = [lambda length=length: function(self.cut(inputs, length)) for length in lengths]
        return jax.lax.switch(fits, branches)


class Agent(NamedTuple):
    """What the learner needs of a policy.

    Attributes:
        features: one observation to network inputs; nothing in it is learned.
        network: batched inputs to (logits, value).
        distribution: of actions, given logits.
        lists: where the network takes track lists of any length.
    """

    features: Callable[[Observation], Any]
    network: nn.Module
    distribution: Distribution
    lists: TrackLists | None = None

    def evaluate(self, weights: Any, inputs: Any) -> tuple[jax.Array, jax.Array]:
        """Logits and value of batched inputs."""
        result: Any = self.network.apply(weights, inputs)
        return result

    def evaluate_quickly(self, weights: Any, inputs: Any) -> tuple[jax.Array, jax.Array]:
        """The same, but for rounding, with the lists cut; not to be differentiated."""
        result: Any = self.on_short_lists(lambda cut: self.evaluate(weights, cut), inputs)
        return result

    def on_short_lists(self, function: Callable[[Any], Any], inputs: Any) -> Any:
        """`function` of batched inputs without the slots that are empty in all of them, where that helps."""
        return self.lists.apply(function, inputs) if self.lists else function(inputs)


def build_agent(name: str, static: StaticParams, params: Params, head: str = "beams") -> Agent:
    """The agent of that name for a scenario.

    Call it inside the jitted program, where `params` are traced: what the geometry fixes is
    then computed there once, instead of being compiled in as a large constant.

    Args:
        name: one of `AGENTS`.
        static: shapes.
        params: numbers.
        head: how it chooses a look, one of `train.networks.HEADS`; the beam policy has only "beams".

    Raises:
        ValueError: if the name is none of `AGENTS`.
    """
    if name not in AGENTS:
        raise ValueError(f"encoder = {name!r}: expected one of {', '.join(AGENTS)}")
    if name == "beams":
        return Agent(BeamGeometry(static, params), BeamNetwork(), build_distribution(head, static, params))
    network = PaperNetwork(encoder=name, head=head, num_looks=static.num_looks)
    distribution = build_distribution(head, static, params)
    lists = TrackLists(static.max_tracks, used_slots, cut_lists) if name in ANY_LENGTH else None
    if head != "beams":
        return Agent(lambda observation: observation, network, distribution, lists)
    beams = BeamGeometry(static, params)
    return Agent(
        lambda observation: {**observation, "beams": beams(observation)}, network, distribution, lists
    )


def build_distribution(head: str, static: StaticParams, params: Params) -> Distribution:
    """The distribution that a head's logits belong to, over indices or over angles."""
    if head == "gaussian":
        return Gaussian(params.field_limit)
    indices = FACTORED if head == "factored" else JOINT
    return OnGrid(indices, static, params) if static.continuous_actions else indices


def used_slots(observations: dict[str, Any]) -> jax.Array:
    """Slots `[B]` up to the last track of each observation."""
    mask = observations["mask"]
    return jnp.max(jnp.where(mask, jnp.arange(1, mask.shape[-1] + 1), 0), axis=-1)


def cut_lists(observations: dict[str, Any], length: int) -> dict[str, Any]:
    """The observations with the first `length` slots of their track lists."""
    cut = {name: observations[name][:, :length] for name in ("mask", "tracks")}
    if "beams" in observations:
        cut["beams"] = observations["beams"].first_tracks(length)
    return {**observations, **cut}


def agent_policy(name: str, weights: Any, greedy: bool = False, head: str = "beams") -> PolicyBuilder:
    """A trained agent in the form of the baselines; it samples its looks unless `greedy`."""

    def build(static: StaticParams, params: Params) -> Policy:
        agent = build_agent(name, static, params, head)

        def policy(key: jax.Array, state: EnvState) -> jax.Array:
            observation = observe(state.tracks, state.scan_map, params, static.observe_variances)
            inputs = jax.tree.map(lambda leaf: leaf[None], agent.features(observation))
            logits, _ = agent.evaluate(weights, inputs)
            if greedy:
                return agent.distribution.mode(logits)[0]
            return agent.distribution.sample(jax.random.fold_in(key, state.time), logits)[0]

        return policy

    return build
