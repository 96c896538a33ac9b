"""Sensor managers: policies that try looks in the expected world (`expected_world`) before they choose one.

Counterparts in Stone Soup: `BruteForceSensorManager` with a `RewardFunction`.

    policy = MANAGERS["greedy"](static, params)
    action = policy(key, state)
"""

import dataclasses
from functools import partial
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp

from jaxtrack.expected_world import beam_pixels, expected_falls, expected_rewards, expected_step
from jaxtrack.params import Params, StaticParams
from jaxtrack.policies import Policy, PolicyBuilder, gain, index, to_action
from jaxtrack.sampling import first_largest
from jaxtrack.scan_map import look_grid

if TYPE_CHECKING:
    from jaxtrack.episode import EnvState

REWARDS = ("information", "shortfall", "paper", "as_printed")
"""Rewards that a manager can expect: sums over tracks that need no truth."""


def greedy(
    static: StaticParams,
    params: Params,
    *,
    reward: str = "information",
    search_weight: float | None = None,
    search_sharpness: int | None = None,
    search_until_complete: bool | None = None,
) -> Policy:
    """The look with the largest expected reward of the next step.

    Args:
        static: shapes; their reward is not read.
        params: numbers.
        reward: one of `REWARDS`.
        search_weight: weight of the reward's search term, if not that of `params`.
        search_sharpness: power of the scan values in it, if not that of `static`.
        search_until_complete: whether it is 0 while there is nothing left to find, if not as in `static`.

    Raises:
        ValueError: naming the reward, if it needs truths or does not exist.
    """
    static, params = _planned(static, params, reward, search_weight, search_sharpness, search_until_complete)
    looks, pixels = look_grid(static, params), beam_pixels(static, params)

    def policy(key: jax.Array, state: "EnvState") -> jax.Array:
        del key
        return to_action(
            first_largest(expected_rewards(state, looks, pixels, static, params)), static, params
        )

    return policy


def rollout(
    static: StaticParams,
    params: Params,
    *,
    candidates: int = 8,
    horizon: int = 10,
    discount: float = 1.0,
    base: PolicyBuilder = index,
    reward: str = "information",
    search_weight: float | None = None,
    search_sharpness: int | None = None,
    search_until_complete: bool | None = None,
) -> Policy:
    """The look after which a base policy collects most reward in the expected world.

    One step of policy improvement (a rollout, as in Bertsekas).

    Args:
        static: shapes; their reward is not read.
        params: numbers.
        candidates: looks that are tried: the best ones by `greedy`; the base policy's own is
            tried too, so that in the expected world the choice is never worse than that policy.
        horizon: steps of the base policy after each; with 0 the choice is that of `greedy`.
        discount: weight of a step's reward over that of the step before.
        base: builder of the base policy.
        reward: one of `REWARDS`.
        search_weight: weight of the reward's search term, if not that of `params`.
        search_sharpness: power of the scan values in it, if not that of `static`.
        search_until_complete: whether it is 0 while there is nothing left to find, if not as in `static`.

    Raises:
        ValueError: naming the argument and its range.
    """
    count = static.num_looks**2
    if not 1 <= candidates <= count:
        raise ValueError(f"candidates = {candidates}: expected an integer in [1, {count}]")
    if horizon < 0:
        raise ValueError(f"horizon = {horizon}: expected an integer >= 0")
    if not 0 <= discount <= 1:
        raise ValueError(f"discount = {discount}: expected a number in [0, 1]")
    static, params = _planned(static, params, reward, search_weight, search_sharpness, search_until_complete)
    looks, pixels = look_grid(static, params), beam_pixels(static, params)
    base_policy = base(static, params)

    def policy(key: jax.Array, state: "EnvState") -> jax.Array:
        expected = expected_rewards(state, looks, pixels, static, params)
        best = jax.lax.top_k(expected, candidates)[1]
        actions = jax.vmap(to_action, in_axes=(0, None, None))(best, static, params)
        actions = jnp.concatenate([actions, base_policy(key, state)[None]])
        # One look after the other: the maps after all of them, in many states, are more than a cache holds.
        returns = jax.lax.map(
            lambda action: expected_return(
                key, state, action, base_policy, horizon, discount, static, params
            ),
            actions,
        )
        return actions[first_largest(returns)]

    return policy


def uncertainty(static: StaticParams, params: Params) -> Policy:
    """The look with the largest expected fall of covariance norms; without tracks, look 0.

    Stone Soup's `BruteForceSensorManager` with its `UncertaintyRewardFunction`: it knows neither
    search nor deletion.
    """
    looks = look_grid(static, params)

    def policy(key: jax.Array, state: "EnvState") -> jax.Array:
        del key
        return to_action(first_largest(expected_falls(state.tracks, looks, params)), static, params)

    return policy


PLAN: dict[str, Any] = {
    "reward": "shortfall",
    "search_weight": 10.0,
    "search_sharpness": 16,
    "search_until_complete": True,
}
"""What the managers by name plan for, whatever the environment pays: an expected world finds no new
tracks, so that searching must be worth something in itself."""

MANAGERS: dict[str, PolicyBuilder] = {
    "greedy": partial(greedy, **PLAN),
    "rollout": partial(rollout, base=gain, **PLAN),
    "uncertainty": uncertainty,
}


def expected_return(
    key: jax.Array,
    state: "EnvState",
    action: jax.Array,
    base: Policy,
    horizon: int,
    discount: float,
    static: StaticParams,
    params: Params,
) -> jax.Array:
    """Discounted sum of the rewards of an action and of `horizon` steps of a base policy after it."""

    def one_step(state: "EnvState", weight: jax.Array) -> tuple["EnvState", jax.Array]:
        state, reward = expected_step(state, base(key, state), static, params)
        return state, weight * reward

    state, first = expected_step(state, action, static, params)
    rest = jax.lax.scan(one_step, state, discount ** jnp.arange(1, horizon + 1))[1]
    return first + rest.sum()


def _planned(
    static: StaticParams,
    params: Params,
    reward: str,
    search_weight: float | None,
    search_sharpness: int | None,
    search_until_complete: bool | None,
) -> tuple[StaticParams, Params]:
    """The scenario with the reward that is planned for."""
    if reward not in REWARDS:
        raise ValueError(f"reward = {reward!r}: expected one of {', '.join(REWARDS)}, which need no truths")
    if search_weight is not None:
        params = dataclasses.replace(params, search_weight=search_weight)
    asked: dict[str, Any] = {
        "search_sharpness": search_sharpness,
        "search_until_complete": search_until_complete,
    }
    chosen = {name: value for name, value in asked.items() if value is not None}
    return dataclasses.replace(static, reward=reward, **chosen), params
