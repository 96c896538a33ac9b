"""The stock Stone Soup scenario: truths move, the radar looks, the tracker tracks.

It is what the paper ran inside Gymnasium (`gym_env.py` is that), and what the benchmarks
time. Everything that Stone Soup has a component for is that component; only observation and
reward are numpy.
"""

from collections.abc import Iterator

import numpy as np
from stonesoup.metricgenerator.uncertaintymetric import SumofCovarianceNormsMetric
from stonesoup.types.array import StateVector
from stonesoup.types.detection import Detection
from stonesoup.types.groundtruth import GroundTruthPath
from stonesoup.types.track import Track

from jaxtrack.params import Params, StaticParams
from reference.components import build_components, gospa_metric, time_of
from reference.observation import ScanMap, TrackSlots, track_observation
from reference.radar import build_radar, steer
from reference.reward import search_term, snapshot, track_term
from reference.translate import to_position
from reference.truths import Draws, Script, initial_states, num_initial, scripted_simulator, truth_simulator

Observation = dict[str, np.ndarray]


class StoneSoupScenario:
    """One scenario of `SearchTrack-v0` in stock Stone Soup.

    Clutter, missed detections, replayed trajectories and stop criteria are not simulated here. Stone Soup
    knows no capacity: more tracks than slots are only left out of the observation.

    Args:
        static: shapes.
        params: numbers.
        exact_jacobian: whether initiation uses the exact Jacobian, for parity, or the stock one.

    Raises:
        ValueError: if the parameters ask for something that is not simulated.
    """

    def __init__(self, static: StaticParams, params: Params, exact_jacobian: bool = False) -> None:
        if params.clutter_rate or params.detection_probability != 1 or params.trajectories is not None:
            raise ValueError(
                "expected clutter_rate = 0, detection_probability = 1 and no trajectories: got "
                f"{params.clutter_rate}, {params.detection_probability}, {params.trajectories is not None}"
            )
        self.static = static
        self.params = params
        self.exact_jacobian = exact_jacobian
        self.uncertainty = SumofCovarianceNormsMetric()
        self.gospa_metric = gospa_metric(params)

    def reset(self, seed: int = 0, draws: Draws | None = None) -> Observation:
        """New truths, no tracks, a field never seen.

        Args:
            seed: of everything random.
            draws: all that is random instead.
        """
        rng = np.random.default_rng(seed)
        motion_seed, radar_seed = (int(number) for number in rng.integers(2**31, size=2))
        self.step_index = 0
        self.script = None if draws is None else Script(draws)
        if self.script is not None:
            simulator = scripted_simulator(self.script, self.params)
        else:
            states = initial_states(rng, num_initial(self.static, self.params), self.params)
            simulator = truth_simulator(states, motion_seed, self.params)
        self.truths: Iterator[tuple[object, set[GroundTruthPath]]] = iter(simulator)
        self.paths: list[GroundTruthPath] = []
        self.row_of: dict[GroundTruthPath, int] = {}
        self._take_paths()
        self.radar = build_radar(self.params, seed=radar_seed)
        self.components = build_components(self.params, self.exact_jacobian, self.static)
        self.tracker = self.components.tracker()
        self.slots = TrackSlots(self.static.max_tracks)
        self.scan_map = ScanMap(self.static, self.params)
        return self.observe()

    def step(self, azimuth: float, elevation: float) -> tuple[Observation, dict[str, float]]:
        """One look at `azimuth` and `elevation` (rad).

        Returns:
            The observation, and what `jaxtrack` reports in its `info`: numbers of live tracks and
            detections, sum of covariance norms, mean scan value, and both terms of the reward.
        """
        self.step_index += 1
        before = snapshot(self.tracks)
        self._move_truths()
        steer(self.radar, azimuth, elevation)
        detections = self.detect()
        self.tracker.update_tracker(time_of(self.step_index, self.params), set(detections))
        self.slots.update(self.tracks)
        self.scan_map.look(azimuth, elevation)
        scan_map = self.scan_map.value
        gospa = self.gospa() if self.static.reward == "gospa" else 0.0
        after, living = snapshot(self.tracks), len(self.paths)
        track = track_term(before, after, gospa, living, self.static, self.params)
        search = search_term(after, scan_map, self.static, self.params)
        return self.observe(), {
            "live_tracks": len(self.tracks),
            "num_detections": len(detections),
            "covariance_norm_sum": self.covariance_norm_sum(),
            "mean_scan_value": float(scan_map.mean()),
            "reward_track": self.params.track_weight * track,
            "reward_search": self.params.search_weight * search,
        }

    @property
    def tracks(self) -> set[Track]:
        """The live tracks."""
        return self.tracker.tracks

    def detect(self) -> list[Detection]:
        """Detections of the truths in the beam, in the order of their rows, numbered for the track keys."""
        if self.script is None:
            # In order, although the radar asks for a set: its noise goes to truths one by one.
            states = [path[-1] for path in self.paths]
            row = {id(state): place for place, state in enumerate(states)}
            found = sorted(self.radar.measure(states), key=lambda one: row[id(one.groundtruth_path)])
        else:
            noise = self.script.draws.detection[self.step_index - 1]
            found = [
                detection
                for path in self.paths
                for detection in self.radar.measure([path[-1]], StateVector(noise[self.row_of[path]]))
            ]
        for index, detection in enumerate(found):
            detection.metadata.update({"step": self.step_index, "index": index})
            if self.exact_jacobian:
                # The initiator asks the detection's own model first.
                detection.measurement_model = self.components.measurement_model
        return [to_position(one) for one in found] if self.static.filter == "converted" else found

    def observe(self) -> Observation:
        """Track features, mask and scan map, as `jaxtrack.observation` gives them."""
        features, mask = track_observation(self.slots.tracks, self.params)
        return {"tracks": features, "mask": mask, "scan_map": self.scan_map.value.copy()}

    def covariance_norm_sum(self) -> float:
        """Stone Soup's metric over the live tracks; 0 without tracks."""
        states = [track.state for track in self.tracks]
        return float(self.uncertainty.compute_covariancenorms(states).value) if states else 0.0

    def gospa(self) -> float:
        """Stone Soup's GOSPA distance (m) of the live tracks, positions only."""
        states = [track.state for track in self.tracks]
        found = self.gospa_metric.compute_gospa_metric(states, [path[-1] for path in self.paths])[0].value
        return float(found["distance"])

    def _move_truths(self) -> None:
        if self.script is not None:
            living = [self.row_of[path] for path in self.paths]
            probability = self.params.death_probability
            self.script.begin(self.step_index - 1, living, len(self.row_of), probability)
        self._take_paths()

    def _take_paths(self) -> None:
        """The next state of every truth; a new truth takes the next row."""
        self.paths = list(next(self.truths)[1])
        for path in self.paths:
            self.row_of.setdefault(path, len(self.row_of))
