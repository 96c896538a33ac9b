"""Our side of the benchmarks: many environments stepped together, through gymnax's `step`."""

import time
from typing import Any, TypeVar

import jax
import jax.numpy as jnp

from jaxtrack import policies
from jaxtrack.env import EnvState, SearchTrack
from jaxtrack.observation import Observation
from jaxtrack.params import Params, StaticParams

Tree = TypeVar("Tree")
Start = tuple[Observation, EnvState]
"""Observation and state of environments `[B]`, from which a piece of an episode is played."""


def pointing(static: StaticParams, params: Params) -> policies.Policy:
    """The look nearest to truth 0, 1, 2, ... in turn: a stand-in for an agent that finds its targets."""

    def policy(key: jax.Array, state: EnvState) -> jax.Array:
        del key
        truth = state.truths.state[state.time % static.num_truths]
        return policies.to_action(policies.nearest_look(truth, static, params), static, params)

    return policy


def play(
    key: jax.Array,
    start: Start,
    params: Params,
    env: SearchTrack,
    build: policies.PolicyBuilder,
    steps: int,
) -> tuple[Start, dict[str, jax.Array]]:
    """Steps the environments of `start` `[B]` together, through gymnax's `step`.

    Returns:
        The last observation and state, and the means of reward and of every scalar of `info`:
        all of them are asked for, so that none is optimised away.
    """
    policy = build(env.static, params)
    num_envs = start[1].time.shape[0]
    key_policy, key_steps = jax.random.split(key)
    policy_keys = jax.random.split(key_policy, num_envs)

    def one_step(carry: Start, keys: jax.Array) -> tuple[Start, dict[str, jax.Array]]:
        _, state = carry
        action = jax.vmap(policy)(policy_keys, state)
        observation, state, reward, _, _, info = jax.vmap(env.step, in_axes=(0, 0, 0, None))(
            keys, state, action, params
        )
        del info["final_observation"]
        return (observation, state), jax.tree.map(jnp.mean, {**info, "reward": reward})

    end, logged = jax.lax.scan(one_step, start, jax.random.split(key_steps, (steps, num_envs)))
    return end, jax.tree.map(jnp.mean, logged)


def raster(key: jax.Array, params: Params, env: SearchTrack, num_envs: int) -> Start:
    """New scenarios `[B]` after one raster over the field, so that tracks exist."""
    key_reset, key_play = jax.random.split(key)
    start = jax.vmap(env.reset, in_axes=(0, None))(jax.random.split(key_reset, num_envs), params)
    return play(key_play, start, params, env, policies.coverage, env.static.num_looks**2)[0]


def compile_play(
    env: SearchTrack, params: Params, start: Start, build: policies.PolicyBuilder, steps: int
) -> tuple[Any, float]:
    """The compiled `play`, called once to warm up, and the seconds that tracing and compiling took."""
    began = time.perf_counter()
    jitted = jax.jit(lambda key, start, params: play(key, start, params, env, build, steps))
    compiled = jitted.lower(jax.random.key(0), start, params).compile()
    seconds = time.perf_counter() - began
    jax.block_until_ready(compiled(jax.random.key(0), start, params))
    return compiled, seconds


def first(count: int, tree: Tree) -> Tree:
    """The first `count` environments."""
    return jax.block_until_ready(jax.tree.map(lambda leaf: leaf[:count], tree))
