"""Steps per second of our learner and of Stable-Baselines3's PPO: `python -m benchmarks.learner`."""

from jaxtrack import cores

if __name__ == "__main__":
    cores.use()  # before gymnax is imported, which starts JAX

import dataclasses
import sys
from collections.abc import Callable, Sequence
from types import ModuleType
from typing import Any

import jax
from rich.console import Console
from rich.progress import Progress

from benchmarks.ppo import REPORTED, UpdateOptions, build_learner, check_update, configure, load, seconds_of
from benchmarks.still_world import StillWorld
from jaxtrack.cli import parse, run
from jaxtrack.params import Params, StaticParams
from jaxtrack.report import circumstances, print_table, spread, write_report
from train.config import TrainConfig


@dataclasses.dataclass(frozen=True)
class LearnerOptions(UpdateOptions):
    """Times our PPO and Stable-Baselines3's with the same networks and sizes, in turns.

    One update is a rollout with inference only, on an environment that costs nothing, and PPO's
    epochs. Needs the extra sb3.
    """

    live_tracks: tuple[int, int] = (5, 10)
    """Fewest and most live tracks in an observation of 20 slots; in between, all are equally frequent."""


Update = Callable[[], Any]
"""One update of a learner that keeps its state to itself."""


def check(options: LearnerOptions) -> None:
    """Raises ValueError, naming the option, before anything is measured."""
    check_update(options)
    (fewest, most), slots = options.live_tracks, StaticParams().max_tracks
    if not 0 <= fewest <= most <= slots:
        raise ValueError(
            f"live_tracks = {options.live_tracks}: expected two integers in order in [0, {slots}]"
        )


def load_stable_baselines3() -> ModuleType:
    """The other side.

    Raises:
        ValueError: where the extra is missing.
    """
    return load("benchmarks.torch_learner", "sb3")


def build_ours(config: TrainConfig, live_tracks: tuple[int, int]) -> tuple[Update, dict[str, Any], float]:
    """Our learner, the observations that it sees, and the seconds that compiling its update took."""
    ours = build_learner(config, StillWorld(config.static, live_tracks))
    observations = jax.device_get(ours.state.env.observation)
    return ours, observations, ours.compiling.wall


def measure(options: LearnerOptions, progress: Progress) -> list[dict[str, Any]]:
    """Times both sides in turns, so that whatever else the machine does hits both.

    Returns:
        One row for each encoder.
    """
    torch_learner = load_stable_baselines3()
    task = progress.add_task("compiling", total=len(options.encoders) * (options.repeats + 1))
    sides: dict[str, tuple[Update, Update]] = {}
    compile_seconds = {}
    for encoder in options.encoders:
        config = configure(encoder, options)
        ours, observations, compile_seconds[encoder] = build_ours(config, options.live_tracks)
        sides[encoder] = ours, torch_learner.build_update(config, observations)
        for update in sides[encoder]:  # warms up
            update()
        progress.advance(task)

    progress.update(task, description="measuring")
    taken: dict[str, list[tuple[float, ...]]] = {encoder: [] for encoder in options.encoders}
    for _ in range(options.repeats):
        for encoder in options.encoders:
            taken[encoder].append(tuple(seconds_of(side).wall for side in sides[encoder]))
            progress.advance(task)
    return [make_row(encoder, options.samples, taken[encoder], compile_seconds[encoder]) for encoder in sides]


def make_row(
    encoder: str, samples: int, taken: Sequence[tuple[float, ...]], compile_seconds: float
) -> dict[str, Any]:
    """What one encoder gave; `taken` holds seconds of our update and of theirs."""
    ours, theirs = (spread([samples / each for each in side]) for side in zip(*taken, strict=True))
    return {
        "encoder": encoder,
        "compile_seconds": compile_seconds,
        "jaxtrack": {"steps_per_second": ours},
        "stable_baselines3": {"steps_per_second": theirs},
        "ratio": ours["median"] / theirs["median"],
    }


HEADER = ("encoder", "jaxtrack, steps/s", "Stable-Baselines3, steps/s", "ratio", "compiled in")


def cells(row: dict[str, Any]) -> list[str]:
    """The row under `HEADER`."""
    speeds = [row[side]["steps_per_second"] for side in ("jaxtrack", "stable_baselines3")]
    return [
        row["encoder"],
        *(f"{speed['median']:,.0f} ({speed['min']:,.0f} - {speed['max']:,.0f})" for speed in speeds),
        f"{row['ratio']:.2f}",
        f"{row['compile_seconds']:.1f} s",
    ]


def main(argv: Sequence[str]) -> int:
    """The command; returns the exit code."""
    options = parse(LearnerOptions(), argv, "python -m benchmarks.learner")
    check(options)
    threads = load_stable_baselines3().threads()
    report = circumstances(REPORTED)
    console = Console(width=None if sys.stdout.isatty() else 150)
    with Progress(console=console, disable=not console.is_terminal) as progress:
        rows = measure(options, progress)
    machine = report["machine"]
    title = (
        f"environment steps of rollout and update, median of {options.repeats} repeats (smallest - largest); "
        f"{options.num_envs} environments x {options.rollout_steps} steps, {options.epochs} epochs of "
        f"minibatches of {options.minibatch_size}; {machine['processor']}, {machine['cores']} cores, "
        f"{machine['jax_backend']}; PyTorch with {threads} threads"
    )
    print_table(HEADER, [cells(row) for row in rows], title, options.markdown, console)
    if options.out is not None:
        report["machine"]["torch_threads"] = threads
        scenario = {**vars(StaticParams()), **vars(Params())}
        write_report(options.out, report, options, scenario=scenario, rows=rows)
    return 0


if __name__ == "__main__":
    run(main)
