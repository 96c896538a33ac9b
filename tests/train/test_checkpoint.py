"""Checkpoints: what is saved comes back, and a folder that is no run is refused in one line."""

import dataclasses
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxtrack import Params, StaticParams
from jaxtrack.env import SearchTrack
from train.checkpoint import KEPT, load_run, open_manager, save, write_config
from train.config import TrainConfig
from train.learner import init_learner

STATIC = StaticParams(num_truths=2, max_tracks=3, max_detections=2, max_clutter=0, map_size=6, num_looks=3)
CONFIG = TrainConfig(
    num_envs=2, rollout_steps=2, num_minibatches=1, microbatch=4, total_steps=8, seed=5, static=STATIC
)


@pytest.fixture(scope="module")
def state():
    """A learner whose arrays all hold different random numbers, without compiling its start."""
    env = SearchTrack(STATIC)
    shapes = jax.eval_shape(lambda: init_learner(jax.random.key(0), Params(), env, CONFIG))
    rng = np.random.default_rng(0)
    return jax.tree.map(lambda leaf: jnp.asarray(rng.normal(size=leaf.shape) * 9).astype(leaf.dtype), shapes)


def write_run(folder, state, updates=(1,)):
    """A run's folder with checkpoints of these updates; each holds other weights."""
    write_config(folder, CONFIG)
    with open_manager(folder) as manager:
        for update in updates:
            weights = jax.tree.map(lambda leaf, add=update: leaf + add, state.weights)
            save(manager, state.replace(update=jnp.asarray(update), weights=weights))
        return list(manager.all_steps())


def test_a_run_comes_back(tmp_path, state):
    write_run(tmp_path, state)
    config, env, weights = load_run(tmp_path)
    assert config == CONFIG
    assert env.static == STATIC
    expected = jax.tree.map(lambda leaf: leaf + 1, state.weights)
    assert jax.tree.structure(weights) == jax.tree.structure(expected)
    jax.tree.map(np.testing.assert_array_equal, weights, expected)


def test_the_latest_of_the_kept_checkpoints_is_loaded(tmp_path, state):
    assert write_run(tmp_path, state, updates=(1, 3, 20)) == [3, 20]
    assert KEPT == 2
    _, _, weights = load_run(tmp_path)
    jax.tree.map(lambda x, y: np.testing.assert_array_equal(x, y + 20), weights, state.weights)


def test_saving_an_update_twice_writes_it_once(tmp_path, state):
    assert write_run(tmp_path, state, updates=(4, 4)) == [4]


def test_the_whole_learner_is_saved(tmp_path, state):
    import orbax.checkpoint as ocp

    with open_manager(tmp_path) as manager:
        save(manager, state)
        restored = manager.restore(int(state.update), args=ocp.args.StandardRestore(state))
    jax.tree.map(np.testing.assert_array_equal, restored, state)


def refusal(folder):
    """The message with which a folder is refused, without its beginning."""
    with pytest.raises(ValueError) as caught:  # noqa: PT011  # callers compare the message
        load_run(folder)
    message = str(caught.value)
    assert "\n" not in message
    assert str(folder) in message
    return message.partition(": ")[2]


def test_a_folder_that_does_not_exist_or_is_empty_is_refused(tmp_path):
    for folder in (tmp_path / "missing", tmp_path):
        assert refusal(folder) == "expected a folder with a config.json"
        assert not (folder / "checkpoints").exists()


def test_a_malformed_config_is_refused(tmp_path):
    (tmp_path / "config.json").write_text('{"num_envs": ')
    assert refusal(tmp_path).startswith("Expecting value: line 1")


@pytest.mark.parametrize(
    ("values", "message"),
    [({"nonsense": 1}, "nonsense: no such field"), ({"num_envs": "8"}, "num_envs = '8': expected int")],
)
def test_a_config_with_wrong_fields_is_refused(tmp_path, values, message):
    (tmp_path / "config.json").write_text(json.dumps(values))
    with pytest.raises(ValueError, match=message):
        load_run(tmp_path)


def test_a_run_without_a_checkpoint_is_refused(tmp_path):
    write_config(tmp_path, CONFIG)
    assert refusal(tmp_path) == "holds no checkpoint"
    assert not (tmp_path / "checkpoints").exists()
    (tmp_path / "checkpoints").mkdir()
    assert refusal(tmp_path) == "holds no checkpoint"


def test_the_scenario_of_a_loaded_run_is_checked(tmp_path):
    write_config(tmp_path, dataclasses.replace(CONFIG, params=Params(time_step=-1.0)))
    with pytest.raises(ValueError, match=r"^time_step = -1"):
        load_run(tmp_path)
