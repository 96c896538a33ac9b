"""Which detection belongs to which track.

Counterparts in Stone Soup: `DistanceHypothesiser` with a `Measure`, `DistanceGater`,
`NearestNeighbour`, `GNNWith2DAssignment`.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp

from jaxtrack.assignment import assign
from jaxtrack.kalman import ExpectedDetections
from jaxtrack.kernel import add_up
from jaxtrack.matrices import batch_first, batch_last, determinant_3x3, inverse_3x3
from jaxtrack.models import measurement_noise
from jaxtrack.params import Params
from jaxtrack.types import DETECTION_DIM, NO_DETECTION, Detections, Scalar, Tracks

Measure = Callable[[ExpectedDetections, Detections, Params], jax.Array]
"""Distances `[T, D]` of every detection from every track's expectation."""


def squared_mahalanobis(expected: ExpectedDetections, detections: Detections, params: Params) -> jax.Array:
    """``d^T S^-1 d`` with ``d = wrap(zbar - z)`` (`SquaredMahalanobis`)."""
    del params
    return _quadratic(_differences(expected, detections), _inverses(expected.covariance))


def mahalanobis(expected: ExpectedDetections, detections: Detections, params: Params) -> jax.Array:
    """``sqrt(d^T S^-1 d)`` with ``d = wrap(zbar - z)`` (`Mahalanobis`). NaN where S is indefinite."""
    return jnp.sqrt(squared_mahalanobis(expected, detections, params))


def euclidean(expected: ExpectedDetections, detections: Detections, params: Params) -> jax.Array:
    """Length of ``wrap(zbar - z)``, radians and metres mixed (`Euclidean`)."""
    del params
    d = _differences(expected, detections)
    return jnp.sqrt(add_up(d * d, axis=-1))


def kullback_leibler(expected: ExpectedDetections, detections: Detections, params: Params) -> jax.Array:
    """Divergence of the expectation N(zbar, S) from the detection N(z, R), in nats (`KLDivergence`).

    ``(ln |R|/|S| - 3 + tr(R^-1 S) + d^T R^-1 d) / 2``.
    """
    R, S = measurement_noise(params), expected.covariance
    inverse_R = inverse_3x3(R)
    log_ratio = jnp.log(determinant_3x3(R) / _determinants(S))
    fixed = log_ratio - DETECTION_DIM + add_up(add_up(inverse_R * S, axis=-1), axis=-1)
    spread = jnp.broadcast_to(inverse_R, S.shape)
    return 0.5 * (fixed[:, None] + _quadratic(_differences(expected, detections), spread))


def squared_hellinger(expected: ExpectedDetections, detections: Detections, params: Params) -> jax.Array:
    """Squared Hellinger distance of N(zbar, S) and N(z, R), in [0, 1] (`SquaredGaussianHellinger`).

    ``1 - sqrt(sqrt(|S| |R|) / |M|) exp(-d^T M^-1 d / 8)`` with ``M = (S + R) / 2``.
    """
    R, S = measurement_noise(params), expected.covariance
    middle = (S + R) / 2
    overlap = jnp.sqrt(jnp.sqrt(_determinants(S) * determinant_3x3(R)) / _determinants(middle))
    exponent = _quadratic(_differences(expected, detections), _inverses(middle)) / 8
    return jnp.maximum(1 - overlap[:, None] * jnp.exp(-exponent), 0.0)


def hellinger(expected: ExpectedDetections, detections: Detections, params: Params) -> jax.Array:
    """Hellinger distance of N(zbar, S) and N(z, R), in [0, 1] (`GaussianHellinger`)."""
    return jnp.sqrt(squared_hellinger(expected, detections, params))


MEASURES: dict[str, Measure] = {
    "mahalanobis": mahalanobis,
    "squared_mahalanobis": squared_mahalanobis,
    "euclidean": euclidean,
    "kullback_leibler": kullback_leibler,
    "hellinger": hellinger,
    "squared_hellinger": squared_hellinger,
}
"""Measures by name; gate threshold and missed distance have the measure's unit."""


def _inverses(matrices: jax.Array) -> jax.Array:
    return batch_first(inverse_3x3(batch_last(matrices)))


def _determinants(matrices: jax.Array) -> jax.Array:
    return determinant_3x3(batch_last(matrices))


def _differences(expected: ExpectedDetections, detections: Detections) -> jax.Array:
    """``wrap(zbar - z)`` `[T, D, 3]`."""
    return expected.innovation(expected.mean[:, None] - detections.value[None])


def _quadratic(d: jax.Array, matrix: jax.Array) -> jax.Array:
    """``d^T M d`` `[T, D]` of differences `[T, D, 3]` and one matrix `[T, 3, 3]` per track."""
    weighted = add_up(d[..., None] * matrix[:, None], axis=-2)
    return add_up(weighted * d, axis=-1)


def gate(distances: jax.Array, predicted: Tracks, detections: Detections, params: Params) -> jax.Array:
    """Distances `[T, D]` of admissible pairs, infinity elsewhere.

    A pair is admissible if track and detection exist and the distance is strictly smaller
    than both the gate threshold and the missed distance (a detection exactly at the missed
    distance loses to the missed hypothesis). NaN is not smaller, so it is refused.
    """
    exists = predicted.active[:, None] & detections.active[None]
    near = distances < jnp.minimum(params.gate_threshold, params.missed_distance)
    return jnp.where(exists & near, distances, jnp.inf)


def associate_nearest_neighbour(admissible: jax.Array) -> jax.Array:
    """Greedy global nearest neighbour on gated distances `[T, D]`.

    Repeatedly takes the smallest distance left and removes its track and its detection.
    Exact ties go to the lowest track, then the lowest detection; in Stone Soup they are
    decided by the order of Python sets.

    Returns:
        `[T]` index of each track's detection, or `NO_DETECTION`.
    """
    num_tracks, num_detections = admissible.shape
    tracks, rows = jnp.arange(num_tracks), jnp.arange(num_detections)

    def any_left(carry: tuple[jax.Array, jax.Array]) -> jax.Array:
        return jnp.any(jnp.isfinite(carry[0]))

    def take_nearest(carry: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        # Two that are each other's nearest are taken before any pair that competes with them,
        # so all such pairs can be taken at once.
        left, associated = carry
        nearest_detection, nearest_track = jnp.argmin(left, axis=1), jnp.argmin(left, axis=0)
        mutual = nearest_track[nearest_detection] == tracks
        taken = mutual & jnp.isfinite(left.min(axis=1))
        associated = jnp.where(taken, nearest_detection, associated)
        used = jnp.any(associated[:, None] == rows, axis=0)
        return jnp.where(taken[:, None] | used, jnp.inf, left), associated

    nothing = jnp.full(num_tracks, NO_DETECTION)
    # Which pairs are chosen has no gradient; the update that follows does.
    left = jax.lax.stop_gradient(admissible)
    return jax.lax.while_loop(any_left, take_nearest, (left, nothing))[1]


def associate_global_nearest_neighbour(admissible: jax.Array, missed_distance: Scalar) -> jax.Array:
    """Assignment of gated distances `[T, D]` with the least total distance (`GNNWith2DAssignment`).

    Every track without a detection adds `missed_distance`, so a pair is worth what it falls short of
    that. `GlobalNearestNeighbour` minimises the same total, by trying all combinations.

    Returns:
        `[T]` index of each track's detection, or `NO_DETECTION`.
    """
    left = jax.lax.stop_gradient(admissible)
    # A pair that is not admissible costs as much as a missed detection, and means one.
    costs = jnp.where(jnp.isfinite(left), left - missed_distance, 0.0)
    columns = assign(costs)
    found = jnp.any((columns[:, None] == jnp.arange(costs.shape[1])) & jnp.isfinite(left), axis=1)
    return jnp.where(found, columns, NO_DETECTION)


Associator = Callable[[jax.Array, Params], jax.Array]
"""Detection `[T]` of every track from gated distances `[T, D]`."""

ASSOCIATORS: dict[str, Associator] = {
    "nearest_neighbour": lambda admissible, params: associate_nearest_neighbour(admissible),
    "global_nearest_neighbour": lambda admissible, params: associate_global_nearest_neighbour(
        admissible, params.missed_distance
    ),
}
"""Associators by name."""
