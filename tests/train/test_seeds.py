"""Several seeds in one command: each as if it were alone, resumed together, compared at the end."""

import contextlib
import io
import json
import os
import shutil
import signal

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from rich.console import Console

from jaxtrack.cli import LARGEST_SEED, run
from tests.train.small_run import CONFIG, assert_same, random_state, step, without_clock
from train import ppo
from train.checkpoint import load_newest, updates
from train.config import to_dict
from train.display import TrainingBar
from train.loop import Programs
from train.metrics_file import MetricsFile
from train.seeds import SEEDS, read_seeds, run_folders

BEGINNING = random_state().replace(update=jnp.asarray(0))
UPDATES = 10


def init(key, params):
    """A start that depends on the seed."""
    draw = lambda leaf: leaf + jax.random.uniform(key)  # noqa: E731
    return BEGINNING.replace(weights=jax.tree.map(draw, BEGINNING.weights))


class Command:
    """The command with a made-up training, in a folder of its own; keeps what was compiled and evaluated."""

    def __init__(self, folder):
        self.folder = folder
        self.compiled, self.evaluated, self.steps = 0, [], 0

    def __call__(self, *arguments, step=step):
        """Exit code, output and errors."""

        def count(state):
            self.steps += 1
            return step(state)

        def compile_nothing(*_):
            self.compiled += 1
            return Programs(init, count)

        def evaluate(weights, env, trained, folders, console):
            self.evaluated.append((weights, trained, folders))

        self.folder.mkdir(exist_ok=True)
        out, err = io.StringIO(), io.StringIO()
        said = contextlib.redirect_stdout(out), contextlib.redirect_stderr(err)
        with pytest.MonkeyPatch.context() as patch, said[0], said[1]:
            patch.chdir(self.folder)
            patch.setattr(ppo, "compile_training", compile_nothing)
            patch.setattr(ppo, "evaluate_agent", evaluate)
            patch.setattr("sys.argv", ["ppo", *map(str, arguments)])
            with pytest.raises(SystemExit) as stop:
                run(ppo.main)
        assert "Traceback" not in err.getvalue()
        return stop.value.code, " ".join(out.getvalue().split()), err.getvalue()


START = ("--config", "../config.json", "--out", "runs")


def write_configuration(folder):
    """The configuration file that all commands take, beside their folders."""
    (folder / "config.json").write_text(json.dumps({**to_dict(CONFIG), "evaluation_episodes": 7}))


@pytest.fixture
def command(tmp_path):
    """Commands, each in a folder of its own."""
    write_configuration(tmp_path)
    return lambda name: Command(tmp_path / name)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """Seeds 5 to 7 that nothing disturbed; not to be written to."""
    folder = tmp_path_factory.mktemp("seeds")
    write_configuration(folder)
    train = Command(folder / "whole")
    assert train(*START, "--seeds", 3)[0] == 0
    return train


@pytest.fixture
def copied(whole, command):
    """The same in a folder that may be written to."""
    train = command("copied")
    shutil.copytree(whole.folder, train.folder)
    return train


def contents(folder):
    """Bytes of all files by name, without the clock's columns."""
    files = {
        str(path.relative_to(folder)): path.read_bytes()
        for path in folder.rglob("*")
        if path.is_file() and path.name != "metrics.csv"
    }
    return {**files, "metrics.csv": without_clock(folder)}


def test_the_folder_of_a_seed_is_that_of_a_run_alone(whole, command):
    assert whole.compiled == 1
    assert sorted(os.listdir(whole.folder / "runs")) == ["seed5", "seed6", "seed7", SEEDS]
    for seed in (5, 7):
        alone = command(f"alone{seed}")
        code, _, _ = alone("--config", "../config.json", "--seed", seed, "--out", f"runs/seed{seed}")
        assert code == 0
        ours, own = (contents(each.folder / f"runs/seed{seed}") for each in (whole, alone))
        assert len(own) == 6
        assert ours == own


def test_all_seeds_are_evaluated_together_at_the_end(whole):
    ((weights, trained, folders),) = whole.evaluated
    assert list(weights) == [5, 6, 7]
    assert (trained.folder.name, trained.evaluation_episodes) == ("runs", 7)
    for folder, own in zip(folders, weights.values(), strict=True):
        saved = load_newest(whole.folder / folder, print).arrays
        leaf = jax.tree.leaves(own)[0]
        assert any(np.array_equal(leaf, array) for array in saved.values())
    assert not np.array_equal(*(jax.tree.leaves(weights[seed])[0] for seed in (5, 6)))


def at_step(number, act):
    """A training that does something in one of its updates, counted over all seeds."""
    done = []

    def step_or_act(state):
        done.append(0)
        return act(state) if len(done) == number else step(state)

    return step_or_act


def killed(state):
    raise SystemExit(9)


def assert_same_runs(one, other):
    """All folders of two commands, but for what follows the training."""
    for seed in (5, 6, 7):
        a, b = (each.folder / f"runs/seed{seed}" for each in (one, other))
        assert_same(load_newest(a, print).arrays, load_newest(b, print).arrays)
        assert without_clock(a) == without_clock(b)
        assert (a / "config.json").read_bytes() == (b / "config.json").read_bytes()


@pytest.mark.parametrize("number", [1, 10, 15])
def test_killed_and_resumed_they_end_as_if_they_had_not_been(whole, command, number):
    train = command("killed")
    assert train(*START, "--seeds", 3, step=at_step(number, killed))[0] == 9
    assert train.evaluated == []
    done = train.steps - 1
    assert train("--resume", "runs", "--evaluation-episodes", 9)[0] == 0
    assert_same_runs(train, whole)
    # What has a checkpoint (every second update, and the last) is not trained again.
    assert train.steps == done + 1 + 3 * UPDATES - (done // UPDATES * UPDATES + done % UPDATES // 2 * 2)
    ((weights, trained, _),) = train.evaluated
    assert (list(weights), trained.evaluation_episodes) == ([5, 6, 7], 9)


@pytest.mark.parametrize(("number", "code", "at"), [(signal.SIGINT, 130, 13), (signal.SIGTERM, 143, 20)])
def test_a_signal_leaves_checkpoints_and_says_how_to_go_on(whole, command, monkeypatch, number, code, at):
    train, write, rows = command("stopped"), MetricsFile.write, []

    def write_and_stop(self, row):
        write(self, row)
        rows.append(row)
        if len(rows) == at:
            os.kill(os.getpid(), number)

    with monkeypatch.context() as patch:
        patch.setattr(MetricsFile, "write", write_and_stop)
        ended, said, _ = train(*START, "--seeds", 3)
    assert ended == code
    assert said.count("continue with: python -m train.ppo --resume runs ") == 1
    assert f"stopped after {at - UPDATES} updates" in said
    assert train.evaluated == []
    assert updates(train.folder / "runs/seed5") == [8, 10]
    assert updates(train.folder / "runs/seed6")[-1] == at - UPDATES
    assert not (train.folder / "runs/seed7").exists()
    assert train("--resume", "runs")[0] == 0
    assert train.compiled == 2
    assert_same_runs(train, whole)


def test_one_of_them_can_be_resumed_alone(whole, command):
    train = command("alone")
    train(*START, "--seeds", 3, step=at_step(15, killed))
    assert train("--resume", "runs/seed6", "--seeds", 1, "--seed", 6)[0] == 0
    ((weights, trained, _),) = train.evaluated
    assert (list(weights), trained.folder.name) == ([6], "seed6")
    assert train("--resume", "runs")[0] == 0
    assert_same_runs(train, whole)


def test_when_one_diverges_the_others_are_trained_and_nothing_is_compared(command):
    def diverge(state):
        after, metrics = step(state)
        return after, {**metrics, "value_loss": jnp.nan}

    train = command("lost")
    code, said, _ = train(*START, "--seeds", 3, step=at_step(15, diverge))
    assert code == 1
    assert "training diverged: value_loss is nan after update 5" in said
    assert "missing: seed 6 " in said
    assert "train.evaluate --runs runs/seed5 runs/seed7" in said
    assert train.evaluated == []
    assert [updates(train.folder / f"runs/seed{seed}")[-1] for seed in (5, 6, 7)] == [10, 4, 10]


def test_finished_ones_say_so(copied):
    assert copied("--resume", "runs")[0] == 0  # trained, but the comparison left nothing
    assert len(copied.evaluated) == 1
    code, said, _ = copied("--resume", "runs", "--evaluation-episodes", 0)
    assert (code, len(copied.evaluated)) == (0, 1)
    assert "the training had finished, nothing is left to do" in said
    (copied.folder / "runs/results.json").write_text("{}")
    assert "the training had finished, nothing is left to do" in copied("--resume", "runs")[1]
    assert (copied.compiled, copied.steps, len(copied.evaluated)) == (0, 0, 1)


def test_the_folder_may_move(whole, copied):
    runs, elsewhere = copied.folder / "runs", copied.folder / "elsewhere"
    runs.rename(elsewhere)
    shutil.rmtree(elsewhere / "seed7")
    assert copied("--resume", "elsewhere")[0] == 0
    assert copied.steps == UPDATES
    saved = [load_newest(each / "seed7", print).arrays for each in (elsewhere, whole.folder / "runs")]
    assert_same(*saved)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--seeds", 0], "seeds = 0: expected an integer in [1, "),
        (["--seeds", -2], "seeds = -2: expected an integer in [1, "),
        (["--seeds", 3, "--seed", LARGEST_SEED - 1], "seeds = 3: expected an integer in [1, 2]"),
        (["--seeds", "many"], "--seeds"),
        (["--seeds", 2, "--gamma", 2], "gamma = 2.0: expected a number in [0, 1]"),
        (["--seeds", 2, "--out", "."], "out = '.': expected a folder that does not exist yet"),
    ],
)
def test_wrong_numbers_are_refused_before_anything_is_written(command, options, message):
    train = command("refused")
    code, _, error = train(*START, *options)
    assert code == 2
    assert message in error
    assert error.count("\n") == 1
    assert list(train.folder.iterdir()) == []


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--seeds", 4], "seeds = 4: expected 3 as in the run"),
        (["--seed", 6], "seed = 6: expected 5 as in the run"),
        (["--gamma", 0.9], "gamma = 0.9: expected 0.995 as in the run"),
        (["--config", "../config.json"], "config: expected none beside --resume"),
    ],
)
def test_options_that_would_change_them_are_refused(whole, options, message):
    code, _, error = whole("--resume", "runs", *options)
    assert code == 2
    assert message in error


def test_a_single_run_is_not_resumed_as_several(command):
    train = command("single")
    assert train(*START)[0] == 0
    assert train("--resume", "runs", "--seeds", 2)[2] == "error: seeds = 2: expected 1 as in the run\n"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{", "seeds.json: "),
        ("[]", "seeds.json: expected a table of fields"),
        ('{"seeds": true, "config": {}}', "seeds.json: seeds = True: expected an integer"),
        ('{"seeds": 0, "config": {}}', "seeds.json: seeds = 0: expected an integer in [1, "),
        ('{"seeds": 2, "config": {"gamma": 3}}', "seeds.json: gamma = 3: expected a number in [0, 1]"),
        ('{"seeds": 2, "config": {"gammas": 1}}', "seeds.json: gammas: no such field"),
        (
            '{"seeds": 3, "config": {"seed": 5}}',
            "config.json: checkpoint_every = 2, but runs/seeds.json says 20",
        ),
    ],
)
def test_a_damaged_folder_is_named(copied, text, message):
    (copied.folder / "runs" / SEEDS).write_text(text)
    code, _, error = copied("--resume", "runs")
    assert code == 2
    assert message in error
    assert error.count("\n") == 1


def test_two_trainings_in_one_folder(copied):
    with MetricsFile(copied.folder / "runs/seed5"):
        code, _, error = copied("--resume", "runs")
    assert code == 1
    assert "another training is writing into this folder" in error
    assert error.endswith("; continue with: python -m train.ppo --resume runs\n")


def test_a_comparison_takes_their_folder_for_its_runs(whole):
    runs = whole.folder / "runs"
    assert run_folders(runs) == [runs / "seed5", runs / "seed6", runs / "seed7"]
    assert run_folders(runs / "seed5") == [runs / "seed5"]
    assert read_seeds(runs).seeds == range(5, 8)


def test_one_bar_shows_all_of_them():
    console = Console(file=io.StringIO(), force_terminal=True)
    row = {"env_steps": 20.0, "steps_per_second": 5.0, "episode_return": 1.0}
    row |= {"completeness": 0.5, "covariance_norm_mean": 7.0}
    with TrainingBar(CONFIG, console, 3) as bar:
        bar.begin("second", place=1, done=2)
        (task,) = bar._progress.tasks
        assert (task.completed, task.total, task.description) == (48, 120, "second")
        bar.tell(5, row)
        assert task.completed == 60
        bar.begin("third", place=2)
        assert (task.completed, task.description) == (80, "third")
    lines = io.StringIO()
    with TrainingBar(CONFIG, Console(file=lines), 3) as bar:
        bar.begin("second", place=1)
        bar.tell(5, row)
    assert "time left 12 s" in lines.getvalue().replace("\n", " ")
