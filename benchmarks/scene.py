"""What every side of `benchmarks.tracker` gets, and how far apart are the results."""

import dataclasses
from collections.abc import Sequence
from typing import Any

import jax
import numpy as np
from flax import struct

from jaxtrack import kalman
from jaxtrack.params import Params
from jaxtrack.types import STATE_DIM, Tracks
from reference.components import noise_sigmas
from reference.parity.compare import covariance_error, mean_error
from reference.parity.scenes import random_tracks, spherical
from reference.translate import slot_keys

STEP = 1
"""Number of the step that is timed; the tracks are those after step 0."""

FAR = 9000.0
"""Range (m) of the detection that belongs to no track: all tracks are nearer than 6.1 km."""


class Scene(struct.PyTreeNode):
    """What every side gets.

    Attributes:
        tracks: `[T]` live tracks after the last step.
        predicted: `[T]` the same, predicted to this step.
        own: `[T, 3]` a detection of every track, for the filter's update.
        scan: `[D, 3]` detections of this step, for the whole tracker: one of each of D - 1 tracks, and
            one of something new.
    """

    tracks: Tracks
    predicted: Tracks
    own: Any  # [T, 3]
    scan: Any  # [D, 3]


@dataclasses.dataclass(frozen=True)
class Estimates:
    """What a side makes of a scene.

    Attributes:
        labels: what is estimated, track by track: places, or keys and detections after a whole step.
        mean: `[T, 6]`.
        covariance: `[T, 6, 6]`.
    """

    labels: list[Any]
    mean: np.ndarray
    covariance: np.ndarray


Timed = tuple[float, Estimates]
"""Seconds, and what came out."""


def random_scenes(count: int, num_tracks: int, num_detections: int, seed: int, params: Params) -> Scene:
    """Scenes `[count]` in float64 on the host, each with its own random numbers."""
    streams = np.random.default_rng((seed, num_tracks)).spawn(count)
    with jax.enable_x64(True):
        scenes = [random_scene(rng, num_tracks, num_detections, params) for rng in streams]
    return jax.tree.map(lambda *leaves: np.stack(leaves), *scenes)


def random_scene(rng: np.random.Generator, num_tracks: int, num_detections: int, params: Params) -> Scene:
    """Tracks all over the field, of which one is so uncertain that this step deletes it."""
    tracks = random_tracks(rng, num_tracks, spread=0.3)
    trace = np.trace(np.asarray(tracks.covariance)[0])
    grown = tracks.covariance.at[0].multiply(2 * params.deletion_threshold / trace)
    tracks = tracks.replace(covariance=grown)
    predicted = kalman.predict(tracks, params.time_step, params)
    factor = np.linalg.cholesky(np.asarray(predicted.covariance))
    states = np.asarray(predicted.mean) + (factor @ rng.standard_normal((num_tracks, STATE_DIM, 1)))[..., 0]
    own = spherical(states[:, ::2]) + noise_sigmas(params) * rng.standard_normal((num_tracks, 3))
    seen = 1 + rng.permutation(num_tracks - 1)[: num_detections - 1]
    scan = np.concatenate([own[seen], [[0.3, -0.3, FAR]]])
    return Scene(tracks=tracks, predicted=predicted, own=own, scan=scan)


def from_tracks(tracks: Tracks) -> Estimates:
    """Our track list after a whole step: the live tracks in the order of their keys."""
    sources = np.asarray(tracks.updated_by)
    ordered = sorted((key, slot) for slot, key in enumerate(slot_keys(tracks)) if key is not None)
    labels, slots = [(key, int(sources[slot])) for key, slot in ordered], [slot for _, slot in ordered]
    return Estimates(labels, np.asarray(tracks.mean)[slots], np.asarray(tracks.covariance)[slots])


def in_order(mean: Sequence[np.ndarray], covariance: Sequence[np.ndarray]) -> Estimates:
    """Filters without identities: one after the other."""
    return Estimates(list(range(len(mean))), np.asarray(mean, float), np.asarray(covariance, float))


def error(ours: Estimates, theirs: Estimates) -> float:
    """Largest error in standard deviations; infinite where tracks or their detections differ."""
    if ours.labels != theirs.labels:
        return float("inf")
    of_means = mean_error(ours.mean, theirs.mean, theirs.covariance)
    return max(of_means, covariance_error(ours.covariance, theirs.covariance))
