"""The environment for programs outside JAX: NumPy in, NumPy out, the random keys kept inside.

Gymnasium's and Stable-Baselines3's views (`gymnasium_env.py`, `sb3.py`) are made of this.
"""

import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxtrack.cli import require_integer
from jaxtrack.env import SearchTrack, make
from jaxtrack.episode import EnvState
from jaxtrack.params import Params, StaticParams
from jaxtrack.sampling import split

Observation = dict[str, np.ndarray]
NUM_SEEDS = 2**32
"""Seeds of scenarios are integers in [0, this)."""


class Step(NamedTuple):
    """One step of all scenarios `[B]`.

    Attributes:
        observation: `[B, ...]`; of the next episode where one ended.
        reward: `[B]`.
        terminated: `[B]` bool.
        truncated: `[B]` bool.
        info: `[B]` each, the environment's own.
        last: `[B, ...]` last observation of the episodes that ended; None if none did.
    """

    observation: Observation
    reward: np.ndarray
    terminated: np.ndarray
    truncated: np.ndarray
    info: dict[str, np.ndarray]
    last: Observation | None


class _Carry(NamedTuple):
    """What stays on the device from step to step, `[B]` each."""

    keys: jax.Array
    state: EnvState
    observation: dict[str, jax.Array]


class Scenarios:
    """Scenarios `[B]` stepped together, each of which begins anew where its episode ends.

    One core does all: up to 256 scenarios, handing a step's arrays to two cores and back took longer
    than the second one saved.

    Args:
        num_envs: how many.
        image: the scan map as `image_of` gives it.
        params: numbers; the paper's scenario by default.
        static: shapes; the paper's by default.
        **fields: any field of `Params` or `StaticParams`, to change just that.

    Raises:
        ValueError: naming the wrong field and its range, or a field that does not exist.
    """

    def __init__(
        self,
        num_envs: int = 1,
        image: bool = False,
        params: Params | None = None,
        static: StaticParams | None = None,
        **fields: Any,
    ) -> None:
        require_integer("num_envs", num_envs, 1)
        self.env, self.params = make(params, static, **fields)
        self.num_envs = num_envs
        self._begin, self._advance = _programs(self.env.static, image)
        # On the device once: numbers of Python's would be carried there at every step.
        self._numbers = jax.tree.map(jnp.asarray, self.params)
        self._carry: _Carry | None = None

    @property
    def begun(self) -> bool:
        """Whether there was a reset, so that the scenarios have keys."""
        return self._carry is not None

    def reset(self, seeds: Sequence[int | None], chosen: np.ndarray | None = None) -> Observation:
        """New scenarios.

        Args:
            seeds: `[B]` integers in [0, `NUM_SEEDS`), each of everything random in its scenario
                from now on; None goes on with the scenario's key, which it has once begun.
            chosen: `[B]` which scenarios begin anew; all by default.

        Returns:
            The observation `[B, ...]`, also of those that were not chosen.
        """
        given = np.array([seed is not None for seed in seeds])
        keys = _keys(np.array([seed or 0 for seed in seeds], dtype=np.uint32))
        if self._carry is not None:
            keys = _select(given, keys, self._carry.keys)
        begun = self._begin(keys, self._numbers)
        if self._carry is not None and chosen is not None:
            begun = _select(chosen, begun, self._carry)
        self._carry = begun
        return self.observation()

    def observation(self) -> Observation:
        """The present observation `[B, ...]`.

        Raises:
            RuntimeError: before the first reset.
        """
        return _to_host(self._begun_carry().observation)

    def step(self, actions: np.ndarray) -> Step:
        """One look in each scenario, by actions `[B, 2]`.

        Raises:
            ValueError: if these are no actions.
            RuntimeError: before the first reset.
        """
        carry = self._begun_carry()
        self._carry, last, result = self._advance(
            carry.keys, carry.state, self._checked(actions), self._numbers
        )
        observation, (reward, terminated, truncated, info) = _to_host((self._carry.observation, result))
        ended = np.any(terminated | truncated)
        return Step(observation, reward, terminated, truncated, info, _to_host(last) if ended else None)

    def _begun_carry(self) -> _Carry:
        if self._carry is None:
            raise RuntimeError("expected a reset before this")
        return self._carry

    def _checked(self, actions: np.ndarray) -> np.ndarray:
        actions = np.asarray(actions)
        continuous = self.env.static.continuous_actions
        kinds, words = ("fiu", "angles (rad)") if continuous else ("iu", "integers")
        if actions.shape != (self.num_envs, 2) or actions.dtype.kind not in kinds:
            raise ValueError(
                f"actions of shape {actions.shape} and type {actions.dtype}: "
                f"expected {words} of shape {(self.num_envs, 2)}"
            )
        return actions.astype(np.float32 if continuous else np.int32)


@functools.cache
def _programs(static: StaticParams, image: bool) -> tuple[Callable, Callable]:
    """Reset and step of scenarios `[B]`; equal shapes share what was compiled."""
    env = SearchTrack(static)

    def present(observation: dict[str, jax.Array]) -> dict[str, jax.Array]:
        shown = {
            name: part.astype(jnp.int8 if part.dtype == bool else jnp.float32)
            for name, part in observation.items()
        }
        return {**shown, "scan_map": image_of(observation["scan_map"])} if image else shown

    def begin(keys: jax.Array, params: Params) -> _Carry:
        keys, reset_keys = jax.vmap(split)(keys)
        observation, state = jax.vmap(env.reset, in_axes=(0, None))(reset_keys, params)
        return _Carry(keys, state, present(observation))

    def advance(keys: jax.Array, state: EnvState, actions: jax.Array, params: Params) -> tuple[Any, ...]:
        keys, step_keys = jax.vmap(split)(keys)
        observation, state, reward, terminated, truncated, info = jax.vmap(env.step, in_axes=(0, 0, 0, None))(
            step_keys, state, actions, params
        )
        last = present(info["final_observation"])
        own = {
            name: info[name] for name in info if name not in ("final_observation", "terminated", "truncated")
        }
        carry = _Carry(keys, state, present(observation))
        return carry, last, (reward, terminated, truncated, own)

    return jax.jit(begin), jax.jit(advance)


def image_of(scan_map: jax.Array) -> jax.Array:
    """Scan maps `[..., M, M]` in [0, 1] as images of one channel `[..., 1, M, M]`, uint8 from 0 to 255."""
    return jnp.round(255 * scan_map).astype(jnp.uint8)[..., None, :, :]


_keys = jax.jit(jax.vmap(jax.random.key))


@jax.jit
def _select(chosen: jax.Array, new: Any, old: Any) -> Any:
    """Rows of `new` where chosen `[B]`, else of `old`."""

    def of_one(pick: jax.Array, new: Any, old: Any) -> Any:
        return jax.tree.map(lambda one, other: jnp.where(pick, one, other), new, old)

    return jax.vmap(of_one)(chosen, new, old)


def _to_host(tree: Any) -> Any:
    """All arrays in one transfer, and as copies: they may be written to."""
    if jax.default_backend() != "cpu":  # a CPU's arrays are there already
        tree = jax.device_get(tree)
    return jax.tree.map(np.array, tree)
