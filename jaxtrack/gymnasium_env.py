"""`SearchTrack-v0` as an environment of Gymnasium: one scenario, or many stepped together.

Importing this module registers ``jaxtrack/SearchTrack-v0`` for `gymnasium.make` and `gymnasium.make_vec`.
"""

from collections.abc import Sequence
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from jaxtrack.env import ENV_ID, SearchTrack
from jaxtrack.host import NUM_SEEDS, Observation, Scenarios, Step
from jaxtrack.params import Params

GYMNASIUM_ID = f"jaxtrack/{ENV_ID}"


class SearchTrackEnv(gymnasium.Env):
    """One scenario: the observation, action, reward and info of `jaxtrack/README.md`, in NumPy.

    Args:
        image: the scan map as an image `[1, M, M]`, uint8 from 0 to 255, as Stable-Baselines3's
            convolutions want it; else `[M, M]` in [0, 1].
        **fields: any field of `Params` or `StaticParams`, or whole ones as `params` and `static`.

    Raises:
        ValueError: naming the wrong field and its range, or a field that does not exist.
    """

    metadata: dict[str, Any] = {"render_modes": []}  # noqa: RUF012 - Gymnasium's own declaration

    def __init__(self, image: bool = False, **fields: Any) -> None:
        self._scenarios = Scenarios(1, image, **fields)
        self.observation_space = observation_space(self._scenarios.env, self._scenarios.params, image)
        self.action_space = action_space(self._scenarios.env, self._scenarios.params)
        self._ended = False

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """New truths, no tracks, a field never seen.

        Args:
            seed: of everything random, also of later episodes.
            options: none are known.
        """
        super().reset(seed=seed)
        if seed is not None or not self._scenarios.begun:
            observation = self._scenarios.reset([int(self.np_random.integers(NUM_SEEDS))])
        elif self._ended:  # the next episode has begun with the step that ended the last one
            observation = self._scenarios.observation()
        else:
            observation = self._scenarios.reset([None])
        self._ended = False
        return _row(observation, 0), {}

    def step(self, action: np.ndarray) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """One look.

        Raises:
            ValueError: if this is no action.
            gymnasium.error.ResetNeeded: before the first reset, and after the end of an episode.
        """
        if self._ended or not self._scenarios.begun:
            raise gymnasium.error.ResetNeeded("expected a reset before this step")
        step = self._scenarios.step(np.asarray(action)[None])
        observation = step.observation if step.last is None else step.last
        terminated, truncated = bool(step.terminated[0]), bool(step.truncated[0])
        self._ended = terminated or truncated
        return _row(observation, 0), float(step.reward[0]), terminated, truncated, _row(step.info, 0)


class SearchTrackVectorEnv(VectorEnv):
    """Scenarios `[B]` stepped together; one that ends begins anew in the same step.

    What it returns is what `gymnasium.vector.SyncVectorEnv` of as many `SearchTrackEnv` returns
    in `AutoresetMode.SAME_STEP`, with equal seeds the same numbers.

    Args:
        num_envs: how many.
        image: as of `SearchTrackEnv`.
        **fields: as of `SearchTrackEnv`.

    Raises:
        ValueError: naming the wrong field and its range, or a field that does not exist.
    """

    def __init__(self, num_envs: int = 1, image: bool = False, **fields: Any) -> None:
        super().__init__()
        self._scenarios = Scenarios(num_envs, image, **fields)
        self.num_envs = num_envs
        self.metadata = {"render_modes": [], "autoreset_mode": AutoresetMode.SAME_STEP}
        self.single_observation_space = observation_space(self._scenarios.env, self._scenarios.params, image)
        self.single_action_space = action_space(self._scenarios.env, self._scenarios.params)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """New scenarios.

        Args:
            seed: of everything random: one for each scenario, or the first of as many in a row.
            options: ``{"reset_mask": array}`` of booleans `[B]`: only these begin anew.

        Raises:
            ValueError: if there are not as many seeds, or no such mask.
        """
        super().reset(seed=seed if isinstance(seed, int) else None)
        chosen = _reset_mask((options or {}).get("reset_mask"), self.num_envs)
        seeds = scenario_seeds(seed, self.num_envs)
        if not self._scenarios.begun:
            seeds = [int(self.np_random.integers(NUM_SEEDS)) if one is None else one for one in seeds]
        return self._scenarios.reset(seeds, chosen), {}

    def step(
        self, actions: np.ndarray
    ) -> tuple[Observation, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """One look in each scenario, by actions `[B, 2]`.

        Raises:
            ValueError: if these are no actions.
            gymnasium.error.ResetNeeded: before the first reset.
        """
        if not self._scenarios.begun:
            raise gymnasium.error.ResetNeeded("expected a reset before this step")
        step = self._scenarios.step(actions)
        return step.observation, step.reward.astype(float), step.terminated, step.truncated, vector_info(step)


def observation_space(env: SearchTrack, params: Params, image: bool) -> spaces.Dict:
    """The observation's space: what is boolean as `MultiBinary`, whose type int8 all libraries take."""
    boxes: dict[str, spaces.Space] = {}
    for name, box in env.observation_space(params).spaces.items():
        if np.dtype(box.dtype) == bool:
            boxes[name] = spaces.MultiBinary(box.shape[0])
        elif name == "scan_map" and image:
            boxes[name] = spaces.Box(0, 255, (1, *box.shape), np.uint8)
        else:
            boxes[name] = spaces.Box(float(box.low), float(box.high), box.shape, np.float32)
    return spaces.Dict(boxes)


def scenario_seeds(seed: int | Sequence[int | None] | None, num_envs: int) -> list[int | None]:
    """Seeds of `Scenarios` `[B]` from Gymnasium's: one for each, or the first of as many in a row.

    Raises:
        ValueError: if there are not as many.
    """
    if isinstance(seed, int | np.integer):
        seed = [int(seed) + place for place in range(num_envs)]
    seeds = [None] * num_envs if seed is None else list(seed)
    if len(seeds) != num_envs:
        raise ValueError(f"seed has {len(seeds)} entries: expected num_envs = {num_envs}")
    # The number that `SearchTrackEnv` draws with its generator after the same seed.
    return [None if one is None else int(seeding.np_random(one)[0].integers(NUM_SEEDS)) for one in seeds]


def action_space(env: SearchTrack, params: Params) -> spaces.Space:
    """Two look indices, or two angles (rad)."""
    if env.static.continuous_actions:
        limit = float(params.field_limit)
        return spaces.Box(-limit, limit, (2,), np.float32)
    return spaces.MultiDiscrete([env.static.num_looks] * 2)


def vector_info(step: Step) -> dict[str, Any]:
    """The info of a step as Gymnasium's vector environments give it.

    Every entry `[B]` has its mask `[B]`, named with an underscore before it. Where an episode
    ended the entries are zero and unmasked: they are in `final_info`, and the last observation
    in `final_obs`.
    """
    ended = step.terminated | step.truncated
    if step.last is None:
        return _masked(step.info, ~ended)
    final_obs = np.full(len(ended), None, dtype=object)
    for row in np.flatnonzero(ended).tolist():
        final_obs[row] = _row(step.last, row)
    final = {"final_obs": final_obs, "final_info": _masked(step.info, ended)}
    final |= {"_final_obs": ended.copy(), "_final_info": ended.copy()}
    return final if np.all(ended) else {**final, **_masked(step.info, ~ended)}


def _masked(info: dict[str, np.ndarray], mask: np.ndarray) -> dict[str, np.ndarray]:
    everywhere = bool(np.all(mask))
    masked = {}
    for name, values in info.items():
        masked[name] = values if everywhere else np.where(mask, values, values.dtype.type(0))
        masked[f"_{name}"] = mask.copy()
    return masked


def _row(tree: dict[str, np.ndarray], row: int) -> dict[str, Any]:
    return {name: values[row] for name, values in tree.items()}


def _reset_mask(mask: Any, num_envs: int) -> np.ndarray | None:
    if mask is None:
        return None
    mask = np.asarray(mask)
    if mask.shape != (num_envs,) or mask.dtype != bool or not mask.any():
        raise ValueError(
            f"reset_mask = {mask!r}: expected booleans of shape {(num_envs,)}, at least one of them True"
        )
    return mask


gymnasium.register(
    GYMNASIUM_ID,
    entry_point=f"{__name__}:SearchTrackEnv",
    vector_entry_point=f"{__name__}:SearchTrackVectorEnv",
)
