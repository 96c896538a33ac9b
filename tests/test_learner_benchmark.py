"""The benchmark of the learner: an environment that costs nothing, honest rows, clear refusals."""

import json
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks import learner
from benchmarks.learner import LearnerOptions
from benchmarks.still_world import StillWorld
from jaxtrack import Params, StaticParams
from jaxtrack.env import SearchTrack
from jaxtrack.report import PACKAGES
from tests.missing_module import run_without
from train.rollout import LOGGED

pytestmark = pytest.mark.usefixtures("quick_compilation")


def test_the_still_world_shows_observations_like_the_environments():
    static, live = StaticParams(max_tracks=6, map_size=12, num_looks=5), (2, 4)
    world = StillWorld(static, live)
    keys = jax.random.split(jax.random.key(0), 200)
    observation, state = jax.vmap(world.reset_env, in_axes=(0, None))(keys, Params())
    expected, _ = jax.eval_shape(SearchTrack(static).reset_env, keys[0], Params())
    assert {name: (leaf.shape[1:], leaf.dtype) for name, leaf in observation.items()} == {
        name: (leaf.shape, leaf.dtype) for name, leaf in expected.items()
    }
    counts = observation["mask"].sum(axis=1)
    assert set(counts.tolist()) == {2, 3, 4}
    np.testing.assert_array_equal(observation["mask"], np.arange(6) < counts[:, None])
    assert np.all(observation["tracks"][~observation["mask"]] == 0)
    row = jax.tree.map(lambda leaf: leaf[0], state)
    shown, after, reward, *ends, info = world.step(keys[0], row, jnp.array([4, 0]), Params())
    assert float(reward) == pytest.approx(0.8)
    assert not any(ends)
    for name, values in row.observation.items():
        np.testing.assert_array_equal(shown[name], values)
        np.testing.assert_array_equal(after.observation[name], values)
    assert set(info) == {"final_observation", *LOGGED}


def test_ours_learns_from_all_samples_of_an_update():
    options = LearnerOptions(num_envs=4, rollout_steps=4, minibatch_size=8, epochs=2, seed=3)
    config = learner.configure("flatten", options)
    assert (config.num_minibatches, config.minibatch_size, config.batch_size) == (2, 8, 16)
    assert (config.encoder, config.epochs, config.seed, config.warm_start) == ("flatten", 2, 3, "none")
    update, observations, seconds = learner.build_ours(config, (5, 10))
    assert observations["scan_map"].shape == (4, 48, 48)
    assert seconds > 0
    update()
    update()  # its own state again: the first was donated


def test_a_row_holds_steps_per_second_of_both_sides_and_their_ratio():
    row = learner.make_row("bigru", 100, [(1.0, 4.0), (2.0, 5.0), (4.0, 2.0)], 7.0)
    assert row["jaxtrack"]["steps_per_second"]["repeats"] == [100.0, 50.0, 25.0]
    assert row["stable_baselines3"]["steps_per_second"]["repeats"] == [25.0, 20.0, 50.0]
    assert row["ratio"] == 2.0
    assert learner.cells(row) == ["bigru", "50 (25 - 100)", "25 (20 - 50)", "2.00", "7.0 s"]


def test_sides_take_turns_and_warm_up_first(monkeypatch):
    calls = []
    monkeypatch.setattr(
        learner, "build_ours", lambda config, live: (lambda: calls.append(f"{config.encoder} ours"), {}, 1.0)
    )
    other = SimpleNamespace(build_update=lambda config, _: lambda: calls.append(f"{config.encoder} theirs"))
    monkeypatch.setattr(learner, "load_stable_baselines3", lambda: other)
    options = LearnerOptions(encoders=("flatten", "mhsa"), repeats=3)
    progress = SimpleNamespace(add_task=lambda *_, **__: 0, advance=lambda _: 0, update=lambda *_, **__: 0)
    rows = learner.measure(options, progress)
    turn = ["flatten ours", "flatten theirs", "mhsa ours", "mhsa theirs"]
    assert calls == turn * 4
    assert [len(row["jaxtrack"]["steps_per_second"]["repeats"]) for row in rows] == [3, 3]


def test_command_writes_all_and_prints_markdown(tmp_path, monkeypatch, capsys):
    rows = [learner.make_row("flatten", 100, [(1.0, 3.0)], 7.0)]
    monkeypatch.setattr(learner, "measure", lambda *_: rows)
    monkeypatch.setattr(learner, "load_stable_baselines3", lambda: SimpleNamespace(threads=lambda: 2))
    file = tmp_path / "result.json"
    assert learner.main(["--out", str(file), "--markdown", "--encoders", "flatten", "--seed", "5"]) == 0
    result = json.loads(file.read_text())
    assert set(result) == {"date", "versions", "machine", "options", "scenario", "rows"}
    assert {*PACKAGES, "flax", "optax"} <= set(result["versions"])
    assert result["machine"]["torch_threads"] == 2
    assert result["rows"] == rows
    assert result["options"]["encoders"] == ["flatten"]
    assert str(tmp_path) not in file.read_text()
    lines = capsys.readouterr().out.splitlines()
    assert lines[2] == "| flatten | 100 (100 - 100) | 33 (33 - 33) | 3.00 | 7.0 s |"
    assert all(line.count("|") == len(learner.HEADER) + 1 for line in lines[:3])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--repeats", "0"], "repeats = 0"),
        (["--encoders", "beams"], "encoders = 'beams': expected some of flatten, bigru, mhsa"),
        (["--encoders", "mhsa", "mhsa"], "expected different"),
        (["--minibatch-size", "1000"], "minibatch_size = 1000: expected a divisor of .* 8192 samples"),
        (
            ["--live-tracks", "5", "21"],
            r"live_tracks = \(5, 21\): expected two integers in order in \[0, 20\]",
        ),
        (["--live-tracks", "5", "4"], r"live_tracks = \(5, 4\)"),
        (["--seed", "-1"], "seed = -1"),
        (["--out", "no/such/folder/x.json"], "out = "),
        (["--nonsense"], "nonsense"),
    ],
)
def test_wrong_options_end_before_anything_is_measured(arguments, message, monkeypatch):
    monkeypatch.setattr(learner, "load_stable_baselines3", lambda: pytest.fail("loaded"))
    with pytest.raises(ValueError, match=message):
        learner.main(arguments)


@pytest.mark.parametrize("missing", ["torch", "stable_baselines3"])
def test_without_the_extra_the_command_says_in_one_line_what_to_install(missing):
    done = run_without(missing, "benchmarks.learner")
    assert done.returncode == 2
    (line,) = done.stderr.splitlines()
    assert line.startswith("error: ")
    assert 'pip install -e ".[sb3]"' in line
    assert done.stdout == ""
