"""The benchmark of whole trainings: both sides alike, honest sums, clear refusals."""

import dataclasses
import json
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import jax
import numpy as np
import pytest

from benchmarks import time_to_gospa, training
from benchmarks.ppo import OurLearner, Seconds, configure
from benchmarks.training import TrainingOptions, Turn
from jaxtrack import Params, StaticParams
from jaxtrack.env import make
from jaxtrack.report import PACKAGES
from train.agents import build_agent
from train.config import TrainConfig
from train.episodes import compare
from train.evaluate import COMPARED_SEED, agent
from train.networks import ENCODERS

pytestmark = pytest.mark.usefixtures("quick_compilation")

ROOT = Path(__file__).parents[1]
SMALL = TrainingOptions(
    encoders=("flatten",),
    num_envs=8,
    rollout_steps=4,
    minibatch_size=16,
    epochs=2,
    repeats=2,
    stone_soup_envs=2,
    stone_soup_steps=8,
    warm_up_steps=6,
)
TURNS = [
    Turn(Seconds(1.0, 2.0), Seconds(0.5, 0.5), Seconds(3.0, 4.0), 10, (4.0, 5.0)),
    Turn(Seconds(2.0, 2.0), Seconds(2.0, 0.5), Seconds(5.0, 4.0), 10, (6.0, 8.0)),
    Turn(Seconds(4.0, 2.0), Seconds(0.1, 0.5), Seconds(1.0, 4.0), 10, (8.0, 8.0)),
]
"""Whole updates of theirs take 8, 25 and 2 s."""
SILENT = SimpleNamespace(add_task=lambda *_, **__: 0, advance=lambda _: 0, update=lambda *_, **__: 0)

WITHOUT = """
import sys

class Absent:
    def find_spec(self, name, path=None, target=None):
        if name == {missing!r}:
            raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)

sys.meta_path.insert(0, Absent())
sys.argv = ["benchmarks.training"]
from jaxtrack.cli import run
from benchmarks.training import main
run(main)
"""
"""The command in a Python in which a module can not be found."""


def a_row(turns=TURNS, encoder="flatten"):
    ours = SimpleNamespace(parameters=7, compiling=Seconds(30.0, 20.0))
    return training.make_row(encoder, 100, turns, ours, SimpleNamespace(parameters=9))


def test_a_row_puts_their_update_together_from_parts_and_learning():
    row = a_row()
    assert row["jaxtrack"]["steps_per_second"]["repeats"] == [100.0, 50.0, 25.0]
    theirs = row["stone_soup"]
    assert theirs["steps_per_second"]["repeats"] == [12.5, 4.0, 50.0]
    assert theirs["rollout_seconds"]["repeats"] == [5.0, 20.0, 1.0]
    assert theirs["learning_seconds"]["median"] == 3.0
    assert row["ratio"] == 4.0
    assert row["processor_time_ratio"] == 4.5
    assert (row["jaxtrack"]["live_tracks"], theirs["live_tracks"]) == (6.0, 7.0)
    assert (row["jaxtrack"]["parameters"], theirs["parameters"]) == (7, 9)
    shown = training.cells(row)
    assert len(shown) == len(training.HEADER)
    assert shown[:5] == ["flatten", "50.0 (25.0 - 100)", "12.5 (4.00 - 50.0)", "4.0", "4.5"]
    assert shown[-2:] == ["6.0 / 7.0", "30.0 s (20.0)"]


def test_the_title_says_what_is_extrapolated():
    machine = {"processor": "chip", "cores": 2, "jax_backend": "cpu", "torch_threads": 1}
    assert "EXTRAPOLATED: a rollout of 32 steps at the speed of 8" in training.describe(SMALL, machine)
    whole = dataclasses.replace(SMALL, stone_soup_steps=32)
    assert "theirs measured whole" in training.describe(whole, machine)


def test_both_sides_learn_from_the_same_batch(monkeypatch):
    ours, theirs, warm = [], [], []

    class Learner:
        def __init__(self, config, piece):
            theirs.append((config, piece))

        def warm_up(self, steps):
            warm.append(steps)

    def build(config, env):
        ours.append((config, env))
        return lambda: warm.append("ours")

    monkeypatch.setattr(training, "build_learner", build)
    monkeypatch.setattr(training, "load_stone_soup_ppo", lambda: SimpleNamespace(StoneSoupPPO=Learner))
    training.build_sides("mhsa", SMALL)
    ((mine, env),), ((other, piece),) = ours, theirs
    assert (mine.num_envs, mine.rollout_steps) == (8, 4)
    assert (other.num_envs, other.rollout_steps, piece) == (2, 16, 4)
    for name in ("batch_size", "minibatch_size", "epochs", "encoder", "static", "params", "learning_rate"):
        assert getattr(mine, name) == getattr(other, name)
    assert (mine.batch_size, mine.minibatch_size, mine.epochs, mine.encoder) == (32, 16, 2, "mhsa")
    assert env.static == StaticParams() == other.static
    assert warm == ["ours", "ours", 6]  # six steps are two updates of four


def test_sides_take_turns(monkeypatch):
    calls = []

    def build(encoder, options):
        def ours():
            calls.append(f"{encoder} ours")
            return {"live_tracks": 3.0}

        def say(what, result):
            return lambda: calls.append(f"{encoder} {what}") or result

        mine = SimpleNamespace(__call__=ours, parameters=1, compiling=Seconds(1.0, 1.0))
        mine = type("Ours", (), {**vars(mine), "__call__": lambda self: ours()})()
        tracks = SimpleNamespace(mean=4.0)
        part, learn = say("part", Seconds(1.0, 1.0)), say("learning", Seconds(2.0, 2.0))
        return mine, SimpleNamespace(collect=part, update=learn, pieces=4, tracks=tracks, parameters=1)

    monkeypatch.setattr(training, "build_sides", build)
    options = TrainingOptions(encoders=("flatten", "mhsa"), repeats=3)
    rows = training.measure(options, SILENT)
    one = ["ours", "part", "learning"]
    assert calls == [f"{encoder} {what}" for encoder in ("flatten", "mhsa") for what in one] * 3
    assert [row["encoder"] for row in rows] == ["flatten", "mhsa"]
    assert rows[0]["stone_soup"]["steps_per_second"]["median"] == pytest.approx(8192 / 6)
    assert rows[0]["stone_soup"]["live_tracks"] == 4.0


FOUND = {
    "goal": 120.0,
    "warm_start": "gain",
    "reached": True,
    "env_steps": 36_000,
    "seconds": 61.2,
    "compile_seconds": 30.4,
    "gospa": 118.26,
    "gospa_on_other_scenarios": 121.04,
    "evaluations": [],
}


def test_command_writes_all_and_prints_markdown(tmp_path, monkeypatch, capsys):
    asked, rows = [], [a_row(), a_row(encoder="mhsa")]
    monkeypatch.setattr(training, "measure", lambda *_: rows)
    monkeypatch.setattr(training, "load_stone_soup_ppo", lambda: SimpleNamespace(threads=lambda: 2))

    def train_until(goal, config):
        asked.append((goal, config.warm_start, config.seed))
        return FOUND

    monkeypatch.setattr(time_to_gospa, "train_until", train_until)
    file = tmp_path / "result.json"
    arguments = ["--out", str(file), "--markdown", "--seed", "5", "--gospa", "120"]
    assert training.main(arguments) == 0
    assert asked == [(120.0, "gain", 5)]
    result = json.loads(file.read_text())
    assert set(result) == {"date", "versions", "machine", "options", "scenario", "rows", "time_to_gospa"}
    assert {*PACKAGES, "flax", "optax"} <= set(result["versions"])
    assert result["machine"]["torch_threads"] == 2
    assert result["rows"] == rows
    assert result["time_to_gospa"] == FOUND
    assert str(tmp_path) not in file.read_text()
    said = capsys.readouterr().out
    lines = said.splitlines()
    assert lines[2].startswith("| flatten | 50.0 (25.0 - 100) | 12.5 (4.00 - 50.0) | 4.0 |")
    assert all(line.count("|") == len(training.HEADER) + 1 for line in lines[:4])
    # 36,000 steps at 12.5 a second
    assert "| gain | 118.3 | 121.0 | 36,000 | 61 | 30 | 0.800 h | 0.800 h |" in lines
    assert "at most 120 m: reached" in said
    training.main(["--markdown"])
    assert len(asked) == 1
    assert "GOSPA" not in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--repeats", "0"], "repeats = 0"),
        (["--encoders", "beams"], "encoders = 'beams': expected some of flatten, bigru, mhsa"),
        (["--encoders", "mhsa", "mhsa"], "expected different"),
        (["--minibatch-size", "1000"], "minibatch_size = 1000: expected a divisor of .* 8192 samples"),
        (["--stone-soup-envs", "0"], "stone_soup_envs = 0"),
        (["--stone-soup-steps", "0"], "stone_soup_steps = 0"),
        (["--stone-soup-steps", "258"], "stone_soup_steps = 258: expected a multiple of stone_soup_envs = 4"),
        (["--stone-soup-steps", "300"], "that divides num_envs x rollout_steps = 8192"),
        (["--warm-up-steps", "0"], "warm_up_steps = 0"),
        (["--gospa", "-1"], "gospa = -1"),
        (["--gospa", "nan"], "gospa = nan"),
        (["--warm-start", "luck"], "warm_start = 'luck'"),
        (["--total-steps", "5"], "total_steps = 5"),
        (["--seed", "-1"], "seed = -1"),
        (["--out", "no/such/folder/x.json"], "out = "),
        (["--nonsense"], "nonsense"),
    ],
)
def test_wrong_options_end_before_anything_is_measured(arguments, message, monkeypatch):
    monkeypatch.setattr(training, "load_stone_soup_ppo", lambda: pytest.fail("loaded"))
    with pytest.raises(ValueError, match=message):
        training.main(arguments)


@pytest.mark.parametrize("missing", ["torch", "stable_baselines3"])
def test_without_the_extra_the_command_says_in_one_line_what_to_install(missing):
    code = WITHOUT.format(missing=missing)
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    (line,) = done.stderr.splitlines()
    assert line.startswith("error: ")
    assert 'pip install -e ".[sb3,reference]"' in line
    assert done.stdout == ""


def test_without_a_warm_start_the_rate_is_the_advised_one():
    assert time_to_gospa.configure("gain", 800_000, 0) == TrainConfig()
    alone = time_to_gospa.configure("none", 2_000_000, 3)
    assert alone == TrainConfig(warm_start="none", total_steps=2_000_000, seed=3, learning_rate=3e-3)


@pytest.mark.parametrize(("goal", "reached", "updates"), [(120.0, True, 3), (90.0, False, 4)])
def test_training_ends_at_the_first_evaluation_that_is_good_enough(monkeypatch, goal, reached, updates):
    config = TrainConfig(num_envs=2, rollout_steps=4, num_minibatches=1, total_steps=32)
    done = []

    def build(config, env):
        return OurLearner(SimpleNamespace(weights=0), lambda state: (done.append(1), {}), Seconds(1.0, 1.0))

    def evaluation(config, env, weights):
        other = {COMPARED_SEED: 130.0}
        return lambda weights, seed: other.get(seed, [200.0, 121.0, 119.0, 100.0][len(done) - 1])

    monkeypatch.setattr(time_to_gospa, "build_learner", build)
    monkeypatch.setattr(OurLearner, "__call__", lambda self: done.append(1))
    monkeypatch.setattr(time_to_gospa, "compile_evaluation", evaluation)
    found = time_to_gospa.train_until(goal, config)
    assert (found["reached"], len(done)) == (reached, updates)
    assert found["env_steps"] == 8 * updates
    assert [each["env_steps"] for each in found["evaluations"]] == [8, 16, 24, 32][:updates]
    assert found["gospa"] == [200.0, 121.0, 119.0, 100.0][updates - 1]
    assert found["gospa_on_other_scenarios"] == 130.0
    assert 0 < found["compile_seconds"] <= found["evaluations"][0]["seconds"] <= found["seconds"]


def test_the_evaluation_is_that_of_train_evaluate():
    static = StaticParams(num_truths=2, max_tracks=3, max_detections=2, map_size=8, num_looks=5)
    static = dataclasses.replace(static, observe_variances=True)
    params = Params(max_steps_in_episode=12)
    config = TrainConfig(static=static, params=params)
    env, _ = make(params, static)
    keys = jax.random.split(jax.random.key(1), 2)
    observations = jax.vmap(env.reset_env, in_axes=(0, None))(keys, params)[0]
    beams = build_agent("beams", static, params)
    weights = beams.network.init(jax.random.key(0), jax.vmap(beams.features)(observations))
    evaluate = time_to_gospa.compile_evaluation(config, env, weights)
    competitor = agent("beams", [weights], (0,))
    expected = compare({"beams": competitor}, env, params, time_to_gospa.EPISODES, seed=3).played["beams"]
    assert evaluate(weights, 3) == pytest.approx(expected.values["gospa"].mean(), rel=1e-5)
    assert evaluate(weights, 4) != evaluate(weights, 3)


@pytest.fixture(scope="module")
def stone_soup_ppo():
    """A small learner on Stone Soup after its warm-up."""
    from benchmarks.stone_soup_ppo import StoneSoupPPO

    config = dataclasses.replace(configure("flatten", SMALL), num_envs=2, rollout_steps=16)
    learner = StoneSoupPPO(config, piece=4)
    learner.warm_up(6)
    return learner


@pytest.mark.sb3
def test_stone_soup_steps_in_pieces_and_learns_from_a_full_batch(stone_soup_ppo, monkeypatch):
    model = stone_soup_ppo.model
    assert model.num_timesteps == 2 * 8  # six steps are two pieces of four
    scenarios = [env.unwrapped.scenario for env in model.env.envs]
    assert [scenario.step_index for scenario in scenarios] == [8, 8]
    seconds = stone_soup_ppo.collect()
    assert seconds.wall > 0
    assert [scenario.step_index for scenario in scenarios] == [12, 12]
    counts = [len(scenario.tracks) for scenario in scenarios]
    assert 0 <= stone_soup_ppo.tracks.mean <= max(counts) + 1

    optimiser_steps, weights = [], {name: value.clone() for name, value in model.policy.named_parameters()}
    step = model.policy.optimizer.step
    monkeypatch.setattr(model.policy.optimizer, "step", lambda: (optimiser_steps.append(1), step()))
    stone_soup_ppo.update()
    assert len(optimiser_steps) == SMALL.epochs * SMALL.samples // SMALL.minibatch_size
    assert any((value != weights[name]).any() for name, value in model.policy.named_parameters())


@pytest.mark.sb3
def test_the_full_batch_is_the_last_piece_again_and_again(stone_soup_ppo):
    stone_soup_ppo.collect()
    batch, rollout = stone_soup_ppo._full_batch(), stone_soup_ppo._rollout
    assert (batch.full, batch.buffer_size, batch.n_envs) == (True, 16, 2)
    assert stone_soup_ppo.pieces == 4
    for step in range(16):
        for name in ("actions", "log_probs", "advantages", "returns", "values", "rewards"):
            np.testing.assert_array_equal(getattr(batch, name)[step], getattr(rollout, name)[step % 4])
        for name, values in batch.observations.items():
            np.testing.assert_array_equal(values[step], rollout.observations[name][step % 4])
    assert np.abs(rollout.advantages).max() > 0
    assert rollout.observations["scan_map"].shape == (4, 2, 1, 48, 48)


@pytest.mark.sb3
def test_live_tracks_come_first_in_their_order():
    from benchmarks.stone_soup_ppo import for_the_network

    mask = np.array([0, 1, 0, 1, 1], np.int8)
    tracks = mask[:, None] * np.arange(5.0)[:, None]
    shown = for_the_network({"tracks": tracks, "mask": mask, "scan_map": np.ones((3, 3))})
    assert shown["mask"].tolist() == [1, 1, 1, 0, 0]
    assert shown["tracks"][:, 0].tolist() == [1, 3, 4, 0, 0]
    assert shown["scan_map"].shape == (1, 3, 3)


@pytest.mark.sb3
@pytest.mark.parametrize("encoder", ENCODERS)
def test_both_networks_have_the_same_number_of_parameters(encoder):
    """But for PyTorch's second bias of the gates r and z, which a GRU adds to the first."""
    from benchmarks.stone_soup_ppo import StoneSoupPPO

    config = configure(encoder, SMALL)
    network = build_agent(encoder, config.static, config.params).network
    env, _ = make(config.params, config.static)
    observation = jax.eval_shape(env.reset_env, jax.random.key(0), config.params)[0]
    one = jax.tree.map(lambda leaf: jax.ShapeDtypeStruct((1, *leaf.shape), leaf.dtype), observation)
    weights = jax.eval_shape(network.init, jax.random.key(0), one)
    ours = OurLearner(SimpleNamespace(weights=weights), None, Seconds(0.0, 0.0)).parameters
    second_biases = 2 * 2 * {"flatten": 0, "bigru": 64, "mhsa": 32}[encoder]
    assert StoneSoupPPO(config, piece=4).parameters == ours + second_biases
    assert ours > 100_000


@pytest.mark.sb3
def test_a_small_benchmark_from_end_to_end():
    (row,) = training.measure(SMALL, SILENT)
    for side in ("jaxtrack", "stone_soup"):
        assert len(row[side]["steps_per_second"]["repeats"]) == 2
        assert row[side]["steps_per_second"]["min"] > 0
        assert row[side]["live_tracks"] >= 0
    assert row["jaxtrack"]["parameters"] == row["stone_soup"]["parameters"]
    assert row["compile_seconds"]["wall"] > 0
    assert len(training.cells(row)) == len(training.HEADER)
