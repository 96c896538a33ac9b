"""The environment in Gymnasium: its own checker, and its own vector environment as the measure of ours."""

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode

from jaxtrack.gymnasium_env import GYMNASIUM_ID, SearchTrackEnv, SearchTrackVectorEnv

pytestmark = pytest.mark.usefixtures("quick_compilation")

SHAPES = {"num_truths": 3, "max_tracks": 4, "map_size": 10, "num_looks": 5}
# A wide beam and few large steps: tracks live, grow uncertain and end, all in a few looks.
FIELDS = SHAPES | {"max_steps_in_episode": 6, "beam_azimuth": 2.5, "beam_elevation": 2.5, "time_step": 0.2}
# Episodes also end one by one: as soon as tracks are uncertain.
STOP = FIELDS | {"stop_metric": "covariance_norm_sum", "stop_threshold": 4000.0}

# Track features have no bounds, and looks are in radians: both warnings are advice.
UNBOUNDED = "ignore:.*A Box observation space (minimum|maximum) value is -?infinity"
IN_RADIANS = "ignore:.*we recommend using a symmetric and normalized space"


@pytest.mark.filterwarnings(UNBOUNDED)
@pytest.mark.filterwarnings(IN_RADIANS)
@pytest.mark.parametrize(
    "choice", [{}, {"image": True, "continuous_actions": True, "observe_variances": True}]
)
def test_the_checker_of_gymnasium(choice):
    env = gymnasium.make(GYMNASIUM_ID, **FIELDS, **choice)
    check_env(env.unwrapped)


def test_observations_lie_in_the_space_of_the_datasheet():
    env = SearchTrackEnv(**FIELDS, observe_variances=True)
    spaces = env.observation_space
    assert spaces["mask"] == gymnasium.spaces.MultiBinary(4)
    assert spaces["scan_map"] == gymnasium.spaces.Box(0, 1, (10, 10), np.float32)
    assert spaces["tracks"].shape == (4, 7)
    assert spaces["variances"].shape == (4, 2)
    assert env.action_space == gymnasium.spaces.MultiDiscrete([5, 5])
    seen = 0
    observation, _ = env.reset(seed=1)
    assert observation in spaces
    for _ in range(6):
        observation, reward, terminated, truncated, info = env.step(np.array([2, 2]))
        assert observation in spaces
        assert type(reward) is float
        assert info["live_tracks"] == observation["mask"].sum()
        seen += info["live_tracks"]
    assert (terminated, truncated) == (False, True)
    assert seen > 0


def test_angles_are_in_radians():
    space = SearchTrackEnv(**FIELDS, continuous_actions=True).action_space
    assert space == gymnasium.spaces.Box(-np.float32(np.pi / 3), np.float32(np.pi / 3), (2,), np.float32)


def assert_same(ours, theirs, place=""):
    """Equal in structure and types, and in numbers but for rounding."""
    assert type(ours) is type(theirs), place
    if isinstance(theirs, dict):
        assert ours.keys() == theirs.keys(), place
        for name in theirs:
            assert_same(ours[name], theirs[name], f"{place}/{name}")
    elif isinstance(theirs, tuple) or (isinstance(theirs, np.ndarray) and theirs.dtype.kind == "O"):
        for row, (one, other) in enumerate(zip(ours, theirs, strict=True)):
            assert_same(one, other, f"{place}[{row}]")
    elif theirs is not None:
        assert ours.dtype == theirs.dtype, place
        np.testing.assert_allclose(ours, theirs, rtol=1e-3, atol=1e-5, err_msg=place)


@pytest.mark.parametrize(
    "fields",
    [pytest.param(STOP, marks=pytest.mark.medium), FIELDS],
    ids=["ends at different times", "ends together"],
)
def test_many_are_what_gymnasium_makes_of_as_many_single_ones(fields):
    same_step = {"autoreset_mode": AutoresetMode.SAME_STEP}
    sync = gymnasium.make_vec(
        GYMNASIUM_ID, num_envs=3, vectorization_mode="sync", vector_kwargs=same_step, **fields
    )
    ours = gymnasium.make_vec(GYMNASIUM_ID, num_envs=3, vectorization_mode="vector_entry_point", **fields)
    assert isinstance(ours, SearchTrackVectorEnv)
    assert ours.metadata["autoreset_mode"] == AutoresetMode.SAME_STEP
    for name in ("observation_space", "action_space", "single_observation_space", "single_action_space"):
        assert getattr(ours, name) == getattr(sync, name)
    assert_same(ours.reset(seed=11), sync.reset(seed=11))
    rng = np.random.default_rng(0)
    ends = []
    for number in range(14):
        if (
            number == 4 and fields is STOP
        ):  # some begin anew: with a seed, and with the number that comes next
            mask = np.array([True, True, False])
            again = [{"seed": [3, None, None], "options": {"reset_mask": mask}} for _ in range(2)]
            assert_same(ours.reset(**again[0]), sync.reset(**again[1]))
        actions = rng.integers(5, size=(3, 2))
        mine, theirs = ours.step(actions), sync.step(actions)
        assert mine[0] in ours.observation_space
        assert_same(mine, theirs, f"step {number}")
        ends.append(int((mine[2] | mine[3]).sum()))
    assert {0, 1} <= set(ends) if fields is STOP else set(ends) == {0, 3}
    assert_same(ours.reset(seed=[4, 5, 6]), sync.reset(seed=[4, 5, 6]))
    assert_same(ours.reset(), sync.reset())


def test_an_episode_must_be_begun():
    env, many = SearchTrackEnv(**FIELDS), SearchTrackVectorEnv(2, **FIELDS)
    with pytest.raises(gymnasium.error.ResetNeeded):
        env.step(np.array([2, 2]))
    with pytest.raises(gymnasium.error.ResetNeeded):
        many.step(np.full((2, 2), 2))
    env.reset(seed=0)
    for _ in range(6):
        env.step(np.array([2, 2]))
    with pytest.raises(gymnasium.error.ResetNeeded):
        env.step(np.array([2, 2]))


def test_without_a_seed_every_run_is_another_but_can_be_repeated():
    def found(env, seed=None):
        env.reset(seed=seed)
        return env.step(np.array([2, 2]))[0]["tracks"]

    one, other = SearchTrackEnv(**FIELDS), SearchTrackEnv(**FIELDS)
    first, second = found(one), found(other)
    assert not np.array_equal(first, second)
    np.testing.assert_array_equal(found(other, seed=one.np_random_seed), first)


def test_wrong_seeds_and_masks_are_named():
    many = SearchTrackVectorEnv(2, **FIELDS)
    with pytest.raises(ValueError, match="seed has 3 entries: expected num_envs = 2"):
        many.reset(seed=[1, 2, 3])
    with pytest.raises(ValueError, match="reset_mask"):
        many.reset(seed=0, options={"reset_mask": np.array([False, False])})
    with pytest.raises(ValueError, match=r"^time_step = -1"):
        gymnasium.make(GYMNASIUM_ID, time_step=-1.0)
