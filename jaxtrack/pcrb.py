"""Posterior Cramer-Rao bound: how well any unbiased filter can know a truth, given the radar.

Counterpart in Stone Soup: `PCRBMetric`, with the exact Jacobian. Like there, a measurement is
assumed on every step after the first, wherever the radar looks.
"""

import jax
import jax.numpy as jnp
from flax import struct

from jaxtrack.lifecycle import initial_estimate
from jaxtrack.matrices import inverse_3x3
from jaxtrack.models import constant_velocity, elevation_bearing_range, measurement_noise
from jaxtrack.params import Params
from jaxtrack.types import POSITION, VELOCITY, Scalar, Truths


class Bound(struct.PyTreeNode):
    """Bound of a path `[K, ...]` or of a record `[K, N, ...]`; zero where the truth is absent.

    Attributes:
        covariance: `[..., 6, 6]` inverse of the information matrix (m^2, m^2/s, m^2/s^2).
        position: root of the summed position variances (m).
        velocity: root of the summed velocity variances (m/s).
    """

    covariance: jax.Array
    position: jax.Array
    velocity: jax.Array


def path_bound(
    states: jax.Array, alive: jax.Array, times: jax.Array, prior: jax.Array, params: Params, irf: Scalar = 1.0
) -> Bound:
    """Bound `[K]` of one truth.

    ``J = (F J^-1 F^T + Q)^-1 + irf H^T R^-1 H`` with the Jacobian H at the true state, here in
    terms of ``P = J^-1``, whose update needs the inverse of a 3x3 matrix only. Motion is the
    filter's (`process_noise`).

    Args:
        states: `[K, 6]` true states (m, m/s).
        alive: `[K]` whether the truth exists; absent steps are passed over in one prediction.
        times: `[K]` times of the steps (s), rising.
        prior: `[6, 6]` covariance on the first step of the truth.
        params: numbers of radar and filter.
        irf: information reduction factor in [0, 1] for missed detections and clutter.
    """

    def step(carry: tuple[jax.Array, ...], now: tuple[jax.Array, ...]) -> tuple:
        covariance, before, started = carry
        state, lives, time = now
        F, Q = constant_velocity(time - before, params.process_noise)
        improved = _with_measurement(F @ covariance @ F.T + Q, state, params, irf)
        moved = lives & started
        covariance = jnp.where(moved, improved, covariance)
        carry = covariance, jnp.where(lives, time, before), started | lives
        return carry, jnp.where(lives, covariance, 0.0)

    start = prior, times[0], jnp.asarray(False)
    covariance: jax.Array = jax.lax.scan(step, start, (states, alive, times))[1]
    variances = jnp.diagonal(covariance, axis1=-2, axis2=-1)
    return Bound(
        covariance=covariance,
        position=jnp.sqrt(jnp.sum(variances[..., POSITION], axis=-1)),
        velocity=jnp.sqrt(jnp.sum(variances[..., VELOCITY], axis=-1)),
    )


def bounds(
    truths: Truths, times: jax.Array, params: Params, prior: jax.Array | None = None, irf: Scalar = 1.0
) -> Bound:
    """Bounds `[K, N]` of all truths of a record.

    Args:
        truths: `[K, N, ...]`.
        times: `[K]` times of the steps (s), rising.
        params: numbers of radar and filter.
        prior: `[N, 6, 6]` covariance on every truth's first step; unset, that of a track
            initiated there.
        irf: information reduction factor in [0, 1].
    """
    prior = initial_covariances(truths, params) if prior is None else prior
    bound = jax.vmap(path_bound, in_axes=(1, 1, None, 0, None, None), out_axes=1)
    return bound(truths.state, truths.alive, times, prior, params, irf)


def initial_covariances(truths: Truths, params: Params) -> jax.Array:
    """`[N, 6, 6]` covariance of a track initiated by a detection of every truth's first state."""
    first = jnp.argmax(truths.alive, axis=0)
    state = jnp.take_along_axis(truths.state, first[None, :, None], axis=0)[0]
    # A truth that never lives may lie at the origin, where no direction exists.
    somewhere = jnp.zeros(6).at[0].set(params.min_range)
    state = jnp.where(jnp.any(truths.alive, axis=0)[:, None], state, somewhere)
    return initial_estimate(elevation_bearing_range(state), params)[1]


def _with_measurement(predicted: jax.Array, state: jax.Array, params: Params, irf: Scalar) -> jax.Array:
    """``(P^-1 + irf H^T R^-1 H)^-1``, by the matrix inversion lemma."""
    # What rounding leaves of asymmetry would grow from step to step, in float32 a thousandfold.
    predicted = (predicted + predicted.T) / 2
    H = jax.jacfwd(elevation_bearing_range)(state)
    cross = predicted @ H.T
    S = irf * H @ cross + measurement_noise(params)
    return predicted - irf * cross @ inverse_3x3(S) @ cross.T
