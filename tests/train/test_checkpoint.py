"""Checkpoints: what is saved comes back, the last two stay, what is no run is refused in one line."""

import dataclasses
import json
import os

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxtrack import Params
from tests.train.small_run import CONFIG, STATIC, assert_same, at, random_state, write_run
from train import checkpoint
from train.checkpoint import KEPT, load_newest, restore, save, updates
from train.config import to_dict
from train.saved_run import load_run, write_config


@pytest.fixture(scope="module")
def state():
    """A learner whose arrays all hold different random numbers."""
    return random_state()


def test_a_run_comes_back(tmp_path, state):
    write_run(tmp_path, state)
    config, env, weights = load_run(tmp_path)
    assert config == CONFIG
    assert env.static == STATIC
    assert_same(weights, at(state, 1).weights)


def test_the_latest_of_the_kept_checkpoints_is_loaded(tmp_path, state, capsys):
    assert write_run(tmp_path, state, written=(1, 3, 20)) == [3, 20]
    assert KEPT == 2
    assert sorted(os.listdir(tmp_path / "checkpoints")) == ["20.json", "20.npz", "3.json", "3.npz"]
    assert_same(load_run(tmp_path)[2], at(state, 20).weights)
    assert capsys.readouterr().out == f"{tmp_path}: using the checkpoint of update 20\n"


def test_the_whole_learner_is_saved_with_what_it_depends_on(tmp_path, state):
    write_run(tmp_path, state, written=(7,))
    found = load_newest(tmp_path)
    restored = restore(found, state)
    assert_same(restored, at(state, 7))
    assert (found.update, found.metrics_digest) == (7, "rows up to 7")
    assert found.config == json.loads(json.dumps(to_dict(CONFIG)))
    about = found.written_with
    assert {"python", "jaxtrack", "jax", "jaxlib", "flax", "optax", "numpy"} <= set(about)
    assert about["cores"] >= 1
    assert about["devices"] == jax.device_count()
    assert about["jax_backend"] == jax.default_backend()


def test_the_configuration_can_be_taken_from_a_checkpoint(tmp_path, state):
    write_run(tmp_path, state, written=(7,))
    with np.load(tmp_path / "checkpoints" / "7.npz", allow_pickle=False) as file:
        about = json.loads(str(file["about"]))
    assert about["config"] == json.loads((tmp_path / "config.json").read_text())


def test_writing_a_checkpoint_again_replaces_it(tmp_path, state):
    write_run(tmp_path, state, written=(4, 6))
    save(tmp_path, at(state, 9).replace(update=jnp.asarray(6)), CONFIG)
    assert updates(tmp_path) == [4, 6]
    assert_same(load_run(tmp_path)[2], at(state, 9).weights)


def test_an_earlier_update_removes_later_ones_but_not_the_one_before(tmp_path, state):
    """After a fallback: 20 was damaged, the training goes on from 10 and is stopped at 15."""
    write_run(tmp_path, state, written=(10, 20, 15))
    assert updates(tmp_path) == [10, 15]


@pytest.mark.parametrize("before", [(), (10,), (10, 20)])
def test_a_checkpoint_that_was_cut_short_leaves_the_old_ones(tmp_path, state, monkeypatch, before):
    """The machine may stop between any two things that are done to files: old or new, and nothing between."""
    write_run(tmp_path, state, written=before)
    steps = []

    def counted(name, real):
        def step(*arguments, **named):
            if len(steps) == limit:
                raise SystemExit
            steps.append(name)
            return real(*arguments, **named)

        return step

    for name in ("replace", "fsync", "unlink"):
        monkeypatch.setattr(os, name, counted(name, getattr(os, name)))
    limit, found = 0, []
    while True:
        steps.clear()
        try:
            save(tmp_path, at(state, 30), CONFIG)
            break
        except SystemExit:
            newest = load_newest(tmp_path)
        found.append(newest.update if newest else 0)
        if newest:
            assert_same(restore(newest, state), at(state, newest.update))
        limit += 1
    assert {"replace", "fsync"} <= set(steps)
    assert found == sorted(found)
    assert set(found) == {max(before, default=0), 30}
    assert updates(tmp_path) == [*before[-1:], 30]


def test_a_checkpoint_of_a_newer_format_is_refused(tmp_path, state, monkeypatch):
    write_run(tmp_path, state, written=(4,))
    with monkeypatch.context() as patch:
        patch.setattr(checkpoint, "FORMAT", 2)
        save(tmp_path, at(state, 6), CONFIG)
    assert "has format 2, expected at most 1; it was written with jaxtrack " in refusal(tmp_path)


def test_a_checkpoint_of_other_shapes_is_refused(tmp_path, state):
    wider = jax.tree.map(lambda leaf: jnp.concatenate([leaf, leaf], -1) if leaf.ndim else leaf, state.weights)
    write_config(tmp_path, CONFIG)
    save(tmp_path, state.replace(weights=wider, update=jnp.asarray(3)), CONFIG)
    with pytest.raises(
        ValueError, match=r"^checkpoint of update 3: weights/params/.* is float32\[.*, expected"
    ):
        load_run(tmp_path)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"seed": 6}, "config.json: seed = 6, but the checkpoint was trained with 5"),
        ({"gamma": 0.99}, "config.json: gamma = 0.99, but the checkpoint was trained with 0.995"),
        (
            {"params": Params(range_sigma=6.0)},
            "params.range_sigma = 6.0, but the checkpoint was trained with 5.0",
        ),
    ],
)
def test_a_checkpoint_of_another_configuration_is_refused(tmp_path, state, change, message):
    write_run(tmp_path, state)
    write_config(tmp_path, dataclasses.replace(CONFIG, **change))
    assert message in refusal(tmp_path)


def refusal(folder):
    """The message with which a folder is refused."""
    with pytest.raises(ValueError) as caught:  # noqa: PT011  # callers compare the message
        load_run(folder)
    message = str(caught.value)
    assert "\n" not in message
    assert str(folder) in message
    return message


def test_a_folder_that_does_not_exist_or_is_empty_is_refused(tmp_path):
    for folder in (tmp_path / "missing", tmp_path):
        assert refusal(folder).endswith(": expected a folder with a config.json")
        assert not (folder / "checkpoints").exists()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('{"num_envs": ', "Expecting value: line 1"),
        ("[1]", "expected a table of fields"),
        ("[" * 100_000, "nested too deeply"),
        ('{"nonsense": 1}', "nonsense: no such field"),
        ('{"num_envs": "8"}', "num_envs = '8': expected int"),
        ('{"num_envs": 0}', "num_envs = 0: expected an integer >= 1"),
        ('{"seed": ' + "9" * 5000 + "}", "config.json: "),
        (" " * 2_000_000, "config.json: expected at most 1048576 bytes"),
    ],
)
def test_a_wrong_config_is_refused(tmp_path, text, message):
    (tmp_path / "config.json").write_text(text)
    assert message in refusal(tmp_path)


def test_a_run_without_a_checkpoint_is_refused(tmp_path):
    write_config(tmp_path, CONFIG)
    assert refusal(tmp_path).endswith(": holds no checkpoint")
    assert not (tmp_path / "checkpoints").exists()
    (tmp_path / "checkpoints").mkdir()
    assert refusal(tmp_path).endswith(": holds no checkpoint")


def test_the_scenario_of_a_loaded_run_is_checked(tmp_path):
    write_config(tmp_path, dataclasses.replace(CONFIG, params=Params(time_step=-1.0)))
    assert "config.json: time_step = -1" in refusal(tmp_path)
