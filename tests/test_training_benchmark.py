"""The benchmark of whole trainings: both sides alike, honest sums, clear refusals."""

import dataclasses
import json
from types import SimpleNamespace

import pytest

from benchmarks import time_to_gospa, training
from benchmarks.ppo import Seconds
from benchmarks.training import TrainingOptions, Turn
from jaxtrack import StaticParams
from jaxtrack.report import PACKAGES
from tests.missing_module import run_without
from train.config import TrainConfig

pytestmark = pytest.mark.usefixtures("quick_compilation")

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
    assert asked == [(120.0, TrainConfig.warm_start, 5)]
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
    done = run_without(missing, "benchmarks.training")
    assert done.returncode == 2
    (line,) = done.stderr.splitlines()
    assert line.startswith("error: ")
    assert 'pip install -e ".[sb3,reference]"' in line
    assert done.stdout == ""


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
