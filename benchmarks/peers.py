"""One step of a tracker by Stone Soup and by FilterPy, on the inputs of ours: see `benchmarks.tracker`.

Whatever a user does once, building filters and objects, is done before the clock starts.
"""

import importlib.util
import time
from collections.abc import Sequence

import jax
import numpy as np
from stonesoup.types.array import StateVector
from stonesoup.types.detection import Detection
from stonesoup.types.hypothesis import SingleHypothesis
from stonesoup.types.prediction import GaussianStatePrediction
from stonesoup.types.state import GaussianState
from stonesoup.types.track import Track
from stonesoup.types.update import Update

from benchmarks.scene import STEP, Estimates, Scene, Timed, in_order
from jaxtrack.params import Params
from jaxtrack.types import NO_DETECTION, STATE_DIM, Tracks
from reference.components import Components, noise_covariance, time_of, transition_model
from reference.pipeline import StoneSoupTracker, estimate
from reference.translate import TrackKey, as_vector, detection_index, to_detections, track_key


class StoneSoup:
    """The stock components, with the exact Jacobian of new tracks, which is quicker than the stock one."""

    def __init__(self, params: Params) -> None:
        self.params = params
        self.tracker = StoneSoupTracker(params, intermediates=False)
        self.times = [time_of(step, params) for step in (0, STEP)]

    @property
    def parts(self) -> Components:
        """Its components."""
        return self.tracker.components

    def predict(self, scene: Scene) -> Timed:
        """`KalmanPredictor`, track by track."""
        states = [
            GaussianState(StateVector(mean), covariance, timestamp=self.times[0])
            for mean, covariance in _estimates(scene.tracks)
        ]
        began = time.perf_counter()
        predicted = [self.parts.predictor.predict(state, timestamp=self.times[1]) for state in states]
        seconds = time.perf_counter() - began
        return seconds, _of_states(predicted)

    def update(self, scene: Scene) -> Timed:
        """`UnscentedKalmanUpdater`: measurement prediction and update, track by track."""
        predictions = [
            GaussianStatePrediction(StateVector(mean), covariance, timestamp=self.times[1])
            for mean, covariance in _estimates(scene.predicted)
        ]
        detections, updater = self._detections(scene.own), self.parts.updater
        began = time.perf_counter()
        updated = []
        for prediction, detection in zip(predictions, detections, strict=True):
            expected = updater.predict_measurement(prediction, detection.measurement_model)
            updated.append(updater.update(SingleHypothesis(prediction, detection, expected)))
        seconds = time.perf_counter() - began
        return seconds, _of_states(updated)

    def step(self, scene: Scene) -> Timed:
        """`MultiTargetTracker`, one whole step."""
        self.tracker.load(scene.tracks, index=0)
        detections = set(self._detections(scene.scan))
        before = {track_key(track) for track in self.tracker.tracks}
        began = time.perf_counter()
        self.tracker.tracker.update_tracker(self.times[1], detections)
        seconds = time.perf_counter() - began
        live = sorted(self.tracker.tracks, key=track_key)
        labels = [(track_key(track), _source(track, before)) for track in live]
        found = [estimate(track) for track in live]
        mean, covariance = zip(*((each.mean, each.covariance) for each in found), strict=True)
        return seconds, Estimates(labels, np.array(mean), np.array(covariance))

    def _detections(self, value: np.ndarray) -> list[Detection]:
        active = np.ones(len(value), dtype=bool)
        return to_detections(value, active, STEP, self.times[1], self.parts.measurement_model)


class FilterPy:
    """FilterPy's filters, one for each track. It has no gates, association, initiation or deletion."""

    def __init__(self, params: Params) -> None:
        from filterpy.kalman import KalmanFilter, MerweScaledSigmaPoints, UnscentedKalmanFilter

        self.linear, self.unscented = KalmanFilter, UnscentedKalmanFilter
        self.points = MerweScaledSigmaPoints(STATE_DIM, params.alpha, params.beta, params.kappa)
        model = transition_model(params.process_noise)
        interval = time_of(STEP, params) - time_of(0, params)
        self.F, self.Q = model.matrix(time_interval=interval), model.covar(time_interval=interval)
        self.R = noise_covariance(params)

    def predict(self, scene: Scene) -> Timed:
        """`KalmanFilter.predict`."""
        filters = []
        for mean, covariance in _estimates(scene.tracks):
            one = self.linear(dim_x=STATE_DIM, dim_z=3)
            one.x, one.P, one.F, one.Q = mean.copy(), covariance.copy(), self.F, np.asarray(self.Q, float)
            filters.append(one)
        began = time.perf_counter()
        for one in filters:
            one.predict()
        seconds = time.perf_counter() - began
        return seconds, in_order([one.x for one in filters], [one.P for one in filters])

    def update(self, scene: Scene) -> Timed:
        """`UnscentedKalmanFilter.update`, with the sigma points of the prediction."""
        filters = []
        for mean, covariance in _estimates(scene.predicted):
            one = self.unscented(
                STATE_DIM, 3, None, hx=_measure, fx=None, points=self.points, z_mean_fn=_mean_detection,
                residual_z=_difference,
            )  # fmt: skip
            one.x, one.P, one.R = mean.copy(), covariance.copy(), self.R
            filters.append(one)
        began = time.perf_counter()
        for one, value in zip(filters, scene.own, strict=True):
            one.sigmas_f = self.points.sigma_points(one.x, one.P)
            one.update(value)
        seconds = time.perf_counter() - began
        return seconds, in_order([one.x for one in filters], [one.P for one in filters])


def has_filterpy() -> bool:
    """Whether FilterPy is installed (extra `bench`)."""
    return importlib.util.find_spec("filterpy") is not None


def _measure(state: np.ndarray) -> np.ndarray:
    """Elevation, bearing (rad) and range (m)."""
    x, y, z = state[0], state[2], state[4]
    ground = np.hypot(x, y)
    return np.array([np.arctan2(z, ground), np.arctan2(y, x), np.hypot(ground, z)])


def _mean_detection(values: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Angles averaged by their sines and cosines, as they must be."""
    mean = weights @ values
    mean[:2] = np.arctan2(weights @ np.sin(values[:, :2]), weights @ np.cos(values[:, :2]))
    return mean


def _difference(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """With the bearing in [-pi, pi)."""
    difference = a - b
    difference[1] = (difference[1] + np.pi) % (2 * np.pi) - np.pi
    return difference


def _estimates(tracks: Tracks) -> list[tuple[np.ndarray, np.ndarray]]:
    mean, covariance = jax.device_get((tracks.mean, tracks.covariance))
    return list(zip(mean, covariance, strict=True))


def _of_states(states: Sequence[GaussianState]) -> Estimates:
    return in_order([as_vector(state.state_vector) for state in states], [state.covar for state in states])


def _source(track: Track, before: set[TrackKey]) -> int:
    """Detection that updated or initiated a track on this step, else `NO_DETECTION`."""
    key = track_key(track)
    if key not in before:
        return key[1]
    if not isinstance(track.state, Update):
        return NO_DETECTION
    return detection_index(track.state.hypothesis.measurement)
