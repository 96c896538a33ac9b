"""The learner on tiny environments of which everything is known (probes)."""

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from jaxtrack import Params
from jaxtrack.policies import POLICIES
from tests.train.probes import Linear, Probe, ProbeState, at_the_end, constant, right_look
from train import learner
from train.agents import Agent
from train.config import TrainConfig
from train.distributions import JOINT
from train.rollout import collect

pytestmark = pytest.mark.usefixtures("quick_compilation")

CONFIG = TrainConfig(
    total_steps=10**6,
    num_envs=8,
    rollout_steps=8,
    num_minibatches=2,
    microbatch=16,
    epochs=4,
    learning_rate=0.03,
    warm_start_learning_rate=0.03,
    anneal=False,
    gamma=0.5,
    target_kl=0.0,
    entropy_coefficient=0.0,
    reward_scale=1.0,
    warm_start="none",
)


@pytest.fixture
def traced(monkeypatch):
    """Lets the learner build the linear agent; counts how often it is traced."""
    names = []

    def build(name, static, params, head="beams"):
        assert head == "beams"
        names.append(name)
        return Agent(lambda observation: observation, Linear(), JOINT)

    monkeypatch.setattr(learner, "build_agent", build)
    return names


def config_for(probe, **fields):
    """The configuration for a probe's episodes."""
    params = Params(max_steps_in_episode=probe.length)
    return dataclasses.replace(CONFIG, params=params, **fields)


def start(probe, config):
    """A fresh learner."""
    return jax.jit(lambda key, params: learner.init_learner(key, params, probe, config))(
        jax.random.key(0), config.params
    )


def learn(probe, config, updates):
    """Trains; the learner's state and the metrics of every update."""
    return program(probe, config, updates)(jax.random.key(0), config.params)


def program(probe, config, updates):
    """A whole training as one function of a key and the scenario."""

    @jax.jit
    def run(key, params):
        state = learner.init_learner(key, params, probe, config)
        return jax.lax.scan(lambda s, _: learner.train_step(s, probe, config), state, length=updates)

    return run


def value_of(state, probe, time):
    """Value of an observation, the mean over both coins."""
    observe = jax.vmap(lambda coin: probe.observe(ProbeState(jnp.asarray(time), coin)))(jnp.arange(2))
    return float(Linear().apply(state.weights, observe)[1].mean())


def set_values(state, values):
    """The same learner with known values of the times; the coin does not count."""
    kernel = jnp.array([*values, 0, 0], dtype=float)[:, None]
    weights = {"params": {**state.weights["params"], "value": {"kernel": kernel}}}
    return state.replace(weights=weights)


def test_a_constant_reward_without_end_is_worth_one_over_one_minus_the_discount(traced):
    # One observation for all times: the final value is then the value itself, 1 / (1 - 0.5) = 2.
    # Taken for a termination, the end of an episode of two steps would pull it to about 1.3.
    probe = Probe(constant, 2)
    probe.observe = lambda state: jnp.ones(3)
    state, _ = learn(probe, config_for(probe), 60)
    value = Linear().apply(state.weights, jnp.ones((1, 3)))[1]
    np.testing.assert_allclose(value, 2.0, atol=0.05)


def test_a_delayed_reward_is_discounted_back_from_a_termination(traced):
    probe = Probe(at_the_end, 3, terminates=True)
    state, metrics = learn(probe, config_for(probe), 60)
    values = [value_of(state, probe, time) for time in range(3)]
    np.testing.assert_allclose(values, [0.25, 0.5, 1.0], atol=0.05)
    assert metrics["explained_variance"][-1] > 0.95
    np.testing.assert_allclose(metrics["episode_return"][2:], 1.0)


def test_the_policy_learns_what_the_observation_tells(traced):
    probe = Probe(right_look, 4)
    _, metrics = learn(probe, config_for(probe), 60)
    assert metrics["reward"][0] < 0.4
    assert metrics["reward"][-1] > 0.95
    assert metrics["entropy"][-1] < metrics["entropy"][0] / 2
    np.testing.assert_allclose(metrics["entropy"][0], math.log(4), atol=0.1)


def test_at_first_a_rule_is_imitated_whatever_it_earns(traced, monkeypatch):
    def rule(static, params):
        # The right look is the wrong one here.
        return lambda key, state: jnp.where(state.coin == 1, jnp.array([0, 1]), jnp.array([1, 0]))

    monkeypatch.setitem(POLICIES, "wrong", rule)
    probe = Probe(right_look, 4)
    config = config_for(probe, warm_start="wrong", warm_start_steps=12 * CONFIG.batch_size + 1)
    assert config.warm_start_updates == 12
    _, metrics = learn(probe, config, 72)
    assert (metrics["reward"][:12] == 0).all()
    # The policy loss is the cross-entropy with the rule.
    np.testing.assert_allclose(metrics["policy_loss"][0], math.log(4), atol=0.3)
    assert metrics["policy_loss"][11] < 0.3
    # On its own it does at first what it was taught, and then learns what pays.
    assert metrics["reward"][12] < 0.3
    assert metrics["reward"][-1] > 0.9


@pytest.mark.parametrize("terminates", [False, True])
def test_the_final_value_counts_exactly_where_an_episode_is_truncated(traced, terminates):
    probe = Probe(constant, 3, terminates)
    config = config_for(probe, gae_lambda=0.0, reward_scale=0.1)
    values = np.array([10.0, 20.0, 30.0, 40.0])
    state = set_values(start(probe, config), values)
    state = state.replace(inputs=jax.vmap(probe.observe)(state.env))
    agent = learner.build_agent("", None, None)

    @jax.jit
    def roll(state):
        _, rollout, _ = collect(jax.random.key(0), state, probe, agent, config)
        return rollout, learner.estimate_advantages(rollout, config)

    rollout, samples = roll(state)
    time = np.argmax(rollout.inputs[..., :4], axis=-1)
    assert rollout.done.any()
    np.testing.assert_array_equal(rollout.done, time == 2)
    np.testing.assert_array_equal(rollout.terminated, (time == 2) & terminates)
    # The final observation is time 3, worth 40; the next episode's first is time 0, worth 10.
    ended = (time == 2) | (np.arange(len(time)) == len(time) - 1)[:, None]  # the episode, or the rollout
    np.testing.assert_allclose(rollout.final_value, np.where(ended, values[time + 1], 0.0))
    following = np.where((time == 2) & terminates, 0.0, values[time + 1])
    np.testing.assert_allclose(samples.advantage, 0.1 + 0.5 * following - values[time], rtol=1e-5)


def test_environments_start_at_different_times_of_their_episode(traced):
    probe = Probe(constant, 4)
    state = start(probe, config_for(probe))
    np.testing.assert_array_equal(state.env.time, [0, 0, 1, 1, 2, 2, 3, 3])
    np.testing.assert_array_equal(state.episode_length, np.zeros(8))


def test_only_whole_episodes_are_counted_and_their_returns_are_unscaled(traced):
    probe = Probe(constant, 4)
    config = config_for(probe, rollout_steps=4, microbatch=16, reward_scale=0.1)
    _, metrics = learn(probe, config, 3)
    # In the first four steps all eight episodes end, but six of them began in the middle.
    np.testing.assert_array_equal(metrics["episodes"], [2, 8, 8])
    np.testing.assert_allclose(metrics["episode_return"], 4.0)
    np.testing.assert_allclose(metrics["reward"], 1.0)


def test_fresh_samples_have_ratio_one_until_the_first_optimiser_step(traced):
    probe = Probe(right_look, 4)
    config = config_for(probe, epochs=1)

    @jax.jit
    def first_update(state, rate):
        changed = dataclasses.replace(config, learning_rate=rate)
        return learner.train_step(state, probe, changed)[1]

    state = start(probe, config)
    still = first_update(state, 0.0)
    np.testing.assert_allclose(still["approximate_kl"], 0.0, atol=1e-6)
    assert still["clip_fraction"] == 0
    # Ratio 1 times advantages of mean 0.
    np.testing.assert_allclose(still["policy_loss"], 0.0, atol=1e-6)
    moved = first_update(state, 0.3)
    assert moved["approximate_kl"] > 1e-3
    assert 0 < moved["clip_fraction"] < 1


@pytest.mark.parametrize(("rule", "steps"), [("none", 1), ("scheduler", 8)])
def test_an_update_ends_where_the_policy_has_gone_too_far_but_for_imitation(traced, monkeypatch, rule, steps):
    monkeypatch.setitem(POLICIES, rule, lambda static, params: lambda key, state: jnp.array([0, 1]))
    probe = Probe(right_look, 4)
    config = config_for(probe, target_kl=1e-9, warm_start=rule, warm_start_steps=CONFIG.batch_size)
    before = start(probe, config)
    after, metrics = jax.jit(lambda state: learner.train_step(state, probe, config))(before)
    # Fresh samples have a divergence of 0, so the first of 4 x 2 steps is taken.
    np.testing.assert_allclose(metrics["steps_taken"], steps / 8)
    counts = [int(count) for _, count in optax.tree.get_all_with_path(after.optimiser, "count")]
    assert counts
    assert set(counts) == {steps}
    changed = jax.tree.map(lambda a, b: np.any(a != b), after.weights, before.weights)
    assert any(jax.tree.leaves(changed))


def test_an_update_that_has_ended_stays_so(traced, monkeypatch):
    """Only the minibatch with sample 0, one of two in every epoch, says that the policy has gone too far."""

    def gradient(weights, samples, rows, *rest):
        return jax.tree.map(jnp.zeros_like, weights), {"approximate_kl": 1.0 * jnp.any(rows == 0)}

    monkeypatch.setattr(learner, "minibatch_gradient", gradient)
    probe = Probe(right_look, 4)
    config = config_for(probe, target_kl=0.1)
    _, metrics = jax.jit(lambda state: learner.train_step(state, probe, config))(start(probe, config))
    assert metrics["steps_taken"] * 8 in (0, 1)


def test_the_step_is_traced_once_and_other_numbers_retrace_nothing(traced):
    probe = Probe(right_look, 4)
    config = config_for(probe)
    state = start(probe, config)
    step = jax.jit(lambda state: learner.train_step(state, probe, config))
    traced.clear()
    for update in range(3):
        state, _ = step(state)
        assert int(state.update) == update + 1
        scenario = state.scenario.replace(time_step=state.scenario.time_step * 2)
        state = state.replace(scenario=scenario)
    assert len(traced) == 1
    assert traced == [config.encoder]


def test_the_same_seed_gives_the_same_weights(traced):
    probe = Probe(right_look, 4)

    config = config_for(probe)
    run = program(probe, config, 2)

    def weights(seed):
        state, _ = run(jax.random.key(seed), config.params)
        return [leaf.tobytes() for leaf in jax.tree.leaves(jax.device_get(state.weights))]

    first = weights(0)
    assert weights(0) == first
    assert all(other != own for other, own in zip(weights(1), first, strict=True))
