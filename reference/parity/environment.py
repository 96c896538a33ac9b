"""Whole episodes of both environments from the same draws: observations and rewards."""

import dataclasses
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxtrack import models
from jaxtrack.env import EnvState, SearchTrack, StepNoise
from jaxtrack.params import Params, StaticParams
from jaxtrack.reward import reward_terms
from jaxtrack.sampling import poisson_quantile
from jaxtrack.truth import born_state
from jaxtrack.types import Truths
from reference.components import step_duration, transition_model
from reference.gym_env import StoneSoupEnv
from reference.parity.episodes import Divergence
from reference.parity.ours import cast
from reference.parity.rows import Tally
from reference.truths import Draws

STATIC = StaticParams(num_truths=12, max_tracks=40, max_detections=20, map_size=24)
"""Roomy: Stone Soup has no capacity."""


@dataclasses.dataclass(frozen=True)
class Played:
    """One episode of ours, K steps, on the host.

    Attributes:
        initial: the truths at the start.
        noise: `[K]` all that was drawn.
        actions: `[K, 2]` look indices.
        observations: `[K]` observations.
        rewards: `[K]` rewards.
    """

    initial: Truths
    noise: StepNoise
    actions: np.ndarray
    observations: dict[str, np.ndarray]
    rewards: np.ndarray


def pointing_or_random(key: jax.Array, state: EnvState, env: SearchTrack, params: Params) -> jax.Array:
    """Half of the looks at one of three truths, half anywhere: updates, births and deletions."""
    elevation, azimuth, _ = models.elevation_bearing_range(state.truths.state[(state.time // 10) % 3])
    last = env.static.num_looks - 1
    there = jnp.round((jnp.stack([azimuth, elevation]) / params.field_limit + 1) / 2 * last).astype(int)
    anywhere = jax.random.randint(key, (2,), 0, env.static.num_looks)
    return jnp.where(state.time % 2 == 0, anywhere, there)


def play_ours(static: StaticParams, params: Params, seed: int, steps: int) -> Played:
    """One episode of our environment in float64."""
    with jax.enable_x64(True):
        return Played(*jax.device_get(_episode(jax.random.key(seed), cast(params, True), static, steps)))


@partial(jax.jit, static_argnames=("static", "steps"))
def _episode(key: jax.Array, params: Params, static: StaticParams, steps: int) -> Any:
    env = SearchTrack(static)

    def step(state: EnvState, key: jax.Array) -> tuple[EnvState, Any]:
        key_action, key_noise = jax.random.split(key)
        action = pointing_or_random(key_action, state, env, params)
        noise = env.sample_noise(key_noise)
        after, _ = env.advance(state, action, noise, params)
        terms = reward_terms(state.tracks, after.tracks, after.scan_map, static, params)
        return after, (noise, action, env.observe(key, after, action, params), sum(terms))

    key_reset, key_steps = jax.random.split(key)
    _, state = env.reset_env(key_reset, params)
    return state.truths, *jax.lax.scan(step, state, jax.random.split(key_steps, steps))[1]


def draws_of(played: Played, params: Params) -> Draws:
    """The same draws in the units that Stone Soup's side takes."""
    noise: Any = played.noise.truths
    shape = noise.motion.shape
    Q = transition_model(params.truth_process_noise).covar(time_interval=step_duration(params))
    factor = np.linalg.cholesky(Q[:2, :2]) if params.truth_process_noise else np.zeros((2, 2))
    with jax.enable_x64(True):
        births = jax.vmap(poisson_quantile, in_axes=(0, None, None))(
            noise.birth_count, params.birth_rate, 4 * shape[1]
        )
        uniform = jax.scipy.stats.norm.cdf(noise.motion[..., 0])
        place = jax.vmap(born_state, in_axes=(0, 0, 0, None))
        newborn = place(2 * uniform[..., :2] - 1, uniform[..., 2:], noise.motion[..., 1], params)
    sigma = np.array([params.elevation_sigma, params.bearing_sigma, params.range_sigma])
    return Draws(
        initial=np.asarray(played.initial.state)[np.asarray(played.initial.alive)],
        motion=(noise.motion @ factor.T).reshape(*shape[:2], 6),
        death=noise.death,
        births=np.asarray(births),
        newborn=np.asarray(newborn),
        detection=sigma * played.noise.sensor.detection,
    )


def compare_environment(
    static: StaticParams, params: Params, seed: int, steps: int, tolerance: float, tally: Tally
) -> Divergence | None:
    """Plays Stone Soup's environment on our draws and actions; the first difference, if any.

    Errors are absolute, of scaled observations near [-1, 1] and of rewards.
    """
    played = play_ours(static, params, seed, steps)
    env = StoneSoupEnv(static, params, np.float64, exact_jacobian=True)
    env.reset(options={"draws": draws_of(played, params)})
    for k in range(steps):
        observation, reward, *_ = env.step(played.actions[k])
        ours = {name: values[k] for name, values in played.observations.items()}
        pairs = {name: (ours[name], observation[name]) for name in ours}
        pairs["reward"] = (played.rewards[k], np.asarray(reward))
        for name, (mine, theirs) in pairs.items():
            errors = np.abs(np.asarray(mine, float) - theirs)
            tally.error(float(errors.max()))
            if not errors.max() <= tolerance:
                worst = tuple(int(i) for i in np.unravel_index(np.argmax(errors), errors.shape))
                return Divergence(k + 1, None, f"{name}{list(worst)}", mine[worst], theirs[worst])
    return None
