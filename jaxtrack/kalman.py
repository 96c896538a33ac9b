"""The filter: linear prediction, unscented measurement prediction, and update.

Counterparts in Stone Soup: `KalmanPredictor`, and `UnscentedKalmanUpdater` with its typed
angles (circular means, wrapped bearings, folded elevations).
"""

import jax
import jax.numpy as jnp
from flax import struct

from jaxtrack.models import (
    constant_velocity,
    elevation_bearing_range,
    spherical_offsets,
    wrap_detection,
)
from jaxtrack.params import Params
from jaxtrack.types import NO_DETECTION, STATE_DIM, Detections, Scalar, Tracks, position, where_rows


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
    """Moves every track by `time_step` (s): ``x = F x``, ``P = F P F^T + Q``."""
    F, Q = constant_velocity(time_step, params.process_noise)
    return tracks.replace(
        mean=jnp.einsum("ij,tj->ti", F, tracks.mean),
        covariance=jnp.einsum("ij,tjk,lk->til", F, tracks.covariance, F) + Q,
        updated_by=jnp.full_like(tracks.updated_by, NO_DETECTION),
        age=tracks.age + 1,
    )


def predict_detections(predicted: Tracks, params: Params) -> ExpectedDetections:
    """Expected detection of every predicted track, by the unscented transform."""
    mean, covariance, cross = jax.vmap(_predict_detection, in_axes=(0, 0, None))(
        predicted.mean, predicted.covariance, params
    )
    return ExpectedDetections(mean=mean, covariance=covariance, cross_covariance=cross)


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
    assigned = detections.value[jnp.maximum(associated, 0)]
    mean, covariance = jax.vmap(_update_one)(
        predicted.mean,
        predicted.covariance,
        expected.mean,
        expected.covariance,
        expected.cross_covariance,
        assigned,
    )
    return predicted.replace(
        mean=where_rows(is_updated, mean, predicted.mean),
        covariance=where_rows(is_updated, covariance, predicted.covariance),
        updated_by=associated,
    )


def sigma_offsets(covariance: jax.Array, params: Params) -> jax.Array:
    """Offsets `[12, 6]` of the sigma points from the mean: plus and minus the scaled Cholesky columns.

    Only the lower triangle of `covariance` is read, as LAPACK does for Stone Soup.
    """
    spread = jnp.sqrt(params.alpha**2 * (STATE_DIM + params.kappa))
    columns = spread * cholesky(covariance).T
    return jnp.concatenate([columns, -columns])


def unscented_weights(params: Params) -> tuple[jax.Array, jax.Array]:
    """The centre's weight in covariances and the weight of each of the 12 other points.

    With ``c = alpha^2 (n + kappa)`` the others have ``1 / (2 c)``, the centre has
    ``1 - n / c`` in means and that plus ``1 - alpha^2 + beta`` in covariances. Means need
    no centre weight here: they are taken as differences from the centre.
    """
    c = params.alpha**2 * (STATE_DIM + params.kappa)
    centre_covariance = 1 - STATE_DIM / c + (1 - params.alpha**2 + params.beta)
    return jnp.asarray(centre_covariance, dtype=float), jnp.asarray(1 / (2 * c), dtype=float)


def cholesky(matrix: jax.Array) -> jax.Array:
    """Lower Cholesky factor of `[n, n]` from its lower triangle, column by column.

    Unrolled, because for matrices this small calling LAPACK costs more than the arithmetic.
    NaN where the matrix is not positive definite.
    """
    size = matrix.shape[-1]
    rows = jnp.arange(size)
    columns: list[jax.Array] = []
    for j in range(size):
        reduced = matrix[:, j] - sum(column * column[j] for column in columns)
        columns.append(jnp.where(rows >= j, reduced / jnp.sqrt(reduced[j]), 0.0))
    return jnp.stack(columns, axis=-1)


def inverse_3x3(matrix: jax.Array) -> jax.Array:
    """Inverse of `[3, 3]` matrices by cofactors, which is exact under scaling of units."""
    cofactors = _cofactors(matrix)
    return cofactors / jnp.dot(matrix[0], cofactors[:, 0])


def determinant_3x3(matrix: jax.Array) -> jax.Array:
    """Determinant of `[3, 3]` matrices by cofactors."""
    return jnp.dot(matrix[0], _cofactors(matrix)[:, 0])


def _cofactors(matrix: jax.Array) -> jax.Array:
    rows = matrix[0], matrix[1], matrix[2]
    return jnp.stack(
        [jnp.cross(rows[1], rows[2]), jnp.cross(rows[2], rows[0]), jnp.cross(rows[0], rows[1])],
        axis=-1,
    )


def measurement_noise(params: Params) -> jax.Array:
    """Measurement noise covariance R `[3, 3]` (rad^2, rad^2, m^2)."""
    sigmas = jnp.array([params.elevation_sigma, params.bearing_sigma, params.range_sigma], dtype=float)
    return jnp.diag(sigmas**2)


def _predict_detection(
    mean: jax.Array, covariance: jax.Array, params: Params
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Unscented measurement prediction of one track: mean, S, cross-covariance.

    All detections are taken relative to the centre point's. With weights that sum to 1 its
    large negative weight then cancels exactly instead of in rounding, which is what makes
    float32 possible. The numbers are those of ``zbar = sum w z`` and
    ``S = sum w (z - zbar)(z - zbar)^T + R``, angles averaged by their sines and cosines.
    """
    offsets = sigma_offsets(covariance, params)
    centre_weight, weight = unscented_weights(params)
    sine, cosine, range_change = spherical_offsets(position(mean), position(offsets))

    centre = elevation_bearing_range(mean)
    angles = jnp.arctan2(weight * sine.sum(axis=0), 1 - weight * (1 - cosine).sum(axis=0))
    z = wrap_detection(centre + jnp.append(angles, weight * range_change.sum()))

    shift = z - centre
    D = _differences(sine, cosine, range_change, shift)
    D0 = wrap_detection(-shift)
    S = weight * _sum_of_outer(D, D) + centre_weight * jnp.outer(D0, D0) + measurement_noise(params)
    # The offsets come in pairs of opposite sign: half the products do.
    half = STATE_DIM
    return z, S, weight * _sum_of_outer(offsets[:half], D[:half] - D[half:])


def _sum_of_outer(a: jax.Array, b: jax.Array) -> jax.Array:
    """``a^T b`` written as a sum, which for matrices this small is faster than a product."""
    return (a[:, :, None] * b[:, None]).sum(axis=0)


def _differences(sine: jax.Array, cosine: jax.Array, range_change: jax.Array, shift: jax.Array) -> jax.Array:
    """Differences `[12, 3]` of the sigma points' detections from their mean, which lies at `shift`.

    The angles are turned back by the shift; the elevation's is folded, as Stone Soup does.
    """
    turn_sine, turn_cosine = jnp.sin(shift[:2]), jnp.cos(shift[:2])
    sine, cosine = sine * turn_cosine - cosine * turn_sine, cosine * turn_cosine + sine * turn_sine
    return jnp.stack(
        [
            jnp.arctan2(sine[:, 0], jnp.abs(cosine[:, 0])),
            jnp.arctan2(sine[:, 1], cosine[:, 1]),
            range_change - shift[2],
        ],
        axis=-1,
    )


def _update_one(
    mean: jax.Array,
    covariance: jax.Array,
    expected_mean: jax.Array,
    S: jax.Array,
    C: jax.Array,
    detection: jax.Array,
) -> tuple[jax.Array, jax.Array]:
    K = C @ inverse_3x3(S)
    innovation = wrap_detection(detection - expected_mean)
    return mean + K @ innovation, covariance - K @ S @ K.T
