"""The only file that knows both worlds: Stone Soup's sets of objects and jaxtrack's records.

A track is identified by its birth step together with its birth detection, which both are
kept in the metadata of the detection that initiated it. Sets have no order: a track list is
always written in the order of these keys.
"""

import datetime
from collections.abc import Iterable, Sequence

import jax.numpy as jnp
import numpy as np
from stonesoup.models.measurement.nonlinear import CartesianToElevationBearingRange
from stonesoup.types.angle import Bearing, Elevation
from stonesoup.types.array import StateVector
from stonesoup.types.detection import Detection
from stonesoup.types.groundtruth import GroundTruthPath, GroundTruthState
from stonesoup.types.hypothesis import SingleHypothesis
from stonesoup.types.state import GaussianState, State
from stonesoup.types.track import Track
from stonesoup.types.update import GaussianStateUpdate

from jaxtrack.types import NO_DETECTION, STATE_DIM, Tracks, Truths

TrackKey = tuple[int, int]
"""Birth step and birth detection of a track."""


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


def detection_index(detection: Detection) -> int:
    """Row of a Stone Soup detection in the array that it came from."""
    return detection.metadata["index"]


def track_key(track: Track) -> TrackKey:
    """Birth step and birth detection of a Stone Soup track."""
    birth = track[0].hypothesis.measurement.metadata
    return birth["step"], birth["index"]


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
    mean = np.zeros((max_tracks, STATE_DIM))
    covariance = np.zeros((max_tracks, STATE_DIM, STATE_DIM))
    births = np.full((max_tracks, 2), NO_DETECTION)
    source = np.full(max_tracks, NO_DETECTION)
    for slot, (track, key) in enumerate(zip(ordered, keys, strict=True)):
        mean[slot], covariance[slot] = as_vector(track.state_vector), track.covar
        births[slot] = key
        source[slot] = updated_by.get(key, NO_DETECTION)
    active = np.arange(max_tracks) < len(ordered)
    return Tracks(
        mean=jnp.asarray(mean, float),
        covariance=jnp.asarray(covariance, float),
        active=jnp.asarray(active),
        updated_by=jnp.asarray(source),
        birth_step=jnp.asarray(births[:, 0]),
        birth_detection=jnp.asarray(births[:, 1]),
        age=jnp.asarray(np.where(active, step - births[:, 0], 0)),
    )


def to_states(truths: Truths, time: datetime.datetime) -> list[State]:
    """Stone Soup states of the living truths."""
    state = np.asarray(truths.state, float)
    return [State(StateVector(state[row]), timestamp=time) for row in np.flatnonzero(truths.alive)]


def _track(mean: np.ndarray, covariance: np.ndarray, key: TrackKey, time: datetime.datetime) -> Track:
    """A track whose only state is the given one, with its key in the birth's metadata."""
    birth = Detection(StateVector(np.zeros(3)), timestamp=time, metadata={"step": key[0], "index": key[1]})
    state = GaussianState(StateVector(mean), covariance, timestamp=time)
    return Track(
        [
            GaussianStateUpdate(
                state.state_vector, state.covar, timestamp=time, hypothesis=SingleHypothesis(None, birth)
            )
        ]
    )


def to_track_histories(tracks: Tracks, times: Sequence[datetime.datetime]) -> dict[TrackKey, Track]:
    """Whole Stone Soup tracks of a record `[K, T, ...]`, one for every key that it holds.

    Args:
        tracks: the record; slots may hold one track after another.
        times: time of every step.
    """
    active, mean = np.asarray(tracks.active), np.asarray(tracks.mean, float)
    covariance = np.asarray(tracks.covariance, float)
    births = np.stack([tracks.birth_step, tracks.birth_detection], axis=-1)
    histories: dict[TrackKey, Track] = {}
    for step, slot in np.argwhere(active):
        birth_step, birth_detection = births[step, slot]
        key, estimate = (int(birth_step), int(birth_detection)), (mean[step, slot], covariance[step, slot])
        if key in histories:
            state = GaussianState(StateVector(estimate[0]), estimate[1], timestamp=times[step])
            histories[key].append(state)
        else:
            histories[key] = _track(*estimate, key, times[step])
    return histories


def to_ground_truth_paths(truths: Truths, times: Sequence[datetime.datetime]) -> dict[int, GroundTruthPath]:
    """Stone Soup paths of a record `[K, N, ...]`, by row; rows that never live have none."""
    alive, state = np.asarray(truths.alive), np.asarray(truths.state, float)
    return {
        int(row): GroundTruthPath(
            [
                GroundTruthState(StateVector(state[step, row]), timestamp=times[step])
                for step in np.flatnonzero(alive[:, row]).tolist()
            ]
        )
        for row in np.flatnonzero(alive.any(axis=0))
    }
