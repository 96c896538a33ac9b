"""Sensor managers: policies that try looks in the expected world before they choose one.

In the expected world a look detects every live track whose predicted mean lies in its beam,
exactly where it is expected, and the detection belongs to that track. So covariances fall as
the filter says, means stay predicted, nothing is random and no truth is read. No track is ever
found there: what search may find pays only through the scan map. And no track is ever missed: one
that has lost its truth, or shares it with another, is looked at again and again until it is deleted.

Counterparts in Stone Soup: `BruteForceSensorManager` with a `RewardFunction`.

    policy = MANAGERS["greedy"](static, params)
    action = policy(key, state)
"""

import dataclasses
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp

from jaxtrack import kalman
from jaxtrack.lifecycle import delete_uncertain_tracks
from jaxtrack.observation import covariance_norms
from jaxtrack.params import Params, StaticParams
from jaxtrack.policies import Policy, PolicyBuilder, index, to_action, tracks_in_beams
from jaxtrack.reward import TRACK_TERMS, reward_terms
from jaxtrack.scan_map import beam_weights, look_grid, update_scan_map
from jaxtrack.sensor import in_beam, look_angles
from jaxtrack.types import Detections, Tracks, Truths, position, where_rows

if TYPE_CHECKING:
    from jaxtrack.episode import EnvState

REWARDS = ("information", "paper", "as_printed")
"""Rewards that a manager can expect: sums over tracks that need no truth."""


def greedy(
    static: StaticParams,
    params: Params,
    *,
    reward: str = "information",
    search_weight: float | None = None,
) -> Policy:
    """The look with the largest expected reward of the next step.

    Args:
        static: shapes; their reward is not read.
        params: numbers.
        reward: one of `REWARDS`.
        search_weight: weight of the reward's search term, if not that of `params`.

    Raises:
        ValueError: naming the reward, if it needs truths or does not exist.
    """
    static, params = _planned(static, params, reward, search_weight)
    looks, pixels = look_grid(static, params), beam_pixels(static, params)

    def policy(key: jax.Array, state: "EnvState") -> jax.Array:
        del key
        return to_action(jnp.argmax(expected_rewards(state, looks, pixels, static, params)), static, params)

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
    static, params = _planned(static, params, reward, search_weight)
    looks, pixels = look_grid(static, params), beam_pixels(static, params)
    base_policy = base(static, params)

    def policy(key: jax.Array, state: "EnvState") -> jax.Array:
        expected = expected_rewards(state, looks, pixels, static, params)
        best = jax.lax.top_k(expected, candidates)[1]
        actions = jax.vmap(to_action, in_axes=(0, None, None))(best, static, params)
        actions = jnp.concatenate([actions, base_policy(key, state)[None]])
        returns = jax.vmap(
            lambda action: expected_return(key, state, action, base_policy, horizon, discount, static, params)
        )(actions)
        return actions[jnp.argmax(returns)]

    return policy


def uncertainty(static: StaticParams, params: Params) -> Policy:
    """The look with the largest expected fall of covariance norms; without tracks, look 0.

    Stone Soup's `BruteForceSensorManager` with its `UncertaintyRewardFunction`: it knows neither
    search nor deletion.
    """
    looks = look_grid(static, params)

    def policy(key: jax.Array, state: "EnvState") -> jax.Array:
        del key
        return to_action(jnp.argmax(expected_falls(state.tracks, looks, params)), static, params)

    return policy


MANAGERS: dict[str, PolicyBuilder] = {"greedy": greedy, "rollout": rollout, "uncertainty": uncertainty}


def expected_rewards(
    state: "EnvState", looks: jax.Array, pixels: jax.Array, static: StaticParams, params: Params
) -> jax.Array:
    """Expected reward `[A]` of the next step for every look.

    Tracks are predicted and updated once; a look is then a choice between two worths of every
    track, and the share of the map that it clears.

    Args:
        state: the present state; its truths are not read.
        looks: `[A, 2]` boresights (rad).
        pixels: `[A, M * M]` 1 for the pixels in the beam of a look, else 0.
        static: shapes, and the reward.
        params: numbers.
    """
    predicted, updated = expected_outcomes(state.tracks, params)
    missed = _worths(state.tracks, predicted, static, params)
    gained = _worths(state.tracks, updated, static, params) - missed
    track = jnp.sum(missed) + tracks_in_beams(predicted, looks, params) @ gained
    aged = update_scan_map(state.scan_map, jnp.full(2, jnp.nan), static, params)  # NaN looks nowhere
    scan_value = (jnp.sum(aged) - pixels @ aged.ravel()) / aged.size
    return params.track_weight * track - params.search_weight * scan_value


def expected_falls(tracks: Tracks, looks: jax.Array, params: Params) -> jax.Array:
    """Fall `[A]` of the covariance norm by the update, summed over the tracks in the beam of every look.

    Stone Soup's `UncertaintyRewardFunction`.
    """
    predicted, updated = expected_outcomes(tracks, params)
    fall = covariance_norms(predicted) - covariance_norms(updated)
    return tracks_in_beams(predicted, looks, params) @ jnp.where(tracks.active, fall, 0.0)


def expected_step(
    state: "EnvState", action: jax.Array, static: StaticParams, params: Params
) -> tuple["EnvState", jax.Array]:
    """One step of the expected world: the state after it, truths untouched, and the reward."""
    look = look_angles(action, static, params)
    predicted, updated = expected_outcomes(state.tracks, params)
    detected = in_beam(position(predicted.mean), look, params)
    tracks = jax.tree.map(lambda a, b: where_rows(detected, a, b), updated, predicted)
    tracks = delete_uncertain_tracks(tracks, params)
    scan_map = update_scan_map(state.scan_map, look, static, params)
    track, search = reward_terms(state.tracks, tracks, _no_truths(), scan_map, static, params)
    return state.replace(time=state.time + 1, tracks=tracks, scan_map=scan_map), track + search


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


def expected_outcomes(tracks: Tracks, params: Params) -> tuple[Tracks, Tracks]:
    """The track list one step on, if no track is detected and if all are; nothing is deleted."""
    predicted = kalman.predict(tracks, params.time_step, params)
    expected = kalman.predict_detections(predicted, params)
    own = jnp.arange(tracks.active.shape[0])
    return predicted, kalman.update(predicted, expected, Detections.from_values(expected.mean), own)


def _worths(before: Tracks, after: Tracks, static: StaticParams, params: Params) -> jax.Array:
    """Track term of the reward, track by track `[T]`: the term is a sum over them."""
    term, after = TRACK_TERMS[static.reward], delete_uncertain_tracks(after, params)
    # Track lists of one track each.
    alone = jax.tree.map(lambda leaf: leaf[:, None], (before, after))
    return jax.vmap(lambda before, after: term(before, after, _no_truths(), static, params))(*alone)


def _no_truths() -> Truths:
    return Truths(state=jnp.zeros((0, 6)), alive=jnp.zeros(0, dtype=bool))


def beam_pixels(static: StaticParams, params: Params) -> jax.Array:
    """`[L * L, M * M]` 1 where a pixel lies in the beam of a look."""
    return (beam_weights(static, params) > 0).astype(float)


def _planned(
    static: StaticParams, params: Params, reward: str, search_weight: float | None
) -> tuple[StaticParams, Params]:
    """The scenario with the reward that is planned for."""
    if reward not in REWARDS:
        raise ValueError(f"reward = {reward!r}: expected one of {', '.join(REWARDS)}, which need no truths")
    if search_weight is not None:
        params = dataclasses.replace(params, search_weight=search_weight)
    return dataclasses.replace(static, reward=reward), params
