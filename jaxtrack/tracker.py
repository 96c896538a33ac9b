"""One cycle of the multi-target tracker. It stands alone: no environment is needed.

Counterpart in Stone Soup: `MultiTargetTracker`.
"""

import jax
import jax.numpy as jnp
from flax import struct

from jaxtrack import association, kalman, lifecycle
from jaxtrack.association import Measure, mahalanobis
from jaxtrack.kalman import ExpectedDetections
from jaxtrack.params import Params
from jaxtrack.types import STATE_DIM, Detections, Scalar, Tracks, where_rows


class TrackerInfo(struct.PyTreeNode):
    """Every intermediate of one step, for parity tests and diagnosis.

    Attributes:
        predicted: the track list predicted to this step.
        expected: measurement prediction of every track.
        distances: `[T, D]` distances before the gate.
        associated: `[T]` index of each track's detection, or `NO_DETECTION`.
        updated: the track list after the update, before deletion.
        deleted: `[T]` which tracks were deleted on this step.
        initiated: `[T]` which slots hold a track born on this step.
        num_dropped: new tracks for which no slot was free.
    """

    predicted: Tracks
    expected: ExpectedDetections
    distances: jax.Array  # [T, D]
    associated: jax.Array  # [T] int
    updated: Tracks
    deleted: jax.Array  # [T] bool
    initiated: jax.Array  # [T] bool
    num_dropped: jax.Array  # [] int


def step(
    tracks: Tracks,
    detections: Detections,
    time_step: Scalar,
    index: jax.Array,
    params: Params,
    measure: Measure = mahalanobis,
) -> tuple[Tracks, TrackerInfo]:
    """Predict, gate, associate, update, delete, initiate: in Stone Soup's order.

    Args:
        tracks: the track list after the previous step.
        detections: what the look returned; none active is fine.
        time_step: time since the previous step (s).
        index: number of this step, which becomes the birth step of new tracks.
        params: numbers of the tracker.
        measure: distance of a detection from a track, one of `association.MEASURES`.

    Returns:
        The track list after this step, and all intermediates.
    """
    tracks, detections = _blank_empty_rows(tracks, detections, params)
    predicted = kalman.predict(tracks, time_step, params)
    expected, distances, associated, updated = jax.lax.cond(
        jnp.any(detections.active),
        lambda: _associate_and_update(predicted, detections, params, measure),
        lambda: _coast(predicted, detections, params, measure),
    )
    surviving = lifecycle.delete_uncertain_tracks(updated, params)
    new = lifecycle.unassociated(detections, associated)
    tracks, num_dropped = jax.lax.cond(
        jnp.any(new),
        lambda: lifecycle.initiate_tracks(surviving, detections, new, index, params),
        lambda: (surviving, jnp.asarray(0)),
    )
    return tracks, TrackerInfo(
        predicted=predicted,
        expected=expected,
        distances=distances,
        associated=associated,
        updated=updated,
        deleted=updated.active & ~surviving.active,
        initiated=tracks.active & ~surviving.active,
        num_dropped=num_dropped,
    )


_Update = tuple[kalman.ExpectedDetections, jax.Array, jax.Array, Tracks]
"""Expectations, distances `[T, D]`, associations `[T]`, and the updated track list."""


def _associate_and_update(
    predicted: Tracks, detections: Detections, params: Params, measure: Measure
) -> _Update:
    expected = kalman.predict_detections(predicted, params)
    distances = measure(expected, detections, params)
    admissible = association.gate(distances, predicted, detections, params)
    associated = association.associate_nearest_neighbour(admissible)
    return expected, distances, associated, kalman.update(predicted, expected, detections, associated)


def _coast(predicted: Tracks, detections: Detections, params: Params, measure: Measure) -> _Update:
    """`_associate_and_update` without a detection; costs nothing where no one asks for its details."""
    expected = kalman.predict_detections(predicted, params)
    return expected, measure(expected, detections, params), predicted.updated_by, predicted


def _blank_empty_rows(tracks: Tracks, detections: Detections, params: Params) -> tuple[Tracks, Detections]:
    """Puts harmless numbers into empty rows, so that neither values nor gradients turn NaN."""
    somewhere = params.min_range * jnp.eye(STATE_DIM)[0]
    tracks = tracks.replace(
        mean=where_rows(tracks.active, tracks.mean, somewhere),
        covariance=where_rows(tracks.active, tracks.covariance, jnp.eye(STATE_DIM)),
    )
    origin = params.min_range * jnp.eye(3)[2]
    return tracks, detections.replace(value=where_rows(detections.active, detections.value, origin))
