"""Metrics by hand values, and GOSPA against a search over all assignments."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from jaxtrack import Params, metrics

gospa = jax.jit(metrics.gospa)
PARAMS = Params(gospa_cutoff=100.0, gospa_order=2.0, deletion_threshold=5000.0)


@pytest.fixture
def scene(tracks_at, truths_at):
    """Truths and tracks on the x axis, of which the given ones live."""

    def build(truths, tracks, truth_alive=None, track_active=None):
        means = np.zeros((len(tracks), 6))
        means[:, 0] = tracks
        track_list = tracks_at(means, len(tracks))
        if track_active is not None:
            track_list = track_list.replace(active=jnp.array(track_active))
        return truths_at([[x, 0, 0] for x in truths], truth_alive), track_list

    return build


def test_gospa_of_one_good_pair_is_its_distance(scene):
    result = gospa(*scene([1000.0], [1030.0]), PARAMS)
    np.testing.assert_allclose(result.distance, 30.0, rtol=1e-5)
    np.testing.assert_allclose([result.localisation, result.missed, result.false], [900, 0, 0], rtol=1e-5)


def test_gospa_pays_half_the_cutoff_for_missed_and_false(scene):
    # Truth 0 has a track 60 m away, truth 1 none; the second track belongs to nobody.
    result = gospa(*scene([0.0, 5000.0], [60.0, 9000.0]), PARAMS)
    parts = [result.localisation, result.missed, result.false]
    np.testing.assert_allclose(parts, [3600, 5000, 5000], rtol=1e-5)
    np.testing.assert_allclose(result.distance, np.sqrt(13_600), rtol=1e-5)


def test_gospa_of_order_one(scene):
    result = gospa(*scene([0.0, 5000.0], [60.0]), PARAMS.replace(gospa_order=1.0))
    np.testing.assert_allclose(result.distance, 60 + 50, rtol=1e-5)


def test_gospa_assigns_globally_not_greedily(scene):
    # Greedy would take 0 -> 10 first and leave 30 -> -50; the best total is 50^2 + 20^2.
    result = gospa(*scene([0.0, 30.0], [10.0, -50.0]), PARAMS)
    np.testing.assert_allclose(result.localisation, 50**2 + 20**2, rtol=1e-5)


@pytest.mark.parametrize(
    ("truths", "tracks", "expected"), [(0, 0, [0, 0]), (2, 0, [10_000, 0]), (0, 2, [0, 10_000])]
)
def test_gospa_when_one_side_is_empty(truths, tracks, expected, scene):
    alive, active = jnp.arange(2) < truths, jnp.arange(2) < tracks
    result = gospa(*scene([0.0, 1.0], [0.0, 1.0], alive, active), PARAMS)
    np.testing.assert_allclose([result.missed, result.false], expected)
    np.testing.assert_allclose(result.distance, np.sqrt(sum(expected)), rtol=1e-6)


def test_absent_rows_never_count_even_if_nan(scene):
    truths, tracks = scene([0.0, 40.0], [5.0, 7.0], [True, False], [False, True])
    truths = truths.replace(state=truths.state.at[1].set(jnp.nan))
    tracks = tracks.replace(mean=tracks.mean.at[0].set(jnp.nan))
    np.testing.assert_allclose(gospa(truths, tracks, PARAMS).distance, 7.0, rtol=1e-5)
    assert float(metrics.completeness(truths, tracks, PARAMS)) == 1.0


coordinates = st.lists(st.integers(-150, 150).map(float), min_size=3, max_size=3)
flags = st.lists(st.booleans(), min_size=3, max_size=3)


@given(coordinates, coordinates, flags, flags)
def test_gospa_equals_the_best_of_all_assignments(scene, truths, tracks, alive, active):
    result = gospa(*scene(truths, tracks, alive, active), PARAMS)
    xs = [x for x, lives in zip(truths, alive, strict=True) if lives]
    ys = [y for y, lives in zip(tracks, active, strict=True) if lives]
    short, long = sorted((xs, ys), key=len)
    best = min(
        sum(min(abs(a - b), 100.0) ** 2 for a, b in zip(short, chosen, strict=True))
        for chosen in itertools.permutations(long, len(short))
    )
    expected = np.sqrt(best + 5000.0 * (len(long) - len(short)))
    np.testing.assert_allclose(result.distance, expected, rtol=1e-5, atol=1e-3)
    parts = result.localisation + result.missed + result.false
    np.testing.assert_allclose(parts, expected**2, rtol=1e-5, atol=1e-2)


def test_completeness_is_the_share_of_living_truths_with_a_track_in_reach(scene):
    # 99 m is within the cut-off, 100 m is not, the third truth has no track, the fourth is dead.
    truths, tracks = scene([0.0, 1000.0, 5000.0, 9000.0], [99.0, 1100.0, 9000.0], [True, True, True, False])
    np.testing.assert_allclose(metrics.completeness(truths, tracks, PARAMS), 1 / 3, rtol=1e-6)
    nobody = truths.replace(alive=jnp.zeros(4, dtype=bool))
    assert float(metrics.completeness(nobody, tracks, PARAMS)) == 0.0


def test_uncertainty_per_truth_by_hand(scene):
    truths, tracks = scene([0.0, 1000.0, 5000.0, 9000.0], [10.0, -20.0, 1010.0], [True, True, True, False])
    covariance = jnp.zeros((3, 6, 6)).at[:, 0, 0].set(jnp.array([700.0, 300.0, 9000.0]))
    tracks = tracks.replace(covariance=covariance)
    # Truth 0: the more certain of two near tracks. Truth 1: capped at the threshold. Truth 2: none.
    expected = (300 + 5000 + 5000) / 3
    np.testing.assert_allclose(metrics.uncertainty_per_truth(truths, tracks, PARAMS), expected, rtol=1e-6)
    fewer = tracks.replace(active=jnp.array([True, False, False]))
    np.testing.assert_allclose(
        metrics.uncertainty_per_truth(truths, fewer, PARAMS), (700 + 5000 + 5000) / 3, rtol=1e-6
    )


def test_norm_sum_and_mean_count_live_tracks_only(scene):
    _, tracks = scene([0.0], [0.0, 0.0, 0.0], None, [True, False, True])
    covariance = jnp.zeros((3, 6, 6)).at[:, 2, 3].set(jnp.array([10.0, jnp.nan, -30.0]))
    tracks = tracks.replace(covariance=covariance)
    assert float(metrics.covariance_norm_sum(tracks)) == pytest.approx(40.0)
    assert float(metrics.covariance_norm_mean(tracks)) == pytest.approx(20.0)
    none = tracks.replace(active=jnp.zeros(3, dtype=bool))
    assert float(metrics.covariance_norm_mean(none)) == 0.0


def test_distances_ignore_velocity(scene):
    truths, tracks = scene([3.0], [0.0])
    tracks = tracks.replace(mean=jnp.array([[0.0, 50.0, 4.0, 50.0, 12.0, 50.0]]))
    np.testing.assert_allclose(metrics.position_distances(truths, tracks), [[13.0]], rtol=1e-6)
