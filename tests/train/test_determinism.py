"""The same seed leaves the same bytes in three processes: a training, and an evaluation of what it learned.

pytest -m medium tests/train/test_determinism.py
pytest -m slow tests/train/test_determinism.py      # at default shapes, compiled by each, and evaluated
"""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from tests.train.small_run import OPTIONS, without_clock
from train.checkpoint import updates

ROOT = Path(__file__).resolve().parents[2]
PROCESSES = 3
LIMIT = 600
"""Seconds for a process on a busy machine."""
TRAINING = """
import sys
from train import ppo
assert ppo.main([*sys.argv[1:], "--evaluation-episodes", "0", "--out", "run"]) == 0
"""
EVALUATION = """
from train import evaluate
assert evaluate.main("--run run --policies random index --episodes 4 --out evaluation".split()) == 0
"""
SMALL = [f"--{name}={value}" for name, value in {**OPTIONS, "total-steps": 64, "warm-start": "none"}.items()]
DEFAULT = ["--total-steps", "16384", "--warm-start", "none"]


def start(folder, code, options, settings):
    """A process of its own; sets of words have another order in each."""
    folder.mkdir()
    return subprocess.Popen(
        [sys.executable, "-c", code, *options],
        cwd=folder,
        env={**os.environ, **settings, "PYTHONPATH": str(ROOT), "PYTHONHASHSEED": folder.name},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )


def finish(*running):
    """Waits for the processes."""
    for process in running:
        said, _ = process.communicate(timeout=LIMIT)
        assert process.returncode == 0, said


def left(folder):
    """What a process left, by name: bytes of every array and table, without what the clock says."""
    found = {"metrics.csv": without_clock(folder / "run")}
    arrays = [
        folder / f"run/checkpoints/{max(updates(folder / 'run'))}.npz",
        folder / "evaluation/curves.npz",
    ]
    for file in filter(Path.exists, arrays):
        with np.load(file) as loaded:
            found |= {
                f"{file.name}: {key}": (str(array.dtype), array.tobytes()) for key, array in loaded.items()
            }
    table = folder / "evaluation/episodes.csv"
    return {**found, table.name: table.read_bytes()} if table.exists() else found


def differing(folders):
    """Names of what is not the same in all folders."""
    first, *others = map(left, folders)
    assert len(first) > 50
    assert all(set(other) == set(first) for other in others)
    return [name for name in first if any(other[name] != first[name] for other in others)]


@pytest.mark.medium
def test_the_same_seed_leaves_the_same_bytes(tmp_path):
    """The first process compiles; the others find that and run at the same time."""
    settings = {
        "JAX_COMPILATION_CACHE_DIR": str(tmp_path / "compiled"),
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
        "JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES": "-1",
        "JAX_DISABLE_MOST_OPTIMIZATIONS": "1",
    }
    folders = [tmp_path / str(number) for number in range(PROCESSES)]
    finish(start(folders[0], TRAINING, SMALL, settings))
    finish(*(start(folder, TRAINING, SMALL, settings) for folder in folders[1:]))
    assert differing(folders) == []

    # A single bit is seen, in any array.
    file = next(iter((folders[1] / "run/checkpoints").glob("*.npz")))
    with np.load(file) as loaded:
        arrays = {key: array.copy() for key, array in loaded.items()}
    name = next(key for key, array in arrays.items() if array.dtype == np.float32 and array.ndim)
    arrays[name].view(np.uint8).flat[0] ^= 1
    np.savez(file, **arrays)
    assert differing(folders) == [f"{file.name}: {name}"]


@pytest.mark.slow
def test_the_same_seed_leaves_the_same_bytes_at_full_size(tmp_path):
    folders = [tmp_path / str(number) for number in range(PROCESSES)]
    finish(*(start(folder, TRAINING + EVALUATION, DEFAULT, {}) for folder in folders))
    assert differing(folders) == []
