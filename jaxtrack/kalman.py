"""The filter: linear prediction, unscented measurement prediction, and update.

Counterparts in Stone Soup: `KalmanPredictor`, and `UnscentedKalmanUpdater` with its typed
angles (circular means, wrapped bearings, folded elevations).
"""

import jax
import jax.numpy as jnp
from flax import struct

from jaxtrack.matrices import batch_first, batch_last, inverse_3x3, product
from jaxtrack.models import interleave, interleave_blocks, wrap_detection
from jaxtrack.params import Params
from jaxtrack.types import NO_DETECTION, Detections, Scalar, Tracks, position, velocity, where_rows
from jaxtrack.unscented import unscented_transform


class ExpectedDetections(struct.PyTreeNode):
    """Measurement prediction of every track (Stone Soup's `GaussianMeasurementPrediction`).

    Attributes:
        mean: `[T, 3]` expected elevation, bearing (rad) and range (m).
        covariance: `[T, 3, 3]` innovation covariance S, measurement noise included.
        cross_covariance: `[T, 6, 3]` between state and detection.
    """

    mean: jax.Array  # [T, 3]
    covariance: jax.Array  # [T, 3, 3]
    cross_covariance: jax.Array  # [T, 6, 3]


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
    )


def predict_detections(predicted: Tracks, params: Params) -> ExpectedDetections:
    """Expected detection of every predicted track, by the unscented transform."""
    z, S, C = unscented_transform(batch_last(predicted.mean), batch_last(predicted.covariance), params)
    return ExpectedDetections(batch_first(z), batch_first(S), batch_first(C))


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
    innovation = wrap_detection(detections.value[jnp.maximum(associated, 0)] - expected.mean)
    S, C = batch_last(expected.covariance), batch_last(expected.cross_covariance)
    K = product(C, inverse_3x3(S))
    change = batch_first(product(K, batch_last(innovation)[:, None]))[..., 0]
    reduction = batch_first(product(product(K, S), jnp.swapaxes(K, 0, 1)))
    return predicted.replace(
        mean=where_rows(is_updated, predicted.mean + change, predicted.mean),
        covariance=where_rows(is_updated, predicted.covariance - reduction, predicted.covariance),
        updated_by=associated,
    )
