"""Steps per second of our environment and of Stone Soup's: `python -m benchmarks.environment`."""

from jaxtrack import cores

if __name__ == "__main__":
    cores.use()  # before gymnax is imported, which starts JAX

import dataclasses
import sys
import time
from collections.abc import Sequence
from itertools import product
from pathlib import Path
from typing import Any

import jax
import numpy as np
from rich.console import Console
from rich.progress import Progress

from benchmarks.playing import Start, compile_play, first, pointing, raster
from benchmarks.stone_soup import Look, play_stone_soup, pointing_look, random_look, raster_look
from jaxtrack import policies
from jaxtrack.cli import parse, require_file, require_integer, run
from jaxtrack.env import make
from jaxtrack.params import Params, StaticParams
from jaxtrack.report import circumstances, print_table, spread, write_report
from reference.simulation import StoneSoupScenario


@dataclasses.dataclass(frozen=True)
class EnvironmentOptions:
    """Times our environment and Stone Soup's on the same scenario, in turns."""

    num_envs: tuple[int, ...] = (1, 64)
    """Numbers of our environments stepped together."""
    repeats: int = 5
    """Scenarios on which everything is timed once."""
    steps: int = 600
    """Steps of ours in one call, after the raster that finds the tracks."""
    stone_soup_steps: int = 200
    """Steps of Stone Soup in one repeat, after the same raster."""
    min_seconds: float = 0.5
    """Ours is called again and again for at least this long in one repeat (s)."""
    seed: int = 0
    """Seed of the scenarios and of the random policy."""
    out: Path | None = None
    """JSON file for the results; nothing is written without it."""
    markdown: bool = False
    """Print the table in Markdown."""


@dataclasses.dataclass(frozen=True)
class Timing:
    """One repeat of one side: steps of all environments per second, and means over these steps."""

    steps_per_second: float
    detections: float
    live_tracks: float


def check(options: EnvironmentOptions, static: StaticParams, params: Params) -> None:
    """Raises ValueError, naming the option, before anything is measured."""
    counts = {"repeats": options.repeats, "steps": options.steps}
    counts |= {"stone_soup_steps": options.stone_soup_steps, "num_envs": min(options.num_envs, default=0)}
    for name, value in counts.items():
        require_integer(name, value, 1)
    if len(set(options.num_envs)) < len(options.num_envs):
        raise ValueError(f"num_envs = {options.num_envs}: expected different numbers")
    require_integer("seed", options.seed, 0)
    left = params.max_steps_in_episode - static.num_looks**2 - 1
    for name in ("steps", "stone_soup_steps"):
        if counts[name] > left:
            raise ValueError(f"{name} = {counts[name]}: expected at most {left}, the rest of the episode")
    if options.out is not None:
        require_file("out", options.out)


def time_ours(
    compiled: Any, key: jax.Array, start: Start, params: Params, options: EnvironmentOptions
) -> Timing:
    """Plays the same piece of an episode with fresh noise until the time is over.

    What it starts from lies on the devices before: in use it comes from the call before.
    """
    seconds, detections, live_tracks = 0.0, list[float](), list[float]()
    num_envs = start[1].time.shape[0]
    while seconds < options.min_seconds or not detections:
        key = jax.random.fold_in(key, len(detections))
        keys = jax.random.split(key, num_envs)
        placed = jax.block_until_ready(jax.device_put((keys, start, params), compiled.input_shardings[0]))
        began = time.perf_counter()
        _, logged = jax.block_until_ready(compiled(*placed))
        seconds += time.perf_counter() - began
        detections.append(float(logged["num_detections"].mean()))
        live_tracks.append(float(logged["live_tracks"].mean()))
    steps = len(detections) * options.steps * num_envs
    return Timing(steps / seconds, float(np.mean(detections)), float(np.mean(live_tracks)))


def time_stone_soup(look: Look, static: StaticParams, params: Params, steps: int, seed: int) -> Timing:
    """A new scenario, one raster, then `steps` timed steps."""
    rng = np.random.default_rng(seed)
    scenario = StoneSoupScenario(static, params)
    scenario.reset(seed)
    play_stone_soup(scenario, raster_look, static.num_looks**2, rng)
    began = time.perf_counter()
    detections, live_tracks = play_stone_soup(scenario, look, steps, rng)
    return Timing(steps / (time.perf_counter() - began), detections, live_tracks)


POLICIES: dict[str, tuple[policies.PolicyBuilder | None, Look]] = {
    "random": (None, random_look),
    "pointing": (pointing, pointing_look),
}
"""Our side, None for looks drawn before the first step, and theirs."""


def measure(
    options: EnvironmentOptions,
    static: StaticParams,
    params: Params,
    progress: Progress,
) -> list[dict[str, Any]]:
    """Times both sides in turns, so that whatever else the machine does hits both.

    Returns:
        One row for each policy and number of environments.
    """
    env, params = make(params, static)
    cases = list(product(POLICIES, options.num_envs))
    task = progress.add_task("compiling", total=len(cases) + len(POLICIES) * options.repeats)
    find_tracks = jax.jit(lambda key, params: raster(key, params, env, max(options.num_envs)))
    keys = jax.random.split(jax.random.key(options.seed), (options.repeats, 2))
    starts = [find_tracks(key, params) for key in keys[:, 0]]
    plays, compile_seconds = {}, {}
    for policy, count in cases:
        build, few = POLICIES[policy][0], first(count, starts[0])
        plays[policy, count], seconds = compile_play(env, params, few, build, options.steps)
        compile_seconds[policy, count] = seconds
        progress.advance(task)

    progress.update(task, description="measuring")
    ours: dict[tuple[str, int], list[Timing]] = {case: [] for case in cases}
    theirs: dict[str, list[Timing]] = {policy: [] for policy in POLICIES}
    for repeat, policy in product(range(options.repeats), POLICIES):
        seed, look = options.seed + repeat, POLICIES[policy][1]
        theirs[policy].append(time_stone_soup(look, static, params, options.stone_soup_steps, seed))
        for count in options.num_envs:
            few = first(count, starts[repeat])
            timing = time_ours(plays[policy, count], keys[repeat, 1], few, params, options)
            ours[policy, count].append(timing)
        progress.advance(task)
    return [make_row(case, ours[case], theirs[case[0]], compile_seconds[case]) for case in cases]


def make_row(
    case: tuple[str, int], ours: list[Timing], theirs: list[Timing], compile_seconds: float
) -> dict[str, Any]:
    """What one policy and number of environments gave."""
    row: dict[str, Any] = {"policy": case[0], "num_envs": case[1], "compile_seconds": compile_seconds}
    for side, timings in (("jaxtrack", ours), ("stone_soup", theirs)):
        row[side] = {
            "steps_per_second": spread([timing.steps_per_second for timing in timings]),
            "detections_per_step": float(np.mean([timing.detections for timing in timings])),
            "live_tracks": float(np.mean([timing.live_tracks for timing in timings])),
        }
    medians = [row[side]["steps_per_second"]["median"] for side in ("jaxtrack", "stone_soup")]
    return {**row, "ratio": medians[0] / medians[1]}


HEADER = (
    "policy", "environments", "jaxtrack, steps/s", "Stone Soup, steps/s", "ratio",
    "detections per step", "live tracks", "compiled in",
)  # fmt: skip


def cells(row: dict[str, Any]) -> list[str]:
    """The row under `HEADER`; pairs are ours / Stone Soup's."""
    sides = [row["jaxtrack"], row["stone_soup"]]
    speeds = [side["steps_per_second"] for side in sides]
    return [
        row["policy"],
        str(row["num_envs"]),
        *(f"{speed['median']:,.0f} ({speed['min']:,.0f} - {speed['max']:,.0f})" for speed in speeds),
        f"{row['ratio']:,.0f}",
        *(
            " / ".join(f"{side[name]:.2f}" for side in sides)
            for name in ("detections_per_step", "live_tracks")
        ),
        f"{row['compile_seconds']:.1f} s",
    ]


def main(argv: Sequence[str]) -> int:
    """The command; returns the exit code."""
    options = parse(EnvironmentOptions(), argv, "python -m benchmarks.environment")
    static, params = StaticParams(), Params()
    check(options, static, params)
    report = circumstances()
    console = Console(width=None if sys.stdout.isatty() else 150)
    with Progress(console=console, disable=not console.is_terminal) as progress:
        rows = measure(options, static, params, progress)
    machine = report["machine"]
    title = (
        f"median of {options.repeats} repeats (smallest - largest); pairs are jaxtrack / Stone Soup; "
        f"{machine['processor']}, {jax.device_count()} of {machine['cores']} cores, {machine['jax_backend']}"
    )
    print_table(HEADER, [cells(row) for row in rows], title, options.markdown, console)
    if options.out is not None:
        write_report(options.out, report, options, scenario={**vars(static), **vars(params)}, rows=rows)
    return 0


if __name__ == "__main__":
    run(main)
