"""The square-root form of the filter: it carries factors L of the covariances, ``P = L L^T``.

A factor in float32 holds what P itself holds only in float64: standard deviations that differ by a
factor of 1e7 instead of variances that do. And P, whenever it is asked for, is a product with its
transpose, so that no variance is ever negative.

Counterparts in Stone Soup: `SqrtKalmanPredictor` and `SqrtKalmanUpdater`, for which the measurement must
be linear or have a Jacobian; sigma points have none there.

P. Kaminski, A. Bryson, S. Schmidt, "Discrete square root filtering: a survey of current techniques", IEEE
Transactions on Automatic Control 16 (1971).
"""

import jax
import jax.numpy as jnp
from flax import struct

from jaxtrack.matrices import batch_first, batch_last, product, solve_lower, triangular_factor
from jaxtrack.models import interleave_blocks, inverse_jacobian, measurement_sigmas
from jaxtrack.params import Params
from jaxtrack.types import Scalar


class Factors(struct.PyTreeNode):
    """Factors of measurement predictions, ``S = G G^T + N N^T``.

    Attributes:
        state: `[T, 3, 6]` G, what the state's uncertainty does to the detection: ``H L``.
        noise: `[T, 3, 3]` N, measurement noise, and what no H explains of a curved measurement.
    """

    state: jax.Array  # [T, 3, 6]
    noise: jax.Array  # [T, 3, 3]

    def covariance(self) -> jax.Array:
        """Innovation covariances S `[T, 3, 3]`."""
        return square(self.state) + square(self.noise)

    def cross_covariance(self, root: jax.Array) -> jax.Array:
        """Covariances ``L G^T`` `[T, 6, 3]` between states with factors `root` `[T, 6, 6]` and detections."""
        return batch_first(product(batch_last(root), jnp.swapaxes(batch_last(self.state), 0, 1)))


def square(root: jax.Array) -> jax.Array:
    """Covariances ``L L^T`` `[T, n, n]` of factors `[T, n, m]`."""
    L = batch_last(root)
    return batch_first(product(L, jnp.swapaxes(L, 0, 1)))


def initial_root(detection: jax.Array, params: Params) -> jax.Array:
    """Factors `[D, 6, 6]` of `lifecycle.initial_estimate`'s covariances; not triangular."""
    of_place = position_noise_root(detection, params)
    none = jnp.zeros_like(of_place)
    of_velocity = jnp.broadcast_to(params.prior_velocity_sigma * jnp.eye(3), of_place.shape)
    return interleave_blocks(of_place, none, none, of_velocity)


def position_noise_root(detection: jax.Array, params: Params) -> jax.Array:
    """Factors `[D, 3, 3]` (m) of the noise of detections' positions: ``G R^1/2``."""
    return inverse_jacobian(detection) * measurement_sigmas(params)


def predict_root(root: jax.Array, time_step: Scalar, params: Params) -> jax.Array:
    """Lower triangular factors `[T, 6, 6]` of ``F P F^T + Q``, after `time_step` (s)."""
    dt = jnp.asarray(time_step, dtype=float)
    L = batch_last(root)
    moved = jnp.stack([L[::2] + dt * L[1::2], L[1::2]], axis=1).reshape(L.shape)
    each, none = jnp.sqrt(params.process_noise * dt) * jnp.eye(3), jnp.zeros((3, 3))
    noise = interleave_blocks(dt / jnp.sqrt(3.0) * each, none, jnp.sqrt(0.75) * each, 0.5 * each)
    noise = jnp.broadcast_to(noise[..., None], L.shape)
    return batch_first(triangular_factor(jnp.concatenate([moved, noise], axis=1)))


def update_root(root: jax.Array, factors: Factors, innovation: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Change of the means `[T, 6]`, and lower triangular factors `[T, 6, 6]` of ``P - K S K^T``.

    One triangular array holds both: of ``[[G, N], [L, 0]]`` it is ``[[S^1/2, 0], [K S^1/2, L]]``. The noise,
    which may be small beside all else, comes last: in the first columns rounding would swallow it.

    Args:
        root: `[T, 6, 6]` factors of the predicted covariances.
        factors: of the measurement predictions.
        innovation: `[T, 3]` detections less their expectations.
    """
    L, G, N = batch_last(root), batch_last(factors.state), batch_last(factors.noise)
    seen = jnp.concatenate([G, N], axis=1)
    unseen = jnp.concatenate([L, jnp.zeros_like(L[:, :3])], axis=1)
    array = triangular_factor(jnp.concatenate([seen, unseen]))
    sigmas = solve_lower(array[:3, :3], batch_last(innovation))
    change = product(array[3:, :3], sigmas[:, None])[:, 0]
    return batch_first(change), batch_first(array[3:, 3:])
