"""Our side of the benchmarks: many environments stepped together, through gymnax's `step`."""

import time
from typing import Any, TypeVar

import jax
import jax.numpy as jnp

from jaxtrack import cores, policies
from jaxtrack.env import SearchTrack
from jaxtrack.episode import EnvState
from jaxtrack.observation import Observation
from jaxtrack.params import Params, StaticParams
from jaxtrack.sampling import split

Tree = TypeVar("Tree")
Start = tuple[Observation, EnvState]
"""Observation, without the scan map that the state has, too, and state of environments `[B]`, from which a
piece of an episode is played."""


def pointing(static: StaticParams, params: Params) -> policies.Policy:
    """The look nearest to truth 0, 1, 2, ... in turn: a stand-in for an agent that finds its targets."""

    def policy(key: jax.Array, state: EnvState) -> jax.Array:
        del key
        truth = state.truths.state[state.time % static.num_truths]
        return policies.to_action(policies.nearest_look(truth, static, params), static, params)

    return policy


def play(
    keys: jax.Array,
    start: Start,
    params: Params,
    env: SearchTrack,
    build: policies.PolicyBuilder | None,
    steps: int,
) -> tuple[Start, dict[str, jax.Array]]:
    """Steps the environments of `start` `[B]`, each with its key of `keys` `[B]`, through gymnax's `step`.

    Args:
        keys: of the environments.
        start: where they are.
        params: numbers.
        env: the environment.
        build: of the policy; None for looks drawn uniformly, all of them before the first step.
        steps: to take.

    Returns:
        The last observation and state, and the means `[B]` of reward and of every scalar of
        `info`: all of them are asked for, so that none is optimised away.
    """
    policy = build(env.static, params) if build else None
    policy_keys, step_keys = jax.vmap(split)(keys)
    of_steps = jax.vmap(lambda key: jax.random.split(key, steps), out_axes=1)(step_keys)
    drawn = None if policy else random_actions(policy_keys, steps, env.static, params)

    def one_step(
        carry: Start, of_step: tuple[jax.Array, jax.Array | None]
    ) -> tuple[Start, dict[str, jax.Array]]:
        (_, state), (keys, action) = carry, of_step
        action = jax.vmap(policy)(policy_keys, state) if policy else action
        observation, state, reward, _, _, info = jax.vmap(env.step, in_axes=(0, 0, 0, None))(
            keys, state, action, params
        )
        del info["final_observation"], observation["scan_map"]
        return (observation, state), {**info, "reward": reward}

    end, logged = jax.lax.scan(one_step, start, (of_steps, drawn))
    return end, jax.tree.map(lambda values: jnp.mean(values, axis=0), logged)


def random_actions(keys: jax.Array, steps: int, static: StaticParams, params: Params) -> jax.Array:
    """Uniformly drawn actions `[steps, B, 2]`, for each key all in one draw of many numbers."""

    def draw(key: jax.Array) -> jax.Array:
        looks = jax.random.randint(key, (steps,), 0, static.num_looks**2)
        return jax.vmap(lambda look: policies.to_action(look, static, params))(looks)

    return jax.vmap(draw, out_axes=1)(keys)


def begin(keys: jax.Array, params: Params, env: SearchTrack) -> Start:
    """New scenarios `[B]`, one for each key."""
    observation, state = jax.vmap(env.reset, in_axes=(0, None))(keys, params)
    del observation["scan_map"]
    return observation, state


def raster(key: jax.Array, params: Params, env: SearchTrack, num_envs: int) -> Start:
    """New scenarios `[B]` after one raster over the field, so that tracks exist."""
    reset_keys, play_keys = jax.random.split(key, (2, num_envs))
    start = begin(reset_keys, params, env)
    return play(play_keys, start, params, env, policies.coverage, env.static.num_looks**2)[0]


def compile_play(
    env: SearchTrack,
    params: Params,
    start: Start,
    build: policies.PolicyBuilder | None,
    steps: int,
    shared: bool = True,
) -> tuple[Any, float]:
    """The compiled `play` on all cores, called once to warm up, and the seconds that compiling took.

    One environment, or a number that the cores can not share equally, is played on one core, and so
    is everything that is not to be `shared`.
    """

    def function(keys: jax.Array, start: Start, params: Params) -> tuple[Start, dict[str, jax.Array]]:
        return play(keys, start, params, env, build, steps)

    num_envs = start[1].time.shape[0]
    on_one = not shared or num_envs % jax.device_count()
    on_all = function if on_one else cores.share_out(function, shared=1)
    keys = jax.random.split(jax.random.key(0), num_envs)
    began = time.perf_counter()
    compiled = jax.jit(on_all).lower(keys, start, params).compile()
    seconds = time.perf_counter() - began
    jax.block_until_ready(compiled(keys, start, params))
    return compiled, seconds


def first(count: int, tree: Tree) -> Tree:
    """The first `count` environments."""
    return jax.block_until_ready(jax.tree.map(lambda leaf: leaf[:count], tree))
