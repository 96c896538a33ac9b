"""A run's folder as it is read: its configuration, its newest intact checkpoint, and whether they agree."""

import dataclasses
import json
from pathlib import Path
from typing import Any

from jaxtrack.env import SearchTrack, make
from train.checkpoint import (
    Checkpoint,
    IncompatibleError,
    Say,
    learner_shapes,
    load_newest,
    read,
    restore,
    write,
)
from train.config import TrainConfig, check, first_difference, from_dict, to_dict
from train.learner_state import LearnerState
from train.recorded import with_recording
from train.sealed import read_json, write_whole


@dataclasses.dataclass(frozen=True)
class SavedRun:
    """What a folder holds.

    Attributes:
        config: the run's configuration.
        env: its environment.
        checkpoint: the newest that is intact; None if none was ever finished.
        state: the learner state in it.
    """

    config: TrainConfig
    env: SearchTrack
    checkpoint: Checkpoint | None = None
    state: LearnerState | None = None


AGENT = "agent.npz"
"""The weights alone, in the folder of an exported agent."""


def write_config(folder: Path, config: TrainConfig) -> None:
    """Writes the run's configuration as config.json."""
    write_whole(folder / "config.json", (json.dumps(to_dict(config), indent=2) + "\n").encode())


def read_config(folder: Path) -> tuple[TrainConfig, dict[str, Any]]:
    """A run's configuration, checked, and the same as it stands in config.json.

    Raises:
        ValueError: naming the folder or the file.
    """
    path = folder / "config.json"
    try:
        values = read_json(path)
    except OSError:
        raise ValueError(f"run = {str(folder)!r}: expected a folder with a config.json") from None
    try:
        config = with_recording(from_dict(values))
        check(dataclasses.replace(config, out=""))
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None
    return config, values


def read_run(folder: Path, say: Say = print) -> SavedRun:
    """Reads a run, of which checkpoint, configuration and this program must agree; what is damaged is said.

    Raises:
        ValueError: naming the folder or the file, if that is not possible.
    """
    config, values = read_config(folder)
    env, _ = make(config.params, config.static)
    checkpoint = load_newest(folder, say)
    if checkpoint is None:
        return SavedRun(config, env)
    agree(folder, values, checkpoint)
    return SavedRun(config, env, checkpoint, restore(checkpoint, learner_shapes(env, config)))


def load_run(folder: Path, say: Say = print) -> tuple[TrainConfig, SearchTrack, Any]:
    """Configuration, environment and latest weights of a run, or of an agent that was exported from one.

    Raises:
        ValueError: naming the folder or the file, if it holds no readable run.
    """
    if (folder / AGENT).exists():
        return load_agent(folder)
    run = read_run(folder, say)
    if run.state is None:
        raise ValueError(f"run = {str(folder)!r}: holds no checkpoint")
    return run.config, run.env, run.state.weights


def save_agent(run: SavedRun, folder: Path) -> None:
    """Writes an agent: the configuration of a run and its weights, without the rest of the learner state.

    Raises:
        ValueError: if the run has no checkpoint.
        OSError: naming the file.
    """
    if run.state is None or run.checkpoint is None:
        raise ValueError("run: holds no checkpoint")
    folder.mkdir(parents=True, exist_ok=True)
    config = dataclasses.replace(run.config, out="")
    write_config(folder, config)
    write(folder / AGENT, run.state.weights, run.checkpoint.update, config)


def load_agent(folder: Path) -> tuple[TrainConfig, SearchTrack, Any]:
    """Configuration, environment and weights of an exported agent.

    Raises:
        ValueError: naming the file, if it is damaged or does not belong to the configuration.
    """
    config, values = read_config(folder)
    try:
        checkpoint = read(folder / AGENT)
    except IncompatibleError:
        raise
    except Exception as error:  # whatever damage does to the readers of JSON, zip and NumPy files
        raise ValueError(f"{folder / AGENT}: is damaged ({' '.join(str(error).split())})") from None
    agree(folder, values, checkpoint)
    env, _ = make(config.params, config.static)
    return config, env, restore(checkpoint, learner_shapes(env, config).weights)


def agree(folder: Path, values: dict[str, Any], checkpoint: Checkpoint) -> None:
    """Raises ValueError, naming the field, if config.json is not what a checkpoint was trained with."""
    if found := first_difference(with_new_fields(values), with_new_fields(checkpoint.config)):
        name, here, there = found
        raise ValueError(
            f"{folder / 'config.json'}: {name} = {here!r}, but the checkpoint was trained with {there!r}"
        )


def with_new_fields(values: dict[str, Any]) -> dict[str, Any]:
    """A configuration as it was written, and the defaults of fields that did not exist yet."""
    defaults = json.loads(json.dumps(to_dict(TrainConfig())))
    tables = {name: {**defaults[name], **values.get(name, {})} for name in ("static", "params")}
    return {**defaults, **values, **tables}
