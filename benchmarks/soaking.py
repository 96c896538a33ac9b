"""What `python -m benchmarks.soak` plays, and what it looks at in every step."""

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from benchmarks.playing import pointing
from jaxtrack import cores, policies
from jaxtrack.env import make
from jaxtrack.episode import EnvState
from jaxtrack.params import Params, StaticParams
from jaxtrack.sampling import draw_index, split

SMALLEST_EIGENVALUE = -1e-6
"""Smallest eigenvalue of a covariance that passes, as a share of its trace."""


def edges(static: StaticParams, params: Params) -> policies.Policy:
    """Angles at the edges of the field and in its middle, or no angles at all: infinite, or NaN."""
    limit = params.field_limit
    angles = jnp.array([-jnp.inf, -limit, 0.0, limit, jnp.inf, jnp.nan])

    def policy(key: jax.Array, state: EnvState) -> jax.Array:
        azimuth, elevation = jnp.divmod(draw_index(key, state.time, angles.size**2), angles.size)
        return angles[jnp.stack([azimuth, elevation])]

    return policy


def one_cell(static: StaticParams, params: Params) -> policies.Policy:
    """The middle of the field for ever."""
    middle = jnp.full(2, static.num_looks // 2)
    return lambda key, state: middle


@dataclasses.dataclass(frozen=True)
class Case:
    """A policy, and the fields in which its scenario differs from the paper's."""

    build: policies.PolicyBuilder
    fields: Mapping[str, Any] = dataclasses.field(default_factory=dict)


CROWDED = {
    "clutter_rate": 8.0,
    "detection_probability": 0.9,
    "initial_truths": 5,
    "birth_rate": 0.01,
    "death_probability": 0.001,
}
"""False detections fill all slots in a few steps; truths come and go."""

CASES = {
    "random": Case(policies.random),
    "pointing": Case(pointing),
    "edges": Case(edges, {"continuous_actions": True}),
    "one cell": Case(one_cell),
    "clutter": Case(policies.random, CROWDED),
}


class Seen(struct.PyTreeNode):
    """What was seen in each of the environments `[B]` over the steps of one call.

    Attributes:
        finite: of every array of state, observation, reward and info, whether it always was.
        smallest_variance: of all live tracks (m^2, m^2/s^2).
        live_tracks: the most at one time.
        dropped_tracks: new tracks for which no slot was free.
    """

    finite: Any
    smallest_variance: jax.Array  # [B]
    live_tracks: jax.Array  # [B]
    dropped_tracks: jax.Array  # [B]


def look_at(state: EnvState, rest: dict[str, Any], info: dict[str, jax.Array]) -> Seen:
    """What is seen of one step of environments `[B]`."""

    def all_finite(array: jax.Array) -> jax.Array:
        return jnp.all(jnp.isfinite(array).reshape(array.shape[0], -1), axis=1)

    variances = jnp.diagonal(state.tracks.covariance, axis1=-2, axis2=-1)
    live = jnp.where(state.tracks.active[..., None], variances, jnp.inf)
    return Seen(
        finite=jax.tree.map(all_finite, {"state": state, "info": info, **rest}),
        smallest_variance=jnp.min(live, axis=(1, 2)),
        live_tracks=info["live_tracks"],
        dropped_tracks=info["dropped_tracks"],
    )


def nothing(shapes: Seen) -> Seen:
    """What is seen where no step is played: changes nothing in `both`."""
    return Seen(
        finite=jax.tree.map(lambda leaf: jnp.ones(leaf.shape, leaf.dtype), shapes.finite),
        smallest_variance=jnp.full_like(shapes.smallest_variance, jnp.inf),
        live_tracks=jnp.zeros_like(shapes.live_tracks),
        dropped_tracks=jnp.zeros_like(shapes.dropped_tracks),
    )


def both(one: Seen, other: Seen) -> Seen:
    """What was seen in both."""
    return Seen(
        finite=jax.tree.map(jnp.logical_and, one.finite, other.finite),
        smallest_variance=jnp.minimum(one.smallest_variance, other.smallest_variance),
        live_tracks=jnp.maximum(one.live_tracks, other.live_tracks),
        dropped_tracks=one.dropped_tracks + other.dropped_tracks,
    )


class Soaked:
    """Environments that are played on and on by one policy.

    Attributes:
        steps: of all environments, so far.
        traces: how often JAX has traced the function that plays.
        most_live: live tracks at one time in one environment.
        dropped: new tracks for which no slot was free.
        smallest_eigenvalue: of the covariances of live tracks after a call, as a share of the trace.
        params: numbers of the scenario.
    """

    def __init__(self, case: Case, static: StaticParams, params: Params, num_envs: int, steps: int) -> None:
        """Draws nothing and compiles nothing yet; a call plays `steps` of each environment."""
        self.env, self.params = make(params, static, **case.fields)
        self.policy = case.build(self.env.static, self.params)
        self.num_envs, self.steps_per_call = num_envs, steps
        self.steps = self.traces = self.most_live = self.dropped = 0
        self.smallest_eigenvalue = np.inf
        self.state: EnvState | None = None
        self._begin = jax.jit(self._on_all_cores(jax.vmap(self.env.reset_env, in_axes=(0, None))))
        self._play = jax.jit(self._on_all_cores(self._trace))

    def advance(self, key: jax.Array) -> list[str]:
        """Plays one call, and returns what was wrong in it, one line each."""
        keys = jax.random.split(key, self.num_envs)
        if self.state is None:
            self.state = self._begin(keys, self.params)[1]
        self.state, seen = jax.block_until_ready(self._play(keys, self.state, self.params))
        before, self.steps = self.steps, self.steps + self.num_envs * self.steps_per_call
        self.most_live = max(self.most_live, int(np.max(seen.live_tracks)))
        self.dropped += int(np.sum(seen.dropped_tracks))
        when = f"in steps {before:,} to {self.steps:,}"
        return [f"{what} {when}" for what in (*wrong(seen), *self._wrong_covariances())] + self._retraced()

    def _on_all_cores(self, function: Callable[..., Any]) -> Callable[..., Any]:
        """Shared out, where the cores can share the environments equally."""
        return function if self.num_envs % jax.device_count() else cores.share_out(function, shared=1)

    def _trace(self, keys: jax.Array, state: EnvState, params: Params) -> tuple[EnvState, Seen]:
        """Plays the environments `[B]`, each with its key; JAX runs this body only to trace it."""
        self.traces += 1
        policy_keys, step_keys = jax.vmap(split)(keys)
        of_steps = jax.vmap(lambda key: jax.random.split(key, self.steps_per_call), out_axes=1)(step_keys)

        def step(carry: tuple[EnvState, Seen | None], keys: jax.Array) -> tuple[tuple[EnvState, Seen], None]:
            state, seen = carry
            actions = jax.vmap(self.policy)(policy_keys, state)
            played = jax.vmap(self.env.step, in_axes=(0, 0, 0, None))(keys, state, actions, params)
            observation, state, reward, _, _, info = played
            del info["final_observation"]
            now = look_at(state, {"observation": observation, "reward": reward}, info)
            return (state, now if seen is None else both(seen, now)), None

        # Only its shapes: compiled once, not once for the first step and once for the others.
        shapes = jax.eval_shape(lambda: step((state, None), of_steps[0])[0][1])
        return jax.lax.scan(step, (state, nothing(shapes)), of_steps)[0]

    def _wrong_covariances(self) -> list[str]:
        """Eigenvalues of the live tracks' covariances as they are now, in float64."""
        assert self.state is not None
        tracks = self.state.tracks
        live = np.asarray(tracks.covariance, dtype=float)[np.asarray(tracks.active)]
        if not live.size or not np.all(np.isfinite(live)):
            return []  # what is not finite was told already
        shares = np.linalg.eigvalsh(live)[:, 0] / np.trace(live, axis1=1, axis2=2)
        smallest = float(shares.min())
        self.smallest_eigenvalue = min(self.smallest_eigenvalue, smallest)
        return [f"an eigenvalue is {smallest:.1e} of the trace"] if smallest < SMALLEST_EIGENVALUE else []

    def _retraced(self) -> list[str]:
        return [f"traced {self.traces} times"] if self.traces > 1 else []


def wrong(seen: Seen) -> list[str]:
    """What must not be seen, one line each."""
    leaves = jax.tree_util.tree_leaves_with_path(seen.finite)
    lost = [jax.tree_util.keystr(path, simple=True, separator=".") for path, ok in leaves if not np.all(ok)]
    negative = float(np.min(seen.smallest_variance))
    lines = [f"{name} is not finite" for name in lost]
    return lines + ([f"a variance is {negative:.1e}"] if negative < 0 else [])
