"""Steps per second of our learner and of Stable-Baselines3's PPO: `python -m benchmarks.learner`."""

import dataclasses
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any

import jax
from rich.console import Console
from rich.progress import Progress

from benchmarks.still_world import StillWorld
from jaxtrack.cli import parse, require_file, require_integer, run
from jaxtrack.params import Params, StaticParams
from jaxtrack.report import PACKAGES, circumstances, print_table, spread, write_report
from train import learner
from train.config import TrainConfig
from train.networks import ENCODERS

ALSO_REPORTED = ("flax", "optax", "stable-baselines3", "torch")


@dataclasses.dataclass(frozen=True)
class LearnerOptions:
    """Times our PPO and Stable-Baselines3's with the same networks and sizes, in turns.

    One update is a rollout with inference only, on an environment that costs nothing, and PPO's
    epochs. Needs the extra sb3.
    """

    encoders: tuple[str, ...] = tuple(ENCODERS)
    """Track-list encoders of the paper: flatten, bigru, mhsa."""
    num_envs: int = 64
    """Environments side by side."""
    rollout_steps: int = 128
    """Steps of every environment in one update."""
    minibatch_size: int = 1024
    """Samples per optimiser step."""
    epochs: int = 4
    """Passes over the samples of an update."""
    live_tracks: tuple[int, int] = (5, 10)
    """Fewest and most live tracks in an observation of 20 slots; in between, all are equally frequent."""
    repeats: int = 5
    """Times that everything is timed."""
    seed: int = 0
    """Seed of the observations and of both learners."""
    out: Path | None = None
    """JSON file for the results; nothing is written without it."""
    markdown: bool = False
    """Print the table in Markdown."""


Update = Callable[[], None]
"""One update of a learner that keeps its state to itself."""


def check(options: LearnerOptions) -> None:
    """Raises ValueError, naming the option, before anything is measured."""
    for name in ("num_envs", "rollout_steps", "minibatch_size", "epochs", "repeats"):
        require_integer(name, getattr(options, name), 1)
    (fewest, most), slots = options.live_tracks, StaticParams().max_tracks
    if not 0 <= fewest <= most <= slots:
        raise ValueError(
            f"live_tracks = {options.live_tracks}: expected two integers in order in [0, {slots}]"
        )
    require_integer("seed", options.seed, 0)
    known = ", ".join(ENCODERS)
    if not options.encoders or len(set(options.encoders)) < len(options.encoders):
        raise ValueError(f"encoders = {options.encoders}: expected different ones of {known}")
    for encoder in options.encoders:
        if encoder not in ENCODERS:
            raise ValueError(f"encoders = {encoder!r}: expected some of {known}")
    samples = options.num_envs * options.rollout_steps
    if samples % options.minibatch_size:
        raise ValueError(
            f"minibatch_size = {options.minibatch_size}: expected a divisor of "
            f"num_envs x rollout_steps = {samples} samples"
        )
    if options.out is not None:
        require_file("out", options.out)


def load_stable_baselines3() -> ModuleType:
    """The other side, imported only here: it loads PyTorch.

    Raises:
        ValueError: where the extra is missing.
    """
    try:
        from benchmarks import torch_learner
    except ImportError as error:
        raise ValueError(f'{error.name} is not installed: pip install -e ".[sb3]"') from None
    return torch_learner


def configure(encoder: str, options: LearnerOptions) -> TrainConfig:
    """The configuration of both learners; what is not an option is a default of `train.ppo`."""
    samples = options.num_envs * options.rollout_steps
    return TrainConfig(
        encoder=encoder,
        head="factored",
        num_envs=options.num_envs,
        rollout_steps=options.rollout_steps,
        num_minibatches=samples // options.minibatch_size,
        epochs=options.epochs,
        seed=options.seed,
        warm_start="none",
        anneal=False,
        static=StaticParams(),
        params=Params(),
    )


def build_ours(config: TrainConfig, live_tracks: tuple[int, int]) -> tuple[Update, dict[str, Any], float]:
    """Our learner, the observations that it sees, and the seconds that compiling its update took."""
    env: Any = StillWorld(config.static, live_tracks)
    init = jax.jit(lambda key, params: learner.init_learner(key, params, env, config))
    state = init(jax.random.key(config.seed), config.params)
    observations = jax.device_get(state.env.observation)
    began = time.perf_counter()
    step = jax.jit(lambda state: learner.train_step(state, env, config), donate_argnums=0)
    compiled = step.lower(state).compile()
    seconds = time.perf_counter() - began

    def update() -> None:
        nonlocal state
        state, metrics = compiled(state)
        jax.block_until_ready((state, metrics))

    return update, observations, seconds


def seconds_of(update: Update) -> float:
    """Seconds that one call takes."""
    began = time.perf_counter()
    update()
    return time.perf_counter() - began


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
            taken[encoder].append(tuple(map(seconds_of, sides[encoder])))
            progress.advance(task)
    samples = options.num_envs * options.rollout_steps
    return [make_row(encoder, samples, taken[encoder], compile_seconds[encoder]) for encoder in sides]


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
    report = circumstances((*PACKAGES, *ALSO_REPORTED))
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
