"""Sensor managers against the slow definition: the real tracker, run once for every look."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxtrack import NO_DETECTION, Detections, Params, StaticParams, Tracks, Truths, kalman, tracker
from jaxtrack.env import SearchTrack
from jaxtrack.episode import EnvState
from jaxtrack.managers import (
    MANAGERS,
    REWARDS,
    beam_pixels,
    expected_return,
    expected_rewards,
    expected_step,
    greedy,
    rollout,
    uncertainty,
)
from jaxtrack.observation import covariance_norms
from jaxtrack.policies import index
from jaxtrack.reward import reward_terms
from jaxtrack.scan_map import look_grid, update_scan_map
from jaxtrack.sensor import in_beam, look_angles

pytestmark = pytest.mark.usefixtures("quick_compilation")

L, T = 5, 6
STATIC = StaticParams(num_truths=3, max_tracks=T, map_size=16, num_looks=L)
# Managers do not read the environment's reward, which here needs truths.
CONTINUOUS = dataclasses.replace(STATIC, continuous_actions=True, reward="gospa")
# Beams that overlap and hold several tracks; steps long enough for predictions to matter.
PARAMS = Params(
    beam_azimuth=0.8, beam_elevation=0.7, time_step=0.1, track_weight=0.8, prior_velocity_sigma=45.0
)
LOOKS = look_grid(STATIC, PARAMS)
KEY = jax.random.key(0)
FEW, HORIZON, DISCOUNT = 3, 6, 0.7
HEAVY = 30.0  # a search weight with which other looks win
UNTIL = dataclasses.replace(STATIC, num_truths=4, reward="shortfall", search_until_complete=True)
PLANNER = functools.partial(rollout, candidates=FEW, horizon=HORIZON, discount=DISCOUNT)
BUILDERS = {**MANAGERS, "rollout": PLANNER}


def scene(seed, num_tracks=T - 1):
    """A state with random tracks in the field and a random scan map.

    Some tracks will be deleted unless they are detected, some anyway; some were detected one
    step ago; the others' slots hold leftovers.
    """
    rng = np.random.default_rng(seed)
    azimuth, elevation = rng.uniform(-PARAMS.field_limit, PARAMS.field_limit, (2, T))
    ground = np.cos(elevation)
    mean = rng.normal(0, 30, (T, 6))
    towards = np.stack([ground * np.cos(azimuth), ground * np.sin(azimuth), np.sin(elevation)], axis=-1)
    mean[:, 0::2] = rng.uniform(1000, 9000, (T, 1)) * towards
    # Shares of the deletion threshold, mostly in position, or in velocity where no update can help much.
    share = np.array([0.3, 0.998, 0.9, 0.05, 2.5, 0.6])[:, None] * PARAMS.deletion_threshold
    split = np.where(np.arange(T)[:, None] % 3 == 1, [0.05, 0.95], [0.9, 0.1])
    sigmas = np.sqrt(share * split / 3)
    factor = rng.normal(0, 0.2, (T, 6, 6)) + np.eye(6)
    factor *= np.tile(sigmas, 3)[:, :, None] / np.linalg.norm(factor, axis=2, keepdims=True)
    order = rng.permutation(T)
    tracks = Tracks.empty(T).replace(
        mean=jnp.asarray(mean, float),
        covariance=jnp.asarray((factor @ factor.transpose(0, 2, 1))[order], float),
        active=jnp.asarray(rng.permutation(T) < num_tracks),
        updated_by=jnp.asarray(rng.integers(NO_DETECTION, 2, T)),
        age=jnp.asarray(rng.integers(0, 5, T)),
    )
    truths = Truths(state=jnp.asarray(rng.normal(0, 1000, (3, 6)), float), alive=jnp.ones(3, bool))
    scan_map = jnp.asarray(rng.uniform(0, 1, (16, 16)), float)
    return EnvState(jnp.asarray(3), truths, tracks, scan_map, jnp.asarray(0), jnp.asarray(0))


@pytest.fixture(scope="module")
def scenes():
    """Twelve states, stacked; the last without tracks."""
    states = [scene(seed) for seed in range(11)] + [scene(11, 0)]
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *states)


def slow_step(state, look, params):
    """One step by the real tracker, fed with the expected detections in the beam of a look `[2]`."""
    predicted = kalman.predict(state.tracks, params.time_step, params)
    seen = state.tracks.active & in_beam(predicted.mean[:, 0::2], look, params)
    detections = Detections.from_values(kalman.predict_detections(predicted, params).mean, seen)
    tracks, info = tracker.step(state.tracks, detections, params.time_step, state.time + 1, params)
    scan_map = update_scan_map(state.scan_map, look, STATIC, params)
    return state.replace(time=state.time + 1, tracks=tracks, scan_map=scan_map), info


def slow_rewards(state, look, params):
    """State after a look, its reward by every name, and the fall of norms by the update."""
    after, info = slow_step(state, look, params)
    rewards = {
        name: sum(
            reward_terms(
                state.tracks,
                after.tracks,
                state.truths,
                after.scan_map,
                dataclasses.replace(STATIC, reward=name),
                params,
            )
        )
        for name in REWARDS
    }
    heavy = params.replace(search_weight=HEAVY)
    terms = reward_terms(state.tracks, after.tracks, state.truths, after.scan_map, UNTIL, heavy)
    rewards["until complete"], rewards["search"] = sum(terms), terms[1]
    fall = covariance_norms(info.predicted) - covariance_norms(info.updated)
    rewards["fall"] = jnp.where(state.tracks.active, fall, 0.0).sum()
    return after, rewards, info.initiated.any() | (info.deleted & ~state.tracks.active).any()


@pytest.fixture(scope="module")
def slow(scenes):
    """The slow definition in all scenes: states, rewards `[S, L * L]`."""
    every_scene = jax.jit(jax.vmap(jax.vmap(slow_rewards, in_axes=(None, 0, None)), in_axes=(0, None, None)))
    after, rewards, odd = every_scene(scenes, LOOKS, PARAMS)
    assert not np.any(odd)
    return after, {name: np.asarray(values) for name, values in rewards.items()}


def act_on_all(build, scenes, static=STATIC):
    """Actions `[S, 2]` of a builder's policy in all scenes."""
    return np.asarray(compiled(build, static)(KEY, scenes))


@functools.cache
def compiled(build, static):
    """A policy over a batch of states, compiled once for all tests."""
    return jax.jit(jax.vmap(build(static, PARAMS), in_axes=(None, 0)))


def assert_best(actions, values, margin=1e-6):
    """Every action has the largest of `values` `[S, L * L]`, but for rounding."""
    chosen = np.take_along_axis(values, actions @ np.array([[L], [1]]), axis=1)[:, 0]
    np.testing.assert_allclose(chosen, values.max(axis=1), rtol=1e-5, atol=margin)


@pytest.mark.parametrize("reward", REWARDS)
def test_expected_rewards_are_those_of_the_tracker(reward, scenes, slow):
    static = dataclasses.replace(STATIC, reward=reward)
    pixels = beam_pixels(static, PARAMS)
    expected = jax.jit(jax.vmap(lambda state: expected_rewards(state, LOOKS, pixels, static, PARAMS)))
    ours = expected(scenes)
    np.testing.assert_allclose(ours, slow[1][reward], rtol=2e-5, atol=2e-6)
    # Looks differ by far more than that.
    assert np.median(np.ptp(slow[1][reward], axis=1)) > 0.01


def test_greedy_takes_the_largest_expected_reward(scenes, slow):
    assert_best(act_on_all(greedy, scenes), slow[1]["information"])
    assert_best(act_on_all(functools.partial(greedy, reward="paper"), scenes), slow[1]["paper"])


def test_scenes_hold_every_case(scenes, slow):
    after = slow[0]
    survived = np.asarray(after.tracks.active)
    saved = survived.any(axis=1) & ~survived.all(axis=1)
    assert saved.any(), "some track lives only if it is detected"
    assert (np.asarray(scenes.tracks.active) & ~survived.any(axis=1)).any(), "some track is deleted anyway"
    detected = np.asarray(after.tracks.updated_by) != NO_DETECTION
    assert (detected & survived).sum(axis=-1).max() >= 2, "some beam holds several tracks"


def test_search_pays_by_its_weight(scenes, slow):
    """Another weight adds the same multiple of the search term, and other looks win."""
    after, rewards = slow
    scan_value = np.asarray(after.scan_map).mean(axis=(-2, -1))
    weight = 30.0
    values = rewards["information"] + (PARAMS.search_weight - weight) * scan_value
    actions = act_on_all(functools.partial(greedy, search_weight=weight), scenes)
    assert_best(actions, values, margin=1e-5)
    assert (actions != act_on_all(greedy, scenes)).any()


def test_search_pays_by_its_sharpness(scenes, slow):
    after, rewards = slow
    scan_map = np.asarray(after.scan_map, dtype=np.float64)
    values = rewards["shortfall"] + PARAMS.search_weight * scan_map.mean(axis=(-2, -1))
    values -= 30 * (scan_map**4).mean(axis=(-2, -1))
    build = functools.partial(greedy, reward="shortfall", search_weight=30.0)
    actions = act_on_all(functools.partial(build, search_sharpness=4), scenes)
    assert_best(actions, values, margin=1e-5)
    assert (actions != act_on_all(build, scenes)).any()


def test_search_pays_until_all_truths_have_confirmed_tracks(scenes, slow):
    _, rewards = slow
    ended = rewards["search"] == 0
    assert (ended.any(axis=1) & ~ended.all(axis=1)).any(), "by a look at the right track alone"
    assert ended.all(axis=1).any()
    params = PARAMS.replace(search_weight=HEAVY)
    pixels = beam_pixels(UNTIL, params)
    expected = jax.jit(jax.vmap(lambda state: expected_rewards(state, LOOKS, pixels, UNTIL, params)))
    np.testing.assert_allclose(expected(scenes), rewards["until complete"], rtol=1e-4, atol=1e-4)
    build = functools.partial(greedy, reward="shortfall", search_weight=HEAVY)
    actions = act_on_all(functools.partial(build, search_until_complete=True), scenes, UNTIL)
    assert_best(actions, rewards["until complete"], margin=1e-5)
    always = functools.partial(build, search_until_complete=False)
    assert (actions != act_on_all(always, scenes, UNTIL)).any()


def test_expected_step_is_that_of_the_tracker(scenes, slow):
    static = dataclasses.replace(STATIC, reward="paper")
    actions = jnp.stack(jnp.meshgrid(jnp.arange(L), jnp.arange(L), indexing="ij"), axis=-1).reshape(-1, 2)
    step = jax.vmap(lambda state, action: expected_step(state, action, static, PARAMS), in_axes=(None, 0))
    ours, reward = jax.jit(jax.vmap(step, in_axes=(0, None)))(scenes, actions)
    theirs = slow[0]
    live = np.asarray(theirs.tracks.active)
    np.testing.assert_array_equal(ours.tracks.active, live)
    np.testing.assert_array_equal(ours.tracks.age[live], theirs.tracks.age[live])
    detected = [np.asarray(side.tracks.updated_by)[live] != NO_DETECTION for side in (ours, theirs)]
    np.testing.assert_array_equal(*detected)
    np.testing.assert_allclose(ours.tracks.mean[live], theirs.tracks.mean[live], rtol=1e-5, atol=1e-2)
    np.testing.assert_allclose(
        ours.tracks.covariance[live], theirs.tracks.covariance[live], rtol=1e-4, atol=1e-2
    )
    np.testing.assert_allclose(ours.scan_map, theirs.scan_map, atol=1e-6)
    np.testing.assert_array_equal(ours.time, theirs.time)
    np.testing.assert_array_equal(ours.truths.state, theirs.truths.state)
    np.testing.assert_allclose(reward, slow[1]["paper"], rtol=2e-5, atol=2e-6)


def test_uncertainty_takes_the_largest_fall_of_norms(scenes, slow):
    actions = act_on_all(uncertainty, scenes)
    assert_best(actions, slow[1]["fall"], margin=1e-3)
    assert len({tuple(action) for action in actions}) > 4
    assert actions[-1].tolist() == [0, 0], "without tracks the first look"


@jax.jit
def slow_futures(state):
    """Rewards `[HORIZON + 1, L * L]` after every look, the index rule following it."""
    base = jax.vmap(index(STATIC, PARAMS), in_axes=(None, 0))

    def one_step(carry, _):
        states, looks = carry
        states, rewards, _ = jax.vmap(slow_rewards, in_axes=(0, 0, None))(states, looks, PARAMS)
        return (states, look_angles(base(KEY, states), STATIC, PARAMS)), rewards["information"]

    states = jax.tree.map(lambda leaf: jnp.repeat(leaf[None], L * L, axis=0), state)
    return jax.lax.scan(one_step, (states, LOOKS), length=HORIZON + 1)[1]


@pytest.mark.medium
def test_rollout_collects_the_rewards_of_the_base_policy(scenes, slow):
    states = [jax.tree.map(lambda leaf, i=i: leaf[i], scenes) for i in range(12)]
    futures = np.stack([slow_futures(state) for state in states])
    totals = np.einsum("skl,k->sl", futures, DISCOUNT ** np.arange(HORIZON + 1))
    # Only the best few by the next reward are tried, and that of the base policy.
    base = act_on_all(index, scenes) @ np.array([[L], [1]])
    tried = np.concatenate([np.argsort(-slow[1]["information"], axis=1)[:, :FEW], base], axis=1)
    few = np.full_like(totals, -np.inf)
    np.put_along_axis(few, tried, np.take_along_axis(totals, tried, axis=1), axis=1)
    assert_best(act_on_all(PLANNER, scenes), few, margin=1e-5)
    assert len({tuple(values.argmax(axis=1)) for values in (totals, few, slow[1]["information"])}) == 3

    information, base = dataclasses.replace(STATIC, reward="information"), index(STATIC, PARAMS)
    ours = jax.vmap(
        lambda state, action: expected_return(
            KEY, state, action, base, HORIZON, DISCOUNT, information, PARAMS
        ),
        in_axes=(0, None),
    )
    action = [2, 3]
    returns = jax.jit(ours)(scenes, jnp.array(action))
    np.testing.assert_allclose(returns, totals[:, action[0] * L + action[1]], rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("name", BUILDERS)
def test_actions_lie_in_the_space_and_no_truth_is_read(name, scenes):
    build = BUILDERS[name]
    indices, angles = act_on_all(build, scenes), act_on_all(build, scenes, CONTINUOUS)
    assert np.issubdtype(indices.dtype, np.integer)
    for static, actions in ((STATIC, indices), (CONTINUOUS, angles)):
        space = SearchTrack(static).action_space(PARAMS)
        assert all(bool(space.contains(jnp.asarray(action))) for action in actions)
    np.testing.assert_allclose(angles, look_angles(indices, STATIC, PARAMS), atol=1e-6)
    hidden = scenes.replace(truths=jax.tree.map(lambda leaf: jnp.full_like(leaf, jnp.nan), scenes.truths))
    np.testing.assert_array_equal(act_on_all(build, hidden), indices)


@pytest.mark.parametrize(
    ("build", "numbers", "message"),
    [
        (greedy, {"reward": "gospa"}, "reward = 'gospa': expected one of information, shortfall, "),
        (rollout, {"reward": "nonsense"}, "reward = 'nonsense'"),
        (rollout, {"candidates": 0}, r"candidates = 0: expected an integer in \[1, 25\]"),
        (rollout, {"candidates": 26}, "candidates = 26"),
        (rollout, {"horizon": -1}, "horizon = -1: expected an integer >= 0"),
        (rollout, {"discount": 1.5}, r"discount = 1.5: expected a number in \[0, 1\]"),
    ],
)
def test_wrong_numbers_are_named(build, numbers, message):
    with pytest.raises(ValueError, match=message):
        build(STATIC, PARAMS, **numbers)
