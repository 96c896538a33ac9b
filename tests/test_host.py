"""The environment for programs outside JAX: the numbers of `env.step`, in NumPy."""

import jax
import numpy as np
import pytest

from jaxtrack import make
from jaxtrack.host import Scenarios, image_of

pytestmark = pytest.mark.usefixtures("quick_compilation")

LENGTH = 4
FIELDS = {
    "num_truths": 3,
    "max_tracks": 4,
    "map_size": 10,
    "num_looks": 5,
    "max_steps_in_episode": LENGTH,
    "beam_azimuth": 2.5,
    "beam_elevation": 2.5,
    "time_step": 0.2,
}
ACTIONS = np.random.default_rng(0).integers(5, size=(2 * LENGTH, 2, 2))


def assert_same(ours, theirs):
    for name, values in ours.items():
        np.testing.assert_allclose(values, theirs[name], rtol=1e-4, atol=1e-6, err_msg=name)


def test_the_very_numbers_of_the_environment_over_the_end_of_an_episode():
    env, params = make(**FIELDS)
    scenarios = Scenarios(2, **FIELDS)
    seeds = np.array([5, 2**32 - 1], dtype=np.uint32)
    keys, reset_keys = jax.vmap(jax.random.split, out_axes=1)(jax.vmap(jax.random.key)(seeds))
    observation, state = jax.vmap(env.reset, in_axes=(0, None))(reset_keys, params)
    assert_same(scenarios.reset(seeds.tolist()), observation)
    step = jax.jit(jax.vmap(env.step, in_axes=(0, 0, 0, None)))
    detections = 0
    for number, actions in enumerate(ACTIONS, start=1):
        keys, step_keys = jax.vmap(jax.random.split, out_axes=1)(keys)
        observation, state, reward, terminated, truncated, info = step(step_keys, state, actions, params)
        ours = scenarios.step(actions)
        assert_same(ours.observation, observation)
        np.testing.assert_allclose(ours.reward, reward, rtol=1e-4, atol=1e-6)
        assert ours.terminated.tolist() == terminated.tolist() == [False, False]
        assert ours.truncated.tolist() == truncated.tolist() == [number % LENGTH == 0] * 2
        assert set(info) - set(ours.info) == {"final_observation", "terminated", "truncated"}
        assert_same(ours.info, info)
        assert (ours.last is None) == (number % LENGTH != 0)
        if ours.last is not None:
            assert_same(ours.last, info["final_observation"])
            assert ours.last["mask"].any()
        detections += ours.info["num_detections"].sum()
    assert detections > 3


def test_the_chosen_begin_anew_and_the_others_go_on():
    together, alone = Scenarios(2, **FIELDS), Scenarios(2, **FIELDS)
    together.reset([1, 2])
    alone.reset([1, 2])
    before = together.step(ACTIONS[0]).observation
    alone.step(ACTIONS[0])
    after = together.reset([None, 7], chosen=np.array([False, True]))
    np.testing.assert_array_equal(after["scan_map"][0], before["scan_map"][0])
    assert before["scan_map"][1].min() == 0
    assert after["scan_map"][1].min() == 1
    one, other = together.step(ACTIONS[1]), alone.step(ACTIONS[1])
    np.testing.assert_array_equal(one.observation["tracks"][0], other.observation["tracks"][0])
    assert one.reward[0] == other.reward[0]
    # The second is what it would be had it begun with this seed at once.
    alone.reset([1, 7])
    again = alone.step(ACTIONS[1])
    np.testing.assert_array_equal(one.observation["scan_map"][1], again.observation["scan_map"][1])
    np.testing.assert_array_equal(one.observation["tracks"][1], again.observation["tracks"][1])


def test_without_a_seed_the_scenarios_differ_and_repeat_with_the_first_one():
    def shown(scenarios):  # truths are hidden: what the first look finds tells them apart
        scenarios.reset([None, None])
        return scenarios.step(np.full((2, 2), 2)).observation["tracks"]

    one, other = Scenarios(2, **FIELDS), Scenarios(2, **FIELDS)
    one.reset([3, 4])
    other.reset([3, 4])
    first = shown(one)
    np.testing.assert_array_equal(first, shown(other))
    assert not np.array_equal(first, shown(one))


def test_arrays_belong_to_the_caller():
    scenarios = Scenarios(2, **FIELDS)
    scenarios.reset([1, 2])["scan_map"][:] = 0.5
    assert scenarios.observation()["scan_map"].min() == 1


def test_types_and_the_map_as_an_image():
    scenarios = Scenarios(2, image=True, **FIELDS)
    plain = Scenarios(2, **FIELDS)
    scenarios.reset([1, 2])
    plain.reset([1, 2])
    image = scenarios.step(ACTIONS[0]).observation
    floats = plain.step(ACTIONS[0]).observation
    assert {name: part.dtype for name, part in floats.items()} == {
        "mask": np.int8,
        "scan_map": np.float32,
        "tracks": np.float32,
    }
    assert image["scan_map"].dtype == np.uint8
    assert image["scan_map"].shape == (2, 1, 10, 10)
    np.testing.assert_array_equal(image["scan_map"][:, 0], np.round(255 * floats["scan_map"]))
    assert np.asarray(image_of(jax.numpy.array([[0.0, 0.5 / 255 + 1e-4, 1.0]]))).tolist() == [[[0, 1, 255]]]


def test_equal_shapes_are_compiled_once():
    one, other = Scenarios(1, **FIELDS), Scenarios(2, **FIELDS | {"clutter_rate": 0.5})
    assert one._advance is other._advance


@pytest.mark.parametrize(
    ("actions", "message"),
    [
        (np.zeros((3, 2), int), r"shape \(3, 2\).*expected integers of shape \(2, 2\)"),
        (np.zeros((2, 2)), "type float64: expected integers"),
        ([[1, 2], [3, None]], "type object: expected integers"),
    ],
)
def test_what_is_no_action_is_refused(actions, message):
    scenarios = Scenarios(2, **FIELDS)
    scenarios.reset([1, 2])
    with pytest.raises(ValueError, match=message):
        scenarios.step(actions)


def test_wrong_use_is_named():
    with pytest.raises(ValueError, match="num_envs = 0: expected an integer >= 1"):
        Scenarios(0)
    with pytest.raises(ValueError, match="nonsense: no such field"):
        Scenarios(1, nonsense=1)
    with pytest.raises(RuntimeError, match="expected a reset"):
        Scenarios(2, **FIELDS).step(np.zeros((2, 2), int))
