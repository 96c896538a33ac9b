"""The main job: `python -m train.ppo` trains an agent, evaluates it, and draws what it learned."""

import csv
import math
import platform
import signal
import time
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path
from types import FrameType
from typing import Any, TextIO

import jax
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.table import Table

from jaxtrack.cli import INTERRUPTED, parse, run, take_config, wide_console
from jaxtrack.env import SearchTrack, make
from train import learner
from train.checkpoint import open_manager, save, write_config
from train.config import TrainConfig, check, from_dict, to_dict
from train.evaluate import COMPARED_SEED, agent, compare_with_baselines
from train.learner import LearnerState
from train.results import print_results, summarise, write_results

FAILED = 1
LOST = "training diverged: {name} is {value} after update {update}"
HELP = (
    "Trains an agent for SearchTrack-v0 by PPO, compares it with all baselines on the same "
    "scenarios, and draws a learning curve and an episode. --config FILE (.toml or .json) sets "
    "the defaults of everything below; options on the command line win over it."
)


class Interrupt:
    """Turns the first Ctrl-C (or SIGTERM) into a request to stop; the second one stops at once."""

    def __init__(self) -> None:
        self.signal = 0

    def __enter__(self) -> "Interrupt":
        """Listens for the signals."""
        self.before = {number: signal.signal(number, self._ask) for number in (signal.SIGINT, signal.SIGTERM)}
        return self

    def __exit__(self, *_: object) -> None:
        """Restores what listened before."""
        for number, handler in self.before.items():
            signal.signal(number, handler)

    def _ask(self, number: int, frame: FrameType | None) -> None:
        if self.signal:
            raise KeyboardInterrupt
        self.signal = number


def main(argv: Sequence[str]) -> int:
    """The command; returns the exit code."""
    values, rest = take_config(argv)
    config = parse(from_dict(values), rest, "python -m train.ppo", HELP)
    check(config)
    console = wide_console()
    folder = prepare_folder(config)
    print_config(config, folder, console)
    env, _ = make(config.params, config.static)

    state, compiled = compile_training(env, config, console)
    with Interrupt() as interrupt:
        state, code = train(state, compiled, config, folder, interrupt, console)
    if code == 0 and config.evaluation_episodes:
        finish(state, env, config, folder, console)
    return code


def prepare_folder(config: TrainConfig) -> Path:
    """Makes the run's folder, which must be new, and writes the configuration into it."""
    name = f"runs/{config.encoder}-seed{config.seed}-{time.strftime('%Y%m%d-%H%M%S')}"
    folder = Path(config.out or name)
    folder.mkdir(parents=True, exist_ok=False)
    write_config(folder, config)
    return folder


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


def compile_training(env: SearchTrack, config: TrainConfig, console: Console) -> tuple[LearnerState, Any]:
    """Initial learner state and the compiled training step; says how long compiling took."""
    started = time.perf_counter()
    with console.status("compiling (about half a minute)"):
        init = jax.jit(lambda key, params: learner.init_learner(key, params, env, config))
        state = init(jax.random.key(config.seed), config.params)
        step = jax.jit(lambda state: learner.train_step(state, env, config), donate_argnums=0)
        compiled = step.lower(state).compile()
    console.print(f"compiled in {time.perf_counter() - started:.1f} s")
    return state, compiled


def train(
    state: LearnerState,
    compiled: Any,
    config: TrainConfig,
    folder: Path,
    interrupt: Interrupt,
    console: Console,
) -> tuple[LearnerState, int]:
    """Runs all updates; one row of metrics each, a checkpoint now and then and at the end."""
    started, code = time.perf_counter(), 0
    with (
        open_manager(folder) as manager,
        open(folder / "metrics.csv", "w", newline="") as file,
        Progress(*_columns(), console=console, disable=not console.is_terminal) as progress,
    ):
        task = progress.add_task("training", total=config.num_updates * config.batch_size, note="")
        for update in range(config.num_updates):
            state, metrics = compiled(state)
            metrics = jax.device_get(metrics)
            row = make_row(metrics, update + 1, time.perf_counter() - started, config)
            lost = next((name for name in HEALTH if not math.isfinite(row[name])), None)
            if lost:
                console.print(LOST.format(name=lost, value=row[lost], update=update + 1))
                code = FAILED
                break
            write_row(file, row)
            progress.update(task, completed=row["env_steps"], note=note(row))
            say_now_and_then(update, row, config, console)
            if interrupt.signal or (update + 1) % config.checkpoint_every == 0:
                save(manager, state)
            if interrupt.signal:
                code = INTERRUPTED if interrupt.signal == signal.SIGINT else 128 + interrupt.signal
                break
        if code == 0:
            save(manager, state)
        last = manager.latest_step()
    if code:
        stopped = f"stopped after {update + 1} updates"
        if last is None:
            console.print(f"{stopped}; no checkpoint yet in {folder}, so nothing to evaluate")
        else:
            console.print(f"{stopped}; checkpoint of update {last} in {folder}")
            console.print(f"evaluate it with: python -m train.evaluate --run {folder}")
    return state, code


HEALTH = ("policy_loss", "value_loss", "gradient_norm", "reward")
"""Metrics that end the training when they are not finite."""


def make_row(metrics: dict[str, Any], update: int, seconds: float, config: TrainConfig) -> dict[str, float]:
    """One row of metrics.csv."""
    steps = update * config.batch_size
    clock = {"update": update, "env_steps": steps, "seconds": seconds, "steps_per_second": steps / seconds}
    return {**clock, **{name: float(value) for name, value in metrics.items()}}


def write_row(file: TextIO, row: dict[str, float]) -> None:
    """Appends a row, with the header before the first, and hands it to the disk."""
    writer = csv.DictWriter(file, fieldnames=list(row))
    if file.tell() == 0:
        writer.writeheader()
    writer.writerow({name: "" if math.isnan(value) else f"{value:.8g}" for name, value in row.items()})
    file.flush()


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
    if not console.is_terminal and ((update + 1) % tenth == 0 or update == 0):
        left = row["seconds"] / (update + 1) * (config.num_updates - update - 1)
        console.print(f"{row['env_steps']:>9,.0f} steps  {note(row)}  time left {left:.0f} s")


def finish(
    state: LearnerState, env: SearchTrack, config: TrainConfig, folder: Path, console: Console
) -> None:
    """Evaluates the trained agent against the baselines; writes tables and pictures."""
    from jaxtrack.recording import record_episode
    from jaxtrack.render import animate
    from train import figures, plots

    started = time.perf_counter()
    competitor = agent(config.encoder, [state.weights], (config.seed,))
    comparison = compare_with_baselines(
        config.encoder, competitor, env, config.params, config.evaluation_episodes, COMPARED_SEED, console
    )
    summary = summarise(comparison.played)
    print_results(comparison, summary, [config.encoder], console)
    write_results(comparison, summary, env, config.params, COMPARED_SEED, folder)
    console.print(f"evaluated in {time.perf_counter() - started:.1f} s")
    plots.learning_curve(folder / "metrics.csv", folder / "learning_curve.png")
    drawn = figures.draw_all(comparison.played, summary, config.params, folder)
    policy = competitor.build(state.weights)(env.static, config.params)
    episode = record_episode(env, config.params, policy, jax.random.key(COMPARED_SEED))
    animate(episode, folder / "episode.gif", progress=console.is_terminal)
    pictures = ["learning_curve.png", *(path.name for path in drawn.values()), "episode.gif"]
    console.print(f"results.json, episodes.csv, curves.npz, {', '.join(pictures)} in {folder}")


def _columns() -> tuple[Any, ...]:
    return (
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.percentage:>3.0f}%"),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
        TextColumn("{task.fields[note]}"),
    )


if __name__ == "__main__":
    run(main)
