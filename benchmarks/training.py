"""Training end to end beside stock PPO on Stone Soup: `python -m benchmarks.training`."""

from jaxtrack import cores

if __name__ == "__main__":
    cores.use()  # before gymnax is imported, which starts JAX

import dataclasses
import math
from collections.abc import Sequence
from types import ModuleType
from typing import Any

import jax
import numpy as np
from rich.progress import Progress

from benchmarks import time_to_gospa
from benchmarks.ppo import (
    REPORTED,
    OurLearner,
    Seconds,
    UpdateOptions,
    build_learner,
    check_update,
    configure,
    load,
    seconds_of,
)
from jaxtrack.cli import parse, require_integer, require_positive, run, wide_console
from jaxtrack.env import make
from jaxtrack.params import Params, StaticParams
from jaxtrack.report import circumstances, print_table, spread, with_spread, write_report
from train.config import TrainConfig


@dataclasses.dataclass(frozen=True)
class TrainingOptions(UpdateOptions):
    """Times whole updates, rollout and learning, of ours and of what the paper used, in turns.

    That is stock Stable-Baselines3 PPO on the Stone Soup environment in Gymnasium, with the same
    networks and batch. Of its slow rollout a part is timed. Needs the extras sb3 and reference.
    """

    stone_soup_envs: int = 4
    """Environments side by side in Stone Soup, in one process; a rollout is longer as they are fewer."""
    stone_soup_steps: int = 256
    """Steps of all of them together that are timed in a repeat; as many as an update has: nothing is
    extrapolated."""
    warm_up_steps: int = 361
    """Steps of every environment before the clock starts, so that tracks exist."""
    gospa: float | None = None
    """Also train the default agent until its mean GOSPA is at most this (m)."""
    warm_start: str = TrainConfig.warm_start
    """Rule that it imitates at first; none: it learns from rewards alone, with the rate advised for that."""
    total_steps: int = TrainConfig.total_steps
    """Steps after which it gives up."""


def check(options: TrainingOptions) -> None:
    """Raises ValueError, naming the option, before anything is measured."""
    check_update(options)
    require_integer("stone_soup_envs", options.stone_soup_envs, 1)
    require_integer("stone_soup_steps", options.stone_soup_steps, 1)
    require_integer("warm_up_steps", options.warm_up_steps, 1)
    if options.stone_soup_steps % options.stone_soup_envs or options.samples % options.stone_soup_steps:
        raise ValueError(
            f"stone_soup_steps = {options.stone_soup_steps}: expected a multiple of stone_soup_envs = "
            f"{options.stone_soup_envs} that divides num_envs x rollout_steps = {options.samples}"
        )
    if options.gospa is not None:
        require_positive("gospa", options.gospa)
    time_to_gospa.configure(options.warm_start, options.total_steps, options.seed)


def load_stone_soup_ppo() -> ModuleType:
    """The other side.

    Raises:
        ValueError: where an extra is missing.
    """
    return load("benchmarks.stone_soup_ppo", "sb3,reference")


def build_sides(encoder: str, options: TrainingOptions) -> tuple[OurLearner, Any]:
    """Both learners, warm: with the same network, batch, minibatches and epochs, on the same scenario."""
    config = configure(encoder, options)
    env, _ = make(config.params, config.static)
    ours = build_learner(config, env)
    for _ in range(math.ceil(options.warm_up_steps / options.rollout_steps)):
        ours()
    envs = options.stone_soup_envs
    alike = dataclasses.replace(config, num_envs=envs, rollout_steps=options.samples // envs)
    theirs = load_stone_soup_ppo().StoneSoupPPO(alike, options.stone_soup_steps // envs)
    theirs.warm_up(options.warm_up_steps)
    return ours, theirs


@dataclasses.dataclass(frozen=True)
class Turn:
    """One repeat: an update of ours; a part of a rollout of theirs, and the update after it.

    Attributes:
        ours: rollout and learning together.
        part: of their rollout.
        learning: of theirs, from a full batch.
        parts: of which their rollout consists.
        live_tracks: mean number in our rollout and in their part.
    """

    ours: Seconds
    part: Seconds
    learning: Seconds
    parts: int
    live_tracks: tuple[float, float]

    @property
    def theirs(self) -> Seconds:
        """The whole update of theirs, put together."""
        pairs = zip(self.part, self.learning, strict=True)
        return Seconds(*(self.parts * part + learning for part, learning in pairs))


def take_turn(ours: OurLearner, theirs: Any) -> Turn:
    """Times both once, one right after the other."""
    metrics: dict[str, jax.Array] = {}
    mine = seconds_of(lambda: metrics.update(ours()))
    part, learning = theirs.collect(), theirs.update()
    tracks = float(metrics["live_tracks"]), theirs.tracks.mean
    return Turn(mine, part, learning, theirs.pieces, tracks)


def measure(options: TrainingOptions, progress: Progress) -> list[dict[str, Any]]:
    """Times both sides in turns, so that whatever else the machine does hits both.

    Returns:
        One row for each encoder.
    """
    task = progress.add_task("warming up", total=len(options.encoders) * (options.repeats + 1))
    sides = {}
    for encoder in options.encoders:
        sides[encoder] = build_sides(encoder, options)
        progress.advance(task)
    progress.update(task, description="measuring")
    turns: dict[str, list[Turn]] = {encoder: [] for encoder in sides}
    for _ in range(options.repeats):
        for encoder in sides:
            turns[encoder].append(take_turn(*sides[encoder]))
            progress.advance(task)
    return [make_row(encoder, options.samples, turns[encoder], *sides[encoder]) for encoder in sides]


def make_row(
    encoder: str, samples: int, turns: Sequence[Turn], ours: OurLearner, theirs: Any
) -> dict[str, Any]:
    """What one encoder gave."""
    speeds = {
        side: spread([samples / getattr(turn, side).wall for turn in turns]) for side in ("ours", "theirs")
    }
    processor = [np.median([getattr(turn, side).processor for turn in turns]) for side in speeds]
    live_tracks = np.mean([turn.live_tracks for turn in turns], axis=0)
    return {
        "encoder": encoder,
        "compile_seconds": ours.compiling._asdict(),
        "jaxtrack": {
            "parameters": ours.parameters,
            "steps_per_second": speeds["ours"],
            "live_tracks": float(live_tracks[0]),
        },
        "stone_soup": {
            "parameters": theirs.parameters,
            "steps_per_second": speeds["theirs"],
            "rollout_seconds": spread([turn.parts * turn.part.wall for turn in turns]),
            "learning_seconds": spread([turn.learning.wall for turn in turns]),
            "live_tracks": float(live_tracks[1]),
        },
        "ratio": speeds["ours"]["median"] / speeds["theirs"]["median"],
        "processor_time_ratio": float(processor[1] / processor[0]),
    }


HEADER = (
    "encoder", "jaxtrack, steps/s", "Stable-Baselines3 on Stone Soup, steps/s", "ratio",
    "ratio of processor time", "of theirs: rollout, s", "learning, s", "live tracks",
    "compiled in (processor)",
)  # fmt: skip


def cells(row: dict[str, Any]) -> list[str]:
    """The row under `HEADER`; the pair is ours / Stone Soup's."""
    ours, theirs = row["jaxtrack"], row["stone_soup"]
    return [
        row["encoder"],
        with_spread(ours["steps_per_second"]),
        with_spread(theirs["steps_per_second"]),
        f"{row['ratio']:.1f}",
        f"{row['processor_time_ratio']:.1f}",
        with_spread(theirs["rollout_seconds"]),
        with_spread(theirs["learning_seconds"]),
        f"{ours['live_tracks']:.1f} / {theirs['live_tracks']:.1f}",
        "{wall:.1f} s ({processor:.1f})".format(**row["compile_seconds"]),
    ]


def describe(options: TrainingOptions, machine: dict[str, Any]) -> str:
    """The title of the table: what was timed, and how their side is put together."""
    whole = options.stone_soup_steps == options.samples
    batch, steps = f"{options.samples:,} steps", f"{options.stone_soup_steps:,}"
    return (
        f"rollout and learning, median of {options.repeats} repeats (smallest - largest); updates of "
        f"{batch}, {options.epochs} epochs of minibatches of {options.minibatch_size:,}, "
        f"{options.num_envs} environments of ours, {options.stone_soup_envs} of Stone Soup's; theirs "
        + ("measured whole" if whole else f"EXTRAPOLATED: a rollout of {batch} at the speed of {steps}")
        + f"; {machine['processor']}, {machine['cores']} cores, {machine['jax_backend']}; "
        f"PyTorch with {machine['torch_threads']} threads"
    )


def main(argv: Sequence[str]) -> int:
    """The command; returns the exit code."""
    options = parse(TrainingOptions(), argv, "python -m benchmarks.training")
    check(options)
    threads = load_stone_soup_ppo().threads()
    report, console = circumstances(REPORTED), wide_console()
    report["machine"]["torch_threads"] = threads
    with Progress(console=console, disable=not console.is_terminal) as progress:
        rows = measure(options, progress)
    title = describe(options, report["machine"])
    print_table(HEADER, [cells(row) for row in rows], title, options.markdown, console)
    found: dict[str, Any] = {"rows": rows}
    if options.gospa is not None:
        config = time_to_gospa.configure(options.warm_start, options.total_steps, options.seed)
        found["time_to_gospa"] = time_to_gospa.train_until(options.gospa, config)
        time_to_gospa.show(found["time_to_gospa"], rows, options.markdown, console)
    if options.out is not None:
        scenario = {**vars(StaticParams()), **vars(Params())}
        write_report(options.out, report, options, scenario=scenario, **found)
    return 0


if __name__ == "__main__":
    run(main)
