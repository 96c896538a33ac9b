"""One cycle of the multi-target tracker. It stands alone: no environment is needed.

Counterpart in Stone Soup: `MultiTargetTracker`. Its parts are chosen by name in `StaticParams`: measure,
filter, associator, deleters and initiator.
"""

import jax
import jax.numpy as jnp
from flax import struct

from jaxtrack import association, converted, kalman, lifecycle
from jaxtrack.association import ASSOCIATORS, MEASURES
from jaxtrack.kalman import FILTERS, ExpectedDetections
from jaxtrack.params import Params, StaticParams
from jaxtrack.platform import seen_in_turn
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
        initiated: `[T]` which slots hold a track that is new in the list on this step.
        num_dropped: new tracks for which no slot was free, tentative ones included.
    """

    predicted: Tracks
    expected: ExpectedDetections
    distances: jax.Array  # [T, D]
    associated: jax.Array  # [T] int
    updated: Tracks
    deleted: jax.Array  # [T] bool
    initiated: jax.Array  # [T] bool
    num_dropped: jax.Array  # [] int


DEFAULT = StaticParams()


def step(
    tracks: Tracks,
    detections: Detections,
    time_step: Scalar,
    index: jax.Array,
    params: Params,
    static: StaticParams = DEFAULT,
) -> tuple[Tracks, TrackerInfo]:
    """Predict, gate, associate, update, delete, initiate: in Stone Soup's order.

    Args:
        tracks: the track list after the previous step; the first one is `lifecycle.no_tracks`.
        detections: what the look returned; none active is fine.
        time_step: time since the previous step (s).
        index: number of this step, which becomes the birth step of new tracks.
        params: numbers of the tracker.
        static: the parts that the tracker is made of; no shape is read.

    Returns:
        The track list after this step, and all intermediates.

    Raises:
        ValueError: if the track list did not begin as `lifecycle.no_tracks` of the same parts.
    """
    _check_form(tracks, static)
    tracks, detections = _blank_empty_rows(tracks, detections, params)
    predicted = _predict(tracks, time_step, index, params)
    expected, distances, associated, updated = _follow(predicted, detections, static, params)
    surviving = lifecycle.delete_tracks(updated, static, params)
    new = lifecycle.unassociated(detections, associated)
    if static.initiator == "multi_measurement":
        left = detections.replace(active=new)
        tracks, num_dropped = _initiate_confirmed(surviving, left, time_step, index, static, params)
    else:
        tracks, num_dropped = _initiate(surviving, detections, new, index, params)
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


def _predict(tracks: Tracks, time_step: Scalar, index: jax.Array, params: Params) -> Tracks:
    """The track list at this step; the platform's turn is known."""
    predicted = kalman.predict(tracks, time_step, params)
    return predicted.replace(mean=seen_in_turn(predicted.mean, index, params))


_Update = tuple[kalman.ExpectedDetections, jax.Array, jax.Array, Tracks]
"""Expectations, distances `[T, D]`, associations `[T]`, and the updated track list."""


def _follow(predicted: Tracks, detections: Detections, static: StaticParams, params: Params) -> _Update:
    """Gate, associate, update."""
    return jax.lax.cond(
        jnp.any(detections.active),
        lambda: _associate_and_update(predicted, detections, static, params),
        lambda: _coast(predicted, detections, static, params),
    )


def _associate_and_update(
    predicted: Tracks, detections: Detections, static: StaticParams, params: Params
) -> _Update:
    expected = FILTERS[static.filter](predicted, params)
    distances = _distances(expected, detections, static, params)
    admissible = association.gate(distances, predicted, detections, params)
    associated = ASSOCIATORS[static.associator](admissible, params)
    if static.filter == "converted":
        positions = converted.convert(detections, params)
        updated = converted.update(predicted, expected, positions, associated)
    else:
        updated = kalman.update(predicted, expected, detections, associated)
    return expected, distances, associated, updated


def _coast(predicted: Tracks, detections: Detections, static: StaticParams, params: Params) -> _Update:
    """`_associate_and_update` without a detection; costs nothing where no one asks for its details."""
    expected = FILTERS[static.filter](predicted, params)
    return expected, _distances(expected, detections, static, params), predicted.updated_by, predicted


def _distances(
    expected: ExpectedDetections, detections: Detections, static: StaticParams, params: Params
) -> jax.Array:
    measure = MEASURES[static.measure]
    if static.filter == "converted":
        return converted.distances(expected, converted.convert(detections, params), measure, params)
    return measure(expected, detections, params)


def _initiate(
    tracks: Tracks, detections: Detections, new: jax.Array, index: jax.Array, params: Params
) -> tuple[Tracks, jax.Array]:
    """`lifecycle.initiate_tracks` where there is anything to initiate."""
    return jax.lax.cond(
        jnp.any(new),
        lambda: lifecycle.initiate_tracks(tracks, detections, new, index, params),
        lambda: (tracks, jnp.asarray(0)),
    )


def _initiate_confirmed(
    tracks: Tracks,
    detections: Detections,
    time_step: Scalar,
    index: jax.Array,
    static: StaticParams,
    params: Params,
) -> tuple[Tracks, jax.Array]:
    """Follows the tentative tracks, and takes over those with enough detections.

    Stone Soup's `MultiMeasurementInitiator`. They have a tracker of their own, of the same parts, which
    gets the `detections` that no track used. A tentative track is not looked at on the step of its birth,
    so that `min_points` = 1 means: on the step after it.
    """
    if tracks.tentative is None:
        raise ValueError("tracks.tentative = None: expected a list that began as lifecycle.no_tracks(...)")
    tentative, detections = _blank_empty_rows(tracks.tentative, detections, params)
    predicted = _predict(tentative, time_step, index, params)
    _, _, associated, updated = _follow(predicted, detections, static, params)
    confirmed = updated.active & (lifecycle.counts_of(updated).hits >= static.min_points)
    tracks, num_dropped = lifecycle.take_over(tracks, updated, confirmed)
    held = lifecycle.delete_tracks(updated.replace(active=updated.active & ~confirmed), static, params)
    new = lifecycle.unassociated(detections, associated)
    held, num_dropped_held = _initiate(held, detections, new, index, params)
    return tracks.replace(tentative=held), num_dropped + num_dropped_held


def _check_form(tracks: Tracks, static: StaticParams) -> None:
    held = "full" if tracks.root is None else "square_root"
    if held != static.covariance_form:
        raise ValueError(
            f"tracks.root: the form of its covariances is {held}; expected a list that began as "
            f"lifecycle.no_tracks(...) with covariance_form = {static.covariance_form!r}"
        )


def _blank_empty_rows(tracks: Tracks, detections: Detections, params: Params) -> tuple[Tracks, Detections]:
    """Puts harmless numbers into empty rows, so that neither values nor gradients turn NaN."""
    somewhere = params.min_range * jnp.eye(STATE_DIM)[0]
    root = tracks.root
    tracks = tracks.replace(
        mean=where_rows(tracks.active, tracks.mean, somewhere),
        covariance=where_rows(tracks.active, tracks.covariance, jnp.eye(STATE_DIM)),
        root=None if root is None else where_rows(tracks.active, root, jnp.eye(STATE_DIM)),
    )
    origin = params.min_range * jnp.eye(3)[2]
    return tracks, detections.replace(value=where_rows(detections.active, detections.value, origin))
