"""`python -m train.ppo` from the command line to its files: whole, interrupted, resumed, refused."""

import csv
import json
import os
import signal

import jax
import numpy as np
import pytest

from jaxtrack import StaticParams
from jaxtrack.cli import run
from jaxtrack.policies import POLICIES
from tests.train.small_run import OPTIONS, assert_same_result
from train import evaluate, ppo
from train.checkpoint import updates
from train.early_stop import COLUMNS
from train.episode_metrics import METRICS
from train.figures import FIGURES
from train.metrics_file import MetricsFile
from train.saved_run import load_run

pytestmark = pytest.mark.usefixtures("quick_compilation")

BASELINES = {name: POLICIES[name] for name in ("static", "coverage")}
PICTURES = ["learning_curve.png", "episode.gif", *(f"{name}.png" for name in FIGURES)]
SIZES = {**OPTIONS, "total-steps": 100, "evaluation-episodes": 2, "checkpoint-every": 2}
SMALL = [f"--{name}={value}" for name, value in SIZES.items()]


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A whole run: its folder, exit code and what it compiled, for further runs of the same shapes."""
    folder = tmp_path_factory.mktemp("runs") / "new" / "run"
    kept = []
    compile_training = ppo.compile_training

    def compile_and_keep(*arguments):
        kept.append(compile_training(*arguments))
        return kept[-1]

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
    return updates(folder)


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


def test_the_columns_that_can_end_a_training_are_those_of_the_metrics(whole):
    counts = {"update", "env_steps", "seconds", "steps_per_second", "episodes"}
    assert set(read_rows(whole[0])[0]) - counts == set(COLUMNS)


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


@pytest.fixture
def go(whole, monkeypatch):
    """Runs the command on what the whole run compiled; gives the exit code."""

    def command(*arguments, step=whole[2].step):
        with monkeypatch.context() as patch:
            patch.setattr(ppo, "compile_training", lambda *_: whole[2]._replace(step=step))
            return ppo.main(list(map(str, arguments)))

    return command


@pytest.fixture
def start(go):
    """A new run in a folder, without evaluation."""
    return lambda folder, *more, **named: go(
        *SMALL, "--evaluation-episodes", 0, "--out", folder, *more, **named
    )


@pytest.fixture
def stop_at(monkeypatch):
    """Sends the process a signal when it has written the row of an update."""

    def plan(update, number=signal.SIGINT, write=MetricsFile.write):
        def write_and_stop(self, row):
            write(self, row)
            if row["update"] == update:
                os.kill(os.getpid(), number)

        monkeypatch.setattr(MetricsFile, "write", write_and_stop)

    return plan


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_the_first_signal_finishes_the_update_and_writes_a_checkpoint(
    start, stop_at, tmp_path, capsys, number, code
):
    before = signal.getsignal(signal.SIGINT)
    stop_at(1, number)
    folder = tmp_path / "run"
    assert start(folder) == code
    assert len(read_rows(folder)) == 1
    assert checkpoints(folder) == [1]
    load_run(folder)
    said = " ".join(capsys.readouterr().out.split())
    assert "stopped after 1 updates; checkpoint of update 1 in" in said
    assert f"continue with: python -m train.ppo --resume {folder}" in said
    assert "python -m train.evaluate --run" in said
    assert signal.getsignal(signal.SIGINT) is before


def test_a_resumed_training_ends_as_if_it_had_never_stopped(whole, start, go, stop_at, tmp_path, capsys):
    folder = tmp_path / "run"
    stop_at(1)
    assert start(folder) == 130
    stop_at(2)
    assert go("--resume", folder) == 130
    rows = (folder / "metrics.csv").read_text()
    # What a kill leaves behind: rows after the checkpoint, the last one cut short.
    (folder / "metrics.csv").write_text(rows + rows.splitlines()[-1] + "\r\n3,96,0.")
    assert go("--resume", folder) == 0
    assert_same_result(folder, whole[0])
    assert f"{folder}: using the checkpoint of update 2" in capsys.readouterr().out
    seconds = [float(row["seconds"]) for row in read_rows(folder)]
    assert seconds == sorted(seconds)


def test_a_training_without_a_checkpoint_starts_anew(whole, start, go, tmp_path, capsys):
    folder = tmp_path / "run"
    with pytest.raises(SystemExit):
        start(folder, step=stopping(whole[2].step, at=1))
    assert checkpoints(folder) == []
    assert len(read_rows(folder)) == 1
    assert go("--resume", folder) == 0
    assert "no checkpoint yet, starting at update 0" in capsys.readouterr().out
    assert_same_result(folder, whole[0])


def stopping(step, at):
    """A training step that ends the process after some updates, as a kill would."""

    def step_or_stop(state):
        if int(state.update) == at:
            raise SystemExit
        return step(state)

    return step_or_stop


def test_a_finished_training_says_so(whole, go, capsys):
    before = {path: path.read_bytes() for path in whole[0].iterdir() if path.is_file()}
    assert go("--resume", whole[0]) == 0
    assert "the training had finished, nothing is left to do" in capsys.readouterr().out
    assert {path: path.read_bytes() for path in whole[0].iterdir() if path.is_file()} == before


def test_a_training_that_was_stopped_in_its_evaluation_is_evaluated(whole, start, go, tmp_path, monkeypatch):
    folder, called = tmp_path / "run", []
    assert start(folder) == 0
    monkeypatch.setattr(ppo, "finish", lambda state, env, run, console: called.append((state, run)))
    assert go("--resume", folder) == 0
    assert called == []
    assert go("--resume", folder, "--evaluation-episodes", 3) == 0
    ((state, run),) = called
    assert int(state.update) == 3
    assert run.evaluation_episodes == 3


def test_a_stopped_evaluation_says_how_to_continue(start, go, tmp_path, monkeypatch, capsys):
    def stopped(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(ppo, "finish", stopped)
    folder = tmp_path / "run"
    assert go(*SMALL, "--out", folder) == 130
    assert capsys.readouterr().err == f"interrupted; continue with: python -m train.ppo --resume {folder}\n"


def test_a_training_that_diverges_says_so_and_keeps_the_last_good_checkpoint(whole, start, tmp_path, capsys):
    def diverging(state):
        after, metrics = whole[2].step(state)
        return after, {**metrics, "value_loss": np.where(after.update == 3, np.nan, metrics["value_loss"])}

    folder = tmp_path / "run"
    assert start(folder, step=diverging) == 1
    said = " ".join(capsys.readouterr().out.split())
    assert "training diverged: value_loss is nan after update 3" in said
    assert "checkpoint of update 2 in" in said
    assert checkpoints(folder) == [2]


def test_without_a_checkpoint_there_is_nothing_to_evaluate(whole, start, tmp_path, capsys):
    def diverging(state):
        after, metrics = whole[2].step(state)
        return after, {**metrics, "value_loss": np.float32(np.nan)}

    folder = tmp_path / "run"
    assert start(folder, step=diverging) == 1
    said = " ".join(capsys.readouterr().out.split())
    assert "stopped after 1 updates; no checkpoint yet in" in said
    assert "nothing to evaluate" in said
    assert "train.evaluate" not in said
    assert checkpoints(folder) == []


def test_the_same_seed_gives_the_same_numbers(whole, start, tmp_path):
    assert start(tmp_path / "run") == 0
    assert_same_result(tmp_path / "run", whole[0])


def test_a_seed_among_several_ends_as_it_does_alone(whole, start, tmp_path):
    assert start(tmp_path / "several", "--seeds", 2) == 0
    assert_same_result(tmp_path / "several/seed0", whole[0])
    assert start(tmp_path / "alone", "--seed", 1) == 0
    assert_same_result(tmp_path / "several/seed1", tmp_path / "alone")
    assert read_rows(tmp_path / "alone")[0]["reward"] != read_rows(whole[0])[0]["reward"]


@pytest.mark.slow
def test_several_seeds_are_compiled_once_and_compared_once(whole, tmp_path, capsys):
    """With a program of their own: that of the first seed serves the second."""
    folder = tmp_path / "runs"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(evaluate, "POLICIES", BASELINES)
        assert ppo.main([*SMALL, "--seed", "1", "--seeds", "2", "--out", str(folder)]) == 0
        assert ppo.main([*SMALL, "--seed", "2", "--out", str(tmp_path / "alone")]) == 0
        assert ppo.main(["--resume", str(folder)]) == 0
        assert evaluate.main(["--run", str(folder), "--episodes", "2", "--out", str(tmp_path / "again")]) == 0
    said = capsys.readouterr().out
    assert said.count("compiled in") == 2 + 3  # by two trainings and three comparisons
    assert "nothing is left to do" in said
    assert_same_result(folder / "seed2", tmp_path / "alone")
    assert all((folder / name).stat().st_size > 1000 for name in PICTURES if name != "learning_curve.png")
    assert sorted(path.name for path in (folder / "seed2").iterdir()) == [
        "checkpoints",
        "config.json",
        "learning_curve.png",
        "metrics.csv",
    ]
    results, again = (
        json.loads((each / "results.json").read_text()) for each in (folder, tmp_path / "again")
    )
    assert results["policies"]["beams"]["training_seeds"] == [1, 2]
    gospa = [each["policies"]["beams"]["metrics"]["gospa"]["by_training_seed"] for each in (results, again)]
    np.testing.assert_allclose(*gospa, rtol=1e-4)


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
        (["--static.num-truths", "0"], "num_truths = 0: expected an integer in [1, 10000]"),
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
