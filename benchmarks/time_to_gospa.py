"""How long our training takes to reach a stated GOSPA, for `benchmarks.training`."""

import dataclasses
import time
from collections.abc import Callable, Sequence
from typing import Any

import jax
from rich.console import Console

from benchmarks.ppo import build_learner
from jaxtrack.env import SearchTrack, make
from jaxtrack.report import print_table, written
from train.agents import agent_policy
from train.config import NO_WARM_START, TrainConfig, check
from train.episodes import play_episodes
from train.evaluate import COMPARED_SEED

EPISODES = 32
"""Scenarios of an evaluation; there are other ones to confirm the last."""
RATE_WITHOUT_WARM_START = 3e-3
"""As `TrainConfig` advises."""


def configure(warm_start: str, total_steps: int, seed: int) -> TrainConfig:
    """The default configuration of `python -m train.ppo` but for these.

    Raises:
        ValueError: naming what is out of range.
    """
    config = TrainConfig(warm_start=warm_start, total_steps=total_steps, seed=seed)
    if warm_start == NO_WARM_START:
        config = dataclasses.replace(config, learning_rate=RATE_WITHOUT_WARM_START)
    check(config)
    return config


def compile_evaluation(config: TrainConfig, env: SearchTrack, weights: Any) -> Callable[[Any, int], float]:
    """The mean GOSPA (m) over whole episodes of an agent with given weights, on scenarios of a seed."""
    params = config.params

    def mean_gospa(weights: Any, keys: jax.Array) -> jax.Array:
        act = agent_policy(config.encoder, weights, head=config.head)(env.static, params)
        return play_episodes(keys, act, env, params, int(params.max_steps_in_episode))[0]["gospa"].mean()

    def keys(seed: int) -> jax.Array:
        return jax.random.split(jax.random.key(seed), EPISODES)

    compiled = jax.jit(mean_gospa).lower(weights, keys(0)).compile()
    return lambda weights, seed: float(compiled(weights, keys(seed)))


def train_until(goal: float, config: TrainConfig) -> dict[str, Any]:
    """Trains until an evaluation, one after every update, finds a mean GOSPA of at most `goal` (m).

    Returns:
        Whether it was reached; environment steps and seconds until then, compiling and evaluations
        included; of them, seconds of compiling; the GOSPA of every evaluation, and the last agent's on
        other scenarios, as stopping at the first good evaluation flatters it.
    """
    began = time.perf_counter()
    env, _ = make(config.params, config.static)
    learner = build_learner(config, env)
    evaluate = compile_evaluation(config, env, jax.device_get(learner.state.weights))
    compiled, evaluations = time.perf_counter() - began, list[dict[str, float]]()
    for update in range(1, config.num_updates + 1):
        learner()
        weights = jax.device_get(learner.state.weights)
        gospa = evaluate(weights, COMPARED_SEED + 1)
        seconds = time.perf_counter() - began
        steps = update * config.batch_size
        evaluations.append({"env_steps": steps, "seconds": seconds, "gospa": gospa})
        if gospa <= goal:
            break
    return {
        "goal": goal,
        "warm_start": config.warm_start,
        "reached": gospa <= goal,
        "env_steps": steps,
        "seconds": seconds,
        "compile_seconds": compiled,
        "gospa": gospa,
        "gospa_on_other_scenarios": evaluate(weights, COMPARED_SEED),
        "evaluations": evaluations,
    }


def hours_of_theirs(steps: int, row: dict[str, Any]) -> float:
    """Hours of Stable-Baselines3 on Stone Soup for so many steps, by the median speed in `row`."""
    return float(steps / row["stone_soup"]["steps_per_second"]["median"] / 3600)


def show(found: dict[str, Any], rows: Sequence[dict[str, Any]], markdown: bool, console: Console) -> None:
    """Prints what `train_until` found beside what as many steps take on the other side."""
    header = (
        "first imitates", "GOSPA, m", "on other scenarios, m", "environment steps", "seconds",
        "of them compiling",
        *(f"as many steps of theirs, {row['encoder']}" for row in rows),
    )  # fmt: skip
    cells = [
        found["warm_start"],
        f"{found['gospa']:.1f}",
        f"{found['gospa_on_other_scenarios']:.1f}",
        f"{found['env_steps']:,}",
        f"{found['seconds']:.0f}",
        f"{found['compile_seconds']:.0f}",
        *(f"{written(hours_of_theirs(found['env_steps'], row))} h" for row in rows),
    ]
    came = "reached" if found["reached"] else "NOT REACHED"
    title = (
        f"our default agent until its mean GOSPA over {EPISODES} scenarios is at most {found['goal']:g} m: "
        f"{came}; hours are EXTRAPOLATED from steps/s above, whatever theirs would have learned"
    )
    if markdown:
        print()
    print_table(header, [cells], title, markdown, console)
