"""Decisions per second of our sensor managers and of Stone Soup's: `python -m benchmarks.planning`."""

import dataclasses
import functools
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
from rich.progress import Progress

from benchmarks.playing import first, raster
from jaxtrack import policies
from jaxtrack.cli import parse, require_file, require_integer, require_positive, run, wide_console
from jaxtrack.env import make
from jaxtrack.episode import EnvState
from jaxtrack.managers import expected_falls, greedy, rollout, uncertainty
from jaxtrack.params import Params, StaticParams
from jaxtrack.report import circumstances, print_table, spread, with_spread, write_report
from jaxtrack.scan_map import look_grid
from reference.components import time_of
from reference.managers import build_manager, look_of
from reference.translate import to_stone_soup_tracks
from train.agents import agent_policy
from train.saved_run import load_run

DIFFERENT = 1
TOLERANCE = 1e-3
STONE_SOUP = "Stone Soup, brute force"
SAME_RULE = "uncertainty"


@dataclasses.dataclass(frozen=True)
class PlanningOptions:
    """Times one decision of every manager on the same track lists, in turns."""

    num_states: tuple[int, ...] = (1, 64)
    """Numbers of states on which we decide together."""
    candidates: tuple[int, ...] = (8, 32)
    """Looks that the rollout planner tries."""
    horizons: tuple[int, ...] = (10, 20)
    """Steps that it looks ahead."""
    runs: tuple[Path, ...] = ()
    """Trained agents to time beside them: folders of runs or of exported agents, as agents/beams."""
    repeats: int = 5
    """Times that everything is timed."""
    stone_soup_decisions: int = 2
    """Decisions of Stone Soup in one repeat, each on another track list."""
    min_seconds: float = 0.5
    """Ours decides again and again for at least this long in one repeat (s)."""
    seed: int = 0
    """Seed of the scenarios."""
    out: Path | None = None
    """JSON file for the results; nothing is written without it."""
    markdown: bool = False
    """Print the table in Markdown."""


def check(options: PlanningOptions, static: StaticParams) -> None:
    """Raises ValueError, naming the option, before anything is measured."""
    counts = {"repeats": options.repeats, "stone_soup_decisions": options.stone_soup_decisions}
    for name in ("num_states", "candidates", "horizons"):
        values = getattr(options, name)
        if len(set(values)) < len(values) or not values:
            raise ValueError(f"{name} = {values}: expected different numbers")
        counts[name] = min(values)
    for name, value in counts.items():
        require_integer(name, value, 1)
    if max(options.candidates) > static.num_looks**2:
        raise ValueError(f"candidates = {max(options.candidates)}: expected at most {static.num_looks**2}")
    require_positive("min_seconds", options.min_seconds)
    require_integer("seed", options.seed, 0)
    if options.out is not None:
        require_file("out", options.out)


def managers(options: PlanningOptions) -> dict[str, policies.PolicyBuilder]:
    """What is timed, by the name in the table."""
    planners = {
        f"rollout, {candidates} looks, {horizon} steps": functools.partial(
            rollout, candidates=candidates, horizon=horizon
        )
        for candidates in options.candidates
        for horizon in options.horizons
    }
    agents = {f"agent, {folder.name}": agent(folder) for folder in options.runs}
    return {"index": policies.index, SAME_RULE: uncertainty, "greedy": greedy, **planners, **agents}


def agent(folder: Path) -> policies.PolicyBuilder:
    """A trained agent, which observes what it was trained on.

    Raises:
        ValueError: naming the folder, if it holds none.
    """
    config, env, weights = load_run(folder)
    build = agent_policy(config.encoder, weights, head=config.head)
    return lambda static, params: build(env.static, config.params)


def scenes(static: StaticParams, params: Params, count: int, seed: int) -> EnvState:
    """States `[count]` after one raster over the field, so that tracks exist."""
    env, params = make(params, static)
    scan_field = jax.jit(lambda key, params: raster(key, params, env, count)[1])
    return jax.block_until_ready(scan_field(jax.random.key(seed), params))


def compile_policy(
    build: policies.PolicyBuilder, static: StaticParams, params: Params, states: EnvState
) -> tuple[Any, float]:
    """The policy compiled for states `[B]` and called once, and the seconds that compiling took."""
    began = time.perf_counter()
    # What does not depend on the state is computed when the policy is built, once.
    decide = jax.jit(jax.vmap(build(static, params), in_axes=(None, 0)))
    compiled = decide.lower(jax.random.key(0), states).compile()
    seconds = time.perf_counter() - began
    jax.block_until_ready(compiled(jax.random.key(0), states))
    return compiled, seconds


def time_ours(compiled: Any, states: EnvState, min_seconds: float) -> float:
    """Decisions per second on states `[B]`."""
    key, calls, began = jax.random.key(0), 0, time.perf_counter()
    while (seconds := time.perf_counter() - began) < min_seconds or not calls:
        jax.block_until_ready(compiled(key, states))
        calls += 1
    return calls * states.time.shape[0] / seconds


def time_stone_soup(
    states: EnvState, static: StaticParams, params: Params
) -> tuple[float, list[tuple[int, int]]]:
    """Decisions per second on states `[B]`, one after the other, and the looks chosen."""
    manager, looks, seconds = build_manager(static, params), [], 0.0
    for place in range(states.time.shape[0]):
        state = jax.tree.map(lambda leaf, place=place: leaf[place], states)
        step = int(state.time)
        tracks = to_stone_soup_tracks(state.tracks, time_of(step, params))
        began = time.perf_counter()
        (config,) = manager.choose_actions(tracks, time_of(step + 1, params))
        seconds += time.perf_counter() - began
        looks.append(look_of(config))
    return len(looks) / seconds, looks


def count_different(
    states: EnvState, looks: list[tuple[int, int]], static: StaticParams, params: Params
) -> int:
    """In how many states `[B]` Stone Soup's look is not the best by the same rule of ours.

    Looks that hold the same tracks are equally good; the tolerance is that of float32.
    """
    grid = look_grid(static, params)
    falls = jax.jit(jax.vmap(lambda tracks: expected_falls(tracks, grid, params)))(states.tracks)
    theirs = np.array([look[0] * static.num_looks + look[1] for look in looks])
    chosen = np.take_along_axis(np.asarray(falls), theirs[:, None], axis=1)[:, 0]
    return int(np.sum(chosen < np.max(falls, axis=1) * (1 - TOLERANCE)))


def measure(
    options: PlanningOptions, static: StaticParams, params: Params, progress: Progress
) -> dict[str, Any]:
    """Times all in turns, so that whatever else the machine does hits all.

    Returns:
        One row for each manager and number of states, Stone Soup's first; mean number of live
        tracks; in how many decisions Stone Soup and ours by the same rule differ.
    """
    built = managers(options)
    cases = [(name, count) for name in built for count in options.num_states]
    task = progress.add_task("compiling", total=len(cases) + options.repeats)
    most = max(*options.num_states, options.stone_soup_decisions)
    states = scenes(static, params, most, options.seed)
    few = {count: first(count, states) for count in (*options.num_states, options.stone_soup_decisions)}
    compiled, compile_seconds = {}, {}
    for name, count in cases:
        case = name, count
        compiled[case], compile_seconds[case] = compile_policy(built[name], static, params, few[count])
        progress.advance(task)

    progress.update(task, description="measuring")
    speeds: dict[tuple[str, int], list[float]] = {case: [] for case in [(STONE_SOUP, 1), *cases]}
    for _ in range(options.repeats):
        speed, looks = time_stone_soup(few[options.stone_soup_decisions], static, params)
        speeds[STONE_SOUP, 1].append(speed)
        for name, count in cases:
            speeds[name, count].append(time_ours(compiled[name, count], few[count], options.min_seconds))
        progress.advance(task)
    rows = [make_row(case, speeds, compile_seconds.get(case)) for case in speeds]
    different = count_different(few[options.stone_soup_decisions], looks, static, params)
    live_tracks = float(np.mean(np.sum(states.tracks.active, axis=1)))
    return {"rows": rows, "live_tracks": live_tracks, "different_decisions": different}


def make_row(
    case: tuple[str, int], speeds: dict[tuple[str, int], list[float]], compile_seconds: float | None
) -> dict[str, Any]:
    """What one manager and number of states gave; the ratio is to Stone Soup's median."""
    return {
        "manager": case[0],
        "num_states": case[1],
        "decisions_per_second": spread(speeds[case]),
        "ratio": float(np.median(speeds[case]) / np.median(speeds[STONE_SOUP, 1])),
        "compile_seconds": compile_seconds,
    }


HEADER = ("manager", "states", "decisions/s", "ratio", "compiled in")


def cells(row: dict[str, Any]) -> list[str]:
    """The row under `HEADER`."""
    speed, seconds = row["decisions_per_second"], row["compile_seconds"]
    return [
        row["manager"],
        str(row["num_states"]),
        with_spread(speed),
        f"{row['ratio']:,.0f}",
        "" if seconds is None else f"{seconds:.1f} s",
    ]


def main(argv: Sequence[str]) -> int:
    """The command; returns the exit code."""
    options = parse(PlanningOptions(), argv, "python -m benchmarks.planning")
    static, params = StaticParams(), Params()
    check(options, static)
    report, console = circumstances(), wide_console()
    with Progress(console=console, disable=not console.is_terminal) as progress:
        found = measure(options, static, params, progress)
    different, machine = found["different_decisions"], report["machine"]
    title = (
        f"median of {options.repeats} repeats (smallest - largest); {found['live_tracks']:.1f} live tracks; "
        f"Stone Soup and {SAME_RULE!r} choose {f'DIFFERENTLY {different} times' if different else 'alike'}; "
        f"{machine['processor']}, {machine['cores']} cores, {machine['jax_backend']}"
    )
    print_table(HEADER, [cells(row) for row in found["rows"]], title, options.markdown, console)
    if options.out is not None:
        write_report(options.out, report, options, scenario={**vars(static), **vars(params)}, **found)
    return DIFFERENT if different else 0


if __name__ == "__main__":
    run(main)
