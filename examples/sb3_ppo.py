"""Stable-Baselines3's PPO on our environment, and on Stone Soup's beside it: `python -m examples.sb3_ppo`.

Needs the extras `sb3` and `reference`: `pip install -e ".[sb3,reference]"`.
"""

import dataclasses
import time
from collections.abc import Sequence

import numpy as np
from gymnasium import spaces
from gymnasium.wrappers import TransformObservation
from rich.table import Table
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecMonitor

from jaxtrack.cli import parse, require_integer, run, wide_console
from jaxtrack.params import Params, StaticParams
from jaxtrack.sb3 import SearchTrackVecEnv
from reference.gym_env import StoneSoupEnv


@dataclasses.dataclass(frozen=True)
class Sb3Options:
    """Trains Stable-Baselines3's PPO for a while on our environment and on Stone Soup's: steps per second."""

    steps: int = 16_384
    """Steps to train on ours."""
    num_envs: int = 64
    """How many of ours are stepped together."""
    rollout: int = 8_192
    """Steps of ours between two updates of the agent."""
    stone_soup_steps: int = 512
    """Steps to train on Stone Soup's, of which there is one, as in the paper; 0 leaves it out."""
    max_steps_in_episode: int = 250
    """Length of an episode (steps)."""
    seed: int = 0
    """Of the environments and of the learner."""


class CollectingTime(BaseCallback):
    """Seconds spent on collecting steps: the policy's and the environment's, without the learner's."""

    seconds = 0.0

    def _on_rollout_start(self) -> None:
        self._began = time.perf_counter()

    def _on_rollout_end(self) -> None:
        self.seconds += time.perf_counter() - self._began

    def _on_step(self) -> bool:
        return True


def train(env: VecEnv, steps: int, rollout: int, seed: int) -> tuple[PPO, float, float]:
    """The agent, and the seconds that training it took and that of these went into collecting steps."""
    model = PPO(
        "MultiInputPolicy",  # a NatureCNN for the scan map, beside the flattened track list
        env,
        n_steps=rollout // env.num_envs,
        batch_size=min(rollout, 512),
        n_epochs=2,
        learning_rate=5e-4,
        seed=seed,
        device="cpu",
    )
    env.reset()
    env.step(np.zeros((env.num_envs, 2), int))  # compiles
    collecting, began = CollectingTime(), time.perf_counter()
    model.learn(steps, callback=collecting)
    return model, time.perf_counter() - began, collecting.seconds


def stone_soup(options: Sb3Options, space: spaces.Space) -> VecEnv:
    """The same scenario in Stone Soup, its scan map as the same image: observations of the same space."""
    params = Params(max_steps_in_episode=options.max_steps_in_episode)
    env = StoneSoupEnv(StaticParams(reward="information"), params)

    def as_image(observation: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        return {**observation, "scan_map": np.round(255 * observation["scan_map"])[None].astype(np.uint8)}

    return DummyVecEnv([lambda: TransformObservation(env, as_image, space)])


def main(argv: Sequence[str]) -> int:
    """Trains and prints the table."""
    options = parse(Sb3Options(), argv, "python -m examples.sb3_ppo")
    for name, low in {"steps": 1, "num_envs": 1, "rollout": 2 * options.num_envs}.items():
        require_integer(name, getattr(options, name), low)
    require_integer("stone_soup_steps", options.stone_soup_steps, 0)
    ours = SearchTrackVecEnv(
        options.num_envs, reward="information", max_steps_in_episode=options.max_steps_in_episode
    )
    runs: list[tuple[str, VecEnv, int, int]] = [("jaxtrack", ours, options.steps, options.rollout)]
    if options.stone_soup_steps:
        steps = options.stone_soup_steps
        runs.append(
            ("Stone Soup", stone_soup(options, ours.observation_space), steps, min(steps, options.rollout))
        )
    table = Table("environment", "together", "steps", "steps/s", "collecting, steps/s", "mean return")
    for name, env, steps, rollout in runs:
        model, seconds, collecting = train(VecMonitor(env), steps, rollout, options.seed)
        done = model.num_timesteps
        returns = [episode["r"] for episode in model.ep_info_buffer or []]
        mean = f"{np.mean(returns):.1f} (last {len(returns)} episodes)" if returns else "no episode ended"
        rates = [f"{done / seconds:,.0f}", f"{done / collecting:,.0f}"]
        table.add_row(name, str(env.num_envs), f"{done:,}", *rates, mean)
    wide_console().print(table)
    return 0


if __name__ == "__main__":
    run(main)
