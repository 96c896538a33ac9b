"""Where Stone Soup's sets of objects become jaxtrack's records, and back.

A track is identified by its birth step together with its birth detection, which both are
kept in the metadata of the detection that initiated it. Sets have no order: a track list is
always written in the order of these keys. Whole episodes: `stone_soup_objects.py`.
"""

import datetime
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from stonesoup.models.measurement.nonlinear import CartesianToElevationBearingRange
from stonesoup.types.angle import Bearing, Elevation
from stonesoup.types.array import StateVector
from stonesoup.types.detection import Detection
from stonesoup.types.groundtruth import GroundTruthPath, GroundTruthState
from stonesoup.types.hypothesis import SingleHypothesis
from stonesoup.types.prediction import GaussianStatePrediction
from stonesoup.types.state import GaussianState, State
from stonesoup.types.track import Track
from stonesoup.types.update import GaussianStateUpdate

from jaxtrack.types import NEVER, NO_DETECTION, STATE_DIM, Tracks, Truths
from reference.components import position_model

TrackKey = tuple[int, int]
"""Birth step and birth detection of a track."""

Estimate = tuple[GaussianState, TrackKey, int]
"""What a slot holds: a track's state, its key, and the detection that updated it, or `NO_DETECTION`."""


def as_vector(state_vector: StateVector) -> np.ndarray:
    """Stone Soup's column of numbers and typed angles as a flat float array."""
    return np.array([float(entry) for entry in np.asarray(state_vector).ravel()])


def to_detections(
    value: np.ndarray,
    active: np.ndarray,
    step: int,
    time: datetime.datetime,
    model: CartesianToElevationBearingRange,
) -> list[Detection]:
    """Stone Soup detections, with typed angles, of the active rows of `value` `[D, 3]`."""
    return [
        Detection(
            StateVector([Elevation(value[row, 0]), Bearing(value[row, 1]), value[row, 2]]),
            timestamp=time,
            measurement_model=model,
            metadata={"step": step, "index": int(row)},
        )
        for row in np.flatnonzero(active)
    ]


def to_position(detection: Detection) -> Detection:
    """The same detection as a position (m), with a linear model and noise of its own."""
    place = as_vector(detection.measurement_model.inverse_function(detection))[0::2]
    return Detection(
        StateVector(place),
        timestamp=detection.timestamp,
        measurement_model=position_model(detection),
        metadata=detection.metadata,
    )


def detection_index(detection: Detection) -> int:
    """Row of a Stone Soup detection in the array that it came from."""
    return detection.metadata["index"]


def track_key(track: Track) -> TrackKey:
    """Birth step and birth detection of a Stone Soup track."""
    return _numbers(track[0].hypothesis.measurement)


def slot_keys(tracks: Tracks) -> list[TrackKey | None]:
    """Key of every slot of jaxtrack's track list, None where it is empty."""
    active = np.asarray(tracks.active)
    births = zip(np.asarray(tracks.birth_step), np.asarray(tracks.birth_detection), strict=True)
    return [(int(step), int(row)) if live else None for live, (step, row) in zip(active, births, strict=True)]


def to_stone_soup_tracks(tracks: Tracks, time: datetime.datetime) -> set[Track]:
    """Stone Soup tracks of the live slots; each has only its present state."""
    keys = slot_keys(tracks)
    mean, covariance = np.asarray(tracks.mean, float), np.asarray(tracks.covariance, float)
    return {
        _track(mean[slot], covariance[slot], key, time) for slot, key in enumerate(keys) if key is not None
    }


def to_tracks(
    stone_soup_tracks: Iterable[Track], step: int, max_tracks: int, updated_by: dict[TrackKey, int]
) -> Tracks:
    """Track list of jaxtrack for Stone Soup tracks, in the order of their keys.

    Args:
        stone_soup_tracks: the live tracks.
        step: present step, from which the ages follow.
        max_tracks: capacity.
        updated_by: detection that updated or initiated the tracks on this step.

    Raises:
        ValueError: if there are more tracks than slots.
    """
    ordered = sorted(stone_soup_tracks, key=track_key)
    if len(ordered) > max_tracks:
        raise ValueError(f"{len(ordered)} tracks: expected at most max_tracks = {max_tracks}")
    keys = [track_key(track) for track in ordered]
    held: list[Estimate | None] = [
        (track.state, key, updated_by.get(key, NO_DETECTION))
        for track, key in zip(ordered, keys, strict=True)
    ]
    return on_device(fill_slots(held + [None] * (max_tracks - len(held)), step))


def fill_slots(held: Sequence[Estimate | None], step: int) -> Tracks:
    """Track list on the host of what each slot holds on a step, None for an empty slot."""
    slots = len(held)
    rows: dict[str, Any] = {
        "mean": np.zeros((slots, STATE_DIM)),
        "covariance": np.zeros((slots, STATE_DIM, STATE_DIM)),
        "active": np.zeros(slots, bool),
        "updated_by": np.full(slots, NO_DETECTION),
        "birth_step": np.full(slots, NEVER),
        "birth_detection": np.full(slots, NO_DETECTION),
        "age": np.zeros(slots, int),
    }
    for slot, estimate in enumerate(held):
        if estimate is not None:
            state, (birth_step, birth_detection), source = estimate
            values = (as_vector(state.state_vector), state.covar, True, source, birth_step, birth_detection)
            for row, value in zip(rows.values(), (*values, step - birth_step), strict=True):
                row[slot] = value
    return Tracks(**rows)


def on_device(tracks: Tracks) -> Tracks:
    """The same in JAX's arrays, at its precision."""
    return jax.tree.map(lambda leaf: jnp.asarray(leaf, float if leaf.dtype.kind == "f" else None), tracks)


def to_states(truths: Truths, time: datetime.datetime) -> list[State]:
    """Stone Soup states of the living truths."""
    state = np.asarray(truths.state, float)
    return [State(StateVector(state[row]), timestamp=time) for row in np.flatnonzero(truths.alive)]


def _track(
    mean: np.ndarray,
    covariance: np.ndarray,
    key: TrackKey,
    time: datetime.datetime,
    birth: Detection | None = None,
) -> Track:
    """A track whose only state is the given one, with its key in the birth's metadata."""
    if birth is None:
        metadata = {"step": key[0], "index": key[1]}
        birth = Detection(StateVector(np.zeros(3)), timestamp=time, metadata=metadata)
    return Track([_update(mean, covariance, time, None, birth)], id=f"{key[0]}-{key[1]}")


def _update(
    mean: np.ndarray,
    covariance: np.ndarray,
    time: datetime.datetime,
    prediction: GaussianStatePrediction | None,
    detection: Detection,
) -> GaussianStateUpdate:
    hypothesis = SingleHypothesis(prediction, detection)
    return GaussianStateUpdate(StateVector(mean), covariance, timestamp=time, hypothesis=hypothesis)


def _prediction(mean: np.ndarray, covariance: np.ndarray, time: datetime.datetime) -> GaussianStatePrediction:
    return GaussianStatePrediction(StateVector(mean), covariance, timestamp=time)


def to_track_histories(
    tracks: Tracks,
    times: Sequence[datetime.datetime],
    predicted: Tracks | None = None,
    detections: Sequence[Mapping[int, Detection]] | None = None,
) -> dict[TrackKey, Track]:
    """Whole Stone Soup tracks of a record `[K, T, ...]`, one for every key that it holds.

    As in Stone Soup's tracker, a state is an `Update` where a detection updated the track, with
    the hypothesis that joins prediction and detection, and a prediction elsewhere.

    Args:
        tracks: the record; slots may hold one track after another.
        times: time of every step.
        predicted: the record of the predictions, for the hypotheses; without it they have none.
        detections: the detections of every step by index; without them all states after a track's
            first are predictions.
    """
    active, source = np.asarray(tracks.active), np.asarray(tracks.updated_by)
    mean, covariance = np.asarray(tracks.mean, float), np.asarray(tracks.covariance, float)
    births = np.stack([tracks.birth_step, tracks.birth_detection], axis=-1)
    histories: dict[TrackKey, Track] = {}
    for step, slot in np.argwhere(active):
        key: TrackKey = tuple(births[step, slot].tolist())
        estimate, time = (mean[step, slot], covariance[step, slot]), times[step]
        detection = None if detections is None else detections[step].get(int(source[step, slot]))
        if key not in histories:
            # A record may begin in the middle of a track's life: then its birth's detection is not there.
            known = detection is not None and _numbers(detection) == key
            histories[key] = _track(*estimate, key, time, detection if known else None)
        elif detection is None:
            histories[key].append(_prediction(*estimate, time))
        else:
            prior = None
            if predicted is not None:
                before = predicted.mean[step, slot], predicted.covariance[step, slot]
                prior = _prediction(np.asarray(before[0], float), np.asarray(before[1], float), time)
            histories[key].append(_update(*estimate, time, prior, detection))
    return histories


def _numbers(detection: Detection) -> TrackKey:
    return detection.metadata["step"], detection.metadata["index"]


def to_ground_truth_paths(truths: Truths, times: Sequence[datetime.datetime]) -> dict[int, GroundTruthPath]:
    """Stone Soup paths of a record `[K, N, ...]`, by row; rows that never live have none."""
    alive, state = np.asarray(truths.alive), np.asarray(truths.state, float)
    return {
        int(row): GroundTruthPath(
            [
                GroundTruthState(StateVector(state[step, row]), timestamp=times[step])
                for step in np.flatnonzero(alive[:, row]).tolist()
            ],
            id=str(row),
        )
        for row in np.flatnonzero(alive.any(axis=0))
    }
