"""Stone Soup inside Gymnasium, as the paper built it: the environment that ours replaces.

Importing this module registers ``StoneSoupSearchTrack-v0``.
"""

from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces

from jaxtrack.observation import TRACK_FEATURES
from jaxtrack.params import Params, StaticParams
from jaxtrack.validation import validate
from reference.simulation import Observation, StoneSoupScenario

ENV_ID = "StoneSoupSearchTrack-v0"


class StoneSoupEnv(gymnasium.Env):
    """`SearchTrack-v0` with the observation, action, reward and parameters of `jaxtrack`.

    Args:
        static: shapes; the paper's by default.
        params: numbers; the paper's by default.
        dtype: of the observation; float64 for parity.
        exact_jacobian: whether new tracks use the exact Jacobian, for parity, or the stock one.

    Raises:
        ValueError: naming the field, if a number is out of range or not simulated here.
    """

    metadata: dict[str, Any] = {"render_modes": []}  # noqa: RUF012 - Gymnasium's own declaration

    def __init__(
        self,
        static: StaticParams | None = None,
        params: Params | None = None,
        dtype: type[np.floating] = np.float32,
        exact_jacobian: bool = False,
    ) -> None:
        self.static, self.params = static or StaticParams(), params or Params()
        validate(self.static, self.params)
        self.dtype = dtype
        self.scenario = StoneSoupScenario(self.static, self.params, exact_jacobian)
        tracks, pixels = self.static.max_tracks, self.static.map_size
        self.observation_space = spaces.Dict(
            {
                "tracks": spaces.Box(-np.inf, np.inf, (tracks, TRACK_FEATURES), dtype),
                "mask": spaces.MultiBinary(tracks),
                "scan_map": spaces.Box(0.0, 1.0, (pixels, pixels), dtype),
            }
        )
        self.action_space = self._action_space()

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """New truths, no tracks, a field never seen.

        Args:
            seed: of everything random, also of later episodes.
            options: ``{"draws": reference.truths.Draws}`` to give all that is random.
        """
        super().reset(seed=seed)
        draws = (options or {}).get("draws")
        return self._typed(self.scenario.reset(int(self.np_random.integers(2**31)), draws)), {}

    def step(self, action: np.ndarray) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """One look. Never terminated; truncated at the end of the episode."""
        observation, info = self.scenario.step(*self.look_angles(np.asarray(action)))
        truncated = self.scenario.step_index >= self.params.max_steps_in_episode
        reward = info["reward_track"] + info["reward_search"]
        return self._typed(observation), float(reward), False, bool(truncated), info

    def look_angles(self, action: np.ndarray) -> np.ndarray:
        """Azimuth and elevation (rad) of an action (paper, eq. 2)."""
        limit = self.params.field_limit
        if self.static.continuous_actions:
            return np.clip(action.astype(float), -limit, limit)
        last = self.static.num_looks - 1
        return limit * (2 * np.clip(action, 0, last) / last - 1)

    def _action_space(self) -> spaces.Space:
        if self.static.continuous_actions:
            limit = self.params.field_limit
            return spaces.Box(-limit, limit, (2,), np.float32)
        return spaces.MultiDiscrete([self.static.num_looks] * 2)

    def _typed(self, observation: Observation) -> Observation:
        return {
            "tracks": observation["tracks"].astype(self.dtype),
            "mask": observation["mask"].astype(np.int8),
            "scan_map": observation["scan_map"].astype(self.dtype),
        }


gymnasium.register(ENV_ID, entry_point=f"{__name__}:StoneSoupEnv")
