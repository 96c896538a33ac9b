"""Which detection belongs to which track.

Counterparts in Stone Soup: `DistanceHypothesiser` with `Mahalanobis`, `DistanceGater`,
`NearestNeighbour`.
"""

import jax
import jax.numpy as jnp

from jaxtrack.kalman import ExpectedDetections, inverse_3x3
from jaxtrack.models import wrap_detection
from jaxtrack.params import Params
from jaxtrack.types import NO_DETECTION, Detections, Tracks


def mahalanobis_distances(expected: ExpectedDetections, detections: Detections) -> jax.Array:
    """Distances `[T, D]` of every detection from every track's expectation.

    ``sqrt(d^T S^-1 d)`` with ``d = wrap(zbar - z)``: not squared. NaN where S is indefinite.
    """
    inverse_S = jax.vmap(inverse_3x3)(expected.covariance)
    d = wrap_detection(expected.mean[:, None] - detections.value[None])
    weighted = (d[..., None] * inverse_S[:, None]).sum(axis=-2)
    return jnp.sqrt((weighted * d).sum(axis=-1))


def gate(distances: jax.Array, predicted: Tracks, detections: Detections, params: Params) -> jax.Array:
    """Distances `[T, D]` of admissible pairs, infinity elsewhere.

    A pair is admissible if track and detection exist and the distance is strictly smaller
    than both the gate threshold and the missed distance (a detection exactly at the missed
    distance loses to the missed hypothesis).
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

    def any_left(carry: tuple[jax.Array, jax.Array]) -> jax.Array:
        return jnp.any(jnp.isfinite(carry[0]))

    def take_nearest(carry: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        left, associated = carry
        nearest = jnp.argmin(left)
        is_track = jnp.arange(num_tracks) == nearest // num_detections
        is_detection = jnp.arange(num_detections) == nearest % num_detections
        associated = jnp.where(is_track, nearest % num_detections, associated)
        removed = is_track[:, None] | is_detection[None]
        return jnp.where(removed, jnp.inf, left), associated

    nothing = jnp.full(num_tracks, NO_DETECTION)
    # Which pairs are chosen has no gradient; the update that follows does.
    left = jax.lax.stop_gradient(admissible)
    return jax.lax.while_loop(any_left, take_nearest, (left, nothing))[1]
