"""Checkpoints of a run: the whole learner state, sealed with its SHA-256, the last two kept.

`checkpoints/UPDATE.npz` holds the arrays by name and, as JSON under `about`, the configuration and what it
was written with; nothing is unpickled. NumPy's format rather than orbax: a whole state is one file, quickly
written, and orbax loads damaged numbers without a word (docs/reliability.md).
"""

import dataclasses
import io
import json
import os
import platform
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from jaxtrack.env import SearchTrack
from jaxtrack.report import circumstances
from train.config import TrainConfig, to_dict
from train.learner import init_learner
from train.learner_state import LearnerState
from train.sealed import check_seal, remove_sealed, seal_of, write_sealed

KEPT = 2
FORMAT = 1
"""Raised when an older program could misread what is written."""
ABOUT = "about"

Say = Callable[[str], None]
Tree = TypeVar("Tree")


class IncompatibleError(ValueError):
    """An intact checkpoint that this program can not use."""


@dataclasses.dataclass(frozen=True)
class Checkpoint:
    """An intact checkpoint.

    Attributes:
        update: updates done.
        config: the run's configuration, as in config.json.
        written_with: versions and machine, flat.
        metrics_digest: of the rows of metrics.csv up to here.
        arrays: leaves of the learner state by their names.
    """

    update: int
    config: dict[str, Any]
    written_with: dict[str, Any]
    metrics_digest: str
    arrays: dict[str, np.ndarray]


def save(folder: Path, state: LearnerState, config: TrainConfig, metrics_digest: str = "") -> None:
    """Writes the learner state under its number of updates, and removes checkpoints that are no longer kept.

    Raises:
        OSError: naming the file; the checkpoints that were there still are.
    """
    update = int(state.update)
    (folder / "checkpoints").mkdir(exist_ok=True)
    write(_path(folder, update), state, update, config, metrics_digest)
    # One of a later update is what a resumed training found damaged.
    kept = [each for each in updates(folder) if each <= update][-KEPT:]
    for other in set(updates(folder)) - set(kept):
        remove_sealed(_path(folder, other))


def write(path: Path, tree: Any, update: int, config: TrainConfig, metrics_digest: str = "") -> None:
    """Writes arrays of a learner state, all of them or a part, into a sealed file."""
    about = {
        "format": FORMAT,
        "update": update,
        "config": to_dict(config),
        "written_with": written_with(),
        "metrics_digest": metrics_digest,
    }
    buffer = io.BytesIO()
    np.savez(buffer, allow_pickle=False, **{ABOUT: np.array(json.dumps(about))}, **_by_name(tree))
    write_sealed(path, buffer.getvalue())


def updates(folder: Path) -> list[int]:
    """Updates with a checkpoint, intact or not, in ascending order."""
    names = (path for path in (folder / "checkpoints").glob("*") if path.suffix in (".npz", ".json"))
    return sorted({int(path.stem) for path in names if path.stem.isdecimal()})


def load_newest(folder: Path, say: Say = print) -> Checkpoint | None:
    """The newest intact checkpoint, None if none was ever finished; what is damaged is said.

    Raises:
        ValueError: if there are checkpoints, but none of them is intact or can be used.
    """
    found = updates(folder)
    finished = [update for update in found if seal_of(_path(folder, update)).exists()]
    for update in reversed(found):
        try:
            checkpoint = read(_path(folder, update))
            if checkpoint.update != update:
                raise ValueError(f"{update}.npz holds update {checkpoint.update}")
        except IncompatibleError:
            raise
        except Exception as error:  # whatever damage does to the readers of JSON, zip and NumPy files
            say(f"{folder}: the checkpoint of update {update} is damaged ({_one_line(error)})")
            continue
        say(f"{folder}: using the checkpoint of update {update}")
        return checkpoint
    if finished:
        raise ValueError(f"run = {str(folder)!r}: none of its checkpoints is intact (updates {found})")
    return None


def read(path: Path) -> Checkpoint:
    """Reads a sealed file.

    Raises:
        IncompatibleError: if a newer program wrote it.
        Exception: of many kinds, if it is damaged.
    """
    check_seal(path)
    with np.load(path, allow_pickle=False) as file:
        arrays = {name: file[name] for name in file.files}
    about = json.loads(str(arrays.pop(ABOUT)))
    if about["format"] > FORMAT:
        raise IncompatibleError(
            f"{path}: has format {about['format']}, expected at most {FORMAT}; "
            f"it was written with jaxtrack {about['written_with']['jaxtrack']}"
        )
    return Checkpoint(
        about["update"], about["config"], about["written_with"], about["metrics_digest"], arrays
    )


def restore(checkpoint: Checkpoint, shapes: Tree) -> Tree:
    """The learner state of a checkpoint, or the part that was written.

    Args:
        checkpoint: an intact one.
        shapes: the same with the shapes and types that are expected.

    Raises:
        ValueError: naming the first array that does not fit.
    """
    expected = _by_name(shapes)
    for name in sorted({*expected, *checkpoint.arrays}):
        ours, theirs = (_kind(side.get(name)) for side in (expected, checkpoint.arrays))
        if ours != theirs:
            wrote = checkpoint.written_with.get("jaxtrack")
            raise ValueError(
                f"checkpoint of update {checkpoint.update}: {name} is {theirs}, expected {ours}; it was "
                f"written with jaxtrack {wrote}"
            )
    leaves = [jnp.asarray(checkpoint.arrays[name]) for name in expected]
    restored: Tree = jax.tree.unflatten(jax.tree.structure(shapes), leaves)
    return restored


def learner_shapes(env: SearchTrack, config: TrainConfig) -> LearnerState:
    """Shapes and types of the learner state, without computing one."""
    init = lambda key, params: init_learner(key, params, env, config)  # noqa: E731
    return jax.eval_shape(init, jax.random.key(config.seed), config.params)


def written_with() -> dict[str, Any]:
    """Versions and machine, as far as results may depend on them."""
    about = circumstances()
    packages = {name: version(name) for name in ("flax", "optax")}
    devices = {"devices": jax.device_count(), "platform": platform.machine()}
    options = {"XLA_FLAGS": os.environ.get("XLA_FLAGS", "")}
    return {**about["versions"], **packages, **about["machine"], **devices, **options}


def _path(folder: Path, update: int) -> Path:
    return folder / "checkpoints" / f"{update}.npz"


def _by_name(state: Any) -> dict[str, Any]:
    """Leaves by name, such as `weights/params/Dense_0/kernel`, in the order of the tree."""
    leaves = jax.tree.leaves_with_path(state)
    return {jax.tree_util.keystr(path, simple=True, separator="/"): leaf for path, leaf in leaves}


def _kind(leaf: Any) -> str:
    return "missing" if leaf is None else f"{np.dtype(leaf.dtype).name}{list(leaf.shape)}"


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split()) or type(error).__name__
