"""Stone Soup's metric generators on a record; every function gives numbers by name.

NaN stands where Stone Soup gives no number, or one that hangs on the order of a Python set.
"""

import datetime
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from stonesoup.dataassociator.tracktotrack import TrackToTruth
from stonesoup.measures import Euclidean
from stonesoup.metricgenerator.base import MetricGenerator
from stonesoup.metricgenerator.basicmetrics import BasicMetrics
from stonesoup.metricgenerator.manager import MultiManager
from stonesoup.metricgenerator.pcrbmetric import PCRBMetric
from stonesoup.metricgenerator.tracktotruthmetrics import SIAPMetrics
from stonesoup.metricgenerator.uncertaintymetric import (
    MeanofCovarianceNormsMetric,
    SumofCovarianceNormsMetric,
)
from stonesoup.types.array import StateVectors
from stonesoup.types.association import AssociationSet
from stonesoup.types.groundtruth import GroundTruthPath
from stonesoup.types.state import GaussianState, State

from jaxtrack.params import Params
from jaxtrack.types import POSITION, STATE_DIM, VELOCITY
from reference.components import (
    ExactCartesianToElevationBearingRange,
    build_components,
    gospa_metric,
    time_of,
    transition_model,
)
from reference.parity.records import Record
from reference.translate import to_detections, to_ground_truth_paths, to_track_histories

Numbers = dict[str, np.ndarray]

GOSPA_PARTS = ("distance", "localisation", "missed", "false", "switching")
SIAP_RATIOS = {
    "completeness": "SIAP Completeness",
    "ambiguity": "SIAP Ambiguity",
    "spuriousness": "SIAP Spuriousness",
    "position_accuracy": "SIAP Position Accuracy",
    "velocity_accuracy": "SIAP Velocity Accuracy",
}
SIAP_CONTINUITY = {
    "track_change_rate": "SIAP Rate of Track Number Change",
    "longest_segment": "SIAP Longest Track Segment",
}


RESOLUTION = datetime.timedelta.resolution


class StockRecord:
    """A record as Stone Soup sees it.

    Attributes:
        record: what it was made from.
        times: time of every step.
        tracks: whole tracks by key.
        paths: ground truth by row, for the rows that ever live.
    """

    def __init__(self, record: Record) -> None:
        self.record = record
        self.times = [time_of(step, record.params) for step in range(len(record.truths.alive))]
        self.tracks = to_track_histories(record.tracks, self.times)
        self.paths = to_ground_truth_paths(record.truths, self.times)
        self.steps = {time: step for step, time in enumerate(self.times)}

    def managed(self, generator: MetricGenerator, associator: TrackToTruth | None = None) -> MultiManager:
        """The manager after it has run one generator on this record."""
        manager = MultiManager([generator], associator)
        manager.add_data({"tracks": self.tracks.values(), "groundtruth_paths": self.paths.values()})
        manager.generate_metrics()
        return manager

    def only_metric(self, generator: MetricGenerator) -> Any:
        """The metric of a generator that makes just one."""
        (metric,) = self.managed(generator).metrics[generator.generator_name].values()
        return metric

    def by_step(self, singles: Sequence, part: str | None = None) -> np.ndarray:
        """Values `[K]` of metrics at single times, NaN on the other steps."""
        values = np.full(len(self.times), np.nan)
        for single in singles:
            values[self.steps[single.timestamp]] = single.value if part is None else single.value[part]
        return values


def stock_norms(stock: StockRecord) -> Numbers:
    """Sum and mean of the covariance norms `[K]`; fails unless tracks exist on two steps."""
    if np.asarray(stock.record.tracks.active).any(axis=1).sum() < 2:
        return {}
    generators = {"sum": SumofCovarianceNormsMetric(), "mean": MeanofCovarianceNormsMetric()}
    return {name: stock.by_step(stock.only_metric(made).value) for name, made in generators.items()}


def stock_gospa(stock: StockRecord) -> Numbers:
    """GOSPA and its parts `[K]`, with the switching penalty of the parameters."""
    metric = stock.only_metric(gospa_metric(stock.record.params))
    # One step alone comes as it is, more as a list.
    singles = metric.value if isinstance(metric.value, list) else [metric]
    return {part: stock.by_step(singles, part) for part in GOSPA_PARTS}


def stock_siap(stock: StockRecord) -> Numbers:
    """SIAP totals, and per step `[K]` those that have a value per step."""
    manager = stock.managed(siap_generator(), track_to_truth(stock.record.params))
    found = manager.metrics[siap_generator().generator_name]
    numbers = {
        name: np.asarray(found[title].value, float) for name, title in (SIAP_RATIOS | SIAP_CONTINUITY).items()
    }
    for name, title in SIAP_RATIOS.items():
        numbers[f"{name}_at_times"] = stock.by_step(found[f"{title} at times"].value)
    if depends_on_set_order(manager.association_set, stock.paths.values()):
        numbers["track_change_rate"] = np.asarray(np.nan)
    return numbers


def siap_generator() -> SIAPMetrics:
    """SIAP with the errors of position and of velocity apart."""
    return SIAPMetrics(position_measure=Euclidean(POSITION), velocity_measure=Euclidean(VELOCITY))


def track_to_truth(params: Params) -> TrackToTruth:
    """The associator, by positions."""
    return TrackToTruth(
        association_threshold=params.siap_threshold,
        consec_pairs_confirm=params.siap_confirm_steps,
        consec_misses_end=params.siap_end_steps,
        measure=Euclidean(POSITION),
    )


def depends_on_set_order(associations: AssociationSet, paths: Iterable[GroundTruthPath]) -> bool:
    """Whether the walk along a truth has to choose between associations that end last together.

    An association may have several stretches. The walk takes one whose last stretch ends last
    of all and follows it to the end of the present stretch; where these differ, the count of
    tracks hangs on which of them a set gives first.
    """
    for path in paths:
        of_truth = associations.associations_including_objects([path])
        key_times = [association.time_range.key_times for association in of_truth]
        resume = path[0].timestamp
        for time in (state.timestamp for state in path):
            present = [(times[-1], end) for times in key_times if (end := stretch_end(times, time))]
            if time < resume or not present:
                continue
            last_of_all = max(present)[0]
            ends = {end for last, end in present if last == last_of_all}
            if len(ends) > 1:
                return True
            (arrival,) = ends
            if arrival == time:
                break  # so does Stone Soup's walk
            resume = arrival + RESOLUTION
    return False


def stretch_end(key_times: Sequence[datetime.datetime], time: datetime.datetime) -> datetime.datetime | None:
    """End of the stretch that holds a time; `key_times` are starts and ends in turn."""
    stretches = zip(key_times[::2], key_times[1::2], strict=True)
    return next((end for start, end in stretches if start <= time <= end), None)


def stock_basic(stock: StockRecord) -> Numbers:
    """Counts of tracks and truths and their ratio."""
    found = stock.managed(BasicMetrics()).metrics[BasicMetrics().generator_name]
    titles = {
        "num_tracks": "Number of tracks",
        "num_truths": "Number of targets",
        "track_to_target_ratio": "Track-to-target ratio",
    }
    return {name: np.asarray(found[title].value, float) for name, title in titles.items()}


class Columns(StateVectors):
    """Sensor locations of which `[:, i]` is a column, as the 3-D measurement models need.

    `PCRBMetric` picks a flat vector, on which their Jacobian fails. Nothing else is mended.
    """

    def __getitem__(self, item: Any) -> Any:
        """Column i for `[:, i]`."""
        column = super().__getitem__(item)
        return np.asarray(column).reshape(-1, 1)


def stock_pcrb(stock: StockRecord) -> Numbers:
    """Bounds `[K, N]` with the exact Jacobian, a sensor at the origin, and a new track's prior."""
    params = stock.record.params
    parts = build_components(params, exact_jacobian=True)
    model = parts.measurement_model
    shape = np.shape(stock.record.truths.alive)
    position, velocity = np.full(shape, np.nan), np.full(shape, np.nan)
    covariance = np.full((*shape, STATE_DIM, STATE_DIM), np.nan)
    for row, path in stock.paths.items():
        if len(path) < 2:  # Stone Soup refuses a range of times without length
            continue
        value = np.asarray(model.function(path[0], noise=False), float).T
        detections = to_detections(value, np.ones(1, dtype=bool), 0, path[0].timestamp, model)
        (track,) = parts.initiator.initiate(set(detections), path[0].timestamp)
        bound = pcrb_of_path(path, track.state, model, params)
        steps = [stock.steps[state.timestamp] for state in path]
        position[steps, row], velocity[steps, row] = bound["position_RMSE"], bound["velocity_RMSE"]
        covariance[steps, row] = bound["inverse_j"]
    return {"position": position, "velocity": velocity, "covariance": covariance}


def pcrb_of_path(
    path: GroundTruthPath,
    prior: GaussianState | State,
    model: ExactCartesianToElevationBearingRange,
    params: Params,
    irf: float = 1.0,
) -> dict[str, Any]:
    """The value of Stone Soup's metric for one path."""
    generator = PCRBMetric(
        prior=prior,
        transition_model=transition_model(params.process_noise),
        measurement_model=model,
        sensor_locations=Columns(np.zeros((3, 1))),
        position_mapping=POSITION,
        velocity_mapping=VELOCITY,
        irf=irf,
    )
    manager = MultiManager([generator])
    manager.add_data({"groundtruth_paths": [path]})
    (metric,) = generator.compute_metric(manager)
    return metric.value
