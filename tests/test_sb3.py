"""Both environments in Stable-Baselines3: its own checker and vector environment; `make sb3` installs it."""

import re

import numpy as np
import pytest

from jaxtrack import Params, StaticParams
from jaxtrack.gymnasium_env import SearchTrackEnv
from reference.gym_env import StoneSoupEnv

pytestmark = [pytest.mark.sb3, pytest.mark.usefixtures("quick_compilation")]

SHAPES = {"num_truths": 3, "max_tracks": 4, "map_size": 36, "num_looks": 5}
# A wide beam and few large steps: tracks live, grow uncertain and end, all in a few looks.
FIELDS = SHAPES | {"max_steps_in_episode": 6, "beam_azimuth": 2.5, "beam_elevation": 2.5, "time_step": 0.2}
# Episodes also end before their time: as soon as tracks are uncertain.
STOP = FIELDS | {"stop_metric": "covariance_norm_sum", "stop_threshold": 4000.0}

# The paper's observation is a list and a map, for which it has its own feature extractor.
ADVICE = "ignore:.*has an unconventional shape:UserWarning"


@pytest.fixture(scope="module")
def sb3():
    """The module with our environment, which needs the extra."""
    import jaxtrack.sb3

    return jaxtrack.sb3


@pytest.mark.filterwarnings(ADVICE)
def test_the_checker_on_the_environment_of_stone_soup():
    from stable_baselines3.common.env_checker import check_env

    shapes = StaticParams(num_truths=3, max_tracks=6, map_size=12, num_looks=7)
    check_env(StoneSoupEnv(shapes, Params(max_steps_in_episode=20)))


@pytest.mark.filterwarnings(ADVICE)
@pytest.mark.parametrize("choice", [{}, {"image": True}, {"image": True, "observe_variances": True}])
def test_the_checker_on_ours(choice):
    from stable_baselines3.common.env_checker import check_env

    check_env(SearchTrackEnv(**FIELDS, **choice))


@pytest.mark.parametrize("fields", [STOP, FIELDS], ids=["ends at different times", "ends together"])
def test_many_are_what_stable_baselines3_makes_of_as_many_single_ones(sb3, fields):
    from stable_baselines3.common.vec_env import DummyVecEnv

    theirs = DummyVecEnv([lambda: SearchTrackEnv(image=True, **fields)] * 3)
    ours = sb3.SearchTrackVecEnv(3, **fields)
    assert ours.observation_space == theirs.observation_space
    assert ours.action_space == theirs.action_space
    assert ours.seed(7) == theirs.seed(7)
    assert_same(ours.reset(), theirs.reset())
    rng = np.random.default_rng(0)
    ends = truncated = 0
    for _ in range(14):
        actions = rng.integers(5, size=(3, 2))
        observation, rewards, dones, infos = ours.step(actions)
        expected, expected_rewards, expected_dones, expected_infos = theirs.step(actions)
        assert_same(observation, expected)
        np.testing.assert_allclose(rewards, expected_rewards, rtol=1e-3, atol=1e-5)
        assert (rewards.dtype, dones.dtype) == (expected_rewards.dtype, expected_dones.dtype)
        assert dones.tolist() == expected_dones.tolist()
        for info, expected_info in zip(infos, expected_infos, strict=True):
            last, expected_last = (one.pop("terminal_observation", {}) for one in (info, expected_info))
            assert_same(last, expected_last)
            assert_same(info, expected_info)
            truncated += info["TimeLimit.truncated"]
        ends += dones.sum()
    assert ends > 3
    assert truncated < ends if fields is STOP else truncated == ends
    assert_same(ours.reset(), theirs.reset())  # without a seed the numbers go on


def assert_same(ours, theirs):
    assert ours.keys() == theirs.keys()
    for name, values in theirs.items():
        # One in 255 where a pixel lies half between two shades.
        tolerance = 1 if name == "scan_map" else 1e-5
        np.testing.assert_allclose(ours[name], values, rtol=1e-3, atol=tolerance, err_msg=name)
        assert np.asarray(ours[name]).dtype.kind == np.asarray(values).dtype.kind


def test_ppo_trains_with_convolutions_over_the_scan_map(sb3):
    from stable_baselines3 import PPO
    from stable_baselines3.common.torch_layers import NatureCNN
    from stable_baselines3.common.vec_env import VecMonitor

    env = VecMonitor(sb3.SearchTrackVecEnv(4, **FIELDS), info_keywords=("completeness",))
    model = PPO("MultiInputPolicy", env, n_steps=8, batch_size=16, n_epochs=1, seed=0, device="cpu")
    assert model.get_env() is env  # no wrapper turns the image around
    assert isinstance(model.policy.features_extractor.extractors["scan_map"], NatureCNN)
    model.learn(32)
    episodes = list(model.ep_info_buffer)
    assert [episode["l"] for episode in episodes] == [6] * 4
    assert all(0 < episode["completeness"] <= 1 for episode in episodes)


def test_what_rows_of_arrays_do_not_have_is_refused(sb3):
    env = sb3.SearchTrackVecEnv(2, **FIELDS)
    assert [params.time_step for params in env.get_attr("params")] == [0.2, 0.2]
    assert env.get_attr("num_envs", indices=1) == [2]
    assert env.env_is_wrapped(object) == [False, False]
    assert not env.has_attr("nonsense")
    with pytest.raises(AttributeError, match="time_step"):
        env.set_attr("time_step", 1.0)
    with pytest.raises(AttributeError, match="render"):
        env.env_method("render")


def test_without_a_seed_every_run_is_another(sb3):
    one, other = (sb3.SearchTrackVecEnv(2, **FIELDS) for _ in range(2))
    one.reset()
    other.reset()
    looks = np.full((2, 2), 2)
    assert not np.array_equal(one.step(looks)[0]["tracks"], other.step(looks)[0]["tracks"])


def test_the_example_trains_on_both_and_prints_a_table(capsys):
    from examples.sb3_ppo import main

    small = ["--steps", "32", "--num-envs", "4", "--rollout", "32", "--stone-soup-steps", "8"]
    assert main([*small, "--max-steps-in-episode", "4"]) == 0
    printed = capsys.readouterr().out
    assert re.search(r"jaxtrack +│ 4 +│ 32 ", printed)
    assert re.search(r"Stone Soup +│ 1 +│ 8 .*last 2 episodes", printed)
    with pytest.raises(ValueError, match="rollout = 4: expected an integer >= 8"):
        main(["--num-envs", "4", "--rollout", "4"])
