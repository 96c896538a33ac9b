"""`SearchTrack-v0` as a vectorised environment of Stable-Baselines3 (extra `sb3`)."""

from collections.abc import Iterable
from typing import Any

import numpy as np
from stable_baselines3.common.vec_env import VecEnv

from jaxtrack.gymnasium_env import action_space, observation_space, scenario_seeds
from jaxtrack.host import Observation, Scenarios, Step

Indices = int | Iterable[int] | None
Info = dict[str, Any]


class SearchTrackVecEnv(VecEnv):
    """Scenarios `[B]` stepped together; one that ends begins anew in the same step.

    `infos` holds for every scenario the environment's info and `TimeLimit.truncated`, and
    `terminal_observation` where an episode ended.

    Args:
        num_envs: how many.
        image: the scan map as an image `[1, M, M]`, uint8 from 0 to 255, which `MultiInputPolicy`
            gives to its NatureCNN (36 x 36 pixels or more); else `[M, M]` in [0, 1], which it flattens.
        **fields: any field of `Params` or `StaticParams`, or whole ones as `params` and `static`.

    Raises:
        ValueError: naming the wrong field and its range, or a field that does not exist.
    """

    def __init__(self, num_envs: int, image: bool = True, **fields: Any) -> None:
        self._scenarios = Scenarios(num_envs, image, **fields)
        env, params = self._scenarios.env, self._scenarios.params
        super().__init__(num_envs, observation_space(env, params, image), action_space(env, params))

    def reset(self) -> Observation:
        """New scenarios, with the seeds that `seed` gave for this reset if it did."""
        if not self._scenarios.begun and None in self._seeds:
            self.seed()
        seeds = scenario_seeds(self._seeds, self.num_envs)
        self._reset_seeds()
        self._reset_options()
        return self._scenarios.reset(seeds)

    def step_async(self, actions: np.ndarray) -> None:
        """Takes the actions `[B, 2]` of the next step."""
        self._actions = actions

    def step_wait(self) -> tuple[Observation, np.ndarray, np.ndarray, list[Info]]:
        """One look in each scenario: observation, reward, done, infos."""
        step = self._scenarios.step(self._actions)
        return step.observation, step.reward, step.terminated | step.truncated, infos(step)

    def close(self) -> None:
        """Nothing is held open."""

    def get_attr(self, attr_name: str, indices: Indices = None) -> list[Any]:
        """An attribute of the environment, which all scenarios share."""
        value = None if attr_name == "render_mode" else getattr(self._scenarios, attr_name)
        return [value for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: Indices = None) -> None:
        """Refused: the scenarios are rows of arrays."""
        raise AttributeError(f"{attr_name}: the scenarios have no attributes of their own to set")

    def env_method(self, method_name: str, *args: Any, indices: Indices = None, **named: Any) -> list[Any]:
        """Refused: the scenarios are rows of arrays."""
        raise AttributeError(f"{method_name}: the scenarios have no methods of their own")

    def env_is_wrapped(self, wrapper_class: type, indices: Indices = None) -> list[bool]:
        """No scenario is wrapped."""
        return [False for _ in self._get_indices(indices)]


def infos(step: Step) -> list[Info]:
    """What Stable-Baselines3 wants to know of every scenario, in Python's numbers."""
    columns = {**step.info, "TimeLimit.truncated": step.truncated & ~step.terminated}
    # Column by column: number by number would take longer than the step itself.
    rows = zip(*(values.tolist() for values in columns.values()), strict=True)
    result: list[Info] = [dict(zip(columns, row, strict=True)) for row in rows]
    if step.last is not None:
        for row in np.flatnonzero(step.terminated | step.truncated):
            result[row]["terminal_observation"] = {name: values[row] for name, values in step.last.items()}
    return result
