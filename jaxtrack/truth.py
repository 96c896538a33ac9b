"""Where the targets are: straight, turning or accelerated flight, births and deaths; or recordings.

Counterpart in Stone Soup: `MultiTargetGroundTruthSimulator`.
"""

import math

import jax
import jax.numpy as jnp
from flax import struct

from jaxtrack.models import direction, interleave, turn
from jaxtrack.params import Params, StaticParams
from jaxtrack.platform import platform_velocity, seen_in_turn
from jaxtrack.sampling import poisson_quantile
from jaxtrack.types import Scalar, Truths, position, velocity

MOST_BIRTHS = 4
"""Births of one step are cut off at this many times the number of rows."""


class TruthNoise(struct.PyTreeNode):
    """The random draws of one step of the truths.

    Attributes:
        motion: `[N, 3, 2]` standard normal, the accelerations; for a truth born on this step,
            which does not move yet, its place and velocity.
        death: `[N]` uniform in [0, 1), below the death probability the truth ends.
        birth_count: `[]` uniform, turned into a Poisson number.
    """

    motion: jax.Array  # [N, 3, 2]
    death: jax.Array  # [N]
    birth_count: jax.Array  # []


def num_truth_draws(num_truths: int) -> tuple[int, int]:
    """Standard normal and uniform numbers that one step of the truths takes."""
    return 6 * num_truths, num_truths + 1


def cut_truth_noise(normal: jax.Array, uniform: jax.Array) -> TruthNoise:
    """The noise of one step from as many numbers as `num_truth_draws` says."""
    return TruthNoise(motion=normal.reshape(-1, 3, 2), death=uniform[:-1], birth_count=uniform[-1])


def initiate_truths(key: jax.Array, static: StaticParams, params: Params) -> Truths:
    """Truths `[N]` at the start: uniform in azimuth, elevation and range, normal in velocity.

    The first `initial_truths` of them live; with trajectories, the first row of the recording.
    """
    if params.trajectories is not None:
        return replay_truths(jnp.asarray(0), params)
    key_angles, key_range, key_velocity = jax.random.split(key, 3)
    n = static.num_truths
    angles = jax.random.uniform(key_angles, (n, 2), minval=-1.0, maxval=1.0)
    share = jax.random.uniform(key_range, (n, 1))
    state = born_state(angles, share, jax.random.normal(key_velocity, (n, 3)), params)
    first = n if params.initial_truths is None else params.initial_truths
    return Truths(state=state, alive=jnp.arange(n) < first)


def born_state(
    angles: jax.Array, share: jax.Array, velocity: jax.Array, params: Params, step: Scalar = 0
) -> jax.Array:
    """States `[N, 6]` of new truths.

    Args:
        angles: `[N, 2]` azimuth and elevation as shares of the field's limit, in [-1, 1].
        share: `[N, 1]` place between the smallest and the largest range, in [0, 1].
        velocity: `[N, 3]` standard normal.
        params: numbers of the scenario.
        step: of their birth.
    """
    azimuth, elevation = params.field_limit * angles[:, 0], params.field_limit * angles[:, 1]
    distance = params.min_range + share * (params.max_range - params.min_range)
    positions = distance * direction(azimuth, elevation)
    velocities = params.truth_velocity_sigma * velocity - platform_velocity(params, step)
    return interleave(positions, velocities)


def propagate_truths(
    truths: Truths, num_born: jax.Array, noise: TruthNoise, step: jax.Array, params: Params
) -> tuple[Truths, jax.Array, jax.Array]:
    """Deaths, motion, births, in Stone Soup's order; or the recording where there is one.

    Args:
        truths: the truths before the step.
        num_born: truths born since the start, those for which no row was left included.
        noise: the draws of this step.
        step: index of the step that the truths move to.
        params: numbers of the scenario.

    Returns:
        The truths after the step, the new `num_born`, and the births of this step for which no
        row was left.
    """
    if params.trajectories is not None:
        return replay_truths(step, params), num_born, jnp.zeros_like(num_born)
    surviving = end_truths(truths, noise.death, params)
    moved = move_truths(surviving, noise.motion, params)
    moved = moved.replace(state=seen_in_turn(moved.state, step, params))
    truths, num_wanted = jax.lax.cond(
        jnp.asarray(params.birth_rate) > 0,
        lambda: begin_truths(moved, num_born, noise, params, step),
        lambda: (moved, num_born),
    )
    rows = truths.alive.shape[0]
    return truths, num_wanted, jnp.maximum(num_wanted, rows) - jnp.maximum(num_born, rows)


def end_truths(truths: Truths, uniform: jax.Array, params: Params) -> Truths:
    """Ends every truth with the death probability.

    Stone Soup ends a truth at ``u <= p``; here it is ``u < p``, so that 0 means never.
    """
    return truths.replace(alive=truths.alive & ~(uniform < params.death_probability))


def move_truths(truths: Truths, noise: jax.Array, params: Params) -> Truths:
    """Moves the truths by one time step; `noise` `[N, 3, 2]` is standard normal."""
    factor = process_noise_factor(params.time_step, params.truth_process_noise)
    way, v = fly(velocity(truths.state), params)
    first, second = noise[..., 0], noise[..., 1]
    return truths.replace(
        state=interleave(
            position(truths.state) + way + factor[0, 0] * first,
            v + factor[1, 0] * first + factor[1, 1] * second,
        )
    )


def fly(velocities: jax.Array, params: Params) -> tuple[jax.Array, jax.Array]:
    """One time step without noise: straight on, in a turn, or accelerated.

    Args:
        velocities: `[N, 3]` before it (m/s).
        params: numbers of the scenario.

    Returns:
        The way `[N, 3]` that is flown (m), and the velocities after it (m/s).
    """
    rows, dt = velocities.shape[0], params.time_step
    way, after = dt * velocities, velocities
    if params.truth_turn_rate is not None:
        way, after = turn(velocities, params.truth_turn_rate * jnp.linspace(-1.0, 1.0, rows), dt)
    if params.truth_acceleration is not None:
        acceleration = params.truth_acceleration * spread_directions(rows)
        way, after = way + dt**2 / 2 * acceleration, after + dt * acceleration
    return way, after


def spread_directions(number: int) -> jax.Array:
    """Unit vectors `[number, 3]`, evenly over the sphere (Fibonacci lattice)."""
    row = jnp.arange(number)
    height = (2 * row + 1) / number - 1
    return direction(math.pi * (3 - math.sqrt(5)) * row, jnp.arcsin(height))


def begin_truths(
    truths: Truths, num_born: jax.Array, noise: TruthNoise, params: Params, step: Scalar = 0
) -> tuple[Truths, jax.Array]:
    """A Poisson number of new truths, in rows never used: a row is one truth for the whole episode.

    Returns:
        The truths, and `num_born` with the new ones, those without a row included.
    """
    row = jnp.arange(truths.alive.shape[0])
    births = num_births(noise, params)
    born = (row >= num_born) & (row < num_born + births)
    state = jnp.where(born[:, None], newborn_states(noise, params, step), truths.state)
    return Truths(state=state, alive=truths.alive | born), num_born + births


def num_births(noise: TruthNoise, params: Params) -> jax.Array:
    """Births `[]` wanted on a step, at most `MOST_BIRTHS` times the number of rows."""
    return poisson_quantile(noise.birth_count, params.birth_rate, MOST_BIRTHS * noise.death.shape[0])


def newborn_states(noise: TruthNoise, params: Params, step: Scalar = 0) -> jax.Array:
    """States `[N, 6]` that the rows would have if they were born on this step.

    A newborn does not move: its six draws of motion serve for its place and velocity.
    """
    uniform = jax.scipy.stats.norm.cdf(noise.motion[:, :, 0])
    return born_state(2 * uniform[:, :2] - 1, uniform[:, 2:], noise.motion[:, :, 1], params, step)


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
