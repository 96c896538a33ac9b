"""Scenarios that change during a training: what is drawn when, what it does, and that nothing else moves."""

import dataclasses
import os
import signal

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxtrack import Params, StaticParams
from jaxtrack.env import SearchTrack
from tests.train.probes import Linear, Probe
from tests.train.small_run import OPTIONS, assert_same, assert_same_result
from train import learner, ppo
from train.agents import Agent
from train.config import TrainConfig
from train.distributions import JOINT
from train.metrics_file import MetricsFile
from train.saved_run import load_run
from train.varied import randomised, scenario_at

pytestmark = pytest.mark.usefixtures("quick_compilation")

CONFIG = TrainConfig(num_envs=4, rollout_steps=5, num_minibatches=1, microbatch=5, total_steps=200)
"""Ten updates."""
STATIC = StaticParams(num_truths=5, max_tracks=6, max_detections=4, max_clutter=3, map_size=6, num_looks=3)
PARAMS = Params(max_steps_in_episode=4, beam_azimuth=0.9, beam_elevation=0.9)
RANGES = {"clutter_rate": (0.5, 2.5), "initial_truths": (1, 5), "deletion_threshold": (4000.0, 3000.0)}
EPISODES = 64


def at(update, **fields):
    """The scenario of a training after so many updates."""
    return scenario_at(jnp.asarray(update), PARAMS, dataclasses.replace(CONFIG, **fields))


def test_a_curriculum_goes_from_one_end_to_the_other_and_stays():
    curriculum = {"detection_probability": (1.0, 0.8), "initial_truths": (1, 4)}
    updates = [0, 1, 2, 4, 5, 9]
    scenarios = [at(update, curriculum=curriculum, curriculum_share=0.4) for update in updates]
    probabilities = [float(each.detection_probability) for each in scenarios]
    np.testing.assert_allclose(probabilities, [1.0, 0.95, 0.9, 0.8, 0.8, 0.8], rtol=1e-6)
    # Exactly: a rounded 1 may be no probability any more.
    assert scenarios[0].detection_probability == jnp.float32(1.0)
    assert scenarios[-1].detection_probability == jnp.float32(0.8)
    assert [int(each.initial_truths) for each in scenarios] == [1, 2, 2, 4, 4, 4]
    assert jnp.issubdtype(scenarios[1].initial_truths.dtype, jnp.integer)
    # All other numbers are as they were.
    same = {name: getattr(PARAMS, name) for name in curriculum}
    assert dataclasses.replace(scenarios[2], **same) == PARAMS


def test_without_the_options_nothing_is_another():
    env = SearchTrack(STATIC)
    assert randomised(env, CONFIG) is env
    assert at(3) == PARAMS


@pytest.fixture(scope="module")
def env():
    """An environment whose numbers are drawn."""
    return randomised(SearchTrack(STATIC), dataclasses.replace(CONFIG, randomise=RANGES))


@pytest.fixture(scope="module")
def played(env):
    """Many environments over three episodes: states `[step, episode]`, and what the steps gave."""
    keys = jax.random.split(jax.random.key(0), EPISODES)
    reset = jax.vmap(env.reset_env, in_axes=(0, None))
    step = jax.vmap(env.step, in_axes=(0, 0, None, None))

    def one(states, key):
        _, after, *given = step(jax.random.split(key, EPISODES), states, jnp.array([1, 1]), PARAMS)
        return after, (after, given)

    @jax.jit
    def play(keys):
        _, first = reset(keys, PARAMS)
        _, (after, given) = jax.lax.scan(one, first, jax.random.split(jax.random.key(1), 12))
        return jax.tree.map(lambda one, rest: jnp.concatenate([one[None], rest]), first, after), given

    return play(keys)


def test_every_episode_draws_within_the_ranges_and_keeps_what_it_drew(played):
    states, (_, _, truncated, _) = played
    np.testing.assert_array_equal(np.flatnonzero(truncated[:, 0]), [3, 7, 11])
    for name, ends in RANGES.items():
        drawn = np.asarray(states.drawn[name])
        episodes = [drawn[begin : begin + 4] for begin in (0, 4, 8)]
        for episode in episodes:
            np.testing.assert_array_equal(episode, np.broadcast_to(episode[0], episode.shape))
        first = np.concatenate([episode[0] for episode in episodes])
        assert min(ends) <= first.min() <= min(ends) + 0.1 * abs(ends[1] - ends[0])
        assert max(ends) >= first.max() >= max(ends) - 0.1 * abs(ends[1] - ends[0])
        # The same number twice by chance is for whole ones alone.
        distinct = len(np.unique(first))
        assert distinct == (5 if name == "initial_truths" else 3 * EPISODES)


def test_numbers_are_drawn_independently_of_each_other_and_of_the_truths(played):
    states, _ = played
    place = np.asarray(states.truths.state[0, :, 0, 0])
    columns = [*(np.asarray(states.drawn[name][0], float) for name in RANGES), place]
    correlation = np.corrcoef(columns) - np.eye(len(columns))
    assert np.abs(correlation).max() < 0.4


def test_an_episode_begins_with_as_many_truths_as_were_drawn(played):
    states, _ = played
    begins = states.time == 0
    np.testing.assert_array_equal(
        states.truths.alive.sum(axis=-1)[begins], states.drawn["initial_truths"][begins]
    )


def test_a_step_is_that_of_a_scenario_with_the_drawn_numbers_but_for_the_scales(env, played):
    states, _ = played
    plain = SearchTrack(STATIC)

    @jax.jit
    def both(key, state):
        own = dataclasses.replace(PARAMS, **state.drawn)
        expected = plain.step_env(key, state, jnp.array([1, 1]), own)
        return env.step_env(key, state, jnp.array([1, 1]), PARAMS), expected

    state = jax.tree.map(lambda leaf: leaf[2, 0], states)
    (observation, moved, *rest), (_, expected, *rest_expected) = both(jax.random.key(3), state)
    assert_same(
        (vars(moved)["tracks"], moved.truths, rest), (expected.tracks, expected.truths, rest_expected)
    )
    assert_same(moved.drawn, state.drawn)
    assert bool(moved.tracks.active.any())
    assert_same(observation, jax.jit(plain.observe)(None, expected, None, PARAMS))
    # A deletion threshold of another scenario would scale the norms in the observation.
    other = plain.observe(None, expected, None, dataclasses.replace(PARAMS, **state.drawn))
    assert not np.array_equal(observation["tracks"], other["tracks"])


def test_drawn_clutter_is_what_the_radar_sees(played):
    states, (_, _, _, info) = played
    # One look is in nobody's beam but that of clutter most times; more clutter, more detections.
    rate = np.asarray(states.drawn["clutter_rate"][:-1])
    detections = np.asarray(info["num_detections"], float)
    assert np.corrcoef(rate.ravel(), detections.ravel())[0, 1] > 0.2


def test_the_learner_moves_a_curriculum_and_logs_it(monkeypatch):
    class Weighted(Probe):
        def step(self, key, state, action, params):
            observation, state, _, *rest = super().step(key, state, action, params)
            return observation, state, jnp.asarray(params.track_weight, float), *rest

    monkeypatch.setattr(learner, "build_agent", lambda *_: Agent(lambda seen: seen, Linear(), JOINT))
    probe = Weighted(lambda *_: jnp.zeros(()), 4)
    config = dataclasses.replace(
        CONFIG,
        params=Params(max_steps_in_episode=4),
        curriculum={"track_weight": (0.0, 5.0)},
        warm_start="none",
    )
    state = jax.jit(lambda key, params: learner.init_learner(key, params, probe, config))(
        jax.random.key(0), config.params
    )
    assert float(state.scenario.track_weight) == 0.0
    step = jax.jit(lambda state: learner.train_step(state, probe, config))
    rows = []
    for _ in range(7):
        state, metrics = step(state)
        rows.append((float(metrics["track_weight"]), float(metrics["reward"])))
    np.testing.assert_allclose(rows, [[w, w] for w in (0, 1, 2, 3, 4, 5, 5)], rtol=1e-5)
    assert step._cache_size() == 1


VARIED = [
    *(f"--{name}={value}" for name, value in OPTIONS.items()),
    *["--total-steps=128", "--evaluation-episodes=0", "--checkpoint-every=2", "--warm-start-steps=32"],
    *["--curriculum", "truth_velocity_sigma=0:300", "detection_probability=1:0.5"],
    *["--randomise", "initial_truths=0:2", "range_sigma=5:50"],
]


@pytest.fixture
def compiled_once(monkeypatch):
    """Lets several trainings of the same configuration share one program."""
    kept = []
    compile_training = ppo.compile_training

    def compile_or_take(run, env, console):
        if not kept:
            kept.append(compile_training(run, env, console))
        return kept[0]

    monkeypatch.setattr(ppo, "compile_training", compile_or_take)


@pytest.mark.medium
@pytest.mark.usefixtures("compiled_once")
def test_a_varied_training_resumes_bit_for_bit(tmp_path, monkeypatch):
    whole, parts = tmp_path / "whole", tmp_path / "parts"
    assert ppo.main([*VARIED, "--out", str(whole)]) == 0
    write = MetricsFile.write

    def write_and_stop(self, row):
        write(self, row)
        if row["update"] == 1:
            os.kill(os.getpid(), signal.SIGINT)

    with monkeypatch.context() as patch:
        patch.setattr(MetricsFile, "write", write_and_stop)
        assert ppo.main([*VARIED, "--out", str(parts)]) == 130
    assert ppo.main(["--resume", str(parts)]) == 0
    assert_same_result(parts, whole)
    config, env, _ = load_run(parts)
    assert config.randomise == {"initial_truths": (0, 2), "range_sigma": (5, 50)}
    # What is evaluated is the scenario as it stands in the configuration.
    assert type(env) is SearchTrack
