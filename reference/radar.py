"""The paper's steerable radar on a fixed platform, in stock Stone Soup.

The paper customised Stone Soup's rotating radar so that its sightline can be set at will;
`SteeredRadar` is that customisation, and as small as it can be.
"""

from typing import Any

import numpy as np
from stonesoup.models.measurement.nonlinear import CartesianToElevationBearingRange
from stonesoup.platform import FixedPlatform
from stonesoup.sensor.radar.radar import RadarElevationBearingRange, RadarRotatingElevationBearingRange
from stonesoup.types.array import StateVector
from stonesoup.types.groundtruth import GroundTruthState
from stonesoup.types.state import State

from jaxtrack.params import Params
from jaxtrack.types import POSITION, STATE_DIM
from reference.components import EPOCH, noise_covariance


class SteeredRadar(RadarRotatingElevationBearingRange):
    """The stock rotating radar, which decides what is seen, with detections in the platform's frame.

    The stock class reports angles in its boresight frame, where the same noise means less
    azimuth the higher the beam points.
    """

    @property
    def measurement_model(self) -> CartesianToElevationBearingRange:
        """Elevation, bearing and range in the platform's frame, as the radar that does not turn."""
        return RadarElevationBearingRange.measurement_model.fget(self)

    def is_detectable(
        self, state: GroundTruthState, measurement_model: CartesianToElevationBearingRange | None = None
    ) -> bool:
        """Whether the beam holds the truth, by the stock test in the boresight frame."""
        del measurement_model
        return super().is_detectable(state, RadarRotatingElevationBearingRange.measurement_model.fget(self))


def build_radar(
    params: Params,
    kind: type[RadarRotatingElevationBearingRange] = SteeredRadar,
    seed: int | None = None,
    place: tuple[float, float, float] = (0.0, 0.0, 0.0),
    orientation: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> Any:
    """A radar on a `FixedPlatform`, which only turns when told to.

    Args:
        params: numbers of the scenario.
        kind: the customised radar, or the stock one.
        seed: of its noise.
        place: of the platform (m).
        orientation: of the platform: roll, pitch, yaw (rad).
    """
    radar = kind(
        ndim_state=STATE_DIM,
        position_mapping=POSITION,
        noise_covar=noise_covariance(params),
        dwell_centre=StateVector([0.0]),
        tilt_centre=StateVector([0.0]),
        rpm=0.0,
        fov_angle=params.beam_azimuth,
        vertical_extent=params.beam_elevation,
        max_range=np.inf,
        seed=seed,
    )
    FixedPlatform(
        states=State(StateVector(place), timestamp=EPOCH),
        position_mapping=(0, 1, 2),
        orientation=StateVector(orientation),
        sensors=[radar],
    )
    return radar


def steer(radar: RadarRotatingElevationBearingRange, azimuth: float, elevation: float) -> None:
    """Points the boresight (rad) at once, past Stone Soup's actions, which turn at a rate."""
    radar.dwell_centre = StateVector([azimuth])
    radar.tilt_centre = StateVector([elevation])
