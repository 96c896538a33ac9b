"""What a training shows: its configuration, a progress bar, or lines where no bar can be drawn."""

import math
import platform
from importlib.metadata import version
from pathlib import Path
from typing import Any

import jax
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.table import Table

from train.config import TrainConfig, to_dict


def print_config(config: TrainConfig, folder: Path, console: Console) -> None:
    """Prints the resolved configuration and what it runs on."""
    table = Table("field", "value", title="configuration")
    for name, value in to_dict(config).items():
        for inner, number in value.items() if isinstance(value, dict) else [("", value)]:
            table.add_row(f"{name}.{inner}" if inner else name, str(number))
    console.print(table)
    versions = ", ".join(f"{package} {version(package)}" for package in ("jaxtrack", "jax", "flax", "gymnax"))
    console.print(f"Python {platform.python_version()}, {versions}; {jax.devices()}")
    console.print(f"run folder: {folder}")


def note(row: dict[str, float]) -> str:
    """What the progress bar shows of a row."""
    episode_return = "  -  " if math.isnan(row["episode_return"]) else f"{row['episode_return']:.0f}"
    return (
        f"{row['steps_per_second']:,.0f} steps/s  return {episode_return}  "
        f"completeness {row['completeness']:.2f}  covariance norm {row['covariance_norm_mean']:.0f}"
    )


def columns() -> tuple[Any, ...]:
    """Columns of the progress bar."""
    return (
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.percentage:>3.0f}%"),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
        TextColumn("{task.fields[note]}"),
    )


class TrainingBar:
    """Progress over a training, or over several of the same length one after the other.

    A bar, or where none can be drawn a line at every tenth of each training.
    """

    def __init__(self, config: TrainConfig, console: Console, number: int = 1) -> None:
        """`number` of trainings; nothing is shown before the first begins."""
        self.config, self.console = config, console
        self._each = config.num_updates * config.batch_size
        self._total, self._before = number * self._each, 0
        self._progress = Progress(*columns(), console=console, disable=not console.is_terminal)

    def __enter__(self) -> "TrainingBar":
        """The bar itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """Leaves the bar as it stands."""
        self.stop()

    def begin(self, name: str, place: int = 0, done: int = 0) -> None:
        """A training begins.

        Args:
            name: what is shown of it.
            place: how many trainings come before it.
            done: updates that it has behind it.
        """
        self._before = place * self._each
        completed = self._before + done * self.config.batch_size
        if not self._progress.tasks:  # what was done earlier tells nothing of the speed now
            self._progress.add_task(name, total=self._total, completed=completed, note="")
        self._progress.start()
        self._progress.update(self._progress.task_ids[0], description=name, completed=completed, note="")

    def tell(self, update: int, row: dict[str, float]) -> None:
        """An update is done, which left this row of metrics."""
        completed = self._before + row["env_steps"]
        self._progress.update(self._progress.task_ids[0], completed=completed, note=note(row))
        tenth = max(1, self.config.num_updates // 10)
        if not self.console.is_terminal and (update % tenth == 0 or update == 1):
            left = (self._total - completed) / row["steps_per_second"]
            steps = f"{row['env_steps']:>9,.0f} steps"
            self.console.print(f"{steps}  {note(row)}  time left {left:.0f} s")

    def stop(self) -> None:
        """Takes no more of the terminal."""
        self._progress.stop()
