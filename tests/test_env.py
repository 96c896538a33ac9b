"""The environment's contract: six values, autoreset, truncation, determinism, one compilation."""

from types import SimpleNamespace

import chex
import gymnax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

import jaxtrack
from jaxtrack import Params, SearchTrack, StaticParams, Tracks, make, metrics
from jaxtrack.association import euclidean
from jaxtrack.env import step_info
from jaxtrack.observation import observe
from jaxtrack.params import METRICS

SHAPES = {
    "observe_variances": True,
    "num_truths": 3,
    "max_tracks": 4,
    "max_detections": 3,
    "max_clutter": 2,
    "map_size": 10,
    "num_looks": 4,
}
LENGTH = 12
# A wide beam, false detections and a short-lived track: everything happens within one episode.
PARAMS = Params(
    max_steps_in_episode=LENGTH, beam_azimuth=1.0, beam_elevation=1.0, clutter_rate=0.7, time_step=0.5
)


@pytest.fixture(scope="module")
def env():
    made, _ = gymnax.make(jaxtrack.ENV_ID, **SHAPES)
    return made


def play(env, params, seed, steps):
    """Random play: all observations and results, in order."""
    key, key_reset = jax.random.split(jax.random.key(seed))
    observation, state = env.reset(key_reset, params)
    history = [(observation, state)]
    results = []
    space = env.action_space(params)
    for key_step in jax.random.split(key, steps):
        key_action, key_env = jax.random.split(key_step)
        action = space.sample(key_action)
        assert bool(space.contains(action))
        observation, state, *result = env.step(key_env, state, action, params)
        history.append((observation, state))
        results.append(result)
    return history, results


@pytest.fixture(scope="module")
def episode(env):
    """One episode and three steps of the next."""
    return play(env, PARAMS, seed=0, steps=LENGTH + 3)


def test_gymnax_makes_the_environment_of_the_paper_by_name():
    env, params = gymnax.make("SearchTrack-v0")
    assert isinstance(env, SearchTrack)
    assert env.name == "SearchTrack-v0"
    assert env.static == StaticParams()
    assert params == Params()
    assert env.num_actions == 361


def test_shapes_come_as_a_record_or_keywords_or_both():
    assert SearchTrack(StaticParams(max_tracks=7), num_looks=5).static == StaticParams(
        max_tracks=7, num_looks=5
    )
    with pytest.raises(ValueError, match=r"^max_tracks = 0"):
        SearchTrack(max_tracks=0)
    with pytest.raises(TypeError, match="nonsense"):
        SearchTrack(nonsense=1)


def test_make_checks_the_numbers():
    with pytest.raises(ValueError, match=r"^time_step = -1"):
        jaxtrack.make(Params(time_step=-1.0))
    with pytest.raises(ValueError, match=r"^clutter_rate"):
        jaxtrack.make(Params(clutter_rate=3.0), max_clutter=2)
    _, params = jaxtrack.make(**SHAPES)
    assert params == Params()


def test_an_episode_begins_with_nothing_known(episode):
    observation, state = episode[0][0]
    assert not bool(jnp.any(observation["mask"]))
    assert not bool(jnp.any(observation["tracks"]))
    assert bool(jnp.all(observation["scan_map"] == 1))
    assert (int(state.time), int(state.num_initiated)) == (0, 0)


def test_every_observation_lies_in_the_space_and_pads_with_zeros(env, episode):
    contains = jax.jit(env.observation_space(PARAMS).contains)
    for observation, state in episode[0]:
        assert bool(contains(observation))
        assert not bool(jnp.any(observation["tracks"][~observation["mask"]]))
        expected = observe(state.tracks, state.scan_map, PARAMS, with_variances=True)
        chex.assert_trees_all_close(observation, expected, rtol=1e-5)
    most = max(int(observation["mask"].sum()) for observation, _ in episode[0])
    assert most >= 3  # else the padding has hardly been tested


def test_episodes_end_by_truncation_exactly_at_their_length(episode):
    ends = [(bool(terminated), bool(truncated)) for _, terminated, truncated, _ in episode[1]]
    assert ends == [(False, step == LENGTH) for step in range(1, LENGTH + 4)]


def test_the_next_episode_starts_at_once_and_the_last_observation_is_kept(episode):
    history, results = episode
    observation, state = history[LENGTH]
    final = results[LENGTH - 1][3]["final_observation"]
    assert int(state.time) == 0
    assert bool(jnp.all(observation["scan_map"] == 1))
    assert not bool(jnp.any(state.tracks.active))
    assert bool(jnp.any(final["mask"]))
    assert float(final["scan_map"].min()) == 0.0
    # New truths, not those of the first episode.
    assert not np.any(np.asarray(state.truths.state) == np.asarray(history[0][1].truths.state))
    assert int(history[LENGTH + 1][1].time) == 1


def test_away_from_the_end_the_final_observation_is_the_observation(episode):
    for (observation, _), result in zip(episode[0][1:LENGTH], episode[1], strict=False):
        chex.assert_trees_all_equal(result[3]["final_observation"], observation)


def test_info_is_scalar_finite_and_adds_up(episode):
    initiated = 0
    for (_, state), (reward, *_, info) in zip(episode[0][1:LENGTH], episode[1], strict=False):
        numbers = {name: value for name, value in info.items() if name != "final_observation"}
        assert all(value.shape == () and np.isfinite(value) for value in numbers.values())
        np.testing.assert_allclose(reward, info["reward_track"] + info["reward_search"], rtol=1e-6)
        assert int(info["live_tracks"]) == int(state.tracks.active.sum())
        np.testing.assert_allclose(info["mean_scan_value"], state.scan_map.mean(), rtol=1e-6)
        newborn = state.tracks.active & (state.tracks.age == 0)
        assert bool(jnp.all(state.tracks.birth_step[newborn] == state.time))
        initiated += int(jnp.sum(newborn))
        assert int(state.num_initiated) == initiated
    assert sum(int(info["num_detections"]) for *_, info in episode[1]) > 5


def test_equal_seeds_give_equal_bytes_and_others_do_not(env, episode):
    again = play(env, PARAMS, seed=0, steps=LENGTH + 3)
    other = play(env, PARAMS, seed=1, steps=2)
    for one, two in zip(jax.tree.leaves(episode), jax.tree.leaves(again), strict=True):
        assert np.asarray(one).tobytes() == np.asarray(two).tobytes()
    first, different = (np.asarray(history[0][1].truths.state) for history, _ in (episode, other))
    assert not np.any(first == different)


def row_of(record, row):
    return jax.tree.map(lambda leaf: leaf[row], record)


def test_a_batch_over_keys_and_numbers_equals_a_loop_and_compiles_once(env):
    @jax.jit
    @chex.assert_max_traces(n=1)
    def step(keys, states, actions, params):
        return jax.vmap(env.step)(keys, states, actions, params)

    numbers = [PARAMS, PARAMS.replace(detection_probability=0.4, beam_azimuth=0.5, max_steps_in_episode=2)]
    batch = jax.tree.map(lambda *leaves: jnp.asarray(np.stack(leaves)), *numbers)
    keys = jax.random.split(jax.random.key(5), 2)
    _, states = jax.vmap(env.reset)(keys, batch)
    alone = [row_of(states, row) for row in range(2)]
    for count in range(3):
        actions = jnp.array([[count, 1], [2, count]])
        observations, states, rewards, _, truncated, _ = step(keys, states, actions, batch)
        for row in range(2):
            observation, alone[row], reward, *_ = env.step(keys[row], alone[row], actions[row], numbers[row])
            chex.assert_trees_all_close(observation, row_of(observations, row), rtol=1e-3, atol=1e-3)
            np.testing.assert_allclose(rewards[row], reward, rtol=1e-3, atol=1e-3)
        np.testing.assert_array_equal(truncated, [False, count == 1])
    # Other numbers, same compilation.
    step(keys, states, actions, batch.replace(clutter_rate=jnp.array([0.0, 2.0])))


def test_actions_out_of_range_are_looks_at_the_edge(env, episode):
    _, state = episode[0][3]
    key = jax.random.key(9)
    edge = env.step(key, state, jnp.array([0, 3]), PARAMS)
    beyond = env.step(key, state, jnp.array([-7, 99]), PARAMS)
    chex.assert_trees_all_equal(beyond, edge)
    assert float(edge[0]["scan_map"][-1, 0]) == 0.0


def test_continuous_actions_and_recorded_truths_in_double_precision(x64):
    recorded = np.zeros((3, 2, 6))
    # Straight ahead, the second one present at time 2 only.
    recorded[:, :, 0] = [[3000, np.nan], [3001, np.nan], [3002, 5000]]
    static = StaticParams(**(SHAPES | {"num_truths": 2}), continuous_actions=True)
    params = Params(trajectories=jnp.asarray(recorded), time_step=0.5)
    env, params = jaxtrack.make(params, static)
    space = env.action_space(params)
    assert space.shape == (2,)
    for key in jax.random.split(jax.random.key(0), 20):
        assert bool(space.contains(space.sample(key)))
    _, state = env.reset(jax.random.key(0), params)
    seen = []
    for action in ([0.02, -0.03], [0.0, 0.0], [50.0, 50.0], [jnp.nan, 0.0]):
        _, state, reward, *_, info = env.step(jax.random.key(1), state, jnp.array(action), params)
        seen.append(int(info["num_detections"]))
        assert np.isfinite(reward)
    assert seen == [1, 2, 0, 0]
    np.testing.assert_array_equal(state.truths.state[:, 0], [3002, 5000])
    assert state.tracks.mean.dtype == state.scan_map.dtype == reward.dtype == jnp.float64


def test_recorded_truths_of_a_wrong_shape_are_refused(env):
    params = PARAMS.replace(trajectories=jnp.zeros((5, 2, 6)))
    with pytest.raises(ValueError, match=r"^trajectories has shape \(5, 2, 6\): expected"):
        env.reset(jax.random.key(0), params)


@pytest.fixture(scope="module")
def choices(quick_compilation):
    """Three steps of an environment with births, another measure, and more metrics in `info`."""
    shapes = {"info_metrics": ("gospa", "gospa_missed"), "measure": "euclidean"}
    wide = PARAMS.replace(birth_rate=2.0, initial_truths=2, beam_azimuth=3.0, beam_elevation=3.0)
    env, params = make(wide, **SHAPES, **shapes)

    @jax.jit
    def play(key, params):
        def advance(state, key):
            noise = env.sample_noise(key)
            # P(at most 1) = 0.41 and P(at most 2) = 0.68 at rate 2.
            noise = noise.replace(truths=noise.truths.replace(birth_count=jnp.asarray(0.5)))
            state, record = env.advance(state, jnp.array([1, 2]), noise, params)
            info = step_info(state, record, (0.0, 0.0), env.static, params)
            measured = euclidean(record.tracker.expected, record.detections, params)
            return state, (state, record, info, measured)

        _, state = env.reset_env(key, params)
        return jax.lax.scan(advance, state, jax.random.split(key, 3))[1]

    return play(jax.random.key(0), params)


def test_metrics_can_be_asked_for_in_info(choices):
    state, _, info, _ = choices
    found = jax.jit(jax.vmap(metrics.gospa, in_axes=(0, 0, None)))(state.truths, state.tracks, PARAMS)
    np.testing.assert_allclose(info["gospa"], found.distance, rtol=1e-5)
    np.testing.assert_allclose(info["gospa_missed"], found.missed, rtol=1e-5)


def test_births_without_a_row_are_counted_step_by_step(choices):
    state, _, info, _ = choices
    np.testing.assert_array_equal(state.num_born, [4, 6, 8])
    # The first takes the third of three rows, then nothing is left.
    np.testing.assert_array_equal(info["dropped_truths"], [1, 2, 2])


def test_the_measure_is_the_one_asked_for(choices):
    _, record, _, measured = choices
    pairs = record.tracker.predicted.active[..., None] & record.detections.active[:, None]
    assert bool(pairs.any())
    np.testing.assert_allclose(record.tracker.distances[pairs], measured[pairs], rtol=1e-5)


@pytest.mark.usefixtures("quick_compilation")
@pytest.mark.parametrize(("threshold", "terminated"), [(1e9, False), (1.0, True)])
def test_a_metric_can_stop_an_episode(threshold, terminated):
    """Without tracks GOSPA is at its worst, 200 m per truth or so."""
    env, params = make(**SHAPES, stop_metric="gospa", stop_threshold=threshold)
    _, state = env.reset(jax.random.key(0), params)
    _, state, _, ended, truncated, _ = env.step(jax.random.key(1), state, jnp.array([2, 2]), params)
    assert bool(ended) is terminated
    assert not bool(truncated)
    assert int(state.time) == (0 if terminated else 1)


def test_a_metric_at_its_threshold_does_not_stop_an_episode(env):
    stopping = SearchTrack(env.static, stop_metric="covariance_norm_sum")
    nothing_tracked = SimpleNamespace(truths=None, tracks=Tracks.empty(1))
    for threshold, terminated in ((0.0, False), (-1e-6, True), (None, False)):
        params = PARAMS.replace(stop_threshold=threshold)
        assert bool(stopping.is_terminated(nothing_tracked, params)) is terminated


def test_nothing_random_serves_twice(env):
    noise = jax.jit(env.sample_noise)(jax.random.key(2))
    normal = np.concatenate([noise.truths.motion.ravel(), noise.sensor.detection.ravel()])
    uniform = [noise.truths.death, noise.truths.birth_count, noise.sensor.detected]
    uniform += [noise.sensor.clutter_count, noise.sensor.clutter]
    levels = np.concatenate([stats.norm.cdf(normal), *(np.ravel(draw) for draw in uniform)])
    assert np.diff(np.sort(levels)).min() > 1e-5


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"info_metrics": ("ospa",)}, "info_metrics = 'ospa': expected one of gospa, "),
        ({"stop_metric": "ospa", "stop_threshold": 1.0}, "stop_metric = 'ospa': expected one of gospa, "),
        ({"stop_metric": "gospa"}, "stop_threshold = None: expected a number for stop_metric = 'gospa'"),
        ({"stop_metric": "gospa", "stop_threshold": float("nan")}, "stop_threshold = nan: expected a number"),
        ({"stop_threshold": "much"}, "stop_threshold = 'much': expected a number"),
        ({"initial_truths": 2.5}, r"initial_truths = 2.5: expected an integer in \[0, 10\]"),
        ({"initial_truths": 11}, r"initial_truths = 11: expected an integer in \[0, 10\]"),
    ],
)
def test_metrics_that_do_not_exist_are_refused(fields, message):
    with pytest.raises(ValueError, match=message):
        make(**fields)


@pytest.mark.usefixtures("quick_compilation")
def test_every_name_of_a_metric_has_its_function(truths_at, tracks_at):
    assert set(METRICS) == set(metrics.METRICS)
    truths = truths_at([[1000, 0, 0], [3000, 0, 0], [5000, 0, 0]])
    tracks = tracks_at([[1010, 0, 0, 0, 0, 0], [9000, 0, 0, 0, 0, 0]], 4)
    found, parts = jax.jit(
        lambda: (
            {name: metric(truths, tracks, PARAMS) for name, metric in metrics.METRICS.items()},
            metrics.gospa(truths, tracks, PARAMS),
        )
    )()
    norm = float(np.linalg.norm(tracks.covariance[0]))
    expected = {
        "gospa": parts.distance,
        "gospa_localisation": parts.localisation,
        "gospa_missed": parts.missed,
        "gospa_false": parts.false,
        "completeness": 1 / 3,
        "uncertainty_per_truth": (norm + 2 * PARAMS.deletion_threshold) / 3,
        "covariance_norm_sum": 2 * norm,
        "covariance_norm_mean": norm,
    }
    assert len({round(float(value), 3) for value in expected.values()}) == len(expected)
    for name, value in expected.items():
        np.testing.assert_allclose(found[name], value, rtol=1e-5, err_msg=name)
