"""Baselines: actions in range, blind to the truths, and each rule against plain numpy."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxtrack import Params, StaticParams, Tracks, Truths
from jaxtrack.env import SearchTrack
from jaxtrack.episode import EnvState
from jaxtrack.policies import POLICIES, REVISIT_SHARE, gain, index, scheduler
from jaxtrack.scan_map import initial_scan_map, update_scan_map
from jaxtrack.search_plan import search_plan
from jaxtrack.sensor import look_angles

pytestmark = pytest.mark.usefixtures("quick_compilation")

L, M, T = 5, 16, 4
STATIC = StaticParams(num_truths=3, max_tracks=T, map_size=M, num_looks=L)
CONTINUOUS = StaticParams(num_truths=3, max_tracks=T, map_size=M, num_looks=L, continuous_actions=True)
# Beams that overlap, and each wide enough to hold pixels and several tracks.
PARAMS = Params(beam_azimuth=0.8, beam_elevation=0.7)
LIMIT = PARAMS.field_limit


def scene(seed, time=3):
    """A state with random tracks in the field, one empty slot, and a random scan map."""
    rng = np.random.default_rng(seed)
    azimuth, elevation = rng.uniform(-LIMIT, LIMIT, (2, T))
    means = np.zeros((T, 6))
    means[:, 0::2] = 3000 * unit(azimuth, elevation)
    traces = rng.uniform(0, PARAMS.deletion_threshold, T)
    tracks = Tracks.empty(T).replace(
        mean=jnp.asarray(means, dtype=float),
        covariance=jnp.asarray(traces[:, None, None] / 6 * np.eye(6), dtype=float),
        active=jnp.arange(T) != seed % T,
    )
    truths = Truths(state=jnp.asarray(rng.normal(0, 1000, (3, 6)), dtype=float), alive=jnp.ones(3, bool))
    scan_map = jnp.asarray(rng.uniform(0, 1, (M, M)), dtype=float)
    return EnvState(jnp.asarray(time), truths, tracks, scan_map, jnp.asarray(0), jnp.asarray(0))


@pytest.fixture(scope="module")
def scenes():
    """Sixteen states, stacked."""
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *[scene(seed, 7 * seed) for seed in range(16)])


def unit(azimuth, elevation):
    """Unit vectors `[..., 3]`, in double precision."""
    ground = np.cos(elevation)
    return np.stack([ground * np.cos(azimuth), ground * np.sin(azimuth), np.sin(elevation)], axis=-1)


def inside(points, azimuth, elevation):
    """Which points `[P, 3]` a beam holds: turned to the boresight, then the two angles."""
    about_z = np.array(
        [[np.cos(azimuth), np.sin(azimuth), 0], [-np.sin(azimuth), np.cos(azimuth), 0], [0, 0, 1]]
    )
    about_y = np.array(
        [[np.cos(elevation), 0, np.sin(elevation)], [0, 1, 0], [-np.sin(elevation), 0, np.cos(elevation)]]
    )
    x, y, z = (points @ about_z.T @ about_y.T).T
    bearing = np.abs(np.arctan2(y, x)) <= PARAMS.beam_azimuth / 2
    return bearing & (np.abs(np.arctan2(z, np.hypot(x, y))) <= PARAMS.beam_elevation / 2)


def by_look(state, exponent=1.0, position_weight=1.0):
    """Mean scan value and, summed over tracks, powers of trace per threshold: `[L, L]` each, in numpy."""
    angles = np.linspace(-LIMIT, LIMIT, M)
    pixels = unit(*np.meshgrid(angles, angles)).reshape(-1, 3)
    values = np.asarray(state.scan_map, dtype=np.float64).ravel()
    tracks = np.asarray(state.tracks.mean, dtype=np.float64)[:, 0::2]
    active = np.asarray(state.tracks.active)
    of_state = np.diagonal(np.asarray(state.tracks.covariance, dtype=np.float64), axis1=1, axis2=2)
    shares = of_state @ np.array([position_weight, 1.0] * 3) / PARAMS.deletion_threshold
    scan, share = np.zeros((L, L)), np.zeros((L, L))
    for i, azimuth in enumerate(np.linspace(-LIMIT, LIMIT, L)):
        for j, elevation in enumerate(np.linspace(-LIMIT, LIMIT, L)):
            scan[i, j] = values[inside(pixels, azimuth, elevation)].mean()
            share[i, j] = (shares[active & inside(tracks, azimuth, elevation)] ** exponent).sum()
    return scan, share


def largest(values):
    """Row and column of the largest entry, which must be clearly the largest."""
    first, second = np.sort(values.ravel())[:-3:-1]
    assert first - second > 1e-5
    return list(np.unravel_index(np.argmax(values), values.shape))


def act(name, state, seed=0, static=STATIC):
    """The action `[2]` of a policy."""
    return np.asarray(POLICIES[name](static, PARAMS)(jax.random.key(seed), state)).tolist()


def act_on_all(name, scenes, static=STATIC):
    """Actions `[S, 2]` in all states with one episode's key."""
    return np.asarray(compiled(name, static)(jax.random.key(0), scenes))


@functools.cache
def compiled(name, static):
    """A policy over a batch of states, compiled once for all tests."""
    return jax.jit(jax.vmap(POLICIES[name](static, PARAMS), in_axes=(None, 0)))


@pytest.mark.parametrize("name", POLICIES)
def test_actions_lie_in_the_space_and_angles_are_those_of_the_indices(name, scenes):
    indices, angles = act_on_all(name, scenes), act_on_all(name, scenes, CONTINUOUS)
    assert np.issubdtype(indices.dtype, np.integer)
    for static, actions in ((STATIC, indices), (CONTINUOUS, angles)):
        assert actions.shape == (16, 2)
        space = SearchTrack(static).action_space(PARAMS)
        assert all(bool(space.contains(jnp.asarray(action))) for action in actions)
    np.testing.assert_allclose(angles, look_angles(indices, STATIC, PARAMS), atol=1e-6)


@pytest.mark.parametrize("name", POLICIES)
def test_the_truths_are_not_read(name, scenes):
    hidden = scenes.replace(truths=jax.tree.map(lambda leaf: jnp.full_like(leaf, jnp.nan), scenes.truths))
    moved = scenes.replace(truths=scenes.truths.replace(state=-scenes.truths.state))
    for other in (hidden, moved):
        np.testing.assert_array_equal(act_on_all(name, other), act_on_all(name, scenes))


def test_random_is_uniform_and_new_at_every_step():
    policy = POLICIES["random"](STATIC, PARAMS)
    times, state = jnp.arange(5000), scene(0)
    actions = jax.vmap(lambda time: policy(jax.random.key(0), state.replace(time=time)))(times)
    counts = np.bincount(np.asarray(actions[:, 0] * L + actions[:, 1]), minlength=L * L)
    # Chi-square with 24 degrees of freedom: 51.2 is passed once in a thousand.
    assert ((counts - 200) ** 2 / 200).sum() < 51.2
    # The same key and the same time give the same look.
    assert act("random", scene(0), seed=3) == act("random", scene(1), seed=3)


def test_static_keeps_its_look_and_draws_another_for_another_episode():
    looks = {tuple(act("static", scene(0, time))) for time in range(5)}
    assert len(looks) == 1
    assert len({tuple(act("static", scene(0), seed)) for seed in range(8)}) > 3


def test_coverage_sees_every_look_once_line_by_line():
    static = StaticParams(map_size=4)
    policy = POLICIES["coverage"](static, PARAMS)
    state = scene(0)
    actions = jax.vmap(lambda time: policy(jax.random.key(0), state.replace(time=time)))(jnp.arange(722))
    actions = np.asarray(actions)
    first = actions[:361]
    assert len({tuple(action) for action in first}) == 361
    np.testing.assert_array_equal(first[:, 1], np.repeat(np.arange(19), 19))
    # Back and forth: the radar never jumps within a pass.
    assert np.abs(np.diff(first, axis=0)).sum(axis=1).max() == 1
    assert first[0].tolist() == [0, 0]
    assert len({tuple(action) for action in actions[361:]}) == 361


@pytest.mark.parametrize("seed", range(4))
def test_stalest_takes_the_largest_mean_scan_value(seed):
    scan, _ = by_look(scene(seed))
    assert act("stalest", scene(seed)) == largest(scan)


@pytest.mark.parametrize("seed", range(4))
def test_index_takes_the_largest_sum_of_scan_value_and_traces(seed):
    scan, share = by_look(scene(seed))
    assert act("index", scene(seed)) == largest(scan + share)


def test_index_weighs_both_terms():
    states = [scene(seed) for seed in range(4)]
    terms = [by_look(state) for state in states]
    chosen = [largest(scan + share) for scan, share in terms]
    # In these scenes either term alone would choose differently.
    assert any(largest(scan) != both for (scan, _), both in zip(terms, chosen, strict=True))
    assert any(share[tuple(both)] < share.max() for (_, share), both in zip(terms, chosen, strict=True))
    assert [act("index", state) for state in states] == chosen


@pytest.mark.parametrize(
    ("exponent", "scan_weight", "sharpness", "position_weight"),
    [(0.3, 1.0, 1, 1.0), (1.0, 5.0, 1, 1.0), (3.0, 0.5, 1, 1.0), (1.0, 1.0, 4, 1.0), (1.0, 1.0, 1, 30.0)],
)
def test_index_with_other_numbers(exponent, scan_weight, sharpness, position_weight):
    numbers = {"exponent": exponent, "scan_weight": scan_weight}
    numbers |= {"sharpness": sharpness, "position_weight": position_weight}
    build = functools.partial(index, **numbers)
    moved = 0
    for seed in range(8):
        state = scene(seed)
        scan, share = by_look(state, exponent, position_weight)
        action = build(STATIC, PARAMS)(jax.random.key(0), state).tolist()
        assert action == largest(scan_weight * scan**sharpness + share)
        moved += action != act("index", state)
    assert moved > 0, "in these scenes the numbers matter"


def by_gain(
    state, sharpness=16, area_exponent=0.5, variance_scale=1000.0, danger_weight=3.0, danger_exponent=8
):
    """Field found unseen, and what the tracks need: `[L, L]` each, in numpy."""
    angles = np.linspace(-LIMIT, LIMIT, M)
    pixels = unit(*np.meshgrid(angles, angles)).reshape(-1, 3)
    values = np.asarray(state.scan_map, dtype=np.float64).ravel() ** sharpness
    places = np.asarray(state.tracks.mean, dtype=np.float64)[:, 0::2]
    of_state = np.diagonal(np.asarray(state.tracks.covariance, dtype=np.float64), axis1=1, axis2=2)
    before = of_state[:, 0::2].sum(axis=1)
    across = PARAMS.elevation_sigma**2 + PARAMS.bearing_sigma**2
    noise = np.linalg.norm(places, axis=1) ** 2 * across + PARAMS.range_sigma**2
    danger = (of_state.sum(axis=1) / PARAMS.deletion_threshold) ** danger_exponent
    needs = (before - 1 / (1 / before + 1 / noise)) / variance_scale + danger_weight * danger
    active = np.asarray(state.tracks.active)
    unseen, sizes, need = np.zeros((3, L, L))
    for i, azimuth in enumerate(np.linspace(-LIMIT, LIMIT, L)):
        for j, elevation in enumerate(np.linspace(-LIMIT, LIMIT, L)):
            held = inside(pixels, azimuth, elevation)
            unseen[i, j], sizes[i, j] = values[held].mean(), held.sum()
            need[i, j] = needs[active & inside(places, azimuth, elevation)].sum()
    return unseen * (sizes / np.median(sizes)) ** area_exponent, need


@pytest.mark.parametrize(
    "numbers",
    [
        {},
        {"sharpness": 2},
        {"area_exponent": 1.5},
        {"variance_scale": 1e3},
        {"danger_weight": 3.0},
        {"danger_exponent": 2},
    ],
    ids=str,
)
def test_gain_takes_the_look_that_finds_most_field_unseen_and_helps_the_tracks_most(numbers):
    # These tracks are worse than usual: by default they would outweigh any search.
    patient = {"variance_scale": 5e4, "danger_weight": 0.1}
    numbers = {**patient, **numbers}
    policy = jax.jit(functools.partial(gain, **numbers)(STATIC, PARAMS))
    gains = [(by_gain(scene(seed), **numbers), by_gain(scene(seed), **patient)) for seed in range(8)]
    chosen = [policy(jax.random.key(0), scene(seed)).tolist() for seed in range(8)]
    assert chosen == [largest(unseen + need) for (unseen, need), _ in gains]
    if numbers == patient:
        # In these scenes either part alone would choose differently.
        assert any(look != largest(unseen) for look, ((unseen, _), _) in zip(chosen, gains, strict=True))
        assert any(need[tuple(look)] < need.max() for look, ((_, need), _) in zip(chosen, gains, strict=True))
    else:
        assert chosen != [largest(unseen + need) for _, (unseen, need) in gains]


@pytest.mark.parametrize(
    ("truths", "sigma", "weight"),
    [
        (3, 100.0, 0.25),  # these scenes have three tracks, all known better than new ones of this spread
        (4, 100.0, 1.0),
        (3, 1.0, 1.0),  # and here none is
    ],
)
def test_gain_searches_less_while_there_are_as_many_confirmed_tracks_as_truths(truths, sigma, weight):
    patient = {"variance_scale": 5e4, "danger_weight": 0.1}
    static, params = (
        dataclasses.replace(STATIC, num_truths=truths),
        PARAMS.replace(prior_velocity_sigma=sigma),
    )
    policy = jax.jit(gain(static, params, **patient, tracked_weight=0.25))
    chosen = [policy(jax.random.key(0), scene(seed)).tolist() for seed in range(8)]
    parts = [by_gain(scene(seed), **patient) for seed in range(8)]
    assert chosen == [largest(weight * unseen + need) for unseen, need in parts]
    assert chosen != [largest((1.25 - weight) * unseen + need) for unseen, need in parts]


def test_sweep_follows_the_search_plan_where_it_has_no_tracks():
    plan = jax.jit(search_plan, static_argnums=0)(STATIC, PARAMS)
    policy = jax.jit(POLICIES["sweep"](STATIC, PARAMS))
    state, order = scene(0), np.argsort(plan.turn).tolist()
    state = state.replace(tracks=Tracks.empty(T), scan_map=initial_scan_map(STATIC))
    for turn in range(6):
        action = policy(jax.random.key(0), state)
        assert action.tolist() == list(divmod(order[turn], L))
        look = look_angles(action, STATIC, PARAMS)
        state = state.replace(scan_map=update_scan_map(state.scan_map, look, STATIC, PARAMS))
    # Urgent tracks come first, as by the rule without a plan.
    urgent = scene(0).replace(scan_map=initial_scan_map(STATIC))
    assert policy(jax.random.key(0), urgent).tolist() == act("gain", urgent)


def with_share(share, azimuth, elevation):
    """One live track of that trace per threshold; a dead slot holds a worse one elsewhere."""
    state = scene(0)
    mean = np.zeros((T, 6))
    mean[:, 0::2] = 5000 * unit(np.array([0.0, azimuth, 0.0, 0.0]), np.array([0.0, elevation, 0.0, 0.0]))
    shares = np.array([5.0, share, 5.0, 5.0])
    covariance = (shares * PARAMS.deletion_threshold / 6)[:, None, None] * np.eye(6)
    tracks = state.tracks.replace(
        mean=jnp.asarray(mean, dtype=float),
        covariance=jnp.asarray(covariance, dtype=float),
        active=jnp.arange(T) == 1,
    )
    return state.replace(tracks=tracks)


@pytest.mark.parametrize("place", [(3, 1), (0, 3), (2, 2)])
def test_scheduler_revisits_an_urgent_track_and_else_the_stalest_cell(place):
    grid = np.linspace(-LIMIT, LIMIT, L)
    # Off the boresight by less than half a step: rounding must choose this look.
    azimuth, elevation = grid[place[0]] + 0.2, grid[place[1]] - 0.2
    urgent = with_share(REVISIT_SHARE + 0.01, azimuth, elevation)
    patient = with_share(REVISIT_SHARE - 0.01, azimuth, elevation)
    stalest = largest(by_look(patient)[0])
    assert stalest != list(place)
    assert act("scheduler", urgent) == list(place)
    assert act("scheduler", patient) == stalest


def test_scheduler_with_another_share():
    place = (3, 1)
    grid = np.linspace(-LIMIT, LIMIT, L)
    policy = functools.partial(scheduler, revisit_share=0.3)(STATIC, PARAMS)
    for share, revisits in ((0.31, True), (0.29, False)):
        state = with_share(share, grid[place[0]], grid[place[1]])
        assert (policy(jax.random.key(0), state).tolist() == list(place)) == revisits


def test_scheduler_turns_to_the_worst_of_several_tracks():
    state = with_share(0.9, 0.0, 0.0)
    both = state.tracks.replace(active=jnp.array([False, True, True, False]))
    mean = both.mean.at[2, 0::2].set(jnp.asarray(5000 * unit(LIMIT, -LIMIT), dtype=float))
    assert act("scheduler", state.replace(tracks=both.replace(mean=mean))) == [L - 1, 0]


def test_a_track_outside_the_field_gets_the_look_at_its_edge():
    assert act("scheduler", with_share(0.9, LIMIT + 0.4, -LIMIT - 0.3)) == [L - 1, 0]
