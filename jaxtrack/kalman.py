"""The filters: linear prediction, measurement prediction by one of several, and update.

Counterparts in Stone Soup: `KalmanPredictor`, and `UnscentedKalmanUpdater`, `ExtendedKalmanUpdater`,
`CubatureKalmanUpdater`, `KalmanUpdater` with typed angles (circular means, wrapped bearings, folded
elevations).
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from flax import struct

from jaxtrack.matrices import batch_first, batch_last, inverse_3x3, product
from jaxtrack.models import (
    elevation_bearing_range,
    interleave,
    interleave_blocks,
    measurement_noise,
    position_jacobian,
    wrap_detection,
)
from jaxtrack.params import Params
from jaxtrack.types import NO_DETECTION, Detections, Scalar, Tracks, position, velocity, where_rows
from jaxtrack.unscented import cubature_transform, unscented_transform


class ExpectedDetections(struct.PyTreeNode):
    """Measurement prediction of every track (Stone Soup's `GaussianMeasurementPrediction`).

    Attributes:
        mean: `[T, 3]` expected elevation, bearing (rad) and range (m).
        covariance: `[T, 3, 3]` innovation covariance S, measurement noise included.
        cross_covariance: `[T, 6, 3]` between state and detection.
        angular: whether differences of detections hold angles, which are wrapped. Not so for the
            filter `converted`: there mean and covariance are those of the position (m), without
            measurement noise, which differs from detection to detection.
    """

    mean: jax.Array  # [T, 3]
    covariance: jax.Array  # [T, 3, 3]
    cross_covariance: jax.Array  # [T, 6, 3]
    angular: bool = struct.field(pytree_node=False, default=True)

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
    return tracks.replace(
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


def predict_detections(predicted: Tracks, params: Params) -> ExpectedDetections:
    """Expected detection of every predicted track, by the unscented transform."""
    z, S, C = unscented_transform(batch_last(predicted.mean), batch_last(predicted.covariance), params)
    return ExpectedDetections(batch_first(z), batch_first(S), batch_first(C))


def predict_detections_extended(predicted: Tracks, params: Params) -> ExpectedDetections:
    """The same to first order: ``S = H P H^T + R``, H the exact Jacobian (`ExtendedKalmanUpdater`)."""
    H = batch_last(position_jacobian(position(predicted.mean)))
    C = product(batch_last(predicted.covariance)[:, ::2], jnp.swapaxes(H, 0, 1))
    S = product(H, C[::2]) + measurement_noise(params)[..., None]
    return ExpectedDetections(elevation_bearing_range(predicted.mean), batch_first(S), batch_first(C))


def predict_detections_cubature(predicted: Tracks, params: Params) -> ExpectedDetections:
    """The same by the cubature transform (`CubatureKalmanUpdater`)."""
    z, S, C = cubature_transform(batch_last(predicted.mean), batch_last(predicted.covariance), params)
    return ExpectedDetections(batch_first(z), batch_first(S), batch_first(C))


def predict_positions(predicted: Tracks, params: Params) -> ExpectedDetections:
    """Expected position of every predicted track (m), noise left out (`KalmanUpdater`).

    For detections that were converted to positions (`jaxtrack.converted`).
    """
    del params
    P = predicted.covariance
    return ExpectedDetections(position(predicted.mean), P[:, ::2, ::2], P[:, :, ::2], angular=False)


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

    ``K = C S^-1``, ``x = x + K wrap(z - zbar)``, ``P = P - K S K^T``.

    Args:
        predicted: the track list at the time of the detections.
        expected: its measurement predictions.
        detections: what the look returned.
        associated: `[T]` index of each track's detection, or `NO_DETECTION`.
    """
    is_updated = associated != NO_DETECTION
    innovation = expected.innovation(detections.value[jnp.maximum(associated, 0)] - expected.mean)
    S, C = batch_last(expected.covariance), batch_last(expected.cross_covariance)
    K = product(C, inverse_3x3(S))
    change = batch_first(product(K, batch_last(innovation)[:, None]))[..., 0]
    reduction = batch_first(product(product(K, S), jnp.swapaxes(K, 0, 1)))
    return predicted.replace(
        mean=where_rows(is_updated, predicted.mean + change, predicted.mean),
        covariance=where_rows(is_updated, predicted.covariance - reduction, predicted.covariance),
        updated_by=associated,
        counts=None if predicted.counts is None else predicted.counts.updated(is_updated),
    )
