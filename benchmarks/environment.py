"""Steps per second of our environment and of Stone Soup's: `python -m benchmarks.environment`."""

import dataclasses
import json
import os
import platform
import time
from collections.abc import Callable, Sequence
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

from jaxtrack import policies
from jaxtrack.cli import parse, run
from jaxtrack.env import EnvState, SearchTrack, make
from jaxtrack.observation import Observation
from jaxtrack.params import Params, StaticParams
from reference.simulation import StoneSoupScenario
from reference.translate import as_vector

Start = tuple[Observation, EnvState]
Look = Callable[[StoneSoupScenario, np.random.Generator], Sequence[int] | np.ndarray]
"""Azimuth and elevation index of Stone Soup's next look."""

PACKAGES = ("jaxtrack", "jax", "jaxlib", "gymnax", "numpy", "stonesoup")


@dataclasses.dataclass(frozen=True)
class EnvironmentOptions:
    """Times our environment and Stone Soup's on the same scenario, in turns."""

    num_envs: tuple[int, ...] = (1, 64)
    """Numbers of our environments stepped together."""
    repeats: int = 5
    """Scenarios on which everything is timed once."""
    steps: int = 300
    """Steps of ours in one call, after the raster that finds the tracks."""
    stone_soup_steps: int = 300
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
        if value < 1:
            raise ValueError(f"{name} = {value}: expected an integer >= 1")
    if options.seed < 0:
        raise ValueError(f"seed = {options.seed}: expected an integer >= 0")
    left = params.max_steps_in_episode - static.num_looks**2 - 1
    for name in ("steps", "stone_soup_steps"):
        if counts[name] > left:
            raise ValueError(f"{name} = {counts[name]}: expected at most {left}, the rest of the episode")
    if options.out is not None and not options.out.parent.is_dir():
        raise ValueError(f"out = {str(options.out)!r}: expected a file in a folder that exists")


# ---- ours


def pointing(static: StaticParams, params: Params) -> policies.Policy:
    """The look nearest to truth 0, 1, 2, ... in turn: a stand-in for an agent that finds its targets."""

    def policy(key: jax.Array, state: EnvState) -> jax.Array:
        del key
        truth = state.truths.state[state.time % static.num_truths]
        return policies.to_action(policies.nearest_look(truth, static, params), static, params)

    return policy


def play(
    key: jax.Array,
    start: Start,
    params: Params,
    env: SearchTrack,
    build: policies.PolicyBuilder,
    steps: int,
) -> tuple[Start, dict[str, jax.Array]]:
    """Steps the environments of `start` `[B]` together, through gymnax's `step`.

    Returns:
        The last observation and state, and the means of reward and of every scalar of `info`:
        all of them are asked for, so that none is optimised away.
    """
    policy = build(env.static, params)
    num_envs = start[1].time.shape[0]
    key_policy, key_steps = jax.random.split(key)
    policy_keys = jax.random.split(key_policy, num_envs)

    def one_step(carry: Start, keys: jax.Array) -> tuple[Start, dict[str, jax.Array]]:
        _, state = carry
        action = jax.vmap(policy)(policy_keys, state)
        observation, state, reward, _, _, info = jax.vmap(env.step, in_axes=(0, 0, 0, None))(
            keys, state, action, params
        )
        del info["final_observation"]
        return (observation, state), jax.tree.map(jnp.mean, {**info, "reward": reward})

    end, logged = jax.lax.scan(one_step, start, jax.random.split(key_steps, (steps, num_envs)))
    return end, jax.tree.map(jnp.mean, logged)


def raster(key: jax.Array, params: Params, env: SearchTrack, num_envs: int) -> Start:
    """New scenarios `[B]` after one raster over the field, so that tracks exist."""
    key_reset, key_play = jax.random.split(key)
    start = jax.vmap(env.reset, in_axes=(0, None))(jax.random.split(key_reset, num_envs), params)
    return play(key_play, start, params, env, policies.coverage, env.static.num_looks**2)[0]


def compile_play(
    env: SearchTrack, params: Params, start: Start, build: policies.PolicyBuilder, steps: int
) -> tuple[Any, float]:
    """The compiled `play`, and the seconds that tracing and compiling took."""
    began = time.perf_counter()
    jitted = jax.jit(lambda key, start, params: play(key, start, params, env, build, steps))
    return jitted.lower(jax.random.key(0), start, params).compile(), time.perf_counter() - began


def time_ours(
    compiled: Any, key: jax.Array, start: Start, params: Params, options: EnvironmentOptions
) -> Timing:
    """Plays the same piece of an episode with fresh noise until the time is over; one call warms up."""
    jax.block_until_ready(compiled(key, start, params))
    seconds, detections, live_tracks = 0.0, [], []
    while seconds < options.min_seconds or not detections:
        key = jax.block_until_ready(jax.random.fold_in(key, len(detections)))
        began = time.perf_counter()
        _, logged = jax.block_until_ready(compiled(key, start, params))
        seconds += time.perf_counter() - began
        detections.append(float(logged["num_detections"]))
        live_tracks.append(float(logged["live_tracks"]))
    steps = len(detections) * options.steps * start[1].time.shape[0]
    return Timing(steps / seconds, float(np.mean(detections)), float(np.mean(live_tracks)))


# ---- Stone Soup: the same looks by the same rules


def raster_look(scenario: StoneSoupScenario, rng: np.random.Generator) -> Sequence[int]:
    """As `policies.coverage`."""
    del rng
    count = scenario.static.num_looks
    line, place = divmod(scenario.step_index, count)
    return place if line % 2 == 0 else count - 1 - place, line % count


def random_look(scenario: StoneSoupScenario, rng: np.random.Generator) -> np.ndarray:
    """As `policies.random`."""
    return rng.integers(scenario.static.num_looks, size=2)


def pointing_look(scenario: StoneSoupScenario, rng: np.random.Generator) -> np.ndarray:
    """As `pointing`."""
    del rng
    truth = scenario.paths[scenario.step_index % len(scenario.paths)][-1]
    x, _, y, _, z, _ = as_vector(truth.state_vector)
    angles = np.array([np.arctan2(y, x), np.arctan2(z, np.hypot(x, y))])
    last = scenario.static.num_looks - 1
    return np.clip(np.round((angles / scenario.params.field_limit + 1) / 2 * last), 0, last)


def play_stone_soup(
    scenario: StoneSoupScenario, look: Look, steps: int, rng: np.random.Generator
) -> tuple[float, float]:
    """Steps the scenario; mean number of detections and of live tracks."""
    detections = live_tracks = 0.0
    for _ in range(steps):
        index = np.asarray(look(scenario, rng))
        azimuth, elevation = scenario.params.field_limit * (2 * index / (scenario.static.num_looks - 1) - 1)
        _, info = scenario.step(azimuth, elevation)
        detections += info["num_detections"]
        live_tracks += info["live_tracks"]
    return detections / steps, live_tracks / steps


def time_stone_soup(look: Look, static: StaticParams, params: Params, steps: int, seed: int) -> Timing:
    """A new scenario, one raster, then `steps` timed steps."""
    rng = np.random.default_rng(seed)
    scenario = StoneSoupScenario(static, params)
    scenario.reset(seed)
    play_stone_soup(scenario, raster_look, static.num_looks**2, rng)
    began = time.perf_counter()
    detections, live_tracks = play_stone_soup(scenario, look, steps, rng)
    return Timing(steps / (time.perf_counter() - began), detections, live_tracks)


POLICIES: dict[str, tuple[policies.PolicyBuilder, Look]] = {
    "random": (policies.random, random_look),
    "pointing": (pointing, pointing_look),
}


# ---- both, in turns


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
    most = max(options.num_envs)
    task = progress.add_task("compiling", total=len(POLICIES) * (len(options.num_envs) + options.repeats))
    find_tracks = jax.jit(lambda key, params: raster(key, params, env, most))
    key = jax.random.key(options.seed)
    start = find_tracks(key, params)
    plays, compile_seconds = {}, {}
    for case in [(policy, count) for policy in POLICIES for count in options.num_envs]:
        few = jax.tree.map(lambda x, count=case[1]: x[:count], start)
        plays[case], compile_seconds[case] = compile_play(env, params, few, POLICIES[case[0]][0], options.steps)
        progress.advance(task)
    progress.update(task, description="measuring")
    ours: dict[Any, list[Timing]] = {case: [] for case in plays}
    theirs: dict[str, list[Timing]] = {policy: [] for policy in POLICIES}
    for repeat in range(options.repeats):
        key_start, key_play = jax.random.split(jax.random.fold_in(key, repeat))
        start = find_tracks(key_start, params)
        seed = options.seed + repeat
        for policy, (_, look) in POLICIES.items():
            theirs[policy].append(time_stone_soup(look, static, params, options.stone_soup_steps, seed))
            for count in options.num_envs:
                few = jax.tree.map(lambda x, count=count: x[:count], start)
                ours[policy, count].append(time_ours(plays[policy, count], key_play, few, params, options))
            progress.advance(task)
    return [row(case, ours[case], theirs[case[0]], compile_seconds[case]) for case in plays]


def row(
    case: tuple[str, int], ours: list[Timing], theirs: list[Timing], compile_seconds: float
) -> dict[str, Any]:
    """What one policy and number of environments gave."""
    sides = {"jaxtrack": summary(ours), "stone_soup": summary(theirs)}
    ratio = sides["jaxtrack"]["median"] / sides["stone_soup"]["median"]
    return {
        "policy": case[0],
        "num_envs": case[1],
        **sides,
        "ratio": ratio,
        "compile_seconds": compile_seconds,
    }
