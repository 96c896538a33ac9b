"""Stone Soup inside Gymnasium: its checkers, its seeds, and whole episodes against ours."""

import dataclasses
from types import SimpleNamespace

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from jaxtrack import Params, StaticParams, Truths
from jaxtrack.params import REWARDS
from reference.gym_env import ENV_ID, StoneSoupEnv
from reference.parity import environment
from reference.parity.compare import TOLERANCE
from reference.parity.environment import (
    LIVELY,
    STATIC,
    EnvironmentTallies,
    Played,
    compare_environment,
    environment_rows,
    play_ours,
)

pytestmark = pytest.mark.usefixtures("quick_compilation")

STEPS = 110
SMALL = StaticParams(num_truths=3, max_tracks=6, map_size=12, num_looks=7)


@pytest.mark.parametrize("continuous", [False, True])
@pytest.mark.filterwarnings("ignore:.*A Box observation space (minimum|maximum) value is:UserWarning")
@pytest.mark.filterwarnings("ignore:.*we recommend using a symmetric and normalized space:UserWarning")
def test_gymnasiums_own_checker(continuous):
    static = StaticParams(**{**vars(SMALL), "continuous_actions": continuous})
    env = gymnasium.make(ENV_ID, static=static, params=Params(max_steps_in_episode=20))
    check_env(env.unwrapped)


def test_whole_episodes_equal_ours():
    """All rewards in turn, with births and deaths of truths and of tracks."""
    rows, divergences = environment_rows(range(len(REWARDS)), steps=STEPS)
    assert not divergences, str(divergences[0])
    assert all(row.passed for row in rows), rows
    assert rows[1].compared == len(REWARDS) * 4 * STEPS


def test_an_episode_of_the_papers_scenario_equals_ours():
    params, tallies = Params(initial_truths=STATIC.num_truths), EnvironmentTallies()
    divergence = compare_environment(STATIC, params, 1, STEPS, TOLERANCE, tallies)
    assert divergence is None, str(divergence)
    assert tallies.truths.compared == STEPS * STATIC.num_truths


def test_the_search_term_ends_with_the_same_track():
    """Three truths: while all have confirmed tracks searching costs nothing, here and there."""
    static = dataclasses.replace(STATIC, num_truths=3, reward="shortfall", search_until_complete=True)
    params, tallies = Params(time_step=0.02, deletion_threshold=20000.0), EnvironmentTallies()
    divergence = compare_environment(static, params, 2, STEPS, TOLERANCE, tallies)
    assert divergence is None, str(divergence)
    always = dataclasses.replace(static, search_until_complete=False, reward=REWARDS[0])
    until = dataclasses.replace(always, search_until_complete=True)
    kept, other = (play_ours(shape, params, 2, STEPS).rewards["shortfall"] for shape in (until, always))
    ended = np.flatnonzero(kept != other)
    assert 10 < len(ended) < STEPS - 10, "in part of the episode"


class Path(list):
    """States of one truth, by identity, as Stone Soup's."""

    __hash__ = object.__hash__


class Echo:
    """Stone Soup's environment if it gave what ours gave, but for what is off."""

    def __init__(self, played, off):
        self.played, self.off, self.scenario, self.k = played, off, SimpleNamespace(), -1

    def reset(self, options):
        pass

    def step(self, action):
        self.k += 1
        off, played = self.off, self.played
        state = played.truths.state[self.k, 1] + off.get("state", 0.0)
        paths = [] if "dead" in off else [Path([SimpleNamespace(state_vector=state[:, None])])]
        self.scenario.paths, self.scenario.row_of = paths, dict.fromkeys(paths, 1)
        seen = {name: values[self.k] + off.get(name, 0.0) for name, values in played.observations.items()}
        return seen, played.rewards["gospa"][self.k] + off.get("reward", 0.0)


@pytest.mark.parametrize(
    ("off", "named", "failed"),
    [
        ({}, None, []),
        ({"tracks": 1e-6}, "tracks[0, 0]", ["seen"]),
        ({"mask": 1}, "mask[0]", ["seen"]),
        ({"scan_map": -1e-6}, "scan_map[0, 0]", ["seen"]),
        ({"reward": 1e-6}, "reward[]", ["seen"]),
        ({"reward": np.nan}, "reward[]", ["seen"]),
        ({"dead": True}, "living truths", ["seen", "truths"]),
        ({"state": [1e-3, 0, 0, 0, 0, 0]}, None, ["truths"]),
        ({"state": [0, 0, 0, 1e-3, 0, 0]}, None, ["truths"]),
    ],
)
def test_every_difference_between_the_environments_is_found(off, named, failed, monkeypatch):
    """Two rows of truths of which the second lives, for two steps."""
    truths = Truths(state=np.full((2, 2, 6), 1000.0), alive=np.array([[False, True]] * 2))
    seen = {"tracks": np.zeros((2, 3, 7)), "mask": np.zeros((2, 3)), "scan_map": np.ones((2, 4, 4))}
    rewards = {name: np.array([0.5, 0.25]) if name == "gospa" else np.full(2, np.nan) for name in REWARDS}
    played = Played(None, truths, None, np.zeros((2, 2)), seen, rewards)
    monkeypatch.setattr(environment, "play_ours", lambda *_: played)
    monkeypatch.setattr(environment, "draws_of", lambda *_: None)
    monkeypatch.setattr(environment, "StoneSoupEnv", lambda *_, **__: Echo(played, off))
    tallies, static = EnvironmentTallies(), StaticParams(num_truths=2, reward="gospa")
    divergence = compare_environment(static, LIVELY, 0, 2, TOLERANCE, tallies)
    assert (divergence and (divergence.step, divergence.quantity)) == (named and (1, named))
    rows = {name: tally.row("ours", "theirs", "arrays") for name, tally in vars(tallies).items()}
    assert [name for name, row in rows.items() if not row.passed] == failed


def play(env, seed, steps=25):
    observation, _ = env.reset(seed=seed)
    env.action_space.seed(0)
    seen = [observation]
    for _ in range(steps):
        observation, reward, *_ = env.step(env.action_space.sample())
        seen.append({**observation, "reward": reward})
    return seen


def test_the_same_seed_gives_the_same_episode():
    params = LIVELY.replace(field_limit=0.15, initial_truths=2)
    first, again, other = (play(StoneSoupEnv(SMALL, params), seed) for seed in (5, 5, 6))
    for one, two in zip(first, again, strict=True):
        assert one.keys() == two.keys()
        for name in one:
            np.testing.assert_array_equal(one[name], two[name])
    assert any(np.any(one["tracks"] != two["tracks"]) for one, two in zip(first, other, strict=True))
    assert first[-1]["mask"].any()


def test_an_episode_is_truncated_at_its_end_and_never_terminated():
    env = StoneSoupEnv(SMALL, Params(max_steps_in_episode=3))
    env.reset(seed=0)
    ends = [env.step(np.array([3, 3]))[2:4] for _ in range(3)]
    assert ends == [(False, False), (False, False), (False, True)]


def test_looks_are_those_of_the_paper():
    env = StoneSoupEnv()
    np.testing.assert_allclose(env.look_angles(np.array([0, 18])), [-np.pi / 3, np.pi / 3])
    np.testing.assert_allclose(env.look_angles(np.array([9, 10])), [0.0, np.pi / 27])


@pytest.mark.parametrize("continuous", [False, True])
def test_looks_beyond_the_field_are_at_its_edge(continuous):
    env = StoneSoupEnv(StaticParams(continuous_actions=continuous))
    np.testing.assert_allclose(env.look_angles(np.array([-7, 99])), [-np.pi / 3, np.pi / 3])


def test_wrong_numbers_are_refused():
    with pytest.raises(ValueError, match="range_sigma = -1"):
        StoneSoupEnv(SMALL, Params(range_sigma=-1.0))
