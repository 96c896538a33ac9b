"""Every component of the tracker, one step at a time from Stone Soup's own state.

Nothing accumulates here: each step starts from the oracle's track list, and every
intermediate is compared.
"""

from collections import defaultdict
from collections.abc import Iterable

import jax
import numpy as np

from jaxtrack import association
from jaxtrack.tracker import TrackerInfo
from jaxtrack.types import NO_DETECTION, Tracks
from reference.parity.compare import (
    TOLERANCE,
    covariance_error,
    cross_covariance_error,
    distance_error,
    estimate_error,
    exact_mahalanobis,
    mean_error,
)
from reference.parity.oracle import tracks_before
from reference.parity.ours import MAX_TRACKS, on_device, steps_from
from reference.parity.rows import Row, Tally
from reference.parity.scenarios import Scenario
from reference.pipeline import Expected, StepRecord
from reference.translate import TrackKey, slot_keys

COMPONENTS = {
    "predict": ("kalman.predict", "KalmanPredictor", "predictions"),
    "expect": ("kalman.predict_detections", "UnscentedKalmanUpdater.predict_measurement", "predictions"),
    "measure": ("association.mahalanobis", "Mahalanobis, in extended precision", "distances"),
    "pinv": ("association.mahalanobis", "Mahalanobis as it is", "distances"),
    "gate": ("association.gate", "DistanceHypothesiser in DistanceGater", "pairs"),
    "associate": ("association.associate_nearest_neighbour", "NearestNeighbour", "tracks"),
    "update": ("kalman.update", "UnscentedKalmanUpdater.update", "updates"),
    "delete": ("lifecycle.delete_uncertain_tracks", "CovarianceBasedDeleter", "tracks"),
    "initiate": ("lifecycle.initiate_tracks", "SimpleMeasurementInitiator", "births"),
    "step": ("tracker.step", "MultiTargetTracker, one step", "steps"),
}
"""Key: our function, Stone Soup's class, what is counted."""

EXCEPTIONS = {
    "pinv": (1e-6, "Stone Soup's own rounding: `pinv` of an S of condition up to 1e10; see the row above"),
}
"""Key: tolerance in float64 and its reason, where it is not 1e-9."""

Tallies = defaultdict[str, Tally]

_GATE = jax.jit(jax.vmap(association.gate, in_axes=(0, 0, 0, None)))


def component_rows(episodes: Iterable[tuple[Scenario, list[StepRecord]]]) -> list[Row]:
    """One row per component over all steps of all episodes; the records hold intermediates."""
    double, single = Tallies(Tally), Tallies(Tally)
    for scenario, records in episodes:
        before = tracks_before(records, MAX_TRACKS)
        compare_steps(scenario, records, before, True, double)
        compare_steps(scenario, records, before, False, single)
    return [
        Row(
            *COMPONENTS[key][:2],
            compared=double[key].decided or double[key].compared,
            unit=COMPONENTS[key][2],
            float64=double[key].largest,
            float32=single[key].largest,
            agreement=double[key].agreement,
            agreement32=single[key].agreement,
            tolerance=EXCEPTIONS.get(key, (TOLERANCE, ""))[0],
            note=EXCEPTIONS.get(key, (TOLERANCE, ""))[1],
        )
        for key in COMPONENTS
    ]


def compare_steps(
    scenario: Scenario, records: list[StepRecord], before: Tracks, is_double: bool, tallies: Tallies
) -> None:
    """Takes all steps of one episode in one precision."""
    detections = scenario.detections
    after, info = steps_from(before, scenario, is_double)
    admissible = np.isfinite(
        on_device(_GATE, is_double, info.distances, info.predicted, detections, scenario.params)
    )
    for k, record in enumerate(records):
        tracks_k, info_k = (jax.tree.map(lambda leaf, k=k: leaf[k], tree) for tree in (after, info))
        keys = slot_keys(jax.tree.map(lambda leaf, k=k: leaf[k], before))
        active, value = np.asarray(detections.active[k]), np.asarray(detections.value[k])
        good = True
        for slot, key in enumerate(keys):
            if key is not None:
                compare_predicted(tallies, info_k, slot, record.expected[key])
                compare_distances(tallies, info_k.distances[slot], record.expected[key], value, active)
                compare_gate(tallies, admissible[k, slot], record.expected[key].admissible, active)
                good &= compare_decided(tallies, info_k, slot, key, record)
        good &= compare_births(tallies, tracks_k, info_k, record)
        tallies["step"].decision(good)


def compare_predicted(tallies: Tallies, info: TrackerInfo, slot: int, theirs: Expected) -> None:
    """Prediction and measurement prediction of one track."""
    S, P = theirs.detection_covariance, theirs.covariance
    tallies["predict"].error(
        max(
            mean_error(info.predicted.mean[slot], theirs.mean, P),
            covariance_error(info.predicted.covariance[slot], P),
        )
    )
    cross = cross_covariance_error(
        info.expected.cross_covariance[slot],
        theirs.cross_covariance,
        np.sqrt(np.diag(P)),
        np.sqrt(np.diag(S)),
    )
    tallies["expect"].error(
        max(
            mean_error(info.expected.mean[slot], theirs.detection_mean, S),
            covariance_error(info.expected.covariance[slot], S),
            cross,
        )
    )


def compare_distances(
    tallies: Tallies, ours: np.ndarray, theirs: Expected, value: np.ndarray, active: np.ndarray
) -> None:
    """Distances of one track from all detections."""
    exact = exact_mahalanobis(theirs.detection_mean, theirs.detection_covariance, value)
    for mine, sharp, stock in zip(ours[active], exact[active], theirs.distances[active], strict=True):
        if not np.isnan(stock):
            tallies["measure"].error(distance_error(mine, sharp))
            tallies["pinv"].error(distance_error(mine, stock))


def compare_gate(tallies: Tallies, ours: np.ndarray, theirs: np.ndarray, active: np.ndarray) -> None:
    """Admissible pairs of one track."""
    for mine, stock in zip(ours[active], theirs[active], strict=True):
        tallies["gate"].decision(mine == stock)


def compare_decided(
    tallies: Tallies, info: TrackerInfo, slot: int, key: TrackKey, record: StepRecord
) -> bool:
    """Association, update and deletion of one track; whether the decisions agree."""
    theirs = record.associated.get(key, NO_DETECTION)
    same_detection = int(info.associated[slot]) == theirs
    tallies["associate"].decision(same_detection)
    if same_detection and theirs != NO_DETECTION:
        tallies["update"].error(estimate_error(info.updated, slot, record.updated[key]))
    same_end = bool(info.deleted[slot]) == (key in record.deleted)
    tallies["delete"].decision(same_end)
    return same_detection and same_end


def compare_births(tallies: Tallies, tracks: Tracks, info: TrackerInfo, record: StepRecord) -> bool:
    """Tracks born on this step and the whole list after it; whether the decisions agree."""
    keys = slot_keys(tracks)
    born = {key: slot for slot, key in enumerate(keys) if key and info.initiated[slot]}
    for key in born.keys() | record.initiated:
        tallies["initiate"].decision(key in born and key in record.initiated)
        if key in born and key in record.initiated:
            tallies["initiate"].error(estimate_error(tracks, born[key], record.live[key]))
    live = {key: slot for slot, key in enumerate(keys) if key}
    for key in live.keys() & record.live.keys():
        if tracks.updated_by[live[key]] == record.source(key):
            tallies["step"].error(estimate_error(tracks, live[key], record.live[key]))
    return live.keys() == record.live.keys() and not info.num_dropped
