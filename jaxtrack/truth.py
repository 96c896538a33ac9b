"""Where the targets are: constant velocity with white acceleration, or replayed recordings.

Counterpart in Stone Soup: `MultiTargetGroundTruthSimulator` without births and deaths.
"""

import jax
import jax.numpy as jnp

from jaxtrack.models import constant_velocity, direction
from jaxtrack.params import Params, StaticParams
from jaxtrack.types import Scalar, Truths


def initiate_truths(key: jax.Array, static: StaticParams, params: Params) -> Truths:
    """Truths at the start: uniform in azimuth, elevation and range, normal in velocity."""
    if params.trajectories is not None:
        return replay_truths(jnp.asarray(0), params)
    key_angles, key_range, key_velocity = jax.random.split(key, 3)
    n = static.num_truths
    angles = params.field_limit * jax.random.uniform(key_angles, (n, 2), minval=-1.0, maxval=1.0)
    share = jax.random.uniform(key_range, (n, 1))
    distance = params.min_range + share * (params.max_range - params.min_range)
    positions = distance * direction(angles[:, 0], angles[:, 1])
    velocities = params.truth_velocity_sigma * jax.random.normal(key_velocity, (n, 3))
    state = jnp.stack([positions, velocities], axis=-1).reshape(n, 6)
    return Truths(state=state, alive=jnp.ones(n, dtype=bool))


def propagate_truths(truths: Truths, noise: jax.Array, step: jax.Array, params: Params) -> Truths:
    """Moves the truths by one time step, or looks them up where trajectories are replayed.

    Args:
        truths: the truths before the step.
        noise: `[N, 3, 2]` standard normal draws, per axis for position and velocity.
        step: index of the step that the truths move to.
        params: numbers of the scenario.
    """
    if params.trajectories is not None:
        return replay_truths(step, params)
    F, _ = constant_velocity(params.time_step, 0.0)
    factor = process_noise_factor(params.time_step, params.truth_process_noise)
    shaken = jnp.einsum("ij,naj->nai", factor, noise).reshape(truths.state.shape)
    return truths.replace(state=jnp.einsum("ij,nj->ni", F, truths.state) + shaken)


def process_noise_factor(time_step: Scalar, process_noise: Scalar) -> jax.Array:
    """Lower Cholesky factor `[2, 2]` of one axis of the constant-velocity Q."""
    dt = jnp.asarray(time_step, dtype=float)
    factor = jnp.array(
        [[dt**1.5 / jnp.sqrt(3.0), 0.0], [jnp.sqrt(3 * dt) / 2, jnp.sqrt(dt) / 2]], dtype=float
    )
    return jnp.sqrt(jnp.asarray(process_noise, dtype=float)) * factor


def replay_truths(step: jax.Array, params: Params) -> Truths:
    """Row `step` of the recorded trajectories; the last row after their end; NaN is absent."""
    recorded = jnp.asarray(params.trajectories, dtype=float)
    state = recorded[jnp.minimum(step, recorded.shape[0] - 1)]
    alive = jnp.all(jnp.isfinite(state), axis=-1)
    return Truths(state=jnp.where(alive[:, None], state, 0.0), alive=alive)
