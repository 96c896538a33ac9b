"""Metrics by hand values, and GOSPA against a search over all assignments."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from jaxtrack import Params, Tracks, Truths, metrics
from jaxtrack.assignment import assign
from jaxtrack.kernel import one_by_one

gospa = jax.jit(metrics.gospa)
gospa_over_time = jax.jit(metrics.gospa_over_time)
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


@pytest.fixture
def crowds(tracks_at):
    """64 scenes of 4 truths and 6 tracks, some absent; in about half of them pairs compete."""
    rng = np.random.default_rng(0)
    state = np.zeros((64, 4, 6))
    state[..., 0::2] = rng.uniform(0, 300, (64, 4, 3))
    mean = np.pad(state, ((0, 0), (0, 2), (0, 0))) + 40 * rng.normal(size=(64, 6, 6))
    tracks = jax.vmap(lambda mean: tracks_at(mean, 6))(mean).replace(
        active=jnp.asarray(rng.random((64, 6)) < 0.8)
    )
    return Truths(jnp.asarray(state), jnp.asarray(rng.random((64, 4)) < 0.8)), tracks


@pytest.mark.usefixtures("x64")
@pytest.mark.parametrize("order", [1.0, 2.0])
def test_scenes_where_no_pairs_compete_need_no_algorithm(crowds, order):
    distances = np.asarray(jax.vmap(metrics.position_distances)(*crowds))
    close = distances < 100.0
    compete = (close.sum(axis=1) > 1).any(axis=1) | (close.sum(axis=2) > 1).any(axis=1)
    assert 10 < compete.sum() < 54
    costs = np.minimum(distances, 100.0) ** order
    by_algorithm = np.asarray(jax.jit(jax.vmap(assign))(costs))[..., None]
    paid = np.take_along_axis(costs, by_algorithm, axis=2)[..., 0]
    assigned = np.where(paid < 100.0**order, by_algorithm[..., 0], -1)
    params = PARAMS.replace(gospa_order=order)
    found, pairs = jax.jit(jax.vmap(metrics._gospa, in_axes=(0, 0, None)))(*crowds, params)
    np.testing.assert_array_equal(pairs, assigned[..., None] == np.arange(6))
    np.testing.assert_allclose(found.localisation, np.where(assigned >= 0, paid, 0).sum(axis=1), rtol=1e-12)


def test_gospa_is_the_same_alone_in_batches_in_a_scan_and_inside_another_kernel(crowds):
    over = lambda function: jax.vmap(function, in_axes=(0, 0, None))  # noqa: E731
    alone = [gospa(*jax.tree.map(lambda leaf, i=i: leaf[i], crowds), PARAMS).distance for i in range(64)]
    squares = jax.tree.map(lambda leaf: leaf.reshape(8, 8, *leaf.shape[1:]), crowds)
    rows = lambda _, scenes: (None, over(metrics.gospa)(*scenes, PARAMS))  # noqa: E731
    for found in (
        jax.jit(over(metrics.gospa))(*crowds, PARAMS),
        jax.jit(over(over(metrics.gospa)))(*squares, PARAMS),
        jax.jit(lambda scenes: jax.lax.scan(rows, None, scenes)[1])(squares),
        jax.jit(over(one_by_one(metrics.gospa)))(*crowds, PARAMS),
    ):
        np.testing.assert_allclose(found.distance.ravel(), alone, rtol=1e-6)


def test_gospa_can_be_differentiated(crowds):
    truths, tracks = crowds
    distance = lambda mean, truths, tracks: metrics.gospa(truths, tracks.replace(mean=mean), PARAMS).distance  # noqa: E731
    value, found = jax.jit(jax.vmap(jax.value_and_grad(distance)))(tracks.mean, truths, tracks)
    step = 1e-3 * found  # too short to change the assignment
    rise = jax.jit(jax.vmap(distance))(tracks.mean + step, truths, tracks) - value
    np.testing.assert_allclose(rise, jnp.sum(found * step, axis=(1, 2)), atol=2e-4)


def test_the_assignments_of_a_batch_are_one_kernel(crowds):
    """Otherwise everything still works, many times slower."""
    together = jax.jit(jax.vmap(metrics.gospa, in_axes=(0, 0, None)))
    text = together.lower(*crowds, PARAMS).compile().as_text()
    entry = text[text.index("ENTRY") :]
    assert 'xla_cpu_small_call="true"' in entry
    assert " while(" not in entry


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


def over_time(scene, tracks, births, alive=None, **numbers):
    """GOSPA over time with tracks [K, T] on the x axis, one truth at 0, and birth steps [K, T].

    A birth step of -1 is an empty slot.
    """
    steps = []
    for row, (at, born) in enumerate(zip(tracks, births, strict=True)):
        here = True if alive is None else alive[row]
        truth, track_list = scene([0.0], at, [here], [step >= 0 for step in born])
        steps.append((truth, track_list.replace(birth_step=jnp.array(born))))
    record = jax.tree.map(lambda *leaves: jnp.stack(leaves), *steps)
    return gospa_over_time(*record, PARAMS.replace(gospa_switching_penalty=50.0, **numbers))


def test_a_change_of_track_costs_the_penalty_once(scene):
    result = over_time(scene, [[10.0]] * 4, [[0], [0], [2], [2]])
    np.testing.assert_allclose(result.switching, [0, 0, 50, 0], atol=1e-6)
    np.testing.assert_allclose(result.distance, [10, 10, np.hypot(10, 50), 10], rtol=1e-5)


def test_tracks_born_on_one_step_differ_by_their_detection(scene):
    truth, tracks = scene([0.0], [10.0])
    first, second = (tracks.replace(birth_detection=jnp.array([row])) for row in (0, 1))
    record = jax.tree.map(lambda *leaves: jnp.stack(leaves), (truth, first), (truth, second))
    result = gospa_over_time(*record, PARAMS.replace(gospa_switching_penalty=50.0))
    np.testing.assert_allclose(result.switching, [0, 50], atol=1e-6)


def test_losing_and_regaining_a_track_cost_half_each_and_the_first_is_free(scene):
    # 500 m is beyond the cut-off: the truth has no track, although one lives.
    result = over_time(scene, [[500.0], [10.0], [500.0], [500.0], [10.0]], [[0]] * 5)
    half = 50 * np.sqrt(0.5)
    np.testing.assert_allclose(result.switching, [0, 0, half, 0, half], rtol=1e-6)


def test_a_step_without_any_track_or_without_the_truth_keeps_the_history(scene):
    # Not seeing a single track is not counted as losing one; coming back to the same is free.
    result = over_time(scene, [[10.0]] * 3, [[0], [-1], [0]])
    np.testing.assert_allclose(result.switching, 0, atol=1e-6)
    result = over_time(scene, [[10.0]] * 3, [[0], [0], [5]], alive=[True, False, True])
    np.testing.assert_allclose(result.switching, [0, 0, 50], atol=1e-6)


def test_the_penalty_takes_the_order_but_joins_the_distance_squared(scene):
    births = [[0, 1], [1, 0]]
    result = over_time(scene, [[10.0, 300.0]] * 2, births, gospa_order=1.0)
    # One truth, one track, one false track: 10 + 100 / 2.
    np.testing.assert_allclose(result.distance, [60, np.hypot(60, 50)], rtol=1e-5)
    two = over_time(scene, [[500.0], [10.0], [500.0]], [[0]] * 3, gospa_order=3.0)
    np.testing.assert_allclose(two.switching, [0, 0, 50 * 0.5 ** (1 / 3)], rtol=1e-5)


def test_an_empty_row_of_the_record_changes_no_switching(scene):
    # The track moves from one slot to the other: it is the same one by its birth.
    result = over_time(scene, [[10.0, np.nan], [np.nan, 10.0]], [[0, -1], [-1, 0]])
    np.testing.assert_allclose(result.switching, 0, atol=1e-6)
    np.testing.assert_allclose(result.distance, 10.0, rtol=1e-5)


def test_a_single_step_has_no_switching(scene):
    result = gospa(*scene([0.0], [10.0]), PARAMS.replace(gospa_switching_penalty=50.0))
    assert float(result.switching) == 0.0
    np.testing.assert_allclose(result.distance, 10.0, rtol=1e-5)


@pytest.fixture
def record():
    """Four steps, three truths of which the last never lives, two slots with three tracks."""
    alive = np.array([[1, 0, 0], [1, 1, 0], [1, 1, 0], [0, 0, 0]], dtype=bool)
    active = np.array([[0, 0], [1, 0], [1, 1], [1, 1]], dtype=bool)
    # Slot 0 holds one track, then on the last step another; slot 1 holds a third.
    birth_step = np.array([[-1, -1], [1, -1], [1, 2], [3, 2]])
    tracks = jax.vmap(lambda _: Tracks.empty(2))(jnp.arange(4))
    truths = Truths(state=jnp.full((4, 3, 6), jnp.nan), alive=jnp.asarray(alive))
    return truths, tracks.replace(active=jnp.asarray(active), birth_step=jnp.asarray(birth_step))


def test_basic_metrics_count_distinct_tracks_and_truths_that_ever_lived(record):
    result = jax.jit(metrics.basic_metrics)(*record)
    assert (int(result.num_tracks), int(result.num_truths)) == (3, 2)
    assert float(result.track_to_target_ratio) == 1.5
    # 0/1, 1/2, 2/2; the last step has no truth.
    np.testing.assert_allclose(result.mean_ratio, 0.5)


def test_basic_metrics_of_an_empty_record_are_zero(record):
    truths, tracks = jax.tree.map(jnp.zeros_like, record)
    assert [float(value) for value in jax.tree.leaves(metrics.basic_metrics(truths, tracks))] == [0, 0, 0, 0]


def test_a_slot_begins_anew_with_another_birth_only(record):
    _, tracks = record
    expected = [[0, 0], [1, 0], [0, 1], [1, 0]]
    np.testing.assert_array_equal(metrics.begins(tracks), np.array(expected, dtype=bool))
    # The same track after a gap is no new one; another detection of the same step is.
    gap = tracks.replace(
        active=jnp.array([[1, 1], [0, 0], [1, 1], [1, 1]], dtype=bool),
        birth_step=jnp.array([[0, 0], [7, 7], [0, 0], [0, 0]]),
        birth_detection=jnp.array([[0, 1], [5, 5], [0, 2], [0, 2]]),
    )
    expected = [[1, 1], [0, 0], [0, 1], [0, 0]]
    np.testing.assert_array_equal(metrics.begins(gap), np.array(expected, dtype=bool))
