"""Killed at random moments and resumed, a training ends with the very bits of one that nobody disturbed.

pytest -m slow tests/train/test_kill.py                # 20 kills
KILLS=100 pytest -m slow tests/train/test_kill.py      # as many as wanted
"""

import os
import random
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tests.train.small_run import OPTIONS, assert_same_result, without_clock
from train.checkpoint import updates
from train.saved_run import load_run

pytestmark = pytest.mark.slow

ROOT = Path(__file__).resolve().parents[2]
KILLS = int(os.environ.get("KILLS", "20"))
LIMIT = 600
"""Seconds for one part of a training, compiling included, on a busy machine."""
UPDATES = 1000
SIZES = {**OPTIONS, "total-steps": 32 * UPDATES, "evaluation-episodes": 0, "checkpoint-every": 2}


@pytest.fixture(scope="module")
def start(tmp_path_factory):
    """Starts the command in a process of its own, which finds compiled what an earlier one compiled."""
    settings = {
        "JAX_COMPILATION_CACHE_DIR": str(tmp_path_factory.mktemp("compiled")),
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
        "JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES": "-1",
        "JAX_DISABLE_MOST_OPTIMIZATIONS": "1",
    }

    def command(*arguments):
        return subprocess.Popen(
            [sys.executable, "-m", "train.ppo", *map(str, arguments)],
            cwd=ROOT,
            env={**os.environ, **settings},
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )

    return command


def new(folder, **changes):
    return [*(f"--{name}={value}" for name, value in {**SIZES, **changes}.items()), "--out", folder]


def finish(process):
    """Exit code and output of a process that ends by itself."""
    said, _ = process.communicate(timeout=LIMIT)
    assert "Traceback" not in said
    return process.returncode, said


@pytest.fixture(scope="module")
def whole(start, tmp_path_factory):
    """A training that nobody disturbs, and the seconds from its first row to its last."""
    folder = tmp_path_factory.mktemp("runs") / "whole"
    code, said = finish(start(*new(folder)))
    assert code == 0, said
    return folder, float((folder / "metrics.csv").read_text().splitlines()[-1].split(",")[2])


def test_killed_at_random_moments_and_resumed(start, whole, tmp_path, capsys):
    reference, seconds = whole
    draw = random.Random(KILLS)
    kills, done = 0, []
    while kills < KILLS:
        folder = tmp_path / f"killed-{kills}"
        process = start(*new(folder))
        for kill in range(min(20, KILLS - kills)):
            if kill % 5 == 4:
                time.sleep(draw.uniform(0, 6))  # while it starts
            else:
                wait_for_rows(process, folder)
                time.sleep(draw.uniform(0, seconds / 40))
            process.kill()
            process.communicate(timeout=LIMIT)
            if process.returncode == 0:  # it was quicker
                break
            assert process.returncode == -signal.SIGKILL
            kills += 1
            done.append(updates(folder)[-1] if updates(folder) else 0)
            process = start("--resume", folder) if (folder / "config.json").exists() else start(*new(folder))
        else:
            code, said = finish(process)
            assert code == 0, said
        assert_same_result(folder, reference)
    with capsys.disabled():
        print(f" {kills} kills, after updates {done} of {UPDATES} ", end="")


def wait_for_rows(process, folder):
    """Waits until this process has written a row, or has ended."""
    path = folder / "metrics.csv"
    before, deadline = (path.stat().st_size if path.exists() else 0), time.monotonic() + LIMIT
    # Resuming cuts the file first, so that any change tells.
    while (size := path.stat().st_size if path.exists() else 0) <= before:
        before = min(before, size)
        if process.poll() is not None:
            return
        assert time.monotonic() < deadline
        time.sleep(0.01)


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_signal_ends_with_its_code_and_a_second_one_at_once(start, whole, tmp_path, number, code):
    folder = tmp_path / "run"
    process = start(*new(folder))
    wait_for_rows(process, folder)
    process.send_signal(number)
    assert finish(process)[0] == code
    rows = len(without_clock(folder)) - 1
    assert updates(folder)[-1] == rows
    load_run(folder)
    # Twice while it starts: whatever it is at, it ends, and nothing is lost.
    process = start("--resume", folder)
    wait_for_words(process, "run folder")
    process.send_signal(number)
    time.sleep(0.3)
    process.send_signal(number)
    ended, said = finish(process)
    assert ended == code, said
    assert "stopped" in said
    assert updates(folder)[-1] >= rows
    process = start("--resume", folder)
    assert finish(process)[0] == 0
    assert_same_result(folder, whole[0])


def wait_for_words(process, words):
    """Reads the output until the words come."""
    for line in process.stdout:
        if re.search(words, line):
            return
    raise AssertionError(f"it ended without saying {words!r}")
