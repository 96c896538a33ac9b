"""Agents by name, and trained agents in the form of the baselines."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxtrack import Params, StaticParams
from jaxtrack.env import SearchTrack
from jaxtrack.observation import observe
from jaxtrack.sensor import look_angles
from train.agents import AGENTS, Agent, agent_policy, build_agent
from train.beams import BeamGeometry, BeamNetwork
from train.distributions import FACTORED, JOINT, Gaussian, OnGrid

pytestmark = pytest.mark.usefixtures("quick_compilation")

STATIC = StaticParams(num_truths=2, max_tracks=3, map_size=36, num_looks=4)
CONTINUOUS = dataclasses.replace(STATIC, continuous_actions=True)
PARAMS = Params()


def shapes(agent):
    """Shapes of logits and value for a batch of two observations."""
    observation = {
        "tracks": jnp.zeros((2, 3, 7)),
        "mask": jnp.zeros((2, 3), dtype=bool),
        "scan_map": jnp.zeros((2, 36, 36)),
    }

    def evaluate(key):
        inputs = jax.vmap(agent.features)(observation)
        return agent.evaluate(agent.network.init(key, inputs), inputs)

    return [leaf.shape for leaf in jax.eval_shape(evaluate, jax.random.key(0))]


def test_the_agents_are_the_beam_policy_and_the_papers_three():
    assert AGENTS == ("beams", "flatten", "bigru", "mhsa")


def test_beams_have_one_logit_per_look():
    agent = build_agent("beams", STATIC, PARAMS)
    assert isinstance(agent.network, BeamNetwork)
    assert agent.distribution is JOINT
    assert shapes(agent) == [(2, 16), (2,)]


@pytest.mark.parametrize("name", ["flatten", "bigru", "mhsa"])
@pytest.mark.parametrize(
    ("head", "distribution", "logits"),
    [("factored", FACTORED, (2, 2, 4)), ("joint", JOINT, (2, 16)), ("beams", JOINT, (2, 16))],
)
def test_the_papers_networks_take_every_head(name, head, distribution, logits):
    agent = build_agent(name, STATIC, PARAMS, head)
    assert (agent.network.encoder, agent.network.head) == (name, head)
    assert agent.distribution is distribution
    assert shapes(agent) == [logits, (2,)]


@pytest.mark.parametrize(
    ("head", "kind", "logits"), [("factored", OnGrid, (2, 2, 4)), ("gaussian", Gaussian, (2, 2, 2))]
)
def test_continuous_actions_have_distributions_of_angles(head, kind, logits):
    agent = build_agent("flatten", CONTINUOUS, PARAMS, head)
    assert isinstance(agent.distribution, kind)
    assert shapes(agent) == [logits, (2,)]


def test_an_unknown_name_is_refused():
    with pytest.raises(ValueError, match=r"^encoder = 'cnn': expected one of beams, flatten, bigru, mhsa$"):
        build_agent("cnn", STATIC, PARAMS)


@pytest.fixture(scope="module")
def state():
    """The state after a reset, on a map that differs from place to place."""
    _, start = SearchTrack(STATIC).reset_env(jax.random.key(0), PARAMS)
    return start.replace(scan_map=jnp.linspace(0, 1, 36 * 36).reshape(36, 36))


@pytest.fixture(scope="module")
def weights(state, draw_variables):
    """Random weights of the beam network."""
    inputs = BeamGeometry(STATIC, PARAMS)(observe(state.tracks, state.scan_map, PARAMS))
    return draw_variables(BeamNetwork(), inputs)


def test_greedy_takes_the_most_probable_look(state, weights):
    agent: Agent = build_agent("beams", STATIC, PARAMS)
    logits, _ = agent.evaluate(weights, agent.features(observe(state.tracks, state.scan_map, PARAMS)))
    greedy = jax.jit(agent_policy("beams", weights, greedy=True)(STATIC, PARAMS))
    for seed in range(3):
        action = greedy(jax.random.key(seed), state)
        np.testing.assert_array_equal(action, np.unravel_index(np.argmax(logits), (4, 4)))


def test_an_agent_looks_at_the_angles_that_it_would_look_at_by_index(state, weights):
    for greedy in (False, True):
        indices, angles = (
            jax.jit(agent_policy("beams", weights, greedy)(static, PARAMS)) for static in (STATIC, CONTINUOUS)
        )
        for time in range(3):
            key, now = jax.random.key(7), state.replace(time=time)
            expected = look_angles(indices(key, now), STATIC, PARAMS)
            np.testing.assert_allclose(angles(key, now), expected, atol=1e-6)


def test_samples_follow_from_the_key_and_the_time(state, weights):
    policy = agent_policy("beams", weights)(STATIC, PARAMS)

    @jax.jit
    def act(seeds, times):
        return jax.vmap(lambda seed, time: policy(jax.random.key(seed), state.replace(time=time)))(
            seeds, times
        )

    counts, same = np.arange(400), np.zeros(400, dtype=int)
    over_time, over_keys = np.asarray(act(same, counts)), np.asarray(act(counts, same))
    np.testing.assert_array_equal(act(same, counts), over_time)
    np.testing.assert_array_equal(act(same, same), np.broadcast_to(over_time[0], (400, 2)))
    agent = build_agent("beams", STATIC, PARAMS)
    logits, _ = agent.evaluate(weights, agent.features(observe(state.tracks, state.scan_map, PARAMS)))
    expected = np.asarray(jax.nn.softmax(logits))
    for actions in (over_time, over_keys):
        share = np.bincount(actions[:, 0] * 4 + actions[:, 1], minlength=16) / 400
        # Four standard deviations of a share p of 400 draws.
        assert (np.abs(share - expected) <= 4 * np.sqrt(expected * (1 - expected) / 400) + 1e-3).all()
