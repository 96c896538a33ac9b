"""Checkpoints of a run, by orbax: the whole learner state, the last two kept.

Nothing is unpickled: orbax writes arrays and JSON.
"""

import json
import logging
from pathlib import Path
from typing import Any

import jax
import orbax.checkpoint as ocp

from jaxtrack.env import SearchTrack, make
from train.config import TrainConfig, from_dict, to_dict
from train.learner import LearnerState, init_learner

KEPT = 2
logging.getLogger("absl").setLevel(logging.ERROR)


def open_manager(folder: Path) -> ocp.CheckpointManager:
    """Manager of the checkpoints below a run's folder."""
    options = ocp.CheckpointManagerOptions(max_to_keep=KEPT, create=True)
    return ocp.CheckpointManager((folder / "checkpoints").absolute(), options=options)


def save(manager: ocp.CheckpointManager, state: LearnerState) -> None:
    """Writes the learner state under its number of updates, whole or not at all."""
    update = int(state.update)
    if manager.latest_step() != update:
        manager.save(update, args=ocp.args.StandardSave(state))
        manager.wait_until_finished()


def write_config(folder: Path, config: TrainConfig) -> None:
    """Writes the run's configuration as config.json."""
    (folder / "config.json").write_text(json.dumps(to_dict(config), indent=2) + "\n")


def load_run(folder: Path) -> tuple[TrainConfig, SearchTrack, Any]:
    """Configuration, environment and latest weights of a run.

    Raises:
        ValueError: naming the folder, if it holds no readable run.
    """
    config = _read_run_config(folder)
    env, params = make(config.params, config.static)
    if not (folder / "checkpoints").is_dir():
        raise ValueError(f"run = {str(folder)!r}: holds no checkpoint")
    shapes = jax.eval_shape(lambda: init_learner(jax.random.key(0), params, env, config))
    with open_manager(folder) as manager:
        if manager.latest_step() is None:
            raise ValueError(f"run = {str(folder)!r}: holds no checkpoint")
        state = manager.restore(manager.latest_step(), args=ocp.args.StandardRestore(shapes))
    return config, env, state.weights


def _read_run_config(folder: Path) -> TrainConfig:
    path = folder / "config.json"
    try:
        return from_dict(json.loads(path.read_text()))
    except OSError:
        raise ValueError(f"run = {str(folder)!r}: expected a folder with a config.json") from None
    except json.JSONDecodeError as error:
        raise ValueError(f"{path}: {error}") from None
