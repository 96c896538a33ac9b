"""`python -m train.ppo` from the command line to its files: whole, interrupted, refused."""

import csv
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import jax
import numpy as np
import pytest

from jaxtrack import StaticParams
from jaxtrack.cli import run
from jaxtrack.policies import POLICIES
from train import evaluate, ppo
from train.checkpoint import load_run
from train.episode_metrics import METRICS
from train.figures import FIGURES

pytestmark = pytest.mark.usefixtures("quick_compilation")

ROOT = Path(__file__).resolve().parents[2]
BASELINES = {name: POLICIES[name] for name in ("static", "coverage")}
PICTURES = ["learning_curve.png", "episode.gif", *(f"{name}.png" for name in FIGURES)]
SIZES = {
    "num-envs": 4,
    "rollout-steps": 8,
    "num-minibatches": 2,
    "microbatch": 8,
    "epochs": 1,
    "total-steps": 100,
    "evaluation-episodes": 2,
    "checkpoint-every": 2,
    "static.num-truths": 2,
    "static.max-tracks": 3,
    "static.max-detections": 2,
    "static.max-clutter": 0,
    "static.map-size": 6,
    "static.num-looks": 3,
    "params.max-steps-in-episode": 6,
    "params.beam-azimuth": 0.9,
    "params.beam-elevation": 0.9,
}
SMALL = [f"--{name}={value}" for name, value in SIZES.items()]


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A whole run: its folder, exit code and what it compiled, for further runs of the same shapes."""
    folder = tmp_path_factory.mktemp("runs") / "new" / "run"
    kept = []
    compile_training = ppo.compile_training

    def compile_and_keep(*arguments):
        state, compiled = compile_training(*arguments)
        kept.append((jax.device_get(state), compiled))
        return state, compiled

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ppo, "compile_training", compile_and_keep)
        patch.setattr(evaluate, "POLICIES", BASELINES)
        code = ppo.main([*SMALL, "--out", str(folder)])
    return folder, code, kept[0]


def read_rows(folder):
    """Rows of a run's metrics.csv."""
    return list(csv.DictReader((folder / "metrics.csv").read_text().splitlines()))


def checkpoints(folder):
    """Updates of the checkpoints in a run's folder."""
    return sorted(int(path.name) for path in (folder / "checkpoints").iterdir())


def test_a_whole_run_leaves_all_its_files(whole):
    folder, code, _ = whole
    assert code == 0
    # 100 steps are three whole updates of 32.
    rows = read_rows(folder)
    assert [int(row["update"]) for row in rows] == [1, 2, 3]
    assert [int(float(row["env_steps"])) for row in rows] == [32, 64, 96]
    assert all(np.isfinite(float(row[name])) for row in rows for name in ("reward", "entropy", "value_loss"))
    assert checkpoints(folder) == [2, 3]
    for name in PICTURES:
        assert (folder / name).stat().st_size > 1000
    results = json.loads((folder / "results.json").read_text())
    assert list(results["policies"]) == ["beams", *BASELINES]
    assert results["policies"]["beams"]["training_seeds"] == [0]
    assert list(results["policies"]["beams"]["metrics"]) == list(METRICS)
    lines = (folder / "episodes.csv").read_text().splitlines()
    assert len(lines) == 1 + 2 * (1 + len(BASELINES))
    assert set(json.loads((folder / "config.json").read_text())["static"]) == set(vars(StaticParams()))


@pytest.mark.slow
def test_a_whole_run_can_be_evaluated_again(whole, tmp_path, capsys):
    folder, _, _ = whole
    config, env, weights = load_run(folder)
    assert config.num_envs == 4
    assert config.params.max_steps_in_episode == 6
    assert env.static.num_looks == 3
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(weights))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(evaluate, "POLICIES", {})
        code = evaluate.main(["--run", str(folder), "--episodes", "2", "--out", str(tmp_path / "again")])
    assert code == 0
    assert "2 scenarios" in capsys.readouterr().out
    # The same scenarios and the same weights: the numbers of the run itself.
    before, after = (
        (path / "episodes.csv").read_text().splitlines() for path in (folder, tmp_path / "again")
    )
    own = [line.split(",")[1:] for line in before if line.startswith("beams")]
    again = [line.split(",")[1:] for line in after[1:]]
    again, own = (np.array([[cell or "nan" for cell in row] for row in rows], float) for rows in (again, own))
    np.testing.assert_allclose(again, own, rtol=1e-4)


def train_again(whole, folder, monkeypatch, **changes):
    """Another run on what the whole run compiled; the exit code."""
    state, compiled = whole[2]
    compiled = changes.pop("compiled", compiled)
    monkeypatch.setattr(ppo, "compile_training", lambda *_: (jax.device_put(state), compiled))
    return ppo.main([*SMALL, "--evaluation-episodes", "0", "--out", str(folder)])


def test_the_first_interrupt_finishes_the_update_and_writes_a_checkpoint(
    whole, tmp_path, monkeypatch, capsys
):
    def write_and_interrupt(file, row, write=ppo.write_row):
        write(file, row)
        if row["update"] == 1:
            os.kill(os.getpid(), signal.SIGINT)

    before = signal.getsignal(signal.SIGINT)
    monkeypatch.setattr(ppo, "write_row", write_and_interrupt)
    folder = tmp_path / "run"
    assert train_again(whole, folder, monkeypatch) == 130
    assert len(read_rows(folder)) == 1
    assert checkpoints(folder) == [1]
    load_run(folder)
    said = " ".join(capsys.readouterr().out.split())
    assert "stopped after 1 updates; checkpoint of update 1 in" in said
    assert "python -m train.evaluate --run" in said
    assert signal.getsignal(signal.SIGINT) is before


def test_a_second_interrupt_stops_at_once():
    with ppo.Interrupt() as interrupt:
        signal.raise_signal(signal.SIGTERM)
        assert interrupt.signal == signal.SIGTERM
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)


def test_a_training_that_diverges_says_so_and_keeps_the_last_good_checkpoint(
    whole, tmp_path, monkeypatch, capsys
):
    _, compiled = whole[2]

    def diverging(state):
        after, metrics = compiled(state)
        return after, {**metrics, "value_loss": np.where(after.update == 3, np.nan, metrics["value_loss"])}

    folder = tmp_path / "run"
    assert train_again(whole, folder, monkeypatch, compiled=diverging) == 1
    said = " ".join(capsys.readouterr().out.split())
    assert "training diverged: value_loss is nan after update 3" in said
    assert "checkpoint of update 2 in" in said
    assert checkpoints(folder) == [2]


def test_without_a_checkpoint_there_is_nothing_to_evaluate(whole, tmp_path, monkeypatch, capsys):
    _, compiled = whole[2]

    def diverging(state):
        after, metrics = compiled(state)
        return after, {**metrics, "value_loss": np.float32(np.nan)}

    folder = tmp_path / "run"
    assert train_again(whole, folder, monkeypatch, compiled=diverging) == 1
    said = " ".join(capsys.readouterr().out.split())
    assert "stopped after 1 updates; no checkpoint yet in" in said
    assert "nothing to evaluate" in said
    assert "train.evaluate" not in said
    assert checkpoints(folder) == []


def test_the_same_seed_gives_the_same_numbers(whole, tmp_path, monkeypatch):
    train_again(whole, tmp_path / "run", monkeypatch)
    clock = ("seconds", "steps_per_second")
    first, again = (
        [[value for name, value in row.items() if name not in clock] for row in read_rows(folder)]
        for folder in (whole[0], tmp_path / "run")
    )
    assert again == first


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--encoder", "cnn"], "encoder = 'cnn': expected one of beams, flatten, bigru, mhsa"),
        (["--params.time-step", "-1"], "time_step = -1.0: expected a number in (0"),
        (["--params.range-sigma", "nan"], "range_sigma = nan: expected a number in (0"),
        (["--num-minibatches", "64"], "num_minibatches = 64: expected a divisor of"),
        (["--num-envs", "0"], "num_envs = 0: expected an integer >= 1"),
        (["--num-envs", "many"], "--num-envs"),
        (["--nonsense", "1"], "--nonsense"),
        (["--static.num-truths", "0"], "num_truths = 0: expected an integer >= 1"),
        (["--config", "nowhere.toml"], "config = 'nowhere.toml': "),
    ],
)
def test_wrong_options_are_one_line_code_2_and_no_folder(tmp_path, monkeypatch, capsys, options, message):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.argv", ["ppo", *SMALL, "--out", "run", *options])
    with pytest.raises(SystemExit) as stop:
        run(ppo.main)
    assert stop.value.code == 2
    said = capsys.readouterr()
    assert said.err.startswith("error: ")
    assert message in said.err
    assert said.err.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


def test_an_existing_folder_is_left_alone(tmp_path, monkeypatch, capsys):
    (tmp_path / "kept").write_text("kept")
    monkeypatch.setattr("sys.argv", ["ppo", *SMALL, "--out", str(tmp_path)])
    with pytest.raises(SystemExit) as stop:
        run(ppo.main)
    assert stop.value.code == 2
    assert "expected a folder that does not exist yet" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["kept"]


@pytest.mark.slow
def test_ctrl_c_in_a_shell_ends_with_code_130(tmp_path):
    folder = tmp_path / "run"
    options = [*SMALL, "--total-steps", "10000000", "--out", str(folder)]
    process = subprocess.Popen(
        [sys.executable, "-m", "train.ppo", *options], cwd=ROOT, stdout=subprocess.PIPE, text=True
    )
    deadline = time.monotonic() + 300
    while not (folder / "metrics.csv").exists() or len(read_rows(folder)) < 3:
        assert process.poll() is None
        assert time.monotonic() < deadline
        time.sleep(0.2)
    process.send_signal(signal.SIGINT)
    said, _ = process.communicate(timeout=60)
    assert process.returncode == 130
    rows = len(read_rows(folder))
    assert checkpoints(folder)[-1] == rows
    assert f"checkpoint of update {rows} in" in " ".join(said.split())
    load_run(folder)
