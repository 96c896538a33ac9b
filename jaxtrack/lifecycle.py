"""How tracks end and begin.

Counterparts in Stone Soup: `CovarianceBasedDeleter`, `UpdateTimeDeleter`, `UpdateTimeStepsDeleter`,
`CompositeDeleter`; `SimpleMeasurementInitiator`, and of `MultiMeasurementInitiator` what it does
with its tentative tracks once they are updated.
"""

import functools
import operator
from collections.abc import Callable

import jax
import jax.numpy as jnp

from jaxtrack.counts import Counts, to_microseconds
from jaxtrack.kernel import add_up
from jaxtrack.models import (
    interleave,
    interleave_blocks,
    inverse_elevation_bearing_range,
)
from jaxtrack.params import Params, StaticParams
from jaxtrack.platform import platform_velocity
from jaxtrack.sampling import matches
from jaxtrack.square_root import initial_root, position_noise_root
from jaxtrack.types import NO_DETECTION, Detections, Scalar, Tracks, where_rows


def no_tracks(max_tracks: int, static: StaticParams) -> Tracks:
    """A track list without tracks, with all that the deleters and the initiator keep of each."""
    tracks = Tracks.empty(max_tracks)
    if static.covariance_form == "square_root":
        tracks = tracks.replace(root=jnp.zeros_like(tracks.covariance))
    several = static.initiator == "multi_measurement"
    if several or static.deleters != ("covariance",):
        tracks = tracks.replace(counts=Counts.zero(max_tracks))
    return tracks.replace(tentative=tracks) if several else tracks


def counts_of(tracks: Tracks) -> Counts:
    """The counts of a track list.

    Raises:
        ValueError: if it keeps none.
    """
    if tracks.counts is None:
        raise ValueError("tracks.counts = None: expected a track list that began as lifecycle.no_tracks(...)")
    return tracks.counts


def is_uncertain(tracks: Tracks, params: Params) -> jax.Array:
    """`[T]` whether the covariance trace over all six states is too large (`CovarianceBasedDeleter`).

    Strictly: a track exactly at the threshold lives, and so does one whose trace is NaN, as in Stone
    Soup.
    """
    trace = add_up(jnp.diagonal(tracks.covariance, axis1=-2, axis2=-1), axis=-1)
    return trace > params.deletion_threshold


def is_missed_long(tracks: Tracks, params: Params) -> jax.Array:
    """`[T]` whether the last detection is longer ago than `deletion_time` (`UpdateTimeDeleter`)."""
    if params.deletion_time is None:
        raise ValueError("deletion_time = None: expected a number for the deleter update_time")
    return counts_of(tracks).missed_time > to_microseconds(params.deletion_time)


def is_missed_often(tracks: Tracks, params: Params) -> jax.Array:
    """`[T]` whether there was no detection for `deletion_steps` steps in a row (`UpdateTimeStepsDeleter`)."""
    if params.deletion_steps is None:
        raise ValueError("deletion_steps = None: expected a number for the deleter update_time_steps")
    return counts_of(tracks).missed_steps >= params.deletion_steps


DELETERS: dict[str, Callable[[Tracks, Params], jax.Array]] = {
    "covariance": is_uncertain,
    "update_time": is_missed_long,
    "update_time_steps": is_missed_often,
}
"""Deleters by name: which tracks `[T]` are to end."""


def delete_uncertain_tracks(tracks: Tracks, params: Params) -> Tracks:
    """Deletes tracks that are uncertain (`is_uncertain`): the default deleter."""
    return tracks.replace(active=tracks.active & ~is_uncertain(tracks, params))


def delete_tracks(tracks: Tracks, static: StaticParams, params: Params) -> Tracks:
    """Deletes tracks that any of the deleters names, or only those that all name (`CompositeDeleter`).

    Runs after the update and before initiation, so that a track can not die on the step of its
    birth.
    """
    named = [DELETERS[name](tracks, params) for name in static.deleters]
    doomed = functools.reduce(operator.and_ if static.intersect_deleters else operator.or_, named)
    return tracks.replace(active=tracks.active & ~doomed)


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
    mean, covariance = initial_estimate(detections.value, params, step)
    root = None
    if tracks.root is not None:
        root = where_rows(born, initial_root(detections.value, params)[source], tracks.root)
    initiated = Tracks(
        mean=where_rows(born, mean[source], tracks.mean),
        covariance=where_rows(born, covariance[source], tracks.covariance),
        active=tracks.active | born,
        updated_by=jnp.where(born, source, jnp.where(tracks.active, tracks.updated_by, NO_DETECTION)),
        birth_step=jnp.where(born, step, tracks.birth_step),
        birth_detection=jnp.where(born, source, tracks.birth_detection),
        age=jnp.where(born, 0, tracks.age),
        root=root,
        counts=None if tracks.counts is None else tracks.counts.initiated(born),
    )
    return initiated, jnp.sum(is_unassociated) - jnp.sum(born)


def take_over(tracks: Tracks, tentative: Tracks, confirmed: jax.Array) -> tuple[Tracks, jax.Array]:
    """Puts the confirmed tentative tracks `[T]`, in order, into the first free slots of the track list.

    Returns:
        The track list, and the number of tracks for which no slot was free.
    """
    taken, source = matches(~tracks.active, confirmed)
    alone = tracks.replace(tentative=None)
    both = jax.tree.map(lambda old, new: where_rows(taken, new[source], old), alone, tentative)
    full = both.replace(active=tracks.active | taken, tentative=tracks.tentative)
    return full, jnp.sum(confirmed) - jnp.sum(taken)


def initial_estimate(detection: jax.Array, params: Params, step: Scalar = 0) -> tuple[jax.Array, jax.Array]:
    """States `[..., 6]` and covariances `[..., 6, 6]` of tracks from one detection `[..., 3]` of a step each.

    The position is the inverse measurement with covariance ``G R G^T``, G the exact Jacobian
    of the inverse; the velocity is the prior's, at rest in the world with `prior_velocity_sigma`.
    """
    place = inverse_elevation_bearing_range(detection)
    of_place = position_noise(detection, params)
    of_velocity = jnp.broadcast_to(params.prior_velocity_sigma**2 * jnp.eye(3), of_place.shape)
    none = jnp.zeros_like(of_place)
    covariance = interleave_blocks(of_place, none, none, of_velocity)
    at_rest = jnp.zeros_like(place) - platform_velocity(params, step)
    return interleave(place, at_rest), covariance


def position_noise(detection: jax.Array, params: Params) -> jax.Array:
    """Covariance ``G R G^T`` `[..., 3, 3]` (m^2) of the position of detections `[..., 3]`."""
    root = position_noise_root(detection, params)
    return add_up(root[..., :, None, :] * root[..., None, :, :], axis=-1)
