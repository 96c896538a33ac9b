"""A rollout: every environment runs for some steps with the current weights, and all of it is kept."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct

from jaxtrack.env import SearchTrack
from jaxtrack.episode import EnvState
from jaxtrack.params import Params
from jaxtrack.policies import POLICIES
from train.agents import Agent
from train.config import TrainConfig
from train.devices import ALONE, Share
from train.learner_state import LearnerState

Chooser = Callable[[jax.Array, EnvState, jax.Array], jax.Array]
"""Key, states of the environments, and logits to actions `[B, 2]`."""

LOGGED = ("completeness", "covariance_norm_mean", "covariance_norm_sum", "live_tracks", "mean_scan_value")


class Transition(struct.PyTreeNode):
    """One step of B environments, as the update needs it (`[B, ...]`, stacked to `[S, B, ...]`).

    `final_value` is that of the observation it led to, before a new episode begins; 0 where none ended,
    but for the last step of the rollout.
    """

    inputs: Any
    action: jax.Array
    taught: jax.Array
    log_prob: jax.Array
    value: jax.Array
    final_value: jax.Array
    reward: jax.Array
    terminated: jax.Array
    done: jax.Array


def collect(
    key: jax.Array,
    state: LearnerState,
    env: SearchTrack,
    agent: Agent,
    config: TrainConfig,
    share: Share = ALONE,
) -> tuple[LearnerState, Transition, dict[str, jax.Array]]:
    """Runs every environment for `rollout_steps` steps with the current weights."""
    choose = build_chooser(state, env, agent, config)
    taught = jnp.full(state.episode_length.shape, imitates(state, config))

    def one_step(
        carry: LearnerState, now: tuple[jax.Array, jax.Array]
    ) -> tuple[LearnerState, tuple[Transition, Any, Any]]:
        key, is_last = now
        key_action, key_env = share.own(jax.random.split(key, (2, config.num_envs)), axis=1)
        logits, value = agent.evaluate_quickly(carry.weights, carry.inputs)
        action = choose(key_action, carry.env, logits)
        observation, env_state, reward, terminated, truncated, info = jax.vmap(
            env.step, in_axes=(0, 0, 0, None)
        )(key_env, carry.env, action, state.scenario)
        done = terminated | truncated
        transition = Transition(
            inputs=carry.inputs,
            action=action,
            taught=taught,
            log_prob=agent.distribution.log_prob(logits, action),
            value=value,
            final_value=value_at_end(carry.weights, info["final_observation"], done | is_last, agent),
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
    is_last = jnp.arange(len(keys)) == len(keys) - 1
    state, (rollout, finished, logged) = jax.lax.scan(one_step, state, (keys, is_last))
    finished, logged = share.all((finished, logged), axis=1)
    return state, rollout, summarise(finished, logged, state.scenario)


def build_chooser(state: LearnerState, env: SearchTrack, agent: Agent, config: TrainConfig) -> Chooser:
    """How actions are chosen: by the policy, or in the first updates by the rule that it imitates."""

    def by_policy(key: jax.Array, states: EnvState, logits: jax.Array) -> jax.Array:
        del states
        return jax.vmap(agent.distribution.sample)(key, logits)

    if not config.warm_start_updates:
        return by_policy
    rule = POLICIES[config.warm_start](env.static, state.scenario)

    def by_rule(key: jax.Array, states: EnvState, logits: jax.Array) -> jax.Array:
        del logits
        return jax.vmap(rule)(key, states)

    return lambda *now: jax.lax.cond(imitates(state, config), by_rule, by_policy, *now)


def imitates(state: LearnerState, config: TrainConfig) -> jax.Array:
    """Whether `[]` the policy still imitates its rule in this update."""
    return state.update < config.warm_start_updates


def value_at_end(weights: Any, final_observation: Any, ended: jax.Array, agent: Agent) -> jax.Array:
    """Value `[B]` of the final observations where the episode or the rollout has ended; 0 where both go on.

    Most steps end no episode: then nothing is computed.
    """

    def evaluate() -> jax.Array:
        _, value = agent.evaluate(weights, jax.vmap(agent.features)(final_observation))
        return jnp.where(ended, value, 0.0)

    return jax.lax.cond(jnp.any(ended), evaluate, lambda: jnp.zeros(ended.shape))


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
