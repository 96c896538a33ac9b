"""Stone Soup's filters: an updater for every name, in both covariance forms, and what goes with it."""

import datetime
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
from stonesoup.functions import gauss2cubature
from stonesoup.initiator.simple import SimpleMeasurementInitiator
from stonesoup.models.measurement.nonlinear import CartesianToElevationBearingRange
from stonesoup.models.transition import TransitionModel
from stonesoup.predictor.kalman import KalmanPredictor, SqrtKalmanPredictor
from stonesoup.types.angle import Bearing, Elevation
from stonesoup.types.array import StateVector
from stonesoup.types.detection import Detection
from stonesoup.types.prediction import MeasurementPrediction
from stonesoup.types.state import GaussianState
from stonesoup.types.track import Track
from stonesoup.types.update import SqrtGaussianStateUpdate
from stonesoup.updater.kalman import (
    CubatureKalmanUpdater,
    ExtendedKalmanUpdater,
    KalmanUpdater,
    SqrtKalmanUpdater,
    UnscentedKalmanUpdater,
)

from jaxtrack.params import Params, StaticParams
from jaxtrack.types import POSITION

UPDATERS: dict[str, Callable[[Params], KalmanUpdater]] = {
    "unscented": lambda params: UnscentedKalmanUpdater(
        measurement_model=None, alpha=params.alpha, beta=params.beta, kappa=params.kappa
    ),
    "extended": lambda _: ExtendedKalmanUpdater(measurement_model=None),
    "cubature": lambda _: SharpCubatureKalmanUpdater(measurement_model=None),
    "converted": lambda _: KalmanUpdater(measurement_model=None),
}
"""Stock updaters by the names of `jaxtrack.kalman.FILTERS`.

The last one needs detections that were converted to positions: `translate.to_position`.
"""

SQUARE_ROOT_UPDATERS: dict[str, Callable[[Params], KalmanUpdater]] = {
    "unscented": UPDATERS["unscented"],
    "extended": lambda _: SharpSqrtKalmanUpdater(measurement_model=None, qr_method=True),
    "cubature": lambda _: UnscentedKalmanUpdater(measurement_model=None, alpha=1.0, beta=0.0, kappa=0.0),
    "converted": lambda _: SqrtKalmanUpdater(measurement_model=None, qr_method=True),
}
"""The same for `covariance_form` = square_root. Sigma points have no square-root updater in Stone Soup."""


class SharpCubatureKalmanUpdater(CubatureKalmanUpdater):
    """The stock updater, but for its rounding: the same formulas in extended precision, radar at the origin.

    It forms products of coordinates, as large as the square of a range, and what is left of their
    difference is as small as a variance.
    """

    def predict_measurement(
        self,
        predicted_state: GaussianState,
        measurement_model: CartesianToElevationBearingRange | None = None,
        measurement_noise: bool = True,
        **kwargs: Any,
    ) -> MeasurementPrediction:
        """As `functions.cubature_transform`."""
        model = self._check_measurement_model(measurement_model)
        points = np.asarray(gauss2cubature(predicted_state), np.longdouble)
        x, y, z = points[list(POSITION)]
        r = np.sqrt(x**2 + y**2 + z**2)
        seen = np.stack([np.arcsin(z / r), np.arctan2(y, x), r])
        mean = np.stack([*np.arctan2(np.sin(seen[:2]).mean(axis=1), np.cos(seen[:2]).mean(axis=1)), r.mean()])
        covariance = seen @ seen.T / r.size - np.outer(mean, mean)
        cross = points @ seen.T / r.size - np.outer(points.mean(axis=1), mean)
        if measurement_noise:
            covariance += model.covar()
        elevation, bearing, distance = map(float, mean)
        return MeasurementPrediction.from_state(
            predicted_state,
            StateVector([Elevation(elevation), Bearing(bearing), distance]),
            covariance.astype(float),
            cross_covar=cross.astype(float),
        )


class SharpSqrtKalmanUpdater(SqrtKalmanUpdater):
    """The stock updater by its QR decomposition, which asks for a linear model's matrix, with the Jacobian.

    Its other method takes square roots of matrices of mixed units, and is off by up to 7e-9 standard
    deviations.
    """

    def _posterior_covariance(self, hypothesis: Any) -> tuple[np.ndarray, np.ndarray]:
        model = hypothesis.measurement.measurement_model
        matrix = self._measurement_matrix(hypothesis.prediction, model)
        linear = SimpleNamespace(
            matrix=lambda: matrix,
            sqrt_covar=np.sqrt(model.covar().astype(float)),
            ndim_meas=model.ndim_meas,
            ndim_state=model.ndim_state,
        )
        seen = SimpleNamespace(measurement_model=linear)
        return super()._posterior_covariance(
            SimpleNamespace(prediction=hypothesis.prediction, measurement=seen)
        )


class SquareRootInitiator(SimpleMeasurementInitiator):
    """The stock initiator, whose tracks begin in the form that `SqrtKalmanPredictor` asks for."""

    def initiate(self, detections: set[Detection], timestamp: datetime.datetime, **kwargs: Any) -> set[Track]:
        """As the stock one."""
        states = [track.state for track in super().initiate(detections, timestamp, **kwargs)]
        return {
            Track(
                [
                    SqrtGaussianStateUpdate(
                        state.state_vector,
                        np.linalg.cholesky(state.covar),
                        timestamp=state.timestamp,
                        hypothesis=state.hypothesis,
                    )
                ]
            )
            for state in states
        }


def build_filter(
    params: Params,
    static: StaticParams,
    transition: TransitionModel,
    model: CartesianToElevationBearingRange,
    prior: GaussianState,
) -> tuple[KalmanPredictor, KalmanUpdater, SimpleMeasurementInitiator]:
    """Predictor and updater in the form asked for, and an initiator whose tracks have it."""
    if static.covariance_form == "full":
        updater = UPDATERS[static.filter](params)
    else:
        updater = SQUARE_ROOT_UPDATERS[static.filter](params)
    if isinstance(updater, SqrtKalmanUpdater):
        predictor = SqrtKalmanPredictor(transition, qr_method=True)
        return predictor, updater, SquareRootInitiator(prior, model)
    return KalmanPredictor(transition), updater, SimpleMeasurementInitiator(prior, model)
