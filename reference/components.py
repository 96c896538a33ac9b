"""Stone Soup's components, built from the parameters of jaxtrack."""

import datetime
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from stonesoup.dataassociator import DataAssociator
from stonesoup.dataassociator.neighbour import GNNWith2DAssignment, NearestNeighbour
from stonesoup.deleter import Deleter
from stonesoup.deleter.error import CovarianceBasedDeleter
from stonesoup.deleter.multi import CompositeDeleter
from stonesoup.deleter.time import UpdateTimeDeleter, UpdateTimeStepsDeleter
from stonesoup.gater.distance import DistanceGater
from stonesoup.hypothesiser.distance import DistanceHypothesiser
from stonesoup.initiator import Initiator
from stonesoup.initiator.simple import MultiMeasurementInitiator
from stonesoup.measures import Euclidean, Mahalanobis
from stonesoup.measures.state import (
    GaussianHellinger,
    KLDivergence,
    Measure,
    SquaredGaussianHellinger,
    SquaredMahalanobis,
)
from stonesoup.metricgenerator.ospametric import GOSPAMetric
from stonesoup.models.measurement.linear import LinearGaussian
from stonesoup.models.measurement.nonlinear import CartesianToElevationBearingRange
from stonesoup.models.transition.linear import CombinedLinearGaussianTransitionModel, ConstantVelocity
from stonesoup.predictor.kalman import KalmanPredictor
from stonesoup.tracker.simple import MultiTargetTracker
from stonesoup.types.detection import Detection
from stonesoup.types.state import GaussianState, State
from stonesoup.updater.kalman import (
    KalmanUpdater,
)

from jaxtrack.params import Params, StaticParams
from jaxtrack.tracker import DEFAULT
from jaxtrack.types import POSITION, STATE_DIM, VELOCITY
from reference.filters import build_filter

EPOCH = datetime.datetime(2000, 1, 1)
"""Time of step 0."""

MEASURES: dict[str, type[Measure]] = {
    "mahalanobis": Mahalanobis,
    "squared_mahalanobis": SquaredMahalanobis,
    "euclidean": Euclidean,
    "kullback_leibler": KLDivergence,
    "hellinger": GaussianHellinger,
    "squared_hellinger": SquaredGaussianHellinger,
}
"""Stock measures by the names of `jaxtrack.association.MEASURES`.

The last three need detections that carry their own covariance (`GaussianDetection`): with a
plain `Detection` they fail for want of one.
"""

ASSOCIATORS: dict[str, type[DataAssociator]] = {
    "nearest_neighbour": NearestNeighbour,
    "global_nearest_neighbour": GNNWith2DAssignment,
}
"""Stock associators by the names of `jaxtrack.association.ASSOCIATORS`."""


def update_time_deleter(params: Params) -> UpdateTimeDeleter:
    """Deletes tracks whose last detection is long ago."""
    assert params.deletion_time is not None
    return UpdateTimeDeleter(time_since_update=datetime.timedelta(seconds=float(params.deletion_time)))


def update_time_steps_deleter(params: Params) -> UpdateTimeStepsDeleter:
    """Deletes tracks that were missed many steps in a row."""
    assert params.deletion_steps is not None
    return UpdateTimeStepsDeleter(time_steps_since_update=int(params.deletion_steps))


DELETERS: dict[str, Callable[[Params], Deleter]] = {
    "covariance": lambda params: CovarianceBasedDeleter(covar_trace_thresh=params.deletion_threshold),
    "update_time": update_time_deleter,
    "update_time_steps": update_time_steps_deleter,
}
"""Stock deleters by the names of `jaxtrack.lifecycle.DELETERS`."""


class ExactCartesianToElevationBearingRange(CartesianToElevationBearingRange):
    """The stock model, but for its Jacobian: exact instead of finite differences.

    Stone Soup's `SimpleMeasurementInitiator` and `ExtendedKalmanUpdater` ask for it.
    """

    def jacobian(self, state: State, **kwargs: Any) -> np.ndarray:
        """Derivative `[3, ndim_state]` of (elevation, bearing, range) by the state."""
        offset = np.asarray(state.state_vector[self.mapping, :] - self.translation_offset, dtype=float)
        x, y, z = (self.rotation_matrix @ offset)[:, 0]
        ground_squared = x**2 + y**2
        ground, r = np.sqrt(ground_squared), np.sqrt(ground_squared + z**2)
        by_position = np.array(
            [
                [-x * z / (ground * r**2), -y * z / (ground * r**2), ground / r**2],
                [-y / ground_squared, x / ground_squared, 0.0],
                [x / r, y / r, z / r],
            ]
        )
        jacobian = np.zeros((self.ndim_meas, self.ndim_state))
        jacobian[:, list(self.mapping)] = by_position @ self.rotation_matrix
        return jacobian


@dataclass(frozen=True)
class Components:
    """The parts of one tracker, each a stock Stone Soup object."""

    measurement_model: CartesianToElevationBearingRange
    predictor: KalmanPredictor
    updater: KalmanUpdater
    measure: Measure
    hypothesiser: DistanceGater
    associator: DataAssociator
    initiator: Initiator
    deleter: Deleter

    def tracker(self) -> MultiTargetTracker:
        """The stock tracker; drive it with `update_tracker`."""
        return MultiTargetTracker(
            initiator=self.initiator,
            deleter=self.deleter,
            detector=None,
            data_associator=self.associator,
            updater=self.updater,
        )


def build_components(
    params: Params, exact_jacobian: bool = True, static: StaticParams = DEFAULT
) -> Components:
    """Builds every component.

    Args:
        params: numbers of the tracker.
        exact_jacobian: whether initiation and the extended filter use the exact Jacobian, or the
            stock finite differences, whose covariance is only good to about 1e-4.
        static: which components, by name.
    """
    model = measurement_model(params, exact_jacobian)
    transition, prior = transition_model(params.process_noise), prior_state(params)
    predictor, updater, first = build_filter(params, static, transition, model, prior)
    distance = MEASURES[static.measure]()
    hypothesiser = DistanceGater(
        DistanceHypothesiser(predictor, updater, distance, missed_distance=params.missed_distance),
        distance,
        params.gate_threshold,
    )
    associator = ASSOCIATORS[static.associator](hypothesiser)
    deleter = build_deleter(params, static)
    initiator: Initiator = first
    if static.initiator == "multi_measurement":
        initiator = MultiMeasurementInitiator(
            prior,
            deleter=deleter,
            data_associator=associator,
            updater=updater,
            measurement_model=model,
            min_points=static.min_points,
            initiator=first,
        )
    return Components(
        measurement_model=model,
        predictor=predictor,
        updater=updater,
        measure=distance,
        hypothesiser=hypothesiser,
        associator=associator,
        initiator=initiator,
        deleter=deleter,
    )


def build_deleter(params: Params, static: StaticParams) -> Deleter:
    """The deleter of that name, or all of several in one."""
    deleters = [DELETERS[name](params) for name in static.deleters]
    return (
        deleters[0]
        if len(deleters) == 1
        else CompositeDeleter(deleters=deleters, intersect=static.intersect_deleters)
    )


def position_model(detection: Detection) -> LinearGaussian:
    """Model of a detection converted to a position: its noise is the detection's, to first order."""
    model = detection.measurement_model
    place = State(model.inverse_function(detection))
    inverse = np.linalg.inv(model.jacobian(place)[:, list(POSITION)])
    return LinearGaussian(STATE_DIM, POSITION, noise_covar=inverse @ model.covar() @ inverse.T)


def transition_model(process_noise: float, seed: int | None = None) -> CombinedLinearGaussianTransitionModel:
    """Constant velocity in three dimensions; `seed` is for drawing process noise.

    It must be the combined model's: noise is drawn there, and the seeds of its parts are unused.
    """
    return CombinedLinearGaussianTransitionModel([ConstantVelocity(float(process_noise))] * 3, seed=seed)


def measurement_model(params: Params, exact_jacobian: bool = True) -> CartesianToElevationBearingRange:
    """Elevation, bearing and range seen from the origin."""
    kind = ExactCartesianToElevationBearingRange if exact_jacobian else CartesianToElevationBearingRange
    return kind(ndim_state=STATE_DIM, mapping=POSITION, noise_covar=noise_covariance(params))


def noise_sigmas(params: Params) -> np.ndarray:
    """Standard deviations `[3]` of the measurement noise (rad, rad, m)."""
    return np.array([params.elevation_sigma, params.bearing_sigma, params.range_sigma])


def noise_covariance(params: Params) -> np.ndarray:
    """Measurement noise covariance R `[3, 3]` (rad^2, rad^2, m^2)."""
    return np.diag(noise_sigmas(params)) ** 2


def gospa_metric(params: Params) -> GOSPAMetric:
    """GOSPA of positions (m)."""
    return GOSPAMetric(
        p=params.gospa_order,
        c=params.gospa_cutoff,
        switching_penalty=params.gospa_switching_penalty,
        measure=Euclidean(POSITION),
    )


def prior_state(params: Params) -> GaussianState:
    """Prior of a new track: only its velocity entries are ever used."""
    variance = np.zeros(STATE_DIM)
    variance[list(VELOCITY)] = params.prior_velocity_sigma**2
    mean = np.zeros((STATE_DIM, 1))
    mean[VELOCITY[0]] = -params.platform_speed
    return GaussianState(mean, np.diag(variance))


def step_duration(params: Params) -> datetime.timedelta:
    """Time step as Stone Soup keeps it: whole microseconds."""
    return datetime.timedelta(microseconds=round(params.time_step * 1e6))


def time_of(step: int, params: Params) -> datetime.datetime:
    """Time of a step."""
    return EPOCH + step * step_duration(params)
