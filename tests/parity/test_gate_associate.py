"""`association` against DistanceHypothesiser, DistanceGater and NearestNeighbour.

Ours gets Stone Soup's own distances, so that a threshold can be hit to the last bit.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from stonesoup.dataassociator.neighbour import (
    GlobalNearestNeighbour,
    GNNWith2DAssignment,
    NearestNeighbour,
)
from stonesoup.types.detection import Detection, MissedDetection
from stonesoup.types.hypothesis import SingleDistanceHypothesis
from stonesoup.types.multihypothesis import MultipleHypothesis

from jaxtrack import NO_DETECTION, Params, association
from reference.parity.scenes import detections_near, padded, random_tracks
from reference.pipeline import StoneSoupTracker

GATE = jax.jit(association.gate)
ASSOCIATE = jax.jit(association.associate_nearest_neighbour)
ASSIGN = jax.jit(association.associate_global_nearest_neighbour)


def expectations(tracks, value, params):
    """Stone Soup's distances `[T, D]` and which of them its hypothesiser and gater admit."""
    oracle = StoneSoupTracker(params)
    oracle.load(tracks, 0)
    expected = oracle.step(value).expected
    rows = [expected[0, slot] for slot in range(len(expected))]
    return np.stack([row.distances for row in rows]), np.stack([row.admissible for row in rows])


@pytest.fixture(scope="module")
def scene():
    rng = np.random.default_rng(1)
    tracks = random_tracks(rng, 6, spread=0.002, distance=(3000.0, 3030.0))
    value = detections_near(rng, tracks, Params(), count=8)
    return tracks, value, expectations(tracks, value, Params())[0]


@pytest.mark.parametrize("nudge", [-1, 0, 1], ids=["below", "exactly", "above"])
@pytest.mark.parametrize("which", ["gate_threshold", "missed_distance", "both"])
def test_gate_at_its_edge(scene, which, nudge):
    """A pair exactly at a threshold is out; one bit further and it is in."""
    tracks, value, distances = scene
    edge = np.sort(distances, axis=None)[20]
    edge = {-1: np.nextafter(edge, 0.0), 0: edge, 1: np.nextafter(edge, np.inf)}[nudge]
    names = ("gate_threshold", "missed_distance") if which == "both" else (which,)
    params = Params(gate_threshold=1e3, missed_distance=1e3).replace(**{name: float(edge) for name in names})
    _, theirs = expectations(tracks, value, params)
    ours = np.isfinite(GATE(distances, tracks, padded(value, 8), params))
    np.testing.assert_array_equal(ours, theirs)
    assert theirs.sum() == 20 + (nudge == 1)


def test_nobody_is_admitted_where_nothing_is():
    """Empty slots and empty rows are never admissible, however small their distance."""
    rng = np.random.default_rng(2)
    tracks = random_tracks(rng, 3, max_tracks=5)
    value = detections_near(rng, tracks, Params(), count=2)
    ours = np.isfinite(GATE(jnp.zeros((5, 4)), tracks, padded(value, 4), Params()))
    expected = np.zeros((5, 4), dtype=bool)
    expected[:3, :2] = True
    np.testing.assert_array_equal(ours, expected)


class FromMatrix:
    """Stands in for a hypothesiser: the distance of track i from detection j is given."""

    def __init__(self, distances, missed_distance):
        self.distances, self.missed_distance = distances, missed_distance

    def hypothesise(self, track, detections, timestamp):
        hypotheses = [SingleDistanceHypothesis(None, MissedDetection(), self.missed_distance)]
        for detection in detections:
            distance = self.distances[track, detection.metadata["index"]]
            if distance < self.missed_distance:
                hypotheses.append(SingleDistanceHypothesis(None, detection, distance))
        return MultipleHypothesis(sorted(hypotheses, reverse=True))


def stone_soup_associations(distances, missed_distance, kind=NearestNeighbour):
    detections = {Detection([0.0], metadata={"index": row}) for row in range(distances.shape[1])}
    hypothesiser = FromMatrix(distances, missed_distance)
    found = kind(hypothesiser).associate(set(range(len(distances))), detections, None)
    associated = np.full(len(distances), NO_DETECTION)
    for track, hypothesis in found.items():
        if hypothesis:
            associated[track] = hypothesis.measurement.metadata["index"]
    return associated


@pytest.mark.parametrize("shape", [(1, 1), (3, 10), (9, 4), (8, 8)])
def test_greedy_association(shape):
    rng = np.random.default_rng(3)
    differs_from_own_nearest = 0
    for _ in range(60):
        distances = 6.0 * rng.random(shape)
        admissible = np.where(distances < 5.0, distances, np.inf)
        theirs = stone_soup_associations(distances, 5.0)
        np.testing.assert_array_equal(ASSOCIATE(admissible), theirs)
        nearest = np.where(np.isfinite(admissible.min(axis=1)), admissible.argmin(axis=1), NO_DETECTION)
        differs_from_own_nearest += np.any(nearest != theirs)
    assert differs_from_own_nearest > 10 or shape == (1, 1)


@pytest.mark.parametrize("missed_distance", [3.5, 5.0])
@pytest.mark.parametrize(
    ("shape", "kind"),
    [
        ((1, 1), GNNWith2DAssignment),
        ((3, 10), GNNWith2DAssignment),
        ((9, 4), GNNWith2DAssignment),
        ((8, 8), GNNWith2DAssignment),
        ((3, 4), GlobalNearestNeighbour),
    ],
)
def test_optimal_association(shape, kind, missed_distance):
    """What a missed detection costs decides how many there are."""
    rng = np.random.default_rng(4)
    differs_from_greedy = 0
    for _ in range(40):
        distances = 6.0 * rng.random(shape)
        admissible = np.where(distances < missed_distance, distances, np.inf)
        theirs = stone_soup_associations(distances, missed_distance, kind)
        np.testing.assert_array_equal(ASSIGN(admissible, missed_distance), theirs)
        differs_from_greedy += np.any(ASSOCIATE(admissible) != theirs)
    assert differs_from_greedy >= 5 or shape == (1, 1)


def test_loser_of_a_contested_detection_takes_its_next_best():
    distances = np.array([[1.0, 2.0, 9.0], [0.5, 3.0, 9.0], [0.7, 2.5, 4.0]])
    expected = [1, 0, 2]
    np.testing.assert_array_equal(stone_soup_associations(distances, 5.0), expected)
    np.testing.assert_array_equal(ASSOCIATE(np.where(distances < 5.0, distances, np.inf)), expected)
