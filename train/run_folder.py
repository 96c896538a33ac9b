"""The folder of a training: made for a new run, or opened to continue an interrupted one."""

import contextlib
import dataclasses
import shlex
import time
from collections.abc import Iterator
from pathlib import Path

from train.checkpoint import Checkpoint, save, written_with
from train.config import TrainConfig, check, first_difference, to_dict
from train.devices import with_devices
from train.early_stop import passed
from train.learner_state import LearnerState
from train.metrics_file import MetricsFile
from train.saved_run import read_config, read_run, write_config

FREE = ("evaluation_episodes",)
"""Options that a resumed training may change, because they change nothing that is learned or logged."""


@dataclasses.dataclass(frozen=True)
class Run:
    """A training and its folder.

    Attributes:
        folder: where it writes.
        config: what it does, as in config.json.
        evaluation_episodes: the configuration's, or what was asked for when it was resumed.
        metrics: the open metrics.csv.
        done: updates that its checkpoint has behind it.
        state: the learner state of the checkpoint; None at the start.
        belongs_to: the folder of several seeds, if it is trained as one of them.
    """

    folder: Path
    config: TrainConfig
    evaluation_episodes: int
    metrics: MetricsFile
    done: int = 0
    state: LearnerState | None = None
    belongs_to: Path | None = None

    @property
    def resume_command(self) -> str:
        """What continues it, and the other seeds."""
        return resume_command(self.belongs_to or self.folder)

    @property
    def trained(self) -> bool:
        """All updates are done, or as many as it took to pass a threshold."""
        return self.done == self.config.num_updates or bool(self.done and self.passed)

    @property
    def passed(self) -> str:
        """The threshold that the last row of metrics.csv passes after the warm start, in words, if one."""
        row, config = self.metrics.last, self.config
        if not row or int(row["update"]) <= config.warm_start_updates:
            return ""
        return passed(row, config.stop_above, config.stop_below)

    @property
    def finished(self) -> bool:
        """The training is done, and what follows them too: results.json is its last file."""
        evaluated = not self.evaluation_episodes or (self.folder / "results.json").exists()
        return self.trained and evaluated

    def save(self, state: LearnerState) -> None:
        """Writes a checkpoint; what metrics.csv tells of the way to it is on the disk before."""
        self.metrics.sync()
        save(self.folder, state, self.config, self.metrics.digest)


def resume_command(folder: Path) -> str:
    """What continues the training in a folder."""
    return f"python -m train.ppo --resume {shlex.quote(str(folder))}"


@contextlib.contextmanager
def start_run(config: TrainConfig) -> Iterator[Run]:
    """Makes the folder of a new run, which must not exist, and writes the configuration into it.

    Raises:
        ValueError: one line, if the configuration can not run.
        OSError: if the folder can not be made.
    """
    check(config)
    config = with_devices(config)
    name = f"runs/{config.encoder}-seed{config.seed}-{time.strftime('%Y%m%d-%H%M%S')}"
    folder = Path(config.out or name)
    folder.mkdir(parents=True, exist_ok=False)
    write_config(folder, config)
    with MetricsFile(folder) as metrics:
        yield Run(folder, config, config.evaluation_episodes, metrics)


@contextlib.contextmanager
def resume_run(folder: Path, evaluation_episodes: int) -> Iterator[Run]:
    """Opens a run's folder at its newest intact checkpoint, or at the start if none was finished yet.

    What is not as it was at the checkpoint is said. The metrics after it are cut off.

    Raises:
        ValueError: one line, if there is no such run, or nothing intact to continue from.
        OSError: if the folder can not be written, or another training writes there.
    """
    read_config(folder)  # an empty folder stays empty
    with MetricsFile(folder) as metrics:
        saved = read_run(folder)
        done = 0
        if saved.checkpoint is not None:
            done = saved.checkpoint.update
            say_changes(saved.checkpoint)
            metrics.cut(done, saved.checkpoint.metrics_digest)
            if metrics.lost:
                print(f"{metrics.path}: begins after update {metrics.lost}, earlier rows are lost")
        elif metrics.num_rows > saved.config.checkpoint_every:
            raise ValueError(f"resume = {str(folder)!r}: its checkpoints are gone, metrics.csv is not")
        else:
            print(f"{folder}: no checkpoint yet, starting at update 0")
            metrics.cut(0)
        yield Run(folder, saved.config, evaluation_episodes, metrics, done, saved.state)


def say_changes(checkpoint: Checkpoint) -> None:
    """Says what is not as it was when the checkpoint was written."""
    now = written_with()
    for name in sorted({*now, *checkpoint.written_with}):
        before, after = checkpoint.written_with.get(name), now.get(name)
        if before != after:
            print(f"{name} was {before}, is {after}: results may differ in rounding from now on")


def require_unchanged(config: TrainConfig, wanted: TrainConfig) -> None:
    """Raises ValueError, naming the option, if one that was given beside --resume would change the run."""
    free = {name: getattr(wanted, name) for name in FREE}
    if found := first_difference(to_dict(wanted), to_dict(dataclasses.replace(config, **free))):
        name, given, own = found
        raise ValueError(
            f"{name} = {given!r}: expected {own!r} as in the run; beside --resume only "
            f"{', '.join(FREE)} may change"
        )
