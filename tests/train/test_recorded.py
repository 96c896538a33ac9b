"""Trainings on a recording: what config.json keeps of it, and a file that is gone or changed."""

import json

import jax
import numpy as np
import pytest

from tests.aircraft_file import FLEET, state_rows, write_states
from tests.train.small_run import OPTIONS
from train import ppo
from train.checkpoint import learner_shapes, save
from train.config import from_dict, to_dict
from train.saved_run import load_run, read_config, read_run, write_config
from train.scenarios import build_scenario

WORDS = [f"--{name}={value}" for name, value in OPTIONS.items() if "truths" not in name]
WORDS += ["--total-steps=64"]


@pytest.fixture
def states(tmp_path, monkeypatch):
    """A recording in the working folder."""
    monkeypatch.chdir(tmp_path)
    return write_states(tmp_path / "states.csv", state_rows(12))


@pytest.fixture
def configure(monkeypatch):
    """The configuration that a command line asks for."""

    def command(*words):
        given = []
        with monkeypatch.context() as patch:
            patch.setattr(ppo, "start_run", given.append)
            ppo.open_run([*WORDS, *map(str, words)])
        return given[0]

    return command


@pytest.fixture
def run(states, configure, tmp_path):
    """A run's folder with a checkpoint of zeros, without any training."""
    config = configure("--scenario", "states.csv")
    write_config(tmp_path, config)
    env, _ = build_scenario("", [config])
    shapes = learner_shapes(env, config)
    save(tmp_path, jax.tree.map(lambda leaf: np.zeros(leaf.shape, leaf.dtype), shapes), config)
    return tmp_path


def test_the_configuration_names_the_file_and_holds_its_aircraft(states, configure):
    config = configure("--scenario", "states.csv")
    assert config.recording == "states.csv"
    assert len(config.recording_sha256) == 64
    assert config.params.trajectories.shape == (7, config.static.num_truths, 6)
    assert config.params.max_range == 300_000
    saved = json.loads(json.dumps(to_dict(config)))
    assert saved["params"]["trajectories"] is None
    assert "trajectories" not in {name for name, value in saved.items() if value}


def test_options_that_change_what_is_seen_change_the_trajectories(states, configure):
    slow = configure("--scenario", "states.csv", "--params.time-step", 2.0)
    fast = configure("--scenario", "states.csv", "--params.time-step", 1.0)
    np.testing.assert_allclose(slow.params.trajectories[:4], fast.params.trajectories[::2], rtol=1e-9)
    with pytest.raises(ValueError, match=r"^start = 0.0, num_steps = 6, time_step = 60.0: expected to lie"):
        configure("--scenario", "states.csv", "--params.time-step", 60)


def test_a_saved_configuration_runs_again_and_another_scenario_replaces_the_recording(run, configure):
    saved = run / "config.json"
    again, _ = read_config(run)
    assert to_dict(configure("--config", saved)) == to_dict(again)
    other = configure("--config", saved, "--scenario", "agile")
    assert (other.recording, other.recording_sha256, other.params.trajectories) == ("", "", None)


def test_a_run_and_its_checkpoint_come_back_with_the_trajectories(run):
    config, env, _ = load_run(run, say=lambda _: None)
    saved = read_run(run, say=lambda _: None)
    assert saved.state.scenario.trajectories.shape == config.params.trajectories.shape
    _, params = build_scenario("", [config, config])
    np.testing.assert_array_equal(params.trajectories, config.params.trajectories)
    assert env.static.num_truths == params.trajectories.shape[1]


def test_a_file_that_is_gone_or_changed_is_said_in_one_line(run, states):
    states.rename(run / "elsewhere.csv")
    for read in (load_run, lambda run: ppo.open_run(["--resume", str(run)])):
        with pytest.raises(ValueError, match=r"config.json: recording = 'states.csv': No such file"):
            read(run)
    write_states(states, state_rows(12, fleet=FLEET[::-1]))
    for read in (load_run, lambda run: ppo.open_run(["--resume", str(run)])):
        with pytest.raises(
            ValueError, match=r"'states.csv': is not the file of the training: its SHA-256 is"
        ):
            read(run)
    (run / "elsewhere.csv").replace(states)
    load_run(run, say=lambda _: None)


def test_runs_on_different_recordings_have_no_scenario_in_common(states, configure, tmp_path):
    write_states(tmp_path / "others.csv", state_rows(12, fleet=FLEET[::-1]))
    configs = [configure("--scenario", name) for name in ("states.csv", "others.csv")]
    with pytest.raises(ValueError, match=r"^scenario: expected one by name"):
        build_scenario("", configs)


@pytest.mark.parametrize("table", ["curriculum", "randomise"])
def test_the_time_step_of_a_recording_can_not_change(states, configure, table, tmp_path):
    values = to_dict(configure("--scenario", "states.csv"))
    values[table] = {"time_step": [0.1, 0.2]}
    (tmp_path / "varied.json").write_text(json.dumps(values))
    assert from_dict(values).recording == "states.csv"
    with pytest.raises(ValueError, match=rf"^{table}.time_step: can not change where truths are recorded"):
        ppo.open_run(["--config", "varied.json"]).__enter__()
