"""The stock Stone Soup environment: truths move, the radar looks, the tracker tracks.

It is what the paper ran inside Gymnasium, and what the benchmarks time. Everything that
Stone Soup has a component for is that component; only the observation is numpy.
"""

from collections.abc import Iterator

import numpy as np
from stonesoup.metricgenerator.uncertaintymetric import SumofCovarianceNormsMetric
from stonesoup.sensor.radar.radar import RadarRotatingElevationBearingRange
from stonesoup.simulator.simple import MultiTargetGroundTruthSimulator
from stonesoup.types.array import StateVector
from stonesoup.types.groundtruth import GroundTruthPath
from stonesoup.types.state import GaussianState
from stonesoup.types.track import Track

from jaxtrack.params import Params, StaticParams
from jaxtrack.types import POSITION, STATE_DIM
from reference.components import (
    EPOCH,
    build_components,
    noise_covariance,
    step_duration,
    time_of,
    transition_model,
)
from reference.observation import ScanMap, track_observation

Observation = dict[str, np.ndarray]


def rotating_radar(params: Params, seed: int | None = None) -> RadarRotatingElevationBearingRange:
    """The radar at the origin, which only turns when told to."""
    return RadarRotatingElevationBearingRange(
        position=StateVector([0.0, 0.0, 0.0]),
        orientation=StateVector([0.0, 0.0, 0.0]),
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


def steer(radar: RadarRotatingElevationBearingRange, azimuth: float, elevation: float) -> None:
    """Points the boresight (rad) at once, past Stone Soup's actions, which turn at a rate."""
    radar.dwell_centre = StateVector([azimuth])
    radar.tilt_centre = StateVector([elevation])


class StoneSoupScenario:
    """One scenario of `SearchTrack-v0` in stock Stone Soup.

    Unlike `jaxtrack.sensor` the stock radar reports angles in its boresight frame, so that
    its noise is the same number of radians wherever it looks. Clutter, missed detections and
    replayed trajectories are not simulated here.

    Raises:
        ValueError: if the parameters ask for one of those.
    """

    def __init__(self, static: StaticParams, params: Params) -> None:
        if params.clutter_rate or params.detection_probability != 1 or params.trajectories is not None:
            raise ValueError(
                "expected clutter_rate = 0, detection_probability = 1 and no trajectories: got "
                f"{params.clutter_rate}, {params.detection_probability}, {params.trajectories is not None}"
            )
        self.static = static
        self.params = params
        self.uncertainty = SumofCovarianceNormsMetric()

    def reset(self, seed: int) -> Observation:
        """New truths, no tracks, a field never seen."""
        rng = np.random.default_rng(seed)
        motion_seed, radar_seed = (int(number) for number in rng.integers(2**31, size=2))
        self.step_index = 0
        self.truths: Iterator[tuple[object, set[GroundTruthPath]]] = iter(
            truth_simulator(initial_states(rng, self.static, self.params), motion_seed, self.params)
        )
        self.paths = list(next(self.truths)[1])
        self.radar = rotating_radar(self.params, radar_seed)
        self.tracker = build_components(self.params, exact_jacobian=False).tracker()
        self.scan_map = ScanMap(self.static, self.params)
        return self.observe()

    def step(self, azimuth: float, elevation: float) -> tuple[Observation, dict[str, float]]:
        """One look at `azimuth` and `elevation` (rad).

        Returns:
            The observation, and the number of live tracks, number of detections, sum of
            covariance norms and mean scan value.
        """
        self.step_index += 1
        next(self.truths)  # every path grows by one state
        steer(self.radar, azimuth, elevation)
        # In order, although the radar asks for a set: its noise goes to truths one by one.
        detections = self.radar.measure([path[-1] for path in self.paths])
        self.tracker.update_tracker(time_of(self.step_index, self.params), detections)
        self.scan_map.look(azimuth, elevation)
        return self.observe(), {
            "live_tracks": len(self.tracks),
            "num_detections": len(detections),
            "covariance_norm_sum": self.covariance_norm_sum(),
            "mean_scan_value": float(self.scan_map.value.mean()),
        }

    @property
    def tracks(self) -> set[Track]:
        """The live tracks."""
        return self.tracker.tracks

    def observe(self) -> Observation:
        """Track features, mask and scan map, as `jaxtrack.observation` gives them."""
        features, mask = track_observation(self.tracks, self.static, self.params)
        return {"tracks": features, "mask": mask, "scan_map": self.scan_map.value}

    def covariance_norm_sum(self) -> float:
        """Stone Soup's metric over the live tracks; 0 without tracks."""
        states = [track.state for track in self.tracks]
        return float(self.uncertainty.compute_covariancenorms(states).value) if states else 0.0


def initial_states(rng: np.random.Generator, static: StaticParams, params: Params) -> np.ndarray:
    """Truths `[N, 6]`: uniform in azimuth, elevation and range, normal in velocity."""
    count = static.num_truths
    azimuth, elevation = rng.uniform(-params.field_limit, params.field_limit, (2, count))
    distance = rng.uniform(params.min_range, params.max_range, count)
    ground = distance * np.cos(elevation)
    states = np.empty((count, STATE_DIM))
    states[:, 0::2] = np.stack(
        [ground * np.cos(azimuth), ground * np.sin(azimuth), distance * np.sin(elevation)], axis=1
    )
    states[:, 1::2] = params.truth_velocity_sigma * rng.standard_normal((count, 3))
    return states


def truth_simulator(states: np.ndarray, seed: int, params: Params) -> MultiTargetGroundTruthSimulator:
    """Moves the given truths for one episode; none is born, none dies."""
    return MultiTargetGroundTruthSimulator(
        transition_model=transition_model(params.truth_process_noise, seed),
        initial_state=GaussianState(np.zeros(STATE_DIM), np.eye(STATE_DIM), timestamp=EPOCH),
        timestep=step_duration(params),
        number_steps=params.max_steps_in_episode + 1,
        birth_rate=0.0,
        death_probability=0.0,
        preexisting_states=[StateVector(state) for state in states],
    )
