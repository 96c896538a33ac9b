"""What a training shows: its configuration, a progress bar, or lines where no bar can be drawn."""

import math
import platform
from importlib.metadata import version
from pathlib import Path
from typing import Any

import jax
from rich.console import Console
from rich.progress import BarColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn
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


def say_now_and_then(update: int, row: dict[str, float], config: TrainConfig, console: Console) -> None:
    """Where no bar can be drawn: a line at every tenth of the way."""
    tenth = max(1, config.num_updates // 10)
    if not console.is_terminal and (update % tenth == 0 or update == 1):
        left = (config.num_updates - update) * config.batch_size / row["steps_per_second"]
        console.print(f"{row['env_steps']:>9,.0f} steps  {note(row)}  time left {left:.0f} s")


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
