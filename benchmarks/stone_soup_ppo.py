"""Stock Stable-Baselines3 PPO on the Stone Soup environment, as the paper trained.

Rollout and update are timed apart. Needs the extras `sb3` and `reference`; only
`benchmarks.training` and its tests import it.
"""

from typing import Any

import gymnasium
import numpy as np
from gymnasium.wrappers import TransformObservation
from stable_baselines3 import PPO
from stable_baselines3.common.buffers import DictRolloutBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv

from benchmarks.ppo import Seconds, seconds_of
from benchmarks.torch_learner import Arrays, build_ppo, threads
from jaxtrack.params import Params, StaticParams
from reference.gym_env import StoneSoupEnv
from train.config import TrainConfig

__all__ = ["StoneSoupPPO", "threads"]

ARRAYS = ("actions", "rewards", "returns", "episode_starts", "values", "log_probs", "advantages")
"""Of a rollout buffer, beside the observations: `[S, B, ...]`."""


def for_the_network(observation: Arrays) -> Arrays:
    """The observation with live tracks first, as packed lists need them, and the map as a channel.

    Live tracks keep their order, so that a recurrent network sees what ours sees.
    """
    order = np.argsort(observation["mask"] == 0, kind="stable")
    return {
        "tracks": observation["tracks"][order],
        "mask": observation["mask"][order],
        "scan_map": observation["scan_map"][None],
    }


def build_env(static: StaticParams, params: Params, num_envs: int) -> VecEnv:
    """Stone Soup's scenarios, stepped one after the other in this process."""

    def one() -> gymnasium.Env[Any, Any]:
        env = StoneSoupEnv(static, params)
        shown = env.observation_space
        assert isinstance(shown, gymnasium.spaces.Dict)
        pixels = gymnasium.spaces.Box(0.0, 1.0, (1, static.map_size, static.map_size), np.float32)
        space = gymnasium.spaces.Dict({**shown.spaces, "scan_map": pixels})
        return TransformObservation(env, for_the_network, space)

    return DummyVecEnv([one] * num_envs)


class CountTracks(BaseCallback):
    """Mean number of live tracks of the steps of a rollout."""

    def _on_rollout_start(self) -> None:
        self._counts: list[int] = []

    def _on_step(self) -> bool:
        self._counts += [info["live_tracks"] for info in self.locals["infos"]]
        return True

    @property
    def mean(self) -> float:
        """Of the last rollout."""
        return float(np.mean(self._counts))


class StoneSoupPPO:
    """`PPO.learn` in two halves, so that a short rollout can be timed beside the update of a full batch.

    Args:
        config: of the learner; `num_envs` and `rollout_steps` are Stone Soup's.
        piece: steps of every environment in a timed rollout; they divide `rollout_steps`.

    Attributes:
        pieces: how many of them are a whole rollout.
        tracks: counts the live tracks.
    """

    def __init__(self, config: TrainConfig, piece: int) -> None:
        self.piece, self.pieces = piece, config.rollout_steps // piece
        self.model: PPO = build_ppo(config, build_env(config.static, config.params, config.num_envs))
        self.tracks = CountTracks()
        # As `learn` begins: resets the environments and opens the log.
        _, self._callback = self.model._setup_learn(config.batch_size, self.tracks)
        self._rollout = self._buffer(piece)

    @property
    def parameters(self) -> int:
        """Weights that are trained."""
        return sum(weight.numel() for weight in self.model.policy.parameters())

    def warm_up(self, steps: int) -> None:
        """At least so many steps of every environment, and one update."""
        for _ in range(-(-steps // self.piece)):
            self.collect()
        self.update()

    def collect(self) -> Seconds:
        """One piece: steps the environments with the policy."""
        env = self.model.env
        assert env is not None
        return seconds_of(lambda: self.model.collect_rollouts(env, self._callback, self._rollout, self.piece))

    def update(self) -> Seconds:
        """The update of a full batch, in which the last piece recurs until it is full."""
        self.model.rollout_buffer = self._full_batch()
        return seconds_of(self.model.train)

    def _buffer(self, steps: int) -> DictRolloutBuffer:
        model = self.model
        assert isinstance(model.observation_space, gymnasium.spaces.Dict)
        return DictRolloutBuffer(
            steps,
            model.observation_space,
            model.action_space,
            device=model.device,
            gae_lambda=model.gae_lambda,
            gamma=model.gamma,
            n_envs=model.n_envs,
        )

    def _full_batch(self) -> DictRolloutBuffer:
        """A batch of `rollout_steps`, made of the last piece again and again."""
        batch = self._buffer(self.model.n_steps)

        def again(rows: np.ndarray) -> np.ndarray:
            return np.tile(rows, (self.pieces, *[1] * (rows.ndim - 1)))

        batch.observations = {name: again(rows) for name, rows in self._rollout.observations.items()}
        for name in ARRAYS:
            setattr(batch, name, again(getattr(self._rollout, name)))
        batch.pos, batch.full = batch.buffer_size, True
        return batch
