"""A run's folder: what resumes and what is refused, a full disk, a folder that vanished, two trainings."""

import contextlib
import errno
import json
import os
import resource
import shutil

import jax
import jax.numpy as jnp
import pytest

from jaxtrack.cli import run
from tests.train.small_run import (
    CONFIG,
    assert_same,
    assert_same_result,
    random_state,
    step,
    without_clock,
    write_run,
)
from train import ppo, run_folder
from train.checkpoint import load_newest, updates
from train.config import to_dict
from train.loop import Programs
from train.metrics_file import MetricsFile
from train.run_folder import resume_run


@pytest.fixture(scope="module")
def state():
    """The made-up training's start."""
    return random_state().replace(update=jnp.asarray(0))


@pytest.fixture
def train(state, tmp_path, monkeypatch, capsys):
    """The command with a made-up training: gives exit code, output and errors."""
    (tmp_path / "config.json").write_text(json.dumps(to_dict(CONFIG)))

    def command(*arguments, step=step):
        with monkeypatch.context() as patch:
            patch.setattr(ppo, "compile_training", lambda *_: Programs(lambda *_: state, step))
            patch.setattr("sys.argv", ["ppo", *map(str, arguments)])
            with pytest.raises(SystemExit) as stop:
                run(ppo.main)
        said = capsys.readouterr()
        assert "Traceback" not in said.err
        return stop.value.code, " ".join(said.out.split()), said.err

    command.start = lambda folder, **named: command(
        "--config", tmp_path / "config.json", "--out", folder, **named
    )
    return command


def stopping(at):
    """A training that ends the process in an update, as a kill would."""

    def stop(state):
        if int(state.update) == at - 1:
            raise SystemExit(9)
        return step(state)

    return stop


@pytest.fixture
def whole(train, tmp_path):
    """A run that nothing disturbed."""
    folder = tmp_path / "whole"
    assert train.start(folder)[0] == 0
    assert updates(folder) == [8, 10]
    return folder


@pytest.fixture
def stopped(train, tmp_path):
    """A run that was killed in its sixth update, after a checkpoint of the fourth."""
    folder = tmp_path / "run"
    assert train.start(folder, step=stopping(6))[0] == 9
    assert updates(folder) == [2, 4]
    return folder


@pytest.mark.parametrize("at", range(1, 11))
def test_killed_in_any_update_it_ends_as_if_it_had_not_been(train, whole, tmp_path, at):
    folder = tmp_path / "run"
    assert train.start(folder, step=stopping(at))[0] == 9
    assert train("--resume", folder)[0] == 0
    assert_same_result(folder, whole)


def test_seconds_go_on_where_they_stood(train, stopped):
    with open(stopped / "metrics.csv") as file:
        rows = file.read().splitlines()
    cells = rows[4].split(",")
    cells[2] = "1000"
    (stopped / "metrics.csv").write_text("\n".join([*rows[:4], ",".join(cells), *rows[5:]]) + "\n")
    train("--resume", stopped)
    after = [line.split(",") for line in (stopped / "metrics.csv").read_text().splitlines()]
    assert after[0][:4] == ["update", "env_steps", "seconds", "steps_per_second"]
    assert 1000 < float(after[5][2]) < 1100
    assert float(after[5][3]) == pytest.approx(20 / float(after[5][2]))


def test_the_damaged_newest_checkpoint_is_named_and_the_one_before_used(train, whole, stopped):
    path = stopped / "checkpoints" / "4.npz"
    path.write_bytes(path.read_bytes()[:1000])
    code, said, _ = train("--resume", stopped)
    assert code == 0
    assert "the checkpoint of update 4 is damaged (4.npz has 1000 bytes, its seal says" in said
    assert f"{stopped}: using the checkpoint of update 2" in said
    assert_same_result(stopped, whole)


def test_without_an_intact_checkpoint_nothing_is_touched(train, stopped):
    for path in (stopped / "checkpoints").glob("*.npz"):
        path.write_bytes(b"nonsense")
    before = files(stopped)
    code, _, error = train("--resume", stopped)
    assert code == 2
    assert error == f"error: run = '{stopped}': none of its checkpoints is intact (updates [2, 4])\n"
    assert files(stopped) == before


def test_when_the_checkpoints_are_gone_the_metrics_stay(train, stopped):
    shutil.rmtree(stopped / "checkpoints")
    before = files(stopped)
    code, _, error = train("--resume", stopped)
    assert code == 2
    assert error == f"error: resume = '{stopped}': its checkpoints are gone, metrics.csv is not\n"
    assert files(stopped) == before


def files(folder):
    """Contents of all files."""
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.parametrize(
    "damage",
    [
        lambda rows: rows[:3],
        lambda rows: [*rows[:2], *rows[3:]],
        lambda rows: [*rows[:2], rows[2][:-5] + "7" + rows[2][-4:], *rows[3:]],
        lambda rows: [rows[0].replace("reward", "rewards"), *rows[1:]],
        lambda rows: [rows[0].replace("update", "updates"), *rows[1:]],
        lambda rows: [*rows[:4], rows[4].partition(",")[0], *rows[5:]],
        lambda rows: ["", *rows],
    ],
)
def test_damaged_metrics_are_refused_until_moved_away(train, stopped, damage):
    path = stopped / "metrics.csv"
    path.write_text("\n".join(damage(path.read_text().splitlines())) + "\n")
    before = files(stopped)
    code, _, error = train("--resume", stopped)
    assert code == 2
    assert error == (
        f"error: {path}: rows up to update 4 are missing or damaged; move the file away to continue "
        "without them\n"
    )
    assert files(stopped) == before
    path.unlink()
    code, said, _ = train("--resume", stopped, step=stopping(8))
    assert f"{path}: begins after update 4, earlier rows are lost" in said
    code, said, _ = train("--resume", stopped)
    assert code == 0
    assert f"{path}: begins after update 4, earlier rows are lost" in said
    assert [row[0] for row in without_clock(stopped)] == ["update", "5", "6", "7", "8", "9", "10"]
    assert float(path.read_text().splitlines()[-1].split(",")[3]) < 4 * 6 / 1e-6


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--seed", 6], "seed = 6: expected 5 as in the run"),
        (["--total-steps", 80], "total_steps = 80: expected 40 as in the run"),
        (["--checkpoint-every", 1], "checkpoint_every = 1: expected 2 as in the run"),
        (["--microbatch", 2], "microbatch = 2: expected 4 as in the run"),
        (["--out", "elsewhere"], "out = 'elsewhere': expected '"),
        (["--params.range-sigma", 6], "params.range_sigma = 6.0: expected 5.0 as in the run"),
        (["--static.map-size", 7], "static.map_size = 7: expected 6 as in the run"),
        (["--nonsense", 7], "--nonsense"),
    ],
)
def test_options_that_would_change_the_run_are_refused(train, stopped, options, message):
    before = files(stopped)
    code, _, error = train("--resume", stopped, *options)
    assert code == 2
    assert message in error
    assert error.count("\n") == 1
    assert files(stopped) == before


def test_options_that_change_nothing_are_taken(train, stopped, monkeypatch):
    finished = []
    monkeypatch.setattr(ppo, "finish", lambda state, env, run, console: finished.append(run))
    assert train("--resume", stopped, "--seed", 5, "--evaluation-episodes", 7)[0] == 0
    assert finished[0].evaluation_episodes == 7
    # The run is still what config.json says.
    assert load_newest(stopped).config == json.loads((stopped / "config.json").read_text())


def test_a_config_file_beside_resume_is_refused(train, stopped, tmp_path):
    code, _, error = train("--resume", stopped, "--config", tmp_path / "config.json")
    assert (code, error) == (2, "error: config: expected none beside --resume, which takes the run's own\n")


@pytest.mark.parametrize("exists", [True, False])
def test_what_is_no_run_is_refused(train, tmp_path, exists):
    folder = tmp_path / "none"
    if exists:
        folder.mkdir()
    code, _, error = train("--resume", folder)
    assert (code, error) == (2, f"error: run = '{folder}': expected a folder with a config.json\n")
    assert folder.exists() == exists
    assert not exists or list(folder.iterdir()) == []


def test_what_changed_since_the_checkpoint_is_said(train, whole, stopped, monkeypatch):
    now = {**run_folder.written_with(), "cores": 64, "jax": "99.0"}
    before = run_folder.written_with()
    monkeypatch.setattr(run_folder, "written_with", lambda: now)
    code, said, _ = train("--resume", stopped)
    assert code == 0
    assert f"cores was {before['cores']}, is 64: results may differ in rounding from now on" in said
    assert f"jax was {before['jax']}, is 99.0: results may differ in rounding" in said
    assert said.count("results may differ") == 2


def test_nothing_is_said_where_nothing_changed(train, stopped):
    assert "results may differ" not in train("--resume", stopped)[1]


def test_a_run_from_before_an_option_existed_goes_on(train, whole, stopped):
    path = stopped / "config.json"
    values = json.loads(path.read_text())
    del values["randomise"], values["params"]["track_weight"]
    path.write_text(json.dumps(values))
    code, _, said = train("--resume", stopped)
    assert (code, said) == (0, "")
    assert_same_result(stopped, whole)


@pytest.fixture
def start_with(train, tmp_path):
    """Starts the made-up training with more options, without a warm start unless they tell."""
    options = ("--config", tmp_path / "config.json", "--warm-start-steps", 0)
    return lambda folder, *more, **named: train(*options, "--out", folder, *more, **named)


def completeness(folder):
    """That column of metrics.csv."""
    columns, *rows = without_clock(folder)
    return [float(row[columns.index("completeness")]) for row in rows]


def threshold_after(folder, update):
    """A completeness that the made-up training, whose metrics grow, passes in the update after this one."""
    before, after = completeness(folder)[update - 1 : update + 1]
    assert before < after
    return (before + after) / 2


def test_a_passed_threshold_ends_the_training_as_its_end_does(
    train, whole, start_with, tmp_path, monkeypatch
):
    folder, called = tmp_path / "short", []
    threshold = threshold_after(whole, 4)
    code, said, _ = start_with(folder, "--stop-above", f"completeness={threshold}")
    assert code == 0
    assert f"ended after update 5: completeness = {completeness(whole)[4]:.8g} is above" in said
    assert "stopped" not in said
    assert without_clock(folder) == without_clock(whole)[: 1 + 5]
    assert updates(folder) == [4, 5]
    code, said, _ = train("--resume", folder)
    assert "the training had finished, nothing is left to do" in said
    assert updates(folder) == [4, 5]
    monkeypatch.setattr(ppo, "finish", lambda state, env, run, console: called.append(int(state.update)))
    assert train("--resume", folder, "--evaluation-episodes", 3)[0] == 0
    assert called == [5]


def test_killed_before_the_checkpoint_of_its_last_update_it_ends_there_again(
    train, whole, start_with, tmp_path, monkeypatch
):
    folder, short = tmp_path / "killed", tmp_path / "short"
    option = ("--stop-above", f"completeness={threshold_after(whole, 4)}")
    assert start_with(short, *option)[0] == 0

    def killed(*_):
        raise SystemExit(9)

    with monkeypatch.context() as patch:
        patch.setattr(run_folder.Run, "save", killed)
        assert start_with(folder, *option)[0] == 9
    assert len(completeness(folder)) == 2
    with monkeypatch.context() as patch:
        save = run_folder.Run.save
        patch.setattr(run_folder.Run, "save", lambda *now: killed() if now[1].update == 5 else save(*now))
        assert train("--resume", folder)[0] == 9
    assert len(completeness(folder)) == 5
    assert updates(folder) == [2, 4]
    assert train("--resume", folder)[0] == 0
    assert_same_result(folder, short)


def test_thresholds_count_after_the_warm_start(whole, start_with, tmp_path):
    threshold = threshold_after(whole, 4)
    option = ("--stop-above", f"completeness={threshold}", "--warm-start-steps", 7 * CONFIG.batch_size)
    assert start_with(tmp_path / "late", *option)[0] == 0
    assert len(completeness(tmp_path / "late")) == 8
    option = ("--stop-below", f"completeness={threshold}", "--warm-start-steps", 2 * CONFIG.batch_size)
    assert start_with(tmp_path / "below", *option)[0] == 0
    assert len(completeness(tmp_path / "below")) == 3


def test_two_trainings_in_one_folder(train, stopped):
    before = files(stopped)
    with MetricsFile(stopped):
        code, _, error = train("--resume", stopped)
    assert code == 1
    assert "another training is writing into this folder" in error
    assert str(stopped) in error
    assert error.count("\n") == 1
    assert files(stopped) == before
    assert train("--resume", stopped)[0] == 0


@contextlib.contextmanager
def full_disk(free):
    """No file grows beyond `free` bytes, as if the disk were full; by the kernel, not by a pretence."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (free, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def test_a_full_disk_loses_nothing(train, whole, stopped):
    with full_disk(20_000):
        code, _, error = train("--resume", stopped)
    assert code == 1
    assert f"'{stopped}/checkpoints/6.npz'; continue with: python -m train.ppo --resume {stopped}" in error
    assert error.count("\n") == 1
    assert sorted(os.listdir(stopped / "checkpoints")) == ["2.json", "2.npz", "4.json", "4.npz"]
    assert train("--resume", stopped)[0] == 0
    assert_same_result(stopped, whole)


def test_a_full_disk_for_the_metrics_loses_nothing(train, whole, stopped):
    with full_disk((stopped / "metrics.csv").stat().st_size + 20):
        code, _, error = train("--resume", stopped)
    assert code == 1
    assert f"'{stopped}/metrics.csv'; continue with" in error
    assert train("--resume", stopped)[0] == 0
    assert_same_result(stopped, whole)


def test_a_folder_that_vanishes(train, stopped):
    def vanish(state):
        shutil.rmtree(stopped, ignore_errors=True)
        return step(state)

    code, _, error = train("--resume", stopped, step=vanish)
    assert code == 1
    assert "No such file or directory" in error
    assert str(stopped) in error
    assert error.count("\n") == 1


@pytest.mark.parametrize("number", [errno.EROFS, errno.EACCES, errno.ENOSPC, errno.EIO])
@pytest.mark.parametrize("call", ["mkdir", "replace", "fsync"])
def test_a_folder_that_can_not_be_written(train, stopped, tmp_path, monkeypatch, number, call):
    def refuse(*_, **__):
        raise OSError(number, os.strerror(number), "somewhere")

    before = files(stopped)
    monkeypatch.setattr(os, call, refuse)
    arguments = ["--resume", stopped], ["--config", tmp_path / "config.json", "--out", tmp_path / "new"]
    for command in arguments[call == "mkdir" :]:
        code, _, error = train(*command)
        assert code == 1
        assert os.strerror(number) in error
        assert error.count("\n") == 1
    assert {path: data for path, data in files(stopped).items() if path.name != "metrics.csv"} == {
        path: data for path, data in before.items() if path.name != "metrics.csv"
    }


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
def test_a_read_only_folder(train, stopped):
    before = files(stopped)
    (stopped / "checkpoints").chmod(0o500)
    code, _, error = train("--resume", stopped)
    (stopped / "checkpoints").chmod(0o700)
    assert code == 1
    assert "Permission denied" in error
    assert {path for path in before if path.parent.name == "checkpoints"} <= set(files(stopped))


def test_a_resumed_run_begins_at_its_checkpoint(state, tmp_path):
    write_run(tmp_path, state, written=(6, 8))
    with resume_run(tmp_path, 3) as resumed:
        assert resumed.done == 8
        assert (resumed.trained, resumed.finished) == (False, False)
        assert resumed.evaluation_episodes == 3
        assert resumed.metrics.lost == 8
        expected = jax.tree.map(lambda leaf: leaf + 8, state.weights)
        assert_same(resumed.state.weights, expected)
