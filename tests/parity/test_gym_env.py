"""Stone Soup inside Gymnasium: its checkers, its seeds, and whole episodes against ours."""

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from jaxtrack import Params, StaticParams
from reference.gym_env import ENV_ID, StoneSoupEnv
from reference.parity.compare import TOLERANCE
from reference.parity.environment import STATIC, compare_environment
from reference.parity.rows import Tally

SMALL = StaticParams(num_truths=3, max_tracks=6, map_size=12, num_looks=7)
# Long steps, so that tracks die within the episode; births and deaths of truths.
LIVELY = Params(
    time_step=0.02, deletion_threshold=3500.0, initial_truths=6, birth_rate=0.03, death_probability=0.004
)


@pytest.mark.parametrize("continuous", [False, True])
@pytest.mark.filterwarnings("ignore:.*A Box observation space (minimum|maximum) value is:UserWarning")
@pytest.mark.filterwarnings("ignore:.*we recommend using a symmetric and normalized space:UserWarning")
def test_gymnasiums_own_checker(continuous):
    static = StaticParams(**{**vars(SMALL), "continuous_actions": continuous})
    env = gymnasium.make(ENV_ID, static=static, params=Params(max_steps_in_episode=20))
    check_env(env.unwrapped)


@pytest.mark.parametrize(
    ("reward", "params"),
    [("paper", Params()), ("information", LIVELY), ("as_printed", LIVELY.replace(truth_process_noise=0.0))],
)
def test_whole_episodes_equal_ours(reward, params):
    tally = Tally()
    static = StaticParams(**{**vars(STATIC), "reward": reward})
    divergence = compare_environment(static, params, seed=1, steps=150, tolerance=TOLERANCE, tally=tally)
    assert divergence is None, str(divergence)
    assert tally.compared == 4 * 150


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
