"""The paper's networks in PyTorch, and Stable-Baselines3's PPO on an environment that costs nothing.

Written as one would for Stable-Baselines3, from PyTorch's own layers. Needs the extra `sb3`;
only benchmarks beside Stable-Baselines3 and their tests import it.
"""

from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.vec_env import VecEnv
from torch import nn
from torch.nn.utils.rnn import pack_padded_sequence

from train.config import TrainConfig

Arrays = dict[str, np.ndarray]
Tensors = dict[str, torch.Tensor]


class FlattenEncoder(nn.Module):
    """The zero-padded track list as one vector through one dense layer."""

    def __init__(self, tracks: int, features: int) -> None:
        super().__init__()
        self.dense = nn.Sequential(nn.Flatten(), nn.Linear(tracks * features, 64), nn.ReLU())

    def forward(self, tracks: torch.Tensor, mask: torch.Tensor) -> torch.Tensor:
        """Maps tracks `[B, T, F]` and mask `[B, T]` to a latent `[B, 64]`."""
        latent: torch.Tensor = self.dense(tracks * mask[..., None])
        return latent


class BiGRUEncoder(nn.Module):
    """PyTorch's bidirectional GRU over packed track lists; its final states through one dense layer."""

    def __init__(self, tracks: int, features: int, hidden: int = 64) -> None:
        super().__init__()
        del tracks
        self.gru = nn.GRU(features, hidden, batch_first=True, bidirectional=True)
        self.dense = nn.Sequential(nn.Linear(2 * hidden, 64), nn.ReLU())

    def forward(self, tracks: torch.Tensor, mask: torch.Tensor) -> torch.Tensor:
        """Maps tracks `[B, T, F]` and mask `[B, T]`, live tracks first, to a latent `[B, 64]`."""
        lengths = mask.sum(dim=1).to(torch.int64)
        # PyTorch packs no empty list: it gets one row, and then the state it would have had, zero.
        packed = pack_padded_sequence(
            tracks, lengths.clamp(min=1).cpu(), batch_first=True, enforce_sorted=False
        )
        _, final = self.gru(packed)
        states = torch.cat([final[0], final[1]], dim=1) * (lengths > 0)[:, None]
        latent: torch.Tensor = self.dense(states)
        return latent


class AttentionEncoder(nn.Module):
    """PyTorch's multi-head self-attention over the tracks, then a BiGRU of half the size."""

    def __init__(self, tracks: int, features: int, embedding: int = 64, heads: int = 4) -> None:
        super().__init__()
        self.embed = nn.Linear(features, embedding)
        self.attention = nn.MultiheadAttention(embedding, heads, batch_first=True)
        self.norm = nn.LayerNorm(embedding, eps=1e-6)
        self.bigru = BiGRUEncoder(tracks, embedding, hidden=32)

    def forward(self, tracks: torch.Tensor, mask: torch.Tensor) -> torch.Tensor:
        """Maps tracks `[B, T, F]` and mask `[B, T]`, live tracks first, to a latent `[B, 64]`."""
        x = self.embed(tracks)
        # An empty list attends to its padding: to nothing at all, it would give NaN.
        ignored = (mask == 0) & (mask.sum(dim=1, keepdim=True) > 0)
        mixed, _ = self.attention(x, x, x, key_padding_mask=ignored, need_weights=False)
        latent: torch.Tensor = self.bigru(self.norm(x + mixed), mask)
        return latent


ENCODERS: dict[str, Callable[[int, int], nn.Module]] = {
    "flatten": FlattenEncoder,
    "bigru": BiGRUEncoder,
    "mhsa": AttentionEncoder,
}
"""By the names of `train.networks.ENCODERS`."""


class PaperFeatures(BaseFeaturesExtractor):
    """NatureCNN on the scan map and a track-list encoder, side by side: `[B, 192]`."""

    def __init__(self, observation_space: gymnasium.spaces.Dict, encoder: str) -> None:
        super().__init__(observation_space, features_dim=128 + 64)
        size = observation_space["scan_map"].shape[-1]  # type: ignore[index]
        self.convolutions = nn.Sequential(
            nn.Conv2d(1, 32, 8, 4), nn.ReLU(), nn.Conv2d(32, 64, 4, 2), nn.ReLU(),
            nn.Conv2d(64, 64, 3, 1), nn.ReLU(), nn.Flatten(),
        )  # fmt: skip
        with torch.no_grad():
            outputs = self.convolutions(torch.zeros(1, 1, size, size)).shape[1]
        self.dense = nn.Sequential(nn.Linear(outputs, 128), nn.ReLU())
        tracks, features = observation_space["tracks"].shape  # type: ignore[misc]
        self.encoder = ENCODERS[encoder](tracks, features)

    def forward(self, observations: Tensors) -> torch.Tensor:
        """Observations of a batch to features."""
        z_sh = self.dense(self.convolutions(observations["scan_map"]))
        z_tl = self.encoder(observations["tracks"], observations["mask"])
        return torch.cat([z_sh, z_tl], dim=1)


class StillVecEnv(VecEnv):
    """The same observations at every step; no episode ends.

    Args:
        observations: `tracks` `[B, T, F]`, `mask` `[B, T]` and `scan_map` `[B, 1, M, M]`.
        num_looks: looks along each axis.
    """

    def __init__(self, observations: Arrays, num_looks: int) -> None:
        boxes: dict[str, gymnasium.spaces.Space[Any]] = {
            name: gymnasium.spaces.Box(-1.0, 1.0, values.shape[1:], np.float32)
            for name, values in observations.items()
        }
        self._observations, self._num_looks = observations, num_looks
        self._never = np.zeros(len(observations["mask"]), dtype=bool)
        self._infos: list[dict[str, Any]] = [{} for _ in self._never]
        looks = gymnasium.spaces.MultiDiscrete([num_looks, num_looks])
        super().__init__(len(self._never), gymnasium.spaces.Dict(boxes), looks)

    def reset(self) -> Arrays:
        """The observations."""
        return self._observations

    def step_async(self, actions: np.ndarray) -> None:
        """Takes the actions `[B, 2]`; the reward is the azimuth index, per number of looks."""
        self._rewards = (actions[:, 0] / self._num_looks).astype(np.float32)

    def step_wait(self) -> tuple[Arrays, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        """The observations again."""
        return self._observations, self._rewards, self._never, self._infos

    def close(self) -> None:
        """Nothing is held open."""

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """An attribute that all environments share."""
        return [getattr(self, attr_name, None)] * self.num_envs

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Refused."""
        raise AttributeError(attr_name)

    def env_method(self, method_name: str, *args: Any, indices: Any = None, **named: Any) -> list[Any]:
        """Refused."""
        raise AttributeError(method_name)

    def env_is_wrapped(self, wrapper_class: type, indices: Any = None) -> list[bool]:
        """No environment is wrapped."""
        return [False] * self.num_envs


def still_env(observations: Arrays, num_looks: int) -> StillVecEnv:
    """`StillVecEnv` with observations as jaxtrack has them: `scan_map` is `[B, M, M]`."""
    arrays = {name: values.astype(np.float32) for name, values in observations.items()}
    return StillVecEnv({**arrays, "scan_map": arrays["scan_map"][:, None]}, num_looks)


def build_ppo(config: TrainConfig, env: VecEnv) -> PPO:
    """Stable-Baselines3's PPO with the paper's network and the numbers of `config`.

    Args:
        config: of our learner.
        env: observations `tracks`, `mask`, and `scan_map` with one channel; track lists with the live
            ones first.
    """
    return PPO(
        "MultiInputPolicy",
        env,
        n_steps=config.rollout_steps,
        batch_size=config.minibatch_size,
        n_epochs=config.epochs,
        learning_rate=config.learning_rate,
        gamma=config.gamma,
        gae_lambda=config.gae_lambda,
        clip_range=config.clip,
        ent_coef=config.entropy_coefficient,
        vf_coef=config.value_coefficient,
        max_grad_norm=config.max_grad_norm,
        policy_kwargs={
            "features_extractor_class": PaperFeatures,
            "features_extractor_kwargs": {"encoder": config.encoder},
            "net_arch": {"pi": [128, 128], "vf": [128, 128]},
            "activation_fn": nn.Tanh,
        },
        seed=config.seed,
        device="cpu",
    )


def build_update(config: TrainConfig, observations: Arrays) -> Callable[[], None]:
    """One update of `build_ppo`'s learner: a rollout and the epochs over it."""
    model = build_ppo(config, still_env(observations, config.static.num_looks))

    def update() -> None:
        model.learn(config.batch_size, reset_num_timesteps=False)

    return update


def threads() -> int:
    """Threads that PyTorch computes with."""
    return torch.get_num_threads()
