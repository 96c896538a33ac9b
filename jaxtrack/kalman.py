"""The filters: linear prediction, measurement prediction by one of several, and update.

Counterparts in Stone Soup: `KalmanPredictor`, and `UnscentedKalmanUpdater`, `ExtendedKalmanUpdater`,
`CubatureKalmanUpdater`, `KalmanUpdater` with typed angles (circular means, wrapped bearings, folded
elevations). Track lists that carry factors of their covariances are filtered in square-root form.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from flax import struct

from jaxtrack import square_root
from jaxtrack.matrices import batch_first, batch_last, inverse_3x3, product
from jaxtrack.models import (
    elevation_bearing_range,
    interleave,
    interleave_blocks,
    measurement_noise,
    measurement_sigmas,
    position_jacobian,
    wrap_detection,
)
from jaxtrack.params import Params
from jaxtrack.square_root import Factors, square
from jaxtrack.types import NO_DETECTION, Detections, Scalar, Tracks, position, velocity, where_rows
from jaxtrack.unscented import cubature, cubature_transform, square_root_transform, unscented_transform


class ExpectedDetections(struct.PyTreeNode):
    """Measurement prediction of every track (Stone Soup's `GaussianMeasurementPrediction`).

    Attributes:
        mean: `[T, 3]` expected elevation, bearing (rad) and range (m).
        covariance: `[T, 3, 3]` innovation covariance S, measurement noise included.
        cross_covariance: `[T, 6, 3]` between state and detection.
        angular: whether differences of detections hold angles, which are wrapped. Not so for the
            filter `converted`: there mean and covariance are those of the position (m), without
            measurement noise, which differs from detection to detection.
        factors: of the covariances, for track lists that have them (`Tracks.root`).
    """

    mean: jax.Array  # [T, 3]
    covariance: jax.Array  # [T, 3, 3]
    cross_covariance: jax.Array  # [T, 6, 3]
    angular: bool = struct.field(pytree_node=False, default=True)
    factors: Factors | None = None

    def innovation(self, difference: jax.Array) -> jax.Array:
        """Differences `[..., 3]` of detections with their angles wrapped, if there are any."""
        return wrap_detection(difference) if self.angular else difference


def predict(tracks: Tracks, time_step: Scalar, params: Params) -> Tracks:
    """Moves every track by `time_step` (s): ``x = F x``, ``P = F P F^T + Q`` (`constant_velocity`)."""
    dt, q = jnp.asarray(time_step, dtype=float), params.process_noise * jnp.eye(3)
    p, v = position(tracks.mean), velocity(tracks.mean)
    # By blocks `[T, 3, 3]` of positions and velocities: three quarters of F are zeros and ones.
    from_p, from_v = tracks.covariance[:, ::2], tracks.covariance[:, 1::2]
    pp, pv, vp, vv = from_p[..., ::2], from_p[..., 1::2], from_v[..., ::2], from_v[..., 1::2]
    predicted = tracks.replace(
        mean=interleave(p + dt * v, v),
        covariance=interleave_blocks(
            pp + dt * (pv + vp) + dt**2 * vv + dt**3 / 3 * q,
            pv + dt * vv + dt**2 / 2 * q,
            vp + dt * vv + dt**2 / 2 * q,
            vv + dt * q,
        ),
        updated_by=jnp.full_like(tracks.updated_by, NO_DETECTION),
        age=tracks.age + 1,
        counts=None if tracks.counts is None else tracks.counts.predicted(dt),
    )
    if tracks.root is None:
        return predicted
    root = square_root.predict_root(tracks.root, dt, params)
    return predicted.replace(covariance=square(root), root=root)


def predict_detections(predicted: Tracks, params: Params) -> ExpectedDetections:
    """Expected detection of every predicted track, by the unscented transform."""
    if predicted.root is not None:
        return _of_sigma_points(predicted, predicted.root, params)
    z, S, C = unscented_transform(batch_last(predicted.mean), batch_last(predicted.covariance), params)
    return ExpectedDetections(batch_first(z), batch_first(S), batch_first(C))


def predict_detections_extended(predicted: Tracks, params: Params) -> ExpectedDetections:
    """The same to first order: ``S = H P H^T + R``, H the exact Jacobian (`ExtendedKalmanUpdater`)."""
    H = batch_last(position_jacobian(position(predicted.mean)))
    if predicted.root is not None:
        state = batch_first(product(H, batch_last(predicted.root)[::2]))
        noise = jnp.broadcast_to(jnp.diag(measurement_sigmas(params)), state[..., :3].shape)
        return _of_factors(elevation_bearing_range(predicted.mean), Factors(state, noise), predicted.root)
    C = product(batch_last(predicted.covariance)[:, ::2], jnp.swapaxes(H, 0, 1))
    S = product(H, C[::2]) + measurement_noise(params)[..., None]
    return ExpectedDetections(elevation_bearing_range(predicted.mean), batch_first(S), batch_first(C))


def predict_detections_cubature(predicted: Tracks, params: Params) -> ExpectedDetections:
    """The same by the cubature transform (`CubatureKalmanUpdater`).

    In factors without what circular means leave (`cubature_transform`): `UnscentedKalmanUpdater` with
    alpha = 1, beta = 0, kappa = 0.
    """
    if predicted.root is not None:
        return _of_sigma_points(predicted, predicted.root, cubature(params))
    z, S, C = cubature_transform(batch_last(predicted.mean), batch_last(predicted.covariance), params)
    return ExpectedDetections(batch_first(z), batch_first(S), batch_first(C))


def predict_positions(predicted: Tracks, params: Params) -> ExpectedDetections:
    """Expected position of every predicted track (m), noise left out (`KalmanUpdater`).

    For detections that were converted to positions (`jaxtrack.converted`).
    """
    del params
    P, factors = predicted.covariance, None
    if predicted.root is not None:
        state = predicted.root[:, ::2]
        factors = Factors(state, jnp.zeros_like(state[..., :3]))
    return ExpectedDetections(position(predicted.mean), P[:, ::2, ::2], P[:, :, ::2], False, factors)


def _of_sigma_points(predicted: Tracks, root: jax.Array, params: Params) -> ExpectedDetections:
    z, G, N = square_root_transform(batch_last(predicted.mean), batch_last(root), params)
    return _of_factors(batch_first(z), Factors(batch_first(G), batch_first(N)), root)


def _of_factors(mean: jax.Array, factors: Factors, root: jax.Array) -> ExpectedDetections:
    covariance, cross = factors.covariance(), factors.cross_covariance(root)
    return ExpectedDetections(mean, covariance, cross, factors=factors)


Filter = Callable[[Tracks, Params], ExpectedDetections]
"""Measurement prediction of every track; prediction and update are the same for all filters."""

FILTERS: dict[str, Filter] = {
    "unscented": predict_detections,
    "extended": predict_detections_extended,
    "cubature": predict_detections_cubature,
    "converted": predict_positions,
}
"""Filters by name."""


def update(
    predicted: Tracks, expected: ExpectedDetections, detections: Detections, associated: jax.Array
) -> Tracks:
    """Updates every associated track with its detection; the others keep their prediction.

    ``K = C S^-1``, ``x = x + K wrap(z - zbar)``, ``P = P - K S K^T``; of track lists with factors by these
    (`jaxtrack.square_root`).

    Args:
        predicted: the track list at the time of the detections.
        expected: its measurement predictions.
        detections: what the look returned.
        associated: `[T]` index of each track's detection, or `NO_DETECTION`.
    """
    is_updated = associated != NO_DETECTION
    innovation = expected.innovation(detections.value[jnp.maximum(associated, 0)] - expected.mean)
    if predicted.root is None or expected.factors is None:
        change, reduction = _gain(expected, innovation)
        root, covariance = None, predicted.covariance - reduction
    else:
        change, updated = square_root.update_root(predicted.root, expected.factors, innovation)
        root, covariance = where_rows(is_updated, updated, predicted.root), square(updated)
    return predicted.replace(
        mean=where_rows(is_updated, predicted.mean + change, predicted.mean),
        covariance=where_rows(is_updated, covariance, predicted.covariance),
        root=root,
        updated_by=associated,
        counts=None if predicted.counts is None else predicted.counts.updated(is_updated),
    )


def _gain(expected: ExpectedDetections, innovation: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Change of the means `[T, 6]` and fall of the covariances `[T, 6, 6]`, were all detected."""
    S, C = batch_last(expected.covariance), batch_last(expected.cross_covariance)
    K = product(C, inverse_3x3(S))
    change = batch_first(product(K, batch_last(innovation)[:, None]))[..., 0]
    return change, batch_first(product(product(K, S), jnp.swapaxes(K, 0, 1)))
