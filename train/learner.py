"""PPO in graph: collect, estimate advantages, update, as one jitted program.

Plain functions with explicit arguments; `train_step` is the table of contents.
"""

from typing import Any

import jax
import jax.numpy as jnp
import optax

from jaxtrack.env import SearchTrack
from jaxtrack.params import Params
from train.agents import Agent, build_agent
from train.config import TrainConfig
from train.devices import ALONE, Share
from train.gae import advantages
from train.learner_state import LearnerState
from train.loss import Sample, explained_variance
from train.pieces import minibatch_gradient, shortest_first
from train.pretrain import pretrain
from train.rollout import Transition, collect, imitates
from train.varied import randomised, scenario_at


def make_optimiser(config: TrainConfig) -> optax.GradientTransformation:
    """Adam on gradients clipped by their global norm.

    The rate of the warm start is constant, the one after it annealed to zero. Its arithmetic is on all
    weights as one row: it is then compiled once, and not once for every array of the network.
    """
    per_update = config.epochs * config.num_minibatches
    warm = config.warm_start_updates * per_update
    end = 0.0 if config.anneal else config.learning_rate
    left = max(1, config.num_updates * per_update - warm)
    rewarded = optax.linear_schedule(config.learning_rate, end, left)
    rate = optax.join_schedules([lambda _: config.warm_start_learning_rate, rewarded], [warm])
    return optax.flatten(
        optax.chain(optax.clip_by_global_norm(config.max_grad_norm), optax.adam(rate, eps=1e-5))
    )


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
    state: LearnerState, env: SearchTrack, config: TrainConfig, share: Share = ALONE
) -> tuple[LearnerState, dict[str, jax.Array]]:
    """One update: a rollout of every environment, advantages, and PPO's epochs over them.

    Args:
        state: on each of several devices with its own environments.
        env: the environment.
        config: of the whole training.
        share: what this device does of it.
    """
    env = randomised(env, config)
    state = state.replace(scenario=scenario_at(state.update, state.scenario, config))
    agent = build_agent(config.encoder, env.static, state.scenario, config.head)
    key, key_rollout, key_update = jax.random.split(jax.random.wrap_key_data(state.key), 3)
    state, rollout, rollout_metrics = collect(key_rollout, state, env, agent, config, share)
    samples = estimate_advantages(rollout, config)
    weights, optimiser, losses = update_epochs(key_update, state, samples, agent, config, share)
    state = state.replace(
        weights=weights, optimiser=optimiser, key=jax.random.key_data(key), update=state.update + 1
    )
    explained = explained_variance(*share.all((samples.value, samples.advantage), axis=1))
    moved = {name: getattr(state.scenario, name) for name in config.curriculum}
    return state, {**rollout_metrics, **losses, "explained_variance": explained, **moved}


def estimate_advantages(rollout: Transition, config: TrainConfig) -> Sample:
    """Advantages of the rollout `[S, B]`, bootstrapped from the value after its last step."""
    following = jnp.concatenate([rollout.value[1:], rollout.final_value[-1:]])
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
    key: jax.Array, state: LearnerState, samples: Sample, agent: Agent, config: TrainConfig, share: Share
) -> tuple[Any, Any, dict[str, jax.Array]]:
    """PPO's epochs: each shuffles all samples and takes an optimiser step per minibatch.

    Once the policy has gone too far (`target_kl`) no step is taken any more, as in Stable-Baselines3.
    """
    flat = jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), samples)
    optimiser = make_optimiser(config)

    farthest = jnp.where(imitates(state, config), jnp.inf, 1.5 * config.target_kl or jnp.inf)

    def one_minibatch(carry: tuple[Any, Any, jax.Array], rows: jax.Array) -> tuple[Any, Any]:
        weights, optimiser_state, near = carry
        rows = shortest_first(rows, flat.inputs, agent)
        grads, losses = minibatch_gradient(weights, flat, rows, agent, config, share)
        near &= losses["approximate_kl"] <= farthest
        updates, moved = optimiser.update(grads, optimiser_state, weights)
        taken = (optax.apply_updates(weights, updates), moved)
        kept = jax.tree.map(lambda new, old: jnp.where(near, new, old), taken, (weights, optimiser_state))
        return (*kept, near), losses | {"gradient_norm": optax.tree.norm(grads), "steps_taken": near * 1.0}

    def one_epoch(carry: Any, key: jax.Array) -> tuple[Any, Any]:
        return jax.lax.scan(one_minibatch, carry, shuffled(key, config, share))

    carry = (state.weights, state.optimiser, jnp.asarray(True))
    (weights, moments, _), losses = jax.lax.scan(one_epoch, carry, jax.random.split(key, config.epochs))
    return weights, moments, jax.tree.map(jnp.mean, losses)


def shuffled(key: jax.Array, config: TrainConfig, share: Share) -> jax.Array:
    """Rows `[minibatches, M]` of this device's samples, the rows of a rollout `[S, B]` of its own.

    Every group of environments gives as many samples to every minibatch, so that devices share
    all of them, and no sample goes from one device to another.
    """
    size = config.group_size
    keys = share.own(jax.random.split(key, config.num_envs // size))
    order = jax.vmap(lambda key: jax.random.permutation(key, size * config.rollout_steps))(keys)
    step, member = jnp.divmod(order, size)
    group = jnp.arange(len(keys))[:, None]
    rows = step * (len(keys) * size) + group * size + member
    return (
        rows.reshape(len(keys), config.num_minibatches, -1).swapaxes(0, 1).reshape(config.num_minibatches, -1)
    )
