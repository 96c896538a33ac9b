"""How tracks end and begin.

Counterparts in Stone Soup: `CovarianceBasedDeleter`, `SimpleMeasurementInitiator`.
"""

import jax
import jax.numpy as jnp

from jaxtrack.kernel import add_up
from jaxtrack.models import (
    interleave,
    interleave_blocks,
    inverse_elevation_bearing_range,
    inverse_jacobian,
    measurement_sigmas,
)
from jaxtrack.params import Params
from jaxtrack.platform import platform_velocity
from jaxtrack.sampling import matches
from jaxtrack.types import NO_DETECTION, Detections, Tracks, where_rows


def delete_uncertain_tracks(tracks: Tracks, params: Params) -> Tracks:
    """Deletes tracks whose covariance trace over all six states exceeds the threshold.

    Strictly: a track exactly at the threshold lives, and so does one whose trace is NaN, as in Stone
    Soup. Runs after the update and before initiation, so that a track can not die on the step of its
    birth.
    """
    trace = add_up(jnp.diagonal(tracks.covariance, axis1=-2, axis2=-1), axis=-1)
    return tracks.replace(active=tracks.active & ~(trace > params.deletion_threshold))


def unassociated(detections: Detections, associated: jax.Array) -> jax.Array:
    """`[D]` whether a detection was used by no track, not even by one just deleted."""
    used = jnp.any(associated[:, None] == jnp.arange(detections.active.shape[0]), axis=0)
    return detections.active & ~used


def initiate_tracks(
    tracks: Tracks, detections: Detections, is_unassociated: jax.Array, step: jax.Array, params: Params
) -> tuple[Tracks, jax.Array]:
    """Starts a track from every unassociated detection, in order, in the first free slots.

    Args:
        tracks: the surviving tracks.
        detections: what the look returned.
        is_unassociated: `[D]` which detections start a track.
        step: index of this step, the birth step of the new tracks.
        params: numbers of the tracker.

    Returns:
        The track list, and the number of detections for which no slot was free.
    """
    # The k-th free slot takes the k-th unassociated detection.
    born, source = matches(~tracks.active, is_unassociated)
    mean, covariance = initial_estimate(detections.value, params)
    initiated = Tracks(
        mean=where_rows(born, mean[source], tracks.mean),
        covariance=where_rows(born, covariance[source], tracks.covariance),
        active=tracks.active | born,
        updated_by=jnp.where(born, source, jnp.where(tracks.active, tracks.updated_by, NO_DETECTION)),
        birth_step=jnp.where(born, step, tracks.birth_step),
        birth_detection=jnp.where(born, source, tracks.birth_detection),
        age=jnp.where(born, 0, tracks.age),
    )
    return initiated, jnp.sum(is_unassociated) - jnp.sum(born)


def initial_estimate(detection: jax.Array, params: Params) -> tuple[jax.Array, jax.Array]:
    """States `[..., 6]` and covariances `[..., 6, 6]` of tracks from one detection `[..., 3]` each.

    The position is the inverse measurement with covariance ``G R G^T``, G the exact Jacobian
    of the inverse; the velocity is the prior's, at rest in the world with `prior_velocity_sigma`.
    """
    place = inverse_elevation_bearing_range(detection)
    root = inverse_jacobian(detection) * measurement_sigmas(params)
    of_place = add_up(root[..., :, None, :] * root[..., None, :, :], axis=-1)
    of_velocity = jnp.broadcast_to(params.prior_velocity_sigma**2 * jnp.eye(3), of_place.shape)
    none = jnp.zeros_like(of_place)
    covariance = interleave_blocks(of_place, none, none, of_velocity)
    at_rest = jnp.zeros_like(place) - platform_velocity(params)
    return interleave(place, at_rest), covariance
