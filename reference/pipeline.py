"""One step of the stock tracker at a time, with every intermediate on record."""

import datetime
from dataclasses import dataclass

import numpy as np
from stonesoup.types.detection import Detection
from stonesoup.types.track import Track
from stonesoup.types.update import Update

from jaxtrack.params import Params, StaticParams
from jaxtrack.tracker import DEFAULT
from jaxtrack.types import NO_DETECTION, Tracks
from reference.components import build_components, time_of
from reference.translate import (
    TrackKey,
    as_vector,
    detection_index,
    to_detections,
    to_position,
    to_stone_soup_tracks,
    to_tracks,
    track_key,
)


@dataclass(frozen=True)
class Expected:
    """Prediction of one track and how far every detection is from it.

    Attributes:
        mean: `[6]` predicted state.
        covariance: `[6, 6]` its covariance.
        detection_mean: `[3]` expected detection.
        detection_covariance: `[3, 3]` innovation covariance S.
        cross_covariance: `[6, 3]` between state and detection.
        distances: `[D]` Mahalanobis distances before the gate, NaN in rows without a detection.
        admissible: `[D]` which detections passed hypothesiser and gater.
    """

    mean: np.ndarray
    covariance: np.ndarray
    detection_mean: np.ndarray
    detection_covariance: np.ndarray
    cross_covariance: np.ndarray
    distances: np.ndarray
    admissible: np.ndarray


@dataclass(frozen=True)
class Estimate:
    """State of one track: mean `[6]` and covariance `[6, 6]`."""

    mean: np.ndarray
    covariance: np.ndarray


@dataclass(frozen=True)
class StepRecord:
    """What the stock tracker did in one step; tracks go by their keys.

    Attributes:
        step: number of the step.
        expected: intermediates of every track that was alive before the step, if asked for.
        associated: detection of each track that got one.
        updated: estimate of every track that was alive before, after the update.
        deleted: tracks deleted on this step.
        initiated: tracks born on this step.
        live: estimate of every track alive after the step.
    """

    step: int
    expected: dict[TrackKey, Expected]
    associated: dict[TrackKey, int]
    updated: dict[TrackKey, Estimate]
    deleted: set[TrackKey]
    initiated: set[TrackKey]
    live: dict[TrackKey, Estimate]

    def source(self, key: TrackKey) -> int:
        """Detection that updated or initiated a live track on this step, else `NO_DETECTION`."""
        born_from = key[1] if key in self.initiated else NO_DETECTION
        return self.associated.get(key, born_from)


class StoneSoupTracker:
    """The stock `MultiTargetTracker`, fed with arrays.

    Args:
        params: numbers of the tracker.
        exact_jacobian: see `build_components`.
        intermediates: whether the records hold predictions and distances, which the stock
            tracker does not give away and which are computed a second time. Not for the filter
            `converted`, whose detections each have their own expectation.
        static: which components, by name.
    """

    def __init__(
        self,
        params: Params,
        exact_jacobian: bool = True,
        intermediates: bool = True,
        static: StaticParams = DEFAULT,
    ) -> None:
        self.params, self.static = params, static
        self.components = build_components(params, exact_jacobian, static)
        self.intermediates = intermediates
        self.tracker = self.components.tracker()
        self.index = 0

    @property
    def tracks(self) -> set[Track]:
        """The live tracks."""
        return self.tracker.tracks

    def load(self, tracks: Tracks, index: int) -> None:
        """Continues from jaxtrack's track list as it was after step `index`."""
        self.index = index
        self.tracker._tracks = to_stone_soup_tracks(tracks, time_of(index, self.params))

    def export(self, max_tracks: int, record: StepRecord | None = None) -> Tracks:
        """The live tracks as jaxtrack's track list, with the sources that `record` knows."""
        updated_by = {key: record.source(key) for key in record.live} if record else {}
        return to_tracks(self.tracks, self.index, max_tracks, updated_by)

    def step(
        self, value: np.ndarray, active: np.ndarray | None = None, time: datetime.datetime | None = None
    ) -> StepRecord:
        """One step of the stock tracker.

        Args:
            value: `[D, 3]` elevation, bearing (rad), range (m).
            active: `[D]` which rows hold a detection; all if not given.
            time: when; one `params.time_step` after the other if not given.
        """
        self.index += 1
        active = np.ones(len(value), dtype=bool) if active is None else np.asarray(active)
        time = time_of(self.index, self.params) if time is None else time
        model = self.components.measurement_model
        detections = to_detections(np.asarray(value, float), active, self.index, time, model)
        if self.static.filter == "converted":
            detections = [to_position(detection) for detection in detections]
        before = {track_key(track): track for track in self.tracks}
        expected = {}
        if self.intermediates:
            expected = {
                key: self.expect(track, detections, len(value), time) for key, track in before.items()
            }

        self.tracker.update_tracker(time, set(detections))

        after = {track_key(track): track for track in self.tracks}
        return StepRecord(
            step=self.index,
            expected=expected,
            associated={
                key: detection_index(track.state.hypothesis.measurement)
                for key, track in before.items()
                if isinstance(track.state, Update)
            },
            updated={key: estimate(track) for key, track in before.items()},
            deleted=before.keys() - after.keys(),
            initiated=after.keys() - before.keys(),
            live={key: estimate(track) for key, track in after.items()},
        )

    def expect(
        self, track: Track, detections: list[Detection], rows: int, time: datetime.datetime
    ) -> Expected:
        """Predicts one track to the time of the present step and measures it against all detections."""
        parts = self.components
        prediction = parts.predictor.predict(track, timestamp=time)
        measured = parts.updater.predict_measurement(prediction, parts.measurement_model)
        distances = np.full(rows, np.nan)
        for detection in detections:
            distances[detection_index(detection)] = parts.measure(measured, detection)
        admissible = np.zeros(rows, dtype=bool)
        for hypothesis in parts.hypothesiser.hypothesise(track, detections, time):
            if hypothesis:
                admissible[detection_index(hypothesis.measurement)] = True
        return Expected(
            mean=as_vector(prediction.state_vector),
            covariance=np.asarray(prediction.covar, float),
            detection_mean=as_vector(measured.state_vector),
            detection_covariance=np.asarray(measured.covar, float),
            cross_covariance=np.asarray(measured.cross_covar, float),
            distances=distances,
            admissible=admissible,
        )


def estimate(track: Track) -> Estimate:
    """The present estimate of a Stone Soup track."""
    return Estimate(as_vector(track.state_vector), np.asarray(track.covar, float))
