"""PPO in graph: collect, estimate advantages, update, as one jitted program.

Plain functions with explicit arguments; `train_step` is the table of contents.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import optax
from flax import struct

from jaxtrack.env import SearchTrack
from jaxtrack.episode import EnvState
from jaxtrack.params import Params
from jaxtrack.policies import POLICIES
from train.agents import Agent, build_agent
from train.config import TrainConfig
from train.gae import advantages
from train.loss import Sample, explained_variance
from train.pieces import minibatch_gradient, shortest_first
from train.pretrain import pretrain
from train.varied import randomised, scenario_at

Chooser = Callable[[jax.Array, EnvState, jax.Array], jax.Array]
"""Key, states of the environments, and logits to actions `[B, 2]`."""

LOGGED = ("completeness", "covariance_norm_mean", "covariance_norm_sum", "live_tracks", "mean_scan_value")


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


class Transition(struct.PyTreeNode):
    """One step of B environments, as the update needs it (`[B, ...]`, stacked to `[S, B, ...]`)."""

    inputs: Any
    action: jax.Array
    taught: jax.Array
    log_prob: jax.Array
    value: jax.Array
    final_value: jax.Array
    reward: jax.Array
    terminated: jax.Array
    done: jax.Array


def make_optimiser(config: TrainConfig) -> optax.GradientTransformation:
    """Adam on gradients clipped by their global norm.

    The rate of the warm start is constant, the one after it annealed to zero.
    """
    per_update = config.epochs * config.num_minibatches
    warm = config.warm_start_updates * per_update
    end = 0.0 if config.anneal else config.learning_rate
    left = max(1, config.num_updates * per_update - warm)
    rewarded = optax.linear_schedule(config.learning_rate, end, left)
    rate = optax.join_schedules([lambda _: config.warm_start_learning_rate, rewarded], [warm])
    return optax.chain(optax.clip_by_global_norm(config.max_grad_norm), optax.adam(rate, eps=1e-5))


def init_learner(key: jax.Array, scenario: Params, env: SearchTrack, config: TrainConfig) -> LearnerState:
    """Fresh weights and environments.

    The environments start at different times of their episode, so that a rollout holds all
    phases of an episode and their ends do not fall on one step.
    """
    env, scenario = randomised(env, config), scenario_at(0, scenario, config)
    agent = build_agent(config.encoder, env.static, scenario, config.head)
    key_env, key_net, key = jax.random.split(key, 3)
    keys = jax.random.split(key_env, config.num_envs)
    observation, state = jax.vmap(env.reset_env, in_axes=(0, None))(keys, scenario)
    phase = jnp.arange(config.num_envs) * scenario.max_steps_in_episode // config.num_envs
    # The first observations are constants: unhidden, the compiler would spend seconds on folding them.
    inputs = jax.vmap(agent.features)(jax.lax.optimization_barrier(observation))
    weights = agent.network.init(key_net, inputs)
    if config.pretrain_steps:
        key, key_lists = jax.random.split(key)
        weights, _ = pretrain(key_lists, weights, observation, state, scenario, env, config)
    return LearnerState(
        weights=weights,
        optimiser=make_optimiser(config).init(weights),
        env=state.replace(time=phase.astype(state.time.dtype)),
        inputs=inputs,
        episode_return=jnp.zeros(config.num_envs),
        episode_length=jnp.zeros(config.num_envs, dtype=int),
        scenario=scenario,
        key=jax.random.key_data(key),
        update=jnp.asarray(0),
    )


def train_step(
    state: LearnerState, env: SearchTrack, config: TrainConfig
) -> tuple[LearnerState, dict[str, jax.Array]]:
    """One update: a rollout of every environment, advantages, and PPO's epochs over them."""
    env = randomised(env, config)
    state = state.replace(scenario=scenario_at(state.update, state.scenario, config))
    agent = build_agent(config.encoder, env.static, state.scenario, config.head)
    key, key_rollout, key_update = jax.random.split(jax.random.wrap_key_data(state.key), 3)
    state, rollout, rollout_metrics = collect(key_rollout, state, env, agent, config)
    samples = estimate_advantages(rollout, state, agent, config)
    weights, optimiser, losses = update_epochs(key_update, state, samples, agent, config)
    state = state.replace(
        weights=weights, optimiser=optimiser, key=jax.random.key_data(key), update=state.update + 1
    )
    explained = explained_variance(samples.value, samples.advantage)
    moved = {name: getattr(state.scenario, name) for name in config.curriculum}
    return state, {**rollout_metrics, **losses, "explained_variance": explained, **moved}


def collect(
    key: jax.Array, state: LearnerState, env: SearchTrack, agent: Agent, config: TrainConfig
) -> tuple[LearnerState, Transition, dict[str, jax.Array]]:
    """Runs every environment for `rollout_steps` steps with the current weights."""
    choose = build_chooser(state, env, agent, config)
    taught = jnp.full(config.num_envs, state.update < config.warm_start_updates)

    def one_step(carry: LearnerState, key: jax.Array) -> tuple[LearnerState, tuple[Transition, Any, Any]]:
        key_action, key_env = jax.random.split(key)
        logits, value = agent.evaluate_quickly(carry.weights, carry.inputs)
        action = choose(key_action, carry.env, logits)
        keys = jax.random.split(key_env, config.num_envs)
        observation, env_state, reward, terminated, truncated, info = jax.vmap(
            env.step, in_axes=(0, 0, 0, None)
        )(keys, carry.env, action, state.scenario)
        done = terminated | truncated
        transition = Transition(
            inputs=carry.inputs,
            action=action,
            taught=taught,
            log_prob=agent.distribution.log_prob(logits, action),
            value=value,
            final_value=value_at_end(carry.weights, info["final_observation"], done, agent),
            reward=config.reward_scale * reward,
            terminated=terminated,
            done=done,
        )
        episode_return, episode_length = carry.episode_return + reward, carry.episode_length + 1
        finished = {"done": done, "episode_return": episode_return, "episode_length": episode_length}
        logged = {"reward": reward} | {name: info[name] for name in (*LOGGED, *env.static.info_metrics)}
        carry = carry.replace(
            env=env_state,
            inputs=jax.vmap(agent.features)(observation),
            episode_return=jnp.where(done, 0.0, episode_return),
            episode_length=jnp.where(done, 0, episode_length),
        )
        return carry, (transition, finished | {"terminated": terminated}, logged)

    keys = jax.random.split(key, config.rollout_steps)
    state, (rollout, finished, logged) = jax.lax.scan(one_step, state, keys)
    return state, rollout, summarise(finished, logged, state.scenario)


def build_chooser(state: LearnerState, env: SearchTrack, agent: Agent, config: TrainConfig) -> Chooser:
    """How actions are chosen: by the policy, or in the first updates by the rule that it imitates."""

    def by_policy(key: jax.Array, states: EnvState, logits: jax.Array) -> jax.Array:
        del states
        return agent.distribution.sample(key, logits)

    if not config.warm_start_updates:
        return by_policy
    rule = POLICIES[config.warm_start](env.static, state.scenario)

    def by_rule(key: jax.Array, states: EnvState, logits: jax.Array) -> jax.Array:
        del logits
        return jax.vmap(rule)(jax.random.split(key, config.num_envs), states)

    imitates = state.update < config.warm_start_updates
    return lambda *now: jax.lax.cond(imitates, by_rule, by_policy, *now)


def value_at_end(weights: Any, final_observation: Any, done: jax.Array, agent: Agent) -> jax.Array:
    """Value `[B]` of the final observations; 0 where the episode goes on.

    Most steps end no episode: then nothing is computed.
    """

    def evaluate() -> jax.Array:
        _, value = agent.evaluate(weights, jax.vmap(agent.features)(final_observation))
        return jnp.where(done, value, 0.0)

    return jax.lax.cond(jnp.any(done), evaluate, lambda: jnp.zeros(done.shape))


def estimate_advantages(
    rollout: Transition, state: LearnerState, agent: Agent, config: TrainConfig
) -> Sample:
    """Advantages of the rollout `[S, B]`, bootstrapped from the value after its last step."""
    _, last_value = agent.evaluate(state.weights, state.inputs)
    following = jnp.concatenate([rollout.value[1:], last_value[None]])
    advantage = advantages(
        rollout.reward,
        rollout.value,
        jnp.where(rollout.done, rollout.final_value, following),
        rollout.terminated,
        rollout.done,
        config.gamma,
        config.gae_lambda,
    )
    return Sample(rollout.inputs, rollout.action, rollout.taught, rollout.log_prob, rollout.value, advantage)


def update_epochs(
    key: jax.Array, state: LearnerState, samples: Sample, agent: Agent, config: TrainConfig
) -> tuple[Any, Any, dict[str, jax.Array]]:
    """PPO's epochs: each shuffles all samples and takes an optimiser step per minibatch."""
    flat = jax.tree.map(lambda leaf: leaf.reshape(config.batch_size, *leaf.shape[2:]), samples)
    optimiser = make_optimiser(config)

    def one_minibatch(carry: tuple[Any, Any], rows: jax.Array) -> tuple[tuple[Any, Any], Any]:
        weights, optimiser_state = carry
        rows = shortest_first(rows, flat.inputs, agent)
        minibatch = jax.tree.map(lambda leaf: leaf[rows], flat)
        grads, losses = minibatch_gradient(weights, minibatch, agent, config)
        updates, optimiser_state = optimiser.update(grads, optimiser_state, weights)
        losses["gradient_norm"] = optax.tree.norm(grads)
        return (optax.apply_updates(weights, updates), optimiser_state), losses

    def one_epoch(carry: tuple[Any, Any], key: jax.Array) -> tuple[tuple[Any, Any], Any]:
        order = jax.random.permutation(key, config.batch_size)
        return jax.lax.scan(one_minibatch, carry, order.reshape(config.num_minibatches, -1))

    carry = (state.weights, state.optimiser)
    carry, losses = jax.lax.scan(one_epoch, carry, jax.random.split(key, config.epochs))
    return *carry, jax.tree.map(jnp.mean, losses)


def summarise(
    finished: dict[str, jax.Array], logged: dict[str, jax.Array], params: Params
) -> dict[str, jax.Array]:
    """Means over a rollout; episode returns over whole episodes only, NaN where none ended."""
    # The first episodes are cut short by the different times at which they start.
    whole = finished["done"] & (
        finished["terminated"] | (finished["episode_length"] == params.max_steps_in_episode)
    )
    count = whole.sum()
    total = jnp.where(whole, finished["episode_return"], 0.0).sum()
    means = {name: values.mean() for name, values in logged.items()}
    return {**means, "episodes": count, "episode_return": jnp.where(count > 0, total / count, jnp.nan)}
