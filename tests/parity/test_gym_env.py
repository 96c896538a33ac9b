"""Stone Soup inside Gymnasium: its checkers, its seeds, and whole episodes against ours."""

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from jaxtrack import Params, StaticParams
from reference.gym_env import ENV_ID, StoneSoupEnv
from reference.parity.compare import TOLERANCE
from reference.parity.environment import (
    LIVELY,
    STATIC,
    EnvironmentTallies,
    compare_environment,
    environment_rows,
)

SMALL = StaticParams(num_truths=3, max_tracks=6, map_size=12, num_looks=7)


@pytest.mark.parametrize("continuous", [False, True])
@pytest.mark.filterwarnings("ignore:.*A Box observation space (minimum|maximum) value is:UserWarning")
@pytest.mark.filterwarnings("ignore:.*we recommend using a symmetric and normalized space:UserWarning")
def test_gymnasiums_own_checker(continuous):
    static = StaticParams(**{**vars(SMALL), "continuous_actions": continuous})
    env = gymnasium.make(ENV_ID, static=static, params=Params(max_steps_in_episode=20))
    check_env(env.unwrapped)


def test_whole_episodes_equal_ours():
    """Three rewards in turn, with births and deaths of truths and of tracks."""
    rows, divergences = environment_rows(range(3), steps=150)
    assert not divergences, str(divergences[0])
    assert all(row.passed for row in rows), rows
    assert rows[1].compared == 3 * 4 * 150


def test_an_episode_of_the_papers_scenario_equals_ours():
    params, tallies = Params(initial_truths=STATIC.num_truths), EnvironmentTallies()
    divergence = compare_environment(STATIC, params, 1, 150, TOLERANCE, tallies)
    assert divergence is None, str(divergence)
    assert tallies.truths.compared == 150 * STATIC.num_truths


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


def test_wrong_numbers_are_refused():
    with pytest.raises(ValueError, match="range_sigma = -1"):
        StoneSoupEnv(SMALL, Params(range_sigma=-1.0))
