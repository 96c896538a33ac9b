"""Gate and association against hand values and a plain Python greedy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from scipy.optimize import linear_sum_assignment

from jaxtrack import NO_DETECTION, Detections, Params
from jaxtrack import params as params_module
from jaxtrack.association import (
    ASSOCIATORS,
    MEASURES,
    associate_global_nearest_neighbour,
    associate_nearest_neighbour,
    gate,
    mahalanobis,
)
from jaxtrack.kalman import ExpectedDetections
from jaxtrack.models import wrap_detection

INF = np.inf
associate = jax.jit(associate_nearest_neighbour)
associate_batch = jax.jit(jax.vmap(associate_nearest_neighbour))
distances_of = jax.jit(mahalanobis)
PARAMS = Params()


def expectation(means, S):
    means = jnp.asarray(means, dtype=float)
    count = means.shape[0]
    return ExpectedDetections(
        mean=means,
        covariance=jnp.broadcast_to(jnp.asarray(S, dtype=float), (count, 3, 3)),
        cross_covariance=jnp.zeros((count, 6, 3)),
    )


def plain_greedy(distances):
    """Shortest pair first, each track and each detection once."""
    pairs = sorted((d, *index) for index, d in np.ndenumerate(distances) if np.isfinite(d))
    associated = [NO_DETECTION] * distances.shape[0]
    for _, track, detection in pairs:
        if associated[track] == NO_DETECTION and detection not in associated:
            associated[track] = detection
    return associated


def test_mahalanobis_distances_by_hand():
    expected = expectation([[0, 0, 1000], [0, 0, 1003]], np.diag([4e-6, 1e-6, 9.0]))
    detections = Detections.from_values([[2e-3, 0, 1000], [0, 2e-3, 1003], [0, 0, 1000]])
    distances = distances_of(expected, detections, PARAMS)
    root = np.sqrt
    # Elevation 1 sigma; bearing 2 sigma; range 3 m is 1 sigma.
    np.testing.assert_allclose(distances, [[1, root(4 + 1), 0], [root(1 + 1), 2, 1]], rtol=1e-4, atol=1e-6)


def test_correlated_innovations_use_the_whole_covariance(x64):
    S = np.array([[2e-6, 1e-6, 1e-4], [1e-6, 3e-6, -2e-4], [1e-4, -2e-4, 5.0]])
    d = np.array([1e-3, 2e-3, -1.0])
    distances = distances_of(expectation([[0, 0, 0]], S), Detections.from_values([d]), PARAMS)
    np.testing.assert_allclose(distances[0, 0], np.sqrt(d @ np.linalg.solve(S, d)), rtol=1e-10)


def test_distances_take_the_short_way_round():
    expected = expectation([[0, np.pi - 1e-3, 1000]], np.diag([1e-6, 1e-6, 1.0]))
    distances = distances_of(expected, Detections.from_values([[0, -np.pi + 1e-3, 1000]]), PARAMS)
    np.testing.assert_allclose(distances, [[2.0]], rtol=1e-3)


def test_measures_by_hand(x64):
    """S = 4 R and a range off by two sigmas of R: every measure of one line of arithmetic."""
    R = np.array([PARAMS.elevation_sigma, PARAMS.bearing_sigma, PARAMS.range_sigma]) ** 2
    expected = expectation([[0, 0, 1000]], np.diag(4 * R))
    detections = Detections.from_values([[0, 0, 1000 + 2 * PARAMS.range_sigma]])
    squared_hellinger = 1 - np.sqrt(4**1.5 / 2.5**3) * np.exp(-4 / 2.5 / 8)
    by_hand = {
        "mahalanobis": 1.0,
        "squared_mahalanobis": 1.0,
        "euclidean": 2 * PARAMS.range_sigma,
        "kullback_leibler": 0.5 * (-3 * np.log(4) - 3 + 3 * 4 + 4),
        "squared_hellinger": squared_hellinger,
        "hellinger": np.sqrt(squared_hellinger),
    }
    assert by_hand.keys() == MEASURES.keys()
    for name, value in by_hand.items():
        ours = jax.jit(MEASURES[name])(expected, detections, PARAMS)
        np.testing.assert_allclose(ours, [[value]], rtol=1e-12, err_msg=name)


@pytest.mark.parametrize("name", list(MEASURES))
def test_every_pair_is_measured_for_itself_and_round_the_back_too(name, x64):
    """Two tracks and three detections; then all of it turned across the seam of bearings."""
    R = np.array([PARAMS.elevation_sigma, PARAMS.bearing_sigma, PARAMS.range_sigma]) ** 2
    correlated = np.diag(2 * R)
    correlated[0, 2] = correlated[2, 0] = np.sqrt(R[0] * R[2])
    S = jnp.stack([jnp.asarray(correlated), jnp.diag(5 * R)])
    means = np.array([[0.1, -1e-3, 1000.0], [0.1, 2e-3, 1005.0]])
    values = np.array([[0.101, 1e-3, 1002.0], [0.1, 4e-3, 1000.0], [0.098, -2e-3, 1010.0]])

    @jax.jit
    def measured(means, S, values):
        expected = expectation(means, jnp.zeros((3, 3))).replace(covariance=S)
        return MEASURES[name](expected, Detections.from_values(values), PARAMS)

    alone = [
        [measured(means[i : i + 1], S[i : i + 1], values[j : j + 1])[0, 0] for j in range(3)] for i in (0, 1)
    ]
    np.testing.assert_allclose(measured(means, S, values), alone, rtol=1e-12)
    behind = [np.asarray(wrap_detection(each + np.array([0, np.pi, 0]))) for each in (means, values)]
    assert np.ptp(behind[1][:, 1]) > 6
    np.testing.assert_allclose(measured(behind[0], S, behind[1]), alone, rtol=1e-9)


def test_every_measure_can_be_asked_for_by_name():
    assert set(params_module.MEASURES) == set(MEASURES)


@pytest.mark.parametrize(("gate_threshold", "missed"), [(5.0, 9.0), (9.0, 5.0)])
def test_the_gate_is_strict_and_the_smaller_threshold_counts(gate_threshold, missed, tracks_at):
    params = Params(gate_threshold=gate_threshold, missed_distance=missed)
    detections = Detections.from_values(np.zeros((4, 3)))
    distances = jnp.array([[4.9999, 5.0, 6.0, jnp.nan]])
    admissible = gate(distances, tracks_at(np.zeros(6), 1), detections, params)
    np.testing.assert_allclose(admissible, [[4.9999, INF, INF, INF]])


def test_empty_rows_are_inadmissible(tracks_at, params):
    detections = Detections.from_values(np.zeros((3, 3)), [True, False, True])
    admissible = gate(jnp.ones((2, 3)), tracks_at(np.zeros(6), 2), detections, params)
    np.testing.assert_array_equal(admissible, [[1, INF, 1], [INF, INF, INF]])


@pytest.mark.parametrize(
    ("distances", "expected"),
    [
        pytest.param([[1, 2], [1.5, 9]], [0, 1], id="contested: the loser takes its second choice"),
        pytest.param([[1, INF], [0.5, 3]], [NO_DETECTION, 0], id="contested: the loser has no other"),
        pytest.param([[3, 1], [2, 0.5]], [0, 1], id="the sum of distances does not matter"),
        pytest.param([[INF, INF], [INF, INF]], [NO_DETECTION] * 2, id="nothing admissible"),
        pytest.param([[1, 1], [1, 1]], [0, 1], id="ties go to the lowest track and detection"),
        pytest.param([[0.0], [0.1], [0.2]], [0, NO_DETECTION, NO_DETECTION], id="one detection"),
        pytest.param([[3, 2, 1]], [2], id="one track"),
    ],
)
def test_greedy_by_hand(distances, expected):
    np.testing.assert_array_equal(associate(jnp.array(distances, dtype=float)), expected)


# Distances on a fine grid: distinct after rounding to single precision, ties included on purpose.
grids = hnp.arrays(np.int64, (6, 4), elements=st.integers(0, 60))


@given(grids)
def test_greedy_equals_a_plain_python_greedy(grid):
    distances = np.where(grid < 40, grid / 8, INF)
    np.testing.assert_array_equal(associate(jnp.asarray(distances, float)), plain_greedy(distances))


@given(hnp.arrays(np.int64, (5, 6, 4), elements=st.integers(0, 60)))
def test_batches_of_unequal_work_do_not_disturb_each_other(grid):
    distances = np.where(grid < 40, grid / 8, INF)
    distances[1] = INF
    distances[3, 1:] = INF
    batched = associate_batch(jnp.asarray(distances, float))
    np.testing.assert_array_equal(batched, [plain_greedy(each) for each in distances])


def test_the_choice_has_no_gradient():
    def chosen_sum(distances):
        chosen = associate(distances)
        return jnp.sum(jnp.where(chosen == 0, distances[:, 0], 0.0))

    gradient = jax.grad(chosen_sum)(jnp.array([[1.0, 2.0], [3.0, INF]]))
    np.testing.assert_array_equal(gradient, [[1, 0], [0, 0]])


assign_all = jax.jit(associate_global_nearest_neighbour)


@pytest.mark.parametrize(
    ("distances", "expected"),
    [
        pytest.param([[1, 2], [1.5, INF]], [1, 0], id="the first leaves it to the other"),
        pytest.param([[1, 4.8], [1.5, INF]], [0, NO_DETECTION], id="a missed detection costs 5: 6 beats 6.3"),
        pytest.param([[3, 1], [2, 0.5]], [1, 0], id="the sum of distances matters"),
        pytest.param([[INF, INF], [INF, INF]], [NO_DETECTION] * 2, id="nothing admissible"),
        pytest.param([[4.9], [4.8], [INF]], [NO_DETECTION, 0, NO_DETECTION], id="one detection"),
        pytest.param([[3, 2, 1]], [2], id="one track"),
    ],
)
def test_assignment_by_hand(distances, expected):
    np.testing.assert_array_equal(assign_all(jnp.array(distances, dtype=float), 5.0), expected)


def least_total(distances, missed):
    """By scipy on the matrix of Stone Soup: a column of each track's own for its missed detection."""
    count = len(distances)
    own = np.where(np.eye(count, dtype=bool), missed, 1e9)
    costs = np.concatenate([np.where(np.isfinite(distances), distances, 1e9), own], axis=1)
    return costs[linear_sum_assignment(costs)].sum()


@pytest.mark.parametrize("shape", [(6, 4), (4, 6)])
def test_assignment_has_the_least_total_distance(shape):
    rng = np.random.default_rng(0)
    better = 0
    for _ in range(200):
        distances = 6 * rng.random(shape)
        distances = np.where(distances < 4.0, distances, INF)

        def total(associated, distances=distances):
            used = associated[associated != NO_DETECTION]
            assert len(set(used.tolist())) == len(used)
            rows = np.flatnonzero(associated != NO_DETECTION)
            return distances[rows, associated[rows]].sum() + 4.5 * (shape[0] - len(rows))

        found = total(np.asarray(assign_all(jnp.asarray(distances), 4.5)))
        np.testing.assert_allclose(found, least_total(distances, 4.5), rtol=1e-5)
        better += found < total(np.asarray(associate(jnp.asarray(distances)))) - 1e-6
    assert better > 50


def test_every_associator_can_be_asked_for_by_name():
    assert tuple(ASSOCIATORS) == params_module.ASSOCIATORS
