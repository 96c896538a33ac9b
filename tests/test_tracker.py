"""One cycle of the tracker: order of the verbs, symmetries, masks, gradients, transformations."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxtrack import NO_DETECTION, Detections, Params, StaticParams, Tracks, lifecycle, tracker
from jaxtrack.models import inverse_elevation_bearing_range
from jaxtrack.types import NO_TRUTH

STEP = 7
DT = 0.1
# Detection 0 belongs to track 1, detection 1 to track 0; detection 2 is new; row 3 is empty.
DETECTED = np.array([[0.1, 0.3, 2003.0], [-0.2, 0.0, 2995.0], [0.4, 0.8, 5000.0], [0.0, 0.0, 4000.0]])
# Track 2 is lost and too uncertain; rows 3 and 4 are empty.
TRACKED = np.array([[-0.2, 0.0, 3000.0], [0.1, 0.3, 2000.0], [0.0, -0.5, 4000.0]])
step = jax.jit(tracker.step)


def scene_tracks(tracks_at):
    means = np.zeros((3, 6))
    means[:, 0::2] = inverse_elevation_bearing_range(jnp.asarray(TRACKED))
    means[:, 1::2] = [[3, -2, 1], [0, 5, 0], [1, 1, 1]]
    built = tracks_at(means, 5, birth_step=jnp.array([0, 1, 2, -1, -1]), age=jnp.array([6, 5, 4, 0, 0]))
    return built.replace(
        covariance=built.covariance.at[2].multiply(20.0), birth_detection=jnp.array([0, 1, 2, -1, -1])
    )


def scene_detections():
    return Detections.from_values(DETECTED, [True, True, True, False])


@pytest.fixture
def tracks(tracks_at):
    return scene_tracks(tracks_at)


@pytest.fixture
def detections():
    return scene_detections()


def by_birth(tracks):
    """Live tracks in the order of their identity, whatever their slots."""
    rows = np.flatnonzero(tracks.active)
    identity = sorted((int(tracks.birth_step[row]), int(tracks.birth_detection[row]), row) for row in rows)
    order = np.array([row for *_, row in identity], dtype=int)
    return jax.tree.map(lambda leaf: np.asarray(leaf)[order], tracks)


def assert_close(actual, expected, rtol=2e-5, atol=2e-3):
    jax.tree.map(lambda a, e: np.testing.assert_allclose(a, e, rtol=rtol, atol=atol), actual, expected)


def pad(record, rows, fill):
    """The record with `rows` more rows, all numbers of which are `fill`; the masks are False."""

    def extend(leaf):
        value = fill if jnp.issubdtype(leaf.dtype, jnp.floating) else 0
        return jnp.concatenate([leaf, jnp.full((rows, *leaf.shape[1:]), value, leaf.dtype)])

    return jax.tree.map(extend, record)


def poison(record):
    """The record with NaN in all numbers of its empty rows."""

    def fill(leaf):
        if not jnp.issubdtype(leaf.dtype, jnp.floating):
            return leaf
        return leaf.at[~record.active].set(jnp.nan)

    return jax.tree.map(fill, record)


def test_the_six_verbs_in_order(tracks, detections, params):
    after, info = step(tracks, detections, DT, STEP, params)
    np.testing.assert_array_equal(info.associated, [1, 0, NO_DETECTION, NO_DETECTION, NO_DETECTION])
    np.testing.assert_array_equal(info.deleted, [False, False, True, False, False])
    # The new track is born in the slot that became free on this very step.
    np.testing.assert_array_equal(info.initiated, [False, False, True, False, False])
    np.testing.assert_array_equal(after.active, [True, True, True, False, False])
    np.testing.assert_array_equal(after.updated_by, [1, 0, 2, NO_DETECTION, NO_DETECTION])
    np.testing.assert_array_equal(after.birth_step[:3], [0, 1, STEP])
    np.testing.assert_array_equal(after.age[:3], [7, 6, 0])
    np.testing.assert_allclose(info.predicted.mean[:2, 0], tracks.mean[:2, 0] + DT * tracks.mean[:2, 1])
    np.testing.assert_allclose(after.mean[:2], info.updated.mean[:2])
    np.testing.assert_allclose(after.mean[2, 4], 5000 * np.sin(0.4), rtol=1e-5)
    assert int(info.num_dropped) == 0


def test_an_empty_look_is_only_a_prediction(tracks, detections, params):
    blind = detections.replace(active=jnp.zeros(4, dtype=bool))
    after, info = step(tracks, blind, DT, STEP, params)
    np.testing.assert_array_equal(after.active, [True, True, False, False, False])
    np.testing.assert_array_equal(after.mean[:2], info.predicted.mean[:2])
    np.testing.assert_array_equal(after.covariance[:2], info.predicted.covariance[:2])
    np.testing.assert_array_equal(after.updated_by, [NO_DETECTION] * 5)


def test_a_newborn_survives_its_first_step_however_uncertain(detections):
    params = Params(deletion_threshold=100.0)  # three velocity variances alone are 2700
    born, _ = step(Tracks.empty(5), detections, DT, STEP, params)
    np.testing.assert_array_equal(born.active, [True, True, True, False, False])
    blind = detections.replace(active=jnp.zeros(4, dtype=bool))
    after, info = step(born, blind, DT, STEP + 1, params)
    assert not bool(jnp.any(after.active))
    np.testing.assert_array_equal(info.deleted, born.active)


def test_the_detection_of_a_track_just_deleted_starts_no_other(tracks, detections):
    after, info = step(tracks, detections, DT, STEP, Params(deletion_threshold=100.0))
    np.testing.assert_array_equal(info.deleted, [True, True, True, False, False])
    np.testing.assert_array_equal(after.birth_detection[after.active], [2])


def test_a_full_track_list_counts_what_it_drops(tracks, detections, params):
    certain = jnp.broadcast_to(100 * jnp.eye(6), (5, 6, 6))
    elsewhere = jnp.zeros((2, 6)).at[:, 0].set(8000.0).at[:, 2].set(jnp.array([100.0, -100.0]))
    full = tracks.replace(
        covariance=certain, active=jnp.ones(5, dtype=bool), mean=tracks.mean.at[3:].set(elsewhere)
    )
    after, info = step(full, detections, DT, STEP, params)
    assert int(info.num_dropped) == 1
    np.testing.assert_array_equal(after.birth_step, full.birth_step)
    jax.tree.map(np.testing.assert_array_equal, after, info.updated)


def test_the_tracker_never_reads_which_truth_caused_a_detection(tracks, detections, params):
    told = detections.replace(truth=jnp.array([2, 1, 0, NO_TRUTH]))
    results = [step(tracks, each, DT, STEP, params) for each in (detections, told)]
    jax.tree.map(np.testing.assert_array_equal, *results)


def test_permuting_slots_permutes_the_result(tracks, detections, params):
    order = jnp.array([4, 2, 1, 3, 0])
    shuffled = jax.tree.map(lambda leaf: leaf[order], tracks)
    after, _ = step(tracks, detections, DT, STEP, params)
    after_shuffled, info = step(shuffled, detections, DT, STEP, params)
    np.testing.assert_array_equal(info.associated, [-1, -1, 0, -1, 1])
    np.testing.assert_array_equal(info.deleted, [False, True, False, False, False])
    assert_close(by_birth(after_shuffled), by_birth(after))


def test_permuting_detections_permutes_the_association(tracks, detections, params):
    order = jnp.array([3, 1, 2, 0])
    shuffled = jax.tree.map(lambda leaf: leaf[order], detections)
    after, _ = step(tracks, detections, DT, STEP, params)
    after_shuffled, info = step(tracks, shuffled, DT, STEP, params)
    np.testing.assert_array_equal(info.associated[:3], [1, 3, NO_DETECTION])
    np.testing.assert_array_equal(after_shuffled.active, after.active)
    assert_close((after_shuffled.mean, after_shuffled.covariance), (after.mean, after.covariance))


@pytest.mark.parametrize("fill", [0.0, np.nan])
def test_more_empty_rows_change_nothing(fill, tracks, detections, params):
    after, _ = step(tracks, detections, DT, STEP, params)
    padded, info = step(pad(tracks, 2, fill), pad(detections, 2, fill), DT, STEP, params)
    np.testing.assert_array_equal(info.initiated, [False, False, True, False, False, False, False])
    assert_close(by_birth(padded), by_birth(after))


def test_nan_in_empty_rows_changes_no_bit(tracks, detections, params):
    clean = step(tracks, detections, DT, STEP, params)
    poisoned = step(poison(tracks), poison(detections), DT, STEP, params)
    jax.tree.map(np.testing.assert_array_equal, poisoned, clean)


def loss(params, tracks, detections):
    """A smooth function of everything the step returns about live tracks, and the track list."""
    after, _ = tracker.step(tracks, detections, params.time_step, STEP, params)
    live = after.active.astype(after.mean.dtype)
    traces = jnp.trace(after.covariance, axis1=1, axis2=2)
    return jnp.sum(live @ after.mean) + jnp.sum(live * traces), after


def floating(record):
    """Only the leaves that can have a gradient."""
    return [leaf for leaf in jax.tree.leaves(record) if jnp.issubdtype(leaf.dtype, jnp.floating)]


loss_and_gradient = jax.jit(jax.value_and_grad(loss, argnums=(0, 1, 2), has_aux=True, allow_int=True))


@pytest.mark.usefixtures("quick_compilation")
def test_gradients_are_finite_and_blind_to_empty_rows(x64, tracks, detections):
    params = jax.tree.map(lambda number: jnp.asarray(float(number)), Params(time_step=DT))
    _, clean = loss_and_gradient(params, tracks, detections)
    _, poisoned = loss_and_gradient(params, poison(tracks), poison(detections))
    jax.tree.map(np.testing.assert_array_equal, floating(poisoned), floating(clean))
    by_params, by_tracks, by_detections = clean
    assert all(np.all(np.isfinite(leaf)) for leaf in floating(clean))
    # Empty rows have no influence: neither rows 3 and 4 of the tracks nor row 3 of the detections.
    assert not np.any(by_tracks.mean[3:])
    assert not np.any(by_detections.value[3])
    assert np.all(np.any(by_detections.value[:3] != 0, axis=-1))
    for name in ("time_step", "range_sigma", "bearing_sigma", "process_noise", "prior_velocity_sigma"):
        epsilon = 1e-4 * float(getattr(params, name))
        low, high = (
            loss_and_gradient(
                params.replace(**{name: getattr(params, name) + sign * epsilon}), tracks, detections
            )[0][0]
            for sign in (-1, 1)
        )
        np.testing.assert_allclose(getattr(by_params, name), (high - low) / (2 * epsilon), rtol=1e-4)


def test_a_step_returns_the_types_it_takes(params):
    # Otherwise a loop over steps compiles twice.
    tracks, detections = Tracks.empty(2), Detections.from_values(DETECTED[:1])
    after, _ = jax.eval_shape(tracker.step, tracks, detections, DT, STEP, params)
    types = [
        jax.tree.map(lambda leaf: (leaf.shape, leaf.dtype, leaf.weak_type), each) for each in (tracks, after)
    ]
    assert types[0] == types[1]


def test_compiled_equals_eager(tracks, detections, params):
    compiled = step(tracks, detections, DT, STEP, params)
    assert_close(compiled, tracker.step(tracks, detections, DT, STEP, params), rtol=1e-4, atol=1e-2)


def test_a_batch_equals_a_loop(tracks, detections, params):
    scenes = [
        (tracks, detections),
        (Tracks.empty(5), detections),
        (tracks, detections.replace(active=jnp.zeros(4, dtype=bool))),
    ]
    batch = jax.tree.map(lambda *leaves: jnp.stack(leaves), *scenes)
    batched, _ = jax.jit(jax.vmap(tracker.step, in_axes=(0, 0, None, None, None)))(*batch, DT, STEP, params)
    for row, scene in enumerate(scenes):
        alone, _ = step(*scene, DT, STEP, params)
        assert_close(by_birth(jax.tree.map(lambda leaf, row=row: leaf[row], batched)), by_birth(alone))


@pytest.fixture(scope="module")
def single(tracks_at, params):
    """The scene's next track list, computed before double precision is switched on."""
    return step(scene_tracks(tracks_at), scene_detections(), DT, STEP, params)[0]


def test_single_precision_agrees_with_double(single, x64, tracks, detections):
    params = jax.tree.map(lambda number: jnp.asarray(float(number)), Params(time_step=DT))
    (_, double), _ = loss_and_gradient(params, tracks, detections)
    assert single.mean.dtype == jnp.float32
    assert double.mean.dtype == double.covariance.dtype == jnp.float64
    np.testing.assert_array_equal(single.updated_by, double.updated_by)
    np.testing.assert_allclose(single.mean[:3], double.mean[:3], rtol=1e-5, atol=0.05)


SEVERAL = StaticParams(initiator="multi_measurement", min_points=3)
follow = jax.jit(tracker.step, static_argnames="static")


def play(scans, static, params=None, time_step=0.1):
    """The track lists after scans, each a list of detections; all have room for two."""
    params, tracks, lists = params or Params(), lifecycle.no_tracks(3, static), []
    for index, scan in enumerate(scans):
        value = np.array([*scan, *[[0.0, 0.0, 1000.0]] * (2 - len(scan))])
        detections = Detections.from_values(value, np.arange(2) < len(scan))
        tracks, info = follow(tracks, detections, time_step, index, params, static=static)
        lists.append((tracks, info))
    return lists


HERE, THERE = [0.1, 0.2, 3000.0], [-0.3, 0.7, 5000.0]


@pytest.mark.usefixtures("quick_compilation")
def test_a_tentative_track_enters_with_its_third_detection():
    """With a miss between; then it is the tracker's own, and its detections start no other."""
    lists = play([[HERE], [], [HERE, THERE], [THERE, HERE], [HERE]], SEVERAL)
    np.testing.assert_array_equal([int(t.active.sum()) for t, _ in lists], [0, 0, 0, 1, 1])
    np.testing.assert_array_equal([int(t.tentative.active.sum()) for t, _ in lists], [1, 1, 2, 1, 1])
    entered, info = lists[3]
    assert info.initiated.tolist() == [True, False, False]
    assert (entered.birth_step[0], entered.birth_detection[0]) == (0, 0)
    assert (entered.age[0], entered.updated_by[0], entered.counts.hits[0]) == (3, 1, 3)
    assert lists[4][1].associated.tolist() == [0, NO_DETECTION, NO_DETECTION]


@pytest.mark.usefixtures("quick_compilation")
def test_tentative_tracks_are_deleted_too():
    static = dataclasses.replace(SEVERAL, deleters=("update_time_steps",))
    lists = play([[HERE, THERE], [HERE], [HERE], [THERE]], static, Params(deletion_steps=2))
    # The other is missed twice and gone; its next detection starts a new one.
    np.testing.assert_array_equal(lists[-1][0].tentative.birth_step[lists[-1][0].tentative.active], [3])
    np.testing.assert_array_equal([int(t.active.sum()) for t, _ in lists], [0, 0, 1, 1])


PARTS = [
    {"filter": "extended"},
    {"filter": "cubature", "associator": "global_nearest_neighbour"},
    {"filter": "converted", "deleters": ("update_time", "update_time_steps"), "intersect_deleters": True},
    {"initiator": "multi_measurement", "min_points": 1},
    {"covariance_form": "square_root"},
]


@pytest.mark.usefixtures("quick_compilation")
@pytest.mark.parametrize("parts", PARTS, ids=lambda parts: "-".join(map(str, parts.values())))
def test_other_parts_keep_the_rules_of_a_step(parts, tracks, detections):
    """Types are kept, NaN in empty rows changes no bit, an empty look is only a prediction."""
    static, params = StaticParams(**parts), Params(deletion_time=1.0, deletion_steps=5)
    start = lifecycle.no_tracks(5, static)
    more = {"counts": start.counts, "tentative": start.tentative}
    if start.root is not None:
        tracks = tracks.replace(root=jnp.nan_to_num(jnp.linalg.cholesky(tracks.covariance)))
    scenes = [
        (tracks.replace(**more), detections),
        (poison(tracks).replace(**more), poison(detections)),
        (tracks.replace(**more), detections.replace(active=jnp.zeros(4, dtype=bool))),
    ]
    batch = jax.tree.map(lambda *leaves: jnp.stack(leaves), *scenes)
    step_all = jax.jit(jax.vmap(lambda *scene: tracker.step(*scene, DT, STEP, params, static)))
    after, info = jax.device_get(step_all(*batch))
    kinds = [jax.tree.map(lambda leaf: (leaf.shape, leaf.dtype), each) for each in (batch[0], after)]
    assert kinds[0] == kinds[1]
    clean, poisoned, blind = (
        jax.tree.map(lambda leaf, row=row: leaf[row], (after, info)) for row in range(3)
    )
    jax.tree.map(np.testing.assert_array_equal, poisoned, clean)
    assert clean[1].associated.tolist()[:2] == [1, 0]
    np.testing.assert_array_equal(blind[0].mean, blind[1].predicted.mean)


def test_a_list_without_tentative_tracks_is_refused(detections, params):
    with pytest.raises(ValueError, match=r"^tracks.tentative = None: expected"):
        follow.trace(Tracks.empty(5), detections, DT, STEP, params, static=SEVERAL)
